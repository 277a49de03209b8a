"""The replay node publishes the messages of an MCAP bag at their recorded times."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, ClassVar

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.exceptions import InvalidTopicNameException
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message, serialize_message
from rclpy.timer import Timer
from rosgraph_msgs.msg import Clock as ClockMessage
from std_msgs.msg import Float64, String
from std_srvs.srv import SetBool

from spacerobot_ros.bag import Playback, ReplayConfig, ReplayMessage, read_bag
from spacerobot_ros.bag.playback import ReplayStatus, SubscriberWait, renamed_topics
from spacerobot_ros.errors import (
    CommandError,
    ParameterError,
    RecordingError,
    SpaceRobotError,
    counted,
)
from spacerobot_ros.messages.builders import TRANSFORM_TYPE
from spacerobot_ros.messages.diagnostics import StatusRecord
from spacerobot_ros.model.meshes import with_attached_meshes
from spacerobot_ros.nodes.common.messages import message_class
from spacerobot_ros.nodes.common.node import LATCHED, STREAM, FlightNode
from spacerobot_ros.nodes.common.process import run_node
from spacerobot_ros.nodes.common.watchdog import Role
from spacerobot_ros.times import LATEST_NS, SECOND

_READER_CHECK_PERIOD = 0.05  # wall s
_MAX_MESSAGES_AT_ONCE = 500
_LONGEST_DELIVERY = Duration(seconds=2)

_LONGEST_TIMER_PERIOD_NS = 3600 * SECOND
"""Maximum timer period, ns; intervals between messages in a bag may be longer."""

_MAX_QUEUE_DEPTH = 10_000
"""Maximum queue depth, because a bag may request any depth, and the middleware allocates the whole
queue.
"""

_CLOCK_TOPIC = "/clock"
_STATUS_TOPIC, _SEEK_TOPIC = "replay/status", "replay/seek"

_STATUS_PERIOD = 0.2  # wall s
_TEXT_TYPE, _DESCRIPTION_TOPIC = "std_msgs/msg/String", "/robot_description"

_BAD_BAG_EXIT_CODE = 2


class ReplayNode(FlightNode):
    """Publishes the messages in a bag as bytes, with the recorded quality of service.

    The node waits until readers are matched, divides the intervals between log times by ``rate``,
    and ends its process at the end of the bag. Meshes in ``robot_description`` that are not on
    this machine are written from the bag to temporary files.

    Services: ``~/pause`` (SetBool), ``~/resume`` and, while paused, ``~/step``
    (Trigger), which sends the next message. A time on ``replay/seek`` sets the position, and
    ``replay/status`` reports it.
    """

    Config: ClassVar = ReplayConfig
    role = Role.REPLAY
    config: ReplayConfig

    def __init__(self, name: str = "replay", **kwargs: Any) -> None:
        self._sends: dict[str, Callable[[bytes], None]] = {}
        self._playing_timers: list[Timer] = []
        self._close_bag: Callable[[], None] = lambda: None
        self._mesh_folder: TemporaryDirectory[str] | None = None
        super().__init__(name, **kwargs)

    # -- life cycle ---------------------------------------------------------------------------

    def configure(self) -> None:
        """Open the bag and create the publishers and services."""
        # A failed configuration may have left its bag and files open.
        self.cleanup()
        config = self.config
        if not config.bag:
            raise ParameterError("Parameter 'bag' is empty; name the MCAP file to replay.")
        self.messages_replayed = 0
        bag = read_bag(config.bag)
        self._playback = Playback(bag, config)
        self._close_bag = self._playback.close
        self._outputs: list[Publisher] = []
        self._sends = {}
        self._attachments = bag.attachments
        self._mesh_folder = TemporaryDirectory(prefix="spacerobot_")
        replayed = {topic.name for topic in self._playback.topics}
        self._create_publishers(renamed_topics(config.remap, replayed))
        self._paused = config.paused
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_service(SetBool, "~/pause", self._on_pause)
        self.offer("~/resume", lambda: self._set_paused(False))
        self.offer("~/step", self._step)
        self._status_topic = self.create_publisher(DiagnosticStatus, _STATUS_TOPIC, LATCHED)
        self.create_subscription(Float64, _SEEK_TOPIC, self._on_seek, STREAM)

    def activate(self) -> None:
        """Wait for readers, then continue the replay."""
        self._begun = False
        self._wait = SubscriberWait(_READER_CHECK_PERIOD, self.config.wait)
        # One timer, which is reset for each message: half the load of a check every millisecond.
        # Its first period never elapses.
        self._timer = self.create_timer(1.0, self._send_due_messages, clock=self._steady)
        self._timer.cancel()
        self._waiting = self.create_timer(
            _READER_CHECK_PERIOD, self._on_reader_check, clock=self._steady
        )
        reports = self.create_timer(_STATUS_PERIOD, self._publish_status, clock=self._steady)
        self._playing_timers = [self._timer, self._waiting, reports]
        rate = self.config.clock
        if rate:
            self._playing_timers.append(
                self.create_timer(1.0 / rate, self._on_clock, clock=self._steady)
            )
        if not self.config.wait:
            self._begin()

    def start_message(self) -> str:
        """Return a log message with the bag, the number of topics and the rate."""
        config = self.config
        return (
            f"Replays {counted(len(self._outputs), 'topic')} of {config.bag} at {config.rate:g} "
            "times the recorded speed."
        )

    def deactivate(self) -> None:
        """Pause; the replay continues from the same message when the node is activated again."""
        if self._playing_timers:
            self._playback.pause(self._now())
        for timer in self._playing_timers:
            self.destroy_timer(timer)
        self._playing_timers = []

    def cleanup(self) -> None:
        """Close the bag, and remove its mesh files."""
        self._close_bag()
        folder, self._mesh_folder = self._mesh_folder, None
        if folder is not None:
            folder.cleanup()

    def destroy_node(self) -> None:
        """Close the bag and remove its mesh files, in any node state."""
        self.cleanup()
        super().destroy_node()

    # -- publishers ---------------------------------------------------------------------------

    def _create_publishers(self, new_names: dict[str, str]) -> None:
        own_clock = self.config.clock > 0
        if own_clock:
            self._clock_publisher = self.create_publisher(ClockMessage, _CLOCK_TOPIC, STREAM)
            self._last_clock = -1
        own = {self.resolve_topic_name(name) for name in (_STATUS_TOPIC, _SEEK_TOPIC)}
        for topic in self._playback.topics:
            if own_clock and topic.name == _CLOCK_TOPIC:
                continue
            if topic.name in own:
                continue  # The bag contains the status of another replay, which is omitted.
            name = new_names.get(topic.name, topic.name)
            latched = topic.qos.durability == "transient_local"
            # Without a depth in the bag, the stack's depth is used.
            depth = min(topic.qos.depth, _MAX_QUEUE_DEPTH) or (1 if latched else STREAM.depth)
            qos = QoSProfile(depth=depth, reliability=ReliabilityPolicy.RELIABLE)
            if topic.qos.reliability == "best_effort":
                qos.reliability = ReliabilityPolicy.BEST_EFFORT
            if latched:
                qos.durability = DurabilityPolicy.TRANSIENT_LOCAL
            try:
                publisher = self.create_publisher(message_class(topic.type_name), name, qos)
            except InvalidTopicNameException:
                raise ParameterError(
                    f"Topic '{topic.name}' cannot be replayed as '{name}': it is not a valid "
                    f"topic name."
                ) from None
            except SpaceRobotError as error:
                message = f"Topic '{topic.name}' is not replayed: {error}"
                # Every bag contains transforms, but few machines without ROS have their type.
                if topic.type_name == TRANSFORM_TYPE:
                    self.get_logger().info(message)
                else:
                    self.get_logger().warning(message)
                continue
            self._outputs.append(publisher)
            send: Callable[[bytes], None] = publisher.publish
            if topic.type_name == _TEXT_TYPE and topic.name.endswith(_DESCRIPTION_TOPIC):
                send = partial(self._publish_description, publisher)
            self._sends[topic.name] = send
        if not self._outputs and not own_clock:
            raise SpaceRobotError("None of the bag's message types is installed here.")

    def _publish_description(self, publisher: Publisher, data: bytes) -> None:
        assert self._mesh_folder is not None
        text = ""
        with suppress(RuntimeError):  # A description that cannot be read is replayed unchanged.
            text = deserialize_message(data, String).data
        located = with_attached_meshes(text, self._attachments, Path(self._mesh_folder.name))
        publisher.publish(data if located == text else serialize_message(String(data=located)))

    def _on_reader_check(self) -> None:
        matched = [p.get_subscription_count() for p in self._outputs]
        known = [self.count_subscribers(p.topic_name) for p in self._outputs]
        if self._wait.may_begin(matched, known):
            self._begin()

    # -- time ---------------------------------------------------------------------------------

    def _now(self) -> int:
        return int(self._steady.now().nanoseconds)

    def _begin(self) -> None:
        self._begun = True
        self._waiting.cancel()
        if not self._paused:
            self._playback.run(self._now())
        self._set_timer()

    def _set_timer(self) -> None:
        due = self._playback.next_due_time()
        if due is None:
            self._timer.cancel()
            return
        # Longer waits are split: the next call finds no message due and sets the timer again.
        self._timer.timer_period_ns = min(max(due - self._now(), 1), _LONGEST_TIMER_PERIOD_NS)
        self._timer.reset()

    def _send_due_messages(self) -> None:
        try:
            for message in self._playback.take_due(self._now(), _MAX_MESSAGES_AT_ONCE):
                self._send(message)
        except RecordingError as error:
            self._end_with_error(error)
            return
        self._set_timer()
        self._end_if_done()

    def _end_with_error(self, error: RecordingError) -> None:
        self._timer.cancel()
        self.get_logger().error(f"The replay has ended: {error}")
        self.on_end(_BAD_BAG_EXIT_CODE)

    def _send(self, message: ReplayMessage) -> None:
        if self.config.clock:
            self._publish_clock(message.log_time_ns)
        send = self._sends.get(message.topic)
        if send is not None:
            send(message.data)
            self.messages_replayed += 1

    def _on_clock(self) -> None:
        if self._begun:
            self._publish_clock(self._playback.bag_time(self._now()))

    def _publish_clock(self, time_ns: int) -> None:
        time_ns = min(time_ns, LATEST_NS)
        if time_ns == self._last_clock:
            return
        self._last_clock = time_ns
        message = ClockMessage()
        message.clock.sec, message.clock.nanosec = divmod(time_ns, SECOND)
        self._clock_publisher.publish(message)

    def _end_if_done(self) -> None:
        if not self._playback.ended:
            return
        self._timer.cancel()
        if self.config.hold:
            self._paused = True
            self._playback.pause(self._now())
            self._publish_status()
            return
        for publisher in self._outputs:
            publisher.wait_for_all_acked(_LONGEST_DELIVERY)
        self.get_logger().info(f"The replay has ended: {self.messages_replayed} messages.")
        self.on_end(0)

    # -- services -----------------------------------------------------------------------------

    def _set_paused(self, paused: bool) -> str:
        self._paused = paused
        if self._begun:
            if paused:
                self._playback.pause(self._now())
            else:
                if self._playback.ended:
                    self._seek(self._playback.start_ns)
                self._playback.run(self._now())
            self._set_timer()
        self._publish_status()
        return "paused" if paused else "running"

    def _on_pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        response.success, response.message = True, self._set_paused(bool(request.data))
        return response

    def _on_seek(self, message: Float64) -> None:
        if not math.isfinite(message.data):
            self.get_logger().warning(f"A replay cannot seek to {message.data} s.")
            return
        if not self._begun:
            return
        offset = min(max(message.data, 0.0), self._playback.duration_s)
        self._seek(self._playback.start_ns + round(offset * SECOND))
        self._set_timer()
        self._publish_status()

    def _seek(self, bag_ns: int) -> None:
        try:
            for message in self._playback.seek(bag_ns, self._now()):
                self._send(message)
        except RecordingError as error:
            self._end_with_error(error)

    def _publish_status(self) -> None:
        playback = self._playback
        position = playback.bag_time(self._now()) - playback.start_ns
        state = "paused" if self._paused or not self._begun else "playing"
        status = ReplayStatus(
            position_s=min(max(position / SECOND, 0.0), playback.duration_s),
            duration_s=playback.duration_s,
            state="ended" if playback.ended else state,
            rate=self.config.rate,
        )
        message = f"The replay is at {status.position_s:.3f} s of {status.duration_s:.3f} s."
        name = self.get_fully_qualified_name()
        self._status_topic.publish(StatusRecord(name, 0, message, status.to_values()).encoded())

    def _step(self) -> str:
        if not (self._paused and self._begun):
            raise CommandError("Only a paused replay can be stepped: pause it first.")
        try:
            message = self._playback.step(self._now())
        except RecordingError as error:
            raise CommandError(str(error)) from error
        if message is None:
            raise CommandError("The replay has ended.")
        self._send(message)
        self._end_if_done()
        return f"{message.topic} at {message.log_time_ns / SECOND:.9f} s"


main = partial(run_node, ReplayNode)
"""Replay a bag until its end, SIGINT or SIGTERM."""

if __name__ == "__main__":
    sys.exit(main())
