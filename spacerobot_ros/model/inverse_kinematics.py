"""Inverse kinematics of an arm on a fixed base, from the current configuration or by a search.

A controller that keeps the base in place follows a path with the arm alone. The web page checks
whether the arm can reach a goal. The controller and the page use the same errors and the same
Jacobian.
"""

from __future__ import annotations

import math

import numpy as np

from spacerobot_ros.model.description import Array, Pose
from spacerobot_ros.model.rotations import quaternion_from_matrix, rotvec_from_quaternion
from spacerobot_ros.model.space_robot import SpaceRobot

AXES: tuple[str, ...] = ("x", "y", "z", "rx", "ry", "rz")
"""W components of a position and a rotation."""

REACHED_DISTANCE = 1e-3
"""End-effector error (m, rad) below which an arm is considered to follow its path."""

_MAX_ITERATIONS = 30
_DAMPING = 0.02
_LARGEST_STEP = 0.2
"""Number of iterations from the current configuration, damping, and largest joint step, m or
rad."""

_SEARCH_STARTS = 8
"""Number of start configurations of a search: the current configuration and random
configurations."""

_MAX_EVALUATIONS = 30

_SEARCH_TOLERANCE = 1e-4  # m and rad

_RADIAN_LENGTH = 0.5
"""Weight of one radian of error in a search, m."""


class FixedBaseArm:
    """An arm on a fixed base.

    Parameters
    ----------
    robot
        The model.
    link
        Link of the end-effector.
    base
        Base pose in W.
    axes
        Controlled end-effector axes; default: all.
    """

    def __init__(
        self, robot: SpaceRobot, link: str, base: Pose, axes: tuple[str, ...] = AXES
    ) -> None:
        self.robot, self._link = robot, link
        self.base, self.axes = base, axes
        self._rows = [AXES.index(axis) for axis in axes]

    def error(self, q: Array, goal: Pose) -> tuple[Array, Array]:
        """Return the end-effector error (m,) along the controlled axes, m and rad, in W.

        Also return the negative derivative of the error with respect to the joint positions (m, n).
        """
        robot, R_WB = self.robot, self.base.R
        R_BE, r_BE = robot.link_pose(self._link, q)
        R_WE = R_WB @ R_BE
        turn = rotvec_from_quaternion(quaternion_from_matrix(R_WE.T @ goal.R))
        error = np.concatenate([goal.r - self.base.r - R_WB @ r_BE, R_WE @ turn])
        J = robot.jacobian(self._link, q)
        # With the base at rest the centre of mass moves against the base's part of its Jacobian.
        fixed = J[:, 6:] - J[:, :3] @ robot.jacobian(robot.base_link, q)[:3, 6:]
        J_W = np.vstack([R_WB @ fixed[:3], R_WB @ fixed[3:]])
        return error[self._rows], J_W[self._rows]

    def nearest_shape(self, q: Array, goal: Pose) -> tuple[Array, float]:
        """Return the configuration (n,) that brings the end-effector closest to a pose, by a search
        from ``q``.

        Also return the largest remaining error, m or rad. The search uses damped least squares
        with steps short enough to stay on one solution branch.
        """
        lower, upper = self.robot.lower, self.robot.upper
        distance = np.inf
        for _ in range(_MAX_ITERATIONS):
            error, J = self.error(q, goal)
            distance = float(np.abs(error).max())
            if distance < 0.1 * REACHED_DISTANCE:
                break
            step = J.T @ np.linalg.solve(J @ J.T + _DAMPING**2 * np.eye(len(error)), error)
            step *= min(1.0, _LARGEST_STEP / max(float(np.abs(step).max()), 1e-12))
            q = np.clip(q + step, lower, upper)
        return q, distance

    def search_shape(self, q: Array, goal: Pose) -> tuple[Array, float, float]:
        """Return the configuration (n,) within joint limits that brings the end-effector closest to
        a pose.

        Also return the remaining distance and angle along the controlled axes, m and rad.
        The search starts at ``q`` and at random configurations; identical arguments yield identical
        results.
        """
        # Imported here because scipy.optimize loads slowly.
        from scipy.optimize import least_squares

        weights = np.repeat([1.0, _RADIAN_LENGTH], 3)[self._rows]
        turns = np.array(self._rows) >= 3

        def error(shape: Array) -> Array:
            return weights * self.error(shape, goal)[0]

        def jacobian(shape: Array) -> Array:
            # The rotation vector is an eigenvector of its own derivative: the gradient is exact.
            return -weights[:, np.newaxis] * self.error(shape, goal)[1]

        lower = np.where(np.isfinite(self.robot.lower), self.robot.lower, -math.pi)
        upper = np.where(np.isfinite(self.robot.upper), self.robot.upper, math.pi)
        # The solver requires a lower bound below the upper one.
        lower, upper = np.minimum(lower, q) - 1e-9, np.maximum(upper, q) + 1e-9
        random = np.random.default_rng(0)
        best, least = q, error(q)
        for number in range(_SEARCH_STARTS):
            start = q if number == 0 else random.uniform(lower, upper)
            found = least_squares(
                error, start, jacobian, bounds=(lower, upper), max_nfev=_MAX_EVALUATIONS
            )
            if np.linalg.norm(found.fun) < np.linalg.norm(least):
                best, least = found.x, found.fun
            if np.linalg.norm(least) < _SEARCH_TOLERANCE:
                break
        angle = float(np.linalg.norm(least[turns])) / _RADIAN_LENGTH
        return best, float(np.linalg.norm(least[~turns])), angle


def is_reached(distance: float, angle: float) -> bool:
    """Whether an arm reaches its goal, given the errors that remain after a search, m and rad."""
    return distance <= 2 * _SEARCH_TOLERANCE and angle <= 4 * _SEARCH_TOLERANCE
