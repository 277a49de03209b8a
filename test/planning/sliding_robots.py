"""Robots with sliders on slots anywhere: as URDF text, and as formulas written out in numpy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation
from support.urdf_text import link, numbers

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Slider:
    """A mass on a slot: ``p(z) = point + z direction`` in B, with an inertia about its centre."""

    mass: float
    direction: Array
    point: Array
    inertia: Array = field(default_factory=lambda: np.zeros((3, 3)))
    stroke: tuple[float, float] = (-2.5, 2.5)
    rate: float = 0.7


@dataclass(frozen=True)
class SlidingRobot:
    """A base with sliders: the robot of paper 1, with bodies instead of points if wanted."""

    mass: float
    inertia: Array
    centre: Array
    sliders: tuple[Slider, ...]

    @property
    def urdf(self) -> str:
        """The robot as URDF; joints ``s1``, ``s2``, ... in the order of the sliders."""
        parts = [link("base_link", self.mass, self.inertia, self.centre)]
        for k, s in enumerate(self.sliders, start=1):
            parts.append(link(f"m{k}", s.mass, s.inertia, np.zeros(3)))
            parts.append(
                f'<joint name="s{k}" type="prismatic"><parent link="base_link"/>'
                f'<child link="m{k}"/><origin xyz="{numbers(s.point)}"/>'
                f'<axis xyz="{numbers(s.direction)}"/><limit lower="{s.stroke[0]!r}" '
                f'upper="{s.stroke[1]!r}" velocity="{s.rate!r}" effort="50"/></joint>'
            )
        return f'<robot name="sliders">{"".join(parts)}</robot>'

    @property
    def total_mass(self) -> float:
        return self.mass + sum(s.mass for s in self.sliders)

    def center_of_mass(self, z: Array) -> Array:
        """Return c(z) (..., 3) from the base origin, for shapes (..., n)."""
        moment = np.broadcast_to(self.mass * self.centre, (*z.shape[:-1], 3)).copy()
        for k, s in enumerate(self.sliders):
            moment += s.mass * (s.point + z[..., k, np.newaxis] * s.direction)
        return moment / self.total_mass

    def base_rate(self, z: Array, zdot: Array) -> Array:
        """Return omega (..., 3) in B at zero angular momentum: ``J(z) omega = sum F_i(z) zdot_i``.

        ``J`` is the inertia of the whole about its centre of mass, ``F_i = -m_i d_i x R_i(1)`` with
        ``d_i`` from that centre: paper 1, eq. (3), body by body.
        """
        c = self.center_of_mass(z)
        J = np.broadcast_to(self.inertia, (*z.shape[:-1], 3, 3)).copy()
        J += self.mass * _parallel(self.centre - c)
        right = np.zeros((*z.shape[:-1], 3))
        for k, s in enumerate(self.sliders):
            d = s.point + z[..., k, np.newaxis] * s.direction - c
            J += s.inertia + s.mass * _parallel(d)
            right -= s.mass * np.cross(d, s.direction) * zdot[..., k, np.newaxis]
        return np.asarray(np.linalg.solve(J, right[..., np.newaxis])[..., 0], dtype=np.float64)

    def attitudes(self, shapes: Array, period: float, start: Rotation) -> list[Rotation]:
        """Return R_WB at every tick of ``shapes`` (N + 1, n), sliders at constant rates in between.

        At zero momentum the turn within a tick depends on nothing but its shapes: all ticks are
        integrated side by side (DOP853), and the turns put one after the other.
        """
        rates = np.diff(shapes, axis=0) / period
        count = len(rates)
        if not count:
            return [start]

        def derivative(t: float, flat: Array) -> Array:
            q = flat.reshape(count, 4)
            omega = self.base_rate(shapes[:-1] + t * rates, rates)
            vector = q[:, 3:] * omega + np.cross(q[:, :3], omega)
            scalar = -np.sum(q[:, :3] * omega, axis=1, keepdims=True)
            return 0.5 * np.hstack([vector, scalar]).ravel()

        identity = np.tile([0.0, 0.0, 0.0, 1.0], count)
        solution = solve_ivp(
            derivative, (0.0, period), identity, method="DOP853", rtol=1e-12, atol=1e-14
        )
        turns = Rotation.from_quat(solution.y[:, -1].reshape(count, 4))
        attitudes = [start]
        for k in range(count):
            attitudes.append(attitudes[-1] * turns[k])
        return attitudes

    def positions(self, shapes: Array, attitudes: Sequence[Rotation], r_WB: npt.ArrayLike) -> Array:
        """Return r_WB (N + 1, 3): the centre of mass rests."""
        c = self.center_of_mass(shapes)
        r_cm = np.asarray(r_WB) + attitudes[0].apply(c[0])
        return np.array([r_cm - R.apply(x) for R, x in zip(attitudes, c, strict=True)])


def paper_robot(**changes: float) -> SlidingRobot:
    """Return the example of paper 1: a base of 10 kg, three points of 2 kg on its axes."""
    sliders = tuple(Slider(2.0, axis, np.zeros(3), **changes) for axis in np.eye(3))  # type: ignore[arg-type]
    return SlidingRobot(10.0, np.diag([1.0, 1.5, 1.5]), np.zeros(3), sliders)


def random_sliding_robot(rng: np.random.Generator, sliders: int) -> SlidingRobot:
    """Return a robot with slots in random directions, beside the centre of mass."""
    while True:
        directions = rng.normal(size=(sliders, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        if np.linalg.svd(directions)[1][-1] > 0.4:
            break
    return SlidingRobot(
        mass=float(rng.uniform(8.0, 15.0)),
        inertia=_random_inertia(rng, 1.0, 2.0),
        centre=rng.uniform(-0.1, 0.1, 3),
        sliders=tuple(
            Slider(
                mass=float(rng.uniform(1.0, 3.0)),
                direction=direction,
                point=rng.uniform(-0.3, 0.3, 3),
                inertia=_random_inertia(rng, 0.0, 0.02),
            )
            for direction in directions
        ),
    )


def _random_inertia(rng: np.random.Generator, low: float, high: float) -> Array:
    R = Rotation.from_rotvec(rng.normal(size=3)).as_matrix()
    second = rng.uniform(low, high, 3) / 2
    return R @ np.diag(second.sum() - second) @ R.T


def _parallel(d: Array) -> Array:
    square = np.sum(d * d, axis=-1)[..., np.newaxis, np.newaxis]
    return square * np.eye(3) - d[..., :, np.newaxis] * d[..., np.newaxis, :]
