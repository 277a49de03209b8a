"""Recovers data from truncated or damaged bags: a complete copy, or the last state."""

from __future__ import annotations

import os
import tempfile
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, cast

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Header, Message, Metadata, Schema
from mcap.stream_reader import MAGIC_SIZE
from mcap.writer import MCAP0_MAGIC

from spacerobot_ros.bag.mcap_file import METADATA_NAME, McapFile, QosProfile, RecordedTopic
from spacerobot_ros.bag.mcap_reading import (
    DAMAGE_ERRORS,
    BagFile,
    ChunkUnpacker,
    blocks_in_time_order,
    file_size,
    open_file,
    parse_record,
    read_record,
    records,
    records_in_chunk,
    require_mcap,
)
from spacerobot_ros.bag.reader import (
    Array,
    RecordedRobot,
    bag_files,
    columns,
    read_bag,
    salvaged_copy,
)
from spacerobot_ros.errors import RecordingError
from spacerobot_ros.times import SECOND

if TYPE_CHECKING:
    from spacerobot_ros.model.grasp import BodyMotion
    from spacerobot_ros.simulation.plant import InitialState


@dataclass(frozen=True)
class Salvaged:
    """Result of salvaging a bag.

    Attributes
    ----------
    path
        The new bag.
    messages, duration
        Number of messages in the new bag, and the time span in s.
    lost_chunks
        Number of chunks that could not be read.
    loss_reason
        Why the first lost chunk could not be read; empty if no chunk was lost.
    lost_bytes
        Number of bytes after the last complete record; these bytes are not in the new bag.
    """

    path: Path
    messages: int
    duration: float
    lost_chunks: int
    lost_bytes: int
    loss_reason: str = ""


def salvage_bag(
    path: str | os.PathLike[str], out: str | os.PathLike[str] | None = None
) -> Salvaged:
    """Write the readable records of a bag into a new, complete bag; the original is unchanged.

    ``out`` is the new file, which must not exist; by default ``NAME-salvaged.mcap`` next to the
    original. If a bag has several files, the first incomplete file is salvaged.

    Raises
    ------
    RecordingError
        The bag does not exist, is not in MCAP format, is already complete or is unreadable, or the
        new bag cannot be written.
    """
    source = next((file for file in bag_files(Path(path)) if not is_complete(file)), None)
    if source is None:
        raise RecordingError(f"The bag {path} is complete: there is nothing to salvage.")
    target = Path(out) if out is not None else salvaged_copy(source)
    with open_file(source) as old:
        start = old.read(MAGIC_SIZE)
        require_mcap(source, start)
        if start != MCAP0_MAGIC:
            raise RecordingError(f"{source} is still empty: there is nothing to salvage.")
        profile = "ros2"
        with suppress(*DAMAGE_ERRORS):
            profile = read_record(old, MAGIC_SIZE, Header).profile
        new = McapFile(target, overwrite=False, profile=profile)
        try:
            copy = _Copy(new)
            copy.add_readable_records(old)
            if copy.empty:
                raise RecordingError(f"Nothing in the bag {source} can be read.")
            new.finish()
        except BaseException:
            new.close()
            target.unlink(missing_ok=True)
            raise
    span = (new.end_ns or 0) - (new.start_ns or 0)
    count = new.message_counts.total()
    return Salvaged(
        target, count, span / SECOND, copy.lost_chunks, copy.lost_bytes, copy.loss_reason
    )


def is_complete(path: Path) -> bool:
    """Whether every message of a bag can be read without repairing the bag."""
    try:
        for file in map(BagFile, bag_files(path)):
            topics = [each.channel.topic for each in file.channels]
            held = sum(map(len, blocks_in_time_order([file], topics)))
            if held != file.statistics.message_count:
                return False
    except RecordingError:
        return False
    return True


class _Copy:
    def __init__(self, file: McapFile) -> None:
        self.empty = True
        self.lost_chunks = self.lost_bytes = 0
        self.loss_reason = ""
        self._file = file
        self._schemas: dict[int, tuple[int, str]] = {}
        """New schema ID and type name, by schema ID in the old file."""
        self._channels: dict[int, int] = {}
        """New channel ID by channel ID in the old file."""

    def add_readable_records(self, old: BinaryIO) -> None:
        """Add the readable content of a file, up to the first truncated record."""
        size, whole = file_size(old), MAGIC_SIZE
        chunks, self._unpacker = ChunkUnpacker(size), ChunkUnpacker(size)
        # A ValueError from the iteration ends it; processing a record raises none.
        with suppress(ValueError):
            for place, opcode, record in records(old, MAGIC_SIZE):
                whole = place + len(record)
                if opcode == Opcode.DATA_END:
                    # The summary repeats earlier records.
                    return
                if opcode != Opcode.CHUNK:
                    self._add(record)
                    continue
                try:
                    data = chunks.unpack(cast("Chunk", parse_record(record)), place)
                except DAMAGE_ERRORS as error:
                    self.lost_chunks += 1
                    self.loss_reason = self.loss_reason or str(error)
                    continue
                with suppress(ValueError):
                    for begin, end in records_in_chunk(data, place):
                        self._add(data[begin:end])
        self.lost_bytes = size - whole

    def _add(self, record: bytes) -> None:
        found = None
        with suppress(*DAMAGE_ERRORS):
            found = parse_record(record)
        self.empty &= found is None or isinstance(found, Header)
        match found:
            case Message() as message if message.channel_id in self._channels:
                number, data = self._channels[message.channel_id], message.data
                # Only the metadata of the old bag say that its messages are compressed.
                with suppress(*DAMAGE_ERRORS):
                    data = self._unpacker.unpack_message(data, 0)
                self._file.add_message(number, message.log_time, data, message.publish_time)
            case Schema() as schema if schema.id not in self._schemas:
                number = self._file.register_schema(schema.name, schema.encoding, schema.data)
                self._schemas[schema.id] = number, schema.name
            case Channel() as channel if channel.id not in self._channels:
                schema_id, type_name = self._schemas.get(channel.schema_id, (0, ""))
                number = self._file.register_channel(
                    channel.topic, channel.message_encoding, schema_id, channel.metadata
                )
                self._channels[channel.id], words = number, channel.metadata
                with suppress(RecordingError):
                    profiles = QosProfile.from_yaml(words.get("offered_qos_profiles", ""))
                    self._file.topics[number] = RecordedTopic(
                        channel.topic,
                        type_name,
                        profiles[0] if profiles else QosProfile(),
                        words.get("topic_type_hash", ""),
                    )
            case Attachment() as file:
                self._file.add_attachment(0, file.log_time, file.name, file.media_type, file.data)
            case Metadata() as metadata if metadata.name != METADATA_NAME:
                self._file.add_metadata(metadata.name, metadata.metadata)


# -- the state to resume from -----------------------------------------------------------------


@dataclass(frozen=True)
class LastState:
    """A robot's last recorded state.

    Attributes
    ----------
    time_ns
        Stamp of the state.
    joint_names
        The joints, in the order of their positions and velocities.
    initial
        The state; its momenta include a held body.
    target
        Motion of the target's root link; None if there is no target.
    payload
        The body that the robot holds, as a string from ``plant/status``; empty if there is no such
        body.
    """

    time_ns: int
    joint_names: list[str]
    initial: InitialState
    target: BodyMotion | None
    payload: str


def last_state(path: str | os.PathLike[str], namespace: str = "") -> LastState:
    """Read the last state whose pose, joints and momenta were recorded.

    A truncated bag is read as far as possible. ``namespace`` is the plant's.

    Raises
    ------
    RecordingError
        The bag does not exist or contains no state.
    """
    source = Path(path)
    if is_complete(source):
        return _last_state(RecordedRobot(read_bag(source), namespace))
    with tempfile.TemporaryDirectory(prefix="spacerobot_") as folder:
        whole = Path(folder, source.name)
        salvage_bag(source, whole)
        return _last_state(RecordedRobot(read_bag(whole), namespace))


def _last_state(robot: RecordedRobot) -> LastState:
    from spacerobot_ros.simulation.plant import InitialState  # Other functions need no model.

    odom, joints, momentum = (robot[name] for name in ("odom", "joint_states", "momentum"))
    # Momenta have no stamp. The plant publishes the momenta of a state first, so that odom k has
    # momenta k.
    common = np.intersect1d(odom.stamp_ns, joints.stamp_ns)
    if not len(common):
        raise RecordingError(f"The bag {robot.bag.path} contains no complete state.")
    k, j = (int(np.flatnonzero(series.stamp_ns == common[-1])[-1]) for series in (odom, joints))
    pose = odom.table(columns("odom", "pose.pose"))[k]
    names = robot.joint_names
    positions = np.asarray(joints.field("position")[j])
    rates = np.asarray(joints.field("velocity")[j])
    momenta = np.asarray(momentum.field("data")[min(k, len(momentum) - 1)])[:6]
    numbers = np.concatenate([pose, positions, rates, momenta])
    whole = len(positions) == len(rates) == len(names) and len(momenta) == 6
    if not (whole and np.isfinite(numbers).all()):
        raise RecordingError(
            f"The last state in the bag {robot.bag.path} has missing or non-finite values."
        )
    initial = InitialState.of_motion(pose, positions, rates, momenta)
    time_ns = int(common[-1])
    target, payload = _last_target(robot, time_ns), _last_payload(robot, time_ns)
    return LastState(time_ns, names, initial, target, payload)


def _last_target(robot: RecordedRobot, time_ns: int) -> BodyMotion | None:
    """Return the motion of the target in a state; None if it was not recorded."""
    from spacerobot_ros.model.grasp import BodyMotion

    for name in ("target/odom_true", "target/odom"):
        series = robot.get(name)
        if series is None:
            continue
        found = np.flatnonzero(series.stamp_ns == time_ns)
        if len(found):
            columns_of_state = (*columns("odom", "pose.pose"), *columns("odom", "twist.twist"))
            state: Array = series.table(columns_of_state)[found[-1]]
            return BodyMotion.of(state[:7], state[7:]) if np.isfinite(state).all() else None
    return None


def _last_payload(robot: RecordedRobot, time_ns: int) -> str:
    """Return the string for the body that the robot held in a state; empty if none."""
    series, payload = robot.get("plant/status"), ""
    for _, message in () if series is None else series.messages():
        values = {pair.key: pair.value for pair in message.values}
        with suppress(KeyError, ValueError):
            # A capture changes the states after the one in which it took place. A plant
            # restarted in the meantime has no record of it, and others publish no states.
            since = round(float(values["time_s"]) * SECOND)
            if values["state"] not in ("inactive", "failed") and since < time_ns:
                payload = values.get("payload", "")
    return payload
