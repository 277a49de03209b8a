"""Streams of serialised messages."""

from __future__ import annotations

import pytest
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile
from rclpy.serialization import serialize_message
from std_msgs.msg import String

from spacerobot_ros.nodes.common.node import LATCHED, STREAM
from spacerobot_ros.nodes.common.streams import RawOutput


@pytest.mark.parametrize(("qos", "number"), [(STREAM, 1), (LATCHED, 4)])
def test_messages_that_nobody_can_receive_are_not_published(
    ros_context: rclpy.Context, qos: QoSProfile, number: int
) -> None:
    """The middleware numbers its messages: a late subscription sees what came before."""
    sender, receiver = (
        rclpy.create_node(name, context=ros_context) for name in ("sender", "receiver")
    )
    output = RawOutput(sender.create_publisher(String, "words", qos), latched=qos is LATCHED)
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
    output.take(said[3])
    while not heard or heard[-1][1] != said[3]:
        executor.spin_once(timeout_sec=0.1)
    assert heard[-1] == (number, said[3])
    for node in (sender, receiver):
        node.destroy_node()
    executor.shutdown()
