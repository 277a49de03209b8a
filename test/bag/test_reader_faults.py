"""Bags that other programs wrote, and files that are no whole bag."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer

from spacerobot_ros.bag import (
    BagWriter,
    RecordingError,
    iterate_raw,
    message_definition,
    read_bag,
)

STRING = "std_msgs/msg/String"


def string(text: str) -> bytes:
    """Serialise a std_msgs/String by hand."""
    data = text.encode() + b"\0"
    return b"\0\1\0\0" + struct.pack("<I", len(data)) + data


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("bags") / "good.mcap"
    with BagWriter(path, chunk_size=2000) as writer:
        writer.add_topic("/silent", STRING)
        odom = writer.add_topic("/odom", "nav_msgs/msg/Odometry")
        for n in range(100):
            writer.write(odom, b"\0\1\0\0" + n.to_bytes(800, "little"), n, n)
    return path


def others_bag(path: Path, **options: Any) -> Path:
    """Write strings out of order, with the library's own writer, on two channels of one topic."""
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=300, **options)
        writer.start("ros2")
        schema = writer.register_schema(STRING, "ros2msg", message_definition(STRING).encode())
        channels = [writer.register_channel("/a", "cdr", schema, {}) for _ in range(2)]
        channels.append(writer.register_channel("/b", "cdr", schema, {}))
        for n in range(60):
            time_ns = (n * 7) % 60
            writer.add_message(channels[n % 3], time_ns, string(f"{time_ns}"), time_ns + 1)
        writer.finish()
    return path


@pytest.mark.parametrize(
    "options",
    [
        {"compression": CompressionType.ZSTD},
        {"compression": CompressionType.LZ4},
        {"compression": CompressionType.NONE, "enable_crcs": False},
        {"use_chunking": False},
        {"index_types": IndexType.NONE},
        {"index_types": IndexType.CHUNK},
    ],
)
def test_bags_of_the_mcap_library(tmp_path: Path, options: dict[str, Any]) -> None:
    path = others_bag(tmp_path / "a.mcap", **options)
    order = [((n * 7) % 60, "/b" if n % 3 == 2 else "/a") for n in range(60)]
    assert [(t, topic) for topic, _, t, _, _ in iterate_raw(path)] == order
    assert all(publish == log + 1 for _, _, log, publish, _ in iterate_raw(path))
    bag = read_bag(path)
    for topic in ("/a", "/b"):
        expected = sorted(t for t, name in order if name == topic)
        assert bag.message_count(topic) == len(expected)
        assert bag[topic].time_ns.tolist() == expected
        assert bag[topic].field("data") == [str(t) for t in expected]


def test_a_folder_with_one_bag(path: Path, tmp_path: Path) -> None:
    (tmp_path / "rosbag2").mkdir()
    (tmp_path / "rosbag2" / "rosbag2_0.mcap").write_bytes(path.read_bytes())
    (tmp_path / "rosbag2" / "metadata.yaml").touch()
    assert read_bag(tmp_path / "rosbag2").message_count() == 100
    assert len(list(iterate_raw(tmp_path / "rosbag2"))) == 100
    (tmp_path / "rosbag2" / "rosbag2_1.mcap").touch()
    with pytest.raises(RecordingError, match="holds 2 MCAP files: name one of them"):
        read_bag(tmp_path / "rosbag2")


def reading_fails(path: Path, words: str) -> None:
    for read in (read_bag, lambda path: list(iterate_raw(path))):
        with pytest.raises(RecordingError, match=words) as caught:
            read(path)
        assert str(path) in str(caught.value)
        assert str(caught.value).endswith(".")
        assert "\n" not in str(caught.value)


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    reading_fails(tmp_path / "a.mcap", "There is no bag at")


def test_a_file_that_is_empty(tmp_path: Path) -> None:
    (tmp_path / "a.mcap").touch()
    reading_fails(tmp_path / "a.mcap", "is empty")


@pytest.mark.parametrize("content", [b"SQLite format 3\0" * 10, b"x", b"\x89MCAP1\r\n" * 3])
def test_a_file_that_is_not_mcap(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a.mcap").write_bytes(content)
    reading_fails(tmp_path / "a.mcap", "is not an MCAP file")


@pytest.mark.parametrize("kept", [1, 8, 9, 50, 0.1, 0.5, 0.99, -1])
def test_a_file_that_was_cut(path: Path, tmp_path: Path, kept: float) -> None:
    content = path.read_bytes()
    length = int(kept * len(content)) if 0 < kept < 1 else int(kept)
    (tmp_path / "a.mcap").write_bytes(content[:length])
    reading_fails(tmp_path / "a.mcap", "was cut short")


def test_a_bag_without_summary(tmp_path: Path) -> None:
    with (tmp_path / "a.mcap").open("wb") as file:
        writer = Writer(
            file,
            index_types=IndexType.NONE,
            repeat_channels=False,
            repeat_schemas=False,
            use_statistics=False,
            use_summary_offsets=False,
        )
        writer.start("ros2")
        writer.finish()
    reading_fails(tmp_path / "a.mcap", "has no summary")


@pytest.mark.parametrize("compression", ["zstd", "lz4", "none"])
def test_a_chunk_that_is_damaged(tmp_path: Path, compression: str) -> None:
    path = tmp_path / "a.mcap"
    with BagWriter(path, compression=compression) as writer:
        channel = writer.add_topic("/a", STRING)
        for n in range(100):
            writer.write(channel, string("x" * 100), n, n)
    content = bytearray(path.read_bytes())
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    index = summary.chunk_indexes[0]
    middle = index.chunk_start_offset + index.chunk_length // 2
    for position in range(middle, middle + 8):
        content[position] ^= 0xFF
    path.write_bytes(content)
    with pytest.raises(RecordingError, match="is damaged"):
        read_bag(path)["/a"]
    with pytest.raises(RecordingError, match="is damaged"):
        list(iterate_raw(path))


def test_a_message_that_is_damaged(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "a.mcap") as writer:
        channel = writer.add_topic("/a", STRING)
        for data in (b"", b"\0\1\0\0", b"\0\1\0\0\xff\xff\xff\xff", string("good")):
            writer.write(channel, data, 1, 1)
    series = read_bag(tmp_path / "a.mcap")["/a"]
    with pytest.raises(RecordingError, match=r"A message on /a is no std_msgs/msg/String"):
        series.field("data")
    with pytest.raises(RecordingError, match=r"A message on /a is no std_msgs/msg/String"):
        next(series.messages())


def test_a_topic_in_another_encoding(tmp_path: Path) -> None:
    with (tmp_path / "a.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start("")
        schema = writer.register_schema("Thing", "jsonschema", b"{}")
        writer.add_message(writer.register_channel("/a", "json", schema), 1, b"{}", 1)
        writer.finish()
    bag = read_bag(tmp_path / "a.mcap")
    assert bag.message_count("/a") == 1
    with pytest.raises(RecordingError, match="is not in ROS 2's encoding"):
        bag["/a"]


@pytest.mark.parametrize(
    ("field", "words"),
    [
        ("pose.pose.positon.x", "no field 'pose.pose.positon.x': .*Pose has position, orientation"),
        ("", "no field ''"),
        ("child_frame_id.x", "no field 'child_frame_id.x': it goes too far"),
    ],
)
def test_a_field_that_is_not_there(path: Path, field: str, words: str) -> None:
    with pytest.raises(RecordingError, match=words):
        read_bag(path)["/odom"].field(field)


def test_a_topic_that_is_not_there(path: Path) -> None:
    bag = read_bag(path)
    for ask in (bag.__getitem__, bag.times, bag.messages, bag.message_count):
        with pytest.raises(RecordingError, match="has no topic /odm: it has /silent, /odom"):
            ask("/odm")
