"""Builds the stack's messages from plain values: states, goals, plans, predicted paths, frames, and
markers for viewers.

All markers are in the world frame, so that a viewer needs no transforms.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from spacerobot_ros.errors import CommandError
from spacerobot_ros.messages.definitions import (
    Layout,
    encode,
    installed_type,
    seconds_and_nanoseconds,
)
from spacerobot_ros.messages.readers import (
    ODOMETRY,
    POSE_PATH,
    JointReader,
    MessageTemplate,
    TemplateReader,
)
from spacerobot_ros.model.description import (
    DEFAULT_END_EFFECTOR,
    Array,
    Pose,
    RobotDescription,
    Shape,
)
from spacerobot_ros.model.kinematics import ForwardKinematics, Frames, LinkPlacement
from spacerobot_ros.model.rotations import matrix_from_quaternion, quaternion_from_matrix
from spacerobot_ros.times import LATEST_NS, SECOND, stamp_bytes
from spacerobot_ros.topics import Topic, link_topic

if TYPE_CHECKING:
    from spacerobot_ros.planning import BasePath, GaitSchedule, Goal

TRANSFORM_TYPE = "tf2_msgs/msg/TFMessage"
TRANSFORMS, STATIC_TRANSFORMS = "/tf", "/tf_static"
"""Transform topic names before remapping."""


def _transform_columns(poses: Array) -> dict[str, Array]:
    """Return poses (m, k, 7) by the path of their first number in a message."""
    return {f"transforms[{i}].transform.translation.x": poses[:, i] for i in range(poses.shape[1])}


def transform_template(frames: Frames) -> MessageTemplate:
    """Return a tf2_msgs/TFMessage template with the parent and child frame of each transform."""
    transforms = [
        {"header": {"frame_id": parent}, "child_frame_id": child} for parent, child in frames
    ]
    return MessageTemplate(TRANSFORM_TYPE, encode(TRANSFORM_TYPE, {"transforms": transforms}))


class RobotTransforms:
    """A robot's transforms as messages.

    Parameters
    ----------
    description
        The robot.
    world_frame
        Name of the inertial frame.
    prefix
        Prefix of link names, like robot_state_publisher's ``frame_prefix``.
    links
        Whether to include the transforms of all links or only that of the base link.
    """

    def __init__(
        self, description: RobotDescription, world_frame: str, prefix: str, *, links: bool
    ) -> None:
        self._links = ForwardKinematics(description) if links else None
        moving, fixed = ((), ()) if self._links is None else (self._links.moving, self._links.fixed)
        base = world_frame, prefix + description.base_link
        self._fixed = _prefix_frames(fixed, prefix)
        # Nodes send a message per tick; a fed template takes a fifth of the time of a copy.
        frames = (base, *_prefix_frames(moving, prefix))
        self._template, self._poses = transform_template(frames), np.zeros((1, len(frames), 7))
        for path, pose in _transform_columns(self._poses).items():
            self._template.feed(path, pose[0])

    def message(self, time_ns: int, pose: Array, q: Array) -> bytes:
        """Return the message for a base link pose (7,) and joint positions (n,)."""
        self._poses[0, 0] = pose
        if self._links is not None:
            self._poses[0, 1:] = self._links.transforms_at(q)
        return self._template.serialised(stamp_bytes(time_ns))

    def messages(self, times_ns: NDArray[np.int64], poses: Array, q: Array) -> list[bytes]:
        """Return the messages for times (m,), base poses (m, 7) and joint positions (m, n)."""
        every = poses[:, np.newaxis]
        if self._links is not None:
            every = np.concatenate([every, self._links.transforms_at(q)], axis=1)
        return self._template.copies(times_ns, _transform_columns(every))

    def static_message(self, time_ns: int) -> bytes | None:
        """Return the message for links fixed to their parents; None without such links."""
        if self._links is None or not self._fixed:
            return None
        columns = _transform_columns(self._links.fixed_transforms[np.newaxis])
        return transform_template(self._fixed).copies(np.array([time_ns]), columns)[0]


def _prefix_frames(frames: Iterable[tuple[str, str]], prefix: str) -> Frames:
    return tuple((prefix + parent, prefix + child) for parent, child in frames)


class StateFrames:
    """Computes a robot's frames from odom and joint_states."""

    def __init__(self, description: RobotDescription) -> None:
        self._description = description
        self._odom = TemplateReader(ODOMETRY)
        self._joints = JointReader(description.joint_names, ["position"], measured=True)
        self.q = self._joints.values["position"]
        """Joint positions (n,), m or rad."""

    def accept(self, odom: bytes, joint_states: bytes) -> None:
        """Take the new state from the serialised messages.

        Raises
        ------
        CommandError
            The messages belong to another robot.
        """
        self._joints.accept(joint_states)
        self._odom.accept(odom)
        self.world = self._odom.text("header.frame_id")
        base = self._odom.text("child_frame_id")
        if not base.endswith(self._description.base_link):
            raise CommandError(f"its child frame is '{base}'")
        self.prefix = base.removesuffix(self._description.base_link)

    @property
    def pose(self) -> Array:
        """Base link pose (7,)."""
        return self._odom.floats(POSE_PATH, 7)

    @property
    def frames(self) -> dict[str, tuple[str, Array]]:
        """Each link's parent, and pose (7,) in the parent, by link name."""
        links, prefix = ForwardKinematics(self._description), self.prefix
        frames = {prefix + self._description.base_link: (self.world, self.pose)}
        moving = links.transforms_at(self.q)
        for names, poses in ((links.moving, moving), (links.fixed, links.fixed_transforms)):
            for (parent, child), pose in zip(names, poses, strict=True):
                frames[prefix + child] = prefix + parent, pose
        return frames


def state_message(
    topic: Topic, names: Sequence[str], world: str, base: str, target: str = ""
) -> bytes:
    """Return a message for a state topic, with all values set to zero.

    Parameters
    ----------
    topic
        A topic table entry.
    names
        Joints or thrusters that correspond to the array entries.
    world, base
        Names of the inertial frame and of the base link frame.
    target
        Frame name of the target's root link.
    """
    values: dict[str, Any] = {}
    if topic.type == "std_msgs/msg/Float64MultiArray":
        words = topic.state[0].array_entry_names
        dimension = {"label": " ".join(words), "size": len(words), "stride": len(words)}
        values["layout"] = {"dim": [dimension]}
    elif topic.state:
        values["header"] = {"frame_id": base if topic.frame == "base" else world}
    if topic.type == "nav_msgs/msg/Odometry":
        values["child_frame_id"] = target if topic.name.startswith("target/") else base
    if topic.type == "sensor_msgs/msg/JointState":
        values["name"] = names
    for field in topic.state:
        if not field.members:
            values[field.path] = np.zeros(len(field.array_entry_names or names))
    return encode(topic.type, values)


def goal_message(goal: Goal, frame: str, stamp_ns: int = 0) -> bytes:
    """Return a goal pose as geometry_msgs/PoseStamped; components not required are NaN."""
    r, quaternion = (
        values if part in goal.asked else np.full(len(values), np.nan)
        for part, values in (("position", goal.position), ("attitude", goal.quaternion))
    )
    header = {"stamp": min(stamp_ns, LATEST_NS), "frame_id": frame}
    return encode(
        "geometry_msgs/msg/PoseStamped", {"header": header, "pose": _pose_fields(r, quaternion)}
    )


def _pose_fields(position: Array, quaternion: Array) -> dict[str, Any]:
    return {
        "position": dict(zip("xyz", position, strict=True)),
        "orientation": dict(zip("xyzw", quaternion, strict=True)),
    }


def goal_messages(
    goal: Goal, end_effector: Goal | None, frame: str, stamp_ns: int
) -> dict[str, bytes]:
    """Return the messages of one goal by topic; ``end_effector`` is a controller's goal, if any."""
    paths = {} if goal.waypoints is None else {"goal_path": goal.path_values}
    poses = {"goal_pose": goal} if goal.base and not paths else {}
    if end_effector is not None:
        poses[link_topic(DEFAULT_END_EFFECTOR, "goal_pose")] = end_effector
    for each in goal.end_effectors:
        link = each.link or DEFAULT_END_EFFECTOR
        if each.waypoints is None:
            poses[link_topic(link, "goal_pose")] = each.as_goal()
        else:
            paths[link_topic(link, "path")] = each.path_values
    messages = {}
    header = {"header": {"stamp": min(stamp_ns, LATEST_NS), "frame_id": frame}}
    for name, path in paths.items():
        # Without attitudes, all quaternions are zero, which means any attitude.
        columns = {"pose.position.x": np.zeros((len(path), 7))}
        columns["pose.position.x"][:, : path.shape[1]] = path
        messages[name] = encode_list("nav_msgs/msg/Path", header, "poses", header, columns)
    return messages | {name: goal_message(aim, frame, stamp_ns) for name, aim in poses.items()}


def encode_list(
    type_name: str,
    values: Mapping[str, Any],
    name: str,
    element: Mapping[str, Any],
    columns: Mapping[str, NDArray[Any]],
) -> bytes:
    """Return a message whose last field is a list of many messages with one layout.

    Parameters
    ----------
    type_name, values
        Values of the message without the list, as in :func:`encode`.
    name
        Field of the list.
    element
        Values common to all elements; arrays have their final lengths.
    columns
        Numbers (N, size), one row per element, keyed by the path of the first field in an element.
    """
    count = len(next(iter(columns.values())))
    if not count:
        return encode(type_name, values)
    # Three elements show the layout: only the padding of the first may differ.
    few = [encode(type_name, {**values, name: [element] * k}) for k in range(4)]
    none, _, second, _ = map(len, few)
    leaves = Layout(few[3], installed_type(type_name), elements=True).leaves
    head = bytearray(few[1])
    struct.pack_into("<I", head, none - 4, count)
    rows = np.tile(np.frombuffer(few[3][second:], np.uint8), (count - 1, 1))
    for path, column in columns.items():
        data = np.ascontiguousarray(column).view(np.uint8).reshape(count, -1)
        size = data.shape[1]
        begin = leaves[f"{name}[0].{path}"].offset
        head[begin : begin + size] = data[0].tobytes()
        begin = leaves[f"{name}[2].{path}"].offset - second
        rows[:, begin : begin + size] = data[1:]
    return bytes(head) + rows.tobytes()


def trajectory_message(schedule: GaitSchedule, stamp_ns: int, frame: str) -> bytes:
    """Return a schedule as trajectory_msgs/JointTrajectory.

    Point k contains the joint positions at tick k and the velocities until tick k+1 (zero at the
    end). Long gaits have about a hundred thousand points.
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
            "time_from_start.sec": seconds_and_nanoseconds(
                np.arange(count, dtype=np.int64) * period_ns
            ),
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
            "header.stamp.sec": seconds_and_nanoseconds(np.minimum(times, LATEST_NS)),
            "pose.position.x": np.hstack([path.position, path.quaternion]),
        },
    )


# -- markers ----------------------------------------------------------------------------------

MARKER_ARRAY = "visualization_msgs/msg/MarkerArray"

_TYPES = {"box": 1, "sphere": 2, "cylinder": 3, "mesh": 10, "capsule": 11}
"""Marker ``type`` values by geometry kind: CUBE ... TRIANGLE_LIST."""

_LINE_STRIP = 4
_DELETE = 2
"""Value of ``action`` that deletes a Marker."""

_GHOST_ALPHA = 0.25
_LINE_WIDTH, _LINE_COLOR = 0.005, (0.95, 0.6, 0.1, 1.0)
"""Width (m) and color of path lines."""


def _marker(frame: str, namespace: str, number: int, **fields: Any) -> dict[str, Any]:
    own = {"header": {"frame_id": frame}, "ns": namespace, "id": number}
    return {**own, "pose": {"orientation": {"w": 1.0}}, **fields}


def shape_marker(shape: Shape, frame: str, namespace: str, number: int) -> dict[str, Any]:
    """Return the marker fields of a URDF visual, with an identity pose."""
    size, points = shape.size, []
    if shape.kind == "cylinder":
        size = (2 * size[0], 2 * size[0], size[1])
    elif shape.kind == "sphere":
        size = (2 * size[0],) * 3
    elif shape.kind == "capsule":
        from spacerobot_ros.model.meshes import solid_mesh  # Few shapes are capsules.

        size, mesh = (1.0, 1.0, 1.0), solid_mesh(replace(shape, pose=Pose()))
        corners = mesh.vertices[mesh.faces].reshape(-1, 3).tolist()
        points = [dict(zip("xyz", corner, strict=True)) for corner in corners]
    return _marker(
        frame,
        namespace,
        number,
        type=_TYPES[shape.kind],
        scale=dict(zip("xyz", size, strict=True)),
        color=dict(zip("rgba", shape.rgba, strict=True)),
        points=points,
        mesh_resource=shape.resource,
    )


def _line(namespace: str, number: int, places: Array, frame: str) -> dict[str, Any]:
    """Return the marker fields of a line through points (K, 3)."""
    points = [dict(zip("xyz", place, strict=True)) for place in places.tolist()]
    look = {"scale": {"x": _LINE_WIDTH}, "color": dict(zip("rgba", _LINE_COLOR, strict=True))}
    return _marker(frame, namespace, number, type=_LINE_STRIP, points=points, **look)


def goal_markers(goal: Goal, path: BasePath, robot: RobotDescription, frame: str) -> bytes:
    """Return markers for the base at its goal, the planned base path as a line, and an
    end-effector's goal path.

    The goal pose is drawn with the visuals of the base link and of the links fixed to it.
    """
    markers: list[dict[str, Any]] = []
    base = Pose(matrix_from_quaternion(goal.quaternion), goal.position)
    for link in robot.links:
        body, link_pose = robot.frames[link.name]
        for shape in link.shapes if body == 0 else ():
            marker = shape_marker(shape, frame, "goal", len(markers))
            placed = base @ link_pose @ shape.pose
            marker["color"] |= {"a": _GHOST_ALPHA}
            markers.append(
                {**marker, "pose": _pose_fields(placed.r, quaternion_from_matrix(placed.R))}
            )
    markers.append(_line("planned_path", len(markers), path.position, frame))
    given = [each.path_values for each in goal.end_effectors if each.waypoints is not None]
    if given:
        markers.append(_line("given_path", 0, given[0][:, :3], frame))
    else:  # The path of an earlier goal is deleted.
        markers.append(_marker("", "given_path", 0, action=_DELETE))
    return encode(MARKER_ARRAY, {"markers": markers})


class RobotMarkers:
    """All visuals of a robot, its target and its obstacles as one marker array, in the namespaces
    ``robot``, ``target`` and ``obstacles``.

    Parameters
    ----------
    robot, target
        The robot and the target; None if it does not exist.
    frame
        Name of the world frame.
    """

    def __init__(self, robot: RobotDescription, target: RobotDescription | None, frame: str):
        self._robot, self._target, self._frame = robot, target, frame
        self._drawn: set[tuple[str, int]] = set()
        """Namespaces and IDs of all markers created so far."""
        self.use_obstacles(robot.world)

    def use_obstacles(self, world: RobotDescription | None) -> None:
        """Replace the obstacles to draw; None: none."""
        robot, target, frame = self._robot, self._target, self._frame
        poses: list[tuple[int, Pose]] = []
        markers: list[dict[str, Any]] = []
        for index, link in enumerate(robot.links):
            for shape in link.shapes:
                markers.append(shape_marker(shape, frame, "robot", len(markers)))
                poses.append((index, shape.pose))
        self._of_target: list[Pose] = []
        """Poses of the target's visuals in the frame of its root link."""
        for link in () if target is None else target.links:
            for shape in link.shapes:
                markers.append(shape_marker(shape, frame, "target", len(markers)))
                assert target is not None
                self._of_target.append(target.frames[link.name][1] @ shape.pose)
        for link in () if world is None else world.links:
            for shape in link.shapes or link.collisions:
                marker = shape_marker(shape, frame, "obstacles", len(markers))
                assert world is not None
                at = world.frames[link.name][1] @ shape.pose
                markers.append({**marker, "pose": _pose_fields(at.r, quaternion_from_matrix(at.R))})
        present = {(marker["ns"], marker["id"]) for marker in markers}
        markers += [_marker("", *each, action=_DELETE) for each in sorted(self._drawn - present)]
        self._drawn |= present
        self.draws_anything = bool(markers)
        """Whether there are any markers; the robot, the target and the obstacles may all lack
        visuals."""
        self._template = MessageTemplate(MARKER_ARRAY, encode(MARKER_ARRAY, {"markers": markers}))
        self._placement = LinkPlacement(len(robot.links), poses)
        self._target_poses = np.tile([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0], (len(self._of_target), 1))
        for i, pose in enumerate([*self._placement.poses, *self._target_poses]):
            self._template.feed(f"markers[{i}].pose.position.x", pose)

    def message(
        self, time_ns: int, base: Array, link_R: Array, link_r: Array, target: Array | None
    ) -> bytes:
        """Return the markers at one time.

        Parameters
        ----------
        time_ns
            The stamp, ns.
        base, target
            Poses (7,) of the base and the target in the world.
        link_R, link_r
            Attitudes (3, 3 L) and positions (3, L) of the links in the base frame, m.
        """
        self._placement.update(base, link_R, link_r)
        if target is not None:
            at = Pose(matrix_from_quaternion(target[3:]), target[:3])
            for pose, fixed in zip(self._target_poses, self._of_target, strict=True):
                shape = at @ fixed
                pose[:3], pose[3:] = shape.r, quaternion_from_matrix(shape.R)
        return self._template.serialised(stamp_bytes(time_ns))
