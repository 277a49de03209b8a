"""Joint messages taken by name, against a dictionary."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from geometry_msgs.msg import WrenchStamped
from hypothesis import given, settings
from hypothesis import strategies as st
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import Header

from spacerobot_ros.errors import CommandError
from spacerobot_ros.messages.readers import CommandReader, JointReader
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.urdf import load_robot
from spacerobot_ros.resources import robot_file
from spacerobot_ros.simulation.actuators import build_plant
from spacerobot_ros.simulation.commands import CommandValidator, Reason
from spacerobot_ros.simulation.config import PlantConfig

JOINTS = ("slider_1", "elbow", "slider_3")
few = settings(derandomize=True, deadline=None, max_examples=30)
numbers = st.floats(allow_nan=True)


def message(names: list[str], time_ns: int = 0, **quantities: list[float]) -> JointState:
    stamp = Time(sec=time_ns // 10**9, nanosec=time_ns % 10**9)
    return JointState(header=Header(stamp=stamp), name=names, **quantities)


@st.composite
def joint_states(draw: Any) -> JointState:
    """Return a message that may be right or wrong, of few layouts so that they come again."""
    names = draw(
        st.one_of(
            st.permutations(JOINTS),
            st.permutations(JOINTS),
            st.lists(st.sampled_from([*JOINTS, "rudder"]), max_size=4),
        )
    )
    right = st.lists(numbers, min_size=len(names), max_size=len(names))
    anything = st.lists(numbers, max_size=4)
    position, velocity, effort = (
        draw(st.one_of(right, right, st.just([]), anything)) for _ in range(3)
    )
    time_ns = draw(st.integers(0, 2**31 * 10**9 - 1))
    return message(names, time_ns, position=position, velocity=velocity, effort=effort)


def expected(sent: JointState, quantities: list[str]) -> dict[str, list[float]] | None:
    """Return what is to be read, in the order of the joints; None where it is to be refused."""
    names = list(sent.name)
    if sorted(names) != sorted(JOINTS):
        return None
    read = {}
    for k, quantity in enumerate(quantities):
        given = list(getattr(sent, quantity))
        if len(given) != len(names) and (given or k == 0):
            return None
        by_name = dict(zip(names, given, strict=False))
        read[quantity] = [by_name.get(joint, 0.0) for joint in JOINTS]
    return read


@pytest.mark.parametrize(
    "quantities", [["velocity"], ["position", "velocity"], ["effort", "position", "velocity"]]
)
def test_whatever_comes_is_read_by_name_or_refused(quantities: list[Any]) -> None:
    @few
    @given(st.lists(joint_states(), min_size=1, max_size=10))
    def check(series: list[JointState]) -> None:
        reader = JointReader(JOINTS, quantities)
        for sent in series:
            wanted = expected(sent, quantities)
            raw = serialize_message(sent)
            stamp = sent.header.stamp.sec * 10**9 + sent.header.stamp.nanosec
            if wanted is None:
                with pytest.raises(CommandError):
                    reader.accept(raw)
                assert reader.stamp_ns == stamp
            else:
                assert reader.accept(raw) == stamp
                assert set(reader.values) == set(quantities)
                for quantity, values in wanted.items():
                    np.testing.assert_array_equal(reader.values[quantity], values)

    check()


def test_a_repeated_layout_is_read_anew_each_time() -> None:
    reader = JointReader(JOINTS, ["velocity"])
    for k in range(5):
        sent = message(["slider_3", "slider_1", "elbow"], k, velocity=[0.1 * k, -0.2 * k, 0.3 * k])
        assert reader.accept(serialize_message(sent)) == k
        np.testing.assert_array_equal(reader.values["velocity"], [-0.2 * k, 0.3 * k, 0.1 * k])


def test_a_quantity_that_is_no_longer_given_is_zero() -> None:
    reader = JointReader(JOINTS, ["velocity", "position"])
    names = ["elbow", "slider_1", "slider_3"]
    reader.accept(serialize_message(message(names, velocity=[1.0, 2.0, 3.0], position=[4.0] * 3)))
    np.testing.assert_array_equal(reader.values["position"], [4.0] * 3)
    reader.accept(serialize_message(message(names, velocity=[1.0, 2.0, 3.0])))
    np.testing.assert_array_equal(reader.values["velocity"], [2.0, 1.0, 3.0])
    np.testing.assert_array_equal(reader.values["position"], np.zeros(3))


def test_a_refused_message_leaves_nothing_behind() -> None:
    reader = JointReader(JOINTS, ["velocity"])
    with pytest.raises(CommandError):
        reader.accept(serialize_message(message([*JOINTS, "rudder"], velocity=[math.nan] * 4)))
    reader.accept(serialize_message(message(list(JOINTS[::-1]), velocity=[4.0, 5.0, 6.0])))
    np.testing.assert_array_equal(reader.values["velocity"], [6.0, 5.0, 4.0])


def test_a_message_that_is_refused_is_refused_again() -> None:
    reader = JointReader(JOINTS, ["velocity"])
    raw = serialize_message(message(["rudder"], velocity=[1.0]))
    for _ in range(3):
        with pytest.raises(CommandError, match="rudder"):
            reader.accept(raw)


@pytest.mark.parametrize(
    ("sent", "mentions"),
    [
        (message(["fin"], velocity=[1.0]), ["'fin'", "slider_1, elbow, slider_3"]),
        (message(["elbow", "elbow"], velocity=[1.0, 2.0]), ["twice", "elbow"]),
        (message(["elbow", "slider_1"], velocity=[1.0, 2.0]), ["'slider_3' is missing"]),
        (message(list(JOINTS), velocity=[]), ["3 joint(s)", "0 velocity"]),
        (message(list(JOINTS), velocity=[1.0, 2.0]), ["3 joint(s)", "2 velocity"]),
        (message(list(JOINTS), velocity=[1.0] * 3, position=[1.0]), ["3 joint(s)", "1 position"]),
    ],
)
def test_a_refusal_says_what_is_wrong(sent: JointState, mentions: list[str]) -> None:
    reader = JointReader(JOINTS, ["velocity", "position"])
    with pytest.raises(CommandError) as refusal:
        reader.accept(serialize_message(sent))
    for mention in mentions:
        assert mention in str(refusal.value)


def test_a_robot_without_joints_takes_an_empty_message() -> None:
    reader = JointReader((), ["velocity"])
    assert reader.accept(serialize_message(message([], 7, velocity=[]))) == 7
    assert reader.values["velocity"].shape == (0,)


# -- commands of a plant ----------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("actuation", ["velocity", "effort"])
def test_a_command_that_does_not_name_all_joints_is_malformed(actuation: Any) -> None:
    config = PlantConfig(actuation=actuation, command_timeout=0.0)
    robot = SpaceRobot(load_robot(robot_file("sliding_masses")))
    commands = CommandValidator(build_plant(robot, config), config)
    source = commands.sources[0]
    reader = CommandReader(source, robot)
    # All three joints, in another order and a frame that is not read; then two of them.
    order = [2, 0, 1]
    names = [robot.joint_names[i] for i in order]
    everything = message(names, 0, **{actuation: [0.3, 0.1, 0.2]})
    everything.header.frame_id = "moon"
    assert reader.offer(commands, serialize_message(everything), 0) is None
    assert source.command.tolist() == [0.1, 0.2, 0.3]
    two = message([robot.joint_names[i] for i in (1, 0)], 0, **{actuation: [0.25, 0.5]})
    refusal = reader.offer(commands, serialize_message(two), 0)
    assert refusal is not None
    assert refusal.reason is Reason.MALFORMED
    assert f"'{robot.joint_names[2]}' is missing" in refusal.clause
    assert source.command.tolist() == [0.1, 0.2, 0.3], "the command before stays in force"
    assert commands.counts == {Reason.MALFORMED: 1}


def test_a_wrench_in_another_frame_is_malformed() -> None:
    config = PlantConfig(actuation="effort", command_timeout=0.0)
    robot = SpaceRobot(load_robot(robot_file("sliding_masses")))
    commands = CommandValidator(build_plant(robot, config), config)
    source = commands.sources[1]
    reader = CommandReader(source, robot, "robot_1/")
    sent = WrenchStamped()
    sent.wrench.force.y = 0.5
    for frame, refused in (
        ("", False), (robot.base_link, False), (f"robot_1/{robot.base_link}", False),
        ("world", True), (f"robot_2/{robot.base_link}", True), ("", False),
    ):  # fmt: skip
        sent.header.frame_id = frame
        # The layout of the second message is known: it is refused all the same.
        for _ in range(2):
            refusal = reader.offer(commands, serialize_message(sent), 0)
            source.arrived = False
            assert (refusal is not None) == refused, frame
            if refusal is not None:
                assert refusal.reason is Reason.MALFORMED
                assert f"'{frame}'" in refusal.clause
    assert source.command.tolist() == [0.0, 0.5, 0.0, 0.0, 0.0, 0.0]
