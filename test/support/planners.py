"""Gait methods that plan one schedule after another, as for an executive."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from spacerobot_ros.errors import PlanningError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.integration import DEFAULT_INTEGRATION_STEP
from spacerobot_ros.planning import (
    METHODS,
    GaitMethod,
    GaitSchedule,
    Goal,
    PlanRequest,
    RobotState,
    Tolerance,
    method_options,
)


class Planner:
    """A method and a tolerance; a schedule for the goal of the one before goes on from that."""

    def __init__(self, method: GaitMethod, tolerance: Tolerance) -> None:
        self.method = method
        self.tolerance = tolerance
        self._previous: GaitSchedule | None = None

    def plan(self, state: RobotState, goal: Goal, *, correction: bool = False) -> GaitSchedule:
        previous = self._previous
        if previous is not None and previous.goal is not goal:
            previous = None
        request = PlanRequest(state, goal, self.tolerance, correction, previous)
        self._previous = self.method.plan(request)
        return self._previous


def planner_of(
    name: str,
    robot: SpaceRobot,
    control_period: float,
    tolerance: Tolerance,
    integration_step: float = DEFAULT_INTEGRATION_STEP,
    **options: Any,
) -> Planner:
    """Return a method of the registry with options by name."""
    chosen = method_options(name, options)
    return Planner(METHODS[name](robot, control_period, integration_step, chosen), tolerance)


def refusal_in(plan: Callable[[], object]) -> str:
    """Return the one sentence with which a plan is refused."""
    with pytest.raises(PlanningError) as refusal:
        plan()
    text = str(refusal.value)
    assert text.endswith(".")
    assert "\n" not in text
    return text


def assert_within(
    schedule: GaitSchedule, velocity: npt.ArrayLike, acceleration: npt.ArrayLike
) -> None:
    """Check by differences of the shapes that a schedule from rest to rest keeps limits (n,)."""
    rest = np.zeros((1, schedule.positions.shape[1]))
    rates = np.vstack([rest, np.diff(schedule.positions, axis=0) / schedule.control_period, rest])
    changes = np.abs(np.diff(rates, axis=0)) / schedule.control_period
    assert np.all(np.abs(rates).max(axis=0) <= np.asarray(velocity) * (1 + 1e-8))
    assert np.all(changes.max(axis=0) <= np.asarray(acceleration) * (1 + 1e-8))
