"""Flight scene: bodies with their solids, colours and poses over time, and pictures of them.

Pictures and the 3D view (:mod:`.player`) draw the same bodies; the live page draws
the same solids (:mod:`spacerobot_ros.model.meshes`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from matplotlib.colors import to_hex, to_rgb

from spacerobot_ros.model.description import Array, Pose, RobotDescription
from spacerobot_ros.model.meshes import TriangleMesh, Visual, visuals_of
from spacerobot_ros.model.rotations import matrix_from_quaternion, quaternion_from_matrix
from spacerobot_ros.report.figures import GHOST_COLOUR, colour
from spacerobot_ros.report.flight import FlightReport, continuous, link_poses

_BASE_COLOUR = "#c4c9d2"

_FLATNESS_STATES = 25
"""Number of states in which links are checked for motion in a horizontal plane."""


@dataclass(frozen=True, eq=False)
class Body:
    """A rigid body in the scene.

    Attributes
    ----------
    name
        Its unique name.
    visuals
        Solids of the body, in the body frame.
    poses
        World poses (K, 7) of the body at the scene instants, m and quaternion; (1, 7) if it is at
        rest.
    color
        ``#rrggbb``; empty if each solid has its own color.
    """

    name: str
    visuals: tuple[Visual, ...]
    poses: Array
    color: str = ""

    def color_of(self, visual: Visual) -> str:
        """Return the colour of a solid, ``#rrggbb``."""
        return self.color or to_hex(visual.shape.rgba[:3])


def robot_bodies(
    robot: RobotDescription, meshes: Mapping[str, TriangleMesh], base: Array, q: Array, most: int
) -> list[Body]:
    """Return the robot links that have solids, with the colours of the joints that move them.

    Parameters
    ----------
    robot
        The robot.
    meshes
        Triangles of its meshes, by URI.
    base, q
        (K, 7) base poses in the world, and (K, n) joint positions, m or rad.
    most
        Largest number of mesh faces.
    """
    visuals = visuals_of(robot, meshes, most)
    found = []
    for link, poses in link_poses(robot, base, q).items():
        solids = tuple(each for each in visuals if each.link == link)
        body = robot.frames[link][0]
        if solids:
            color = _BASE_COLOUR if body == 0 else colour(body - 1)
            found.append(Body(link, solids, poses, color))
    return found


def bodies_of(flight: FlightReport, rows: Sequence[int], most: int) -> list[Body]:
    """Return the robot and the target in a flight, at selected recorded states.

    ``most``: largest number of mesh faces.
    """
    assert flight.robot is not None
    at = np.asarray(rows)
    base = continuous(flight.pose)[at]
    found = robot_bodies(flight.robot, flight.meshes, base, flight.joints[at], most)
    target, seen = flight.target, flight.target_pose
    if target is not None and len(seen):
        times = np.searchsorted(seen.time, flight.time[at] - 1e-9)
        poses = continuous(seen.values)[np.minimum(times, len(seen) - 1)]
        solids = [_moved(x, target.frames[x.link][1]) for x in visuals_of(target, {}, most)]
        found.append(Body("target", tuple(solids), poses))
    return found


def obstacles_of(flight: FlightReport) -> list[Body]:
    """Return the obstacles around a robot, with the geometry used to measure distances."""
    return [
        Body(
            f"obstacle {number} {visual.link}",
            (visual,),
            np.concatenate([pose.r, quaternion_from_matrix(pose.R)])[np.newaxis],
        )
        for number, (visual, pose) in enumerate(flight.obstacles)
    ]


def goal_of_base(flight: FlightReport, most: int) -> Body | None:
    """Return a robot's base at its goal; None if the base has no goal.

    If the goal specifies only the attitude, the base is drawn at its last position.
    """
    goal, robot = flight.base_goal, flight.robot
    if goal is None or robot is None or not flight.controls("base"):
        return None
    position = goal.position if flight.position_counts else flight.pose[-1, :3]
    pose = np.concatenate([position, goal.quaternion])[np.newaxis]
    solids = tuple(
        _moved(each, robot.frames[each.link][1])
        for each in visuals_of(robot, flight.meshes, most)
        if each.body == 0
    )
    return Body("goal", solids, pose, GHOST_COLOUR)


def is_flat(flight: FlightReport) -> bool:
    """Whether every link of a robot stays in a plane z = const in the world."""
    bodies = bodies_of(flight, flight.samples(_FLATNESS_STATES), 1)
    poses = np.array([each.poses for each in bodies])
    # Tilt of the z axis: 1 - cos.
    tilt = 2 * (poses[..., 3] ** 2 + poses[..., 4] ** 2)
    return bool((tilt < 1e-9).all() and np.ptp(poses[..., 2], axis=1).max() < 1e-6)


def _moved(visual: Visual, frame: Pose) -> Visual:
    """Return a solid in the frame in which its link has the pose ``frame``."""
    shape = replace(visual.shape, pose=frame @ visual.shape.pose)
    return replace(visual, shape=shape, mesh=visual.mesh.moved(frame))


# -- pictures: parallel projection with hidden surfaces removed -----------------------------------

Image = npt.NDArray[np.float32]

EDGE_COLOUR = "#3d4450"
MAX_MESH_FACES = 1500
"""Largest number of mesh faces, since faces are filled one by one."""

_OVERSAMPLING = 2
_EDGE_WIDTH = 3
"""Edge width, in pixels before averaging."""

_MIN_FACING_COSINE = 1e-6
_MIN_FACE_AREA = 1e-6
"""Twice the smallest area of a face that is filled, pixels."""
_ROUNDING = 1e-9
"""Rounding of shares and of nearness, m: faces leave no gap at a common edge, and of faces in one
plane the first is visible."""


class PlacedSolid(NamedTuple):
    """A solid in the world.

    Attributes
    ----------
    corners, normals
        (F, 3, 3) triangle corners, and outward normals (F, 3).
    edges, edge_normals
        (E, 2, 3) ends of sharp edges, and normals (E, 2, 3) of the two adjacent faces; an edge is
        visible if one of these faces is visible.
    fill
        (3,) color: red, green and blue, 0 to 1.
    """

    corners: Array
    normals: Array
    edges: Array
    edge_normals: Array
    fill: Array


def placed_solids(bodies: Iterable[Body], instant: int) -> list[PlacedSolid]:
    """Return the solids of bodies in the world at the instant with the given index."""
    found = []
    for body in bodies:
        pose = body.poses[min(instant, len(body.poses) - 1)]
        R, r = matrix_from_quaternion(pose[3:]), pose[:3]
        for visual in body.visuals:
            corners = visual.mesh.vertices[visual.mesh.faces] @ R.T + r
            normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            lengths = np.linalg.norm(normals, axis=1, keepdims=True)
            real = lengths[:, 0] > 0
            edges = visual.edges
            found.append(
                PlacedSolid(
                    corners[real],
                    normals[real] / lengths[real],
                    edges.lines @ R.T + r,
                    edges.normals @ R.T,
                    np.array(to_rgb(body.color_of(visual))),
                )
            )
    return found


def corner_points(solids: Iterable[PlacedSolid]) -> Array:
    """Return all corners (k, 3) of solids."""
    return np.concatenate([np.zeros((0, 3)), *(each.corners.reshape(-1, 3) for each in solids)])


class View:
    """A parallel projection of world points onto the image plane, for a view from a given azimuth
    and elevation (deg)."""

    def __init__(self, azimuth: float = -58.0, elevation: float = 24.0) -> None:
        a, e = math.radians(azimuth), math.radians(elevation)
        self.viewing_direction = np.array(
            [math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)]
        )
        right = np.array([-math.sin(a), math.cos(a), 0.0])
        self.paper_axes = np.array([right, np.cross(self.viewing_direction, right)])
        light = self.viewing_direction + np.array([0.35, -0.1, 0.9])
        self._light = light / np.linalg.norm(light)

    def __call__(self, points: Array) -> Array:
        """Return the image plane coordinates (..., 2) of points (..., 3)."""
        return np.asarray(points @ self.paper_axes.T)

    def shade(self, fill: Array, normal: Array) -> Array:
        """Return the colour (3,) of a face with an outward normal under the light of the view."""
        return fill * (0.72 + 0.28 * max(float(normal @ self._light), 0.0))


class Canvas:
    """Pixels over a rectangle in the image plane, ``low`` to ``high`` (2,) in m.

    Parameters
    ----------
    view
        The projection.
    low, high
        Corners of the rectangle.
    width
        Pixels across.
    """

    def __init__(self, view: View, low: Array, high: Array, width: int) -> None:
        self._view = view
        self._low = low
        self._scale = width * _OVERSAMPLING / float(high[0] - low[0])
        rows = round(width * float(high[1] - low[1]) / float(high[0] - low[0]))
        size = (rows * _OVERSAMPLING, width * _OVERSAMPLING)
        self._depth = np.full(size, -np.inf)
        self._pixels = np.zeros((*size, 4), np.float32)

    def draw(self, solids: Sequence[PlacedSolid]) -> None:
        """Draw the faces of solids, then the edges that are not hidden."""
        for solid in solids:
            for corners, normal in zip(solid.corners, solid.normals, strict=True):
                if normal @ self._view.viewing_direction > _MIN_FACING_COSINE:
                    self._fill_face(corners, self._view.shade(solid.fill, normal))
        for solid in solids:
            # An edge is visible if one of the adjacent faces is.
            seen = solid.edge_normals @ self._view.viewing_direction > _MIN_FACING_COSINE
            for ends in solid.edges[seen.any(axis=1)]:
                self._draw_edge(ends)

    def draw_lines(self, lines: Iterable[Array], color: str) -> None:
        """Draw lines (2, 3) in the world on top of everything."""
        for ends in lines:
            self._draw_edge(ends, color, pixels_nearer=1e9)

    def image(self) -> Image:
        """Return the picture (rows, columns, 4), with the top row first and empty pixels
        transparent."""
        n = _OVERSAMPLING
        total = sum(self._pixels[i::n, j::n] for i in range(n) for j in range(n))
        image = np.asarray(total, np.float32)
        image[..., :3] /= np.maximum(image[..., 3:], 1.0)
        image[..., 3] /= n * n
        return image[::-1]

    def _to_pixels(self, points: Array) -> Array:
        """Convert world points (k, 3) to column, row and nearness (k, 3)."""
        at = (self._view(points) - self._low) * self._scale
        return np.column_stack([at, points @ self._view.viewing_direction])

    def _fill_face(self, face: Array, fill: Array) -> None:
        corners = self._to_pixels(face)
        ends = corners[:, :2].min(axis=0), corners[:, :2].max(axis=0)
        limits = np.array(self._depth.shape[::-1])
        (left, bottom), (right, top) = np.clip(np.round(ends), 0, limits).astype(int)
        triangle = np.vstack([corners[:, :2].T, np.ones(3)])
        if left >= right or bottom >= top or abs(np.linalg.det(triangle)) < _MIN_FACE_AREA:
            return
        x, y = np.arange(left, right) + 0.5, np.arange(bottom, top)[:, np.newaxis] + 0.5
        # Shares of the three corners at the centre of each pixel: the point is in the face unless
        # one is negative.
        weights = np.array([a * x + b * y + c for a, b, c in np.linalg.inv(triangle)])
        depth = np.tensordot(corners[:, 2], weights, axes=1)
        part = self._depth[bottom:top, left:right]
        shown = (weights >= -_ROUNDING).all(axis=0) & (depth > part + _ROUNDING)
        part[shown] = depth[shown]
        self._pixels[bottom:top, left:right][shown] = [*fill, 1.0]

    def _draw_edge(
        self, ends: Array, color: str = EDGE_COLOUR, pixels_nearer: float = 2.0 * _EDGE_WIDTH
    ) -> None:
        at = self._to_pixels(ends)
        # An edge lies in the adjacent faces and is drawn slightly nearer.
        at[:, 2] += pixels_nearer / self._scale
        rows, columns = self._depth.shape
        brush = np.arange(_EDGE_WIDTH) - (_EDGE_WIDTH - 1) / 2
        offsets = np.stack(np.meshgrid(brush, brush), axis=-1).reshape(-1, 1, 2)
        count = max(2, math.ceil(float(np.abs(at[1, :2] - at[0, :2]).max())) + 1)
        points = np.linspace(at[0], at[1], count)
        places = np.floor(points[:, :2] + offsets).astype(int).reshape(-1, 2)
        depth = np.tile(points[:, 2], len(offsets))
        known = ((places >= 0) & (places < (columns, rows))).all(axis=1)
        column, row = places[known].T
        seen = depth[known] > self._depth[row, column]
        self._pixels[row[seen], column[seen]] = [*to_rgb(color), 1.0]


def outlines(body: Body) -> list[Array]:
    """Return the outline of a body at its first instant as lines (2, 3) in the world.

    A body without solids is drawn as a small cross.
    """
    R, r = matrix_from_quaternion(body.poses[0, 3:]), body.poses[0, :3]
    lines = [line for visual in body.visuals for line in visual.outline]
    return [line @ R.T + r for line in lines or [0.1 * np.array([-x, x]) for x in np.eye(3)]]
