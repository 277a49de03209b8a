"""Reads records, summary and messages of an MCAP file that anybody may have written.

Values are checked before use: a record lies inside of its file, a chunk holds as much as it
claims to, and all chunks of a bag together inflate to no more than a limit. A violation is a
``ValueError`` that names the byte; :func:`open_bag` turns it into a message for users.
"""

from __future__ import annotations

import os
import shlex
import stat
import struct
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

import lz4.frame
import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import (
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    Footer,
    MetadataIndex,
    Schema,
    Statistics,
)
from mcap.summary import Summary
from mcap.writer import MCAP0_MAGIC
from numpy.typing import NDArray

from spacerobot_ros.errors import RecordingError

T = TypeVar("T")

INFLATED_SIZE_VARIABLE = "SPACEROBOT_BAG_LIMIT"
"""Environment variable: how many MB a bag may inflate to, however small its file is."""

_DEFAULT_LIMIT_MB = 32.0
"""Default limit of the inflated size of a bag, MB."""

_MAX_INFLATION_RATIO = 200
"""Largest ratio of inflated size to file size of a bag above the limit in MB. Telemetry has
3 to 40, bags made to fill the memory 1000 and more."""

RECORD_HEADER = struct.Struct("<BQ")
"""Head of an MCAP record: opcode and length of the body in bytes."""

_UINT64 = struct.Struct("<Q")

_CHUNK_HEAD = struct.Struct("<QQQI")
"""Head of an MCAP chunk: times, size and checksum of its content."""

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
    """Open a regular file for reading; never waits.

    Raises
    ------
    RecordingError
        There is no such file, it is no regular file, or it cannot be read while the context lasts.
    """
    try:
        require_regular(os.stat(path).st_mode, path)
        # A pipe may have replaced the file since the first check.
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        with open(descriptor, "rb") as file:
            require_regular(os.fstat(descriptor).st_mode, path)
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
        except MemoryError as error:
            raise RecordingError(
                f"The bag {path} is damaged: a record claims to be larger than the memory."
            ) from error
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


def records(file: BinaryIO, start: int, end: int) -> Iterator[tuple[int, int, bytes]]:
    """Iterate over the records between two bytes of a file: where each begins, opcode and body."""
    while start < end:
        file.seek(start)
        opcode, length = _read_record_header(file, start, end)
        yield start, opcode, file.read(length)
        start += RECORD_HEADER.size + length


def records_in_chunk(data: bytes, place: int) -> Iterator[tuple[int, int, int]]:
    """Iterate over the records of the unpacked chunk at ``place``: opcode, first and last byte."""
    position, size = 0, len(data)
    unpack, header = RECORD_HEADER.unpack_from, RECORD_HEADER.size
    while position < size:
        if size - position < header:
            raise ValueError(f"the chunk at byte {place} ends inside of a record")
        opcode, length = unpack(data, position)
        end = position + header + length
        if end > size:
            raise ValueError(f"a record reaches out of the chunk at byte {place}")
        if not opcode:
            # Otherwise a chunk of zeros would count as millions of records.
            raise ValueError(f"the chunk at byte {place} has records of no kind")
        yield opcode, position, end
        position = end


def read_record(file: BinaryIO, place: int, expected: Opcode) -> bytes:
    """Return the body of the record at byte ``place`` of a file, which must be of a kind."""
    end = file_size(file)
    if place + RECORD_HEADER.size > end:
        raise ValueError(f"its index names byte {place}, and it has {end} bytes")
    file.seek(place)
    opcode, length = _read_record_header(file, place, end)
    if opcode != expected:
        raise ValueError(f"the file has no {expected.name.lower()} at byte {place}")
    return file.read(length)


def _read_record_header(file: BinaryIO, place: int, end: int) -> tuple[int, int]:
    head = file.read(RECORD_HEADER.size)
    if len(head) < RECORD_HEADER.size:
        raise ValueError(f"it ends inside of the record at byte {place}")
    opcode, length = RECORD_HEADER.unpack(head)
    left = end - place - RECORD_HEADER.size
    if length > left:
        raise ValueError(
            f"the record at byte {place} claims {length} bytes, where {max(left, 0)} are left"
        )
    return opcode, length


def parse_record(read: Callable[[ReadDataStream], T], body: bytes, place: int) -> T:
    """Return the object that a class of ``mcap.records`` reads from the record at ``place``."""
    try:
        return read(ReadDataStream(BytesIO(body)))
    except DAMAGE_ERRORS as error:
        reason = str(error) or type(error).__name__
        raise ValueError(f"the record at byte {place} cannot be read ({reason})") from error


# -- chunks -----------------------------------------------------------------------------------


class InflationLimit:
    """Limit of the inflated size of all chunks of a file.

    Parameters
    ----------
    compressed
        How large the file is, in bytes.
    """

    def __init__(self, compressed: int) -> None:
        self.max_bytes = max(
            round(1e6 * _inflated_size_limit_mb()), _MAX_INFLATION_RATIO * compressed
        )
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


def _inflated_size_limit_mb() -> float:
    try:
        limit = float(os.environ.get(INFLATED_SIZE_VARIABLE, _DEFAULT_LIMIT_MB))
    except ValueError:
        return _DEFAULT_LIMIT_MB
    return limit if 0.0 < limit < 1e12 else _DEFAULT_LIMIT_MB


def chunk_size(body: bytes) -> int:
    """Return the inflated size stated in a chunk, bytes; struct.error for a truncated chunk."""
    return int(_CHUNK_HEAD.unpack_from(body)[2])


def unpack_chunk(body: bytes, place: int) -> bytes:
    """Return the records of the chunk at ``place``, of the size and checksum that it claims."""
    chunk = parse_record(Chunk.read, body, place)
    if chunk.compression not in _DECOMPRESSORS:
        raise ValueError(
            f"the compression {chunk.compression!r} of the chunk at byte {place} is unknown"
        )
    claimed = _UINT64.unpack_from(body, _CHUNK_HEAD.size + 4 + len(chunk.compression.encode()))[0]
    if claimed != len(chunk.data):
        raise ValueError(
            f"the chunk at byte {place} holds {len(chunk.data)} packed bytes, not the {claimed} "
            "that it claims"
        )
    size = chunk.uncompressed_size
    try:
        data = _DECOMPRESSORS[chunk.compression](chunk.data, size)
    except DAMAGE_ERRORS as error:
        reason = str(error) or type(error).__name__
        raise ValueError(f"the chunk at byte {place} cannot be unpacked ({reason})") from error
    if len(data) != size:
        more = "more" if len(data) > size else "less"
        raise ValueError(f"the chunk at byte {place} holds {more} than the {size} bytes it claims")
    if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
        raise ValueError(f"the checksum of the chunk at byte {place} is wrong")
    return data


def _unpack_zstd(data: bytes, size: int) -> bytes:
    if not data and not size:
        return b""
    # The library allocates as much as the frame claims.
    claimed = zstandard.frame_content_size(data)
    if claimed > size:
        raise ValueError(f"its frame claims {claimed} bytes")
    return zstandard.ZstdDecompressor().decompress(data, max_output_size=max(size, 1))


def _unpack_lz4(data: bytes, size: int) -> bytes:
    if not data and not size:
        return b""
    # One more byte shows whether the chunk is larger than stated.
    return bytes(lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size + 1))


_DECOMPRESSORS: dict[str, Callable[[bytes, int], bytes]] = {
    "zstd": _unpack_zstd,
    "lz4": _unpack_lz4,
    "": lambda data, _: data,
}
"""Decompressor by name: it takes the data and their stated size; returns one byte more at most."""


_MESSAGE_HEAD = struct.Struct("<BQHIQQ")
"""Head of a message record: opcode, length, channel, sequence, log time, publish time."""

MESSAGE_HEADERS = np.dtype(
    [
        ("opcode", "<u1"),
        ("length", "<u8"),
        ("channel", "<u2"),
        ("sequence", "<u4"),
        ("log_time", "<u8"),
        ("publish_time", "<u8"),
    ]
)
"""The same head in arrays."""

_MESSAGE_BODY = struct.Struct("<HIQQ")
_MESSAGE_INDEX_HEAD = struct.Struct("<HI")
_FOOTER_SIZE = RECORD_HEADER.size + struct.calcsize("<QQI")
_LATEST_TIME_NS = 2**63 - 1

_SUMMARY_PARSERS: dict[int, Callable[[ReadDataStream], Any]] = {
    Opcode.STATISTICS: Statistics.read,
    Opcode.SCHEMA: Schema.read,
    Opcode.CHANNEL: Channel.read,
    Opcode.ATTACHMENT_INDEX: AttachmentIndex.read,
    Opcode.CHUNK_INDEX: ChunkIndex.read,
    Opcode.METADATA_INDEX: MetadataIndex.read,
}
"""Parser of each record kind that is read from a summary."""

RawMessage = tuple[int, int, int, bytes]
"""A recorded message: channel, log time and publish time in ns, serialised bytes."""

MessageBlock = tuple[NDArray[np.uint64], NDArray[np.uint64], NDArray[np.uint64], list[bytes]]
"""N recorded messages: their channels (N,), log times (N,), publish times (N,) and bytes."""


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
    end = file_size(file) - len(MCAP0_MAGIC) - _FOOTER_SIZE
    footer = parse_record(Footer.read, read_record(file, max(end, 0), Opcode.FOOTER), max(end, 0))
    if footer.summary_start > end:
        raise ValueError(f"its summary begins at byte {footer.summary_start}, behind its end")
    summary = Summary()
    found = records(file, footer.summary_start, end) if footer.summary_start else ()
    for place, opcode, body in found:
        if opcode not in _SUMMARY_PARSERS:
            continue
        match parse_record(_SUMMARY_PARSERS[opcode], body, place):
            case Statistics() as statistics:
                summary.statistics = statistics
            case Schema() as schema:
                summary.schemas[schema.id] = schema
            case Channel() as channel:
                summary.channels[channel.id] = channel
            case AttachmentIndex() as attachment:
                summary.attachment_indexes.append(attachment)
            case ChunkIndex() as chunk:
                summary.chunk_indexes.append(chunk)
            case MetadataIndex() as metadata:
                summary.metadata_indexes.append(metadata)
    if summary.statistics is None:
        raise RecordingError(
            f"The bag {path} has no summary: 'spacerobot salvage {shlex.quote(str(path))}' makes "
            "one."
        )
    _check_chunks(summary, end)
    return summary


def _check_chunks(summary: Summary, end: int) -> None:
    """Check that the indexed chunks do not overlap, and inflate to an allowed size."""
    allowance = InflationLimit(end)
    free = 0
    for index in sorted(summary.chunk_indexes, key=lambda index: index.chunk_start_offset):
        place = index.chunk_start_offset
        if place < free:
            raise ValueError(f"the chunks that its index has at byte {place} overlap")
        free = place + index.chunk_length
        allowance.count(index.uncompressed_size, place)


def indexed_records(
    file: BinaryIO, indexes: Sequence[AttachmentIndex | MetadataIndex], opcode: Opcode
) -> Iterator[tuple[int, bytes]]:
    """Iterate over the records that an index of a summary names, each once: its place and body."""
    for place in dict.fromkeys(index.offset for index in indexes):
        yield place, read_record(file, place, opcode)


# -- messages ---------------------------------------------------------------------------------


def messages_in_file_order(file: BinaryIO) -> Iterator[RawMessage]:
    """Iterate over all messages of a bag in the order they were written."""
    size = file_size(file)
    allowance = InflationLimit(size)
    for place, opcode, body in records(file, len(MCAP0_MAGIC), size):
        if opcode == Opcode.CHUNK:
            allowance.count(chunk_size(body), place)
            yield from _messages_in_records(unpack_chunk(body, place), place)
        elif opcode == Opcode.MESSAGE:
            channel, _, log_ns, publish_ns = _MESSAGE_BODY.unpack_from(body)
            yield channel, log_ns, publish_ns, body[_MESSAGE_BODY.size :]
        elif opcode == Opcode.DATA_END:
            return


def _messages_in_records(data: bytes, place: int) -> Iterator[RawMessage]:
    for opcode, position, end in records_in_chunk(data, place):
        if opcode == Opcode.MESSAGE:
            _, _, channel, _, log_ns, publish_ns = _MESSAGE_HEAD.unpack_from(data, position)
            yield channel, log_ns, publish_ns, data[position + _MESSAGE_HEAD.size : end]


def messages_in_time_order(
    path: str | os.PathLike[str],
    channel_ids: set[int],
    start_ns: int = 0,
    end_ns: int = _LATEST_TIME_NS,
    summary: Summary | None = None,
) -> Iterator[RawMessage]:
    """Iterate over the messages of :func:`blocks_in_time_order`, one by one."""
    for block in blocks_in_time_order(path, channel_ids, start_ns, end_ns, summary):
        *numbers, messages = block
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
    # Latest time that an int64 of nanoseconds holds: the year 2262.
    start_ns, end_ns = min(start_ns, _LATEST_TIME_NS), min(end_ns, _LATEST_TIME_NS)
    with open_bag(Path(path)) as file:
        summary = summary or read_summary(Path(path), file)
        indexes = summary.chunk_indexes
        if not indexes or not all(index.message_index_offsets for index in indexes):
            # The bag has no chunks or no message indexes.
            wanted = [
                message
                for message in messages_in_file_order(file)
                if message[0] in channel_ids and start_ns <= message[1] <= end_ns
            ]
            if wanted:
                *numbers, data = zip(*sorted(wanted, key=lambda message: message[1]), strict=True)
                channels, logged, published = np.array(numbers, np.uint64)
                yield channels, logged, published, list(data)
            return
        for cluster in _overlapping_chunks(summary, channel_ids, start_ns, end_ns):
            yield _messages_in_chunks(file, cluster, channel_ids, start_ns, end_ns)


def _overlapping_chunks(
    summary: Summary, channel_ids: set[int], start_ns: int, end_ns: int
) -> Iterator[list[ChunkIndex]]:
    """Group the chunks that hold the selected messages; the chunks of a group overlap in time."""
    selected = [
        index
        for index in summary.chunk_indexes
        if not channel_ids.isdisjoint(index.message_index_offsets)
        and index.message_start_time <= end_ns
        and index.message_end_time >= start_ns
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


def _messages_in_chunks(
    file: BinaryIO,
    cluster: Sequence[ChunkIndex],
    channel_ids: set[int],
    start_ns: int,
    end_ns: int,
) -> MessageBlock:
    chunks, entries, size = [], [], 0
    for index in sorted(cluster, key=lambda i: i.chunk_start_offset):
        chunk, pairs = _chunk_and_entries(file, index, channel_ids)
        chunks.append(chunk)
        entries.append(pairs + np.array([0, size], np.uint64))
        size += len(chunk)
    table = np.concatenate(entries)
    table = table[(table[:, 0] >= start_ns) & (table[:, 0] <= end_ns)]
    order = np.lexsort((table[:, 1], table[:, 0]))
    places = table[order, 1].astype(np.int64)
    data = chunks[0] if len(chunks) == 1 else b"".join(chunks)
    content = np.frombuffer(data, np.uint8)
    within = np.arange(MESSAGE_HEADERS.itemsize)
    heads = content[places[:, np.newaxis] + within].view(MESSAGE_HEADERS)[:, 0]
    if not set(np.unique(heads["channel"]).tolist()) <= channel_ids:
        raise ValueError("a message index names messages of other channels")
    begins = places + _MESSAGE_HEAD.size
    ends = places + RECORD_HEADER.size + heads["length"].astype(np.int64)
    messages = [data[a:b] for a, b in zip(begins.tolist(), ends.tolist(), strict=True)]
    return heads["channel"], heads["log_time"], heads["publish_time"], messages


def _chunk_and_entries(
    file: BinaryIO, index: ChunkIndex, channel_ids: set[int]
) -> tuple[bytes, NDArray[np.uint64]]:
    """Return a chunk's records, and the log time and offset of each selected message (N, 2)."""
    place = index.chunk_start_offset
    body = read_record(file, place, Opcode.CHUNK)
    if chunk_size(body) != index.uncompressed_size:
        raise ValueError(f"the chunk at byte {place} and its index claim different sizes")
    chunk = unpack_chunk(body, place)
    entries = [np.empty((0, 2), np.uint64)]
    for channel, offset in index.message_index_offsets.items():
        if channel not in channel_ids:
            continue
        listed = read_record(file, offset, Opcode.MESSAGE_INDEX)
        named, size = _MESSAGE_INDEX_HEAD.unpack_from(listed)
        if named != channel or size % 16 or _MESSAGE_INDEX_HEAD.size + size > len(listed):
            raise ValueError(f"the message index at byte {offset} is damaged")
        pairs = np.frombuffer(listed, "<u8", size // 8, _MESSAGE_INDEX_HEAD.size)
        entries.append(pairs.reshape(-1, 2))
    pairs = np.concatenate(entries)
    _check_entries(chunk, pairs[:, 1], place)
    return chunk, pairs


def _check_entries(chunk: bytes, positions: NDArray[np.uint64], place: int) -> None:
    """Check that the offsets (N,) in a chunk begin messages that do not overlap."""
    if not len(positions):
        return
    wrong = f"the message indexes of the chunk at byte {place} do not fit it"
    if int(positions.max()) > len(chunk) - _MESSAGE_HEAD.size:
        raise ValueError(wrong)
    starts = positions.astype(np.int64)
    content = np.frombuffer(chunk, np.uint8)
    lengths = content[starts[:, np.newaxis] + np.arange(1, 9)].copy().view("<u8")[:, 0]
    if (content[starts] != Opcode.MESSAGE).any() or int(lengths.max()) > len(chunk):
        raise ValueError(wrong)
    ends = starts + RECORD_HEADER.size + lengths.astype(np.int64)
    order = np.argsort(starts)
    apart = bool((starts[order][1:] >= ends[order][:-1]).all())
    if not apart or int(ends.max()) > len(chunk) or (ends - starts < _MESSAGE_HEAD.size).any():
        raise ValueError(wrong)
