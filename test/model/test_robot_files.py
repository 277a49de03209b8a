"""Robots in files: URDF and xacro, other formats, their meshes; and what is said of each."""

from __future__ import annotations

from pathlib import Path

import pytest

from spacerobot_ros.errors import ParameterError, RobotDescriptionError
from spacerobot_ros.model import load_robot
from spacerobot_ros.model.urdf import mesh_file
from spacerobot_ros.resources import robot_file

INERTIAL = """<inertial><mass value="{mass}"/>
    <inertia ixx="{ixx}" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>"""
LIMIT = '<limit lower="-1" upper="1" velocity="0.5" effort="3"/>'


def urdf(
    mass: str = "9", ixx: str = "1", visual: str = "", limit: str = LIMIT, attribute: str = ""
) -> str:
    """Return a hull that carries an arm."""
    return f"""<?xml version="1.0"?>
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


@pytest.mark.parametrize("name", ["probe.urdf.xacro", "probe.xacro", "probe.urdf"])
def test_a_xacro_file_is_expanded(tmp_path: Path, name: str) -> None:
    heading = ' xmlns:xacro="http://www.ros.org/wiki/xacro"'
    text = urdf(mass="${3 * unit}", attribute=heading)
    text = text.replace("  <link", '  <xacro:property name="unit" value="14"/>\n  <link', 1)
    found = load_robot(file_with(tmp_path, text, name))
    assert found.bodies[0].inertia.mass == 42.0
    assert "xacro:property" not in found.urdf


def test_a_xacro_file_that_cannot_be_expanded_is_refused(tmp_path: Path) -> None:
    heading = ' xmlns:xacro="http://www.ros.org/wiki/xacro"'
    path = file_with(tmp_path, urdf(mass="${no_such}", attribute=heading), "probe.xacro")
    with pytest.raises(RobotDescriptionError, match=r"cannot be expanded: .*no_such"):
        load_robot(path)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("name:password:0:0\n", r"not valid URDF: it is no XML"),
        ("<sdf version='1.9'><model name='a'/></sdf>", r"but an SDF model: .* <sdf>"),
        ("<mujoco><worldbody/></mujoco>", r"but a MuJoCo model: .* <mujoco>"),
        ("<html><body/></html>", r"but something else: .* <html>"),
        (urdf(mass="0"), r"base link 'hull' has no mass; .*<mass value=\"100\"/>"),
        (urdf(ixx="3"), r"inertia of link 'arm' is that of no body: .* 1, 1 and 3 kg m\^2"),
        (urdf(limit=""), r"joint 'elbow' is revolute and has no <limit>: give lower, upper"),
        (urdf(limit='<limit lower="-1" upper="1"/>'), r"not valid URDF: .*(effort|velocity)"),
        (urdf(mass="-1"), r"mass of link 'hull' is negative"),
        (urdf().replace('link="arm"', 'link="amr"'), r"is 'amr'.*mean 'arm'\?"),
        (urdf().replace('type="revolute"', 'type="floating"'), r"type of joint 'elbow'"),
        (urdf().replace("<joint", '<link name="hull"/><joint'), r"link name 'hull' is used twice"),
    ],
)
def test_a_file_that_is_no_robot_says_what_to_mend(
    tmp_path: Path, text: str, sentence: str
) -> None:
    path = file_with(tmp_path, text)
    with pytest.raises(RobotDescriptionError, match=sentence) as refusal:
        load_robot(path)
    assert str(path) in str(refusal.value)
    assert str(refusal.value).count("\n") == 0


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


def test_a_folder_and_a_misspelt_file_are_named(tmp_path: Path) -> None:
    (tmp_path / "robots").mkdir()
    with pytest.raises(ParameterError, match="is a folder; name the URDF file in it"):
        robot_file(str(tmp_path / "robots"))
    file_with(tmp_path, urdf(), "inspector.urdf")
    with pytest.raises(ParameterError, match=r"Did you mean 'inspector\.urdf'\?"):
        robot_file(str(tmp_path / "inspectr.urdf"))
