"""Robots in files: URDF and xacro, other formats, their meshes; and what is said of each."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from support.command_line import CliRunner

from spacerobot_ros.cli.main import main
from spacerobot_ros.errors import RobotDescriptionError
from spacerobot_ros.model import SpaceRobot, load_robot, parse_robot
from spacerobot_ros.model.urdf import mesh_file
from spacerobot_ros.session.own_robot import urdf_remarks

INERTIAL = """<inertial><mass value="{mass}"/>
    <inertia ixx="{ixx}" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>"""
HEADING = ' xmlns:xacro="http://www.ros.org/wiki/xacro"'
LIMIT = '<limit lower="-1" upper="1" velocity="0.5" effort="3"/>'


def urdf(
    mass: str = "9", ixx: str = "1", visual: str = "", limit: str = LIMIT, attribute: str = ""
) -> str:
    """Return a hull that carries an arm."""
    return f"""<?xml version="1.0" encoding="UTF-8"?>
<robot name="probe"{attribute}>
  <link name="hull">{INERTIAL.format(mass=mass, ixx="1")}{visual}</link>
  <link name="arm">{INERTIAL.format(mass="2", ixx=ixx)}</link>
  <joint name="elbow" type="revolute"><parent link="hull"/><child link="arm"/>
    <axis xyz="0 0 1"/>{limit}</joint>
</robot>"""


def file_with(tmp_path: Path, text: str, name: str = "probe.urdf") -> Path:
    path = tmp_path / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, "utf-8")
    return path


@pytest.mark.parametrize("name", ["probe.urdf.xacro", "probe.xacro"])
def test_a_xacro_file_is_expanded(tmp_path: Path, name: str) -> None:
    text = urdf(mass="${3 * unit}", attribute=HEADING)
    text = text.replace("  <link", '  <xacro:property name="unit" value="14"/>\n  <link', 1)
    found = load_robot(file_with(tmp_path, text, name))
    assert found.bodies[0].inertia.mass == 42.0
    assert "xacro:property" not in found.urdf


def test_a_xacro_file_takes_its_arguments(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """By the command, and from the environment, where nodes and workers find them."""
    text = urdf(mass="$(arg mass)", attribute=HEADING)
    argument = '  <xacro:arg name="mass" default="7"/>\n  <link'
    path = file_with(tmp_path, text.replace("  <link", argument, 1), "probe.xacro")
    assert load_robot(path).bodies[0].inertia.mass == 7.0
    monkeypatch.setenv("SPACEROBOT_XACRO_ARGS", "mass:=9")
    assert load_robot(path).bodies[0].inertia.mass == 9.0
    words = ["--xacro-arg", "mass:=42", "--xacro-arg", "title:=two words", "analyze", str(path)]
    told = CliRunner().invoke(main, words)
    assert told.exit_code == 0, told.output
    assert re.search(r"44 kg", told.stdout)
    (ignored,) = caplog.messages
    assert ignored.endswith("no argument 'title', which is ignored; its arguments are: mass.")
    told = CliRunner().invoke(main, [*words[:4], "new", str(path), "-o", str(tmp_path / "s.yaml")])
    assert "  spacerobot --xacro-arg mass:=42 --xacro-arg 'title:=two words' run" in told.stdout
    CliRunner().invoke(main, ["--xacro-arg", "mas:=42", "analyze", str(path)])
    assert caplog.messages[-1].endswith("its arguments are: mass. Did you mean 'mass'?")
    refused = CliRunner().invoke(main, ["--xacro-arg", "mass=42", "analyze", str(path)])
    assert refused.exit_code == 2
    assert refused.stderr == "The xacro argument 'mass=42' is not of the form NAME:=VALUE.\n"


@pytest.mark.parametrize(
    ("mass", "reason"),
    [("${no_such}", ".*no_such"), ("$(arg kg)", "its argument 'kg' .* --xacro-arg kg:=VALUE ")],
)
def test_a_xacro_file_that_cannot_be_expanded_is_refused(
    tmp_path: Path, mass: str, reason: str
) -> None:
    path = file_with(tmp_path, urdf(mass=mass, attribute=HEADING), "probe.xacro")
    with pytest.raises(RobotDescriptionError, match=rf"cannot be expanded: {reason}"):
        load_robot(path)


def test_xacro_in_a_urdf_file_and_in_a_text_is_not_expanded(tmp_path: Path) -> None:
    text = urdf(mass="${3 * 14}", attribute=HEADING)
    with pytest.raises(RobotDescriptionError, match=r"rename it to probe\.xacro\.$"):
        load_robot(file_with(tmp_path, text, "probe.urdf"))
    with pytest.raises(RobotDescriptionError, match=r"'value' of the <mass> of link 'hull' has"):
        parse_robot(text)
    comment = "<!-- <xacro:read/>\n ${mass} -->"
    plain = urdf(mass="heavy").replace("  <link", f"  {comment}\n  <link", 1)
    assert comment in plain
    with pytest.raises(RobotDescriptionError) as refused:
        load_robot(file_with(tmp_path, plain, "probe.urdf"))
    assert "rename" not in str(refused.value)


def test_a_xacro_file_takes_macros_properties_lists_and_files_of_its_package(
    tmp_path: Path,
) -> None:
    file_with(tmp_path, "<package/>", "package.xml")
    file_with(tmp_path, "hull: {mass: 40.0}\nextra: [1.0, 2.0]\n", "config/masses.yaml")
    parts = (
        f'<robot{HEADING}><xacro:macro name="read" params="file:=masses">'
        '<xacro:property name="m" scope="parent"'
        " value=\"${xacro.load_yaml('../config/' + file + '.yaml')}\"/></xacro:macro></robot>"
    )
    file_with(tmp_path, parts, "urdf/parts.xacro")
    text = urdf(mass="${m.hull.mass + max(m['extra']) * (1 if pi > 3 else 0)}", attribute=HEADING)
    head = '<xacro:include filename="parts.xacro"/><xacro:read/>'
    text = text.replace("  <link", f"{head}\n  <link", 1)
    path = file_with(tmp_path, text, "urdf/probe.xacro")
    assert load_robot(path).bodies[0].inertia.mass == 42.0


@pytest.mark.parametrize(
    ("package", "folder"), [("probe_arm", "src/checkout"), ("probe_parts", "src/probe_arm")]
)
def test_a_package_is_found_by_its_name_from_its_own_files_and_those_beside_it(
    tmp_path: Path, package: str, folder: str
) -> None:
    """Folders of checkouts have names of their own; nothing is installed."""
    for name, where in (("probe_arm", "src/checkout"), ("probe_parts", "src/probe_arm")):
        file_with(tmp_path, f"<package><name>{name}</name></package>", f"{where}/package.xml")
    parts = f'<robot{HEADING}><xacro:property name="m" value="42"/></robot>'
    file_with(tmp_path / folder, parts, "urdf/probe.gazebo")
    file_with(tmp_path / folder, "solid hull", "meshes/hull.stl")
    mesh = f'<visual><geometry><mesh filename="package://{package}/meshes/hull.stl"/></geometry>'
    text = urdf(mass="${m}", attribute=HEADING, visual=f"{mesh}</visual>")
    head = f'<xacro:include filename="$(find {package})/urdf/probe.gazebo"/>'
    text = text.replace("  <link", f"{head}\n  <link", 1)
    found = load_robot(file_with(tmp_path / "src/checkout", text, "urdf/probe.xacro"))
    assert found.bodies[0].inertia.mass == 42.0
    assert found.links[0].shapes[0].resource == f"file://{tmp_path / folder}/meshes/hull.stl"


def test_a_package_that_is_nowhere_is_named(tmp_path: Path) -> None:
    text = urdf(attribute=HEADING).replace("  <link", "<a b='$(find no_such)'/><link", 1)
    with pytest.raises(
        RobotDescriptionError, match=r"expanded: the package 'no_such' was found neither"
    ):
        load_robot(file_with(tmp_path, text, "probe.xacro"))


@pytest.mark.parametrize(
    ("expression", "reason"),
    [
        # Of processor time, or of wall time on a busy machine.
        ("${9**9**9}", "needs too much time or memory|takes longer than"),
        ("${len('a' * 10**11)}", "cannot be expanded"),
    ],
)
def test_a_xacro_file_has_limits_of_time_and_memory(
    tmp_path: Path, expression: str, reason: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("spacerobot_ros.model.urdf._XACRO_CPU_TIME", 1)
    path = file_with(tmp_path, urdf(mass=expression, attribute=HEADING), "probe.xacro")
    with pytest.raises(RobotDescriptionError, match=reason):
        load_robot(path)


NO_INERTIA = '<inertia ixx="0" ixy="0" ixz="0" iyy="0" iyz="0" izz="0"/>'
SOME_INERTIA = '<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/>'
TOOL = '<link name="tool"><inertial><mass value="1"/>' + SOME_INERTIA + "</inertial></link>"
MASSLESS = '<link name="tool"/>'


def joint(name: str, parent: str, child: str, inner: str = "", kind: str = "revolute") -> str:
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<axis xyz="0 0 1"/>{LIMIT}{inner}</joint></robot>'
    )


def more(*parts: str) -> str:
    """Return the robot with more links and joints at its end."""
    return urdf().replace("</robot>", "".join(parts))


def seen(geometry: str) -> str:
    return urdf(visual=f"<visual><geometry>{geometry}</geometry></visual>")


def limited(limit: str) -> str:
    return urdf(limit=f"<limit {limit}/>")


def changed(before: str, after: str, count: int = -1) -> str:
    text = urdf()
    assert before in text
    return text.replace(before, after, count)


BROKEN = {
    # No URDF.
    "a password file": ("name:password:0:0\n", r"not valid URDF: it is not XML"),
    "nothing": ("", r"it is not XML \(no element found"),
    "half a file": (urdf()[:300], r"it is not XML \("),
    "SDF": ("<sdf version='1.9'><model name='a'/></sdf>", r"but an SDF model: .* <sdf>.* convert"),
    "MuJoCo": ("<mujoco><worldbody/></mujoco>", r"but a MuJoCo model: .* <mujoco>.* convert"),
    "a web page": ("<html><body/></html>", r"but something else: .* <html>"),
    "no name": (changed(' name="probe"', ""), r"the <robot> has no name; write <robot name="),
    "no link": ('<robot name="a"/>', r"exactly one root link .* found: none\. Give it a <link>"),
    # Masses and inertias.
    "a massless base": (urdf(mass="0"), r"base link 'hull' has no mass; .*<mass value=\"100\"/>"),
    "a base without inertial": (
        changed(INERTIAL.format(mass="9", ixx="1"), ""),
        r"base link 'hull' has no mass; a free-floating base needs an <inertial>",
    ),
    "a massless root": (
        changed('<link name="hull">', '<link name="world"/><link name="hull">').replace(
            "</robot>", joint("mount", "world", "hull")
        ),
        r"base link 'world' has no mass",
    ),
    "an arm without mass": (
        more(MASSLESS, joint("wrist", "arm", "tool")),
        r"joint 'wrist' can move without moving any mass, .*Give 'tool' an <inertia>.*fixed",
    ),
    "a slider without mass": (
        more(MASSLESS, joint("rail", "arm", "tool", kind="prismatic")),
        r"joint 'rail' can move without moving any mass",
    ),
    "a point on a hinge": (
        more(TOOL.replace(SOME_INERTIA, NO_INERTIA), joint("wrist", "arm", "tool")),
        r"joint 'wrist' can move without moving any mass, .*Give 'tool' an <inertia>.*fixed",
    ),
    "a point that carries": (
        changed(SOME_INERTIA, NO_INERTIA, 1),
        r"joint 'elbow' can move without moving any mass, .*Give 'hull' an <inertia>",
    ),
    "a point alone": (
        f'<robot name="probe"><link name="a"><inertial><mass value="2"/>{NO_INERTIA}</inertial>'
        "</link></robot>",
        r"not positive definite: it can rotate without moving any mass\. Give 'a' an <inertia>",
    ),
    "no mass in inertial": (
        changed('<mass value="2"/>', ""),
        r"the <inertial> of link 'arm' has no <mass>; write <mass value=\"\.\.\.\"/> in kg",
    ),
    "a negative mass": (urdf(mass="-1"), r"mass of link 'hull' is negative \(-1\.0 kg\)"),
    "negative inertia": (urdf(ixx="-1"), r"of link 'arm' has a negative principal moment; .*signs"),
    "a negative inertia by its products": (
        changed(SOME_INERTIA, SOME_INERTIA.replace('ixy="0"', 'ixy="1.5"'), 1),
        r"inertia of link 'hull' has a negative principal moment",
    ),
    "an impossible inertia": (
        urdf(ixx="3"),
        r"inertia of link 'arm' is not physical: .* 1, 1 and 3 kg m\^2, .* Check units",
    ),
    "a mass that is no number": (
        urdf(mass="nan"),
        r"A number in the <mass> of link 'hull' is not finite: nan",
    ),
    "an endless mass": (urdf(mass="inf"), r"<mass> of link 'hull' is not finite: inf"),
    "a mass in no unit": (
        urdf(mass="9e15"),
        r"in the <mass> of link 'hull' is larger than 1e\+12 in its SI unit",
    ),
    "a comma": (
        urdf(mass="9,5"),
        r"<mass> of link 'hull' has '9,5', which is not a number; write <mass value=",
    ),
    # Joints.
    "no limits": (
        urdf(limit=""),
        r"joint 'elbow' is revolute and has no <limit>: give lower, upper",
    ),
    "no range": (
        limited('velocity="1" effort="3"'),
        r"lower limit of joint 'elbow' \(0\.0\) is not below .*; give it a range, or make it fixed",
    ),
    "limits the wrong way round": (
        limited('lower="1" upper="-1" velocity="1" effort="3"'),
        r"lower limit of joint 'elbow' \(1\.0\) is not below its upper limit \(-1\.0\)",
    ),
    "a negative velocity": (
        limited('lower="-1" upper="1" velocity="-2" effort="3"'),
        r"The limit 'velocity' of joint 'elbow' is negative \(-2\.0\)",
    ),
    "a negative effort": (
        limited('lower="-1" upper="1" velocity="1" effort="-1"'),
        r"limit 'effort' of joint 'elbow' is negative",
    ),
    "an axis of zero length": (
        changed('<axis xyz="0 0 1"/>', '<axis xyz="0 0 0"/>'),
        r"The axis of joint 'elbow' is zero; give it a direction",
    ),
    "no type": (
        changed(' type="revolute"', ""),
        r"joint 'elbow' has no type; write type=.*revolute",
    ),
    "unknown type": (changed('"revolute"', '"ball"'), r"type of joint 'elbow' is 'ball'; .* fixed"),
    "a floating joint": (
        changed('"revolute"', '"floating"'),
        r"type of joint 'elbow' is 'floating'; .* The base floats .* remove .* joints in a row",
    ),
    "no parent": (
        changed('<parent link="hull"/>', ""),
        r"the joint 'elbow' has no <parent>; write <parent link=\"\.\.\.\"/>",
    ),
    "a misspelt link": (changed('link="arm"', 'link="amr"'), r"is 'amr'.*mean 'arm'\?"),
    "an unknown parent": (
        changed('parent link="hull"', 'parent link="hall"'),
        r"parent of joint 'elbow' is 'hall', but there is no such link",
    ),
    "a link without a name": (
        changed('<link name="arm">', "<link>"),
        r"the link number 2 has no name; write <link name=\"\.\.\.\">",
    ),
    "a joint without a name": (
        changed(' name="elbow"', ""),
        r"the joint number 1 has no name; write <joint name=\"\.\.\.\">",
    ),
    "a link twice": (
        changed("<joint", '<link name="hull"/><joint'),
        r"link name 'hull' is used twice",
    ),
    "a joint twice": (
        more(TOOL, joint("elbow", "arm", "tool")),
        r"joint name 'elbow' is used twice; names must be unique",
    ),
    # The tree.
    "two parents": (
        more(joint("other", "hull", "arm")),
        r"Link 'arm' is the child of two joints \('elbow' and 'other'\); .* remove one",
    ),
    "a ring": (
        more(joint("back", "arm", "hull")),
        r"exactly one root link .* found: none\. Remove a joint from the loop",
    ),
    "a ring beside the robot": (
        more(TOOL, joint("back", "tool", "tool")),
        r"Link 'tool' is not connected to the root: its joints form a loop\. Remove one",
    ),
    "two roots": (
        more(TOOL, "</robot>"),
        r"exactly one root link \(the base\); found: 'hull', 'tool'\. Connect 'tool' by a joint",
    ),
    # Joints that follow others.
    "a follower of nobody": (
        more(TOOL, joint("wrist", "arm", "tool", '<mimic joint="elbo"/>')),
        r"'wrist' mimics 'elbo', but there is no such joint\. Did you mean 'elbow'\?",
    ),
    "a follower of itself": (
        changed(LIMIT, LIMIT + '<mimic joint="elbow"/>'),
        r"joint 'elbow' mimics itself",
    ),
    "a follower that stands": (
        more(TOOL, joint("wrist", "arm", "tool", '<mimic joint="elbow" multiplier="0"/>')),
        r"'wrist' mimics 'elbow' with multiplier 0: it does not move; make it fixed",
    ),
    # Looks.
    "a cone": (
        seen('<cone radius="1" length="2"/>'),
        r"<geometry> of link 'hull' is a <cone>; write one of <box>, <cylinder>, <sphere>",
    ),
    "no shape": (seen(""), r"<geometry> of link 'hull' has 0 shapes; write one of <box>"),
    "no geometry": (
        urdf(visual="<visual/>"),
        r"the <visual> of link 'hull' has no <geometry>; write a <geometry> with one of box",
    ),
    "a negative size": (
        seen('<sphere radius="-1"/>'),
        r"size in a <geometry> of link 'hull' is negative: \[-1\.0\]\. Give lengths in m",
    ),
}


@pytest.mark.parametrize(("text", "sentence"), BROKEN.values(), ids=BROKEN)
def test_a_file_that_is_no_robot_says_what_to_mend(
    tmp_path: Path, text: str, sentence: str
) -> None:
    path = file_with(tmp_path, text)
    with pytest.raises(RobotDescriptionError, match=sentence) as refusal:
        SpaceRobot.from_file(path)
    assert str(path) in str(refusal.value) or "robot 'probe'" in str(refusal.value)
    assert str(refusal.value).count("\n") == 0
    assert "urdf_parser" not in str(refusal.value)
    assert "ParseError" not in str(refusal.value)


def test_other_encodings_are_asked_for_as_utf_8(tmp_path: Path) -> None:
    path = tmp_path / "probe.urdf"
    path.write_bytes(urdf().replace("probe", "Süd").encode("latin-1"))
    with pytest.raises(RobotDescriptionError, match=r"not UTF-8 text .*\. Save it as UTF-8"):
        load_robot(path)
    with pytest.raises(RobotDescriptionError, match=r"nowhere\.urdf cannot be read"):
        load_robot(tmp_path / "nowhere.urdf")
    path.write_bytes(b"\xef\xbb\xbf" + urdf().replace("probe", "Süd").encode())
    assert load_robot(path).name == "Süd"
    assert parse_robot(urdf().replace("probe", "Süd")).name == "Süd"


def test_what_other_programs_have_written_is_passed_over(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """Collision shapes, transmissions, plugins and safety controllers are nothing to a flight."""
    collision = "<collision><geometry><plane radius='1' length='2'/></geometry></collision>"
    text = urdf(visual=collision, limit=LIMIT + '<safety_controller k_velocity="x"/>')
    control = (
        '<ros2_control name="arm" type="system"><hardware><plugin>a/b</plugin></hardware>'
        '<joint name="elbow"><command_interface name="effort"/></joint></ros2_control>'
    )
    others = f'<gazebo reference="arm"><a b="c"/></gazebo><transmission/>{control}</robot>'
    found = load_robot(file_with(tmp_path, text.replace("</robot>", others)))
    assert (found.name, found.joint_names, found.total_mass) == ("probe", ("elbow",), 11.0)
    assert "plane" in found.urdf
    captured = capfd.readouterr()
    assert captured.out + captured.err == ""


def test_limits_that_motions_do_not_keep_are_named_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    soft = '<safety_controller soft_lower_limit="-0.1" soft_upper_limit="0.1" k_velocity="1"/>'
    text = urdf(limit=LIMIT.replace("<limit", '<limit acceleration="1" jerk="2"') + soft)
    file = file_with(tmp_path, text.replace('name="probe"', 'name="jerky"'))
    for _ in range(2):
        load_robot(file)
    (line,) = caplog.messages
    named = (
        "The limits of acceleration, jerk and safety_controller in the URDF of 'jerky' are ignored"
    )
    assert line.startswith(named)


def test_limits_of_a_follower_that_leave_its_leader_no_range_are_ignored(
    caplog: pytest.LogCaptureFixture,
) -> None:
    # Grippers whose fingers turn towards each other are often written with the limits of one.
    follower = joint("wrist", "arm", "tool", '<mimic joint="elbow" multiplier="-1" offset="-7"/>')
    robot = parse_robot(more(TOOL, follower))
    alone = parse_robot(urdf())
    assert robot.limits("lower") == alone.limits("lower")
    assert robot.limits("upper") == alone.limits("upper")
    (line,) = caplog.messages
    assert line == (
        "The position limits of joint 'wrist' are ignored: they would leave 'elbow', which it "
        "mimics, no range. Check multiplier, offset and limits."
    )


def test_what_a_link_is_welded_to_makes_up_for_its_inertia(tmp_path: Path) -> None:
    """Antennas and mounts of many a public URDF have moments that no body has."""
    impossible = TOOL.replace(SOME_INERTIA, SOME_INERTIA.replace('ixx="1"', 'ixx="0.4"'))
    text = more(impossible.replace('izz="1"', 'izz="1.5"'), joint("mount", "arm", "tool"))
    with pytest.raises(RobotDescriptionError, match="link 'tool' is not physical"):
        load_robot(file_with(tmp_path, text))
    fixed = text.replace('name="mount" type="revolute"', 'name="mount" type="fixed"')
    robot = load_robot(file_with(tmp_path, fixed))
    found = [each for each in urdf_remarks(robot) if "not physical" in each]
    assert found == [next(each for each in found if "'tool'" in each and "welded" in each)]


def test_textures_are_passed_over(tmp_path: Path) -> None:
    visual = (
        '<visual><geometry><sphere radius="1"/></geometry>'
        '<material name="skin"><texture/><color rgba="1 0 0 1"/></material></visual>'
    )
    robot = load_robot(file_with(tmp_path, urdf(visual=visual)))
    assert robot.links[0].shapes[0].rgba == (1.0, 0.0, 0.0, 1.0)


def test_of_a_fixed_joint_axis_and_limits_do_not_matter(tmp_path: Path) -> None:
    text = urdf(limit='<limit lower="1"/><mimic joint="nobody"/>').replace("revolute", "fixed")
    assert load_robot(file_with(tmp_path, text)).joint_names == ()


@pytest.mark.parametrize("ixx", ["0.001", "2.0", "2.01"])
def test_inertias_of_thin_rods_and_plates_are_accepted(tmp_path: Path, ixx: str) -> None:
    """A plate has ixx = iyy + izz, with the digits that its author has written."""
    assert load_robot(file_with(tmp_path, urdf(ixx=ixx))).total_mass == 11.0


@pytest.mark.parametrize("uri", ["meshes/hull.stl", "package://probe_description/meshes/hull.stl"])
def test_a_mesh_beside_the_urdf_is_found_from_anywhere(tmp_path: Path, uri: str) -> None:
    folder = tmp_path / "probe_description"
    visual = f'<visual><geometry><mesh filename="{uri}"/></geometry></visual>'
    path = file_with(folder, urdf(visual=visual))
    (folder / "meshes").mkdir()
    mesh = folder / "meshes" / "hull.stl"
    assert mesh_file(load_robot(path).links[0].shapes[0].resource) is None
    mesh.write_bytes(b"solid hull")
    found = load_robot(path)
    assert found.links[0].shapes[0].resource == f"file://{mesh}"
    assert mesh_file(found.links[0].shapes[0].resource) == mesh
    assert f"file://{mesh}" in found.urdf


def test_meshes_of_this_package_are_found_without_a_ros_environment() -> None:
    found = mesh_file("package://spacerobot_ros/package.xml")
    assert found is None or found.name == "package.xml"
    assert mesh_file("package://no_such_package/a.stl") is None
    assert mesh_file("http://example.org/a.stl") is None
