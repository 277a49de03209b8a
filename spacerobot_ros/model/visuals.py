"""What a robot looks like, for whatever draws it: triangles of every visual, and its sharp edges.

Pictures, pages and viewers choose colours, cameras and backgrounds; which solid or mesh is where is
here. Meshes travel in bags as :func:`carried_meshes` makes them, and come from there again by
:func:`meshes_in`, or as files by :class:`MeshFolder`; on the machine of the robot,
:func:`~spacerobot_ros.model.meshes.shape_mesh` reads their files.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from spacerobot_ros.errors import MeshError
from spacerobot_ros.model.description import Array, Pose, RobotDescription, Shape
from spacerobot_ros.model.meshes import (
    TriangleMesh,
    joined,
    mesh_file,
    mesh_of_stl,
    shape_mesh,
    stl_of,
    with_mesh_files,
)

_AROUND = 24
"""Facets around a cylinder or sphere."""

_ROD = 0.05
"""Thinner than this part of its length, a box is a rod: without edges, its outline a line."""

_SHARP = math.cos(math.radians(30.0))
_CARRIED = 20_000
"""Faces of a mesh that is carried in a bag: 1 MB."""

_BOX = (
    *((0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1)),
    *((2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)),
)


@dataclass(frozen=True)
class Edges:
    """Lines (K, 2, 3), and the normals of the two faces beside each (K, 2, 3)."""

    lines: Array
    normals: Array


@dataclass(frozen=True)
class Visual:
    """One solid or mesh of a robot.

    Attributes
    ----------
    link
        The link that it belongs to.
    body
        Number of the moving body that the link is a part of; 0: the base.
    shape
        What the URDF says of it.
    mesh
        Its triangles in the frame of the link.
    """

    link: str
    body: int
    shape: Shape
    mesh: TriangleMesh

    @cached_property
    def edges(self) -> Edges:
        """Its sharp edges in the frame of the link; none where it is too thin to draw them."""
        none = np.empty((0, 2, 3))
        return Edges(none, none) if self.is_rod else sharp_edges(self.mesh)

    @property
    def is_rod(self) -> bool:
        """Whether it is a box too thin to draw its edges."""
        size = sorted(self.shape.size)
        return self.shape.kind == "box" and size[1] < _ROD * size[2]

    @property
    def outline(self) -> Array:
        """Lines (K, 2, 3) in the frame of the link that show it without hiding things behind it."""
        shape = self.shape
        if self.is_rod:
            longest = int(np.argmax(shape.size))
            ends = np.outer([-0.5, 0.5], np.eye(3)[longest] * shape.size[longest])
            return (ends @ shape.pose.R.T + shape.pose.r)[np.newaxis]
        if len(self.edges.lines):
            return self.edges.lines
        low, high = self.mesh.vertices.min(axis=0), self.mesh.vertices.max(axis=0)
        around = TriangleMesh(_corners() * (high - low) / 2 + (low + high) / 2, np.array(_BOX))
        return sharp_edges(around).lines


def visuals_of(
    robot: RobotDescription, meshes: Mapping[str, TriangleMesh], most: int
) -> tuple[Visual, ...]:
    """Return all visuals of a robot that can be drawn.

    Parameters
    ----------
    robot
        The robot.
    meshes
        Triangles of meshes by their URIs, in their own frames. Meshes that are not there are left
        out.
    most
        Faces that a mesh has at most: finer ones are made coarser.
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
    return tuple(found)


def solid_mesh(shape: Shape) -> TriangleMesh:
    """Return the triangles of a box, a cylinder or a sphere in the frame of its link."""
    match shape.kind:
        case "box":
            mesh = TriangleMesh(_corners() * np.array(shape.size) / 2, np.array(_BOX))
        case "cylinder":
            radius, length = shape.size
            mesh = _turned([0.0, radius, radius, 0.0], np.repeat([-length / 2, length / 2], 2))
        case _:
            polar = np.linspace(-np.pi / 2, np.pi / 2, _AROUND // 2 + 1)
            radii = shape.size[0] * np.cos(polar)
            radii[[0, -1]] = 0.0
            mesh = _turned(radii.tolist(), shape.size[0] * np.sin(polar))
    return mesh.moved(shape.pose)


def _corners() -> Array:
    return np.array(list(itertools.product((-1.0, 1.0), repeat=3)))


def _turned(radii: list[float], heights: Array) -> TriangleMesh:
    """Return the surface that a profile in the plane of x and z makes, turned about z."""
    angles = np.linspace(0.0, 2 * np.pi, _AROUND, endpoint=False)
    circle = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(_AROUND)])
    rings = [r * circle + [0.0, 0.0, z] for r, z in zip(radii, heights, strict=True)]
    corners = []
    for (low, r), (high, s) in itertools.pairwise(zip(rings, radii, strict=True)):
        low_next, high_next = np.roll(low, -1, axis=0), np.roll(high, -1, axis=0)
        if r > 0:
            corners.append(np.stack([low, low_next, high_next], axis=1))
        if s > 0:
            corners.append(np.stack([low, high_next, high], axis=1))
    return joined(np.concatenate(corners).reshape(-1, 3))


def sharp_edges(mesh: TriangleMesh) -> Edges:
    """Return the edges of a mesh at which its surface turns by more than 30 degrees, or ends."""
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
    sharp = (count != 2) | (np.einsum("ij,ij->i", beside[:, 0], beside[:, 1]) < _SHARP)
    return Edges(mesh.vertices[pairs[first[sharp]]], beside[sharp])


# -- meshes in bags -----------------------------------------------------------------------------

_PREFIX = "mesh/"


def carried_meshes(robot: RobotDescription) -> dict[str, bytes]:
    """Return the meshes of a robot for a bag: names of attachments, and STL of at most 1 MB each.

    Those whose files are not found or cannot be read are left out.
    """
    found = {}
    for resource in _resources(robot):
        try:
            mesh = shape_mesh(Shape("mesh", (1.0,) * 3, Pose(), resource=resource), _CARRIED)
        except MeshError:
            continue
        found[f"{_PREFIX}{resource}"] = stl_of(mesh)
    return found


def meshes_in(robot: RobotDescription, attachments: Mapping[str, bytes]) -> dict[str, TriangleMesh]:
    """Return the meshes of a robot that are among the attachments of a bag, by their URIs.

    No file is read: a bag that a stranger has written names whatever it likes.
    """
    found = {}
    for resource in _resources(robot):
        try:
            data = attachments[f"{_PREFIX}{resource}"]
            found[resource] = mesh_of_stl(data, resource)
        except (KeyError, MeshError):
            continue
    return found


class MeshFolder:
    """A folder with meshes of bags that are not on this machine, for programs that read files.

    Parameters
    ----------
    attachments
        Of the bag, as :func:`carried_meshes` makes them.

    Raises
    ------
    OSError
        There is no room for a folder.
    """

    def __init__(self, attachments: Mapping[str, bytes]) -> None:
        self._attachments = attachments
        self._folder = TemporaryDirectory(prefix="spacerobot_")
        self._files: dict[str, Path | None] = {}

    def described(self, urdf: str) -> str:
        """Return the text of a URDF with the files of the meshes that only the bag has.

        Those that are found on this machine, or that the bag does not carry, keep their names.
        """
        return with_mesh_files(urdf, self._file)

    def _file(self, resource: str) -> Path | None:
        if resource not in self._files:
            self._files[resource] = self._written(resource)
        return self._files[resource]

    def _written(self, resource: str) -> Path | None:
        data = self._attachments.get(f"{_PREFIX}{resource}")
        if data is None or mesh_file(resource) is not None:
            return None
        try:
            mesh = mesh_of_stl(data, resource).coarsened(_CARRIED)
        except MeshError:
            return None
        # Its name is none of the bag's, and what is written is what was understood.
        path = Path(self._folder.name, f"{len(self._files)}.stl")
        path.write_bytes(stl_of(mesh))
        return path

    def close(self) -> None:
        """Remove the folder."""
        self._folder.cleanup()


def carries_meshes(attachments: Mapping[str, bytes]) -> bool:
    """Whether a mesh is among the attachments of a bag."""
    return any(name.startswith(_PREFIX) for name in attachments)


def _resources(robot: RobotDescription) -> list[str]:
    """Return the URIs of all meshes, each once."""
    shapes = (shape for link in robot.links for shape in link.shapes if shape.kind == "mesh")
    return list(dict.fromkeys(shape.resource for shape in shapes))
