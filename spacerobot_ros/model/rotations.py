"""Attitude representations in numpy: rotation matrices, unit quaternions (x, y, z, w), rotation
vectors.

A quaternion or matrix named ``R_WB`` maps vectors given in B to vectors given in W.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
"""Type of all vectors and matrices in the package."""


def hat(a: npt.ArrayLike) -> Array:
    """Return the skew-symmetric matrix (3, 3): ``hat(a) @ b == cross(a, b)``."""
    x, y, z = np.asarray(a, dtype=float)
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def cross(a: Array, b: Array) -> Array:
    """Return the cross products (..., 3) of vectors (..., 3); faster than ``numpy.cross``."""
    if a.ndim == b.ndim == 1:
        ax, ay, az = a.tolist()
        bx, by, bz = b.tolist()
        return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])
    ax, ay, az = a[..., 0], a[..., 1], a[..., 2]
    bx, by, bz = b[..., 0], b[..., 1], b[..., 2]
    x = ay * bz - az * by
    product = np.empty((*x.shape, 3))
    product[..., 0] = x
    product[..., 1] = az * bx - ax * bz
    product[..., 2] = ax * by - ay * bx
    return product


def _components(quaternion: Any) -> Any:
    """Return x, y, z and w of a quaternion (4,), or their arrays (...) for quaternions (..., 4),
    which may be on a device."""
    if getattr(quaternion, "ndim", 1) > 1:
        return [quaternion[..., k] for k in range(4)]
    # Python's float arithmetic is bit-identical and several times faster.
    return np.asarray(quaternion, dtype=float).tolist()


def matrix_about_axis(axis: npt.ArrayLike, angle: float) -> Array:
    """Return the rotation (3, 3) by an angle (rad) about a unit axis (Rodrigues)."""
    a = hat(axis)
    turned: Array = np.eye(3) + np.sin(angle) * a + (1 - np.cos(angle)) * (a @ a)
    return turned


def matrix_from_rpy(rpy: npt.ArrayLike) -> Array:
    """Return the rotation (3, 3) for URDF's fixed-axis roll, pitch and yaw (rad)."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(rpy), np.sin(rpy)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def rpy_from_matrix(R: npt.ArrayLike) -> Array:
    """Return roll, pitch and yaw (3,), rad, of a rotation (3, 3): the inverse of
    :func:`matrix_from_rpy`.

    If the pitch is 90 degrees, roll and yaw are not unique; one of the solutions is returned.
    """
    m = np.asarray(R, dtype=float)
    yaw = math.atan2(m[1, 0], m[0, 0])
    c, s = math.cos(yaw), math.sin(yaw)
    # Without the yaw, the roll of the rest is as exact near a right angle as elsewhere.
    roll = math.atan2(s * m[0, 2] - c * m[1, 2], c * m[1, 1] - s * m[0, 1])
    return np.array([roll, math.atan2(-m[2, 0], math.hypot(m[0, 0], m[1, 0])), yaw])


def matrix_from_quaternion(quaternion: npt.ArrayLike) -> Array:
    """Return the rotation matrix (3, 3) of a unit quaternion (x, y, z, w)."""
    return np.array(rows_from_quaternion(*_components(quaternion)))


def matrices_from_quaternions(quaternions: Array) -> Array:
    """Return the rotation matrices (..., 3, 3) of unit quaternions (..., 4)."""
    rows = rows_from_quaternion(*(quaternions[..., k] for k in range(4)))
    entries = np.stack([entry for row in rows for entry in row])
    return np.moveaxis(entries.reshape(3, 3, *quaternions.shape[:-1]), (0, 1), (-2, -1))


def rows_from_quaternion(x: Any, y: Any, z: Any, w: Any) -> list[list[Any]]:
    """Return the rows of a rotation matrix from numbers, arrays or symbols x, y, z and w."""
    return [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]


def quaternion_multiply(a: npt.ArrayLike, b: npt.ArrayLike) -> Array:
    """Return the product of two quaternions a and b (x, y, z, w): the rotation b followed by the
    rotation a.

    If either is an array (N, 4), so is the product.
    """
    ax, ay, az, aw = _components(a)
    bx, by, bz, bw = _components(b)
    product = [
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    ]
    return np.array(product) if isinstance(product[0], float) else np.stack(product).T


def quaternion_inverse(quaternion: npt.ArrayLike) -> Array:
    """Return the inverse of unit quaternions (..., 4)."""
    values: Any = quaternion if hasattr(quaternion, "ndim") else np.asarray(quaternion, dtype=float)
    return values * np.asarray((-1.0, -1.0, -1.0, 1.0), values.dtype, like=values)


def quaternion_from_rotvec(rotvec: npt.ArrayLike) -> Array:
    """Return the unit quaternion (x, y, z, w) of ``exp(hat(rotvec))``; rotvec (3,) in rad."""
    vector = np.asarray(rotvec, dtype=float)
    angle = float(np.linalg.norm(vector))
    # np.sinc is sin(pi x)/(pi x), finite at zero.
    if not math.isfinite(angle):
        return np.full(4, math.nan)
    return np.append(0.5 * np.sinc(angle / (2 * math.pi)) * vector, math.cos(angle / 2))


def quaternions_from_rotvecs(rotvecs: Array) -> Array:
    """Return the unit quaternions (N, 4) of rotation vectors (N, 3) in rad."""
    angle = np.linalg.norm(rotvecs, axis=1, keepdims=True)
    return np.hstack([0.5 * np.sinc(angle / (2 * math.pi)) * rotvecs, np.cos(angle / 2)])


def rotvec_from_quaternion(quaternion: npt.ArrayLike) -> Array:
    """Return the rotation vector (3,) in rad, at most pi long, of a unit quaternion."""
    q = np.asarray(quaternion, dtype=float)
    if q[3] < 0:
        q = -q
    sine = math.sqrt(q[:3].dot(q[:3]))
    angle = 2 * math.atan2(sine, float(q[3]))
    return q[:3] * (angle / sine if sine > 1e-12 else 2.0)


def rotvecs_from_quaternions(quaternions: Array) -> Array:
    """Return the rotation vectors (N, 3) of unit quaternions (N, 4), each at most pi long."""
    q = np.where(quaternions[:, 3:] < 0, -quaternions, quaternions)
    sine = np.linalg.norm(q[:, :3], axis=1)
    angle = 2 * np.arctan2(sine, q[:, 3])
    small = sine < 1e-12
    scale: Array = np.where(small, 2.0, angle / np.where(small, 1.0, sine))
    return q[:, :3] * scale[:, np.newaxis]


def attitude_error(quaternion: npt.ArrayLike, target: npt.ArrayLike) -> Array:
    """Return the rotation vector (3,) from one attitude to another, in the body frame, rad."""
    return rotvec_from_quaternion(quaternion_multiply(quaternion_inverse(quaternion), target))


def attitude_errors(quaternions: Array, targets: Array) -> Array:
    """Return :func:`attitude_error` (N, 3) for attitudes (N, 4); either may be a single one."""
    return rotvecs_from_quaternions(quaternion_multiply(quaternion_inverse(quaternions), targets))


def compose_poses(outer: Array, inner: Array) -> Array:
    """Return the composition (7,) of two poses; ``inner`` is relative to ``outer``."""
    position = outer[:3] + matrix_from_quaternion(outer[3:]) @ inner[:3]
    return np.concatenate([position, quaternion_multiply(outer[3:], inner[3:])])


def relative_pose(outer: Array, pose: Array) -> Array:
    """Return a pose (7,) relative to the pose ``outer``, both given in the same frame."""
    back = quaternion_inverse(outer[3:])
    position = matrix_from_quaternion(back) @ (pose[:3] - outer[:3])
    return np.concatenate([position, quaternion_multiply(back, pose[3:])])


def swing_angle(quaternion: npt.ArrayLike, axes: Array) -> float:
    """Return the angle, rad, between a rotation and the nearest rotation about axes (k, 3).

    The rotation is a unit quaternion (x, y, z, w); the axes are orthonormal. With one axis, this is
    the swing angle that remains after the twist about it; without axes, it is the angle of the
    whole rotation.
    """
    q = np.asarray(quaternion, dtype=float)
    about = axes @ q[:3]
    across = float(np.linalg.norm(q[:3] - axes.T @ about))
    return 2 * math.atan2(across, math.hypot(float(np.linalg.norm(about)), float(q[3])))


def unit_quaternion(quaternion: npt.ArrayLike) -> Array:
    """Return the quaternion (x, y, z, w) scaled to length one.

    Raises
    ------
    ValueError
        The quaternion is zero or not finite.
    """
    q = np.asarray(quaternion, dtype=float)
    largest = float(np.abs(q).max())
    if math.isfinite(largest) and largest > 1.0:
        q = q / largest  # Scaling avoids overflow of squares.
    norm = float(np.linalg.norm(q))
    if not math.isfinite(norm) or norm < 1e-6:
        raise ValueError(f"the quaternion {q.tolist()} is not a rotation")
    return q / norm


def quaternion_from_matrix(R: Array) -> Array:
    """Return the unit quaternion (x, y, z, w) of a rotation matrix (3, 3)."""
    # In Python floats, which are faster than array entries.
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = R.tolist()
    trace = xx + yy + zz
    squares = (1 + 2 * xx - trace, 1 + 2 * yy - trace, 1 + 2 * zz - trace, 1 + trace)
    # The divisor is the largest of four squares, which keeps precision near rotations by pi.
    largest = max(squares)
    s = 0.5 / math.sqrt(largest)
    match squares.index(largest):
        case 3:
            q = (zy - yz) * s, (xz - zx) * s, (yx - xy) * s, largest * s
        case 0:
            q = largest * s, (yx + xy) * s, (zx + xz) * s, (zy - yz) * s
        case 1:
            q = (xy + yx) * s, largest * s, (zy + yz) * s, (xz - zx) * s
        case _:
            q = (xz + zx) * s, (yz + zy) * s, largest * s, (yx - xy) * s
    return np.array(q)
