"""Solids of a robot, and distances between two of them: exact values from coal, or bounds.

A link uses the shapes of its ``<collision>`` elements or, if it has none, of its ``<visual>``
elements. Meshes, closed or open, are replaced by their convex hulls.

Without coal, bounds come from rounded boxes around the solids. A rounded box is the set of all
points within a radius of a box, its core. The core is a point for a sphere and a line for a
capsule, so one formula bounds all distances. The gap between the projections of two convex bodies
onto any direction is at most their distance, and equal to it along the line between their nearest
points. The nearest points are found by alternating projections; if cores overlap, the depth is
found along the axes of the separating axis theorem.

J. Pan, S. Chitta, D. Manocha, "FCL: a general purpose library for collision and proximity queries",
ICRA, 2012; coal is its successor. S. Gottschalk, M. Lin, D. Manocha, "OBBTree: a hierarchical
structure for rapid interference detection", SIGGRAPH, 1996. W. Cheney, A. Goldstein, "Proximity
maps for convex sets", Proceedings of the American Mathematical Society 10, 1959.
"""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np

from spacerobot_ros.errors import MeshError, enumeration
from spacerobot_ros.files import warn_first_time
from spacerobot_ros.model.compilation import cache_directory
from spacerobot_ros.model.description import Array, Pose, RobotDescription, Shape
from spacerobot_ros.model.meshes import TriangleMesh, Visual, shape_mesh, solid_mesh

_LOG = logging.getLogger(__name__)

WORLD_BODY = -1
"""Body index of obstacles."""

_MAX_PROJECTIONS = 60
"""Number of alternating projections; the bound is valid after any number."""

_MAX_NAMED_LINKS = 4

_PARALLEL_TOLERANCE = 1e-9
"""Length of the cross product of two unit vectors below which they are considered parallel."""


@dataclass(frozen=True)
class RoundedBox:
    """All points within ``radius`` (m) of a box.

    Attributes
    ----------
    pose
        Pose of the box in its link frame: origin at the centre, axes along the edges.
    half
        (3,) half edge lengths of the core, m.
    radius
        m.
    """

    pose: Pose
    half: Array
    radius: float = 0.0

    @property
    def bounding_radius(self) -> float:
        """Radius of the bounding sphere around the centre of the box, m."""
        return float(np.linalg.norm(self.half)) + self.radius

    @property
    def volume(self) -> float:
        """m^3 (Steiner's formula)."""
        a, b, c = 2 * self.half
        r = self.radius
        faces = 2 * (a * b + b * c + c * a) * r
        edges = math.pi * r**2 * (a + b + c)
        return float(a * b * c + faces + edges + 4 / 3 * math.pi * r**3)

    @classmethod
    def around(cls, shape: Shape, vertices: Array | None = None) -> RoundedBox:
        """Return the smaller of two rounded boxes that enclose a shape.

        ``vertices`` (V, 3), m, are mesh vertices in the link frame.
        """
        match shape.kind:
            case "sphere":
                return cls(shape.pose, np.zeros(3), shape.size[0])
            case "box":
                return cls(shape.pose, np.array(shape.size) / 2)
            case "cylinder" | "capsule":
                radius, length = shape.size
                capsule = cls(shape.pose, np.array([0.0, 0.0, length / 2]), radius)
                if shape.kind == "capsule":
                    return capsule
                box = cls(shape.pose, np.array([radius, radius, length / 2]))
                return min(capsule, box, key=lambda each: each.volume)
            case _:
                assert vertices is not None
                return _around_points(vertices, shape.pose.R)


def _around_points(points: Array, R: Array) -> RoundedBox:
    """Return the smallest of boxes along the axes ``R`` or the principal axes, and a capsule."""
    principal = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2].T
    if np.linalg.det(principal) < 0:
        principal = -principal
    found = []
    for axes in (R, principal):
        local = points @ axes
        low, high = local.min(axis=0), local.max(axis=0)
        middle, half = (low + high) / 2, (high - low) / 2
        found.append(RoundedBox(Pose(axes, axes @ middle), half))
        longest = int(np.argmax(half))
        across = np.delete(local - middle, longest, axis=1)
        radius = float(np.linalg.norm(across, axis=1).max())
        found.append(RoundedBox(found[-1].pose, half * (np.arange(3) == longest), radius))
    return min(found, key=lambda each: each.volume)


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


@dataclass(frozen=True)
class UnreadMesh:
    """An unreadable mesh: some contacts of its link are not detected.

    Attributes
    ----------
    link
        Name of its link.
    reason
        A sentence with the reason.
    is_collision_shape
        Whether the mesh belongs to a ``<collision>`` and not only to a ``<visual>``.
    """

    link: str
    reason: str
    is_collision_shape: bool


def unread_mesh_notes(meshes: Sequence[UnreadMesh]) -> list[str]:
    """Return a warning for each reason why meshes cannot be read; it names one of the meshes."""
    by_reason: dict[str, list[UnreadMesh]] = {}
    for each in meshes:
        reason = re.sub(r"^The mesh ('.*?'|\S+)", "", each.reason)
        by_reason.setdefault(reason, []).append(each)
    notes = []
    for unread in by_reason.values():
        links = [f"'{name}'" for name in dict.fromkeys(each.link for each in unread)]
        if len(links) > _MAX_NAMED_LINKS:
            links[_MAX_NAMED_LINKS - 1 :] = [f"{len(links) - _MAX_NAMED_LINKS + 1} more"]
        which = "link" if len(links) == 1 else "links"
        note = f"Some contacts of {which} {enumeration(links)} are not detected: {unread[0].reason}"
        others = len({each.reason for each in unread}) - 1
        more = f" The same applies to {others} other mesh{'es' * (others > 1)}." if others else ""
        notes.append(note + more)
    return notes


def solids_of(
    robot: RobotDescription, mesh_of: Callable[[Shape], TriangleMesh] = shape_mesh
) -> tuple[tuple[Solid, ...], tuple[str, ...], tuple[UnreadMesh, ...]]:
    """Return the solids of a robot, notes on links whose geometry may be unexpected, and meshes
    that cannot be read. See :class:`CollisionGeometry` for ``mesh_of``.
    """
    solids: list[Solid] = []
    notes: list[str] = []
    unread: list[UnreadMesh] = []
    drawn = [link.name for link in robot.links if link.shapes and not link.collisions]
    if drawn and any(link.collisions for link in robot.links):
        names = ", ".join(f"'{name}'" for name in drawn[:3]) + ", ..." * (len(drawn) > 3)
        notes.append(f"Links without <collision> use the shapes of their <visual>: {names}.")
    elif drawn:
        notes.append("No link has a <collision>: distances are computed from the <visual> shapes.")
    for link in robot.links:
        body = robot.frames[link.name][0]
        for shape in link.collisions or link.shapes:
            if shape.kind == "mesh":
                try:
                    vertices = mesh_of(shape).vertices
                except MeshError as error:
                    unread.append(UnreadMesh(link.name, str(error), bool(link.collisions)))
                    continue
                hull = _convex_hull(vertices)
                vertices = vertices if hull is None else vertices[hull.vertices]
                enclosure = RoundedBox.around(shape, vertices)
                solids.append(Solid(link.name, body, shape, enclosure, vertices))
            elif max(shape.size) > 0:
                solids.append(Solid(link.name, body, shape, RoundedBox.around(shape)))
    return tuple(solids), tuple(notes), tuple(unread)


def _convex_hull(points: Array) -> Any:
    """Return the convex hull of points (V, 3) by scipy; None if they are coplanar."""
    # Slow to import, and few robots have meshes.
    from scipy.spatial import ConvexHull, QhullError

    try:
        return ConvexHull(points)
    except QhullError:
        return None


# -- as triangles, for pages and pictures ---------------------------------------------------------


def collision_visuals(
    robot: RobotDescription, mesh_of: Callable[[Shape], TriangleMesh] = shape_mesh
) -> tuple[Visual, ...]:
    """Return the solids used for distances: hulls of meshes, except for unreadable ones.

    See :class:`.CollisionGeometry` for ``mesh_of``.
    """
    solids, _, _ = solids_of(robot, mesh_of)
    return tuple(Visual(each.link, each.body, each.shape, _mesh_of(each)) for each in solids)


def obstacle_visuals(
    world: RobotDescription | None, mesh_of: Callable[[Shape], TriangleMesh] = shape_mesh
) -> tuple[tuple[Visual, Pose], ...]:
    """Return solids of obstacles, each with its link pose in W; see :func:`collision_visuals`."""
    if world is None:
        return ()
    return tuple((each, world.frames[each.link][1]) for each in collision_visuals(world, mesh_of))


def _mesh_of(solid: Solid) -> TriangleMesh:
    """Return the triangles of a solid; none for a flat hull."""
    points = solid.vertices
    if points is None:
        return solid_mesh(solid.shape)
    hull = _convex_hull(points)
    if hull is None:
        return TriangleMesh(points, np.zeros((0, 3), np.int32))
    faces = hull.simplices.astype(np.int32)
    a, b, c = (points[faces[:, k]] for k in range(3))
    # Corners are in counterclockwise order when viewed from outside.
    inward = np.einsum("ka,ka->k", np.cross(b - a, c - a), hull.equations[:, :3]) < 0
    faces[inward] = faces[inward][:, ::-1]
    return TriangleMesh(points, faces)


# -- distances -------------------------------------------------------------------------------------


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


# -- distances between rounded boxes ---------------------------------------------------------------


def support(box: RoundedBox, R: Array, directions: Array) -> Array:
    """Return the points (N, 3) of a box, rotated by R, that lie farthest in directions (N, 3)."""
    axes = R @ box.pose.R
    corner = box.half * np.sign(np.round(np.einsum("nba,nb->na", axes, directions), 9))
    of_core = np.einsum("nab,nb->na", axes, corner)
    return np.asarray(R @ box.pose.r + of_core + box.radius * directions)


def widest_gaps(
    first: RoundedBox, R_1: Array, r_1: Array, second: RoundedBox, R_2: Array, r_2: Array
) -> tuple[Array, Array]:
    """Return lower bounds (N,) on the distances between two rounded boxes, m (negative: penetration
    depths), and the directions (N, 3) that attain them, from first to second.

    Parameters
    ----------
    first, second
        The rounded boxes, in their link frames.
    R_1, r_1, R_2, r_2
        Poses of these link frames in a common frame: attitudes (N, 3, 3), and positions (N, 3), m.
    """
    c_1, c_2 = r_1 + R_1 @ first.pose.r, r_2 + R_2 @ second.pose.r
    A, B = R_1 @ first.pose.R, R_2 @ second.pose.R
    radii = first.radius + second.radius
    between = c_2 - c_1
    edges = np.cross(A[:, :, :, np.newaxis], B[:, :, np.newaxis, :], axis=1).reshape(-1, 3, 9)
    lengths = np.linalg.norm(edges, axis=1, keepdims=True)
    parallel = lengths[:, 0] < _PARALLEL_TOLERANCE
    edges = edges / np.where(lengths < _PARALLEL_TOLERANCE, 1.0, lengths)
    axes = np.concatenate([A, B, edges], axis=2)

    def gaps(directions: Array) -> Array:
        """Return the gaps (N, k) of the boxes projected onto unit vectors (N, 3, k)."""
        apart = np.abs(np.einsum("na,nak->nk", between, directions))
        for R, half in ((A, first.half), (B, second.half)):
            apart = apart - np.einsum("a,nak->nk", half, np.abs(np.swapaxes(R, 1, 2) @ directions))
        return np.asarray(apart)

    found = gaps(axes)
    found[:, 6:][parallel] = -np.inf
    widest = found.argmax(axis=1)
    rows = np.arange(len(found))
    best, directions = found[rows, widest], axes[rows, :, widest]
    apart = best > 0
    if apart.any():
        x, y = _nearest_points(c_1, A, c_2, B, first.half, second.half)
        nearest = (y - x) / np.maximum(np.linalg.norm(y - x, axis=1, keepdims=True), 1e-300)
        cores = np.where(apart, gaps(nearest[:, :, np.newaxis])[:, 0], -np.inf)
        directions = np.where((cores > best)[:, np.newaxis], nearest, directions)
        best = np.maximum(best, cores)
    toward = np.where(np.einsum("na,na->n", between, directions) < 0, -1.0, 1.0)
    return np.asarray(best - radii), directions * toward[:, np.newaxis]


def nearest_points(
    first: RoundedBox, R_1: Array, r_1: Array, second: RoundedBox, R_2: Array, r_2: Array
) -> Array:
    """Return the points (N, 3) on the second core that are approximately nearest to the first box.

    Parameters are as in :func:`widest_gaps`.
    """
    c_1, c_2 = r_1 + R_1 @ first.pose.r, r_2 + R_2 @ second.pose.r
    cores = R_1 @ first.pose.R, R_2 @ second.pose.R
    return _nearest_points(c_1, cores[0], c_2, cores[1], first.half, second.half)[1]


def _nearest_points(
    c_1: Array, A: Array, c_2: Array, B: Array, a: Array, b: Array
) -> tuple[Array, Array]:
    """Return approximately the nearest points (N, 3) of two boxes, by alternating projections."""
    x, y = c_1, c_2
    for _ in range(_MAX_PROJECTIONS):
        x = _projected(y, c_1, A, a)
        y = _projected(x, c_2, B, b)
    return x, y


def _projected(points: Array, c: Array, R: Array, half: Array) -> Array:
    local = np.clip(np.einsum("nba,nb->na", R, points - c), -half, half)
    return np.asarray(c + np.einsum("nab,nb->na", R, local))
