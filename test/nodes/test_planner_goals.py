"""Goals of a planner: flown to, announced, resumed, planned in the background, and refused.

And what its parameters and its robot do.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.parameter import Parameter
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import JointState
from support.planner_flight import (
    HERE,
    NEAR,
    TOPICS,
    TURNED,
    Flight,
    Place,
    goal_at,
    pose_arrays,
    stamp_of,
    values_of,
)
from support.plant_rig import SLIDERS, TICK_NS
from support.ros_harness import Harness, nanoseconds
from support.sentences import assert_one_sentence

from spacerobot_ros.nodes.common.messages import goal_of
from spacerobot_ros.planning import METHODS, GaitSchedule
from spacerobot_ros.planning.execution.goal_file import (
    BASE_GOAL_KEY,
    GoalFile,
    IdentifiedGoal,
    PursuedGoals,
)
from spacerobot_ros.planning.methods.lie_bracket import LieBracketGait


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
    # Every state was answered with one command of its stamp.
    states = [stamp_of(m) for m in flight.probe.messages["joint_states"]]
    commands = [stamp_of(m) for m in flight.probe.messages["joint_commands"]]
    assert states == [k * TICK_NS for k in range(len(states))]
    assert commands == states[: len(commands)]
    assert len(states) - len(commands) <= 1
    for message in flight.probe.messages["joint_commands"]:
        assert list(message.name) == SLIDERS
        assert np.all(np.isfinite([*message.position, *message.velocity]))


def changed(place: Place = NEAR, frame: str = "world", **fields: float) -> PoseStamped:
    goal = goal_at(place, frame)
    for name, value in fields.items():
        part = goal.pose.orientation if name.startswith("q") else goal.pose.position
        setattr(part, name[-1], value)
    return goal


REFUSED = {
    "beyond the stroke": (
        # 16 kg / 2 kg times 0.4 m is 3.2 m of slide.
        changed(x=-0.4, y=0.0, z=0.0),
        ("beyond the stroke", "'slider_1'", "3.2 m", "[-2.5, 2.5] m"),
    ),
    "another frame": (changed(frame="moon"), ("'moon'", "'world'", "/tf")),
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
    flight.send(NEAR)
    flight.wait("executing")
    flight.ticks(10)
    # One that is refused now does not disturb the one that is flown.
    flight.send(REFUSED["beyond the stroke"][0])
    flight.wait("refused")
    flight.wait("reached")
    refused = ["refused"] * len(REFUSED)
    assert flight.states == ["idle", *refused, "executing", "refused", "reached"]
    assert max(flight.error_to(NEAR)) <= 1e-3
    assert len(flight.probe.messages["gait_schedule"]) == 1


def test_the_schedule_is_what_is_flown_and_stays_for_late_readers(harness: Harness) -> None:
    """With a slide and a turn, from a pose and a shape that are not zero."""
    flown = Flight(
        harness,
        {"position_tolerance": 2e-3, "attitude_tolerance": 2e-3},
        {
            "initial_position": [1.0, -0.5, 0.25],
            "initial_orientation": Rotation.from_rotvec([0.4, -0.3, 0.2]).as_quat().tolist(),
            "initial_joint_positions": [0.2, -0.1, 0.15],
        },
    )
    status = flown.decide(([1.01, -0.52, 0.26], [0.41, -0.31, 0.215]))
    assert values_of(status)["state"] == "reached", status.message
    (schedule,), (path,) = (flown.probe.messages[t] for t in ("gait_schedule", "planned_path"))
    assert list(schedule.joint_names) == SLIDERS
    assert schedule.header.frame_id == "base_link"
    measured = {stamp_of(m): m for m in flown.probe.messages["joint_states"]}
    start = stamp_of(schedule)
    assert len(schedule.points) > 100
    for k, point in enumerate(schedule.points):
        assert nanoseconds(point.time_from_start) == k * TICK_NS
        state = measured[start + k * TICK_NS]
        np.testing.assert_allclose(point.positions, state.position, rtol=0, atol=1e-9)
        if k:
            held = schedule.points[k - 1].velocities
            np.testing.assert_allclose(held, state.velocity, rtol=0, atol=1e-9)
    assert list(schedule.points[-1].velocities) == [0.0] * 3
    # The path fits the schedule.
    assert path.header.stamp == schedule.header.stamp
    assert stamp_of(path.poses[0]) == stamp_of(schedule)
    times = [stamp_of(knot) - stamp_of(schedule) for knot in path.poses]
    assert times == sorted(set(times))
    assert times[-1] == nanoseconds(schedule.points[-1].time_from_start)
    status = next(
        values_of(s)
        for s in flown.probe.messages["planner/status"]
        if values_of(s)["state"] == "executing"
    )
    assert float(status["duration_s"]) == pytest.approx(times[-1] / 1e9)
    assert status["method"] == "lie_bracket"
    # Three 2 kg masses on the axes of a 10 kg base: the centre of mass is at q / 8, and it rests.
    centres = []
    for at, knot in zip(times, path.poses, strict=True):
        position, attitude = pose_arrays(knot.pose)
        shape = np.array(schedule.points[at // TICK_NS].positions)
        centres.append(position + attitude.apply(shape / 8))
    np.testing.assert_allclose(centres, np.tile(centres[0], (len(centres), 1)), atol=1e-12)
    # Schedule, path and status are there for a late reader.
    latched = ("gait_schedule", "planned_path", "planner/status")
    late = harness.probe({t: TOPICS[t] for t in latched}, latched=latched, name="late")
    harness.spin_until(lambda: all(late.count(t) for t in latched), "the latched topics")
    for topic in latched:
        assert late.count(topic) == 1
        assert late.last(topic) == flown.probe.last(topic)


REAL_TIME = {"time_mode": "realtime"}


class Gate:
    """Holds every plan back until it is opened."""

    def __init__(self) -> None:
        self.open = threading.Event()
        self.waiting = threading.Event()

    def held(self, plan: Callable[..., GaitSchedule]) -> Callable[..., GaitSchedule]:
        def wait(*args: Any, **options: Any) -> GaitSchedule:
            self.waiting.set()
            assert self.open.wait(30.0)
            return plan(*args, **options)

        return wait


@pytest.fixture
def gate(monkeypatch: pytest.MonkeyPatch) -> Iterator[Gate]:
    gate = Gate()
    assert METHODS["lie_bracket"] is LieBracketGait
    monkeypatch.setattr(LieBracketGait, "plan", gate.held(LieBracketGait.plan))
    yield gate
    gate.open.set()


@pytest.fixture
def flight(harness: Harness) -> Flight:
    return Flight(harness, {"abort_time": 0.5}, REAL_TIME)


def speeds(flight: Flight, since: int = 0) -> list[float]:
    """The largest commanded velocities, by state."""
    return [max(map(abs, m.velocity)) for m in flight.probe.messages["joint_commands"][since:]]


def test_states_are_answered_at_rest_until_the_plan_is_there(flight: Flight, gate: Gate) -> None:
    flight.send(NEAR)
    flight.start()
    flight.harness.spin_until(gate.waiting.is_set, "the planner plans")
    flight.ticks(40)
    assert flight.states[-1] != "executing"
    assert not any(speeds(flight))
    gate.open.set()
    flight.wait("executing")
    flight.wait("reached")
    assert flight.error_to(NEAR)[0] < 1e-3
    assert any(speeds(flight))
    # One command for a state, with its stamp; where states pile up, for the last of them.
    flight.plant.trigger_deactivate()
    flight.harness.settle(flight.probe)
    stamps = [m.header.stamp for m in flight.probe.messages["joint_commands"]]
    states = [nanoseconds(m.header.stamp) for m in flight.probe.messages["joint_states"]]
    answered = [nanoseconds(stamp) for stamp in stamps]
    assert answered == sorted(set(answered))
    assert set(answered) <= set(states)
    assert len(answered) > 0.5 * len(states)
    assert flight.probe.count("gait_schedule") >= 1


def interrupted(harness: Harness, path: Path) -> Flight:
    """Start a planner whose predecessor was flying to a goal; time stands still."""
    goal = goal_of(goal_at(TURNED), "world")
    GoalFile(str(path)).pursue(PursuedGoals({BASE_GOAL_KEY: IdentifiedGoal(goal, "7.000000000")}))
    flight = Flight(harness, {"robot": "", "resume_file": str(path)})
    status = flight.wait("waiting")
    assert values_of(status)["goal_id"] == "7.000000000"
    assert path.exists()
    return flight


def test_a_goal_is_flown_to_once_the_robot_is_known(harness: Harness, tmp_path: Path) -> None:
    path = tmp_path / "goal.json"
    flight = interrupted(harness, path)
    flight.start()
    assert values_of(flight.wait("reached"))["goal_id"] == "7.000000000"
    assert max(flight.error_to(TURNED)) <= 1e-3
    assert not path.exists()


def test_a_goal_that_is_aborted_before_is_not_flown_to(harness: Harness, tmp_path: Path) -> None:
    path = tmp_path / "goal.json"
    flight = interrupted(harness, path)
    answer = flight.trigger("planner/abort")
    assert answer.success
    # Who follows the goal learns of its end.
    status = flight.wait("aborted")
    assert values_of(status)["goal_id"] == "7.000000000"
    assert answer.message == status.message
    assert not path.exists()
    flight.start()
    flight.ticks(20)
    assert "executing" not in flight.states
    assert list(flight.probe.last("joint_states").velocity) == [0.0] * 3
    assert not flight.trigger("planner/abort").success, "nothing is pursued"
    # A new goal is.
    assert values_of(flight.decide(NEAR))["state"] == "reached"
    assert max(flight.error_to(NEAR)) <= 1e-3


def test_goals_that_replace_each_other_do_not_repeat_what_is_executed(
    harness: Harness, capfd: pytest.CaptureFixture[str]
) -> None:
    flight = Flight(harness)
    flight.send(TURNED)
    flight.start()
    flight.wait("executing")
    flight.plant.trigger_deactivate()
    for _ in range(7):
        flight.send(NEAR)
    harness.spin_until(lambda: flight.all_states.count("aborted") == 6, "all but one are replaced")
    assert capfd.readouterr().err.count("Executing") == 1


def test_a_goal_has_the_shape_that_was_wanted_before_it(harness: Harness, tmp_path: Path) -> None:
    path = tmp_path / "goal.json"
    flight = Flight(harness, {"resume_file": str(path)})
    shapes = flight.probe.create_publisher(JointState, "goal_joint_states", 10)
    harness.connect()
    names = ["slider_3", "slider_1", "slider_2"]
    shapes.publish(JointState(name=names, position=[0.3, 0.1, 0.2]))
    harness.spin_until(lambda: flight.planner.goal_shape is not None, "the shape is received")
    flight.send(NEAR)
    flight.start()
    harness.spin_until(path.exists, "the goal is pursued")
    goal = GoalFile(str(path)).load()[BASE_GOAL_KEY].goal
    assert goal.joint_positions is not None
    assert goal.joint_positions.tolist() == [0.1, 0.2, 0.3]
    # A message without joints lets later goals end in any.
    shapes.publish(JointState())
    harness.spin_until(lambda: flight.planner.goal_shape is None, "the shape is free")


# -- managed life -----------------------------------------------------------------------------


def test_a_deactivated_planner_is_silent_and_goes_on_when_activated(harness: Harness) -> None:
    flight = Flight(harness)
    flight.send(NEAR)
    flight.start()
    flight.wait("executing")
    flight.ticks(10)
    flight.planner.trigger_deactivate()
    harness.settle(flight.probe)
    commands = flight.probe.count("joint_commands")
    flight.send(TURNED)
    harness.settle(flight.probe)
    assert flight.probe.count("joint_commands") == commands
    flight.planner.trigger_activate()
    flight.ticks(5)
    assert list(flight.probe.last("joint_states").velocity) == [0.0] * 3, "the goal was given up"
    assert values_of(flight.decide(NEAR))["state"] == "reached"


def test_a_planner_that_is_configured_again_in_flight_is_shown_the_state_it_has_missed(
    harness: Harness,
) -> None:
    flight = Flight(harness)
    flight.send(NEAR)
    flight.start()
    flight.wait("executing")
    # No time between these: the plant sees as many subscriptions as before.
    for name in ("deactivate", "cleanup", "configure", "activate"):
        trigger = getattr(flight.planner, f"trigger_{name}")
        assert trigger() is TransitionCallbackReturn.SUCCESS
    harness.connect()
    flight.ticks(5)
    assert values_of(flight.decide(NEAR))["state"] == "reached"


# -- parameters -------------------------------------------------------------------------------


def test_a_planner_that_is_configured_again_finds_its_robot_again(harness: Harness) -> None:
    flight = Flight(harness, {"robot": ""})
    assert values_of(flight.decide(NEAR))["state"] == "reached"
    flight.plant.trigger_deactivate()
    for step in ("deactivate", "cleanup"):
        assert getattr(flight.planner, f"trigger_{step}")() is TransitionCallbackReturn.SUCCESS
    outputs = ("joint_commands", "planner/status", "gait_schedule", "planned_path")
    harness.spin_until(
        lambda: not any(map(flight.probe.count_publishers, outputs)), "the end of its topics"
    )
    assert flight.planner.trigger_configure() is TransitionCallbackReturn.SUCCESS
    harness.connect()
    assert flight.planner.trigger_activate() is TransitionCallbackReturn.SUCCESS
    assert values_of(flight.decide(HERE))["state"] == "reached"
    assert flight.error_to(HERE)[0] < 1e-3


def test_abortion_brings_the_joints_to_rest(harness: Harness) -> None:
    flight = Flight(harness)
    flight.send(NEAR)
    flight.start()
    flight.wait("executing")
    answer = flight.trigger("planner/abort")
    assert answer.success
    assert_one_sentence(answer.message, "brake along the planned path")
    status = flight.wait("aborted")
    assert status.level == DiagnosticStatus.WARN
    assert_one_sentence(status.message, answer.message)
    flight.ticks(10**9 // TICK_NS + 3)  # abort_time, and commands that were on their way.
    assert list(flight.probe.last("joint_states").velocity) == [0.0] * 3
    assert flight.states == ["idle", "executing", "aborted"]
    answer = flight.trigger("planner/abort")
    assert not answer.success
    assert answer.message


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
    tight = [Parameter(f"{what}_tolerance", value=1e-6) for what in ("position", "attitude")]
    assert [result.successful for result in flight.planner.set_parameters(tight)] == [True, True]
    status = flight.wait("reached", "failed")
    assert values_of(status)["state"] == "reached", status.message
    assert max(flight.error_to(TURNED)) <= 1e-6
    corrections = int(values_of(status)["corrections"])
    assert corrections >= 1
    assert flight.states == ["idle", "executing", *["executing"] * corrections, "reached"]
    assert len(flight.probe.messages["gait_schedule"]) == 1 + corrections


def stamped(place: Place, sec: int, nanosec: int) -> PoseStamped:
    goal = goal_at(place)
    goal.header.stamp.sec, goal.header.stamp.nanosec = sec, nanosec
    return goal


def ids_of(flight: Flight) -> list[tuple[str, str]]:
    """States with the ids of the goals that they speak of."""
    values = [values_of(status) for status in flight.probe.messages["planner/status"]]
    found = [(value["state"], value.get("goal_id", "")) for value in values]
    return [each for each in found if each[0] not in ("idle", "planning", "waiting")]


def test_statuses_name_the_goal_by_its_stamp(harness: Harness) -> None:
    flight = Flight(harness)
    flight.decide(stamped(NEAR, 3, 5))
    flight.decide(NEAR)
    refused = stamped(NEAR, 4, 123456789)
    refused.header.frame_id = "moon"
    flight.decide(refused)
    assert ids_of(flight) == [
        ("executing", "3.000000005"),
        ("reached", "3.000000005"),
        ("executing", "unstamped-1"),
        ("reached", "unstamped-1"),
        ("refused", "4.123456789"),
    ]
