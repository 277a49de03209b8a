"""What imperfect sensors measure of a robot and of a target, and what is reported."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import kstest
from support.effort_flights import robot_of
from support.oracles import Array, PinocchioOracle

from spacerobot_ros.errors import ParameterError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.parameters import configured
from spacerobot_ros.resources import robot_file, share_directory
from spacerobot_ros.simulation import InitialState, VelocityPlant
from spacerobot_ros.simulation.actuators import PlantWithFaults, build_plant
from spacerobot_ros.simulation.config import (
    PlantConfig,
    SensorConfig,
    TargetConfig,
    TargetSensorConfig,
)
from spacerobot_ros.simulation.sensors import NormalNumbers, ReportedState, Sensors, TargetSensors

TICK = 0.05
URDF = (share_directory() / "urdf" / "three_joint_arm.urdf").read_text("utf-8")
START = InitialState(
    position=np.array([1.0, -2.0, 0.5]),
    quaternion=Rotation.from_rotvec([0.4, -1.0, 0.7]).as_quat(),
    joint_positions=np.array([0.2, -0.4, 0.9]),
    angular_momentum=np.array([0.5, -0.2, 0.3]),
)


def test_noise_is_normal_independent_and_given_by_its_seed() -> None:
    count, size = 20_000, 18
    rows, others = (
        np.array([source.next_row() for _ in range(count)])
        for source in (NormalNumbers(7, size), NormalNumbers(8, size))
    )
    assert kstest(rows.ravel(), "norm").pvalue > 0.01
    # Of columns, of successive rows, of successive seeds: five standard deviations.
    correlations = np.corrcoef(np.hstack([rows[1:], rows[:-1], others[1:]]).T)
    assert np.abs(correlations - np.eye(3 * size)).max() < 5.0 / np.sqrt(count)
    again = NormalNumbers(7, size)
    np.testing.assert_array_equal([again.next_row() for _ in range(100)], rows[:100])
    # The first two numbers from the words of the generator of NumPy, by Box and Muller.
    one, two = (np.random.Philox(key=7).random_raw(2) >> 11) / 2.0**53
    radius, angle = np.hypot(*rows[0, :2]), np.arctan2(rows[0, 1], rows[0, 0]) % (2.0 * np.pi)
    np.testing.assert_allclose([np.exp(-(radius**2) / 2.0), angle / (2.0 * np.pi)], [one, two])


def measured_plant(
    errors: SensorConfig, tick: float, faults: tuple[str, ...] = ()
) -> tuple[PlantWithFaults, Sensors]:
    config = PlantConfig(actuation="velocity", tick_rate=1 / tick, faults=faults, sensors=errors)
    plant = PlantWithFaults(VelocityPlant(robot_of(URDF), tick, START), config)
    return plant, Sensors(plant, config)


class Flight:
    """A plant, its sensors, and everything they said beside the truth."""

    def __init__(self, config: SensorConfig, *faults: str, ticks: int, moving: bool = True) -> None:
        self.plant, self.sensors = measured_plant(config, TICK, faults)
        self.dropouts: list[bool] = []
        measured: list[Array] = []
        true: list[Array] = []
        for tick in range(ticks):
            self.sensors.measure()
            for rows, source in ((measured, self.sensors), (true, self.plant)):
                rows.append(np.concatenate([source.pose, source.twist, source.q, source.qdot]))
            self.dropouts.append(self.sensors.dropout)
            # To and fro: strokes are short.
            self.plant.step(np.array([0.1, -0.05, 0.1]) * (moving * (-1) ** (tick // 5)))
        self.measured, self.true = np.array(measured), np.array(true)

    def errors(self) -> dict[str, Array]:
        """Return what each group is off by, tick by tick; attitudes as rotation vectors in B."""
        off = self.measured - self.true
        turn = Rotation.from_quat(self.true[:, 3:7]).inv() * Rotation.from_quat(
            self.measured[:, 3:7]
        )
        return {
            "position": off[:, :3],
            "attitude": turn.as_rotvec(),
            "velocity": off[:, 7:10],
            "angular_velocity": off[:, 10:13],
            "joints": off[:, 13:16],
            "joint_rates": off[:, 16:],
        }


SIGMAS = {
    "position": 1e-3,
    "attitude": 9e-4,
    "velocity": 2e-3,
    "angular_velocity": 3e-3,
    "joints": 4e-3,
    "joint_rates": 5e-3,
}
NOISY = SensorConfig(
    position_noise=SIGMAS["position"],
    attitude_noise=SIGMAS["attitude"],
    velocity_noise=SIGMAS["velocity"],
    angular_velocity_noise=SIGMAS["angular_velocity"],
    joint_noise=SIGMAS["joints"],
    joint_rate_noise=SIGMAS["joint_rates"],
    seed=3,
)


def test_every_component_has_its_noise_and_no_mean() -> None:
    ticks = 3000
    flight = Flight(NOISY, ticks=ticks)
    assert flight.sensors.used
    np.testing.assert_allclose(np.linalg.norm(flight.measured[:, 3:7], axis=1), 1.0, atol=1e-12)
    for group, errors in flight.errors().items():
        sigma = SIGMAS[group]
        np.testing.assert_allclose(errors.std(axis=0), sigma, rtol=5 / np.sqrt(2 * ticks))
        assert np.abs(errors.mean(axis=0)).max() < 5 * sigma / np.sqrt(ticks)
        # No tick knows of the one before.
        lagged = np.sum(errors[1:] * errors[:-1], axis=0) / np.sum(errors**2, axis=0)
        assert np.abs(lagged).max() < 5 / np.sqrt(ticks)
    # A seed is a flight.
    again, other = (Flight(replace(NOISY, seed=s), ticks=50) for s in (3, 6))
    np.testing.assert_array_equal(again.measured, flight.measured[:50])
    np.testing.assert_array_equal(again.true, other.true)
    assert np.abs(again.measured - other.measured).max() > 1e-3


def test_one_noise_leaves_the_rest_exact() -> None:
    flight = Flight(SensorConfig(attitude_noise=1e-3), ticks=20)
    errors = flight.errors()
    assert np.abs(errors.pop("attitude")).min() > 0.0
    assert all(not error.any() for error in errors.values())


def test_biases_are_added_and_attitudes_turned_in_the_base() -> None:
    config = SensorConfig(
        position_bias=(0.1, 0.0, -0.2),
        attitude_bias=(0.0, 0.01, 0.0),
        joint_bias=(0.0, 0.003, -0.004),
    )
    flight = Flight(config, "sensor_bias position_y 0.5 at 0.5", ticks=20)
    errors = flight.errors()
    step = np.where(np.arange(20) >= 10, 0.5, 0.0)
    np.testing.assert_allclose(errors["position"][:, [0, 2]], np.tile([0.1, -0.2], (20, 1)))
    np.testing.assert_allclose(errors["position"][:, 1], step, atol=1e-15)
    np.testing.assert_allclose(errors["attitude"], np.tile([0.0, 0.01, 0.0], (20, 1)), atol=1e-12)
    np.testing.assert_allclose(errors["joints"], np.tile([0.0, 0.003, -0.004], (20, 1)), atol=1e-15)


def test_faults_of_sensors_come_and_go() -> None:
    flight = Flight(
        SensorConfig(position_noise=3e-3),
        "sensor_noise position 4e-3 at 50 until 100",
        "sensor_dropout odom at 10 until 11",
        "sensor_bias elbow_pitch 0.2 at 20 until 21",
        ticks=3000,
    )
    position = flight.errors()["position"]
    assert position[:1000].std() == pytest.approx(3e-3, rel=0.05)
    assert position[1000:2000].std() == pytest.approx(5e-3, rel=0.05), "variances add up"
    assert position[2000:].std() == pytest.approx(3e-3, rel=0.05)
    assert np.flatnonzero(flight.dropouts).tolist() == list(range(200, 220))
    biased = flight.errors()["joints"][:, 2]
    assert np.flatnonzero(biased).tolist() == list(range(400, 420))


def test_a_bias_of_other_joints_is_refused() -> None:
    with pytest.raises(ParameterError, match=r"'sensors.joint_bias' has 2 value.*has 3 joints"):
        Flight(SensorConfig(joint_bias=(0.1, 0.2)), ticks=1)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *((f"sensors.{group}_noise", 1e7) for group in ("position", "attitude", "joint_rate")),
        ("sensors.joint_noise", 1e200),
        ("sensors.position_bias", (0.0, -1e7, 0.0)),
        ("sensors.joint_bias", (1e300,)),
        ("command_timeout", 1e300),
        ("marker_period", 1e308),
        ("initial_position", (1e200, 0.0, 0.0)),
        ("angular_momentum", (0.0, 1e200, 0.0)),
    ],
)
def test_parameters_that_would_overflow_are_refused_by_name(name: str, value: object) -> None:
    with pytest.raises(ParameterError, match=name):
        configured(PlantConfig, {name: value})


@pytest.mark.parametrize(
    "fault",
    [
        "sensor_bias position_x 0.1",
        "sensor_noise joints 0.1",
        "sensor_dropout odom",
        "sensor_delay odom 0.1",
    ],
)
def test_sensors_that_will_fail_are_in_use_from_the_begin(fault: str) -> None:
    flight = Flight(SensorConfig(), f"{fault} at 5", ticks=1)
    assert flight.sensors.used
    assert not flight.sensors.is_imperfect
    assert not Flight(SensorConfig(), "joint_stuck elbow_pitch at 5", ticks=1).sensors.used


@pytest.mark.parametrize("config", [SensorConfig(), SensorConfig(position_bias=(0.3, -0.2, 0.1))])
@pytest.mark.parametrize(("tick", "delay"), [(0.05, 0.15), (0.1, 0.3)])
def test_a_delay_that_begins_in_flight_holds_the_present_pose_and_follows_it(
    config: SensorConfig, tick: float, delay: float
) -> None:
    """Whatever quotients round to, a delay of three ticks lasts three; a bias does not add up."""
    plant, sensors = measured_plant(config, tick)
    bias = np.array(config.position_bias)
    true, measured = [], []
    for number in range(14):
        if number == 6:
            plant.inject(f"sensor_delay odom {delay}")
        sensors.measure()
        true.append(plant.pose.copy())
        pose = sensors.pose if sensors.used else plant.pose
        measured.append(np.concatenate([pose[:3] - bias * sensors.used, pose[3:]]))
        plant.step(np.array([0.1, -0.05, 0.1]))
    held = 5 if bias.any() else 6  # Sensors in use remember the state before.
    expected = [*true[:6], *[true[max(held, number - 3)] for number in range(6, 14)]]
    np.testing.assert_allclose(measured, expected, rtol=0, atol=1e-15)
    assert np.ptp([pose[0] for pose in true]) > 1e-4


def test_actuators_and_sensors_draw_from_different_streams() -> None:
    """With one seed, no draw of one is among the first thousands of the other."""
    config = PlantConfig(
        faults=tuple(f"actuator_noise {name} 0.001" for name in robot_of(URDF).joint_names),
        sensors=SensorConfig(position_noise=1.0, seed=11),
    )
    plant = build_plant(robot_of(URDF), config, START)
    sensors = Sensors(plant, config)
    noises, errors = [], []
    for _ in range(300):
        sensors.measure()
        errors.append(sensors.pose[:3] - plant.pose[:3])
        plant.step(np.zeros(3))
        noises.append(plant.qdot / 0.001)
    of_actuators, of_sensors = np.ravel(noises), np.ravel(errors)
    assert of_actuators.std() == pytest.approx(1.0, abs=0.15)
    assert np.abs(of_actuators[:, None] - of_sensors).min() > 1e-9
    assert abs(np.corrcoef(of_actuators, of_sensors)[0, 1]) < 0.15


# -- measurements of a target: each error by itself, as published, and without new ones ----------


TARGET_TICK = 0.08


@dataclass
class Target:
    """The motion of a target."""

    target_pose: Array = field(default_factory=lambda: np.zeros(7))
    target_twist: Array = field(default_factory=lambda: np.zeros(6))


class Seen:
    """What sensors of a target say, tick by tick, beside the truth; None where they say nothing."""

    def __init__(self, ticks: int, seed: int = 5, **errors: Any) -> None:
        target_config = TargetConfig(sensors=configured(TargetSensorConfig, errors))
        config = PlantConfig(
            tick_rate=1 / TARGET_TICK, sensors=SensorConfig(seed=seed), target=target_config
        )
        target = Target()
        self.true: list[Array] = []
        self.measured: list[Array | None] = []
        for tick in range(ticks):
            turned = Rotation.from_rotvec([0.3 + 0.01 * tick, -0.5, 0.02 * tick])
            target.target_pose[:] = [1.0 + 0.1 * tick, -2.0, 0.03 * tick, *turned.as_quat()]
            target.target_twist[:] = [0.1, -0.2, 0.3 + 0.001 * tick, 0.05, 0.04, -0.06]
            if not tick:
                plant: Any = target
                self.sensors = TargetSensors(plant, config)
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
    seen = Seen(600, loss=0.3, rate=1 / (2 * TARGET_TICK))
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


# -- what a plant reports by topic, and that a new topic is an entry in the table and a ----------


SLIDERS = SpaceRobot.from_file(robot_file("sliding_masses"))
ARM = SpaceRobot.from_file(robot_file("three_joint_arm"))


def reported(robot: SpaceRobot, **parameters: Any) -> ReportedState:
    config = PlantConfig(**parameters)
    return ReportedState(build_plant(robot, config), config)


def names(state: ReportedState) -> list[str]:
    return [topic.name for topic in state.topics]


def test_named_links_are_where_pinocchio_sees_them_in_the_measured_state() -> None:
    named = ("link_3", "base_link", "link_1")
    config = PlantConfig(
        end_effectors=named,
        initial_position=(1.0, 2.0, 3.0),
        initial_orientation=(0.1, -0.5, 0.3, 0.8),
        initial_joint_positions=(0.3, -0.7, 0.5),
    )
    plant = build_plant(ARM, config)
    state = ReportedState(plant, config)
    oracle = PinocchioOracle(robot_file("three_joint_arm").read_text("utf-8"), ARM.joint_names)
    for fault in ("clear", f"sensor_bias {ARM.joint_names[1]} 0.4", "sensor_bias position_x 0.7"):
        plant.inject(fault)
        plant.step(np.array([0.1, -0.3, 0.2]))
        state.update()
        pose, q = state.quantities["measured_pose"], state.quantities["measured_q"]
        oracle.set_configuration(q, pose[3:], pose[:3])
        for name in named:
            R_WE, r_WE = oracle.frame_W(name)
            published = state.quantities[f"pose_of_{name}"]
            np.testing.assert_allclose(published[:3], r_WE, atol=1e-12)
            R = Rotation.from_quat(published[3:]).as_matrix()
            np.testing.assert_allclose(R, R_WE, atol=1e-12)
    assert names(state)[:3] == [f"{name}/pose" for name in named]
    with pytest.raises(ParameterError, match="'end_effectors' names 'claw'"):
        reported(ARM, end_effectors=("link_1", "claw"))
    with pytest.raises(ParameterError, match="name only one of them"):
        reported(ARM, end_effectors=("link_1", "link_1"))
