"""Bags are written: whole files of any size, on disks that fill up, with their QoS profiles."""

from __future__ import annotations

import contextlib
import signal
import struct
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from mcap.exceptions import EndOfFile
from mcap.reader import NonSeekingReader, make_reader
from mcap.records import Message
from mcap.stream_reader import StreamReader
from rosbags.highlevel import AnyReader
from support.full_disk import MakeDisk
from support.hostile.records import string

import spacerobot_ros
from spacerobot_ros.bag import LATCHED, BagWriter, QosProfile, RecordingError, read_bag
from spacerobot_ros.bag.config import RecorderConfig
from spacerobot_ros.bag.salvage import salvage_bag

STRING = "std_msgs/msg/String"
S = 10**9


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
    with BagWriter(path, RecorderConfig(compression=compression)) as writer:
        channel = writer.add_topic("/a", STRING)
        for n, text in enumerate(texts):
            writer.write(channel, string(text), n, n)
        assert writer.messages_written == len(texts)
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert {index.compression for index in summary.chunk_indexes} == {
        "" if compression == "none" else compression
    }
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
        with pytest.raises(RecordingError, match="not nav_msgs/msg/Path"):
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


def test_a_bag_is_replaced_by_default(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(b"x" * 100_000)
    with BagWriter(path):
        pass
    with AnyReader([path]) as reader:
        assert reader.message_count == 0


def test_where_no_bag_can_be_made(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(RecordingError, match="Cannot create the bag"):
        BagWriter(tmp_path)
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


def bag_of(path: Path, times: list[float], max_duration: float = 0.0) -> Path:
    config = RecorderConfig(max_duration=max_duration)
    with BagWriter(path, config, chunk_size=1) as writer:
        writer.add_topic("/silent", STRING)
        channel = writer.add_topic("/a", STRING)
        for n, time in enumerate(times):
            writer.write(channel, string(f"{n}"), round(time * S), round(time * S))
    return path


def test_a_file_is_full_when_it_lasts_exactly_as_long_as_it_may(tmp_path: Path) -> None:
    bag_of(tmp_path / "a.mcap", [0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0], max_duration=1.0)
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


# -- disks that fill up, and kills -------------------------------------------------------------


FULL = r"No space left on device; 'spacerobot salvage \S+a.mcap' recovers the \d+ messages? already"


def salvaged(path: Path) -> list[bytes]:
    """Read the messages of a file, complete or cut."""
    found = []
    with path.open("rb") as file, contextlib.suppress(EndOfFile, struct.error):
        for record in StreamReader(file, validate_crcs=True).records:
            if isinstance(record, Message):
                found.append(record.data)
    return found


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
    for add in (
        lambda: writer.write(channel, b"", 1, 1),
        lambda: writer.add_topic("/new", STRING),
        lambda: writer.add_attachment("a", b"", "text/plain", 1),
        lambda: writer.add_metadata("a", {}),
        writer.flush,
    ):
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
    assert salvaged(tmp_path / "a.mcap") == [string("kept")]


def test_a_disk_that_fills_up_on_closing_is_reported_once(
    tmp_path: Path, make_disk: MakeDisk
) -> None:
    disk = make_disk(1_000_000)
    writer = BagWriter(tmp_path / "a.mcap")
    writer.write(writer.add_topic("/a", STRING), string("kept"), 1, 1)
    writer.flush()
    disk.size = (tmp_path / "a.mcap").stat().st_size + 5
    with pytest.raises(RecordingError, match="No space left on device"):
        writer.close()
    writer.close()
    assert salvaged(tmp_path / "a.mcap") == [string("kept")]


def test_a_disk_that_is_full_from_the_start(tmp_path: Path, make_disk: MakeDisk) -> None:
    make_disk(10)
    with pytest.raises(RecordingError, match=r"a\.mcap: No space left on device"):
        BagWriter(tmp_path / "a.mcap")


def test_the_limit_of_a_real_file(tmp_path: Path) -> None:
    program = """
import resource, sys
import spacerobot_ros
from spacerobot_ros.bag import BagWriter, RecordingError
from spacerobot_ros.bag.config import RecorderConfig
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
    done = _run(program, tmp_path / "a.mcap")
    message, kept = done.communicate(timeout=60)[0].decode().splitlines()
    assert message.startswith("Cannot write the bag")
    assert "File too large" in message
    assert int(kept) > 2000
    assert len(salvaged(tmp_path / "a.mcap")) == int(kept)


def _run(program: str, *arguments: Path) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [sys.executable, "-c", program, *map(str, arguments)],
        cwd=Path(spacerobot_ros.__file__).parents[1],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    )


def test_a_kill_loses_nothing_before_a_flush(tmp_path: Path) -> None:
    program = """
import sys
import spacerobot_ros
from spacerobot_ros.bag import BagWriter
writer = BagWriter(sys.argv[1], chunk_size=65536)
channel = writer.add_topic("/a", "std_msgs/msg/String")
for n in range(777):
    writer.write(channel, n.to_bytes(8, "little"), n, n)
writer.flush()
print("flushed", flush=True)
sys.stdin.read()
"""
    with _run(program, tmp_path / "a.mcap") as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"flushed\n"
        process.send_signal(signal.SIGKILL)
        assert process.wait(timeout=60) == -signal.SIGKILL
    found = [int.from_bytes(data, "little") for data in salvaged(tmp_path / "a.mcap")]
    assert found == list(range(777))


def test_a_kill_in_mid_write_loses_the_chunk_in_progress_only(tmp_path: Path) -> None:
    program = """
import sys
import spacerobot_ros
from spacerobot_ros.bag import BagWriter
writer = BagWriter(sys.argv[1], chunk_size=65536)
channel = writer.add_topic("/a", "std_msgs/msg/String")
n = 0
while True:
    writer.write(channel, n.to_bytes(100, "little"), n, n)
    n += 1
    if n % 10_000 == 0:
        print(n, flush=True)
"""
    with _run(program, tmp_path / "a.mcap") as process:
        assert process.stdout is not None
        written = [int(process.stdout.readline()) for _ in range(3)][-1]
        process.send_signal(signal.SIGKILL)
        assert process.wait(timeout=60) == -signal.SIGKILL
    found = [int.from_bytes(data, "little") for data in salvaged(tmp_path / "a.mcap")]
    assert found == list(range(len(found)))
    # A chunk of 64 KiB holds about 500 of these.
    assert len(found) >= written - 600
    # Which of the two depends on where in a record the file ends.
    with pytest.raises((EndOfFile, struct.error)), (tmp_path / "a.mcap").open("rb") as file:
        list(StreamReader(file).records)


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
    [
        QosProfile(),
        LATCHED,
        QosProfile("unknown", 0, "best_effort", liveliness="manual_by_topic"),
    ],
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
