"""Messages of the stack made from plain values: states, goals, plans, predicted paths."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from spacerobot_ros.messages.layout import encode, encode_list, times_of
from spacerobot_ros.planning import BasePath, GaitSchedule, Goal
from spacerobot_ros.times import LATEST_NS, SECOND
from spacerobot_ros.topics import Topic

POSE_STAMPED = "geometry_msgs/msg/PoseStamped"


def state_message(topic: Topic, names: Sequence[str], world: str, base: str) -> bytes:
    """Return the message of a state topic with all numbers zero.

    Parameters
    ----------
    topic
        An entry of the table of topics.
    names
        Joints or thrusters that its arrays have entries for.
    world, base
        Names of the inertial frame and of that of the base link.
    """
    values: dict[str, Any] = {}
    if topic.type == "std_msgs/msg/Float64MultiArray":
        words = topic.state[0].entries
        dimension = {"label": " ".join(words), "size": len(words), "stride": len(words)}
        values["layout"] = {"dim": [dimension]}
    elif topic.state:
        values["header"] = {"frame_id": base if topic.frame == "base" else world}
    if topic.type == "nav_msgs/msg/Odometry":
        values["child_frame_id"] = base
    if topic.type == "sensor_msgs/msg/JointState":
        values["name"] = names
    for field in topic.state:
        if not field.members:
            values[field.path] = np.zeros(len(field.entries or names))
    return encode(topic.type, values)


def goal_message(goal: Goal, frame: str, stamp_ns: int = 0) -> bytes:
    """Return the pose of a goal as geometry_msgs/PoseStamped."""
    position = dict(zip("xyz", goal.position, strict=True))
    orientation = dict(zip("xyzw", goal.quaternion, strict=True))
    return encode(
        POSE_STAMPED,
        {
            "header": {"stamp": stamp_ns, "frame_id": frame},
            "pose": {"position": position, "orientation": orientation},
        },
    )


def trajectory_message(schedule: GaitSchedule, stamp_ns: int, frame: str) -> bytes:
    """Return a schedule as trajectory_msgs/JointTrajectory.

    Point k holds the shape at tick k and the velocities held from there on (zero at the last).
    Long gaits have a hundred thousand points.
    """
    n, count = len(schedule.joint_names), len(schedule.positions)
    period_ns = round(schedule.control_period * SECOND)
    return encode_list(
        "trajectory_msgs/msg/JointTrajectory",
        {"header": {"stamp": stamp_ns, "frame_id": frame}, "joint_names": schedule.joint_names},
        "points",
        {"positions": np.zeros(n), "velocities": np.zeros(n)},
        {
            "positions": schedule.positions,
            "velocities": np.vstack([schedule.velocities, np.zeros(n)]),
            "time_from_start.sec": times_of(np.arange(count, dtype=np.int64) * period_ns),
        },
    )


def path_message(path: BasePath, start_ns: int, frame: str) -> bytes:
    """Return a predicted base path that begins at ``start_ns`` as nav_msgs/Path."""
    times = (path.time * SECOND).round().astype(np.int64) + start_ns
    return encode_list(
        "nav_msgs/msg/Path",
        {"header": {"stamp": min(start_ns, LATEST_NS), "frame_id": frame}},
        "poses",
        {"header": {"frame_id": frame}},
        {
            "header.stamp.sec": times_of(np.minimum(times, LATEST_NS)),
            "pose.position.x": np.hstack([path.position, path.quaternion]),
        },
    )
