"""A goal of the planner node that is replaced, aborted or corrected while it is flown."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger
from support.planner_flight import NEAR, TURNED, Flight, stamp_of, values_of
from support.plant_rig import TICK_NS
from support.ros_harness import Harness, nanoseconds
from support.sentences import assert_one_sentence

pytestmark = pytest.mark.usefixtures("one_plant")

Array = npt.NDArray[np.float64]

URDF = Path(__file__).parents[2] / "urdf"


# -- preemption and abortion ------------------------------------------------------------------


def test_a_new_goal_replaces_the_one_that_is_flown(harness: Harness) -> None:
    flight = Flight(harness)
    flight.send(([-0.1, 0.0, 0.05], [0.0, 0.0, 0.0]))
    flight.start()
    flight.wait("executing")
    flight.ticks(15)
    assert any(flight.probe.last("joint_states").velocity), "the first goal is being flown"
    flight.decide(TURNED)
    assert flight.states == ["idle", "executing", "executing", "reached"]
    distance, angle = flight.error_to(TURNED)
    assert max(distance, angle) <= 1e-3
    first, second = flight.probe.messages["gait_schedule"]
    ends = stamp_of(first) + nanoseconds(first.points[-1].time_from_start)
    assert stamp_of(first) < stamp_of(second) < ends
    # The second begins at the shape that the first had come to.
    at_switch = next(
        m for m in flight.probe.messages["joint_states"] if stamp_of(m) == stamp_of(second)
    )
    np.testing.assert_array_equal(second.points[0].positions, at_switch.position)
    # No joint stops dead: what was flown comes to rest before the second gait begins.
    after = next(
        m
        for m in flight.probe.messages["joint_states"]
        if stamp_of(m) == stamp_of(second) + TICK_NS
    )
    before, now = np.array(at_switch.velocity), np.array(after.velocity)
    assert np.abs(before).max() > 0.01
    assert np.abs(now - before).max() < 0.2 * np.abs(before).max()


def test_the_rest_is_planned_again_when_the_base_drifts_off_its_path(
    harness: Harness, tmp_path: Path
) -> None:
    """The base is heavier than the planner believes, so that it does not go where it should."""
    urdf = (URDF / "sliding_masses.urdf").read_text("utf-8")
    heavier = tmp_path / "heavier.urdf"
    heavier.write_text(urdf.replace('<mass value="10"/>', '<mass value="13"/>'), "utf-8")
    flight = Flight(
        harness, {"drift_position": 2e-3, "max_corrections": 10}, {"robot": str(heavier)}
    )
    flight.decide(NEAR)
    first, second = flight.probe.messages["gait_schedule"][:2]
    ends = stamp_of(first) + nanoseconds(first.points[-1].time_from_start)
    assert stamp_of(first) < stamp_of(second) < ends
    assert flight.states[-1] == "reached"
    assert max(flight.error_to(NEAR)) <= 1e-3


def test_small_drift_is_left_to_the_end(harness: Harness) -> None:
    flight = Flight(harness, {"drift_position": 2e-3, "drift_attitude": 2e-3})
    flight.decide(NEAR)
    assert flight.states == ["idle", "executing", "reached"]


def distance_from(path: Array, shape: Array) -> float:
    """Return how far a shape is from the polygon through the shapes of a path."""
    legs = np.diff(path, axis=0)
    lengths = np.maximum((legs**2).sum(axis=1), 1e-30)
    share = np.clip(((shape - path[:-1]) * legs).sum(axis=1) / lengths, 0.0, 1.0)
    nearest = path[:-1] + share[:, np.newaxis] * legs
    return float(np.linalg.norm(shape - nearest, axis=1).min())


def test_abortion_brings_the_joints_to_rest(harness: Harness) -> None:
    flight = Flight(harness)
    flight.send(NEAR)
    flight.start()
    flight.wait("executing")
    flight.ticks(15)
    assert any(flight.probe.last("joint_states").velocity)
    client = flight.probe.create_client(Trigger, "planner/abort")
    answer = harness.call(client, Trigger.Request())
    assert answer.success
    status = flight.wait("aborted")
    assert status.level == DiagnosticStatus.WARN
    assert_one_sentence(status.message)
    began = flight.probe.count("joint_states")
    flight.ticks(10**9 // TICK_NS + 3)  # abort_time, and commands that were on their way.
    braking = flight.probe.messages["joint_states"][began:]
    place = list(braking[-1].position)
    (schedule,) = flight.probe.messages["gait_schedule"]
    path = np.array([point.positions for point in schedule.points])
    for state in braking:
        assert distance_from(path, np.array(state.position)) < 1e-9, "it rests on its path"
    speeds = [np.abs(m.velocity).max() for m in braking]
    assert max(np.abs(np.diff(speeds))) < 0.5 * max(speeds), "and does not stop dead"
    flight.ticks(60)
    assert list(flight.probe.last("joint_states").position) == place
    assert list(flight.probe.last("joint_states").velocity) == [0.0] * 3
    assert flight.states == ["idle", "executing", "aborted"]
    answer = harness.call(client, Trigger.Request())
    assert not answer.success
    assert answer.message
    flight.decide(NEAR)
    assert flight.states[-1] == "reached"
    assert max(flight.error_to(NEAR)) <= 1e-3


def test_a_goal_that_waits_for_a_state_can_be_aborted(harness: Harness) -> None:
    flight = Flight(harness)
    flight.send(NEAR)
    harness.settle(flight.probe)
    harness.call(flight.probe.create_client(Trigger, "planner/abort"), Trigger.Request())
    flight.start()
    flight.ticks(10)
    assert not flight.probe.messages["gait_schedule"]


def test_a_reset_of_the_plant_does_not_keep_the_goal_from_being_met(harness: Harness) -> None:
    flight = Flight(harness)
    flight.send(NEAR)
    flight.start()
    flight.wait("executing")
    flight.ticks(15)
    harness.call(flight.probe.create_client(Trigger, "plant/reset"), Trigger.Request())
    flight.wait("reached", "failed")
    assert flight.states[-1] == "reached"
    assert max(flight.error_to(NEAR)) <= 1e-3


# -- corrections ------------------------------------------------------------------------------


def test_a_tolerance_that_is_tightened_in_flight_makes_corrections_happen(harness: Harness) -> None:
    # Wide tolerances and one large cycle: a first order that is some way off.
    flight = Flight(
        harness,
        {
            "position_tolerance": 0.1,
            "attitude_tolerance": 0.1,
            "lie_bracket.loop_area": 10.0,
            "max_corrections": 5,
        },
    )
    flight.send(TURNED)
    flight.start()
    flight.wait("executing")
    request = SetParameters.Request(
        parameters=[
            Parameter(f"{what}_tolerance", value=1e-6).to_parameter_msg()
            for what in ("position", "attitude")
        ]
    )
    client = flight.probe.create_client(SetParameters, "planner/set_parameters")
    assert [r.successful for r in harness.call(client, request).results] == [True, True]
    status = flight.wait("reached", "failed")
    assert values_of(status)["state"] == "reached", status.message
    assert max(flight.error_to(TURNED)) <= 1e-6
    corrections = int(values_of(status)["corrections"])
    assert corrections >= 1
    assert flight.states == ["idle", "executing", *["executing"] * corrections, "reached"]
    assert len(flight.probe.messages["gait_schedule"]) == 1 + corrections


def test_a_goal_that_is_missed_fails_with_a_sentence(harness: Harness) -> None:
    flight = Flight(
        harness,
        {
            "position_tolerance": 0.1,
            "attitude_tolerance": 0.1,
            "lie_bracket.loop_area": 10.0,
            "max_corrections": 0,
        },
    )
    flight.send(TURNED)
    flight.start()
    flight.wait("executing")
    flight.planner.set_parameters([Parameter("attitude_tolerance", value=1e-9)])
    status = flight.wait("failed")
    assert status.level == DiagnosticStatus.ERROR
    assert_one_sentence(status.message, "not reached", "0 correction(s)")
    flight.ticks(10)
    assert list(flight.probe.last("joint_states").velocity) == [0.0] * 3


def test_a_bad_change_in_flight_is_refused(harness: Harness) -> None:
    flight = Flight(harness)
    flight.send(NEAR)
    flight.start()
    flight.wait("executing")
    cases: list[tuple[str, Any, str]] = [
        ("position_tolerance", -1.0, "position_tolerance"),
        ("max_corrections", -1, "max_corrections"),
        # What follows rclpy itself refuses.
        ("attitude_tolerance", "small", "DOUBLE"),
        ("max_corrections", 2.5, "INTEGER"),
        ("tick_rate", 50.0, "tick_rate"),
    ]
    for name, value, mention in cases:
        before = flight.planner.get_parameter(name).value
        (result,) = flight.planner.set_parameters([Parameter(name, value=value)])
        assert not result.successful
        assert mention in result.reason
        assert flight.planner.get_parameter(name).value == before
    flight.wait("reached")
    assert max(flight.error_to(NEAR)) <= 1e-3
