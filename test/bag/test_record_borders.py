"""Records, chunks and definitions of a bag at the borders of what is accepted.

The bytes are put together here; what is exactly right is read, and one byte more is refused.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from io import BytesIO
from pathlib import Path

import lz4.frame
import pytest
import zstandard
from mcap.opcode import Opcode
from mcap.records import Chunk, Footer, Header
from mcap.writer import MCAP0_MAGIC
from rosbags.interfaces import Nodetype
from support.hostile.records import Part, bag, encoded, plain, string

from spacerobot_ros.bag import RecordingError, iterate_raw, read_bag
from spacerobot_ros.bag.mcap_reading import (
    INFLATED_SIZE_VARIABLE,
    ChunkUnpacker,
    read_record,
    records,
    records_in_chunk,
)
from spacerobot_ros.messages.definitions import MessageTypes, _FieldCounts


def record(opcode: int, body: bytes, claims: int | None = None) -> bytes:
    return struct.pack("<BQ", opcode, len(body) if claims is None else claims) + body


def message(data: bytes, claims: int | None = None) -> bytes:
    return record(Opcode.MESSAGE, struct.pack("<HIQQ", 1, 0, 7, 8) + data, claims)


# -- records ----------------------------------------------------------------------------------


def test_a_record_may_end_where_the_file_does() -> None:
    first, last = encoded(Header("ros2", "")), encoded(Footer(1, 2, 3))
    file = BytesIO(first + last)
    place = len(first)
    assert list(records(file, 0)) == [(0, Opcode.HEADER, first), (place, Opcode.FOOTER, last)]
    assert read_record(file, 0, Header) == Header("ros2", "")
    assert read_record(file, place, Footer) == Footer(1, 2, 3)
    for wrong in (0, place + len(last), 2**64 - 1):
        with pytest.raises(ValueError, match=f"the file has no Footer record at byte {wrong}"):
            read_record(file, wrong, Footer)


def test_a_record_that_claims_one_byte_more_than_is_left_is_refused() -> None:
    content = record(Opcode.HEADER, b"abc") + record(Opcode.CHUNK, b"de", claims=3)
    words = "the record at byte 12 claims 3 bytes, where 2 are left"
    with pytest.raises(ValueError, match=words):
        list(records(BytesIO(content), 0))
    with pytest.raises(ValueError, match=words):
        read_record(BytesIO(content), 12, Chunk)


def test_a_file_may_end_inside_of_the_head_of_a_record() -> None:
    content = record(Opcode.HEADER, b"abc") + record(Opcode.FOOTER, b"")[:8]
    with pytest.raises(ValueError, match="it ends inside of the record at byte 12"):
        list(records(BytesIO(content), 0))


def test_records_of_a_chunk_end_with_it() -> None:
    whole = message(b"") + record(Opcode.SCHEMA, b"")
    assert list(records_in_chunk(whole, 40)) == [(0, 31), (31, 40)]
    assert list(records_in_chunk(b"", 40)) == []
    for chunk, words in (
        (whole[:-1], "the chunk at byte 40 ends inside of a record"),
        (message(b"", claims=23), "a record reaches out of the chunk at byte 40"),
        (record(0, b"abc"), "the chunk at byte 40 has records of no kind"),
    ):
        with pytest.raises(ValueError, match=words):
            list(records_in_chunk(chunk, 40))


def test_a_message_may_hold_nothing_and_has_a_whole_head(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(bag(plain(message(string("text")), message(b""))))
    assert [data for *_, data in iterate_raw(path)] == [string("text"), b""]
    path.write_bytes(bag(plain(message(string("text")), record(Opcode.MESSAGE, bytes(21)))))
    for read in (lambda: list(iterate_raw(path)), lambda: read_bag(path)["/a"]):
        with pytest.raises(RecordingError, match=r"is damaged: a message .* is shorter"):
            read()


# -- what chunks inflate to -------------------------------------------------------------------


def test_chunks_may_inflate_to_the_limit_together_and_no_further() -> None:
    chunks = ChunkUnpacker(1000)
    assert chunks.max_bytes == 32_000_000
    chunks.count(31_999_999, 8)
    chunks.count(1, 50)
    chunks.count(0, 60)
    words = "the chunk at byte 70 it inflates to 32000001 bytes, more than the 32000000 that"
    with pytest.raises(ValueError, match=words):
        chunks.count(1, 70)
    assert ChunkUnpacker(160_000).max_bytes == ChunkUnpacker(0).max_bytes == 32_000_000
    assert ChunkUnpacker(160_001).max_bytes == 32_000_200


@pytest.mark.parametrize(
    ("text", "most"),
    [
        ("5", 5_000_000),
        ("0.5", 500_000),
        ("0", 32_000_000),
        ("-3", 32_000_000),
        ("1e12", 32_000_000),
        ("nan", 32_000_000),
        ("much", 32_000_000),
    ],
)
def test_the_limit_is_a_positive_number_of_megabytes(
    text: str, most: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(INFLATED_SIZE_VARIABLE, text)
    assert ChunkUnpacker(0).max_bytes == most


PACKED: dict[str, Callable[[bytes], bytes]] = {
    "": lambda data: data,
    "zstd": lambda data: zstandard.ZstdCompressor().compress(data) if data else b"",
    "lz4": lambda data: lz4.frame.compress(data) if data else b"",
}


@pytest.mark.parametrize("compression", PACKED)
def test_a_chunk_holds_what_it_claims_to_the_byte(compression: str) -> None:
    def unpacked(data: bytes, size: int, crc: int = 0) -> bytes:
        packed = PACKED[compression](data)
        return ChunkUnpacker(0).unpack(Chunk(compression, packed, 0, 0, crc, size), 40)

    data = message(b"text") * 3
    for held in (data, b"", b"x"):
        assert unpacked(held, len(held)) == held
        assert unpacked(held, len(held), zlib.crc32(held)) == held
    for size in (len(data) - 1, len(data) + 1):
        with pytest.raises(ValueError, match=f"chunk at byte 40 does not hold the {size} bytes"):
            unpacked(data, size)
    with pytest.raises(ValueError, match="the checksum of the chunk at byte 40 is wrong"):
        unpacked(data, len(data), zlib.crc32(data) ^ 1)


def test_a_chunk_and_its_index_agree(tmp_path: Path) -> None:
    path, data = tmp_path / "a.mcap", message(string("x"))
    path.write_bytes(bag(Part("", data, len(data), indexed_size=len(data) + 1)))
    with pytest.raises(RecordingError, match="and its index claim different sizes"):
        read_bag(path)["/a"]


# -- definitions ------------------------------------------------------------------------------


def refused(text: str) -> str:
    try:
        MessageTypes().decoder("a/msg/A", text.encode())
    except ValueError as error:
        return str(error)
    raise AssertionError("it is accepted")


def accepted(text: str) -> None:
    MessageTypes().decoder("a/msg/A", text.encode())


def test_a_message_may_have_a_thousand_fields_and_no_more() -> None:
    other = f"{'=' * 80}\nMSG: a/B\nfloat64 x\nfloat64 y\n"
    accepted("string[1000] s\n")
    accepted("a/B[500] b\n" + other)
    accepted("a/B[499] b\nfloat64 x\nuint8[70000] y\n" + other)
    accepted(f"a/B[] b\na/B[498] c\nfloat64[] x\nstring y\n{other}")
    for text in (
        "string[1001] s\n",
        "string[1000] s\nfloat64 x\n",
        "a/B[500] b\nfloat64 x\n" + other,
        "a/B[499] b\nstring[3] y\n" + other,
        f"a/B[] b\na/B[499] c\nfloat64 x\n{other}",
    ):
        assert "a/msg/A has more than 1000 fields" in refused(text)


def test_a_message_without_fields_counts_as_one() -> None:
    sizes = _FieldCounts({"E": ([], []), "A": ([], [("e", (Nodetype.NAME, "E"))] * 1000)})
    assert sizes.of("E", 0) == 1
    assert sizes.of("A", 0) == 1000


def test_types_may_be_nested_32_deep() -> None:
    def chain(count: int) -> str:
        parts = [f"a/T{k + 1} t\n{'=' * 80}\nMSG: a/T{k + 1}\n" for k in range(count)]
        return "".join(parts) + "uint8 x\n"

    accepted(chain(32))
    assert "nested more than 32 deep" in refused(chain(33))


def test_a_text_may_have_so_many_bytes_and_lines() -> None:
    accepted("float64 x\n" + "#" * (262_144 - 10))
    assert "longer than 262144 bytes or 5000 lines" in refused("float64 x\n" + "#" * 262_135)
    accepted("float64 x\n" + "\n" * 4_999)
    assert "longer than 262144 bytes or 5000 lines" in refused("float64 x\n" + "\n" * 5_000)


@pytest.mark.parametrize("length", [0, 20, 21, 28])
def test_a_file_that_is_too_short_for_a_footer_is_damaged_at_its_begin(
    tmp_path: Path, length: int
) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(MCAP0_MAGIC + bytes([1] * length) + MCAP0_MAGIC)
    # The footer takes 29 bytes, and what the file ends with 8.
    place = max(8 + length - 29, 0)
    with pytest.raises(RecordingError, match=f"is damaged: the record at byte {place} claims"):
        read_bag(path)
