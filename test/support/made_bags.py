"""Bags of messages that a test has made, one by one."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from support.hostile.records import string

from spacerobot_ros.bag import BagWriter

STRING = "std_msgs/msg/String"

Say = Callable[[str, Any, float], None]
"""Writes a message on a topic at a log time in s."""


def bag_of_strings(path: Path, times: Sequence[float], **options: Any) -> Path:
    """Write the numbers 0, 1, ... on /a at some times in s, a chunk each; /silent says nothing."""
    with BagWriter(path, chunk_size=1, **options) as writer:
        writer.add_topic("/silent", STRING)
        channel = writer.add_topic("/a", STRING)
        for n, time in enumerate(times):
            writer.write(channel, string(f"{n}"), round(time * 1e9), round(time * 1e9))
    return path


def write_message(bag: BagWriter, topic: str, message: Any, time_ns: int) -> None:
    """Write a message on a topic of its type."""
    kind = type(message)
    channel = bag.add_topic(topic, f"{kind.__module__.split('.')[0]}/msg/{kind.__name__}")
    bag.write(channel, bytes(serialize_message(message)), time_ns, time_ns)


@contextmanager
def made_bag(path: Path, **options: Any) -> Iterator[tuple[BagWriter, Say]]:
    """Open a new bag with options of its writer; yield it, and what writes messages into it."""
    with BagWriter(path, **options) as bag:

        def say(topic: str, message: Any, time: float) -> None:
            write_message(bag, topic, message, round(time * 1e9))

        yield bag, say


def stamped(message: Any, time: float, frame: str = "") -> Any:
    """Return a message with its header filled in."""
    sec, nanosec = divmod(round(time * 1e9), 10**9)
    message.header.stamp.sec, message.header.stamp.nanosec = sec, nanosec
    message.header.frame_id = frame
    return message


def _fill(pose: Any, numbers: tuple[float, ...]) -> None:
    p, o = pose.position, pose.orientation
    p.x, p.y, p.z, o.x, o.y, o.z, o.w = map(float, numbers)


def pose(time: float, *numbers: float) -> PoseStamped:
    """Return a pose of seven numbers in the world."""
    message = stamped(PoseStamped(), time, "world")
    _fill(message.pose, numbers)
    return message


def odometry(time: float, *numbers: float) -> Odometry:
    """Return an odometry message of seven numbers of pose and six, or none, of twist."""
    message = stamped(Odometry(), time, "world")
    _fill(message.pose.pose, numbers[:7])
    linear, angular = message.twist.twist.linear, message.twist.twist.angular
    twist = numbers[7:] or np.zeros(6)
    linear.x, linear.y, linear.z, angular.x, angular.y, angular.z = map(float, twist)
    return message


def joint_states(
    time: float, names: list[str], position: list[float], velocity: list[float]
) -> JointState:
    """Return a message of joints without efforts."""
    return stamped(JointState(name=names, position=position, velocity=velocity), time)


def status(values: Mapping[str, str], message: str = "", name: str = "") -> DiagnosticStatus:
    """Return a status of a node with values by key."""
    pairs = [KeyValue(key=key, value=value) for key, value in values.items()]
    return DiagnosticStatus(name=name, message=message, values=pairs)


def array(*numbers: float) -> Float64MultiArray:
    """Return the numbers as a message."""
    return Float64MultiArray(data=list(map(float, numbers)))
