"""Attributes of URDF, batches of masses, and meshes: exact numbers and sentences."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest

from spacerobot_ros.errors import RobotDescriptionError
from spacerobot_ros.model import load_robot, parse_robot
from spacerobot_ros.model.description import Array, Inertia, Pose, Shape
from spacerobot_ros.model.inertial_parameters import InertialParameters
from spacerobot_ros.model.meshes import TriangleMesh
from spacerobot_ros.model.visuals import Visual, sharp_edges, solid_mesh
from spacerobot_ros.resources import robot_file

# -- attributes ---------------------------------------------------------------------------------

EVERYTHING = """<robot name="r">
  <material name="m"><color rgba="1 1 1 1"/></material>
  <link name="hull">
    <inertial><origin xyz="0 0 0" rpy="0 0 0"/><mass value="5"/>
      <inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>
    <visual><geometry><box size="1 1 1"/></geometry></visual>
    <visual><geometry><cylinder radius="1" length="1"/></geometry></visual>
    <visual><geometry><sphere radius="2"/></geometry></visual>
    <visual><geometry><mesh filename="a.stl" scale="1 2 1"/></geometry></visual>
  </link>
  <link name="arm"><inertial><mass value="6"/>
    <inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>
  <link name="hand"><inertial><mass value="7"/>
    <inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>
  <joint name="elbow" type="revolute"><parent link="hull"/><child link="arm"/><axis xyz="0 0 1"/>
    <limit lower="-1" upper="1" velocity="1" effort="1"/></joint>
  <joint name="wrist" type="revolute"><parent link="arm"/><child link="hand"/><axis xyz="0 1 0"/>
    <limit lower="-2" upper="2" velocity="1" effort="1"/>
    <mimic joint="elbow" multiplier="1" offset="0"/></joint>
</robot>"""


@pytest.mark.parametrize(
    ("tag", "name", "count", "needed", "meaning"),
    [
        ("origin", "xyz", 3, False, "m"),
        ("origin", "rpy", 3, False, "rad: roll, pitch and yaw"),
        ("mass", "value", 1, True, "kg"),
        *[("inertia", f"i{a}", 1, True, "kg m^2") for a in ("xx", "xy", "xz", "yy", "yz", "zz")],
        ("axis", "xyz", 3, True, "a direction"),
        ("limit", "velocity", 1, True, "m/s or rad/s"),
        ("limit", "effort", 1, True, "N or N m"),
        ("limit", "lower", 1, False, "m or rad"),
        ("limit", "upper", 1, False, "m or rad"),
        ("mimic", "multiplier", 1, False, "its position per position of the leading joint"),
        ("mimic", "offset", 1, False, "m or rad"),
        ("box", "size", 3, True, "m"),
        ("cylinder", "radius", 1, True, "m"),
        ("cylinder", "length", 1, True, "m"),
        ("sphere", "radius", 1, True, "m"),
        ("mesh", "scale", 3, False, "factors along x, y and z"),
        ("color", "rgba", 4, True, "red, green, blue and opacity, from 0 to 1"),
        ("parent", "link", 0, True, "the name of a link"),
        ("child", "link", 0, True, "the name of a link"),
        ("mimic", "joint", 0, True, "the name of the joint that it follows"),
        ("mesh", "filename", 0, True, "the file of the mesh"),
    ],
)
def test_attributes_have_their_count_of_numbers(
    tag: str, name: str, count: int, needed: bool, meaning: str
) -> None:
    found = re.search(rf'(?<=<{tag} )([^>]*?)\b{name}="([^"]*)"', EVERYTHING)
    assert found is not None

    def refusal(changed: str) -> str:
        text = f"{EVERYTHING[: found.start()]}{found[1]}{changed}{EVERYTHING[found.end() :]}"
        with pytest.raises(RobotDescriptionError) as refused:
            parse_robot(text)
        return str(refused.value)

    numbers = {0: "", 1: "a number, "}.get(count, f"{count} numbers with blanks between them, ")
    remedy = f'; write <{tag} {name}="..."/>: {numbers}{meaning}.'
    if needed:
        missing = refusal("")
        assert f"has no '{name}'" in missing
        assert missing.endswith(remedy)
    if count:
        for words in (found[2].split()[1:], [*found[2].split(), "1"]):
            text = refusal(f'{name}="{" ".join(words)}"')
            assert f"has {len(words)} numbers instead of {count}" in text
            assert text.endswith(remedy)
        assert "has 'one', no number; write" in refusal(f'{name}="{"one " * count}"')


def test_joints_that_mimic_each_other_are_named_in_their_order() -> None:
    text = EVERYTHING.replace('<limit lower="-1"', '<mimic joint="wrist"/><limit lower="-1"')
    with pytest.raises(RobotDescriptionError) as refused:
        parse_robot(text)
    assert str(refused.value) == "The joint 'elbow' mimics itself, by way of wrist."


# -- masses -------------------------------------------------------------------------------------

ARM = InertialParameters.of(load_robot(robot_file("three_joint_arm")))
BODIES = len(ARM.masses)
NAMES = [f"body_{k}" for k in range(BODIES)]


def with_first(**changed: Array) -> InertialParameters:
    """Return the arm with other numbers of its first body."""
    arrays = {name: getattr(ARM, name).copy() for name in ("masses", "centers", "inertias")}
    for name, value in changed.items():
        arrays[name][0] = value
    return InertialParameters(**arrays)


def test_batches_are_scaled_and_shifted_body_by_body() -> None:
    factors = np.array([[1.0] * BODIES, np.arange(2.0, 2.0 + BODIES)])
    batch = ARM.scaled(factors)
    np.testing.assert_allclose(batch.masses, ARM.masses * factors)
    np.testing.assert_allclose(batch[1].inertias[1], 3.0 * ARM.inertias[1])
    np.testing.assert_array_equal(batch[0].centers, ARM.centers)
    assert batch.total_mass == pytest.approx([ARM.masses.sum(), (ARM.masses * factors[1]).sum()])
    other = ARM.scaled(2.0, np.full((3, 1), 0.5))
    assert other.masses.shape == (3, BODIES)
    np.testing.assert_allclose(other.masses[2], 2.0 * ARM.masses)
    np.testing.assert_allclose(other.inertias[2], 0.5 * ARM.inertias)
    offsets = np.zeros((2, BODIES, 3))
    offsets[1, 1] = [0.1, -0.2, 0.3]
    moved = ARM.shifted(offsets)
    np.testing.assert_allclose(moved.centers[1, 1], ARM.centers[1] + [0.1, -0.2, 0.3])
    np.testing.assert_array_equal(moved[0].centers, ARM.centers)
    np.testing.assert_array_equal(moved.inertias[1], ARM.inertias)
    both = InertialParameters.stacked([batch[1], moved[1]])
    np.testing.assert_array_equal(both.masses, [batch.masses[1], ARM.masses])
    np.testing.assert_array_equal(both.centers[1], moved.centers[1])
    np.testing.assert_array_equal(both.inertias[0], batch.inertias[1])


def test_a_payload_is_welded_to_its_body() -> None:
    """Two points of 1 kg and 3 kg, 2 m apart, are as 0.75 kg of reduced mass at that distance."""
    point = with_first(masses=np.array(1.0), centers=np.zeros(3), inertias=np.zeros((3, 3)))
    loaded = point.with_payload(0, Inertia(3.0, np.array([0.0, 2.0, 0.0])))
    assert loaded.masses[0] == 4.0
    assert loaded.centers[0].tolist() == [0.0, 1.5, 0.0]
    np.testing.assert_allclose(loaded.inertias[0], np.diag([3.0, 0.0, 3.0]), atol=1e-12)
    np.testing.assert_array_equal(loaded.masses[1:], ARM.masses[1:])


def test_the_vector_of_a_body_has_mass_centre_and_second_moments() -> None:
    inertia = np.array([[6.0, -0.1, 0.2], [-0.1, 7.0, 0.3], [0.2, 0.3, 8.0]])
    known = with_first(masses=np.array(2.0), centers=np.array([1.0, 2, 3]), inertias=inertia)
    moments = [(7 + 8 - 6) / 2, (6 + 8 - 7) / 2, (6 + 7 - 8) / 2, 0.1, -0.2, -0.3]
    assert known.vector.shape == (10 * BODIES,)
    assert known.vector[:10] == pytest.approx([2.0, 1.0, 2.0, 3.0, *moments])
    with pytest.raises(ValueError, match=re.escape(f"masses ({BODIES},), centers (2, 3) and")):
        InertialParameters(ARM.masses, np.zeros((2, 3)), ARM.inertias)


@pytest.mark.parametrize(
    ("changed", "sentence"),
    [
        ({"masses": np.nan}, "A mass, centre or inertia of 'body_0' is not finite."),
        ({"masses": -0.5}, "The mass of 'body_0' is -0.5 kg; it must be positive."),
        ({"masses": 0.0}, None),
        ({"inertias": np.diag([1.0, 1.0, 2.02])}, None),
        (
            {"inertias": np.diag([1.0, 1.0, 2.03])},
            "The inertia of 'body_0' is that of no body: its principal moments are 1, 1, 2.03 "
            "kg m^2.",
        ),
        (
            {"inertias": np.diag([-1e-9, 1.0, 1.0])},
            "The inertia of 'body_0' is that of no body: its principal moments are -1e-09, 1, 1 "
            "kg m^2.",
        ),
    ],
)
def test_masses_that_no_body_has_are_refused(changed: dict[str, Array], sentence: str) -> None:
    batch = InertialParameters.stacked([ARM, with_first(**changed)])
    if sentence is None:
        batch.require_physical(NAMES)
        return
    with pytest.raises(RobotDescriptionError) as refused:
        batch.require_physical(NAMES)
    assert str(refused.value) == sentence
    nothing = InertialParameters(0 * ARM.masses, ARM.centers, ARM.inertias)
    with pytest.raises(RobotDescriptionError, match=r"The total mass of the robot is zero\."):
        nothing.require_physical(NAMES)


# -- meshes -------------------------------------------------------------------------------------


@pytest.mark.parametrize(("angle", "edges"), [(29.9, 4), (30.1, 5)])
def test_a_fold_of_more_than_thirty_degrees_is_an_edge(angle: float, edges: int) -> None:
    turn = math.radians(angle)
    corners = [[0, 0, 0], [0, 1, 0], [-1, 0, 0], [math.cos(turn), 0, math.sin(turn)]]
    folded = TriangleMesh(np.array(corners), np.array([[0, 1, 2], [0, 3, 1]], np.int32))
    assert len(sharp_edges(folded).lines) == edges


@pytest.mark.parametrize(("thickness", "rod"), [(0.0499, True), (0.0501, False)])
def test_a_box_is_a_rod_by_its_second_side(thickness: float, rod: bool) -> None:
    shape = Shape("box", (0.01, 2.0, 2.0 * thickness), Pose())
    assert Visual("a", 0, shape, solid_mesh(shape)).is_rod is rod
    flat = Shape("cylinder", (0.01, 2.0), Pose())
    assert not Visual("a", 0, flat, solid_mesh(flat)).is_rod


def test_round_solids_have_24_facets_around() -> None:
    """A cylinder has two triangles a facet and two lids; a sphere twelve bands, of two lids."""
    cylinder = solid_mesh(Shape("cylinder", (0.5, 2.0), Pose()))
    assert len(cylinder.faces) == 24 * 4
    sphere = solid_mesh(Shape("sphere", (0.5,), Pose()))
    assert len(sphere.faces) == 24 * (2 * 10 + 2)
    assert np.linalg.norm(sphere.vertices, axis=1) == pytest.approx(0.5)


def test_an_outline_without_edges_is_that_of_the_box_around() -> None:
    ball = Shape("sphere", (0.5,), Pose(r=np.array([1.0, 2.0, 3.0])))
    mesh = solid_mesh(ball)
    outline = Visual("a", 0, ball, mesh).outline
    assert len(outline) == 12
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    ends = outline.reshape(-1, 3)
    np.testing.assert_allclose([ends.min(axis=0), ends.max(axis=0)], [low, high])


def test_a_coarse_mesh_has_at_most_so_many_faces_and_the_finest_grid_that_gives_them() -> None:
    """Of a bumpy sheet of 512 triangles; on finer grids there are more."""
    at = np.linspace(0.0, 2.0, 17)
    grid = np.array([[x, y, 0.1 * math.sin(3 * x + y)] for x in at for y in at])
    place = np.arange(17 * 17).reshape(17, 17)
    a, b, c, d = (
        x.ravel() for x in (place[:-1, :-1], place[1:, :-1], place[1:, 1:], place[:-1, 1:])
    )
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]).astype(np.int32)
    sheet = TriangleMesh(grid, faces)
    assert sheet.coarsened(512) is sheet
    counts = [len(sheet.coarsened(most).faces) for most in (511, 130, 40, 10, 1)]
    assert counts == sorted(counts, reverse=True)
    assert counts[0] > 100
    assert all(count <= most for count, most in zip(counts, (511, 130, 40, 10, 1), strict=True))
    assert counts[3] in (2, 4, 6, 8, 10)
    assert counts[4] == 0
    span = np.ptp(sheet.coarsened(130).vertices, axis=0)[:2]
    assert np.all(span > 1.7)
    # A point has no size to divide.
    point = TriangleMesh(np.ones((3, 3)), np.array([[0, 1, 2]], np.int32))
    assert len(point.coarsened(0).faces) == 0
