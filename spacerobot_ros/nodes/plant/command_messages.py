"""Commands of a plant as serialised messages."""

from __future__ import annotations

from typing import Any

import numpy as np
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


class CommandReader:
    """Reads the messages of one source and offers them to the validator.

    Parameters
    ----------
    source
        Where the commands come from.
    robot
        The model.
    frame_prefix
        Which the name of the base link may have in commands.
    """

    def __init__(self, source: CommandSource, robot: SpaceRobot, frame_prefix: str = "") -> None:
        self.source = source
        self.message_type: type[Any] = JointState
        self._reader: JointReader | _WrenchReader
        if source.quantity == "wrench":
            self.message_type, self._reader = (
                WrenchStamped,
                _WrenchReader(robot.base_link, frame_prefix),
            )
            self._values = self._reader.values
        else:
            self._reader = JointReader(robot.joint_names, [source.quantity])
            self._values = self._reader.values[source.quantity]

    def offer(self, commands: CommandValidator, raw: bytes, now_ns: int) -> Refusal | None:
        """Offer a message to the validator; return why it is refused, if it is."""
        try:
            stamp = self._reader.accept(raw)
        except UnreadableError as error:
            return commands.unreadable(self.source, error, now_ns)
        except CommandError as error:
            return commands.offer(self.source, self._reader.stamp_ns, error, now_ns)
        return commands.offer(self.source, stamp, self._values, now_ns)


class _WrenchReader:
    """Reads force over torque (6,) into ``values``; their frame must be that of the base link."""

    def __init__(self, base_link: str, frame_prefix: str) -> None:
        self.values: Array = np.zeros(6)
        self._base_link, self._prefix = base_link, frame_prefix
        self._reader = TemplateReader(WrenchStamped, lambda _: {"wrench.force.x": 6})

    def accept(self, raw: bytes) -> int:
        self._reader.accept(raw)
        message = self._reader.prototype
        assert message is not None
        require_frame(message.header.frame_id, self._base_link, self._prefix)
        self.values[:] = self._reader.floats("wrench.force.x")
        return self._reader.stamp_ns

    @property
    def stamp_ns(self) -> int:
        return self._reader.stamp_ns
