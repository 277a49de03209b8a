"""Motion of a free body relative to a circular orbit, in closed form."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


def relative_motion(n: float, r0_O: Array, v0_O: Array, t: npt.ArrayLike) -> tuple[Array, Array]:
    """Return the position and velocity (..., 3) in the orbital frame O at times (...), s.

    ``n`` is the mean motion, rad/s. This is the solution of the equations of Clohessy and Wiltshire
    (1960), ``xdd = 3 n^2 x + 2 n yd``, ``ydd = -2 n xd``, ``zdd = -n^2 z``.
    """
    angle = n * np.asarray(t, dtype=float)
    s, c = np.sin(angle), np.cos(angle)
    (x, y, z), (x_dot, y_dot, z_dot) = r0_O, v0_O
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
