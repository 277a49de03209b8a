from __future__ import annotations

import contextlib
import errno
import io
import os
import signal
import struct
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from mcap.exceptions import EndOfFile
from mcap.reader import make_reader
from mcap.records import Message
from mcap.stream_reader import StreamReader
from rosbags.highlevel import AnyReader

import spacerobot_ros
from spacerobot_ros.bag import BagWriter, RecordingError

STRING = "std_msgs/msg/String"

FULL = r"No space left on device; the \d+ messages before that are safe in it\.$"


def string(text: str) -> bytes:
    """Serialise a std_msgs/String by hand."""
    data = text.encode() + b"\0"
    return b"\0\1\0\0" + struct.pack("<I", len(data)) + data


def salvaged(path: Path) -> list[bytes]:
    """Read the messages of a file, complete or cut."""
    found = []
    with path.open("rb") as file, contextlib.suppress(EndOfFile):
        for record in StreamReader(file, validate_crcs=True).records:
            if isinstance(record, Message):
                found.append(record.data)
    return found


class Disk:
    """A disk of some bytes, in place of the one that `open` opens files on."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, size: int) -> None:
        self.size = size
        disk = self

        class File(io.FileIO):
            def write(self, data: Any) -> int:
                free = disk.size - self.tell()
                if free <= 0:
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
                return super().write(bytes(data)[:free])

        def fake_open(path: Path, mode: str, buffering: int) -> File:
            assert buffering == 0
            return File(path, mode)

        monkeypatch.setattr("spacerobot_ros.bag.mcap_file.open", fake_open, raising=False)


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


def test_a_full_disk_leaves_a_complete_bag_of_what_fits(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    disk = Disk(monkeypatch, 1_000_000)
    writer = BagWriter(tmp_path / "a.mcap", compression="none")
    channel = writer.add_topic("/a", STRING)
    accepted = fill(writer, channel)
    kept = writer.messages_written
    for _ in range(2):
        with pytest.raises(RecordingError, match="No space left on device"):
            writer.write(channel, b"", 1, 1)
    with pytest.raises(RecordingError, match="No space left on device"):
        writer.add_topic("/new", STRING)
    with pytest.raises(RecordingError, match="No space left on device"):
        writer.add_attachment("a", b"", "text/plain", 1)
    with pytest.raises(RecordingError, match="No space left on device"):
        writer.add_metadata("a", {})
    with pytest.raises(RecordingError, match="No space left on device"):
        writer.flush()
    writer.close()
    writer.close()
    assert (tmp_path / "a.mcap").stat().st_size <= disk.size
    with AnyReader([tmp_path / "a.mcap"]) as reader:
        data = [bytes(data[8:14]) for _, _, data in reader.messages()]
    assert data == [b"%06d" % n for n in range(kept)]
    with (tmp_path / "a.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == kept
    assert summary.statistics.channel_message_counts == {channel: kept}
    assert summary.statistics.message_end_time == kept - 1
    # Nothing but the chunk in progress was lost.
    assert accepted - 65536 // len(string("x" * 96)) <= kept <= accepted


def test_a_disk_without_room_for_a_file_leaves_a_complete_bag(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    Disk(monkeypatch, 100_000)
    writer = BagWriter(tmp_path / "a.mcap")
    channel = writer.add_topic("/a", STRING)
    writer.write(channel, string("kept"), 1, 1)
    writer.flush()
    writer.add_metadata("kept", {})
    writer.write(channel, string("lost"), 2, 2)
    assert writer.bytes_waiting > 0
    with pytest.raises(RecordingError, match="the 1 messages before that are safe in it"):
        writer.add_attachment("lost", bytes(200_000), "text/plain", 3)
    assert writer.message_counts == {"/a": 1}
    writer.close()
    with (tmp_path / "a.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        assert [message.data for _, _, message in reader.iter_messages()] == [string("kept")]
        assert list(reader.iter_attachments()) == []
        assert [metadata.name for metadata in reader.iter_metadata()] == ["rosbag2", "kept"]
        summary = reader.get_summary()
    assert summary is not None
    assert summary.statistics is not None
    found = summary.statistics
    assert (found.message_count, found.attachment_count, found.metadata_count) == (1, 0, 2)


def test_a_disk_without_room_for_the_summary_leaves_the_chunks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    disk = Disk(monkeypatch, 1_000_000)
    writer = BagWriter(tmp_path / "a.mcap", compression="none")
    fill(writer, writer.add_topic("/a", STRING))
    size = (tmp_path / "a.mcap").stat().st_size
    disk.size = size + 10
    writer.close()
    writer.close()
    assert (tmp_path / "a.mcap").stat().st_size == size
    assert [data[8:14] for data in salvaged(tmp_path / "a.mcap")] == [
        b"%06d" % n for n in range(writer.messages_written)
    ]


def test_a_disk_that_fills_up_on_closing_is_reported_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    disk = Disk(monkeypatch, 1_000_000)
    writer = BagWriter(tmp_path / "a.mcap")
    writer.write(writer.add_topic("/a", STRING), string("kept"), 1, 1)
    writer.flush()
    disk.size = (tmp_path / "a.mcap").stat().st_size + 5
    with pytest.raises(RecordingError, match="No space left on device"):
        writer.close()
    writer.close()
    assert salvaged(tmp_path / "a.mcap") == [string("kept")]


def test_a_disk_that_is_full_from_the_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    Disk(monkeypatch, 10)
    with pytest.raises(RecordingError, match=r"a\.mcap: No space left on device"):
        BagWriter(tmp_path / "a.mcap")


def test_the_limit_of_a_real_file(tmp_path: Path) -> None:
    program = """
import resource, sys
import spacerobot_ros
from spacerobot_ros.bag import BagWriter, RecordingError
resource.setrlimit(resource.RLIMIT_FSIZE, (500_000, 500_000))
writer = BagWriter(sys.argv[1], compression="none")
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
    with (tmp_path / "a.mcap").open("rb") as file:
        assert len(list(make_reader(file).iter_messages())) == int(kept)


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
writer = BagWriter(sys.argv[1])
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
writer = BagWriter(sys.argv[1])
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
