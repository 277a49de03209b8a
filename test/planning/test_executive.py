"""The planner's state machine: no illegal transition, and its page in the documents."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.planner_loop import HERE, NEAR, TICK, Loop, MovingStub, StubMethod
from support.planner_phases import (
    FAR,
    OTHER,
    Act,
    jump,
    quick_without_joints,
    reset_plant,
    stub_of,
)

from spacerobot_ros.errors import PlanningError
from spacerobot_ros.planning import GaitSchedule
from spacerobot_ros.planning.core.cancellation import NEVER, Cancellation
from spacerobot_ros.planning.core.method import PlanRequest
from spacerobot_ros.planning.execution.executive import (
    TRANSITIONS,
    Event,
    Phase,
    Transition,
)
from spacerobot_ros.planning.execution.teleoperation import TwistCommand, TwistFrame
from spacerobot_ros.planning.execution.worker import PlanningWorker, PlanReason

PAGE = Path(__file__).parents[2] / "docs" / "planner_state_machine.md"


# -- every transition, by what happens --------------------------------------------------------


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


def check_chain(loop: Loop) -> None:
    """Check that the transitions follow each other, and that each is in the table."""
    phase = Phase.IDLE
    for transition in loop.transitions:
        assert transition.source is phase
        assert transition in TRANSITIONS
        phase = transition.target
    assert loop.executive.phase is phase


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


class PieceStub(StubMethod):
    """Plans a piece, after which others of 7.5 s are expected."""

    def plan(self, request: PlanRequest, cancellation: Cancellation = NEVER) -> GaitSchedule:
        return replace(super().plan(request, cancellation), remaining=7.5)


def test_the_time_until_the_end_of_a_goal_is_that_of_this_piece_and_of_those_to_come() -> None:
    loop = Loop(method=PieceStub(ticks=8))
    goal = loop.propose_goal(NEAR)
    assert loop.executive.progress(goal)[1] is None
    while loop.executive.phase is not Phase.EXECUTING:
        loop.tick()
    _, first = loop.executive.progress(goal)
    assert first is not None
    assert first - 7.5 == pytest.approx(8 * TICK, abs=TICK + 1e-9)
    for ticks in (1, 2, 3):
        loop.tick()
        _, left = loop.executive.progress(goal)
        assert left == pytest.approx(first - ticks * TICK)


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
