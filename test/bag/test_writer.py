from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader

from spacerobot_ros.bag import BagWriter, RecordingError

STRING = "std_msgs/msg/String"


def string(text: str) -> bytes:
    """Serialise a std_msgs/String by hand."""
    data = text.encode() + b"\0"
    return b"\0\1\0\0" + struct.pack("<I", len(data)) + data


def data_of(path: Path) -> list[bytes]:
    with path.open("rb") as file:
        return [message.data for _, _, message in make_reader(file).iter_messages()]


def all_additions(writer: BagWriter, channel: int) -> list[Callable[[], Any]]:
    return [
        lambda: writer.write(channel, b"", 1, 1),
        lambda: writer.add_topic("/new", STRING),
        lambda: writer.add_attachment("a", b"", "text/plain", 1),
        lambda: writer.add_metadata("a", {}),
        writer.flush,
    ]


@pytest.mark.parametrize("compression", ["zstd", "lz4", "none"])
def test_every_compression_is_read_back(tmp_path: Path, compression: str) -> None:
    path = tmp_path / "deep" / "folder" / "a.mcap"
    texts = [f"message {n} " + "x" * (n % 50) for n in range(3000)]
    with BagWriter(path, compression=compression) as writer:
        channel = writer.add_topic("/a", STRING)
        for n, text in enumerate(texts):
            writer.write(channel, string(text), n, n)
        assert writer.messages_written == len(texts)
    assert data_of(path) == [string(text) for text in texts]
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert {index.compression for index in summary.chunk_indexes} == {
        "" if compression == "none" else compression
    }
    with AnyReader([path]) as reader:
        assert [data for _, _, data in reader.messages()] == [string(text) for text in texts]


def test_what_is_not_bytes_leaves_no_trace(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "a.mcap") as writer:
        channel = writer.add_topic("/a", STRING)
        writer.write(channel, string("before"), 1, 1)
        with pytest.raises(TypeError):
            writer.write(channel, "text", 2, 2)  # type: ignore[arg-type]
        writer.write(channel, bytearray(string("after")), 3, 3)  # type: ignore[arg-type]
    assert data_of(tmp_path / "a.mcap") == [string("before"), string("after")]


def test_messages_are_counted_by_topic(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "a.mcap", chunk_size=200) as writer:
        one, two = writer.add_topic("/one", STRING), writer.add_topic("/two", STRING)
        for n in range(100):
            writer.write(one if n % 4 else two, string("text"), n, n)
            assert writer.messages_written == n + 1
        assert writer.message_counts == {"/one": 75, "/two": 25}
    assert writer.message_counts == {"/one": 75, "/two": 25}
    with (tmp_path / "a.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.chunk_count > 10
    assert summary.statistics.message_start_time == 0
    assert summary.statistics.message_end_time == 99


def test_a_known_topic_keeps_its_channel_and_its_type(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "a.mcap") as writer:
        channel = writer.add_topic("/a", STRING)
        assert writer.add_topic("/a", STRING) == channel
        assert writer.add_topic("/b", STRING) != channel
        with pytest.raises(RecordingError, match="cannot have nav_msgs/msg/Path too"):
            writer.add_topic("/a", "nav_msgs/msg/Path")


def test_a_type_that_is_not_installed_leaves_no_trace(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "a.mcap") as writer:
        with pytest.raises(RecordingError, match="no_such_msgs"):
            writer.add_topic("/a", "no_such_msgs/msg/A")
        writer.write(writer.add_topic("/a", STRING), string("a"), 1, 1)
    assert data_of(tmp_path / "a.mcap") == [string("a")]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((99, b"", 1, 1), "has no channel 99"),
        ((70000, b"", 1, 1), "has no channel 70000"),
        ((1, b"", -1, 1), "non-negative numbers of nanoseconds"),
        ((1, b"", 1, 2**64), "non-negative numbers of nanoseconds"),
        ((1, b"", 1.5, 1), "non-negative numbers of nanoseconds"),
    ],
)
def test_what_no_bag_can_hold_is_refused(
    tmp_path: Path, arguments: tuple[Any, ...], words: str
) -> None:
    with BagWriter(tmp_path / "a.mcap") as writer:
        channel = writer.add_topic("/a", STRING)
        with pytest.raises(RecordingError, match=words):
            writer.write(*arguments)
        writer.write(channel, string("good"), 1, 1)
    assert data_of(tmp_path / "a.mcap") == [string("good")]


def test_attachments_and_metadata_between_messages(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    urdf = b"<robot/>" * 20000
    with BagWriter(path, chunk_size=100) as writer:
        channel = writer.add_topic("/a", STRING)
        writer.write(channel, string("one"), 1, 1)
        writer.add_attachment("robot.urdf", urdf, "application/xml", 5)
        writer.add_metadata("parameters", {"plant.seed": "42", "Δ": ""})
        writer.write(channel, string("two"), 2, 2)
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        (attachment,) = reader.iter_attachments()
        metadata = {record.name: record.metadata for record in reader.iter_metadata()}
        assert [m.data for _, _, m in reader.iter_messages()] == [string("one"), string("two")]
    assert attachment.name == "robot.urdf"
    assert attachment.media_type == "application/xml"
    assert attachment.log_time == 5
    assert attachment.data == urdf
    assert metadata["parameters"] == {"plant.seed": "42", "Δ": ""}


def test_a_bag_without_messages_opens(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "a.mcap") as writer:
        writer.add_topic("/a", STRING)
    with AnyReader([tmp_path / "a.mcap"]) as reader:
        assert [c.topic for c in reader.connections] == ["/a"]
        assert list(reader.messages()) == []


def test_a_closed_bag_takes_nothing(tmp_path: Path) -> None:
    writer = BagWriter(tmp_path / "a.mcap")
    channel = writer.add_topic("/a", STRING)
    writer.close()
    content = (tmp_path / "a.mcap").read_bytes()
    writer.close()
    for call in all_additions(writer, channel):
        with pytest.raises(RecordingError, match=r"a\.mcap is closed\."):
            call()
    assert (tmp_path / "a.mcap").read_bytes() == content


def test_an_error_in_the_flight_still_completes_the_bag(tmp_path: Path) -> None:
    def flight() -> None:
        with BagWriter(tmp_path / "a.mcap") as writer:
            writer.write(writer.add_topic("/a", STRING), string("a"), 1, 1)
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        flight()
    with AnyReader([tmp_path / "a.mcap"]) as reader:
        assert reader.message_count == 1


def test_a_bag_is_replaced_unless_it_is_to_be_kept(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(b"x" * 100_000)
    with pytest.raises(RecordingError, match=r"Cannot make the bag .*: File exists"):
        BagWriter(path, overwrite=False)
    assert path.read_bytes() == b"x" * 100_000
    with BagWriter(path):
        pass
    with AnyReader([path]) as reader:
        assert reader.message_count == 0
    BagWriter(tmp_path / "new.mcap", overwrite=False).close()


def test_where_no_bag_can_be_made(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(RecordingError, match="Cannot make the bag"):
        BagWriter(tmp_path)
    with pytest.raises(RecordingError, match="Cannot make the bag"):
        BagWriter(tmp_path / "file" / "a.mcap")
    with pytest.raises(RecordingError, match="'gzip' is not one of zstd, lz4, none"):
        BagWriter(tmp_path / "a.mcap", compression="gzip")


@pytest.mark.parametrize("limit", [{"max_size": 20_000}, {"max_duration_ns": 10**9}])
def test_a_bag_is_split_into_complete_files(tmp_path: Path, limit: dict[str, int]) -> None:
    count, step = 3000, 10**7
    with BagWriter(
        tmp_path / "a.mcap",
        chunk_size=2000,
        compression="none",
        **limit,  # type: ignore[arg-type]
    ) as writer:
        writer.add_attachment("robot.urdf", b"<robot/>", "application/xml", 0)
        channel = writer.add_topic("/a", "std_msgs/msg/String")
        for n in range(count):
            if n == 2000:
                # Metadata and topics of later files.
                writer.add_metadata("late", {"n": "2000"})
                writer.add_topic("/b", "std_msgs/msg/String")
            writer.write(channel, n.to_bytes(8, "little"), n * step, n * step)
        assert writer.messages_written == count
    files = sorted(tmp_path.iterdir(), key=lambda path: int(path.stem.split("_")[1]))
    assert [path.name for path in files] == [f"a_{k}.mcap" for k in range(len(files))]
    assert len(files) > 4
    found = []
    for path in files:
        with path.open("rb") as file:
            reader = make_reader(file)
            summary = reader.get_summary()
            assert summary is not None
            assert summary.statistics is not None
            messages = [message for _, _, message in reader.iter_messages()]
            assert summary.statistics.message_count == len(messages) > 0
            assert [a.data for a in reader.iter_attachments()] == [b"<robot/>"]
            names = [metadata.name for metadata in reader.iter_metadata()]
        found += [int.from_bytes(message.data, "little") for message in messages]
        assert ("late" in names) == (found[-1] >= 2000)
        # A chunk of 2000 bytes holds some fifty messages of 10 ms.
        if "max_size" in limit:
            assert path.stat().st_size < 20_000 + 10_000
        else:
            assert messages[-1].log_time - messages[0].log_time < 1.7e9
    assert found == list(range(count))
