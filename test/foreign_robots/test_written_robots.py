"""Legs, arms, a snake and a light base, written for this test: plans within bounds of time.

Each robot is limbs of equal boxes on a box, and turns to an attitude, with a position of the base,
and with a shape.
"""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from planning.drifting import angle_between, flown_by_pinocchio
from scipy.spatial.transform import Rotation

from spacerobot_ros.errors import UnreachableError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.planning import RobotState, plan
from spacerobot_ros.planning.core.clearance import Clearance

SEED = int(os.environ.get("SPACEROBOT_WRITTEN_SEED", "46"))

LONGEST_SEARCH = 30.0
"""Processor time of a plan, s; a busy machine takes longer than an idle one."""

TURN = np.array([0.2, -0.15, 0.25])


@dataclass(frozen=True)
class Limb:
    """A chain of boxes.

    Attributes
    ----------
    at, way
        (3,) where it begins in the base, m, and the direction of the links.
    axes
        Axes of its joints, as letters.
    length, width, mass
        Of each link: m, m and kg.
    """

    at: Sequence[float]
    way: Sequence[float]
    axes: str
    length: float
    width: float
    mass: float


def robot_urdf(
    size: Sequence[float], mass: float, limbs: Sequence[Limb], rate: float, reach: float
) -> str:
    """Return a robot whose joints turn by ``reach``, rad, either way, at a ``rate``, rad/s."""
    parts = [link("base_link", size, mass, np.zeros(3))]
    for number, limb in enumerate(limbs):
        parent, at, way = "base_link", np.asarray(limb.at), np.asarray(limb.way)
        for k, axis in enumerate(limb.axes):
            name = f"limb_{number}_{k}"
            # Neighbours nearly touch.
            box = limb.width + (0.96 * limb.length - limb.width) * np.abs(way)
            parts.append(link(name, box, limb.mass, limb.length / 2 * way))
            unit = " ".join("1" if letter == axis else "0" for letter in "xyz")
            parts.append(
                f'<joint name="{name}" type="revolute"><parent link="{parent}"/>'
                f'<child link="{name}"/><origin xyz="{text(at)}"/><axis xyz="{unit}"/>'
                f'<limit lower="{-reach}" upper="{reach}" velocity="{rate}" effort="1e6"/></joint>'
            )
            parent, at = name, limb.length * way
    return f'<robot name="written">{"".join(parts)}</robot>'


def link(name: str, size: Sequence[float] | Array, mass: float, center: Array) -> str:
    squares = np.square(size)
    ixx, iyy, izz = mass / 12 * (squares.sum() - squares)
    return (
        f'<link name="{name}"><inertial><origin xyz="{text(center)}"/><mass value="{mass}"/>'
        f'<inertia ixx="{ixx}" ixy="0" ixz="0" iyy="{iyy}" iyz="0" izz="{izz}"/></inertial>'
        f'<collision><origin xyz="{text(center)}"/><geometry><box size="{text(size)}"/></geometry>'
        "</collision></link>"
    )


def text(values: Sequence[float] | Array) -> str:
    return " ".join(f"{value:.9g}" for value in values)


LEGS = [
    Limb((0.22 * x, 0.16 * y, 0.0), (0, 0, -1), "xyy", 0.2, 0.05, 0.8)
    for x in (-1, 1)
    for y in (-1, 1)
]
ARMS = [Limb((0.45, 0.3 * y, 0.0), (1, 0, 0), "xyzyxyx", 0.3, 0.1, 4.0) for y in (-1, 1)]
SNAKE = Limb((0.12, 0.0, 0.0), (1, 0, 0), "yzyzyzyzyz", 0.15, 0.08, 1.0)
HEAVY_ARM = Limb((0.1, 0.0, 0.0), (1, 0, 0), "yzy", 0.4, 0.08, 4.0)

ROBOTS = {
    "legs": robot_urdf((0.5, 0.2, 0.12), 8.0, LEGS, rate=1000.0, reach=1.2),
    "two_arms": robot_urdf((0.8, 0.8, 0.8), 150.0, ARMS, rate=1.0, reach=2.5),
    "snake": robot_urdf((0.2, 0.1, 0.1), 2.0, [SNAKE], rate=2.0, reach=1.3),
    "light_base": robot_urdf((0.1, 0.1, 0.1), 0.004, [HEAVY_ARM], rate=1.0, reach=2.0),
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["attitude", "position", "shape"])
@pytest.mark.parametrize("name", ROBOTS)
def test_a_robot_is_planned_for_in_time_and_ends_where_its_plan_says(
    name: str, kind: str, tmp_path: Path
) -> None:
    path = tmp_path / "written.urdf"
    path.write_text(ROBOTS[name], encoding="utf-8")
    robot = SpaceRobot.from_file(path)
    geometry = Clearance(robot.description, 0.02).geometry
    rng = np.random.default_rng([SEED, list(ROBOTS).index(name)])

    def clear_shape() -> Array:
        while True:
            q = rng.uniform(-0.8, 0.8, robot.n)
            nearest = geometry.nearest(q)
            if nearest is None or nearest[0] >= 0.02:
                return q

    start, final, turn = clear_shape(), clear_shape(), Rotation.from_rotvec(TURN)
    goal: dict[str, Any] = {"rotvec": TURN}
    if kind == "position":
        # The centre of mass rests, so that the base is there in some shape.
        there = robot.center_of_mass(start) - turn.apply(robot.center_of_mass(final))
        goal |= {"position": there, "base_position": 1}
    if kind == "shape":
        goal["joint_positions"] = final
    began = time.process_time()
    try:
        schedule = plan(robot, start=start, cache=0, **goal)
    except UnreachableError as refusal:
        print(f"  {name}, {kind}: {refusal}")
        return
    finally:
        cpu = time.process_time() - began
        print(f"  {name}, {kind}: {cpu:.1f} s of CPU time", flush=True)
        assert cpu < LONGEST_SEARCH
    state = RobotState(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), start)
    _, quaternion = flown_by_pinocchio(ROBOTS[name], schedule, state, longest_step=0.00125)
    missed = angle_between(quaternion, turn.as_quat())
    said = schedule.notes["predicted_attitude_error"]
    assert isinstance(said, float)
    print(
        f"  {schedule.duration:.4g} s, misses by {missed:.2e} rad and says {said:.2e}", flush=True
    )
    assert abs(missed - said) < 1e-8
