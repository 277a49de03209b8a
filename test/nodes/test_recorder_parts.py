"""Parts of the recorder without a node: quality of service, streams, stamps, descriptions."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import rclpy
from mcap.reader import make_reader
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import serialize_message
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from support.made_bags import joint_states

from spacerobot_ros.bag import BagWriter, QosProfile, Recording
from spacerobot_ros.errors import ParameterError
from spacerobot_ros.nodes import recorder

RELIABLE, BEST_EFFORT = ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT
LATCHED, VOLATILE = DurabilityPolicy.TRANSIENT_LOCAL, DurabilityPolicy.VOLATILE
S = 10**9


def offer(reliability: ReliabilityPolicy, durability: DurabilityPolicy) -> QoSProfile:
    return QoSProfile(depth=3, reliability=reliability, durability=durability)


@pytest.mark.parametrize(
    ("offered", "reliability", "durability"),
    [
        ([(RELIABLE, LATCHED)], RELIABLE, LATCHED),
        ([(BEST_EFFORT, VOLATILE)], BEST_EFFORT, VOLATILE),
        # A reader that asks for more than a publisher offers hears nothing of that one.
        ([(RELIABLE, LATCHED), (BEST_EFFORT, LATCHED)], BEST_EFFORT, LATCHED),
        ([(RELIABLE, VOLATILE), (RELIABLE, LATCHED)], RELIABLE, VOLATILE),
    ],
)
def test_a_topic_is_subscribed_with_what_all_of_its_publishers_offer(
    offered: list[Any], reliability: ReliabilityPolicy, durability: DurabilityPolicy
) -> None:
    qos = recorder._subscribed_qos([offer(*each) for each in offered])
    assert (qos.reliability, qos.durability) == (reliability, durability)


def test_a_bag_says_what_was_offered() -> None:
    qos = QoSProfile(
        history=HistoryPolicy.KEEP_LAST, depth=7, reliability=BEST_EFFORT, durability=LATCHED
    )
    found = recorder._recorded_qos(qos)
    assert (found.history, found.depth) == ("keep_last", 7)
    assert (found.reliability, found.durability) == ("best_effort", "transient_local")


def test_messages_carry_the_clock_and_their_stamps(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    writer = BagWriter(path)
    recording = Recording(writer, 2.0)
    recording.start()
    stamps = recorder._StampReader()

    def take(topic: str, message: Any) -> Any:
        kind = type(message)
        package = kind.__module__.split(".")[0]
        channel = writer.add_topic(topic, f"{package}/msg/{kind.__name__}", QosProfile())
        return recorder._recording_callback(recording, stamps, topic, kind, channel)

    clock, joints = take("/clock", Clock()), take("/joint_states", JointState())
    text, urdf = take("/talk", String()), take("/a/robot_description", String())
    for second in (1, 2, 2):
        message = Clock()
        message.clock.sec = second
        clock(bytes(serialize_message(message)))
        joints(bytes(serialize_message(joint_states(second - 0.5, ["a"], [1.0], [2.0]))))
        text(bytes(serialize_message(String(data=f"at {second}"))))
        urdf(bytes(serialize_message(String(data=f"<robot name='{second}'/>"))))
    recording.close()
    with path.open("rb") as file:
        reader = make_reader(file)
        found: dict[str, list[tuple[float, float]]] = {}
        for _, channel, record in reader.iter_messages(log_time_order=False):
            times = record.log_time / S, record.publish_time / S
            found.setdefault(channel.topic, []).append(times)
        attachments = [(a.name, a.data) for a in reader.iter_attachments()]
    assert found == {
        "/clock": [(1.0, 1.0), (2.0, 2.0), (2.0, 2.0)],
        "/joint_states": [(1.0, 0.5), (2.0, 1.5), (2.0, 1.5)],
        "/talk": [(1.0, 1.0), (2.0, 2.0), (2.0, 2.0)],
        "/a/robot_description": [(1.0, 1.0), (2.0, 2.0), (2.0, 2.0)],
    }
    # The first one only; the others are messages like all.
    assert attachments == [("a.robot_description.urdf", b"<robot name='1'/>")]


def test_without_a_clock_messages_keep_their_stamps(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    writer = BagWriter(path)
    recording = Recording(writer, 2.0, wall_time=lambda: 7 * S)
    recording.start()
    channel = writer.add_topic("/joint_states", "sensor_msgs/msg/JointState", QosProfile())
    take = recorder._recording_callback(
        recording, recorder._StampReader(), "/joint_states", JointState, channel
    )
    for second in (0.5, 1.5, 1.5, 1.25):
        take(bytes(serialize_message(joint_states(second, ["a"], [1.0], [2.0]))))
    recording.close()
    with path.open("rb") as file:
        found = make_reader(file).iter_messages(log_time_order=False)
        times = [(record.log_time / S, record.publish_time / S) for _, _, record in found]
    assert times == [(7.0, 0.5), (7.0, 1.5), (7.0, 1.5), (7.0, 1.25)]


def test_losses_add_up(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "a.mcap") as writer:
        recording = Recording(writer, 2.0)
        events = recorder.loss_events(recording, "/a")
        for count in (3, 4):
            events.message_lost(SimpleNamespace(total_count_change=count))
        recorder.loss_events(recording, "/b").message_lost(SimpleNamespace(total_count_change=1))
        assert recording.lost == {"/a": 7, "/b": 1}


def test_descriptions_are_texts(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    path.write_text(json.dumps({"one": {"a": 1, "b": "x"}, "two": {}}))
    assert recorder._read_descriptions(str(path)) == [("one", {"a": "1", "b": "x"}), ("two", {})]
    assert recorder._read_descriptions("") == []
    for text in ("[1]", "{", '{"one": 5}'):
        path.write_text(text)
        with pytest.raises(ParameterError, match="'describe'"):
            recorder._read_descriptions(str(path))


@pytest.mark.parametrize(
    ("settings", "given"),
    [
        (
            {"max_size": 2.5, "max_duration": 0.75, "when_exists": "refuse"},
            (2_500_000, 750_000_000, False),
        ),
        ({"when_exists": "next"}, (0, 0, True)),
    ],
)
def test_a_recorder_opens_its_bag_with_the_bounds_that_it_is_given(
    tmp_path: Path,
    ros_context: rclpy.Context,
    monkeypatch: pytest.MonkeyPatch,
    settings: dict[str, Any],
    given: tuple[Any, ...],
) -> None:
    opened: list[dict[str, Any]] = []
    writers: list[BagWriter] = []

    def write(path: str, **options: Any) -> BagWriter:
        opened.append({"path": path, **options})
        writers.append(BagWriter(path))
        return writers[-1]

    monkeypatch.setattr(recorder, "BagWriter", write)
    values = {"bag": str(tmp_path / "a.mcap"), "compression": "lz4", **settings}
    node = recorder.RecorderNode(
        context=ros_context,
        parameter_overrides=[Parameter(name, value=value) for name, value in values.items()],
    )
    try:
        (options,) = opened
        assert (options["path"], options["compression"]) == (values["bag"], "lz4")
        bounds = (options["max_size"], options["max_duration_ns"], options["next_free"])
        assert bounds == given
        assert options["overwrite"] is False
    finally:
        node.destroy_node()
        for writer in writers:
            writer.close()
