"""Attitude as symbols: quaternions (x, y, z, w) of links, and the error between two of them."""

from __future__ import annotations

import casadi as ca

from spacerobot_ros.model.description import Array, JointKind, RobotDescription
from spacerobot_ros.model.rotations import quaternion_from_matrix


def multiply(a: ca.SX, b: ca.SX) -> ca.SX:
    """Return the product (4,) of two quaternions: the rotation b followed by a."""
    vector = a[3] * b[:3] + b[3] * a[:3] + ca.cross(a[:3], b[:3])
    return ca.vertcat(vector, a[3] * b[3] - ca.dot(a[:3], b[:3]))


def link_quaternion(description: RobotDescription, link: str, q: ca.SX) -> ca.SX:
    """Return the quaternion (4,) of ``R_BL``, smooth in q: no matrix is turned into it."""
    index, pose = description.frames[link]
    quaternion = _constant(pose.R)
    while index > 0:
        body = description.bodies[index]
        assert body.joint is not None
        if body.joint.kind is not JointKind.PRISMATIC:
            half = q[index - 1] / 2
            turn = ca.vertcat(ca.sin(half) * ca.DM(body.joint.axis), ca.cos(half))
            quaternion = multiply(turn, quaternion)
        quaternion = multiply(_constant(body.origin.R), quaternion)
        index = body.parent
    return quaternion


def quaternion_from_rotvec(rotvec: ca.SX) -> ca.SX:
    """Return the quaternion (4,) of ``exp(hat(rotvec))``; rotvec (3,) in rad."""
    # The small number gives the limit, 1/2, at no rotation, and is below rounding elsewhere.
    angle = ca.sqrt(ca.dot(rotvec, rotvec) + 1e-30)
    return ca.vertcat(rotvec * (ca.sin(angle / 2) / angle), ca.cos(angle / 2))


def rotation_error(quaternion: ca.SX, target: ca.SX) -> ca.SX:
    """Return the rotation vector (3,), rad, world components, from an attitude to its target.

    It is the shortest: its length is at most pi, whichever of the two signs the quaternions have.
    At half a turn, where both ways are as short, it takes one of them.
    """
    inverse = ca.vertcat(-quaternion[:3], quaternion[3])
    error = multiply(target, inverse)
    error = error * ca.if_else(error[3] < 0, -1, 1)
    # The small number gives the limit, 2, at no rotation, and is below rounding elsewhere.
    sine = ca.sqrt(ca.dot(error[:3], error[:3]) + 1e-30)
    return error[:3] * (2 * ca.atan2(sine, error[3]) / sine)


def _constant(R: Array) -> ca.DM:
    return ca.sparsify(ca.DM(quaternion_from_matrix(R)))
