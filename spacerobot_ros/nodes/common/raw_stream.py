"""Serialised messages on their way through a node, for those who listen in its process."""

from __future__ import annotations

from collections.abc import Callable

from rclpy.publisher import Publisher

from spacerobot_ros.nodes.common.cdr import raw_publish

Take = Callable[[bytes], None]


class RawStream:
    """The messages of one topic that pass through a node.

    A subscription of its own is dear for somebody who is in the same process and wants every
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
        """Show messages to nobody any more."""
        self.take = self._take


class RawOutput(RawStream):
    """What one publisher publishes: ``take`` sends a message on its way."""

    def __init__(self, publisher: Publisher) -> None:
        super().__init__(publisher.topic_name, raw_publish(publisher))
        self.readers: Callable[[], int] = publisher.get_subscription_count
        """Returns how many subscriptions it is matched with."""


class RawInput(RawStream):
    """What a node takes of a topic, whoever publishes it: ``take`` is the node's callback."""
