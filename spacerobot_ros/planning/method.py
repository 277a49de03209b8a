"""What every gait method is: a state and a goal in, a schedule or a reason out."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.reconstruction import DEFAULT_INTEGRATION_STEP
from spacerobot_ros.planning.goal import Goal, RobotState, Tolerance
from spacerobot_ros.planning.schedule import GaitSchedule


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
    """

    name: ClassVar[str]
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
