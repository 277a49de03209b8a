"""Recovers bags that were cut off or damaged: a complete bag, or the last state in one."""

from __future__ import annotations

import os
import struct
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Header, Metadata, Schema
from mcap.writer import MCAP0_MAGIC

from spacerobot_ros.bag.mcap_file import (
    METADATA_NAME,
    Entries,
    McapFile,
    QosProfile,
    RecordedTopic,
    encode,
    no_entries,
)
from spacerobot_ros.bag.mcap_reading import (
    DAMAGE_ERRORS,
    RECORD_HEADER,
    InflationLimit,
    chunk_size,
    file_size,
    messages_in_file_order,
    open_bag,
    open_file,
    parse_record,
    read_summary,
    records,
    records_in_chunk,
    unpack_chunk,
)
from spacerobot_ros.bag.reader import Array, RecordedRobot, columns, read_bag
from spacerobot_ros.errors import RecordingError
from spacerobot_ros.times import SECOND

_STATE_TOPICS = ("odom", "joint_states", "momentum")
_WITHOUT_STATES = ("inactive", "failed")
"""States of a plant that publishes no states of the robot."""
_CHUNK_SIZE = 65536
_CHANNEL_AND_TIME = struct.Struct("<H4xQ")
"""Head of a message: channel, sequence number (skipped) and log time."""


@dataclass(frozen=True)
class Salvaged:
    """Result of salvaging a bag.

    Attributes
    ----------
    path
        The new bag.
    messages, duration
        Messages in it, and the time in s that they span.
    lost_chunks
        Chunks that could not be read.
    loss_reason
        Why the first lost chunk could not be read; empty if no chunk is lost.
    lost_bytes
        Bytes after the last complete record, which only the old bag has.
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
    """Write the readable records of a bag into a new, complete one; the old one stays as it is.

    ``out`` is the new file, which must not exist; by default ``NAME-salvaged.mcap`` beside the old
    one.

    Raises
    ------
    RecordingError
        There is no such bag, it is not MCAP, it is complete already, nothing in it
        can be read, or the new one cannot be written.
    """
    source = Path(path)
    target = Path(out) if out is not None else source.with_name(f"{source.stem}-salvaged.mcap")
    if is_complete(source):
        raise RecordingError(f"The bag {source} is complete: there is nothing to salvage.")
    found = _ReadableRecords(source)
    first = next(found.records, None)
    if first is None:
        raise RecordingError(f"Nothing in the bag {source} can be read.")
    file = McapFile(target, compression="zstd", overwrite=False, profile=found.profile)
    try:
        copy = _SalvagedBag(file)
        copy.add(*first)
        for opcode, body in found.records:
            copy.add(opcode, body)
        copy.finish(found.profile)
    except BaseException:
        file.close()
        target.unlink(missing_ok=True)
        raise
    file.close()
    span = (file.end_ns or 0) - (file.start_ns or 0)
    return Salvaged(
        target,
        sum(file.message_counts.values()),
        span / SECOND,
        found.lost_chunks,
        found.lost_bytes,
        found.reason,
    )


def is_complete(path: Path) -> bool:
    """Whether every message of a bag can be read without a repair."""
    try:
        with open_bag(path) as file:
            summary = read_summary(path, file)
            count = sum(1 for _ in messages_in_file_order(file))
            return summary.statistics is not None and summary.statistics.message_count == count
    except RecordingError:
        return False


def _complete_records(file: BinaryIO, start: int, end: int) -> Iterator[tuple[int, int, bytes]]:
    """Iterate over the records between two bytes of a file, up to the first incomplete one."""
    # Only reading is inside the try: errors of the caller must not be caught.
    with suppress(ValueError):
        yield from records(file, start, end)


class _ReadableRecords:
    """The readable records of a bag, with those in chunks."""

    def __init__(self, path: Path) -> None:
        self.profile = "ros2"
        self.lost_chunks = self.lost_bytes = 0
        self.reason = ""
        """Reason why the first lost chunk cannot be read."""
        self._path = path
        self.records = self._read_records()

    def _read_records(self) -> Iterator[tuple[int, bytes]]:
        with open_file(self._path) as file:
            size = file_size(file)
            start = file.read(len(MCAP0_MAGIC))
            if start != MCAP0_MAGIC:
                empty = start == MCAP0_MAGIC[: len(start)]
                what = "holds nothing yet" if empty else "is not an MCAP file"
                raise RecordingError(f"{self._path} {what}: there is nothing to salvage.")
            whole, allowance = len(start), InflationLimit(size)
            for place, opcode, body in _complete_records(file, len(start), size):
                whole = place + RECORD_HEADER.size + len(body)
                if opcode == Opcode.HEADER:
                    with suppress(*DAMAGE_ERRORS):
                        self.profile = parse_record(Header.read, body, place).profile
                elif opcode == Opcode.CHUNK:
                    yield from self._records_in_chunk(body, place, allowance)
                elif opcode == Opcode.DATA_END:
                    # The summary repeats earlier records.
                    return
                else:
                    yield opcode, body
            self.lost_bytes = size - whole

    def _records_in_chunk(
        self, body: bytes, place: int, allowance: InflationLimit
    ) -> Iterator[tuple[int, bytes]]:
        try:
            allowance.count(chunk_size(body), place)
            data = unpack_chunk(body, place)
        except DAMAGE_ERRORS as error:
            self.lost_chunks += 1
            self.reason = self.reason or str(error) or type(error).__name__
            return
        with suppress(ValueError):
            for opcode, start, end in records_in_chunk(data, place):
                yield opcode, data[start + RECORD_HEADER.size : end]


class _SalvagedBag:
    """A bag written from the readable records of another bag."""

    def __init__(self, file: McapFile) -> None:
        self._file = file
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._records_in_chunk = bytearray()
        self._entries: dict[int, Entries] = {}

    def add(self, opcode: int, body: bytes) -> None:
        """Add a record; an unreadable record is left out."""
        with suppress(*DAMAGE_ERRORS):
            if opcode == Opcode.MESSAGE:
                self._add_message(body)
            elif opcode == Opcode.SCHEMA:
                schema = parse_record(Schema.read, body, 0)
                self._schemas[schema.id] = schema
            elif opcode == Opcode.CHANNEL:
                channel = parse_record(Channel.read, body, 0)
                self._channels[channel.id] = channel
            elif opcode == Opcode.ATTACHMENT:
                self._file.append_attachment(parse_record(Attachment.read, body, 0))
            elif opcode == Opcode.METADATA:
                metadata = parse_record(Metadata.read, body, 0)
                if metadata.name != METADATA_NAME:
                    self._file.append_metadata(metadata)

    def finish(self, profile: str) -> None:
        """Write the last chunk, rosbag2's record and the summary."""
        self._flush()
        self._file.schemas += self._schemas.values()
        self._file.channels += self._channels.values()
        if profile == "ros2":
            self._append_rosbag2_metadata()
        self._file.finish()

    def _add_message(self, body: bytes) -> None:
        channel_id, log_time_ns = _CHANNEL_AND_TIME.unpack_from(body)
        if channel_id not in self._channels:
            return
        if channel_id not in self._entries:
            # Streaming readers need schema and channel before the message.
            self._entries[channel_id] = no_entries()
            channel = self._channels[channel_id]
            if channel.schema_id in self._schemas:
                self._records_in_chunk += encode(self._schemas[channel.schema_id])
            self._records_in_chunk += encode(channel)
        self._entries[channel_id].extend((log_time_ns, len(self._records_in_chunk)))
        self._records_in_chunk += RECORD_HEADER.pack(Opcode.MESSAGE, len(body)) + body
        if len(self._records_in_chunk) >= _CHUNK_SIZE:
            self._flush()

    def _flush(self) -> None:
        if any(self._entries.values()):
            self._file.append_chunk(self._records_in_chunk, self._entries)
            self._records_in_chunk = bytearray()
            for entries in self._entries.values():
                del entries[:]

    def _append_rosbag2_metadata(self) -> None:
        topics = []
        for channel in self._channels.values():
            words = channel.metadata
            with suppress(RecordingError):
                profiles = QosProfile.from_yaml(words.get("offered_qos_profiles", ""))
                schema = self._schemas.get(channel.schema_id)
                topics.append(
                    RecordedTopic(
                        channel.topic,
                        schema.name if schema else "",
                        words.get("topic_type_hash", ""),
                        profiles[0] if profiles else QosProfile(),
                        self._file.message_counts.get(channel.id, 0),
                    )
                )
        self._file.append_rosbag2_metadata(topics)


# -- the state to resume from -----------------------------------------------------------------


@dataclass(frozen=True)
class LastState:
    """The last recorded state of a robot.

    Attributes
    ----------
    time_ns
        Stamp of the state.
    position, quaternion
        Pose of the base link in the world: (3,) m and (x, y, z, w).
    joint_names, joints, rates
        Names, positions and velocities (n,) of the joints.
    momenta
        Linear over angular momentum in the world (6,); of robot and held body together.
    target
        Pose (7,) of the root link of the target in the world, over its twist (6,) in T; None:
        there is no target.
    payload
        The body that the robot holds, as the text of ``plant/status``; empty: none.
    """

    time_ns: int
    position: Array
    quaternion: Array
    joint_names: list[str]
    joints: Array
    rates: Array
    momenta: Array
    target: Array | None = None
    payload: str = ""


def last_state(path: str | os.PathLike[str], namespace: str = "") -> LastState:
    """Read the last state of which pose, joints and momenta were recorded.

    A bag that was cut off is read as far as possible. ``namespace`` is the plant's.

    Raises
    ------
    RecordingError
        There is no such bag, or no state in it.
    """
    source = Path(path)
    if is_complete(source):
        return _last_state(RecordedRobot(read_bag(source), namespace))
    with tempfile.TemporaryDirectory(prefix="spacerobot_") as folder:
        whole = Path(folder, source.name)
        salvage_bag(source, whole)
        return _last_state(RecordedRobot(read_bag(whole), namespace))


def _last_state(robot: RecordedRobot) -> LastState:
    odom, joints, momentum = (robot[name] for name in _STATE_TOPICS)
    # Momenta have no stamp. The plant publishes the momenta of a state first, so that odom k has
    # momenta k.
    common = np.intersect1d(odom.stamp_ns, joints.stamp_ns)
    if not len(common):
        raise RecordingError(f"The bag {robot.bag.path} holds no state with all its parts.")
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
            f"The last state in the bag {robot.bag.path} lacks numbers, or they are not finite."
        )
    return LastState(
        time_ns=int(common[-1]),
        position=pose[:3],
        quaternion=pose[3:],
        joint_names=names,
        joints=positions,
        rates=rates,
        momenta=momenta,
        target=_last_target(robot, int(common[-1])),
        payload=_last_payload(robot, int(common[-1])),
    )


def _last_target(robot: RecordedRobot, time_ns: int) -> Array | None:
    """Return pose over twist (13,) of the target in a state; None: it was not recorded."""
    for name in ("target/odom_true", "target/odom"):
        series = robot.get(name)
        if series is None:
            continue
        found = np.flatnonzero(series.stamp_ns == time_ns)
        if len(found):
            columns_of_state = (*columns("odom", "pose.pose"), *columns("odom", "twist.twist"))
            state: Array = series.table(columns_of_state)[found[-1]]
            return state if np.isfinite(state).all() else None
    return None


def _last_payload(robot: RecordedRobot, time_ns: int) -> str:
    """Return the text of the body that the robot held in a state; empty: none."""
    series, payload = robot.get("plant/status"), ""
    for _, message in () if series is None else series.messages():
        values = {pair.key: pair.value for pair in message.values}
        with suppress(KeyError, ValueError):
            # A capture changes the states after that in which it took place. A plant that was
            # started meanwhile knows of nothing.
            since = round(float(values["time_s"]) * SECOND)
            if values["state"] not in _WITHOUT_STATES and since < time_ns:
                payload = values.get("payload", "")
    return payload
