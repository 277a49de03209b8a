"""MCAP bags that any ROS 2 tool opens: writing, reading, replaying and verifying them."""

from spacerobot_ros.recording.errors import RecordingError
from spacerobot_ros.recording.qos import LATCHED, QosProfile
from spacerobot_ros.recording.reader import Bag, iterate_raw, read_bag
from spacerobot_ros.recording.replay import Playback, ReplayMessage, ReplayTopic, Timeline
from spacerobot_ros.recording.schemas import message_definition, type_hash
from spacerobot_ros.recording.series import TopicSeries
from spacerobot_ros.recording.writer import BagWriter

__all__ = [
    "LATCHED",
    "Bag",
    "BagWriter",
    "Playback",
    "QosProfile",
    "RecordingError",
    "ReplayMessage",
    "ReplayTopic",
    "Timeline",
    "TopicSeries",
    "iterate_raw",
    "message_definition",
    "read_bag",
    "type_hash",
]
