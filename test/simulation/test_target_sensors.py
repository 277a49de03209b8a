"""Measurements of a target: each error by itself, as published, and without new ones in between."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.oracles import Array

from spacerobot_ros.errors import ParameterError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.parameters import configured
from spacerobot_ros.resources import robot_file, share_directory
from spacerobot_ros.simulation.actuators import build_plant
from spacerobot_ros.simulation.config import PlantConfig, TargetSensorConfig
from spacerobot_ros.simulation.sensors import ReportedState, TargetSensors

TICK = 0.08


class Seen:
    """What sensors of a target say, tick by tick, beside the truth; None where they say nothing."""

    def __init__(self, ticks: int, seed: int = 5, **errors: Any) -> None:
        config = configured(TargetSensorConfig, errors)
        target = SimpleNamespace(target_pose=np.zeros(7), target_twist=np.zeros(6))
        self.true: list[Array] = []
        self.measured: list[Array | None] = []
        for tick in range(ticks):
            turned = Rotation.from_rotvec([0.3 + 0.01 * tick, -0.5, 0.02 * tick])
            target.target_pose[:] = [1.0 + 0.1 * tick, -2.0, 0.03 * tick, *turned.as_quat()]
            target.target_twist[:] = [0.1, -0.2, 0.3 + 0.001 * tick, 0.05, 0.04, -0.06]
            if not tick:
                plant: Any = target
                self.sensors = TargetSensors(plant, config, seed, TICK)
            self.sensors.measure()
            self.true.append(np.concatenate([target.target_pose, target.target_twist]))
            said = np.concatenate([self.sensors.pose, self.sensors.twist])
            self.measured.append(None if self.sensors.missing else said)

    def errors(self) -> Array:
        """Return the errors of position (W), attitude (T) and twist (N, 12)."""
        rows = []
        for true, said in zip(self.true, self.measured, strict=True):
            assert said is not None
            turn = Rotation.from_quat(true[3:7]).inv() * Rotation.from_quat(said[3:7])
            rows.append([*(said[:3] - true[:3]), *turn.as_rotvec(), *(said[7:] - true[7:])])
        return np.array(rows)


def test_sensors_without_errors_are_not_used() -> None:
    seen = Seen(3)
    assert not seen.sensors.used
    assert not seen.sensors.missing
    # They do not even follow.
    assert seen.measured[2] is not None
    np.testing.assert_array_equal(seen.measured[2], seen.true[0])


@pytest.mark.parametrize(
    ("name", "columns", "sigma"),
    [
        ("position_noise", slice(0, 3), 0.02),
        ("attitude_noise", slice(3, 6), 0.01),
        ("velocity_noise", slice(6, 9), 0.03),
        ("angular_velocity_noise", slice(9, 12), 0.04),
    ],
)
def test_a_noise_is_that_of_its_quantity_alone(name: str, columns: slice, sigma: float) -> None:
    error: dict[str, Any] = {name: sigma}
    seen = Seen(400, **error)
    assert seen.sensors.used
    errors = seen.errors()
    assert errors[:, columns].std(axis=0) == pytest.approx([sigma] * 3, rel=0.15)
    assert np.abs(errors[:, columns].mean(axis=0)).max() < 0.15 * sigma
    errors[:, columns] = 0.0
    np.testing.assert_allclose(errors, 0.0, atol=1e-14)


def test_biases_turn_with_the_target() -> None:
    bias, turn = np.array([0.02, -0.01, 0.03]), np.array([0.004, 0.006, -0.002])
    seen = Seen(9, position_bias=bias.tolist(), attitude_bias=turn.tolist())
    for true, error in zip(seen.true, seen.errors(), strict=True):
        in_world = Rotation.from_quat(true[3:7]).apply(bias)
        np.testing.assert_allclose(error[:3], in_world, atol=1e-14)
        np.testing.assert_allclose(error[3:6], turn, atol=1e-14)
    assert np.ptp(seen.errors()[:, :3], axis=0).max() > 1e-3


def test_a_delay_is_a_number_of_ticks_after_a_standstill() -> None:
    seen = Seen(7, delay=0.17)
    for tick, said in enumerate(seen.measured):
        assert said is not None
        np.testing.assert_allclose(said, seen.true[max(0, tick - 2)], atol=1e-15)


def test_a_rate_leaves_whole_ticks_between_measurements() -> None:
    seen = Seen(9, rate=1 / 0.26)
    assert [said is not None for said in seen.measured] == [True, False, False] * 3
    assert all(said is not None for said in Seen(4, rate=50.0).measured)


def test_measurements_are_lost_at_random() -> None:
    seen = Seen(600, loss=0.3, rate=1 / (2 * TICK))
    there = np.array([said is not None for said in seen.measured])
    assert not there[1::2].any()
    assert there[::2].mean() == pytest.approx(0.7, abs=0.06)
    assert not any(said is not None for said in Seen(20, loss=1.0).measured)


def test_a_seed_is_a_stream_of_its_own() -> None:
    noisy: dict[str, Any] = {"position_noise": 1.0, "loss": 0.4}
    first, again, other = (Seen(30, seed, **noisy) for seed in (5, 5, 6))
    for one, two in zip(first.measured, again.measured, strict=True):
        assert (one is None) is (two is None)
        if one is not None and two is not None:
            np.testing.assert_array_equal(one, two)
    assert [x is None for x in first.measured] != [x is None for x in other.measured]
    # The noise of the target is not that of the robot, nor that of its actuators.
    error = Seen(1, 5, position_noise=1.0).errors()[0, :3]
    sequence = np.random.SeedSequence(5)
    for stream in (np.random.default_rng(5), np.random.default_rng(sequence.spawn(1)[0])):
        assert np.abs(error[:, None] - stream.standard_normal(50)).min() > 1e-6


def test_the_truth_is_published_beside_measurements(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SPACEROBOT_COMPILE", "0")
    robot = SpaceRobot.from_file(robot_file("planar_manipulator"))
    block = str(share_directory() / "config" / "targets" / "block.urdf")
    values: dict[str, Any] = {"target.robot": block, "target.position": [3.0, 1.0, 2.0]}
    values |= {"target.sensors.position_bias": [0.5, 0.0, 0.0], "target.sensors.rate": 1e-3}
    config = configured(PlantConfig, values)
    plant = build_plant(robot, config)
    reported = ReportedState(plant, config)
    assert not reported.misses_target
    reported.update()
    assert not reported.misses_target
    topics = [topic.name for topic in reported.topics]
    assert topics.index("target/odom") + 1 == topics.index("target/odom_true")
    found = reported.quantities
    np.testing.assert_allclose(found["target_pose"][:3], [3.5, 1.0, 2.0])
    assert plant.capturing is not None
    assert found["true_target_pose"] is plant.capturing.target_pose
    assert found["true_target_twist"] is plant.capturing.target_twist
    reported.update()
    assert reported.misses_target


def test_errors_beyond_their_range_are_refused() -> None:
    for name, value in (("loss", 1.01), ("loss", -0.1), ("delay", 61.0), ("rate", -1.0)):
        with pytest.raises(ParameterError, match=name):
            configured(TargetSensorConfig, {name: value})
