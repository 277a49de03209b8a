"""What commanders make of the statuses of their plant."""

from __future__ import annotations

from dataclasses import replace

from support.sentences import assert_one_sentence

from spacerobot_ros.commanding.plant_state import PlantChange, PlantListener, PlantStopped
from spacerobot_ros.simulation.status import PlantState, PlantStatus

RUNNING = PlantStatus(PlantState.RUNNING, "A command is in force.")
LATCHED = PlantStatus(
    PlantState.LATCHED, "Nothing moves: a fuse.", "abort", "a fuse is blown", time_s=2.0
)
RESTING = PlantStatus(
    PlantState.RESTING, "It is too old.", "timeout", timeouts=1, last_command_s=1.5, time_s=2.0
)
AGAIN = replace(RUNNING, rearms=1, time_s=3.0)


def listener(*statuses: PlantStatus) -> PlantListener:
    made = PlantListener()
    for status in statuses:
        made.update(status, "/robot/plant")
    return made


def test_a_latched_plant_stops_commanders_once_and_goals_are_refused() -> None:
    one = listener(RUNNING)
    assert (one.refusal_of_goals, one.has_no_command) == ("", False)
    assert one.update(LATCHED, "/robot/plant") == [PlantStopped("Nothing moves: a fuse.")]
    assert one.update(replace(LATCHED, faults=("joint_stuck a",)), "/robot/plant") == []
    assert_one_sentence(one.refusal_of_goals, "a fuse is blown", "/robot/plant/rearm")
    # Paused or inactive it is latched as well.
    for state in (PlantState.PAUSED, PlantState.INACTIVE):
        assert one.update(replace(LATCHED, state=state), "/robot/plant") == []
        assert one.refusal_of_goals
        assert one.has_no_command, "no command is in force"
    assert one.update(AGAIN) == [PlantChange.OBEYS]
    assert (one.refusal_of_goals, one.has_no_command) == ("", False)


def test_a_commander_that_comes_later_learns_that_the_plant_is_latched() -> None:
    assert listener().update(LATCHED) == [PlantStopped("Nothing moves: a fuse.")]
    assert listener().update(RUNNING) == []
    assert listener().update(RESTING) == []


def test_a_latch_that_was_missed_is_noticed_by_the_rearming() -> None:
    (stopped, change) = listener(RUNNING).update(AGAIN)
    assert isinstance(stopped, PlantStopped)
    assert_one_sentence(stopped.reason, "latched")
    assert change is PlantChange.OBEYS
    assert listener(RUNNING, LATCHED).update(replace(LATCHED, rearms=1)) == []


def test_a_plant_that_fails_stops_commanders() -> None:
    one = listener(RUNNING)
    failed = PlantStatus(PlantState.FAILED, "Its model has no inertia.", "model")
    assert one.update(failed) == [PlantStopped("Its model has no inertia.")]
    assert_one_sentence(one.refusal_of_goals, "failed", "Its model has no inertia.")
    assert one.update(RUNNING) == [PlantChange.OBEYS]


def test_a_plant_that_rests_stops_what_was_commanded_before() -> None:
    assert listener(RUNNING).update(RESTING) == [
        PlantStopped("It is too old.", 1_500_000_000, 2_000_000_000)
    ]
    assert listener(RUNNING, RESTING).update(replace(RUNNING, timeouts=1)) == []
    # Missed: it runs again.
    (stopped,) = listener(RUNNING).update(replace(RUNNING, timeouts=1, last_command_s=1.5))
    assert isinstance(stopped, PlantStopped)
    assert stopped.commanded_until_ns == 1_500_000_000
    assert_one_sentence(stopped.reason, "rest")
    # A plant without counters says when it came to rest.
    plain = PlantStatus(PlantState.RESTING, "It rests.", "timeout", time_s=2.0)
    assert listener(RUNNING).update(plain) == [PlantStopped("It rests.", 2 * 10**9, 2 * 10**9)]
    assert listener(RUNNING).update(replace(plain, reason="no_command")) == []
    assert listener(RUNNING).update(replace(plain, time_s=float("nan"))) == []


def test_pauses_and_restarts_stop_nothing() -> None:
    one = listener(replace(RUNNING, rearms=2, resets=3, timeouts=4))
    assert (
        one.update(replace(RUNNING, state=PlantState.PAUSED, rearms=2, resets=3, timeouts=4)) == []
    )
    assert one.paused
    assert one.update(PlantStatus(PlantState.INACTIVE, "The plant is not configured.")) == []
    assert one.update(PlantStatus(PlantState.RESTING, "No command yet.", "no_command")) == []
    assert one.update(RUNNING) == []
    assert not one.paused


def test_a_reset_is_reported_once() -> None:
    one = listener(RUNNING)
    assert one.update(replace(RUNNING, resets=1)) == [PlantChange.RESET]
    assert one.update(replace(RUNNING, resets=1, time_s=9.0)) == []
