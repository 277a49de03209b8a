"""The transforms that a recorder writes into a bag where no node publishes them."""

from __future__ import annotations

from collections.abc import Callable

from rclpy.serialization import deserialize_message
from std_msgs.msg import String

from spacerobot_ros.bag import QosProfile, Recording
from spacerobot_ros.bag.rosbag2 import LATCHED
from spacerobot_ros.errors import CommandError, RecordingError, RobotDescriptionError
from spacerobot_ros.model.description import RobotDescription
from spacerobot_ros.model.urdf import parse_robot
from spacerobot_ros.nodes.common.streams import Take
from spacerobot_ros.nodes.common.transforms import TRANSFORM_TYPE, RobotTransforms, StateFrames
from spacerobot_ros.times import HEADER_STAMP, SECOND, first_time_ns

_STREAM = QosProfile(depth=100)


class RecordedTransforms:
    """Writes the frames of one robot by its recorded topics.

    A state is taken when its odom and its joint_states are there, whichever comes first; so the
    transforms have the stamps of states.

    Parameters
    ----------
    recording
        Where they go.
    period
        Bag time between two of them, s.
    topics
        Names of /tf and /tf_static in the bag.
    is_published
        Returns whether a node publishes /tf: its messages are recorded, and none are written here.
    """

    def __init__(
        self,
        recording: Recording,
        period: float,
        topics: tuple[str, str],
        is_published: Callable[[], bool],
    ) -> None:
        self._recording, self._topics, self._is_published = recording, topics, is_published
        self._period_ns = round(period * SECOND)
        self._odom, self._joint_states = b"", b""
        self._last_ns, self._next_ns = 0, 0
        self._description: RobotDescription | None = None
        self._state: StateFrames | None = None
        self._frames: RobotTransforms | None = None
        self._channel = -1

    def listeners(self, odom: str, joint_states: str, description: str) -> dict[str, Take]:
        """Return the callback of every message of these topics."""
        return {
            odom: self._on_odom,
            joint_states: self._on_joint_states,
            description: self._on_description,
        }

    def _on_odom(self, raw: bytes) -> None:
        self._odom = raw
        if raw[HEADER_STAMP] == self._joint_states[HEADER_STAMP]:
            self._take_state(first_time_ns(raw))

    def _on_joint_states(self, raw: bytes) -> None:
        self._joint_states = raw
        if raw[HEADER_STAMP] == self._odom[HEADER_STAMP]:
            self._take_state(first_time_ns(raw))

    def _on_description(self, raw: bytes) -> None:
        try:
            description = parse_robot(deserialize_message(raw, String).data)
        except (RobotDescriptionError, RuntimeError):
            return  # Nothing is known of such a robot.
        self._description, self._frames = description, None
        self._state = StateFrames(description)

    def _take_state(self, time_ns: int) -> None:
        """Write the transforms if the period is over, or time has gone back."""
        state = self._state
        if self._last_ns <= time_ns < self._next_ns or state is None:
            return
        if not self._recording.running or self._is_published():
            return
        try:
            state.accept(self._odom, self._joint_states)
            self._write(state, time_ns)
        except (CommandError, RecordingError):
            return  # Of another robot; a disk that refuses is reported by whatever is next.
        self._last_ns, self._next_ns = time_ns, time_ns + self._period_ns

    def _write(self, state: StateFrames, time_ns: int) -> None:
        recording = self._recording
        if self._frames is None:
            assert self._description is not None
            self._frames = RobotTransforms(self._description, state.world, state.prefix, links=True)
            self._channel = recording.writer.add_topic(self._topics[0], TRANSFORM_TYPE, _STREAM)
            static = self._frames.static_message(time_ns)
            if static is not None:
                channel = recording.writer.add_topic(self._topics[1], TRANSFORM_TYPE, LATCHED)
                recording.record(channel, static, time_ns)
        message = self._frames.message(time_ns, state.pose, state.q)
        recording.record(self._channel, message, time_ns)
