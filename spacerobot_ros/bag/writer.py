"""Writes bags as MCAP files in the format of rosbag2's storage plugin, and records messages into
them: bag time base, latched topics and failures."""

from __future__ import annotations

import itertools
import os
import re
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from enum import Enum
from pathlib import Path
from typing import NamedTuple

from spacerobot_ros.bag import RecorderConfig
from spacerobot_ros.bag.mcap_file import BagExistsError, McapFile, QosProfile, RecordedTopic
from spacerobot_ros.errors import RecordingError, RobotDescriptionError
from spacerobot_ros.messages.definitions import type_hash
from spacerobot_ros.times import SECOND

_DEFAULTS = RecorderConfig()


def _numbered_names(path: Path) -> Iterator[Path]:
    """Yield ``NAME``, ``NAME-1``, ``NAME-2``, ..."""
    yield path
    for number in itertools.count(1):
        yield path.with_name(f"{path.stem}-{number}{path.suffix}")


def free_name(path: Path) -> Path:
    """Return a path, or the first of ``NAME-1``, ``NAME-2``, ..., that is no bag yet: neither a
    file, nor the name of a split one."""
    names = (
        (name, name.with_name(f"{name.stem}_0{name.suffix}")) for name in _numbered_names(path)
    )
    return next(each[0] for each in names if not any(map(os.path.lexists, each)))


class BagWriter(AbstractContextManager["BagWriter"]):
    """Writes serialised ROS 2 messages to a bag that any ROS 2 tool can open.

    Messages are collected in a chunk in memory. A full chunk is passed to the operating system in
    one piece: a killed process loses only the current chunk (a power failure may lose more). A bag
    is complete, including its summary, once it is closed; use the writer as a context manager. Only
    one thread at a time may use a writer.

    If writing a chunk fails, the chunk is lost, and this and all later calls that add data raise
    RecordingError. Closing still completes the file if there is space.

    Parameters
    ----------
    path
        Path of the bag, usually ``*.mcap``; parent folders are created.
    config
        Compression, and the file size and log time at which a new file is started, checked after
        every chunk. If the bag may be split, its files are ``NAME_0.mcap``, ``NAME_1.mcap``, ...,
        each complete, with all attachments and metadata.
    chunk_size
        Uncompressed chunk size, bytes; larger chunks have less overhead, but slow down seeking.
    overwrite
        Whether to replace an existing file, unless it is being written.
    next_free
        Whether to use the next free name if the name is already used: ``NAME-1.mcap``,
        ``NAME-2.mcap``, ...

    Raises
    ------
    RecordingError
        The file cannot be created, or it exists and must not be replaced.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        config: RecorderConfig = _DEFAULTS,
        *,
        chunk_size: int = 262_144,
        overwrite: bool = True,
        next_free: bool = False,
    ) -> None:
        self._unsplit_path = Path(path)
        self._limits = round(config.max_size * 1e6), round(config.max_duration * SECOND)
        """File size in bytes and log time in ns at which a new file is started; 0: unlimited."""
        self._file_number = 0
        self._compression, self._overwrite = config.compression, overwrite and not next_free
        self._chunk_size = chunk_size
        self._next_free = next_free
        self._earlier_counts: Counter[int] = Counter()
        self._repeated: list[Callable[[McapFile], None]] = []
        """One function per attachment or metadata record; it adds the attachment or record to a
        file."""
        self._refusal: str | None = None
        """Why nothing more can be written; None if writing is possible."""
        self._closed = False
        self._file = self._open_first_file()
        try:
            # rosbag2 writes this record at both ends. The first one informs readers of a
            # truncated file that its QoS policies are strings.
            self._file.add_rosbag2_metadata()
        except RecordingError:
            self._file.close()
            raise

    @property
    def path(self) -> Path:
        """Path of the bag, or of the file being written."""
        return self._file.path

    @property
    def message_counts(self) -> dict[str, int]:
        """Number of messages on each topic in the bag, including the current chunk."""
        counts = self._earlier_counts + self._file.message_counts
        return {topic.name: counts[channel] for channel, topic in self._file.topics.items()}

    @property
    def bytes_written(self) -> int:
        """Size of the current file after compression, in bytes."""
        return self._file.size

    @property
    def bytes_waiting(self) -> int:
        """Size, in bytes, of the current chunk, which is not yet in the file."""
        return self._file.bytes_waiting

    @property
    def messages_written(self) -> int:
        """Number of messages in the bag, including the current chunk."""
        return sum(self.message_counts.values())

    def add_topic(self, name: str, type_name: str, qos: QosProfile | None = None) -> int:
        """Register a topic before its first message is written.

        Parameters
        ----------
        name
            Full name of the topic, such as ``/odom``.
        type_name
            Message type, such as ``nav_msgs/msg/Odometry``.
        qos
            QoS offered by its publisher; by default reliable, volatile, depth 10.

        Returns
        -------
        The channel for ``write``. A topic added earlier keeps its channel and QoS.

        Raises
        ------
        RecordingError
            The type is not installed, the topic already has another type, or nothing more can
            be written.
        """
        if self._refusal is not None:
            raise RecordingError(self._refusal)
        for channel, known in self._file.topics.items():
            if known.name == name:
                if type_name != known.type_name:
                    raise RecordingError(
                        f"The topic {name} has type {known.type_name} in the bag {self.path}, not "
                        f"{type_name}."
                    )
                return channel
        topic = RecordedTopic(name, type_name, qos or QosProfile(), type_hash(type_name))
        return self._file.add_topic(topic)

    def write(self, channel_id: int, data: bytes, log_time_ns: int, publish_time_ns: int) -> None:
        """Add one message.

        Parameters
        ----------
        channel_id
            Return value of ``add_topic``.
        data
            The serialised message (CDR with header), as received by a raw subscription.
        log_time_ns
            Recording time in nanoseconds, not negative.
        publish_time_ns
            Publish time in nanoseconds, not negative.

        Raises
        ------
        RecordingError
            Writing fails or has failed earlier, the channel is unknown, or a time is negative.
        """
        if self._refusal is None and channel_id not in self._file.topics:
            raise RecordingError(
                f"The bag {self.path} has no channel {channel_id}: use channels from add_topic."
            )
        if log_time_ns < 0 or publish_time_ns < 0:
            raise RecordingError(f"The bag {self.path} cannot store negative times.")
        with self._adding():
            self._file.add_message(channel_id, log_time_ns, data, publish_time_ns)
            if not self._file.bytes_waiting and self._is_full():
                self._begin_next_file()

    def add_attachment(self, name: str, data: bytes, media_type: str, log_time_ns: int) -> None:
        """Attach a file to the bag.

        ``media_type`` is for example ``application/xml``; ``log_time_ns`` is the recording time.
        """
        self._add(lambda file: file.add_attachment(0, log_time_ns, name, media_type, data))

    def add_metadata(self, name: str, data: dict[str, str]) -> None:
        """Add a key-value metadata record to the bag."""
        self._add(lambda file: file.add_metadata(name, data))

    def _add(self, record: Callable[[McapFile], None]) -> None:
        with self._adding():
            self._repeated.append(record)
            record(self._file)

    def flush(self) -> None:
        """Pass the current chunk to the operating system, so that it survives if the process is
        killed."""
        with self._adding():
            if self._file.bytes_waiting:
                self._file.flush()
                if self._is_full():
                    self._begin_next_file()

    def close(self) -> None:
        """Write pending messages and the summary, and close the file; further calls do nothing.

        After a failure, the file is closed even though it is incomplete: `spacerobot salvage`
        completes it.

        Raises
        ------
        RecordingError
            A write during this call fails.
        """
        if self._closed:
            return
        self._closed = True
        refused, self._refusal = self._refusal, self._refusal or f"The bag {self.path} is closed."
        if refused:
            self._file.close()
        else:
            self._file.finish()

    def __exit__(self, *_: object) -> None:
        self.close()

    def _is_full(self) -> bool:
        max_size, max_duration_ns = self._limits
        span = (self._file.end_ns or 0) - (self._file.start_ns or 0)
        return 0 < max_size <= self._file.size or 0 < max_duration_ns <= span

    def _open_first_file(self) -> McapFile:
        """Create the first file; files of one bag are not mixed with files of another."""
        names = _numbered_names(self._unsplit_path)
        while True:
            self._unsplit_path = whole = next(names)
            numbered = re.compile(rf"{re.escape(whole.stem)}(_\d+)?{re.escape(whole.suffix)}")
            others: list[str] = []
            if any(self._limits) and not self._overwrite:
                with suppress(OSError):
                    others = sorted(filter(numbered.fullmatch, os.listdir(whole.parent)))
            try:
                if others:
                    raise BagExistsError(
                        f"Cannot create the bag {whole.with_name(others[0])}: File exists; name "
                        "another one, or remove it."
                    )
                return self._open_numbered_file()
            except BagExistsError:
                if not self._next_free:
                    raise

    def check(self) -> None:
        """Check that the bag file still exists and has its full size.

        Raises
        ------
        RecordingError
            The file is missing or is shorter than expected; nothing more is written.
        """
        with self._adding():
            self._file.check()

    def _open_numbered_file(self) -> McapFile:
        path = self._unsplit_path
        if any(self._limits):
            path = path.with_name(f"{path.stem}_{self._file_number}{path.suffix}")
        return McapFile(
            path,
            compression=self._compression,
            chunk_size=self._chunk_size,
            overwrite=self._overwrite,
        )

    def _begin_next_file(self) -> None:
        """Complete the current file and start the next one, with the same schemas and channels."""
        done = self._file
        done.finish()
        self._earlier_counts += done.message_counts
        while self._file is done:
            self._file_number += 1
            try:
                self._file = self._open_numbered_file()
            except BagExistsError:
                # A file of another bag has this number: in flight, the next number is used.
                if self._overwrite:
                    raise
        for topic in done.topics.values():
            self._file.add_topic(topic)
        self._file.add_rosbag2_metadata()
        for record in self._repeated:
            record(self._file)

    @contextmanager
    def _adding(self) -> Iterator[None]:
        """Reject additions after a failure, and remember the failure."""
        if self._refusal is not None:
            raise RecordingError(self._refusal)
        try:
            yield
        except RecordingError as error:
            self._refusal = str(error)
            raise


# -- recording ------------------------------------------------------------------------------------


class RecordingState(Enum):
    """What a recorder does with incoming messages."""

    PAUSED = "paused"
    """Messages are dropped; the last message of each latched topic is kept until recording
    starts."""

    WAITING = "waiting"
    """Messages are kept in memory until it is known whether a clock is published."""

    ON_CLOCK = "on clock"
    """Messages are written with the published clock time."""

    ON_WALL_TIME = "on wall time"
    """Messages are written with the wall time of their arrival."""

    FAILED = "failed"
    """Messages are dropped because the disk is full or no longer available; earlier messages are
    kept."""

    CLOSED = "closed"
    """Messages are dropped because the bag is complete."""


_DROPPING_STATES = (RecordingState.PAUSED, RecordingState.FAILED, RecordingState.CLOSED)


_MAX_EARLY_MESSAGES = 5000
"""Number of messages kept in memory from which on a bag no longer waits for a clock."""


class _EarlyMessage(NamedTuple):
    """A message received before the bag's time base was chosen."""

    channel: int
    message: bytes
    published_ns: int
    arrival_ns: int


class Recording:
    """Writes messages with one time base for the whole bag; recording is initially paused.

    Messages are logged at the published clock time; earlier messages are logged at the time of the
    first clock message. If no clock is published for ``clock_wait``, or too many messages wait for
    one, all messages are logged at the wall time of their arrival. The choice is final, because a
    bag has one time base.

    Parameters
    ----------
    writer
        The bag, which is closed together with the recording.
    clock_wait
        Longest time that the first message waits for a clock, wall time in s; messages on
        preliminary channels wait with it.
    on_failure
        Called once, with the reason, if writing fails.
    wall_time
        Returns the wall time in ns.
    """

    def __init__(
        self,
        writer: BagWriter,
        clock_wait: float,
        on_failure: Callable[[RecordingError], None] = lambda error: None,
        wall_time: Callable[[], int] = time.time_ns,
    ) -> None:
        self.writer = writer
        self.state = RecordingState.PAUSED
        self.now_ns = 0
        """Latest clock time, or arrival time of the latest message, ns."""
        self.messages = 0
        """Number of messages written to the bag."""
        self.clock_steps_back = 0
        """Number of backward clock jumps: one jump after a restart, many jumps if there are two
        clocks."""
        self.lost: Counter[str] = Counter()
        """Number of messages on each topic that were published but never received."""
        self.attached: set[str] = set()
        """Names of the files attached to the bag."""
        self.preliminary: set[int] = set()
        """Channels of messages that other nodes publish before a plant starts: they do not start
        the wait for its clock."""
        self.latched: dict[int, _EarlyMessage | None] = {}
        """Last message of each latched topic received during a pause, by channel."""
        self.failure: RecordingError | None = None
        self._clock_wait_ns = clock_wait * SECOND
        self._on_failure = on_failure
        self._wall_time = wall_time
        self.early_messages: list[_EarlyMessage] = []
        """Messages kept until the bag's time base is chosen."""
        self._time_base: RecordingState | None = None

    @property
    def running(self) -> bool:
        """Whether messages are recorded."""
        return self.state not in _DROPPING_STATES

    def start(self) -> None:
        """Start recording, including the last earlier message of every latched topic."""
        if self.state is not RecordingState.PAUSED:
            return
        self.state = self._time_base or RecordingState.WAITING
        for channel, last in self.latched.items():
            self.latched[channel] = None
            if last is not None:
                self.record(channel, last.message, last.published_ns)

    def pause(self) -> None:
        """Pause recording until the next start."""
        if self.running:
            self.state = RecordingState.PAUSED

    def set_clock(self, time_ns: int) -> None:
        """Set the clock time; has no effect once the bag uses wall time."""
        if self._time_base is RecordingState.ON_WALL_TIME:
            return
        self.clock_steps_back += time_ns < self.now_ns
        self.now_ns = time_ns
        if self.state is RecordingState.WAITING:
            self._choose_time_base(RecordingState.ON_CLOCK)

    def record(self, channel: int, message: bytes, published_ns: int = 0) -> None:
        """Write a message, or keep it until the bag's time base is chosen.

        ``published_ns`` is the publication time of the message; 0 selects the recording time.
        """
        if self.state is not RecordingState.ON_CLOCK:
            arrived = _EarlyMessage(channel, message, published_ns, self._wall_time())
            if self.state is RecordingState.PAUSED and channel in self.latched:
                self.latched[channel] = arrived
            elif self.state is RecordingState.WAITING:
                self.early_messages.append(arrived)
            if self.state is not RecordingState.ON_WALL_TIME:
                return
            self.now_ns = arrived.arrival_ns
        self._write(channel, message, self.now_ns, published_ns or self.now_ns)

    def _write(self, channel: int, message: bytes, log_ns: int, published_ns: int) -> None:
        try:
            self.writer.write(channel, message, log_ns, published_ns)
        except RecordingError as error:
            self._fail(error)
            return
        self.messages += 1

    def flush(self, clock_is_published: bool) -> None:
        """Write buffered data to the file once per flush period (wall time)."""
        first = next((x for x in self.early_messages if x.channel not in self.preliminary), None)
        waited_ns = self._wall_time() - first.arrival_ns if first is not None else 0
        late = waited_ns > self._clock_wait_ns and not clock_is_published
        if late or len(self.early_messages) >= _MAX_EARLY_MESSAGES:
            self._choose_time_base(RecordingState.ON_WALL_TIME)
        self._fail_on_error(self.writer.flush)

    def check(self) -> None:
        """Check that the bag file still exists and has its full size."""
        self._fail_on_error(self.writer.check)

    def describe(self, name: str, values: dict[str, str]) -> None:
        """Write named values into the bag."""
        self._fail_on_error(lambda: self.writer.add_metadata(name, values))

    def attach_robot(self, name: str, urdf: bytes) -> None:
        """Attach a robot description, and its meshes if they exist on this machine."""
        # Importing the robot model doubles the import time of this module.
        from spacerobot_ros.model.meshes import meshes_for_bag
        from spacerobot_ros.model.urdf import parse_robot

        self.attach(name, urdf, "application/xml")
        if b"<mesh" in urdf:
            with suppress(RobotDescriptionError, UnicodeDecodeError):
                for mesh, data in meshes_for_bag(parse_robot(urdf.decode())).items():
                    self.attach(mesh, data, "model/stl")

    def attach(self, name: str, data: bytes, media_type: str) -> None:
        """Attach a file to the bag."""
        self.attached.add(name)
        self._fail_on_error(lambda: self.writer.add_attachment(name, data, media_type, self.now_ns))

    def close(self) -> None:
        """Write the remaining data and the message counts, and complete the bag if this has not
        been done yet.

        Raises
        ------
        RecordingError
            Writing failed, and no earlier call reported it.
        """
        if self.state is RecordingState.CLOSED:
            return
        self._choose_time_base(RecordingState.ON_WALL_TIME)
        counts = {"messages": self.messages, "messages_lost": self.lost.total()}
        self.describe("recorder", {name: str(count) for name, count in counts.items()})
        self.check()
        self.state = RecordingState.CLOSED
        try:
            self.writer.close()
        except RecordingError as error:
            self.failure = error
            raise

    def _choose_time_base(self, state: RecordingState) -> None:
        """Choose the bag's time base unless already chosen, and write the early messages."""
        if self._time_base is not None or self.failure is not None:
            return
        self._time_base = state
        if self.state is RecordingState.WAITING:
            self.state = state
        on_clock = state is RecordingState.ON_CLOCK
        early, self.early_messages = self.early_messages, []
        for channel, message, published_ns, arrival_ns in early:
            if self.failure is None:
                log_ns = self.now_ns if on_clock else arrival_ns
                self._write(channel, message, log_ns, published_ns or log_ns)

    def _fail_on_error(self, act: Callable[[], None]) -> None:
        if self.failure is None and self.state is not RecordingState.CLOSED:
            try:
                act()
            except RecordingError as error:
                self._fail(error)

    def _fail(self, error: RecordingError) -> None:
        self.failure, self.state = error, RecordingState.FAILED
        self._on_failure(error)
