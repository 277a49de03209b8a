"""Topics that are heard where they pass through nodes of this process."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from spacerobot_ros.nodes.common.node import FlightNode
from spacerobot_ros.nodes.common.raw_stream import RawInput, RawStream, Take


class StreamTaps:
    """Listens to the streams of nodes, where these carry every message of a topic."""

    def __init__(self) -> None:
        self.nodes: Sequence[FlightNode] = ()
        """Whose streams they are."""
        self._tapped: dict[str, list[RawStream]] = {}

    def tap(self, topic: str, listener: Take, publishers: int) -> bool:
        """Listen to a topic with so many publishers; return whether nothing can escape."""
        streams = self._streams(topic, publishers)
        if streams:
            self._tapped[topic] = streams
        for stream in streams:
            stream.listen(listener)
        return bool(streams)

    def release_incomplete(self, count_publishers: Callable[[str], int]) -> list[str]:
        """Let go of topics that have changed their publishers or nodes, and return which."""
        changed = [
            topic
            for topic, streams in self._tapped.items()
            if self._streams(topic, count_publishers(topic)) != streams
        ]
        for topic in changed:
            self._release(topic)
        return changed

    def release(self) -> None:
        """Let go of everything."""
        for topic in list(self._tapped):
            self._release(topic)

    def _release(self, topic: str) -> None:
        for stream in self._tapped.pop(topic):
            stream.unlisten()

    def _streams(self, topic: str, publishers: int) -> list[RawStream]:
        """Return the streams that carry every message of a topic, empty if some may escape."""
        found = [s for node in self.nodes for s in node.raw_streams if s.topic == topic]
        for stream in found:
            if isinstance(stream, RawInput):
                return [stream]
        return found if len(found) == publishers else []
