"""The recorder node and publishers: quality of service, times, and what a bag says of a flight."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

from mcap.reader import make_reader
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from support.made_bags import joint_states
from support.ros_harness import LATCHED, Harness
from support.sentences import assert_one_sentence

from spacerobot_ros.bag import read_bag
from spacerobot_ros.nodes import RecorderNode

RELIABLE, BEST_EFFORT = ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT
KEPT, VOLATILE = DurabilityPolicy.TRANSIENT_LOCAL, DurabilityPolicy.VOLATILE
S = 10**9


class Recorded:
    """A recorder of chosen topics, and a probe that publishes on them."""

    def __init__(self, harness: Harness, bag: Path, **parameters: Any) -> None:
        self.harness, self.bag, self.sent = harness, bag, 0
        self.probe = harness.probe({})
        self.parameters = {"bag": str(bag), "watchdog_timeout": 0.0, "tf_period": 0.0, **parameters}

    def start(self, *topics: str) -> None:
        self.recorder = self.harness.make(
            RecorderNode, {**self.parameters, "topics": " ".join(topics)}
        )
        self.harness.spin_until(lambda: self.recorder.topics == set(topics), "subscriptions")
        self.harness.connect()

    def publish(self, publisher: Any, message: Any) -> None:
        """Publish a message, and wait until it is recorded."""
        recording = self.recorder.recording
        assert recording is not None
        publisher.publish(message)
        self.sent += 1
        self.harness.spin_until(
            lambda: recording.messages + recording.messages_waiting >= self.sent, "it is recorded"
        )

    def close(self) -> dict[str, list[tuple[float, float]]]:
        """Close the bag; return log and publish times in s by topic."""
        self.recorder.trigger_shutdown()
        found: dict[str, list[tuple[float, float]]] = {}
        with self.bag.open("rb") as file:
            for _, channel, record in make_reader(file).iter_messages(log_time_order=False):
                times = record.log_time / S, record.publish_time / S
                found.setdefault(channel.topic, []).append(times)
        return found


def test_every_publisher_of_a_topic_is_heard_as_it_offers(harness: Harness, tmp_path: Path) -> None:
    """A reader that asks for more than a publisher offers hears nothing of that one."""
    recorded = Recorded(harness, tmp_path / "a.mcap", clock_wait=0.0)
    offers = {
        "/reliability": [(RELIABLE, VOLATILE), (BEST_EFFORT, VOLATILE)],
        "/durability": [(RELIABLE, KEPT), (RELIABLE, VOLATILE)],
        "/kept": [(BEST_EFFORT, KEPT)],
    }
    publishers = [
        recorded.probe.create_publisher(
            String, topic, QoSProfile(depth=7, reliability=reliability, durability=durability)
        )
        for topic, offered in offers.items()
        for reliability, durability in offered
    ]
    recorded.start(*offers)
    for publisher in publishers:
        recorded.publish(publisher, String(data="heard"))
    assert {topic: len(times) for topic, times in recorded.close().items()} == {
        topic: len(offered) for topic, offered in offers.items()
    }
    (qos,) = read_bag(recorded.bag).qos("/kept")
    assert (qos.reliability, qos.durability) == ("best_effort", "transient_local")


def test_messages_carry_the_clock_and_their_stamps(harness: Harness, tmp_path: Path) -> None:
    recorded = Recorded(harness, tmp_path / "a.mcap")
    create = recorded.probe.create_publisher
    clock, joints = create(Clock, "/clock", 10), create(JointState, "/joint_states", 10)
    talk, urdf = create(String, "/talk", 10), create(String, "/a/robot_description", LATCHED)
    recorded.start("/clock", "/joint_states", "/talk", "/a/robot_description")
    for second in (1, 2, 2):
        message = Clock()
        message.clock.sec = second
        recorded.publish(clock, message)
        recorded.publish(joints, joint_states(second - 0.5, ["a"], [1.0], [2.0]))
        recorded.publish(talk, String(data=f"at {second}"))
        recorded.publish(urdf, String(data=f"<robot name='{second}'/>"))
    assert recorded.close() == {
        "/clock": [(1.0, 1.0), (2.0, 2.0), (2.0, 2.0)],
        "/joint_states": [(1.0, 0.5), (2.0, 1.5), (2.0, 1.5)],
        "/talk": [(1.0, 1.0), (2.0, 2.0), (2.0, 2.0)],
        "/a/robot_description": [(1.0, 1.0), (2.0, 2.0), (2.0, 2.0)],
    }
    # The first one only; the others are messages like all.
    with recorded.bag.open("rb") as file:
        attachments = [(a.name, a.data) for a in make_reader(file).iter_attachments()]
    assert attachments == [("a.robot_description.urdf", b"<robot name='1'/>")]


def test_without_a_clock_messages_keep_their_stamps(harness: Harness, tmp_path: Path) -> None:
    recorded = Recorded(harness, tmp_path / "a.mcap", clock_wait=0.0)
    joints = recorded.probe.create_publisher(JointState, "/joint_states", 10)
    recorded.start("/joint_states")
    stamps = [0.5, 1.5, 1.5, 1.25]
    for second in stamps:
        recorded.publish(joints, joint_states(second, ["a"], [1.0], [2.0]))
    times = recorded.close()["/joint_states"]
    assert [publish for _, publish in times] == stamps
    assert all(abs(log - time.time()) < 60 for log, _ in times)


def test_a_file_of_named_objects_is_in_the_bag_or_refused(harness: Harness, tmp_path: Path) -> None:
    file = tmp_path / "about.json"
    file.write_text(json.dumps({"one": {"a": 1, "b": "x"}, "two": {}}))
    recorded = Recorded(harness, tmp_path / "a.mcap", describe=str(file))
    recorded.probe.create_publisher(String, "/talk", 10)
    recorded.start("/talk")
    recorded.close()
    metadata = read_bag(recorded.bag).metadata
    assert (metadata["one"], metadata["two"]) == ({"a": "1", "b": "x"}, {})
    refusing = harness.make(RecorderNode, recorded.parameters, autostart=False)
    for text in ("[1]", "{", '{"one": 5}'):
        file.write_text(text)
        refusing.trigger_configure()
        assert_one_sentence(str(refusing.fault), "'describe'")
        refusing.cleanup()
