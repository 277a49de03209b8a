"""The parameters of recorder and replay."""

from __future__ import annotations

from dataclasses import dataclass

from spacerobot_ros.model.shared_parameters import WatchdogConfig
from spacerobot_ros.parameters import nonnegative, parameter


@dataclass(frozen=True)
class RecorderConfig(WatchdogConfig):
    """Parameters of the recorder: topics, time and file."""

    bag: str = parameter("", "file to write; '': spacerobot-<date>-<time>.mcap here")
    when_exists: str = parameter(
        "next",
        "if a bag of this name exists: take the next free name (NAME-1, NAME-2, ...), or "
        "refuse to start; no bag is ever overwritten",
        choices=("next", "refuse"),
    )
    topics: str = parameter("", "names to record, separated by spaces; '': all of the stack")
    compression: str = parameter("zstd", "compression of chunks", choices=("zstd", "lz4", "none"))
    clock_wait: float = parameter(
        2.0, "wall time to wait for a clock before wall time is used", "s"
    )
    describe: str = parameter("", "JSON file of named objects to put into the bag as metadata")
    diagnostics_period: float = nonnegative(
        0.0, "wall time between diagnostics; 0: losses only", "s"
    )
    tf_period: float = nonnegative(
        0.1,
        "bag time between transforms that the recorder writes if no node publishes /tf; 0: none",
        "s",
    )
    flush_period: float = parameter(
        0.5, "longest wall time for which a killed recorder loses messages", "s", minimum=0.01
    )
    max_size: float = nonnegative(
        0.0, "file size after which the next file (NAME_0, NAME_1, ...) begins; 0: never", "MB"
    )
    max_duration: float = nonnegative(
        0.0, "bag time after which the next file begins; 0: never", "s"
    )


@dataclass(frozen=True)
class ReplayConfig:
    """Parameters of a replay: bag, part of it, rate and topics."""

    bag: str = parameter("", "MCAP file to replay, or a folder with one")
    rate: float = parameter(1.0, "bag time over wall time", minimum=0.001, maximum=1000000.0)
    start: float = nonnegative(0.0, "start, from the first message", "s")
    duration: float = nonnegative(0.0, "how much of the bag to replay; 0: all", "s")
    loop: bool = parameter(False, "repeat the replay when it ends")
    topics: str = parameter("", "names to replay, separated by spaces; '': all")
    remap: str = parameter("", "new names of topics: 'old:=new', separated by spaces")
    clock: float = nonnegative(
        0.0, "publish bag time on /clock at this rate; 0: as recorded", "Hz", maximum=10000.0
    )
    paused: bool = parameter(False, "begin paused")
    hold: bool = parameter(False, "pause at the end instead of ending")
    wait: float = nonnegative(3.0, "longest wall time to wait for readers", "s")
