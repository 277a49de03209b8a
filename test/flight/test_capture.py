"""Flights that capture: the scenario, and the servicing arm."""

from __future__ import annotations

import math
import shutil
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from spacerobot_ros.bag import read_bag
from spacerobot_ros.bag.salvage import salvage_bag
from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.events import Event, EventKind
from spacerobot_ros.flight.flight import Flight
from spacerobot_ros.flight.lockstep import fly_scenario
from spacerobot_ros.flight.reading import namespaces, read_run
from spacerobot_ros.flight.series import Signal
from spacerobot_ros.flight.verification import verify_bag
from spacerobot_ros.scenario import load_scenario

TOPICS = ("/target/odom", "/momentum_expected", "/odom", "/joint_states")


@pytest.fixture(scope="module", autouse=True)
def _interpreted() -> Iterator[None]:
    """Simulate in CasADi's virtual machine: compiling would take longer than these flights."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SPACEROBOT_COMPILE", "0")
        yield


@pytest.fixture(scope="module")
def flight() -> Flight:
    return fly_scenario(load_scenario("capture"))


@pytest.fixture(scope="module")
def bag(flight: Flight, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("capture") / "capture.mcap"
    flight.save(path)
    return path


def test_the_block_is_captured_at_once_and_brought_to_rest(flight: Flight) -> None:
    """Figures by Pinocchio."""
    assert flight.succeeded
    assert [each.kind for each in flight.events if each.time_s == 0.0] == [
        EventKind.RUNNING,
        EventKind.GOAL_ACCEPTED,
        EventKind.CAPTURED,
    ]
    capture = flight.summary()["capture"]
    assert (capture["time_s"], capture["captured"], capture["requested"]) == (0.0, True, False)
    np.testing.assert_allclose(capture["joint_rates_radps"], [-0.0362457, 0.0809148], atol=5e-8)
    np.testing.assert_allclose(capture["impulse_Ns"][:2], [-0.110519, -0.065737], atol=5e-7)
    assert capture["energy_lost_J"] == pytest.approx(0.0048564, abs=5e-8)
    assert capture["total_momentum_residual"] < 1e-12
    # Thrusters have taken the momentum of the block away.
    assert np.abs(flight.momentum[1, :6]).max() > 0.2
    assert np.abs(flight.momentum[-1, :6]).max() < 0.02
    assert flight.momentum_drift.max() < 1e-14
    assert flight.target is not None
    assert flight.target.name == "block"


def test_a_capture_is_measured(flight: Flight, bag: Path) -> None:
    """The block is caught at once, 0.3 m from its centre, and there is no detumbling."""
    measures = flight.measures.capture
    assert (measures.captured, measures.placed, measures.time) == (1.0, 1.0, 0.0)
    assert measures.impulse == pytest.approx(math.hypot(0.110519, 0.065737), abs=1e-6)
    assert measures.angular_impulse == pytest.approx(0.035296, abs=1e-6)
    worst = np.abs(flight.capture["joint_impulses_Nms"]).max()
    assert measures.joint_impulse == worst > 0.0
    # By the published poses: the grapple frame is 0.3 m from the block's centre.
    hand, block = flight.signal("end_effector_pose").values[0], flight.signal("target_pose")
    frame = block.values[0, :3] + Rotation.from_quat(block.values[0, 3:]).apply([-0.3, 0.0, 0.0])
    assert measures.distance == pytest.approx(np.linalg.norm(frame - hand[:3]), abs=1e-12)
    assert measures.distance < 0.01
    assert math.isnan(measures.detumbling_time)
    assert math.isnan(measures.detumbling_bound)
    of_bag = asdict(read_run(bag).measures.capture)
    assert of_bag == pytest.approx(asdict(measures), rel=1e-12, nan_ok=True)


def test_without_a_capture_the_nearest_distance_is_measured(flight: Flight) -> None:
    """The end-effector does not come nearer than at the beginning, and the truth is measured."""
    missed = replace(flight, events=flight.events[:2], series=dict(flight.series))
    measures = missed.measures.capture
    assert (measures.captured, measures.placed) == (0.0, 0.0)
    assert math.isnan(measures.time)
    assert math.isnan(measures.impulse)
    assert measures.distance <= flight.measures.capture.distance
    shifted = flight.signal("target_pose").values + np.array([0.0, 0.0, 0.7, 0, 0, 0, 0])
    series = {**flight.series, "true_target_pose": Signal(flight.time, shifted)}
    apart = replace(missed, series=series).measures.capture.distance
    assert apart == pytest.approx(math.hypot(0.7, measures.distance), abs=1e-6)
    released = Event(EventKind.RELEASED, "The target is released.", 0, 0.5)
    let_go = replace(flight, events=(*flight.events, released)).measures.capture
    assert (let_go.captured, let_go.placed) == (1.0, 0.0)


def test_measured_targets_are_read_back_and_verified(tmp_path: Path) -> None:
    """With the truth beside them, and gaps where nothing was measured."""
    errors = {"position_noise": 0.004, "delay": 0.03, "loss": 0.25, "rate": 34.0}
    values = {f"target.sensors.{name}": value for name, value in errors.items()}
    scenario = load_scenario("capture").with_overrides("plant", values)
    flown = fly_scenario(scenario, longest=0.4)
    lost = flown.quantities["target_lost"][:, 0]
    assert 0.6 < lost.mean() < 0.95
    flown.save(tmp_path / "noisy.mcap")
    recorded = read_run(tmp_path / "noisy.mcap")
    seen, true = recorded.signal("target_pose"), recorded.signal("true_target_pose")
    np.testing.assert_array_equal(seen.values, flown.signal("target_pose").values[lost == 0.0])
    np.testing.assert_array_equal(true.values, flown.signal("true_target_pose").values)
    assert len(true.time) == len(flown.time) > len(seen.time) > 3
    assert verify_bag(tmp_path / "noisy.mcap").difference is None


def test_the_bag_of_a_capture_verifies_and_reads_as_it_was_flown(flight: Flight, bag: Path) -> None:
    found = verify_bag(bag)
    assert found.difference is None
    assert found.largest == 0.0
    assert set(TOPICS) <= set(found.topics)
    assert namespaces(read_bag(bag)) == [""]
    read = read_run(bag)
    assert read.capture == flight.capture
    np.testing.assert_array_equal(
        read.signal("target_pose").values, flight.signal("target_pose").values
    )
    assert read.target is not None
    assert read.target.base_link == "block"


def test_a_bag_that_was_cut_after_the_capture_is_salvaged_and_verifies(bag: Path) -> None:
    cut = bag.with_name("cut.mcap")
    shutil.copy(bag, cut)
    with cut.open("r+b") as file:
        file.truncate(int(bag.stat().st_size * 0.9))
    found = verify_bag(salvage_bag(cut).path)
    assert found.difference is None
    assert "/target/odom" in found.topics


def test_a_target_that_moved_otherwise_is_found(flight: Flight, bag: Path) -> None:
    pose = flight.signal("target_pose")
    values = pose.values.copy()
    values[100:, 1] += 1e-6
    series = {**flight.series, "target_pose": Signal(pose.time, values)}
    path = bag.with_name("moved.mcap")
    replace(flight, series=series).save(path)
    difference = verify_bag(path).difference
    assert difference is not None
    assert (difference.topic, difference.time) == ("/target/odom", 1.0)
    assert difference.field == "pose.pose.position.y"


def test_mujoco_does_not_capture(bag: Path) -> None:
    with pytest.raises(SpaceRobotError) as error:
        verify_bag(bag, mujoco=True)
    assert str(error.value) == (
        f"The bag {bag} has a target, which MuJoCo does not capture: verify it without the second "
        "engine."
    )


def test_a_block_that_passes_is_missed() -> None:
    flight = fly_scenario(load_scenario("faults/missed_capture"))
    summary = flight.summary()
    assert summary["capture"] == {"captured": False}
    assert (summary["succeeded"], summary["succeeded_by_measurement"]) == (False, True)
    assert summary["verdict"].startswith("The goal is reached, but the target is not captured: ")
    assert EventKind.CAPTURED not in {each.kind for each in flight.events}
    # It drifts past the end-effector.
    x = flight.signal("target_pose").values[:, 0]
    hand = flight.signal("end_effector_pose").values[:, 0]
    assert x[0] - 0.3 > hand[0]
    assert x[-1] - 0.3 < hand[-1]
    np.testing.assert_allclose(flight.momentum[:, :6], 0.0, atol=1e-6)


def test_a_flight_without_a_target_has_no_capture() -> None:
    scenario = load_scenario("coordinated_control").with_overrides(
        "coordinated_control", {"time_limit": 0.05}
    )
    flight = fly_scenario(scenario)
    assert flight.target is None
    assert flight.capture == {}
    assert "capture" not in flight.summary()


# -- A planar arm approaches a block, captures it, comes to rest and carries it, in few ----------


def test_a_planar_arm_fetches_a_block(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SPACEROBOT_COMPILE", "0")
    target = {
        "tick_rate": 5.0,
        "integration_step": 0.1,
        "clearance_period": 0.0,
        "target.position": (2.2, -0.1, 0.0),
        "target.velocity": (0.004, -0.003, 0.0),
        "target.angular_velocity": (0.0, 0.0, 0.02),
        "capture.speed": 0.02,
    }
    control = {
        "tick_rate": 5.0,
        "tasks": "approach detumble",
        "target.standoff": (-0.1, 0.0, 0.0),
        "target.standoff_time": 0.5,
        # The arm grasps obliquely, past a corner of the block.
        "target.clearance": 0.0,
        "detumble.grapple_torque_limit": 0.5,
        "max_torque": 2.0,
        "max_force": 5.0,
        "gains.base_position.kp": 0.5,
        "gains.base_position.kd": 1.4,
        "gains.base_attitude.kp": 1.0,
        "gains.base_attitude.kd": 2.0,
        "gains.end_effector_position.kp": 4.0,
        "gains.end_effector_position.kd": 4.0,
        "settle_time": 0.5,
        "position_tolerance": 0.1,
        "attitude_tolerance": 0.1,
    }
    scenario = load_scenario("capture").with_overrides("plant", target)
    flight = fly_scenario(scenario.with_overrides("coordinated_control", control), longest=120.0)
    assert flight.succeeded, flight.message
    kinds = [each.kind for each in flight.events]
    assert kinds[-4:] == [
        EventKind.CAPTURED,
        EventKind.DETUMBLE_STARTED,
        EventKind.DETUMBLED,
        EventKind.GOAL_REACHED,
    ]
    detumbling = flight.summary()["detumbling"]
    assert detumbling == {"time_s": flight.events[-2].time_s, **detumbling}
    assert detumbling["largest_torque_Nm"] == 2.0
    assert 0.0 < detumbling["shortest_s"] < detumbling["took_s"] < 30.0
    assert detumbling["grasp_torque_Nm"] <= 0.5 + 1e-9
    summed, expected = flight.momentum[:, :6], flight.signal("expected_momenta").values
    assert np.abs(summed - expected).max() < 1e-11
    assert np.abs(expected).max() > 0.05
