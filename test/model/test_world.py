"""Obstacles in the world: URDF files without moving joints, carried by the text of a robot."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.crossing import URDF

from spacerobot_ros.errors import ParameterError, RobotDescriptionError
from spacerobot_ros.model import parse_robot
from spacerobot_ros.model.shared_parameters import RobotConfig, robot_of
from spacerobot_ros.model.urdf import load_world, parse_world
from spacerobot_ros.model.world import with_world
from spacerobot_ros.resources import share_directory

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
    ("change", "message"),
    [
        (('name="b" type="fixed"', 'name="b" type="continuous"'), "joint 'b' is continuous"),
        ((BALL, ""), "The world 'station' has no obstacle"),
        (("</robot>", ""), "is no XML"),
    ],
)
def test_a_world_that_is_none_is_refused(change: tuple[str, str], message: str) -> None:
    with pytest.raises(RobotDescriptionError, match=message):
        parse_world(WORLD.replace(*change))


def test_a_node_has_the_world_of_its_parameter(tmp_path: Path) -> None:
    file = tmp_path / "station.urdf"
    file.write_text(WORLD, "utf-8")
    robot = robot_of(RobotConfig(robot_description=URDF, world=str(file)))
    assert robot is not None
    assert robot.description.world is not None
    with pytest.raises(ParameterError, match=r"Parameter 'world' is refused: .* cannot be read"):
        robot_of(RobotConfig(robot_description=URDF, world=str(tmp_path / "none.urdf")))


def test_the_package_has_a_world() -> None:
    world = load_world(share_directory() / "config" / "worlds" / "strut.urdf")
    assert [link.name for link in world.links if link.collisions] == ["strut"]
