"""What a planner's executive decides and reports: plans it requests, statuses, events."""

from __future__ import annotations

import re
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.decided_clearance import DecidedClearance
from support.planner_loop import (
    HERE,
    NEAR,
    TICK,
    TICK_NS,
    Loop,
    MovingStub,
    PlantState,
    StubMethod,
    goal_at,
)
from support.planner_phases import (
    FAR,
    OTHER,
    Act,
    braking,
    evaluating,
    executing,
    jump,
    long_flight,
    measuring,
    planning,
    quick_without_joints,
    reset_plant,
    resting,
    stub_of,
    stuck,
    until,
)
from support.sentences import assert_one_sentence

from spacerobot_ros.errors import PlanningError
from spacerobot_ros.events import EventKind
from spacerobot_ros.planning import GaitSchedule
from spacerobot_ros.planning.core.cancellation import NEVER, Cancellation
from spacerobot_ros.planning.core.method import PlanRequest
from spacerobot_ros.planning.execution.goal_file import (
    BASE_GOAL_KEY,
    GoalFile,
    IdentifiedGoal,
    PursuedGoals,
)
from spacerobot_ros.planning.execution.status import (
    Event,
    Phase,
    PlannerState,
    PlanReason,
    Transition,
)
from spacerobot_ros.planning.execution.teleoperation import TwistCommand
from spacerobot_ros.planning.execution.worker import PlanningWorker
from spacerobot_ros.simulation import InitialState, VelocityPlant

# -- why plans are requested ------------------------------------------------------------------


def test_what_is_missed_is_corrected_and_counts() -> None:
    loop = resting()
    stub_of(loop).overshoot = 0.1
    status = loop.decide(NEAR)
    # 0.062 m, a tenth of it is missed by every plan: 6.2 mm, 0.62 mm.
    assert status.state is PlannerState.REACHED
    assert status.corrections == 1
    assert loop.plan_reasons == [PlanReason.NEW_GOAL, PlanReason.CORRECTION]
    first, second = stub_of(loop).requests
    assert (first.correction, second.correction) == (False, True)
    assert second.previous is loop.starts[0].schedule


def test_partial_schedules_are_continued_and_do_not_count() -> None:
    loop = resting(max_corrections=0)
    stub_of(loop).partial = True
    status = loop.decide(NEAR)
    assert status.state is PlannerState.REACHED
    assert status.corrections == 0
    # Half of 0.062 m at a time until 1 mm is left.
    assert loop.plan_reasons == [PlanReason.NEW_GOAL, *[PlanReason.CONTINUATION] * 5]
    assert all(request.correction for request in stub_of(loop).requests[1:])


@pytest.mark.parametrize("held", [False, True])
def test_a_tracking_error_is_planned_for_at_once_or_from_rest(held: bool) -> None:
    loop = executing(held=held, ticks=60, wrong_path=0.1, drift_position=0.02)
    stub_of(loop).wrong_path = 0.0
    for _ in range(400):
        loop.tick()
        loop.held.release()
    again = PlanReason.REPLAN if held else PlanReason.TRACKING_ERROR
    assert loop.plan_reasons == [PlanReason.NEW_GOAL, again]
    status = loop.statuses[-1]
    assert (status.state, status.corrections) == (PlannerState.REACHED, 1)
    deviation = r"Deviates from the path by 2\d\.\d mm and < 1 µrad: the remaining motion is"
    assert any(re.match(deviation, notice) for notice in loop.notices)
    assert not stub_of(loop).requests[-1].correction
    # Either way the joints come to rest along the path: no step in velocity.
    assert np.abs(np.diff(loop.speeds)).max() < 0.5 * max(loop.speeds)


def test_a_tracking_error_that_cannot_be_planned_for_is_left_to_the_end() -> None:
    loop = executing(ticks=60, wrong_path=0.1, drift_position=0.02)
    stub_of(loop).refusing = True
    loop.until(PlannerState.REACHED)
    assert any("cannot be planned again: It is too far." in notice for notice in loop.notices)
    assert loop.states == ["executing", "reached"]


def test_tracking_errors_are_corrected_as_often_as_allowed() -> None:
    loop = executing(ticks=200, wrong_path=0.5, drift_position=1e-3, max_corrections=2)
    loop.tick(150)
    assert len(stub_of(loop).requests) == 3
    assert loop.statuses[-1].corrections == 2


def test_a_goal_is_planned_for_without_the_joints_that_are_stuck() -> None:
    loop = stuck(long_flight())
    q = loop.plant.q.copy()
    (event,) = [event for event in loop.events if event.kind is EventKind.STUCK_JOINT]
    assert (event.level, event.goal_id, dict(event.about)) == (1, "goal-1", {"joints": "slider_1"})
    until(loop, Phase.PLANNING)
    assert loop.plan_reasons == [PlanReason.NEW_GOAL, PlanReason.STUCK_JOINTS]
    task = loop.held.tasks[-1]
    assert dict(task.stuck_joint_positions) == {"slider_1": q[0]}
    assert task.required == {"position"}
    assert not task.request.correction
    assert any("Stuck: slider_1." in notice for notice in loop.notices)
    # All joints are planned with for the next goal, and again without for this one if that is
    # refused.
    loop.propose_goal(FAR)
    loop.held.release()
    loop.tick(2)
    until(loop, Phase.PLANNING)
    assert not loop.held.tasks[-1].stuck_joint_positions
    loop.held.release()
    until(loop, Phase.EVALUATING)
    until(loop, Phase.PLANNING)
    assert dict(loop.held.tasks[-1].stuck_joint_positions) == {"slider_1": q[0]}


def test_the_next_goal_takes_the_result_of_a_refused_one_along() -> None:
    """In the background: braked for a goal that is refused, the earlier one is planned again."""
    loop = executing(held=True, ticks=40)
    loop.tick(5)
    loop.propose_goal(FAR)
    until(loop, Phase.PLANNING)
    loop.held.release()
    loop.tick()
    refused = loop.statuses[-1]
    assert (refused.state, refused.goal_id) == (PlannerState.REFUSED, "goal-2")
    assert refused.message == "It is too far. The earlier goal is still pursued."
    until(loop, Phase.PLANNING)
    loop.held.release()
    reached = loop.until(PlannerState.REACHED)
    assert (reached.goal_id, reached.corrections) == ("goal-1", 0)


# -- a plant that does not obey, and times that are not its own -------------------------------


@pytest.mark.parametrize("start", [measuring, planning, executing, evaluating])
def test_a_plant_that_stops_ends_the_goal_with_its_reason(
    start: Callable[[], Loop], tmp_path: Path
) -> None:
    loop = start()
    loop.goal_file = GoalFile(str(tmp_path / "goal.json"))
    loop.goal_file.pursue(PursuedGoals({BASE_GOAL_KEY: IdentifiedGoal(goal_at(NEAR), "goal-1")}))
    loop.executive.plant_stopped("The plant is latched: a fuse is blown.")
    loop.tick()
    status = loop.statuses[-1]
    assert (status.state, status.goal_id) == (PlannerState.ABORTED, "goal-1")
    assert status.message == "Aborted by the plant: The plant is latched: a fuse is blown."
    assert not (tmp_path / "goal.json").exists()
    # Nothing moves, whatever was being planned, until there is another goal.
    loop.held.release()
    loop.tick(60)
    assert not any(loop.speeds[-60:])
    assert loop.statuses[-1] is status
    loop.executive.plant_stopped("The plant is latched still.")
    loop.tick()
    assert loop.statuses[-1] is status
    status = loop.decide(OTHER)
    assert (status.state, status.goal_id) == (PlannerState.REACHED, "goal-2")


def test_braking_for_an_aborted_goal_ends_where_the_plant_stops() -> None:
    loop = braking()
    before = len(loop.statuses)
    loop.executive.plant_stopped("The plant is latched.")
    loop.tick(20)
    assert not any(loop.speeds[-20:])
    assert len(loop.statuses) == before


def test_a_motion_is_replanned_if_the_plant_rested_during_it() -> None:
    """While a plan is made at once no command comes, and a plant in real time rests."""
    loop = resting(ticks=40)
    loop.tick(10)
    loop.propose_goal(NEAR)
    loop.tick()
    (start,) = loop.starts
    loop.executive.plant_rested(start.stamp_ns - TICK_NS, 10**12)
    loop.executive.plant_rested(start.stamp_ns - TICK_NS, 0)
    loop.tick(10)
    assert loop.plan_reasons == [PlanReason.NEW_GOAL]
    loop.executive.plant_rested(loop.measured.stamp_ns, 10**12)
    # A motion from rest to what is left, which is no correction.
    reached = loop.until(PlannerState.REACHED)
    assert (reached.goal_id, reached.corrections) == ("goal-1", 0)
    assert loop.plan_reasons == [PlanReason.NEW_GOAL, PlanReason.REPLAN]
    (notice,) = [each for each in loop.statuses if "brought to rest" in each.message]
    assert_one_sentence(notice.message, "no command arrived in time", "replanned")
    # A goal that nothing was commanded for, or that is decided, is not touched.
    loop.executive.plant_rested(loop.measured.stamp_ns, 10**12)
    assert loop.statuses[-1] is reached
    loop.propose_goal(OTHER)
    loop.executive.plant_rested(loop.measured.stamp_ns, 10**12)
    assert loop.executive.phase is Phase.MEASURING


def test_a_plan_in_the_background_outlives_a_plant_that_rests() -> None:
    """A search that keeps commands late must not be begun again and again."""
    loop = executing(held=True, ticks=40)
    loop.tick(5)
    loop.propose_goal(OTHER)
    until(loop, Phase.PLANNING).tick(5)
    loop.executive.plant_rested(loop.measured.stamp_ns, loop.measured.stamp_ns + 1)
    assert loop.executive.phase is Phase.PLANNING


@pytest.mark.parametrize(("rests_after", "again"), [(0, True), (500_000_000, False)])
def test_joints_that_a_plant_held_are_not_taken_for_stuck(rests_after: int, again: bool) -> None:
    """What it did while the plan without these joints was made is that plan's fault."""
    loop = until(stuck(long_flight()), Phase.PLANNING)
    planned_from = loop.measured.stamp_ns - TICK_NS
    loop.plant.hold(np.zeros(3, dtype=bool))
    loop.executive.plant_rested(planned_from - TICK_NS, planned_from + rests_after)
    if again:
        loop.held.release()
    until(loop, Phase.PLANNING)
    assert (not loop.held.tasks[-1].stuck_joint_positions) == again


@pytest.mark.parametrize("seconds", [1e6, 12.0, -3.0])
def test_a_time_without_a_plan_is_no_end_of_a_schedule(seconds: float) -> None:
    loop = resting(ticks=40, max_corrections=0)
    loop.tick(60)
    loop.propose_goal(NEAR)
    loop.tick(20)
    before = loop.measured.stamp_ns / 1e9 - TICK
    jump(seconds)(loop)
    assert not any(loop.speeds[-1:])
    words = (
        f"has jumped from {before:.9g} s to {before + TICK + seconds:.9g} s; no motion is planned"
    )
    assert any(words in notice for notice in loop.notices), loop.notices
    # The rest is planned again, which is no correction.
    status = loop.until(PlannerState.REACHED, PlannerState.FAILED)
    assert (status.state, status.corrections) == (PlannerState.REACHED, 0)
    assert len(loop.starts) == 2


def test_a_gap_within_the_schedule_is_flown_on() -> None:
    loop = executing(ticks=80)
    loop.tick(20)
    jump(2.0)(loop)
    assert loop.executive.phase is Phase.EXECUTING
    loop.until(PlannerState.REACHED)
    assert loop.plan_reasons == [PlanReason.NEW_GOAL]


def test_a_reset_is_planned_for_from_where_the_robot_is_then() -> None:
    loop = executing(ticks=40, max_corrections=0)
    loop.tick(20)
    reset_plant(loop)
    said = loop.statuses[-1]
    message = "The plant was reset: the motion is replanned from the initial state."
    assert (said.state, said.goal_id, said.message) == (PlannerState.PLANNING, "goal-1", message)
    status = loop.until(PlannerState.REACHED, PlannerState.FAILED)
    assert (status.state, status.corrections) == (PlannerState.REACHED, 0)
    assert loop.plan_reasons == [PlanReason.NEW_GOAL, PlanReason.REPLAN]
    np.testing.assert_array_equal(stub_of(loop).requests[-1].state.q, np.zeros(3))


def test_a_reset_at_the_end_of_a_schedule_is_no_miss() -> None:
    loop = evaluating(max_corrections=0)
    reset_plant(loop)
    status = loop.until(PlannerState.REACHED, PlannerState.FAILED)
    assert (status.state, status.corrections) == (PlannerState.REACHED, 0)
    assert loop.plan_reasons == [PlanReason.NEW_GOAL, PlanReason.REPLAN]


def test_momenta_of_before_a_reset_are_not_planned_for() -> None:
    loop = resting()
    spin = InitialState(angular_momentum=np.array([0.0, 0.0, 0.25]))
    loop.measured = PlantState(VelocityPlant(loop.plant.robot, TICK, spin))
    loop.propose_goal(NEAR)
    loop.tick()
    (request,) = stub_of(loop).requests
    np.testing.assert_allclose(request.state.angular_momentum, [0.0, 0.0, 0.25], atol=1e-12)
    # The plant is reset while the joints move already, at no momentum.
    loop.executive.abort()
    loop.plant.step(np.array([0.1, 0.0, 0.0]))
    loop.measured = PlantState(loop.plant)
    loop.executive.plant_reset()
    loop.propose_goal(NEAR)
    assert loop.plant.qdot.any()
    loop.tick()
    np.testing.assert_allclose(stub_of(loop).requests[1].state.angular_momentum, 0.0, atol=1e-12)


def test_after_a_reset_the_shape_of_before_is_not_held() -> None:
    loop = evaluating(output="reference")
    loop.until(PlannerState.REACHED)
    loop.tick(3)
    assert np.abs(loop.plant.q).max() > 0.01
    reset_plant(loop)
    loop.tick()
    np.testing.assert_array_equal(loop.executive.update(loop.measured.now).position, np.zeros(3))


# -- what the statuses say --------------------------------------------------------------------


def test_times_and_corrections_are_those_of_the_goal() -> None:
    loop = resting()
    assert loop.executive.statistics.plan_time_s == 0.0, "before the first goal"
    stub_of(loop).overshoot = 0.1
    status = loop.decide(NEAR)
    assert status.manoeuvre_time_s == pytest.approx(2 * 8 * 0.05)
    assert status.ends_at_s == pytest.approx(loop.starts[1].stamp_ns / 1e9 + 8 * 0.05)
    assert loop.executive.statistics.plans == 2
    assert loop.executive.statistics.plan_time_s > 0
    assert loop.executive.statistics.commands_published == len(loop.commands)
    # A goal that is refused in flight takes nothing from the one that is pursued.
    stub_of(loop).overshoot = 0.0
    loop.propose_goal(OTHER)
    loop.tick(2)
    loop.propose_goal(FAR)
    status = loop.until(PlannerState.REACHED)
    assert status.manoeuvre_time_s == pytest.approx(8 * 0.05)


def test_what_is_cut_off_a_schedule_is_no_time_of_the_manoeuvre() -> None:
    loop = until(stuck(long_flight()), Phase.PLANNING)
    loop.held.release()
    until(loop, Phase.EXECUTING)
    first, second = loop.starts[-2:]
    flown = (second.stamp_ns - first.stamp_ns) / 1e9
    assert flown < 0.5 * first.schedule.duration
    # From the first command to the stop; then planning takes some ticks.
    counted = loop.statuses[-1].manoeuvre_time_s - second.schedule.duration
    assert flown - 3 * 0.05 < counted < flown


def test_a_state_that_is_not_finite_ends_no_goal_silently() -> None:
    loop = measuring()
    loop.measured.broken = True
    loop.tick()
    assert loop.statuses[-1].state is PlannerState.REFUSED
    assert "not finite" in loop.statuses[-1].message
    loop.measured.broken = False
    assert loop.decide(NEAR).state is PlannerState.REACHED
    # Measured in flight, the joints are commanded to rest as long as nothing is known of them.
    loop.propose_goal(HERE)
    loop.tick(3)
    loop.measured.broken = True
    loop.tick()
    assert not loop.commands[-1].any()
    loop.measured.broken = False
    assert loop.until(PlannerState.REACHED).goal_id == "goal-3"


# -- measurements that are none ---------------------------------------------------------------


def test_a_goal_whose_result_cannot_be_measured_has_failed_with_the_reason() -> None:
    loop = evaluating()
    loop.measured.broken = True
    loop.tick()
    status = loop.statuses[-1]
    assert (status.state, status.goal_id) == (PlannerState.FAILED, "goal-1")
    assert status.message == "The measured state is not finite; see odom and joint_states."
    assert loop.executive.phase is Phase.IDLE
    loop.measured.broken = False
    assert loop.decide(OTHER).state is PlannerState.REACHED


def test_a_tracking_error_that_cannot_be_measured_is_none() -> None:
    loop = executing(ticks=40, wrong_path=0.0, drift_position=1e-3)
    loop.measured.broken = True
    loop.tick(3)
    assert any("The path is unknown: The measured state" in n for n in loop.notices)
    assert loop.executive.phase is Phase.EXECUTING
    assert not any(loop.speeds[-3:]), "nor is anything commanded"
    loop.measured.broken = False
    loop.until(PlannerState.REACHED)


# -- events -----------------------------------------------------------------------------------


def test_each_change_of_a_goal_is_one_event() -> None:
    loop = resting()
    stub_of(loop).overshoot = 0.1
    assert loop.decide(NEAR).corrections == 1
    assert loop.statuses[0].message == "Executing a stub gait of 0.4 s."
    assert loop.events[1].message == "The plan is a stub gait of 0.4 s."
    planned = [("plan_started", "goal-1"), ("plan_ready", "goal-1")]
    assert loop.event_kinds == [
        *planned,
        ("goal_accepted", "goal-1"),
        ("correction", "goal-1"),
        *planned,
    ]
    first = loop.events[0]
    assert first.time_s == 0.0
    assert dict(first.about) == {"reason": "new goal"}
    loop.outputs.clear()
    loop.decide(FAR)
    assert loop.event_kinds == [("plan_started", "goal-2")]


def test_no_joint_is_stuck_at_a_plant_where_no_command_is_in_force() -> None:
    loop = executing(ticks=400, stuck_ticks=5)
    loop.executive.plant_rests = True
    loop.plant.hold(np.array([True, False, False]))
    loop.tick(100)
    assert loop.executive.phase is Phase.EXECUTING
    loop.executive.plant_rests = False
    stuck(loop)


# -- whatever happens -------------------------------------------------------------------------


PAGE = Path(__file__).parents[2] / "docs" / "planner_state_machine.md"
TRANSITIONS = [
    Transition(Phase[source], Event[event], Phase[target])
    for source, event, targets in re.findall(
        r"^\| `(\w+)` \| `(\w+)` \| (`[^|]+) \|", PAGE.read_text("utf-8"), re.M
    )
    for target in re.findall(r"`(\w+)`", targets)
]
"""The transitions that the page lists."""


def twist(loop: Loop) -> None:
    command = TwistCommand("mass_2", np.array([0.3, 0.01, -0.4]), np.ones(3), "base")
    with suppress(PlanningError):
        loop.executive.propose_twist(command)


def stopped_plant(loop: Loop) -> None:
    loop.executive.plant_stopped("The plant is latched.")
    loop.take()


def late(loop: Loop) -> None:
    loop.tick(base=False)
    loop.late()


def broken(loop: Loop) -> None:
    loop.measured.broken = True
    loop.tick()
    loop.measured.broken = False


def obstacles(*, near: bool) -> Act:
    """Let other obstacles be there, which the rest of the schedule comes too near to, or not."""

    def act(loop: Loop) -> None:
        def make() -> PlanningWorker:
            description = loop.plant.robot.description
            loop.worker.clearance = DecidedClearance(description, lambda _: near, obstacles=True)
            return loop.worker

        loop.executive.use_obstacles(make)
        loop.take()

    return act


def check_chain(loop: Loop) -> None:
    """Check that the transitions follow each other, and that each is in the table."""
    phase = Phase.IDLE
    for transition in loop.transitions:
        assert transition.source is phase
        assert transition in TRANSITIONS
        phase = transition.target
    assert loop.executive.phase is phase


ACTIONS: dict[str, Callable[[Loop], object]] = {
    "near": lambda loop: loop.propose_goal(NEAR),
    "other": lambda loop: loop.propose_goal(OTHER),
    "here": lambda loop: loop.propose_goal(HERE),
    "far": lambda loop: loop.propose_goal(FAR),
    "abort": lambda loop: loop.abort(),
    "stop": lambda loop: loop.stop(),
    "twist": twist,
    "latch": stopped_plant,
    "told of reset": reset_plant,
    "later": jump(50.0),
    "earlier": lambda loop: jump(-min(3.0, loop.measured.stamp_ns / 1e9))(loop),
    "tick": lambda loop: loop.tick(),
    "ticks": lambda loop: loop.tick(7),
    "many": lambda loop: loop.tick(50),
    "blind": lambda loop: loop.tick(2, base=False),
    "late": late,
    "broken": broken,
    "release": lambda loop: loop.held.release(),
    "reset": lambda loop: loop.plant.reset(),
    "jam": lambda loop: loop.plant.hold(np.array([True, False, False])),
    "free": lambda loop: loop.plant.hold(np.zeros(3, dtype=np.bool_)),
    "refuse": lambda loop: setattr(stub_of(loop), "refusing", True),
    "plan": lambda loop: setattr(stub_of(loop), "refusing", False),
    "partial": lambda loop: setattr(stub_of(loop), "partial", not stub_of(loop).partial),
    "overshoot": lambda loop: setattr(stub_of(loop), "overshoot", 0.3),
    "wrong path": lambda loop: setattr(stub_of(loop), "wrong_path", 0.1),
    "obstacles near": obstacles(near=True),
    "obstacles far": obstacles(near=False),
    "strict": lambda loop: loop.set(position_tolerance=1e-9, max_corrections=1),
}


@settings(max_examples=75, deadline=None)
@given(
    st.booleans(),
    st.booleans(),
    st.integers(1, 3),
    st.lists(st.sampled_from(sorted(ACTIONS)), min_size=1, max_size=25),
)
def test_no_sequence_of_events_leads_astray(
    held: bool, moving: bool, averaging: int, actions: list[str]
) -> None:
    parameters = {"averaging": averaging, "stuck_ticks": 3, "abort_time": 0.3}
    motion = {"takeover_time": 0.2, "replan_period": 0.1}
    method = MovingStub(12) if moving else StubMethod(12)
    loop = Loop({"drift_position": 0.05, **parameters, **motion}, method=method, held=held)
    quick_without_joints(loop)
    for action in actions:
        ACTIONS[action](loop)  # A tick asserts that its command is finite.
        phase = loop.executive.phase
        assert held or phase not in (Phase.PLANNING, Phase.REPLANNING)
    check_chain(loop)
    # Whatever happened, it can be stopped, and the next goal is reached.
    loop.stop()
    loop.plant.hold(np.zeros(3, dtype=np.bool_))
    loop.measured.broken = False
    method.refusing = method.partial = False
    method.overshoot = method.wrong_path = 0.0
    loop.set(position_tolerance=1e-3)
    assert loop.decide(OTHER).state is PlannerState.REACHED
    check_chain(loop)


class PieceStub(StubMethod):
    """Plans a piece, after which others of 7.5 s are expected."""

    def plan(self, request: PlanRequest, cancellation: Cancellation = NEVER) -> GaitSchedule:
        return replace(super().plan(request, cancellation), remaining=7.5)


def test_the_time_until_the_end_of_a_goal_is_that_of_this_piece_and_of_those_to_come() -> None:
    loop = Loop(method=PieceStub(ticks=8))
    goal = loop.propose_goal(NEAR)
    assert loop.executive.progress(goal)[1] is None
    until(loop, Phase.EXECUTING)
    _, first = loop.executive.progress(goal)
    assert first is not None
    assert first - 7.5 == pytest.approx(8 * TICK, abs=TICK + 1e-9)
    for ticks in (1, 2, 3):
        loop.tick()
        _, left = loop.executive.progress(goal)
        assert left == pytest.approx(first - ticks * TICK)


# -- the page in the documents ----------------------------------------------------------------


def test_the_table_of_the_documentation_has_each_transition_once() -> None:
    assert len(TRANSITIONS) == len(set(TRANSITIONS))
    assert {t.target for t in TRANSITIONS} == set(Phase)
    assert {t.source for t in TRANSITIONS} == set(Phase)
    assert {t.event for t in TRANSITIONS} == set(Event)


def test_the_diagram_of_the_documentation_is_its_table() -> None:
    diagram = re.search(r"```mermaid\nstateDiagram-v2\n(.*?)```", PAGE.read_text("utf-8"), re.S)
    assert diagram is not None
    arrows = re.findall(r"^ *(\w+) --> (\w+): (.+)$", diagram[1], re.M)
    shown = {
        Transition(Phase[source], Event(event.strip()), Phase[target])
        for source, target, events in arrows
        for event in events.split(",")
    }
    # Every phase may be deactivated, which the page says in words.
    assert shown == {t for t in TRANSITIONS if t.event is not Event.DEACTIVATED}


def test_the_documentation_explains_every_phase_event_and_reason() -> None:
    text = PAGE.read_text("utf-8")
    for each in (*Phase, *Event, *PlanReason):
        assert f"`{each.name}`" in text
