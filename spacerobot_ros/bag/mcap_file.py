"""Bag file: MCAP with rosbag2 metadata."""

from __future__ import annotations

import errno
import fcntl
import io
import os
import shlex
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import IO, Any, cast

import yaml
from mcap.opcode import Opcode
from mcap.writer import CompressionType, Writer

from spacerobot_ros.bag.mcap_reading import require_regular
from spacerobot_ros.errors import RecordingError, counted, reason
from spacerobot_ros.files import load_yaml
from spacerobot_ros.messages.definitions import message_definition
from spacerobot_ros.times import SECOND

# -- quality of service -----------------------------------------------------------------------

_INFINITE_NS = 2**63 - 1
"""Infinite duration, in nanoseconds (``RMW_DURATION_INFINITE``)."""

_INFINITE_DURATION = dict(zip(("sec", "nsec"), divmod(_INFINITE_NS, SECOND), strict=True))


@dataclass(frozen=True)
class QosProfile:
    """Quality of service offered by a topic's publisher; all durations are infinite.

    Policies are rmw's lower-case strings (``rmw_qos_*_policy_to_str``), the only form that ``ros2
    bag play`` accepts.

    Parameters
    ----------
    history
        ``keep_last``, ``keep_all``, ``system_default`` or ``unknown``.
    depth
        Number of messages that ``keep_last`` keeps.
    reliability
        ``reliable``, ``best_effort``, ``system_default``, ``best_available`` or ``unknown``.
    durability
        ``volatile``, ``transient_local`` (latched), or one of the last three values of
        ``reliability``.
    liveliness
        ``automatic``, ``manual_by_topic``, or one of the last three values of ``reliability``.
    """

    history: str = "keep_last"
    depth: int = 10
    reliability: str = "reliable"
    durability: str = "volatile"
    liveliness: str = "automatic"

    @classmethod
    def from_yaml(cls, text: str) -> list[QosProfile]:
        """Parse a channel's ``offered_qos_profiles``, whose policies are strings or numbers.

        ``text`` is a YAML list with one profile per publisher, or empty. Missing
        entries default to those of ``QosProfile()``.

        Raises
        ------
        RecordingError
            ``text`` is not such a list.
        """
        # This import loads all of rosbags, and few bags are replayed.
        from rosbags.rosbag2.metadata import parse_qos

        profiles = []
        try:
            entries = [cls().to_dict() | entry for entry in load_yaml(text) or []]
            for given in parse_qos(entries):
                if type(given.depth) is not int or not 0 <= given.depth <= _INFINITE_NS:
                    raise ValueError(f"its depth is {given.depth!r}")
                policies = "history", "reliability", "durability", "liveliness"
                words = {name: getattr(given, name).name.lower() for name in policies}
                profiles.append(cls(depth=given.depth, **words))
        except (ValueError, TypeError, AttributeError, KeyError) as error:
            raise RecordingError(f"A QoS profile of the bag cannot be read: {error}.") from error
        return profiles

    def to_yaml(self) -> str:
        """Return a channel's ``offered_qos_profiles`` with this profile, in rosbag2's format."""
        return _to_yaml([self.to_dict()]).rstrip()

    def to_dict(self) -> dict[str, Any]:
        """Return the profile as it appears in rosbag2's YAML."""
        return {
            "history": self.history,
            "depth": self.depth,
            "reliability": self.reliability,
            "durability": self.durability,
            "deadline": _INFINITE_DURATION,
            "lifespan": _INFINITE_DURATION,
            "liveliness": self.liveliness,
            "liveliness_lease_duration": _INFINITE_DURATION,
            "avoid_ros_namespace_conventions": False,
        }


LATCHED = QosProfile(depth=1, durability="transient_local")
"""Reliable, transient local, depth 1: late subscribers receive the last message."""


class _Dumper(getattr(yaml, "CSafeDumper", yaml.SafeDumper)):  # type: ignore[misc]
    def ignore_aliases(self, data: Any) -> bool:
        return True


def _to_yaml(values: Any) -> str:
    return yaml.dump(values, Dumper=_Dumper, sort_keys=False, allow_unicode=True)


# -- the metadata record ----------------------------------------------------------------------

METADATA_NAME = "rosbag2"
"""Name of the MCAP Metadata record that ``ros2 bag info`` and ``ros2 bag play`` read first."""


@dataclass(frozen=True)
class RecordedTopic:
    """One topic of a bag: name, type, offered QoS, and type hash if known."""

    name: str
    type_name: str
    qos: QosProfile
    type_hash: str = ""


# -- the file ---------------------------------------------------------------------------------

_MESSAGE_HEAD_SIZE = 31
"""Length of a message header in a chunk, bytes."""


class BagExistsError(RecordingError):
    """The bag file exists and must not be overwritten."""


def _create_locked_file(path: Path, overwrite: bool) -> io.FileIO:
    """Create an empty, locked, regular file; BagExistsError if the file must not be overwritten."""
    with suppress(FileNotFoundError):
        require_regular(os.stat(path).st_mode, path, "create")
    flags = os.O_RDWR | os.O_CREAT | os.O_CLOEXEC
    try:
        descriptor = os.open(path, flags if overwrite else flags | os.O_EXCL, 0o666)
    except FileExistsError as error:
        raise BagExistsError(
            f"Cannot create the bag {path}: File exists; name another one, or remove it."
        ) from error
    # Unbuffered: appended records survive a kill.
    raw = open(descriptor, "wb", buffering=0)  # noqa: SIM115
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raw.close()
        raise BagExistsError(f"The bag {path} is being written by another recorder.") from error
    except OSError as error:
        # Some network file systems have no locks: an existing file is then refused.
        if error.errno not in (errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS):
            raw.close()
            raise
    raw.truncate(0)
    return raw


class McapFile(Writer):
    """A writer of MCAP records whose file is complete up to its last record.

    Chunks, attachments and metadata records are passed to the operating system immediately; failed
    writes are undone. If the process dies, the file is complete except for the record being added.
    An open file is locked: the same path cannot be opened a second time. If the disk is full or
    fails, calls that add records raise RecordingError, and the file must be closed.

    The parent folders of ``path`` are created. For ``compression``, ``chunk_size`` and
    ``overwrite``, see :class:`~spacerobot_ros.bag.BagWriter`; ``profile`` is the profile in the
    MCAP header. Raises RecordingError if the file cannot be created, and BagExistsError if it
    exists or is being written.
    """

    def __init__(
        self,
        path: Path,
        *,
        compression: str = "zstd",
        chunk_size: int = 65536,
        overwrite: bool,
        profile: str = "ros2",
    ) -> None:
        self.path, self._profile = path, profile
        self.topics: dict[int, RecordedTopic] = {}
        """Topics in rosbag2's metadata, by channel."""
        self._schema_ids: dict[str, int] = {}
        self.message_counts: Counter[int] = Counter()
        """Number of messages by channel, including the current chunk."""
        self.start_ns: int | None = None
        self.end_ns: int | None = None
        """Earliest and latest log times, ns."""
        self.bytes_waiting = 0
        """Size of the messages in the current chunk, bytes."""
        self.size = 0
        """Number of bytes passed to the operating system."""
        self._counts_in_file: Counter[int] = Counter()
        output = SimpleNamespace(write=self._append, tell=lambda: self.size, flush=lambda: None)
        super().__init__(
            cast("IO[bytes]", output),
            chunk_size=chunk_size,
            compression=CompressionType[compression.upper()],
        )
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._raw = _create_locked_file(path, overwrite)
        except (OSError, ValueError) as error:
            raise RecordingError(f"Cannot create the bag {path}: {reason(error)}.") from error
        try:
            self.start(profile, library="spacerobot_ros")
        except RecordingError:
            self.close()
            raise

    def check(self) -> None:
        """Raise RecordingError unless this file still exists at its path, at full size."""
        problem = ""
        try:
            ours, theirs = os.fstat(self._raw.fileno()), os.stat(self.path)
            if (ours.st_dev, ours.st_ino) != (theirs.st_dev, theirs.st_ino):
                problem = "another file replaced it"
            elif ours.st_size != self.size:
                problem = f"it has {ours.st_size} bytes, but {self.size} were written"
        except FileNotFoundError:
            problem = "it was removed or moved"
        except OSError as error:
            problem = reason(error)
        if problem:
            raise RecordingError(f"The bag {self.path} was lost during recording: {problem}.")

    def add_topic(self, topic: RecordedTopic) -> int:
        """Add a topic of an installed type, and return its channel."""
        kind = topic.type_name
        if kind not in self._schema_ids:
            text = message_definition(kind).encode()
            self._schema_ids[kind] = self.register_schema(kind, "ros2msg", text)
        profile, type_hash = topic.qos.to_yaml(), topic.type_hash
        metadata = {"offered_qos_profiles": profile, "topic_type_hash": type_hash}
        channel = self.register_channel(topic.name, "cdr", self._schema_ids[kind], metadata)
        self.topics[channel] = topic
        return channel

    def add_message(
        self, channel_id: int, log_time: int, data: bytes, publish_time: int, sequence: int = 0
    ) -> None:
        """Add a message; times are in ns."""
        self.message_counts[channel_id] += 1
        self.bytes_waiting += _MESSAGE_HEAD_SIZE + len(data)
        if self.start_ns is None or log_time < self.start_ns:
            self.start_ns = log_time
        if self.end_ns is None or log_time > self.end_ns:
            self.end_ns = log_time
        super().add_message(channel_id, log_time, data, publish_time, sequence)

    def add_rosbag2_metadata(self) -> None:
        """Append rosbag2's metadata record for the messages written so far."""
        start, duration = _INFINITE_NS, 0
        if self.start_ns is not None and self.end_ns is not None:
            start, duration = self.start_ns, self.end_ns - self.start_ns
        content = {
            "duration": {"nanoseconds": duration},
            "starting_time": {"nanoseconds_since_epoch": start},
            "message_count": sum(self.message_counts[channel] for channel in self.topics),
        }
        whole = {
            # First version with QoS policies as strings; without it, readers expect numbers.
            "version": 9,
            "storage_identifier": "mcap",
            **content,
            "topics_with_message_count": [
                {
                    "topic_metadata": {
                        "name": topic.name,
                        "type": topic.type_name,
                        "serialization_format": "cdr",
                        "offered_qos_profiles": [topic.qos.to_dict()],
                        "type_description_hash": topic.type_hash,
                    },
                    "message_count": self.message_counts[channel],
                }
                for channel, topic in self.topics.items()
            ],
            "compression_format": "",
            "compression_mode": "",
            "relative_file_paths": [self.path.name],
            "files": [{"path": self.path.name, **content}],
            "custom_data": None,
            "ros_distro": os.environ.get("ROS_DISTRO", "jazzy"),
        }
        self.add_metadata(METADATA_NAME, {"serialized_metadata": _to_yaml(whole)})

    def flush(self) -> None:
        """Complete the current chunk."""
        Writer.flush(self)

    def finish(self) -> None:
        """Complete and close the file; a ROS 2 bag ends with rosbag2's metadata."""
        try:
            self.flush()
            if self._profile == "ros2":
                self.add_rosbag2_metadata()
            Writer.finish(self)
        finally:
            self.close()

    def close(self) -> None:
        """Close the file without raising an exception."""
        with suppress(OSError):
            self._raw.close()

    def _append(self, data: bytes) -> None:
        """Pass records to the operating system, completely or not at all."""
        rest = memoryview(data)
        try:
            while rest:
                rest = rest[self._raw.write(rest) :]
        except OSError as error:
            with suppress(OSError):
                self._raw.truncate(self.size)
                self._raw.seek(self.size, os.SEEK_SET)
            self.message_counts = self._counts_in_file
            written, what_is_left = self.message_counts.total(), "no message was written."
            if written:
                what_is_left = (
                    f"'spacerobot salvage {shlex.quote(str(self.path))}' recovers the "
                    f"{counted(written, 'message')} already written."
                )
            raise RecordingError(
                f"Cannot write the bag {self.path}: {reason(error)}; {what_is_left}"
            ) from error
        self.size += len(data)
        if data[:1] == bytes([Opcode.CHUNK]):
            self.bytes_waiting, self._counts_in_file = 0, self.message_counts.copy()
