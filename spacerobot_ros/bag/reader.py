"""Reads a bag as time series."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Metadata
from numpy.typing import NDArray

from spacerobot_ros.bag.definitions import MessageTypes
from spacerobot_ros.bag.mcap_reading import (
    RawMessage,
    indexed_bodies,
    messages_in_file_order,
    messages_in_time_order,
    read_summary,
)
from spacerobot_ros.bag.mcap_records import file_size, open_bag, parsed
from spacerobot_ros.bag.rosbag2 import QosProfile
from spacerobot_ros.bag.series import TopicSeries
from spacerobot_ros.errors import RecordingError

_DECODABLE, _DECODABLE_TIMES = 16_000_000, 50
"""Bytes of a topic that may become objects, which take ten times as much: so many, or so many times
the size of the file."""


def read_bag(path: str | os.PathLike[str]) -> Bag:
    """Open a bag for reading; nothing but its summary is read until asked for.

    ``path`` is an MCAP file, or a folder that holds one, as ``ros2 bag record`` makes it.

    Raises
    ------
    RecordingError
        There is no such bag, it is not MCAP, was cut short or is damaged.
    """
    return Bag(_bag_file(path))


def iterate_raw(path: str | os.PathLike[str]) -> Iterator[tuple[str, str, int, int, bytes]]:
    """Go through all messages of a bag, still serialised, in the order they were written.

    Yields
    ------
    Topic, type, log time and publish time in nanoseconds, serialised message.

    Raises
    ------
    RecordingError
        As of :func:`read_bag`, when the first message or a damaged one is asked for.
    """
    file_path = _bag_file(path)
    with open_bag(file_path) as file:
        summary = read_summary(file_path, file)
        names = {
            channel.id: (channel.topic, _type_name(summary.schemas, channel))
            for channel in summary.channels.values()
        }
        for channel_id, log_time_ns, publish_time_ns, data in messages_in_file_order(file):
            if channel_id not in names:
                raise ValueError(f"its summary lacks channel {channel_id}")
            topic, type_name = names[channel_id]
            yield topic, type_name, log_time_ns, publish_time_ns, data


class Bag:
    """A bag as time series: ``bag["/odom"].field("pose.pose.position.x")``.

    A topic is read when it is first asked for and kept. The file is not held open. Raises as
    :func:`read_bag` does.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        with open_bag(path) as file:
            self._summary = read_summary(path, file)
            self._decodable = max(_DECODABLE, _DECODABLE_TIMES * file_size(file))
        self._types = MessageTypes()
        self._series: dict[str, TopicSeries] = {}

    @cached_property
    def _channels_by_topic(self) -> dict[str, list[Channel]]:
        found: dict[str, list[Channel]] = {}
        for channel in self._summary.channels.values():
            found.setdefault(channel.topic, []).append(channel)
        return found

    @cached_property
    def topics(self) -> dict[str, str]:
        """Name and type of every topic, with messages or without."""
        channels = self._summary.channels.values()
        return {c.topic: _type_name(self._summary.schemas, c) for c in channels}

    @cached_property
    def metadata(self) -> dict[str, dict[str, str]]:
        """Keys and values of every metadata record by its name; the last of several of one name."""
        with open_bag(self.path) as file:
            found = indexed_bodies(file, self._summary.metadata_indexes, Opcode.METADATA)
            read = (parsed(Metadata.read, body, place) for place, body in found)
            return {metadata.name: metadata.metadata for metadata in read}

    @cached_property
    def attachments(self) -> dict[str, bytes]:
        """Content of every attachment by its name; the last of several of one name."""
        with open_bag(self.path) as file:
            found = indexed_bodies(file, self._summary.attachment_indexes, Opcode.ATTACHMENT)
            read = (parsed(Attachment.read, body, place) for place, body in found)
            return {attachment.name: attachment.data for attachment in read}

    @property
    def start_time(self) -> float:
        """Log time of the earliest message in seconds; nan without messages."""
        return self._statistics.message_start_time / 1e9 if self.message_count() else float("nan")

    @property
    def end_time(self) -> float:
        """Log time of the latest message in seconds; nan without messages."""
        return self._statistics.message_end_time / 1e9 if self.message_count() else float("nan")

    @property
    def start_time_ns(self) -> int:
        """Log time of the earliest message in nanoseconds; 0 without messages."""
        return int(self._statistics.message_start_time)

    @property
    def end_time_ns(self) -> int:
        """Log time of the latest message in nanoseconds; 0 without messages."""
        return int(self._statistics.message_end_time)

    def message_count(self, topic: str | None = None) -> int:
        """Say how many messages a topic has, or the whole bag.

        Raises
        ------
        RecordingError
            There is no such topic.
        """
        if topic is None:
            return int(self._statistics.message_count)
        counts = self._statistics.channel_message_counts
        return sum(counts.get(channel.id, 0) for channel in self._channels(topic))

    def channel_ids(self, topic: str) -> set[int]:
        """Return the numbers under which a topic's messages are in the file.

        Raises
        ------
        RecordingError
            There is no such topic.
        """
        return {channel.id for channel in self._channels(topic)}

    def raw_messages(
        self, channel_ids: set[int], start_ns: int = 0, end_ns: int = 2**63 - 1
    ) -> Iterator[RawMessage]:
        """Go through the messages of some channels, still serialised, by log time.

        Yields
        ------
        Channel, log time and publish time in nanoseconds, serialised message.

        Raises
        ------
        RecordingError
            The bag is damaged.
        """
        return messages_in_time_order(self.path, channel_ids, start_ns, end_ns, self._summary)

    def qos(self, topic: str) -> list[QosProfile]:
        """Return what the publishers of a topic offered, as far as the bag says it.

        Raises
        ------
        RecordingError
            There is no such topic, or what the bag says cannot be read.
        """
        texts = [c.metadata.get("offered_qos_profiles", "") for c in self._channels(topic)]
        return [profile for text in texts for profile in QosProfile.from_yaml(text)]

    def times(self, topic: str) -> NDArray[np.float64]:
        """Return the log times of a topic in seconds, shape (N,).

        Raises
        ------
        RecordingError
            There is no such topic, or the bag is damaged.
        """
        return self[topic].time

    def messages(self, topic: str) -> Iterator[tuple[int, Any]]:
        """Go through the decoded messages of a topic by log time.

        Yields
        ------
        Log time in nanoseconds, message.

        Raises
        ------
        RecordingError
            There is no such topic, or the bag is damaged.
        """
        return self[topic].messages()

    def __getitem__(self, topic: str) -> TopicSeries:
        if topic not in self._series:
            channels = self._channels(topic)
            decode = self._decoder(channels[0])
            times, data = self._read(self.channel_ids(topic))
            self._series[topic] = TopicSeries(
                topic, self.topics[topic], times, data, self._types.fields, decode, self._decodable
            )
        return self._series[topic]

    @property
    def _statistics(self) -> Any:
        return self._summary.statistics

    def _channels(self, topic: str) -> list[Channel]:
        channels = self._channels_by_topic.get(topic, [])
        if not channels:
            raise RecordingError(
                f"The bag {self.path} has no topic {topic}: it has {_listed(list(self.topics))}."
            )
        if len({channel.schema_id for channel in channels}) > 1:
            raise RecordingError(f"The topic {topic} of the bag {self.path} has several types.")
        return channels

    def _decoder(self, channel: Channel) -> Callable[[bytes], Any]:
        type_name = self.topics[channel.topic]
        schema = self._summary.schemas.get(channel.schema_id)
        if schema is None or (channel.message_encoding, schema.encoding) != ("cdr", "ros2msg"):
            raise RecordingError(
                f"The topic {channel.topic} of the bag {self.path} is not in ROS 2's encoding "
                "('cdr' defined by 'ros2msg')."
            )
        try:
            return self._types.decoder(type_name, schema.data)
        except ValueError as error:
            raise RecordingError(
                f"The definition of {type_name} in the bag {self.path} cannot be read: {error}."
            ) from error

    def _read(self, channel_ids: set[int]) -> tuple[NDArray[np.int64], list[bytes]]:
        """Read some channels: log times in nanoseconds in order, serialised messages."""
        times: list[int] = []
        data: list[bytes] = []
        for _, log_time_ns, _, message in self.raw_messages(channel_ids):
            times.append(log_time_ns)
            data.append(message)
        return np.array(times, np.int64), data


def _type_name(schemas: dict[int, Any], channel: Channel) -> str:
    schema = schemas.get(channel.schema_id)
    return "" if schema is None else schema.name


def _listed(names: list[str], most: int = 40) -> str:
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more


def _bag_file(path: str | os.PathLike[str]) -> Path:
    given = Path(path)
    if not given.is_dir():
        return given
    files = sorted(given.glob("*.mcap"))
    if len(files) != 1:
        raise RecordingError(f"The folder {given} holds {len(files)} MCAP files: name one of them.")
    return files[0]
