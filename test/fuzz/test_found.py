"""Inputs that once ended in another exception than a refusal, each by its name."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64
from support.sentences import assert_one_sentence

from spacerobot_ros.bag import BagWriter, read_bag
from spacerobot_ros.errors import (
    ParameterError,
    PlanningError,
    RobotDescriptionError,
    SpaceRobotError,
)
from spacerobot_ros.messages.readers import TemplateReader, UnreadableError
from spacerobot_ros.model.urdf import parse_robot
from spacerobot_ros.parameters import Parameter
from spacerobot_ros.planning import Goal
from spacerobot_ros.resources import robot_file
from spacerobot_ros.scenario import load_scenario

CHUNK = 6
ORIGIN, ZERO_TURN_PER_AREA = [0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]


def reader() -> TemplateReader:
    return TemplateReader("sensor_msgs/msg/JointState", {"velocity": None})


def test_a_line_break_in_what_is_quoted_does_not_break_the_sentence() -> None:
    assert_one_sentence(str(SpaceRobotError("The name 'a\nb' is refused.")), "'a b'")


def test_bytes_that_are_no_message_leave_the_message_before() -> None:
    read = reader()
    read.accept(serialize_message(JointState(name=["a"], velocity=[2.0])))
    with pytest.raises(UnreadableError):
        read.accept(b"\0\1\0\0" + b"\xff" * 40)
    assert read.floats("velocity").tolist() == [2.0]


@pytest.mark.parametrize("text", [b"\xff\xfe", b"a\0"], ids=["not UTF-8", "zero byte inside"])
def test_numbers_behind_a_broken_string_are_read_in_their_place(text: bytes) -> None:
    raw = bytes(serialize_message(JointState(name=["ab"], velocity=[2.0], effort=[3.0])))
    read = reader()
    read.accept(raw.replace(b"ab\0", text + b"\0"))
    assert read.floats("velocity").tolist() == [2.0]


def test_a_large_quaternion_is_scaled_without_overflow() -> None:
    goal = Goal.checked(ORIGIN, [0.0, 0.0, 1e300, 1e300])
    assert goal.quaternion == pytest.approx([0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)])


@pytest.mark.parametrize("position", [[1e200, 0.0, 0.0], ["", 0, 0], {"x": 1}, [10**400, 0, 0]])
def test_a_position_that_is_no_place_is_refused(position: Any) -> None:
    with pytest.raises(PlanningError) as caught:
        Goal.checked(position, ZERO_TURN_PER_AREA)
    assert_one_sentence(str(caught.value), "goal position")


def test_a_rotation_vector_of_absurd_length_is_refused() -> None:
    with pytest.raises(PlanningError, match="rotation vector"):
        Goal.from_rotvec(ORIGIN, [1e200, 0.0, 0.0])


@pytest.mark.parametrize("value", [10**400, [10**400]])
def test_a_whole_number_beyond_every_float_is_refused(value: Any) -> None:
    default: Any = [0.0] if isinstance(value, list) else 0.0
    with pytest.raises(ParameterError, match="'size'"):
        Parameter("size", default, "m", "").checked(value)


@pytest.mark.parametrize("section", ["[1, 2]", "{ros__parameters: null}"])
def test_a_node_section_that_is_no_mapping_is_refused(tmp_path: Path, section: str) -> None:
    path = tmp_path / "s.yaml"
    path.write_text(f"scenario: {{ros__parameters: {{}}}}\nplant: {section}\n", encoding="utf-8")
    with pytest.raises(ParameterError) as caught:
        load_scenario(str(path))
    assert_one_sentence(str(caught.value), "'plant'")


@pytest.mark.parametrize("number", ["nan", "1e300"])
def test_a_size_that_is_no_size_is_refused(number: str) -> None:
    text = robot_file("servicer").read_text(encoding="utf-8")
    start = text.index('size="') + len('size="')
    with pytest.raises(RobotDescriptionError) as caught:
        parse_robot(text[:start] + f"{number} 1 1" + text[text.index('"', start) :])
    assert_one_sentence(str(caught.value), "geometry of link")


def test_a_chunk_that_claims_to_be_larger_than_the_memory_takes_no_more(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with BagWriter(path) as writer:
        channel = writer.add_topic("/a", "std_msgs/msg/Float64")
        writer.write(channel, serialize_message(Float64(data=1.0)), 0, 0)
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    data = bytearray(path.read_bytes())
    # Opcode and length, start, end, uncompressed size, checksum, "zstd": then the data's length.
    start = summary.chunk_indexes[0].chunk_start_offset
    assert data[start] == CHUNK
    struct.pack_into("<Q", data, start + 9 + 8 + 8 + 8 + 4 + 4 + len("zstd"), 2**45)
    path.write_bytes(data)
    assert read_bag(path)["/a"].field("data").tolist() == [1.0]
