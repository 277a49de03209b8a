"""Streams of serialised messages through nodes, and matched publishers and subscriptions."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.subscription import Subscription

_MIDDLEWARE_TOPICS = ("/rosout", "/parameter_events")

Matches = tuple[tuple[str, int], ...]
"""Topic of each endpoint, and the number of endpoints matched with it."""


@dataclass(frozen=True)
class MatchedEndpoints:
    """The endpoints of one node, those of the middleware left out.

    Attributes
    ----------
    publishers, subscriptions
        Topic of each endpoint, and the number of endpoints matched with it.
    """

    publishers: Matches
    subscriptions: Matches

    @classmethod
    def of(cls, node: Node) -> MatchedEndpoints:
        """Return the endpoints of a node of this process."""
        readers = [(each.topic_name, each.get_subscription_count()) for each in node.publishers]
        writers = [(each.topic_name, each.get_publisher_count()) for each in node.subscriptions]
        return cls(_without_middleware(readers), _without_middleware(writers))

    def to_json(self) -> str:
        """Return the endpoints as a JSON text."""
        return json.dumps([self.publishers, self.subscriptions])

    @classmethod
    def from_json(cls, text: str) -> MatchedEndpoints:
        """Return the endpoints of a text from :meth:`to_json`."""
        publishers, subscriptions = json.loads(text)
        return cls(_without_middleware(publishers), _without_middleware(subscriptions))


def topics_without_all_matches(nodes: Iterable[MatchedEndpoints]) -> set[str]:
    """Return the topics on which endpoints of these nodes are not all matched."""
    nodes = list(nodes)
    writers = Counter(topic for node in nodes for topic, _ in node.publishers)
    readers = Counter(topic for node in nodes for topic, _ in node.subscriptions)
    return {
        topic
        for node in nodes
        for matches, partners in ((node.publishers, readers), (node.subscriptions, writers))
        for topic, met in matches
        if met < partners[topic]
    }


def _without_middleware(matches: Iterable[Iterable[object]]) -> Matches:
    pairs = (tuple(pair) for pair in matches)
    return tuple(
        (str(topic), int(str(met))) for topic, met in pairs if topic not in _MIDDLEWARE_TOPICS
    )


RawCallback = Callable[[bytes], None]


def raw_publish(publisher: Publisher) -> RawCallback:
    """Return the function that publishes serialised messages.

    ``publisher.publish`` does the same after taking its handle and looking at the type, which
    costs as much again as the publication; the handle lives as long as the publisher.
    """
    function: RawCallback = publisher.handle.publish_raw
    return function


class AnnouncedPublisher(Publisher):
    """A publisher that announces each publication before it happens."""

    on_publish: Callable[[], None] | None = None
    """Function that is called before each publication."""

    def publish(self, msg: Any) -> None:
        """Publish a message, or the bytes of one."""
        if self.on_publish is not None:
            self.on_publish()
        super().publish(msg)


class RawStream:
    """The messages of one topic that pass through a node.

    For a component of the same process that needs every message, a subscription is expensive: the
    middleware copies each message, queues it, and wakes the executor.

    Parameters
    ----------
    topic
        Full name of the topic.
    take
        Called with each message.
    """

    def __init__(self, topic: str, take: RawCallback) -> None:
        self.topic = topic
        self.take = take
        """Called by the owner with each message; looked up every time."""
        self._act = take
        self._listener: RawCallback | None = None

    def add_listener(self, listener: RawCallback) -> None:
        """Call a listener with every message before ``take``; one listener at a time."""
        self._listener = listener
        self._compose()

    def remove_listener(self) -> None:
        """Stop calling the listener."""
        self._listener = None
        self._compose()

    def _compose(self) -> None:
        """Make ``take`` call the listener, if any, and then the function of the stream."""
        listeners = () if self._listener is None else (self._listener,)
        self.take = _one_after_another(*listeners, self._act)


def _one_after_another(*acts: RawCallback) -> RawCallback:
    """Return a function that does up to three things with a message, without further calls."""
    if not acts:
        return _drop
    if len(acts) == 1:
        return acts[0]
    first, second, *others = acts

    def call_two(raw: bytes) -> None:
        first(raw)
        second(raw)

    if not others:
        return call_two
    (third,) = others

    def call_three(raw: bytes) -> None:
        first(raw)
        second(raw)
        third(raw)

    return call_three


def _drop(_: bytes) -> None:
    """Do nothing with a message."""


class RawOutput(RawStream):
    """Messages of one publisher: ``take`` publishes a message.

    A message that nobody can receive is not given to the middleware: nobody is subscribed, and the
    topic keeps no last message for late subscribers. A new listener is shown the last message of a
    latched topic first, as a subscription is.

    Every message looks for readers, unless its owner looks for many of them
    (:meth:`look_for_readers`).

    Parameters
    ----------
    publisher
        The publisher of the messages.
    latched
        Whether its topic keeps the last message for late subscribers.
    """

    def __init__(self, publisher: Publisher, *, latched: bool = False) -> None:
        self._last: bytes | None = None
        self._latched = latched
        publish, count_readers = raw_publish(publisher), publisher.handle.get_subscription_count

        def keep_and_publish(raw: bytes) -> None:
            self._last = raw
            publish(raw)

        def publish_to_readers(raw: bytes) -> None:
            # To count takes a third of the time of a publication.
            if count_readers():
                publish(raw)

        self._publish = keep_and_publish if latched else publish_to_readers
        self._publish_unseen, self._count_readers = publish, count_readers
        self._before: tuple[RawCallback, ...] = ()
        self._after: tuple[RawCallback, ...] = ()
        super().__init__(publisher.topic_name, self._publish)
        self._compose()
        self.readers: Callable[[], int] = publisher.get_subscription_count
        """Function that returns the number of matched subscriptions."""
        self.await_readers: Callable[[Duration], bool] = publisher.wait_for_all_acked
        """Function that waits for all readers' confirmations; returns whether all came."""

    def add_listener(self, listener: RawCallback) -> None:
        """Call a listener with every message, with the last one of a latched topic at once."""
        super().add_listener(listener)
        if self._last is not None:
            listener(self._last)

    def announce(self, on_publish: Callable[[], None] | None) -> None:
        """Call a function before each publication; None: no longer."""
        self._before = () if on_publish is None else (lambda _: on_publish(),)
        self._compose()

    def call_after_publication(self, deliver: RawCallback | None) -> None:
        """Call a function with each message after its publication; None: no longer."""
        self._after = () if deliver is None else (deliver,)
        self._compose()

    def look_for_readers(self) -> None:
        """Look for readers once for all messages until the next look; a latched topic needs none.

        A new listener or act ends that, as :meth:`look_with_every_message` does.
        """
        if not self._latched:
            self.take = self._takes[self._count_readers() > 0]

    def look_with_every_message(self) -> None:
        """Look for readers with every message from now on."""
        self.take = self._looking_take

    def _compose(self) -> None:
        listeners = () if self._listener is None else (self._listener,)
        unread = _one_after_another(*listeners, *self._after)
        self._looking_take, read = (
            _one_after_another(*listeners, *self._before, publish, *self._after)
            for publish in (self._publish, self._publish_unseen)
        )
        self._takes = unread, read
        """Functions that take a message without readers, and one with some."""
        self.take = self._looking_take


class RawInput(RawStream):
    """Messages received on a topic, from any publisher: ``take`` is the node's callback.

    Parameters
    ----------
    topic, take
        As of every stream.
    create, destroy
        Create a subscription with a callback and a quality of service, and destroy one.
    qos
        Quality of service of the subscription.
    on_error
        Called with an exception of a callback: none leaves the executor.
    """

    def __init__(
        self,
        topic: str,
        take: RawCallback,
        *,
        create: Callable[[Callable[..., None], QoSProfile], Subscription],
        destroy: Callable[[Subscription], object],
        qos: QoSProfile,
        on_error: Callable[[Exception], None],
    ) -> None:
        super().__init__(topic, take)
        self._create, self._destroy, self._qos = create, destroy, qos

        def receive(raw: bytes) -> None:
            try:
                # ``take`` is looked up for every message, because listeners come and go.
                self.take(raw)
            except Exception as error:
                on_error(error)

        self.receive: RawCallback = receive
        """Callback of the subscription."""
        self.subscription: Subscription | None = None
        """The subscription; None while messages are handed over without it."""
        self.subscribe()

    def subscribe(self, qos: QoSProfile | None = None) -> None:
        """Subscribe, in place of a present subscription, with the same or another QoS."""
        self.unsubscribe()
        self._qos = qos or self._qos
        self.subscription = self._create(self.receive, self._qos)

    def unsubscribe(self) -> None:
        """End the subscription."""
        if self.subscription is not None:
            self._destroy(self.subscription)
            self.subscription = None

    @property
    def has_publisher(self) -> bool:
        """Whether a publisher is connected; without a subscription one of this process is."""
        return self.subscription is None or self.subscription.get_publisher_count() > 0

    def waiting(self) -> list[bytes]:
        """Take and return the messages that wait in the subscription."""
        found: list[bytes] = []
        if self.subscription is not None:
            handle, kind = self.subscription.handle, self.subscription.msg_type
            with handle:
                while (taken := handle.take_message(kind, True)) is not None:
                    found.append(taken[0])
        return found


class StreamingNode(Protocol):
    """A node whose serialised streams other components may listen to."""

    raw_streams: list[RawStream]

    def get_fully_qualified_name(self) -> str:
        """Return the name of the node with its namespace."""


class StreamListeners:
    """Listens to streams of nodes in this process that carry every message of a topic."""

    def __init__(self) -> None:
        self.nodes: Sequence[StreamingNode] = ()
        self._tapped: dict[str, list[RawStream]] = {}

    def tap(self, topic: str, listener: RawCallback, publishers: int) -> bool:
        """Listen to a topic's streams; return whether they carry all publishers' messages."""
        streams = self._streams(topic, publishers)
        if streams:
            self._tapped[topic] = streams
        for stream in streams:
            stream.add_listener(listener)
        return bool(streams)

    def release_incomplete(self, count_publishers: Callable[[str], int]) -> list[str]:
        """Release and return the topics whose publishers or nodes have changed."""
        changed = [
            topic
            for topic, streams in self._tapped.items()
            if self._streams(topic, count_publishers(topic)) != streams
        ]
        for topic in changed:
            self._release(topic)
        return changed

    def release(self) -> None:
        """Stop listening to all streams."""
        for topic in list(self._tapped):
            self._release(topic)

    def _release(self, topic: str) -> None:
        for stream in self._tapped.pop(topic):
            stream.remove_listener()

    def _streams(self, topic: str, publishers: int) -> list[RawStream]:
        """Return the streams that carry every message of a topic, empty if some may escape."""
        found = [s for node in self.nodes for s in node.raw_streams if s.topic == topic]
        for stream in found:
            if isinstance(stream, RawInput):
                return [stream]
        return found if len(found) == publishers else []
