"""The commands a plant takes: one channel a topic, each read, checked and held."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import Any, ClassVar

import numpy as np
from geometry_msgs.msg import WrenchStamped
from sensor_msgs.msg import JointState

from spacerobot_ros.errors import CommandError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.nodes.cdr import TemplateReader
from spacerobot_ros.nodes.joint_command import JointReader, Quantity

NEVER = -math.inf


class CommandChannel(ABC):
    """One command topic of a plant.

    ``command`` is what the actuators are to do now; ``stamp_ns`` is when the command in force was
    stamped, :data:`NEVER` while there is none; ``arrived`` whether this tick's has come.
    """

    topic: ClassVar[str]
    message_type: ClassVar[type[Any]]
    required: bool = True
    """Whether a lockstep plant waits for it."""

    def __init__(self, size: int) -> None:
        self.command: Array = np.zeros(size)
        self.stamp_ns: float = NEVER
        self.arrived = False

    @abstractmethod
    def read(self, raw: bytes) -> tuple[int, Array]:
        """Return stamp (ns) and values of a message.

        Raises
        ------
        CommandError
            It does not fit the robot; :attr:`read_stamp_ns` still tells its stamp.
        """

    @property
    @abstractmethod
    def read_stamp_ns(self) -> int:
        """Stamp of the message read last, ns."""

    def check(self, raw: bytes) -> tuple[int, str]:
        """Read a message; return its stamp (ns) and why it is refused, empty if it is not."""
        try:
            stamp, values = self.read(raw)
        except CommandError as error:
            return self.read_stamp_ns, str(error)
        self._read = values
        # A sum is finite only if every term is; for a few numbers a list is summed fastest.
        if not math.isfinite(sum(values.tolist())):
            return stamp, f"a value is not finite: {values.tolist()}"
        return stamp, ""

    def take(self, stamp_ns: float) -> None:
        """Put the message that was checked last into force."""
        self.command[:] = self._read
        self.stamp_ns = stamp_ns
        self.arrived = True

    def rest(self) -> None:
        """Command nothing from now on."""
        self.command[:] = 0.0
        self.stamp_ns = NEVER
        self.arrived = True


class JointChannel(CommandChannel):
    """``joint_commands``: velocities or efforts by joint name."""

    topic = "joint_commands"
    message_type = JointState

    def __init__(self, robot: SpaceRobot, quantity: Quantity) -> None:
        super().__init__(robot.n)
        self._reader = JointReader(robot.joint_names, [quantity])
        self._quantity = quantity

    def read(self, raw: bytes) -> tuple[int, Array]:
        """Read the channel's quantity in the order of the model's joints."""
        return self._reader.accept(raw), self._reader.values[self._quantity]

    @property
    def read_stamp_ns(self) -> int:
        """Stamp of the message read last, ns."""
        return self._reader.stamp_ns


class WrenchChannel(CommandChannel):
    """``base_wrench``: thruster force and torque at the origin of the base link, in its frame."""

    topic = "base_wrench"
    message_type = WrenchStamped

    def __init__(self, robot: SpaceRobot) -> None:
        super().__init__(6)
        self._base_link = robot.base_link
        self._reader = TemplateReader(WrenchStamped, lambda _: {"wrench.force.x": 6})

    def read(self, raw: bytes) -> tuple[int, Array]:
        """Read force over torque."""
        self._reader.accept(raw)
        message = self._reader.prototype
        frame = message.header.frame_id if message is not None else ""
        if frame not in ("", self._base_link):
            raise CommandError(
                f"the wrench is in frame '{frame}'; it is taken in '{self._base_link}'"
            )
        return self._reader.stamp_ns, self._reader.floats("wrench.force.x")

    @property
    def read_stamp_ns(self) -> int:
        """Stamp of the message read last, ns."""
        return self._reader.stamp_ns
