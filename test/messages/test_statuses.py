"""Statuses as messages: rclpy reads what is encoded, and nothing unprintable is read."""

from __future__ import annotations

import pytest
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from rclpy.serialization import deserialize_message, serialize_message
from rosbags.typesys import Stores, get_typestore

from spacerobot_ros.messages.statuses import STATUS, StatusRecord, read_status

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
