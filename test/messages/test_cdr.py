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
from visualization_msgs.msg import MarkerArray

from spacerobot_ros.messages.definitions import Layout, encode, installed_type
from spacerobot_ros.messages.readers import MessageTemplate, TemplateReader, UnreadableError
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


def type_name(message_type: Any) -> str:
    return f"{message_type.__module__.split('.')[0]}/msg/{message_type.__name__}"


def layout(message: Any) -> Layout:
    return Layout(
        serialize_message(message), installed_type(type_name(type(message))), elements=True
    )


def offset(found: Layout, path: str) -> int:
    """Return the first byte of a number, which may be an entry of an array."""
    if path in found.leaves:
        return found.leaves[path].offset
    array, _, index = path.rstrip("]").rpartition("[")
    leaf = found.leaves[array]
    assert leaf.dtype is not None
    assert int(index) < leaf.shape[0]
    return leaf.offset + int(index) * leaf.dtype.itemsize


def bytes_of(found: Layout, path: str, typename: str) -> range:
    """Return the places of the bytes of a number."""
    start = offset(found, path)
    return range(start, start + struct.calcsize("<" + FORMATS[typename]))


def template(message: Any) -> MessageTemplate:
    return MessageTemplate(type_name(type(message)), serialize_message(message))


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
        found = layout(message)
        for path, typename, value in numbers_of(message):
            assert at(message, path) == value
            (stored,) = struct.unpack_from("<" + FORMATS[typename], raw, offset(found, path))
            assert stored == value, path
        assert raw[:4] == b"\0\1\0\0"
        # What follows the end is nothing: another serialiser leaves it out.
        assert found.end <= len(raw)
        assert deserialize_message(raw[: found.end], message_type) == message

    check()


@pytest.mark.parametrize("message_type", MESSAGES, ids=lambda t: t.__name__)
def test_what_is_neither_number_nor_fixed_is_padding(message_type: Any) -> None:
    @few
    @given(messages(message_type), st.integers(0, 255))
    def check(message: Any, filler: int) -> None:
        raw = bytearray(serialize_message(message))
        found = layout(message)
        used = bytearray(len(raw))
        used[:4] = b"\1" * 4
        for start, end in found.fixed:
            used[start:end] = b"\1" * (end - start)
        for path, typename, _ in numbers_of(message):
            for place in bytes_of(found, path, typename):
                assert not used[place], f"{path} overlaps something"
                used[place] = 1
        for place, taken in enumerate(used):
            if not taken:
                raw[place] = filler
        assert deserialize_message(bytes(raw), message_type) == message

    check()


# -- making messages --------------------------------------------------------------------------


def plain(message: Any) -> dict[str, Any]:
    """Return a message as nested dictionaries."""

    def value(part: Any) -> Any:
        if hasattr(part, "get_fields_and_field_types"):
            return plain(part)
        if isinstance(part, bytes):
            return int.from_bytes(part, "little", signed=True)
        if isinstance(part, list):
            return [value(each) for each in part]
        return part

    return {name: value(getattr(message, name)) for name in message.get_fields_and_field_types()}


@pytest.mark.parametrize("message_type", MESSAGES, ids=lambda t: t.__name__)
def test_rclpy_reads_what_is_encoded(message_type: Any) -> None:
    @few
    @given(messages(message_type))
    def check(message: Any) -> None:
        raw = encode(type_name(message_type), plain(message))
        assert deserialize_message(raw, message_type) == message
        assert len(raw) == layout(message).end

    check()


def test_a_field_that_a_type_lacks_is_not_encoded() -> None:
    with pytest.raises(KeyError, match="Odometry has no field child_frame"):
        encode("nav_msgs/msg/Odometry", {"child_frame": "base"})
    with pytest.raises(ValueError, match="36 numbers"):
        encode("nav_msgs/msg/Odometry", {"pose": {"covariance": np.zeros(6)}})
    with pytest.raises(ValueError, match=r"2 numbers are required; the shape is \(2, 3\)"):
        encode(JOINT_STATE, {"position": np.zeros((2, 3))})
    with pytest.raises(TypeError):
        encode(JOINT_STATE, {"position": 5.0})


def test_arrays_may_be_empty() -> None:
    raw = encode(
        JOINT_STATE, {"name": [], "position": np.zeros(0), "effort": np.ones((3, 2))[:, 1]}
    )
    assert deserialize_message(raw, JointState) == JointState(effort=[1.0] * 3)


def test_whole_nanoseconds_are_a_time() -> None:
    raw = encode("rosgraph_msgs/msg/Clock", {"clock": 12_000_000_034})
    assert deserialize_message(raw, Clock) == Clock(clock=Time(sec=12, nanosec=34))


# -- templates --------------------------------------------------------------------------------


@few
@given(messages(Odometry), st.lists(st.floats(allow_nan=False), min_size=7, max_size=7),
       st.integers(0, 2**31 * 10**9 - 1))  # fmt: skip
def test_a_template_changes_its_numbers_and_nothing_else(
    prototype: Odometry, numbers: list[float], time_ns: int
) -> None:
    patched = template(prototype)
    patched.feed("pose.pose.position.x", np.array(numbers))
    patched.feed("pose.covariance", np.arange(36.0))
    sent = deserialize_message(patched.serialised(stamp_bytes(time_ns)), Odometry)
    p, o = prototype.pose.pose.position, prototype.pose.pose.orientation
    p.x, p.y, p.z, o.x, o.y, o.z, o.w = numbers
    prototype.pose.covariance = np.arange(36.0)
    prototype.header.stamp = Time(sec=time_ns // 10**9, nanosec=time_ns % 10**9)
    assert sent == prototype


@few
@given(messages(MarkerArray), st.integers(0, 2**31 * 10**9 - 1))
def test_a_template_stamps_every_header(prototype: MarkerArray, time_ns: int) -> None:
    sent = deserialize_message(template(prototype).serialised(stamp_bytes(time_ns)), MarkerArray)
    for marker in prototype.markers:
        for header in (marker.header, marker.texture.header):
            header.stamp = Time(sec=time_ns // 10**9, nanosec=time_ns % 10**9)
    assert sent == prototype


def test_what_a_template_has_given_out_does_not_change() -> None:
    patched = template(Float64MultiArray(data=[0.0] * 3))
    data = np.ones(3)
    patched.feed("data", data)
    first = patched.serialised(stamp_bytes(0))
    data[:] = 2.0
    patched.serialised(stamp_bytes(1))
    assert list(deserialize_message(first, Float64MultiArray).data) == [1.0] * 3


# -- reading ----------------------------------------------------------------------------------


QUANTITIES = ("position", "velocity", "effort")
JOINT_STATE = "sensor_msgs/msg/JointState"


def check_reads(reader: TemplateReader, message: JointState) -> None:
    assert reader.stamp_ns == message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
    for name in ("position", "velocity"):
        expected = getattr(message, name)
        assert reader.value_count(name) == len(expected)
        if len(expected):
            np.testing.assert_array_equal(reader.floats(name), expected)


# Few different layouts, so that they come again.
joint_states = st.builds(
    JointState,
    header=st.builds(
        Header,
        stamp=st.builds(Time, sec=st.integers(-(2**31), 2**31 - 1), nanosec=st.integers(0, 10**9)),
        frame_id=st.sampled_from(["", "base_link"]),
    ),
    name=st.sampled_from([[], ["a"], ["b"], ["a", "b"], ["ab", ""], ["elbow", "wrist"]]),
    **{quantity: st.lists(st.floats(allow_nan=False), max_size=2) for quantity in QUANTITIES},
)


@settings(few, max_examples=80)
@given(st.lists(joint_states, min_size=1, max_size=12))
def test_a_reader_reads_what_rclpy_reads_whatever_comes(sent: list[JointState]) -> None:
    reader = TemplateReader(JOINT_STATE)
    for message in sent:
        reader.accept(serialize_message(message))
        check_reads(reader, message)
        assert reader.texts("name") == list(message.name)
        assert reader.text("header.frame_id") == message.header.frame_id


@settings(few, max_examples=60)
@given(
    joint_states,
    st.lists(st.lists(st.floats(allow_nan=False), min_size=6, max_size=6), max_size=8),
    st.randoms(use_true_random=False),
)
def test_a_reader_learns_a_layout_once(
    message: JointState, series: list[list[float]], random: Any
) -> None:
    reader = TemplateReader(JOINT_STATE)
    reader.accept(serialize_message(message))
    found = layout(message)
    for numbers in series:
        for k, name in enumerate(QUANTITIES):
            count = len(getattr(message, name))
            setattr(message, name, numbers[2 * k : 2 * k + count])
        message.header.stamp.nanosec = random.randrange(10**9)
        raw = bytearray(serialize_message(message))
        # Padding may hold anything, and other clients leave other things there.
        taken = {b for start, end in found.fixed for b in range(start, end)} | set(range(12))
        for path, typename, _ in numbers_of(message):
            taken |= set(bytes_of(found, path, typename))
        for place in set(range(len(raw))) - taken:
            raw[place] = random.randrange(256)
        assert not reader.accept(bytes(raw))
        check_reads(reader, message)


def test_a_name_without_its_final_zero_is_whole_as_in_other_readers() -> None:
    raw = bytearray(serialize_message(JointState(name=["ab", "cd"])))
    raw[raw.index(b"ab\0") + 2] = 1
    reader = TemplateReader(JOINT_STATE)
    reader.accept(bytes(raw))
    assert reader.texts("name") == list(deserialize_message(bytes(raw), JointState).name)
    assert reader.texts("name") == ["ab\x01", "cd"]


def test_a_reader_refuses_what_is_no_message() -> None:
    reader = TemplateReader(JOINT_STATE)
    for position in (1.0, 2.0):
        message = JointState(name=["a"], position=[position], velocity=[2.0], effort=[0.0])
        reader.accept(serialize_message(message))
        check_reads(reader, message)
        with pytest.raises(UnreadableError, match="its bytes are not a JointState"):
            reader.accept(b"\0\1\0\0" + b"\xff" * 29)
        assert reader.floats("position") == [position]
