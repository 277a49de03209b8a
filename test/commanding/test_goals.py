"""Goals without ROS: followed through statuses, and served as actions with one result each."""

from __future__ import annotations

import math
from dataclasses import asdict, replace
from typing import Any

import numpy as np
import pytest
from commanding.commanders import Client
from scipy.spatial.transform import Rotation
from support.sentences import assert_one_sentence

from spacerobot_ros.commanding.fly_to import (
    FEEDBACK_PERIOD_NS,
    FlyTo,
    FlyToGoals,
    GoalErrors,
    Progress,
)
from spacerobot_ros.commanding.goal_follower import GoalFollower, Status, decision_event
from spacerobot_ros.control.status import ControllerState, ControllerStatus
from spacerobot_ros.errors import GoalError, PlanningError
from spacerobot_ros.events import EventKind
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.urdf import load_robot
from spacerobot_ros.planning.core.goal import Controlled, EndEffectorGoal, Goal, Tolerance
from spacerobot_ros.planning.execution.status import PlannerState, PlannerStatus
from spacerobot_ros.resources import robot_file

POSE = Goal.checked([0.05, -0.03, 0.02], [0.1, -0.2, 0.3, 0.9])
NAN = math.nan


class Rig:
    """Served goals, and the aborts that they report."""

    def __init__(self) -> None:
        self.aborted: list[tuple[str, str]] = []
        self.errors = GoalErrors(0.4, 0.5)
        self.goals = FlyToGoals(lambda goal: self.errors, self.report)
        self.clients: dict[str, Client] = {}

    def report(self, goal_id: str, message: str) -> PlannerStatus:
        self.aborted.append((goal_id, message))
        return PlannerStatus(PlannerState.ABORTED, message, goal_id)

    def send(self, goal_id: str, **about: Any) -> Client:
        client = self.clients[goal_id] = Client()
        self.goals.begin(goal_id, client, FlyTo(POSE, **about))
        self.goals.accepted(goal_id)
        return client

    def advance(self, now_ns: int) -> None:
        self.goals.advance(
            now_ns,
            lambda goal_id, goal, begun: Progress(
                goal_id, None, (now_ns - begun) / 1e9, now_ns, None, GoalErrors()
            ),
        )


def status(state: str, goal_id: str, message: str = "So it is.", **about: Any) -> PlannerStatus:
    return PlannerStatus(PlannerState(state), message, goal_id, **about)


# -- numbers ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"position": -0.5}, "position tolerance of the goal is -0.5 m:"),
        ({"attitude": math.inf}, "attitude tolerance of the goal is inf rad:"),
        ({"shape": math.nan}, "joint tolerance of the goal is nan m or rad:"),
    ],
)
def test_tolerances_are_finite_numbers(change: dict[str, float], words: str) -> None:
    tolerance = Tolerance(0.0, 0.2, 0.3)
    assert FlyTo(POSE, tolerance, 7.5).tolerance == tolerance
    with pytest.raises(PlanningError) as refused:
        FlyTo(POSE, replace(tolerance, **change), 7.5)
    assert_one_sentence(str(refused.value), words, "finite number above 0")


def test_a_time_limit_is_a_finite_number() -> None:
    assert FlyTo(POSE, Tolerance(0.0, 0.0, 0.0), 0.0).time_limit == 0.0
    for limit in (-1.0, math.inf):
        with pytest.raises(PlanningError, match="time limit of the goal is"):
            FlyTo(POSE, Tolerance(0.0, 0.0, 0.0), limit)


def test_tolerances_that_a_goal_leaves_open_are_the_parameters() -> None:
    default = Tolerance(0.1, 0.2, 0.3)
    assert FlyTo(POSE).tolerance_or(default) == default
    given = Tolerance(0.0, 0.5, 0.0)
    assert FlyTo(POSE, given).tolerance_or(default) == Tolerance(0.1, 0.5, 0.3)
    given = Tolerance(0.4, 0.0, 0.6)
    assert FlyTo(POSE, given).tolerance_or(default) == Tolerance(0.4, 0.2, 0.6)


@pytest.mark.parametrize(
    ("tolerance", "controls", "missing"),
    [
        (Tolerance(0.1, 0.2, 0.3), {"attitude", "position", "shape"}, ""),
        (Tolerance(0.1, 0.2, 0.3), {"attitude", "shape"}, "position"),
        (Tolerance(0.1, 0.2, 0.3), {"position", "shape"}, "attitude"),
        (Tolerance(0.1, 0.2, 0.3), {"position"}, "attitude and joints"),
        (Tolerance(0.0, 0.2, 0.0), {"attitude"}, ""),
        (Tolerance(0.1, 0.2, 0.0), {"attitude"}, "position"),
    ],
)
def test_tolerances_are_for_parts_that_are_controlled(
    tolerance: Tolerance, controls: set[Controlled], missing: str
) -> None:
    shaped = replace(POSE, joint_positions=np.array([0.1, 0.2]))
    if not missing:
        tolerance.require_control(shaped, frozenset(controls), "the law")
        return
    with pytest.raises(GoalError) as refused:
        tolerance.require_control(shaped, frozenset(controls), "the law")
    assert_one_sentence(str(refused.value), f"a tolerance for its {missing}, which the law does")


def test_tolerances_for_parts_that_a_goal_does_not_have_are_free() -> None:
    hand = EndEffectorGoal("", np.zeros(3))
    Tolerance(0.1, 0.2, 0.3).require_control(Goal.of_end_effectors([hand]), frozenset(), "x")
    turned = Goal.of_end_effectors([hand], quaternion=[0.0, 0.0, 0.0, 1.0])
    with pytest.raises(GoalError, match="for its attitude, which x"):
        Tolerance(0.1, 0.2, 0.3).require_control(turned, frozenset({"end_effectors"}), "x")


@pytest.fixture(scope="module")
def arm() -> SpaceRobot:
    return SpaceRobot(load_robot(robot_file("planar_manipulator")))


def test_errors_are_those_that_a_goal_asks_for(arm: SpaceRobot) -> None:
    turn = Rotation.from_rotvec([0.0, 0.0, 0.3])
    pose = np.array([0.2, -0.1, 0.0, *turn.as_quat()])
    q = np.array([0.4, -0.9])
    base = Goal.checked([0.5, 0.3, 0.0], [0, 0, 0, 1], [0.5, -0.2])
    errors = GoalErrors.between(arm, pose, q, base)
    assert errors.position == pytest.approx(0.5)
    assert errors.attitude == pytest.approx(0.3)
    assert errors.joints == pytest.approx(0.7)
    assert math.isnan(errors.end_effector_position)
    assert math.isnan(errors.end_effector_attitude)
    R_BE, r_BE_B = arm.link_pose("end_effector", q)
    there = pose[:3] + turn.as_matrix() @ r_BE_B
    hand = EndEffectorGoal("", there + np.array([0.03, 0.0, -0.04]))
    errors = GoalErrors.between(arm, pose, q, Goal.of_end_effectors([hand]))
    assert errors.end_effector_position == pytest.approx(0.05)
    assert np.isnan([errors.position, errors.attitude, errors.joints]).all()
    assert math.isnan(errors.end_effector_attitude)
    attitude = turn * Rotation.from_matrix(R_BE) * Rotation.from_rotvec([0.0, 0.0, 0.2])
    hand = EndEffectorGoal("end_effector", there, attitude.as_quat())
    goal = Goal.of_end_effectors([hand], position=[0.2, -0.1, 0.6])
    errors = GoalErrors.between(arm, pose, q, goal)
    assert errors.end_effector_attitude == pytest.approx(0.2)
    assert errors.end_effector_position == pytest.approx(0.0, abs=1e-12)
    assert errors.position == pytest.approx(0.6)
    assert math.isnan(errors.attitude)


def test_errors_of_a_status_count_where_the_goal_has_them() -> None:
    own = GoalErrors(0.1, NAN, 0.3, NAN, 0.5)
    told = status(
        "reached",
        "a",
        position_error_m=0.01,
        attitude_error_rad=0.02,
        end_effector_position_error_m=0.03,
        end_effector_attitude_error_rad=0.0,
    )
    mixed = own.reported_by(told)
    assert list(asdict(mixed).values()) == pytest.approx([0.01, NAN, 0.03, NAN, 0.5], nan_ok=True)
    parts = ["position", "attitude"]
    assert list(asdict(mixed)) == [*parts, *(f"end_effector_{each}" for each in parts), "joints"]
    unchanged = own.reported_by(status("aborted", "a"))
    assert asdict(unchanged) == pytest.approx(asdict(own), nan_ok=True)
    assert own.reported_by(ControllerStatus(ControllerState.REACHED)) is own


# -- results ----------------------------------------------------------------------------------


@pytest.mark.parametrize("state", ["reached", "failed", "refused", "aborted"])
def test_the_status_that_decides_a_goal_is_its_result(state: str) -> None:
    rig = Rig()
    first, second = rig.send("a"), rig.send("b")
    rig.goals.update(status("executing", "b"))
    rig.goals.update(status(state, "b", "It is over.", position_error_m=0.02))
    assert second.end_of == (state, "It is over.")
    assert second.results[0][1].position == 0.02
    assert second.results[0][1].attitude == 0.5
    rig.goals.update(status(state, "b", "Once more."))
    assert len(second.results) == 1
    assert not first.results
    assert rig.goals
    rig.goals.update(status(state, "a"))
    assert not rig.goals
    assert rig.aborted == []


def test_a_goal_that_is_refused_at_once_has_no_errors() -> None:
    rig, client = Rig(), Client()
    rig.goals.begin("a", client, None)
    rig.advance(5)
    rig.goals.update(status("refused", "a", "It is in frame 'moon'."))
    assert client.end_of == ("refused", "It is in frame 'moon'.")
    assert math.isnan(client.results[0][1].position)
    assert client.told == []


def test_goals_that_are_pursued_no_more_are_aborted_by_the_later_one() -> None:
    rig = Rig()
    first, second = rig.send("a"), rig.send("b")
    rig.goals.end_dropped_goals({"a", "b"})
    assert not first.results
    rig.goals.accepted("12.5")
    rig.goals.end_dropped_goals({"b", "12.5"})
    assert first.end_of == ("aborted", "Aborted: replaced by goal 12.5.")
    assert rig.aborted == [("a", "Aborted: replaced by goal 12.5.")]
    rig.goals.end_dropped_goals((), "Aborted: this node was deactivated.")
    assert second.end_of == ("aborted", "Aborted: this node was deactivated.")
    assert len(first.results) == 1


def test_a_goal_that_was_refused_has_replaced_none() -> None:
    rig = Rig()
    first = rig.send("a")
    rig.goals.accepted("later")
    rig.goals.update(status("refused", "later"))
    rig.goals.end_dropped_goals(())
    assert first.end_of == ("aborted", "The goal is no longer pursued.")


# -- aborts -----------------------------------------------------------------------------------


def test_the_latest_goal_is_aborted_once() -> None:
    rig = Rig()
    rig.send("a")
    assert rig.goals.abort_reason({"a"}) == ""
    rig.goals.request_abort("unknown")
    rig.goals.request_abort("a", "after lunch")
    rig.goals.request_abort("a", "again")
    assert rig.goals.abort_reason({"a", "an earlier one"}) == "after lunch"
    assert rig.goals.abort_reason({"a"}) == ""


def test_a_goal_that_is_about_to_be_replaced_is_not_aborted() -> None:
    rig = Rig()
    rig.send("a")
    rig.goals.accepted("later")
    rig.goals.request_abort("a")
    assert rig.goals.abort_reason({"later"}) == ""
    # The later one is refused, or pursued beside it.
    assert rig.goals.abort_reason(()) == "on request"


def test_feedback_comes_by_simulated_time() -> None:
    rig = Rig()
    assert FEEDBACK_PERIOD_NS == 200_000_000
    client = rig.send("a", time_limit=0.5)
    begin = 3_000_000_000
    for step in (0, 1, 199_999_999, 200_000_000, 399_999_999, 400_000_000, 499_999_999):
        rig.advance(begin + step)
    assert [each.stamp_ns - begin for each in client.told] == [0, 200_000_000, 400_000_000]
    assert [each.elapsed_time for each in client.told] == [0.0, 0.2, 0.4]
    assert rig.goals.abort_reason({"a"}) == ""
    rig.advance(begin + 500_000_000)
    assert rig.goals.abort_reason({"a"}) == "after its time limit of 0.5 s"


def test_time_that_goes_back_begins_the_goal_anew() -> None:
    rig = Rig()
    client = rig.send("a", time_limit=2.0)
    rig.advance(9_000_000_000)
    rig.advance(1_000_000_000)
    rig.advance(2_999_999_999)
    assert [each.elapsed_time for each in client.told] == pytest.approx([0.0, 0.0, 2.0])
    assert rig.goals.abort_reason({"a"}) == ""
    rig.advance(3_000_000_000)
    assert rig.goals.abort_reason({"a"})


def test_the_first_schedule_and_the_first_decision_of_the_goal_count() -> None:
    follower = GoalFollower(ID)
    first, second = (status("executing", ID, text) for text in ("one", "two"))
    reached, later = status("reached", ID), status("aborted", ID)
    told: list[Status] = [status("planning", ID), first, second, reached, later]
    assert [follower.update(each) for each in told] == [False, False, False, True, False]
    assert (follower.gait, follower.decision) == (first, reached)


ID, OTHER = "12.000000346", "12.000000345"


def test_statuses_without_an_id_are_those_of_the_goal_in_old_bags() -> None:
    follower = GoalFollower(ID, unnamed=True)
    assert not follower.update(status("failed", OTHER))
    assert not follower.update(status("executing", ""))
    assert follower.update(status("failed", ""))
    assert follower.gait is not None


def test_a_controller_that_tracks_begins_no_schedule() -> None:
    follower = GoalFollower(ID)
    assert not follower.update(ControllerStatus(ControllerState.TRACKING, goal_id=ID))
    assert follower.update(ControllerStatus(ControllerState.REACHED, goal_id=ID))
    assert follower.gait is None


@pytest.mark.parametrize("kind", [PlannerStatus, ControllerStatus])
def test_decisions_are_events(kind: type[PlannerStatus] | type[ControllerStatus]) -> None:
    states = PlannerState if kind is PlannerStatus else ControllerState
    expected = {
        "reached": (EventKind.GOAL_REACHED, 0),
        "reached_partly": (EventKind.GOAL_REACHED_PARTLY, 1),
        "failed": (EventKind.GOAL_FAILED, 2),
        "refused": (EventKind.GOAL_REFUSED, 2),
        "aborted": (EventKind.GOAL_ABORTED, 1),
    }
    assert {state.value for state in states if state.decided} == set(expected)
    for state in states:
        if state.decided:
            event = decision_event(kind(state, "So it is.", goal_id=ID))  # type: ignore[arg-type]
            assert (event.kind, event.level) == expected[state.value]
            assert (event.message, event.goal_id) == ("So it is.", ID)
