"""The file of a bag: never written over, never shared, missed at once, whole after any kill."""

from __future__ import annotations

import errno
import io
import os
import signal
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from support.full_disk import MakeDisk
from support.hostile.records import string
from support.made_bags import STRING

from spacerobot_ros.bag import (
    BagWriter,
    RecorderConfig,
    Recording,
    RecordingError,
    free_name,
    mcap_file,
    read_bag,
)
from spacerobot_ros.bag.salvage import is_complete, salvage_bag


def numbers(path: Path) -> list[int]:
    return [int(data[8:14]) for *_, data in read_bag(path).raw_messages(["/a"])]


def make_bag(path: Path, count: int = 3) -> bytes:
    with BagWriter(path) as writer:
        channel = writer.add_topic("/a", STRING)
        for n in range(count):
            writer.write(channel, string(f"{n:06d}"), n, n)
    return path.read_bytes()


# -- names -------------------------------------------------------------------------------------


def test_a_bag_that_is_there_is_kept_and_the_next_name_taken(tmp_path: Path) -> None:
    path = tmp_path / "crash.mcap"
    before = make_bag(path)
    for number in (1, 2):
        with BagWriter(path, next_free=True) as writer:
            assert writer.path == tmp_path / f"crash-{number}.mcap"
    assert path.read_bytes() == before
    assert free_name(path) == tmp_path / "crash-3.mcap"
    with pytest.raises(RecordingError, match=r"crash\.mcap: File exists; name another one"):
        BagWriter(path, overwrite=False)
    assert path.read_bytes() == before


def test_a_dangling_link_is_a_name_that_is_taken(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    path.symlink_to(tmp_path / "elsewhere.mcap")
    with pytest.raises(RecordingError, match="File exists"):
        BagWriter(path, overwrite=False)
    assert not (tmp_path / "elsewhere.mcap").exists()
    assert free_name(path) == tmp_path / "a-1.mcap"


def test_a_bag_is_read_after_its_recorder_has_stopped(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with BagWriter(path) as writer:
        writer.write(writer.add_topic("/a", STRING), string("000001"), 1, 1)
        writer.flush()
        with pytest.raises(RecordingError, match="is still being written: stop its recorder"):
            read_bag(path)
    assert numbers(path) == [1]


@pytest.mark.parametrize("max_size", [0.0, 0.01])
@pytest.mark.parametrize("overwrite", [True, False])
def test_two_recorders_do_not_share_a_file(
    tmp_path: Path, max_size: float, overwrite: bool
) -> None:
    path, config = tmp_path / "a.mcap", RecorderConfig(max_size=max_size)
    with BagWriter(path, config, overwrite=overwrite) as first:
        channel = first.add_topic("/a", STRING)
        first.write(channel, string("000007"), 1, 1)
        with pytest.raises(RecordingError, match=r"is being written by another|File exists"):
            BagWriter(path, config, overwrite=overwrite)
        with BagWriter(path, config, overwrite=overwrite, next_free=True) as second:
            assert second.path.name.startswith("a-1")
            assert second.path != first.path
    assert numbers(first.path) == [7]


def test_a_split_bag_is_not_mixed_with_another(tmp_path: Path) -> None:
    old = make_bag(tmp_path / "a_2.mcap")
    with pytest.raises(RecordingError, match=r"a_2\.mcap: File exists"):
        BagWriter(tmp_path / "a.mcap", RecorderConfig(max_size=0.001), overwrite=False)
    config = RecorderConfig(max_size=0.001)
    with BagWriter(tmp_path / "a.mcap", config, next_free=True) as writer:
        assert writer.path == tmp_path / "a-1_0.mcap"
    assert (tmp_path / "a_2.mcap").read_bytes() == old


def test_a_file_in_the_way_of_a_split_is_stepped_over(tmp_path: Path) -> None:
    config = RecorderConfig(max_size=0.0015)
    with BagWriter(tmp_path / "a.mcap", config, chunk_size=500, overwrite=False) as writer:
        channel = writer.add_topic("/a", STRING)
        old = make_bag(tmp_path / "a_1.mcap")
        for n in range(60):
            writer.write(channel, string(f"{n:06d}" + "x" * 90), n, n)
    assert (tmp_path / "a_1.mcap").read_bytes() == old
    parts = sorted(tmp_path.glob("a_*.mcap"), key=lambda path: int(path.stem[2:]))
    assert len(parts) > 3
    found = [n for path in parts if path.name != "a_1.mcap" for n in numbers(path)]
    assert found == list(range(60))


# -- a file that goes while it is written ------------------------------------------------------


def replace(path: Path) -> None:
    other = path.with_suffix(".other")
    other.write_bytes(path.read_bytes())
    other.replace(path)


def move(path: Path) -> None:
    path.rename(path.with_suffix(".moved"))


def remove_folder(path: Path) -> None:
    path.unlink()
    path.parent.rmdir()


def replace_folder(path: Path) -> None:
    path.parent.rename(path.parent.with_name("other"))
    path.parent.mkdir()


def cut(path: Path) -> None:
    os.truncate(path, 20)


def lengthen(path: Path) -> None:
    with path.open("ab") as file:
        file.write(b"x")


def link_to_itself(path: Path) -> None:
    path.unlink()
    path.symlink_to(path)


GONE = "it was removed or moved"


@pytest.mark.parametrize(
    ("harm", "reason"),
    [
        (Path.unlink, GONE),
        (replace, "another file replaced it"),
        (move, GONE),
        (remove_folder, GONE),
        (replace_folder, GONE),
        (cut, "it has 20 bytes, but "),
        (lengthen, "were written"),
        (link_to_itself, os.strerror(errno.ELOOP)),
    ],
)
def test_a_file_that_goes_while_it_is_written_is_missed(
    tmp_path: Path, harm: Callable[[Path], None], reason: str
) -> None:
    path = tmp_path / "folder" / "a.mcap"
    failures: list[RecordingError] = []
    recording = Recording(BagWriter(path), 0.0, failures.append)
    channel = recording.writer.add_topic("/a", STRING)
    recording.start()
    recording.set_clock(5)
    recording.record(channel, string("000001"))
    recording.flush(True)
    recording.check()
    assert not failures
    harm(path)
    recording.check()
    recording.check()
    (failure,) = failures
    assert str(failure).startswith(f"The bag {path} was lost during recording: ")
    assert reason in str(failure)
    assert recording.failure is failure
    assert not recording.running
    recording.close()


def test_a_file_that_goes_just_before_the_end_is_missed(tmp_path: Path) -> None:
    recording = Recording(BagWriter(tmp_path / "a.mcap"), 0.0)
    recording.start()
    (tmp_path / "a.mcap").unlink()
    recording.close()
    assert recording.failure is not None


def test_a_disk_that_is_full_at_the_very_end_is_a_failure(
    tmp_path: Path, make_disk: MakeDisk
) -> None:
    disk, path = make_disk(1_000_000), tmp_path / "a.mcap"
    recording = Recording(BagWriter(path), 0.0)
    channel = recording.writer.add_topic("/a", STRING)
    recording.start()
    recording.set_clock(5)
    recording.record(channel, string("000007"))
    recording.flush(True)
    # Enough for the counts of the recording, and not for the end of the bag.
    disk.size = path.stat().st_size + 200
    with pytest.raises(RecordingError, match="No space left on device"):
        recording.close()
    assert recording.failure is not None
    recording.close()
    disk.size = 1_000_000
    assert saved(path) == [7]


# -- kills -------------------------------------------------------------------------------------


def record_until_killed(path: Path, step: int, share: float) -> None:
    """Write to the end, or be killed in a step of it, when a share of its bytes is on the disk.

    Every message that was handed to the operating system is counted in a file beside the bag.
    """
    left = step

    class File(io.FileIO):
        def write(self, data: Any) -> int:
            nonlocal left
            left -= 1
            if left < 0:
                super().write(bytes(data)[: int(share * len(data))])
                os.kill(os.getpid(), signal.SIGKILL)
            return super().write(data)

    # The process of a test of its own: nothing else opens a file in this module.
    mcap_file.open = lambda descriptor, mode, buffering: File(descriptor, mode)  # type: ignore[attr-defined]
    config = RecorderConfig(compression="none", max_size=0.003)
    with BagWriter(path, config, overwrite=False) as writer:
        writer.add_attachment("robot.urdf", b"<robot/>", "application/xml", 5)
        channel = writer.add_topic("/a", STRING)
        for n in range(40):
            writer.write(channel, string(f"{n:06d}" + "x" * 90), n, n)
            if n % 4 == 3:
                writer.flush()
                path.with_suffix(".count").write_text(f"{n + 1}")


def saved(part: Path) -> list[int]:
    if is_complete(part):
        return numbers(part)
    with suppress(RecordingError):  # Nothing is in a file that was just begun.
        return numbers(salvage_bag(part).path)
    return []


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_a_kill_in_any_step_of_a_split_loses_nothing_that_was_written(
    tmp_path: Path, share: float
) -> None:
    steps = 0
    while True:
        folder = tmp_path / f"{steps}"
        folder.mkdir()
        path = folder / "a.mcap"
        child = os.fork()
        if not child:
            record_until_killed(path, steps, share)
            os._exit(0)
        status = os.waitpid(child, 0)[1]
        count = path.with_suffix(".count")
        written = int(count.read_text()) if count.exists() else 0
        found: list[int] = []
        parts = sorted(folder.glob("a_*.mcap"), key=lambda path: int(path.stem[2:]))
        for part in parts:
            found += saved(part)
        assert found == list(range(len(found)))
        assert len(found) >= written, f"step {steps}"
        if not status:
            break
        assert os.waitstatus_to_exitcode(status) == -signal.SIGKILL
        steps += 1
    assert len(parts) >= 3
    assert found == list(range(40))
    assert steps > 20
