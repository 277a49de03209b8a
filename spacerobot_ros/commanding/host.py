"""Interfaces that a commander uses: its host, and the decoder of the received states."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any, Protocol

from spacerobot_ros.commanding.plant_state import Stamped
from spacerobot_ros.events import Event
from spacerobot_ros.model.description import Array
from spacerobot_ros.planning.core.schedule import BasePath, GaitSchedule
from spacerobot_ros.planning.execution.status import LogLevel


class CommanderActivity(Enum):
    """Whether a commander handles states."""

    INACTIVE = "inactive"
    ACTIVE = "active"
    DECIDED = "decided"
    """The commander has stopped after its goal ended (``stop_when_decided``)."""


class CommanderHost(Protocol):
    """The host of a commander: a node, a loop without ROS, or a test."""

    def send_command(self, stamp_ns: int) -> None:
        """Send the commander's current values as the command for the state with this stamp."""

    def publish_status(self, status: Any) -> None:
        """Publish a status of the goal."""

    def report_event(self, event: Event) -> None:
        """Publish an event."""

    def publish_plan(
        self, path: BasePath, stamp_ns: int, schedule: GaitSchedule | None = None
    ) -> None:
        """Publish the path of a plan that starts with this stamp, and its schedule; plans of
        controllers have none."""

    def log(self, level: LogLevel, message: str) -> None:
        """Write a line to the log."""

    def has_publisher(self, topic: str) -> bool:
        """Whether a publisher of odom, or of a reference, is connected."""

    def waiting_states(self) -> tuple[Sequence[Stamped], Sequence[Stamped]]:
        """Return received odom messages and joint states that the commander has not processed
        yet."""


class StateDecoder(Protocol):
    """Decodes the messages for one robot; the messages are opaque to a commander."""

    q: Array
    """Latest accepted joint positions (n,), m or rad."""
    qdot: Array
    """Latest accepted joint rates (n,), m/s or rad/s."""

    def check_robot(self, joints: Any) -> None:
        """Raise CommandError if the joint states are from another robot."""

    def decode_joints(self, joints: Any) -> int:
        """Read joint states into ``q`` and ``qdot``; return their stamp, ns, or raise
        CommandError."""

    def decode_base(self, odom: Any) -> tuple[Array, Array]:
        """Return pose (7,) and twist (6,) from an odom message or a base reference, or raise
        CommandError."""

    def target(self, odom: Any) -> tuple[Array, Array]:
        """Return pose (7,) and twist (6,) from a target odom message, or raise CommandError."""

    def joint_reference(self, message: Any) -> tuple[Array, Array]:
        """Return positions and rates (n,) from a joint reference, or raise CommandError."""


@dataclass(frozen=True, slots=True, eq=False)
class StateArrays:
    """A complete state as arrays: the joints, and the base if measured."""

    stamp_ns: int
    q: Array
    qdot: Array
    pose: Array | None = None
    twist: Array | None = None


class ArrayDecoder:
    """A :class:`StateDecoder` of :class:`StateArrays`."""

    q: Array
    qdot: Array

    def check_robot(self, joints: StateArrays) -> None:
        """Accept any joints."""

    def decode_joints(self, joints: StateArrays) -> int:
        """Store the joints unchanged."""
        self.q, self.qdot = joints.q, joints.qdot
        return joints.stamp_ns

    def decode_base(self, odom: StateArrays) -> tuple[Array, Array]:
        """Return pose and twist."""
        assert odom.pose is not None
        assert odom.twist is not None
        return odom.pose, odom.twist

    target = decode_base

    def joint_reference(self, message: StateArrays) -> tuple[Array, Array]:
        """Return positions and rates."""
        return message.q, message.qdot
