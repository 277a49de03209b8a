"""Plans that take over while the joints move: when, from what state, and what else happens."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.planner_loop import (
    HERE,
    NEAR,
    TICK,
    TICK_NS,
    TURNED,
    Loop,
    MovingStub,
    PlantState,
    StubMethod,
    goal_at,
    robot_of,
)
from support.planner_phases import FAR, OTHER, stub_of, stuck

from spacerobot_ros.events import EventKind
from spacerobot_ros.planning import BasePath, GaitSchedule, Goal, RobotState
from spacerobot_ros.planning.execution.config import PlannerConfig
from spacerobot_ros.planning.execution.goal_file import BASE_GOAL_KEY, GoalFile
from spacerobot_ros.planning.execution.measured_states import BaseMeasurement, PathCheck
from spacerobot_ros.planning.execution.status import Phase, PlannerState
from spacerobot_ros.planning.execution.tracker import TrajectoryTracker
from spacerobot_ros.times import SECOND

AHEAD = 6
"""Ticks from the request to the take-over."""


def flying(ticks: int = 40, *, held: bool = False, **parameters: Any) -> Loop:
    """Fly to NEAR for ten ticks."""
    times = {"takeover_time": AHEAD * TICK, "abort_time": 0.5}
    loop = Loop({**times, **parameters}, method=MovingStub(ticks), held=held)
    loop.propose_goal(NEAR)
    loop.tick()
    if held:
        loop.held.release()
        loop.tick()
    loop.tick(10)
    return loop


def tracker_of(loop: Loop) -> TrajectoryTracker:
    """Return a tracker that has just begun the first schedule."""
    tracker = TrajectoryTracker(robot_of(), loop.config)
    tracker.start(loop.starts[0].schedule, loop.starts[0].stamp_ns, loop.config.averaging)
    return tracker


def phase_of(loop: Loop) -> Phase:
    return loop.executive.phase


# -- another goal -----------------------------------------------------------------------------


def test_a_plan_takes_over_at_its_tick_from_the_state_of_the_plant_then() -> None:
    loop = flying()
    now = len(loop.commands)
    loop.propose_goal(OTHER)
    loop.tick(AHEAD)
    first = loop.starts[0].schedule
    assert len(loop.starts) == 1, "it is not there yet"
    np.testing.assert_allclose(loop.commands[now:], first.velocities[now : now + AHEAD], atol=1e-12)
    loop.tick()
    second = loop.starts[1]
    assert second.stamp_ns == (now + AHEAD) * TICK_NS
    # What was predicted is where the plant has come to, and how it moves.
    request = stub_of(loop).requests[-1]
    assert request.motion is not None
    pose = loop.poses[now + AHEAD]
    np.testing.assert_allclose(request.state.q, loop.shapes[now + AHEAD], atol=1e-12)
    np.testing.assert_allclose(request.state.position, pose[:3], atol=1e-12)
    np.testing.assert_allclose(request.state.quaternion, pose[3:], atol=1e-12)
    np.testing.assert_allclose(request.motion.velocity, loop.commands[now + AHEAD - 1], atol=1e-12)
    np.testing.assert_array_equal(request.motion.remaining, first.positions[now + AHEAD :])
    np.testing.assert_allclose(loop.commands[-1], second.schedule.velocities[0], atol=1e-12)
    status = loop.until(PlannerState.REACHED)
    assert status.goal_id == "goal-2"
    assert loop.error_to(OTHER)[0] < 1e-3
    assert status.manoeuvre_time_s == pytest.approx(40 * TICK)
    assert loop.states == ["executing", "executing", "reached"]
    assert loop.event_kinds[-4:] == [
        ("plan_started", "goal-2"),
        ("plan_ready", "goal-2"),
        ("goal_accepted", "goal-2"),
        ("plan_taken_over", "goal-2"),
    ]
    taken = loop.events[-1]
    assert taken.time_s == second.stamp_ns / 1e9
    assert taken.about["reason"] == "new goal in motion"


def test_nothing_but_parameters_decides_when_a_plan_takes_over() -> None:
    """In the background the plan is there sooner or later: the flight is the same."""
    flights = []
    for released_after in (0, 2, AHEAD):
        loop = flying(held=True)
        loop.propose_goal(OTHER)
        loop.tick(released_after + 1 if released_after < AHEAD else AHEAD)
        loop.held.release()
        loop.until(PlannerState.REACHED)
        flights.append(np.array(loop.commands[:80]))
    np.testing.assert_array_equal(flights[0], flights[1])
    np.testing.assert_array_equal(flights[0], flights[2])
    # In lockstep the first plan is there a tick earlier.
    lockstep = flying()
    lockstep.propose_goal(OTHER)
    lockstep.until(PlannerState.REACHED)
    np.testing.assert_array_equal(np.array(lockstep.commands[:57]), flights[0][1:58])


def test_a_late_plan_is_tried_for_once_more_and_then_from_rest() -> None:
    loop = flying(ticks=80, held=True)
    loop.propose_goal(OTHER)
    loop.tick(AHEAD)
    for attempt in (1, 2):
        assert phase_of(loop) is Phase.REPLANNING
        assert len(loop.held.tasks) == 1 + attempt
        loop.tick()
        assert loop.held.cancelled
        assert phase_of(loop) is Phase.EXECUTING
        first = loop.starts[0].schedule.velocities[: len(loop.commands) - 1]
        np.testing.assert_allclose(np.array(loop.commands[1:]), first, atol=1e-12)
        if attempt == 1:
            loop.held.release()
            loop.tick(1 + 2 * AHEAD)
    loop.held.release()
    loop.tick()
    assert phase_of(loop) is Phase.BRAKING
    assert [kind for kind, _ in loop.event_kinds].count("plan_late") == 2
    loop.tick(20)
    assert phase_of(loop) is Phase.PLANNING
    loop.held.release()
    assert loop.until(PlannerState.REACHED).goal_id == "goal-2"


def test_a_goal_that_is_refused_in_motion_is_planned_for_from_rest(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    loop = flying()
    plan = StubMethod.plan

    def from_rest_only(self: StubMethod, request: Any, *rest: Any) -> Any:
        monkeypatch.setattr(stub_of(loop), "refusing", request.motion is not None)
        return plan(self, request, *rest)

    monkeypatch.setattr(MovingStub, "plan", from_rest_only)
    loop.propose_goal(OTHER)
    status = loop.until(PlannerState.REACHED)
    assert (status.goal_id, loop.error_to(OTHER)[0] < 1e-3) == ("goal-2", True)
    begin = "No plan that begins in motion was found, so planning is repeated from"
    assert [n for n in loop.notices if n.startswith(begin)] == [
        f"{begin} a later tick: It is too far.",
        f"{begin} rest: It is too far.",
    ]
    assert "refused" not in loop.states


def test_a_goal_that_is_refused_in_motion_is_planned_for_from_a_later_tick(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    loop = flying(ticks=80)
    plan, asked = StubMethod.plan, []

    def later_only(self: StubMethod, request: Any, *rest: Any) -> Any:
        asked.append(len(loop.commands))
        monkeypatch.setattr(stub_of(loop), "refusing", len(asked) == 1)
        return plan(self, request, *rest)

    monkeypatch.setattr(MovingStub, "plan", later_only)
    loop.propose_goal(OTHER)
    assert loop.until(PlannerState.REACHED).goal_id == "goal-2"
    begins = [round(start.stamp_ns / TICK_NS) for start in loop.starts]
    assert begins[1] == asked[1] + 2 * AHEAD
    assert all(t.target is not Phase.BRAKING for t in loop.transitions)


def test_a_goal_out_of_reach_leaves_the_earlier_one_as_it_is() -> None:
    loop = flying()
    loop.propose_goal(FAR)
    assert loop.until(PlannerState.REACHED).goal_id == "goal-1"
    assert loop.states == ["executing", "refused", "reached"]
    assert len(loop.starts) == 1
    assert loop.error_to(NEAR)[0] < 1e-3


@pytest.mark.parametrize("held", [False, True])
def test_of_many_goals_only_the_newest_is_planned_for(held: bool) -> None:
    loop = flying(held=held, ticks=80)
    for k in range(8):
        loop.propose_goal(([0.01 * k, 0.02, 0.0], [0.0, 0.0, 0.0]))
        loop.tick(2)
        loop.held.release()
        loop.tick(k % 2)
    newest = loop.decide(OTHER)
    assert (newest.state, newest.goal_id) == (PlannerState.REACHED, "goal-10")
    accepted = [goal for kind, goal in loop.event_kinds if kind == "goal_accepted"]
    assert accepted == ["goal-1", "goal-10"]
    assert len(loop.starts) == 2
    assert loop.error_to(OTHER)[0] < 1e-3


def test_a_plan_for_an_earlier_goal_is_cancelled_at_once() -> None:
    loop = flying(held=True, ticks=80)
    loop.propose_goal(([0.01, 0.02, 0.0], [0.0, 0.0, 0.0]))
    loop.tick(2)
    assert phase_of(loop) is Phase.REPLANNING
    assert not loop.held.cancelled
    loop.propose_goal(OTHER)
    assert loop.held.cancelled


def test_the_present_goal_once_more_goes_on_under_its_new_id(tmp_path: Path) -> None:
    loop = flying()
    loop.goal_file = GoalFile(str(tmp_path / "goal.json"))
    loop.propose_goal(NEAR)
    loop.tick()
    assert loop.goal_file.load()[BASE_GOAL_KEY].goal_id == "goal-2"
    assert loop.until(PlannerState.REACHED).goal_id == "goal-2"
    assert len(loop.starts) == 1
    assert [(s.state.value, s.goal_id) for s in loop.statuses] == [
        ("executing", "goal-1"),
        ("executing", "goal-2"),
        ("reached", "goal-2"),
    ]
    assert len(loop.commands) <= 43, "and takes no longer"


def test_what_is_planned_for_another_goal_is_aborted_with_all_goals(tmp_path: Path) -> None:
    for planned in (False, True):
        loop = flying(held=True)
        loop.goal_file = GoalFile(str(tmp_path / "goal.json"))
        loop.propose_goal(OTHER)
        loop.tick()
        if planned:
            loop.held.release()
            loop.tick()
            assert phase_of(loop) is Phase.TAKING_OVER
        assert loop.abort() == "The joints brake along the planned path within 0.5 s."
        status = loop.statuses[-1]
        assert (status.state, status.goal_id) == (PlannerState.ABORTED, "goal-2")
        loop.held.release()
        loop.tick(40)
        assert phase_of(loop) is Phase.IDLE
        assert len(loop.starts) == 1
        assert not (tmp_path / "goal.json").exists()
        assert not any(loop.speeds[-20:])


def test_joints_that_stick_before_the_take_over_have_the_new_goal_planned_from_rest() -> None:
    loop = flying(ticks=200, stuck_ticks=3, takeover_time=3.0)
    loop.propose_goal(OTHER)
    loop.tick()
    assert phase_of(loop) is Phase.TAKING_OVER
    stuck(loop)
    loop.plant.hold(np.zeros(3, dtype=np.bool_))
    assert loop.until(PlannerState.REACHED).goal_id == "goal-2"
    assert stub_of(loop).requests[-1].motion is None


def test_a_gap_in_the_states_over_the_take_over_tick_delays_nothing_that_follows() -> None:
    loop = flying(ticks=80)
    loop.propose_goal(OTHER)
    loop.tick()
    loop.measured.stamp_ns += (AHEAD + 3) * TICK_NS
    loop.tick()
    second = loop.starts[1]
    assert second.stamp_ns == (11 + AHEAD) * TICK_NS
    tick = (loop.measured.stamp_ns - TICK_NS - second.stamp_ns) // TICK_NS
    np.testing.assert_array_equal(loop.executive.setpoint.position, second.schedule.positions[tick])
    loop.until(PlannerState.REACHED)


@pytest.mark.parametrize(
    "parameters", [{"takeover_time": 0.0}, {"takeover_time": 1.6}], ids=["never", "too far"]
)
def test_where_no_plan_can_take_over_the_joints_brake(parameters: dict[str, Any]) -> None:
    for held in (False, True):
        loop = flying(held=held, **parameters)
        status = loop.decide(OTHER)
        assert (status.state, status.goal_id) == (PlannerState.REACHED, "goal-2")
        assert stub_of(loop).requests[-1].motion is None


# -- the remaining motion, again --------------------------------------------------------------


def test_the_remaining_motion_is_planned_again_where_it_leads_beside_the_goal() -> None:
    """The plant's base goes by half of what the plan says: with each plan less is left."""
    loop = flying(ticks=40, replan_period=0.5, max_corrections=0)
    stub_of(loop).wrong_path = 0.05
    loop.propose_goal(([0.05, 0.0, 0.0], [0.0, 0.0, 0.0]))
    loop.tick(200)
    taken = [event for event in loop.events if event.kind is EventKind.PLAN_TAKEN_OVER]
    reasons = [event.about["reason"] for event in taken]
    assert reasons[0] == "new goal in motion"
    assert set(reasons[1:]) == {"shrinking horizon"}
    stamps = [start.stamp_ns for start in loop.starts[1:]]
    assert min(np.diff(stamps)) >= 0.5e9
    assert {s.goal_id for s in loop.statuses[2:]} == {"goal-2"}


def test_a_motion_that_leads_to_the_goal_is_left_alone() -> None:
    loop = flying(ticks=80, replan_period=0.2)
    loop.until(PlannerState.REACHED)
    assert len(stub_of(loop).requests) == 1


def check_of(path: BasePath, average: int) -> PathCheck:
    """Return the check of a path with a pose a second, along which the sliders rest."""
    shapes = np.zeros((len(path.time), 3))
    goal = Goal(path.position[-1], path.quaternion[-1])
    schedule = GaitSchedule("any", robot_of().joint_names, 1.0, shapes, path, goal)
    return PathCheck(robot_of(), schedule, 0, PlannerConfig(), average)


def test_the_deviation_from_a_path_is_carried_to_its_end_as_a_rigid_motion() -> None:
    """A path in the world, and the same one seen from a base that is off by a rigid motion."""
    rng = np.random.default_rng(5)
    positions = rng.normal(size=(6, 3))
    attitudes = Rotation.random(6, random_state=7)
    path = BasePath(np.arange(6.0), positions, attitudes.as_quat())
    turn, shift = Rotation.from_rotvec([0.3, -0.5, 0.2]), np.array([0.4, 0.1, -0.2])
    moved, turned = turn.apply(positions) + shift, turn * attitudes
    check = check_of(path, 1)
    assert check.due(2 * SECOND)
    pose = check.average_pose(RobotState(moved[2], turned[2].as_quat(), np.zeros(3)))
    for (position, quaternion), k in (((pose.position, pose.quaternion), 2), (check.end, 5)):
        np.testing.assert_allclose(position, moved[k], atol=1e-12)
        assert (Rotation.from_quat(quaternion).inv() * turned[k]).magnitude() < 1e-12


def test_noise_is_averaged_over_the_last_measurements() -> None:
    path = BasePath(np.arange(9.0), np.zeros((9, 3)), np.tile([0.0, 0.0, 0.0, 1.0], (9, 1)))
    check = check_of(path, 4)
    for k, (x, angle) in enumerate([(9.0, 1.0), (0.1, 0.01), (0.3, 0.03), (0.2, 0.0), (0.4, 0.04)]):
        turned = Rotation.from_rotvec([0.0, 0.0, angle]).as_quat()
        assert check.due(k * SECOND)
        pose = check.average_pose(RobotState(np.array([x, 0.0, 0.0]), turned, np.zeros(3)))
    np.testing.assert_allclose(pose.position, [0.25, 0.0, 0.0])
    np.testing.assert_allclose(Rotation.from_quat(pose.quaternion).as_rotvec(), [0.0, 0.0, 0.02])


class ShakenState(PlantState):
    """The measured state, whose base is seen 1 cm to one side and to the other in turn."""

    @property
    def base(self) -> BaseMeasurement | None:
        side = (-1) ** (self.stamp_ns // TICK_NS)
        pose = self._plant.pose + 0.01 * side * np.eye(7)[0]
        return BaseMeasurement(pose, self._plant.twist, self._plant.qdot)


@pytest.mark.parametrize(
    ("averaging", "replanning", "off"),
    [(1, 0.0, 0.01), (4, 0.0, 0.01), (1, 2.0, 0.01), (4, 2.0, 0.0)],
)
def test_a_plan_in_motion_begins_where_measured_poses_say(
    averaging: int, replanning: float, off: float
) -> None:
    """Poses are collected on the way where a replanning needs them."""
    loop = flying(averaging=averaging, replan_period=replanning)
    shaken = ShakenState(loop.plant)
    shaken.stamp_ns, loop.measured = loop.measured.stamp_ns, shaken
    loop.tick(6)
    loop.propose_goal(OTHER)
    loop.tick(AHEAD + 1)
    begin = loop.poses[loop.starts[-1].stamp_ns // TICK_NS]
    error = np.linalg.norm(stub_of(loop).requests[-1].state.position - begin[:3])
    assert error == pytest.approx(off, abs=1e-3)


def test_a_base_that_is_off_as_its_joints_lag_is_on_its_way_to_the_end() -> None:
    """The base of this robot is at an eighth of its sliders' way, to the other side."""
    loop = flying(ticks=80, replan_period=1.0)
    schedule, tracker = loop.starts[0].schedule, tracker_of(loop)
    check = tracker.path_check
    assert check.due(loop.measured.stamp_ns)
    k = round((loop.measured.stamp_ns - loop.starts[0].stamp_ns) / TICK_NS)
    lag = np.array([-0.04, 0.02, 0.03])
    pose = schedule.path.position[k] - lag / 8, schedule.path.quaternion[k]
    averaged = check.average_pose(RobotState(*pose, schedule.positions[k] + lag))
    np.testing.assert_allclose(averaged.position, pose[0], atol=1e-9)
    for position, _ in (check.end, check.expected_end):
        np.testing.assert_allclose(position, schedule.path.position[-1], atol=5e-5)
    off = check.average_pose(RobotState(*pose, schedule.positions[k]))
    np.testing.assert_allclose(off.position, pose[0], atol=1e-9)
    np.testing.assert_allclose(check.end[0], schedule.path.position[-1] - lag / 8, atol=1e-6)


def test_noise_of_joints_is_not_taken_for_another_shape() -> None:
    loop = flying(shape_deadband=1e-3)
    shape = loop.plant.q + np.array([4e-4, 0.0, 5e-3])
    taken = tracker_of(loop).take_over(loop.measured.stamp_ns, shape, 0.3)
    assert taken is not None
    wanted = loop.starts[0].schedule.positions[len(loop.commands)]
    np.testing.assert_array_equal(taken.shapes[0], [wanted[0], wanted[1], shape[2]])


def test_goals_are_the_same_where_every_number_is() -> None:
    goal = goal_at(TURNED)
    shaped = replace(goal, joint_positions=np.zeros(3))
    for one, other, same in (
        (goal, goal_at(TURNED), True),
        (goal, goal_at(HERE), False),
        (goal, shaped, False),
        (shaped, goal, False),
        (shaped, replace(shaped), True),
    ):
        assert one.equals(other) is same


def test_the_remaining_motion_is_planned_again_where_plans_are_made_beside_the_flight() -> None:
    assert PlannerConfig(plan_in_background=True).replanning > 0
    assert PlannerConfig(plan_in_background=False).replanning == 0
    for background in (True, False):
        config = PlannerConfig(plan_in_background=background, replan_period=2.5)
        assert config.replanning == 2.5
