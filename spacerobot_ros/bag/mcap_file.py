"""An MCAP file on its way to disk: whole records at its end, and the summary that closes it.

The records are encoded by the classes of ``mcap.records``. What ``mcap.writer.Writer`` does for
every single message is left to the caller, who brings whole chunks: with the library's writer a
recorder would slow a simulation down.
"""

from __future__ import annotations

import errno
import fcntl
import io
import os
import struct
import zlib
from collections import defaultdict
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path

import lz4.frame
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.writer import MCAP0_MAGIC

from spacerobot_ros.bag.mcap_records import require_regular
from spacerobot_ros.errors import RecordingError

_COMPRESSIONS = {"zstd": "zstd", "lz4": "lz4", "none": ""}
"""Our name of each compression -> its name in the file."""

_MESSAGE_INDEX_HEADER = struct.Struct("<BQHI")


def _compressor(compression: str) -> Callable[[bytes | bytearray], bytes]:
    if compression == "zstd":
        # One for each file, because two threads must not share one. Level -1 makes
        # telemetry 3 % larger than levels 1 and 3, in half the time.
        return zstandard.ZstdCompressor(level=-1).compress
    return lz4.frame.compress if compression == "lz4" else bytes


class BagExistsError(RecordingError):
    """A bag that is there, and is not to be written over."""


def _created(path: Path, overwrite: bool) -> io.FileIO:
    """Open a file of our own for writing: regular, empty and locked.

    Raises
    ------
    RecordingError
        There is something that is not to be written over.
    OSError
        It cannot be opened.
    """
    with suppress(FileNotFoundError):
        require_regular(os.stat(path).st_mode, path, "make")
    flags = os.O_RDWR | os.O_CREAT | os.O_NONBLOCK | os.O_CLOEXEC
    try:
        descriptor = os.open(path, flags if overwrite else flags | os.O_EXCL, 0o666)
    except FileExistsError as error:
        raise BagExistsError(
            f"Cannot make the bag {path}: File exists; name another one, or remove it."
        ) from error
    # Unbuffered: what was appended survives a kill.
    raw = open(descriptor, "wb", buffering=0)  # noqa: SIM115
    try:
        require_regular(os.fstat(descriptor).st_mode, path, "make")
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raw.close()
        raise BagExistsError(f"The bag {path} is being written by another recorder.") from error
    except OSError as error:
        # Some file systems of networks have no locks; a file that was there is refused there.
        if error.errno not in (errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS):
            raw.close()
            raise
    except RecordingError:
        raw.close()
        raise
    raw.truncate(0)
    return raw


def encode(record: McapRecord) -> bytes:
    """Return the bytes of one record."""
    builder = RecordBuilder()
    record.write(builder)
    return bytes(builder.end())


class McapFile:
    """An MCAP file that grows by whole records.

    Every append goes to the operating system at once, and one that fails is undone, so that the
    file of a process that dies is whole but for the record that it was appending. While it is open
    it is locked: no second one can be opened on the same path. ``compression`` and ``overwrite``
    are as of :class:`~spacerobot_ros.bag.BagWriter`; ``profile`` says what the messages are.

    Raises
    ------
    BagExistsError
        The file is there and is not to be replaced, or is being written.
    RecordingError
        The file cannot be made.
    """

    def __init__(
        self, path: Path, *, compression: str, overwrite: bool, profile: str = "ros2"
    ) -> None:
        if compression not in _COMPRESSIONS:
            raise RecordingError(
                f"The compression {compression!r} is not one of {', '.join(_COMPRESSIONS)}."
            )
        self.path = path
        self.schemas: list[Schema] = []
        self.channels: list[Channel] = []
        self.message_counts: dict[int, int] = defaultdict(int)
        self.start_ns: int | None = None
        self.end_ns: int | None = None
        self._compression = _COMPRESSIONS[compression]
        self._compress = _compressor(compression)
        self._chunk_indexes: list[bytes] = []  # Encoded: a long flight has many.
        self._attachment_indexes: list[AttachmentIndex] = []
        self._metadata_indexes: list[MetadataIndex] = []
        self._size = 0
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._raw = _created(path, overwrite)
        except (OSError, ValueError) as error:
            reason = getattr(error, "strerror", None) or error
            raise RecordingError(f"Cannot make the bag {path}: {reason}.") from error
        try:
            self._append(MCAP0_MAGIC + encode(Header(profile=profile, library="spacerobot_ros")))
        except RecordingError:
            self.close()
            raise

    @property
    def size(self) -> int:
        """How many bytes the file has."""
        return self._size

    def check(self) -> None:
        """Find out whether the path still names this file, and it has all that was written.

        Raises
        ------
        RecordingError
            It was removed, replaced, moved or cut, so the path no longer leads to what was written.
        """
        what = ""
        try:
            ours, theirs = os.fstat(self._raw.fileno()), os.stat(self.path)
            if (ours.st_dev, ours.st_ino) != (theirs.st_dev, theirs.st_ino):
                what = "another file is in its place"
            elif ours.st_size != self._size:
                what = f"it has {ours.st_size} bytes, and {self._size} were written"
        except FileNotFoundError:
            what = "it was removed or moved"
        except (OSError, ValueError) as error:
            what = str(getattr(error, "strerror", None) or error)
        if what:
            raise RecordingError(f"The bag {self.path} is lost while it is written: {what}.")

    def append_chunk(self, records: bytearray, entries: dict[int, list[int]]) -> None:
        """Append a chunk of encoded records and the indexes of its messages.

        ``entries`` are, of each channel, for each of its messages, log time in nanoseconds and
        offset in ``records``, one after the other.

        Raises
        ------
        RecordingError
            The disk refused it; the file is as it was.
        """
        entries = {channel: entry for channel, entry in entries.items() if entry}
        times = [entry[::2] for entry in entries.values()]
        start, end = min(map(min, times)), max(map(max, times))
        data = self._compress(records)
        chunk = encode(
            Chunk(
                compression=self._compression,
                data=data,
                message_start_time=start,
                message_end_time=end,
                uncompressed_crc=zlib.crc32(records),
                uncompressed_size=len(records),
            )
        )
        parts, offsets, position = [chunk], {}, self._size + len(chunk)
        for channel, entry in entries.items():
            size = 8 * len(entry)
            header = _MESSAGE_INDEX_HEADER.pack(Opcode.MESSAGE_INDEX, 6 + size, channel, size)
            parts += header, struct.pack(f"<{len(entry)}Q", *entry)
            offsets[channel] = position
            position += len(header) + size
        index = ChunkIndex(
            message_start_time=start,
            message_end_time=end,
            chunk_start_offset=self._size,
            chunk_length=len(chunk),
            message_index_offsets=offsets,
            message_index_length=position - self._size - len(chunk),
            compression=self._compression,
            compressed_size=len(data),
            uncompressed_size=len(records),
        )
        self._append(b"".join(parts))
        self._chunk_indexes.append(encode(index))
        for channel, entry in entries.items():
            self.message_counts[channel] += len(entry) // 2
        self.start_ns = start if self.start_ns is None else min(start, self.start_ns)
        self.end_ns = end if self.end_ns is None else max(end, self.end_ns)

    def append_attachment(self, attachment: Attachment) -> None:
        """Append an attachment.

        Raises
        ------
        RecordingError
            The disk refused it; the file is as it was.
        """
        record, offset = encode(attachment), self._size
        self._append(record)
        self._attachment_indexes.append(
            AttachmentIndex(
                offset=offset,
                length=len(record),
                log_time=attachment.log_time,
                create_time=attachment.create_time,
                data_size=len(attachment.data),
                name=attachment.name,
                media_type=attachment.media_type,
            )
        )

    def append_metadata(self, metadata: Metadata) -> None:
        """Append a metadata record.

        Raises
        ------
        RecordingError
            The disk refused it; the file is as it was.
        """
        record, offset = encode(metadata), self._size
        self._append(record)
        self._metadata_indexes.append(
            MetadataIndex(offset=offset, length=len(record), name=metadata.name)
        )

    def finish(self) -> None:
        """Append the summary, after which the file is complete.

        Raises
        ------
        RecordingError
            The disk refused it; the file is as it was.
        """
        data_end = encode(DataEnd(data_section_crc=0))
        start = self._size + len(data_end)
        groups: tuple[tuple[Opcode, Iterable[bytes]], ...] = (
            (Opcode.SCHEMA, map(encode, self.schemas)),
            (Opcode.CHANNEL, map(encode, self.channels)),
            (Opcode.STATISTICS, [encode(self._statistics())]),
            (Opcode.CHUNK_INDEX, self._chunk_indexes),
            (Opcode.ATTACHMENT_INDEX, map(encode, self._attachment_indexes)),
            (Opcode.METADATA_INDEX, map(encode, self._metadata_indexes)),
        )
        summary, offsets = bytearray(), bytearray()
        for opcode, records in groups:
            group = b"".join(records)
            if group:
                offsets += encode(
                    SummaryOffset(
                        group_opcode=opcode,
                        group_start=start + len(summary),
                        group_length=len(group),
                    )
                )
                summary += group
        offsets_start = start + len(summary)
        summary += offsets
        # The checksum covers the footer too, up to the checksum itself.
        unchecked = encode(Footer(start, offsets_start, summary_crc=0))
        checksum = zlib.crc32(unchecked[:-4], zlib.crc32(summary))
        footer = encode(Footer(start, offsets_start, summary_crc=checksum))
        self._append(data_end + bytes(summary) + footer + MCAP0_MAGIC)

    def close(self) -> None:
        """Close the file; does not raise."""
        with suppress(OSError):
            self._raw.close()

    def _statistics(self) -> Statistics:
        return Statistics(
            attachment_count=len(self._attachment_indexes),
            channel_count=len(self.channels),
            channel_message_counts=dict(self.message_counts),
            chunk_count=len(self._chunk_indexes),
            message_count=sum(self.message_counts.values()),
            message_start_time=self.start_ns or 0,
            message_end_time=self.end_ns or 0,
            metadata_count=len(self._metadata_indexes),
            schema_count=len(self.schemas),
        )

    def _append(self, data: bytes) -> None:
        rest = memoryview(data)
        try:
            while rest:
                rest = rest[self._raw.write(rest) :]
        except OSError as error:
            with suppress(OSError):
                self._raw.truncate(self._size)
                self._raw.seek(self._size, os.SEEK_SET)
            count = sum(self.message_counts.values())
            raise RecordingError(
                f"Cannot write the bag {self.path}: {error.strerror or error}; "
                f"the {count} messages before that are safe in it."
            ) from error
        self._size += len(data)
