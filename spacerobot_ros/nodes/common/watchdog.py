"""Node heartbeats, and the detection of nodes whose heartbeats stop."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.clock import Clock, ClockType
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.timer import Timer

from spacerobot_ros.messages.diagnostics import (
    StatusRecord,
    diagnostic_name,
    encode_diagnostics,
    read_status,
)
from spacerobot_ros.model.compilation import compilation_contexts

if TYPE_CHECKING:
    from spacerobot_ros.nodes.common.node import FlightNode

TOPIC = "heartbeat"

HEARTBEAT_PERIOD = 0.2
"""Wall time, s, between two heartbeats of an active node."""

_SILENCE_CHECK_PERIOD = 0.1  # wall s

_SUSPENSION_TIME = 0.3
"""Wall time, s, between two checks above which this node itself is assumed to have been
suspended.
"""

_REPORT_PERIOD = 1.0  # wall s, while a node is silent

_TOLERATED_ECHOES = 2
"""Heartbeats with the name of a node that may exceed those that it has sent, such as the last ones
of a process that it replaces."""

HEARTBEAT_QOS = QoSProfile(depth=20, reliability=ReliabilityPolicy.RELIABLE)


class Role(str, Enum):
    """The role of a node in the stack; the value is the ``hardware_id`` of its heartbeats."""

    PLANT = "plant"
    COMMANDER = "commander"
    RECORDER = "recorder"
    REPLAY = "replay"


class HeartbeatState(str, Enum):
    """The state of a node; the value is the ``message`` of its heartbeats."""

    ACTIVE = "active"
    BUSY = "busy"
    """The node is planning or compiling, and sends no heartbeat until it is done."""
    INACTIVE = "inactive"
    """The node was deactivated or shut down cleanly, and sends no heartbeat."""


@dataclass(frozen=True)
class SilenceReport:
    """A node has become silent, or has returned."""

    name: str
    seconds: float
    """Duration without a heartbeat, s of wall time."""
    over: bool = False
    """Whether the node has returned."""

    @property
    def message(self) -> str:
        """Message to the user about the silence."""
        if self.over:
            return f"Node '{self.name}' is back after {self.seconds:.2g} s."
        return f"Node '{self.name}' is silent for {self.seconds:.2g} s."


class Watchdog:
    """Detects nodes whose heartbeats stop.

    A node is monitored from its first heartbeat until it reports that it is inactive. While a
    node is busy, no heartbeat is expected. If this node itself was suspended, all timeouts restart.

    Parameters
    ----------
    timeout
        Wall time, s, without a heartbeat after which a node is considered silent.
    clock
        Function that returns the wall time, s.
    """

    def __init__(self, timeout: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._timeout, self._clock = timeout, clock
        self._heard: dict[str, float] = {}
        """Time of the last received or excused heartbeat of each node, s; infinite if the node is
        busy.
        """
        self.silent: dict[str, float] = {}
        """Time of the last heartbeat of each silent node, s."""
        self._looked = clock()

    def hear(self, name: str, pulse: str) -> SilenceReport | None:
        """Process a heartbeat; return the end of a silence, or None if the node was not silent."""
        now, since = self._clock(), self.silent.pop(name, None)
        match pulse:
            case HeartbeatState.ACTIVE.value:
                self._heard[name] = now
            case HeartbeatState.BUSY.value:
                self._heard[name] = math.inf
            case _:
                self._heard.pop(name, None)
        return None if since is None else SilenceReport(name, now - since, over=True)

    def look(self) -> list[SilenceReport]:
        """Return the nodes that have become silent since the last call."""
        now = self._clock()
        if now - self._looked > _SUSPENSION_TIME:
            self._heard = {name: max(heard, now) for name, heard in self._heard.items()}
        self._looked = now
        lost = {
            name: heard
            for name, heard in self._heard.items()
            if now - heard > self._timeout and name not in self.silent
        }
        self.silent |= lost
        return [SilenceReport(name, now - heard) for name, heard in lost.items()]


class Liveness:
    """Sends the heartbeats of a node, and monitors the heartbeats of the roles on which this node
    depends: the node is told when a monitored node has become silent, or has returned.
    """

    def __init__(self, node: FlightNode) -> None:
        self._node = node
        self._role = "" if node.role is None else node.role.value
        self._publisher = node.create_publisher(DiagnosticStatus, TOPIC, HEARTBEAT_QOS)
        self._timers: list[Timer] = []
        self._watched = {each.value for each in node.depends_on}
        self._watchdog: Watchdog | None = None
        self._timeout = 0.0
        self._busy = 0
        """Number of running computations that may take a long time."""
        self._foreign = 0
        """Heartbeats received with the name of this node, minus those that it has sent."""

    def configure(self, timeout: float) -> None:
        """Subscribe to heartbeats and create the diagnostics publisher; a cleanup destroys both.

        For ``timeout``, see :class:`Watchdog`; if it is 0, nothing is monitored.
        """
        self._timeout, node = timeout, self._node
        if self._watched and timeout:
            node.create_subscription(DiagnosticStatus, TOPIC, self._on_heartbeat, HEARTBEAT_QOS)
            self._diagnostics = node.create_publisher(
                DiagnosticArray, "/diagnostics", HEARTBEAT_QOS
            )

    def begin(self) -> None:
        """Start sending heartbeats and monitoring the heartbeats of other nodes."""
        # Compiling a function on its first call counts as a long computation.
        compilation_contexts.append(self.busy)
        steady, create = Clock(clock_type=ClockType.STEADY_TIME), self._node.create_timer
        self._timers = [create(HEARTBEAT_PERIOD, self._beat, clock=steady)]
        if self._watched and self._timeout:
            self._watchdog, self._next_report = Watchdog(self._timeout), 0.0
            self._timers.append(create(_SILENCE_CHECK_PERIOD, self._look, clock=steady))
        self._beat()

    def end(self) -> None:
        """Announce the end of this node's heartbeats, if it was active."""
        if not self._timers:
            return
        compilation_contexts.remove(self.busy)
        for timer in self._timers:
            self._node.destroy_timer(timer)
        self._timers, self._watchdog = [], None
        with suppress(Exception):  # The ROS context may be shut down already.
            self._publish(HeartbeatState.INACTIVE)

    @contextmanager
    def busy(self) -> Iterator[None]:
        """Announce to other nodes' watchdogs that a computation may take a long time."""
        self._busy += 1
        self._beat()
        try:
            yield
        finally:
            self._busy -= 1
            self._beat()

    def _beat(self) -> None:
        if self._timers:
            self._publish(HeartbeatState.BUSY if self._busy else HeartbeatState.ACTIVE)

    def _publish(self, pulse: HeartbeatState) -> None:
        name = self._node.get_fully_qualified_name()
        self._foreign -= 1
        self._publisher.publish(
            DiagnosticStatus(name=name, message=pulse.value, hardware_id=self._role)
        )

    def _on_heartbeat(self, received: DiagnosticStatus) -> None:
        watchdog, message = self._watchdog, read_status(received)
        if message.name == self._node.get_fully_qualified_name():
            self._foreign += 1
            if self._foreign > _TOLERATED_ECHOES:
                self._node.get_logger().warning(
                    f"Another node '{message.name}' runs in this ROS domain: end it, or give one "
                    "of the two another namespace or ROS_DOMAIN_ID.",
                    once=True,
                )
            return
        if watchdog is None or message.hardware_id not in self._watched:
            return
        back = watchdog.hear(message.name, message.message)
        if back is not None:
            self._report([back])

    def _look(self) -> None:
        assert self._watchdog is not None
        lost = self._watchdog.look()
        if lost or (self._watchdog.silent and time.monotonic() >= self._next_report):
            self._report(lost)

    def _report(self, news: list[SilenceReport]) -> None:
        for silence in news:
            self._node.on_silence(silence)
        if self._watchdog is None:
            return  # The node has reacted by stopping.
        self._next_report = time.monotonic() + _REPORT_PERIOD
        silent = sorted(self._watchdog.silent)
        values = dict.fromkeys(silent, "silent")
        values.update({each.name: "back" for each in news if each.over})
        record = StatusRecord(
            diagnostic_name(self._node.get_fully_qualified_name(), "watchdog"),
            2 if silent else 0,
            f"silent: {', '.join(silent)}" if silent else "all nodes send heartbeats",
            values,
            self._role,
        )
        self._diagnostics.publish(encode_diagnostics([record], 0))
