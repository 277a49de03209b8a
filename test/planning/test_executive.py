"""The planner's state machine: every transition, no illegal one, and its page in the documents."""

from __future__ import annotations

import itertools
import re
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.planner_loop import HERE, NEAR, TICK_NS, Loop, MovingStub, Place, StubMethod
from support.planner_phases import (
    FAR,
    OTHER,
    Act,
    braking,
    braking_off_path,
    evaluating,
    executing,
    flying_on,
    jump,
    long_flight,
    measuring,
    planning,
    quick_without_joints,
    reset_plant,
    resting,
    stub_of,
    stuck,
    taking_over,
    twisting,
    until,
)

from spacerobot_ros.errors import PlanningError
from spacerobot_ros.planning.execution.executive import (
    TRANSITIONS,
    Event,
    IllegalTransitionError,
    Phase,
    Transition,
)
from spacerobot_ros.planning.execution.teleoperation import TwistCommand, TwistFrame
from spacerobot_ros.planning.execution.worker import PlanningWorker, PlanReason

PAGE = Path(__file__).parents[2] / "docs" / "planner_state_machine.md"


# -- every transition, by what happens --------------------------------------------------------

P, E = Phase, Event


def propose_goal(place: Place) -> Act:
    return lambda loop: loop.propose_goal(place)


def tick(loop: Loop) -> None:
    loop.tick()


def release(loop: Loop) -> None:
    loop.held.release()
    loop.tick()


def abort(loop: Loop) -> None:
    loop.abort()


def stop(loop: Loop) -> None:
    loop.stop()


def twist(loop: Loop) -> None:
    command = TwistCommand("mass_2", np.array([0.3, 0.01, -0.4]), np.ones(3), TwistFrame.BASE)
    with suppress(PlanningError):
        loop.executive.propose_twist(command)


def stopped_plant(loop: Loop) -> None:
    loop.executive.plant_stopped("The plant is latched.")
    loop._take()


def late_command(loop: Loop) -> None:
    """Let the plant rest because no command has come in time for the goal that is pursued."""
    now = loop.measured.stamp_ns
    loop.executive.plant_stopped("The last command is too old.", now, now + 1)
    loop._take()


def obstacles(*, near: bool) -> Act:
    """Let other obstacles be there, which the rest of the schedule comes too near to, or not."""
    clearance: Any = SimpleNamespace(
        has_obstacles=True,
        approaches=lambda positions, base: ["there"] * near,
        clause=lambda approach, period: "link 'a' and obstacle 'b' touch",
    )

    def act(loop: Loop) -> None:
        worker = loop.executive._worker

        def make() -> PlanningWorker:
            worker.clearance = clearance
            return worker

        loop.executive.use_obstacles(make)
        loop._take()

    return act


def to(phase: Phase, *, base: bool = True) -> Act:
    return lambda loop: until(loop, phase, base=base)


def long_braking() -> Loop:
    return braking_off_path(abort_time=100.0, stuck_ticks=5)


def again(start: Callable[..., Loop]) -> Callable[[], Loop]:
    """Start with a plan for the remaining motion instead of one for another goal."""
    return lambda: start(again=True)


def long_before(start: Callable[..., Loop]) -> Callable[..., Loop]:
    """Start long before the plan is to take over."""
    return lambda **options: start(takeover_time=3.0, stuck_ticks=3, **options)


def ticks_later(count: int) -> Act:
    """Let states be missing for a while, and show the one after it, at the end of the schedule."""

    def act(loop: Loop) -> None:
        loop.plant.q[:] = loop.starts[-1].schedule.positions[-1]
        loop.measured.stamp_ns += count * TICK_NS
        loop.tick(base=False)

    return act


def without_base(act: Callable[..., object]) -> Act:
    return lambda loop: act(loop, base=False)


HAPPENS: dict[tuple[Phase, Event, Phase], tuple[Callable[..., Any], ...]] = {
    (P.IDLE, E.NEW_GOAL, P.MEASURING): (measuring,),
    (P.MEASURING, E.NEW_GOAL, P.MEASURING): (measuring, propose_goal(OTHER)),
    (P.MEASURING, E.PLAN_REQUESTED, P.PLANNING): (planning,),
    (P.MEASURING, E.ABORTED, P.IDLE): (measuring, abort),
    (P.PLANNING, E.PLANNED, P.EXECUTING): (executing,),
    (P.PLANNING, E.REFUSED, P.IDLE): (resting, propose_goal(FAR), tick),
    (P.PLANNING, E.REFUSED, P.MEASURING): (lambda: planning(FAR), propose_goal(NEAR), release),
    (P.PLANNING, E.REFUSED, P.EXECUTING): (executing, propose_goal(FAR), tick),
    (P.PLANNING, E.REFUSED, P.BRAKING): (braking, propose_goal(FAR), tick),
    (P.PLANNING, E.REFUSED, P.EVALUATING): (
        *(lambda: executing(held=True), propose_goal(FAR), to(P.PLANNING), release),
    ),
    (P.PLANNING, E.ABORTED, P.IDLE): (planning, abort),
    (P.EXECUTING, E.NEW_GOAL, P.BRAKING): (lambda: executing(held=True), propose_goal(OTHER), tick),
    (P.EXECUTING, E.PLAN_REQUESTED, P.PLANNING): (executing, propose_goal(OTHER), tick),
    (P.EXECUTING, E.SCHEDULE_ENDED, P.EVALUATING): (executing, to(P.IDLE)),
    (P.EXECUTING, E.SCHEDULE_ENDED, P.MEASURING): (
        *(executing, propose_goal(OTHER), to(P.MEASURING, base=False)),
    ),
    (P.EXECUTING, E.TRACKING_ERROR, P.BRAKING): (braking_off_path,),
    (P.EXECUTING, E.JOINTS_STUCK, P.EVALUATING): (long_flight, stuck),
    (P.EXECUTING, E.JOINTS_STUCK, P.MEASURING): (
        *(long_flight, propose_goal(OTHER), without_base(stuck)),
    ),
    (P.EXECUTING, E.ABORTED, P.BRAKING): (braking,),
    (P.EXECUTING, E.PLAN_REQUESTED, P.REPLANNING): (flying_on,),
    (P.REPLANNING, E.PLANNED, P.TAKING_OVER): (taking_over,),
    (P.REPLANNING, E.REFUSED, P.EXECUTING): (
        *(flying_on, lambda loop: setattr(stub_of(loop), "refusing", True), release),
    ),
    (P.REPLANNING, E.PLAN_LATE, P.EXECUTING): (flying_on, to(P.EXECUTING)),
    (P.REPLANNING, E.SCHEDULE_ENDED, P.MEASURING): (flying_on, ticks_later(80)),
    (P.REPLANNING, E.SCHEDULE_ENDED, P.EVALUATING): (again(flying_on), ticks_later(80)),
    (P.TAKING_OVER, E.TAKEN_OVER, P.EXECUTING): (taking_over, to(P.EXECUTING)),
    **{
        (phase, event, target): story
        for phase, start in ((P.REPLANNING, flying_on), (P.TAKING_OVER, taking_over))
        for event, target, story in (
            (E.NEW_GOAL, P.EXECUTING, (start, propose_goal(HERE))),
            (E.JOINTS_STUCK, P.MEASURING, (long_before(start), stuck)),
            (E.JOINTS_STUCK, P.EVALUATING, (again(long_before(start)), stuck)),
            (E.TIME_JUMPED, P.MEASURING, (start, jump(1e6))),
            (E.TIME_JUMPED, P.EVALUATING, (again(start), jump(-100.0))),
            (E.PLANT_RESET, P.MEASURING, (start, reset_plant)),
            (E.PLANT_RESET, P.EVALUATING, (again(start), reset_plant)),
            (E.ABORTED, P.BRAKING, (start, abort)),
            (E.OBSTACLES, P.EXECUTING, (start, obstacles(near=False))),
            (E.PLANT_STOPPED, P.IDLE, (start, stopped_plant)),
            (E.PLANT_STOPPED, P.MEASURING, (start, late_command)),
            (E.DEACTIVATED, P.IDLE, (start, stop)),
        )
    },
    (P.BRAKING, E.PLAN_REQUESTED, P.PLANNING): (braking, propose_goal(OTHER), tick),
    (P.BRAKING, E.AT_REST, P.IDLE): (braking, to(P.IDLE)),
    (P.BRAKING, E.AT_REST, P.MEASURING): (
        *(braking, propose_goal(OTHER), to(P.MEASURING, base=False)),
    ),
    (P.BRAKING, E.AT_REST, P.EVALUATING): (braking_off_path, to(P.PLANNING)),
    (P.BRAKING, E.JOINTS_STUCK, P.EVALUATING): (long_braking, stuck),
    (P.BRAKING, E.JOINTS_STUCK, P.MEASURING): (long_braking, propose_goal(OTHER), stuck),
    (P.BRAKING, E.ABORTED, P.BRAKING): (braking, abort),
    (P.EVALUATING, E.NEW_GOAL, P.MEASURING): (evaluating, propose_goal(OTHER)),
    (P.EVALUATING, E.PLAN_REQUESTED, P.PLANNING): (lambda: evaluating(overshoot=0.5), tick),
    (P.EVALUATING, E.REACHED, P.IDLE): (evaluating, tick),
    (P.EVALUATING, E.FAILED, P.IDLE): (
        *(lambda: evaluating(overshoot=0.5, max_corrections=0), tick),
    ),
    (P.EVALUATING, E.ABORTED, P.IDLE): (evaluating, abort),
    (P.MEASURING, E.PLANT_STOPPED, P.IDLE): (measuring, stopped_plant),
    (P.MEASURING, E.PLANT_STOPPED, P.MEASURING): (evaluating, propose_goal(OTHER), late_command),
    (P.PLANNING, E.PLANT_STOPPED, P.MEASURING): (
        *(lambda: executing(held=True), propose_goal(OTHER), to(P.PLANNING), late_command),
    ),
    (P.EXECUTING, E.PLANT_STOPPED, P.MEASURING): (executing, propose_goal(OTHER), late_command),
    (P.BRAKING, E.PLANT_STOPPED, P.MEASURING): (
        *(lambda: executing(held=True), propose_goal(OTHER), tick, late_command),
    ),
    (P.PLANNING, E.PLANT_STOPPED, P.IDLE): (planning, stopped_plant),
    (P.EXECUTING, E.PLANT_STOPPED, P.IDLE): (executing, stopped_plant),
    (P.BRAKING, E.PLANT_STOPPED, P.IDLE): (braking, stopped_plant),
    (P.EVALUATING, E.PLANT_STOPPED, P.IDLE): (evaluating, stopped_plant),
    (P.PLANNING, E.PLANT_RESET, P.MEASURING): (planning, reset_plant),
    (P.PLANNING, E.PLANT_RESET, P.EVALUATING): (*(braking_off_path, to(P.PLANNING), reset_plant),),
    (P.PLANNING, E.OBSTACLES, P.MEASURING): (planning, obstacles(near=True)),
    (P.PLANNING, E.OBSTACLES, P.EVALUATING): (
        *(braking_off_path, to(P.PLANNING), obstacles(near=False)),
    ),
    (P.EXECUTING, E.OBSTACLES, P.BRAKING): (executing, obstacles(near=True)),
    (P.EXECUTING, E.PLANT_RESET, P.EVALUATING): (executing, reset_plant),
    (P.EXECUTING, E.PLANT_RESET, P.MEASURING): (executing, propose_goal(OTHER), reset_plant),
    (P.BRAKING, E.PLANT_RESET, P.IDLE): (braking, reset_plant),
    (P.BRAKING, E.PLANT_RESET, P.MEASURING): (braking, propose_goal(OTHER), reset_plant),
    (P.BRAKING, E.PLANT_RESET, P.EVALUATING): (long_braking, reset_plant),
    (P.EXECUTING, E.TIME_JUMPED, P.EVALUATING): (long_flight, jump(1e6)),
    (P.EXECUTING, E.TIME_JUMPED, P.MEASURING): (long_flight, propose_goal(OTHER), jump(-1.0)),
    (P.BRAKING, E.TIME_JUMPED, P.IDLE): (braking, jump(-100.0)),
    (P.BRAKING, E.TIME_JUMPED, P.MEASURING): (braking, propose_goal(OTHER), jump(1e6)),
    (P.BRAKING, E.TIME_JUMPED, P.EVALUATING): (long_braking, jump(1e6)),
    (P.IDLE, E.TWIST, P.TELEOPERATING): (twisting,),
    (P.TELEOPERATING, E.AT_REST, P.IDLE): (twisting, to(P.IDLE)),
    (P.TELEOPERATING, E.AT_REST, P.MEASURING): (*(twisting, propose_goal(OTHER), to(P.MEASURING)),),
    (P.TELEOPERATING, E.TIME_JUMPED, P.IDLE): (twisting, jump(1e6)),
    (P.TELEOPERATING, E.TIME_JUMPED, P.MEASURING): (twisting, propose_goal(OTHER), jump(-0.3)),
    (P.TELEOPERATING, E.PLANT_RESET, P.IDLE): (twisting, reset_plant),
    (P.TELEOPERATING, E.PLANT_RESET, P.MEASURING): (twisting, propose_goal(OTHER), reset_plant),
    (P.TELEOPERATING, E.PLANT_STOPPED, P.IDLE): (twisting, stopped_plant),
    (P.TELEOPERATING, E.DEACTIVATED, P.IDLE): (twisting, stop),
    (P.IDLE, E.DEACTIVATED, P.IDLE): (resting, stop),
    (P.MEASURING, E.DEACTIVATED, P.IDLE): (measuring, stop),
    (P.PLANNING, E.DEACTIVATED, P.IDLE): (planning, stop),
    (P.EXECUTING, E.DEACTIVATED, P.IDLE): (executing, stop),
    (P.BRAKING, E.DEACTIVATED, P.IDLE): (braking, stop),
    (P.EVALUATING, E.DEACTIVATED, P.IDLE): (evaluating, stop),
}
"""How every transition comes about: a start, and what happens then."""


def in_words(transition: Transition) -> str:
    return f"{transition.source.value}, {transition.event.value}, {transition.target.value}"


def check_chain(loop: Loop) -> None:
    """Check that the transitions follow each other, and that each is in the table."""
    phase = Phase.IDLE
    for transition in loop.transitions:
        assert transition.source is phase
        assert transition in TRANSITIONS
        phase = transition.target
    assert loop.executive.phase is phase


@pytest.mark.parametrize("wanted", [Transition(*key) for key in HAPPENS], ids=in_words)
def test_every_transition_of_the_table_happens(wanted: Transition) -> None:
    start, *story = HAPPENS[wanted.source, wanted.event, wanted.target]
    loop = start()
    for act in story:
        act(loop)
    assert wanted in loop.transitions
    check_chain(loop)


def test_only_transitions_of_the_table_are_tried() -> None:
    assert {Transition(*key) for key in HAPPENS} == TRANSITIONS


def test_every_other_transition_raises() -> None:
    executive = resting().executive
    for source, event, target in itertools.product(Phase, Event, Phase):
        if Transition(source, event, target) in TRANSITIONS:
            continue
        executive.phase = source
        with pytest.raises(IllegalTransitionError, match=source.name):
            executive._change_phase(event, target)
        assert executive.phase is source
    assert not executive.outputs


def test_every_phase_is_reached_and_left_and_every_event_used() -> None:
    assert {t.target for t in TRANSITIONS} == set(Phase)
    assert {t.source for t in TRANSITIONS} == set(Phase)
    assert {t.event for t in TRANSITIONS} == set(Event)


def test_the_state_machine_needs_no_ros() -> None:
    load = "import sys, spacerobot_ros.planning.execution.executive; print('rclpy' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", load], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


# -- whatever happens -------------------------------------------------------------------------

ACTIONS: dict[str, Callable[[Loop], object]] = {
    "near": lambda loop: loop.propose_goal(NEAR),
    "other": lambda loop: loop.propose_goal(OTHER),
    "here": lambda loop: loop.propose_goal(HERE),
    "far": lambda loop: loop.propose_goal(FAR),
    "abort": lambda loop: loop.abort(),
    "stop": lambda loop: loop.stop(),
    "twist": lambda loop: twist(loop),
    "latch": stopped_plant,
    "told of reset": reset_plant,
    "later": jump(50.0),
    "earlier": lambda loop: jump(-min(3.0, loop.measured.stamp_ns / 1e9))(loop),
    "tick": lambda loop: loop.tick(),
    "ticks": lambda loop: loop.tick(7),
    "many": lambda loop: loop.tick(50),
    "blind": lambda loop: loop.tick(2, base=False),
    "late": lambda loop: late(loop),
    "broken": lambda loop: broken(loop),
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


IN_MOTION = (Phase.EXECUTING, Phase.REPLANNING, Phase.TAKING_OVER, Phase.BRAKING)


def late(loop: Loop) -> None:
    loop.tick(base=False)
    loop.late()


def broken(loop: Loop) -> None:
    loop.measured.broken = True
    loop.tick()
    loop.measured.broken = False


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
        assert loop.executive._tracker.is_active == (phase in IN_MOTION)
        assert held or phase not in (Phase.PLANNING, Phase.REPLANNING)
    check_chain(loop)
    # Whatever happened, it can be stopped, and the next goal is reached.
    loop.stop()
    loop.plant.hold(np.zeros(3, dtype=np.bool_))
    loop.measured.broken = False
    method.refusing = method.partial = False
    method.overshoot = method.wrong_path = 0.0
    loop.set(position_tolerance=1e-3)
    loop.propose_goal(OTHER)
    for _ in range(250):
        loop.held.release()
        loop.tick()
        if loop.states[-1:] == ["reached"]:
            break
    assert loop.states[-1:] == ["reached"]
    check_chain(loop)


# -- the page in the documents ----------------------------------------------------------------


def test_the_table_of_the_documentation_is_that_of_the_code() -> None:
    rows = re.findall(r"^\| `(\w+)` \| `(\w+)` \| (`[^|]+) \|", PAGE.read_text("utf-8"), re.M)
    shown = [
        Transition(Phase[source], Event[event], Phase[target])
        for source, event, targets in rows
        for target in re.findall(r"`(\w+)`", targets)
    ]
    assert len(shown) == len(set(shown))
    assert set(shown) == TRANSITIONS


def test_the_diagram_of_the_documentation_is_that_of_the_code() -> None:
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
