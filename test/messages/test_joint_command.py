"""Joint messages taken by name, against a dictionary."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from hypothesis import given, settings
from hypothesis import strategies as st
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import Header

from spacerobot_ros.errors import CommandError
from spacerobot_ros.messages.readers import JointReader

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
            st.lists(st.sampled_from(JOINTS), max_size=3, unique=True),
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
    if len(set(names)) < len(names) or not set(names) <= set(JOINTS):
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
                    np.testing.assert_array_equal(reader.values[quantity], values)  # type: ignore[index]

    check()


def test_a_repeated_layout_is_read_anew_each_time() -> None:
    reader = JointReader(JOINTS, ["velocity"])
    for k in range(5):
        sent = message(["slider_3", "slider_1"], k, velocity=[0.1 * k, -0.2 * k])
        assert reader.accept(serialize_message(sent)) == k
        np.testing.assert_array_equal(reader.values["velocity"], [-0.2 * k, 0.0, 0.1 * k])


def test_a_joint_that_is_no_longer_named_is_left_out() -> None:
    reader = JointReader(JOINTS, ["velocity"])
    reader.accept(serialize_message(message(list(JOINTS), velocity=[1.0, 2.0, 3.0])))
    reader.accept(serialize_message(message(["elbow"], velocity=[4.0])))
    np.testing.assert_array_equal(reader.values["velocity"], [0.0, 4.0, 0.0])
    reader.accept(serialize_message(message([], velocity=[])))
    np.testing.assert_array_equal(reader.values["velocity"], np.zeros(3))


def test_a_refused_message_leaves_nothing_behind() -> None:
    reader = JointReader(JOINTS, ["velocity"])
    with pytest.raises(CommandError):
        reader.accept(serialize_message(message([*JOINTS, "rudder"], velocity=[math.nan] * 4)))
    reader.accept(serialize_message(message(["elbow"], velocity=[4.0])))
    np.testing.assert_array_equal(reader.values["velocity"], [0.0, 4.0, 0.0])


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
        (message(["elbow"], velocity=[]), ["1 joint(s)", "0 velocity"]),
        (message(["elbow"], velocity=[1.0, 2.0]), ["1 joint(s)", "2 velocity"]),
        (message([], velocity=[1.0]), ["0 joint(s)", "1 velocity"]),
        (message(["elbow"], velocity=[1.0], position=[1.0] * 3), ["1 joint(s)", "3 position"]),
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
