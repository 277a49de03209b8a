"""What the way to the goal must keep, beside the limits of the joints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import casadi as ca
import numpy as np

from spacerobot_ros.errors import ParameterError
from spacerobot_ros.model import SpaceRobot, symbolic_rotations
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.rotations import matrix_from_quaternion
from spacerobot_ros.planning.methods.optimal.trajectory import Trajectory

_SHARPNESS = 8
"""Exponent of the smooth bodies that stand for boxes of shapes."""

_FREE = 1e6
"""Bounds of a box beyond this, m or rad, are none where a joint has no end of stroke."""

_ROOM = 0.02
"""What a solution keeps off its path constraints, relative: they are imposed between steps."""


@dataclass(frozen=True)
class _Body:
    """A smooth body of shapes through the corners of a box: outside of it is outside of the box.

    ``middle`` and ``half`` are the box's, of the ``joints`` that it bounds.
    """

    joints: list[int]
    middle: Array
    half: Array

    @classmethod
    def of(cls, robot: SpaceRobot, lower: Array, upper: Array) -> _Body:
        bounded = [
            i
            for i in range(robot.n)
            if lower[i] > max(robot.lower[i], -_FREE) or upper[i] < min(robot.upper[i], _FREE)
        ]
        if not bounded:
            raise ParameterError("A box of optimal.keep_out holds all shapes of the robot.")
        # A side beyond the stroke is as good a stroke away: nobody comes there.
        stroke = robot.upper - robot.lower
        lower = np.maximum(lower, robot.lower - stroke)[bounded]
        upper = np.minimum(upper, robot.upper + stroke)[bounded]
        return cls(bounded, (upper + lower) / 2, (upper - lower) / 2 * (1 + _ROOM))


@dataclass(frozen=True)
class PathConstraints:
    """Bounds on the path; each is absent by default.

    ``base_rate`` in rad/s is the fastest turn of the base (0: any). ``axis_B`` (3,), a direction
    fixed in the base, stays out of the cone of half angle ``cone`` (rad) round ``direction_W``
    (3,) (an instrument that must not see the Sun). ``boxes`` (K, 2, n) are lower and upper corners
    of boxes of shapes that the joints must not enter.
    """

    base_rate: float = 0.0
    axis_B: Array | None = None
    direction_W: Array | None = None
    cone: float = 0.0
    boxes: Array = field(default_factory=lambda: np.zeros((0, 2, 0)))
    bodies: tuple[_Body, ...] = ()

    @classmethod
    def of(
        cls,
        robot: SpaceRobot,
        base_rate: float,
        axis: Sequence[float],
        direction: Sequence[float],
        cone: float,
        boxes: Sequence[float],
    ) -> PathConstraints:
        """Return constraints from a method's options; boxes as lower and upper corners in turn.

        Raises
        ------
        ParameterError
            A list has the wrong length, a direction is zero, or a box is empty.
        """
        pointing = [_direction(name, v) for name, v in (("axis", axis), ("direction", direction))]
        if (pointing[0] is None) != (pointing[1] is None) or (cone > 0) != bool(axis):
            raise ParameterError(
                "An attitude that is kept takes all of optimal.keep_axis, optimal.keep_direction "
                "and optimal.keep_angle."
            )
        joints = robot.n
        if len(boxes) % (2 * joints or 1):
            raise ParameterError(
                f"optimal.keep_out has {len(boxes)} numbers; a box of shapes has {joints} lower "
                f"and {joints} upper ones."
            )
        corners = np.reshape(np.asarray(boxes, dtype=float), (-1, 2, max(joints, 1)))
        if np.any(corners[:, 0] >= corners[:, 1]):
            raise ParameterError(
                "optimal.keep_out has a box whose lower bound is not below its upper."
            )
        bodies = tuple(_Body.of(robot, *box) for box in corners)
        return cls(base_rate, pointing[0], pointing[1], cone, corners, bodies)

    @property
    def on_knots(self) -> int:
        """How many inequalities :meth:`symbolic` returns."""
        return len(self.boxes) + (self.axis_B is not None)

    def symbolic(self, q: ca.SX, quaternion: ca.SX, direction: ca.SX) -> ca.SX:
        """Return what must not be negative at a shape and an attitude, scaled to about one.

        ``direction`` (3,) is the kept direction in the frame that the quaternion refers to.
        """
        rows = [ca.SX(0, 1)]
        for body in self.bodies:
            x = (q[body.joints] - body.middle) / body.half
            rows.append(ca.log(ca.sum1(x**_SHARPNESS) / len(body.joints) + 1e-3))
        if self.axis_B is not None:
            R_WB = symbolic_rotations.matrix_from_quaternion(quaternion)
            seen = ca.dot(R_WB @ ca.DM(self.axis_B), direction)
            rows.append(np.cos(min(self.cone * (1 + _ROOM), np.pi)) - seen)
        return ca.vertcat(*rows)

    def violation(self, positions: Array, quaternions: Array, period: float) -> str:
        """Return which constraint a path at ticks breaks, in words; "" if none.

        ``positions`` (N + 1, n), ``quaternions`` (N + 1, 4) of R_WB.
        """
        for box in self.boxes:
            inside = np.all((positions > box[0]) & (positions < box[1]), axis=1)
            if inside.any():
                return f"the shape enters a box of keep_out at {np.argmax(inside) * period:.4g} s"
        if self.axis_B is not None and self.direction_W is not None:
            seen = [
                float(matrix_from_quaternion(x) @ self.axis_B @ self.direction_W)
                for x in quaternions
            ]
            angle = np.arccos(np.clip(np.max(seen), -1.0, 1.0))
            if angle < self.cone - 1e-9:
                return f"the axis comes within {angle:.4g} rad of keep_direction"
        if self.base_rate > 0:
            rate = _fastest_turn(quaternions, period)
            if rate > self.base_rate * (1 + 1e-6):
                return f"the base turns at {rate:.4g} rad/s"
        return ""

    @property
    def imposed_base_rate(self) -> float:
        """The bound on the base rate that a solution is held to at its steps, rad/s."""
        return self.base_rate * (1 - _ROOM)

    def slowed(self, guess: Trajectory) -> Trajectory:
        """Return a guess that turns the base no faster than it may."""
        if self.base_rate == 0:
            return guess
        fastest = _fastest_turn(guess.quaternions, guess.step)
        return guess.retimed(max(1.0, fastest / self.imposed_base_rate))


def _direction(name: str, values: Sequence[float]) -> Array | None:
    if not values:
        return None
    vector = np.asarray(values, dtype=float)
    length = float(np.linalg.norm(vector))
    if vector.shape != (3,) or length == 0:
        raise ParameterError(
            f"optimal.keep_{name} is {values}; it must be three numbers, not all zero."
        )
    return np.asarray(vector / length)


def _fastest_turn(quaternions: Array, period: float) -> float:
    """Return the largest mean rate (rad/s) between attitudes (N + 1, 4) that are so far apart."""
    # |a - b| is twice the sine of a quarter of the angle.
    apart = np.linalg.norm(np.diff(quaternions, axis=0), axis=1)
    angles = 4 * np.arcsin(np.minimum(apart / 2, 1.0))
    return float(angles.max(initial=0.0)) / period
