"""Planar robots: as URDF text, and as formulas written out in numpy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation
from support.urdf_text import link, numbers

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Part:
    """A link in the plane: parent, joint in the parent's frame, mass centre in its own, limits."""

    parent: int
    joint: Array
    com: Array
    mass: float
    inertia: float
    limits: tuple[float, float] | None = None
    rate: float = 2.0


@dataclass(frozen=True)
class PlanarTree:
    """A planar robot from its angular momentum; ``plane`` (3, 3) turns plane vectors into B."""

    parts: tuple[Part, ...]
    plane: Array

    @property
    def urdf(self) -> str:
        """The robot as URDF: joints ``j1``, ``j2``, ... about the third axis of ``plane``."""
        text = []
        for k, part in enumerate(self.parts):
            moments = self.plane @ np.diag([0.3, 0.4, 0.7]) @ self.plane.T * part.inertia / 0.7
            text.append(link(f"l{k}", part.mass, moments, self.plane[:, :2] @ part.com))
            if k:
                text.append(
                    joint(k, part.parent, self.plane[:, :2] @ part.joint, self.plane[:, 2], part)
                )
        return f'<robot name="tree">{"".join(text)}</robot>'

    def positions(self, psi: Array) -> tuple[Array, Array]:
        """Return joints and mass centres (..., N, 2) of shapes (..., N - 1), base components."""
        angle = [np.zeros(psi.shape[:-1])]
        origin = [np.zeros((*psi.shape[:-1], 2))]
        for k, part in enumerate(self.parts[1:], start=1):
            origin.append(origin[part.parent] + turned(angle[part.parent], part.joint))
            angle.append(angle[part.parent] + psi[..., k - 1])
        com = [
            p + turned(a, part.com) for p, a, part in zip(origin, angle, self.parts, strict=True)
        ]
        return np.stack(origin, axis=-2), np.stack(com, axis=-2)

    def center_of_mass(self, psi: Array) -> Array:
        """Return the mass centre (..., 2) of shapes (..., N - 1), base components."""
        mass = np.array([part.mass for part in self.parts])
        return np.tensordot(self.positions(psi)[1], mass / mass.sum(), axes=([-2], [0]))

    def s(self, psi: Array) -> Array:
        """Return s (..., N - 1) of ``theta_dot = -s' psi_dot``: the angular momentum about the mass
        centre of the whole is ``D theta_dot + sum N_i psi_dot_i = 0``.
        """
        origin, com = self.positions(psi)
        d = com - self.center_of_mass(psi)[..., np.newaxis, :]
        mass = np.array([part.mass for part in self.parts])
        inertia = np.array([part.inertia for part in self.parts])
        D = inertia.sum() + (mass * (d * d).sum(axis=-1)).sum(axis=-1)
        N = []
        for i in range(1, len(self.parts)):
            carried = [k for k in range(len(self.parts)) if self.carries(i, k)]
            arm = com[..., carried, :] - origin[..., i : i + 1, :]
            moment = mass[carried] * (d[..., carried, :] * arm).sum(axis=-1)
            N.append(inertia[carried].sum() + moment.sum(axis=-1))
        return np.stack(N, axis=-1) / D[..., np.newaxis]

    def carries(self, i: int, k: int) -> bool:
        while k > i:
            k = self.parts[k].parent
        return k == i


def turned(angle: Array, vector: Array) -> Array:
    """Return plane vectors (..., 2): a vector (2,) turned by angles (...)."""
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([c * vector[0] - s * vector[1], s * vector[0] + c * vector[1]], axis=-1)


def joint(k: int, parent: int, origin: Array, axis: Array, part: Part) -> str:
    kind, stops = "continuous", ""
    if part.limits is not None:
        kind, stops = "revolute", f'lower="{part.limits[0]!r}" upper="{part.limits[1]!r}" '
    return (
        f'<joint name="j{k}" type="{kind}"><parent link="l{parent}"/><child link="l{k}"/>'
        f'<origin xyz="{numbers(origin)}"/><axis xyz="{numbers(axis)}"/>'
        f'<limit {stops}velocity="{part.rate!r}" effort="50"/></joint>'
    )


def random_tree(rng: np.random.Generator, links: int, *, branched: bool = False) -> PlanarTree:
    """Return a heavy base with links of about a metre, in any plane of the base's frame."""
    parts = [Part(-1, np.zeros(2), rng.uniform(-0.2, 0.2, 2), 60.0, float(rng.uniform(4, 12)))]
    # Parents in ascending order, as the model orders the joints of a tree.
    parents = sorted(int(rng.integers(k)) if branched else k - 1 for k in range(1, links))
    for parent in parents:
        reach = rng.uniform([0.4, -0.2], [1.0, 0.2])
        com, mass = rng.uniform([0.2, -0.1], [0.6, 0.1]), float(rng.uniform(5, 15))
        parts.append(Part(parent, reach, com, mass, float(rng.uniform(0.3, 2.0))))
    return PlanarTree(tuple(parts), Rotation.from_rotvec(rng.normal(size=3)).as_matrix())
