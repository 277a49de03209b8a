"""Messages of commands, and bytes that are none: taken as meant, or refused and counted."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import WrenchStamped
from hypothesis import strategies as st
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from support.fuzzing import NUMBERS, TEXTS, damaged, fuzz
from support.plant_rig import STATE, Rig
from support.ros_harness import Harness

from spacerobot_ros.messages.readers import CommandReader
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.resources import robot_file
from spacerobot_ros.simulation.actuators import build_plant
from spacerobot_ros.simulation.commands import CommandSource, CommandValidator, Reason
from spacerobot_ros.simulation.config import PlantConfig

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
    count = draw(st.just(3) | st.integers(0, 4))
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


class Commanded:
    """A source of commands with its reader and validator, in a plant that takes any stamp."""

    def __init__(self, actuation: str, number: int) -> None:
        # In real time without a timeout a stamp is only compared with the one in force.
        config = PlantConfig(actuation=actuation, command_timeout=0.0)
        self.commands = CommandValidator(build_plant(robot(), config), config)
        self.source: CommandSource = self.commands.sources[number]
        self.reader: CommandReader = CommandReader(self.source, robot())

    def accepts(self, raw: bytes) -> bool:
        """Return whether the source accepts some bytes; what it accepts is finite."""
        refusal = self.reader.offer(self.commands, raw, 0)
        self.stamp = self.source.stamp_ns
        self.source.stamp_ns = -float("inf")
        if refusal is not None:
            assert refusal.clause
            assert "\n" not in refusal.clause
            return False
        assert np.all(np.isfinite(self.source.command))
        return True

    def assert_good_passes(self, good: object, values: list[float]) -> None:
        assert self.accepts(bytes(serialize_message(good)))
        assert self.stamp == 0
        assert self.source.command.tolist() == values


def joints() -> Commanded:
    return Commanded("velocity", 0)


def wrench() -> Commanded:
    return Commanded("effort", 1)


@fuzz("joint command", joint_commands(), fast=30, long=1200)
def test_joint_commands_are_taken_by_name_or_refused(message: JointState) -> None:
    given = joints()
    if given.accepts(bytes(serialize_message(message))):
        meant = dict(zip(message.name, message.velocity, strict=True))
        assert given.source.command.tolist() == [meant[n] for n in robot().joint_names]
    given.assert_good_passes(GOOD, [0.1, 0.2, -0.3])


@fuzz("wrench", wrenches(), fast=30, long=800)
def test_wrenches_are_taken_in_their_frame_or_refused(message: WrenchStamped) -> None:
    given = wrench()
    taken = given.accepts(bytes(serialize_message(message)))
    if message.header.frame_id not in ("", robot().base_link):
        assert not taken
    if taken:
        force = message.wrench.force
        assert given.source.command[:3].tolist() == [force.x, force.y, force.z]
    given.assert_good_passes(GOOD_WRENCH, [0.0, 0.0, 0.0, 0.0, 0.0, 0.5])


@fuzz(
    "damaged command",
    damaged(bytes(serialize_message(GOOD))),
    st.booleans(),
    fast=40,
    long=1500,
)
def test_damaged_joint_commands_mean_what_any_reader_takes_them_for(
    raw: bytes, learned: bool
) -> None:
    given = joints()
    if learned:
        given.assert_good_passes(GOOD, [0.1, 0.2, -0.3])
    if given.accepts(raw):
        message = deserialize_message(raw, JointState)
        meant = dict(zip(message.name, message.velocity, strict=True))
        assert given.source.command.tolist() == [meant[n] for n in robot().joint_names]
    given.assert_good_passes(GOOD, [0.1, 0.2, -0.3])


@fuzz(
    "damaged wrench",
    damaged(bytes(serialize_message(GOOD_WRENCH))),
    st.booleans(),
    fast=30,
    long=800,
)
def test_damaged_wrenches_mean_what_any_reader_takes_them_for(raw: bytes, learned: bool) -> None:
    given = wrench()
    if learned:
        given.assert_good_passes(GOOD_WRENCH, [0.0, 0.0, 0.0, 0.0, 0.0, 0.5])
    if given.accepts(raw):
        torque = deserialize_message(raw, WrenchStamped).wrench.torque
        assert given.source.command[3:].tolist() == [torque.x, torque.y, torque.z]
    given.assert_good_passes(GOOD_WRENCH, [0.0, 0.0, 0.0, 0.0, 0.0, 0.5])


@fuzz("latched joint command", joint_commands(), st.booleans(), fast=40, long=1500)
def test_malformed_joint_commands_latch_a_fault(message: JointState, refuse: bool) -> None:
    assert_latches_if_malformed(message, 0, "refuse" if refuse else "clip")


@fuzz("latched wrench", wrenches(), fast=20, long=800)
def test_malformed_wrenches_latch_a_fault(message: WrenchStamped) -> None:
    assert_latches_if_malformed(message, 1, "clip")


def assert_latches_if_malformed(
    message: JointState | WrenchStamped, number: int, beyond_limits: str
) -> None:
    """Offer a message in lockstep at its own stamp."""
    config = PlantConfig(
        actuation="effort" if number else "velocity",
        time_mode="lockstep",
        beyond_limits=beyond_limits,
        latched_faults="malformed beyond_limits",
    )
    commands = CommandValidator(build_plant(robot(), config), config)
    stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
    commands.revoke_before(stamp)  # So that no stamp is of a state before the start.
    reader = CommandReader(commands.sources[number], robot())
    refusal = reader.offer(commands, bytes(serialize_message(message)), stamp)
    assert (refusal is not None and refusal.reason is not Reason.NOT_FINITE) == bool(commands.fault)


# -- a live plant under any messages -----------------------------------------------------------

JOINTS = ["slider_1", "slider_2", "slider_3"]

LIVE = JointState(name=JOINTS, velocity=[0.01, 0.0, 0.0], effort=[0.01, 0.0, 0.0])


@st.composite
def live_commands(draw: st.DrawFn) -> tuple[list[str], list[float], list[float], int]:
    names = draw(st.permutations(JOINTS) | st.lists(st.sampled_from(JOINTS) | TEXTS, max_size=4))
    size = len(names) if draw(st.booleans()) else draw(st.integers(0, 4))
    numbers = st.lists(NUMBERS, min_size=size, max_size=size)
    late = draw(st.sampled_from([0, 0, 0, 1, -1, 10**9, -(10**9), 10**18]))
    return names, draw(numbers), draw(numbers), late


INPUTS = st.one_of(
    live_commands(),
    st.lists(NUMBERS, min_size=6, max_size=6),
    damaged(bytes(serialize_message(LIVE))),
    st.text(
        max_size=20, alphabet=st.characters(exclude_categories=["Cs"], exclude_characters="\0")
    ),
)


def numbers_in(message: Any) -> list[float]:
    """Return every float of a message, whatever its type."""
    if isinstance(message, float):
        return [message]
    if hasattr(message, "get_fields_and_field_types"):
        return [
            x
            for name in message.get_fields_and_field_types()
            for x in numbers_in(getattr(message, name))
        ]
    if isinstance(message, (str, bytes, int)):
        return []
    return [x for element in message for x in numbers_in(element)]


def stops(rig: Rig) -> int:
    return sum("The plant stops at" in line.msg for line in rig.probe.messages["/rosout"])


class Sender:
    """Publishes inputs of any kind to a plant, and a good command after each."""

    def __init__(self, rig: Rig, quantity: str) -> None:
        self.rig, self.quantity, self.stops = rig, quantity, 0
        self.wrench = None
        if quantity == "effort":
            self.wrench = rig.probe.create_publisher(WrenchStamped, "base_wrench", 100)
        self.faults = rig.probe.create_publisher(String, "fault_injection", 100)
        rig.harness.connect()

    def send(self, given: Any) -> None:
        rig = self.rig
        if isinstance(given, bytes):
            rig.commands.publish(given)
        elif isinstance(given, str):
            self.faults.publish(String(data=given))
        elif isinstance(given, list):
            if self.wrench is not None:
                self.wrench.publish(self.stamped_wrench(given))
        else:
            names, first, second, late = given
            stamp = min(max(rig.now_ns + late, 0), (2**31 - 1) * 10**9)
            rig.send(first, names, stamp_ns=stamp, effort=second)

    def stamped_wrench(self, values: list[float]) -> WrenchStamped:
        message = WrenchStamped()
        message.header.stamp = self.rig.probe.last("joint_states").header.stamp
        wrench = message.wrench
        for vector, part in ((wrench.force, values[:3]), (wrench.torque, values[3:])):
            vector.x, vector.y, vector.z = part
        return message

    def good(self) -> None:
        """Send the command of this tick, until the plant has gone on."""
        rig = self.rig
        before, end = rig.probe.count("joint_states"), rig.now_ns
        if self.wrench is not None:
            self.wrench.publish(self.stamped_wrench([0.0] * 6))
        rig.send([0.01], ["slider_1"], effort=[0.01])
        rig.harness.spin_until(
            lambda: rig.probe.count("joint_states") > before or not rig.plant.is_active, "a tick"
        )
        if not rig.plant.is_active:
            # A wrench or a fault of any size: the robot spins faster than numbers tell.
            assert self.quantity == "effort"
            rig.harness.spin_until(lambda: stops(rig) > self.stops, "a word on why it stops")
            rig.plant.plant.inject("clear")
            rig.trigger("plant/reset")
            rig.activate()
            self.stops = stops(rig)
        else:
            assert rig.now_ns > end


@pytest.mark.slow
@pytest.mark.parametrize("actuation", ["velocity", "effort"])
def test_a_lockstep_plant(actuation: str, harness: Harness) -> None:
    rig = Rig(harness, {"actuation": actuation, "latched_faults": ""})
    sender = Sender(rig, actuation)
    seen = dict.fromkeys(STATE, 0)

    @fuzz("live lockstep plant", INPUTS, fast=25, long=400)
    def disturb(given: Any) -> None:
        sender.send(given)
        sender.good()
        for topic in STATE:
            for message in rig.probe.messages[topic][seen[topic] :]:
                assert all(map(math.isfinite, numbers_in(message))), (topic, given)
            seen[topic] = rig.probe.count(topic)

    disturb()
    assert rig.plant.is_active


def test_a_plant_in_real_time(harness: Harness) -> None:
    rig = Rig(harness, {"time_mode": "realtime", "real_time_factor": 10.0, "latched_faults": ""})
    sender = Sender(rig, "velocity")
    seen = dict.fromkeys(STATE, 0)

    @fuzz("live real-time plant", INPUTS, fast=15, long=200)
    def disturb(given: Any) -> None:
        sender.send(given)
        before = rig.probe.count("joint_states")
        rig.send([0.01], ["slider_1"], stamp_ns=0)
        rig.wait("joint_states", before + 1)
        for topic in STATE:
            for message in rig.probe.messages[topic][seen[topic] :]:
                assert all(map(math.isfinite, numbers_in(message))), (topic, given)
            seen[topic] = rig.probe.count(topic)

    disturb()
    rig.send([0.01], ["slider_1"], stamp_ns=0)
    assert rig.plant.is_active
