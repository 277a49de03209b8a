"""What every gait method is: a state and a goal in, a schedule or a reason out."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from spacerobot_ros.errors import PlanningError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array, JointKind
from spacerobot_ros.model.integration import DEFAULT_INTEGRATION_STEP
from spacerobot_ros.parameters import configured, require_known
from spacerobot_ros.planning.core.goal import POSE, Controlled, Goal, RobotState, Tolerance
from spacerobot_ros.planning.core.schedule import BasePath, GaitSchedule, Notes

_AT_REST = 1e-9
"""Momenta below this times the mass count as zero, m/s and m^2/s."""

_BEYOND = 1e-9
"""Rounding that a goal shape may be beyond a limit by, m or rad."""


@dataclass(frozen=True)
class NoOptions:
    """The options of a method that has none."""


class GaitMethod(ABC):
    """A way to turn a goal pose into a gait.

    A method is constructed once for a robot and plans many times. Its ``options`` become the
    parameters ``<name>.<option>`` of the planner node and arrive as keyword arguments.

    ``controls`` names the parts of a goal that the method brings about and is judged by; the others
    come out as they must.

    Parameters
    ----------
    robot
        The model.
    tick_period
        How long a command is held, s.
    tolerance
        How near is there.
    integration_step
        Longest Runge-Kutta step of the predicted attitude, s; the plant's, for equal numbers.
    options
        Values of the method's ``options`` by name; those left out have their defaults.

    Raises
    ------
    ParameterError
        There is no such option, or a value does not go with its range, the robot or another option.
    """

    name: ClassVar[str]
    controls: frozenset[Controlled] = POSE
    Options: ClassVar[Any] = NoOptions

    def __init__(
        self,
        robot: SpaceRobot,
        tick_period: float,
        tolerance: Tolerance,
        integration_step: float = DEFAULT_INTEGRATION_STEP,
        **options: Any,
    ) -> None:
        self.robot = robot
        self.tick_period = tick_period
        self.tolerance = tolerance
        self.integration_step = integration_step
        require_known(self.name, self.Options, options)
        self._options = configured(self.Options, options)
        self._prepare()

    def _prepare(self) -> None:  # noqa: B027 - methods that delegate have nothing to set up here
        """Set up what the method keeps for all its plans, by ``_settings``; called once."""

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

    def _schedule_of(
        self, goal: Goal, positions: Array, path: BasePath, notes: Notes, *, partial: bool = False
    ) -> GaitSchedule:
        """Return shapes (N + 1, n) at the ticks as a schedule of this method."""
        return GaitSchedule(
            method=self.name,
            joint_names=self.robot.joint_names,
            tick_period=self.tick_period,
            positions=positions,
            path=path,
            goal=goal,
            notes=notes,
            partial=partial,
        )

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
