"""A robot with two branches, sliders, a joint that follows another one, and all kinds of solids."""

from __future__ import annotations

from pathlib import Path

from spacerobot_ros.model import load_robot
from spacerobot_ros.model.description import RobotDescription

_LINK = """<link name="{name}"><inertial><origin xyz="0.1 0 0"/><mass value="2"/>
  <inertia ixx="0.1" ixy="0" ixz="0" iyy="0.2" iyz="0" izz="0.3"/></inertial>
  <visual><origin xyz="{at}" rpy="0.3 -0.2 0.5"/><geometry>{shape}</geometry></visual></link>"""

_JOINT = """<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>
  <origin xyz="{at}" rpy="0.4 -0.7 1.1"/><axis xyz="0.6 0 0.8"/>
  <limit lower="-2" upper="1.5" effort="9" velocity="1"/>{mimic}</joint>"""


def branched_robot(folder: Path) -> RobotDescription:
    """Return the robot, from a URDF in a folder."""
    links = {
        "base": ("0 0 0.1", '<box size="0.5 0.4 0.3"/>'),
        "a1": ("0.2 0 0", '<cylinder radius="0.05" length="0.4"/>'),
        "a2": ("0.1 0.2 0", '<box size="0.3 0.2 0.25"/>'),
        "a3": ("0 0 0.2", '<sphere radius="0.08"/>'),
        "b1": ("0 0.1 0.2", '<box size="0.06 0.3 0.25"/>'),
        "b2": ("0.2 0.1 0", '<cylinder radius="0.06" length="0.5"/>'),
    }
    joints = [
        ("b_slide", "prismatic", "base", "b1", "0.1 0.5 0", ""),
        ("a_turn", "revolute", "base", "a1", "0.4 0 0.1", ""),
        ("a_slide", "prismatic", "a1", "a2", "0.5 0.1 0", ""),
        ("a_follow", "revolute", "a2", "a3", "0.3 0 0.2", "a_turn"),
        ("b_turn", "revolute", "b1", "b2", "0 0.4 0.1", ""),
    ]
    text = "".join(_LINK.format(name=k, at=at, shape=shape) for k, (at, shape) in links.items())
    for name, kind, parent, child, at, leader in joints:
        mimic = f'<mimic joint="{leader}" multiplier="-0.7" offset="0.2"/>' if leader else ""
        text += _JOINT.format(name=name, kind=kind, parent=parent, child=child, at=at, mimic=mimic)
    path = folder / "branched.urdf"
    path.write_text(f'<robot name="branched">{text}</robot>', encoding="utf-8")
    return load_robot(path)
