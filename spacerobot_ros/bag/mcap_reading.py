"""Reads the records of an MCAP file, and says in one sentence what is wrong with it."""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

import lz4.frame
import zstandard
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Chunk, DataEnd, Message
from mcap.stream_reader import StreamReader
from mcap.summary import Summary
from mcap.writer import MCAP0_MAGIC

from spacerobot_ros.bag.errors import RecordingError

# Each takes the compressed data and how large they were.
_DECOMPRESSORS: dict[str, Callable[[bytes, int], bytes]] = {
    "zstd": zstandard.decompress,
    "lz4": lambda data, _: bytes(lz4.frame.decompress(data)),
    "": lambda data, _: data,
}
_RECORD_HEADER = struct.Struct("<BQ")
_MESSAGE_HEADER = struct.Struct("<HIQQ")

RawMessage = tuple[int, int, int, bytes]
"""Channel, log time and publish time in nanoseconds, serialised message."""


@contextmanager
def open_bag(path: Path) -> Iterator[BinaryIO]:
    """Open a bag that is complete, and turn what is found wrong with it into one sentence.

    Args:
        path: the MCAP file.

    Yields:
        The file.

    Raises:
        RecordingError: there is no such file, it cannot be read, is not MCAP, was cut short, or a
            record turns out damaged while the context lasts.
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
    """Read the summary at the end of a bag.

    Args:
        path: the bag, for the sentence.
        file: the same, open.

    Returns:
        Its schemas, channels, statistics and indexes.

    Raises:
        RecordingError: there is none.
    """
    summary = SeekingReader(file).get_summary()
    if summary is None or summary.statistics is None:
        raise RecordingError(
            f"The bag {path} has no summary: 'spacerobot salvage {path}' makes one."
        )
    return summary


def messages_in_file_order(file: BinaryIO) -> Iterator[RawMessage]:
    """Go through all messages of a bag in the order in which they were written.

    Args:
        file: the bag, open at its start.

    Yields:
        Channel, log time, publish time, serialised message.

    Raises:
        ValueError: a chunk is damaged.
    """
    for record in StreamReader(file, emit_chunks=True).records:
        if isinstance(record, Chunk):
            yield from _messages_in_chunk(decompress(record))
        elif isinstance(record, Message):
            yield record.channel_id, record.log_time, record.publish_time, record.data
        elif isinstance(record, DataEnd):
            return


def decompress(chunk: Chunk) -> bytes:
    """Give the records of a chunk.

    Raises:
        ValueError: its checksum or its compression is wrong.
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
        body = position + _RECORD_HEADER.size
        position = body + length
        if opcode == Opcode.MESSAGE:
            channel_id, _, log_time_ns, publish_time_ns = _MESSAGE_HEADER.unpack_from(data, body)
            message = data[body + _MESSAGE_HEADER.size : position]
            yield channel_id, log_time_ns, publish_time_ns, message
