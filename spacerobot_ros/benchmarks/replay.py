"""How well a replay keeps the recorded spacing, heard by a subscriber."""

from __future__ import annotations

import statistics
import time
from itertools import pairwise
from pathlib import Path

import rclpy
from rclpy.experimental import EventsExecutor
from rclpy.parameter import Parameter
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState

from spacerobot_ros.bag import BagWriter
from spacerobot_ros.nodes import ReplayNode
from spacerobot_ros.nodes.common.node import STREAM, spin_until

_PERIOD = 0.01
_COUNT = 500
_PATIENCE = 2.0
"""Wall s for what is on its way when the replay has ended."""

_TOPIC = "/bench/joint_states"


def replay_spacing(folder: Path) -> tuple[float, float]:
    """Return by how much the spacing of 500 messages, 100 a second, is missed at rate 1.

    Returns the median and the largest error of the time from one message to the next, s.
    """
    bag = folder / "spacing.mcap"
    with BagWriter(bag) as writer:
        channel = writer.add_topic(_TOPIC, "sensor_msgs/msg/JointState")
        raw = serialize_message(JointState(name=["a", "b", "c"], position=[0.0] * 3))
        for k in range(_COUNT):
            stamp = round(k * _PERIOD * 1e9)
            writer.write(channel, raw, stamp, stamp)
    arrivals: list[float] = []
    executor = EventsExecutor()
    listener = rclpy.create_node("listener")
    listener.create_subscription(
        JointState, _TOPIC, lambda _: arrivals.append(time.perf_counter()), STREAM, raw=True
    )
    replay = ReplayNode("replay", parameter_overrides=[Parameter("bag", value=str(bag))])
    done = rclpy.task.Future()
    replay.on_end = done.set_result
    try:
        for node in (listener, replay):
            executor.add_node(node)
        spin_until(executor, done)
        patience = time.perf_counter() + _PATIENCE
        while len(arrivals) < _COUNT and time.perf_counter() < patience:
            executor.spin_once(timeout_sec=0.1)
    finally:
        for node in (listener, replay):
            node.destroy_node()
        executor.shutdown()
    errors = [abs(later - earlier - _PERIOD) for earlier, later in pairwise(arrivals)]
    return statistics.median(errors), max(errors)
