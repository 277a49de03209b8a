"""Triangles of a robot: its visuals for pictures, pages and the viewer, and the meshes among them.

:func:`shape_mesh` returns the triangles of a mesh in its link frame::

    for link in robot.links:
        for shape in link.shapes:
            if shape.kind == "mesh":
                mesh = shape_mesh(shape, most=20_000)   # MeshError: a message for the user
                draw(mesh.vertices, mesh.faces, shape.rgba)

STL and OBJ are read here; COLLADA, glTF and PLY are read by trimesh, if it is installed. Files,
including those in bags, may be untrusted: sizes are bounded, and messages do not quote file
content.

Colours, cameras and backgrounds are chosen where visuals are drawn. Meshes come from files
(:func:`meshes_from_files`) or from a bag (:func:`meshes_from_attachments`), to which a recorder
adds the result of :func:`meshes_for_bag`; :func:`with_attached_meshes` writes them back to files.
"""

from __future__ import annotations

import hashlib
import itertools
import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from spacerobot_ros.errors import MeshError, reason
from spacerobot_ros.files import read_regular
from spacerobot_ros.model.description import Array, Pose, RobotDescription, Shape
from spacerobot_ros.model.urdf import mesh_file, with_mesh_files

_MAX_MESH_BYTES = 100_000_000
_MAX_TRIANGLES = 2_000_000

_STL_HEADER_BYTES = 84
"""Header size of a binary STL file, bytes: 80 bytes of text, followed by the number of
triangles."""

_STL_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])

_STL_VERTEX_PATTERN = re.compile(rb"^\s*vertex\s+(\S+)\s+(\S+)\s+(\S+)\s*$", re.MULTILINE)

_TRIMESH_SUFFIXES = (".dae", ".glb", ".gltf", ".ply")

Faces = npt.NDArray[np.int32]

_FACETS_AROUND = 24

_ROD_THICKNESS_RATIO = 0.05
"""Ratio of thickness to length below which a box is treated as a rod, which is drawn as a line."""

_SHARP_EDGE_COSINE = math.cos(math.radians(30.0))
_MAX_FACES_IN_BAG = 20_000
"""Largest number of mesh faces in a bag: 1 MB."""

_BALL_RADIUS, _BAR_RADIUS = 0.05, 0.02
"""Radii of the balls and bars that represent the links and joints of a robot without visuals, m."""

_BOX_CORNERS = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
_BOX_FACES = (
    *((0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1)),
    *((2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)),
)


@dataclass(frozen=True)
class TriangleMesh:
    """Triangles: ``vertices`` (N, 3) in m, ``faces`` (M, 3) of vertex indices.

    Face corners keep their order in the file, normally counter-clockwise viewed from outside.
    """

    vertices: Array
    faces: Faces

    def moved(self, pose: Pose, scale: tuple[float, ...] = (1.0, 1.0, 1.0)) -> TriangleMesh:
        """Return the mesh, scaled along its axes and placed at ``pose``.

        If the scale mirrors the mesh, faces are reversed so that normals still point outward.
        """
        vertices = (self.vertices * np.asarray(scale)) @ pose.R.T + pose.r
        faces = self.faces if np.prod(scale) >= 0 else self.faces[:, ::-1]
        return TriangleMesh(vertices, np.ascontiguousarray(faces))

    def coarsened(self, most: int) -> TriangleMesh:
        """Return a simplified mesh of at most ``most`` faces.

        Vertices in the same grid cell are replaced by their mean, and zero-area faces are
        removed. The cells are cubes, obtained by halving the bounding cube as often as ``most``
        allows.
        """
        if len(self.faces) <= most:
            return self
        low = self.vertices.min(axis=0)
        size = float(np.ptp(self.vertices, axis=0).max()) or 1.0
        coarse = TriangleMesh(self.vertices[:1], np.zeros((0, 3), np.int32))
        for cells in (2**power for power in range(1, 12)):
            cell = np.floor((self.vertices - low) * (cells / size)).astype(np.int64)
            key = (cell[:, 0] * (cells + 1) + cell[:, 1]) * (cells + 1) + cell[:, 2]
            _, inverse, count = np.unique(key, return_inverse=True, return_counts=True)
            mean = np.stack(
                [np.bincount(inverse, self.vertices[:, axis]) / count for axis in range(3)], axis=1
            )
            faces = _without_degenerate_faces(inverse[self.faces].astype(np.int32))
            faces = faces[np.unique(np.sort(faces, axis=1), axis=0, return_index=True)[1]]
            if len(faces) > most:
                break
            coarse = TriangleMesh(mean, faces)
        return coarse


def shape_mesh(shape: Shape, most: int = _MAX_TRIANGLES) -> TriangleMesh:
    """Return the triangles of a URDF mesh in its link frame, with origin and scale applied.

    Parameters
    ----------
    shape
        A visual of kind ``mesh``.
    most
        A mesh with more faces is simplified (:meth:`TriangleMesh.coarsened`).

    Raises
    ------
    MeshError
        The file is not found or cannot be read.
    """
    path = mesh_file(shape.resource)
    if path is None:
        raise MeshError(
            f"The mesh '{shape.resource}' was not found: give a path relative to the URDF, or "
            "source the workspace of its package."
        )
    return read_mesh(path).coarsened(most).moved(shape.pose, shape.size)


def read_mesh(path: str | Path) -> TriangleMesh:
    """Read the triangles in a file, in the file's frame and unit (COLLADA: in m).

    Raises
    ------
    MeshError
        The file is too large or damaged, or has an unsupported format.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in (".stl", ".obj", *_TRIMESH_SUFFIXES):
        raise MeshError(
            f"The mesh {path} has an unsupported format (not STL, OBJ, COLLADA, glTF or PLY): "
            "convert it to STL."
        )
    try:
        if (size := path.stat().st_size) > _MAX_MESH_BYTES:
            raise MeshError(
                f"The mesh {path} is {size / 1e6:.0f} MB; at most "
                f"{_MAX_MESH_BYTES / 1e6:.0f} MB are read. Make it coarser."
            )
        data = read_regular(path)
    except OSError as error:
        raise MeshError(f"The mesh {path} cannot be read: {reason(error)}.") from error
    readers = {".stl": _read_stl, ".obj": _read_obj}
    return _sound_mesh(readers.get(suffix, partial(_read_by_trimesh, path)), data, str(path))


def mesh_of_stl(data: bytes, name: str) -> TriangleMesh:
    """Read triangles from STL bytes, such as an attachment of a bag.

    Raises
    ------
    MeshError
        The mesh is damaged or too large; the message refers to it by ``name``.
    """
    return _sound_mesh(_read_stl, data, name)


def stl_of(mesh: TriangleMesh) -> bytes:
    """Return a mesh as binary STL (unitless, seven digits of precision)."""
    corners = mesh.vertices[mesh.faces]
    made = np.zeros(len(corners), _STL_TRIANGLE)
    made["corners"] = corners
    a, b, c = np.moveaxis(corners, 1, 0)
    normals = np.cross(b - a, c - a)
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    made["normal"] = normals / np.maximum(lengths, 1e-300)
    return bytes(80) + len(made).to_bytes(4, "little") + made.tobytes()


class _DamagedError(Exception):
    """The content of a mesh file is damaged; the text is a clause."""


def _sound_mesh(read: Callable[[bytes], TriangleMesh], data: bytes, name: str) -> TriangleMesh:
    """Read a mesh without faces of zero area; reject invalid coordinates and indices."""
    try:
        mesh = read(data)
        vertices, faces = mesh.vertices, mesh.faces
        if len(faces) > _MAX_TRIANGLES:
            most = f"at most {_MAX_TRIANGLES} are read"
            raise _DamagedError(f"it has {len(faces)} triangles, and {most}")
        if not np.isfinite(vertices).all():
            raise _DamagedError("a coordinate is not finite")
        if faces.size and (faces.min() < 0 or faces.max() >= len(vertices)):
            raise _DamagedError("a face refers to a missing vertex")
        faces = _without_degenerate_faces(faces)
        if not len(faces):
            raise _DamagedError("it has no triangle")
    except _DamagedError as error:
        raise MeshError(f"The mesh {name} cannot be read: {error}.") from error
    except (ValueError, IndexError, OverflowError) as error:
        # The text of a parse error would quote the file.
        why = "a coordinate or index is not a number"
        raise MeshError(f"The mesh {name} cannot be read: {why}.") from error
    return TriangleMesh(vertices, faces)


def _without_degenerate_faces(faces: Faces) -> Faces:
    a, b, c = faces.T
    return faces[(a != b) & (b != c) & (c != a)]


def _read_stl(data: bytes) -> TriangleMesh:
    """Read STL; the file is binary if its header states its length, otherwise text."""
    if len(data) >= _STL_HEADER_BYTES:
        count = int.from_bytes(data[80:_STL_HEADER_BYTES], "little")
        if len(data) >= _STL_HEADER_BYTES + count * _STL_TRIANGLE.itemsize and (
            not data[:80].lstrip().startswith(b"solid")
            or len(data) == _STL_HEADER_BYTES + count * _STL_TRIANGLE.itemsize
        ):
            triangles = np.frombuffer(data, _STL_TRIANGLE, count, _STL_HEADER_BYTES)
            return mesh_from_corners(triangles["corners"].reshape(-1, 3))
    if not data.lstrip().startswith(b"solid"):
        raise _DamagedError("it is not an STL file, or it is truncated")
    if b"endsolid" not in data:
        raise _DamagedError("the file is truncated")
    corners = np.array(_STL_VERTEX_PATTERN.findall(data), dtype=bytes).astype(float)
    if len(corners) % 3:
        raise _DamagedError("a triangle does not have three corners")
    return mesh_from_corners(corners.reshape(-1, 3))


def mesh_from_corners(corners: npt.NDArray[Any]) -> TriangleMesh:
    """Return a mesh from triangle corners (3 M, 3); identical corners are merged."""
    if not len(corners):
        return TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), np.int32))
    # Adding 0.0 turns -0.0 into 0.0, so that equal numbers have equal bytes.
    rows = np.ascontiguousarray(corners + 0.0)
    keys = rows.view(np.dtype((np.void, rows.dtype.itemsize * 3))).ravel()
    _, first, inverse = np.unique(keys, return_index=True, return_inverse=True)
    return TriangleMesh(rows[first].astype(float), inverse.reshape(-1, 3).astype(np.int32))


def _read_obj(data: bytes) -> TriangleMesh:
    """Read vertices and faces of OBJ; a polygonal face becomes a fan of triangles."""
    corners: list[tuple[float, float, float]] = []
    faces: list[tuple[int, int, int]] = []
    for line in data.replace(b"\\\n", b" ").replace(b"\\\r\n", b" ").splitlines():
        words = line.split()
        if not words:
            continue
        if words[0] == b"v":
            corners.append((float(words[1]), float(words[2]), float(words[3])))
        elif words[0] == b"f":
            # Corners are v/vt/vn; files count from 1, or from the last -1.
            numbers = [int(word.split(b"/")[0]) for word in words[1:]]
            face = [each - 1 if each > 0 else len(corners) + each for each in numbers]
            faces += [(face[0], a, b) for a, b in itertools.pairwise(face[1:])]
    vertices = np.array(corners, dtype=float).reshape(-1, 3)
    # A corner that does not exist is refused later; NumPy 1 would wrap a large number.
    checked = np.array(faces, dtype=np.int64).clip(-1, len(corners))
    return TriangleMesh(vertices, checked.astype(np.int32).reshape(-1, 3))


def _read_by_trimesh(path: Path, data: bytes) -> TriangleMesh:
    # trimesh takes a second to import, and few robots need it.
    try:
        import trimesh

        if path.suffix.lower() == ".dae":
            import collada  # noqa: F401  # Used by trimesh to read COLLADA
    except ImportError:
        raise MeshError(
            f"The mesh {path} requires trimesh, which is not installed: "
            "`pip install '.[viewer]'` in the clone, or convert it to STL."
        ) from None
    load: Callable[..., Any] = trimesh.load
    try:
        found = load(path, force="mesh", process=False, skip_materials=True)
        vertices = np.asarray(found.vertices, dtype=float).reshape(-1, 3)
        faces = np.asarray(found.faces, dtype=np.int32).reshape(-1, 3)
    except Exception as error:  # Each trimesh parser raises its own exceptions.
        raise _DamagedError(f"trimesh raised {type(error).__name__}") from error
    # COLLADA files may use a unit other than the metre.
    unit = re.search(rb"<unit\b[^>]*\bmeter\s*=\s*[\"']([^\"']+)[\"']", data)
    scale = float(unit[1]) if unit is not None and path.suffix.lower() == ".dae" else 1.0
    return TriangleMesh(vertices * scale, faces)


# -- visuals -------------------------------------------------------------------------------------


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
            _BOX_CORNERS * (high - low) / 2 + (low + high) / 2, np.array(_BOX_FACES)
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
            mesh = TriangleMesh(_BOX_CORNERS * np.array(shape.size) / 2, np.array(_BOX_FACES))
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
