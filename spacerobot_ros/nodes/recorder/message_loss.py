"""Messages that the middleware reports as lost on their way to a node."""

from __future__ import annotations

from collections import Counter
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.publisher import Publisher

from spacerobot_ros.nodes.common.cdr import NANOSECONDS
from spacerobot_ros.nodes.common.diagnostics import diagnostic_status
from spacerobot_ros.nodes.common.node import STREAM

_LOG_PERIOD = 5.0
"""Wall s between two log lines."""


class MessageLoss:
    """Counts by topic what was published for a node and never came.

    Events of the middleware are counted: messages themselves cost nothing more. They tell of
    messages that their publisher no longer kept when they should have been sent again; the
    overflow of a subscription's own queue they do not tell of (Fast DDS).
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._publisher: Publisher | None = None
        self.counts: Counter[str] = Counter()

    @property
    def total(self) -> int:
        """How many messages were lost so far."""
        return self.counts.total()

    def events(self, topic: str) -> SubscriptionEventCallbacks:
        """Return what a subscription of a topic is to be created with."""

        def on_loss(info: Any) -> None:
            self.counts[topic] += info.total_count_change

        return SubscriptionEventCallbacks(message_lost=on_loss)

    def report(self, time_ns: int) -> None:
        """Log and publish as diagnostics what was lost; nothing as long as nothing was."""
        if not self.counts:
            return
        sentence = f"{self.total} messages were lost on their way to the recorder."
        self._node.get_logger().warning(sentence, throttle_duration_sec=_LOG_PERIOD)
        counts = dict(sorted(self.counts.items()))
        name = f"{self._node.get_fully_qualified_name()}: lost messages"
        self.publish(time_ns, diagnostic_status(name, DiagnosticStatus.WARN, sentence, counts))

    def publish(self, time_ns: int, status: DiagnosticStatus) -> None:
        """Publish diagnostics of the recorder.

        A publisher that is there without need would be one more thing to wait for and to record.
        """
        if self._publisher is None:
            self._publisher = self._node.create_publisher(DiagnosticArray, "/diagnostics", STREAM)
        array = DiagnosticArray(status=[status])
        array.header.stamp.sec, array.header.stamp.nanosec = divmod(time_ns, NANOSECONDS)
        self._publisher.publish(array)
