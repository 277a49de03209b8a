"""Writing, reading, replaying and verifying MCAP bags that any ROS 2 tool can open."""

from __future__ import annotations

from typing import TYPE_CHECKING

from spacerobot_ros.errors import RecordingError
from spacerobot_ros.lazy import lazy_names

if TYPE_CHECKING:
    from spacerobot_ros.bag.mcap_file import LATCHED, QosProfile, RecordedTopic
    from spacerobot_ros.bag.playback import Playback, ReplayMessage
    from spacerobot_ros.bag.reader import Bag, RecordedRobot, read_bag
    from spacerobot_ros.bag.series import TopicSeries
    from spacerobot_ros.bag.writer import BagWriter, Recording, RecordingState, free_name
    from spacerobot_ros.messages.definitions import message_definition, type_hash

__all__ = [
    "LATCHED",
    "Bag",
    "BagWriter",
    "Playback",
    "QosProfile",
    "RecordedRobot",
    "RecordedTopic",
    "Recording",
    "RecordingError",
    "RecordingState",
    "ReplayMessage",
    "TopicSeries",
    "free_name",
    "message_definition",
    "read_bag",
    "type_hash",
]

# Scenarios, and with them plans, need only the recorder's parameters.
__getattr__ = lazy_names(
    __name__,
    {
        "bag.mcap_file": ["LATCHED", "QosProfile", "RecordedTopic"],
        "bag.playback": ["Playback", "ReplayMessage"],
        "bag.reader": ["Bag", "RecordedRobot", "read_bag"],
        "bag.series": ["TopicSeries"],
        "bag.writer": ["BagWriter", "Recording", "RecordingState", "free_name"],
        "messages.definitions": ["message_definition", "type_hash"],
    },
)
