"""Bags are written: whole files of any size, on disks that fill up, with their QoS profiles."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from rosbags.highlevel import AnyReader
from support.command_line import finished
from support.full_disk import MakeDisk
from support.hostile.records import string
from support.made_bags import STRING, bag_of_strings
from support.raw_messages import Content

import spacerobot_ros
from spacerobot_ros.bag import (
    LATCHED,
    BagWriter,
    QosProfile,
    RecorderConfig,
    RecordingError,
    read_bag,
)
from spacerobot_ros.bag.salvage import salvage_bag

S = 10**9


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
    with BagWriter(path, RecorderConfig(compression=compression)) as writer:
        channel = writer.add_topic("/a", STRING)
        for n, text in enumerate(texts):
            writer.write(channel, string(text), n, n)
        assert writer.messages_written == len(texts)
    used = {index.compression for index in Content(path).summary.chunk_indexes}
    assert used == {"" if compression == "none" else compression}
    with AnyReader([path]) as reader:
        assert [data for _, _, data in reader.messages()] == [string(text) for text in texts]


def test_messages_are_counted_by_topic(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "a.mcap", chunk_size=200) as writer:
        one, two = writer.add_topic("/one", STRING), writer.add_topic("/two", STRING)
        for n in range(100):
            writer.write(one if n % 4 else two, string("text"), n, n)
            assert writer.messages_written == n + 1
        assert writer.message_counts == {"/one": 75, "/two": 25}
    assert writer.message_counts == {"/one": 75, "/two": 25}
    assert Content(tmp_path / "a.mcap").statistics.chunk_count > 10


def test_a_known_topic_keeps_its_channel_and_its_type(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "a.mcap") as writer:
        channel = writer.add_topic("/a", STRING)
        assert writer.add_topic("/a", STRING) == channel
        assert writer.add_topic("/b", STRING) != channel
        with pytest.raises(RecordingError, match="not nav_msgs/msg/Path"):
            writer.add_topic("/a", "nav_msgs/msg/Path")


def test_a_type_that_is_not_installed_leaves_no_trace(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "a.mcap") as writer:
        with pytest.raises(RecordingError, match="no_such_msgs"):
            writer.add_topic("/a", "no_such_msgs/msg/A")
        writer.write(writer.add_topic("/a", STRING), string("a"), 1, 1)
    assert Content(tmp_path / "a.mcap").data == [string("a")]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((99, b"", 1, 1), "has no channel 99"),
        ((70000, b"", 1, 1), "has no channel 70000"),
        ((1, b"", -1, 1), "cannot store negative times"),
        ((1, b"", 1, -1), "cannot store negative times"),
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
    assert Content(tmp_path / "a.mcap").data == [string("good")]


def test_attachments_and_metadata_between_messages(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    urdf = b"<robot/>" * 20000
    with BagWriter(path, chunk_size=100) as writer:
        channel = writer.add_topic("/a", STRING)
        writer.write(channel, string("one"), 1, 1)
        writer.add_attachment("robot.urdf", urdf, "application/xml", 5)
        writer.add_metadata("parameters", {"plant.seed": "42", "Δ": ""})
        writer.write(channel, string("two"), 2, 2)
    content = Content(path)
    assert content.data == [string("one"), string("two")]
    assert content.attachments == {"robot.urdf": (5, "application/xml", urdf)}
    assert content.metadata["parameters"] == {"plant.seed": "42", "Δ": ""}


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
    assert Content(tmp_path / "a.mcap").data == [string("a")]


def test_a_bag_is_replaced_by_default(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(b"x" * 100_000)
    with BagWriter(path):
        pass
    assert Content(path).data == []


def test_where_no_bag_can_be_made(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(RecordingError, match="Cannot create the bag"):
        BagWriter(tmp_path / "file" / "a.mcap")


@pytest.mark.parametrize("limit", [{"max_size": 0.02}, {"max_duration": 1.0}])
def test_a_bag_is_split_into_complete_files(tmp_path: Path, limit: dict[str, float]) -> None:
    count, step = 3000, 10**7
    config = RecorderConfig(compression="none", **limit)  # type: ignore[arg-type]
    with BagWriter(tmp_path / "a.mcap", config, chunk_size=2000) as writer:
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
        content = Content(path)
        assert content.attachments == {"robot.urdf": (0, "application/xml", b"<robot/>")}
        found += [int.from_bytes(data, "little") for data in content.data]
        assert ("late" in content.metadata) == (found[-1] >= 2000)
        # A chunk of 2000 bytes holds some fifty messages of 10 ms.
        if "max_size" in limit:
            assert path.stat().st_size < 20_000 + 10_000
        else:
            assert content.messages[-1][1] - content.messages[0][1] < 1.7e9
    assert found == list(range(count))


def test_a_file_is_full_when_it_lasts_exactly_as_long_as_it_may(tmp_path: Path) -> None:
    at = [0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0]
    bag_of_strings(tmp_path / "a.mcap", at, config=RecorderConfig(max_duration=1.0))
    files = [Content(tmp_path / f"a_{n}.mcap") for n in range(3)]
    times = [[log_ns / S for _, log_ns, *_ in content.messages] for content in files]
    assert times == [[0.0, 0.5, 1.0], [1.5, 2.0, 2.5], [3.0]]


def test_the_statistics_of_messages_that_were_written_out_of_order(tmp_path: Path) -> None:
    path = bag_of_strings(tmp_path / "a.mcap", [5.0, 9.0, 3.0, 4.0])
    content = Content(path)
    statistics = content.statistics
    assert (statistics.message_start_time, statistics.message_end_time) == (3 * S, 9 * S)
    assert (statistics.channel_count, statistics.schema_count) == (2, 1)
    assert (statistics.chunk_count, statistics.message_count) == (4, 4)
    told = yaml.safe_load(content.metadata["rosbag2"]["serialized_metadata"])
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


# -- disks that fill up ------------------------------------------------------------------------


FULL = r"No space left on device; 'spacerobot salvage \S+a.mcap' recovers the \d+ messages? already"


def fill(writer: BagWriter, channel: int) -> int:
    """Write until the disk is full; return how many messages were accepted before."""
    accepted = 0

    def write_on() -> None:
        nonlocal accepted
        for accepted in range(100_000):
            writer.write(channel, string(f"{accepted:06d}" + "x" * 90), accepted, accepted)

    with pytest.raises(RecordingError, match=FULL):
        write_on()
    return accepted


def test_on_a_full_disk_what_fits_is_salvaged(tmp_path: Path, make_disk: MakeDisk) -> None:
    disk = make_disk(1_000_000)
    writer = BagWriter(tmp_path / "a.mcap", RecorderConfig(compression="none"), chunk_size=65536)
    channel = writer.add_topic("/a", STRING)
    accepted = fill(writer, channel)
    kept = writer.messages_written
    for add in all_additions(writer, channel):
        with pytest.raises(RecordingError, match="No space left on device"):
            add()
    writer.close()
    writer.close()
    assert (tmp_path / "a.mcap").stat().st_size <= disk.size
    made = salvage_bag(tmp_path / "a.mcap")
    assert (made.messages, made.lost_chunks, made.lost_bytes) == (kept, 0, 0)
    with AnyReader([made.path]) as reader:
        data = [bytes(data[8:14]) for _, _, data in reader.messages()]
    assert data == [b"%06d" % n for n in range(kept)]
    # Nothing but the chunk in progress was lost.
    assert accepted - 65536 // len(string("x" * 96)) <= kept <= accepted


def test_a_disk_without_room_for_a_file_keeps_what_was_before(
    tmp_path: Path, make_disk: MakeDisk
) -> None:
    make_disk(100_000)
    writer = BagWriter(tmp_path / "a.mcap")
    channel = writer.add_topic("/a", STRING)
    writer.write(channel, string("kept"), 1, 1)
    writer.flush()
    writer.write(channel, string("lost"), 2, 2)
    with pytest.raises(RecordingError, match=r"recovers the 1 message already written\."):
        writer.add_attachment("lost", bytes(200_000), "text/plain", 3)
    assert writer.message_counts == {"/a": 1}
    writer.close()
    assert Content(salvage_bag(tmp_path / "a.mcap").path).data == [string("kept")]


@pytest.mark.parametrize("size", [10, 100])
def test_a_bag_that_a_disk_is_too_full_to_begin_is_not_held_open(
    tmp_path: Path, make_disk: MakeDisk, size: int
) -> None:
    """A head takes some 40 bytes, and the metadata after it some hundreds."""
    make_disk(size)
    bag = tmp_path / "a.mcap"
    with pytest.raises(RecordingError, match=r"a\.mcap: No space left on device"):
        BagWriter(bag)
    assert not [path for path in Path("/proc/self/fd").iterdir() if path.resolve() == bag]


def test_the_limit_of_a_real_file(tmp_path: Path) -> None:
    program = """
import resource, sys
import spacerobot_ros
from spacerobot_ros.bag import BagWriter, RecordingError
from spacerobot_ros.bag import RecorderConfig
resource.setrlimit(resource.RLIMIT_FSIZE, (500_000, 500_000))
writer = BagWriter(sys.argv[1], RecorderConfig(compression="none"), chunk_size=65536)
channel = writer.add_topic("/a", "std_msgs/msg/String")
try:
    for n in range(1_000_000):
        writer.write(channel, bytes(100), n, n)
except RecordingError as error:
    print(error)
writer.close()
print(writer.messages_written)
"""
    done = finished(
        [sys.executable, "-c", program, str(tmp_path / "a.mcap")],
        cwd=Path(spacerobot_ros.__file__).parents[1],
        timeout=60,
    )
    message, kept = done.stdout.splitlines()
    assert message.startswith("Cannot write the bag")
    assert "File too large" in message
    assert int(kept) > 2000
    assert len(Content(salvage_bag(tmp_path / "a.mcap").path).data) == int(kept)


# -- quality of service as bags hold it --------------------------------------------------------

# As rosbag2 of Humble wrote it: rmw's numbers, an infinite duration as the largest numbers.
HUMBLE = """- history: 1
  depth: 5
  reliability: 2
  durability: 1
  deadline:
    sec: 9223372036
    nsec: 854775807
  lifespan:
    sec: 1
    nsec: 500000000
  liveliness: 3
  liveliness_lease_duration:
    sec: 9223372036
    nsec: 854775807
  avoid_ros_namespace_conventions: false"""


@pytest.mark.parametrize(
    "profile",
    [QosProfile(), LATCHED, QosProfile("unknown", 0, "best_effort", liveliness="manual_by_topic")],
)
def test_what_is_written_is_read_back(profile: QosProfile) -> None:
    other = QosProfile(depth=77)
    assert QosProfile.from_yaml(profile.to_yaml()) == [profile]
    assert QosProfile.from_yaml(f"{profile.to_yaml()}\n{other.to_yaml()}") == [profile, other]


def test_numbers_of_earlier_versions_are_read() -> None:
    assert QosProfile.from_yaml(HUMBLE) == [
        QosProfile(
            history="keep_last",
            depth=5,
            reliability="best_effort",
            durability="transient_local",
            liveliness="manual_by_topic",
        )
    ]
    for word in ("9", "sometimes"):
        assert QosProfile.from_yaml(f"- history: {word}")[0].history == "unknown"
    assert QosProfile.from_yaml("") == []


@pytest.mark.parametrize("text", ["- [", "- 5", "- depth: -1", "- deadline: 3", "7"])
def test_what_is_no_profile_is_refused(text: str) -> None:
    with pytest.raises(RecordingError):
        QosProfile.from_yaml(text)


def test_the_longest_durations_of_any_middleware_are_read() -> None:
    """Connext's infinite duration, for one, is more than a duration of ROS holds."""
    text = (
        "- deadline: {sec: 9223372036854775807, nsec: 4294967295}\n  lifespan: {sec: .inf, nsec: 5}"
    )
    assert QosProfile.from_yaml(text) == [QosProfile()]
