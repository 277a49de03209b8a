"""How far a path of shapes turns the base of a planar robot: the geometric phase of paper 3.

The attitude is one angle theta about the axis of the robot. At zero angular momentum
``theta_dot = -s(psi)' psi_dot`` (eq. 3), where ``s_i = N_i / D`` is the component about the axis of
the mechanical connection, ``D`` the inertia of the locked robot about the axis and ``N_i`` its
coupling to joint i. The turn along a path of shapes is the line integral of ``-s`` (eq. 11): it
depends on the path and not on the speed.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import casadi as ca
import numpy as np

from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.planning.core.planar import planar_axis

_PANEL = 0.5
"""Longest piece of a leg that one Gauss rule integrates, rad."""

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(10)
_NODES, _WEIGHTS = (_NODES + 1) / 2, _WEIGHTS / 2

_ANGLES: Array = 2 * math.pi / 3 * np.arange(3.0)
"""Three angles determine a trigonometric polynomial of degree one."""

_SLOPE = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""``h @ _SLOPE`` is the derivative of ``h = [1, cos, sin]``."""

_CORNERS = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
"""Corners of the unit square, counter-clockwise."""


class PlanarPhase:
    """Turns of the base of a planar robot about its axis, rad, by paths of the shape.

    Parameters
    ----------
    robot
        The model.

    Raises
    ------
    PlanningError
        The robot is not planar; see :func:`planar_axis`.
    """

    def __init__(self, robot: SpaceRobot) -> None:
        self.axis = planar_axis(robot)
        """Unit vector (3,) that positive angles turn about, base components."""
        psi = ca.SX.sym("psi", robot.n)
        D, D_q = robot.function("locked_inertia", compile=False)(psi)
        axis = ca.DM(self.axis)
        # A = D^-1 D_q where nothing couples the axis to the others.
        N_D = ca.vertcat((axis.T @ D_q).T, axis.T @ D @ axis)
        self._N_D = ca.Function("N_D", [psi], [ca.densify(N_D)])

    def legs(self, starts: Array, ends: Array) -> Array:
        """Return the turns (L,) along straight legs of the shape, starts and ends (L, n)."""
        return _along(self._s, starts, ends)

    def plane(self, psi: Array, i: int, j: int) -> PhasePlane:
        """Return the phase in the plane of joints i and j, the others at rest in ``psi`` (n,)."""
        shapes = np.tile(psi, (9, 1))
        shapes[:, i], shapes[:, j] = np.repeat(_ANGLES, 3), np.tile(_ANGLES, 3)
        samples = self._N_D(shapes.T).full()[[i, j, -1]].reshape(3, 3, 3)
        fit: Array = np.linalg.inv(_harmonics(_ANGLES)).astype(float)
        return PhasePlane(fit @ samples @ fit.T)

    def _s(self, shapes: Array) -> Array:
        """Return ``s`` (..., n) at shapes (..., n)."""
        N_D = self._N_D(shapes.reshape(-1, shapes.shape[-1]).T).full()
        return np.asarray((N_D[:-1] / N_D[-1]).T).reshape(shapes.shape)


class PhasePlane:
    """Turns of the base by two joints, in formulas.

    Each joint turns one rigid part of the robot against the other, and ``N_i``, ``N_j`` and ``D``
    are sums of products of two vectors, each fixed in some body. They are trigonometric polynomials
    of degree one in either angle: ``f = h(psi_i)' C h(psi_j)`` with ``h(x) = [1, cos x, sin x]``.

    Parameters
    ----------
    coefficients
        (3, 3, 3) ``C`` of ``N_i``, ``N_j`` and ``D``, kg m^2.
    """

    def __init__(self, coefficients: Array) -> None:
        self._C = coefficients

    def curvature(self, points: Array) -> Array:
        """Return the turn of the base an area of small loops, 1/rad, (...), at points (..., 2).

        Loops are counter-clockwise in the plane (psi_i, psi_j): it is ``-H``, eq. (10), with
        ``H = ds_j/dpsi_i - ds_i/dpsi_j``.
        """
        left, right = _harmonics(points[..., 0]), _harmonics(points[..., 1])
        N_i, N_j, D = self._polynomials(left, right)
        _, N_j_i, D_i = self._polynomials(left @ _SLOPE, right)
        N_i_j, _, D_j = self._polynomials(left, right @ _SLOPE)
        return np.asarray((N_i_j * D - N_i * D_j - N_j_i * D + N_j * D_i) / D**2)

    def squares(self, centres: Array, sides: Array) -> Array:
        """Return the turns (R,) by squares gone round counter-clockwise, centres (R, 2)."""
        corners = square_corners(centres, sides)
        ends = np.roll(corners, -1, axis=1)
        legs = _along(self._s, corners.reshape(-1, 2), ends.reshape(-1, 2))
        return legs.reshape(-1, 4).sum(axis=1)

    def _s(self, points: Array) -> Array:
        """Return ``(s_i, s_j)`` (..., 2) at points (..., 2)."""
        N_i, N_j, D = self._polynomials(_harmonics(points[..., 0]), _harmonics(points[..., 1]))
        return np.stack([N_i / D, N_j / D], axis=-1)

    def _polynomials(self, left: Array, right: Array) -> tuple[Array, Array, Array]:
        """Return ``N_i``, ``N_j``, ``D`` (...) at harmonics (..., 3) of the two angles."""
        N_i, N_j, D = (np.sum(left @ C * right, axis=-1) for C in self._C)
        return N_i, N_j, D


def square_corners(centres: Array, sides: Array) -> Array:
    """Return the corners (R, 4, 2) of squares, counter-clockwise; centres (R, 2), sides (R,)."""
    return centres[:, np.newaxis] + np.multiply.outer(sides, _CORNERS)


def _harmonics(angles: Array) -> Array:
    """Return ``[1, cos, sin]`` (..., 3) of angles (...)."""
    return np.stack([np.ones_like(angles), np.cos(angles), np.sin(angles)], axis=-1)


def _along(s: Callable[[Array], Array], starts: Array, ends: Array) -> Array:
    """Return the integrals (L,) of ``-s' dpsi`` along straight legs from (L, n) to (L, n).

    Gauss-Legendre quadrature in pieces of at most half a radian.
    """
    moves = ends - starts
    count = max(1, math.ceil(np.abs(moves).max(initial=0.0) / _PANEL))
    along = ((np.arange(count)[:, np.newaxis] + _NODES) / count).ravel()
    weights = np.tile(_WEIGHTS, count) / count
    shapes = starts[:, np.newaxis] + along[:, np.newaxis] * moves[:, np.newaxis]
    return np.asarray(-np.einsum("p,lpn,ln->l", weights, s(shapes), moves))
