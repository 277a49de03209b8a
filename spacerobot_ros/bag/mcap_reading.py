"""Reads summary and messages out of an MCAP file that is open."""

from __future__ import annotations

import os
import shlex
import struct
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import (
    AttachmentIndex,
    Channel,
    ChunkIndex,
    Footer,
    MetadataIndex,
    Schema,
    Statistics,
)
from mcap.summary import Summary
from mcap.writer import MCAP0_MAGIC
from numpy.typing import NDArray

from spacerobot_ros.bag.mcap_records import (
    RECORD_HEADER,
    Allowance,
    chunk_size,
    file_size,
    open_bag,
    parsed,
    record_at,
    records,
    records_in,
    unpacked,
)
from spacerobot_ros.errors import RecordingError

_MESSAGE = struct.Struct("<BQHIQQ")
"""Opcode, length of the rest, channel, sequence, log time, publish time."""

_MESSAGE_BODY = struct.Struct("<HIQQ")
_MESSAGE_INDEX = struct.Struct("<HI")
_FOOTER_SIZE = RECORD_HEADER.size + struct.calcsize("<QQI")
_END_OF_TIME = 2**63 - 1

_SUMMARY: dict[int, Callable[[ReadDataStream], Any]] = {
    Opcode.STATISTICS: Statistics.read,
    Opcode.SCHEMA: Schema.read,
    Opcode.CHANNEL: Channel.read,
    Opcode.ATTACHMENT_INDEX: AttachmentIndex.read,
    Opcode.CHUNK_INDEX: ChunkIndex.read,
    Opcode.METADATA_INDEX: MetadataIndex.read,
}
"""What a summary is read for; it also has its offsets, which save no time."""

RawMessage = tuple[int, int, int, bytes]
"""Channel, log time and publish time in nanoseconds, serialised message."""


# -- summary ----------------------------------------------------------------------------------


def read_summary(path: Path, file: BinaryIO) -> Summary:
    """Read schemas, channels, statistics and indexes from the end of a bag that is open.

    Raises
    ------
    RecordingError
        There is none.
    ValueError
        It is damaged, or contradicts the file.
    """
    end = file_size(file) - len(MCAP0_MAGIC) - _FOOTER_SIZE
    footer = parsed(Footer.read, record_at(file, max(end, 0), Opcode.FOOTER), max(end, 0))
    if footer.summary_start > end:
        raise ValueError(f"its summary begins at byte {footer.summary_start}, behind its end")
    summary = Summary()
    found = records(file, footer.summary_start, end) if footer.summary_start else ()
    for place, opcode, body in found:
        if opcode not in _SUMMARY:
            continue
        match parsed(_SUMMARY[opcode], body, place):
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
    """Refuse indexes by which more would be read than there is.

    Raises
    ------
    ValueError
        Two chunks overlap, or all together are too large.
    """
    allowance = Allowance(end)
    free = 0
    for index in sorted(summary.chunk_indexes, key=lambda index: index.chunk_start_offset):
        place = index.chunk_start_offset
        if place < free:
            raise ValueError(f"the chunks that its index has at byte {place} overlap")
        free = place + index.chunk_length
        allowance.take(index.uncompressed_size, place)


def indexed_records(
    file: BinaryIO, indexes: Sequence[AttachmentIndex | MetadataIndex], wanted: Opcode
) -> Iterator[tuple[int, bytes]]:
    """Go through the records that an index of a summary names, each once: its place and body.

    Raises
    ------
    ValueError
        One is not there.
    """
    for place in dict.fromkeys(index.offset for index in indexes):
        yield place, record_at(file, place, wanted)


# -- messages ---------------------------------------------------------------------------------


def messages_in_file_order(file: BinaryIO) -> Iterator[RawMessage]:
    """Go through all messages of a bag in the order they were written.

    Raises
    ------
    ValueError
        A record is damaged.
    """
    size = file_size(file)
    allowance = Allowance(size)
    for place, opcode, body in records(file, len(MCAP0_MAGIC), size):
        if opcode == Opcode.CHUNK:
            allowance.take(chunk_size(body), place)
            yield from _messages_in_chunk(unpacked(body, place), place)
        elif opcode == Opcode.MESSAGE:
            channel, _, log_ns, publish_ns = _MESSAGE_BODY.unpack_from(body)
            yield channel, log_ns, publish_ns, body[_MESSAGE_BODY.size :]
        elif opcode == Opcode.DATA_END:
            return


def _messages_in_chunk(data: bytes, place: int) -> Iterator[RawMessage]:
    for opcode, position, end in records_in(data, place):
        if opcode == Opcode.MESSAGE:
            _, _, channel, _, log_ns, publish_ns = _MESSAGE.unpack_from(data, position)
            yield channel, log_ns, publish_ns, data[position + _MESSAGE.size : end]


def messages_in_time_order(
    path: str | os.PathLike[str],
    channel_ids: set[int],
    start_ns: int = 0,
    end_ns: int = _END_OF_TIME,
    summary: Summary | None = None,
) -> Iterator[RawMessage]:
    """Go through messages of a bag by log time, those of one time in the order they were written.

    Only chunks whose times overlap are in memory together.

    Parameters
    ----------
    path
        The MCAP file.
    channel_ids
        The channels wanted.
    start_ns
        Earliest log time wanted, in nanoseconds.
    end_ns
        Latest log time wanted, in nanoseconds.
    summary
        Of the bag, where that was read before.

    Raises
    ------
    RecordingError
        There is no such bag, it is not MCAP, was cut short or is damaged.
    """
    # The largest time that the columns of this package hold: the year 2262.
    start_ns, end_ns = min(start_ns, _END_OF_TIME), min(end_ns, _END_OF_TIME)
    with open_bag(Path(path)) as file:
        summary = summary or read_summary(Path(path), file)
        indexes = summary.chunk_indexes
        if not indexes or not all(index.message_index_offsets for index in indexes):
            # Written without chunks or without message indexes.
            wanted = [
                message
                for message in messages_in_file_order(file)
                if message[0] in channel_ids and start_ns <= message[1] <= end_ns
            ]
            yield from sorted(wanted, key=lambda message: message[1])
            return
        for cluster in _clusters(summary, channel_ids, start_ns, end_ns):
            yield from _messages_of(file, cluster, channel_ids, start_ns, end_ns)


def _clusters(
    summary: Summary, channel_ids: set[int], start_ns: int, end_ns: int
) -> Iterator[list[ChunkIndex]]:
    """Group the chunks with something wanted in them: those of a group overlap in time."""
    wanted = [
        index
        for index in summary.chunk_indexes
        if not channel_ids.isdisjoint(index.message_index_offsets)
        and index.message_start_time <= end_ns
        and index.message_end_time >= start_ns
    ]
    cluster: list[ChunkIndex] = []
    latest = farthest = 0
    for index in sorted(wanted, key=lambda i: (i.message_start_time, i.chunk_start_offset)):
        start = index.message_start_time, index.chunk_start_offset
        # Of equal times the messages of chunks that were written before come first.
        if cluster and start >= (latest, farthest):
            yield cluster
            cluster = []
        cluster.append(index)
        latest = max(latest, index.message_end_time)
        farthest = max(farthest, index.chunk_start_offset)
    if cluster:
        yield cluster


def _messages_of(
    file: BinaryIO,
    cluster: Sequence[ChunkIndex],
    channel_ids: set[int],
    start_ns: int,
    end_ns: int,
) -> Iterator[RawMessage]:
    chunks, entries = [], []
    for number, index in enumerate(sorted(cluster, key=lambda i: i.chunk_start_offset)):
        chunk, pairs = _chunk_and_entries(file, index, channel_ids)
        chunks.append(chunk)
        entries.append(np.column_stack([pairs, np.full(len(pairs), number, np.uint64)]))
    table = np.concatenate(entries)
    table = table[(table[:, 0] >= start_ns) & (table[:, 0] <= end_ns)]
    order = np.lexsort((table[:, 1], table[:, 2], table[:, 0]))
    for _, position, number in table[order].tolist():
        chunk = chunks[number]
        _, length, channel, _, log_ns, publish_ns = _MESSAGE.unpack_from(chunk, position)
        end = position + RECORD_HEADER.size + length
        data = chunk[position + _MESSAGE.size : end]
        yield channel, log_ns, publish_ns, data


def _chunk_and_entries(
    file: BinaryIO, index: ChunkIndex, channel_ids: set[int]
) -> tuple[bytes, NDArray[np.uint64]]:
    """Return the records of a chunk; log time and place in it of each message wanted (N, 2).

    Raises
    ------
    ValueError
        The chunk is damaged, or its indexes name what are no messages, or some twice.
    """
    place = index.chunk_start_offset
    body = record_at(file, place, Opcode.CHUNK)
    if chunk_size(body) != index.uncompressed_size:
        raise ValueError(f"the chunk at byte {place} and its index claim different sizes")
    chunk = unpacked(body, place)
    entries = [np.empty((0, 2), np.uint64)]
    for channel, offset in index.message_index_offsets.items():
        if channel not in channel_ids:
            continue
        listed = record_at(file, offset, Opcode.MESSAGE_INDEX)
        named, size = _MESSAGE_INDEX.unpack_from(listed)
        if named != channel or size % 16 or _MESSAGE_INDEX.size + size > len(listed):
            raise ValueError(f"the message index at byte {offset} is damaged")
        pairs = np.frombuffer(listed, "<u8", size // 8, _MESSAGE_INDEX.size)
        entries.append(pairs.reshape(-1, 2))
    pairs = np.concatenate(entries)
    _check_entries(chunk, pairs[:, 1], place)
    return chunk, pairs


def _check_entries(chunk: bytes, positions: NDArray[np.uint64], place: int) -> None:
    """Refuse positions in a chunk (N,) that are not those of messages, each once.

    Raises
    ------
    ValueError
        They are not.
    """
    if not len(positions):
        return
    wrong = f"the message indexes of the chunk at byte {place} do not fit it"
    if int(positions.max()) > len(chunk) - _MESSAGE.size:
        raise ValueError(wrong)
    starts = positions.astype(np.int64)
    content = np.frombuffer(chunk, np.uint8)
    lengths = content[starts[:, np.newaxis] + np.arange(1, 9)].copy().view("<u8")[:, 0]
    if (content[starts] != Opcode.MESSAGE).any() or int(lengths.max()) > len(chunk):
        raise ValueError(wrong)
    ends = starts + RECORD_HEADER.size + lengths.astype(np.int64)
    order = np.argsort(starts)
    apart = bool((starts[order][1:] >= ends[order][:-1]).all())
    if not apart or int(ends.max()) > len(chunk) or (ends - starts < _MESSAGE.size).any():
        raise ValueError(wrong)
