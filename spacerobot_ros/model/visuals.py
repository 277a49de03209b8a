"""Robot visuals as triangles and sharp edges, for pictures, pages and the viewer.

Colours, cameras and backgrounds are chosen there. Meshes come from files
(:func:`meshes_from_files`) or from a bag (:func:`meshes_from_attachments`), to which a recorder
adds the result of :func:`meshes_for_bag`; :func:`with_attached_meshes` writes them back to files.
"""

from __future__ import annotations

import hashlib
import itertools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from spacerobot_ros.errors import MeshError
from spacerobot_ros.model.description import Array, Pose, RobotDescription, Shape
from spacerobot_ros.model.meshes import (
    TriangleMesh,
    mesh_file,
    mesh_from_corners,
    mesh_of_stl,
    shape_mesh,
    stl_of,
    with_mesh_files,
)

_FACETS_AROUND = 24

_ROD_THICKNESS_RATIO = 0.05
"""Ratio of thickness to length below which a box is treated as a rod, which is drawn as a line."""

_SHARP_EDGE_COSINE = math.cos(math.radians(30.0))
_MAX_FACES_IN_BAG = 20_000
"""Largest number of mesh faces in a bag: 1 MB."""

_BALL_RADIUS, _BAR_RADIUS = 0.05, 0.02
"""Radii of the balls and bars that represent the links and joints of a robot without visuals, m."""

_BOX_FACES = (
    *((0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1)),
    *((2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)),
)


@dataclass(frozen=True)
class Edges:
    """Line segments (K, 2, 3), and the normals of the two faces adjacent to each segment (K, 2,
    3)."""

    lines: Array
    normals: Array


@dataclass(frozen=True)
class Visual:
    """A solid or mesh of a robot.

    Attributes
    ----------
    link
        Name of its link.
    body
        Index of the body that contains the link; 0 for the base.
    shape
        Its URDF description.
    mesh
        Triangles in the link frame.
    """

    link: str
    body: int
    shape: Shape
    mesh: TriangleMesh

    @cached_property
    def edges(self) -> Edges:
        """Sharp edges in the link frame; a rod has none."""
        none = np.empty((0, 2, 3))
        return Edges(none, none) if self.is_rod else sharp_edges(self.mesh)

    @property
    def is_rod(self) -> bool:
        """Whether the visual is a box too thin to show edges."""
        size = sorted(self.shape.size)
        return self.shape.kind == "box" and size[1] < _ROD_THICKNESS_RATIO * size[2]

    @property
    def outline(self) -> Array:
        """Outline of the visual in the link frame: line segments (K, 2, 3) that do not hide any
        other part."""
        shape = self.shape
        if self.is_rod:
            longest = int(np.argmax(shape.size))
            ends = np.outer([-0.5, 0.5], np.eye(3)[longest] * shape.size[longest])
            return (ends @ shape.pose.R.T + shape.pose.r)[np.newaxis]
        if len(self.edges.lines):
            return self.edges.lines
        low, high = self.mesh.vertices.min(axis=0), self.mesh.vertices.max(axis=0)
        around = TriangleMesh(
            _box_corners() * (high - low) / 2 + (low + high) / 2, np.array(_BOX_FACES)
        )
        return sharp_edges(around).lines


def visuals_of(
    robot: RobotDescription, meshes: Mapping[str, TriangleMesh], most: int
) -> tuple[Visual, ...]:
    """Return all drawable visuals of a robot.

    If the robot has no visuals, links are drawn as balls and joint offsets as bars.

    Parameters
    ----------
    robot
        The robot.
    meshes
        Mesh triangles by URI, in the mesh frames; other meshes are omitted.
    most
        Largest number of faces per mesh; finer meshes are simplified.
    """
    found = []
    for link in robot.links:
        body = robot.frames[link.name][0]
        for shape in link.shapes:
            mesh = None
            if shape.kind != "mesh":
                mesh = solid_mesh(shape)
            elif shape.resource in meshes:
                mesh = meshes[shape.resource].coarsened(most).moved(shape.pose, shape.size)
            if mesh is not None and len(mesh.faces):
                found.append(Visual(link.name, body, shape, mesh))
    return tuple(found) or _stand_in_visuals(robot)


def _stand_in_visuals(robot: RobotDescription) -> tuple[Visual, ...]:
    shapes = [(link.name, Shape("sphere", (_BALL_RADIUS,), Pose())) for link in robot.links]
    for joint in robot.joints:
        length = float(np.linalg.norm(joint.origin.r))
        if length > 1e-6:
            z = joint.origin.r / length
            x = np.cross(z, np.eye(3)[int(np.argmin(np.abs(z)))])
            x /= np.linalg.norm(x)
            pose = Pose(np.column_stack([x, np.cross(z, x), z]), joint.origin.r / 2)
            shapes.append((joint.parent, Shape("cylinder", (_BAR_RADIUS, length), pose)))
    return tuple(
        Visual(link, robot.frames[link][0], shape, solid_mesh(shape)) for link, shape in shapes
    )


def solid_mesh(shape: Shape) -> TriangleMesh:
    """Return the triangles of a box, cylinder, sphere or capsule in its link frame."""
    match shape.kind:
        case "box":
            mesh = TriangleMesh(_box_corners() * np.array(shape.size) / 2, np.array(_BOX_FACES))
        case "cylinder":
            radius, length = shape.size
            mesh = _surface_of_revolution(
                [0.0, radius, radius, 0.0], np.repeat([-length / 2, length / 2], 2)
            )
        case _:
            polar = np.linspace(-np.pi / 2, np.pi / 2, _FACETS_AROUND // 2 + 1)
            radii = shape.size[0] * np.cos(polar)
            radii[[0, -1]] = 0.0
            heights = shape.size[0] * np.sin(polar)
            if shape.kind == "capsule":
                equator, half = len(polar) // 2, shape.size[1] / 2
                radii = np.concatenate([radii[: equator + 1], radii[equator:]])
                heights = np.concatenate([heights[: equator + 1] - half, heights[equator:] + half])
            mesh = _surface_of_revolution(radii.tolist(), heights)
    return mesh.moved(shape.pose)


def _box_corners() -> Array:
    return np.array(list(itertools.product((-1.0, 1.0), repeat=3)))


def _surface_of_revolution(radii: list[float], heights: Array) -> TriangleMesh:
    """Return the surface of revolution of a profile in the x-z plane about z."""
    angles = np.linspace(0.0, 2 * np.pi, _FACETS_AROUND, endpoint=False)
    circle = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(_FACETS_AROUND)])
    rings = [r * circle + [0.0, 0.0, z] for r, z in zip(radii, heights, strict=True)]
    corners = []
    for (low, r), (high, s) in itertools.pairwise(zip(rings, radii, strict=True)):
        low_next, high_next = np.roll(low, -1, axis=0), np.roll(high, -1, axis=0)
        if r > 0:
            corners.append(np.stack([low, low_next, high_next], axis=1))
        if s > 0:
            corners.append(np.stack([low, high_next, high], axis=1))
    return mesh_from_corners(np.concatenate(corners).reshape(-1, 3))


def sharp_edges(mesh: TriangleMesh) -> Edges:
    """Return the mesh edges on its boundary or between faces that meet at over 30 degrees."""
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    normals = np.cross(b - a, c - a)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    pairs = np.sort(mesh.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    _, first, inverse, count = np.unique(
        pairs, axis=0, return_index=True, return_inverse=True, return_counts=True
    )
    last = np.zeros(len(first), np.int64)
    last[inverse.ravel()] = np.arange(len(pairs))
    beside = np.stack([normals[first // 3], normals[last // 3]], axis=1)
    sharp = (count != 2) | (np.einsum("ij,ij->i", beside[:, 0], beside[:, 1]) < _SHARP_EDGE_COSINE)
    return Edges(mesh.vertices[pairs[first[sharp]]], beside[sharp])


# -- meshes in bags -----------------------------------------------------------------------------

_ATTACHMENT_PREFIX = "mesh/"


def meshes_from_files(
    robot: RobotDescription, most: int, on_error: Callable[[str], None] = lambda message: None
) -> dict[str, TriangleMesh]:
    """Return a robot's meshes that can be read on this machine, by URI.

    Parameters
    ----------
    robot
        The robot.
    most
        Largest number of faces per mesh; finer meshes are simplified.
    on_error
        Function that is called with a message for each mesh that cannot be read.
    """
    found = {}
    for resource in _mesh_uris(robot):
        try:
            shape = Shape("mesh", (1.0,) * 3, Pose(), resource=resource)
            found[resource] = shape_mesh(shape, most)
        except MeshError as error:
            on_error(str(error))
    return found


def meshes_for_bag(robot: RobotDescription) -> dict[str, bytes]:
    """Return a robot's meshes for a bag, by attachment name, as STL files of at most 1 MB each."""
    meshes = meshes_from_files(robot, _MAX_FACES_IN_BAG)
    return {f"{_ATTACHMENT_PREFIX}{resource}": stl_of(mesh) for resource, mesh in meshes.items()}


def meshes_from_attachments(
    robot: RobotDescription, attachments: Mapping[str, bytes]
) -> dict[str, TriangleMesh]:
    """Return a robot's meshes that are attached to a bag, by URI.

    No file is read, because an untrusted bag may name any file on this machine.
    """
    found = {}
    for resource in _mesh_uris(robot):
        try:
            data = attachments[f"{_ATTACHMENT_PREFIX}{resource}"]
            found[resource] = mesh_of_stl(data, resource)
        except (KeyError, MeshError):
            continue
    return found


def with_attached_meshes(urdf: str, attachments: Mapping[str, bytes], folder: Path) -> str:
    """Return a URDF string in which meshes that exist only in a bag are replaced by files, for
    programs that read files; other meshes keep their names.

    Parameters
    ----------
    urdf
        The URDF string.
    attachments
        Bag attachments, as returned by :func:`meshes_for_bag`.
    folder
        Folder for the files.

    Raises
    ------
    OSError
        A file cannot be written.
    """

    def write_mesh(resource: str) -> Path | None:
        data = attachments.get(f"{_ATTACHMENT_PREFIX}{resource}")
        if data is None or mesh_file(resource) is not None:
            return None
        # Name and bytes are not copied from the bag, which may come from a stranger.
        path = folder / f"{hashlib.sha256(data).hexdigest()[:32]}.stl"
        try:
            if not path.is_file():
                path.write_bytes(stl_of(mesh_of_stl(data, resource).coarsened(_MAX_FACES_IN_BAG)))
        except MeshError:
            return None
        return path

    return with_mesh_files(urdf, write_mesh)


def _mesh_uris(robot: RobotDescription) -> list[str]:
    shapes = (shape for link in robot.links for shape in link.shapes if shape.kind == "mesh")
    return list(dict.fromkeys(shape.resource for shape in shapes))
