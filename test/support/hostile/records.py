"""Bags put together record by record, and what claims to be one."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import lz4.frame
from mcap.data_stream import RecordBuilder
from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Message,
    MessageIndex,
    Schema,
    Statistics,
)
from mcap.writer import MCAP0_MAGIC

MOST = 2**64 - 1
GIB = 2**30
SEPARATOR = "=" * 80 + "\n"

CASES: dict[str, Callable[[], bytes]] = {}
"""Makers of bags by name."""


# -- records ----------------------------------------------------------------------------------


def encoded(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return bytes(builder.end())


def raw(opcode: int, body: bytes, length: int | None = None) -> bytes:
    return struct.pack("<BQ", opcode, len(body) if length is None else length) + body


STRING = Schema(id=1, data=b"string data\n", encoding="ros2msg", name="std_msgs/msg/String")


def string(text: str | bytes) -> bytes:
    data = (text if isinstance(text, bytes) else text.encode()) + b"\0"
    return b"\0\1\0\0" + struct.pack("<I", len(data)) + data


def channel(number: int = 1, topic: str = "/a", **metadata: str) -> Channel:
    return Channel(
        id=number, topic=topic, message_encoding="cdr", metadata=dict(metadata), schema_id=1
    )


def message(data: bytes, time_ns: int = 5, number: int = 1) -> bytes:
    return encoded(Message(number, time_ns, data, time_ns, 0))


@dataclass
class Part:
    """A chunk on its way into a bag, and what is said of it."""

    compression: str
    data: bytes
    size: int
    """Claimed by the chunk."""
    indexed_size: int | None = None
    """Claimed by its index; None: the same."""
    entries: list[tuple[int, int]] = field(default_factory=lambda: [(5, 0)])
    times: tuple[int, int] = (5, 5)


def plain(*parts: bytes, **options: Any) -> Part:
    data = b"".join(parts)
    return Part("", data, len(data), **options)


def bag(
    *chunks: Part,
    schema: Schema = STRING,
    channels: list[Channel] | None = None,
    statistics: dict[str, Any] | None = None,
    records: bytes = b"",
    summary: bytes = b"",
    footer: Footer | None = None,
    chunk_offset: int | None = None,
    index_offset: int | None = None,
    index_size: int | None = None,
    repeat: int = 1,
) -> bytes:
    """Return a bag of chunks, with whatever is wrong with it."""
    known = channels or [channel()]
    out = bytearray(MCAP0_MAGIC + encoded(Header("ros2", "hostile")) + records)
    out += encoded(schema)
    for each in known[:10]:
        out += encoded(each)
    indexes = []
    for part in chunks:
        start = len(out)
        out += encoded(Chunk(part.compression, part.data, *part.times[::-1], 0, part.size))
        length = len(out) - start
        offset = len(out)
        index = bytearray(encoded(MessageIndex(1, part.entries)))
        if index_size is not None:
            index[11:15] = struct.pack("<I", index_size)
        out += index
        claimed = part.size if part.indexed_size is None else part.indexed_size
        indexes += [
            encoded(
                ChunkIndex(
                    chunk_length=length,
                    chunk_start_offset=start if chunk_offset is None else chunk_offset,
                    compression=part.compression,
                    compressed_size=len(part.data),
                    message_end_time=part.times[1],
                    message_index_length=len(index),
                    message_index_offsets={1: offset if index_offset is None else index_offset},
                    message_start_time=part.times[0],
                    uncompressed_size=claimed,
                )
            )
        ] * repeat
    out += encoded(DataEnd(0))
    start = len(out)
    out += encoded(schema) + b"".join(map(encoded, known))
    counted: dict[str, Any] = {
        "attachment_count": 0,
        "channel_count": len(known),
        "channel_message_counts": {1: len(chunks)},
        "chunk_count": len(chunks),
        "message_count": len(chunks),
        "message_start_time": 5,
        "message_end_time": 5,
        "metadata_count": 0,
        "schema_count": 1,
    }
    out += encoded(Statistics(**(counted | (statistics or {}))))
    out += b"".join(indexes) + summary
    out += encoded(footer or Footer(start, 0, 0))
    return bytes(out + MCAP0_MAGIC)


GOOD = plain(message(string("x")))


# -- what inflates ----------------------------------------------------------------------


def zstd_zeros(size: int, *, claims: int | None = None) -> bytes:
    """Return a zstd frame of so many zeros, in blocks of four bytes for 128 KiB each."""
    known = claims is not None
    frame = bytearray(b"\x28\xb5\x2f\xfd")
    frame += b"\xc0" if known else b"\x00"
    frame += b"\x38"  # A window of 128 KiB.
    if known:
        frame += struct.pack("<Q", claims)
    block = 128 * 1024
    count = size // block
    body = struct.pack("<I", block << 3 | 1 << 1)[:3] + b"\0"
    last = struct.pack("<I", block << 3 | 1 << 1 | 1)[:3] + b"\0"
    return bytes(frame + body * (count - 1) + last)


def lz4_zeros(size: int) -> bytes:
    """Return an lz4 frame of so many zeros, in blocks of 16 kB for 4 MiB each."""
    block = 4 * 2**20
    whole = lz4.frame.compress(
        bytes(block), block_size=lz4.frame.BLOCKSIZE_MAX4MB, block_linked=False, store_size=False
    )
    return bytes(whole[:7] + whole[7:-4] * (size // block) + whole[-4:])
