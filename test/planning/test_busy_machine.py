"""The same goals on an idle machine and on a busy one: the same schedules."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.planning import plan

LENGTHS = (0.3, 0.4, 0.35, 0.3, 0.25, 0.2, 0.15)
AXES = ("0 0 1", "0 1 0", "1 0 0", "0 1 0", "1 0 0", "0 1 0", "0 0 1")
TURNS = ([0.05, 0.0, 0.0], [0.1, -0.15, 0.2], [-0.3, 0.1, 0.25])
BUSY = 6


def seven_joint_arm() -> str:
    """Return an arm of seven joints on a base of 100 kg, as URDF."""

    def link(name: str, mass: float, size: float) -> str:
        x, y = mass * size**2 / 30, mass * size**2 / 10
        return (
            f'<link name="{name}"><inertial><origin xyz="{size / 2} 0 0"/><mass value="{mass}"/>'
            f'<inertia ixx="{x}" iyy="{y}" izz="{y}" ixy="0" ixz="0" iyz="0"/></inertial></link>'
        )

    parts = [link("base", 100.0, 1.0)]
    parent, reach = "base", 0.5
    for k, (length, axis) in enumerate(zip(LENGTHS, AXES, strict=True)):
        parts.append(link(f"link_{k}", 5.0 - 0.5 * k, length))
        parts.append(
            f'<joint name="joint_{k}" type="revolute"><parent link="{parent}"/>'
            f'<child link="link_{k}"/><origin xyz="{reach} 0 0"/><axis xyz="{axis}"/>'
            '<limit lower="-2.5" upper="2.5" velocity="0.8" effort="50"/></joint>'
        )
        parent, reach = f"link_{k}", length
    return f'<robot name="seven_joint_arm">{"".join(parts)}</robot>'


@pytest.mark.slow
def test_schedules_beside_busy_processes_are_those_of_an_idle_machine() -> None:
    robot, start = SpaceRobot.from_urdf(seven_joint_arm()), np.full(7, 0.3)

    def plans() -> list[bytes]:
        return [plan(robot, rotvec=x, start=start, cache=0).positions.tobytes() for x in TURNS]

    alone = plans()
    command = [sys.executable, "-c", "import sys\nwhile True:\n    pass"]
    busy = [subprocess.Popen(command) for _ in range(BUSY)]
    try:
        beside = plans()
        assert all(process.poll() is None for process in busy)
    finally:
        for process in busy:
            process.kill()
            process.wait()
    assert beside == alone
