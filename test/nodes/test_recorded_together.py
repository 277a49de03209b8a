"""Messages that a recorder writes together: the same bag as written one by one."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader

from spacerobot_ros.bag import BagWriter, FirstTime, QosProfile, Recording, RecordingError
from spacerobot_ros.messages.layout import encode
from spacerobot_ros.model.urdf import load_robot
from spacerobot_ros.nodes import recorder
from spacerobot_ros.nodes.common.messages import message_class
from spacerobot_ros.resources import robot_file

S = 10**9
TOPICS = {
    "/clock": "rosgraph_msgs/msg/Clock",
    "/odom": "nav_msgs/msg/Odometry",
    "/joint_states": "sensor_msgs/msg/JointState",
    "/momentum": "std_msgs/msg/Float64MultiArray",
    "/robot_description": "std_msgs/msg/String",
}
ROBOT = load_robot(robot_file("servicer"))


def message(topic: str, time_ns: int, rng: np.random.Generator) -> bytes:
    """Return a message with random numbers; negative times are those of faulty publishers."""
    header = {"stamp": max(time_ns, 0), "frame_id": "world"}
    n = len(ROBOT.joint_names)
    values: dict[str, Any] = {
        "/clock": {"clock": max(time_ns, 0)},
        "/odom": {
            "header": header,
            "child_frame_id": "base_link" if rng.random() < 0.95 else "of_another_robot",
            "pose": {"pose": {"position": dict(zip("xyz", rng.normal(size=3), strict=True))}},
        },
        "/joint_states": {
            "header": header,
            "name": ROBOT.joint_names,
            "position": rng.normal(size=n),
            "velocity": rng.normal(size=n),
            "effort": np.zeros(n),
        },
        "/momentum": {"data": rng.normal(size=int(rng.integers(0, 9)))},
        "/robot_description": {"data": ROBOT.urdf},
    }
    raw = encode(TOPICS[topic], values[topic])
    if time_ns < 0 and topic in ("/odom", "/joint_states", "/clock"):
        raw = raw[:4] + (-5).to_bytes(4, "little", signed=True) + raw[8:]
    return raw


def flight(seed: int) -> list[tuple[str, bytes]]:
    """Return messages as a plant sends them, with losses, jumps, repetitions and swapped states."""
    rng = np.random.default_rng(seed)
    found: list[tuple[str, bytes]] = [("/robot_description", message("/robot_description", 0, rng))]
    time_ns = 0
    for _ in range(700):
        time_ns += 50_000_000
        if rng.random() < 0.01:
            time_ns = int(rng.integers(-2, 40)) * S
        state = ["/clock", "/momentum", "/odom", "/joint_states"]
        if rng.random() < 0.1:
            state[2:] = state[:1:-1]
        for topic in state:
            if rng.random() > 0.03:
                found.append((topic, message(topic, time_ns, rng)))
    return found


def recorded(
    path: Path, messages: list[tuple[str, bytes]], *, together: bool, transforms: bool
) -> Recording:
    writer = BagWriter(path, chunk_size=20_000)
    recording = Recording(writer, 2.0)
    if not together:
        recording.collector = lambda channel, first_time, take: take  # type: ignore[method-assign]
    sources = "/odom", "/joint_states", "/robot_description"
    derived = recorder._RecordedTransforms(
        recording, 0.1, ("/tf", "/tf_static"), lambda: not transforms, sources
    )
    if together:
        recording.derive = derived.derive
    stamps = recorder._StampReader()
    takes: dict[str, Callable[[bytes], None]] = {}
    for topic, kind in TOPICS.items():
        channel = writer.add_topic(topic, kind, QosProfile())
        takes[topic] = recorder._recording_callback(
            recording,
            stamps,
            topic,
            message_class(kind),
            channel,
            listener=derived.listener(topic, channel),
        )
    recording.start()
    for number, (topic, raw) in enumerate(messages):
        takes[topic](raw)
        if number % 997 == 500:
            recording.pause()
        if number % 997 == 510:
            recording.start()
    recording.close()
    assert recording.messages == writer.messages_written
    return recording


def content(path: Path) -> list[tuple[str, int, int, bytes]]:
    with path.open("rb") as file:
        found = make_reader(file).iter_messages(log_time_order=False)
        return [(c.topic, m.log_time, m.publish_time, m.data) for _, c, m in found]


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("transforms", [True, False])
def test_the_bag_is_the_same_as_one_by_one(seed: int, transforms: bool, tmp_path: Path) -> None:
    messages = flight(seed)
    names = {True: "together", False: "alone"}
    files = {}
    for together, name in names.items():
        (tmp_path / name).mkdir()
        path = tmp_path / name / "a.mcap"
        recording = recorded(path, messages, together=together, transforms=transforms)
        files[together] = path
        assert recording.writer.message_counts.get("/tf", 0) > 100 or not transforms
    if transforms:  # Its channel is announced some messages earlier: chunks may differ.
        assert content(files[True]) == content(files[False])
    else:
        assert files[True].read_bytes() == files[False].read_bytes()


def test_messages_of_a_clock_wait_together_until_something_else_is_asked(tmp_path: Path) -> None:
    writer = BagWriter(tmp_path / "a.mcap")
    recording = Recording(writer, 2.0)
    channel = writer.add_topic("/clock", TOPICS["/clock"])
    alone: list[bytes] = []
    take = recording.collector(channel, FirstTime.CLOCK, alone.append)
    rng = np.random.default_rng(0)
    take(message("/clock", S, rng))
    assert len(alone) == 1, "it is not known yet whether a clock is published"
    recording.start()
    recording.set_clock(S)
    for second in (2, 3):
        take(message("/clock", second * S, rng))
    assert (len(alone), recording.messages, writer.messages_written) == (1, 2, 0)
    assert recording.now_ns == 3 * S
    assert writer.messages_written == 2
    # What is recorded alone comes after those that waited.
    take(message("/clock", 3 * S, rng))
    recording.record(writer.add_topic("/talk", TOPICS["/momentum"]), b"alone")
    assert writer.message_counts == {"/clock": 3, "/talk": 1}
    cut = message("/clock", 4 * S, rng)[:4]
    take(cut)
    assert recording.now_ns == 0, "a cut message has no time"
    recording.close()


def test_a_refused_chunk_ends_the_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    failures: list[RecordingError] = []
    writer = BagWriter(tmp_path / "a.mcap", chunk_size=100)
    recording = Recording(writer, 2.0, failures.append)
    channel = writer.add_topic("/clock", TOPICS["/clock"])
    take = recording.collector(channel, FirstTime.CLOCK, lambda raw: None)
    recording.start()
    recording.set_clock(0)
    rng = np.random.default_rng(0)
    for second in range(9):
        take(message("/clock", second * S, rng))

    def refuse(_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("spacerobot_ros.bag.mcap_file._AppendedFile.commit", refuse)
    recording.flush(clock_is_published=True)
    (failure,) = map(str, failures)
    assert failure.endswith("No space left on device; the 0 messages before that are safe in it.")
    assert recording.messages == 0
    take(message("/clock", S, rng))
    assert recording.messages == 0
    recording.close()
