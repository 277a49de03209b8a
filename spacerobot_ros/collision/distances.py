"""Distances between two solids: exact values from coal, or bounds from rounded boxes around them.

J. Pan, S. Chitta, D. Manocha, "FCL: a general purpose library for collision and proximity queries",
ICRA, 2012; coal is its successor.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np

from spacerobot_ros.collision.rounded_box import RoundedBox, support, widest_gaps
from spacerobot_ros.files import warn_first_time
from spacerobot_ros.model.compilation import cache_directory
from spacerobot_ros.model.description import Array, Shape

_LOG = logging.getLogger(__name__)

WORLD_BODY = -1
"""Body index of obstacles."""


@dataclass(frozen=True)
class Solid:
    """A convex solid of a robot or an obstacle.

    Attributes
    ----------
    link
        Name of its link.
    body
        Index of the rigid body of the link; 0: the base, -1: an obstacle, in the world frame.
    shape
        URDF description of the solid.
    enclosure
        Enclosing rounded box in the link frame.
    vertices
        (V, 3) vertices of a mesh's convex hull in the link frame, m; None: no mesh.
    """

    link: str
    body: int
    shape: Shape
    enclosure: RoundedBox
    vertices: Array | None = field(default=None, repr=False)

    @property
    def is_obstacle(self) -> bool:
        """Whether the solid is an obstacle, fixed in the world."""
        return self.body == WORLD_BODY


@lru_cache(maxsize=1)
def _coal() -> Any:
    """Return the module coal; None: it is not installed, which is logged once per installation."""
    try:
        import coal
    except ImportError:
        warn_first_time(
            _LOG,
            cache_directory(),
            "warned_of_coal",
            "Distances between links are lower bounds from enclosing spheres, capsules and boxes, "
            "because the package coal is not installed: `pip install '.[collision]'` in the clone.",
        )
        return None
    return coal


class ExactDistances:
    """Exact distances between shapes and convex mesh hulls, computed by coal.

    Two solids are given by index, and their link poses by attitudes (N, 3, 3) and positions (N, 3),
    m, in a common frame. Negative distances are penetration depths.
    """

    exact = True

    def __init__(self, solids: Sequence[Solid], coal: Any) -> None:
        self._coal = coal
        self._geometries = [self._geometry(solid) for solid in solids]
        self._computers: dict[tuple[int, int], Any] = {}

    def _geometry(self, solid: Solid) -> tuple[Any, Array, Array]:
        """Return the shape, and its attitude and position in the frame of its link."""
        coal, shape, box = self._coal, solid.shape, solid.enclosure
        if solid.vertices is None:
            kinds = {"sphere": coal.Sphere, "box": coal.Box, "cylinder": coal.Cylinder}
            kind = kinds.get(shape.kind, coal.Capsule)
            return kind(*shape.size), shape.pose.R, shape.pose.r
        if (hull := self._hull(solid.vertices)) is not None:
            return hull, np.eye(3), np.zeros(3)
        sides = 2 * (box.half + box.radius)
        return coal.Box(*sides.tolist()), box.pose.R, box.pose.r

    def _hull(self, vertices: Array) -> Any:
        """Return the convex hull of vertices (V, 3); None if coal has none for them."""
        if np.linalg.matrix_rank(vertices - vertices[0], tol=1e-9) < 3:
            return None
        points = self._coal.StdVec_Vec3s()
        points.extend(list(vertices))
        # A vertex may have at most 254 neighbours. A disc cut into triangles can exceed this; if it
        # stays whole, only a cone's tip can.
        for triangles, options in ((True, "Qt"), (False, "")):
            with suppress(RuntimeError):
                return self._coal.Convex.convexHull(points, triangles, options)
        return None

    def __call__(
        self, first: int, R_1: Array, r_1: Array, second: int, R_2: Array, r_2: Array
    ) -> Array:
        """Return the distances (N,), m."""
        poses = R_1, r_1, R_2, r_2
        return np.array([distance for distance, *_ in self._results(first, second, *poses)])

    def planes(
        self, first: int, R_1: Array, r_1: Array, second: int, R_2: Array, r_2: Array
    ) -> tuple[Array, Array]:
        """Return the distances (N,) between the solids, m, with planes and points (N, 7).

        A plane touches the first solid at its point nearest to the second. The plane is given by
        its unit normal (3,) toward the second solid and its distance from the origin, m, in the
        first link frame. The point (3,) is the nearest point on the second solid, in its frame, m.
        """
        (_, R_a, r_a), (_, R_b, r_b) = self._geometries[first], self._geometries[second]
        distances, planes = np.empty(len(R_1)), np.empty((len(R_1), 7))
        results = self._results(first, second, R_1, r_1, R_2, r_2)
        for k, (distance, result, R_ab, r_ab) in enumerate(results):
            normal = R_a @ result.normal
            distances[k], planes[k, :3] = distance, normal
            planes[k, 3] = normal @ (R_a @ result.getNearestPoint1() + r_a)
            planes[k, 4:] = R_b @ (R_ab.T @ (result.getNearestPoint2() - r_ab)) + r_b
        return distances, planes

    def _results(
        self, first: int, second: int, R_1: Array, r_1: Array, R_2: Array, r_2: Array
    ) -> Iterator[tuple[float, Any, Array, Array]]:
        """Yield distances, coal's results in the frame of the first, poses of the second there."""
        coal = self._coal
        (one, R_a, r_a), (other, R_b, r_b) = self._geometries[first], self._geometries[second]
        if (first, second) not in self._computers:
            self._computers[first, second] = coal.ComputeDistance(one, other)
        compute = self._computers[first, second]
        request, result = coal.DistanceRequest(), coal.DistanceResult()
        R_ab = np.swapaxes(R_1 @ R_a, 1, 2) @ (R_2 @ R_b)
        between = (r_2 + R_2 @ r_b) - (r_1 + R_1 @ r_a)
        r_ab = np.einsum("nba,nb->na", R_1 @ R_a, between)
        here, there = coal.Transform3s.Identity(), coal.Transform3s.Identity()
        for k in range(len(R_1)):
            there.setRotation(R_ab[k])
            there.setTranslation(r_ab[k])
            result.clear()
            yield compute(here, there, request, result), result, R_ab[k], r_ab[k]


class EnclosureDistances:
    """Lower bounds on distances: the distances between the rounded boxes around the solids.

    Arguments and results are those of :class:`ExactDistances`.
    """

    exact = False

    def __init__(self, solids: Sequence[Solid]) -> None:
        self._enclosures = [solid.enclosure for solid in solids]

    def __call__(
        self, first: int, R_1: Array, r_1: Array, second: int, R_2: Array, r_2: Array
    ) -> Array:
        """Return the bounds."""
        one, other = self._enclosures[first], self._enclosures[second]
        return widest_gaps(one, R_1, r_1, other, R_2, r_2)[0]

    def planes(
        self, first: int, R_1: Array, r_1: Array, second: int, R_2: Array, r_2: Array
    ) -> tuple[Array, Array]:
        """Return the distances between the enclosures, with planes and points."""
        one, other = self._enclosures[first], self._enclosures[second]
        bounds, directions = widest_gaps(one, R_1, r_1, other, R_2, r_2)
        on_first = support(one, R_1, directions)
        on_second = support(other, R_2, -directions)
        normals = np.einsum("nba,nb->na", R_1, directions)
        offsets = np.einsum("na,na->n", normals, np.einsum("nba,nb->na", R_1, on_first))
        return bounds, np.column_stack([normals, offsets, np.einsum("nba,nb->na", R_2, on_second)])


DistanceFunction = ExactDistances | EnclosureDistances


def distance_function(solids: Sequence[Solid]) -> DistanceFunction:
    """Return an exact distance function, or lower bounds if ``coal`` is not installed."""
    coal = _coal()
    return EnclosureDistances(solids) if coal is None else ExactDistances(solids, coal)
