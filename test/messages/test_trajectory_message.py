"""Serialised schedules against rclpy's reading, and against two other readers of CDR."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory
from rclpy.serialization import deserialize_message
from rosbags.typesys import Stores, get_typestore
from support.random_messages import few
from trajectory_msgs.msg import JointTrajectory

from spacerobot_ros.bag import message_definition
from spacerobot_ros.messages.builders import trajectory_message
from spacerobot_ros.planning import BasePath, GaitSchedule, Goal


@st.composite
def schedules(draw: Any) -> GaitSchedule:
    names = draw(st.lists(st.text("abcdefghij", min_size=1, max_size=9), min_size=1, max_size=5))
    ticks = draw(st.integers(0, 7))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    return schedule_of(
        tuple(names), rng.normal(size=(ticks + 1, len(names))), draw(st.sampled_from([0.05, 0.7]))
    )


def schedule_of(names: tuple[str, ...], positions: Any, period: float) -> GaitSchedule:
    still = Goal(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]))
    path = BasePath(np.zeros(1), np.zeros((1, 3)), still.quaternion[np.newaxis])
    return GaitSchedule("test", names, period, positions, path, still)


def check_trajectory(message: Any, schedule: GaitSchedule, stamp_ns: int, frame: str) -> None:
    """Check a decoded trajectory, whoever has decoded it, against the schedule."""
    assert message.header.frame_id == frame
    assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == stamp_ns
    assert tuple(message.joint_names) == schedule.joint_names
    assert len(message.points) == len(schedule.positions)
    period_ns = round(schedule.control_period * 1e9)
    for k, point in enumerate(message.points):
        np.testing.assert_array_equal(point.positions, schedule.positions[k])
        held = np.zeros(len(schedule.joint_names))
        if k < schedule.ticks:
            held = (schedule.positions[k + 1] - schedule.positions[k]) / schedule.control_period
        np.testing.assert_array_equal(point.velocities, held)
        assert len(point.accelerations) == len(point.effort) == 0
        since = point.time_from_start
        assert since.sec * 10**9 + since.nanosec == k * period_ns
        assert 0 <= since.nanosec < 10**9


THREE = schedule_of(("slider_1", "slider_2", "slider_3"), np.arange(12.0).reshape(4, 3), 0.05)


@settings(few, max_examples=80)
@given(schedules(), st.integers(0, 2**31 * 10**9 - 1), st.text("lmnop", max_size=9))
@example(THREE, 0, "base_link")
@example(THREE, 3, "base")
def test_a_schedule_is_serialised_as_rclpy_would(
    schedule: GaitSchedule, stamp_ns: int, frame: str
) -> None:
    raw = trajectory_message(schedule, stamp_ns, frame)
    message = deserialize_message(raw, JointTrajectory)
    check_trajectory(message, schedule, stamp_ns, frame)


@pytest.mark.slow
@few
@given(schedules(), st.integers(0, 2**31 * 10**9 - 1), st.text("lmnop", max_size=9))
@example(THREE, 0, "base_link")
def test_other_readers_take_a_serialised_schedule(
    schedule: GaitSchedule, stamp_ns: int, frame: str
) -> None:
    raw = trajectory_message(schedule, stamp_ns, frame)
    kind = "trajectory_msgs/msg/JointTrajectory"
    by_rosbags = get_typestore(Stores.ROS2_JAZZY).deserialize_cdr(raw, kind)
    check_trajectory(by_rosbags, schedule, stamp_ns, frame)
    schema = Schema(id=1, name=kind, encoding="ros2msg", data=message_definition(kind).encode())
    decode = DecoderFactory().decoder_for("cdr", schema)
    assert decode is not None
    check_trajectory(decode(raw), schedule, stamp_ns, frame)


@pytest.mark.slow
def test_a_long_schedule_is_whole() -> None:
    # The gait of paper 1 has 98,001 points.
    rng = np.random.default_rng(4)
    schedule = schedule_of(("slider_1", "slider_2", "slider_3"), rng.normal(size=(98_001, 3)), 0.05)
    raw = trajectory_message(schedule, 50_000_000, "base_link")
    kind = "trajectory_msgs/msg/JointTrajectory"
    message: Any = get_typestore(Stores.ROS2_JAZZY).deserialize_cdr(raw, kind)
    assert len(message.points) == 98_001
    np.testing.assert_array_equal([p.positions for p in message.points], schedule.positions)
    last = message.points[-1].time_from_start
    assert (last.sec, last.nanosec) == (4900, 0)
