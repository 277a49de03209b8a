"""Nearest approaches while commands are held.

While a command is held, two solids move relative to each other by at most v per tick
(``CollisionGeometry.largest_lever_arms``). So their distance during the tick is at least
``(d_0 + d_1 - v) / 2``, where d_0 and d_1 are the distances at the ends of the tick. Ticks for
which this bound is below the clearance are bisected until v is small. For obstacles, the base
motion also matters: within a tick, the base moves along a straight line and rotates about one axis.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spacerobot_ros.collision.geometry import BasePoses, CollisionGeometry, LinkPair
from spacerobot_ros.errors import numbers, quantity
from spacerobot_ros.model.description import Array

_MOTION_RESOLUTION = 5e-4
"""Largest relative motion of a pair between two evaluations of its distance, m."""


@dataclass(frozen=True)
class Approach:
    """Nearest approach of a pair.

    Attributes
    ----------
    links
        Names of the links.
    pair
        Index of the pair in :attr:`CollisionGeometry.pairs`.
    distance
        m; negative: penetration depth.
    tick
        Time of the approach, in ticks from the first configuration.
    shape
        (n,) configuration at that time, m or rad.
    place_on_obstacle
        (3,) nearest obstacle point in W, m; None for two links.
    """

    links: LinkPair
    pair: int
    distance: float
    tick: float
    shape: Array
    place_on_obstacle: Array | None = None

    def __str__(self) -> str:
        where = ""
        if self.place_on_obstacle is not None:
            where = f" near ({numbers(self.place_on_obstacle, 3)}) m"
        if self.distance <= 0:
            return f"{self.links.subject} touch, {quantity(-self.distance, 'm')} deep{where}"
        return f"{self.links.subject} come within {quantity(self.distance, 'm')}{where}"


@dataclass(frozen=True)
class _Path:
    """A path of shapes (N + 1, n) at the ticks, with the base poses if obstacles matter, else None.

    ``largest_motions`` (N, P) are the largest relative motions of pairs in each tick, m, and
    ``lower_bounds`` (N, P) lower bounds on their distances in each tick, m.
    """

    positions: Array
    base: BasePoses | None
    largest_motions: Array
    lower_bounds: Array

    @classmethod
    def of(cls, geometry: CollisionGeometry, positions: Array, base: BasePoses | None) -> _Path:
        if len(positions) == 1:
            twice = np.zeros(2, dtype=np.int64)
            positions, base = positions[twice], None if base is None else base.rows(twice)
        bounds = geometry.lower_bounds(geometry.poses(positions, base))
        reaches, from_base = geometry.largest_lever_arms(positions)
        moved = np.abs(np.diff(geometry.moving_positions(positions), axis=0))
        motion = moved @ reaches.T
        if base is not None and geometry.with_obstacles.any():
            straight = np.linalg.norm(np.diff(base.position, axis=0), axis=1)
            # Quaternions contain half the angle.
            chord = np.linalg.norm(np.diff(base.quaternion, axis=0), axis=1)
            turned = 4 * np.arcsin(np.minimum(np.minimum(chord, np.sqrt(4 - chord**2)) / 2, 1.0))
            motion += np.outer(turned, from_base) + np.outer(straight, geometry.with_obstacles)
        return cls(positions, base, motion, (bounds[:-1] + bounds[1:] - motion) / 2)

    def interpolated(self, ticks: Array) -> tuple[Array, BasePoses | None]:
        """Return configurations (K, n) and base poses at times (K,) in ticks."""
        before = np.minimum(ticks.astype(int), len(self.positions) - 2)
        share = (ticks - before)[:, np.newaxis]
        shapes = (1 - share) * self.positions[before] + share * self.positions[before + 1]
        return shapes, None if self.base is None else self.base.between(before, share)


def nearest_approaches(
    geometry: CollisionGeometry,
    positions: Array,
    required: Array,
    base: BasePoses | None = None,
) -> list[Approach]:
    """Return the nearest approaches of all pairs that come closer than allowed, nearest first.

    Parameters
    ----------
    geometry
        The solids and pairs.
    positions
        (N + 1, n) configurations at the ticks, interpolated linearly in between, m or rad.
    required
        (P,) smallest allowed distances of the pairs, m; minus infinity: any distance.
    base
        Base poses at the ticks; None: obstacles are ignored.
    """
    if not len(geometry.pairs):
        return []
    path = _Path.of(geometry, positions, base)
    near = np.flatnonzero(path.lower_bounds.min(axis=0) < required)
    found = (_nearest(geometry, path, p, required[p]) for p in near.tolist())
    return sorted((each for each in found if each), key=lambda each: each.distance)


def nearest_approach(
    geometry: CollisionGeometry, positions: Array, base: BasePoses | None = None
) -> Approach | None:
    """Return the nearest approach of all pairs along a path (N + 1, n); None: no pairs.

    ``base`` contains the base poses at the ticks; None: obstacles are ignored.
    """
    if not len(geometry.pairs):
        return None
    path = _Path.of(geometry, positions, base)
    least = path.lower_bounds.min(axis=0)
    best: Approach | None = None
    for pair in np.argsort(least, kind="stable").tolist():
        if best is not None and least[pair] >= best.distance:
            break
        limit = np.inf if best is None else best.distance
        best = _nearest(geometry, path, pair, limit) or best
    return best


def _nearest(geometry: CollisionGeometry, path: _Path, pair: int, limit: float) -> Approach | None:
    """Return the nearest approach of a pair; None if it does not come nearer than limit."""

    def distances(ticks: Array) -> Array:
        return geometry.distances(pair, geometry.poses(*path.interpolated(ticks)))

    close = path.lower_bounds[:, pair] < limit
    starts = np.flatnonzero(close)
    if not len(starts):
        return None
    ticks = np.flatnonzero(np.append(close, False) | np.append(False, close)).astype(float)
    known = distances(ticks)
    least = int(np.argmin(known))
    best, at = float(known[least]), float(ticks[least])
    index = np.searchsorted(ticks, starts)
    left, right = starts.astype(float), starts + 1.0
    d_0, d_1, v = known[index], known[index + 1], path.largest_motions[starts, pair]
    while True:
        # Only where the distance may be smaller than all known ones, and relevant.
        open_ = ((d_0 + d_1 - v) / 2 < min(best, limit)) & (v > _MOTION_RESOLUTION)
        if not open_.any():
            break
        left, right, d_0, d_1, v = (x[open_] for x in (left, right, d_0, d_1, v))
        middle = (left + right) / 2
        d = distances(middle)
        least = int(np.argmin(d))
        if d[least] < best:
            best, at = float(d[least]), float(middle[least])
        left, right = np.concatenate([left, middle]), np.concatenate([middle, right])
        d_0, d_1 = np.concatenate([d_0, d]), np.concatenate([d, d_1])
        v = np.concatenate([v, v]) / 2
    if best >= limit:
        return None
    shapes, base = path.interpolated(np.array([at]))
    place = None
    if base is not None and geometry.with_obstacles[pair]:
        place = geometry.nearest_point_on_obstacle(pair, shapes[0], base)
    return Approach(geometry.links_of(pair), pair, best, at, shapes[0], place)
