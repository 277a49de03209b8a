"""What definitions and messages may be at most, and what is read of the allowed ones."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from geometry_msgs.msg import WrenchStamped
from nav_msgs.msg import Path
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import Header, String

from spacerobot_ros.errors import CommandError, RecordingError
from spacerobot_ros.messages.definitions import MessageType, fields_of, message_definition
from spacerobot_ros.messages.layout import (
    encode_list,
    read_columns,
    seconds_and_nanoseconds,
    stamped_copies,
)
from spacerobot_ros.messages.readers import (
    JointReader,
    MessageDecoder,
    UnreadableError,
    joint_template,
    read_text,
)
from spacerobot_ros.times import LATEST_NS, stamp_bytes

S = 10**9
NAME = "a/msg/B"


def refused(text: str, name: str = NAME) -> str:
    with pytest.raises(ValueError, match=r"\w") as caught:
        MessageType(name, text.encode())
    return str(caught.value)


@pytest.mark.parametrize("name", ["a/B", "a/msg/1B", "a/msg/B/C", "1a/msg/B", "a/foo/B"])
def test_types_have_names_of_three_parts(name: str) -> None:
    assert refused("int32 x\n", name) == "a type is called 'package/msg/Type'"


def test_texts_of_types_are_limited() -> None:
    line = "int32 x\n"
    full = line + "#" * (262_144 - len(line))
    assert MessageType(NAME, full.encode())
    long = "its text is longer than 262144 bytes or 5000 lines, which no message needs"
    assert refused(full + "#") == long
    lines = line + "\n" * 4_999
    assert MessageType(NAME, lines.encode())
    assert refused(lines + "\n") == long


@pytest.mark.parametrize(
    ("text", "count"),
    [
        # Of strings and messages every element counts, of numbers the list.
        ("int32[5000] x\n", 1),
        ("string[1000] x\n", 1000), ("string[999] x\nint8 y\n", 1000),
        ("string[] x\nint8[] y\n", 2),
        ("C[500] c\n" + "=" * 80 + "\nMSG: a/C\nint8 x\nint8 y\n", 1000),
        ("C[] c\n" + "=" * 80 + "\nMSG: a/C\nint8 x\nint8 y\n", 2),
    ],
)  # fmt: skip
def test_fields_are_counted_with_those_of_messages_in_them(text: str, count: int) -> None:
    assert NAME in MessageType(NAME, text.encode()).fields
    if count < 1000:
        assert MessageType(NAME, f"string[{1000 - count}] z\n{text}".encode())
    more = f"string[{1001 - count}] z\n{text}"
    assert refused(more).startswith("a/msg/B has more than 1000 fields")


def chain(depth: int) -> str:
    parts = [f"C{i + 1} x\n" if i < depth else "int8 x\n" for i in range(depth + 1)]
    rule = "=" * 80
    return "".join(p if not i else f"{rule}\nMSG: a/C{i}\n{p}" for i, p in enumerate(parts))


def test_types_are_nested_at_most_32_deep_and_never_in_themselves() -> None:
    assert MessageType(NAME, chain(32).encode())
    deep = "its types are nested more than 32 deep, or in themselves"
    assert refused(chain(33)) == refused("B x\n") == deep
    assert refused("C x\n") == "it does not define a/msg/C"


@pytest.mark.parametrize("wrong", ["String", "std_msgs/msg/", "a/msg/B/c", "/String"])
def test_names_that_are_none_of_types_are_refused(wrong: str) -> None:
    with pytest.raises(RecordingError, match="is not the name of a message type"):
        message_definition(wrong)


# -- messages -----------------------------------------------------------------------------------


def state(names: list[str], sec: int = 0, nanosec: int = 0, frame: str = "", **more: Any) -> bytes:
    values: dict[str, Any] = {"position": [float(i + 1) for i in range(len(names))], **more}
    header = Header(stamp=Time(sec=sec, nanosec=nanosec), frame_id=frame)
    return serialize_message(JointState(header=header, name=names, **values))


def test_a_measured_state_may_be_as_long_as_that_of_a_machine_with_other_joints() -> None:
    reader = JointReader(["arms", "ü"], ["position"], measured=True)
    longest = 4096 + 2 * (4 + 32 + 2 + 32) + 65536
    short = state(["arms", "ü"], frame="f")
    fits = state(["arms", "ü"], frame="f" * (longest - len(short) + 1))
    assert len(fits) == longest
    assert reader.accept(fits) == 0
    longer = state(["arms", "ü"], frame="f" * (longest - len(short) + 9))
    with pytest.raises(UnreadableError) as caught:
        reader.accept(longer)
    said = f"it has {len(longer)} bytes, of which at most {longest} can be meant"
    assert str(caught.value) == said
    assert JointReader(["arms", "ü"], ["position"]).accept(longer) == 0


@pytest.mark.parametrize("measured", [False, True])
def test_the_stamp_of_a_measured_state_is_one_of_an_answer(measured: bool) -> None:
    reader = JointReader(["a"], ["position"], measured=measured)
    last = state(["a"], 2**31 - 1, 999_999_999)
    assert reader.accept(last) == LATEST_NS
    late = last[:8] + (1_000_000_000).to_bytes(4, "little") + last[12:]
    if not measured:
        assert reader.accept(late) == LATEST_NS + 1
        return
    with pytest.raises(UnreadableError, match="no command can carry its stamp of 2147483648 s"):
        reader.accept(late)


def test_references_lack_what_they_do_not_give() -> None:
    decoder = MessageDecoder(["a", "b"])
    position, velocity = decoder.joint_reference(state(["b", "a"]))
    assert (position.tolist(), velocity.tolist()) == ([2, 1], [0, 0])
    decoder.decode_joints(state(["a", "b"], velocity=[0.5, 0.25]))
    assert (decoder.q.tolist(), decoder.qdot.tolist()) == ([1, 2], [0.5, 0.25])


@pytest.mark.parametrize("count", [10_000, 10_001])
def test_a_list_of_texts_has_ten_thousand_at_most(count: int) -> None:
    reader = JointReader(["a"], ["position"])
    raw = state(["a"] * count, 3, position=[])
    with pytest.raises(CommandError) as caught:
        reader.accept(raw)
    long = f"it has a list of {count} entries, more than 10000"
    assert (str(caught.value) == long) is (count > 10_000)
    assert reader.stamp_ns == 3 * S


def test_messages_of_big_endian_machines_are_read() -> None:
    little = state(["a"], 3, 4, position=[0.5])
    header = (3).to_bytes(4, "big") + (4).to_bytes(4, "big") + (1).to_bytes(4, "big") + b"\0\0\0\0"
    name = (1).to_bytes(4, "big") + (2).to_bytes(4, "big") + b"a\0\0\0"
    number = (1).to_bytes(4, "big") + np.array([0.5], ">f8").tobytes()
    big = b"\0\0\0\0" + header + name + number + bytes(8)
    for raw in (little, big, little, big):
        reader = JointReader(["a"], ["position"])
        assert reader.accept(raw) == 3 * S + 4
        assert reader.values["position"].tolist() == [0.5]
    with pytest.raises(UnreadableError, match="its bytes are not a JointState"):
        JointReader(["a"], ["position"]).accept(b"\0\2" + little[2:])
    with pytest.raises(UnreadableError, match="its bytes are not a JointState"):
        JointReader(["a"], ["position"]).accept(big[:-9])


def test_single_texts_are_read_and_broken_ones_refused() -> None:
    raw = serialize_message(String(data="a robot ü"))
    assert read_text(raw, "std_msgs/msg/String", "data") == "a robot ü"
    with pytest.raises(UnreadableError, match=r"^its bytes are not a String$"):
        read_text(raw[:-4], "std_msgs/msg/String", "data")


def test_a_template_of_joints_has_all_their_quantities() -> None:
    template = joint_template(["a", "bc"])
    for number, name in enumerate(("position", "velocity", "effort")):
        template.floats(name, 2)[:] = [number + 0.5, number + 0.25]
    found = JointReader(["a", "bc"], ["position", "velocity", "effort"])
    assert found.accept(template.serialised(stamp_bytes(2 * S + 5))) == 2 * S + 5
    assert [values.tolist() for values in found.values.values()] == [
        [0.5, 0.25], [1.5, 1.25], [2.5, 2.25]]  # fmt: skip


# -- lists and columns --------------------------------------------------------------------------


@pytest.mark.parametrize("count", [0, 1, 2, 5])
def test_lists_of_messages_have_a_row_each(count: int) -> None:
    times = np.arange(count, dtype=np.int64) * 1_500_000_000
    positions = np.arange(3.0 * count).reshape(count, 3)
    raw = encode_list(
        "nav_msgs/msg/Path", {"header": {"frame_id": "world"}}, "poses",
        {"header": {"frame_id": "hand"}},
        {"header.stamp.sec": seconds_and_nanoseconds(times), "pose.position.x": positions},
    )  # fmt: skip
    message = deserialize_message(raw, Path)
    assert message.header.frame_id == "world"
    assert len(message.poses) == count
    for i, each in enumerate(message.poses):
        assert each.header.frame_id == "hand"
        assert each.header.stamp.sec * S + each.header.stamp.nanosec == times[i]
        at = each.pose.position
        assert [at.x, at.y, at.z] == positions[i].tolist()


def test_copies_differ_in_stamps_and_numbers() -> None:
    prototype = serialize_message(WrenchStamped(header=Header(frame_id="base")))
    stamps = np.array([1, S + 2, 5 * S], np.int64)
    forces = np.arange(9.0).reshape(3, 3) + 0.5
    copies = stamped_copies(
        prototype, "geometry_msgs/msg/WrenchStamped", stamps, {"wrench.force.x": forces}
    )
    name = "geometry_msgs/msg/WrenchStamped"
    found = read_columns(copies, name, fields_of(name))
    assert found is not None
    assert list(found["header.stamp.sec"]) == [0, 1, 5]
    assert list(found["header.stamp.nanosec"]) == [1, 2, 0]
    assert list(found["wrench.force.y"]) == [1.5, 4.5, 7.5]
    assert list(found["wrench.torque.z"]) == [0.0] * 3
    assert found["header.frame_id"] == ["base"] * 3
