"""A whole gait as messages: its schedule, and the base path that it predicts."""

from __future__ import annotations

import struct

import numpy as np
from builtin_interfaces.msg import Duration, Time
from geometry_msgs.msg import Point, Pose, PoseStamped, Quaternion
from nav_msgs.msg import Path
from rclpy.serialization import serialize_message
from std_msgs.msg import Header
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from spacerobot_ros.nodes.common.cdr import NANOSECONDS, Layout
from spacerobot_ros.planning import BasePath, GaitSchedule


def path_message(path: BasePath, start_ns: int, frame: str) -> Path:
    """Return a predicted base path that begins at ``start_ns`` as nav_msgs/Path."""

    def header(time_ns: int) -> Header:
        sec, nanosec = divmod(time_ns, NANOSECONDS)
        return Header(frame_id=frame, stamp=Time(sec=sec, nanosec=nanosec))

    instants = (path.time * NANOSECONDS).round().astype(np.int64) + start_ns
    poses = []
    for instant, r, o in zip(
        instants.tolist(), path.position.tolist(), path.quaternion.tolist(), strict=True
    ):
        position = Point(x=r[0], y=r[1], z=r[2])
        orientation = Quaternion(x=o[0], y=o[1], z=o[2], w=o[3])
        pose = Pose(position=position, orientation=orientation)
        poses.append(PoseStamped(header=header(instant), pose=pose))
    return Path(header=header(start_ns), poses=poses)


def serialised_trajectory(schedule: GaitSchedule, stamp_ns: int, frame: str) -> bytes:
    """Return the schedule as a serialised trajectory_msgs/JointTrajectory.

    Point k holds the shape at tick k and the velocities held from there on (zero at the last).
    Long gaits have a hundred thousand points: three of them are serialised by ROS to learn the
    layout, the rest are laid out alike.
    """
    n = len(schedule.joint_names)
    zeros = [0.0] * n
    prototype = JointTrajectory(joint_names=list(schedule.joint_names))
    prototype.header.frame_id = frame
    prototype.header.stamp.sec, prototype.header.stamp.nanosec = divmod(stamp_ns, NANOSECONDS)
    prototype.points = [
        JointTrajectoryPoint(positions=zeros, velocities=zeros, time_from_start=Duration())
        for _ in range(3)
    ]
    raw = serialize_message(prototype)
    layout = Layout.of(prototype)
    offsets = layout.offsets
    fields = ("positions", "velocities", "time_from_start.sec")
    at = [[offsets[f"points[{i}].{name}"] for name in fields] for i in range(3)]
    # A point ends with its time; the first may be padded differently, all others are alike.
    ends = [time + 8 for _, _, time in at]
    stride = ends[2] - ends[1]
    start = ends[0] - stride

    count = len(schedule.positions)
    records = np.tile(np.frombuffer(raw[ends[1] : ends[2]], np.uint8), (count, 1))
    velocities = np.vstack([schedule.velocities, np.zeros(n)])
    times = np.arange(count, dtype=np.int64) * round(schedule.control_period * NANOSECONDS)
    clock = np.stack([times // NANOSECONDS, times % NANOSECONDS], axis=1).astype("<u4")
    for values, offset in zip((schedule.positions, velocities, clock), at[2], strict=True):
        data = np.ascontiguousarray(values).view(np.uint8)
        first = offset - ends[1]
        records[:, first : first + data.shape[1]] = data

    # The first point's own bytes up to its positions, then what it shares with the others.
    head = bytearray(raw[: at[0][0]])
    struct.pack_into("<I", head, layout.lengths["points"], count)
    body = records.reshape(-1)[at[0][0] - start :]
    return bytes(head) + body.tobytes()
