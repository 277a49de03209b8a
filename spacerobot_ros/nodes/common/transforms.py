"""Transforms: the frames of a robot as /tf carries them, and what /tf says of others.

``tf2_msgs`` is not on every machine. Its one message is put together here byte by byte, so that
bags have it everywhere; topics need the package.
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from geometry_msgs.msg import TransformStamped
from nav_msgs.msg import Odometry
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message

from spacerobot_ros.errors import CommandError, SpaceRobotError
from spacerobot_ros.model.description import Array, RobotDescription
from spacerobot_ros.model.kinematics import ForwardKinematics, Frames
from spacerobot_ros.nodes.common.cdr import JointReader, TemplateReader
from spacerobot_ros.nodes.common.messages import chained, message_class
from spacerobot_ros.times import SECOND

TRANSFORM_TYPE = "tf2_msgs/msg/TFMessage"
TRANSFORMS, STATIC_TRANSFORMS = "/tf", "/tf_static"
"""Names of the topics where no remap moves them."""

_ENCAPSULATION = b"\x00\x01\x00\x00"
_NUMBERS = 7
_LISTENED = 200
"""Messages of /tf that are kept: some seconds of a robot with several publishers."""

_LISTENED_STATIC = 100
_LONGEST_CHAIN = 1000


def transform_class() -> Any | None:
    """Return the class of the message, or None where its package is not installed."""
    try:
        return message_class(TRANSFORM_TYPE)
    except SpaceRobotError:
        return None


class TransformTemplate:
    """A serialised tf2_msgs/TFMessage whose stamps and numbers are written in place.

    Parameters
    ----------
    frames
        Names of the parent and the child of each transform.
    """

    def __init__(self, frames: Frames) -> None:
        body = bytearray(struct.pack("<I", len(frames)))
        stamps, numbers = [], []
        for parent, child in frames:
            _align(body, 4)
            stamps.append(len(body) // 4)
            body += bytes(8)
            for name in (parent, child):
                text = name.encode() + b"\0"
                _align(body, 4)
                body += struct.pack("<I", len(text)) + text
            _align(body, 8)
            numbers.append(len(body) // 8)
            body += bytes(8 * _NUMBERS)
        self._buffer = bytearray(_ENCAPSULATION) + body
        words = np.frombuffer(self._buffer, np.uint32, offset=len(_ENCAPSULATION))
        self._words = words
        # All numbers are at multiples of eight bytes from the encapsulation.
        self._doubles = np.frombuffer(
            self._buffer, np.float64, len(body) // 8, offset=len(_ENCAPSULATION)
        )
        self._stamps = np.array(stamps, dtype=int)
        self._places = np.array(numbers, dtype=int)[:, None] + np.arange(_NUMBERS)

    def serialised(self, time_ns: int, poses: Array) -> bytes:
        """Return the message with the poses (k, 7), all of one time."""
        seconds, nanoseconds = divmod(time_ns, SECOND)
        self._words[self._stamps] = seconds
        self._words[self._stamps + 1] = nanoseconds
        self._doubles[self._places] = poses
        return bytes(self._buffer)


def _align(body: bytearray, size: int) -> None:
    body += bytes(-len(body) % size)


class RobotTransforms:
    """The transforms of a robot as messages.

    Parameters
    ----------
    description
        The robot.
    world_frame
        Name of the inertial frame.
    prefix
        Goes before the names of the links, as robot_state_publisher's ``frame_prefix``.
    links
        Whether all links are in it, or the base link alone.
    """

    def __init__(
        self, description: RobotDescription, world_frame: str, prefix: str, *, links: bool
    ) -> None:
        self._links = ForwardKinematics(description) if links else None
        moving, fixed = ((), ()) if self._links is None else (self._links.moving, self._links.fixed)
        frames = ((world_frame, prefix + description.base_link), *_prefixed(moving, prefix))
        self._template = TransformTemplate(frames)
        self._poses = np.zeros((len(frames), _NUMBERS))
        self._fixed = _prefixed(fixed, prefix)

    def message(self, time_ns: int, pose: Array, q: Array) -> bytes:
        """Return the message of a pose (7,) of the base link and positions (n,) of the joints."""
        self._poses[0] = pose
        if self._links is not None:
            self._links.update(q)
            self._poses[1:] = self._links.transforms
        return self._template.serialised(time_ns, self._poses)

    def static_message(self, time_ns: int) -> bytes | None:
        """Return the message of the links that do not move in their parents, if there are any."""
        if self._links is None or not self._fixed:
            return None
        return TransformTemplate(self._fixed).serialised(time_ns, self._links.fixed_transforms)


def _prefixed(frames: Iterable[tuple[str, str]], prefix: str) -> Frames:
    return tuple((prefix + parent, prefix + child) for parent, child in frames)


class StateFrames:
    """Reads the frames of a robot from its odom and joint_states."""

    def __init__(self, description: RobotDescription) -> None:
        self._description = description
        self._odom = TemplateReader(Odometry, lambda _: {"pose.pose.position.x": _NUMBERS})
        self._joints = JointReader(description.joint_names, ["position"], complete=True)

    def accept(self, odom: bytes, joint_states: bytes) -> None:
        """Make these the state.

        Raises
        ------
        CommandError
            They are not of this robot.
        """
        self._joints.accept(joint_states)
        self._odom.accept(odom)
        message = self._odom.prototype
        assert message is not None
        self.world, base = message.header.frame_id, message.child_frame_id
        if not base.endswith(self._description.base_link):
            raise CommandError(f"its child frame is '{base}'")
        self.prefix = base.removesuffix(self._description.base_link)

    @property
    def pose(self) -> Array:
        """Pose of the base link (7,)."""
        return self._odom.floats("pose.pose.position.x")

    @property
    def q(self) -> Array:
        """Positions of the joints (n,), m or rad."""
        return self._joints.values["position"]


class KnownFrames:
    """The frames that a node knows: those of its robot's state, and those of /tf where it is there.

    Messages of /tf are kept as they are received, and read when a frame is asked for.

    Parameters
    ----------
    node
        Whose they are.
    """

    def __init__(self, node: Any) -> None:
        self._recent: deque[bytes] = deque(maxlen=_LISTENED)
        self._static: deque[bytes] = deque(maxlen=_LISTENED_STATIC)
        self._kind = transform_class()
        if self._kind is None:
            return
        reliable = ReliabilityPolicy.RELIABLE
        latched = QoSProfile(
            depth=_LISTENED_STATIC,
            reliability=reliable,
            durability=DurabilityPolicy.TRANSIENT_LOCAL,
        )
        stream = QoSProfile(depth=100, reliability=reliable)
        for topic, kept, qos in (
            (TRANSFORMS, self._recent, stream),
            (STATIC_TRANSFORMS, self._static, latched),
        ):
            node.create_subscription(self._kind, topic, kept.append, qos, raw=True)

    def pose(self, frame: str, world: str, own: dict[str, tuple[str, Array]]) -> Array | None:
        """Return the pose (7,) of a frame in the world, by the latest that is known of it.

        ``own`` goes before what /tf says: by frame its parent and its pose in that. None: nothing
        connects the two.
        """
        parents = {**self._heard(), **own}
        pose = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
        for _ in range(_LONGEST_CHAIN):  # Frames may be connected in a circle.
            if frame == world:
                return pose
            if frame not in parents:
                return None
            frame, step = parents[frame]
            pose = chained(step, pose)
        return None

    def _heard(self) -> dict[str, tuple[str, Array]]:
        received: dict[str, tuple[str, Array]] = {}
        for raw in (*self._static, *self._recent):
            try:
                transforms: Sequence[TransformStamped] = deserialize_message(
                    raw, self._kind
                ).transforms
            except RuntimeError:
                continue  # Bytes that are no such message.
            for each in transforms:
                r, o = each.transform.translation, each.transform.rotation
                pose = np.array([r.x, r.y, r.z, o.x, o.y, o.z, o.w])
                length = float(np.linalg.norm(pose[3:]))
                if np.all(np.isfinite(pose)) and length > 0.5:
                    pose[3:] /= length
                    received[each.child_frame_id] = each.header.frame_id, pose
        return received


def robot_frames(description: RobotDescription, state: StateFrames) -> dict[str, tuple[str, Array]]:
    """Return, by name of a link, its parent and its pose (7,) in that, in a measured state."""
    links, prefix = ForwardKinematics(description), state.prefix
    links.update(state.q)
    frames = {prefix + description.base_link: (state.world, state.pose)}
    for names, poses in ((links.moving, links.transforms), (links.fixed, links.fixed_transforms)):
        for (parent, child), pose in zip(names, poses, strict=True):
            frames[prefix + child] = prefix + parent, pose
    return frames
