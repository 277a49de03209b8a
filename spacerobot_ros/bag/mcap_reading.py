"""Reads records, summary and messages of an MCAP file that anybody may have written.

The records are parsed by ``mcap``. Values are checked before use: a record lies inside of its file,
a chunk holds as much as it claims to, and all chunks of a bag together inflate to no more than a
limit. A violation is a ``ValueError`` that names the byte; :func:`open_bag` turns it into a message
for users.
"""

from __future__ import annotations

import os
import shlex
import stat
import struct
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, NamedTuple, TypeVar, cast

import lz4.frame
import numpy as np
import zstandard
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import FOOTER_SIZE
from mcap.records import (
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    Footer,
    McapRecord,
    MetadataIndex,
    Schema,
    Statistics,
)
from mcap.stream_reader import MAGIC_SIZE, StreamReader
from mcap.summary import Summary
from mcap.writer import MCAP0_MAGIC
from numpy.typing import NDArray

from spacerobot_ros.errors import RecordingError

RecordT = TypeVar("RecordT", bound=McapRecord)

INFLATED_SIZE_VARIABLE = "SPACEROBOT_BAG_LIMIT"
"""Environment variable: how many MB a bag may inflate to, however small its file is."""

_DEFAULT_LIMIT_MB = 32.0
"""Default limit of the inflated size of a bag, MB."""

_MAX_INFLATION_RATIO = 200
"""Largest ratio of inflated size to file size of a bag above the limit in MB. Telemetry has
3 to 40, bags made to fill the memory 1000 and more."""

_RECORD_HEAD = struct.Struct("<BQ")
"""Head of a record: opcode and length of the body in bytes."""

_OPCODES = set(Opcode)

DAMAGE_ERRORS = (
    McapError,
    ValueError,
    OverflowError,
    RuntimeError,
    MemoryError,
    struct.error,
    zstandard.ZstdError,
)
"""Exceptions of reading a damaged record: the libraries have no common base class."""


# -- files ------------------------------------------------------------------------------------

_FILE_KINDS = (
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISFIFO, "a pipe"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)


def require_regular(mode: int, path: Path, action: str = "read") -> None:
    """Raise RecordingError unless a file is regular: pipes block, devices may be damaged."""
    if not stat.S_ISREG(mode):
        kind = next((words for test, words in _FILE_KINDS if test(mode)), "no file")
        raise RecordingError(f"Cannot {action} the bag {path}: it is {kind}.")


@contextmanager
def open_file(path: Path) -> Iterator[BinaryIO]:
    """Open a regular file for reading.

    Raises
    ------
    RecordingError
        There is no such file, it is no regular file, or it cannot be read while the context lasts.
    """
    try:
        require_regular(os.stat(path).st_mode, path)
        with path.open("rb") as file:
            yield file
    except FileNotFoundError as error:
        raise RecordingError(f"There is no bag at {path}.") from error
    except OSError as error:
        raise RecordingError(f"Cannot read the bag {path}: {error.strerror or error}.") from error


@contextmanager
def open_bag(path: Path) -> Iterator[BinaryIO]:
    """Open a complete bag; turn every defect of it into an error of one sentence.

    Raises
    ------
    RecordingError
        There is no such file, it cannot be read, is not MCAP, was cut short, or a record turns out
        damaged while the context lasts.
    """
    with open_file(path) as file:
        try:
            _require_magic_bytes(path, file)
            yield file
        except DAMAGE_ERRORS as error:
            reason = str(error) or type(error).__name__
            raise RecordingError(f"The bag {path} is damaged: {reason}.") from error


def _require_magic_bytes(path: Path, file: BinaryIO) -> None:
    size = len(MCAP0_MAGIC)
    start = file.read(size)
    if not start:
        raise RecordingError(f"The bag {path} is empty: its writer was stopped before it began.")
    if start != MCAP0_MAGIC[: len(start)]:
        raise RecordingError(f"{path} is not an MCAP file.")
    length = file.seek(0, os.SEEK_END)
    file.seek(max(length - size, 0))
    if length < 2 * size or file.read(size) != MCAP0_MAGIC:
        raise RecordingError(
            f"The bag {path} was cut short, its writer having been killed or its disk full: "
            f"'spacerobot salvage {shlex.quote(str(path))}' makes a complete bag of its content."
        )
    file.seek(0)


def file_size(file: BinaryIO) -> int:
    """Return the size of an open file in bytes, leaving its read position."""
    place = file.tell()
    size = file.seek(0, os.SEEK_END)
    file.seek(place)
    return size


# -- records ----------------------------------------------------------------------------------


def records(file: BinaryIO, start: int) -> Iterator[tuple[int, int, bytes]]:
    """Iterate over the records from a byte on: where each begins, its opcode, all of its bytes."""
    end = file_size(file)
    while start < end:
        file.seek(start)
        head = file.read(_RECORD_HEAD.size)
        if len(head) < _RECORD_HEAD.size:
            raise ValueError(f"it ends inside of the record at byte {start}")
        opcode, length = _RECORD_HEAD.unpack(head)
        left = end - start - len(head)
        if length > left:
            raise ValueError(
                f"the record at byte {start} claims {length} bytes, where {left} are left"
            )
        yield start, opcode, head + file.read(length)
        start += len(head) + length


def records_in_chunk(data: bytes, place: int) -> Iterator[tuple[int, int]]:
    """Iterate over the records of the unpacked chunk at ``place``: first byte and end of each."""
    position, size = 0, len(data)
    unpack, head = _RECORD_HEAD.unpack_from, _RECORD_HEAD.size
    while position < size:
        if size - position < head:
            raise ValueError(f"the chunk at byte {place} ends inside of a record")
        opcode, length = unpack(data, position)
        end = position + head + length
        if end > size:
            raise ValueError(f"a record reaches out of the chunk at byte {place}")
        if not opcode:
            # Otherwise a chunk of zeros would count as millions of records.
            raise ValueError(f"the chunk at byte {place} has records of no kind")
        yield position, end
        position = end


def parse_record(record: bytes, place: int) -> McapRecord | None:
    """Return the record at ``place``, a chunk still packed; None for a kind that MCAP lacks."""
    if record[0] not in _OPCODES:
        return None
    try:
        return next(StreamReader(BytesIO(record), skip_magic=True, emit_chunks=True).records)
    except DAMAGE_ERRORS as error:
        reason = str(error) or type(error).__name__
        raise ValueError(f"the record at byte {place} cannot be read ({reason})") from error


def read_record(file: BinaryIO, place: int, kind: type[RecordT]) -> RecordT:
    """Return the record at byte ``place`` of a file, which must be of a kind."""
    for _, _, record in records(file, place):
        found = parse_record(record, place)
        if isinstance(found, kind):
            return found
        break
    raise ValueError(f"the file has no {kind.__name__} record at byte {place}")


# -- chunks -----------------------------------------------------------------------------------


class ChunkUnpacker:
    """Unpacks the chunks of a file, up to a limit of the inflated size of all together.

    Parameters
    ----------
    compressed
        How large the file is, in bytes.
    """

    def __init__(self, compressed: int) -> None:
        limit_mb = _DEFAULT_LIMIT_MB
        with suppress(ValueError):
            given = float(os.environ.get(INFLATED_SIZE_VARIABLE, limit_mb))
            limit_mb = given if 0.0 < given < 1e12 else limit_mb
        self.max_bytes = max(round(1e6 * limit_mb), _MAX_INFLATION_RATIO * compressed)
        """Largest inflated size of all chunks together, bytes."""
        self._inflated_size = 0

    def count(self, size: int, place: int) -> None:
        """Count the inflated size of the chunk at ``place``; ValueError if the sum is too large."""
        if self._inflated_size + size > self.max_bytes:
            raise ValueError(
                f"with the chunk at byte {place} it inflates to {self._inflated_size + size} "
                f"bytes, more than the {self.max_bytes} that its size allows (set "
                f"{INFLATED_SIZE_VARIABLE} to more MB if you trust it)"
            )
        self._inflated_size += size

    def unpack(self, chunk: Chunk, place: int) -> bytes:
        """Return the records of the chunk at ``place``, of the size and checksum that it claims."""
        size = chunk.uncompressed_size
        self.count(size, place)
        if chunk.compression not in _DECOMPRESSORS:
            raise ValueError(
                f"the compression {chunk.compression!r} of the chunk at byte {place} is unknown"
            )
        try:
            # One more byte shows whether the chunk is larger than stated.
            data = _DECOMPRESSORS[chunk.compression](chunk.data, size + 1) if size else chunk.data
        except DAMAGE_ERRORS as error:
            reason = str(error) or type(error).__name__
            raise ValueError(f"the chunk at byte {place} cannot be unpacked ({reason})") from error
        if len(data) != size:
            raise ValueError(f"the chunk at byte {place} does not hold the {size} bytes it claims")
        if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
            raise ValueError(f"the checksum of the chunk at byte {place} is wrong")
        return data


_DECOMPRESSORS: dict[str, Callable[[bytes, int], bytes]] = {
    "zstd": lambda data, most: zstandard.ZstdDecompressor().stream_reader(data).read(most),
    "lz4": lambda data, most: lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=most),
    "": lambda data, _: data,
}
"""Decompressor by name: it takes the data and how many bytes it returns at most."""


# -- summary ----------------------------------------------------------------------------------


def read_summary(path: Path, file: BinaryIO) -> Summary:
    """Read schemas, channels, statistics and indexes from the end of a bag that is open.

    Raises
    ------
    RecordingError
        The bag has no summary.
    ValueError
        The summary is damaged, or contradicts the file.
    """
    size = file_size(file)
    start = read_record(file, max(size - FOOTER_SIZE - MAGIC_SIZE, 0), Footer).summary_start
    if start > size:
        raise ValueError(f"its summary begins at byte {start}, behind its end")
    summary, chunks = Summary(), ChunkUnpacker(size)
    for place, _, record in records(file, start) if start else ():
        match parse_record(record, place):
            case Statistics() as statistics:
                summary.statistics = statistics
            case Schema() as schema:
                summary.schemas[schema.id] = schema
            case Channel() as channel:
                summary.channels[channel.id] = channel
            case AttachmentIndex() as attachment:
                summary.attachment_indexes.append(attachment)
            case ChunkIndex() as chunk:
                chunks.count(chunk.uncompressed_size, chunk.chunk_start_offset)
                summary.chunk_indexes.append(chunk)
            case MetadataIndex() as metadata:
                summary.metadata_indexes.append(metadata)
            case Footer():
                break
    if summary.statistics is None:
        raise RecordingError(
            f"The bag {path} has no summary: 'spacerobot salvage {shlex.quote(str(path))}' makes "
            "one."
        )
    return summary


# -- messages ---------------------------------------------------------------------------------

RawMessage = tuple[int, int, int, bytes]
"""A recorded message: channel, log time and publish time in ns, serialised bytes."""

MessageBlock = tuple[NDArray[np.uint64], NDArray[np.uint64], NDArray[np.uint64], list[bytes]]
"""N recorded messages: their channels (N,), log times (N,), publish times (N,) and bytes."""

_MESSAGE_HEADS = np.dtype(
    [
        ("opcode", "<u1"),
        ("length", "<u8"),
        ("channel", "<u2"),
        ("sequence", "<u4"),
        ("log_time", "<u8"),
        ("publish_time", "<u8"),
    ]
)
_LATEST_TIME_NS = 2**63 - 1
"""Latest time that an int64 of nanoseconds holds: the year 2262."""


class _Wanted(NamedTuple):
    """The messages to read: their channels, and their earliest and latest log time in ns."""

    channel_ids: set[int]
    start_ns: int
    end_ns: int


def blocks_in_file_order(file: BinaryIO, wanted: _Wanted | None = None) -> Iterator[MessageBlock]:
    """Iterate over messages of a bag in the order they were written, chunk by chunk."""
    chunks = ChunkUnpacker(file_size(file))
    for place, opcode, record in records(file, MAGIC_SIZE):
        if opcode == Opcode.CHUNK:
            chunk = cast("Chunk", parse_record(record, place))
            yield _messages_in(chunks.unpack(chunk, place), place, wanted)
        elif opcode == Opcode.MESSAGE:
            yield _messages_in(record, place, wanted)
        elif opcode == Opcode.DATA_END:
            return


def _messages_in(data: bytes, place: int, wanted: _Wanted | None = None) -> MessageBlock:
    """Return the messages among the records of the chunk at ``place``, in their order."""
    found = [a for a, _ in records_in_chunk(data, place) if data[a] == Opcode.MESSAGE]
    begins, size = np.array(found, np.int64), _MESSAGE_HEADS.itemsize
    within = begins[:, np.newaxis] + np.arange(size)
    heads = np.frombuffer(data, np.uint8).take(within, mode="clip").view(_MESSAGE_HEADS)[:, 0]
    if (heads["length"] < size - _RECORD_HEAD.size).any():
        raise ValueError(f"a message of the chunk at byte {place} is shorter than its head")
    if wanted is not None:
        rows = np.flatnonzero(
            np.isin(heads["channel"], list(wanted.channel_ids))
            & (heads["log_time"] >= wanted.start_ns)
            & (heads["log_time"] <= wanted.end_ns)
        )
        heads, begins = heads[rows], begins[rows]
    ends = begins + _RECORD_HEAD.size + heads["length"].astype(np.int64)
    spans = zip((begins + size).tolist(), ends.tolist(), strict=True)
    messages = [data[a:b] for a, b in spans]
    return heads["channel"], heads["log_time"], heads["publish_time"], messages


def messages_of(blocks: Iterable[MessageBlock]) -> Iterator[RawMessage]:
    """Iterate over the messages of blocks, one by one."""
    for *numbers, messages in blocks:
        yield from zip(*(each.tolist() for each in numbers), messages, strict=True)


def blocks_in_time_order(
    path: str | os.PathLike[str],
    channel_ids: set[int],
    start_ns: int = 0,
    end_ns: int = _LATEST_TIME_NS,
    summary: Summary | None = None,
) -> Iterator[MessageBlock]:
    """Iterate over messages of a bag by log time, those of one time in the order they were written.

    Each block has the messages of chunks whose times overlap; only these are in memory together.

    Parameters
    ----------
    path
        The MCAP file; errors are those of :func:`open_bag`.
    channel_ids
        The channels to read.
    start_ns, end_ns
        Earliest and latest log time to read, in nanoseconds.
    summary
        Summary of the bag, where that was read before.
    """
    wanted = _Wanted(channel_ids, min(start_ns, _LATEST_TIME_NS), min(end_ns, _LATEST_TIME_NS))
    with open_bag(Path(path)) as file:
        summary = summary or read_summary(Path(path), file)
        if not summary.chunk_indexes:
            yield _in_time_order(blocks_in_file_order(file, wanted))
        for cluster in _overlapping_chunks(summary.chunk_indexes, wanted):
            cluster.sort(key=lambda index: index.chunk_start_offset)
            yield _in_time_order(_messages_of_chunk(file, index, wanted) for index in cluster)


def _in_time_order(blocks: Iterable[MessageBlock]) -> MessageBlock:
    """Merge blocks into one by log time; messages of one time keep their order."""
    empty = np.zeros(0, np.uint64)
    parts = list(zip((empty, empty, empty, []), *blocks, strict=True))
    channels, log_times, publish_times = map(np.concatenate, parts[:3])
    order = np.argsort(log_times, kind="stable")
    messages = [message for part in parts[3] for message in part]
    data = [messages[k] for k in order.tolist()]
    return channels[order], log_times[order], publish_times[order], data


def _overlapping_chunks(
    indexes: Sequence[ChunkIndex], wanted: _Wanted
) -> Iterator[list[ChunkIndex]]:
    """Group the chunks that may hold the messages; those of a group overlap in time."""
    selected = [
        index
        for index in indexes
        if not (
            index.message_index_offsets
            and wanted.channel_ids.isdisjoint(index.message_index_offsets)
        )
        and index.message_start_time <= wanted.end_ns
        and index.message_end_time >= wanted.start_ns
    ]
    cluster: list[ChunkIndex] = []
    latest = farthest = 0
    for index in sorted(selected, key=lambda i: (i.message_start_time, i.chunk_start_offset)):
        start = index.message_start_time, index.chunk_start_offset
        # Among messages of equal time, those of earlier chunks come first.
        if cluster and start >= (latest, farthest):
            yield cluster
            cluster = []
        cluster.append(index)
        latest = max(latest, index.message_end_time)
        farthest = max(farthest, index.chunk_start_offset)
    if cluster:
        yield cluster


def _messages_of_chunk(file: BinaryIO, index: ChunkIndex, wanted: _Wanted) -> MessageBlock:
    place = index.chunk_start_offset
    chunk = read_record(file, place, Chunk)
    if chunk.uncompressed_size != index.uncompressed_size:
        raise ValueError(f"the chunk at byte {place} and its index claim different sizes")
    return _messages_in(ChunkUnpacker(file_size(file)).unpack(chunk, place), place, wanted)
