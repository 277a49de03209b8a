"""What a planner is asked for, and from where."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from spacerobot_ros.errors import PlanningError
from spacerobot_ros.model.attitude import attitude_error, unit_quaternion
from spacerobot_ros.model.description import Array


@dataclass(frozen=True)
class Goal:
    """A pose of the base link in the world: ``position`` (3,) in m, ``quaternion`` (x, y, z, w)."""

    position: Array
    quaternion: Array

    @classmethod
    def checked(cls, position: npt.ArrayLike, quaternion: npt.ArrayLike) -> Goal:
        """Return a goal with a unit quaternion.

        Raises
        ------
        PlanningError
            A number is not finite, or the quaternion is zero.
        """
        r = np.asarray(position, dtype=float)
        q = np.asarray(quaternion, dtype=float)
        if r.shape != (3,) or q.shape != (4,):
            raise PlanningError("A goal has three numbers of position and four of orientation.")
        if not np.all(np.isfinite(r)):
            raise PlanningError(f"The goal position {r.tolist()} is not finite.")
        if not np.all(np.isfinite(q)):
            raise PlanningError(f"The goal orientation {q.tolist()} is not finite.")
        try:
            return cls(r, unit_quaternion(q))
        except ValueError:
            raise PlanningError(
                f"The goal orientation {q.tolist()} is a zero quaternion, not a rotation; "
                "no rotation is (0, 0, 0, 1)."
            ) from None


@dataclass(frozen=True)
class RobotState:
    """Where the robot is: base pose in W, shape, total momenta in W (about the centre of mass)."""

    position: Array
    quaternion: Array
    q: Array
    linear_momentum: Array = field(default_factory=lambda: np.zeros(3))
    angular_momentum: Array = field(default_factory=lambda: np.zeros(3))


@dataclass(frozen=True)
class PoseError:
    """What is left to a goal: ``position`` (3,) in W, m, and ``rotvec`` (3,) in B, rad."""

    position: Array
    rotvec: Array

    @classmethod
    def between(cls, position: Array, quaternion: Array, goal: Goal) -> PoseError:
        """Return what is left from a pose to the goal."""
        return cls(goal.position - position, attitude_error(quaternion, goal.quaternion))

    @property
    def distance(self) -> float:
        """Length of the position error, m."""
        return float(np.linalg.norm(self.position))

    @property
    def angle(self) -> float:
        """Angle of the attitude error, rad."""
        return float(np.linalg.norm(self.rotvec))


@dataclass(frozen=True)
class Tolerance:
    """How near is there: ``position`` in m, ``attitude`` in rad."""

    position: float
    attitude: float

    def admits(self, error: PoseError) -> bool:
        """Whether the goal is met."""
        return error.distance <= self.position and error.angle <= self.attitude
