"""One goal followed through statuses: its own, those of other goals, and those without an id."""

from __future__ import annotations

import pytest

from spacerobot_ros.commanding.goal_follower import GoalFollower, Status, decision_event
from spacerobot_ros.control.status import ControllerState, ControllerStatus
from spacerobot_ros.events import EventKind
from spacerobot_ros.planning.execution.status import PlannerState, PlannerStatus

ID, OTHER = "12.000000346", "12.000000345"


def planner(state: PlannerState, goal_id: str = ID, message: str = "") -> PlannerStatus:
    return PlannerStatus(state, message, goal_id=goal_id)


def test_the_first_schedule_and_the_first_decision_of_the_goal_count() -> None:
    follower = GoalFollower(ID)
    first, second = (planner(PlannerState.EXECUTING, message=text) for text in ("one", "two"))
    reached, later = planner(PlannerState.REACHED), planner(PlannerState.ABORTED)
    told: list[Status] = [planner(PlannerState.PLANNING), first, second, reached, later]
    assert [follower.update(status) for status in told] == [False, False, False, True, False]
    assert (follower.gait, follower.decision) == (first, reached)


@pytest.mark.parametrize("state", [PlannerState.EXECUTING, PlannerState.REFUSED])
def test_statuses_of_other_goals_tell_nothing(state: PlannerState) -> None:
    for follower, others in ((GoalFollower(ID), (OTHER, "")), (GoalFollower(), (ID, OTHER, ""))):
        for other in others:
            assert not follower.is_about_goal(planner(state, other))
            assert not follower.update(planner(state, other))
        assert follower.gait is None
        assert follower.decision is None


def test_statuses_without_an_id_are_those_of_the_goal_in_old_bags() -> None:
    follower = GoalFollower(ID, unnamed=True)
    assert not follower.update(planner(PlannerState.FAILED, OTHER))
    assert not follower.update(planner(PlannerState.EXECUTING, ""))
    assert follower.update(planner(PlannerState.FAILED, ""))
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
        "failed": (EventKind.GOAL_FAILED, 2),
        "refused": (EventKind.GOAL_REFUSED, 2),
        "aborted": (EventKind.GOAL_ABORTED, 1),
    }
    for state in states:
        event = decision_event(kind(state, "So it is.", goal_id=ID))  # type: ignore[arg-type]
        found = None if event is None else (event.kind, event.level)
        assert found == expected.get(state.value)
        if event is not None:
            assert (event.message, event.goal_id) == ("So it is.", ID)
