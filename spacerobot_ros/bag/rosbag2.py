"""Additions of rosbag2 to MCAP: the quality of service of topics, and a metadata record."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, fields
from textwrap import indent
from typing import Any

import yaml
from mcap.records import Metadata

from spacerobot_ros.errors import RecordingError
from spacerobot_ros.times import SECOND

# -- quality of service -----------------------------------------------------------------------

INFINITE_NS = 2**63 - 1
"""A duration without end, in nanoseconds (``RMW_DURATION_INFINITE``)."""

_POLICIES = {
    "history": ("keep_last", "keep_all", "system_default", "unknown"),
    "reliability": ("reliable", "best_effort", "system_default", "best_available", "unknown"),
    "durability": ("volatile", "transient_local", "system_default", "best_available", "unknown"),
    "liveliness": ("automatic", "manual_by_topic", "system_default", "best_available", "unknown"),
}

# Before Jazzy rosbag2 wrote the numbers of rmw's enumerations.
_POLICY_NUMBERS = {
    "history": {0: "system_default", 1: "keep_last", 2: "keep_all"},
    "reliability": {0: "system_default", 1: "reliable", 2: "best_effort"},
    "durability": {0: "system_default", 1: "transient_local", 2: "volatile"},
    "liveliness": {0: "system_default", 1: "automatic", 3: "manual_by_topic"},
}
_DURATIONS = ("deadline", "lifespan", "liveliness_lease_duration")


@dataclass(frozen=True)
class QosProfile:
    """The quality of service that a topic's publisher offers.

    The policies are the lower-case words of rmw (``rmw_qos_*_policy_to_str``), the only ones that
    ``ros2 bag play`` knows.

    Parameters
    ----------
    history
        ``keep_last``, ``keep_all``, ``system_default`` or ``unknown``.
    depth
        How many messages ``keep_last`` keeps.
    reliability
        ``reliable``, ``best_effort``, ``system_default``, ``best_available`` or ``unknown``.
    durability
        ``volatile``, ``transient_local`` (latched), or as above.
    deadline_ns
        Longest time between two messages, in nanoseconds.
    lifespan_ns
        How long a message is worth delivering, in nanoseconds.
    liveliness
        ``automatic``, ``manual_by_topic``, or as above.
    liveliness_lease_duration_ns
        How long a silent publisher counts as alive, in nanoseconds.
    avoid_ros_namespace_conventions
        Whether the topic is a bare DDS topic.

    Raises
    ------
    RecordingError
        A policy is not one of its words, or a number is none.
    """

    history: str = "keep_last"
    depth: int = 10
    reliability: str = "reliable"
    durability: str = "volatile"
    deadline_ns: int = INFINITE_NS
    lifespan_ns: int = INFINITE_NS
    liveliness: str = "automatic"
    liveliness_lease_duration_ns: int = INFINITE_NS
    avoid_ros_namespace_conventions: bool = False

    def __post_init__(self) -> None:
        for policy, words in _POLICIES.items():
            word = getattr(self, policy)
            if word not in words:
                raise RecordingError(f"The QoS {policy} {word!r} is not one of {', '.join(words)}.")
        durations = self.deadline_ns, self.lifespan_ns, self.liveliness_lease_duration_ns
        for number in (self.depth, *durations):
            if type(number) is not int or not 0 <= number <= INFINITE_NS:
                raise RecordingError(
                    f"A depth or duration of QoS is {number!r}, no whole number from 0 to 2^63 - 1."
                )

    @classmethod
    def from_yaml(cls, text: str) -> list[QosProfile]:
        """Read a channel's ``offered_qos_profiles``, whose policies are words or numbers.

        ``text`` is the YAML of a list with one profile for each publisher; empty for none. What a
        profile does not say is as in ``QosProfile()``.

        Raises
        ------
        RecordingError
            The text is not such a list.
        """
        try:
            _require_plain(text)
            entries = yaml.safe_load(text) or []
            return [cls(**_arguments(entry)) for entry in entries]
        except (
            *(yaml.YAMLError, TypeError, ValueError, AttributeError),
            *(KeyError, OverflowError, RecursionError),
        ) as error:
            reason = " ".join(str(error).split())
            raise RecordingError(f"A QoS profile of the bag cannot be read: {reason}.") from error

    def to_yaml(self) -> str:
        """Return a channel's ``offered_qos_profiles`` with this profile, as rosbag2 dumps it."""
        return "\n".join(
            (
                f"- history: {self.history}",
                f"  depth: {self.depth}",
                f"  reliability: {self.reliability}",
                f"  durability: {self.durability}",
                *_duration("deadline", self.deadline_ns),
                *_duration("lifespan", self.lifespan_ns),
                f"  liveliness: {self.liveliness}",
                *_duration("liveliness_lease_duration", self.liveliness_lease_duration_ns),
                "  avoid_ros_namespace_conventions: "
                + ("true" if self.avoid_ros_namespace_conventions else "false"),
            )
        )


LATCHED = QosProfile(depth=1, durability="transient_local")
"""Reliable, transient local, depth 1: a late subscriber gets the last message."""


def _duration(name: str, nanoseconds: int) -> tuple[str, str, str]:
    seconds, rest = divmod(nanoseconds, SECOND)
    return f"  {name}:", f"    sec: {seconds}", f"    nsec: {rest}"


_LONGEST_TEXT = 65_536
_DEEPEST = 8
"""Levels of lists and mappings: a list of profiles, each with durations, has three."""


def _require_plain(text: str) -> None:
    """Refuse YAML that is nested, or multiplies itself by references.

    Raises
    ------
    ValueError
        It does.
    """
    if len(text) > _LONGEST_TEXT:
        raise ValueError(f"it is longer than {_LONGEST_TEXT} characters")
    depth = 0
    # Events are read without recursion.
    for event in yaml.parse(text, Loader=yaml.SafeLoader):
        if isinstance(event, yaml.AliasEvent):
            raise ValueError("it has references")
        if isinstance(event, yaml.CollectionStartEvent):
            depth += 1
        elif isinstance(event, yaml.CollectionEndEvent):
            depth -= 1
        if depth > _DEEPEST:
            raise ValueError(f"it is nested more than {_DEEPEST} deep")


def _arguments(entry: dict[str, Any]) -> dict[str, Any]:
    """Turn one entry of the YAML into the arguments of a profile."""
    arguments: dict[str, Any] = {}
    for name, value in entry.items():
        if name in _DURATIONS:
            nanoseconds = int(value["sec"]) * SECOND + int(value["nsec"])
            arguments[f"{name}_ns"] = min(nanoseconds, INFINITE_NS)
        elif name in _POLICIES:
            number = isinstance(value, int) and not isinstance(value, bool)
            arguments[name] = _POLICY_NUMBERS[name].get(value, "unknown") if number else value
        elif name in {field.name for field in fields(QosProfile)}:
            arguments[name] = value
    return arguments


# -- the metadata record ----------------------------------------------------------------------

METADATA_NAME = "rosbag2"
"""Name of the MCAP Metadata record that ``ros2 bag info`` and ``ros2 bag play`` read first."""

_METADATA_KEY = "serialized_metadata"
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


def metadata_record(
    file_name: str, topics: Sequence[RecordedTopic], start_ns: int | None, end_ns: int | None
) -> Metadata:
    """Return rosbag2's metadata record, its YAML laid out as rosbag2 dumps it.

    ``file_name`` has no folders; ``start_ns`` and ``end_ns`` are the log times of the earliest and
    the latest message in nanoseconds, None without messages.
    """
    start, duration = INFINITE_NS, 0
    if start_ns is not None and end_ns is not None:
        start, duration = start_ns, end_ns - start_ns
    count = sum(topic.message_count for topic in topics)
    path = _scalar(file_name)
    listed = "\n" + "\n".join(map(_topic, topics)) if topics else "\n  []"
    text = (
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
    return Metadata(name=METADATA_NAME, metadata={_METADATA_KEY: text})


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
