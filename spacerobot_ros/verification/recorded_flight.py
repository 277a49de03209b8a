"""What a bag holds of one flight of a plant: its parameters, its robot, and what commanded it."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spacerobot_ros.bag.reader import Bag
from spacerobot_ros.bag.recorded_robot import RecordedRobot
from spacerobot_ros.errors import CommandError, ParameterError, RecordingError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.robot_source import robot_from_text
from spacerobot_ros.parameters import configured
from spacerobot_ros.simulation.commands import (
    CommandSource,
    joint_order,
    require_frame,
    require_values,
)
from spacerobot_ros.simulation.config import PlantConfig
from spacerobot_ros.topics import TOPICS

_SECOND = 10**9

RecordedCommand = NDArray[np.float64] | CommandError
"""The values of a command, or why its message is malformed."""


@dataclass(frozen=True)
class RecordedFlight:
    """A flight in lockstep, as a bag holds it.

    Attributes
    ----------
    bag, namespace
        Where it is recorded, and the namespace of its topics.
    config
        The parameters of its plant; those that an earlier version did not have are at their
        defaults.
    robot
        The model.
    injections
        The faults that were injected in each tick.
    """

    bag: Bag
    namespace: str
    config: PlantConfig
    robot: SpaceRobot
    injections: dict[int, list[str]]

    def commands(self, source: CommandSource) -> dict[int, RecordedCommand]:
        """Return the first command of each tick; later ones and those between ticks are stale.

        Raises
        ------
        RecordingError
            A message is damaged.
        """
        commands: dict[int, RecordedCommand] = {}
        for _, message in self._messages(source.topic):
            stamp = message.header.stamp
            tick, rest = divmod(stamp.sec * _SECOND + stamp.nanosec, self.config.period_ns)
            if not rest and tick not in commands:
                commands[tick] = read_command(message, source, self.robot)
        return commands

    def _messages(self, topic: str) -> Any:
        return _messages(self.bag, self.namespace, topic)


def read_command(message: Any, source: CommandSource, robot: SpaceRobot) -> RecordedCommand:
    """Return what a decoded message commands, in the order of the robot's joints.

    Joints that it does not name are commanded nothing.
    """
    try:
        if source.quantity == "wrench":
            require_frame(message.header.frame_id, robot.base_link)
            force, torque = message.wrench.force, message.wrench.torque
            return np.array([force.x, force.y, force.z, torque.x, torque.y, torque.z])
        order = joint_order(robot.joint_names, message.name)
        given = getattr(message, source.quantity)
        require_values(message.name, source.quantity, len(given))
    except CommandError as error:
        return error
    values = np.zeros(robot.n)
    values[order] = given
    return values


def read_flight(bag: Bag) -> RecordedFlight:
    """Read what a re-simulation needs.

    Raises
    ------
    RecordingError
        The bag holds no flight of one plant in lockstep, or is damaged.
    RobotDescriptionError
        Its URDF is refused.
    """
    namespace = _namespace(bag)
    config = _config(bag, namespace)
    urdf = RecordedRobot(bag, namespace).urdf
    if urdf is None:
        raise RecordingError(f"The bag {bag.path} holds no description of its robot.")
    injections: dict[int, list[str]] = {}
    # Faults have no stamp: they came in the tick of their log time.
    for time_ns, message in _messages(bag, namespace, "fault_injection"):
        injections.setdefault(time_ns // config.period_ns, []).append(message.data)
    robot = robot_from_text(urdf.decode(errors="replace"), config)
    return RecordedFlight(bag, namespace, config, robot, injections)


def _messages(bag: Bag, namespace: str, topic: str) -> Any:
    """Return the messages of a topic with their log times; none where it has another type."""
    name = f"{namespace}/{topic}"
    return bag.messages(name) if bag.topics.get(name) == TOPICS[topic].type else ()


def _namespace(bag: Bag) -> str:
    namespaces = [
        topic.removesuffix("/odom")
        for topic, kind in bag.topics.items()
        if topic.endswith("/odom")
        and kind == TOPICS["odom"].type
        and bag.message_count(topic)
        and bag.topics.get(f"{topic.removesuffix('/odom')}/joint_states")
        == TOPICS["joint_states"].type
    ]
    if len(namespaces) != 1:
        found = f"{len(namespaces)} plants ({', '.join(namespaces)})" if namespaces else "no plant"
        raise RecordingError(
            f"The bag {bag.path} holds the states of {found}: to verify it takes one that "
            "published odom and joint_states."
        )
    return namespaces[0]


def _config(bag: Bag, namespace: str) -> PlantConfig:
    texts = bag.metadata.get(f"parameters{namespace}/plant") or bag.metadata.get("parameters/plant")
    if texts is None:
        raise RecordingError(
            f"The bag {bag.path} does not say what its plant was: bags of 'spacerobot run' hold "
            "the plant's parameters."
        )
    try:
        values = {name: json.loads(text) for name, text in texts.items()}
    except ValueError as error:
        raise RecordingError(
            f"The plant's parameters in the bag {bag.path} cannot be read: {error}."
        ) from error
    try:
        config = configured(PlantConfig, values)
    except ParameterError as error:
        raise RecordingError(
            f"The plant's parameters in the bag {bag.path} cannot be used: {error}"
        ) from error
    if config.time_mode != "lockstep":
        raise RecordingError(
            f"The bag {bag.path} was flown in real time, where nothing records which command the "
            "plant held in which tick: only flights in lockstep can be verified."
        )
    return config
