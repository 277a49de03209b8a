"""The nearest pair of a robot at one state after another, as fast as a plant in flight needs it."""

from __future__ import annotations

import numpy as np

from spacerobot_ros.collision.distances import ExactDistances
from spacerobot_ros.collision.geometry import BasePoses, CollisionGeometry, LinkPair
from spacerobot_ros.model.description import Array

_MARGIN = 1e-9
"""Rounding of the bounds by balls, m."""


class NearestPair:
    """The smallest distance of the pairs of a robot, from the poses of its links.

    Parameters
    ----------
    geometry
        The solids and at least one pair; its distances are exact.
    links
        The links in the order of the poses.
    """

    def __init__(self, geometry: CollisionGeometry, links: tuple[str, ...]) -> None:
        exact = geometry.distance_function
        assert isinstance(exact, ExactDistances)
        self.geometry = geometry
        self._place = exact.placed()
        solids = geometry.solids
        self._first, self._second = np.ascontiguousarray(geometry.pairs.T)
        self._pairs: list[tuple[int, int]] = [(int(a), int(b)) for a, b in geometry.pairs]
        # Obstacles are in the frame of the world, which comes after the links.
        self._columns = np.array(
            [len(links) if each.is_obstacle else links.index(each.link) for each in solids],
            dtype=int,
        )
        self._centers = np.array([each.enclosure.pose.r for each in solids])[:, :, np.newaxis]
        radii = np.array([each.enclosure.bounding_radius for each in solids])
        self._reach = radii[self._first] + radii[self._second] + _MARGIN

    def nearest(self, link_R: Array, link_r: Array, pose: Array) -> tuple[float, int]:
        """Return the smallest distance, m, and its pair.

        Parameters
        ----------
        link_R, link_r
            Attitudes (3, 3 L) and positions (3, L), m, of the links in B.
        pose
            (7,) position, m, and quaternion (x, y, z, w) of the base in W.
        """
        bounds = self._bounds(link_R, link_r, pose)
        best, nearest = np.inf, 0
        for pair in bounds.argsort(kind="stable").tolist():
            if bounds[pair] >= best:
                break
            distance = self._place.distance(*self._pairs[pair])
            if distance < best:
                best, nearest = distance, pair
        return best, nearest

    def touching(self, link_R: Array, link_r: Array, pose: Array) -> frozenset[LinkPair]:
        """Return the links that touch, for poses as of :meth:`nearest`."""
        near = np.flatnonzero(self._bounds(link_R, link_r, pose) <= 0).tolist()
        return frozenset(
            self.geometry.links_of(pair)
            for pair in near
            if self._place.distance(*self._pairs[pair]) <= 0
        )

    def _bounds(self, link_R: Array, link_r: Array, pose: Array) -> Array:
        """Place the solids, and return lower bounds (P,) of the distances of all pairs, m."""
        if self.geometry.robot.world is not None:
            R_BW, r_BW = BasePoses(pose[np.newaxis, :3], pose[np.newaxis, 3:]).world
            link_R, link_r = np.hstack([link_R, R_BW[0]]), np.column_stack([link_r, r_BW[0]])
        R = np.ascontiguousarray(link_R.reshape(3, -1, 3).transpose(1, 0, 2))[self._columns]
        r = link_r.T[self._columns]
        self._place.move(R, r)
        centers = r + (R @ self._centers)[:, :, 0]
        between = centers[self._first] - centers[self._second]
        return np.sqrt(np.einsum("pa,pa->p", between, between)) - self._reach
