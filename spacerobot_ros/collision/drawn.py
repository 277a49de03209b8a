"""The solids of a robot and of obstacles as triangles, for pages and pictures."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from spacerobot_ros.collision.geometry import Solid, solids_of
from spacerobot_ros.model.description import Array, Pose, RobotDescription, Shape
from spacerobot_ros.model.meshes import TriangleMesh, shape_mesh
from spacerobot_ros.model.visuals import Visual, solid_mesh


def collision_visuals(
    robot: RobotDescription, mesh_of: Callable[[Shape], TriangleMesh] = shape_mesh
) -> tuple[Visual, ...]:
    """Return the solids whose distances count; a mesh is its convex hull, and one that cannot be
    read is left out.

    ``mesh_of`` is that of :class:`~spacerobot_ros.collision.geometry.CollisionGeometry`.
    """
    solids, _ = solids_of(robot, mesh_of)
    return tuple(Visual(each.link, each.body, each.shape, _mesh_of(each)) for each in solids)


def obstacle_visuals(
    world: RobotDescription | None, mesh_of: Callable[[Shape], TriangleMesh] = shape_mesh
) -> tuple[tuple[Visual, Pose], ...]:
    """Return the solids of obstacles by which distances are measured, each with the pose of its
    link in the world; None: there are none. ``mesh_of`` is that of :func:`collision_visuals`.
    """
    if world is None:
        return ()
    return tuple((each, world.frames[each.link][1]) for each in collision_visuals(world, mesh_of))


def _mesh_of(solid: Solid) -> TriangleMesh:
    if solid.vertices is None:
        return solid_mesh(solid.shape)
    return _hull_mesh(solid.vertices)


def _hull_mesh(points: Array) -> TriangleMesh:
    """Return the convex hull of points (V, 3), m; no faces where all lie in a plane."""
    # Slow to import, and few robots have meshes.
    from scipy.spatial import ConvexHull, QhullError

    try:
        hull = ConvexHull(points)
    except QhullError:
        return TriangleMesh(points, np.zeros((0, 3), np.int32))
    faces = hull.simplices.astype(np.int32)
    a, b, c = (points[faces[:, k]] for k in range(3))
    # Corners go round counterclockwise, seen from outside.
    inward = np.einsum("ka,ka->k", np.cross(b - a, c - a), hull.equations[:, :3]) < 0
    faces[inward] = faces[inward][:, ::-1]
    return TriangleMesh(points, faces)
