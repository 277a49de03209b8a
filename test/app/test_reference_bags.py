"""The reference bags: the commands in them, re-simulated, give the states in them."""

from __future__ import annotations

import json

import numpy as np
import pytest
from numpy.typing import NDArray

from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.recording import Bag, read_bag
from spacerobot_ros.resources import resource_names, share_directory
from spacerobot_ros.simulation import VelocityPlant

TOLERANCE = 1e-9


def poses(bag: Bag) -> NDArray[np.float64]:
    """Return the recorded base poses (N, 7), position and quaternion."""
    odom = bag["/odom"]
    position = [odom.field(f"pose.pose.position.{x}") for x in "xyz"]
    orientation = [odom.field(f"pose.pose.orientation.{x}") for x in "xyzw"]
    return np.column_stack([*position, *orientation])


@pytest.mark.parametrize("name", resource_names("bags", ".mcap"))
def test_recorded_commands_give_the_recorded_states(name: str) -> None:
    bag = read_bag(share_directory() / "bags" / f"{name}.mcap")
    robot = SpaceRobot.from_urdf(bag.attachments["robot_description.urdf"].decode())
    rate = json.loads(bag.metadata["parameters/plant"]["tick_rate"])
    plant = VelocityPlant(robot, 1.0 / rate)
    commands = np.asarray(bag["/joint_commands"].field("velocity"))
    shapes = np.asarray(bag["/joint_states"].field("position"))
    recorded = poses(bag)
    assert len(commands) >= len(recorded) - 1 > 100
    for command, pose, shape in zip(commands, recorded[1:], shapes[1:], strict=False):
        plant.step(command)
        np.testing.assert_allclose(plant.pose, pose, atol=TOLERANCE)
        np.testing.assert_allclose(plant.q, shape, atol=TOLERANCE)


def test_there_is_a_reference_bag() -> None:
    assert "sliding_masses" in resource_names("bags", ".mcap")
    size = sum(path.stat().st_size for path in (share_directory() / "bags").iterdir())
    assert size < 5_000_000
