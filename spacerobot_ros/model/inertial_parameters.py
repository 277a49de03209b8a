"""Masses, centres of mass and inertias of a robot's bodies.

:class:`InertialParameters` holds the values of these quantities for one robot, or for a batch of
robots that differ only in these values. In expressions, these quantities are either constants
(:class:`MassProperties`: fewest operations, one compilation per set of values) or entries of an
argument ``p`` (:class:`SymbolicMassProperties`: one compilation for all sets).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
import numpy.typing as npt

from spacerobot_ros.errors import RobotDescriptionError
from spacerobot_ros.model.description import Array, Inertia, RobotDescription

TRIANGLE_SLACK = 0.01
"""Largest relative violation of the triangle inequality due to rounding."""

_ROUNDING_ERROR = 1e-12

NUMBERS_PER_BODY = 10
"""Values per body in :attr:`InertialParameters.vector`."""

INERTIA_ENTRIES = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
"""Row and column of each of the six second moments in the (3, 3) matrix."""


def symmetric_of_entries(entries: Iterable[float]) -> Array:
    """Return the symmetric matrix (3, 3) with the six given :data:`INERTIA_ENTRIES`."""
    matrix = np.zeros((3, 3))
    for (i, j), value in zip(INERTIA_ENTRIES, entries, strict=True):
        matrix[i, j] = matrix[j, i] = float(value)
    return matrix


@dataclass(frozen=True)
class InertialParameters:
    """Mass properties of the ``bodies`` in a :class:`RobotDescription`, for one robot or a batch.

    The leading dimensions (...) index the batch: none for one robot, (N,) for N robots.

    Attributes
    ----------
    masses
        (..., B) kg.
    centers
        (..., B, 3) centres of mass in the body frames (the frames of their first links), m.
    inertias
        (..., B, 3, 3) inertias about the centres of mass, along the axes of the body frames, kg
        m^2.
    """

    masses: Array
    centers: Array
    inertias: Array

    @classmethod
    def of(cls, robot: RobotDescription) -> InertialParameters:
        """Return the inertial parameters from a robot description."""
        parts = [body.inertia for body in robot.bodies]
        return cls(
            np.array([part.mass for part in parts]),
            np.array([part.com for part in parts]),
            np.array([part.about_com for part in parts]),
        )

    @classmethod
    def stacked(cls, each: Sequence[InertialParameters]) -> InertialParameters:
        """Return the parameters of N robots as one batch, (N, ...)."""
        return cls(
            np.stack([one.masses for one in each]),
            np.stack([one.centers for one in each]),
            np.stack([one.inertias for one in each]),
        )

    def __getitem__(self, index: int | slice | Array | npt.NDArray[np.int64]) -> InertialParameters:
        """Return the parameters of some robots of a batch."""
        return InertialParameters(self.masses[index], self.centers[index], self.inertias[index])

    @property
    def total_mass(self) -> Array:
        """Total robot masses (...), kg."""
        return np.asarray(self.masses.sum(axis=-1))

    def scaled(
        self, masses: npt.ArrayLike = 1.0, inertias: npt.ArrayLike | None = None
    ) -> InertialParameters:
        """Return the parameters with masses and inertias multiplied by factors (..., B).

        Inertias are multiplied by the mass factors (as for a change of density) unless separate
        inertia factors are given. Factors of shape (N, B), or (N, 1) if common to all bodies, turn
        one robot into a batch.
        """
        by_mass = np.asarray(masses, dtype=float)
        by_inertia = by_mass if inertias is None else np.asarray(inertias, dtype=float)
        shape = np.broadcast_shapes(self.masses.shape, by_mass.shape, by_inertia.shape)
        return InertialParameters(
            np.broadcast_to(self.masses * by_mass, shape),
            np.broadcast_to(self.centers, (*shape, 3)),
            np.broadcast_to(self.inertias * by_inertia[..., None, None], (*shape, 3, 3)),
        )

    def shifted(self, offsets: npt.ArrayLike) -> InertialParameters:
        """Return the parameters with centres of mass shifted by offsets (..., B, 3), m.

        The inertias about the centres of mass do not change.
        """
        centers = self.centers + np.asarray(offsets, dtype=float)
        masses = np.broadcast_to(self.masses, centers.shape[:-1])
        return InertialParameters(
            masses, centers, np.broadcast_to(self.inertias, (*centers.shape, 3))
        )

    def with_payload(self, body: int, payload: Inertia) -> InertialParameters:
        """Return the parameters with a payload fixed to a body, given in the body frame."""
        own = Inertia(float(self.masses[body]), self.centers[body], self.inertias[body])
        both = own + payload
        masses, centers, inertias = (
            array.copy() for array in (self.masses, self.centers, self.inertias)
        )
        masses[body], centers[body], inertias[body] = both.mass, both.com, both.about_com
        return InertialParameters(masses, centers, inertias)

    @property
    def second_moments(self) -> Array:
        """Second moments of mass (..., B, 3, 3) about the centres: ``tr(I)/2 1 - I``, kg m^2."""
        half = np.trace(self.inertias, axis1=-2, axis2=-1)[..., None, None] / 2
        return np.asarray(half * np.eye(3) - self.inertias)

    @property
    def vector(self) -> Array:
        """All values (..., 10 B) as one vector, the argument ``p`` of compiled functions.

        For each body: mass, centre of mass (3), second moments xx, yy, zz, xy, xz, yz.
        """
        moments = self.second_moments
        six = np.stack([moments[..., i, j] for i, j in INERTIA_ENTRIES], axis=-1)
        rows = np.concatenate([self.masses[..., None], self.centers, six], axis=-1)
        return rows.reshape(*self.masses.shape[:-1], -1)

    def require_physical(self, names: Sequence[str]) -> None:
        """Check that masses and inertias are physical; ``names`` are the body names.

        Raises
        ------
        RobotDescriptionError
            A value is not finite, a mass is negative, all masses are zero, or principal moments
            are negative or violate the triangle inequality.
        """
        finite = np.isfinite(self.vector).reshape(-1, len(names), NUMBERS_PER_BODY).all(axis=(0, 2))
        if not finite.all():
            body = names[int(np.argmin(finite))]
            raise RobotDescriptionError(f"A mass, centre or inertia of '{body}' is not finite.")
        masses = self.masses.reshape(-1, len(names))
        row, body_index = np.unravel_index(int(masses.argmin()), masses.shape)
        if masses[row, body_index] < 0:
            raise RobotDescriptionError(
                f"The mass of '{names[int(body_index)]}' is {masses[row, body_index]:.6g} kg; it "
                "must be positive."
            )
        if not masses.sum(axis=1).all():
            raise RobotDescriptionError("The total robot mass is zero.")
        tensors = self.inertias.reshape(-1, len(names), 3, 3)
        low, middle, high = np.moveaxis(np.linalg.eigvalsh(tensors), -1, 0)
        slack = _ROUNDING_ERROR * np.maximum(1.0, high)
        impossible = (low < -slack) | (high > (1 + TRIANGLE_SLACK) * (low + middle) + slack)
        if impossible.any():
            row, body_index = np.argwhere(impossible)[0]
            moments = ", ".join(f"{each[row, body_index]:.4g}" for each in (low, middle, high))
            raise RobotDescriptionError(
                f"The inertia of '{names[int(body_index)]}' is not physical: its principal "
                f"moments are {moments} kg m^2."
            )

    def apply_to_description(self, robot: RobotDescription) -> RobotDescription:
        """Return a robot description with these parameters; its ``urdf`` is unchanged.

        The first link of each body receives the mass properties of the body; links fixed to this
        link receive none.
        """
        of_body = {
            body.name: Inertia(float(mass), center, inertia)
            for body, mass, center, inertia in zip(
                robot.bodies, self.masses, self.centers, self.inertias, strict=True
            )
        }
        links = tuple(
            replace(link, inertia=of_body.get(link.name, Inertia())) for link in robot.links
        )
        return robot.with_links(links)


class MassProperties:
    """Mass properties from a robot description, as constants in expressions.

    Attributes
    ----------
    masses, total
        Body masses and total robot mass, kg.
    centers
        Centres of mass (3,) in the body frames, m.
    inputs
        Mass property symbols by name, which are the last function arguments; empty for constants.
    """

    def __init__(self, robot: RobotDescription) -> None:
        self._inertias = [body.inertia for body in robot.bodies]
        self.masses: tuple[float | ca.SX, ...] = tuple(each.mass for each in self._inertias)
        self.centers: tuple[ca.DM | ca.SX, ...] = tuple(
            sparse_constant(each.com) for each in self._inertias
        )
        self.total: float | ca.SX = robot.total_mass
        self.inputs: dict[str, ca.SX] = {}

    def inertia(self, k: int, R: ca.SX) -> ca.SX:
        """Return the inertia (3, 3) of body k about its centre, rotated by R, kg m^2."""
        return R @ sparse_constant(self._inertias[k].about_com) @ R.T

    def second_moment(self, k: int, R: ca.SX) -> ca.SX:
        """Return the second moment of mass ``tr(I)/2 1 - I`` (3, 3) of body k rotated by R, kg m^2.

        Along principal axes ``u``: ``J = lambda 1 + sum (lambda_u - lambda) u u'``. If ``lambda``
        is the intermediate principal moment, a body with a symmetry axis needs only this axis.
        """
        about = self._inertias[k].about_com
        moments, axes = np.linalg.eigh(np.trace(about) / 2 * np.eye(3) - about)
        J = moments[1] * ca.SX.eye(3)
        for moment, axis in ((moments[0], axes[:, 0]), (moments[2], axes[:, 2])):
            u = R @ sparse_constant(axis)
            J = J + symmetric(((moment - moments[1]) * u) @ u.T)
        return J


class SymbolicMassProperties(MassProperties):
    """Mass properties as entries of a symbolic vector ``p``.

    Parameters
    ----------
    free
        (10 B,) mask of the entries of :attr:`.InertialParameters.vector` that are in ``p``; the
        other entries are zero.
    """

    def __init__(self, free: npt.NDArray[np.bool_]) -> None:
        self._p = ca.SX.sym("p", int(np.count_nonzero(free)))
        rows = ca.SX(len(free), 1)
        for at, index in enumerate(np.flatnonzero(free).tolist()):
            rows[index] = self._p[at]
        bodies = ca.vertsplit(rows, NUMBERS_PER_BODY)
        self.masses = tuple(body[0] for body in bodies)
        self.centers = tuple(body[1:4] for body in bodies)
        self._moments = [body[4:] for body in bodies]
        self.total = sum(self.masses[1:], self.masses[0])
        self.inputs = {"p": self._p}

    def inertia(self, k: int, R: ca.SX) -> ca.SX:
        """Return the inertia (3, 3) of body k about its centre, rotated by R, kg m^2."""
        return rotational(self.second_moment(k, R))

    def second_moment(self, k: int, R: ca.SX) -> ca.SX:
        """Return the second moment of mass (3, 3) of body k, rotated by R, kg m^2.

        The matrix is computed as for constants, with the columns of R as axes, plus terms for
        products of inertia.
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


def possibly_nonzero_entries(nominal: InertialParameters) -> npt.NDArray[np.bool_]:
    """Return a mask (10 B,) of the vector entries that can be nonzero for robots with the given
    structure.

    All masses can be. Coordinates of centres of mass and products of inertia that are zero stay
    zero; principal moments are either all zero (a point mass) or all free.
    """
    rows = nominal.vector.reshape(-1, NUMBERS_PER_BODY) != 0.0
    rows[:, 0] = True
    rows[:, 4:7] = rows[:, 4:7].any(axis=1, keepdims=True)
    return np.asarray(rows.reshape(-1))


def rotational(J: ca.SX) -> ca.SX:
    """Return the rotational inertia ``tr(J) 1 - J`` for a second moment of mass."""
    inertia = -J
    for i in range(3):
        inertia[i, i] = J[i - 2, i - 2] + J[i - 1, i - 1]
    return inertia


def symmetric(matrix: ca.SX) -> ca.SX:
    """Return a symmetric matrix whose off-diagonal pairs share one expression each."""
    return ca.tril2symm(ca.tril(matrix))


def sparse_constant(array: Array) -> ca.DM:
    """Return constants for use in expressions; their zeros cost no operations."""
    return ca.sparsify(ca.DM(array))
