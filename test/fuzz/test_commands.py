"""Messages of commands, and bytes that are none: taken as meant, or refused and counted."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from geometry_msgs.msg import WrenchStamped
from hypothesis import strategies as st
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import JointState
from support.fuzzing import NUMBERS, TEXTS, damaged, fuzz

from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.nodes.common.cdr import UnreadableError
from spacerobot_ros.nodes.plant.command_channel import CommandChannel, JointChannel, WrenchChannel
from spacerobot_ros.resources import robot_file

NAMES = st.one_of(
    st.sampled_from(["slider_1", "slider_2", "slider_3"]),
    TEXTS,
)
STAMPS = st.tuples(
    st.sampled_from([0, 1, -1, 2**31 - 1, -(2**31)]), st.sampled_from([0, 1, 50_000_000, 2**32 - 1])
)


@lru_cache
def robot() -> SpaceRobot:
    return SpaceRobot.from_file(robot_file("sliding_masses"))


@st.composite
def joint_commands(draw: st.DrawFn) -> JointState:
    count = draw(st.integers(0, 4))
    usual = [f"slider_{i % 3 + 1}" for i in range(count)]
    message = JointState(
        name=draw(st.just(usual) | st.lists(NAMES, max_size=4)),
        velocity=draw(st.lists(NUMBERS, min_size=count, max_size=count) | st.lists(NUMBERS)),
        position=draw(st.just([]) | st.lists(NUMBERS, max_size=4)),
        effort=draw(st.just([]) | st.lists(NUMBERS, max_size=4)),
    )
    message.header.frame_id = draw(TEXTS)
    message.header.stamp.sec, message.header.stamp.nanosec = draw(STAMPS)
    return message


@st.composite
def wrenches(draw: st.DrawFn) -> WrenchStamped:
    message = WrenchStamped()
    message.header.frame_id = draw(st.sampled_from(["", robot().base_link]) | TEXTS)
    message.header.stamp.sec, message.header.stamp.nanosec = draw(STAMPS)
    for vector in (message.wrench.force, message.wrench.torque):
        vector.x, vector.y, vector.z = draw(st.tuples(NUMBERS, NUMBERS, NUMBERS))
    return message


GOOD = JointState(name=["slider_1", "slider_2", "slider_3"], velocity=[0.1, 0.2, -0.3])
GOOD_WRENCH = WrenchStamped()
GOOD_WRENCH.wrench.torque.z = 0.5


def assert_good_passes(channel: CommandChannel, good: object, values: list[float]) -> None:
    stamp, refused = channel.check(bytes(serialize_message(good)))
    assert (stamp, refused) == (0, None)
    channel.take(stamp)
    assert channel.command.tolist() == values


def check(channel: CommandChannel, raw: bytes) -> bool:
    """Return whether a channel takes some bytes; what it takes is finite."""
    try:
        stamp, refused = channel.check(raw)
    except UnreadableError:
        return False
    assert isinstance(stamp, int)
    if refused is not None:
        assert refused[1]
        assert "\n" not in refused[1]
        return False
    channel.take(stamp)
    assert np.all(np.isfinite(channel.command))
    return True


@fuzz("joint command", joint_commands(), fast=60, long=1200)
def test_joint_commands_are_taken_by_name_or_refused(message: JointState) -> None:
    channel = JointChannel(robot(), "velocity")
    if check(channel, bytes(serialize_message(message))):
        meant = dict(zip(message.name, message.velocity, strict=True))
        assert channel.command.tolist() == [meant.get(n, 0.0) for n in robot().joint_names]
    assert_good_passes(channel, GOOD, [0.1, 0.2, -0.3])


@fuzz("wrench", wrenches(), fast=60, long=800)
def test_wrenches_are_taken_in_their_frame_or_refused(message: WrenchStamped) -> None:
    channel = WrenchChannel(robot())
    taken = check(channel, bytes(serialize_message(message)))
    if message.header.frame_id not in ("", robot().base_link):
        assert not taken
    if taken:
        force = message.wrench.force
        assert channel.command[:3].tolist() == [force.x, force.y, force.z]
    assert_good_passes(channel, GOOD_WRENCH, [0.0, 0.0, 0.0, 0.0, 0.0, 0.5])


@fuzz(
    "damaged command",
    damaged(bytes(serialize_message(GOOD))),
    st.booleans(),
    fast=80,
    long=1500,
)
def test_damaged_joint_commands_mean_what_any_reader_takes_them_for(
    raw: bytes, learned: bool
) -> None:
    channel = JointChannel(robot(), "velocity")
    if learned:
        assert_good_passes(channel, GOOD, [0.1, 0.2, -0.3])
    if check(channel, raw):
        message = deserialize_message(raw, JointState)
        meant = dict(zip(message.name, message.velocity, strict=True))
        assert channel.command.tolist() == [meant.get(n, 0.0) for n in robot().joint_names]
    assert_good_passes(channel, GOOD, [0.1, 0.2, -0.3])


@fuzz(
    "damaged wrench",
    damaged(bytes(serialize_message(GOOD_WRENCH))),
    st.booleans(),
    fast=60,
    long=800,
)
def test_damaged_wrenches_mean_what_any_reader_takes_them_for(raw: bytes, learned: bool) -> None:
    channel = WrenchChannel(robot())
    if learned:
        assert_good_passes(channel, GOOD_WRENCH, [0.0, 0.0, 0.0, 0.0, 0.0, 0.5])
    if check(channel, raw):
        torque = deserialize_message(raw, WrenchStamped).wrench.torque
        assert channel.command[3:].tolist() == [torque.x, torque.y, torque.z]
    assert_good_passes(channel, GOOD_WRENCH, [0.0, 0.0, 0.0, 0.0, 0.0, 0.5])
