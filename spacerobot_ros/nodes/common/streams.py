"""Endpoints of nodes: serialised messages on their way, and which endpoints have met."""

from __future__ import annotations

import inspect
import json
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher

_MIDDLEWARE = ("/rosout", "/parameter_events")

Matches = tuple[tuple[str, int], ...]
"""For each endpoint its topic, and how many partners it has met."""


@dataclass(frozen=True)
class Connections:
    """The endpoints of one node, those of the middleware left out.

    Attributes
    ----------
    publishers, subscriptions
        With the number of their partners.
    """

    publishers: Matches
    subscriptions: Matches

    @classmethod
    def of(cls, node: Node) -> Connections:
        """Return those of a node of this process."""
        readers = [(each.topic_name, each.get_subscription_count()) for each in node.publishers]
        writers = [(each.topic_name, each.get_publisher_count()) for each in node.subscriptions]
        return cls(_own(readers), _own(writers))

    def to_json(self) -> str:
        """Return them as a text."""
        return json.dumps([self.publishers, self.subscriptions])

    @classmethod
    def from_json(cls, text: str) -> Connections:
        """Return what :meth:`to_json` has made a text of."""
        publishers, subscriptions = json.loads(text)
        return cls(_own(publishers), _own(subscriptions))


def unconnected(nodes: Iterable[Connections]) -> set[str]:
    """Return the topics on which an endpoint of these nodes has not met all of the others'."""
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


def _own(matches: Iterable[Iterable[object]]) -> Matches:
    pairs = (tuple(pair) for pair in matches)
    return tuple((str(topic), int(str(met))) for topic, met in pairs if topic not in _MIDDLEWARE)


Take = Callable[[bytes], None]

_TWO_PARAMETERS = inspect.signature(lambda message, information: None)


def raw_publish(publisher: Publisher) -> Take:
    """Return the function that publishes serialised messages.

    ``publisher.publish`` does the same after taking its handle and looking at the type, which
    costs as much again as the publication; the handle lives as long as the publisher.
    """
    function: Take = publisher.handle.publish_raw
    return function


class RawStream:
    """The messages of one topic that pass through a node.

    A subscription of its own is dear for a component of the same process that wants every
    message: the middleware copies each one, queues it, and wakes the executor for it.

    Parameters
    ----------
    topic
        Its full name.
    take
        What is done with each message.
    """

    def __init__(self, topic: str, take: Take) -> None:
        self.topic = topic
        self.take = self._take = take
        """``take`` is what the owner calls with each message; look it up every time."""

    def listen(self, listener: Take) -> None:
        """Have every message shown to a listener, before it is taken; one listener at a time."""
        act = self._take

        def take(raw: bytes) -> None:
            listener(raw)
            act(raw)

        self.take = take

    def unlisten(self) -> None:
        """Call the listener no more."""
        self.take = self._take


class RawOutput(RawStream):
    """What one publisher publishes: ``take`` sends a message on its way.

    A new listener is shown the last message of a latched topic first, as a subscription is.

    Parameters
    ----------
    publisher
        Where messages go.
    latched
        Whether its topic is.
    """

    def __init__(self, publisher: Publisher, *, latched: bool = False) -> None:
        self._last: bytes | None = None
        publish = raw_publish(publisher)

        def keep_and_publish(raw: bytes) -> None:
            self._last = raw
            publish(raw)

        super().__init__(publisher.topic_name, keep_and_publish if latched else publish)
        self.readers: Callable[[], int] = publisher.get_subscription_count
        """Returns how many subscriptions it is matched with."""
        self.await_readers: Callable[[Duration], bool] = publisher.wait_for_all_acked
        """Waits until they have received everything; returns whether they have, in time."""

    def listen(self, listener: Take) -> None:
        """Have every message shown to a listener, the last one of a latched topic at once."""
        super().listen(listener)
        if self._last is not None:
            listener(self._last)


class RawInput(RawStream):
    """What a node receives on a topic, from any publisher: ``take`` is the node's callback."""

    def callback(
        self, number: Callable[[int], None] | None, on_error: Callable[[Exception], None]
    ) -> Callable[..., None]:
        """Return what a subscription calls with each message.

        Parameters
        ----------
        number
            Called before with the number that its publisher has given to the message, if wanted.
        on_error
            Called with an exception of a callback: none leaves the executor.
        """

        def take(raw: bytes) -> None:
            try:
                self.take(raw)  # Looked up for every message: a listener may come and go.
            except Exception as error:
                on_error(error)

        if number is None:
            return take

        def take_numbered(*given: Any) -> None:
            # rclpy's events executor hands over message and information as one tuple (7.1).
            raw, information = given[0] if len(given) == 1 else given
            number(information.get("publication_sequence_number") or 0)  # 0: it has none.
            take(raw)

        # By the number of parameters rclpy finds out that the information is wanted.
        take_numbered.__signature__ = _TWO_PARAMETERS  # type: ignore[attr-defined]
        return take_numbered
