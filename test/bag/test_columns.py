"""Columns cut out of serialised messages, against the same messages decoded one by one."""

from __future__ import annotations

from operator import attrgetter
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from hypothesis import given, settings
from hypothesis import strategies as st
from rclpy.serialization import deserialize_message, serialize_message
from rosbags.typesys import Stores, get_typestore
from sensor_msgs.msg import JointState
from std_msgs.msg import Header
from visualization_msgs.msg import Marker

from spacerobot_ros.messages.layout import read_columns

Sample = tuple[str, str, Any]

TYPESTORE = get_typestore(Stores.ROS2_JAZZY)

# Fields outside of lists of messages and of strings, counted in the definitions by hand.
FIELD_COUNTS = {
    "/odom": 4 + 7 + 1 + 6 + 1,
    "/base_pose": 3 + 7,
    "/joint_states": 3 + 3,
    "/momentum": 2,
    "/gait_schedule": 3,
    "/planned_path": 3,
    "/base_wrench": 3 + 6,
    "/planner/status": 4,
    "/diagnostics": 3,
    "/robot_description": 1,
    "/markers": 0,
    "/clock": 2,
}


def check(messages: list[bytes], type_name: str, decoded: list[Any] | None = None) -> int:
    """Compare every column with the decoded messages; return how many columns there are."""
    found = read_columns(messages, type_name, TYPESTORE.fielddefs)
    assert found is not None
    if decoded is None:
        decoded = [TYPESTORE.deserialize_cdr(message, type_name) for message in messages]
    for path in found.paths:
        expected = list(map(attrgetter(path), decoded))
        column = found[path]
        if isinstance(column, list):
            assert column == expected
        else:
            assert len(column) == len(messages)
            # Equal to the bit, not-a-number and signed zeros included.
            expected_array = np.array(expected).astype(column.dtype)
            assert column.shape == expected_array.shape
            assert column.tobytes() == expected_array.tobytes()
    return len(found.paths)


def test_every_type(samples: list[Sample]) -> None:
    for topic, type_name, message in samples:
        assert check([serialize_message(message)] * 3, type_name) == FIELD_COUNTS[topic], topic


words = st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=6)
numbers = st.floats(allow_nan=True, width=64)


@st.composite
def joint_states(draw: st.DrawFn) -> list[JointState]:
    """Messages of one layout and with different values; any of the lists may be empty."""
    names = draw(st.lists(words, max_size=4))
    frame_id = draw(words)
    sizes = draw(st.tuples(*[st.integers(0, 3)] * 3))
    values = [st.lists(numbers, min_size=size, max_size=size) for size in sizes]
    return [
        JointState(
            header=Header(frame_id=frame_id),
            name=names,
            position=draw(values[0]),
            velocity=draw(values[1]),
            effort=draw(values[2]),
        )
        for _ in range(draw(st.integers(1, 5)))
    ]


@settings(deadline=None, max_examples=100)
@given(joint_states())
def test_joint_states(messages: list[JointState]) -> None:
    data = [serialize_message(message) for message in messages]
    decoded = [deserialize_message(message, JointState) for message in data]
    assert check(data, "sensor_msgs/msg/JointState", decoded) == 6


@settings(deadline=None, max_examples=50)
@given(words, words, words, st.booleans(), st.integers(0, 3))
def test_markers(ns: str, text: str, mesh: str, locked: bool, count: int) -> None:
    marker = Marker(ns=ns, text=text, mesh_resource=mesh, frame_locked=locked, type=count)
    assert check([serialize_message(marker)] * 2, "visualization_msgs/msg/Marker") == 35


def test_strings_of_one_length_may_differ() -> None:
    states = [DiagnosticStatus(name="plan", message=m) for m in ("idle", "busy", "Δok")]
    data = [serialize_message(state) for state in states]
    assert check(data, "diagnostic_msgs/msg/DiagnosticStatus") == 4


@pytest.mark.parametrize(
    "messages",
    [
        # As long as the other one, with another layout.
        [JointState(name=["ab", "c"]), JointState(name=["a", "bc"])],
        [JointState(position=[1.0], velocity=[]), JointState(position=[], velocity=[1.0])],
        [JointState(name=["a"]), JointState(name=["a", "b"])],
        [],
    ],
)
def test_there_are_no_columns_where_layouts_differ(messages: list[JointState]) -> None:
    data = [serialize_message(message).ljust(80, b"\0") for message in messages]
    assert read_columns(data, "sensor_msgs/msg/JointState", TYPESTORE.fielddefs) is None


def test_there_are_no_columns_in_what_is_no_message() -> None:
    data = serialize_message(JointState(name=["a"]))
    for broken in (b"", data[:3], data[:10], data[:-12], b"\0\0" + data[2:]):
        assert read_columns([broken], "sensor_msgs/msg/JointState", TYPESTORE.fielddefs) is None


def test_there_are_no_columns_where_the_order_of_bytes_changes() -> None:
    little, big = (bytes([0, order, 0, 0]) + bytes(8) for order in (1, 0))
    time = "builtin_interfaces/msg/Time"
    assert read_columns([little, little], time, TYPESTORE.fielddefs) is not None
    assert read_columns([little, big], time, TYPESTORE.fielddefs) is None


def test_numbers_beyond_int64_stay_as_they_are() -> None:
    message = bytes([0, 1, 0, 0]) + (2**63 + 5).to_bytes(8, "little")
    found = read_columns([message] * 2, "std_msgs/msg/UInt64", TYPESTORE.fielddefs)
    assert found is not None
    assert [int(each) for each in found["data"]] == [2**63 + 5] * 2
