"""Reads messages out of an MCAP file, and says in one sentence what is wrong with it."""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

import lz4.frame
import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Chunk, ChunkIndex, DataEnd, Message
from mcap.stream_reader import StreamReader
from mcap.summary import Summary
from mcap.writer import MCAP0_MAGIC

from spacerobot_ros.errors import RecordingError

# Each takes the compressed data and how large they were.
_DECOMPRESSORS: dict[str, Callable[[bytes, int], bytes]] = {
    "zstd": zstandard.decompress,
    "lz4": lambda data, _: bytes(lz4.frame.decompress(data)),
    "": lambda data, _: data,
}
_RECORD_HEADER = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<BQHIQQ")
"""Opcode, length of the rest, channel, sequence, log time, publish time."""

_MESSAGE_INDEX_HEADER = struct.Struct("<BQHI")

RawMessage = tuple[int, int, int, bytes]
"""Channel, log time and publish time in nanoseconds, serialised message."""


@contextmanager
def open_bag(path: Path) -> Iterator[BinaryIO]:
    """Open a bag that is complete, and turn what is found wrong with it into one sentence.

    Raises
    ------
    RecordingError
        There is no such file, it cannot be read, is not MCAP, was cut short, or a record turns out
        damaged while the context lasts.
    """
    try:
        with path.open("rb") as file:
            _require_both_ends(path, file)
            yield file
    except FileNotFoundError as error:
        raise RecordingError(f"There is no bag at {path}.") from error
    except OSError as error:
        raise RecordingError(f"Cannot read the bag {path}: {error.strerror or error}.") from error
    except MemoryError as error:
        raise RecordingError(
            f"The bag {path} is damaged: a record claims to be larger than the memory."
        ) from error
    # The decompressors and the MCAP library have no error in common.
    except (McapError, ValueError, RuntimeError, struct.error, zstandard.ZstdError) as error:
        reason = str(error) or type(error).__name__
        raise RecordingError(f"The bag {path} is damaged: {reason}.") from error


def _require_both_ends(path: Path, file: BinaryIO) -> None:
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
            f"'spacerobot salvage {path}' makes a complete bag of what is in it."
        )
    file.seek(0)


def read_summary(path: Path, file: BinaryIO) -> Summary:
    """Read schemas, channels, statistics and indexes from the end of a bag that is open.

    Raises
    ------
    RecordingError
        There is none.
    """
    summary = SeekingReader(file).get_summary()
    if summary is None or summary.statistics is None:
        raise RecordingError(
            f"The bag {path} has no summary: 'spacerobot salvage {path}' makes one."
        )
    return summary


def messages_in_file_order(file: BinaryIO) -> Iterator[RawMessage]:
    """Go through all messages of a bag, open at its start, in the order they were written.

    Raises
    ------
    ValueError
        A chunk is damaged.
    """
    for record in StreamReader(file, emit_chunks=True).records:
        if isinstance(record, Chunk):
            yield from _messages_in_chunk(decompress(record))
        elif isinstance(record, Message):
            yield record.channel_id, record.log_time, record.publish_time, record.data
        elif isinstance(record, DataEnd):
            return


def decompress(chunk: Chunk) -> bytes:
    """Return the records of a chunk.

    Raises
    ------
    ValueError
        Its checksum or its compression is wrong.
    """
    if chunk.compression not in _DECOMPRESSORS:
        raise ValueError(f"the compression {chunk.compression!r} is unknown")
    data = _DECOMPRESSORS[chunk.compression](chunk.data, chunk.uncompressed_size)
    if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
        raise ValueError("the checksum of a chunk is wrong")
    return data


def _messages_in_chunk(data: bytes) -> Iterator[RawMessage]:
    position = 0
    while position < len(data):
        opcode, length = _RECORD_HEADER.unpack_from(data, position)
        end = position + _RECORD_HEADER.size + length
        if opcode == Opcode.MESSAGE:
            _, _, channel, _, log_ns, publish_ns = _MESSAGE.unpack_from(data, position)
            yield channel, log_ns, publish_ns, data[position + _MESSAGE.size : end]
        position = end


def messages_in_time_order(
    path: str | os.PathLike[str],
    channel_ids: set[int],
    start_ns: int = 0,
    end_ns: int = 2**63 - 1,
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

    Raises
    ------
    RecordingError
        There is no such bag, it is not MCAP, was cut short or is damaged.
    """
    with open_bag(Path(path)) as file:
        summary = read_summary(Path(path), file)
        indexes = summary.chunk_indexes
        if not indexes or not all(index.message_index_offsets for index in indexes):
            # Written without chunks or without message indexes.
            file.seek(0)
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
        file.seek(index.chunk_start_offset + _RECORD_HEADER.size)
        chunks.append(decompress(Chunk.read(ReadDataStream(file))))
        for channel, offset in index.message_index_offsets.items():
            if channel in channel_ids:
                file.seek(offset)
                size = _MESSAGE_INDEX_HEADER.unpack(file.read(_MESSAGE_INDEX_HEADER.size))[3]
                pairs = np.frombuffer(file.read(size), "<u8").reshape(-1, 2)
                entries.append(np.column_stack([pairs, np.full(len(pairs), number, np.uint64)]))
    table = np.concatenate(entries)
    table = table[(table[:, 0] >= start_ns) & (table[:, 0] <= end_ns)]
    order = np.lexsort((table[:, 1], table[:, 2], table[:, 0]))
    for _, position, number in table[order].tolist():
        chunk = chunks[number]
        _, length, channel, _, log_ns, publish_ns = _MESSAGE.unpack_from(chunk, position)
        end = position + _RECORD_HEADER.size + length
        data = chunk[position + _MESSAGE.size : end]
        yield channel, log_ns, publish_ns, data
