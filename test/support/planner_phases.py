"""Planner loops that are in each phase of the state machine."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from support.planner_loop import NEAR, Loop, Place, StubMethod

from spacerobot_ros.planning.execution.status import Phase

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


def evaluating(**options: Any) -> Loop:
    """Wait for a second measured state after a schedule."""
    return until(executing(averaging=2, **options), Phase.EVALUATING)


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
    loop.take()


def jump(seconds: float) -> Act:
    """Let the time of the states jump, and show one of them."""

    def act(loop: Loop) -> None:
        loop.measured.stamp_ns += round(seconds * 1e9)
        loop.tick(base=False)

    return act


def long_flight() -> Loop:
    """Fly long enough for a joint to be found stuck, and plan without it in the background."""
    loop = executing(held=True, ticks=400, stuck_ticks=5)
    quick_without_joints(loop)
    return loop


def quick_without_joints(loop: Loop) -> None:
    """Have the stub plan without stuck joints too: models without them take seconds to build."""
    loop.held.plans_with_stuck_joints = True
