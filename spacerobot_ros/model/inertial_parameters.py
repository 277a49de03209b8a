"""Masses, centres of mass and inertias of a robot's bodies as numbers that may differ.

What a robot looks like and how its joints sit stays; what its bodies weigh is known to a few per
cent. One robot, or a batch of robots that differ in these numbers alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from spacerobot_ros.errors import RobotDescriptionError
from spacerobot_ros.model.description import Array, Inertia, RobotDescription

TRIANGLE_SLACK = 0.01
"""Share by which rounded principal moments may break the triangle inequality."""

_ROUNDING = 1e-12

PER_BODY = 10
"""Numbers a body in :attr:`InertialParameters.vector`."""

PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
"""Where the six second moments of a body stand in their matrix."""


@dataclass(frozen=True)
class InertialParameters:
    """What the bodies of a robot weigh; ``bodies`` as :class:`RobotDescription` has them.

    Leading dimensions (...) make it a batch: none is one robot, (N,) are N robots.

    Attributes
    ----------
    masses
        (..., B) kg.
    centers
        (..., B, 3) centres of mass in the frames of the bodies (the frame of the first link of
        each), m.
    inertias
        (..., B, 3, 3) about those centres, along the axes of those frames, kg m^2.

    Raises
    ------
    ValueError
        The shapes of the three do not go together.
    """

    masses: Array
    centers: Array
    inertias: Array

    def __post_init__(self) -> None:
        shape = self.masses.shape
        if self.centers.shape != (*shape, 3) or self.inertias.shape != (*shape, 3, 3):
            raise ValueError(
                f"masses {shape}, centers {self.centers.shape} and inertias "
                f"{self.inertias.shape} do not go together"
            )

    @classmethod
    def of(cls, robot: RobotDescription) -> InertialParameters:
        """Return those of a described robot."""
        parts = [body.inertia for body in robot.bodies]
        return cls(
            np.array([part.mass for part in parts]),
            np.array([part.com for part in parts]),
            np.array([part.about_com for part in parts]),
        )

    @classmethod
    def stacked(cls, each: Sequence[InertialParameters]) -> InertialParameters:
        """Return robots as one batch, (N, ...)."""
        return cls(
            np.stack([one.masses for one in each]),
            np.stack([one.centers for one in each]),
            np.stack([one.inertias for one in each]),
        )

    def __getitem__(self, index: int | slice | Array) -> InertialParameters:
        """Return robots of a batch."""
        return InertialParameters(self.masses[index], self.centers[index], self.inertias[index])

    @property
    def total_mass(self) -> Array:
        """Masses of the robots (...), kg."""
        return np.asarray(self.masses.sum(axis=-1))

    def scaled(
        self, masses: npt.ArrayLike = 1.0, inertias: npt.ArrayLike | None = None
    ) -> InertialParameters:
        """Return robots whose masses and inertias are multiplied by factors (..., B).

        Without factors of their own the inertias go with the masses, as those of bodies of another
        density do. Factors of shape (N, B), or (N, 1) for all bodies alike, make one robot a batch.
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
        """Return robots whose centres of mass are moved by offsets (..., B, 3) in m.

        The inertias about the centres stay.
        """
        centers = self.centers + np.asarray(offsets, dtype=float)
        shape = centers.shape[:-1]
        return InertialParameters(
            np.broadcast_to(self.masses, shape),
            centers,
            np.broadcast_to(self.inertias, (*shape, 3, 3)),
        )

    def with_payload(self, body: int, payload: Inertia) -> InertialParameters:
        """Return one robot that carries a payload, given in the frame of a body, fixed to it."""
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
        """All numbers in a row, (..., 10 B): what compiled functions take.

        Of each body its mass, its centre (3) and its second moments xx, yy, zz, xy, xz, yz.
        """
        moments = self.second_moments
        six = np.stack([moments[..., i, j] for i, j in PAIRS], axis=-1)
        rows = np.concatenate([self.masses[..., None], self.centers, six], axis=-1)
        return rows.reshape(*self.masses.shape[:-1], -1)

    def require_physical(self, names: Sequence[str]) -> None:
        """Refuse what no body weighs; ``names`` are those of the bodies.

        Raises
        ------
        RobotDescriptionError
            A number is not finite, a mass negative or none where there was to be one, or
            principal moments are negative or break the triangle inequality.
        """
        finite = np.isfinite(self.vector).reshape(-1, len(names), PER_BODY).all(axis=(0, 2))
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
            raise RobotDescriptionError("All bodies of the robot together weigh nothing.")
        tensors = self.inertias.reshape(-1, len(names), 3, 3)
        low, middle, high = np.moveaxis(np.linalg.eigvalsh(tensors), -1, 0)
        slack = _ROUNDING * np.maximum(1.0, high)
        impossible = (low < -slack) | (high > (1 + TRIANGLE_SLACK) * (low + middle) + slack)
        if impossible.any():
            row, body_index = np.argwhere(impossible)[0]
            moments = ", ".join(f"{each[row, body_index]:.4g}" for each in (low, middle, high))
            raise RobotDescriptionError(
                f"The inertia of '{names[int(body_index)]}' is that of no body: its principal "
                f"moments are {moments} kg m^2."
            )

    def described(self, robot: RobotDescription) -> RobotDescription:
        """Return a robot that has these instead of its own; ``urdf`` stays what it was.

        The first link of each body has what the body weighs, and the links that fixed joints weld
        to it weigh nothing.
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
