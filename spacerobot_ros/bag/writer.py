"""Writes bags as MCAP files in the format of rosbag2's storage plugin."""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path

from spacerobot_ros.bag.config import RecorderConfig
from spacerobot_ros.bag.mcap_file import BagExistsError, McapFile, QosProfile, RecordedTopic
from spacerobot_ros.errors import RecordingError
from spacerobot_ros.messages.definitions import type_hash
from spacerobot_ros.times import SECOND

_DEFAULTS = RecorderConfig()


def free_name(path: Path) -> Path:
    """Return a path, or the first of ``NAME-1``, ``NAME-2``, ... that does not exist yet."""
    number = 0
    while True:
        name = path.with_name(f"{path.stem}-{number}{path.suffix}") if number else path
        if not os.path.lexists(name):
            return name
        number += 1


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
        asked, number = self._unsplit_path, 0
        while True:
            try:
                whole = self._unsplit_path
                numbered = re.compile(rf"{re.escape(whole.stem)}_\d+{re.escape(whole.suffix)}")
                others: list[str] = []
                if any(self._limits) and not self._overwrite:
                    with suppress(OSError):
                        others = sorted(filter(numbered.fullmatch, os.listdir(whole.parent)))
                if others:
                    raise BagExistsError(
                        f"Cannot create the bag {whole.with_name(others[0])}: File exists; name "
                        "another one, or remove it."
                    )
                return self._open_numbered_file()
            except BagExistsError:
                if not self._next_free:
                    raise
            number += 1
            self._unsplit_path = asked.with_name(f"{asked.stem}-{number}{asked.suffix}")

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
