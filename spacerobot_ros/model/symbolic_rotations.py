"""Attitude representations in CasADi: the symbolic counterpart of
:mod:`spacerobot_ros.model.rotations`.

Quaternions are unit quaternions (x, y, z, w); one named ``R_WB`` or ``quaternion_WB`` maps vectors
given in B to vectors given in W. Arguments may be SX or MX.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from spacerobot_ros.model.rotations import rows_from_quaternion


def matrix_from_quaternion(quaternion: ca.SX) -> ca.SX:
    """Return the rotation matrix (3, 3) of a unit quaternion."""
    return ca.blockcat(rows_from_quaternion(*ca.vertsplit(quaternion)))


def quaternion_from_matrix(R: ca.SX) -> ca.SX:
    """Return the unit quaternion (4,) of a rotation matrix (3, 3), in the same way as the numeric
    counterpart."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = (ca.horzsplit(row) for row in ca.vertsplit(R))
    trace = xx + yy + zz
    squares = [1 + 2 * xx - trace, 1 + 2 * yy - trace, 1 + 2 * zz - trace, 1 + trace]
    # The divisor is the largest of four squares, which keeps precision near rotations by pi.
    largest = ca.mmax(ca.vertcat(*squares))
    whole, s = ca.sqrt(largest) / 2, 0.5 / ca.sqrt(largest)
    about_x = ca.vertcat(whole, (yx + xy) * s, (zx + xz) * s, (zy - yz) * s)
    about_y = ca.vertcat((xy + yx) * s, whole, (zy + yz) * s, (xz - zx) * s)
    about_z = ca.vertcat((xz + zx) * s, (yz + zy) * s, whole, (yx - xy) * s)
    found = ca.vertcat((zy - yz) * s, (xz - zx) * s, (yx - xy) * s, whole)
    for square, candidate in zip(squares[2::-1], (about_z, about_y, about_x), strict=True):
        found = ca.if_else(square == largest, candidate, found)
    return found


def matrix_about_axis(axis: np.ndarray, angle: ca.SX) -> ca.SX:
    """Return the rotation (3, 3) by an angle (rad) about a constant unit axis (Rodrigues)."""
    a = ca.sparsify(ca.DM(axis))
    cosine, sine = ca.cos(angle), ca.sin(angle)
    return cosine * ca.DM.eye(3) + sine * ca.sparsify(ca.skew(a)) + (1 - cosine) * (a @ a.T)


def quaternion_multiply(a: ca.SX, b: ca.SX) -> ca.SX:
    """Return the product (4,) of two quaternions a and b: the rotation b followed by the rotation
    a."""
    vector = a[3] * b[:3] + b[3] * a[:3] + ca.cross(a[:3], b[:3])
    return ca.vertcat(vector, a[3] * b[3] - ca.dot(a[:3], b[:3]))


def relative_vector(a: ca.SX, b: ca.SX) -> ca.SX:
    """Return the vector part (3,) of the quaternion from a to b: zero if b equals a or -a."""
    return a[3] * b[:3] - b[3] * a[:3] - ca.cross(a[:3], b[:3])


_HALF_TURN_ROUNDING = 1e-9
"""Small number that keeps the half-angle derivatives finite at a rotation by pi."""


def half_angle_vector(R: ca.SX) -> ca.SX:
    """Return the axis of a rotation (3, 3), multiplied by twice the sine of half the rotation
    angle, (3,)."""
    vector = ca.inv_skew((R - R.T) / 2) * 2
    return vector / ca.sqrt(ca.fmax(1 + ca.trace(R), 0) + _HALF_TURN_ROUNDING)


def quaternion_rate(quaternion: ca.SX, omega_WB_B: ca.SX) -> ca.SX:
    """Return the derivative (4,) of the quaternion ``R_WB`` for body rate ``omega_WB_B``."""
    vector, scalar = quaternion[:3], quaternion[3]
    return 0.5 * ca.vertcat(
        scalar * omega_WB_B + ca.cross(vector, omega_WB_B), -ca.dot(vector, omega_WB_B)
    )


def quaternion_from_rotvec(rotvec: ca.SX) -> ca.SX:
    """Return the quaternion (4,) of ``exp(hat(rotvec))``; rotvec (3,) in rad."""
    # The small number gives the limit 1/2 at zero rotation, and is below rounding elsewhere.
    angle = ca.sqrt(ca.dot(rotvec, rotvec) + 1e-30)
    return ca.vertcat(rotvec * (ca.sin(angle / 2) / angle), ca.cos(angle / 2))


def quaternion_from_small_rotvec(rotvec: ca.SX) -> ca.SX:
    """Return the quaternion (4,) of a rotation vector (3,) much shorter than a radian.

    The result is a power series with sixth-order error, smooth at zero and without a square root.
    """
    square = ca.sumsqr(rotvec)
    return ca.vertcat(
        rotvec * (1 / 2 - square / 48 + square**2 / 3840),
        1 - square / 8 + square**2 / 384 - square**3 / 46080,
    )


def rotation_error(quaternion: ca.SX, target: ca.SX) -> ca.SX:
    """Return the rotation vector (3,) from one attitude to another, in the world frame, rad.

    The result is the shortest such rotation vector: its length is at most pi for either sign of the
    quaternions. For a rotation by pi, either of the two shortest vectors is returned.
    """
    inverse = ca.vertcat(-quaternion[:3], quaternion[3])
    error = quaternion_multiply(target, inverse)
    error = error * ca.if_else(error[3] < 0, -1, 1)
    # The small number gives the limit 2 at zero rotation, and is below rounding elsewhere.
    sine = ca.sqrt(ca.dot(error[:3], error[:3]) + 1e-30)
    return error[:3] * (2 * ca.atan2(sine, error[3]) / sine)
