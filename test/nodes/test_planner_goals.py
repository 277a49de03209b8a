"""Goals of the planner node: met, or refused with the true reason."""

from __future__ import annotations

import math

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from support.planner_flight import HERE, NEAR, TURNED, Flight, Place, goal_at, stamp_of, values_of
from support.plant_rig import SLIDERS, TICK_NS
from support.ros_harness import Harness
from support.sentences import assert_one_sentence

pytestmark = pytest.mark.usefixtures("one_plant")


def test_a_goal_is_met_within_tolerance(harness: Harness) -> None:
    flight = Flight(harness, {"position_tolerance": 2e-3, "attitude_tolerance": 3e-4})
    status = flight.decide(TURNED)
    assert flight.states == ["idle", "executing", "reached"]
    distance, angle = flight.error_to(TURNED)
    assert distance <= 2e-3
    assert angle <= 3e-4
    values = values_of(status)
    assert status.level == DiagnosticStatus.OK
    assert status.name == "/planner"
    assert_one_sentence(status.message, "reached")
    assert float(values["position_error_m"]) == pytest.approx(distance, rel=1e-3, abs=1e-9)
    assert float(values["attitude_error_rad"]) == pytest.approx(angle, rel=1e-3, abs=1e-9)
    assert [float(x) for x in values["goal"].split()[:3]] == TURNED[0]
    assert values["corrections"] == "0"
    # The robot stays there.
    flight.ticks(20)
    assert flight.error_to(TURNED) == pytest.approx((distance, angle), abs=1e-9)
    assert flight.states[-1] == "reached"


def test_every_state_is_answered_with_one_command_of_its_stamp(harness: Harness) -> None:
    flight = Flight(harness)
    flight.decide(NEAR)
    flight.ticks(5)
    states = [stamp_of(m) for m in flight.probe.messages["joint_states"]]
    commands = [stamp_of(m) for m in flight.probe.messages["joint_commands"]]
    assert states == [k * TICK_NS for k in range(len(states))]
    assert commands == states[: len(commands)]
    assert len(states) - len(commands) <= 1
    for message in flight.probe.messages["joint_commands"]:
        assert list(message.name) == SLIDERS
        assert np.all(np.isfinite([*message.position, *message.velocity]))


def test_a_goal_without_a_frame_is_taken_in_the_world(harness: Harness) -> None:
    flight = Flight(harness, {"world_frame": "map"}, {"world_frame": "map"})
    flight.send(goal_at(NEAR, frame=""))
    flight.start()
    flight.wait("reached")
    assert flight.probe.last("planned_path").header.frame_id == "map"
    flight.send(goal_at(HERE, frame="world"))
    assert_one_sentence(flight.wait("refused").message, "'world'", "'map'")


def test_a_quaternion_of_any_length_is_an_attitude(harness: Harness) -> None:
    flight = Flight(harness)
    goal = goal_at(TURNED)
    o = goal.pose.orientation
    o.x, o.y, o.z, o.w = (-3.0 * value for value in (o.x, o.y, o.z, o.w))
    flight.send(goal)
    flight.start()
    flight.wait("reached")
    assert max(flight.error_to(TURNED)) <= 1e-3


def changed(place: Place = NEAR, frame: str = "world", **fields: float) -> PoseStamped:
    goal = goal_at(place, frame)
    for name, value in fields.items():
        part = goal.pose.orientation if name.startswith("q") else goal.pose.position
        setattr(part, name[-1], value)
    return goal


REFUSED = {
    "beyond stroke": (
        # 16 kg / 2 kg times 0.4 m is 3.2 m of slide.
        changed(x=-0.4, y=0.0, z=0.0),
        ("beyond stroke", "'slider_1'", "3.2 m", "[-2.5, 2.5] m"),
    ),
    "another frame": (changed(frame="moon"), ("'moon'", "'world'")),
    "position not a number": (changed(y=math.nan), ("position", "not finite")),
    "endless position": (changed(z=math.inf), ("position", "not finite")),
    "orientation not a number": (changed(qx=math.nan), ("orientation", "not finite")),
    "zero quaternion": (changed(qw=0.0), ("orientation", "zero quaternion")),
}


def test_what_cannot_be_done_is_refused_and_the_next_goal_flies(harness: Harness) -> None:
    flight = Flight(harness)
    flight.start()
    for goal, mentions in REFUSED.values():
        status = flight.decide(goal)
        assert flight.states[-1] == "refused"
        assert status.level == DiagnosticStatus.ERROR
        assert_one_sentence(status.message, *mentions)
    flight.ticks(3)
    assert not any(any(m.velocity) for m in flight.probe.messages["joint_states"])
    assert not flight.probe.messages["gait_schedule"]
    flight.decide(NEAR)
    assert flight.states == ["idle", *["refused"] * len(REFUSED), "executing", "reached"]
    assert max(flight.error_to(NEAR)) <= 1e-3


@pytest.mark.parametrize("case", ["beyond stroke", "another frame"])
def test_a_refused_goal_does_not_disturb_the_one_that_is_flown(harness: Harness, case: str) -> None:
    flight = Flight(harness)
    flight.send(NEAR)
    flight.start()
    flight.wait("executing")
    flight.ticks(10)
    flight.send(REFUSED[case][0])
    flight.wait("refused")
    flight.wait("reached")
    assert flight.states == ["idle", "executing", "refused", "reached"]
    assert max(flight.error_to(NEAR)) <= 1e-3
    assert len(flight.probe.messages["gait_schedule"]) == 1
