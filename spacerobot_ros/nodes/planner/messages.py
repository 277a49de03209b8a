"""Messages of the planner: measured states in; setpoints, statuses and whole gaits out."""

from __future__ import annotations

import struct
from collections.abc import Sequence

import numpy as np
from builtin_interfaces.msg import Duration, Time
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import Point, Pose, PoseStamped, Quaternion
from nav_msgs.msg import Odometry, Path
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import Header
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint
from visualization_msgs.msg import Marker, MarkerArray

from spacerobot_ros.errors import CommandError
from spacerobot_ros.model.description import Shape
from spacerobot_ros.nodes.common.cdr import JointReader, Layout, MessageTemplate, TemplateReader
from spacerobot_ros.nodes.common.messages import diagnostic_status, shape_marker
from spacerobot_ros.planning import BasePath, GaitSchedule, Goal
from spacerobot_ros.planning.execution.state_average import BaseMeasurement
from spacerobot_ros.planning.execution.status import PlannerStatus
from spacerobot_ros.planning.execution.tracker import Setpoint
from spacerobot_ros.times import LATEST_NS, SECOND, set_stamp


class StateReader:
    """The :class:`~spacerobot_ros.planning.execution.state_average.MeasuredState` of raw messages.

    Everything but the positions of the joints is read only where it is needed.

    Parameters
    ----------
    joint_names
        The robot's joints.
    """

    def __init__(self, joint_names: Sequence[str]) -> None:
        self.stamp_ns = 0
        self.base_error: CommandError | None = None
        """Why the last :meth:`base` could not be read."""
        self.shape_reader = JointReader(joint_names, ["position"], complete=True)
        self._joints = JointReader(joint_names, ["position", "velocity"], complete=True)
        self._odom = TemplateReader(
            Odometry, lambda _: {"pose.pose.position.x": 7, "twist.twist.linear.x": 6}
        )
        self.q = self.shape_reader.values["position"]

    def accept(self, joint_states: bytes, odom: bytes | None) -> None:
        """Make this the measured state; ``odom`` is of the same stamp, or None.

        Raises
        ------
        CommandError
            The joints are not those of the robot; the state before stays.
        """
        self.stamp_ns = self.shape_reader.accept(joint_states)
        self._joints_raw, self._odom_raw = joint_states, odom

    def base(self) -> BaseMeasurement | None:
        """Return pose and twist of the base and the rates of the joints, None without odom."""
        if self._odom_raw is None:
            return None
        try:
            self._odom.accept(self._odom_raw)
            self._joints.accept(self._joints_raw)
        except CommandError as error:
            self.base_error = error
            return None
        return BaseMeasurement(
            self._odom.floats("pose.pose.position.x"),
            self._odom.floats("twist.twist.linear.x"),
            self._joints.values["velocity"],
        )


def setpoint_template(joint_names: Sequence[str], setpoint: Setpoint) -> MessageTemplate:
    """Return a JointState message that carries the values that a setpoint has at the time."""
    zeros = [0.0] * len(joint_names)
    template = MessageTemplate(
        JointState(name=list(joint_names), position=zeros, velocity=zeros, effort=zeros)
    )
    if zeros:
        template.feed("position", setpoint.position)
        template.feed("velocity", setpoint.velocity)
    return template


def status_message(status: PlannerStatus, name: str) -> DiagnosticStatus:
    """Return the status of the planner ``name``."""
    level = bytes([status.state.level])
    return diagnostic_status(name, level, status.message, status.to_values())


def goal_markers(
    goal: Goal, path: BasePath, base_shapes: Sequence[Shape], frame: str
) -> MarkerArray:
    """Return the base as a ghost at the goal, and the planned path of the base as a line."""
    markers: list[Marker] = []
    for shape in base_shapes:
        marker = shape_marker(shape, frame, "goal", len(markers))
        marker.color.a = 0.25
        marker.pose.position.x, marker.pose.position.y, marker.pose.position.z = (
            goal.position.tolist()
        )
        o = marker.pose.orientation
        o.x, o.y, o.z, o.w = goal.quaternion.tolist()
        markers.append(marker)
    line = Marker(ns="planned_path", id=len(markers), type=Marker.LINE_STRIP, action=Marker.ADD)
    line.header.frame_id = frame
    line.scale.x = 0.005
    line.color.r, line.color.g, line.color.b, line.color.a = 0.95, 0.6, 0.1, 1.0
    line.pose.orientation.w = 1.0
    line.points = [Point(x=x, y=y, z=z) for x, y, z in path.position.tolist()]
    return MarkerArray(markers=[*markers, line])


def path_message(path: BasePath, start_ns: int, frame: str) -> Path:
    """Return a predicted base path that begins at ``start_ns`` as nav_msgs/Path."""

    def header(time_ns: int) -> Header:
        sec, nanosec = divmod(min(time_ns, LATEST_NS), SECOND)
        return Header(frame_id=frame, stamp=Time(sec=sec, nanosec=nanosec))

    instants = (path.time * SECOND).round().astype(np.int64) + start_ns
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
    set_stamp(prototype.header.stamp, stamp_ns)
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
    times = np.arange(count, dtype=np.int64) * round(schedule.control_period * SECOND)
    clock = np.stack([times // SECOND, times % SECOND], axis=1).astype("<u4")
    for values, offset in zip((schedule.positions, velocities, clock), at[2], strict=True):
        data = np.ascontiguousarray(values).view(np.uint8)
        first = offset - ends[1]
        records[:, first : first + data.shape[1]] = data

    # The first point's own bytes up to its positions, then what it shares with the others.
    head = bytearray(raw[: at[0][0]])
    struct.pack_into("<I", head, layout.lengths["points"], count)
    body = records.reshape(-1)[at[0][0] - start :]
    return bytes(head) + body.tobytes()
