"""What a robot looks like: solids, meshes and their files."""

from __future__ import annotations

import math
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from docs_build import surveyor as surveyor_script
from spacerobot_ros.errors import MeshError
from spacerobot_ros.model import meshes as module
from spacerobot_ros.model import parse_robot
from spacerobot_ros.model.description import Array, Pose, RobotDescription, Shape
from spacerobot_ros.model.meshes import (
    TriangleMesh,
    mesh_of_stl,
    meshes_for_bag,
    meshes_from_attachments,
    read_mesh,
    shape_mesh,
    sharp_edges,
    solid_mesh,
    stl_of,
    visuals_of,
)
from spacerobot_ros.model.rotations import matrix_from_rpy
from spacerobot_ros.model.urdf import load_robot
from spacerobot_ros.resources import robot_file, share_directory

PLACED = Pose(matrix_from_rpy([0.3, -0.7, 1.9]), np.array([0.4, -2.0, 1.1]))
POLYGON = 24 / (2 * math.pi) * math.sin(2 * math.pi / 24)
"""Area of a polygon of 24 corners by that of its circle."""


def volume(mesh: TriangleMesh) -> float:
    """Volume inside a closed surface, positive where faces go round counterclockwise from outside
    (divergence theorem).
    """
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)


@pytest.mark.parametrize(
    ("kind", "size", "inside", "edges"),
    [
        ("box", (0.3, 0.5, 0.7), 0.105, 12),
        ("cylinder", (0.2, 1.5), 0.06 * math.pi * POLYGON, 48),
        ("sphere", (0.4,), None, 0),
    ],
)
def test_solids_are_closed_and_seen_from_outside(
    kind: str, size: tuple[float, ...], inside: float | None, edges: int
) -> None:
    mesh = solid_mesh(Shape(kind, size, PLACED))
    if inside is not None:
        assert volume(mesh) == pytest.approx(inside)
    else:
        assert 0.97 < volume(mesh) / (4 / 3 * math.pi * size[0] ** 3) < 1.0
    # Every edge has a face on both sides, which go along it in opposite directions.
    directed = mesh.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2).tolist()
    assert {(a, b) for a, b in directed} == {(b, a) for a, b in directed}
    assert len(set(map(tuple, directed))) == len(directed)
    found = sharp_edges(mesh)
    assert len(found.lines) == edges
    local = (mesh.vertices - PLACED.r) @ PLACED.R
    if kind == "box":
        np.testing.assert_allclose(np.abs(local).max(axis=0), np.array(size) / 2)
        assert sorted(lengths(found.lines).round(9)) == sorted([0.3, 0.5, 0.7] * 4)
        first, second = np.moveaxis(found.normals, 1, 0)
        np.testing.assert_allclose(np.sum(first * second, axis=1), 0.0, atol=1e-12)
    if kind == "cylinder":
        np.testing.assert_allclose(np.abs(local[:, 2]), 0.75)
        np.testing.assert_allclose(lengths(found.lines), 2 * 0.2 * math.sin(math.pi / 24))


def lengths(lines: Array) -> Array:
    return np.linalg.norm(lines[:, 1] - lines[:, 0], axis=1)


def test_an_open_mesh_ends_in_sharp_edges() -> None:
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    square = TriangleMesh(corners, np.array([[0, 1, 2], [0, 2, 3]], np.int32))
    assert sorted(lengths(sharp_edges(square).lines)) == [1.0] * 4


def test_a_rod_is_a_line_along_its_longest_side() -> None:
    inertia = 'ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"'
    text = (
        f'<robot name="r"><link name="base"><inertial><mass value="1"/><inertia {inertia}/>'
        '</inertial><visual><origin xyz="1 0 0"/><geometry><box size="0.01 2 0.02"/></geometry>'
        "</visual></link></robot>"
    )
    (rod,) = visuals_of(parse_robot(text), {}, 100)
    assert len(rod.edges.lines) == 0
    np.testing.assert_allclose(rod.outline, [[[1, -1, 0], [1, 1, 0]]])


@pytest.fixture(scope="module")
def surveyor() -> RobotDescription:
    return load_robot(robot_file("surveyor"))


def test_meshes_travel_in_a_bag(surveyor: RobotDescription) -> None:
    carried = meshes_for_bag(surveyor)
    elsewhere = parse_robot(surveyor.urdf.replace("package://", "package://not_here_"))
    moved = {name.replace("//", "//not_here_"): data for name, data in carried.items()}
    assert meshes_for_bag(elsewhere) == {}
    meshes = meshes_from_attachments(elsewhere, moved)
    found = visuals_of(elsewhere, meshes, 20_000)
    shapes = [
        (link.name, shape)
        for link in surveyor.links
        for shape in link.shapes
        if shape.kind == "mesh"
    ]
    assert len(found) == len(shapes) > 5
    for visual, (link, shape) in zip(found, shapes, strict=True):
        assert visual.link == link
        expected = shape_mesh(shape)
        assert len(visual.mesh.faces) == len(expected.faces)
        assert volume(visual.mesh) == pytest.approx(volume(expected), rel=1e-5)
        for side in (np.min, np.max):
            np.testing.assert_allclose(
                side(visual.mesh.vertices, axis=0), side(expected.vertices, axis=0), atol=1e-6
            )
    assert all(len(visual.mesh.faces) <= 50 for visual in visuals_of(elsewhere, meshes, 50))


def test_no_file_is_read_that_a_bag_names(surveyor: RobotDescription) -> None:
    assert meshes_from_attachments(surveyor, {}) == {}
    damaged = {name: data[:100] for name, data in meshes_for_bag(surveyor).items()}
    assert meshes_from_attachments(surveyor, damaged) == {}
    assert all(each.shape.kind != "mesh" for each in visuals_of(surveyor, {}, 100))


def test_stl_holds_the_triangles() -> None:
    mesh = solid_mesh(Shape("box", (0.3, 0.5, 0.7), Pose()))
    again = mesh_of_stl(stl_of(mesh), "a box")
    assert len(again.faces) == 12
    assert len(again.vertices) == 8
    assert volume(again) == pytest.approx(0.105, rel=1e-6)


def test_a_robot_without_visuals_has_balls_at_links_and_bars_to_its_joints() -> None:
    urdf = re.sub(r"<visual>.*?</visual>", "", load_robot(robot_file("servicer")).urdf, flags=re.S)
    robot = parse_robot(urdf)
    visuals = visuals_of(robot, {}, 100)
    balls = [each for each in visuals if each.shape.kind == "sphere"]
    bars = [each for each in visuals if each.shape.kind == "cylinder"]
    assert [each.link for each in balls] == [link.name for link in robot.links]
    joints = [joint for joint in robot.joints if np.linalg.norm(joint.origin.r) > 0]
    assert [each.link for each in bars] == [joint.parent for joint in joints]
    for bar, joint in zip(bars, joints, strict=True):
        ends, r = bar.mesh.vertices, joint.origin.r
        along = ends @ r / np.linalg.norm(r)
        assert along.min() == pytest.approx(0.0, abs=1e-12)
        assert along.max() == pytest.approx(np.linalg.norm(r))
        across = np.linalg.norm(np.cross(ends, r / np.linalg.norm(r)), axis=1)
        assert across.max() < 0.03
        assert bar.body == robot.frames[joint.parent][0]


# -- meshes of visuals, and those of the example robot ------------------------------------------


WEDGE = np.array([[0.0, 0, 0], [2, 0, 0], [0, 3, 0], [0, 0, 5]])
WEDGE_FACES = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
WEDGE_VOLUME = 5.0

OBJ = b"""# a unit cube of quadrangles, some counted backwards
o cube
v 0 0 0
v 1 0 0
v 1 1 0
v 0 1 0 0.5 0.5 0.5
v 0 0 1
v 1 0 1
v 1 1 1
v 0 1 1
vn 0 0 1
f 4//1 3//1 2//1 1//1
f -4 -3 -2 -1
f 1 2 6 5
f 2/1/1 3/1/1 \\
7/1/1 6/1/1
f 3 4 8 7
f 4 1 5 8
"""


def stl_text(vertices: Any, faces: Any) -> bytes:
    lines = ["solid wedge"]
    for face in faces:
        corners = "\n".join("      vertex {:e} {:e} {:e}".format(*vertices[i]) for i in face)
        lines.append(f"  facet normal 0 0 0\n    outer loop\n{corners}\n    endloop\n  endfacet")
    return "\n".join([*lines, "endsolid wedge\n"]).encode()


def stl_binary(vertices: Any, faces: Any, header: bytes = b"") -> bytes:
    rows = np.zeros(len(faces), "3<f4, (3,3)<f4, <u2")
    rows["f1"] = np.asarray(vertices, dtype=float)[faces]
    return header.ljust(80) + len(faces).to_bytes(4, "little") + rows.tobytes()


def written(folder: Path, name: str, data: bytes) -> Path:
    path = folder / name
    path.write_bytes(data)
    return path


@pytest.mark.parametrize(
    "data",
    [
        stl_text(WEDGE, WEDGE_FACES),
        stl_text(WEDGE, WEDGE_FACES).replace(b"\n", b"\r\n"),
        stl_binary(WEDGE, WEDGE_FACES),
        stl_binary(WEDGE, WEDGE_FACES, b"solid, says the header of some CAD programs"),
        stl_binary(WEDGE, WEDGE_FACES) + b"what follows the last triangle",
    ],
    ids=["text", "text of Windows", "binary", "binary called solid", "binary and more"],
)
def test_stl_is_read_whether_text_or_binary(tmp_path: Path, data: bytes) -> None:
    mesh = read_mesh(written(tmp_path, "wedge.STL", data))
    assert mesh.vertices.shape == (4, 3)  # Corners that triangles share are one vertex.
    assert sorted(mesh.vertices.tolist()) == sorted(WEDGE.tolist())
    assert volume(mesh) == pytest.approx(WEDGE_VOLUME, rel=1e-6)


def test_obj_faces_of_many_corners_are_triangles_that_look_the_same_way(tmp_path: Path) -> None:
    mesh = read_mesh(written(tmp_path, "cube.obj", OBJ))
    assert mesh.vertices.shape == (8, 3)
    assert mesh.faces.shape == (12, 3)
    assert volume(mesh) == pytest.approx(1.0)


CORNERS = b"v 0 0 0\nv 1 0 0 1.0\nv 1 1 0\n\nv 0 1 0\n# no corner\nv 0.5 0.5 1\n"


@pytest.mark.parametrize(
    ("faces", "triangles"),
    [
        (b"f 1 2 3", [(0, 1, 2)]),
        (b"f 1 2 3 4", [(0, 1, 2), (0, 2, 3)]),
        (b"f 2/1/1 3//2 4/3 1 5", [(1, 2, 3), (1, 3, 0), (1, 0, 4)]),
        (b"f -1 -5 -4", [(4, 0, 1)]),
        (b"f 1 2 \\\n3", [(0, 1, 2)]),
        (b"f 1 2 \\\r\n5 4", [(0, 1, 4), (0, 4, 3)]),
    ],
)
def test_obj_faces_are_fans_of_triangles(
    tmp_path: Path, faces: bytes, triangles: list[tuple[int, ...]]
) -> None:
    mesh = read_mesh(written(tmp_path, "a.obj", CORNERS + faces))
    assert [tuple(face) for face in mesh.faces.tolist()] == triangles
    assert mesh.vertices.tolist() == [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 0.5, 1]]


@pytest.mark.parametrize("suffix", [".dae", ".glb", ".ply"])
def test_other_kinds_are_read_by_trimesh(tmp_path: Path, suffix: str) -> None:
    solid = trimesh.Trimesh(WEDGE, WEDGE_FACES, process=False)
    data: Any = solid.export(file_type=suffix[1:])
    mesh = read_mesh(written(tmp_path, f"wedge{suffix}", data))
    assert volume(mesh) == pytest.approx(WEDGE_VOLUME, rel=1e-6)


def test_collada_in_millimetres_becomes_metres(tmp_path: Path) -> None:
    data: Any = trimesh.Trimesh(WEDGE, WEDGE_FACES, process=False).export(file_type="dae")
    asset = b"<asset><unit name='millimeter' meter='0.001'/>"
    assert b"<asset>" in data
    scaled = data.replace(b"<asset>", asset)
    mesh = read_mesh(written(tmp_path, "wedge.dae", scaled))
    assert mesh.vertices.max() == pytest.approx(0.005)


@pytest.mark.parametrize(("name", "hidden"), [("a.glb", "trimesh"), ("a.dae", "collada")])
def test_a_missing_reader_is_named_with_the_command_that_installs_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, hidden: str
) -> None:
    path = written(tmp_path, name, b"")
    monkeypatch.setitem(sys.modules, hidden, None)
    with pytest.raises(MeshError, match=r"pip install '\.\[viewer\]'` in the clone"):
        read_mesh(path)


@pytest.mark.parametrize(
    ("name", "data", "sentence"),
    [
        ("a.stl", b"\x7fELF" + bytes(200), "it has no triangle"),
        ("a.stl", b"short", "it is not an STL file, or it is truncated"),
        ("a.stl", stl_binary(WEDGE, WEDGE_FACES)[:-1], "it is not an STL file, or it is truncated"),
        ("a.stl", bytes(80) + b"\xff\xff\xff\xff" + bytes(50), "or it is truncated"),
        ("a.stl", stl_text(WEDGE, WEDGE_FACES)[:300], "the file is truncated"),
        (
            "a.stl",
            stl_text(WEDGE, WEDGE_FACES).replace(b"tex 2", b"tx 2", 1),
            "does not have three corners",
        ),
        ("a.stl", stl_text(WEDGE, WEDGE_FACES).replace(b"2.0", b"two"), "is not a number"),
        ("a.stl", stl_binary(WEDGE * np.nan, WEDGE_FACES), "not finite"),
        ("a.stl", stl_binary(WEDGE, [[0, 0, 1]]), "it has no triangle"),
        ("a.obj", b"", "it has no triangle"),
        ("a.obj", b"v 1 2\n", "is not a number"),
        ("a.obj", b"v 1 2 x\nf 1 1 1\n", "is not a number"),
        ("a.obj", OBJ + b"f 1 2 9\n", "refers to a missing vertex"),
        ("a.obj", OBJ + b"f 1 2 -9\n", "refers to a missing vertex"),
        ("a.obj", OBJ + b"f 1 2 0\n", "refers to a missing vertex"),
        ("a.obj", OBJ + b"f 1 2 x\n", "is not a number"),
        ("a.obj", OBJ + b"f 1 2 99999999999\n", "refers to a missing vertex"),
        ("a.ply", b"secret of the host", "trimesh raised [A-Za-z]+[.]$"),
        ("a.dae", b"secret of the host", "trimesh raised [A-Za-z]+[.]$"),
        ("a.step", b"", r"unsupported format \(not STL, OBJ, COLLADA, glTF or PLY\): convert"),
    ],
)
def test_what_cannot_be_read_is_refused_in_a_sentence(
    tmp_path: Path, name: str, data: bytes, sentence: str
) -> None:
    path = written(tmp_path, name, data)
    with pytest.raises(MeshError, match=sentence) as refusal:
        read_mesh(path)
    assert str(path) in str(refusal.value)
    assert "secret" not in str(refusal.value)


def test_sizes_are_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = written(tmp_path, "a.stl", stl_binary(WEDGE, WEDGE_FACES))
    monkeypatch.setattr(module, "_MAX_TRIANGLES", 3)
    with pytest.raises(MeshError, match="it has 4 triangles, and at most 3 are read"):
        read_mesh(path)
    monkeypatch.setattr(module, "_MAX_MESH_BYTES", 83)
    with pytest.raises(MeshError, match=r"at most 0 MB are read\. Make it coarser"):
        read_mesh(path)
    with pytest.raises(MeshError, match=r"cannot be read: No such file or directory[.]"):
        read_mesh(tmp_path / "gone.stl")
    with pytest.raises(
        MeshError, match=r"'gone\.stl' was not found: give a path relative to the URDF"
    ):
        shape_mesh(Shape("mesh", (1.0, 1.0, 1.0), Pose(), resource="gone.stl"))


@settings(max_examples=150, deadline=None)
@given(st.data())
def test_damaged_files_are_read_or_refused(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    whole = data.draw(
        st.sampled_from([stl_binary(WEDGE, WEDGE_FACES), stl_text(WEDGE, WEDGE_FACES), OBJ])
    )
    damaged = bytearray(whole)
    for _ in range(data.draw(st.integers(1, 4))):
        damaged[data.draw(st.integers(0, len(damaged) - 1))] = data.draw(st.integers(0, 255))
    folder = tmp_path_factory.getbasetemp()
    path = written(folder, "damaged.obj" if whole is OBJ else "damaged.stl", bytes(damaged))
    try:
        mesh = read_mesh(path)
    except MeshError:
        return
    assert np.isfinite(mesh.vertices).all()
    assert mesh.faces.min() >= 0
    assert mesh.faces.max() < len(mesh.vertices)


def test_origin_and_scale_of_the_visual_are_applied_and_outside_stays_outside(
    tmp_path: Path,
) -> None:
    path = written(tmp_path, "wedge.stl", stl_binary(WEDGE, WEDGE_FACES))
    pose = Pose(matrix_from_rpy([0.3, -0.2, 1.1]), np.array([5.0, 6.0, 7.0]))
    mesh = shape_mesh(Shape("mesh", (0.1, -0.2, 0.5), pose, resource=str(path)))
    assert volume(mesh) == pytest.approx(WEDGE_VOLUME * 0.01)
    tip = pose.r + pose.R @ np.array([0.0, -0.6, 0.0])
    assert np.abs(mesh.vertices - tip).max(axis=1).min() < 1e-6


@pytest.mark.parametrize("most", [50, 300, 1279, 1280, 5000])
def test_a_coarser_mesh_keeps_form_and_size(most: int) -> None:
    ball = trimesh.creation.icosphere(subdivisions=3, radius=2.0)
    fine = TriangleMesh(np.asarray(ball.vertices), np.asarray(ball.faces, dtype=np.int32))
    coarse = fine.coarsened(most)
    assert len(fine.faces) == 1280
    assert 0 < len(coarse.faces) <= most
    assert np.linalg.norm(coarse.vertices, axis=1).max() <= 2.0 + 1e-9
    assert volume(coarse) > (0.3 if most < 100 else 0.75) * volume(fine)
    if most >= 1280:
        assert coarse is fine


def test_the_meshes_of_the_example_are_those_of_its_script() -> None:
    folder = share_directory() / "meshes" / "surveyor"
    made = surveyor_script.files()
    assert sorted(path.name for path in folder.iterdir()) == sorted(made)
    for name, data in made.items():
        assert (folder / name).read_bytes() == data, f"run python -m docs_build.surveyor: {name}"
    assert sum(len(data) for data in made.values()) < 60_000


@pytest.mark.parametrize(
    "link", ["base_link", "left_panel", "right_panel", "shoulder", "upper_arm", "forearm", "camera"]
)
def test_masses_of_the_example_are_those_of_its_meshes(
    surveyor: RobotDescription, link: str
) -> None:
    """Trimesh integrates over the closed surfaces by another formulation than the script's."""
    found = next(each for each in surveyor.links if each.name == link)
    mesh = shape_mesh(found.shapes[0])
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    assert solid.is_watertight
    assert solid.volume > 0
    solid.density = found.inertia.mass / solid.volume
    np.testing.assert_allclose(solid.center_mass, found.inertia.com, atol=6e-5)
    scale = np.abs(solid.moment_inertia).max()
    np.testing.assert_allclose(solid.moment_inertia, found.inertia.about_com, atol=2e-4 * scale)
