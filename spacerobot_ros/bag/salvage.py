"""Makes a complete bag of one that was cut off or is damaged."""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Header, Metadata, Schema
from mcap.writer import MCAP0_MAGIC

from spacerobot_ros.bag.mcap_file import McapFile, encode
from spacerobot_ros.bag.mcap_reading import (
    decompress,
    messages_in_file_order,
    open_bag,
    read_summary,
)
from spacerobot_ros.bag.rosbag2 import METADATA_NAME, QosProfile, RecordedTopic, metadata_record
from spacerobot_ros.errors import RecordingError

_CHUNK_SIZE = 65536
_RECORD = struct.Struct("<BQ")
_CHANNEL_AND_TIME = struct.Struct("<H4xQ")
"""What a message begins with; between them is its sequence number."""

_BROKEN = (McapError, ValueError, RuntimeError, struct.error, zstandard.ZstdError)
"""What reading a damaged record raises."""


@dataclass(frozen=True)
class Salvaged:
    """What was saved of a bag, and what was not.

    Attributes
    ----------
    path
        The new bag.
    messages, duration
        Messages in it, and the time in s that they span.
    lost_chunks
        Chunks that could not be read.
    lost_bytes
        Bytes behind the last whole record, which remain in the old bag alone.
    """

    path: Path
    messages: int
    duration: float
    lost_chunks: int
    lost_bytes: int


def salvage_bag(
    path: str | os.PathLike[str], out: str | os.PathLike[str] | None = None
) -> Salvaged:
    """Write what can be read of a bag into a new, complete one; the old one stays as it is.

    ``out`` is the new file, which must not exist; by default ``NAME-salvaged.mcap`` beside the old
    one.

    Raises
    ------
    RecordingError
        There is no such bag, it is not MCAP, it is complete already, nothing in it
        can be read, or the new one cannot be written.
    """
    source = Path(path)
    target = Path(out) if out is not None else source.with_name(f"{source.stem}-salvaged.mcap")
    if is_complete(source):
        raise RecordingError(f"The bag {source} is complete: there is nothing to salvage.")
    found = _Found(source)
    first = next(found.records, None)
    if first is None:
        raise RecordingError(f"Nothing in the bag {source} can be read.")
    file = McapFile(target, compression="zstd", overwrite=False, profile=found.profile)
    try:
        copy = _Copy(file)
        copy.add(*first)
        for opcode, body in found.records:
            copy.add(opcode, body)
        copy.finish(found.profile)
    except BaseException:
        file.close()
        target.unlink(missing_ok=True)
        raise
    file.close()
    span = (file.end_ns or 0) - (file.start_ns or 0)
    return Salvaged(
        target,
        sum(file.message_counts.values()),
        span / 1e9,
        found.lost_chunks,
        found.lost_bytes,
    )


def is_complete(path: Path) -> bool:
    """Whether every message of a bag can be read and counted as it is."""
    try:
        with open_bag(path) as file:
            summary = read_summary(path, file)
            file.seek(0)
            count = sum(1 for _ in messages_in_file_order(file))
            return summary.statistics is not None and summary.statistics.message_count == count
    except RecordingError:
        return False


def _records(stream: BinaryIO, size: int) -> Iterator[tuple[int, bytes]]:
    """Go through opcode and body of the whole records of a stream."""
    while True:
        head = stream.read(_RECORD.size)
        if len(head) < _RECORD.size:
            return
        opcode, length = _RECORD.unpack(head)
        if length > size - stream.tell():
            return
        yield opcode, stream.read(length)


class _Found:
    """Opcodes and bodies of a bag's records as far as they can be read, chunks unpacked."""

    def __init__(self, path: Path) -> None:
        self.profile = "ros2"
        self.lost_chunks = self.lost_bytes = 0
        self._path = path
        self.records = self._read()

    def _read(self) -> Iterator[tuple[int, bytes]]:
        try:
            with self._path.open("rb") as file:
                size = file.seek(0, os.SEEK_END)
                file.seek(0)
                start = file.read(len(MCAP0_MAGIC))
                if start != MCAP0_MAGIC:
                    empty = start == MCAP0_MAGIC[: len(start)]
                    what = "holds nothing yet" if empty else "is not an MCAP file"
                    raise RecordingError(f"{self._path} {what}: there is nothing to salvage.")
                whole = file.tell()
                for opcode, body in _records(file, size):
                    whole = file.tell()
                    if opcode == Opcode.HEADER:
                        with suppress(*_BROKEN):
                            self.profile = Header.read(_stream(body)).profile
                    elif opcode == Opcode.CHUNK:
                        yield from self._chunk(body)
                    elif opcode == Opcode.DATA_END:
                        # The summary says nothing new.
                        return
                    else:
                        yield opcode, body
                self.lost_bytes = size - whole
        except FileNotFoundError as error:
            raise RecordingError(f"There is no bag at {self._path}.") from error
        except OSError as error:
            reason = error.strerror or error
            raise RecordingError(f"Cannot read the bag {self._path}: {reason}.") from error

    def _chunk(self, body: bytes) -> Iterator[tuple[int, bytes]]:
        try:
            data = decompress(Chunk.read(_stream(body)))
        except _BROKEN:
            self.lost_chunks += 1
            return
        yield from _records(BytesIO(data), len(data))


def _stream(body: bytes) -> ReadDataStream:
    return ReadDataStream(BytesIO(body))


class _Copy:
    """A bag that is written from the records of another."""

    def __init__(self, file: McapFile) -> None:
        self._file = file
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._chunk = bytearray()
        self._entries: dict[int, list[int]] = {}

    def add(self, opcode: int, body: bytes) -> None:
        """Take a record; one that cannot be read is left out."""
        with suppress(*_BROKEN):
            if opcode == Opcode.MESSAGE:
                self._add_message(body)
            elif opcode == Opcode.SCHEMA:
                schema = Schema.read(_stream(body))
                self._schemas[schema.id] = schema
            elif opcode == Opcode.CHANNEL:
                channel = Channel.read(_stream(body))
                self._channels[channel.id] = channel
            elif opcode == Opcode.ATTACHMENT:
                self._file.append_attachment(Attachment.read(_stream(body)))
            elif opcode == Opcode.METADATA:
                metadata = Metadata.read(_stream(body))
                if metadata.name != METADATA_NAME:
                    self._file.append_metadata(metadata)

    def finish(self, profile: str) -> None:
        """Write the last chunk, rosbag2's record and the summary."""
        self._flush()
        self._file.schemas += self._schemas.values()
        self._file.channels += self._channels.values()
        if profile == "ros2":
            self._append_rosbag2_metadata()
        self._file.finish()

    def _add_message(self, body: bytes) -> None:
        channel_id, log_time_ns = _CHANNEL_AND_TIME.unpack_from(body)
        if channel_id not in self._channels:
            return
        if channel_id not in self._entries:
            # Readers that stream find what a message needs before it.
            self._entries[channel_id] = []
            channel = self._channels[channel_id]
            if channel.schema_id in self._schemas:
                self._chunk += encode(self._schemas[channel.schema_id])
            self._chunk += encode(channel)
        self._entries[channel_id] += log_time_ns, len(self._chunk)
        self._chunk += _RECORD.pack(Opcode.MESSAGE, len(body)) + body
        if len(self._chunk) >= _CHUNK_SIZE:
            self._flush()

    def _flush(self) -> None:
        if any(self._entries.values()):
            self._file.append_chunk(self._chunk, self._entries)
            self._chunk = bytearray()
            for entries in self._entries.values():
                entries.clear()

    def _append_rosbag2_metadata(self) -> None:
        topics = []
        for channel in self._channels.values():
            words = channel.metadata
            with suppress(RecordingError):
                profiles = QosProfile.from_yaml(words.get("offered_qos_profiles", ""))
                schema = self._schemas.get(channel.schema_id)
                topics.append(
                    RecordedTopic(
                        channel.topic,
                        schema.name if schema else "",
                        words.get("topic_type_hash", ""),
                        profiles[0] if profiles else QosProfile(),
                        self._file.message_counts.get(channel.id, 0),
                    )
                )
        file = self._file
        file.append_metadata(metadata_record(file.path.name, topics, file.start_ns, file.end_ns))
