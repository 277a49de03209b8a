"""Robots with reaction wheels: the text of a URDF whose wheels lie askew among the joints."""

from __future__ import annotations

from spacerobot_ros.model import SpaceRobot

LIMIT = '<limit velocity="200" effort="0.3"/>'
ROUND = '<inertia ixx="0.02" ixy="0" ixz="0" iyy="0.02" iyz="0" izz="0.03"/>'


def link(name: str, mass: float, com: str, inertia: str) -> str:
    inertial = f'<inertial><origin xyz="{com}"/><mass value="{mass}"/>{inertia}</inertial>'
    return f'<link name="{name}">{inertial}</link>'


def joint(name: str, kind: str, parent: str, place: str, content: str) -> str:
    ends = f'<parent link="{parent}"/><child link="{name}_body"/>'
    return f'<joint name="{name}" type="{kind}">{ends}{place}{content}</joint>'


def wheel(name: str, place: str, content: str = f"{LIMIT}<wheel/>", **changes: str) -> str:
    """Return a wheel about the axis z of its frame; ``changes`` replace parts of it."""
    body = {"com": "0 0 0.01", "inertia": ROUND, "parent": "hull", "kind": "continuous"} | changes
    text = link(f"{name}_body", 3.0, body["com"], body["inertia"])
    axis = '<axis xyz="0 0 1"/>'
    return text + joint(name, body["kind"], body["parent"], place, axis + content)


HULL = link(
    "hull", 40.0, "0.1 -0.05 0.02",
    '<inertia ixx="3" ixy="0.1" ixz="-0.2" iyy="2.5" iyz="0.15" izz="2"/>',
)  # fmt: skip
ARM = link(
    "elbow_body", 4.0, "0.3 0.02 -0.04",
    '<inertia ixx="0.02" ixy="0" ixz="0.01" iyy="0.2" iyz="0" izz="0.21"/>',
)  # fmt: skip
ELBOW = joint(
    "elbow", "revolute", "hull", '<origin xyz="0.4 0 0.2" rpy="0.3 -0.2 0.5"/>',
    '<axis xyz="0 1 0"/><limit lower="-2" upper="2" velocity="0.5" effort="9"/>',
)  # fmt: skip
WHEELS = (
    wheel("spin_c", '<origin xyz="0.1 0.2 -0.1" rpy="0.4 0.2 0"/>'),
    wheel(
        "spin_a", '<origin xyz="-0.1 0.1 0" rpy="1.4 -0.3 0.6"/>',
        '<limit velocity="300" effort="0.2"/><wheel/>',
    ),
    wheel("spin_b", '<origin xyz="0 -0.2 0.1" rpy="0.1 1.5 -0.4"/>'),
)  # fmt: skip


def text(*parts: str) -> str:
    return f'<robot name="gyro">{"".join(parts)}</robot>'


def wheeled_robot() -> SpaceRobot:
    """Return a robot with two wheels, an elbow and a third wheel."""
    return SpaceRobot.from_urdf(text(HULL, *WHEELS[:2], ARM, ELBOW, WHEELS[2]))
