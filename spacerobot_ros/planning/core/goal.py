"""Goals, the states in which plans begin, and the error between them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import numpy.typing as npt

from spacerobot_ros.errors import GoalError
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.rotations import (
    attitude_error,
    matrix_from_rpy,
    quaternion_from_matrix,
    quaternion_from_rotvec,
    unit_quaternion,
)

Controlled = Literal["position", "attitude", "shape"]
"""A part of a goal: the position and the attitude of the base, and the joint positions."""

POSE: frozenset[Controlled] = frozenset({"position", "attitude"})
"""The parts of a goal that are the pose of the base."""


POSITION_SLACK = 0.5
"""Share of the position tolerance by which a plan may miss an unreachable position."""

_MAX_COORDINATE = 1e12
"""Largest coordinate, m or rad; a float64 resolves a millimetre up to it."""

_MAX_ANGLE = 2e6 * np.pi
"""A million turns, rad: beyond them an angle does not resolve its attitude."""


@dataclass(frozen=True)
class Goal:
    """A pose of the base link in the world, and the final shape of the joints.

    Attributes
    ----------
    position
        (3,) r_WB, m.
    quaternion
        (4,) of R_WB, (x, y, z, w).
    joint_positions
        (n,) in the order of the robot's joints, m or rad; None: the method chooses.
    """

    position: Array
    quaternion: Array
    joint_positions: Array | None = None

    @classmethod
    def checked(
        cls,
        position: npt.ArrayLike,
        quaternion: npt.ArrayLike,
        joint_positions: npt.ArrayLike | None = None,
    ) -> Goal:
        """Return a goal with a unit quaternion.

        Raises
        ------
        GoalError
            A list has the wrong length, or numbers that are not finite or too large, or the
            quaternion is zero.
        """
        r = _convert_numbers(position, "position")
        q = _convert_numbers(quaternion, "orientation")
        if r.shape != (3,) or q.shape != (4,):
            raise GoalError("A goal has three numbers of position and four of orientation.")
        if not np.all(np.isfinite(r)):
            raise GoalError(f"The goal position {r.tolist()} is not finite.")
        if np.abs(r).max() > _MAX_COORDINATE:
            raise GoalError(
                f"The goal position {r.tolist()} is farther than {_MAX_COORDINATE:g} m away."
            )
        if not np.all(np.isfinite(q)):
            raise GoalError(f"The goal orientation {q.tolist()} is not finite.")
        shape = None if joint_positions is None else _convert_numbers(joint_positions, "shape")
        if shape is not None and not (
            shape.ndim == 1
            and np.all(np.isfinite(shape))
            and np.all(np.abs(shape) <= _MAX_COORDINATE)
        ):
            raise GoalError(
                f"The goal shape {shape.tolist()} is not a list of finite joint positions "
                f"of at most {_MAX_COORDINATE:g} m or rad."
            )
        try:
            return cls(r, unit_quaternion(q), shape)
        except ValueError:
            raise GoalError(
                f"The goal orientation {q.tolist()} is a zero quaternion, not a rotation; "
                "no rotation is (0, 0, 0, 1)."
            ) from None

    @classmethod
    def from_rotvec(cls, position: npt.ArrayLike, rotvec: npt.ArrayLike) -> Goal:
        """Return the goal at a position (m) with the attitude ``exp(hat(rotvec))`` (rad).

        Raises
        ------
        GoalError
            It is no goal, or the rotation vector is not three numbers of at most a million turns.
        """
        vector = _convert_numbers(rotvec, "rotation vector")
        if vector.shape != (3,) or not np.all(np.abs(vector) <= _MAX_ANGLE):
            raise GoalError(
                f"The rotation vector {rotvec!r} is not three finite numbers of at most "
                f"{_MAX_ANGLE:.2g} rad."
            )
        return cls.checked(position, quaternion_from_rotvec(vector))

    @classmethod
    def from_rpy(cls, position: npt.ArrayLike, rpy_deg: npt.ArrayLike) -> Goal:
        """Return the goal at a position (m) after roll, pitch and yaw about fixed axes (deg).

        Raises
        ------
        GoalError
            It is no goal, or the angles are not three finite numbers.
        """
        angles = _convert_numbers(rpy_deg, "roll, pitch and yaw")
        if angles.shape != (3,) or not np.all(np.abs(angles) <= np.degrees(_MAX_ANGLE)):
            raise GoalError(f"The angles {rpy_deg!r} are not three finite numbers of degrees.")
        return cls.checked(position, quaternion_from_matrix(matrix_from_rpy(np.radians(angles))))

    def equals(self, other: Goal) -> bool:
        """Whether another goal has exactly the same pose and shape."""
        mine, others = self.joint_positions, other.joint_positions
        same_shape = (
            mine is others if mine is None or others is None else np.array_equal(mine, others)
        )
        return (
            bool(same_shape)
            and np.array_equal(self.position, other.position)
            and np.array_equal(self.quaternion, other.quaternion)
        )


def _convert_numbers(given: npt.ArrayLike, name: str) -> Array:
    try:
        return np.asarray(given, dtype=float)
    except (TypeError, ValueError, OverflowError):
        raise GoalError(f"The goal {name} {given!r} is not a list of numbers.") from None


@dataclass(frozen=True)
class RobotState:
    """The state of a robot.

    Attributes
    ----------
    position, quaternion
        (3,) r_WB in m, and (4,) of R_WB, (x, y, z, w).
    q
        (n,) joint positions, m or rad.
    linear_momentum, angular_momentum
        (3,) each in W, the second about the centre of mass of the system; kg m/s and kg m^2/s.
    """

    position: Array
    quaternion: Array
    q: Array
    linear_momentum: Array = field(default_factory=lambda: np.zeros(3))
    angular_momentum: Array = field(default_factory=lambda: np.zeros(3))


@dataclass(frozen=True)
class PoseError:
    """The remaining error of a pose and a shape to a goal.

    Attributes
    ----------
    position
        (3,) from the base to its goal, in W, m.
    rotvec
        (3,) rotation vector from the attitude to that of the goal, in B, rad.
    shape
        (n,) from the joint positions to those of the goal, m or rad; empty where the goal has none.
    """

    position: Array
    rotvec: Array
    shape: Array = field(default_factory=lambda: np.zeros(0))

    @classmethod
    def between(
        cls, position: Array, quaternion: Array, goal: Goal, q: Array | None = None
    ) -> PoseError:
        """Return the error from a pose, and from the shape ``q`` (n,) if given, to the goal."""
        shape = np.zeros(0)
        if q is not None and goal.joint_positions is not None:
            shape = goal.joint_positions - q
        return cls(goal.position - position, attitude_error(quaternion, goal.quaternion), shape)

    @property
    def distance(self) -> float:
        """Length of the position error, m."""
        return float(np.linalg.norm(self.position))

    @property
    def angle(self) -> float:
        """Angle of the attitude error, rad."""
        return float(np.linalg.norm(self.rotvec))

    @property
    def max_joint_error(self) -> float:
        """Largest joint error, m or rad; zero for a goal without shape."""
        return float(np.abs(self.shape).max(initial=0.0))


@dataclass(frozen=True)
class Tolerance:
    """Largest errors of a reached goal: ``position`` m, ``attitude`` rad, joints m or rad."""

    position: float
    attitude: float
    shape: float = 1e-3

    def admits(self, error: PoseError, controls: frozenset[Controlled] = POSE) -> bool:
        """Whether an error is within tolerance in all controlled parts of the goal."""
        return (
            ("position" not in controls or error.distance <= self.position)
            and ("attitude" not in controls or error.angle <= self.attitude)
            and ("shape" not in controls or error.max_joint_error <= self.shape)
        )
