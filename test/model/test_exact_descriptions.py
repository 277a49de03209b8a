"""Attributes of URDF, batches of masses, and meshes: exact numbers and sentences."""

from __future__ import annotations

import re

import numpy as np
import pytest

from spacerobot_ros.errors import RobotDescriptionError
from spacerobot_ros.model import load_robot, parse_robot
from spacerobot_ros.model.description import Array, Inertia
from spacerobot_ros.model.inertial_parameters import InertialParameters
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
        assert "has 'one', which is not a number; write" in refusal(f'{name}="{"one " * count}"')


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


def test_a_payload_is_welded_to_its_body() -> None:
    """Two points of 1 kg and 3 kg, 2 m apart, are as 0.75 kg of reduced mass at that distance."""
    point = with_first(masses=np.array(1.0), centers=np.zeros(3), inertias=np.zeros((3, 3)))
    loaded = point.with_payload(0, Inertia(3.0, np.array([0.0, 2.0, 0.0])))
    assert loaded.masses[0] == 4.0
    assert loaded.centers[0].tolist() == [0.0, 1.5, 0.0]
    np.testing.assert_allclose(loaded.inertias[0], np.diag([3.0, 0.0, 3.0]), atol=1e-12)
    np.testing.assert_array_equal(loaded.masses[1:], ARM.masses[1:])


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
