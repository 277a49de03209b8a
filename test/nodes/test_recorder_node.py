"""The recorder node beside a plant and a planner: what is in the bag against what was heard."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from mcap.reader import make_reader
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.qos import qos_profile_system_default
from rclpy.serialization import deserialize_message
from rclpy.service_introspection import ServiceIntrospectionState
from std_msgs.msg import String
from std_srvs.srv import SetBool
from support.planner_flight import PLANNER
from support.recorded_stack import LATCHED_TOPICS, PLANT, STREAMS, BagContent, Stack, parameters_of
from support.ros_harness import LATCHED, Harness

from spacerobot_ros import __version__, read_bag
from spacerobot_ros.model import load_robot
from spacerobot_ros.nodes import PlantNode, RecorderNode

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


def test_description_parameters_and_version_are_in_the_bag(stack: Stack) -> None:
    for node in (stack.plant, stack.planner):
        stack.recorder.describe(f"parameters/{node.get_name()}", parameters_of(node))
    urdf = stack.plant.plant.robot.description.urdf
    assert stack.recorder.recording is not None
    stack.recorder.recording.attach("robot_description.urdf", urdf.encode(), "application/xml")
    stack.fly()
    stack.stop()
    bag = stack.close_bag()
    assert bag.metadata["spacerobot"]["version"] == __version__
    media_type, data = bag.attachments["robot_description.urdf"]
    assert media_type == "application/xml"
    assert data == load_robot(URDF).urdf.encode()
    for name, given in (("plant", PLANT), ("planner", PLANNER)):
        written = {k: json.loads(v) for k, v in bag.metadata[f"parameters/{name}"].items()}
        node = getattr(stack, name)
        for key, value in given.items():
            assert written[key] == value
        declared = node.get_parameters_by_prefix("")
        assert set(declared) - set(written) <= {"use_sim_time", "start_type_description_service"}
        for key, value in written.items():
            known = declared[key].value
            # An empty list is declared without a value.
            assert value == ([] if known is None else np.array(known).tolist()), key


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


def test_a_shutdown_completes_the_bag(stack: Stack) -> None:
    stack.fly()
    stack.stop()
    assert stack.recorder.trigger_shutdown() is TransitionCallbackReturn.SUCCESS
    assert BagContent(stack.bag)["/odom"] == stack.probe.messages["/odom"]


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
    np.testing.assert_array_equal([e.log_ns for e in content.by_topic["/craft/odom"]], 0)


def test_the_recorder_tells_of_its_bag(harness: Harness, tmp_path: Path) -> None:
    stack = Stack(harness, tmp_path / "flight.mcap", diagnostics_period=0.05, flush_period=0.05)
    stack.configure(*STREAMS, *LATCHED_TOPICS)
    stack.recorder.trigger_activate()
    stack.fly()
    stack.stop()

    def told() -> list[dict[str, str]]:
        return [
            {pair.key: pair.value for pair in status.values}
            for array in stack.probe.messages["/diagnostics"]
            for status in array.status
            if status.name == "recorder: bag"
        ]

    before = len(told())
    harness.spin_until(lambda: len(told()) > before + 2, "diagnostics of the recorder")
    said = told()[-1]
    assert said["messages_lost"] == "0"
    assert int(said["topics"]) == len(stack.recorder.topics)
    assert int(said["bytes_written"]) == pytest.approx(stack.bag.stat().st_size, rel=0.2)
    bag = stack.close_bag()
    # It records what it says, and so is a few messages further by now.
    assert bag.count - 20 <= int(said["messages"]) <= bag.count
