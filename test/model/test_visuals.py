"""What a robot looks like: triangles of solids and meshes, their sharp edges, meshes in bags."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest

from spacerobot_ros.model import parse_robot
from spacerobot_ros.model.description import Array, Pose, RobotDescription, Shape
from spacerobot_ros.model.meshes import TriangleMesh, mesh_of_stl, shape_mesh, stl_of
from spacerobot_ros.model.rotations import matrix_from_rpy
from spacerobot_ros.model.urdf import load_robot
from spacerobot_ros.model.visuals import (
    meshes_for_bag,
    meshes_from_attachments,
    sharp_edges,
    solid_mesh,
    visuals_of,
)
from spacerobot_ros.resources import robot_file

PLACED = Pose(matrix_from_rpy([0.3, -0.7, 1.9]), np.array([0.4, -2.0, 1.1]))
POLYGON = 24 / (2 * math.pi) * math.sin(2 * math.pi / 24)
"""Area of a polygon of 24 corners by that of its circle."""


def volume(mesh: TriangleMesh) -> float:
    """Volume inside a closed surface, positive where faces go round counterclockwise from outside
    (divergence theorem).
    """
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)


def area(mesh: TriangleMesh) -> float:
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


@pytest.mark.parametrize(
    ("kind", "size", "inside", "surface", "edges"),
    [
        ("box", (0.3, 0.5, 0.7), 0.105, 1.42, 12),
        ("cylinder", (0.2, 1.5), 0.06 * math.pi * POLYGON, None, 48),
        ("sphere", (0.4,), None, None, 0),
    ],
)
def test_solids_are_closed_and_seen_from_outside(
    kind: str, size: tuple[float, ...], inside: float | None, surface: float | None, edges: int
) -> None:
    mesh = solid_mesh(Shape(kind, size, PLACED))
    if inside is not None:
        assert volume(mesh) == pytest.approx(inside)
    else:
        assert 0.97 < volume(mesh) / (4 / 3 * math.pi * size[0] ** 3) < 1.0
    if surface is not None:
        assert area(mesh) == pytest.approx(surface)
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
