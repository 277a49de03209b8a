"""Motion relative to a point on a circular orbit, in an inverse-square field to first order.

The orbital frame O moves with the point: its x axis points outward along the radius, its y axis
along the orbit, its z axis along the orbit's normal. It turns at the mean motion n about z.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from spacerobot_ros.errors import ParameterError
from spacerobot_ros.model.description import Array

EARTH_GRAVITATION = 3.986004418e14
"""Gravitational parameter of the Earth, m^3/s^2."""

EARTH_RADIUS = 6378137.0
"""Equatorial radius of the Earth, m (WGS 84)."""


def mean_motion_at(altitude: float) -> float:
    """Return the mean motion of a circular orbit round the Earth, rad/s.

    ``altitude`` is the height above the equatorial radius, m.
    """
    return math.sqrt(EARTH_GRAVITATION / (EARTH_RADIUS + altitude) ** 3)


def relative_acceleration(n: float, r_O: npt.ArrayLike, v_O: npt.ArrayLike) -> Array:
    """Return the acceleration (..., 3) of a free body in the orbital frame, m/s^2.

    The equations of Clohessy and Wiltshire (1960): ``xdd = 3 n^2 x + 2 n yd``, ``ydd = -2 n xd``,
    ``zdd = -n^2 z``.

    Parameters
    ----------
    n
        Mean motion, rad/s.
    r_O, v_O
        (..., 3) position (m) and velocity (m/s), both relative to O and in its components.
    """
    x, _, z = np.moveaxis(np.asarray(r_O, dtype=float), -1, 0)
    x_dot, y_dot, _ = np.moveaxis(np.asarray(v_O, dtype=float), -1, 0)
    components = 3 * n**2 * x + 2 * n * y_dot, -2 * n * x_dot, -(n**2) * z
    return np.stack(components, axis=-1)


def relative_motion(
    n: float, r0_O: npt.ArrayLike, v0_O: npt.ArrayLike, t: npt.ArrayLike
) -> tuple[Array, Array]:
    """Return position and velocity of a free body in the orbital frame at some times.

    The closed solution of :func:`relative_acceleration`.

    Parameters
    ----------
    n
        Mean motion, rad/s; zero: uniform motion.
    r0_O, v0_O
        (3,) position (m) and velocity (m/s) at time zero, both relative to O and in its components.
    t
        (...) times, s.

    Returns
    -------
    r_O, v_O
        (..., 3), m and m/s.

    Raises
    ------
    ParameterError
        A number is not finite, or ``n`` is negative.
    """
    r0, v0, times = (np.asarray(each, dtype=float) for each in (r0_O, v0_O, t))
    if not (math.isfinite(n) and n >= 0.0):
        raise ParameterError(f"The mean motion is {n:g} rad/s; it must be finite and from 0.")
    if not all(np.all(np.isfinite(each)) for each in (r0, v0, times)):
        raise ParameterError("Position, velocity and times of a relative motion must be finite.")
    if n == 0.0:
        return r0 + times[..., np.newaxis] * v0, np.broadcast_to(v0, (*times.shape, 3)).copy()
    angle = n * times
    s, c = np.sin(angle), np.cos(angle)
    (x, y, z), (x_dot, y_dot, z_dot) = r0, v0
    r = (
        (4 - 3 * c) * x + s / n * x_dot + 2 / n * (1 - c) * y_dot,
        6 * (s - angle) * x + y - 2 / n * (1 - c) * x_dot + (4 * s - 3 * angle) / n * y_dot,
        c * z + s / n * z_dot,
    )
    v = (
        3 * n * s * x + c * x_dot + 2 * s * y_dot,
        6 * n * (c - 1) * x - 2 * s * x_dot + (4 * c - 3) * y_dot,
        -n * s * z + c * z_dot,
    )
    return np.stack(r, axis=-1), np.stack(v, axis=-1)
