"""Commands of a plant as serialised messages: one reader for each source."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

from geometry_msgs.msg import WrenchStamped
from sensor_msgs.msg import JointState

from spacerobot_ros.errors import CommandError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.nodes.common.cdr import JointReader, TemplateReader, UnreadableError
from spacerobot_ros.simulation.commands import (
    CommandSource,
    CommandValidator,
    Refusal,
    require_frame,
)


class CommandReader(ABC):
    """Reads the messages of one source and offers them to the validator.

    Parameters
    ----------
    source
        Where the commands come from.
    """

    message_type: type[Any]
    values: Array
    """What the message read last commands, in the order of the robot's joints."""

    def __init__(self, source: CommandSource) -> None:
        self.source = source

    @abstractmethod
    def read(self, raw: bytes) -> int:
        """Read a message into :attr:`values`; return its stamp, ns.

        Raises
        ------
        CommandError
            It does not fit the robot; :attr:`stamp_ns` still tells its stamp.
        UnreadableError
            The bytes are no message of the topic's type.
        """

    @property
    @abstractmethod
    def stamp_ns(self) -> int:
        """Stamp of the message read last, ns."""

    def offer(self, commands: CommandValidator, raw: bytes, now_ns: int) -> Refusal | None:
        """Offer a message to the validator; return why it is refused, if it is."""
        try:
            stamp = self.read(raw)
        except UnreadableError as error:
            return commands.unreadable(self.source, error)
        except CommandError as error:
            return commands.offer(self.source, self.stamp_ns, error, now_ns)
        return commands.offer(self.source, stamp, self.values, now_ns)


class _JointCommandReader(CommandReader):
    """Velocities or efforts by joint name."""

    message_type = JointState

    def __init__(self, source: CommandSource, robot: SpaceRobot) -> None:
        super().__init__(source)
        assert source.quantity != "wrench"
        self._reader = JointReader(robot.joint_names, [source.quantity])
        self.values = self._reader.values[source.quantity]

    def read(self, raw: bytes) -> int:
        """Read the source's quantity."""
        return self._reader.accept(raw)

    @property
    def stamp_ns(self) -> int:
        """Stamp of the message read last, ns."""
        return self._reader.stamp_ns


class _WrenchReader(CommandReader):
    """Force over torque (6,) on the base link, in its frame."""

    message_type = WrenchStamped

    def __init__(self, source: CommandSource, robot: SpaceRobot) -> None:
        super().__init__(source)
        self._base_link = robot.base_link
        self._reader = TemplateReader(WrenchStamped, lambda _: {"wrench.force.x": 6})

    def read(self, raw: bytes) -> int:
        """Read force over torque."""
        self._reader.accept(raw)
        message = self._reader.prototype
        assert message is not None
        require_frame(message.header.frame_id, self._base_link)
        self.values = self._reader.floats("wrench.force.x")
        return self._reader.stamp_ns

    @property
    def stamp_ns(self) -> int:
        """Stamp of the message read last, ns."""
        return self._reader.stamp_ns


def command_reader(source: CommandSource, robot: SpaceRobot) -> CommandReader:
    """Return what reads the messages of a source."""
    reader = _WrenchReader if source.quantity == "wrench" else _JointCommandReader
    return reader(source, robot)
