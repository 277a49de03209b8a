"""How long a goal was flown to, from what its planner has reported."""

from __future__ import annotations

from spacerobot_ros.planning.execution.status import PlannerState, PlannerStatus, time_to_end

HERE, THERE = (0.0,) * 6 + (1.0,), (1.0,) + (0.0,) * 5 + (1.0,)


def said(
    time: float, state: str, goal_id: str = "", goal: tuple[float, ...] = ()
) -> tuple[float, PlannerStatus]:
    return time, PlannerStatus(PlannerState(state), goal_id=goal_id, goal=goal)


def test_it_counts_from_the_first_schedule_for_the_last_goal() -> None:
    flown = [
        said(0.0, "idle"),
        said(1.0, "executing", "a", HERE),
        said(4.0, "reached", "a", HERE),
        said(5.0, "planning", "b", THERE),
        said(7.0, "executing", "b", THERE),
        said(8.0, "planning", "b"),
        said(9.0, "executing", "b", THERE),
    ]
    assert time_to_end(flown, 12.5) == 5.5
    refused = said(10.0, "refused", "c", HERE)
    assert time_to_end([*flown, refused], 12.5) == 5.5, "which is another goal's"
    assert time_to_end([*flown, refused, said(11.0, "aborted", "b")], 12.5) == 4.0
    # The same goal again is another one.
    again = [*flown, said(13.0, "reached", "b", THERE), said(20.0, "executing", "d", THERE)]
    assert time_to_end(again, 21.0) == 1.0


def test_a_goal_that_was_refused_in_between_ends_nothing() -> None:
    flown = [
        said(1.0, "executing", "a", HERE),
        said(3.0, "planning", "b"),
        said(3.5, "refused", "b", THERE),
        said(6.0, "planning", "a"),
        said(7.0, "executing", "a", HERE),
        said(9.0, "aborted", "a"),
    ]
    assert time_to_end(flown, 12.0) == 8.0
    # One that was flown in between does.
    flown[2] = said(3.5, "executing", "b", THERE)
    assert time_to_end(flown, 12.0) == 2.0
    # So does the refusal of the same pose: what follows is another attempt.
    flown[2] = said(3.5, "refused", "b", HERE)
    assert time_to_end(flown, 12.0) == 2.0


def test_it_goes_on_where_a_planner_was_started_again() -> None:
    flown = [
        said(0.25, "executing", "a", HERE),
        said(40.5, "planning", "a"),
        said(46.5, "executing", "a", HERE),
        said(49.0, "aborted", "a"),
    ]
    assert time_to_end(flown, 60.0) == 48.75


def test_bags_of_earlier_versions_have_no_ids() -> None:
    flown = [said(0.0, "executing", goal=HERE), said(2.0, "executing", goal=THERE)]
    assert time_to_end(flown, 5.0) == 3.0
    assert time_to_end([said(1.0, "executing", goal=THERE), *flown[1:]], 5.0) == 4.0


def test_without_a_schedule_there_is_none() -> None:
    assert time_to_end([said(0.0, "idle"), said(1.0, "refused", "a")], 5.0) is None
