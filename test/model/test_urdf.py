"""What a URDF is read as, what is refused, and which obstacles a text is."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from scipy.spatial.transform import Rotation
from support.crossing import URDF
from support.oracles import PinocchioOracle, assert_agrees
from support.random_robots import random_robot_urdf

from spacerobot_ros.errors import ParameterError, RobotDescriptionError
from spacerobot_ros.model import SpaceRobot, load_robot, parse_robot
from spacerobot_ros.model.description import Array, Inertia, Shape
from spacerobot_ros.model.inertial_parameters import InertialParameters
from spacerobot_ros.model.shared_parameters import RobotConfig, robot_of
from spacerobot_ros.model.urdf import (
    links_with_shapes,
    obstacles_from_topic,
    parse_world,
    with_srdf,
    with_world,
)
from spacerobot_ros.resources import robot_file

UNIT = '<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/>'
BODY = f'<inertial><mass value="2"/>{UNIT}</inertial>'
POINT = BODY.replace('"1"', '"0"')
LIMIT = '<limit lower="-1" upper="1" velocity="0.5" effort="3"/>'


def link(name: str, content: str = BODY) -> str:
    return f'<link name="{name}">{content}</link>'


def joint(
    name: str, kind: str, parent: str, child: str, content: str = f'<axis xyz="0 0 1"/>{LIMIT}'
) -> str:
    ends = f'<parent link="{parent}"/><child link="{child}"/>'
    return f'<joint name="{name}" type="{kind}">{ends}{content}</joint>'


def robot(*elements: str) -> str:
    return f'<robot name="probe">{"".join(elements)}</robot>'


HULL, ARM = link("Hull"), link("Arm")
ELBOW = joint("Elbow", "revolute", "Hull", "Arm")


def elbow_with(content: str) -> str:
    return robot(HULL, ARM, joint("Elbow", "revolute", "Hull", "Arm", content))


ON_AXES = [
    link(f"M{axis}", POINT)
    + joint(f"S{axis}", "prismatic", "Hull", f"M{axis}", f'<axis xyz="{xyz}"/>{LIMIT}')
    for axis, xyz in (("x", "1 0 0"), ("y", "0 1 0"), ("z", "0 0 1"))
]


@pytest.mark.parametrize(
    "elements",
    [
        (HULL, link("Arm", POINT.replace("<mass", '<origin xyz="0 0 1"/><mass')), ELBOW),
        # Three point masses through the centre leave a point-mass base no moment at zero.
        (link("Hull", POINT), *ON_AXES),
    ],
    ids=["a point mass on its axis", "a base without inertia"],
)
def test_what_turns_without_moving_any_mass_is_refused(elements: tuple[str, ...]) -> None:
    description = parse_robot(robot(*elements))
    with pytest.raises(RobotDescriptionError, match=r"robot 'probe' is not positive definite"):
        SpaceRobot(description)


def test_shape_of_the_wrong_length_is_refused() -> None:
    found = SpaceRobot(parse_robot(robot(HULL, ARM, ELBOW)))
    with pytest.raises(ValueError, match=r"connection: q has 2 numbers, not 1"):
        found.connection([0.1, 0.2])


# -- what is accepted -------------------------------------------------------------------------


def test_limits() -> None:
    names = ("turns", "slides", "spins", "free")
    found = parse_robot(
        robot(
            HULL,
            *(link(f"l_{name}") for name in names),
            joint("turns", "revolute", "Hull", "l_turns"),
            joint("slides", "prismatic", "Hull", "l_slides", LIMIT.replace("-1", "-0.2")),
            joint("spins", "continuous", "Hull", "l_spins", LIMIT),
            joint("free", "continuous", "Hull", "l_free", ""),
        )
    )
    inf = np.inf
    assert found.joint_names == names
    assert found.limits("lower").tolist() == [-1.0, -0.2, -inf, -inf]
    assert found.limits("upper").tolist() == [1.0, 1.0, inf, inf]
    assert found.limits("velocity").tolist() == [0.5, 0.5, 0.5, inf]
    assert found.limits("effort").tolist() == [3.0, 3.0, 3.0, inf]


def test_limits_of_any_size_stand_for_none() -> None:
    limit = LIMIT.replace('"-1"', '"-1e16"').replace('"1"', '"1e4"')
    text = robot(HULL, ARM, joint("turns", "revolute", "Hull", "Arm", limit))
    found = parse_robot(text)
    assert (found.limits("lower")[0], found.limits("upper")[0]) == (-np.inf, np.inf)


def test_an_attitude_by_a_quaternion_is_that_of_pinocchio() -> None:
    turned = Rotation.from_rotvec([0.3, -0.7, 0.5])
    numbers = " ".join(map(str, turned.as_quat()))
    origin = f'<origin xyz="0.3 0.1 -0.2" quat_xyzw="{numbers}"/>'
    elbow = joint("elbow", "revolute", "Hull", "Arm", LIMIT + origin)
    text = robot(HULL, ARM, elbow).replace("<robot", '<robot version="1.1"')
    (found,) = [each for each in parse_robot(text).bodies if each.joint]
    (theirs,) = list(pin.buildModelFromXML(text).jointPlacements)[1:]
    np.testing.assert_allclose(found.origin.R, theirs.rotation, atol=1e-12)
    np.testing.assert_allclose(found.origin.R, turned.as_matrix(), atol=1e-12)
    with pytest.raises(RobotDescriptionError, match="has both 'rpy' and 'quat_xyzw'"):
        parse_robot(robot(HULL, ARM, elbow.replace("quat_xyzw", 'rpy="0 0 1" quat_xyzw')))
    with pytest.raises(RobotDescriptionError, match="has the unknown attribute 'rpw'"):
        parse_robot(robot(HULL, ARM, elbow.replace("quat_xyzw", "rpw")))


def test_axis_is_scaled_to_length_one_and_x_by_default() -> None:
    found = parse_robot(elbow_with(f'<axis xyz="0 3 4"/>{LIMIT}'))
    assert_agrees(found.movable_joints[0].axis, [0.0, 0.6, 0.8])
    assert parse_robot(elbow_with(LIMIT)).movable_joints[0].axis.tolist() == [1.0, 0.0, 0.0]


def test_base_may_carry_its_mass_on_a_fixed_link() -> None:
    text = robot(
        link("base_link", ""), HULL, ARM, joint("Mount", "fixed", "base_link", "Hull"), ELBOW
    )
    found = parse_robot(text)
    assert found.base_link == "base_link"
    assert found.total_mass == 4.0
    assert found.joint_names == ("Elbow",)


def test_rotor_without_mass_but_with_inertia() -> None:
    rotor = link("Arm", BODY.replace('value="2"', 'value="0"'))
    found = SpaceRobot(parse_robot(robot(HULL, rotor, ELBOW)))
    # Two equal moments about z: the hull turns back by half of what the rotor turns.
    assert_agrees(found.connection([0.3])[:, 0], [0, 0, 0, 0, 0, 0.5])


def test_of_several_materials_the_first_counts_and_one_scale_is_for_all_axes() -> None:
    colours = '<material name="first"/><material name="other"><color rgba="0 1 0 1"/></material>'
    form = '<geometry><mesh filename="package://a/b.stl" scale="0.5"/></geometry>'
    content = f"<visual>{form}{colours}</visual><collision>{form}{colours}</collision>"
    first = '<material name="first"><color rgba="1 0 0 1"/></material>'
    hull = parse_robot(robot(first, link("Hull", BODY + content))).links[0]
    for (shape,) in (hull.shapes, hull.collisions):
        assert (shape.size, shape.rgba) == ((0.5, 0.5, 0.5), (1.0, 0.0, 0.0, 1.0))


def test_visuals() -> None:
    content = """
      <visual><origin xyz="1 2 3" rpy="0 0 1.5707963267948966"/>
        <geometry><box size="1 2 3"/></geometry><material name="red"/></visual>
      <visual><geometry><cylinder radius="0.5" length="2"/></geometry>
        <material name="own"><color rgba="0 1 0 0.5"/></material></visual>
      <visual><geometry><sphere radius="0.25"/></geometry></visual>
      <visual><geometry><mesh filename="package://a/b.stl" scale="1 1 2"/></geometry></visual>"""
    red = '<material name="red"><color rgba="1 0 0 1"/></material>'
    box, cylinder, sphere, mesh = (
        parse_robot(robot(red, link("Hull", BODY + content))).links[0].shapes
    )
    assert (box.kind, box.size, box.rgba) == ("box", (1.0, 2.0, 3.0), (1.0, 0.0, 0.0, 1.0))
    assert box.pose.r.tolist() == [1.0, 2.0, 3.0]
    assert_agrees(box.pose.R @ [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    assert (cylinder.kind, cylinder.size) == ("cylinder", (0.5, 2.0))
    assert cylinder.rgba == (0.0, 1.0, 0.0, 0.5)
    assert (sphere.kind, sphere.size, sphere.rgba) == ("sphere", (0.25,), Shape.rgba)
    assert (mesh.kind, mesh.size) == ("mesh", (1.0, 1.0, 2.0))
    assert mesh.resource == "package://a/b.stl"


# -- welding ----------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(60, 66))
def test_fixed_joints_are_welded_as_pinocchio_welds_them(seed: int) -> None:
    urdf = random_robot_urdf(np.random.default_rng(seed), joints=3 + seed % 4)
    found = parse_robot(urdf)
    model = PinocchioOracle(urdf, found.joint_names).model
    assert found.total_mass == pytest.approx(sum(i.mass for i in model.inertias), rel=1e-14)
    for body in found.bodies:
        name = body.joint.name if body.joint is not None else "root_joint"
        expected = model.inertias[model.getJointId(name)]
        assert_agrees(body.inertia.mass, expected.mass)
        assert_agrees(body.inertia.com, expected.lever)
        assert_agrees(body.inertia.about_com, expected.inertia)
    for name, (index, pose) in found.frames.items():
        frame = model.frames[model.getFrameId(name, pin.FrameType.BODY)]
        carrier = found.bodies[index].joint
        # Its name is another since Pinocchio 3.
        number = frame.parentJoint if hasattr(frame, "parentJoint") else frame.parent
        assert model.names[number] == (carrier.name if carrier else "root_joint")
        assert_agrees(pose.R, frame.placement.rotation)
        assert_agrees(pose.r, frame.placement.translation)


# -- obstacles in the world, carried by the text of a robot -------------------------------------


BALL = '<collision><geometry><sphere radius="0.3"/></geometry></collision>'
WORLD = f"""<?xml version="1.0"?>
<robot name="station"><link name="frame"/><link name="mast">{BALL}</link><link name="tip"/>
<joint name="a" type="fixed"><parent link="frame"/><child link="mast"/>
<origin xyz="1 2 3" rpy="0 0 1.5707963267948966"/></joint>
<joint name="b" type="fixed"><parent link="mast"/><child link="tip"/><origin xyz="1 0 0"/></joint>
</robot>"""


def test_the_text_of_a_robot_carries_its_world() -> None:
    world = parse_world(WORLD)
    assert [link.name for link in world.links] == ["frame", "mast", "tip"]
    assert world.frames["tip"][1].r == pytest.approx([1, 3, 3])
    robot = with_world(with_world(parse_robot(URDF), parse_world(WORLD)), world)
    again = parse_robot(robot.urdf)
    assert robot.urdf.count("<world>") == 1
    assert again.world is not None
    assert again.world.name == "station"
    assert again.joint_names == parse_robot(URDF).joint_names
    assert np.array_equal(again.world.frames["mast"][1].R, world.frames["mast"][1].R)
    assert again.with_locked({"x": 0.1}).world is again.world


@pytest.mark.parametrize(
    "comment", ["<!-- end of </robot> -->", "<!-- no <world> here -->", "<!-- </world> -->"]
)
@pytest.mark.parametrize("after", [False, True])
def test_obstacles_disabled_pairs_and_comments_get_along(
    comment: str, after: bool, tmp_path: Path
) -> None:
    end = f"</robot>{comment}" if after else f"{comment}</robot>"
    srdf = tmp_path / "robot.srdf"
    first, second = (link.name for link in parse_robot(URDF).links[:2])
    srdf.write_text(
        f'<robot><disable_collisions link1="{first}" link2="{second}"/></robot>', "utf-8"
    )
    robot = parse_robot(URDF.replace("</robot>", end))
    robot = with_srdf(with_world(robot, parse_world(WORLD)), srdf)
    again = parse_robot(robot.urdf)
    assert again.world is not None
    assert links_with_shapes(again.world) == ["mast"]
    assert again.disabled_collisions == {frozenset({first, second})}
    assert len(pin.buildModelFromXML(robot.urdf).names) - 1 == len(again.joint_names)


def test_a_node_has_the_world_of_its_parameter(tmp_path: Path) -> None:
    file = tmp_path / "station.urdf"
    file.write_text(WORLD, "utf-8")
    robot = robot_of(RobotConfig(robot_description=URDF, world=str(file)))
    assert robot is not None
    assert robot.description.world is not None
    with pytest.raises(ParameterError, match=r"Parameter 'world' is invalid: .* cannot be read"):
        robot_of(RobotConfig(robot_description=URDF, world=str(tmp_path / "none.urdf")))


# -- obstacles in texts from topics, and robots among others than so far -------------------------


BALL_AND_POST = (
    '<robot name="w"><link name="w"/><link name="ball"><collision><geometry><sphere radius="0.3"/>'
    '</geometry></collision></link><link name="post"><visual><geometry><box size="1 2 3"/>'
    '</geometry></visual></link><joint name="a" type="fixed"><parent link="w"/>'
    '<child link="ball"/></joint><joint name="b" type="fixed"><parent link="ball"/>'
    '<child link="post"/></joint></robot>'
)


def test_a_text_is_obstacles_and_an_empty_one_is_none() -> None:
    world = obstacles_from_topic(BALL_AND_POST)
    assert world is not None
    assert links_with_shapes(world) == ["ball", "post"]
    for empty in ("", " \n"):
        assert obstacles_from_topic(empty) is None


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            BALL_AND_POST.replace('"a" type="fixed"', '"a" type="continuous"'),
            "joint 'a' is (floating|continuous): give it",
        ),
        ('<robot name="w"><link name="w"/></robot>', "The world 'w' has no obstacle"),
        ("<robot", "is not XML"),
        (
            BALL_AND_POST.replace("</robot>", f"<world>{BALL_AND_POST}</world></robot>"),
            "^Obstacles cannot contain obstacles: remove <world>",
        ),
        (BALL_AND_POST.replace("0.3", "${radius}"), "radius"),
    ],
)
def test_other_texts_are_refused(text: str, message: str) -> None:
    with pytest.raises(RobotDescriptionError, match=message):
        obstacles_from_topic(text)


def test_a_robot_is_among_the_obstacles_that_came_last() -> None:
    robot = load_robot(robot_file("planar_chain"))
    before = with_world(robot, parse_world(BALL_AND_POST.replace("ball", "stone")))
    other = with_world(before, parse_world(BALL_AND_POST))
    assert other.world is not None
    carried = parse_robot(other.urdf).world
    assert carried is not None
    assert links_with_shapes(carried) == ["ball", "post"]
    free = with_world(other, None)
    assert free.world is None
    assert parse_robot(free.urdf).world is None
    assert "<world" not in free.urdf


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
        ("mimic", "multiplier", 1, False, "ratio of its motion to that of the leading joint"),
        ("mimic", "offset", 1, False, "m or rad"),
        ("box", "size", 3, True, "m"),
        ("cylinder", "radius", 1, True, "m"),
        ("cylinder", "length", 1, True, "m"),
        ("sphere", "radius", 1, True, "m"),
        ("mesh", "scale", 3, False, "factors along x, y and z"),
        ("color", "rgba", 4, True, "red, green, blue and opacity, from 0 to 1"),
        ("parent", "link", 0, True, "the name of a link"),
        ("child", "link", 0, True, "the name of a link"),
        ("mimic", "joint", 0, True, "the name of the joint to follow"),
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

    numbers = {0: "", 1: "a number, "}.get(count, f"{count} numbers separated by spaces, ")
    remedy = f'; write <{tag} {name}="..."/>: {numbers}{meaning}.'
    if needed:
        missing = refusal("")
        assert f"has no '{name}'" in missing
        assert missing.endswith(remedy)
    if count:
        for words in (found[2].split()[1:], [*found[2].split(), "1"]):
            text = refusal(f'{name}="{" ".join(words)}"')
            assert f"has {len(words)} number{'s' * (len(words) != 1)} instead of {count}" in text
            assert text.endswith(remedy)
        assert "has 'one', which is not a number; write" in refusal(f'{name}="{"one " * count}"')
        assert "is not finite: " in refusal(f'{name}="{"nan " * count}"')


# -- masses -------------------------------------------------------------------------------------

ARM_MASSES = InertialParameters.of(load_robot(robot_file("three_joint_arm")))
BODIES = len(ARM_MASSES.masses)
NAMES = [f"body_{k}" for k in range(BODIES)]


def with_first(**changed: Array) -> InertialParameters:
    """Return the arm with other numbers of its first body."""
    arrays = {name: getattr(ARM_MASSES, name).copy() for name in ("masses", "centers", "inertias")}
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
    np.testing.assert_array_equal(loaded.masses[1:], ARM_MASSES.masses[1:])


@pytest.mark.parametrize(
    ("changed", "sentence"),
    [
        ({"masses": np.nan}, "A mass, centre or inertia of 'body_0' is not finite."),
        ({"masses": -0.5}, "The mass of 'body_0' is -0.5 kg; it must be positive."),
        ({"masses": 0.0}, None),
        ({"inertias": np.diag([1.0, 1.0, 2.02])}, None),
        (
            {"inertias": np.diag([1.0, 1.0, 2.03])},
            "The inertia of 'body_0' is not physical: its principal moments are 1, 1, 2.03 kg m^2.",
        ),
        (
            {"inertias": np.diag([-1e-9, 1.0, 1.0])},
            "The inertia of 'body_0' is not physical: its principal moments are -1e-09, 1, 1 kg "
            "m^2.",
        ),
    ],
)
def test_masses_that_no_body_has_are_refused(changed: dict[str, Array], sentence: str) -> None:
    batch = InertialParameters.stacked([ARM_MASSES, with_first(**changed)])
    if sentence is None:
        batch.require_physical(NAMES)
        return
    with pytest.raises(RobotDescriptionError) as refused:
        batch.require_physical(NAMES)
    assert str(refused.value) == sentence
    nothing = InertialParameters(0 * ARM_MASSES.masses, ARM_MASSES.centers, ARM_MASSES.inertias)
    with pytest.raises(RobotDescriptionError, match=r"The total robot mass is zero\."):
        nothing.require_physical(NAMES)
