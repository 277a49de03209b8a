"""Messages created or read by several nodes: types by name, diagnostics, markers, goals."""

from __future__ import annotations

import importlib
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Path
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message
from rclpy.type_support import check_for_type_support
from sensor_msgs.msg import JointState

from spacerobot_ros.errors import PlanningError, RecordingError, SpaceRobotError, counted, printable
from spacerobot_ros.messages.builders import STATIC_TRANSFORMS, TRANSFORMS
from spacerobot_ros.messages.definitions import message_module
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.rotations import (
    compose_poses,
    matrix_from_quaternion,
    quaternion_multiply,
)
from spacerobot_ros.nodes.common.node import LATCHED, LATCHED_QUEUE, STREAM
from spacerobot_ros.times import SECOND

if TYPE_CHECKING:
    from spacerobot_ros.planning import Goal
    from spacerobot_ros.planning.core.goal import EndEffectorGoal

_MAX_KEPT_TRANSFORMS, _MAX_KEPT_STATIC_TRANSFORMS = 200, 100
"""Numbers of stored /tf and /tf_static messages, enough for a few seconds from several
publishers.
"""

TRANSFORM_CLASS = "tf2_msgs.msg", "TFMessage"
"""Module and name of a class that few machines without ROS have; see :func:`interface_class`."""

_MAX_CHAINED_FRAMES = 1000
"""Maximum number of frames between a frame and the world; needed because received frames may form
a cycle.
"""

_SHORTEST_QUATERNION = 1e-6
"""Minimum quaternion norm in a message."""


def message_class(type_name: str) -> Any:
    """Return the class of a type such as ``nav_msgs/msg/Odometry``.

    Names may come from bags, so only packages with installed definitions are imported.

    Raises
    ------
    SpaceRobotError
        The package with the type is not installed; the error message completes a sentence about a
        topic.
    """
    try:
        module, interface, name = message_module(type_name)
    except (ValueError, RecordingError):
        kind = None
    else:
        kind = interface_class(module, interface)
    if kind is not None and name != interface:
        kind = interface_class(kind.__module__, name)
    if kind is None:
        raise SpaceRobotError(f"its type {type_name} is not installed here.")
    return kind


def interface_class(module: str, name: str) -> Any | None:
    """Return the class of an interface; None if its package is not fully installed."""
    try:
        kind = getattr(importlib.import_module(module), name)
        check_for_type_support(kind)
    except Exception:  # Several exceptions mean that it, or its libraries, are not on the paths.
        return None
    return kind


def shape_message(goal: Goal, joint_names: Sequence[str]) -> JointState:
    """Return a message with the joint positions required by a goal; empty if there are none."""
    positions = goal.joint_positions
    if positions is None:
        return JointState()
    return JointState(name=list(joint_names), position=positions.tolist())


def pose_array(position: Any, orientation: Any) -> Array | None:
    """Return the pose (7,), normalised, from a point or vector and a quaternion message.

    None if a value is not finite or the quaternion is zero.
    """
    p, o = position, orientation
    pose = np.array([p.x, p.y, p.z, o.x, o.y, o.z, o.w])
    length = float(np.linalg.norm(pose[3:]))
    if not np.all(np.isfinite(pose)) or length < _SHORTEST_QUATERNION:
        return None
    pose[3:] /= length
    return pose


def goal_of(
    message: PoseStamped,
    frame: str,
    what: str = "The goal pose",
    shape: Array | None = None,
    pose_of: Callable[[str], Array | None] = lambda frame: None,
) -> Goal:
    """Return the goal of a pose message in ``frame``, with joint positions ``shape``.

    A position or orientation whose values are all NaN is not part of the goal.

    ``pose_of`` returns the pose (7,) of another frame in ``frame``; None if unknown.

    Raises
    ------
    PlanningError
        The frame is unknown, or the message is not a pose; ``what`` names it.
    """
    from spacerobot_ros.planning import Goal  # A plant does not accept goals.

    pose = _pose_of_frame(message.header.frame_id, frame, what, pose_of)
    p, o = message.pose.position, message.pose.orientation
    goal = Goal.received([p.x, p.y, p.z], [o.x, o.y, o.z, o.w], shape)
    if pose is None:
        return goal
    moved = compose_poses(pose, np.concatenate([goal.position, goal.quaternion]))
    return replace(Goal.checked(moved[:3], moved[3:], shape), asked=goal.asked)


def end_effector_goal(
    link: str,
    message: PoseStamped,
    frame: str,
    what: str,
    pose_of: Callable[[str], Array | None] = lambda frame: None,
) -> EndEffectorGoal:
    """Return a link goal; if the orientation is all zeros or all NaN, any attitude is accepted.

    Raises
    ------
    PlanningError
        The message is not a pose, its position is NaN, or its frame is unknown; ``what`` names it.
    """
    from spacerobot_ros.planning.core.goal import EndEffectorGoal

    given = message.pose
    o = given.orientation
    any_attitude = not any((o.x, o.y, o.z, o.w))
    if any_attitude:
        message = PoseStamped(header=message.header)
        message.pose.position, message.pose.orientation.w = given.position, 1.0
    pose = goal_of(message, frame, what, None, pose_of)
    if "position" not in pose.asked:
        raise PlanningError(f"{what} has no position: x, y and z are NaN.")
    any_attitude |= "attitude" not in pose.asked
    return EndEffectorGoal(link, pose.position, None if any_attitude else pose.quaternion)


def _pose_of_frame(
    name: str, frame: str, what: str, pose_of: Callable[[str], Array | None]
) -> Array | None:
    """Return the pose (7,) of a frame by its name in ``frame``; None: it is that frame."""
    given = name.removeprefix("/")
    if given in ("", frame):
        return None
    pose = pose_of(given)
    if pose is None:
        raise PlanningError(
            f"{what} is in frame '{given}'; goals are accepted in '{frame}', in frames of the "
            "robot once its state is known, and in frames that /tf connects to these."
        )
    return pose


def path_poses(
    message: Path,
    frame: str,
    what: str,
    pose_of: Callable[[str], Array | None] = lambda frame: None,
) -> Array:
    """Return the poses (K, 7) of a path message in ``frame``, or their positions (K, 3).

    Only positions are returned if all orientations are zeros. ``pose_of``: see :func:`goal_of`. A
    pose without a frame name is in the frame of the path.

    Raises
    ------
    PlanningError
        A frame is unknown, or the pose stamps decrease; ``what`` names the path.
    """
    given = [each.header.frame_id or message.header.frame_id for each in message.poses]
    poses, times = np.zeros((len(given), 7)), np.zeros(len(given), dtype=np.int64)
    for k, each in enumerate(message.poses):
        p, o, stamp = each.pose.position, each.pose.orientation, each.header.stamp
        poses[k] = p.x, p.y, p.z, o.x, o.y, o.z, o.w
        times[k] = stamp.sec * SECOND + stamp.nanosec
    back = np.flatnonzero(np.diff(times) < 0)
    if len(back):
        k = int(back[0]) + 1
        raise PlanningError(
            f"{what} goes back in time: pose {k + 1} is stamped {times[k] / SECOND:.9g} s, after "
            f"{times[k - 1] / SECOND:.9g} s; omit the stamps, or sort the poses by time."
        )
    for name in dict.fromkeys(given):
        other = _pose_of_frame(name, frame, what, pose_of)
        if other is not None:
            rows = np.array([each == name for each in given])
            r, quaternions = poses[rows, :3], poses[rows, 3:]
            poses[rows, :3] = other[:3] + r @ matrix_from_quaternion(other[3:]).T
            poses[rows, 3:] = quaternion_multiply(other[3:], quaternions)
    return poses if poses[:, 3:].any() else poses[:, :3]


def goal_description(part: str, goal_id: str, message: PoseStamped | Path, goal: Goal) -> str:
    """Return a log line about a received goal."""
    frame = printable(message.header.frame_id)
    given = f", given in '{frame}'" if frame else ""
    aim = goal.end_effectors[0] if goal.end_effectors else goal
    position, attitude = "any position", "any attitude"
    if "position" in goal.asked:
        position = f"({', '.join(f'{x:.4g}' for x in aim.position)}) m"
    if aim.quaternion is not None and "attitude" in goal.asked:
        attitude = f"({', '.join(f'{x:.4g}' for x in aim.quaternion)})"
    waypoints = getattr(aim, "waypoints", None)
    through = "" if waypoints is None else f" through {counted(len(waypoints), 'waypoint')}"
    return f"Goal {goal_id} of {part}: {position}, {attitude}{through}{given}."


def shape_of(message: JointState, joint_names: Sequence[str]) -> Array:
    """Return the joint positions (n,) in a message, in the robot's joint order.

    Raises
    ------
    PlanningError
        A joint is missing, or a position is not finite.
    """
    values = dict(zip(message.name, message.position, strict=False))
    missing = set(joint_names) - set(values)
    if missing:
        raise PlanningError(
            f"The goal joint positions are invalid: joint '{min(missing)}' is missing."
        )
    if not np.all(np.isfinite(list(values.values()))):
        raise PlanningError("The goal joint positions are invalid: a position is not finite.")
    return np.array([values[name] for name in joint_names])


class LatchedSubscription:
    """A subscription to a latched topic, renewed if a publisher has left while others remain: they
    then send their last messages again.
    """

    def __init__(
        self,
        node: Any,
        kind: type[Any],
        topic: str,
        take: Callable[[Any], None],
        qos: QoSProfile = LATCHED,
    ) -> None:
        self._node, self._arguments = node, (kind, topic, take, qos)
        self._subscribe()

    def _subscribe(self) -> None:
        self.outdated = False
        """Whether the last message may be from a node other than the present publishers."""
        events = SubscriptionEventCallbacks(matched=self._on_match)
        self.subscription = self._node.create_subscription(*self._arguments, event_callbacks=events)

    def _on_match(self, matches: Any) -> None:
        self.outdated |= matches.total_count > matches.current_count > 0

    def renew(self) -> None:
        """Subscribe again if outdated; to be called by a timer of the node."""
        if self.outdated:
            self._node.destroy_subscription(self.subscription)
            self._subscribe()


class KnownFrames:
    """The frames known to a node, from the robot state and, if available, from /tf.

    Messages from /tf are stored in serialised form and read when a frame is requested.
    """

    def __init__(self, node: Any) -> None:
        self._recent: deque[bytes] = deque(maxlen=_MAX_KEPT_TRANSFORMS)
        self._static: deque[bytes] = deque(maxlen=_MAX_KEPT_STATIC_TRANSFORMS)
        self._kind = interface_class(*TRANSFORM_CLASS)
        if self._kind is None:
            return
        for topic, kept, qos in (
            (TRANSFORMS, self._recent, STREAM),
            (STATIC_TRANSFORMS, self._static, LATCHED_QUEUE),
        ):
            node.create_subscription(self._kind, topic, kept.append, qos, raw=True)

    def pose(self, frame: str, world: str, own: dict[str, tuple[str, Array]]) -> Array | None:
        """Return the last known pose (7,) of a frame in the world.

        ``own`` maps each frame to its parent and its pose in the parent frame, and overrides /tf.
        None if the frames are not connected.
        """
        parents: dict[str, tuple[str, Array]] = {}
        for raw in (*self._static, *self._recent):
            try:
                transforms = deserialize_message(raw, self._kind).transforms
            except RuntimeError:
                continue  # The bytes are not a TFMessage.
            for each in transforms:
                step = pose_array(each.transform.translation, each.transform.rotation)
                if step is not None:
                    parents[each.child_frame_id] = each.header.frame_id, step
        parents |= own
        pose = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
        for _ in range(_MAX_CHAINED_FRAMES):
            if frame == world:
                return pose
            if frame not in parents:
                return None
            frame, step = parents[frame]
            pose = compose_poses(step, pose)
        return None
