"""Planner loops that are in each phase of the state machine."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from support.planner_loop import NEAR, Loop, MovingStub, Place, StubMethod

from spacerobot_ros.planning.execution.executive import (
    Phase,
)
from spacerobot_ros.planning.execution.teleoperation import TwistCommand, TwistFrame

FAR: Place = ([50.0, 0.0, 0.0], [0.0, 0.0, 0.0])
OTHER: Place = ([-0.04, 0.0, 0.01], [0.0, 0.0, 0.0])


def resting(*, held: bool = False, ticks: int = 8, **parameters: Any) -> Loop:
    return Loop(parameters, method=StubMethod(ticks), held=held)


def stub_of(loop: Loop) -> StubMethod:
    assert isinstance(loop.method, StubMethod)
    return loop.method


def measuring(**options: Any) -> Loop:
    loop = resting(**options)
    loop.propose_goal(NEAR)
    return loop


def planning(place: Place = NEAR) -> Loop:
    loop = resting(held=True)
    loop.propose_goal(place)
    loop.tick()
    return loop


def executing(*, wrong_path: float = 0.0, overshoot: float = 0.0, **options: Any) -> Loop:
    loop = resting(**options)
    stub_of(loop).wrong_path, stub_of(loop).overshoot = wrong_path, overshoot
    loop.propose_goal(NEAR)
    loop.tick()
    if loop.held.is_busy:
        loop.held.release()
        loop.tick()
    return loop


def braking() -> Loop:
    """Brake because the goal was given up."""
    loop = executing(ticks=40)
    loop.tick(5)
    loop.abort()
    return loop


def braking_off_path(**options: Any) -> Loop:
    """Brake to plan from rest, because the base is off its path."""
    loop = executing(held=True, ticks=400, wrong_path=0.1, drift_position=1e-3, **options)
    loop.tick(60)
    return loop


def twisting() -> Loop:
    """Let a slider follow twists."""
    loop = resting()
    loop.tick(3)
    twist = np.array([0.02, -0.01, 0.015])
    command = TwistCommand("mass_1", twist, np.zeros(3), TwistFrame.WORLD)
    loop.executive.propose_twist(command)
    loop.tick(4)
    return loop


def evaluating(**options: Any) -> Loop:
    """Wait for a second measured state after a schedule."""
    return until(executing(averaging=2, **options), Phase.EVALUATING)


def flying_on(*, again: bool = False, **parameters: Any) -> Loop:
    """Fly while a plan is made that takes over in motion: for another goal, or for this one."""
    if again:
        parameters = {"replan_period": 0.2, **parameters}
    parameters = {"takeover_time": 0.5, **parameters}
    loop = Loop(parameters, method=MovingStub(80), held=True)
    stub_of(loop).wrong_path = 0.1
    loop.propose_goal(NEAR)
    loop.tick()
    loop.held.release()
    loop.tick(5)
    if not again:
        loop.propose_goal(OTHER)
        loop.tick()
    return until(loop, Phase.REPLANNING)


def taking_over(*, again: bool = False, **parameters: Any) -> Loop:
    """Fly on until the plan that is there takes over."""
    loop = flying_on(again=again, **parameters)
    loop.held.release()
    loop.tick()
    assert loop.executive.phase is Phase.TAKING_OVER
    return loop


def until(loop: Loop, phase: Phase, *, base: bool = True, ticks: int = 600) -> Loop:
    for _ in range(ticks):
        if loop.executive.phase is phase:
            return loop
        loop.tick(base=base)
    raise AssertionError(f"{loop.executive.phase} instead of {phase}")


def stuck(loop: Loop, *, base: bool = True) -> Loop:
    """Hold the first joint until it is found stuck."""
    loop.plant.hold(np.array([True, False, False]))
    before = loop.executive.phase
    for _ in range(600):
        if loop.executive.phase is not before:
            return loop
        loop.tick(base=base)
    raise AssertionError("no joint was found stuck")


Act = Callable[[Loop], object]


def reset_plant(loop: Loop) -> None:
    loop.plant.reset()
    loop.executive.plant_reset()
    loop._take()


def jump(seconds: float) -> Act:
    """Let the time of the states jump, and show one of them."""

    def act(loop: Loop) -> None:
        loop.measured.stamp_ns += round(seconds * 1e9)
        loop.tick(base=False)

    return act


def long_flight() -> Loop:
    return executing(ticks=400, stuck_ticks=5)


def quick_without_joints(loop: Loop) -> None:
    """Have the stub plan without stuck joints too: models without them take seconds to build."""
    loop.held._choose_method = lambda task: stub_of(loop)  # type: ignore[method-assign]
