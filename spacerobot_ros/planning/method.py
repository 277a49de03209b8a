"""What every gait method is: a state and a goal in, a schedule or a reason out."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from spacerobot_ros.errors import PlanningError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.reconstruction import DEFAULT_INTEGRATION_STEP
from spacerobot_ros.planning.goal import POSE, Controlled, Goal, RobotState, Tolerance
from spacerobot_ros.planning.schedule import GaitSchedule

_AT_REST = 1e-9
"""Momenta below this times the mass count as zero, m/s and m^2/s."""


@dataclass(frozen=True)
class Option:
    """A parameter of a method; the default sets its type, unit and meaning are for people."""

    name: str
    default: float | int
    unit: str
    meaning: str
    minimum: float = 0.0
    maximum: float = 1e9


class GaitMethod(ABC):
    """A way to turn a goal pose into a gait.

    A method is constructed once for a robot and plans many times. Its ``options`` become the
    parameters ``<name>.<option>`` of the planner node and arrive as keyword arguments.

    ``controls`` names the parts of a goal that the method brings about and is judged by; the others
    come out as they must.
    """

    name: ClassVar[str]
    controls: ClassVar[frozenset[Controlled]] = POSE
    options: ClassVar[tuple[Option, ...]] = ()

    def __init__(
        self,
        robot: SpaceRobot,
        tick_period: float,
        tolerance: Tolerance,
        integration_step: float = DEFAULT_INTEGRATION_STEP,
    ) -> None:
        self.robot = robot
        self.tick_period = tick_period
        self.tolerance = tolerance
        self.integration_step = integration_step

    @abstractmethod
    def plan(self, state: RobotState, goal: Goal, *, correction: bool = False) -> GaitSchedule:
        """Return a gait from ``state`` to ``goal``, at rest at both ends.

        ``correction`` says that an earlier schedule for the same goal has just ended: what is left
        is small, and options that fix the size of the first manoeuvre do not apply.

        Raises
        ------
        PlanningError
            The method cannot reach the goal; the sentence says why.
        """

    def _require_rest(self, state: RobotState) -> None:
        """Refuse a robot whose total momentum is not zero; for methods that plan without it."""
        p, L = np.linalg.norm(state.linear_momentum), np.linalg.norm(state.angular_momentum)
        if max(p, L) > _AT_REST * self.robot.total_mass:
            raise PlanningError(
                "The robot drifts: its total momentum is not zero "
                f"({p:.3g} kg m/s, {L:.3g} kg m^2/s), and {self.name} plans for zero momentum; "
                "shape changes cannot remove it."
            )
