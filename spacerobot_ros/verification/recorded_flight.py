"""What a bag holds of one flight of a plant: its parameters, its robot, and what commanded it."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spacerobot_ros.bag.reader import Bag, RecordedRobot
from spacerobot_ros.errors import CommandError, ParameterError, RecordingError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.urdf import parse_robot
from spacerobot_ros.parameters import configured
from spacerobot_ros.simulation.commands import (
    CommandSource,
    joint_order,
    require_frame,
    require_values,
)
from spacerobot_ros.simulation.config import PlantConfig
from spacerobot_ros.times import stamp_to_ns

RecordedCommand = NDArray[np.float64] | CommandError
"""The values of a command, or why its message is malformed."""


@dataclass(frozen=True)
class RecordedFlight:
    """A flight in lockstep, as a bag holds it.

    Attributes
    ----------
    recorded
        The topics of the robot.
    config
        The parameters of its plant; those that an earlier version did not have are at their
        defaults.
    robot
        The model.
    injections
        The faults that were injected in each tick.
    """

    recorded: RecordedRobot
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
        series = self.recorded.get(source.topic)
        for _, message in series.messages() if series is not None else ():
            stamp = message.header.stamp
            tick, rest = divmod(stamp_to_ns(stamp), self.config.period_ns)
            if not rest and tick not in commands:
                prefix = self.config.frame_prefix
                commands[tick] = read_command(message, source, self.robot, prefix)
        return commands

    @property
    def path(self) -> Path:
        """The bag."""
        return self.recorded.bag.path


def read_command(
    message: Any, source: CommandSource, robot: SpaceRobot, frame_prefix: str = ""
) -> RecordedCommand:
    """Return what a decoded message commands, in the order of the robot's joints.

    Joints that it does not name are commanded nothing; ``frame_prefix`` is of the robot's frames.
    """
    try:
        if source.quantity == "wrench":
            require_frame(message.header.frame_id, robot.base_link, frame_prefix)
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
    recorded = _recorded(bag)
    config = _config(recorded)
    urdf = recorded.urdf
    if urdf is None:
        raise RecordingError(f"The bag {bag.path} holds no description of its robot.")
    injections: dict[int, list[str]] = {}
    # Faults have no stamp: they came in the tick of their log time.
    series = recorded.get("fault_injection")
    for time_ns, message in series.messages() if series is not None else ():
        injections.setdefault(time_ns // config.period_ns, []).append(message.data)
    description = parse_robot(urdf.decode(errors="replace"))
    names = recorded.joint_names
    if names != list(description.joint_names):
        # Before equations are derived of whatever robot there is.
        raise RecordingError(
            f"The joint states in the bag {bag.path} are of {', '.join(names)}; its robot has "
            f"{', '.join(description.joint_names)}."
        )
    robot = SpaceRobot(config.believed(description))
    return RecordedFlight(recorded, config, robot, injections)


def _recorded(bag: Bag) -> RecordedRobot:
    """Return the one robot of which the bag holds odom and joint_states."""
    candidates = [
        RecordedRobot(bag, topic.removesuffix("/odom"))
        for topic in bag.topics
        if topic.endswith("/odom")
    ]
    found = [each for each in candidates if each.get("odom") and each.get("joint_states")]
    if len(found) != 1:
        names = ", ".join(each.namespace for each in found)
        plants = f"{len(found)} plants ({names})" if found else "no plant"
        raise RecordingError(
            f"The bag {bag.path} holds the states of {plants}: to verify it takes one that "
            "published odom and joint_states."
        )
    return found[0]


def _config(recorded: RecordedRobot) -> PlantConfig:
    bag, texts = recorded.bag, recorded.metadata.get("parameters/plant")
    if texts is None:
        raise RecordingError(
            f"The bag {bag.path} does not say what its plant was: bags of 'spacerobot run' hold "
            "the plant's parameters."
        )
    try:
        values = {name: json.loads(text) for name, text in texts.items()}
    except (ValueError, RecursionError) as error:
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
