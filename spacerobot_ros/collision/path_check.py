"""Clearance along held commands: between the ticks, too.

A pair of solids moves against each other by at most v in a tick (``CollisionGeometry.reaches``). So
its distance within the tick is at least ``(d_0 + d_1 - v) / 2``, with d_0 and d_1 those at its
ends. Ticks where that is less than what is asked for are halved until v is small.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from spacerobot_ros.collision.geometry import CollisionGeometry, LinkPair
from spacerobot_ros.model.description import Array

_RESOLUTION = 5e-4
"""Motion of a pair within which its distance is not looked at any more, m."""


@dataclass(frozen=True)
class Approach:
    """The nearest approach of a pair.

    Attributes
    ----------
    links
        Names of the links.
    pair
        Number of the pair of solids in :attr:`CollisionGeometry.pairs`.
    distance
        m; negative: the depth of the contact.
    tick
        When, in ticks from the first shape.
    shape
        (n,) there, m or rad.
    """

    links: LinkPair
    pair: int
    distance: float
    tick: float
    shape: Array

    def __str__(self) -> str:
        if self.distance <= 0:
            return f"links {self.links} touch, {-self.distance:.3g} m deep"
        return f"links {self.links} come within {self.distance:.3g} m"


class PathCheck:
    """Nearest approaches of the pairs of a robot along paths.

    Parameters
    ----------
    geometry
        The solids and pairs.
    """

    def __init__(self, geometry: CollisionGeometry) -> None:
        self.geometry = geometry

    def approaches(self, positions: Array, required: Array) -> list[Approach]:
        """Return the nearest approaches of all pairs that come nearer than required.

        Parameters
        ----------
        positions
            (N + 1, n) shapes at the ticks, along straight lines in between; m or rad.
        required
            (P,) smallest distances of the pairs, m; minus infinity: any.
        """
        geometry = self.geometry
        if not len(geometry.pairs):
            return []
        motion = self._motion(positions)
        bounds = geometry.lower_bounds(geometry.poses(positions))
        least = (bounds[:-1] + bounds[1:] - motion) / 2 if len(motion) else bounds
        near = np.flatnonzero(least.min(axis=0) < required)
        found = (self._nearest(positions, motion, bounds, p, required[p]) for p in near.tolist())
        return sorted((each for each in found if each), key=lambda each: each.distance)

    def nearest(self, positions: Array) -> Approach | None:
        """Return the nearest approach of all pairs along a path (N + 1, n); None without pairs."""
        geometry = self.geometry
        if not len(geometry.pairs):
            return None
        motion = self._motion(positions)
        bounds = geometry.lower_bounds(geometry.poses(positions))
        least = (bounds[:-1] + bounds[1:] - motion) / 2 if len(motion) else bounds
        least = least.min(axis=0)
        best: Approach | None = None
        for pair in np.argsort(least, kind="stable").tolist():
            if best is not None and least[pair] >= best.distance:
                break
            limit = np.inf if best is None else best.distance
            best = self._nearest(positions, motion, bounds, pair, limit) or best
        return best

    def _motion(self, positions: Array) -> Array:
        """Return how far pairs move against each other at most in each tick, (N, P), m."""
        moved = np.abs(np.diff(self.geometry.moving_positions(positions), axis=0))
        return np.asarray(moved @ self.geometry.reaches(positions).T)

    def _nearest(
        self, positions: Array, motion: Array, bounds: Array, pair: int, limit: float
    ) -> Approach | None:
        """Return the nearest approach of a pair; None where it does not come nearer than limit."""
        geometry = self.geometry

        def distances(ticks: Array) -> Array:
            before = np.minimum(ticks.astype(int), len(positions) - 2)
            share = (ticks - before)[:, np.newaxis]
            shapes = (1 - share) * positions[before] + share * positions[before + 1]
            return geometry.distances(pair, geometry.poses(shapes))

        if len(positions) == 1:
            distance = float(geometry.distances(pair, geometry.poses(positions))[0])
            found = Approach(geometry.links_of(pair), pair, distance, 0.0, positions[0])
            return found if distance < limit else None
        close = (bounds[:-1, pair] + bounds[1:, pair] - motion[:, pair]) / 2 < limit
        starts = np.flatnonzero(close)
        if not len(starts):
            return None
        ticks = np.unique(np.concatenate([starts, starts + 1])).astype(float)
        known = distances(ticks)
        least = int(np.argmin(known))
        best, at = float(known[least]), float(ticks[least])
        index = np.searchsorted(ticks, starts)
        left, right = starts.astype(float), starts + 1.0
        d_0, d_1, v = known[index], known[index + 1], motion[starts, pair]
        while True:
            # Only where the distance may be less than any that is known, and matters.
            open_ = ((d_0 + d_1 - v) / 2 < min(best, limit)) & (v > _RESOLUTION)
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
        k = min(int(at), len(positions) - 2)
        shape = (1 - (at - k)) * positions[k] + (at - k) * positions[k + 1]
        return Approach(geometry.links_of(pair), pair, best, at, shape)


def names(approaches: Iterable[Approach]) -> list[LinkPair]:
    """Return the links of approaches, each pair once."""
    return list(dict.fromkeys(each.links for each in approaches))
