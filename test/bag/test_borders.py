"""Reading and writing at the borders: equal times, ends of windows, limits met exactly.

What a bag holds is read with the mcap library alone, or was written with it.
"""

from __future__ import annotations

import itertools
import random
import struct
import zlib
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Any

import lz4.frame
import numpy as np
import pytest
import yaml
import zstandard
from mcap.opcode import Opcode
from mcap.reader import NonSeekingReader, make_reader
from mcap.records import Chunk, Footer, Header
from mcap.stream_reader import StreamReader
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer
from std_msgs.msg import UInt8, UInt8MultiArray
from support.hostile.records import Part, bag, encoded, plain, string
from support.made_bags import joint_states, made_bag

from spacerobot_ros.bag import (
    BagWriter,
    QosProfile,
    RecordingError,
    iterate_raw,
    read_bag,
)
from spacerobot_ros.bag.mcap_file import INFINITE_NS
from spacerobot_ros.bag.mcap_reading import (
    INFLATED_SIZE_VARIABLE,
    BagFile,
    ChunkUnpacker,
    blocks_in_time_order,
    read_record,
    records,
    records_in_chunk,
)
from spacerobot_ros.bag.playback import Playback
from spacerobot_ros.bag.salvage import salvage_bag
from spacerobot_ros.messages.definitions import MessageType

STRING = "std_msgs/msg/String"
S = 10**9


# -- the order of messages ---------------------------------------------------------------------


def written(path: Path, times: list[int], chunked: bool, chunk_size: int) -> Path:
    """Write messages on two topics in turn, with publish times of their own."""
    with path.open("wb") as file:
        writer = Writer(
            file, chunk_size=chunk_size, use_chunking=chunked, compression=CompressionType.NONE
        )
        writer.start("ros2")
        schema = writer.register_schema(STRING, "ros2msg", b"string data")
        channels = [writer.register_channel(topic, "cdr", schema) for topic in ("/a", "/b")]
        for n, time in enumerate(times):
            writer.add_message(channels[n % 2], time, string(f"{n:03d}"), 1000 + n)
        writer.finish()
    return path


@pytest.mark.parametrize("chunked", [True, False])
@pytest.mark.parametrize("spread", [2, 5, 40])
def test_messages_come_by_time_and_those_of_one_time_as_they_were_written(
    tmp_path: Path, chunked: bool, spread: int
) -> None:
    """Against a stable sort; many of the times are equal, within chunks and across them."""
    chance = random.Random(spread)
    for turn in range(12):
        times = [chance.randrange(spread) for _ in range(40)]
        path = written(tmp_path / f"{turn}.mcap", times, chunked, chance.choice([60, 150, 400]))
        order = sorted(range(len(times)), key=times.__getitem__)
        found = list(read_bag(path).raw_messages(["/a", "/b"]))
        assert [data[8:-1] for *_, data in found] == [b"%03d" % n for n in order]
        assert [log for _, log, _ in found] == [times[n] for n in order]
        assert [topic for topic, _, _ in found] == ["/b" if n % 2 else "/a" for n in order]
        # A window holds both of its ends, and one topic is every second message.
        start, end = sorted(chance.sample(range(2 + spread), 2))
        part = read_bag(path).raw_messages(["/b"], start, end)
        wanted = [n for n in order if start <= times[n] <= end and n % 2]
        assert [data[8:-1] for *_, data in part] == [b"%03d" % n for n in wanted]


@pytest.mark.parametrize("chunked", [True, False])
def test_topics_that_are_read_together_are_the_same(tmp_path: Path, chunked: bool) -> None:
    times = [random.Random(1).randrange(30) for _ in range(60)]
    bag = read_bag(written(tmp_path / "bag.mcap", times, chunked, 150))
    # One that is not there is left out; leading slashes do not count.
    bag.load(["a", "/b", "/c"])
    for topic, first in (("/a", 0), ("/b", 1)):
        order = sorted(range(first, 60, 2), key=times.__getitem__)
        assert [message.data for _, message in bag[topic].messages()] == [f"{n:03d}" for n in order]
        np.testing.assert_array_equal(bag[topic].time_ns, [times[n] for n in order])
    with pytest.raises(RecordingError, match="no topic /c"):
        bag["/c"]


def test_messages_in_order_are_read_chunk_by_chunk(tmp_path: Path) -> None:
    """Chunks that share one time are no reason to hold all of them in memory."""
    path = written(tmp_path / "a.mcap", [n // 3 for n in range(300)], True, 200)
    file = BagFile(path)
    chunks = file.summary.chunk_indexes
    assert len(chunks) > 30
    assert len(list(blocks_in_time_order([file], ["/a", "/b"]))) == len(chunks)


# -- replay ------------------------------------------------------------------------------------


LATCHED = QosProfile(depth=1, durability="transient_local")


def replayed(path: Path, start: float) -> Playback:
    """Replay /a every 0.1 s for 1 s, and /latched at 0, 0.2 and 0.3 s."""
    with BagWriter(path) as writer:
        a = writer.add_topic("/a", STRING)
        latched = writer.add_topic("/latched", STRING, LATCHED)
        for n in range(11):
            if n in (0, 2, 3):
                writer.write(latched, string(f"latched {n}"), 77 * S + n * S // 10, 0)
            writer.write(a, string(f"{n}"), 77 * S + n * S // 10, 0)
    return Playback(read_bag(path), start=start)


@pytest.mark.parametrize(
    ("start", "expected"),
    [
        (0.0, ["latched 0", "0"]),
        (0.2, ["latched 0", "latched 2", "2"]),
        (0.3, ["latched 2", "latched 3", "3"]),
        (0.35, ["latched 3"]),
    ],
)
def test_what_was_latched_comes_once(tmp_path: Path, start: float, expected: list[str]) -> None:
    playback = replayed(tmp_path / "a.mcap", start)
    playback.run(5 * S)
    due = playback.take_due(5 * S, 100)
    assert [message.data[8:-1].decode() for message in due] == expected
    # What was sent before is due at the start: a clock made of it does not go back.
    assert {message.log_time_ns for message in due} == {77 * S + round(start * S)}


def test_the_time_of_a_late_replay_is_not_ahead_of_what_is_still_to_come(tmp_path: Path) -> None:
    playback = replayed(tmp_path / "a.mcap", 0.0)
    playback.run(5 * S)
    assert playback.bag_time(9 * S) == 77 * S
    playback.take_due(5 * S, 100)
    assert playback.bag_time(9 * S) == 77 * S + S // 10
    playback.take_due(9 * S, 100)
    assert playback.ended
    assert playback.bag_time(9 * S) == 81 * S


# -- writing -----------------------------------------------------------------------------------


def bag_of(path: Path, times: list[float], **options: Any) -> Path:
    with BagWriter(path, chunk_size=1, **options) as writer:
        writer.add_topic("/silent", STRING)
        channel = writer.add_topic("/a", STRING)
        for n, time in enumerate(times):
            writer.write(channel, string(f"{n}"), round(time * S), round(time * S))
    return path


def test_a_file_is_full_when_it_lasts_exactly_as_long_as_it_may(tmp_path: Path) -> None:
    bag_of(tmp_path / "a.mcap", [0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0], max_duration_ns=S)
    times = []
    for n in range(3):
        with (tmp_path / f"a_{n}.mcap").open("rb") as file:
            # As a stream: a message whose channel or schema did not come before is an error.
            found = NonSeekingReader(file).iter_messages(log_time_order=False)
            times.append([message.log_time / S for _, _, message in found])
            file.seek(0)
            assert list(StreamReader(file, validate_crcs=True).records)
    assert times == [[0.0, 0.5, 1.0], [1.5, 2.0, 2.5], [3.0]]


def test_the_statistics_of_messages_that_were_written_out_of_order(tmp_path: Path) -> None:
    path = bag_of(tmp_path / "a.mcap", [5.0, 9.0, 3.0, 4.0])
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
        content = {m.name: m.metadata for m in make_reader(file).iter_metadata()}
    assert summary is not None
    assert summary.statistics is not None
    statistics = summary.statistics
    assert (statistics.message_start_time, statistics.message_end_time) == (3 * S, 9 * S)
    assert (statistics.channel_count, statistics.schema_count) == (2, 1)
    assert (statistics.chunk_count, statistics.message_count) == (4, 4)
    told = yaml.safe_load(content["rosbag2"]["serialized_metadata"])
    assert told["starting_time"]["nanoseconds_since_epoch"] == 3 * S
    assert told["duration"]["nanoseconds"] == 6 * S
    bag = read_bag(path)
    assert (bag.start_time, bag.end_time) == (3.0, 9.0)


def test_what_waits_in_memory_is_counted_until_it_is_written(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "a.mcap") as writer:
        channel = writer.add_topic("/a", STRING)
        before, size = writer.bytes_waiting, writer.bytes_written
        for _ in range(3):
            writer.write(channel, string("x" * 91), 1, 1)
        # A record is 9 + 22 bytes of head, 4 + 4 of the message, 91 of text and its zero.
        assert writer.bytes_waiting - before == 3 * (9 + 22 + 4 + 4 + 91 + 1)
        assert writer.bytes_written == size
        writer.flush()
        assert writer.bytes_waiting == 0
        assert writer.bytes_written == (tmp_path / "a.mcap").stat().st_size > size


# -- reading -----------------------------------------------------------------------------------


def test_a_topic_of_two_publishers_is_one_topic(tmp_path: Path) -> None:
    with (tmp_path / "a.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start("ros2")
        schema = writer.register_schema(STRING, "ros2msg", b"string data")
        channels = [writer.register_channel("/a", "cdr", schema) for _ in range(2)]
        for n in range(5):
            writer.add_message(channels[n > 2], n, string(f"{n}"), n)
        writer.finish()
    assert channels[0] != channels[1]
    bag = read_bag(tmp_path / "a.mcap")
    assert bag.message_count("/a") == bag.message_count() == 5
    assert [message.data for _, message in bag.messages("/a")] == list("01234")


def test_of_many_topics_some_are_named(tmp_path: Path) -> None:
    for count, more in ((3, ""), (400, " more")):
        with BagWriter(tmp_path / f"{count}.mcap") as writer:
            for n in range(count):
                writer.add_topic(f"/topic_{n:03d}", STRING)
        with pytest.raises(RecordingError, match="has no topic /none") as refusal:
            read_bag(tmp_path / f"{count}.mcap")["/none"]
        sentence = str(refusal.value)
        named = sentence.count("/topic_")
        assert sentence.endswith(f" and {count - named} more." if more else "/topic_002.")
        assert named < 100
        assert len(sentence) < 1000


def test_bytes_are_not_signed(tmp_path: Path) -> None:
    with made_bag(tmp_path / "a.mcap") as (_, say):
        for n in (0, 127, 128, 255):
            say("/one", UInt8(data=n), 0.0)
            say("/many", UInt8MultiArray(data=[n, 255 - n]), 0.0)
    bag = read_bag(tmp_path / "a.mcap")
    np.testing.assert_array_equal(bag["/one"].field("data"), [0, 127, 128, 255])
    many = bag["/many"].field("data")
    np.testing.assert_array_equal(many, [[0, 255], [127, 128], [128, 127], [255, 0]])


def test_a_table_of_nothing_has_no_columns(tmp_path: Path) -> None:
    with made_bag(tmp_path / "a.mcap") as (_, say):
        for _ in range(3):
            say("/joints", joint_states(0.0, [], [], []), 0.0)
    series = read_bag(tmp_path / "a.mcap")["/joints"]
    assert series.table([], 0).shape == (3, 0)
    assert series.table(["position"], 0).shape == (3, 0)


def test_a_bag_that_cannot_be_begun_is_not_held_open(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bag = tmp_path / "a.mcap"

    def full(*_: Any) -> None:
        raise RecordingError("No space left on device.")

    monkeypatch.setattr("spacerobot_ros.bag.mcap_file.McapFile.add_metadata", full)
    with pytest.raises(RecordingError, match="No space left"):
        BagWriter(bag)
    assert not [path for path in Path("/proc/self/fd").iterdir() if path.resolve() == bag]


def test_durations_beyond_the_longest_are_the_longest() -> None:
    """Connext's infinite duration, for one, is more than a duration of ROS holds."""
    text = "- deadline: {sec: 9223372036854775807, nsec: 4294967295}\n  lifespan: {sec: 2, nsec: 5}"
    (profile,) = QosProfile.from_yaml(text)
    assert profile.deadline_ns == INFINITE_NS
    assert profile.lifespan_ns == 2 * S + 5
    (again,) = QosProfile.from_yaml(profile.to_yaml())
    assert again == profile


# -- salvage -----------------------------------------------------------------------------------


def ends_of_records(content: bytes | bytearray) -> list[tuple[int, int]]:
    """Return opcode and end of every record of a file, from its bytes."""
    ends, position = [], 8
    while position < len(content) - 8:
        opcode, length = struct.unpack_from("<BQ", content, position)
        position += 9 + length
        ends.append((opcode, position))
    return ends


def test_what_is_lost_behind_the_last_whole_record_is_counted(tmp_path: Path) -> None:
    whole = bag_of(tmp_path / "a.mcap", [float(n) for n in range(6)]).read_bytes()
    records = ends_of_records(whole)
    data_end = next(end for opcode, end in records if opcode == 0x0F)
    cut = tmp_path / "cut.mcap"
    chance = random.Random(1)
    exact = [end for _, end in records if end < data_end][-4:]
    for length in [*exact, *(chance.randrange(exact[0], data_end - 1) for _ in range(12))]:
        cut.write_bytes(whole[:length])
        saved = salvage_bag(cut)
        last = max(end for _, end in records if end <= length)
        assert saved.lost_bytes == length - last
        assert saved.duration == pytest.approx(saved.messages - 1)
        with saved.path.open("rb") as file:
            names = [metadata.name for metadata in make_reader(file).iter_metadata()]
        assert names.count("rosbag2") == 1
        saved.path.unlink()


def test_a_bag_whose_statistics_are_wrong_is_salvaged(tmp_path: Path) -> None:
    path = bag_of(tmp_path / "a.mcap", [0.0, 1.0, 2.0])
    content = bytearray(path.read_bytes())
    records = ends_of_records(content)
    (end,) = (end for (_, end), (opcode, _) in itertools.pairwise(records) if opcode == 11)
    (count,) = struct.unpack_from("<Q", content, end + 9)
    assert count == 3
    struct.pack_into("<Q", content, end + 9, 4)
    path.write_bytes(content)
    assert salvage_bag(path).messages == 3


# -- bytes put together here: what is exactly right is read, one byte more is refused ----------


def record(opcode: int, body: bytes, claims: int | None = None) -> bytes:
    return struct.pack("<BQ", opcode, len(body) if claims is None else claims) + body


def message(data: bytes, claims: int | None = None) -> bytes:
    return record(Opcode.MESSAGE, struct.pack("<HIQQ", 1, 0, 7, 8) + data, claims)


# -- records -----------------------------------------------------------------------------------


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


# -- what chunks inflate to --------------------------------------------------------------------


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


# -- definitions -------------------------------------------------------------------------------


def refused(text: str) -> str:
    try:
        MessageType("a/msg/A", text.encode())
    except ValueError as error:
        return str(error)
    raise AssertionError("it is accepted")


def accepted(text: str) -> None:
    MessageType("a/msg/A", text.encode())


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
