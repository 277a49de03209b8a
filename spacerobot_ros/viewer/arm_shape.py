"""A shape in which the end-effector is where it is to be, the base being where that is to be.

A controller flies to any pose, and says only in flight that the arm is too short for it.
"""

from __future__ import annotations

import math

import numpy as np

from spacerobot_ros.model.description import Array, RobotDescription
from spacerobot_ros.model.kinematics import ForwardKinematics
from spacerobot_ros.model.rotations import (
    matrix_from_quaternion,
    quaternion_from_matrix,
    rotvec_from_quaternion,
)
from spacerobot_ros.planning import Goal

_STARTS = 8
"""Shapes that the search begins in: the present one, and others."""

_EVALUATIONS = 30
"""How often each search looks at the error at most."""

_NEAR = 1e-4
"""Errors within which a shape counts as one that reaches, m and rad."""

_RADIAN = 0.5
"""The distance that an error of one radian counts as much as, m."""


def arm_shape(
    robot: RobotDescription, link: str, base: Goal, tool: Goal, q: Array
) -> tuple[Array, float, float]:
    """Return the shape (n,) that brings a link nearest to its pose, and how far off it is, m, rad.

    It is searched for from the shape ``q`` and from others, within the limits of the joints: for
    equal arguments the same.
    """
    # Imported where it is used: scipy.optimize loads slowly.
    from scipy.optimize import least_squares

    kinematics = ForwardKinematics(robot)
    end = kinematics.links.index(link)
    R_WB = matrix_from_quaternion(base.quaternion)
    wanted_r = R_WB.T @ (tool.position - base.position)
    wanted_R = R_WB.T @ matrix_from_quaternion(tool.quaternion)

    def error(shape: Array) -> Array:
        R, r = kinematics.link_poses(shape)
        turn = rotvec_from_quaternion(quaternion_from_matrix(R[end].T @ wanted_R))
        return np.concatenate([wanted_r - r[end], _RADIAN * turn])

    lower = np.where(np.isfinite(robot.limits("lower")), robot.limits("lower"), -math.pi)
    upper = np.where(np.isfinite(robot.limits("upper")), robot.limits("upper"), math.pi)
    # The search wants room between its bounds.
    lower, upper = np.minimum(lower, q) - 1e-9, np.maximum(upper, q) + 1e-9
    random = np.random.default_rng(0)
    best, least = q, error(q)
    for number in range(_STARTS):
        start = q if number == 0 else random.uniform(lower, upper)
        found = least_squares(error, start, bounds=(lower, upper), max_nfev=_EVALUATIONS)
        if np.linalg.norm(found.fun) < np.linalg.norm(least):
            best, least = found.x, found.fun
        if np.linalg.norm(least) < _NEAR:
            break
    return best, float(np.linalg.norm(least[:3])), float(np.linalg.norm(least[3:]) / _RADIAN)


def is_near(distance: float, angle: float) -> bool:
    """Whether a shape that is so far off counts as one that reaches, m and rad."""
    return distance <= 2 * _NEAR and angle <= 4 * _NEAR
