"""The commands a plant takes: one channel a topic, each read, checked and held."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import Any, ClassVar, Literal

import numpy as np
from geometry_msgs.msg import WrenchStamped
from sensor_msgs.msg import JointState

from spacerobot_ros.errors import CommandError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.nodes.common.cdr import TemplateReader, UnreadableError
from spacerobot_ros.nodes.common.joint_command import JointReader
from spacerobot_ros.nodes.plant.command_gate import Reason

NEVER = -math.inf

Refused = tuple[Reason, str]
"""Why a command is refused, as a word and as a clause."""


class CommandChannel(ABC):
    """One command topic of a plant.

    ``command`` is what the actuators are to do now; ``stamp_ns`` is when the command in force was
    stamped, :data:`NEVER` while there is none; ``arrived`` whether this tick's has come;
    ``resting`` whether the last was taken back, so that the joints are to come to rest.

    Parameters
    ----------
    limits
        (size,) largest magnitude of each value; beyond it the plant clips.
    """

    topic: ClassVar[str]
    message_type: ClassVar[type[Any]]
    required: bool = True
    """Whether a lockstep plant waits for it."""

    def __init__(self, limits: Array) -> None:
        self.command: Array = np.zeros(len(limits))
        self.stamp_ns: float = NEVER
        self.arrived = self.resting = False
        self.refuses_beyond_limits = False
        """Whether a command beyond the limits is refused as a whole instead of clipped."""
        self.commanders = 1
        """How many publish on the topic, as far as is known."""
        self._limits = limits

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

    def check(self, raw: bytes) -> tuple[int, Refused | None]:
        """Read a message; return its stamp (ns), and why it is refused if it is.

        Raises
        ------
        UnreadableError
            The bytes are no message of the topic's type.
        """
        try:
            stamp, values = self.read(raw)
        except UnreadableError:
            raise
        except CommandError as error:
            return self.read_stamp_ns, (Reason.MALFORMED, str(error))
        self._read = values
        # A sum is finite only if every term is; for a few numbers a list is summed fastest.
        if not math.isfinite(sum(values.tolist())):
            return stamp, (Reason.NOT_FINITE, f"a value is not finite: {values.tolist()}")
        if self.refuses_beyond_limits and np.any(np.abs(values) > self._limits):
            limits = f"{values.tolist()} is beyond the limits {self._limits.tolist()}"
            return stamp, (Reason.BEYOND_LIMITS, limits)
        return stamp, None

    def take(self, stamp_ns: float) -> None:
        """Put the message that was checked last into force."""
        self.command[:] = self._read
        self.stamp_ns = stamp_ns
        self.arrived = True
        self.resting = False

    def rest(self) -> None:
        """Command nothing from now on."""
        self.command[:] = 0.0
        self.stamp_ns = NEVER
        self.arrived = self.resting = True


class JointChannel(CommandChannel):
    """``joint_commands``: velocities or efforts by joint name."""

    topic = "joint_commands"
    message_type = JointState

    def __init__(self, robot: SpaceRobot, quantity: Literal["velocity", "effort"]) -> None:
        limits = {"velocity": robot.velocity_limit, "effort": robot.effort_limit}
        super().__init__(limits[quantity])
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
        super().__init__(np.full(6, np.inf))
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
