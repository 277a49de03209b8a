"""Messages and what they say: pairs of words, statuses, commands of joints, trajectories."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from geometry_msgs.msg import WrenchStamped
from hypothesis import example, given, settings
from hypothesis import strategies as st
from nav_msgs.msg import Path
from rclpy.serialization import deserialize_message, serialize_message
from rosbags.typesys import Stores, get_typestore
from sensor_msgs.msg import JointState
from std_msgs.msg import Header, String
from support.random_messages import few
from trajectory_msgs.msg import JointTrajectory

from spacerobot_ros.bag.series import read_columns
from spacerobot_ros.errors import CommandError, SpaceRobotError
from spacerobot_ros.events import INTEGER, SECONDS, KeyValueField, KeyValueFormat, list_format
from spacerobot_ros.messages.builders import encode_list, trajectory_message
from spacerobot_ros.messages.definitions import MessageType, installed_type, seconds_and_nanoseconds
from spacerobot_ros.messages.diagnostics import STATUS, StatusRecord, read_status
from spacerobot_ros.messages.readers import (
    CommandReader,
    JointReader,
    MessageDecoder,
    MessageTemplate,
    UnreadableError,
    joint_template,
    read_text,
)
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.urdf import load_robot
from spacerobot_ros.planning import BasePath, GaitSchedule, Goal
from spacerobot_ros.resources import robot_file
from spacerobot_ros.simulation.actuators import build_plant
from spacerobot_ros.simulation.commands import CommandValidator, Reason
from spacerobot_ros.simulation.config import PlantConfig
from spacerobot_ros.times import LATEST_NS, stamp_bytes

JOINTS = ("slider_1", "elbow", "slider_3")
numbers = st.floats(allow_nan=True)


def message(
    names: list[str], time_ns: int = 0, frame: str = "", **quantities: list[float]
) -> JointState:
    stamp = Time(sec=time_ns // 10**9, nanosec=time_ns % 10**9)
    return JointState(header=Header(stamp=stamp, frame_id=frame), name=names, **quantities)


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
    @settings(few, max_examples=30)
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
    before = serialize_message(message(list(JOINTS), velocity=[1.0, 2.0, 3.0]))
    refused = serialize_message(message([*JOINTS, "rudder"], velocity=[math.nan] * 4))
    reader.accept(before)
    for act in (reader.require, reader.accept):
        with pytest.raises(CommandError, match="'rudder' is unknown"):
            act(refused)
        np.testing.assert_array_equal(reader.values["velocity"], [1.0, 2.0, 3.0])
    reader.accept(serialize_message(message(list(JOINTS[::-1]), velocity=[4.0, 5.0, 6.0])))
    np.testing.assert_array_equal(reader.values["velocity"], [6.0, 5.0, 4.0])


@pytest.mark.parametrize(
    ("sent", "mentions"),
    [
        (message(["fin"], velocity=[1.0]), ["'fin'", "slider_1, elbow, slider_3"]),
        (message(["elbow", "elbow"], velocity=[1.0, 2.0]), ["twice", "elbow"]),
        (message(["elbow", "slider_1"], velocity=[1.0, 2.0]), ["'slider_3' is missing"]),
        (message(list(JOINTS), velocity=[]), ["3 joint names", "0 velocity"]),
        (message(list(JOINTS), velocity=[1.0, 2.0]), ["3 joint names", "2 velocity"]),
        (
            message(list(JOINTS), velocity=[1.0] * 3, position=[1.0]),
            ["3 joint names", "1 position"],
        ),
    ],
)
def test_a_refusal_says_what_is_wrong(sent: JointState, mentions: list[str]) -> None:
    reader = JointReader(JOINTS, ["velocity", "position"])
    for _ in range(2):
        with pytest.raises(CommandError) as refusal:
            reader.accept(serialize_message(sent))
        for mention in mentions:
            assert mention in str(refusal.value)


def test_a_robot_without_joints_takes_an_empty_message() -> None:
    reader = JointReader((), ["velocity"])
    assert reader.accept(serialize_message(message([], 7, velocity=[]))) == 7
    assert reader.values["velocity"].shape == (0,)


# -- commands of a plant ----------------------------------------------------------------------


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


# -- the key-value pairs of statuses and events: names, order, defaults, and pairs that ----------


@dataclass(frozen=True)
class Sample:
    count: int
    time_s: float | None = None
    words: tuple[str, ...] = ()
    named: dict[str, int] = field(default_factory=dict)
    others: dict[str, str] = field(default_factory=dict)


FORMAT = KeyValueFormat(
    "sample",
    KeyValueField("words", list_format("; "), always=True),
    KeyValueField("count", INTEGER, key="number"),
    KeyValueField("time_s", SECONDS),
    KeyValueField("named", INTEGER, prefix="n."),
    KeyValueField("others", prefix="", present_with="words"),
)


def test_pairs_have_the_order_of_the_fields_and_leave_defaults_out() -> None:
    sample = Sample(3, 0.0, ("a b", "c"), {"x": 4, "y": 5}, {"free": "text"})
    pairs = {"words": "a b; c", "number": "3", "time_s": "0.000000000"}
    pairs |= {"n.x": "4", "n.y": "5", "free": "text"}
    assert list(FORMAT.to_values(sample).items()) == list(pairs.items())
    assert FORMAT.from_values(Sample, pairs) == sample
    assert FORMAT.to_values(Sample(0, others={"free": "text"})) == {"words": "", "number": "0"}
    assert FORMAT.from_values(Sample, {"number": "7"}, time_s=2.5) == Sample(7, 2.5)


@pytest.mark.parametrize(
    ("pairs", "named"), [({"words": "a"}, "'number'"), ({"number": "3", "n.x": "1.5"}, "1.5")]
)
def test_pairs_that_are_missing_or_unreadable_are_named(pairs: dict[str, str], named: str) -> None:
    with pytest.raises(SpaceRobotError, match=f"^No sample can be read from the values: .*{named}"):
        FORMAT.from_values(Sample, pairs)


# -- statuses as messages: rclpy reads what is encoded, and nothing unprintable is read ----------


RECORD = StatusRecord(
    "/a/planner", 2, "The goal is refused.", {"state": "refused", "goal_id": "1.5"}, "servicer"
)


def test_rclpy_reads_an_encoded_status() -> None:
    message = deserialize_message(RECORD.encoded(), DiagnosticStatus)
    assert (message.level, message.name, message.hardware_id) == (b"\2", "/a/planner", "servicer")
    assert message.message == "The goal is refused."
    assert message.values == [
        KeyValue(key="state", value="refused"),
        KeyValue(key="goal_id", value="1.5"),
    ]


@pytest.mark.parametrize("by", ["rclpy", "rosbags"])
def test_a_status_of_either_library_is_read(by: str) -> None:
    raw = RECORD.encoded()
    if by == "rclpy":
        message = deserialize_message(raw, DiagnosticStatus)
    else:
        message = get_typestore(Stores.ROS2_JAZZY).deserialize_cdr(raw, STATUS)
    assert read_status(message) == RECORD


def test_control_characters_are_not_read() -> None:
    """Of a terminal: clear the screen, a title, go back in the line, an 8-bit sequence."""
    hostile = "a\x1b[2Jb\x1b]0;title\x07\rc\x9b31md\n\u202ee"
    sent = DiagnosticStatus(
        name=hostile,
        message=hostile,
        hardware_id=hostile,
        values=[KeyValue(key=hostile, value=hostile)],
    )
    record = read_status(deserialize_message(serialize_message(sent), DiagnosticStatus))
    ((key, value),) = record.values.items()
    for text in (record.name, record.message, record.hardware_id, key, value):
        assert text.isprintable()
        assert all(letter in text for letter in "abcde")


# -- serialised schedules against rclpy's reading, and against two other readers of CDR ----------


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


S = 10**9
NAME = "a/msg/B"


def refused(text: str, name: str = NAME) -> str:
    with pytest.raises(ValueError, match=r"\w") as caught:
        MessageType(name, text.encode())
    return str(caught.value)


@pytest.mark.parametrize("name", ["a/B", "a/msg/1B", "a/msg/B/C", "1a/msg/B", "a/foo/B"])
def test_types_have_names_of_three_parts(name: str) -> None:
    assert refused("int32 x\n", name) == "a type name must have the form 'package/msg/Type'"


def test_texts_of_types_are_limited() -> None:
    line = "int32 x\n"
    full = line + "#" * (262_144 - len(line))
    assert MessageType(NAME, full.encode())
    long = "its definition is longer than 262144 bytes or 5000 lines, more than any message needs"
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
    deep = "its types are nested more than 32 deep, or recursive"
    assert refused(chain(33)) == refused("B x\n") == deep
    assert refused("C x\n") == "it does not define a/msg/C"


# -- messages -----------------------------------------------------------------------------------


def state(names: list[str], time_ns: int = 0, **more: Any) -> bytes:
    values = {"position": [float(i + 1) for i in range(len(names))], **more}
    return serialize_message(message(names, time_ns, **values))


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
    said = f"it has {len(longer)} bytes; at most {longest} are expected"
    assert str(caught.value) == said


@pytest.mark.parametrize("measured", [False, True])
def test_the_stamp_of_a_measured_state_is_one_of_an_answer(measured: bool) -> None:
    reader = JointReader(["a"], ["position"], measured=measured)
    last = state(["a"], LATEST_NS)
    assert reader.accept(last) == LATEST_NS
    late = last[:8] + (1_000_000_000).to_bytes(4, "little") + last[12:]
    if not measured:
        assert reader.accept(late) == LATEST_NS + 1
        return
    with pytest.raises(UnreadableError, match="its stamp of 2147483648 s is too large for"):
        reader.accept(late)


def test_references_lack_what_they_do_not_give() -> None:
    decoder = MessageDecoder(["a", "b"])
    position, velocity = decoder.joint_reference(state(["b", "a"]))
    assert (position.tolist(), velocity.tolist()) == ([2, 1], [0, 0])
    decoder.decode_joints(state(["a", "b"], velocity=[0.5, 0.25]))
    assert (decoder.q.tolist(), decoder.qdot.tolist()) == ([1, 2], [0.5, 0.25])


def test_what_a_measured_state_says_beyond_the_robot_is_counted_with_its_reason() -> None:
    decoder = MessageDecoder(["arm", "finger"], ["finger2"])
    raw = state(["camera_pan", "finger2", "finger", "arm"], velocity=[9.0, 9.0, np.nan, 0.5])
    decoder.decode_joints(raw)
    assert (decoder.q.tolist(), decoder.qdot.tolist()) == ([4, 3], [0.5, 0.0])
    assert decoder.ignored == {
        "joint 'camera_pan' is unknown": 1,
        "joint 'finger2' mimics another": 1,
        "velocities are not finite": 1,
    }
    # Drivers of two machines send a message each.
    assert decoder.joined(state(["arm"], velocity=[0.25])) is None
    whole = decoder.joined(state(["finger"], velocity=[0.125]))
    assert whole is not None
    decoder.decode_joints(whole)
    assert (decoder.q.tolist(), decoder.qdot.tolist()) == ([1, 1], [0.25, 0.125])


def test_messages_in_another_encoding_are_refused() -> None:
    little = state(["a"], 3 * S + 4, position=[0.5])
    for start in (b"\0\0", b"\0\2"):
        with pytest.raises(UnreadableError, match="its bytes are not a JointState"):
            JointReader(["a"], ["position"]).accept(start + little[2:])


def test_single_texts_are_read_and_broken_ones_refused() -> None:
    raw = serialize_message(String(data="a robot ü"))
    assert read_text(raw, "std_msgs/msg/String", "data") == "a robot ü"
    with pytest.raises(UnreadableError, match=r"^its bytes are not a String$"):
        read_text(raw[:-4], "std_msgs/msg/String", "data")


def test_a_template_of_joints_has_all_their_quantities() -> None:
    template = joint_template(["a", "bc"])
    for number, name in enumerate(("position", "velocity", "effort")):
        template.feed(name, np.array([number + 0.5, number + 0.25]))
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
    name = "geometry_msgs/msg/WrenchStamped"
    copies = MessageTemplate(name, prototype).copies(stamps, {"wrench.force.x": forces})
    found = read_columns(copies, installed_type(name))
    assert found is not None
    assert list(found["header.stamp.sec"]) == [0, 1, 5]
    assert list(found["header.stamp.nanosec"]) == [1, 2, 0]
    assert list(found["wrench.force.y"]) == [1.5, 4.5, 7.5]
    assert list(found["wrench.torque.z"]) == [0.0] * 3
    assert found["header.frame_id"] == ["base"] * 3
