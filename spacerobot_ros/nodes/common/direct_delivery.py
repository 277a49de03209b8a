"""Direct delivery: messages between nodes of one process, past the loop of the executor."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

from rclpy.clock import Clock, ClockType
from rclpy.experimental import EventsExecutor
from rclpy.node import Node

from spacerobot_ros.nodes.common.node import FlightNode
from spacerobot_ros.nodes.common.streams import AnnouncedPublisher, RawCallback, RawInput, RawOutput

_CHECK_PERIOD = 0.1
"""Wall time between two checks for other publishers, s; messages under way are checks, too."""

_MESSAGES_PER_TURN = 1000
"""Messages delivered in one turn, of about 10 ms; then the executor serves timers and services."""

_MESSAGES_PER_LOOK = 50
"""Messages delivered from one look for readers outside to the next, about every millisecond."""

_LONGEST_MATCHING = 1.0
"""Longest wall time until new subscriptions have met the publishers, s."""


class _Link(NamedTuple):
    """A topic with all its publishers and its serialised subscriptions in this process."""

    topic: str
    outputs: list[RawOutput]
    inputs: list[RawInput]


class DirectDelivery:
    """Decides how messages reach the nodes of this process: directly, or by the middleware.

    States and commands of a stack in one process need no middleware: where all publishers of a
    topic are in this process, its messages are given to the callbacks of the nodes that subscribe
    it. They are published all the same, for everybody else: within a turn of deliveries, a new
    reader is noticed after some messages. The nodes' own subscriptions of these topics end
    meanwhile.

    The decision is one for all topics, and changes once: as soon as one of the topics has another
    publisher, or one of the nodes is cleaned up, all nodes subscribe again, and the middleware
    delivers everything from then on.

    Nodes are called in the same order either way. The executor calls back in the order of
    publication. So a message may pass it only while nothing that was published before is still on
    its way: publications on other topics that nodes of this process subscribe are counted. While
    some are under way, messages are put at the end of the executor's queue, as tasks.

    Parameters
    ----------
    executor
        The executor of all nodes.
    nodes
        All nodes of this process; their subscriptions are matched.
    host
        The node whose timer looks for other publishers.
    """

    def __init__(self, executor: EventsExecutor, nodes: Sequence[Node], host: Node) -> None:
        self._executor, self._nodes, self._host = executor, nodes, host
        self._links: list[_Link] = []
        self._queue: deque[tuple[RawCallback, bytes]] = deque()
        self._in_turn = False
        """Whether messages are being delivered, and the turn is not used up."""
        self._published = self._delivered = 0
        """Number of messages in the executor's queue so far, and of those known to have left it."""
        self._left = _MESSAGES_PER_TURN
        self._announcing: list[AnnouncedPublisher | RawOutput] = []
        self._outputs: list[RawOutput] = []
        """The streams of the nodes, which look for readers."""

    @property
    def topics(self) -> set[str]:
        """Names of the topics whose messages are handed over directly."""
        return {link.topic for link in self._links}

    def begin(self) -> None:
        """Hand messages over directly from now on; nothing may be published meanwhile."""
        flight_nodes = [node for node in self._nodes if isinstance(node, FlightNode)]
        outputs = [
            stream
            for node in flight_nodes
            for stream in node.raw_streams
            if isinstance(stream, RawOutput)
        ]
        inputs = [stream for node in flight_nodes for stream in node.raw_inputs]
        subscribed = [each.topic_name for node in self._nodes for each in node.subscriptions]
        for topic in dict.fromkeys(stream.topic for stream in inputs):
            link = _Link(
                topic,
                [stream for stream in outputs if stream.topic == topic],
                [stream for stream in inputs if stream.topic == topic],
            )
            alone = subscribed.count(topic) == len(link.inputs)
            if link.outputs and alone and not self._has_other_publishers(link):
                self._links.append(link)
        self._announce(outputs, set(subscribed) - self.topics)
        for link in self._links:
            for stream in link.inputs:
                stream.unsubscribe()
            deliver = partial(self._deliver, [stream.receive for stream in link.inputs])
            for output in link.outputs:
                output.call_after_publication(deliver)
        for node in flight_nodes:
            node.before_cleanup = self.end
        if self._links:
            self._outputs = outputs
            clock = Clock(clock_type=ClockType.STEADY_TIME)
            self._timer = self._host.create_timer(_CHECK_PERIOD, self.check, clock=clock)

    def check(self) -> None:
        """Leave delivery to the middleware if a topic has another publisher."""
        if any(map(self._has_other_publishers, self._links)):
            self.end()

    def end(self) -> None:
        """Leave delivery to the middleware from now on; pending messages still arrive directly."""
        links, self._links = self._links, []
        if not links:
            return
        self._host.destroy_timer(self._timer)
        for link in links:
            for stream in link.inputs:
                stream.subscribe()
        deadline = time.monotonic() + _LONGEST_MATCHING
        while not all(map(_is_matched, links)) and time.monotonic() < deadline:
            time.sleep(0.001)
        for link in links:
            for output in link.outputs:
                output.call_after_publication(None)
        for publisher in self._announcing:
            _set_announcement(publisher, None)
        self._look_with_every_message()
        self._outputs = []

    def _announce(self, outputs: Sequence[RawOutput], topics: set[str]) -> None:
        """Count the messages on topics that the executor delivers to nodes here."""
        publishers = [
            each
            for node in self._nodes
            for each in node.publishers
            if isinstance(each, AnnouncedPublisher) and each.topic_name in topics
        ]
        self._announcing = [*publishers, *(each for each in outputs if each.topic in topics)]
        for publisher in self._announcing:
            _set_announcement(publisher, self._count)

    def _count(self) -> None:
        self._published += 1

    def _deliver(self, readers: Sequence[RawCallback], raw: bytes) -> None:
        """Deliver a message that has been published: after this callback, or by the executor."""
        if self._in_turn and self._delivered == self._published:
            for take in readers:
                self._queue.append((take, raw))
        else:
            self._published += 1
            self._executor.create_task(self._deliver_one_turn, readers, raw, self._published)

    def _deliver_one_turn(self, readers: Sequence[RawCallback], raw: bytes, number: int) -> None:
        """Deliver a message, and those that answer it as long as nothing else is under way.

        The executor calls this when everything that was published before ``number`` has arrived.
        """
        self._delivered, self._in_turn = number, True
        queue = self._queue
        for take in readers:
            queue.append((take, raw))
        self._look_for_readers()
        try:
            while queue:
                self._left -= 1
                if not self._left % _MESSAGES_PER_LOOK:
                    self._look_for_readers()
                    if not self._left:
                        # Messages wait from now on until the executor calls again.
                        self._in_turn = False
                take, raw = queue.popleft()
                take(raw)
        finally:
            # Timers and services may publish a single message of a topic.
            self._look_with_every_message()
        self._in_turn = False
        if self._left <= 0:
            self._left = _MESSAGES_PER_TURN
            self.check()

    def _look_for_readers(self) -> None:
        for output in self._outputs:
            output.look_for_readers()

    def _look_with_every_message(self) -> None:
        for output in self._outputs:
            output.look_with_every_message()

    def _has_other_publishers(self, link: _Link) -> bool:
        """Whether a topic has publishers beside those of this process."""
        return bool(self._host.count_publishers(link.topic) != len(link.outputs))


def _is_matched(link: _Link) -> bool:
    """Whether every subscription of a topic has met as many publishers as there are here."""
    return all(
        stream.subscription is not None
        and stream.subscription.get_publisher_count() >= len(link.outputs)
        for stream in link.inputs
    )


def _set_announcement(
    publisher: AnnouncedPublisher | RawOutput, on_publish: Callable[[], None] | None
) -> None:
    if isinstance(publisher, RawOutput):
        publisher.announce(on_publish)
    else:
        publisher.on_publish = on_publish
