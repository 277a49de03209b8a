"""Gait methods that plan one schedule after another, as for an executive."""

from __future__ import annotations

from typing import Any

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
