"""A shape in which the end-effector is where it is to be, the base being where that is to be.

A controller flies to any pose, and says only in flight that the arm is too short for it.
"""

from __future__ import annotations

import math

import numpy as np

from spacerobot_ros.model.description import Array, Joint, JointKind, RobotDescription
from spacerobot_ros.model.rotations import (
    matrix_about_axis,
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


class Chain:
    """The joints from the base of a robot to a link.

    Parameters
    ----------
    robot, link
        The robot, and the link at the end of the chain.
    """

    def __init__(self, robot: RobotDescription, link: str) -> None:
        above = {joint.child: joint for joint in robot.joints}
        G, b = robot.coupling
        rows = {joint.name: row for row, joint in enumerate(robot.moving_joints)}
        self._parts: list[tuple[Joint, Array, float]] = []
        none = np.zeros(len(robot.joint_names))
        while link in above:
            joint = above[link]
            row = rows.get(joint.name)
            part = (joint, none, 0.0) if row is None else (joint, G[row], float(b[row]))
            self._parts.insert(0, part)
            link = joint.parent

    def end(self, q: Array) -> tuple[Array, Array]:
        """Return attitude (3, 3) and position (3,) of its end in the base, at a shape (n,)."""
        R, r = np.eye(3), np.zeros(3)
        for joint, factors, offset in self._parts:
            r = r + R @ joint.origin.r
            R = R @ joint.origin.R
            if joint.kind is JointKind.PRISMATIC:
                r = r + R @ ((factors @ q + offset) * joint.axis)
            elif joint.kind is not JointKind.FIXED:
                R = R @ matrix_about_axis(joint.axis, float(factors @ q + offset))
        return R, r


def arm_shape(
    robot: RobotDescription, link: str, base: Goal, tool: Goal, q: Array
) -> tuple[Array, float, float]:
    """Return the shape (n,) that brings a link nearest to its pose, and how far off it is, m, rad.

    It is searched for from the shape ``q`` and from others, within the limits of the joints: for
    equal arguments the same.
    """
    # Imported where it is used: scipy.optimize loads slowly.
    from scipy.optimize import least_squares

    chain = Chain(robot, link)
    R_WB = matrix_from_quaternion(base.quaternion)
    wanted_r = R_WB.T @ (tool.position - base.position)
    wanted_R = R_WB.T @ matrix_from_quaternion(tool.quaternion)

    def error(shape: Array) -> Array:
        R, r = chain.end(shape)
        turn = rotvec_from_quaternion(quaternion_from_matrix(R.T @ wanted_R))
        return np.concatenate([wanted_r - r, _RADIAN * turn])

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
