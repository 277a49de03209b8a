"""Writes the file of a bag: MCAP with the metadata of rosbag2.

The records are encoded by the classes of ``mcap.records``. What ``mcap.writer.Writer`` does for
every single message is left to the caller, who brings whole chunks: with the library's writer a
recorder would slow a simulation down.
"""

from __future__ import annotations

import array
import errno
import fcntl
import io
import json
import os
import re
import struct
import zlib
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields
from pathlib import Path
from textwrap import indent
from typing import Any, TypeAlias

import lz4.frame
import numpy as np
import yaml
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.writer import MCAP0_MAGIC

from spacerobot_ros.bag.mcap_reading import require_regular
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
_DURATION_POLICIES = ("deadline", "lifespan", "liveliness_lease_duration")


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

        ``text`` is the YAML of a list with one profile for each publisher; empty for none. Entries
        that a profile lacks are as in ``QosProfile()``.

        Raises
        ------
        RecordingError
            The text is not such a list.
        """
        try:
            _require_flat_yaml(text)
            entries = yaml.safe_load(text) or []
            return [cls(**_profile_arguments(entry)) for entry in entries]
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
                *_duration_lines("deadline", self.deadline_ns),
                *_duration_lines("lifespan", self.lifespan_ns),
                f"  liveliness: {self.liveliness}",
                *_duration_lines("liveliness_lease_duration", self.liveliness_lease_duration_ns),
                "  avoid_ros_namespace_conventions: "
                + ("true" if self.avoid_ros_namespace_conventions else "false"),
            )
        )


LATCHED = QosProfile(depth=1, durability="transient_local")
"""Reliable, transient local, depth 1: a late subscriber gets the last message."""


def _duration_lines(name: str, nanoseconds: int) -> tuple[str, str, str]:
    seconds, rest = divmod(nanoseconds, SECOND)
    return f"  {name}:", f"    sec: {seconds}", f"    nsec: {rest}"


_MAX_YAML_CHARACTERS = 65_536
_MAX_YAML_DEPTH = 8
"""Deepest YAML nesting read: a list of profiles with durations has three levels."""


def _require_flat_yaml(text: str) -> None:
    """Raise ValueError for YAML that is deeply nested or repeats parts of itself by references."""
    if len(text) > _MAX_YAML_CHARACTERS:
        raise ValueError(f"it is longer than {_MAX_YAML_CHARACTERS} characters")
    depth = 0
    # Events are read without recursion.
    for event in yaml.parse(text, Loader=yaml.SafeLoader):
        if isinstance(event, yaml.AliasEvent):
            raise ValueError("it has references")
        if isinstance(event, yaml.CollectionStartEvent):
            depth += 1
        elif isinstance(event, yaml.CollectionEndEvent):
            depth -= 1
        if depth > _MAX_YAML_DEPTH:
            raise ValueError(f"it is nested more than {_MAX_YAML_DEPTH} deep")


def _profile_arguments(entry: dict[str, Any]) -> dict[str, Any]:
    """Turn one entry of the YAML into the arguments of a profile."""
    arguments: dict[str, Any] = {}
    for name, value in entry.items():
        if name in _DURATION_POLICIES:
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
"""Only key of the rosbag2 metadata record."""

# First version with QoS policies as words; without a version readers expect numbers.
_METADATA_VERSION = 9

# Strings that every YAML reader accepts without quotes, except for YAML's keywords.
_UNQUOTED_STRING = re.compile(r"[A-Za-z/][\w./-]*", re.ASCII)
_YAML_KEYWORDS = {"false", "n", "no", "null", "off", "on", "true", "y", "yes"}


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
    path = _yaml_string(file_name)
    listed = "\n" + "\n".join(map(_topic_entry, topics)) if topics else "\n  []"
    text = (
        f"version: {_METADATA_VERSION}\n"
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
        f"ros_distro: {_yaml_string(os.environ.get('ROS_DISTRO', 'jazzy'))}"
    )
    return Metadata(name=METADATA_NAME, metadata={_METADATA_KEY: text})


def _topic_entry(topic: RecordedTopic) -> str:
    return (
        "  - topic_metadata:\n"
        f"      name: {_yaml_string(topic.name)}\n"
        f"      type: {_yaml_string(topic.type_name)}\n"
        "      serialization_format: cdr\n"
        f"      offered_qos_profiles:\n{indent(topic.qos.to_yaml(), ' ' * 8)}\n"
        f"      type_description_hash: {_yaml_string(topic.type_hash)}\n"
        f"    message_count: {topic.message_count}"
    )


def _yaml_string(text: str) -> str:
    # Every JSON string is a YAML string.
    plain = _UNQUOTED_STRING.fullmatch(text) and text.lower() not in _YAML_KEYWORDS
    return text if plain else json.dumps(text)


_COMPRESSIONS = {"zstd": "zstd", "lz4": "lz4", "none": ""}
"""Name of each compression in this package -> its name in the MCAP file."""

_MESSAGE_INDEX_HEADER = struct.Struct("<BQHI")


def _compression_function(compression: str) -> Callable[[bytes | bytearray], bytes]:
    if compression == "zstd":
        # Each file has its own compressor, because two threads must not share one. Level -1 makes
        # telemetry 1 to 4 % larger than level 1 and 3 to 8 % larger than level 3, in half the
        # time of level 3.
        return zstandard.ZstdCompressor(level=-1).compress
    return lz4.frame.compress if compression == "lz4" else bytes


Entries: TypeAlias = "array.array[int]"
"""Log time in nanoseconds and offset in the chunk of each message of a channel, unsigned."""


def no_entries() -> Entries:
    """Return entries without a message."""
    return array.array("Q")


class BagExistsError(RecordingError):
    """The bag file exists and must not be overwritten."""


def _create_locked_file(path: Path, overwrite: bool) -> io.FileIO:
    """Create an empty, locked, regular file; BagExistsError if the file must not be overwritten."""
    with suppress(FileNotFoundError):
        require_regular(os.stat(path).st_mode, path, "make")
    flags = os.O_RDWR | os.O_CREAT | os.O_NONBLOCK | os.O_CLOEXEC
    try:
        descriptor = os.open(path, flags if overwrite else flags | os.O_EXCL, 0o666)
    except FileExistsError as error:
        raise BagExistsError(
            f"Cannot make the bag {path}: File exists; name another one, or remove it."
        ) from error
    # Unbuffered: appended records survive a kill.
    raw = open(descriptor, "wb", buffering=0)  # noqa: SIM115
    try:
        require_regular(os.fstat(descriptor).st_mode, path, "make")
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raw.close()
        raise BagExistsError(f"The bag {path} is being written by another recorder.") from error
    except OSError as error:
        # Some network file systems have no locks: an existing file is then refused.
        if error.errno not in (errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS):
            raw.close()
            raise
    except RecordingError:
        raw.close()
        raise
    raw.truncate(0)
    return raw


def encode(record: McapRecord) -> bytes:
    """Return an MCAP record as bytes."""
    builder = RecordBuilder()
    record.write(builder)
    return bytes(builder.end())


class McapFile:
    """An MCAP file that grows by whole records.

    Every append goes to the operating system at once, and one that fails is undone, so that the
    file of a process that dies is whole but for the record that it was appending. While it is open
    it is locked: no second one can be opened on the same path. ``compression`` and ``overwrite``
    are as of :class:`~spacerobot_ros.bag.BagWriter`; ``profile`` is that of the MCAP header. Every
    append raises RecordingError where the disk refuses it; the file is then as it was.

    Raises
    ------
    BagExistsError
        The file is there and is not to be replaced, or is being written.
    RecordingError
        The file cannot be made.
    """

    def __init__(
        self, path: Path, *, compression: str, overwrite: bool, profile: str = "ros2"
    ) -> None:
        if compression not in _COMPRESSIONS:
            raise RecordingError(
                f"The compression {compression!r} is not one of {', '.join(_COMPRESSIONS)}."
            )
        self.path = path
        self.schemas: list[Schema] = []
        self.channels: list[Channel] = []
        self.message_counts: dict[int, int] = defaultdict(int)
        self.start_ns: int | None = None
        self.end_ns: int | None = None
        self._compression = _COMPRESSIONS[compression]
        self._compress = _compression_function(compression)
        self._chunk_indexes: list[bytes] = []  # Encoded, because a long flight has many.
        self._attachment_indexes: list[AttachmentIndex] = []
        self._metadata_indexes: list[MetadataIndex] = []
        self._size = 0
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._raw = _create_locked_file(path, overwrite)
        except (OSError, ValueError) as error:
            reason = getattr(error, "strerror", None) or error
            raise RecordingError(f"Cannot make the bag {path}: {reason}.") from error
        try:
            self._append(MCAP0_MAGIC + encode(Header(profile=profile, library="spacerobot_ros")))
        except RecordingError:
            self.close()
            raise

    @property
    def size(self) -> int:
        """Size of the file, bytes."""
        return self._size

    def check(self) -> None:
        """Check that the path still names this file, uncut; else raise RecordingError."""
        problem = ""
        try:
            ours, theirs = os.fstat(self._raw.fileno()), os.stat(self.path)
            if (ours.st_dev, ours.st_ino) != (theirs.st_dev, theirs.st_ino):
                problem = "another file is in its place"
            elif ours.st_size != self._size:
                problem = f"it has {ours.st_size} bytes, and {self._size} were written"
        except FileNotFoundError:
            problem = "it was removed or moved"
        except (OSError, ValueError) as error:
            problem = str(getattr(error, "strerror", None) or error)
        if problem:
            raise RecordingError(f"The bag {self.path} is lost while it is written: {problem}.")

    def append_chunk(self, records: bytearray, entries: Mapping[int, Entries]) -> None:
        """Append a chunk of encoded records and the indexes of its messages.

        ``entries`` are, of each channel, for each of its messages, log time in nanoseconds and
        offset in ``records``, one after the other.
        """
        given = {channel: np.array(entry, "<u8") for channel, entry in entries.items() if entry}
        times = np.concatenate([entry[::2] for entry in given.values()])
        start, end = int(times.min()), int(times.max())
        data = self._compress(records)
        chunk = encode(
            Chunk(
                compression=self._compression,
                data=data,
                message_start_time=start,
                message_end_time=end,
                uncompressed_crc=zlib.crc32(records),
                uncompressed_size=len(records),
            )
        )
        parts, offsets, position = [chunk], {}, self._size + len(chunk)
        for channel, entry in given.items():
            size = 8 * len(entry)
            header = _MESSAGE_INDEX_HEADER.pack(Opcode.MESSAGE_INDEX, 6 + size, channel, size)
            parts += header, entry.tobytes()
            offsets[channel] = position
            position += len(header) + size
        index = ChunkIndex(
            message_start_time=start,
            message_end_time=end,
            chunk_start_offset=self._size,
            chunk_length=len(chunk),
            message_index_offsets=offsets,
            message_index_length=position - self._size - len(chunk),
            compression=self._compression,
            compressed_size=len(data),
            uncompressed_size=len(records),
        )
        self._append(b"".join(parts))
        self._chunk_indexes.append(encode(index))
        for channel, entry in given.items():
            self.message_counts[channel] += len(entry) // 2
        self.start_ns = start if self.start_ns is None else min(start, self.start_ns)
        self.end_ns = end if self.end_ns is None else max(end, self.end_ns)

    def append_attachment(self, attachment: Attachment) -> None:
        """Append an attachment."""
        record, offset = encode(attachment), self._size
        self._append(record)
        self._attachment_indexes.append(
            AttachmentIndex(
                offset=offset,
                length=len(record),
                log_time=attachment.log_time,
                create_time=attachment.create_time,
                data_size=len(attachment.data),
                name=attachment.name,
                media_type=attachment.media_type,
            )
        )

    def append_metadata(self, metadata: Metadata) -> None:
        """Append a metadata record."""
        record, offset = encode(metadata), self._size
        self._append(record)
        self._metadata_indexes.append(
            MetadataIndex(offset=offset, length=len(record), name=metadata.name)
        )

    def finish(self) -> None:
        """Append the summary, after which the file is complete."""
        data_end = encode(DataEnd(data_section_crc=0))
        start = self._size + len(data_end)
        groups: tuple[tuple[Opcode, Iterable[bytes]], ...] = (
            (Opcode.SCHEMA, map(encode, self.schemas)),
            (Opcode.CHANNEL, map(encode, self.channels)),
            (Opcode.STATISTICS, [encode(self._statistics())]),
            (Opcode.CHUNK_INDEX, self._chunk_indexes),
            (Opcode.ATTACHMENT_INDEX, map(encode, self._attachment_indexes)),
            (Opcode.METADATA_INDEX, map(encode, self._metadata_indexes)),
        )
        summary, offsets = bytearray(), bytearray()
        for opcode, records in groups:
            group = b"".join(records)
            if group:
                offsets += encode(
                    SummaryOffset(
                        group_opcode=opcode,
                        group_start=start + len(summary),
                        group_length=len(group),
                    )
                )
                summary += group
        offsets_start = start + len(summary)
        summary += offsets
        # The checksum covers the footer too, up to the checksum itself.
        unchecked = encode(Footer(start, offsets_start, summary_crc=0))
        checksum = zlib.crc32(unchecked[:-4], zlib.crc32(summary))
        footer = encode(Footer(start, offsets_start, summary_crc=checksum))
        self._append(data_end + bytes(summary) + footer + MCAP0_MAGIC)

    def close(self) -> None:
        """Close the file; does not raise."""
        with suppress(OSError):
            self._raw.close()

    def _statistics(self) -> Statistics:
        return Statistics(
            attachment_count=len(self._attachment_indexes),
            channel_count=len(self.channels),
            channel_message_counts=dict(self.message_counts),
            chunk_count=len(self._chunk_indexes),
            message_count=sum(self.message_counts.values()),
            message_start_time=self.start_ns or 0,
            message_end_time=self.end_ns or 0,
            metadata_count=len(self._metadata_indexes),
            schema_count=len(self.schemas),
        )

    def append_rosbag2_metadata(self, topics: Sequence[RecordedTopic]) -> None:
        """Append rosbag2's metadata record of the messages so far."""
        self.append_metadata(metadata_record(self.path.name, topics, self.start_ns, self.end_ns))

    def _append(self, data: bytes) -> None:
        rest = memoryview(data)
        try:
            while rest:
                rest = rest[self._raw.write(rest) :]
        except OSError as error:
            with suppress(OSError):
                self._raw.truncate(self._size)
                self._raw.seek(self._size, os.SEEK_SET)
            count = sum(self.message_counts.values())
            raise RecordingError(
                f"Cannot write the bag {self.path}: {error.strerror or error}; "
                f"the {count} messages before that are safe in it."
            ) from error
        self._size += len(data)
