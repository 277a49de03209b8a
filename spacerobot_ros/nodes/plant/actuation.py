"""Which commands drive a plant."""

from __future__ import annotations

from collections.abc import Callable

from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.nodes.plant.command_channel import CommandChannel, JointChannel, WrenchChannel

CHANNELS: dict[str, Callable[[SpaceRobot], list[CommandChannel]]] = {
    "velocity": lambda robot: [JointChannel(robot, "velocity")],
    "effort": lambda robot: [JointChannel(robot, "effort"), WrenchChannel(robot)],
}
"""By actuation: the channels whose commands are the arguments of a step, in that order."""
