"""Bags of messages that a test has made, one by one."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from spacerobot_ros.bag import BagWriter

Say = Callable[[str, Any, float], None]
"""Writes a message on a topic at a log time in s."""


@contextmanager
def made_bag(path: Path) -> Iterator[tuple[BagWriter, Say]]:
    """Open a new bag; yield it, and what writes messages into it."""
    with BagWriter(path) as bag:

        def say(topic: str, message: Any, time: float) -> None:
            kind = type(message)
            package = kind.__module__.split(".")[0]
            channel = bag.add_topic(topic, f"{package}/msg/{kind.__name__}")
            now = round(time * 1e9)
            bag.write(channel, bytes(serialize_message(message)), now, now)

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
    """Return an odometry message of seven numbers of pose and six of twist."""
    message = stamped(Odometry(), time, "world")
    _fill(message.pose.pose, numbers[:7])
    linear, angular = message.twist.twist.linear, message.twist.twist.angular
    linear.x, linear.y, linear.z, angular.x, angular.y, angular.z = map(float, numbers[7:])
    return message


def joint_states(
    time: float, names: list[str], position: list[float], velocity: list[float]
) -> JointState:
    """Return a message of joints without efforts."""
    return stamped(JointState(name=names, position=position, velocity=velocity), time)


def array(*numbers: float) -> Float64MultiArray:
    """Return the numbers as a message."""
    return Float64MultiArray(data=list(map(float, numbers)))
