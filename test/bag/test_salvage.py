"""Bags cut off anywhere, or damaged: what is saved, read with nothing of this package."""

from __future__ import annotations

import itertools
import random
import shlex
import struct
from pathlib import Path
from typing import Any

import pytest
import yaml
from mcap.reader import make_reader
from mcap.writer import Writer
from rosbags.highlevel import AnyReader
from std_msgs.msg import String
from support.command_line import spacerobot
from support.hostile.records import string
from support.made_bags import STRING, Say, array, bag_of_strings, joint_states, made_bag, odometry
from support.raw_messages import Content

from spacerobot_ros.bag import LATCHED, BagWriter, RecordedRobot, RecordingError, read_bag
from spacerobot_ros.bag.salvage import last_state, salvage_bag

COUNT = 900


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """900 messages on two topics in some 30 chunks, an attachment and metadata among them."""
    path = tmp_path_factory.mktemp("bags") / "flight.mcap"
    with BagWriter(path, chunk_size=2000) as writer:
        writer.add_attachment("robot.urdf", b"<robot/>" * 50, "application/xml", 5)
        writer.add_metadata("parameters/plant", {"tick_rate": "20.0"})
        channels = [writer.add_topic("/a", STRING), writer.add_topic("/b", STRING, LATCHED)]
        for n in range(COUNT):
            writer.write(channels[n % 2], string(f"{n:05d}" + "x" * 40), n * 10**7, n * 10**7 + 5)
    return path


def whole_chunks(bag: Path, length: int) -> int:
    """Say how many messages are in chunks that end before `length`, from the bag's own index."""
    content, total = bag.read_bytes(), 0
    for index in Content(bag).summary.chunk_indexes:
        if index.chunk_start_offset + index.chunk_length <= length:
            for offset in index.message_index_offsets.values():
                total += struct.unpack_from("<I", content, offset + 11)[0] // 16
    return total


@pytest.mark.slow
def test_whatever_was_cut_off_the_rest_is_saved(bag: Path, tmp_path: Path) -> None:
    whole, everything = bag.read_bytes(), Content(bag)
    cut = tmp_path / "cut.mcap"
    chance = random.Random(4)
    lengths = [
        len(whole) - 1,
        len(whole) - 30,
        *(chance.randrange(600, len(whole)) for _ in range(25)),
    ]
    for length in lengths:
        cut.write_bytes(whole[:length])
        saved = salvage_bag(cut)
        assert saved.path == tmp_path / "cut-salvaged.mcap"
        content = Content(saved.path)
        assert content.messages == everything.messages[: len(content.messages)]
        assert len(content.messages) == saved.messages == whole_chunks(bag, length)
        assert content.attachments == {"robot.urdf": (5, "application/xml", b"<robot/>" * 50)}
        assert content.metadata["parameters/plant"] == {"tick_rate": "20.0"}
        said = yaml.safe_load(content.metadata["rosbag2"]["serialized_metadata"])
        assert said["message_count"] == saved.messages
        assert said["relative_file_paths"] == ["cut-salvaged.mcap"]
        assert content.channels.items() <= everything.channels.items()
        with AnyReader([saved.path]) as reader:
            assert reader.message_count == saved.messages
        assert read_bag(saved.path).message_count() == saved.messages
        assert cut.read_bytes() == whole[:length]
        saved.path.unlink()


def test_a_damaged_chunk_is_left_out_and_counted(bag: Path, tmp_path: Path) -> None:
    content = bytearray(bag.read_bytes())
    index = Content(bag).summary.chunk_indexes[10]
    content[index.chunk_start_offset + index.chunk_length - 20] ^= 0xFF
    damaged = tmp_path / "damaged.mcap"
    damaged.write_bytes(content)
    saved = salvage_bag(damaged, tmp_path / "out.mcap")
    assert saved.lost_chunks == 1
    place = f"the chunk at byte {index.chunk_start_offset} cannot be unpacked"
    assert saved.loss_reason.startswith(place)
    assert saved.lost_bytes == 0
    messages = Content(saved.path).messages
    lost = [m for m in Content(bag).messages if m not in messages]
    assert len(messages) == COUNT - len(lost) == saved.messages
    assert index.message_start_time <= lost[0][1] <= lost[-1][1] <= index.message_end_time


def test_a_bag_without_chunks_and_of_another_kind(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = Writer(file, use_chunking=False)
        writer.start("mine")
        schema = writer.register_schema("Thing", "jsonschema", b"{}")
        channel = writer.register_channel("/a", "json", schema)
        for n in range(100):
            writer.add_message(channel, n, b"%d" % n, n)
        writer.finish()
    content = path.read_bytes()
    path.write_bytes(content[: content.index(b"\x0f\x04\0\0\0\0\0\0\0") - 3])
    saved = salvage_bag(path)
    found = Content(saved.path)
    assert found.data == [b"%d" % n for n in range(99)]
    assert "rosbag2" not in found.metadata
    with saved.path.open("rb") as file:
        assert make_reader(file).get_header().profile == "mine"


def test_what_cannot_be_salvaged_is_refused(bag: Path, tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="is complete: there is nothing to salvage"):
        salvage_bag(bag)
    with pytest.raises(RecordingError, match="There is no bag at"):
        salvage_bag(tmp_path / "none.mcap")
    (tmp_path / "text.mcap").write_text("some other thing")
    with pytest.raises(RecordingError, match="is not an MCAP file"):
        salvage_bag(tmp_path / "text.mcap")
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(bag.read_bytes()[:30])
    with pytest.raises(RecordingError, match="Nothing in the bag"):
        salvage_bag(cut)
    cut.write_bytes(bag.read_bytes()[:-1])
    (tmp_path / "cut-salvaged.mcap").write_text("precious")
    with pytest.raises(RecordingError, match=r"cut-salvaged.mcap: File exists"):
        salvage_bag(cut)
    assert (tmp_path / "cut-salvaged.mcap").read_text() == "precious"


def test_the_commands_offer_it_and_it_does(bag: Path, tmp_path: Path) -> None:
    cut = tmp_path / "ein Flug's Ende.mcap"
    cut.write_bytes(bag.read_bytes()[:20_000])
    for command in ("verify", "report", "export"):
        refusal = spacerobot(command, cut, code=2).stderr
        offered = refusal.partition("'spacerobot")[2].rpartition("' recovers")[0]
        assert shlex.split(f"spacerobot{offered}") == ["spacerobot", "salvage", str(cut)]
    result = spacerobot("salvage", cut, "-o", tmp_path / "new.mcap")
    count = len(Content(tmp_path / "new.mcap").data)
    assert f"saved       {count} messages over {(count - 1) / 100:g} s" in result.output
    spacerobot("salvage", bag, code=2)


def ends_of_records(content: bytes | bytearray) -> list[tuple[int, int]]:
    """Return opcode and end of every record of a file, from its bytes."""
    ends, position = [], 8
    while position < len(content) - 8:
        opcode, length = struct.unpack_from("<BQ", content, position)
        position += 9 + length
        ends.append((opcode, position))
    return ends


def test_what_is_lost_behind_the_last_whole_record_is_counted(tmp_path: Path) -> None:
    whole = bag_of_strings(tmp_path / "a.mcap", range(6)).read_bytes()
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
        assert Content(saved.path).statistics.metadata_count == 1
        saved.path.unlink()


def test_a_bag_whose_statistics_are_wrong_is_salvaged(tmp_path: Path) -> None:
    path = bag_of_strings(tmp_path / "a.mcap", [0.0, 1.0, 2.0])
    content = bytearray(path.read_bytes())
    records = ends_of_records(content)
    (end,) = (end for (_, end), (opcode, _) in itertools.pairwise(records) if opcode == 11)
    (count,) = struct.unpack_from("<Q", content, end + 9)
    assert count == 3
    struct.pack_into("<Q", content, end + 9, 4)
    path.write_bytes(content)
    assert salvage_bag(path).messages == 3


# -- the state that a flight goes on from ------------------------------------------------------

NAMES = ["elbow", "wrist"]
STILL = (0.0,) * 6


def position(k: float) -> tuple[float, ...]:
    """Return a pose by its number, and a twist."""
    return (k, 10.0 + k, 20.0 + k, 0.0, 0.6, 0.0, 0.8, *STILL)


def say_momentum(say: Say, time: float, k: float, prefix: str = "") -> None:
    say(f"{prefix}/momentum", array(*(100.0 * (i + 1) + k for i in range(7))), time)


def say_odom(say: Say, time: float, k: float, prefix: str = "") -> None:
    say(f"{prefix}/odom", odometry(time, *position(k)), time)


def say_joints(say: Say, time: float, k: float, prefix: str = "") -> None:
    joints = joint_states(time, NAMES, [0.1 + k, 0.2 + k], [0.3 + k, 0.4 + k])
    say(f"{prefix}/joint_states", joints, time)


PARTS = (say_momentum, say_odom, say_joints)


def say_state(say: Say, time: float, k: float, prefix: str = "") -> None:
    """Write a state as a plant does: momenta first."""
    for part in PARTS:
        part(say, time, k, prefix)


def assert_state(bag: Path, time: float, k: float, namespace: str = "") -> None:
    state = last_state(bag, namespace)
    assert state.time_ns == round(time * 1e9)
    assert state.joint_names == NAMES
    initial = state.initial
    assert initial.position.tolist() == [k, 10.0 + k, 20.0 + k]
    assert initial.quaternion.tolist() == [0.0, 0.6, 0.0, 0.8]
    assert initial.joint_positions == pytest.approx([0.1 + k, 0.2 + k], abs=0.0)
    assert initial.joint_velocities == pytest.approx([0.3 + k, 0.4 + k], abs=0.0)
    momenta = *initial.linear_momentum, *initial.angular_momentum
    assert momenta == tuple(100.0 * (i + 1) + k for i in range(6))


TWO = ((say_state, 0.5, 1), (say_state, 1.0, 2))


@pytest.mark.parametrize(
    ("said", "last"),
    [
        # A recorder that is killed leaves a state of which only some messages are there.
        *(([*TWO, *((part, 1.5, 3) for part in PARTS[:n])], 2) for n in range(3)),
        ([*TWO, *((part, 1.5, 3) for part in PARTS)], 3),
        # A gap in odom leaves the state before it.
        ([(say_state, 0.0, 0), (say_state, 0.5, 1), (say_joints, 1.0, 2), (say_joints, 1.5, 3)], 1),
        # Joints and poses are found by their stamps and not by their numbers.
        ([(say_joints, 0.0, 7), *TWO, (say_joints, 1.5, 9)], 2),
        # A plant that is reset publishes its tick once more.
        ([(say_state, 0.0, 0), (say_state, 0.5, 1), (say_state, 0.5, 8)], 8),
    ],
)
def test_the_last_state_is_the_last_whole_one(
    tmp_path: Path, said: list[tuple[Any, float, float]], last: float
) -> None:
    with made_bag(tmp_path / "a.mcap") as (_, say):
        for part, time, k in said:
            part(say, time, k)
    assert_state(tmp_path / "a.mcap", next(time for _, time, k in said if k == last), last)


def test_each_robot_has_its_own(tmp_path: Path) -> None:
    with made_bag(tmp_path / "a.mcap") as (_, say):
        say_state(say, 0.5, 1, "/a")
        say_state(say, 1.0, 2, "/b")
    assert_state(tmp_path / "a.mcap", 0.5, 1, "/a")
    assert_state(tmp_path / "a.mcap", 1.0, 2, "/b")
    with pytest.raises(RecordingError, match="no messages on /odom"):
        last_state(tmp_path / "a.mcap")


def test_a_bag_that_was_cut_off_has_one_too_and_stays_as_it_is(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with made_bag(path) as (bag, say):
        for k in range(3):
            say_state(say, 0.5 * k, k)
            bag.flush()
        whole = path.read_bytes()
        for k in range(3, 6):
            say_state(say, 0.5 * k, k)
    path.write_bytes(whole + b"\x06\x00")
    assert_state(path, 1.0, 2)
    assert path.read_bytes() == whole + b"\x06\x00"
    assert list(tmp_path.iterdir()) == [path]


def test_states_that_never_meet_are_none(tmp_path: Path) -> None:
    with made_bag(tmp_path / "a.mcap") as (_, say):
        say_momentum(say, 0.0, 0)
        say_odom(say, 0.0, 0)
        say_joints(say, 0.5, 0)
    with pytest.raises(RecordingError, match="no complete state"):
        last_state(tmp_path / "a.mcap")


def test_a_robot_is_described_by_its_file_or_else_by_the_last_message(tmp_path: Path) -> None:
    for attached in (False, True):
        path = tmp_path / f"{attached}.mcap"
        with made_bag(path) as (bag, say):
            if attached:
                bag.add_attachment("a.robot_description.urdf", b"<file/>", "application/xml", 0)
                bag.add_attachment("b.robot_description.urdf", b"<other/>", "application/xml", 0)
            for k, text in enumerate(("<old/>", "<new/>")):
                say("/a/robot_description", String(data=text), 0.1 * k)
        expected = b"<file/>" if attached else b"<new/>"
        assert RecordedRobot(read_bag(path), "/a").urdf == expected
    assert RecordedRobot(read_bag(path)).urdf is None
