"""Bags of made-up flights, written message by message."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from nav_msgs.msg import Path as PathMessage
from support.made_bags import array, joint_states, made_bag, odometry, pose, status

from spacerobot_ros.model.description import Array
from spacerobot_ros.model.rotations import quaternion_from_rotvec

TICK = 0.05
GOAL = ([0.3, -0.25, 0.1], [0.5, -0.15, 0.1])
FINAL = ([0.31, -0.26, 0.12], [0.52, -0.14, 0.09])
EXECUTING = {"state": "executing", "method": "lie_bracket", "zf": "-2.37840784 1.6872523"}
REACHED = {"state": "reached", "corrections": "0"}

URDF = """<robot name="test_robot"><link name="base_link"><inertial><mass value="10"/>
<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>
<visual><geometry><box size="1 .6 .6"/></geometry></visual>
<visual><geometry><mesh filename="package://robot/dish.stl"/></geometry></visual></link>{}</robot>"""
JOINT = """<link name="link_{0}"><inertial><mass value="2"/>
<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>
<visual><geometry><{1}/></geometry></visual></link>
<joint name="joint_{0}" type="{2}"><parent link="base_link"/><child link="link_{0}"/>
<axis xyz="{3}"/><limit lower="-1.5" upper="1.5" velocity="0.8" effort="5"/></joint>"""
SOLIDS = ('sphere radius=".1"', 'cylinder radius=".1" length="1"', 'box size=".1 .1 .8"')


def urdf_of(n: int) -> str:
    """A base with n joints, in turn a slider with a sphere and two revolute ones."""
    axes = ("1 0 0", "0 1 0", "0 0 1")
    kinds = ("prismatic", "revolute", "revolute")
    return URDF.format(
        "".join(JOINT.format(i, SOLIDS[i % 3], kinds[i % 3], axes[i % 3]) for i in range(n))
    )


@dataclass
class Story:
    """What a bag tells: the motion in it, and what was said along the way (time, values)."""

    shapes: Array
    statuses: Sequence[tuple[float, str, dict[str, str]]] = ()
    goals: Sequence[tuple[float, Sequence[float], Sequence[float]]] = ()
    urdf: str | None = ""
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    prefix: str = ""
    name: str = "joint_"
    topics: Sequence[str] = ("odom", "joint_states", "momentum")
    events: Sequence[tuple[float, dict[str, str]]] = ()


def cyclic_shapes(slide: int = 40, cycles: int = 20, period: int = 30) -> Array:
    """A slide, then equal cycles of three joints."""
    ramp = np.linspace(0, 1, slide)[:, np.newaxis] * np.array([-0.8, 0.5, 0.3])
    phase = 2 * np.pi * np.arange(1, cycles * period + 1)[:, np.newaxis] / period
    loops = np.hstack([0.1 * (1 - np.cos(phase)), 0.2 * np.sin(phase), 0.05 * np.sin(2 * phase)])
    return np.vstack([ramp, ramp[-1] + loops])


def still(n: int = 3, count: int = 5) -> Array:
    """A few states of joints that rest."""
    return np.zeros((count, n))


def rates_of(shapes: Array) -> Array:
    """Velocities that led to each shape."""
    return np.diff(shapes, axis=0, prepend=shapes[:1]) / TICK


def tell(path: Path, story: Story) -> Path:
    """Write the bag of a story."""
    count, n = story.shapes.shape
    rates = rates_of(story.shapes)
    share = np.linspace(0, 1, count) if count > 1 else np.ones(1)
    names = [f"{story.name}{i}" for i in range(n)]
    with made_bag(path) as (bag, say_at):

        def say(topic: str, message: Any, time: float) -> None:
            say_at(f"{story.prefix}/{topic}", message, time)

        for name, values in story.metadata.items():
            bag.add_metadata(name, values)
        if story.urdf is not None:
            text = story.urdf or urdf_of(n)
            bag.add_attachment("robot_description.urdf", text.encode(), "application/xml", 0)
        for time, r, rotvec in story.goals:
            say("goal_pose", pose(time, *r, *quaternion_from_rotvec(rotvec)), time)
        for time, sentence, values in story.statuses:
            say("planner/status", status(values, sentence), time)
        for time, values in story.events:
            say("events", status(values, "It is so.", "/node"), time)
        for k in range(count):
            time, rotvec = k * TICK, share[k] * np.array(FINAL[1])
            at = (*(share[k] * np.array(FINAL[0])), *quaternion_from_rotvec(rotvec))
            ledger = [1e-16 * k, 0.0, 0.0, 0.0, -2e-16 * k, 0.0, 0.5 * share[k]]
            messages = {
                "odom": odometry(time, *at),
                "joint_states": joint_states(
                    time, names, story.shapes[k].tolist(), rates[k].tolist()
                ),
                "momentum": array(*ledger),
            }
            for topic in story.topics:
                say(topic, messages[topic], time)
        if story.goals:
            path_message = PathMessage(poses=[pose(0.0, 0, 0, 0, 0, 0, 0, 1), pose(time, *at)])
            say("planned_path", path_message, 0.0)
    return path


def goal_value(r: Sequence[float] = GOAL[0], rotvec: Sequence[float] = GOAL[1]) -> dict[str, str]:
    return {"goal": " ".join(f"{x:.9g}" for x in (*r, *quaternion_from_rotvec(rotvec)))}
