"""What every gait method is: a state and a goal in, a schedule or a reason out."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from spacerobot_ros.errors import PlanningError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array, JointKind
from spacerobot_ros.model.reconstruction import DEFAULT_INTEGRATION_STEP
from spacerobot_ros.planning.goal import POSE, Controlled, Goal, RobotState, Tolerance
from spacerobot_ros.planning.schedule import GaitSchedule

_AT_REST = 1e-9
"""Momenta below this times the mass count as zero, m/s and m^2/s."""

_BEYOND = 1e-9
"""Rounding that a goal shape may be beyond a limit by, m or rad."""


@dataclass(frozen=True)
class Option:
    """A parameter of a method; the default sets its type, unit and meaning are for people.

    ``minimum`` and ``maximum`` are those of numbers and of the entries of a list.
    """

    name: str
    default: float | int | str | list[float]
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
    controls: frozenset[Controlled] = POSE
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

    @classmethod
    def objection(cls, robot: SpaceRobot) -> str:
        """Return why no goal of this robot can be planned, whatever the options; "" if some can."""
        return ""

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

    def _goal_shape(self, goal: Goal) -> Array | None:
        """Return the shape (n,) that the goal asks for, None where it asks for none.

        Raises
        ------
        PlanningError
            It is of another robot or beyond the joint limits.
        """
        wanted, robot = goal.joint_positions, self.robot
        if wanted is None:
            return None
        if len(wanted) != robot.n:
            raise PlanningError(
                f"The goal shape has {len(wanted)} joint position(s); robot "
                f"'{robot.description.name}' has {robot.n} joints."
            )
        beyond = np.maximum(robot.lower - wanted, wanted - robot.upper)
        worst = int(np.argmax(beyond))
        if beyond[worst] > _BEYOND:
            joint = robot.description.movable_joints[worst]
            unit = "m" if joint.kind is JointKind.PRISMATIC else "rad"
            raise PlanningError(
                f"The goal shape is beyond limits: joint '{joint.name}' at "
                f"{wanted[worst]:.4g} {unit}, and its limits are "
                f"[{robot.lower[worst]:.4g}, {robot.upper[worst]:.4g}] {unit}."
            )
        return np.clip(wanted, robot.lower, robot.upper)

    def _require_rest(self, state: RobotState) -> None:
        """Refuse a robot whose total momentum is not zero; for methods that plan without it."""
        p, L = np.linalg.norm(state.linear_momentum), np.linalg.norm(state.angular_momentum)
        if max(p, L) > _AT_REST * self.robot.total_mass:
            raise PlanningError(
                "The robot drifts: its total momentum is not zero "
                f"({p:.3g} kg m/s, {L:.3g} kg m^2/s), and {self.name} plans for zero momentum; "
                "shape changes cannot remove it."
            )
