"""Writing, reading, replaying and verifying MCAP bags that any ROS 2 tool can open."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from spacerobot_ros.errors import RecordingError
from spacerobot_ros.parameters import WatchdogConfig, nonnegative, parameter
from spacerobot_ros.resources import lazy_names

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
    "RecorderConfig",
    "Recording",
    "RecordingError",
    "RecordingState",
    "ReplayConfig",
    "ReplayMessage",
    "TopicSeries",
    "free_name",
    "message_definition",
    "read_bag",
    "type_hash",
]

# Scenarios, and with them plans, need only the parameters below.
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


@dataclass(frozen=True)
class RecorderConfig(WatchdogConfig):
    """Recorder parameters: topics, time and file."""

    bag: str = parameter("", "file to write; '': spacerobot-<date>-<time>.mcap")
    when_exists: str = parameter(
        "next",
        "what to do if a bag with this name exists: use the next free name (NAME-1, NAME-2, ...) "
        "or refuse to start; bags are never overwritten",
        choices=("next", "refuse"),
    )
    topics: str = parameter("", "space-separated topics to record; '': all topics of the stack")
    compression: str = parameter("zstd", "compression of chunks", choices=("zstd", "lz4", "none"))
    clock_wait: float = parameter(
        2.0, "wall time to wait for /clock before falling back to wall time", "s"
    )
    describe: str = parameter("", "JSON file with named objects to store in the bag as metadata")
    diagnostics_period: float = nonnegative(
        0.0, "wall time between diagnostics; 0: only when messages are lost", "s"
    )
    tf_period: float = nonnegative(
        0.1, "bag time between transforms written if no node publishes /tf; 0: none", "s"
    )
    flush_period: float = parameter(
        0.5,
        "wall time between flushes, which is also the longest period lost if the recorder is "
        "killed",
        "s",
        minimum=0.01,
    )
    max_size: float = nonnegative(
        0.0, "file size at which a new file (NAME_0, NAME_1, ...) is started; 0: never", "MB"
    )
    max_duration: float = nonnegative(
        0.0, "bag time after which a new file is started; 0: never", "s"
    )


@dataclass(frozen=True)
class ReplayConfig:
    """Replay parameters: bag, time span, rate and topics."""

    bag: str = parameter("", "MCAP file to replay, or a folder containing one")
    rate: float = parameter(1.0, "ratio of bag time to wall time", minimum=0.001, maximum=1000000.0)
    start: float = nonnegative(0.0, "start time, relative to the first message", "s")
    duration: float = nonnegative(0.0, "duration to replay; 0: all", "s")
    loop: bool = parameter(False, "repeat the replay when it ends")
    topics: str = parameter("", "space-separated topics to replay; '': all")
    remap: str = parameter("", "space-separated topic remappings 'old:=new'")
    clock: float = nonnegative(
        0.0,
        "publish bag time on /clock at this rate; 0: publish it as recorded",
        "Hz",
        maximum=10000.0,
    )
    paused: bool = parameter(False, "begin paused")
    hold: bool = parameter(False, "pause at the end instead of exiting")
    wait: float = nonnegative(3.0, "longest wall time to wait for subscribers", "s")
