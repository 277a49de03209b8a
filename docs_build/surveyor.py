"""Draw the parts of the robot ``surveyor``: ``python -m docs_build.surveyor``.

It writes meshes/surveyor and prints the ``<inertial>`` of each part, at uniform density, from its
triangles, for urdf/surveyor.urdf. As with parts from a CAD program, some files are in mm and some
are OBJ.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from spacerobot_ros.model.meshes import TriangleMesh
from spacerobot_ros.model.rotations import matrix_from_rpy

Array = npt.NDArray[np.float64]

FOLDER = Path(__file__).resolve().parent.parent / "meshes" / "surveyor"

_X = (0.0, math.pi / 2, 0.0)
"""Roll, pitch and yaw that turn the z axis into the x axis."""

_Y = (-math.pi / 2, 0.0, 0.0)


@dataclass(frozen=True)
class Part:
    """A closed surface in m, the mass (kg) of what it encloses, and the unit of its file in m."""

    mesh: TriangleMesh
    mass: float
    file: str
    unit: float = 1.0


def turned(
    profile: Sequence[tuple[float, float]], sides: int = 16, phase: float = 0.0
) -> TriangleMesh:
    """Return the solid that a profile of (radius, z) encloses with the z axis, in ``sides`` flats.

    The profile begins and ends on the axis, the lowest point first.
    """
    rings = [point for point in profile if point[0] > 0]
    angles = phase + 2 * math.pi * np.arange(sides) / sides
    vertices = [[0.0, 0.0, profile[0][1]]]
    for r, z in rings:
        vertices += [[r * math.cos(angle), r * math.sin(angle), z] for angle in angles]
    vertices.append([0.0, 0.0, profile[-1][1]])
    faces = []
    for i in range(sides):
        j = (i + 1) % sides
        faces.append([0, 1 + j, 1 + i])
        for ring in range(len(rings) - 1):
            a, b = 1 + ring * sides, 1 + (ring + 1) * sides
            faces += [[a + i, a + j, b + j], [a + i, b + j, b + i]]
        top = 1 + (len(rings) - 1) * sides
        faces.append([top + i, top + j, len(vertices) - 1])
    return TriangleMesh(np.array(vertices), np.array(faces, dtype=np.int32))


def box(x: float, y: float, z: float) -> TriangleMesh:
    """Return a box about the origin: a turned solid of four flats, squeezed."""
    r = math.sqrt(0.5)
    cube = turned([(0, -0.5), (r, -0.5), (r, 0.5), (0, 0.5)], sides=4, phase=math.pi / 4)
    return TriangleMesh(cube.vertices * [x, y, z], cube.faces)


def rod(radius: float, length: float, sides: int = 16) -> TriangleMesh:
    """Return a cylinder about the origin, along z."""
    half = length / 2
    return turned([(0, -half), (radius, -half), (radius, half), (0, half)], sides)


def at(
    mesh: TriangleMesh,
    xyz: tuple[float, float, float],
    rpy: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> TriangleMesh:
    """Return a solid turned and moved."""
    return TriangleMesh(mesh.vertices @ matrix_from_rpy(np.array(rpy)).T + xyz, mesh.faces)


def together(*solids: TriangleMesh) -> TriangleMesh:
    """Return solids that touch as one mesh, rounded to a micrometre."""
    first = np.cumsum([0, *(len(solid.vertices) for solid in solids)])
    faces = [solid.faces + start for solid, start in zip(solids, first, strict=False)]
    vertices = np.vstack([solid.vertices for solid in solids])
    return TriangleMesh(np.round(vertices, 6) + 0.0, np.vstack(faces).astype(np.int32))


def parts() -> dict[str, Part]:
    """Return the parts by their links; the frames are those of urdf/surveyor.urdf."""
    outer = 0.45 / math.cos(math.pi / 8)
    inner = outer - 0.05
    hinges = [(x, 0.89 + 0.6 * k, 0.0) for k in range(2) for x in (-0.3, 0.3)]
    bus = together(
        turned(
            [(0, -0.4), (inner, -0.4), (outer, -0.35), (outer, 0.35), (inner, 0.4), (0, 0.4)],
            sides=8,
            phase=math.pi / 8,
        ),
        # An engine bell below, an antenna dish above.
        turned([(0, -0.62), (0.16, -0.62), (0.11, -0.5), (0.05, -0.4), (0, -0.4)]),
        at(rod(0.02, 0.1, 8), (-0.2, 0.0, 0.45)),
        turned_dish((-0.2, 0.0, 0.5)),
    )
    panel = together(
        at(rod(0.025, 0.3, 8), (0.0, 0.15, 0.0), _Y),
        *(at(box(0.7, 0.58, 0.03), (0.0, 0.3 + 0.29 + 0.6 * k, 0.0)) for k in range(3)),
        *(at(box(0.04, 0.02, 0.02), hinge) for hinge in hinges),
    )
    shoulder = together(
        at(rod(0.09, 0.06), (0.0, 0.0, 0.03)),
        at(rod(0.06, 0.06), (0.0, 0.0, 0.09)),
        at(rod(0.07, 0.16), (0.0, 0.0, 0.19), _Y),
    )
    upper_arm = together(
        at(rod(0.065, 0.14), (0.0, 0.15, 0.0), _Y),
        at(rod(0.04, 0.57, 12), (0.35, 0.15, 0.0), _X),
        at(rod(0.06, 0.14), (0.695, 0.15, 0.0), _Y),
    )
    forearm = together(
        at(rod(0.055, 0.12), (0.0, -0.13, 0.0), _Y),
        at(rod(0.035, 0.49, 12), (0.3, -0.13, 0.0), _X),
        at(rod(0.045, 0.05), (0.57, -0.13, 0.0), _X),
    )
    camera = together(
        at(box(0.12, 0.16, 0.1), (0.09, 0.0, 0.0)),
        at(rod(0.03, 0.03), (0.015, 0.0, 0.0), _X),
        at(turned([(0, 0), (0.03, 0), (0.045, 0.07), (0, 0.05)]), (0.15, 0.0, 0.0), _X),
    )
    return {
        "base_link": Part(bus, 118.0, "bus.stl"),
        "solar_panel": Part(panel, 5.5, "solar_panel.stl"),
        "shoulder": Part(shoulder, 3.2, "shoulder.stl"),
        "upper_arm": Part(upper_arm, 4.6, "upper_arm.obj", 0.001),
        "forearm": Part(forearm, 3.4, "forearm.obj"),
        "camera": Part(camera, 2.1, "camera.stl", 0.001),
    }


def turned_dish(xyz: tuple[float, float, float]) -> TriangleMesh:
    """Return an antenna dish that opens upwards, its back at a place."""
    profile = [(0, 0), (0.08, 0.02), (0.15, 0.07), (0.14, 0.07), (0.07, 0.03), (0, 0.015)]
    return at(turned(profile), xyz)


def inertial(mesh: TriangleMesh, mass: float) -> tuple[Array, Array]:
    """Return centre of mass (3,) and inertia about it (3, 3) of a closed surface of one density.

    Tetrahedra between the origin and each face: their second moments are those of a unit simplex,
    (1 + delta_ij) / 120, transformed by their edges.
    """
    edges = mesh.vertices[mesh.faces]
    volume = np.linalg.det(edges)
    com = np.einsum("m,mij->j", volume / 24, edges) / (volume.sum() / 6)
    simplex = (np.ones((3, 3)) + np.eye(3)) / 120
    second = np.einsum("m,mki,kl,mlj->ij", volume, edges, simplex, edges)
    second = second * (mass / (volume.sum() / 6)) - mass * np.outer(com, com)
    return com, np.trace(second) * np.eye(3) - second


def stl(mesh: TriangleMesh, unit: float, name: str) -> bytes:
    """Return a binary STL."""
    corners = (mesh.vertices[mesh.faces] / unit).astype("<f4")
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    facets = np.zeros(
        len(corners), [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")]
    )
    # Of the normals few digits, so that every machine writes the same.
    facets["normal"], facets["corners"] = np.round(normals, 3) + 0.0, corners
    return name.encode().ljust(80) + len(facets).to_bytes(4, "little") + facets.tobytes()


def obj(mesh: TriangleMesh, unit: float, name: str) -> bytes:
    """Return an OBJ."""
    lines = [f"# {name}"]
    lines += ["v " + " ".join(f"{x:.6g}" for x in vertex) for vertex in mesh.vertices / unit]
    lines += ["f " + " ".join(str(i + 1) for i in face) for face in mesh.faces]
    return "\n".join([*lines, ""]).encode()


def files() -> dict[str, bytes]:
    """Return the contents of the mesh files by their names."""
    found = {}
    for link, part in parts().items():
        write = stl if part.file.endswith(".stl") else obj
        found[part.file] = write(part.mesh, part.unit, f"surveyor {link}")
    return found


def main() -> None:
    """Write the files, and print what the URDF says of masses."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    for name, data in files().items():
        (FOLDER / name).write_bytes(data)
    for link, part in parts().items():
        com, about = inertial(part.mesh, part.mass)
        centre = " ".join(f"{x:.5g}" for x in np.round(com, 5) + 0.0)
        tensor = " ".join(
            f'i{a}{b}="{np.round(about[i, j], 6) + 0.0:.5g}"'
            for i, j, a, b in (
                (0, 0, "x", "x"),
                (0, 1, "x", "y"),
                (0, 2, "x", "z"),
                (1, 1, "y", "y"),
                (1, 2, "y", "z"),
                (2, 2, "z", "z"),
            )
        )
        print(f'{link}: <origin xyz="{centre}"/><mass value="{part.mass}"/><inertia {tensor}/>')


if __name__ == "__main__":
    main()
