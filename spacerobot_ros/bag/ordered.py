"""Messages of a bag by log time, a chunk or a few of them at a time."""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import BinaryIO

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.records import Chunk, ChunkIndex
from mcap.summary import Summary

from spacerobot_ros.bag.mcap_reading import (
    RawMessage,
    decompress,
    messages_in_file_order,
    open_bag,
    read_summary,
)

_RECORD_HEADER_SIZE = 9
_MESSAGE_INDEX_HEADER = struct.Struct("<BQHI")
_MESSAGE = struct.Struct("<BQHIQQ")
"""Opcode, length of the rest, channel, sequence, log time, publish time."""

_LENGTH_WITHOUT_DATA = _MESSAGE.size - _RECORD_HEADER_SIZE


def messages_in_time_order(
    path: str | os.PathLike[str],
    channel_ids: set[int],
    start_ns: int = 0,
    end_ns: int = 2**63 - 1,
) -> Iterator[RawMessage]:
    """Go through messages of a bag by log time, those of one time in the order they were written.

    Only chunks whose times overlap are in memory together.

    Args:
        path: the MCAP file.
        channel_ids: the channels wanted.
        start_ns: earliest log time wanted, in nanoseconds.
        end_ns: latest log time wanted, in nanoseconds.

    Yields:
        Channel, log time, publish time, serialised message.

    Raises:
        RecordingError: there is no such bag, it is not MCAP, was cut short or is damaged.
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
    latest = 0
    for index in sorted(wanted, key=lambda i: (i.message_start_time, i.chunk_start_offset)):
        if cluster and index.message_start_time >= latest:
            yield cluster
            cluster = []
        cluster.append(index)
        latest = max(latest, index.message_end_time)
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
        file.seek(index.chunk_start_offset + _RECORD_HEADER_SIZE)
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
        begin = position + _MESSAGE.size
        data = chunk[begin : begin + length - _LENGTH_WITHOUT_DATA]
        yield channel, log_ns, publish_ns, data
