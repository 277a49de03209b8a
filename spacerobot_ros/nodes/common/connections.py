"""Who has met whom: a stack begins when every publisher and subscription has all its partners."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass

from rclpy.node import Node

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
