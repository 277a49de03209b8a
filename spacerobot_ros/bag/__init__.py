"""Writing, reading, replaying and verifying MCAP bags that any ROS 2 tool can open."""

from spacerobot_ros.bag.mcap_file import LATCHED, QosProfile
from spacerobot_ros.bag.playback import Playback, ReplayMessage, ReplayTopic
from spacerobot_ros.bag.reader import Bag, RecordedRobot, read_bag
from spacerobot_ros.bag.recording import Recording, RecordingState
from spacerobot_ros.bag.series import TopicSeries
from spacerobot_ros.bag.writer import BagWriter, free_name
from spacerobot_ros.errors import RecordingError
from spacerobot_ros.messages.definitions import message_definition, type_hash

__all__ = [
    "LATCHED",
    "Bag",
    "BagWriter",
    "Playback",
    "QosProfile",
    "RecordedRobot",
    "Recording",
    "RecordingError",
    "RecordingState",
    "ReplayMessage",
    "ReplayTopic",
    "TopicSeries",
    "free_name",
    "message_definition",
    "read_bag",
    "type_hash",
]
