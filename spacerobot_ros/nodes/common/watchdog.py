"""Heartbeats of nodes, and the detection of nodes whose heartbeats cease."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from enum import Enum

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.timer import Timer

from spacerobot_ros.messages.diagnostics import diagnostic_name
from spacerobot_ros.messages.statuses import read_status
from spacerobot_ros.model.compilation import compilation_contexts
from spacerobot_ros.nodes.common.messages import diagnostic_status

TOPIC = "heartbeat"

HEARTBEAT_PERIOD = 0.2
"""Wall s between two heartbeats of an active node."""

_SILENCE_CHECK_PERIOD = 0.1
"""Wall time between two checks for silent nodes, s."""

_SUSPENSION_TIME = 0.3
"""Wall time between two checks beyond which this node itself was suspended, s."""

_REPORT_PERIOD = 1.0
"""Wall s between two diagnostics while a node is silent."""

HEARTBEAT_QOS = QoSProfile(depth=20, reliability=ReliabilityPolicy.RELIABLE)


class Role(str, Enum):
    """The part of a node in the stack; the value is the ``hardware_id`` of its heartbeats."""

    PLANT = "plant"
    COMMANDER = "commander"
    RECORDER = "recorder"
    REPLAY = "replay"


class HeartbeatState(str, Enum):
    """The state of a node; the value is the ``message`` of its heartbeats."""

    ACTIVE = "active"
    BUSY = "busy"
    """The node plans or compiles, and sends no heartbeat until it is done."""
    INACTIVE = "inactive"
    """The node was deactivated or shut down in order, and sends no heartbeat."""


@dataclass(frozen=True)
class SilenceReport:
    """A node has become silent, or is back.

    Attributes
    ----------
    name
        Full name of the node.
    seconds
        Duration without a heartbeat, wall s.
    over
        Whether the node is back.
    """

    name: str
    seconds: float
    over: bool = False

    @property
    def message(self) -> str:
        """Sentence about the silence for the user."""
        if self.over:
            return f"Node '{self.name}' is back after {self.seconds:.2g} s."
        return f"Node '{self.name}' is silent for {self.seconds:.2g} s."


class Watchdog:
    """Finds nodes whose heartbeats cease.

    A node is watched from its first heartbeat on until it says that it is inactive. While it is
    busy nothing is expected of it. Where this node itself stood still, all are given their time
    again.

    Parameters
    ----------
    timeout
        Wall s without a heartbeat after which a node is silent.
    clock
        Returns the wall time, s.
    """

    def __init__(self, timeout: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._timeout, self._clock = timeout, clock
        self._heard: dict[str, float] = {}
        """Time of the last received or excused heartbeat by node, s."""
        self._busy: set[str] = set()
        self.silent: dict[str, float] = {}
        """Time of the last heartbeat by silent node, s."""
        self._looked = clock()

    def hear(self, name: str, pulse: str) -> SilenceReport | None:
        """Process a heartbeat; return the end of a silence, None if the node was not silent."""
        now = self._clock()
        back = None
        if name in self.silent:
            back = SilenceReport(name, now - self.silent.pop(name), over=True)
        self._busy.discard(name)
        if pulse == HeartbeatState.BUSY.value:
            self._busy.add(name)
        if pulse in (HeartbeatState.ACTIVE.value, HeartbeatState.BUSY.value):
            self._heard[name] = now
        else:
            self._heard.pop(name, None)
        return back

    def look(self) -> list[SilenceReport]:
        """Return the nodes that have become silent since the last call."""
        now = self._clock()
        if now - self._looked > _SUSPENSION_TIME:
            for name in self._heard:
                self._heard[name] = now
        self._looked = now
        lost = [
            SilenceReport(name, now - heard)
            for name, heard in self._heard.items()
            if name not in self.silent and name not in self._busy and now - heard > self._timeout
        ]
        for silence in lost:
            self.silent[silence.name] = self._heard[silence.name]
        return lost


class Liveness:
    """Sends the heartbeats of a node, and watches those of other nodes.

    Parameters
    ----------
    node
        The node that sends them.
    role
        Its role.
    depends_on
        The roles that it watches.
    on_silence
        Called when a node has become silent, or is back.
    """

    def __init__(
        self,
        node: Node,
        role: Role | None,
        depends_on: Iterable[Role],
        on_silence: Callable[[SilenceReport], None],
    ) -> None:
        self._node, self._role, self._on_silence = node, role, on_silence
        self._publisher = node.create_publisher(DiagnosticStatus, TOPIC, HEARTBEAT_QOS)
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._timers: list[Timer] = []
        self._watched = {each.value for each in depends_on}
        self._timeout = 0.0
        self._watchdog: Watchdog | None = None
        self._busy = 0
        """Number of computations under way that may take long."""

    def configure(self, timeout: float) -> None:
        """Subscribe to heartbeats and create the publisher of diagnostics; a cleanup ends both.

        ``timeout``: see :class:`Watchdog`; 0: nothing is watched.
        """
        self._timeout = timeout
        if self._watched and timeout:
            node = self._node
            node.create_subscription(DiagnosticStatus, TOPIC, self._on_heartbeat, HEARTBEAT_QOS)
            self._diagnostics = node.create_publisher(
                DiagnosticArray, "/diagnostics", HEARTBEAT_QOS
            )

    def begin(self) -> None:
        """Start to send heartbeats and to watch those of other nodes."""
        self._end_timers()
        # Compiling a function on its first call counts as a long computation.
        compilation_contexts.append(self.busy)
        node = self._node
        beat = node.create_timer(HEARTBEAT_PERIOD, self.beat, clock=self._steady)
        self._timers.append(beat)
        if self._watched and self._timeout:
            self._watchdog = Watchdog(self._timeout)
            self._timers.append(
                node.create_timer(_SILENCE_CHECK_PERIOD, self._look, clock=self._steady)
            )
            self._next_report = 0.0
        self.beat()

    def end(self) -> None:
        """Announce the end of this node's heartbeats."""
        if self._timers:
            self._end_timers()
            self._watchdog = None
            with suppress(Exception):  # The ROS context may be shut down already.
                self._publish(HeartbeatState.INACTIVE)

    def beat(self) -> None:
        """Send a heartbeat if the node is active."""
        if self._timers:
            self._publish(HeartbeatState.BUSY if self._busy else HeartbeatState.ACTIVE)

    @contextmanager
    def busy(self) -> Iterator[None]:
        """Tell the watchdogs of other nodes that a computation may take long."""
        self._busy += 1
        self.beat()
        try:
            yield
        finally:
            self._busy -= 1
            self.beat()

    def _publish(self, pulse: HeartbeatState) -> None:
        name, role = self._node.get_fully_qualified_name(), self._role
        self._publisher.publish(
            DiagnosticStatus(
                name=name, message=pulse.value, hardware_id="" if role is None else role.value
            )
        )

    def _end_timers(self) -> None:
        if self.busy in compilation_contexts:
            compilation_contexts.remove(self.busy)
        for timer in self._timers:
            self._node.destroy_timer(timer)
        self._timers.clear()

    def _on_heartbeat(self, received: DiagnosticStatus) -> None:
        watchdog, message = self._watchdog, read_status(received)
        if watchdog is None or message.hardware_id not in self._watched:
            return
        if message.name == self._node.get_fully_qualified_name():
            return
        back = watchdog.hear(message.name, message.message)
        if back is not None:
            self._report([back])

    def _look(self) -> None:
        if self._watchdog is None:
            return  # The executor still calls a timer that is destroyed when it is due.
        lost = self._watchdog.look()
        if lost or (self._watchdog.silent and time.monotonic() >= self._next_report):
            self._report(lost)

    def _report(self, news: list[SilenceReport]) -> None:
        """Report changes to the node, and publish diagnostics about silent nodes."""
        for silence in news:
            self._on_silence(silence)
        watchdog, node = self._watchdog, self._node
        if watchdog is None:
            return  # The node has reacted by stopping.
        self._next_report = time.monotonic() + _REPORT_PERIOD
        silent = sorted(watchdog.silent)
        values = dict.fromkeys(silent, "silent")
        values.update({each.name: "back" for each in news if each.over})
        status = diagnostic_status(
            diagnostic_name(node.get_fully_qualified_name(), "watchdog"),
            DiagnosticStatus.ERROR if silent else DiagnosticStatus.OK,
            f"silent: {', '.join(silent)}" if silent else "all nodes send heartbeats",
            values,
            "" if self._role is None else self._role.value,
        )
        self._diagnostics.publish(DiagnosticArray(status=[status]))
