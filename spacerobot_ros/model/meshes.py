"""Meshes in a URDF: their files and triangles.

:func:`shape_mesh` returns the triangles of a visual in its link frame::

    for link in robot.links:
        for shape in link.shapes:
            if shape.kind == "mesh":
                mesh = shape_mesh(shape, most=20_000)   # MeshError: a message for the user
                draw(mesh.vertices, mesh.faces, shape.rgba)

STL and OBJ are read here; COLLADA, glTF and PLY are read by trimesh, if it is installed. Files,
including those in bags, may be untrusted: sizes are bounded, and messages do not quote file
content.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote, urlparse
from xml.etree.ElementTree import ParseError, tostring

import numpy as np
import numpy.typing as npt

from spacerobot_ros.errors import MeshError, reason
from spacerobot_ros.files import read_regular
from spacerobot_ros.model.description import Array, Pose, Shape, editable_root
from spacerobot_ros.model.xacro_files import package_around
from spacerobot_ros.resources import installed_share_directory, share_directory

_MAX_MESH_BYTES = 100_000_000
_MAX_TRIANGLES = 2_000_000

_STL_HEADER_BYTES = 84
"""Header size of a binary STL file, bytes: 80 bytes of text, followed by the number of
triangles."""

_STL_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])

_STL_VERTEX_PATTERN = re.compile(rb"^\s*vertex\s+(\S+)\s+(\S+)\s+(\S+)\s*$", re.MULTILINE)

_TRIMESH_SUFFIXES = (".dae", ".glb", ".gltf", ".ply")

Faces = npt.NDArray[np.int32]


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


def with_mesh_files(text: str, find: Callable[[str], Path | None]) -> str:
    """Return a URDF string with meshes referenced by ``file://`` URIs.

    Parameters
    ----------
    text
        URDF string; a string that is not XML is returned unchanged.
    find
        Function that returns the file for a mesh name in the URDF; None keeps the name.
    """
    try:
        root = editable_root(text)
    except (ParseError, ValueError):
        return text
    any_found = False
    for mesh in root.iter("mesh"):
        if found := find(mesh.get("filename", "")):
            mesh.set("filename", f"file://{quote(str(found))}")
            any_found = True
    return tostring(root, encoding="unicode") if any_found else text


def mesh_beside(resource: str, folder: Path) -> Path | None:
    """Return the file of a mesh named relative to a folder; None if the path is absolute."""
    scheme, mark, rest = resource.partition("://")
    if not mark:
        found = folder / resource
        return found.resolve() if found.is_file() else None
    if scheme != "package" or mesh_file(resource) is not None:
        return None
    package, _, inside = rest.partition("/")
    around = package_around(package, folder)
    return around / inside if around is not None and (around / inside).is_file() else None


def mesh_file(resource: str) -> Path | None:
    """Return the file of a mesh given its URI (``file://``, ``package://``) or path; None if not
    found.

    Packages are looked up in the ROS environment; the meshes in this package do not require a ROS
    environment.
    """
    url = urlparse(resource)
    if url.scheme == "package":
        own = url.netloc == "spacerobot_ros"
        folder = share_directory() if own else installed_share_directory(url.netloc)
        path = None if folder is None else folder / unquote(url.path).lstrip("/")
    elif url.scheme in ("file", ""):
        path = Path(unquote(url.path))
    else:
        return None
    return path if path is not None and path.is_file() else None


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
        return _without_flaws(read(data))
    except _DamagedError as error:
        raise MeshError(f"The mesh {name} cannot be read: {error}.") from error
    except (ValueError, IndexError, OverflowError) as error:
        # The text of a parse error would quote the file.
        why = "a coordinate or index is not a number"
        raise MeshError(f"The mesh {name} cannot be read: {why}.") from error


def _without_flaws(mesh: TriangleMesh) -> TriangleMesh:
    vertices, faces = mesh.vertices, mesh.faces
    if len(faces) > _MAX_TRIANGLES:
        raise _DamagedError(f"it has {len(faces)} triangles, and at most {_MAX_TRIANGLES} are read")
    if not np.isfinite(vertices).all():
        raise _DamagedError("a coordinate is not finite")
    if faces.size and (faces.min() < 0 or faces.max() >= len(vertices)):
        raise _DamagedError("a face refers to a missing vertex")
    faces = _without_degenerate_faces(faces)
    if not len(faces):
        raise _DamagedError("it has no triangle")
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
            faces += [(face[0], a, b) for a, b in pairwise(face[1:])]
    vertices = np.array(corners, dtype=float).reshape(-1, 3)
    return TriangleMesh(vertices, np.array(faces, dtype=np.int32).reshape(-1, 3))


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
    return TriangleMesh(vertices * _unit_in_metres(path, data), faces)


def _unit_in_metres(path: Path, data: bytes) -> float:
    """Return the unit of a COLLADA file in m; other formats use metres."""
    if path.suffix.lower() != ".dae":
        return 1.0
    found = re.search(rb"<unit\b[^>]*\bmeter\s*=\s*[\"']([^\"']+)[\"']", data)
    return 1.0 if found is None else float(found[1])
