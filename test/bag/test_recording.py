"""Which time recorded messages carry, and when: against bags read with the MCAP library alone."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.full_disk import MakeDisk
from support.made_bags import STRING
from support.raw_messages import Content

from spacerobot_ros.bag import BagWriter, RecorderConfig, Recording, RecordingError, read_bag
from spacerobot_ros.resources import robot_file

S = 10**9
WALL = 1_700_000_000 * S


class Bench:
    """A recording of two topics against a wall clock that is set by hand."""

    def __init__(self, path: Path, clock_wait: float = 2.0) -> None:
        self.path = path
        self.wall_ns = WALL
        self.failures: list[RecordingError] = []
        self.recording = Recording(
            BagWriter(path), clock_wait, self.failures.append, wall_time=lambda: self.wall_ns
        )
        self.a, self.b = (self.recording.writer.add_topic(name, STRING) for name in ("/a", "/b"))

    def written(self) -> list[tuple[str, str, int, int]]:
        """Topic, content, log time and publish time of every message, in the order of writing."""
        self.recording.close()
        return [
            (topic, data.decode(), log_ns, published_ns)
            for topic, log_ns, published_ns, data in Content(self.path).messages
        ]


@pytest.fixture
def bench(tmp_path: Path) -> Bench:
    return Bench(tmp_path / "a.mcap")


def test_nothing_is_recorded_before_the_start_and_in_a_pause(bench: Bench) -> None:
    recording = bench.recording
    assert recording.state.value == "paused"
    recording.record(bench.a, b"early")
    recording.set_clock(3 * S)
    recording.start()
    recording.set_clock(4 * S)
    recording.record(bench.a, b"one")
    recording.pause()
    assert not recording.running
    recording.set_clock(5 * S)
    recording.record(bench.a, b"paused")
    recording.start()
    recording.record(bench.a, b"two")
    assert bench.written() == [("/a", "one", 4 * S, 4 * S), ("/a", "two", 5 * S, 5 * S)]
    assert recording.messages == 2


def test_the_last_message_of_a_latched_topic_in_a_pause_is_recorded(bench: Bench) -> None:
    recording = bench.recording
    recording.latched[bench.b] = None
    recording.record(bench.b, b"configured")
    recording.record(bench.b, b"inactive")
    assert recording.latched[bench.b] is not None
    recording.start()
    recording.set_clock(4 * S)
    recording.record(bench.b, b"running")
    recording.pause()
    recording.set_clock(5 * S)
    recording.start()  # Nothing was sent in this pause: nothing is repeated.
    recording.pause()
    recording.record(bench.b, b"latched")
    recording.set_clock(6 * S)
    recording.start()
    assert recording.latched[bench.b] is None
    texts = [(text, log_ns) for _, text, log_ns, _ in bench.written()]
    assert texts == [("inactive", 4 * S), ("running", 4 * S), ("latched", 6 * S)]


def test_what_comes_before_the_clock_carries_its_first_time(bench: Bench) -> None:
    recording = bench.recording
    recording.start()
    assert recording.state.value == "waiting"
    recording.record(bench.a, b"unstamped")
    recording.record(bench.b, b"stamped", 7)
    bench.wall_ns += 60 * S
    recording.flush(clock_is_published=True)  # It is there and has not begun: go on waiting.
    states = [recording.state]
    recording.set_clock(4 * S)
    states.append(recording.state)
    assert [state.value for state in states] == ["waiting", "on clock"]
    recording.record(bench.a, b"later", 3 * S)
    assert bench.written() == [
        ("/a", "unstamped", 4 * S, 4 * S),
        ("/b", "stamped", 4 * S, 7),
        ("/a", "later", 4 * S, 3 * S),
    ]


def test_without_a_clock_messages_carry_the_wall_time_of_their_arrival(bench: Bench) -> None:
    recording = bench.recording
    recording.start()
    recording.record(bench.a, b"one")
    bench.wall_ns += 2 * S
    recording.record(bench.b, b"two", 9)
    recording.flush(clock_is_published=False)  # Exactly the wait is not longer than the wait.
    assert recording.state.value == "waiting"
    bench.wall_ns += 1
    recording.flush(clock_is_published=False)
    assert recording.state.value == "on wall time"
    recording.set_clock(4 * S)  # Too late: a bag has one time.
    bench.wall_ns += S
    recording.record(bench.a, b"three")
    last = WALL + 3 * S + 1
    assert bench.written() == [
        ("/a", "one", WALL, WALL),
        ("/b", "two", WALL + 2 * S, 9),
        ("/a", "three", last, last),
    ]


def test_messages_from_before_the_plant_wait_for_its_clock(bench: Bench) -> None:
    recording = bench.recording
    recording.preliminary.add(bench.a)
    recording.start()
    recording.record(bench.a, b"waits for a robot")
    bench.wall_ns += 60 * S
    recording.flush(clock_is_published=False)
    assert recording.state.value == "waiting"
    recording.record(bench.b, b"pose", 7)
    bench.wall_ns += S
    recording.flush(clock_is_published=False)
    recording.set_clock(4 * S)
    assert bench.written() == [("/a", "waits for a robot", 4 * S, 4 * S), ("/b", "pose", 4 * S, 7)]


@pytest.mark.parametrize("clock", [False, True])
def test_messages_that_wait_for_a_clock_in_vain_do_not_pile_up(bench: Bench, clock: bool) -> None:
    recording, count = bench.recording, 20_000
    recording.preliminary.add(bench.a)
    recording.start()
    most = 0
    for k in range(count):
        recording.record(bench.a, b"waits for a robot")
        if k % 100 == 0:  # As the recorder does twice a second.
            recording.flush(clock_is_published=clock)
        most = max(most, len(recording.early_messages))
    assert most < count // 2
    assert recording.messages > count // 2
    assert {log_ns for *_, log_ns, _ in bench.written()} == {WALL}
    assert recording.messages == count


def test_a_pause_keeps_what_was_decided(bench: Bench) -> None:
    recording = bench.recording
    recording.start()
    recording.record(bench.a, b"one")
    recording.pause()
    bench.wall_ns += 3 * S
    recording.flush(clock_is_published=False)
    assert recording.state.value == "paused"
    recording.start()
    assert recording.state.value == "on wall time"
    assert bench.written() == [("/a", "one", WALL, WALL)]


def test_a_bag_that_ends_undecided_has_wall_time_and_its_counts(bench: Bench) -> None:
    recording = bench.recording
    recording.start()
    recording.record(bench.a, b"one")
    recording.lost["/b"] += 3
    assert bench.written() == [("/a", "one", WALL, WALL)]
    assert Content(bench.path).metadata["recorder"] == {"messages": "1", "messages_lost": "3"}
    assert recording.state.value == "closed"
    recording.start()
    recording.record(bench.a, b"after")
    recording.describe("after", {"a": "b"})
    recording.close()
    assert recording.state.value == "closed"
    assert recording.messages == 1


def test_files_carry_the_latest_time(bench: Bench) -> None:
    recording = bench.recording
    recording.start()
    recording.set_clock(5 * S)
    recording.attach("robot.urdf", b"<robot/>", "application/xml")
    assert recording.attached == {"robot.urdf"}
    recording.close()
    attached = Content(bench.path).attachments
    assert attached == {"robot.urdf": (5 * S, "application/xml", b"<robot/>")}


@pytest.mark.parametrize("size", [70_000, 6_000])
def test_a_disk_that_refuses_a_message_is_reported_once(
    tmp_path: Path, make_disk: MakeDisk, size: int
) -> None:
    """At once if it is more than a chunk, which has 64 KiB, and otherwise on flushing."""
    make_disk(5_000)
    failures: list[RecordingError] = []
    writer = BagWriter(tmp_path / "a.mcap", RecorderConfig(compression="none"), chunk_size=65536)
    recording = Recording(writer, 0.5, failures.append)
    channel = writer.add_topic("/a", STRING)
    recording.start()
    recording.set_clock(S)
    for _ in range(3):
        recording.record(channel, b"x" * size)
        recording.flush(clock_is_published=True)
    assert recording.state.value == "failed"
    recording.start()
    recording.record(channel, b"after")
    (failure,) = failures
    assert "No space left on device; " in str(failure)
    assert str(failure).endswith("; no message was written.")
    assert recording.failure is failure
    assert recording.messages == (size < 65536), "those that were handed to the bag"
    recording.close()


def test_meshes_of_a_robot_go_into_the_bag_with_its_description(bench: Bench) -> None:
    urdf = robot_file("surveyor").read_bytes()
    bench.recording.attach_robot("robot_description.urdf", urdf)
    bench.recording.attach_robot("other.urdf", b"<robot name='x'><mesh is='no robot'/></robot>")
    bench.recording.close()
    found = read_bag(bench.path).attachments
    assert found["robot_description.urdf"] == urdf
    meshes = {name for name in found if name.startswith("mesh/package://spacerobot_ros/")}
    assert len(meshes) == 6
    assert found.keys() == meshes | {"robot_description.urdf", "other.urdf"}
