"""Byte layouts against rclpy's own serialisation."""

from __future__ import annotations

import re
import struct
from functools import reduce
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped, WrenchStamped
from hypothesis import given, settings
from hypothesis import strategies as st
from nav_msgs.msg import Odometry, Path
from rclpy.serialization import deserialize_message, serialize_message
from rosgraph_msgs.msg import Clock
from rosidl_parser.definition import AbstractSequence, Array, BasicType, NamespacedType
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, Header, String
from support.random_messages import few, messages
from trajectory_msgs.msg import JointTrajectory
from visualization_msgs.msg import Marker, MarkerArray

from spacerobot_ros.nodes.common.cdr import (
    Layout,
    MessageTemplate,
    TemplateReader,
    UnreadableError,
)
from spacerobot_ros.times import stamp_bytes

MESSAGES = (
    Clock, DiagnosticArray, DiagnosticStatus, Float64MultiArray, JointState, JointTrajectory,
    MarkerArray, Odometry, Path, PoseStamped, String, WrenchStamped,
)  # fmt: skip

FORMATS = {
    "boolean": "?", "octet": "c", "uint8": "B", "int8": "b", "uint16": "H", "int16": "h",
    "uint32": "I", "int32": "i", "uint64": "Q", "int64": "q", "float": "f", "double": "d",
}  # fmt: skip


def scalars(value: Any, kind: Any, path: str) -> list[tuple[str, str, Any]]:
    """Return path, type and value of every number of a message, in the order of its fields."""
    if isinstance(kind, BasicType):
        return [(path, kind.typename, value)]
    if isinstance(kind, NamespacedType):
        fields = zip(value.get_fields_and_field_types(), value.SLOT_TYPES, strict=True)
        return [s for name, k in fields for s in scalars(getattr(value, name), k, f"{path}.{name}")]
    if isinstance(kind, (AbstractSequence, Array)):
        return [s for i, x in enumerate(value) for s in scalars(x, kind.value_type, f"{path}[{i}]")]
    return []


def numbers_of(message: Any) -> list[tuple[str, str, Any]]:
    fields = zip(message.get_fields_and_field_types(), message.SLOT_TYPES, strict=True)
    return [s for name, kind in fields for s in scalars(getattr(message, name), kind, name)]


def at(message: Any, path: str) -> Any:
    """Return what stands at a path such as ``markers[2].pose.position.x``."""
    parts = re.findall(r"\w+", path)
    return reduce(lambda v, p: v[int(p)] if p.isdigit() else getattr(v, p), parts, message)


# -- layouts ----------------------------------------------------------------------------------


@pytest.mark.parametrize("message_type", MESSAGES, ids=lambda t: t.__name__)
def test_every_number_is_where_the_layout_says(message_type: Any) -> None:
    @few
    @given(messages(message_type))
    def check(message: Any) -> None:
        raw = serialize_message(message)
        layout = Layout.of(message)
        for path, typename, value in numbers_of(message):
            assert at(message, path) == value
            (stored,) = struct.unpack_from("<" + FORMATS[typename], raw, layout.offsets[path])
            assert stored == value, path
        assert raw[:4] == b"\0\1\0\0"
        # What follows the end is nothing: another serialiser leaves it out.
        assert layout.end <= len(raw)
        assert deserialize_message(raw[: layout.end], message_type) == message

    check()


@pytest.mark.parametrize("message_type", MESSAGES, ids=lambda t: t.__name__)
def test_what_is_neither_number_nor_fixed_is_padding(message_type: Any) -> None:
    @few
    @given(messages(message_type), st.integers(0, 255))
    def check(message: Any, filler: int) -> None:
        raw = bytearray(serialize_message(message))
        layout = Layout.of(message)
        used = bytearray(len(raw))
        used[:4] = b"\1" * 4
        for start, end in layout.fixed:
            used[start:end] = b"\1" * (end - start)
        for path, typename, _ in numbers_of(message):
            start = layout.offsets[path]
            size = struct.calcsize("<" + FORMATS[typename])
            assert not any(used[start : start + size]), f"{path} overlaps something"
            used[start : start + size] = b"\1" * size
        for place, taken in enumerate(used):
            if not taken:
                raw[place] = filler
        assert deserialize_message(bytes(raw), message_type) == message

    check()


def test_a_path_to_a_part_is_that_of_its_first_number() -> None:
    message = MarkerArray(markers=[Marker(ns="a"), Marker(ns="bc")])
    offsets = Layout.of(message).offsets
    assert offsets["markers[1].pose"] == offsets["markers[1].pose.position.x"]
    assert offsets["markers[1]"] == offsets["markers[1].header.stamp.sec"]
    assert offsets["markers"] == offsets["markers[0].header.stamp.sec"]


# -- templates --------------------------------------------------------------------------------


@few
@given(messages(Odometry), st.lists(st.floats(allow_nan=False), min_size=7, max_size=7),
       st.integers(0, 2**31 * 10**9 - 1))  # fmt: skip
def test_a_template_changes_its_numbers_and_nothing_else(
    prototype: Odometry, numbers: list[float], time_ns: int
) -> None:
    template = MessageTemplate(prototype)
    template.floats("pose.pose.position.x", 7)[:] = numbers
    template.floats("pose.covariance", 36)[:] = np.arange(36.0)
    sent = deserialize_message(template.serialised(stamp_bytes(time_ns)), Odometry)
    p, o = prototype.pose.pose.position, prototype.pose.pose.orientation
    p.x, p.y, p.z, o.x, o.y, o.z, o.w = numbers
    prototype.pose.covariance = np.arange(36.0)
    prototype.header.stamp = Time(sec=time_ns // 10**9, nanosec=time_ns % 10**9)
    assert sent == prototype


@few
@given(messages(MarkerArray), st.integers(0, 2**31 * 10**9 - 1))
def test_a_template_stamps_every_header(prototype: MarkerArray, time_ns: int) -> None:
    sent = deserialize_message(
        MessageTemplate(prototype).serialised(stamp_bytes(time_ns)), MarkerArray
    )
    for marker in prototype.markers:
        for header in (marker.header, marker.texture.header):
            header.stamp = Time(sec=time_ns // 10**9, nanosec=time_ns % 10**9)
    assert sent == prototype


def test_a_template_stamps_the_clock() -> None:
    raw = MessageTemplate(Clock()).serialised(stamp_bytes(12_000_000_034))
    assert deserialize_message(raw, Clock) == Clock(clock=Time(sec=12, nanosec=34))


def test_what_a_template_has_given_out_does_not_change() -> None:
    template = MessageTemplate(Float64MultiArray(data=[0.0] * 3))
    data = template.floats("data", 3)
    data[:] = 1.0
    first = template.serialised(stamp_bytes(0))
    data[:] = 2.0
    template.serialised(stamp_bytes(1))
    assert list(deserialize_message(first, Float64MultiArray).data) == [1.0] * 3


# -- reading ----------------------------------------------------------------------------------


QUANTITIES = ("position", "velocity", "effort")


def spans(message: JointState) -> dict[str, int]:
    return {name: len(getattr(message, name)) for name in ("position", "velocity")}


def check_reads(reader: TemplateReader[JointState], message: JointState) -> None:
    assert reader.stamp_ns == message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
    for name in ("position", "velocity"):
        expected = getattr(message, name)
        assert reader.has(name) == bool(len(expected))
        if len(expected):
            np.testing.assert_array_equal(reader.floats(name), expected)
    assert not reader.has("effort")


# Few different layouts, so that they come again.
joint_states = st.builds(
    JointState,
    header=st.builds(
        Header,
        stamp=st.builds(Time, sec=st.integers(-(2**31), 2**31 - 1), nanosec=st.integers(0, 10**9)),
        frame_id=st.sampled_from(["", "base_link"]),
    ),
    name=st.sampled_from([[], ["a"], ["b"], ["a", "b"], ["ab", ""], ["elbow", "wrist"]]),
    **{
        quantity: st.lists(st.floats(allow_nan=False), max_size=2)
        for quantity in ("position", "velocity", "effort")
    },
)


@settings(few, max_examples=80)
@given(st.lists(joint_states, min_size=1, max_size=12))
def test_a_reader_reads_what_rclpy_reads_whatever_comes(sent: list[JointState]) -> None:
    reader = TemplateReader(JointState, spans)
    for message in sent:
        reader.accept(serialize_message(message))
        check_reads(reader, message)
        assert reader.prototype is not None
        assert list(reader.prototype.name) == list(message.name)


@settings(few, max_examples=60)
@given(
    joint_states,
    st.lists(st.lists(st.floats(allow_nan=False), min_size=6, max_size=6), max_size=8),
    st.randoms(use_true_random=False),
)
def test_a_reader_learns_a_layout_once(
    message: JointState, series: list[list[float]], random: Any
) -> None:
    reader = TemplateReader(JointState, spans)
    reader.accept(serialize_message(message))
    layout = Layout.of(message)
    for numbers in series:
        for k, name in enumerate(QUANTITIES):
            count = len(getattr(message, name))
            setattr(message, name, numbers[2 * k : 2 * k + count])
        message.header.stamp.nanosec = random.randrange(10**9)
        raw = bytearray(serialize_message(message))
        # Padding may hold anything, and other clients leave other things there.
        taken = {b for start, end in layout.fixed for b in range(start, end)} | set(range(12))
        for path, typename, _ in numbers_of(message):
            start = layout.offsets[path]
            taken |= set(range(start, start + struct.calcsize("<" + FORMATS[typename])))
        for place in set(range(len(raw))) - taken:
            raw[place] = random.randrange(256)
        reader.accept(bytes(raw))
        check_reads(reader, message)
    assert reader.changes == 1


@pytest.mark.parametrize("quantity", QUANTITIES)
def test_a_reader_sees_that_a_name_of_equal_length_has_changed(quantity: str) -> None:
    reader = TemplateReader(JointState, lambda m: {quantity: len(getattr(m, quantity))})
    for names, changes in ((["a", "b"], 1), (["a", "b"], 1), (["b", "a"], 2), (["b", "a"], 2)):
        numbers: dict[str, Any] = {q: [1.0, 2.0] for q in QUANTITIES}
        reader.accept(serialize_message(JointState(name=names, **numbers)))
        assert reader.changes == changes
        assert list(reader.prototype.name) == names  # type: ignore[union-attr]
        np.testing.assert_array_equal(reader.floats(quantity), [1.0, 2.0])


def test_a_reader_sees_that_numbers_have_moved_from_one_field_to_the_next() -> None:
    # The same size and names, and other lengths.
    reader = TemplateReader(JointState, spans)
    for position, velocity in (([1.0, 2.0], [3.0]), ([1.0], [2.0, 3.0]), ([1.0, 2.0], [3.0])):
        message = JointState(name=["a"], position=position, velocity=velocity, effort=[0.0])
        reader.accept(serialize_message(message))
        check_reads(reader, message)
    assert reader.changes == 3


def test_a_reader_refuses_what_is_no_message() -> None:
    reader = TemplateReader(JointState, spans)
    with pytest.raises(UnreadableError, match="its bytes are no JointState"):
        reader.accept(b"\0\1\0\0" + b"\xff" * 29)
    # And still reads the next.
    message = JointState(name=["a"], position=[1.0], velocity=[2.0], effort=[0.0])
    reader.accept(serialize_message(message))
    check_reads(reader, message)
