"""A live plant under any messages: it stays up, says finite numbers, and takes the next command."""

from __future__ import annotations

import math
from typing import Any

import pytest
from geometry_msgs.msg import WrenchStamped
from hypothesis import strategies as st
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from support.fuzzing import NUMBERS, TEXTS, damaged, fuzz
from support.plant_rig import STATE, Rig
from support.ros_harness import Harness

JOINTS = ["slider_1", "slider_2", "slider_3"]

GOOD = JointState(name=JOINTS, velocity=[0.01, 0.0, 0.0], effort=[0.01, 0.0, 0.0])
FRAMES = st.sampled_from(["", "base_link"]) | TEXTS


@st.composite
def joint_commands(draw: st.DrawFn) -> tuple[list[str], list[float], list[float], int]:
    names = draw(st.permutations(JOINTS) | st.lists(st.sampled_from(JOINTS) | TEXTS, max_size=4))
    size = len(names) if draw(st.booleans()) else draw(st.integers(0, 4))
    numbers = st.lists(NUMBERS, min_size=size, max_size=size)
    late = draw(st.sampled_from([0, 0, 0, 1, -1, 10**9, -(10**9), 10**18]))
    return names, draw(numbers), draw(numbers), late


INPUTS = st.one_of(
    joint_commands(),
    st.lists(NUMBERS, min_size=6, max_size=6),
    damaged(bytes(serialize_message(GOOD))),
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
