"""Bags that were made to harm their reader, and a program that has the package read them.

Run as a program it makes each bag, and has a process of its own do everything to it that the
package does with bags, one after the other; it prints a line of JSON for each: how it ended,
processor time and peak memory.
"""

from __future__ import annotations

import contextlib
import json
import os
import resource
import signal
import struct
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import lru_cache
from io import BytesIO
from pathlib import Path
from typing import Any

import lz4.frame
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.reader import make_reader
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Message,
    MessageIndex,
    MetadataIndex,
    Schema,
    Statistics,
)
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer

REFERENCE = Path(__file__).parents[2] / "bags" / "sliding_masses.mcap"
MOST = 2**64 - 1
GIB = 2**30
TIME_LIMIT = 10.0
MEMORY_LIMIT_MB = 500.0
SEPARATOR = "=" * 80 + "\n"

CASES: dict[str, Callable[[], bytes]] = {}
"""Makers of bags by name."""


def case(name: str) -> Callable[[Callable[[], bytes]], Callable[[], bytes]]:
    def register(make: Callable[[], bytes]) -> Callable[[], bytes]:
        assert name not in CASES
        CASES[name] = make
        return make

    return register


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


# -- chunks that inflate ----------------------------------------------------------------------


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


@case("zstd: 6 GiB in 197 kB, claimed")
def _() -> bytes:
    return bag(Part("zstd", zstd_zeros(6 * GIB, claims=6 * GIB), 6 * GIB))


@case("zstd: 6 GiB in 197 kB, claimed by the chunk alone")
def _() -> bytes:
    return bag(Part("zstd", zstd_zeros(6 * GIB), 6 * GIB))


@case("zstd: 6 GiB in 197 kB, 1000 bytes claimed")
def _() -> bytes:
    return bag(Part("zstd", zstd_zeros(6 * GIB), 1000))


@case("zstd: 6 GiB claimed by the frame, 1000 bytes by the chunk")
def _() -> bytes:
    return bag(Part("zstd", zstd_zeros(6 * GIB, claims=6 * GIB), 1000))


@case("zstd: 6 GiB claimed by the chunk, 1000 bytes by its index")
def _() -> bytes:
    return bag(Part("zstd", zstd_zeros(6 * GIB, claims=6 * GIB), 6 * GIB, 1000))


@case("zstd: a frame that claims 2^62 bytes")
def _() -> bytes:
    return bag(Part("zstd", zstd_zeros(GIB, claims=2**62), 2**62))


@case("zstd: two hundred chunks of 60 MB")
def _() -> bytes:
    each = Part("zstd", zstd_zeros(60 * 2**20, claims=60 * 2**20), 60 * 2**20)
    return bag(*[each] * 200)


@case("zstd: 60 MB of zeros, which is allowed")
def _() -> bytes:
    return bag(Part("zstd", zstd_zeros(60 * 2**20, claims=60 * 2**20), 60 * 2**20))


@case("lz4: 1 GiB in 4 MB, claimed")
def _() -> bytes:
    return bag(Part("lz4", lz4_zeros(GIB), GIB))


@case("lz4: 1 GiB in 4 MB, 1000 bytes claimed")
def _() -> bytes:
    return bag(Part("lz4", lz4_zeros(GIB), 1000))


for _size in (MOST, 2**63, 2**63 - 1, 2**40):

    def _sized(size: int = _size) -> Callable[[str], Callable[[], bytes]]:
        whole = message(string("x"))
        data = {
            "zstd": zstandard.compress(whole),
            "lz4": lz4.frame.compress(whole),
            "": whole,
        }
        return lambda name: lambda: bag(Part(name, data[name], size))

    for _name in ("zstd", "lz4", ""):
        CASES[f"{_name or 'no compression'}: a chunk claims {_size} bytes"] = _sized()(_name)


@case("a compression of no name")
def _() -> bytes:
    return bag(Part("\u202erar", message(string("x")), 100))


@case("a chunk of noise")
def _() -> bytes:
    return bag(Part("zstd", bytes(range(256)), 1000))


@case("an empty chunk")
def _() -> bytes:
    return bag(Part("zstd", b"", 0))


@case("chunks in a chunk")
def _() -> bytes:
    inner = encoded(Chunk("zstd", zstd_zeros(6 * GIB, claims=6 * GIB), 5, 5, 0, 6 * GIB))
    return bag(plain(message(string("x")), inner))


@case("one chunk, a thousand times in the index")
def _() -> bytes:
    size = 60 * 2**20
    return bag(Part("zstd", zstd_zeros(size, claims=size), size), repeat=1000)


@case("one small chunk, ten thousand times in the index")
def _() -> bytes:
    return bag(plain(message(string("x" * 50_000))), repeat=10_000)


# -- places and lengths -----------------------------------------------------------------------

GOOD = plain(message(string("x")))


@case("a record of 2^64 - 1 bytes")
def _() -> bytes:
    return bag(GOOD, records=raw(0x0C, b"xyz", MOST))


@case("a record of 2^63 bytes in the summary")
def _() -> bytes:
    return bag(GOOD, summary=raw(0x04, b"xyz", 2**63))


@case("a chunk at byte 2^64 - 1")
def _() -> bytes:
    return bag(GOOD, chunk_offset=MOST)


@case("a message index at byte 2^64 - 1")
def _() -> bytes:
    return bag(GOOD, index_offset=MOST)


@case("a message index of 4 GiB")
def _() -> bytes:
    return bag(GOOD, index_size=2**32 - 16)


@case("messages at byte 2^64 - 1 of a chunk")
def _() -> bytes:
    return bag(plain(message(string("x")), entries=[(5, MOST), (5, 0)]))


@case("one message, half a million times in the index")
def _() -> bytes:
    return bag(plain(message(string("x" * 1_000_000)), entries=[(5, 0)] * 500_000))


@case("messages inside of messages")
def _() -> bytes:
    count, size = 30_000, 31
    records = [
        struct.pack("<BQHIQQ", 5, 22 + size * (count - k - 1), 1, 0, 5, 5) for k in range(count)
    ]
    return bag(plain(*records, entries=[(5, size * k) for k in range(count)]))


@case("a message that reaches out of its chunk")
def _() -> bytes:
    return bag(plain(raw(0x05, bytes(22), MOST)))


@case("a message shorter than its header")
def _() -> bytes:
    return bag(plain(raw(0x05, b"xy"), bytes(60)))


@case("a footer that names byte 2^64 - 1")
def _() -> bytes:
    return bag(GOOD, footer=Footer(MOST, MOST, 0))


@case("a footer that names a chunk as the summary")
def _() -> bytes:
    return bag(Part("zstd", zstd_zeros(6 * GIB, claims=6 * GIB), 6 * GIB), footer=Footer(8, 0, 0))


@case("an attachment of 2^64 - 1 bytes")
def _() -> bytes:
    body = bytes(24) + struct.pack("<Q", MOST) + b"abcd"
    place = len(MCAP0_MAGIC + encoded(Header("ros2", "hostile")))
    index = AttachmentIndex(place, len(body) + 9, 0, 0, 4, "a.urdf", "")
    return bag(GOOD, records=raw(0x09, body), summary=encoded(index))


@case("attachments and metadata at byte 2^64 - 1")
def _() -> bytes:
    summary = encoded(AttachmentIndex(MOST, MOST, 0, 0, MOST, "a.urdf", ""))
    return bag(GOOD, summary=summary + encoded(MetadataIndex(MOST, MOST, "a")))


@case("an attachment of 5 MB, ten thousand times in the index")
def _() -> bytes:
    record = encoded(Attachment(0, 0, "a.urdf", "", bytes(5_000_000)))
    place = len(MCAP0_MAGIC + encoded(Header("ros2", "hostile")))
    index = encoded(AttachmentIndex(place, len(record), 0, 0, 5_000_000, "a.urdf", ""))
    return bag(GOOD, records=record, summary=index * 10_000)


@case("metadata of 4 GiB")
def _() -> bytes:
    body = struct.pack("<I", 1) + b"a" + struct.pack("<I", 2**32 - 1) + bytes(50)
    place = len(MCAP0_MAGIC + encoded(Header("ros2", "hostile")))
    index = MetadataIndex(place, len(body) + 9, "a")
    return bag(GOOD, records=raw(0x0C, body), summary=encoded(index))


@case("a channel with a name of 4 GiB")
def _() -> bytes:
    return bag(GOOD, summary=raw(0x04, struct.pack("<HHI", 3, 1, 2**32 - 1) + b"x"))


@case("65534 channels")
def _() -> bytes:
    return bag(GOOD, channels=[channel(k + 1, f"/t{k}") for k in range(65_534)])


@case("65534 channels of one topic")
def _() -> bytes:
    return bag(GOOD, channels=[channel(k + 1, "/a") for k in range(65_534)])


@case("statistics of 2^64 - 1")
def _() -> bytes:
    names = ("message_count", "message_start_time", "message_end_time")
    return bag(GOOD, statistics=dict.fromkeys(names, MOST) | {"channel_message_counts": {1: MOST}})


@case("statistics of messages that are not there")
def _() -> bytes:
    return bag(statistics={"message_count": 10, "channel_message_counts": {1: 10}})


@case("messages at 2^64 - 1 ns")
def _() -> bytes:
    part = plain(message(string("x"), MOST), entries=[(MOST, 0)], times=(5, MOST))
    return bag(part, statistics={"message_end_time": MOST})


@case("messages 292 years apart")
def _() -> bytes:
    last = 2**63 - 1
    one = message(string("x"), 0)
    part = plain(
        one, message(string("y"), last), entries=[(0, 0), (last, len(one))], times=(0, last)
    )
    return bag(part, statistics={"message_count": 2, "message_end_time": last})


# -- schemas ----------------------------------------------------------------------------------


def of_type(text: str | bytes, name: str = "a/msg/B", data: bytes | None = None) -> bytes:
    content = text if isinstance(text, bytes) else text.encode()
    schema = Schema(id=1, data=content, encoding="ros2msg", name=name)
    return bag(plain(message(string("x" * 50) if data is None else data)), schema=schema)


INNER = SEPARATOR + "MSG: a/C\n"
SCHEMAS: dict[str, tuple[str | bytes, str]] = {
    "an array of 3e7 messages": (f"C[30000000] x\n{INNER}int32 y\n", "a/msg/B"),
    "an array of 3e7 strings": ("string[30000000] x\n", "a/msg/B"),
    "an array of 3e7 numbers": ("float64[30000000] x\n", "a/msg/B"),
    "an array of 1e300 numbers": (f"float64[{'9' * 300}] x\n", "a/msg/B"),
    "an array of no elements": (f"C[] x\n{INNER}uint8[0] y\n", "a/msg/B"),
    "a type in itself": ("B x\n", "a/msg/B"),
    "a type in itself by a list": ("B[] x\n", "a/msg/B"),
    "two types in each other": (f"C x\n{INNER}B y\n", "a/msg/B"),
    "types that double twenty times": (
        "T0 x\nT0 y\n"
        + "".join(f"{SEPARATOR}MSG: a/T{k}\nT{k + 1} x\nT{k + 1} y\n" for k in range(20))
        + f"{SEPARATOR}MSG: a/T20\nint8 x\n",
        "a/msg/B",
    ),
    "types 900 deep": (
        "T0 x\n"
        + "".join(f"{SEPARATOR}MSG: a/T{k}\nT{k + 1} x\n" for k in range(900))
        + f"{SEPARATOR}MSG: a/T900\nint8 x\n",
        "a/msg/B",
    ),
    "a type that is not defined": ("Q x\n", "a/msg/B"),
    "no text": ("", "a/msg/B"),
    "text that is no text": (b"\xff\xfe\x00", "a/msg/B"),
    "text of 3 MB": ("int32 x\n" * 400_000, "a/msg/B"),
    "comments of 200 kB": ("# hello\n" * 25_000 + "int32 x\n", "a/msg/B"),
    "five thousand fields": ("".join(f"int32 x{k}\n" for k in range(4_999)), "a/msg/B"),
    "a constant of 1e999": ("float32 X=1e999\nint32 y\n", "a/msg/B"),
    "fields with the names of keywords": ("int32 class\nint32 class_\nint32 None\n", "a/msg/B"),
    "fields with the names of methods": ("int32 __init__\nint32 __class__\n", "a/msg/B"),
    "two fields of one name": ("int32 x\nint32 x\n", "a/msg/B"),
    "a type called ../../x": ("int32 x\n", "../../x"),
    "a type called nothing": ("int32 x\n", ""),
    "a type of two lines": ("int32 x\n", "a/msg/B\nint32 y"),
    "a type of one part": ("int32 x\n", "B"),
    "a type of nine parts": ("int32 x\n", "a/b/c/d/e/f/g/h/i"),
    "a type with code in it": ("int32 x\n", 'a/msg/B"""\nimport os\n"""'),
    "a type with a control character": ("int32 x\n", "a/msg/\x1b[31mB\x00"),
    "a type of 100 kB": ("int32 x\n", "a/msg/" + "B" * 100_000),
}
for _title, (_text, _type) in SCHEMAS.items():
    CASES[f"schema: {_title}"] = lambda text=_text, name=_type: of_type(text, name)  # type: ignore[misc]


@case("schema: empty lists in lists")
def _() -> bytes:
    # Were elements without bytes believed, this would be 1e11 of them.
    text = f"C[] x\n{INNER}D[] y\n{SEPARATOR}MSG: a/D\nuint8[0] z\n"
    count = 200_000
    data = b"\0\1\0\0" + struct.pack("<I", count) + struct.pack("<I", 400_000) * count
    return of_type(text, data=data)


@case("schema: a list of 4e9 messages")
def _() -> bytes:
    text = f"C[] x\n{INNER}float64 y\n"
    return of_type(text, data=b"\0\1\0\0" + struct.pack("<I", 2**32 - 1) + bytes(100))


@case("schema: two definitions of one type")
def _() -> bytes:
    return bag(GOOD, summary=encoded(Schema(2, b"int32 x\n", "ros2msg", STRING.name)))


# -- quality of service -----------------------------------------------------------------------

QOS = {
    "sixty thousand brackets": "[" * 60_000,
    "sixty thousand braces": "{" * 60_000 + "}" * 60_000,
    "two thousand levels": "".join(f"{' ' * k}-\n" for k in range(300)) + "[" * 2000 + "]" * 2000,
    "references that multiply": "- &a0 {x: 1}\n"
    + "".join(f"- &a{k + 1} {{<<: [*a{k}, *a{k}, *a{k}]}}\n" for k in range(30)),
    "a list in itself": "&a [*a]",
    "a depth of 10^30": "- depth: 1" + "0" * 30,
    "a depth of 2^62": f"- depth: {2**62}",
    "a depth of -1": "- depth: -1",
    "a depth of yes": "- depth: yes",
    "a depth of a list": "- depth: [1]",
    "a deadline without end": "- deadline: {sec: .inf, nsec: 0}",
    "a deadline of no number": "- deadline: {sec: .nan, nsec: x}",
    "a deadline without seconds": "- deadline: {nsec: 0}",
    "a history that is a list": "- history: [keep_last]",
    "python objects": "- !!python/object/apply:os.system ['false']",
    "a megabyte": "- history: keep_last\n" * 50_000,
    "a tab and a zero": "-\t\0",
}
for _title, _text in QOS.items():
    CASES[f"QoS: {_title}"] = lambda text=_text: bag(  # type: ignore[misc]
        GOOD, channels=[channel(offered_qos_profiles=text)]
    )


# -- flights that are altered -----------------------------------------------------------------


def flight(
    change: Callable[[str, int, bytes], bytes | None] = lambda topic, number, data: data,
    *,
    urdf: bytes | None = None,
    metadata: dict[str, dict[str, str]] | None = None,
    most: int = 200,
    more: list[tuple[str, int, bytes]] | None = None,
    times: Callable[[int], int] = lambda time_ns: time_ns,
) -> bytes:
    """Return the first messages of a reference bag, altered."""
    out = BytesIO()
    reader = make_reader(BytesIO(_reference()))
    writer = Writer(out, compression=CompressionType.ZSTD)
    writer.start("ros2")
    for attachment in reader.iter_attachments():
        data = attachment.data if urdf is None else urdf
        writer.add_attachment(0, 0, attachment.name, attachment.media_type, data)
    for each in reader.iter_metadata():
        given = (metadata or {}).get(each.name, {})
        writer.add_metadata(each.name, {**each.metadata, **given})
    channels: dict[str, int] = {}
    counts: dict[str, int] = {}
    for number, (schema, source, each_message) in enumerate(reader.iter_messages()):
        if number == most:
            break
        assert schema is not None
        topic = source.topic
        if topic not in channels:
            identifier = writer.register_schema(schema.name, schema.encoding, schema.data)
            channels[topic] = writer.register_channel(
                topic, source.message_encoding, identifier, source.metadata
            )
        counts[topic] = counts.get(topic, -1) + 1
        changed = change(topic, counts[topic], each_message.data)
        if changed is not None:
            time_ns = times(each_message.log_time)
            writer.add_message(channels[topic], time_ns, changed, time_ns)
    for topic, time_ns, data in more or []:
        writer.add_message(channels[topic], time_ns, data, time_ns)
    writer.finish()
    return out.getvalue()


@lru_cache
def _reference() -> bytes:
    return REFERENCE.read_bytes()


def on(topic: str, edit: Callable[[int, bytes], bytes | None]) -> Callable[..., bytes | None]:
    def change(name: str, number: int, data: bytes) -> bytes | None:
        return edit(number, data) if name == topic else data

    return change


def stamped(data: bytes, sec: int) -> bytes:
    return data[:4] + struct.pack("<i", sec) + data[8:]


def joint_state(names: int) -> bytes:
    """Return a serialised JointState of so many joints without a position."""
    texts = b"".join(struct.pack("<I", 2) + b"j\0" + bytes(2) for _ in range(names))
    head = b"\0\1\0\0" + bytes(8) + struct.pack("<I", 1) + bytes(4) + struct.pack("<I", names)
    return head + texts + struct.pack("<III", 0, 0, 0)


NUMBERS = {
    "1e308": struct.pack("<d", 1e308),
    "nan": struct.pack("<d", float("nan")),
    "inf": struct.pack("<d", float("inf")),
    "5e-324": struct.pack("<d", 5e-324),
}
for _title, _number in NUMBERS.items():
    # The last numbers of a pose lie before its covariance.
    CASES[f"flight: every number of joint_states is {_title}"] = (
        lambda number=_number: flight(  # type: ignore[misc]
            on("/joint_states", lambda n, data: data[:-56] + number * 7)
        )
    )
    CASES[f"flight: poses of {_title}"] = (
        lambda number=_number: flight(  # type: ignore[misc]
            on("/odom", lambda n, data: data[:-700] + number * 7 + data[-644:])
        )
    )


@case("flight: cut messages")
def _() -> bytes:
    return flight(lambda topic, number, data: data[: number % 40])


@case("flight: empty messages")
def _() -> bytes:
    return flight(lambda topic, number, data: b"")


@case("flight: messages of 0xFF")
def _() -> bytes:
    return flight(lambda topic, number, data: data[:4] + b"\xff" * (len(data) - 4))


@case("flight: frames that are no text")
def _() -> bytes:
    return flight(on("/odom", lambda n, data: data.replace(b"world", b"\xff\xfe\xfd\xfc\xfb")))


@case("flight: a state in 2038")
def _() -> bytes:
    return flight(on("/joint_states", lambda n, data: stamped(data, 2**31 - 1) if n == 9 else data))


@case("flight: a state in 1901")
def _() -> bytes:
    return flight(on("/odom", lambda n, data: stamped(data, -(2**31)) if n == 9 else data))


@case("flight: 20000 joints")
def _() -> bytes:
    return flight(on("/joint_states", lambda n, data: joint_state(20_000) if n == 0 else data))


@case("flight: 3000 joints in every state")
def _() -> bytes:
    return flight(on("/joint_states", lambda n, data: joint_state(3_000)))


@case("flight: a status of three million values")
def _() -> bytes:
    pair = struct.pack("<I", 1) + bytes(4) + struct.pack("<I", 1) + bytes(4)
    count = 3_000_000
    head = b"\0\1\0\0" + b"\0" + bytes(3) + (struct.pack("<I", 1) + bytes(4)) * 3
    data = head + struct.pack("<I", count) + pair * count
    return flight(more=[("/planner/status", 10, data)])


@case("flight: log times up to 2^63")
def _() -> bytes:
    return flight(times=lambda time_ns: min(time_ns * 10**11, 2**63 - 1))


@case("flight: parameters nested 100000 deep")
def _() -> bytes:
    return flight(metadata={"parameters/plant": {"tick_rate": "[" * 100_000}})


@case("flight: parameters of 1e400 and 10^5000")
def _() -> bytes:
    given = {"tick_rate": "1e400", "position_mass": "1" + "0" * 5000}
    return flight(metadata={"parameters/plant": given})


@case("flight: a tick rate of 1e-3 and 1e5")
def _() -> bytes:
    return flight(metadata={"parameters/plant": {"tick_rate": "100000.0"}})


@case("flight: a scenario nested 100000 deep")
def _() -> bytes:
    nested = "[" * 100_000 + "]" * 100_000
    return flight(
        metadata={"scenario": {"published": nested}, "parameters/planner": {"method": nested}}
    )


def robot(joints: int, *, chain: bool = True) -> bytes:
    parts = ['<robot name="r"><link name="l0"><inertial><mass value="1"/>']
    inertia = '<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>'
    parts.append(inertia)
    for k in range(joints):
        parts.append(f'<link name="l{k + 1}"><inertial><mass value="1"/>{inertia}')
        parts.append(
            f'<joint name="j{k}" type="revolute"><parent link="l{k if chain else 0}"/>'
            f'<child link="l{k + 1}"/><axis xyz="0 0 1"/>'
            '<limit lower="-1" upper="1" velocity="1" effort="1"/></joint>'
        )
    return ("".join(parts) + "</robot>").encode()


LAUGHS = (
    '<!DOCTYPE r [<!ENTITY a0 "ha">'
    + "".join(f'<!ENTITY a{k + 1} "{f"&a{k};" * 10}">' for k in range(10))
    + "]>"
)
URDFS = {
    "empty": b"",
    "noise": bytes(range(256)) * 40,
    "references that multiply": f'{LAUGHS}<robot name="&a10;"><link name="x"/></robot>'.encode(),
    "references that multiply in text": f'{LAUGHS}<robot name="r">&a10;</robot>'.encode(),
    "a file of the machine": (
        b'<!DOCTYPE r [<!ENTITY f SYSTEM "file:///etc/passwd">]>'
        b'<robot name="r"><link name="x">&f;</link></robot>'
    ),
    "100000 elements deep": b"<robot>" + b"<link>" * 100_000 + b"</link>" * 100_000 + b"</robot>",
    "a chain of 2000 joints": robot(2_000),
    "a chain of 60 joints": robot(60),
    "a chain of 190 joints": robot(190),
    "a star of 20000 joints": robot(20_000, chain=False),
    "a name of 5 MB": b'<robot name="' + b"r" * 5_000_000 + b'"><link name="x"/></robot>',
    "in a loop": (
        b'<robot name="r"><link name="a"/><link name="b"/>'
        b'<joint name="j" type="fixed"><parent link="a"/><child link="b"/></joint>'
        b'<joint name="k" type="fixed"><parent link="b"/><child link="a"/></joint></robot>'
    ),
}
for _title, _urdf in URDFS.items():
    CASES[f"URDF: {_title}"] = lambda urdf=_urdf: flight(urdf=urdf)  # type: ignore[misc]


# -- what the package does with bags ----------------------------------------------------------


def read(path: Path) -> None:
    from spacerobot_ros.bag import iterate_raw, read_bag

    whole = read_bag(path)
    for topic in list(whole.topics)[:50]:
        whole.qos(topic)
        series = whole[topic]
        assert len(series.time) == sum(1 for _ in series.messages())
    _ = (whole.metadata, whole.attachments, whole.start_time, whole.end_time)
    for _item in iterate_raw(path):
        pass


def resume(path: Path) -> None:
    from spacerobot_ros.bag.recorded_robot import last_state

    last_state(path)


def play(path: Path) -> None:
    from spacerobot_ros.bag import Playback, read_bag

    playback = Playback(read_bag(path), rate=1e9)
    playback.run(0)
    while not playback.ended:
        playback.next_due()
        playback.bag_time(1)
        playback.step(0)


def command(*words: str) -> Callable[[Path], None]:
    def run(path: Path) -> None:
        from spacerobot_ros.cli.main import main

        given = [word.format(bag=path, out=path.with_suffix("")) for word in words]
        main(given, prog_name="spacerobot")

    return run


def replay(path: Path) -> None:
    """Replay for at most ten seconds: what would go on for ever is stopped like by Ctrl-C."""
    if not (stopper := os.fork()):
        time.sleep(10.0)
        os.kill(os.getppid(), signal.SIGINT)
        os._exit(0)
    try:
        command("replay", "{bag}", "--rate", "1e6", "--wait", "0", "--clock")(path)
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.kill(stopper, signal.SIGKILL)
        os.waitpid(stopper, 0)


def everything(path: Path) -> None:
    """Do what needs neither a robot's equations nor figures, whatever comes of each."""
    from spacerobot_ros.bag.salvage import salvage_bag
    from spacerobot_ros.errors import SpaceRobotError

    refusals = []
    for act in (read, resume, play, lambda bag: salvage_bag(bag, bag.with_suffix(".saved"))):
        try:
            act(path)
        except SpaceRobotError as error:
            refusals.append(error)
    if refusals:
        raise refusals[0]


OPERATIONS: dict[str, Callable[[Path], None]] = {
    "everything": everything,
    "read": read,
    "resume": resume,
    "play": play,
    "salvage": command("salvage", "{bag}", "-o", "{out}-salvaged.mcap"),
    "verify": command("verify", "{bag}"),
    "report": command("report", "{bag}", "-o", "{out}.html"),
    "replay": replay,
}


@dataclass(frozen=True)
class Outcome:
    """What came of one operation on one bag."""

    case: str
    operation: str
    code: int
    """Exit code; -9 for a process that was killed, by its memory or by its time."""
    sentence: str
    seconds: float
    """Processor time: another load of the machine does not count."""
    megabytes: float

    @property
    def fault(self) -> str:
        """What is wrong with it; empty: nothing."""
        ends = (0, 1, 2, 130) if self.operation == "replay" else (0, 1, 2)
        if self.code not in ends or "Traceback" in self.sentence:
            return f"code {self.code}: {self.sentence[-1500:]}"
        if self.code == 2 and len(self.sentence.strip().splitlines()) != 1:
            return f"not one sentence: {self.sentence[:1500]!r}"
        if self.code == 2 and len(self.sentence) > 3000:
            return f"a sentence of {len(self.sentence)} characters"
        if self.code == 0 and self.operation in ("read", "resume", "play") and self.sentence:
            return self.sentence
        if self.seconds > TIME_LIMIT:
            return f"{self.seconds:.1f} s of the processor"
        return f"{self.megabytes:.0f} MB" if self.megabytes > MEMORY_LIMIT_MB else ""


def attempt(name: str, path: Path, operation: str) -> Outcome:
    """Do one thing to a bag in a process of its own."""
    output = path.with_suffix(".txt")
    child = os.fork()
    if not child:
        _child(path, operation, output)
    _, status, usage = os.wait4(child, 0)
    code = os.waitstatus_to_exitcode(status)
    sentence = output.read_text(errors="replace")
    seconds = usage.ru_utime + usage.ru_stime
    return Outcome(name, operation, code, sentence, seconds, usage.ru_maxrss / 1024)


def _child(path: Path, operation: str, output: Path) -> None:
    from spacerobot_ros.errors import SpaceRobotError

    code = 3
    try:
        # What takes more is a failure, and must not take the machine with it.
        resource.setrlimit(resource.RLIMIT_AS, (6 * GIB, 6 * GIB))
        resource.setrlimit(resource.RLIMIT_CPU, (2 * round(TIME_LIMIT), GIB))
        # A child that waits for ever takes no processor.
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.alarm(12 * round(TIME_LIMIT))
        descriptor = os.open(output, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644)
        os.dup2(descriptor, 2)
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        sys.stdout, sys.stderr = os.fdopen(1, "w"), os.fdopen(2, "w")
        OPERATIONS[operation](path)
        code = 0
    except SpaceRobotError as error:
        sys.stderr.write(f"{error}\n")
        code = 2
    except SystemExit as error:
        code = error.code if isinstance(error.code, int) else 0
    except BaseException:
        traceback.print_exc()
    with contextlib.suppress(BaseException):
        sys.stderr.flush()
    os._exit(code)


QUICK = (
    *(
        "zstd: 6 GiB in 197 kB, claimed",
        "zstd: 6 GiB claimed by the frame, 1000 bytes by the chunk",
    ),
    *("zstd: two hundred chunks of 60 MB", "lz4: 1 GiB in 4 MB, 1000 bytes claimed"),
    f"zstd: a chunk claims {MOST} bytes",
    f"lz4: a chunk claims {2**63 - 1} bytes",
    *("a record of 2^64 - 1 bytes", "a message index at byte 2^64 - 1"),
    *("messages inside of messages", "a footer that names byte 2^64 - 1"),
    *("an attachment of 2^64 - 1 bytes", "messages at 2^64 - 1 ns"),
    *("schema: an array of 3e7 messages", "schema: types that double twenty times"),
    *("schema: a type in itself", "schema: empty lists in lists"),
    *("schema: a list of 4e9 messages", "schema: a type of two lines"),
    *("QoS: sixty thousand brackets", "QoS: references that multiply"),
    *("QoS: a deadline without end", "statistics of messages that are not there"),
    "flight: cut messages",
)
"""Cases that are tried with all tests."""


def outcomes(folder: Path, operations: list[str], words: str = "") -> Iterator[Outcome]:
    """Make the bags whose names have some words in them, and do these things to each."""
    for number, (name, make) in enumerate(CASES.items()):
        if words not in name if words != "QUICK" else name not in QUICK:
            continue
        path = folder / f"{number}.mcap"
        path.write_bytes(make())
        for operation in operations:
            yield attempt(name, path, operation)
        for left in folder.glob(f"{number}*"):
            left.unlink()


def main() -> None:
    folder, operations, *words = sys.argv[1:]
    # What every case would import is there before the processes part.
    import spacerobot_ros.bag.recorded_robot

    if operations != "everything":
        import spacerobot_ros.cli.main
        import spacerobot_ros.report
        import spacerobot_ros.verification.comparison  # noqa: F401

    for outcome in outcomes(Path(folder), operations.split(","), *words):
        print(json.dumps({**vars(outcome), "fault": outcome.fault}), flush=True)


if __name__ == "__main__":
    main()
