"""A recorder that watches the nodes of its own process: the same bag, without subscriptions."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from nav_msgs.msg import Odometry
from rclpy.executors import SingleThreadedExecutor
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.qos import QoSProfile
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from support.recorded_stack import LATCHED_TOPICS, STREAMS, Stack
from support.ros_harness import DEEP, Harness, nanoseconds

from spacerobot_ros.nodes.common.node import LATCHED, STREAM
from spacerobot_ros.nodes.common.streams import RawOutput

TAPPED = {"/clock", "/odom", "/base_pose", "/joint_states", "/momentum", "/joint_commands"}


def watching(harness: Harness, bag: Path, **recorder: Any) -> Stack:
    stack = Stack(harness, bag, **recorder)
    stack.recorder.watch([stack.plant, stack.planner])
    return stack


@pytest.fixture
def stack(harness: Harness, tmp_path: Path) -> Stack:
    """Return a stack with a watching recorder that is active before anything happens."""
    stack = watching(harness, tmp_path / "flight.mcap")
    stack.configure(*STREAMS, *LATCHED_TOPICS)
    stack.recorder.trigger_activate()
    return stack


def subscribed(stack: Stack) -> set[str]:
    return {subscription.topic_name for subscription in stack.recorder.subscriptions}


def test_recorded_is_what_subscribers_hear(stack: Stack) -> None:
    assert not subscribed(stack) & TAPPED
    stack.fly()
    stack.stop()
    bag = stack.close_bag()
    heard = {topic: kept for topic, kept in stack.probe.messages.items() if topic != "/rosout"}
    assert set(bag.by_topic) == {*STREAMS, *LATCHED_TOPICS}
    # The status of a plant is there before all its readers are: some may miss the first ones.
    statuses = heard.pop("/plant/status")
    both = min(len(statuses), len(bag["/plant/status"]))
    assert both
    assert bag["/plant/status"][-both:] == statuses[-both:]
    for topic, kept in heard.items():
        assert bag[topic] == kept, topic
    assert len(bag["/odom"]) > 40
    assert bag.log_times == sorted(bag.log_times)
    for topic in TAPPED - {"/clock", "/momentum"}:
        for entry in bag.by_topic[topic]:
            assert entry.log_ns == entry.publish_ns == nanoseconds(entry.message.header.stamp)


def test_a_command_is_recorded_before_the_state_that_it_makes(stack: Stack) -> None:
    stack.fly()
    stack.stop()
    bag = stack.close_bag()
    times = [entry.log_ns for entry in bag.by_topic["/joint_commands"]]
    # One each tick, the last of them unanswered: time was stopped.
    states = [entry.log_ns for entry in bag.by_topic["/joint_states"]]
    assert times in (states, states[:-1])


def test_the_clock_counts_though_it_is_not_recorded(harness: Harness, tmp_path: Path) -> None:
    stack = watching(harness, tmp_path / "flight.mcap", topics="odom momentum")
    stack.configure("/odom", "/momentum")
    stack.recorder.trigger_activate()
    stack.probe.watch("/planner/status", DiagnosticStatus, latched=True)
    stack.fly()
    stack.stop()
    assert not subscribed(stack) & TAPPED
    bag = stack.close_bag()
    assert set(bag.by_topic) == {"/odom", "/momentum"}
    for odom, momentum in zip(bag.by_topic["/odom"], bag.by_topic["/momentum"], strict=True):
        assert odom.log_ns == momentum.log_ns == nanoseconds(odom.message.header.stamp)


def test_commands_of_others_are_recorded_as_the_plant_took_them(stack: Stack) -> None:
    other = stack.probe.create_publisher(JointState, "/joint_commands", DEEP)
    stack.harness.connect()
    stack.plant.trigger_activate()
    odd = JointState(name=["nobody's"], position=[1.0], velocity=[2.0])
    heard = stack.probe.count("/joint_commands")
    other.publish(odd)
    stack.harness.spin_until(lambda: stack.probe.count("/joint_commands") > heard, "the command")
    stack.stop()
    assert "/joint_commands" not in subscribed(stack)
    bag = stack.close_bag()
    assert odd in bag["/joint_commands"]
    assert bag["/joint_commands"] == stack.probe.messages["/joint_commands"]


def test_a_second_publisher_is_recorded_too(stack: Stack) -> None:
    stack.fly()
    stack.stop()
    other = stack.probe.create_publisher(Odometry, "/odom", DEEP)
    stack.harness.spin_until(lambda: "/odom" in subscribed(stack), "a subscription of odom")
    stack.harness.connect()
    foreign = Odometry(child_frame_id="somebody_else")
    other.publish(foreign)
    stack.fly(0.0)
    stack.stop()
    bag = stack.close_bag()
    assert foreign in bag["/odom"]
    by_content = [str(message) for message in bag["/odom"]]
    assert sorted(by_content) == sorted(str(m) for m in stack.probe.messages["/odom"])


def test_a_plant_that_is_configured_again_is_recorded_again(stack: Stack) -> None:
    stack.fly()
    stack.stop()
    before = stack.probe.count("/odom")
    assert stack.plant.trigger_cleanup() is TransitionCallbackReturn.SUCCESS
    stack.harness.spin_until(lambda: "/odom" not in stack.recorder.topics, "odom is let go")
    assert stack.plant.trigger_configure() is TransitionCallbackReturn.SUCCESS
    stack.await_topics("/odom", "/joint_states", "/clock")
    stack.harness.connect()
    stack.fly(0.02)
    stack.stop()
    bag = stack.close_bag()
    assert stack.probe.count("/odom") > before
    assert bag["/odom"] == stack.probe.messages["/odom"]


def test_a_closed_recorder_listens_no_more(stack: Stack) -> None:
    stack.fly()
    stack.stop()
    count = stack.close_bag().count
    stack.fly(0.0)
    stack.stop()
    assert stack.recorder.messages_recorded == count


def test_other_topics_are_subscribed(stack: Stack) -> None:
    assert {"/goal_pose", "/planner/status", "/markers"} <= subscribed(stack)
    notes = stack.probe.create_publisher(String, "/notes", DEEP)
    stack.harness.spin_until(lambda: "/notes" in stack.recorder.topics, "a subscription of notes")
    stack.harness.matched(notes)
    notes.publish(String(data="hello"))
    before = stack.recorder.messages_recorded
    stack.plant.trigger_activate()
    stack.harness.spin_until(lambda: stack.recorder.messages_recorded > before + 1, "the note")
    stack.stop()
    assert [message.data for message in stack.close_bag()["/notes"]] == ["hello"]


@pytest.mark.parametrize(("qos", "number"), [(STREAM, 1), (LATCHED, 4)])
@pytest.mark.parametrize("looks", [False, True])
def test_messages_that_nobody_can_receive_are_not_published(
    ros_context: rclpy.Context, qos: QoSProfile, number: int, looks: bool
) -> None:
    """The middleware numbers its messages: a late subscription sees what came before.

    Where the owner ``looks`` for readers, a message before its next look is not published.
    """
    sender, receiver = (
        rclpy.create_node(name, context=ros_context) for name in ("sender", "receiver")
    )
    output = RawOutput(sender.create_publisher(String, "words", qos), latched=qos is LATCHED)
    kept: list[bytes] = []
    output.add_listener(kept.append)
    if looks:
        output.look_for_readers()
    said = [serialize_message(String(data=word)) for word in ("one", "two", "three", "four")]
    for raw in said[:3]:
        output.take(raw)
    heard: list[tuple[int, bytes]] = []
    receiver.create_subscription(
        String,
        "words",
        lambda raw, about: heard.append((about["publication_sequence_number"], raw)),
        qos,
        raw=True,
    )
    executor = SingleThreadedExecutor(context=ros_context)
    executor.add_node(receiver)
    while not output.readers():
        executor.spin_once(timeout_sec=0.01)
    if looks:
        output.take(said[2])
        output.look_for_readers()
    output.take(said[3])
    while not heard or heard[-1][1] != said[3]:
        executor.spin_once(timeout_sec=0.1)
    more = [said[2]] if looks else []
    assert heard[-1] == (number + (looks and qos is LATCHED), said[3])
    assert kept == [*said[:3], *more, said[3]]
    for node in (sender, receiver):
        node.destroy_node()
    executor.shutdown()
