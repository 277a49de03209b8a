"""The recorder node beside a plant and a planner: what is in the bag against what was heard."""

from __future__ import annotations

import json
import signal
import time
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import rclpy
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from lifecycle_msgs.msg import Transition
from mcap.reader import make_reader
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy, qos_profile_system_default
from rclpy.serialization import deserialize_message
from rclpy.service_introspection import ServiceIntrospectionState
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from std_srvs.srv import SetBool
from support.made_bags import joint_states
from support.nodes_apart import NodesApart
from support.planner_flight import values_of
from support.recorded_stack import LATCHED_TOPICS, PLANT, STREAMS, BagContent, Stack
from support.ros_harness import LATCHED, Harness, construction
from support.sentences import assert_one_sentence

from spacerobot_ros import read_bag
from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.model import load_robot
from spacerobot_ros.nodes import PlantNode, RecorderNode
from spacerobot_ros.nodes.recorder import loss_events

URDF = Path(__file__).parents[2] / "urdf" / "sliding_masses.urdf"


@pytest.fixture
def stack(harness: Harness, tmp_path: Path) -> Stack:
    """Return a stack whose recorder is active before anything happens."""
    stack = Stack(harness, tmp_path / "bags" / "flight.mcap")
    stack.configure(*STREAMS, *LATCHED_TOPICS)
    stack.recorder.trigger_activate()
    return stack


# -- what is in the bag -----------------------------------------------------------------------


def test_recorded_is_published_on_every_topic(stack: Stack) -> None:
    stack.fly()
    stack.stop()
    bag = stack.close_bag()
    heard = {topic: kept for topic, kept in stack.probe.messages.items() if topic != "/rosout"}
    assert set(bag.by_topic) == {topic for topic, kept in heard.items() if kept}
    assert set(bag.by_topic) == {*STREAMS, *LATCHED_TOPICS}
    for topic, kept in heard.items():
        recorded = bag[topic]
        if topic == "/events":
            # The probe looks for topics only when every node has been configured.
            recorded = [event for event in recorded if "is configured" not in event.message]
        assert len(recorded) == len(kept), topic
        assert recorded == kept, topic
    assert len(bag["/odom"]) > 40
    assert stack.recorder.messages_recorded == bag.count
    assert bag["/robot_description"][0].data == load_robot(URDF).urdf


def test_a_recorder_of_events_alone_writes_them_without_a_clock(
    harness: Harness, tmp_path: Path
) -> None:
    talk = harness.probe({}).create_publisher(DiagnosticStatus, "/events", 10)
    named = {"bag": str(tmp_path / "events.mcap"), "topics": "/events", "clock_wait": 0.0}
    recorder = harness.make(RecorderNode, named)
    harness.spin_until(lambda: "/events" in recorder.topics, "the subscription")
    harness.matched(talk)
    talk.publish(DiagnosticStatus(message="waiting"))
    harness.spin_until(lambda: recorder.messages_recorded >= 1, "the event in the bag")


def test_events_of_services_are_recorded(
    harness: Harness, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """They are published by services with introspection, with messages that rosidl makes."""
    server = harness.probe({}, name="server")

    def answer(request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        response.success, response.message = request.data, "so it is"
        return response

    service = server.create_service(SetBool, "ask", answer)
    service.configure_introspection(
        server.get_clock(), qos_profile_system_default, ServiceIntrospectionState.CONTENTS
    )
    bag = tmp_path / "events.mcap"
    chosen = {"bag": str(bag), "topics": "/ask/_service_event", "clock_wait": 0.0}
    recorder = harness.make(RecorderNode, chosen)
    harness.spin_until(lambda: "/ask/_service_event" in recorder.topics, "the subscription")
    harness.connect()
    client = server.create_client(SetBool, "ask")
    assert harness.call(client, SetBool.Request(data=True)).success
    harness.spin_until(lambda: recorder.messages_recorded >= 2, "both events")
    recorder.trigger_shutdown()
    assert "is not recorded" not in capfd.readouterr().err
    events = [event for _, event in read_bag(bag)["/ask/_service_event"].messages()]
    received, sent = events
    assert (received.info.event_type, received.request[0].data) == (1, True)
    assert (sent.info.event_type, sent.response[0].message) == (2, "so it is")
    with bag.open("rb") as file:
        raw = [
            (schema.name, deserialize_message(message.data, SetBool.Event))
            for schema, _, message in make_reader(file).iter_messages("/ask/_service_event")
            if schema is not None
        ]
    assert {name for name, _ in raw} == {"std_srvs/srv/SetBool_Event"}
    assert [event.info.event_type for _, event in raw] == [1, 2]


def test_topics_can_be_chosen(harness: Harness, tmp_path: Path) -> None:
    stack = Stack(harness, tmp_path / "flight.mcap", topics="/clock odom planner/status")
    stack.configure("/clock", "/odom", "/planner/status")
    stack.recorder.trigger_activate()
    stack.fly()
    stack.stop()
    bag = stack.close_bag()
    assert set(bag.by_topic) == {"/clock", "/odom", "/planner/status"}
    assert bag["/odom"] == stack.probe.messages["/odom"]


# -- when it records --------------------------------------------------------------------------


@pytest.mark.slow
def test_a_topic_that_appears_in_flight_is_recorded(stack: Stack) -> None:
    stack.fly()
    stack.stop()
    before = stack.recorder.messages_recorded
    late = stack.probe.create_publisher(String, "/notes", LATCHED)
    late.publish(String(data="before anybody listened"))
    stack.harness.spin_until(
        lambda: stack.recorder.messages_recorded == before + 1, "the latched message"
    )
    late.publish(String(data="after"))
    stack.fly(0.0)
    stack.stop()
    bag = stack.close_bag()
    assert [m.data for m in bag["/notes"]] == ["before anybody listened", "after"]


def test_a_bag_is_whole_while_the_flight_goes_on(stack: Stack, tmp_path: Path) -> None:
    stack.fly()
    stack.stop()
    bag = stack.close_bag()
    before = bag.count
    stack.fly(0.0)
    assert BagContent(stack.bag).count == before
    # Configured again, it writes a new one.
    assert stack.recorder.trigger_configure() is TransitionCallbackReturn.SUCCESS
    assert stack.recorder.recording is not None
    first, stack.bag = stack.bag, stack.recorder.recording.writer.path
    assert stack.bag == first.with_name("flight-1.mcap")
    stack.await_topics(*STREAMS)
    stack.harness.connect()
    stack.recorder.trigger_activate()
    heard = stack.probe.count("/odom")
    stack.fly(0.02)
    stack.stop()
    again = stack.close_bag()
    assert BagContent(first).count == before
    assert len(again["/odom"]) <= stack.probe.count("/odom") - heard
    assert len(again["/odom"]) > 40


def test_a_recording_in_a_namespace_has_the_topics_of_it(harness: Harness, tmp_path: Path) -> None:
    bag = tmp_path / "flight.mcap"
    recorder = harness.make(
        RecorderNode, {"bag": str(bag), "topics": "odom /clock"}, namespace="/craft"
    )
    harness.make(PlantNode, PLANT, namespace="/craft")
    harness.spin_until(lambda: {"/craft/odom", "/clock"} <= recorder.topics, "subscriptions")
    # A lockstep plant shows newcomers its state again.
    harness.spin_until(lambda: recorder.messages_recorded >= 2, "the state of tick 0")
    recorder.trigger_shutdown()
    content = BagContent(bag)
    assert set(content.by_topic) == {"/craft/odom", "/clock"}
    np.testing.assert_array_equal([log_ns for log_ns, _ in content.by_topic["/craft/odom"]], 0)


def test_the_recorder_tells_of_its_bag(harness: Harness, tmp_path: Path) -> None:
    stack = Stack(harness, tmp_path / "flight.mcap", diagnostics_period=0.05, flush_period=0.05)
    stack.configure(*STREAMS, *LATCHED_TOPICS)
    stack.recorder.trigger_activate()
    stack.fly()
    stack.stop()
    told = partial(stack.probe.diagnoses, "recorder: bag")
    before = len(told())
    harness.spin_until(lambda: len(told()) > before + 2, "diagnostics of the recorder")
    said = values_of(told()[-1])
    assert said["messages_lost"] == "0"
    assert int(said["topics"]) == len(stack.recorder.topics)
    assert int(said["bytes_written"]) == pytest.approx(stack.bag.stat().st_size, rel=0.2)
    bag = stack.close_bag()
    # It records what it says, and so is a few messages further by now.
    assert bag.count - 20 <= int(said["messages"]) <= bag.count


# -- files on disk --------------------------------------------------------------------------------


def test_a_recording_is_split_by_time_and_flushed_as_often_as_it_is_to(
    harness: Harness, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    publisher = harness.probe({}).create_publisher(String, "/talk", 10)
    parameters = {"topics": "/talk", "clock_wait": 0.0, "flush_period": 0.375}
    bag = str(tmp_path / "flight.mcap")
    # The third message comes more than a nanosecond after the first.
    recorder = harness.make(RecorderNode, {**parameters, "bag": bag, "max_duration": 1e-9})
    assert 375_000_000 in {timer.timer_period_ns for timer in recorder.timers}
    harness.matched(publisher)
    for n in range(3):
        publisher.publish(String(data=f"{n}"))
        harness.spin_until(lambda n=n: recorder.messages_recorded > n, "it is recorded")  # type: ignore[misc]
        recorder.flush()
    recorder.trigger_deactivate()
    recorder.trigger_cleanup()
    files = sorted(tmp_path.iterdir())
    assert len(files) > 1
    where = f"{files[0]} to {files[-1].name}."
    assert f"3 messages are recorded in {where}" in capfd.readouterr().err
    assert [m.data for path in files for _, m in read_bag(path)["/talk"].messages()] == list("012")


class Lost(NamedTuple):
    """As rclpy tells it."""

    total_count_change: int


def test_lost_messages_are_published_and_stay_in_the_bag(harness: Harness, tmp_path: Path) -> None:
    probe = harness.probe({"/diagnostics": DiagnosticArray})
    publisher = probe.create_publisher(String, "/talk", 10)
    # Its watchdog has diagnostics of its own.
    parameters = {"bag": str(tmp_path / "flight.mcap"), "watchdog_timeout": 0.0}
    recorder = harness.make(RecorderNode, parameters)
    harness.matched(publisher)
    assert recorder.recording is not None
    assert recorder.recording.lost.total() == 0
    assert recorder.count_publishers("/diagnostics") == 0
    for count in (3, 4):
        events = loss_events(recorder.recording, "/talk")
        events.message_lost(Lost(count))
    harness.spin_until(lambda: probe.messages["/diagnostics"], "the loss is published")
    (status,) = probe.last("/diagnostics").status
    assert status.level == DiagnosticStatus.WARN
    assert [(pair.key, pair.value) for pair in status.values] == [("/talk", "7")]
    recorder.trigger_deactivate()
    recorder.trigger_cleanup()
    assert read_bag(tmp_path / "flight.mcap").metadata["recorder"]["messages_lost"] == "7"


def test_a_device_is_refused_in_a_sentence(harness: Harness) -> None:
    stack = Stack(harness, Path("/dev/full"))
    assert stack.recorder.trigger_configure() is not TransitionCallbackReturn.SUCCESS
    assert_one_sentence(str(stack.recorder.fault), "/dev/full", "it is a device")


def test_a_recorder_that_is_to_refuse_a_bag_that_is_there_does(
    ros_context: rclpy.Context, tmp_path: Path
) -> None:
    bag = tmp_path / "flight.mcap"
    bag.write_bytes(b"the record of the crash")
    parameters = {"bag": str(bag), "when_exists": "refuse"}
    with pytest.raises(SpaceRobotError) as refusal:
        RecorderNode(**construction(ros_context, parameters))
    assert_one_sentence(str(refusal.value), str(bag), "File exists")
    assert bag.read_bytes() == b"the record of the crash"


def test_a_bag_that_goes_is_reported_within_a_second(apart: NodesApart, tmp_path: Path) -> None:
    bag = tmp_path / "folder" / "flight.mcap"
    recorder = apart.start("recorder", bag=bag, flush_period=60.0)
    heard = apart.probe.messages
    while not heard["events"]:  # Until these have met: paused, and on again.
        for transition in (Transition.TRANSITION_DEACTIVATE, Transition.TRANSITION_ACTIVATE):
            assert apart.change("recorder", transition)
    bag.unlink()
    bag.parent.rmdir()
    gone = time.monotonic()
    apart.wait(lambda: heard["/diagnostics"], "it is reported")
    seconds = time.monotonic() - gone
    apart.wait(
        lambda: any(values_of(event)["event"] == "recording_failed" for event in heard["events"]),
        "the event",
    )
    recorder.signal(signal.SIGINT)
    assert recorder.end() == 1
    (status,) = apart.probe.last("/diagnostics").status
    assert status.level == DiagnosticStatus.ERROR
    assert "was lost during recording: it was removed or moved" in status.message
    assert seconds < 1.0
    assert "was lost during recording" in recorder.said
    assert "messages are recorded" not in recorder.said
    assert "Traceback" not in recorder.said


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
            lambda: recording.messages + len(recording.early_messages) >= self.sent,
            "it is recorded",
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


def test_messages_before_states_wait_for_the_clock(harness: Harness, tmp_path: Path) -> None:
    recorded = Recorded(harness, tmp_path / "a.mcap", clock_wait=0.0)
    create, topics = recorded.probe.create_publisher, ("/plant/status", "/obstacles", "/a/twist")
    early = [create(String, topic, 10) for topic in topics]
    create(JointState, "/joint_states", 10)
    recorded.start("/joint_states", *topics)
    for publisher in early:
        recorded.publish(publisher, String())
    recorded.recorder.flush()
    clock = create(Clock, "/clock", 10)
    harness.connect()
    clock.publish(Clock(clock=Time(sec=3)))
    harness.spin_until(lambda: recorded.recorder.messages_recorded == 3, "the time of the clock")
    assert recorded.close() == {topic: [(3.0, 3.0)] for topic in topics}


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
    refused_bag = tmp_path / "refused.mcap"
    parameters = {**recorded.parameters, "bag": str(refused_bag)}
    refusing = harness.make(RecorderNode, parameters, autostart=False)
    for text in ("[1]", "{", '{"one": 5}'):
        file.write_text(text)
        refusing.trigger_configure()
        assert_one_sentence(str(refusing.fault), "'describe'")
        assert not refused_bag.exists()
