"""Pictures of a robot: the solids of its URDF in a parallel projection, hidden surfaces removed."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.colors import to_hex, to_rgb

from spacerobot_ros.model.description import Array, Pose, RobotDescription
from spacerobot_ros.model.kinematics import ForwardKinematics
from spacerobot_ros.model.meshes import TriangleMesh
from spacerobot_ros.model.visuals import Visual, visuals_of
from spacerobot_ros.report.figures import colour

Image = npt.NDArray[np.float32]

_OVERSAMPLING = 2
_EDGE_WIDTH = 3
"""Width of an edge, in pixels before averaging."""

_MIN_FACING_COSINE = 1e-6


@dataclass(frozen=True)
class Face:
    """A convex flat polygon (k, 3) in the world with its outward normal (3,) and its colour."""

    corners: Array
    normal: Array
    fill: tuple[float, float, float]


@dataclass(frozen=True)
class Edge:
    """A line (k, 3) in the world, visible if one of the two faces beside it is.

    ``normals`` (k - 1, 2, 3) are those of the faces; a line without normals is always visible.
    """

    line: Array
    normals: Array
    fill: tuple[float, float, float]


class View:
    """A parallel projection from azimuth and elevation (deg): world points to the paper."""

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
        """Return points (..., 3) on the paper (..., 2)."""
        return np.asarray(points @ self.paper_axes.T)

    def shade(self, face: Face) -> Array:
        """Return the colour of a face under the light of this view."""
        return np.array(face.fill) * (0.72 + 0.28 * max(float(face.normal @ self._light), 0.0))


class Canvas:
    """Pixels over a rectangle of the paper, ``low`` to ``high`` (2,) in m.

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

    def draw(self, faces: list[Face], edges: list[Edge]) -> None:
        """Draw faces, and over them the edges that no face hides."""
        for face in faces:
            if face.normal @ self._view.viewing_direction > _MIN_FACING_COSINE:
                self._fill_face(face)
        for edge in edges:
            self._draw_edge(edge)

    def image(self) -> Image:
        """Return the picture (rows, columns, 4), the top row first, transparent where empty."""
        n = _OVERSAMPLING
        total = sum(self._pixels[i::n, j::n] for i in range(n) for j in range(n))
        image = np.asarray(total, np.float32)
        image[..., :3] /= np.maximum(image[..., 3:], 1.0)
        image[..., 3] /= n * n
        return image[::-1]

    def _to_pixels(self, points: Array) -> Array:
        """World points (k, 3) to column, row and nearness (k, 3)."""
        at = (self._view(points) - self._low) * self._scale
        return np.column_stack([at, points @ self._view.viewing_direction])

    def _fill_face(self, face: Face) -> None:
        corners = self._to_pixels(face.corners)
        rows, columns = self._depth.shape
        bottom = max(math.ceil(float(corners[:, 1].min()) - 0.5), 0)
        top = min(math.floor(float(corners[:, 1].max()) - 0.5) + 1, rows)
        if bottom >= top:
            return
        # A convex face covers one run of pixels in each row.
        y = np.arange(bottom, top) + 0.5
        left, right = np.full(len(y), np.inf), np.full(len(y), -np.inf)
        for (ax, ay, _), (bx, by, _) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            if ay != by:
                met = (y >= min(ay, by)) & (y <= max(ay, by))
                x = ax + (y[met] - ay) * ((bx - ax) / (by - ay))
                left[met] = np.minimum(left[met], x)
                right[met] = np.maximum(right[met], x)
        first = np.ceil(np.clip(left - 0.5, 0, columns)).astype(int)
        last = np.floor(np.clip(right - 0.5, -1, columns - 1)).astype(int)
        counts = np.maximum(last - first + 1, 0)
        row = np.repeat(np.arange(bottom, top), counts)
        column = np.arange(len(row)) - np.repeat(np.cumsum(counts) - counts - first, counts)
        depth = self._face_depth(face, column + 0.5, row + 0.5)
        nearer = depth > self._depth[row, column]
        row, column = row[nearer], column[nearer]
        self._depth[row, column] = depth[nearer]
        self._pixels[row, column] = [*self._view.shade(face), 1.0]

    def _face_depth(self, face: Face, x: npt.NDArray[Any], y: npt.NDArray[Any]) -> Array:
        """Nearness of the plane of a face at places in pixels."""
        across, up = self._view.paper_axes @ face.normal
        offset = float(face.normal @ face.corners[0]) - self._low @ (across, up)
        depth = offset - (across * x + up * y) / self._scale
        return np.asarray(depth / float(face.normal @ self._view.viewing_direction))

    def _draw_edge(self, edge: Edge) -> None:
        at = self._to_pixels(edge.line)
        # An edge lies in the faces beside it and is drawn a little nearer.
        at[:, 2] += 2.0 * _EDGE_WIDTH / self._scale
        rows, columns = self._depth.shape
        brush = np.arange(_EDGE_WIDTH) - (_EDGE_WIDTH - 1) / 2
        offsets = np.stack(np.meshgrid(brush, brush), axis=-1).reshape(-1, 1, 2)
        for k in range(len(at) - 1):
            if (
                len(edge.normals)
                and not (edge.normals[k] @ self._view.viewing_direction > _MIN_FACING_COSINE).any()
            ):
                continue
            count = max(2, math.ceil(float(np.abs(at[k + 1, :2] - at[k, :2]).max())) + 1)
            points = np.linspace(at[k], at[k + 1], count)
            places = np.floor(points[:, :2] + offsets).astype(int).reshape(-1, 2)
            depth = np.tile(points[:, 2], len(offsets))
            known = ((places >= 0) & (places < (columns, rows))).all(axis=1)
            column, row = places[known].T
            seen = depth[known] > self._depth[row, column]
            self._pixels[row[seen], column[seen]] = [*edge.fill, 1.0]


_BASE_COLOUR = "#c4c9d2"
EDGE_COLOUR = "#3d4450"
MAX_MESH_FACES = 1500
"""Largest number of faces of a mesh: each is filled by itself."""

Colour = tuple[float, float, float]


@dataclass
class Solids:
    """Faces and edges in the world, as lists to draw."""

    faces: list[Face] = field(default_factory=list)
    edges: list[Edge] = field(default_factory=list)

    def __add__(self, other: Solids) -> Solids:
        """Return the faces and edges of both."""
        return Solids(self.faces + other.faces, self.edges + other.edges)

    def corner_points(self) -> Array:
        """All corners (k, 3)."""
        return np.concatenate([f.corners for f in self.faces] + [e.line for e in self.edges])

    def add(self, visual: Visual, pose: Pose, fill: Colour) -> None:
        """Add a visual whose link has a pose in the world."""
        corners = visual.mesh.vertices[visual.mesh.faces] @ pose.R.T + pose.r
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        lengths = np.linalg.norm(normals, axis=1)
        for triangle, normal, length in zip(corners, normals, lengths, strict=True):
            if length > 0:
                self.faces.append(Face(triangle, normal / length, fill))
        edges = visual.edges
        self.edges += [
            Edge(line, normals[np.newaxis], rgb(EDGE_COLOUR))
            for line, normals in zip(
                edges.lines @ pose.R.T + pose.r, edges.normals @ pose.R.T, strict=True
            )
        ]


class SolidRobot:
    """A robot with its visuals, for pictures of any pose.

    ``meshes`` are the triangles of its meshes by their URIs; ``obstacles`` stand still, each with
    the pose of its link in the world.
    """

    def __init__(
        self,
        robot: RobotDescription,
        meshes: Mapping[str, TriangleMesh],
        obstacles: Iterable[tuple[Visual, Pose]] = (),
    ) -> None:
        self.robot = robot
        self._visuals = visuals_of(robot, meshes, MAX_MESH_FACES)
        self.kinematics = ForwardKinematics(robot)
        self.surroundings = Solids()
        """Faces and edges of the obstacles."""
        for visual, pose in obstacles:
            self.surroundings.add(visual, pose, rgb(obstacle_color(visual)))

    def link_poses(self, q: Array, base: Pose) -> dict[str, Pose]:
        """Poses of all links in the world, at joint positions ``q`` (n,) and a pose of the base."""
        poses = zip(self.kinematics.links, *self.kinematics.link_poses(q), strict=True)
        return {link: base @ Pose(R, r) for link, R, r in poses}

    def at(self, q: Array, base: Pose) -> Solids:
        """Return the robot at joint positions ``q`` (n,), its base at a pose in the world."""
        poses = self.link_poses(q, base)
        solids = Solids()
        for visual in self._visuals:
            solids.add(visual, poses[visual.link], rgb(body_color(visual.body)))
        return solids

    def base_outlines(self, base: Pose) -> list[Array]:
        """Return the outlines of the base body as lines (k, 3) in the world."""
        lines = []
        for visual in self._visuals:
            if visual.body == 0:
                placed = base @ self.robot.frames[visual.link][1]
                lines += list(visual.outline @ placed.R.T + placed.r)
        return lines or _cross_lines(base)


def rgb(name: str) -> Colour:
    """Return a color as three shares."""
    r, g, b = to_rgb(name)
    return r, g, b


def obstacle_color(visual: Visual) -> str:
    """Return the color of an obstacle, ``#rrggbb``: that of its shape."""
    return to_hex(visual.shape.rgba[:3])


def body_color(body: int) -> str:
    """Return the color of the links of a moving body: that of its joint, grey on the base."""
    return _BASE_COLOUR if body == 0 else colour(body - 1)


def _cross_lines(pose: Pose) -> list[Array]:
    """Return a small cross (three lines), in place of a base without visuals."""
    return [pose.r + 0.1 * np.array([-axis, axis]) @ pose.R.T for axis in np.eye(3)]
