"""Files that are wrong whatever is in the messages: chunks that inflate, places, lengths, times."""

from __future__ import annotations

import struct
from collections.abc import Callable

import lz4.frame
import zstandard
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Chunk,
    Footer,
    Header,
    MetadataIndex,
)
from mcap.writer import MCAP0_MAGIC
from support.hostile.records import (
    CASES,
    GIB,
    GOOD,
    MOST,
    Part,
    bag,
    case,
    channel,
    encoded,
    lz4_zeros,
    message,
    plain,
    raw,
    string,
    zstd_zeros,
)

# -- chunks that inflate ---------------------------------------------------------------------


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
