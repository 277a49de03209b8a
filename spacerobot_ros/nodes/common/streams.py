"""Matching of the publishers and subscriptions of nodes."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass

from rclpy.node import Node

_MIDDLEWARE_TOPICS = ("/rosout", "/parameter_events")

Matches = tuple[tuple[str, int], ...]
"""Topic of each endpoint, and the number of endpoints matched with it."""


@dataclass(frozen=True)
class MatchedEndpoints:
    """The endpoints of one node, except those of the middleware.

    Attributes
    ----------
    publishers, subscriptions
        Topic of each endpoint, and the number of endpoints matched with it.
    """

    publishers: Matches
    subscriptions: Matches

    @classmethod
    def of(cls, node: Node) -> MatchedEndpoints:
        """Return the endpoints of a node in this process."""
        readers = [(each.topic_name, each.get_subscription_count()) for each in node.publishers]
        writers = [(each.topic_name, each.get_publisher_count()) for each in node.subscriptions]
        return cls(_without_middleware(readers), _without_middleware(writers))

    def to_json(self) -> str:
        """Return the endpoints as a JSON string."""
        return json.dumps([self.publishers, self.subscriptions])

    @classmethod
    def from_json(cls, text: str) -> MatchedEndpoints:
        """Return the endpoints from a string returned by :meth:`to_json`."""
        publishers, subscriptions = json.loads(text)
        return cls(_without_middleware(publishers), _without_middleware(subscriptions))


def topics_without_all_matches(nodes: Iterable[MatchedEndpoints]) -> set[str]:
    """Return the topics on which some endpoints of these nodes have not been matched yet."""
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
