"""What bodies weigh, in expressions: the numbers of a description, or symbols.

Numbers are folded into the expressions: the fewest operations, and one compilation for each set of
numbers. Symbols are entries of one argument ``p``: one compilation for all.
"""

from __future__ import annotations

from typing import Protocol

import casadi as ca
import numpy as np
import numpy.typing as npt

from spacerobot_ros.model.description import Array, RobotDescription
from spacerobot_ros.model.inertial_parameters import PER_BODY, InertialParameters


class BodyWeights(Protocol):
    """Masses (kg), centres of mass (3,) in the bodies' frames (m), and moments about them."""

    masses: tuple[float | ca.SX, ...]
    centers: tuple[ca.DM | ca.SX, ...]
    total: float | ca.SX

    @property
    def inputs(self) -> dict[str, ca.SX]:
        """The symbol ``p`` by its name; empty for numbers."""

    def inertia(self, k: int, R: ca.SX) -> ca.SX:
        """Return the inertia (3, 3) of body k about its centre, turned by R, kg m^2."""

    def second_moment(self, k: int, R: ca.SX) -> ca.SX:
        """Return the second moment of mass (3, 3) likewise: ``tr(I)/2 1 - I``, kg m^2."""


class DescribedWeights:
    """The numbers of a description."""

    def __init__(self, robot: RobotDescription) -> None:
        self._inertias = [body.inertia for body in robot.bodies]
        self.masses: tuple[float | ca.SX, ...] = tuple(each.mass for each in self._inertias)
        self.centers: tuple[ca.DM | ca.SX, ...] = tuple(
            _constant(each.com) for each in self._inertias
        )
        self.total: float | ca.SX = robot.total_mass

    @property
    def inputs(self) -> dict[str, ca.SX]:
        """None: numbers are no argument."""
        return {}

    def inertia(self, k: int, R: ca.SX) -> ca.SX:
        """Return the inertia (3, 3) of body k about its centre, turned by R, kg m^2."""
        return R @ _constant(self._inertias[k].about_com) @ R.T

    def second_moment(self, k: int, R: ca.SX) -> ca.SX:
        """Return the second moment of mass (3, 3) of body k, turned by R, kg m^2.

        Along principal axes ``u``: ``J = lambda 1 + sum (lambda_u - lambda) u u'``. The middle
        moment serves as ``lambda``: a body with an axis of symmetry is left with that axis alone.
        """
        about = self._inertias[k].about_com
        moments, axes = np.linalg.eigh(np.trace(about) / 2 * np.eye(3) - about)
        J = moments[1] * ca.SX.eye(3)
        for moment, axis in ((moments[0], axes[:, 0]), (moments[2], axes[:, 2])):
            u = R @ _constant(axis)
            J = J + symmetric(((moment - moments[1]) * u) @ u.T)
        return J


class SymbolicWeights:
    """Entries of a symbol ``p``, which has those of :attr:`.InertialParameters.vector` that may
    differ from zero.

    Parameters
    ----------
    free
        (10 B,) which entries these are.
    """

    def __init__(self, free: npt.NDArray[np.bool_]) -> None:
        self.free = free
        self._p = ca.SX.sym("p", int(np.count_nonzero(free)))
        rows = ca.SX(len(free), 1)
        for at, index in enumerate(np.flatnonzero(free).tolist()):
            rows[index] = self._p[at]
        bodies = ca.vertsplit(rows, PER_BODY)
        self.masses: tuple[float | ca.SX, ...] = tuple(body[0] for body in bodies)
        self.centers: tuple[ca.DM | ca.SX, ...] = tuple(body[1:4] for body in bodies)
        self._moments = [body[4:] for body in bodies]
        self.total: float | ca.SX = sum(self.masses[1:], self.masses[0])

    @property
    def inputs(self) -> dict[str, ca.SX]:
        """The symbol ``p`` by its name."""
        return {"p": self._p}

    def inertia(self, k: int, R: ca.SX) -> ca.SX:
        """Return the inertia (3, 3) of body k about its centre, turned by R, kg m^2."""
        return rotational(self.second_moment(k, R))

    def second_moment(self, k: int, R: ca.SX) -> ca.SX:
        """Return the second moment of mass (3, 3) of body k, turned by R, kg m^2.

        As of numbers, with the columns of R in the place of principal axes, and products beside.
        """
        xx, yy, zz, xy, xz, yz = ca.vertsplit(self._moments[k])
        x, y, z = ca.horzsplit(R)
        J = yy * ca.SX.eye(3) + symmetric(((xx - yy) * x) @ x.T + ((zz - yy) * z) @ z.T)
        if xy.nnz() or xz.nnz():
            beside = xy * y + xz * z
            J = J + symmetric(x @ beside.T + beside @ x.T)
        if yz.nnz():
            J = J + symmetric(yz * (y @ z.T + z @ y.T))
        return ca.sparsify(J)


def free_entries(nominal: InertialParameters) -> npt.NDArray[np.bool_]:
    """Return which entries (10 B,) of the vector of robots like this one differ from zero.

    Every mass does. What is zero of a centre and of products of inertia stays zero; principal
    moments are all zero (a point mass) or all free.
    """
    rows = nominal.vector.reshape(-1, PER_BODY) != 0.0
    rows[:, 0] = True
    rows[:, 4:7] = rows[:, 4:7].any(axis=1, keepdims=True)
    return np.asarray(rows.reshape(-1))


def rotational(J: ca.SX) -> ca.SX:
    """Return the rotational inertia ``tr(J) 1 - J`` of a second moment of mass."""
    inertia = -J
    for i in range(3):
        inertia[i, i] = J[i - 2, i - 2] + J[i - 1, i - 1]
    return inertia


def symmetric(matrix: ca.SX) -> ca.SX:
    """Return a symmetric matrix with one expression, not two equal ones, for each pair."""
    return ca.tril2symm(ca.tril(matrix))


def _constant(array: Array) -> ca.DM:
    return ca.sparsify(ca.DM(array))
