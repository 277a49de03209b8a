"""Writes a bag: an MCAP file as rosbag2's storage plugin writes it."""

from __future__ import annotations

import os
import re
import struct
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Metadata, Schema
from numpy.typing import NDArray

from spacerobot_ros.bag.mcap_file import (
    BagExistsError,
    Entries,
    McapFile,
    QosProfile,
    RecordedTopic,
    encode,
    no_entries,
)
from spacerobot_ros.bag.mcap_reading import MESSAGE_HEADERS
from spacerobot_ros.errors import RecordingError
from spacerobot_ros.messages.definitions import message_definition, type_hash

_MESSAGE_HEADER = struct.Struct("<BQHIQQ")
"""Head of a message record: opcode, length, channel, sequence, log time, publish time."""

_pack_header = _MESSAGE_HEADER.pack
_HEADER_LENGTH = _MESSAGE_HEADER.size - 9
_MESSAGE = int(Opcode.MESSAGE)


def free_name(path: Path, first: int = 0) -> Path:
    """Return a path, or the first of ``NAME-1``, ``NAME-2``, ... that does not exist."""
    number = first
    while True:
        name = path.with_name(f"{path.stem}-{number}{path.suffix}") if number else path
        if not os.path.lexists(name):
            return name
        number += 1


def _places_by_value(numbers: NDArray[np.int64]) -> Iterator[tuple[int, NDArray[np.intp]]]:
    """Yield each of some numbers with its places, in order."""
    order = np.argsort(numbers, kind="stable")
    ascending = numbers[order]
    begins = np.flatnonzero(np.diff(ascending, prepend=-1))
    yield from zip(ascending[begins].tolist(), np.split(order, begins[1:]), strict=True)


class BagWriter:
    """Writes serialised ROS 2 messages into a bag that any ROS 2 tool opens.

    Messages gather in a chunk in memory. A chunk that is full goes to the operating system as one
    piece: a process that is killed loses the chunk in progress and nothing before it (a computer
    that loses power may lose more). A bag is complete, with its summary, once it is closed; use the
    writer as a context manager. One thread at a time may use it.

    When the disk refuses a chunk, that chunk is lost, the call that met it and every later one that
    would add something raise RecordingError, and closing still completes the file where there is
    room.

    Parameters
    ----------
    path
        The bag, usually ``*.mcap``; its folders are made.
    compression
        Of the chunks: ``zstd``, ``lz4`` or ``none``.
    chunk_size
        How large a chunk grows, in bytes before compression.
    overwrite
        Whether a file that is there is replaced; not one that is being written.
    next_free
        Whether the bag takes the next name that is free where one is there: ``NAME-1.mcap``,
        ``NAME-2.mcap``, ...
    max_size
        How large a file grows, in bytes, before the next one is begun; 0: without bound. The files
        of a bag that may be split are ``NAME_0.mcap``, ``NAME_1.mcap``, ..., each complete, with
        all attachments and metadata.
    max_duration_ns
        How much log time a file spans, in nanoseconds, likewise. Both are checked after every
        chunk.

    Raises
    ------
    RecordingError
        The file cannot be made, or is there and is not to be replaced.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        compression: str = "zstd",
        chunk_size: int = 65536,
        overwrite: bool = True,
        next_free: bool = False,
        max_size: int = 0,
        max_duration_ns: int = 0,
    ) -> None:
        self._unsplit_path = Path(path)
        self._limits = max_size, max_duration_ns
        self._file_number = 0
        self._compression, self._overwrite = compression, overwrite and not next_free
        self._next_free = next_free
        self.splits = 0
        """Number of files begun after the first one."""
        self._earlier_counts: Counter[str] = Counter()
        self._repeated_records: list[Attachment | Metadata] = []
        self._file = self._open_first_file()
        self._chunk_size = chunk_size
        self._chunk = bytearray()
        # For each channel: log time of each message and its offset in the chunk. Empty as soon as
        # nothing more can be written, so that `write` needs no test of its own for that.
        self._entries: dict[int, Entries] = {}
        self._topics: dict[str, tuple[int, str, QosProfile]] = {}
        self._schema_ids: dict[str, int] = {}
        self._refusal: str | None = None
        self._closed = False
        try:
            # rosbag2 writes this record at both ends. The first tells the readers of a cut file
            # that its QoS policies are words.
            self._append_rosbag2_metadata()
        except RecordingError:
            self._file.close()
            raise

    @property
    def path(self) -> Path:
        """Path of the bag, or of its file that is being written."""
        return self._file.path

    @property
    def message_counts(self) -> dict[str, int]:
        """Number of messages of each topic in the bag, with the chunk in progress."""
        return {
            name: self._earlier_counts[name] + self._message_count(channel)
            for name, (channel, _, _) in self._topics.items()
        }

    @property
    def bytes_written(self) -> int:
        """Size of the present file after compression, bytes."""
        return self._file.size

    @property
    def bytes_waiting(self) -> int:
        """Size of the chunk in progress, which is not in the file yet, bytes."""
        return len(self._chunk)

    @property
    def messages_written(self) -> int:
        """Number of messages in the bag, with the chunk in progress."""
        return sum(self.message_counts.values())

    def add_topic(self, name: str, type_name: str, qos: QosProfile | None = None) -> int:
        """Register a topic before its first message is written.

        Parameters
        ----------
        name
            Full name of the topic, such as ``/odom``.
        type_name
            Message type, such as ``nav_msgs/msg/Odometry``.
        qos
            QoS that its publisher offers; reliable, volatile and depth 10 unless given.

        Returns
        -------
        The channel that ``write`` takes. A topic that is known already keeps its channel and QoS.

        Raises
        ------
        RecordingError
            The type is not installed, the topic is known with another type, or nothing more can
            be written.
        """
        self._require_open()
        if name in self._topics:
            channel_id, known_type, _ = self._topics[name]
            if type_name != known_type:
                raise RecordingError(
                    f"The topic {name} has the type {known_type} in the bag {self.path} and cannot "
                    f"have {type_name} too."
                )
            return channel_id
        profile = QosProfile() if qos is None else qos
        hash_string = type_hash(type_name)
        schema_id = self._schema_ids.get(type_name) or self._add_schema(type_name)
        channel = Channel(
            id=len(self._file.channels) + 1,
            topic=name,
            message_encoding="cdr",
            metadata={"offered_qos_profiles": profile.to_yaml(), "topic_type_hash": hash_string},
            schema_id=schema_id,
        )
        self._chunk += encode(channel)
        self._file.channels.append(channel)
        self._topics[name] = channel.id, type_name, profile
        self._entries[channel.id] = no_entries()
        return channel.id

    def write(self, channel_id: int, data: bytes, log_time_ns: int, publish_time_ns: int) -> None:
        """Add one message.

        Parameters
        ----------
        channel_id
            From ``add_topic``.
        data
            The serialised message (CDR with its header), as a raw subscription receives it.
        log_time_ns
            When it was recorded, in nanoseconds, not negative.
        publish_time_ns
            When it was published, in nanoseconds, not negative.

        Raises
        ------
        RecordingError
            The disk refused it, nothing more can be written, the channel is unknown, or a time is
            not a whole number of at least 0.
        """
        chunk = self._chunk
        try:
            header = _pack_header(
                _MESSAGE,
                _HEADER_LENGTH + len(data),
                channel_id,
                0,
                log_time_ns,
                publish_time_ns,
            )
            entries = self._entries[channel_id]
        except (KeyError, struct.error):
            raise self._explain_refusal(channel_id) from None
        record = header + data
        entries.extend((log_time_ns, len(chunk)))
        chunk += record
        if len(chunk) >= self._chunk_size:
            self._finish_chunk()

    def write_many(
        self,
        channel_ids: Sequence[int],
        messages: Sequence[bytes],
        log_times_ns: NDArray[np.int64],
        publish_times_ns: NDArray[np.int64],
    ) -> None:
        """Add messages as :meth:`write` does one by one, in a fifth of the time.

        Parameters
        ----------
        channel_ids, messages
            Channel and bytes of each message.
        log_times_ns, publish_times_ns
            (k,) its times, not negative.

        Raises
        ------
        RecordingError
            As by :meth:`write`; messages before the refused chunk are in the bag.
        """
        channels = np.array(channel_ids)
        headers = np.zeros(len(messages), MESSAGE_HEADERS)
        headers["opcode"], headers["channel"] = _MESSAGE, channels
        headers["log_time"], headers["publish_time"] = log_times_ns, publish_times_ns
        sizes = np.fromiter(map(len, messages), np.int64, len(messages))
        headers["length"] = sizes + _HEADER_LENGTH
        size = MESSAGE_HEADERS.itemsize
        pieces: list[bytes] = [b""] * (2 * len(messages))
        pieces[::2] = headers.view(f"V{size}").tolist()
        pieces[1::2] = messages
        ends = np.cumsum(sizes + size)
        first = 0
        while first < len(messages):
            begin = int(ends[first - 1]) if first else 0
            # A chunk is finished after the message that makes it full.
            room = self._chunk_size - len(self._chunk) + begin
            last = min(int(np.searchsorted(ends, room)) + 1, len(messages))
            offsets = len(self._chunk) - begin + ends[first:last] - sizes[first:last] - size
            entries = np.column_stack([log_times_ns[first:last], offsets])
            for channel, places in _places_by_value(channels[first:last]):
                if channel not in self._entries:
                    raise self._explain_refusal(channel)
                self._entries[channel].frombytes(entries[places].tobytes())
            self._chunk += b"".join(pieces[2 * first : 2 * last])
            if len(self._chunk) >= self._chunk_size:
                self._finish_chunk()
            first = last

    def add_attachment(self, name: str, data: bytes, media_type: str, log_time_ns: int) -> None:
        """Put a whole file into the bag.

        ``media_type`` is such as ``application/xml``, ``log_time_ns`` when it was recorded.
        """
        self._require_open()
        attachment = Attachment(
            create_time=0, log_time=log_time_ns, name=name, media_type=media_type, data=data
        )
        self._repeated_records.append(attachment)
        with self._refusing_after_failure():
            self._file.append_attachment(attachment)

    def add_metadata(self, name: str, data: dict[str, str]) -> None:
        """Put a record of keys and values into the bag."""
        self._require_open()
        metadata = Metadata(name=name, metadata=data)
        self._repeated_records.append(metadata)
        with self._refusing_after_failure():
            self._file.append_metadata(metadata)

    def flush(self) -> None:
        """Hand the chunk in progress to the operating system: a kill loses nothing of it."""
        self._require_open()
        self._finish_chunk()

    def close(self) -> None:
        """Write pending messages and the summary, and close the file; a second call does nothing.

        Raises
        ------
        RecordingError
            The disk refused something, and no earlier call has said so.
        """
        if self._closed:
            return
        self._closed = True
        failed_before = self._refusal is not None
        failure: RecordingError | None = None
        # Each step is worth trying when the one before failed: a summary is smaller than a chunk.
        for step in (self._finish_chunk, self._append_rosbag2_metadata, self._file.finish):
            try:
                step()
            except RecordingError as error:
                failure = failure or error
        self._file.close()
        self._refuse_further_writes(self._refusal or f"The bag {self.path} is closed.")
        if failure is not None and not failed_before:
            raise failure

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def _add_schema(self, type_name: str) -> int:
        schema = Schema(
            id=len(self._file.schemas) + 1,
            data=message_definition(type_name).encode(),
            encoding="ros2msg",
            name=type_name,
        )
        self._chunk += encode(schema)
        self._file.schemas.append(schema)
        self._schema_ids[type_name] = schema.id
        return schema.id

    def _finish_chunk(self) -> None:
        if not any(self._entries.values()):
            return
        with self._refusing_after_failure():
            self._file.append_chunk(self._chunk, self._entries)
        self._chunk = bytearray()
        for entries in self._entries.values():
            del entries[:]
        if not self._closed and self._is_full():
            with self._refusing_after_failure():
                self._begin_next_file()

    def _is_full(self) -> bool:
        max_size, max_duration_ns = self._limits
        span = (self._file.end_ns or 0) - (self._file.start_ns or 0)
        return 0 < max_size <= self._file.size or 0 < max_duration_ns <= span

    def _open_first_file(self) -> McapFile:
        """Create the first file; files of one bag are not mixed with files of another."""
        asked, number = self._unsplit_path, 0
        while True:
            try:
                if any(self._limits) and not self._overwrite:
                    self._require_no_numbered_files()
                return self._open_numbered_file()
            except BagExistsError:
                if not self._next_free:
                    raise
            number += 1
            self._unsplit_path = asked.with_name(f"{asked.stem}-{number}{asked.suffix}")

    def _require_no_numbered_files(self) -> None:
        """Raise BagExistsError if numbered files of another bag with this name exist."""
        whole = self._unsplit_path
        pattern = re.compile(rf"{re.escape(whole.stem)}_\d+{re.escape(whole.suffix)}")
        with suppress(OSError):
            for name in sorted(os.listdir(whole.parent)):
                if pattern.fullmatch(name):
                    raise BagExistsError(
                        f"Cannot make the bag {whole.with_name(name)}: File exists; name another "
                        "one, or remove it."
                    )

    def check(self) -> None:
        """Check that the bag file still exists with its full size.

        Raises
        ------
        RecordingError
            The file is gone or shorter; nothing more is written.
        """
        self._require_open()
        with self._refusing_after_failure():
            self._file.check()

    def _open_numbered_file(self) -> McapFile:
        path = self._unsplit_path
        if any(self._limits):
            path = path.with_name(f"{path.stem}_{self._file_number}{path.suffix}")
        return McapFile(path, compression=self._compression, overwrite=self._overwrite)

    def _begin_next_file(self) -> None:
        """Complete the present file and begin the next one, with the same schemas and channels."""
        self._append_rosbag2_metadata()
        self._file.finish()
        self._file.close()
        for name, (channel, _, _) in self._topics.items():
            self._earlier_counts[name] += self._message_count(channel)
        schemas, channels = self._file.schemas, self._file.channels
        self._file = self._open_next_file()
        self.splits += 1
        self._append_rosbag2_metadata()
        for record in self._repeated_records:
            if isinstance(record, Attachment):
                self._file.append_attachment(record)
            else:
                self._file.append_metadata(record)
        self._file.schemas += schemas
        self._file.channels += channels
        for known in (*schemas, *channels):
            self._chunk += encode(known)

    def _open_next_file(self) -> McapFile:
        while True:
            self._file_number += 1
            try:
                return self._open_numbered_file()
            except BagExistsError:
                # A file of another bag has this number: in flight, the next number is taken.
                if self._overwrite:
                    raise

    def _append_rosbag2_metadata(self) -> None:
        topics = [
            RecordedTopic(
                name, type_name, type_hash(type_name), qos, self._message_count(channel_id)
            )
            for name, (channel_id, type_name, qos) in self._topics.items()
        ]
        self._file.append_rosbag2_metadata(topics)

    def _message_count(self, channel_id: int) -> int:
        in_progress = len(self._entries.get(channel_id, ())) // 2
        return self._file.message_counts.get(channel_id, 0) + in_progress

    def _require_open(self) -> None:
        if self._refusal is not None:
            raise RecordingError(self._refusal)

    @contextmanager
    def _refusing_after_failure(self) -> Iterator[None]:
        try:
            yield
        except RecordingError as error:
            self._refuse_further_writes(str(error))
            raise

    def _refuse_further_writes(self, reason: str) -> None:
        self._refusal = reason
        self._chunk = bytearray()
        self._entries = {}

    def _explain_refusal(self, channel_id: int) -> RecordingError:
        if self._refusal is not None:
            return RecordingError(self._refusal)
        if channel_id not in self._entries:
            return RecordingError(
                f"The bag {self.path} has no channel {channel_id}: add_topic gives the channels."
            )
        return RecordingError(
            f"The bag {self.path} takes times only as whole, non-negative numbers of nanoseconds."
        )
