"""The record `rosbag2` in a bag: what `ros2 bag info` and `ros2 bag play` read first."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from textwrap import indent

from spacerobot_ros.bag.qos import INFINITE_NS, QosProfile

NAME = "rosbag2"
"""Name of the MCAP Metadata record."""

KEY = "serialized_metadata"
"""Its only key."""

# The first one whose QoS policies are words; a reader that finds no version takes them for numbers.
_VERSION = 9

# What every YAML reader takes for a string without quotes: such words, but for these.
_PLAIN = re.compile(r"[A-Za-z/][\w./-]*", re.ASCII)
_NOT_STRINGS = {"false", "n", "no", "null", "off", "on", "true", "y", "yes"}


@dataclass(frozen=True)
class RecordedTopic:
    """One topic of a bag: name, type, hash of the type, QoS offered and messages recorded."""

    name: str
    type_name: str
    type_hash: str
    qos: QosProfile
    message_count: int


def serialize(
    file_name: str, topics: Sequence[RecordedTopic], start_ns: int | None, end_ns: int | None
) -> str:
    """Give the YAML of rosbag2's metadata, laid out as rosbag2 dumps it.

    Args:
        file_name: name of the bag file, without folders.
        topics: the topics in the bag.
        start_ns: log time of the earliest message in nanoseconds; None without messages.
        end_ns: log time of the latest one.

    Returns:
        The value of `serialized_metadata`, without a final newline.
    """
    start, duration = INFINITE_NS, 0
    if start_ns is not None and end_ns is not None:
        start, duration = start_ns, end_ns - start_ns
    count = sum(topic.message_count for topic in topics)
    path = _scalar(file_name)
    listed = "\n" + "\n".join(map(_topic, topics)) if topics else "\n  []"
    return (
        f"version: {_VERSION}\n"
        "storage_identifier: mcap\n"
        f"duration:\n  nanoseconds: {duration}\n"
        f"starting_time:\n  nanoseconds_since_epoch: {start}\n"
        f"message_count: {count}\n"
        f"topics_with_message_count:{listed}\n"
        'compression_format: ""\n'
        'compression_mode: ""\n'
        f"relative_file_paths:\n  - {path}\n"
        "files:\n"
        f"  - path: {path}\n"
        f"    starting_time:\n      nanoseconds_since_epoch: {start}\n"
        f"    duration:\n      nanoseconds: {duration}\n"
        f"    message_count: {count}\n"
        "custom_data: ~\n"
        f"ros_distro: {_scalar(os.environ.get('ROS_DISTRO', 'jazzy'))}"
    )


def _topic(topic: RecordedTopic) -> str:
    return (
        "  - topic_metadata:\n"
        f"      name: {_scalar(topic.name)}\n"
        f"      type: {_scalar(topic.type_name)}\n"
        "      serialization_format: cdr\n"
        f"      offered_qos_profiles:\n{indent(topic.qos.to_yaml(), ' ' * 8)}\n"
        f"      type_description_hash: {_scalar(topic.type_hash)}\n"
        f"    message_count: {topic.message_count}"
    )


def _scalar(text: str) -> str:
    # Every JSON string is a YAML string.
    plain = _PLAIN.fullmatch(text) and text.lower() not in _NOT_STRINGS
    return text if plain else json.dumps(text)
