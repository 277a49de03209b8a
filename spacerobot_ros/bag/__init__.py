"""Writing, reading, replaying and verifying MCAP bags that any ROS 2 tool can open."""

from __future__ import annotations

from typing import TYPE_CHECKING

from spacerobot_ros.errors import RecordingError
from spacerobot_ros.lazy import lazy_names

if TYPE_CHECKING:
    from spacerobot_ros.bag.mcap_file import LATCHED, QosProfile, RecordedTopic
    from spacerobot_ros.bag.playback import Playback, ReplayMessage
    from spacerobot_ros.bag.reader import Bag, RecordedRobot, read_bag
    from spacerobot_ros.bag.recording import Recording, RecordingState
    from spacerobot_ros.bag.series import TopicSeries
    from spacerobot_ros.bag.writer import BagWriter, free_name
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
        "LATCHED": "spacerobot_ros.bag.mcap_file",
        "QosProfile": "spacerobot_ros.bag.mcap_file",
        "RecordedTopic": "spacerobot_ros.bag.mcap_file",
        "Playback": "spacerobot_ros.bag.playback",
        "ReplayMessage": "spacerobot_ros.bag.playback",
        "Bag": "spacerobot_ros.bag.reader",
        "RecordedRobot": "spacerobot_ros.bag.reader",
        "read_bag": "spacerobot_ros.bag.reader",
        "Recording": "spacerobot_ros.bag.recording",
        "RecordingState": "spacerobot_ros.bag.recording",
        "TopicSeries": "spacerobot_ros.bag.series",
        "BagWriter": "spacerobot_ros.bag.writer",
        "free_name": "spacerobot_ros.bag.writer",
        "message_definition": "spacerobot_ros.messages.definitions",
        "type_hash": "spacerobot_ros.messages.definitions",
    },
)
