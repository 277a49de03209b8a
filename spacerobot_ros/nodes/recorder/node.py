"""The recorder node: every topic as it was published, into an MCAP bag."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, ClassVar

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.clock import Clock as RosClock
from rclpy.clock import ClockType
from rclpy.experimental import EventsExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from rosgraph_msgs.msg import Clock
from std_msgs.msg import String

from spacerobot_ros import __version__
from spacerobot_ros.bag import BagWriter, QosProfile, RecordingError
from spacerobot_ros.bag.config import RecorderConfig
from spacerobot_ros.errors import ParameterError, SpaceRobotError
from spacerobot_ros.nodes.common.cdr import NANOSECONDS, first_time_ns
from spacerobot_ros.nodes.common.diagnostics import diagnostic_status
from spacerobot_ros.nodes.common.message_types import message_class
from spacerobot_ros.nodes.common.node import FlightNode, run_node
from spacerobot_ros.nodes.common.raw_stream import Take
from spacerobot_ros.nodes.recorder.message_loss import MessageLoss
from spacerobot_ros.nodes.recorder.stream_taps import StreamTaps

_CLOCK = "/clock"

_QUEUE = 2000
"""Messages a subscription may be behind; the events executor wedges above 5000."""

_CHUNK_SIZE = 262_144
"""Bytes before compression: of larger ones the fixed costs are smaller, a seek's are larger."""

_SCAN_PERIOD = 0.1
"""Wall s between two looks for new topics."""

_LONGEST_DRAIN = 1.5
"""Wall s after a signal in which what is on its way is still recorded."""

_NOT_RECORDED = ("/rosout", "/parameter_events", "/transition_event")
"""Ends of topics with the middleware's own chatter, left out unless asked for by name."""


class RecorderNode(FlightNode):
    """Records topics as raw bytes, as rosbag2 would.

    Messages carry the time of /clock, what comes before its first message that one's time. Where
    nobody publishes a clock for ``clock_wait`` all carry the wall time of their arrival. A bag has
    one time: what was decided stays.
    """

    Config: ClassVar = RecorderConfig

    def __init__(self, name: str = "recorder", **kwargs: Any) -> None:
        self._writer: BagWriter | None = None
        self._taps = StreamTaps()
        super().__init__(name, **kwargs)

    # -- life ---------------------------------------------------------------------------------

    def configure(self) -> None:
        """Open the bag and look for topics; they are subscribed, and recorded once active."""
        path = str(self.parameters["bag"]) or time.strftime("spacerobot-%Y%m%d-%H%M%S.mcap")
        values: dict[str, Any] = self.parameters
        self._writer = BagWriter(
            path,
            compression=values["compression"],
            chunk_size=_CHUNK_SIZE,
            max_size=round(values["max_size"] * 1e6),
            max_duration_ns=round(values["max_duration"] * NANOSECONDS),
        )
        self.loss = MessageLoss(self)
        self._wanted = {
            self.resolve_topic_name(topic) for topic in str(self.parameters["topics"]).split()
        }
        self._recorded: dict[str, int] = {}
        self._unknown: set[str] = set()
        self._attached: set[str] = set()
        self._early: list[tuple[int, bytes, int, int]] | None = []
        self._wall = False
        self._now = 0
        self._now_stamp = b""
        self._active = self._steady = False
        self.messages_recorded = 0
        self.failure: RecordingError | None = None
        steady = RosClock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(_SCAN_PERIOD, self.scan, clock=steady)
        flush_period = float(self.parameters["flush_period"])  # type: ignore[arg-type]
        self.create_timer(flush_period, self._flush, clock=steady)
        if values["diagnostics_period"]:
            self.create_timer(values["diagnostics_period"], self._report, clock=steady)
        self.describe("spacerobot", {"version": __version__})
        for title, values in _descriptions(str(self.parameters["describe"])):
            self.describe(title, values)
        if self._wanted and _CLOCK not in self._wanted:
            self._follow_clock()
        self.scan()

    def activate(self) -> None:
        """Record from now on."""
        self._active = True
        self._settle()

    def deactivate(self) -> None:
        """Pause: what arrives is not recorded."""
        self._active = self._steady = False

    def drain(self, executor: EventsExecutor, quiet: float = 0.3) -> None:
        """Record what is still on its way, until nothing has come for ``quiet`` wall s."""
        began = last = time.monotonic()
        while self._active and last - began < _LONGEST_DRAIN:
            before = self.messages_recorded
            executor.spin_once(timeout_sec=0.001)
            if self.messages_recorded != before:
                last = time.monotonic()
            elif time.monotonic() - last > quiet:
                return

    def cleanup(self) -> None:
        """Complete the bag.

        Raises
        ------
        RecordingError
            The disk refused what was left.
        """
        if self._writer is not None:
            self._taps.release()
            self._release_early(None)
            counts = {"messages": self.messages_recorded, "messages_lost": self.loss.total}
            self.describe("recorder", {name: str(count) for name, count in counts.items()})
            writer, self._writer = self._writer, None
            writer.close()

    # -- for whoever composes the nodes -------------------------------------------------------

    def watch(self, nodes: Iterable[FlightNode]) -> None:
        """Take the streams of nodes of this process and executor where they pass through them.

        To be called before the recorder is configured. Messages are then recorded in the order of
        their publication, and a plant's commands as the plant took them. Other topics are
        subscribed, and so is what a node outside publishes too.
        """
        self._taps.nodes = list(nodes)

    @property
    def bag_path(self) -> str:
        """File that is being written, or was last."""
        return str(self._writer.path) if self._writer is not None else ""

    @property
    def topics(self) -> set[str]:
        """Full names of the topics that are subscribed."""
        return set(self._recorded)

    def describe(self, name: str, values: dict[str, str]) -> None:
        """Put named values into the bag (parameters, seed, version)."""
        if self._writer is not None:
            self._guarded(lambda writer: writer.add_metadata(name, values))

    def attach(self, name: str, data: bytes, media_type: str) -> None:
        """Put a whole file into the bag; the URDF of a recorded robot_description is by itself."""
        self._guarded(lambda writer: writer.add_attachment(name, data, media_type, self._now))

    def scan(self) -> None:
        """Subscribe to topics that have appeared."""
        if self._writer is None:
            return
        for topic in self._taps.release_incomplete(self.count_publishers):
            if self._recorded.pop(topic, None) is None:
                self._follow_clock()
        for topic, types in self.get_topic_names_and_types():
            chosen = topic in self._wanted if self._wanted else not topic.endswith(_NOT_RECORDED)
            if chosen and topic not in self._recorded and topic not in self._unknown:
                self._record(topic, types[0])

    # -- recording ----------------------------------------------------------------------------

    def _settle(self) -> None:
        """Nothing but writing is left to do with a message once the time is known."""
        self._steady = self._active and self._early is None and not self._wall

    def _follow_clock(self) -> None:
        """Know the time of a clock that is not recorded itself."""
        if not self._taps.tap(_CLOCK, self._on_time, self.count_publishers(_CLOCK)):
            depth = QoSProfile(depth=_QUEUE)
            self.create_subscription(Clock, _CLOCK, self._on_time, depth, raw=True)

    def _record(self, topic: str, type_name: str) -> None:
        infos = self.get_publishers_info_by_topic(topic)
        if not infos:
            return  # Only readers so far: its quality of service is not known yet.
        try:
            message_type = message_class(type_name)
            channel = self._add_topic(topic, type_name, infos[0].qos_profile)
        except SpaceRobotError as error:
            self._unknown.add(topic)
            self.get_logger().warning(f"Topic '{topic}' is not recorded: {error}")
            return
        self._recorded[topic] = channel
        callback = self._callback(topic, type_name, channel)
        if self._taps.tap(topic, callback, len(infos)):
            return
        reliable = all(i.qos_profile.reliability == ReliabilityPolicy.RELIABLE for i in infos)
        latched = all(i.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL for i in infos)
        qos = QoSProfile(
            depth=_QUEUE,
            reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
            durability=(DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE),
        )
        self.create_subscription(
            message_type,
            topic,
            callback,
            qos,
            event_callbacks=self.loss.events(topic),
            raw=True,
        )

    def _add_topic(self, topic: str, type_name: str, qos: QoSProfile) -> int:
        assert self._writer is not None
        return self._writer.add_topic(
            topic,
            type_name,
            QosProfile(
                history=qos.history.name.lower(),
                depth=qos.depth,
                reliability=qos.reliability.name.lower(),
                durability=qos.durability.name.lower(),
                liveliness=qos.liveliness.name.lower(),
            ),
        )

    def _callback(self, topic: str, type_name: str, channel: int) -> Take:
        """Return what takes a topic's messages: the clock sets the time of all others."""
        assert self._writer is not None
        write = self._writer.write

        def store(raw: bytes, published_ns: int) -> None:
            if not self._steady:
                if not self._active:
                    return
                if self._early is not None:
                    self._early.append((channel, raw, published_ns, time.time_ns()))
                    return
                self._now = time.time_ns()
            try:
                write(channel, raw, self._now, published_ns or self._now)
            except RecordingError as error:
                self._fail(error)
                return
            self.messages_recorded += 1

        def on_clock(raw: bytes) -> None:
            self._on_time(raw)
            store(raw, 0)

        def on_stamped(raw: bytes) -> None:
            store(raw, 0 if raw[4:12] == self._now_stamp else first_time_ns(raw))

        def on_description(raw: bytes) -> None:
            if topic not in self._attached and self._active:
                self._attached.add(topic)
                urdf = deserialize_message(raw, String).data.encode()
                name = f"{topic.strip('/').replace('/', '.')}.urdf"
                self.attach(name, urdf, "application/xml")
            store(raw, 0)

        if topic == _CLOCK:
            return on_clock
        if topic.endswith("/robot_description"):
            return on_description
        header = next(iter(message_class(type_name).get_fields_and_field_types().values()), "")
        if header == "std_msgs/Header":
            return on_stamped
        return lambda raw: store(raw, 0)

    def _on_time(self, raw: bytes) -> None:
        if self._wall:
            return
        self._now, self._now_stamp = first_time_ns(raw), raw[4:12]
        if self._early is not None and self._active:
            self._release_early(self._now)

    def _release_early(self, now_ns: int | None) -> None:
        """Write what came before the time was known; None: at the wall time that it came."""
        early, self._early = self._early or [], None
        self._settle()

        def write_all(writer: BagWriter) -> None:
            for channel, raw, published_ns, arrival_ns in early:
                log_ns = arrival_ns if now_ns is None else now_ns
                writer.write(channel, raw, log_ns, published_ns or log_ns)
                self.messages_recorded += 1

        self._guarded(write_all)

    def _flush(self) -> None:
        if self._early and not self.count_publishers(_CLOCK):
            waited = time.time_ns() - self._early[0][3]
            if waited > float(self.parameters["clock_wait"]) * NANOSECONDS:  # type: ignore[arg-type]
                self._wall = True
                self._release_early(None)
        self._guarded(lambda writer: writer.flush())
        self.loss.report(self._now)

    def _report(self) -> None:
        if self._writer is None:
            return
        status = diagnostic_status(
            f"{self.get_fully_qualified_name()}: bag",
            DiagnosticStatus.ERROR if self.failure else DiagnosticStatus.OK,
            str(self.failure) if self.failure else "recording" if self._active else "paused",
            {
                "messages": self.messages_recorded,
                "messages_lost": self.loss.total,
                "topics": len(self._recorded),
                "bytes_written": self._writer.bytes_written,
                "bytes_waiting": self._writer.bytes_waiting,
            },
        )
        self.loss.publish(self._now, status)

    def _guarded(self, act: Callable[[BagWriter], None]) -> None:
        if self._writer is None or self.failure is not None:
            return
        try:
            act(self._writer)
        except RecordingError as error:
            self._fail(error)

    def _fail(self, error: RecordingError) -> None:
        """The disk is full or gone: say so once, keep what is written, let the others fly on."""
        self.failure = error
        self._active = self._steady = False
        self.get_logger().error(f"Recording has ended: {error}")


def _descriptions(path: str) -> list[tuple[str, dict[str, str]]]:
    if not path:
        return []
    try:
        records = json.loads(Path(path).read_text(encoding="utf-8"))
        return [(n, {k: str(v) for k, v in values.items()}) for n, values in records.items()]
    except (OSError, ValueError, AttributeError) as error:
        raise ParameterError(
            f"Parameter 'describe' is '{path}', which is no JSON file of named objects: {error}."
        ) from error


def parameters_of(node: FlightNode) -> dict[str, str]:
    """Return a node's parameters as JSON texts by name, for a bag's metadata."""
    return {name: json.dumps(value) for name, value in node.parameters.items()}


def main() -> None:
    """Record until SIGINT or SIGTERM."""
    sys.exit(run_node(RecorderNode))


if __name__ == "__main__":
    main()
