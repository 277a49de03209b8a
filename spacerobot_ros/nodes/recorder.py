"""The recorder node: writes every topic, as published, to an MCAP bag."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.clock import Clock as RosClock
from rclpy.clock import ClockType
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.experimental import EventsExecutor
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock

from spacerobot_ros.bag import (
    LATCHED,
    BagWriter,
    QosProfile,
    RecorderConfig,
    Recording,
    RecordingState,
)
from spacerobot_ros.errors import (
    CommandError,
    ParameterError,
    RecordingError,
    RobotDescriptionError,
    SpaceRobotError,
)
from spacerobot_ros.events import Event, EventKind
from spacerobot_ros.messages.builders import (
    STATIC_TRANSFORMS,
    TRANSFORM_TYPE,
    TRANSFORMS,
    RobotTransforms,
    StateFrames,
)
from spacerobot_ros.messages.diagnostics import StatusRecord, diagnostic_name, encode_diagnostics
from spacerobot_ros.messages.readers import read_text
from spacerobot_ros.model.description import RobotDescription
from spacerobot_ros.model.urdf import parse_robot
from spacerobot_ros.nodes.common.messages import message_class
from spacerobot_ros.nodes.common.node import STREAM, UNKNOWN_NODE, FlightNode
from spacerobot_ros.nodes.common.process import run_node
from spacerobot_ros.nodes.common.ros_parameters import RemoteParameters
from spacerobot_ros.nodes.common.watchdog import Role
from spacerobot_ros.resources import __version__
from spacerobot_ros.times import HEADER_STAMP, SECOND, first_time_ns
from spacerobot_ros.topics import TOPICS, TOPICS_NOT_RECORDED

RawCallback = Callable[[bytes], None]

_CLOCK_TOPIC = "/clock"

_SHARED_TOPICS = ("/diagnostics", TRANSFORMS, STATIC_TRANSFORMS)
_DESCRIPTION_TOPIC = "robot_description"

_PRELIMINARY_TOPICS = tuple(
    f"/{name.lstrip('/').removeprefix('end_effector/')}"
    for name, topic in TOPICS.items()
    if not topic.state
)
"""Suffixes of topics on which messages are published before a plant starts: all but its states."""

_TEXT_TYPE = "std_msgs/msg/String"
_CLOCK_TYPE = "rosgraph_msgs/msg/Clock"

_PARAMETER_RECORD_BY_TOPIC = {
    "odom": "plant",
    "planner/status": "planner",
    "controller/status": "coordinated_control",
}
"""Name of the record with the parameters of a node, by a topic that the node publishes.

A node that publishes such a topic is configured, so its parameters are fixed."""

_QUEUE_DEPTH = 2000
"""Queue depth of subscriptions; above 5000 the events executor stops responding."""

_SCAN_PERIOD = 0.1  # wall s

_CHECK_PERIOD = 0.4
"""Wall time, s, between two checks that the bag file exists; a failure is detected within a
second.
"""

_LONGEST_DRAIN = 1.2  # wall s

_LOSS_LOG_PERIOD = 5.0
"""Wall time, s, between two log lines about lost messages."""


class RecorderNode(FlightNode):
    """Records topics as raw bytes, as rosbag2 does.

    :class:`Recording` determines the time stamps.
    """

    Config: ClassVar = RecorderConfig
    role = Role.RECORDER
    depends_on = (Role.PLANT,)
    config: RecorderConfig
    recording: Recording | None = None
    """The current recording, or the last one."""

    def __init__(self, name: str = "recorder", **kwargs: Any) -> None:
        self._parameter_requests: dict[str, RemoteParameters | None] = {}
        """Names of the parameter records that are in the bag or have been requested from nodes."""
        self._topics_without_owner: set[str] = set()
        """Topics whose publisher was discovered before its node; the parameters of the node must
        still be requested."""
        super().__init__(name, **kwargs)

    # -- life cycle ---------------------------------------------------------------------------

    def configure(self) -> None:
        """Open the bag and subscribe to topics, which are recorded once the node is active."""
        config = self.config
        # Checks that may fail come before the bag is opened, as it would stay open.
        descriptions: dict[str, dict[str, str]] = {}
        if config.describe:
            try:
                records = json.loads(Path(config.describe).read_text(encoding="utf-8"))
                for title, values in records.items():
                    descriptions[title] = {name: str(value) for name, value in values.items()}
            except (OSError, ValueError, AttributeError) as error:
                raise ParameterError(
                    f"Parameter 'describe' is '{config.describe}', which is not a JSON file with "
                    f"named objects: {error}."
                ) from error
        self._clock_topic = self.resolve_topic_name(_CLOCK_TOPIC)
        self._chosen_topics = {self.resolve_topic_name(topic) for topic in config.topics.split()}
        self._shared_topics = {self._clock_topic, *map(self.resolve_topic_name, _SHARED_TOPICS)}
        writer = BagWriter(
            config.bag or time.strftime("spacerobot-%Y%m%d-%H%M%S.mcap"),
            config,
            overwrite=False,
            next_free=config.when_exists == "next",
        )
        recording = self.recording = Recording(writer, config.clock_wait, self._on_failure)
        self._parameter_requests = {}
        self._topics_without_owner = set()
        self._listeners: dict[str, RawCallback] = {}
        """Functions that also receive the messages on a topic."""
        frames = self.resolve_topic_name(TRANSFORMS)
        if config.tf_period and self._is_chosen(frames, TRANSFORM_TYPE):
            self._listeners = _RecordedTransforms(self, recording).listeners
        self.topics: set[str] = set()
        """Full names of the subscribed topics."""
        self._unreadable_topics: set[str] = set()
        self._diagnostics: Publisher | None = None
        steady = RosClock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(_SCAN_PERIOD, self.scan, clock=steady)
        self.create_timer(config.flush_period, self.flush, clock=steady)
        self.create_timer(_CHECK_PERIOD, self._check_file, clock=steady)
        self._path = self._first_path = writer.path
        self._steps_back_of_one_clock = 0
        asked = Path(config.bag).name
        if asked and not writer.path.name.startswith((f"{Path(asked).stem}_", asked)):
            self.get_logger().warning(
                f"The bag {config.bag} already exists: this flight is recorded in {writer.path}."
            )
        if config.diagnostics_period:
            self.create_timer(config.diagnostics_period, self._publish_state, clock=steady)
        self.describe("spacerobot", {"version": __version__})
        for title, values in descriptions.items():
            self.describe(title, values)
        if self._chosen_topics and self._clock_topic not in self._chosen_topics:
            self.create_subscription(
                Clock,
                self._clock_topic,
                lambda raw: recording.set_clock(first_time_ns(raw)),
                QoSProfile(depth=_QUEUE_DEPTH),
                raw=True,
            )
        self.scan()

    def activate(self) -> None:
        """Start recording."""
        if self.recording is not None:
            self.recording.start()
            # The event omits the file name, so that two equal flights have equal bags.
            self.report_event(Event(EventKind.RECORDING, "Recording has begun."))

    def start_message(self) -> str:
        """Return a log message with the bag path."""
        return f"Records into {self.recording.writer.path}." if self.recording else ""

    def deactivate(self) -> None:
        """Pause recording; arriving messages are not recorded."""
        if self.recording is not None:
            paused = self.recording.running
            self.recording.pause()
            if paused:
                self.report_event(Event(EventKind.RECORDING_PAUSED, "Recording is paused."))

    def drain(self, executor: EventsExecutor) -> None:
        """Record messages in transit until no message has arrived for 0.3 s of wall time."""
        began = last = time.monotonic()
        recording = self.recording
        while recording is not None and recording.running and last - began < _LONGEST_DRAIN:
            before = recording.messages
            executor.spin_once(timeout_sec=0.001)
            if recording.messages != before:
                last = time.monotonic()
            elif time.monotonic() - last > 0.3:
                return

    def cleanup(self) -> None:
        """Complete and close the bag.

        Raises
        ------
        RecordingError
            The remaining data could not be written to disk.
        """
        for question in filter(None, self._parameter_requests.values()):
            question.close()
        if self.recording is not None:
            self.recording.close()
            if self.failure is None:
                first, last = self._first_path, self.recording.writer.path
                files = f"{first}" if first == last else f"{first} to {last.name}"
                count = self.recording.messages
                self.get_logger().info(f"{count} messages are recorded in {files}.")

    # -- contents ------------------------------------------------------------------------------

    @property
    def messages_recorded(self) -> int:
        """Number of messages written."""
        return self.recording.messages if self.recording is not None else 0

    @property
    def exit_code(self) -> int:
        """1 if an error ended the recording."""
        return 0 if self.failure is None else 1

    @property
    def failure(self) -> RecordingError | None:
        """Error that ended the recording; None if there was none."""
        return self.recording.failure if self.recording is not None else None

    def describe(self, name: str, values: dict[str, str]) -> None:
        """Write named values into the bag (parameters, seed, version)."""
        if self.recording is not None:
            self._parameter_requests[name] = None
            self.recording.describe(name, values)

    def scan(self) -> None:
        """Subscribe to newly discovered topics."""
        recording = self.recording
        if recording is None or recording.state is RecordingState.CLOSED:
            return
        for topic, types in self.get_topic_names_and_types():
            known = topic in self.topics or topic in self._unreadable_topics
            if not known and self._is_chosen(topic, types[0]):
                self._record(recording, topic, types[0])
        for topic in tuple(self._topics_without_owner):
            for owner in self.get_publishers_info_by_topic(topic)[:1]:
                self._request_parameters(topic, owner)
        for name, question in self._parameter_requests.items():
            if question is not None and question.look():
                self._parameter_requests[name] = None
                if question.values is not None:
                    recording.describe(name, question.values)

    def flush(self) -> None:
        """Pass the recorded data to the operating system, and report lost messages."""
        if self.recording is not None:
            clocks = self.count_publishers(self._clock_topic)
            self.recording.flush(clock_is_published=clocks > 0)
            if self.recording.lost:
                lost = sorted(self.recording.lost.items())
                counts = {topic: str(count) for topic, count in lost}
                listed = ", ".join(f"{count} on '{topic}'" for topic, count in lost)
                message = f"Messages were lost on their way to the recorder: {listed}."
                self.get_logger().warning(message, throttle_duration_sec=_LOSS_LOG_PERIOD)
                self._publish_diagnostics(self.recording, "lost messages", 1, message, counts)
            self._warn_of_clocks(self.recording, clocks)

    def _warn_of_clocks(self, recording: Recording, publishers: int) -> None:
        """Warn of a second clock, because times in the bag jump between the clocks.

        For a while, the middleware lists a killed plant together with the restarted one, but the
        clock jumps back only once for each listed plant after the first.
        """
        if publishers < 2:
            self._steps_back_of_one_clock = recording.clock_steps_back
        elif recording.clock_steps_back - self._steps_back_of_one_clock >= publishers:
            self.get_logger().warning(
                f"More than one clock is published on '{self._clock_topic}': times in the bag "
                f"jump between these clocks. Give each stack its own namespace and clock "
                "(--ros-args -r __ns:=/NAME -r /clock:=clock).",
                once=True,
            )

    # -- subscriptions ------------------------------------------------------------------------

    def _is_chosen(self, topic: str, type_name: str) -> bool:
        """Whether a topic is recorded: a requested one or, by default, any topic of the stack."""
        if self._chosen_topics:
            return topic in self._chosen_topics
        if topic in self._shared_topics:
            return True
        namespace = self.get_namespace().rstrip("/")
        ours = topic.startswith(f"{namespace}/") and not topic.endswith(TOPICS_NOT_RECORDED)
        return ours and type_name != _CLOCK_TYPE

    def _request_parameters(self, topic: str, owner: Any) -> None:
        """Request the parameters of a topic's publisher for the bag, unless the bag has them."""
        for name, title in _PARAMETER_RECORD_BY_TOPIC.items():
            if not topic.endswith(f"/{name}"):
                continue
            record = f"parameters{topic.removesuffix(f'/{name}')}/{title}"
            own = self.get_namespace().rstrip("/")
            if topic == f"{own}/{name}":
                record = f"parameters/{title}"
            if owner.node_name == UNKNOWN_NODE:
                self._topics_without_owner.add(topic)
                continue
            self._topics_without_owner.discard(topic)
            full = f"{owner.node_namespace.rstrip('/')}/{owner.node_name}"
            if record not in self._parameter_requests:
                self._parameter_requests[record] = RemoteParameters(self, full)

    def _record(self, recording: Recording, topic: str, type_name: str) -> None:
        publishers = self.get_publishers_info_by_topic(topic)
        offered = [info.qos_profile for info in publishers]
        if not offered:
            return  # The topic has no publisher yet, so its quality of service is unknown.
        try:
            kind = message_class(type_name)
            policies = ("history", "reliability", "durability", "liveliness")
            words = {name: getattr(offered[0], name).name.lower() for name in policies}
            recorded = QosProfile(depth=offered[0].depth, **words)
            channel = recording.writer.add_topic(topic, type_name, recorded)
        except SpaceRobotError as error:
            self._unreadable_topics.add(topic)
            self.get_logger().warning(f"Topic '{topic}' is not recorded: {error}")
            return
        self.topics.add(topic)
        # A bag of such topics alone cannot expect a plant.
        chosen = self._chosen_topics
        alone = bool(chosen) and all(each.endswith(_PRELIMINARY_TOPICS) for each in chosen)
        if topic.endswith(_PRELIMINARY_TOPICS) and not alone:
            recording.preliminary.add(channel)
        self._request_parameters(topic, publishers[0])
        take = self._recording_callback(recording, topic, kind, channel)
        qos = QoSProfile(depth=_QUEUE_DEPTH, reliability=ReliabilityPolicy.BEST_EFFORT)
        if all(each.reliability == ReliabilityPolicy.RELIABLE for each in offered):
            qos.reliability = ReliabilityPolicy.RELIABLE
        if all(each.durability == DurabilityPolicy.TRANSIENT_LOCAL for each in offered):
            qos.durability = DurabilityPolicy.TRANSIENT_LOCAL
            recording.latched[channel] = None
        # Latched topics keep their last message: a message replaced in transit is not lost.
        events = None if channel in recording.latched else loss_events(recording, topic)
        self.create_subscription(kind, topic, take, qos, event_callbacks=events, raw=True)

    def _recording_callback(
        self, recording: Recording, topic: str, kind: Any, channel: int
    ) -> RawCallback:
        """Return the callback for a topic's messages; the clock sets the time of all others."""
        is_clock, listener = topic == self._clock_topic, self._listeners.get(topic)
        is_description = topic.endswith(f"/{_DESCRIPTION_TOPIC}")
        urdf_name = f"{topic.strip('/').replace('/', '.')}.urdf"
        header = next(iter(kind.get_fields_and_field_types().values()), "")
        is_stamped = header == "std_msgs/Header"

        def take(raw: bytes) -> None:
            if is_clock:
                recording.set_clock(first_time_ns(raw))
            elif is_description and urdf_name not in recording.attached:
                recording.attach_robot(urdf_name, read_text(raw, _TEXT_TYPE, "data").encode())
            recording.record(channel, raw, first_time_ns(raw) if is_stamped else 0)
            if listener is not None:
                listener(raw)

        return take

    # -- reports ------------------------------------------------------------------------------

    def _on_failure(self, error: RecordingError) -> None:
        message = f"Recording has ended: {error}"
        self.get_logger().error(message)
        self._report_bag_event(EventKind.RECORDING_FAILED, message, level=2)
        self._publish_state()

    def _check_file(self) -> None:
        recording = self.recording
        if recording is None or recording.state is RecordingState.CLOSED:
            return
        recording.check()
        if recording.failure is not None:
            self._publish_state()
        elif recording.writer.path != self._path:
            self._path = recording.writer.path
            self._report_bag_event(EventKind.FILE_SPLIT, f"Recording continues in {self._path}.")

    def _report_bag_event(self, kind: EventKind, message: str, level: int = 0) -> None:
        bag = str(self.recording.writer.path) if self.recording is not None else ""
        self.report_event(Event(kind, message, level, about={"bag": bag}))

    def _publish_state(self) -> None:
        recording = self.recording
        if recording is None or recording.state is RecordingState.CLOSED:
            return
        failure = recording.failure
        message = str(failure) if failure else "recording" if recording.running else "paused"
        values = {
            "messages": str(recording.messages),
            "messages_lost": str(recording.lost.total()),
            "topics": str(len(self.topics)),
            "bytes_written": str(recording.writer.bytes_written),
            "bytes_waiting": str(recording.writer.bytes_waiting),
        }
        self._publish_diagnostics(recording, "bag", 2 if failure else 0, message, values)

    def _publish_diagnostics(
        self, recording: Recording, what: str, level: int, message: str, values: Mapping[str, str]
    ) -> None:
        # The publisher is created on first use, as each one is discovered and recorded.
        if self._diagnostics is None:
            self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", STREAM)
        name = diagnostic_name(self.get_fully_qualified_name(), what)
        record = StatusRecord(name, level, message, values, recording.writer.path.name)
        self._diagnostics.publish(encode_diagnostics([record], recording.now_ns))


class _RecordedTransforms:
    """Writes transforms of one robot, computed from its recorded topics.

    A state is used once its odom and its joint_states have arrived, in either order: topics have no
    common order. So the transforms have the stamps of states, and are at least ``tf_period`` of bag
    time apart. While a node publishes /tf itself, its messages are recorded, and none are written
    here.
    """

    def __init__(self, node: RecorderNode, recording: Recording) -> None:
        self._node, self._recording = node, recording
        self._period_ns = round(node.config.tf_period * SECOND)
        self._topics = [node.resolve_topic_name(name) for name in (TRANSFORMS, STATIC_TRANSFORMS)]
        callbacks: dict[str, RawCallback] = {
            "odom": partial(self._on_state, "odom"),
            "joint_states": partial(self._on_state, "joint_states"),
            _DESCRIPTION_TOPIC: self._on_description,
        }
        self.listeners = {node.resolve_topic_name(name): f for name, f in callbacks.items()}
        """Functions that take the messages, by topic."""
        self._unpaired: dict[str, dict[bytes, bytes]] = {"odom": {}, "joint_states": {}}
        """By topic and stamp: messages whose state is not complete, in order of arrival."""
        self._last_ns, self._next_ns = 0, 0
        self._description: RobotDescription | None = None
        self._state: StateFrames | None = None
        self._frames: RobotTransforms | None = None
        self._channel = -1

    def _on_description(self, raw: bytes) -> None:
        try:
            description = parse_robot(read_text(raw, _TEXT_TYPE, "data"))
        except (RobotDescriptionError, CommandError):
            return  # The description is unusable, so no transforms are written.
        self._description, self._frames = description, None
        self._state = StateFrames(description)

    def _on_state(self, topic: str, raw: bytes) -> None:
        """Write the transforms of a complete state if the period is over, or time has jumped
        back."""
        stamp, own = raw[HEADER_STAMP], self._unpaired[topic]
        other = self._unpaired["joint_states" if topic == "odom" else "odom"]
        if stamp not in other:
            own[stamp] = raw
            if len(own) > STREAM.depth:
                del own[next(iter(own))]
            return
        own.clear()  # The other topic has passed these.
        while (first := next(iter(other))) != stamp:
            del other[first]
        partner = other.pop(stamp)
        odom, joint_states = (raw, partner) if topic == "odom" else (partner, raw)
        state, time_ns = self._state, first_time_ns(odom)
        if self._last_ns <= time_ns < self._next_ns or state is None:
            return
        if not self._recording.running or self._topics[0] in self._node.topics:
            return
        try:
            state.accept(odom, joint_states)
            frames = self._frames or self._begin(state, time_ns)
        except (CommandError, RecordingError):
            return  # The state is of another robot. The next message reports a failed write.
        self._last_ns, self._next_ns = time_ns, time_ns + self._period_ns
        self._recording.record(self._channel, frames.message(time_ns, state.pose, state.q), time_ns)

    def _begin(self, state: StateFrames, time_ns: int) -> RobotTransforms:
        """Return the transforms for the robot in the first state; write those of fixed links."""
        assert self._description is not None
        writer, (moving, fixed) = self._recording.writer, self._topics
        frames = RobotTransforms(self._description, state.world, state.prefix, links=True)
        self._channel = writer.add_topic(moving, TRANSFORM_TYPE, QosProfile(depth=100))
        static = frames.static_message(time_ns)
        if static is not None:
            channel = writer.add_topic(fixed, TRANSFORM_TYPE, LATCHED)
            self._recording.record(channel, static, time_ns)
        self._frames = frames
        return frames


def loss_events(recording: Recording, topic: str) -> SubscriptionEventCallbacks:
    """Return callbacks for subscription events, which count lost messages.

    The middleware reports messages that the publisher dropped before they could be resent; it
    does not report overflows of the subscription's own queue (Fast DDS).
    """

    def on_loss(info: Any) -> None:
        recording.lost[topic] += info.total_count_change

    return SubscriptionEventCallbacks(message_lost=on_loss)


main = partial(run_node, RecorderNode)
"""Record until SIGINT or SIGTERM; the exit code is 1 if the recording has failed."""

if __name__ == "__main__":
    sys.exit(main())
