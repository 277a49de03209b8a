"""Nodes under test in one executor, what they publish, and waiting without sleeping."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.client import Client
from rclpy.experimental import EventsExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from spacerobot_ros.nodes import RecorderNode

TIMEOUT = 30.0
"""Wall s after which a wait has failed: far beyond what anything takes on a busy machine."""

_SLICE = 0.05
"""Longest wall s between two looks at a condition that no callback changes."""

LATCHED = QoSProfile(
    depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)

# Deeper than what is kept for latecomers, or of two messages in a row only one is heard.
DEEP_LATCHED = QoSProfile(
    depth=100, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)

# Beyond 5000 a backlog wedges a subscription of the events executor.
DEEP = QoSProfile(depth=5000, reliability=ReliabilityPolicy.RELIABLE)

_MIDDLEWARE = ("/rosout", "/parameter_events")

N = TypeVar("N", bound=Node)


class Probe(Node):
    """Keeps the messages of topics, decoded, in the order they came; publishes and calls.

    Parameters
    ----------
    topics
        Message type by topic name as it is subscribed.
    latched
        Which of them are latched.
    """

    def __init__(
        self,
        topics: Mapping[str, Any],
        *,
        context: rclpy.Context,
        latched: tuple[str, ...] = (),
        name: str = "probe",
        **options: Any,
    ) -> None:
        super().__init__(name, context=context, **options)
        self.messages: dict[str, list[Any]] = {}
        """What came, by topic."""
        self.arrivals: dict[str, list[float]] = {}
        """When it came, wall s of a steady clock."""
        self.order: list[str] = []
        """The topic of every message of any topic, in the order they came."""
        self.react: dict[str, Callable[[Any], None]] = {}
        """What is done with a message of a topic when it comes."""
        for topic, kind in topics.items():
            self.watch(topic, kind, latched=topic in latched)

    def watch(self, topic: str, kind: Any, *, latched: bool = False) -> None:
        """Keep the messages of one more topic."""
        kept: list[Any] = []
        times: list[float] = []
        self.messages[topic], self.arrivals[topic] = kept, times

        def on_message(message: Any) -> None:
            times.append(time.monotonic())
            kept.append(message)
            self.order.append(topic)
            if topic in self.react:
                self.react[topic](message)

        self.create_subscription(kind, topic, on_message, DEEP_LATCHED if latched else DEEP)

    def last(self, topic: str) -> Any:
        """Return the latest message of a topic."""
        assert self.messages[topic], f"nothing has come on {topic}"
        return self.messages[topic][-1]

    def count(self, topic: str) -> int:
        """Return how many messages of a topic have come."""
        return len(self.messages[topic])

    def diagnoses(self, name: str) -> list[DiagnosticStatus]:
        """Return what has come on /diagnostics under a name."""
        arrays = self.messages["/diagnostics"]
        return [status for array in arrays for status in array.status if status.name == name]


class Harness:
    """Nodes in one events executor and one context."""

    def __init__(self, context: rclpy.Context) -> None:
        self.context = context
        self.executor = EventsExecutor(context=context)
        self._nodes: list[Node] = []

    def add(self, node: N) -> N:
        """Take a node into the executor; it is destroyed with the harness."""
        self._nodes.append(node)
        self.executor.add_node(node)
        return node

    def remove(self, node: Node) -> None:
        """Destroy a node before the harness is."""
        self._nodes.remove(node)
        self.executor.remove_node(node)
        node.destroy_node()

    def make(self, kind: Callable[..., N], parameters: Mapping[str, Any], **options: Any) -> N:
        """Construct a node of a class with parameters, and take it in."""
        return self.add(kind(**construction(self.context, parameters), **options))

    def probe(self, topics: Mapping[str, Any], **options: Any) -> Probe:
        """Add a probe; see :class:`Probe`."""
        return self.add(Probe(topics, context=self.context, **options))

    def spin_until(
        self, predicate: Callable[[], Any], what: str = "the condition", timeout: float = TIMEOUT
    ) -> None:
        """Run callbacks until ``predicate`` is true; looked at after each of them.

        Raises
        ------
        AssertionError
            It was not true within ``timeout`` wall s.
        """
        deadline = time.monotonic() + timeout
        while not predicate():
            left = deadline - time.monotonic()
            assert left > 0, f"{what}: not within {timeout:g} s"
            began = time.monotonic()
            self.executor.spin_once(timeout_sec=min(left, _SLICE))
            # What a callback computes is no waiting: a busy machine takes long to compile a robot.
            deadline += max(0.0, time.monotonic() - began - _SLICE)

    def spin_for(self, seconds: float) -> None:
        """Run callbacks for a wall time, to see that something does not happen."""
        end = time.monotonic() + seconds
        self.spin_until(lambda: time.monotonic() >= end, timeout=seconds + TIMEOUT)

    def settle(self, *probes: Probe) -> None:
        """Run callbacks until the probes have heard nothing for as long as twenty idle spins."""
        quiet, before = 0, -1
        while quiet < 20:
            self.executor.spin_once(timeout_sec=0.002)
            heard = sum(len(probe.order) for probe in probes)
            quiet = quiet + 1 if heard == before else 0
            before = heard

    def connect(self) -> None:
        """Wait until every publisher here has met every subscription here."""
        self.spin_until(lambda: not self._unmatched(), "publishers and subscriptions meet")

    def _unmatched(self) -> list[str]:
        wanted: dict[str, int] = {}
        for node in self._nodes:
            for subscription in node.subscriptions:
                wanted[subscription.topic_name] = wanted.get(subscription.topic_name, 0) + 1
        return [
            publisher.topic_name
            for node in self._nodes
            for publisher in node.publishers
            if publisher.topic_name not in _MIDDLEWARE
            and publisher.get_subscription_count() < wanted.get(publisher.topic_name, 0)
        ]

    def matched(self, publisher: Publisher, readers: int = 1) -> Publisher:
        """Wait until a publisher has this many readers, in whatever process, and return it."""
        self.spin_until(
            lambda: publisher.get_subscription_count() >= readers,
            f"{readers} reader(s) of {publisher.topic_name}",
        )
        return publisher

    def call(self, client: Client, request: Any) -> Any:
        """Call a service as soon as it is there, and return its response."""
        self.spin_until(client.service_is_ready, f"the service {client.srv_name}")
        future = client.call_async(request)
        self.spin_until(future.done, f"an answer of the service {client.srv_name}")
        return future.result()

    def close(self) -> None:
        """Destroy the nodes and the executor; bags are completed."""
        for node in self._nodes:
            if isinstance(node, RecorderNode):
                node.cleanup()
            self.executor.remove_node(node)
            node.destroy_node()
        self._nodes.clear()
        self.executor.shutdown()


def construction(context: rclpy.Context, parameters: Mapping[str, Any]) -> dict[str, Any]:
    """Return the arguments of a node's constructor that give it a context and parameters."""
    return {
        "context": context,
        "parameter_overrides": [Parameter(key, value=value) for key, value in parameters.items()],
    }


def dumped(node: Node) -> dict[str, Any]:
    """Return what ``ros2 param dump`` writes of a node: its parameters, in groups by the dots."""
    section: dict[str, Any] = {}
    for name, parameter in node.get_parameters_by_prefix("").items():
        *groups, last = name.split(".")
        inner = section
        for group in groups:
            inner = inner.setdefault(group, {})
        value = parameter.value
        plain = None | bool | int | float | str
        inner[last] = value if isinstance(value, plain) else list(value)
    return {node.get_fully_qualified_name(): {"ros__parameters": section}}


def nanoseconds(stamp: Any) -> int:
    """Return a builtin_interfaces/Time (or Duration) in ns."""
    return int(stamp.sec * 1_000_000_000 + stamp.nanosec)
