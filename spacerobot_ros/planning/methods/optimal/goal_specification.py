"""Which parts of a goal are to be met, and what that asks of the joints."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from spacerobot_ros.errors import PlanningError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.rotations import (
    matrix_from_quaternion,
    quaternion_inverse,
    quaternion_multiply,
)
from spacerobot_ros.planning.core.goal import Controlled, Goal, RobotState, Tolerance
from spacerobot_ros.planning.methods.optimal.limits import MotionLimits
from spacerobot_ros.planning.methods.optimal.reach import Turning, shape_for_center, slides_anywhere
from spacerobot_ros.planning.methods.optimal.trajectory import Task

_NO_ROTATION = 1e-9


@dataclass(frozen=True)
class Wishes:
    """The parts of a goal that one robot's manoeuvres meet.

    ``same_shape`` says that goals without a shape of their own end in the one they start from.
    """

    position: bool
    attitude: bool
    same_shape: bool
    turning: Turning

    @classmethod
    def of(
        cls, robot: SpaceRobot, position: int = 0, attitude: int = 1, final_shape: int = 0
    ) -> Wishes:
        """Return the wishes of a method's options (see ``OptimalGait.options``)."""
        wanted = slides_anywhere(robot) if position == 0 else position == 1
        return cls(wanted, bool(attitude), bool(final_shape), Turning.of(robot))

    @property
    def controls(self) -> frozenset[Controlled]:
        """The parts by name."""
        parts: set[Controlled] = {"shape"}
        if self.position:
            parts.add("position")
        if self.attitude:
            parts.add("attitude")
        return frozenset(parts)

    @property
    def axes(self) -> Array:
        """Directions (m, 3) in the base along which the attitude is to be met."""
        return self.turning.axes if self.attitude else np.zeros((0, 3))

    def objection(self, robot: SpaceRobot) -> str:
        """Return why none of these goals can be planned for the robot, "" if some can."""
        name = robot.description.name
        if robot.n == 0:
            return f"Robot '{name}' has no joints that could move its base."
        if self.attitude and self.turning.moves and not len(self.turning.axes):
            return (
                f"The attitude of robot '{name}' is uncontrollable: whatever its joints do, its "
                "base only turns to and fro along one curve of attitudes; with "
                "optimal.base_attitude 0 the attitude of the goal is ignored."
            )
        return ""

    def task(
        self,
        robot: SpaceRobot,
        state: RobotState,
        goal: Goal,
        shape: Array | None,
        limits: MotionLimits,
        tolerance: Tolerance,
        direction_W: Array | None,
    ) -> Task:
        """Return what is asked; ``shape`` (n,) is the goal's, within the strokes.

        Raises
        ------
        PlanningError
            A part of the goal is out of the robot's reach.
        """
        if refusal := self.objection(robot):
            raise PlanningError(refusal)
        turn = quaternion_multiply(quaternion_inverse(state.quaternion), goal.quaternion)
        if shape is None and self.same_shape:
            shape = state.q
        if self.attitude:
            self._require_turn(robot, turn, shape, tolerance)
        R_WB = matrix_from_quaternion(state.quaternion)
        direction = np.zeros(3) if direction_W is None else R_WB.T @ direction_W
        if not self.position:
            return Task(state.q, turn, state.q if shape is None else shape, shape, None, direction)
        if not self.attitude:
            raise PlanningError(
                "The position of the base depends on its attitude: optimal meets it together with "
                "the attitude (optimal.base_attitude 1)."
            )
        # r + R c(q) is the centre of mass and stays: so c(q_f) is known.
        r_cm = state.position + R_WB @ robot.center_of_mass(state.q)
        center = matrix_from_quaternion(goal.quaternion).T @ (r_cm - goal.position)
        if shape is not None:
            miss = float(np.linalg.norm(robot.center_of_mass(shape) - center))
            if miss > tolerance.position:
                raise PlanningError(
                    f"Attitude and shape of the goal put the base {miss:.3g} m from its position: "
                    "without thrust the centre of mass stays where it is. Leave the shape out, or "
                    "ignore the position with optimal.base_position 2."
                )
            return Task(state.q, turn, shape, shape, None, direction)
        likely = shape_for_center(robot, limits, state.q, center)
        # Three coordinates have few shapes for one centre of mass, or one.
        if robot.n <= 3:
            return Task(state.q, turn, likely, likely, None, direction)
        return Task(state.q, turn, likely, None, center, direction)

    def _require_turn(
        self, robot: SpaceRobot, turn: Array, shape: Array | None, tolerance: Tolerance
    ) -> None:
        """Refuse attitudes that the joints cannot bring about."""
        axes, name = self.turning.axes, robot.description.name
        vector, scalar = turn[:3], float(turn[3])
        about = axes @ vector
        across = float(np.linalg.norm(vector - axes.T @ about))
        tilt = 2 * math.atan2(across, math.hypot(float(np.linalg.norm(about)), scalar))
        if tilt > max(tolerance.attitude, _NO_ROTATION):
            if not len(axes):
                raise PlanningError(
                    f"The attitude of robot '{name}' is uncontrollable: its joints do not turn its "
                    f"base, and the goal is turned by {tilt:.4g} rad."
                )
            raise PlanningError(
                f"The goal attitude is {tilt:.4g} rad off any rotation about the axis "
                f"{(np.round(axes[0], 6) + 0.0).tolist()} of {robot.base_link}: planar robot "
                f"'{name}' turns about no other."
            )
        if shape is not None and len(axes) and not self.turning.loops:
            raise PlanningError(
                f"The attitude of robot '{name}' is uncontrollable where the final shape is given: "
                "loops of its joints do not turn its base."
            )
