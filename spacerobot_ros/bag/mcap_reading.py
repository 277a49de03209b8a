"""Reads records, summaries and messages from untrusted MCAP files.

The records are parsed by ``mcap``. Values are checked before use: records end within the file,
chunks have the declared size, and the total uncompressed size of all chunks in a bag is limited.
A violation raises a ``ValueError`` that states the byte offset; :class:`BagFile` converts it to a
user message.
"""

from __future__ import annotations

import fcntl
import os
import shlex
import struct
import tempfile
import weakref
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from io import BytesIO
from operator import itemgetter
from pathlib import Path
from typing import BinaryIO, NamedTuple, TypeVar, cast

import lz4.frame
import zstandard
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import FOOTER_SIZE
from mcap.records import (
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    Footer,
    McapRecord,
    MetadataIndex,
    Schema,
    Statistics,
)
from mcap.stream_reader import MAGIC_SIZE, StreamReader
from mcap.summary import Summary
from mcap.writer import MCAP0_MAGIC

from spacerobot_ros.errors import RecordingError, reason
from spacerobot_ros.files import irregular_kind

RecordT = TypeVar("RecordT", bound=McapRecord)

INFLATED_SIZE_VARIABLE = "SPACEROBOT_BAG_LIMIT"
"""Environment variable: uncompressed size, in MB, that even a small bag may have."""

_DEFAULT_LIMIT_MB = 32.0
"""Default limit on the uncompressed size of a bag, MB."""

_MAX_INFLATION_RATIO = 200
"""Largest ratio of uncompressed size to file size for a bag above the MB limit. Telemetry has
ratios of 3 to 40, malicious bags 1000 and more."""

_UNPACKED_AT_ONCE = 1 << 20  # bytes

_SQLITE_MAGIC = b"SQLite f"
"""First eight bytes of rosbag2 SQLite files."""

_RECORD_HEAD = struct.Struct("<BQ")
"""Record header: opcode and body length in bytes."""

_OPCODES = set(Opcode)

DAMAGE_ERRORS = (
    McapError,
    ValueError,
    OverflowError,
    RuntimeError,
    MemoryError,
    struct.error,
    zstandard.ZstdError,
)
"""Exceptions that damaged records cause; the exceptions of the libraries have no common base
class."""


# -- files ------------------------------------------------------------------------------------


def require_regular(mode: int, path: Path, action: str = "read") -> None:
    """Raise RecordingError unless a file is regular: pipes block, and devices may be damaged."""
    if kind := irregular_kind(mode):
        raise RecordingError(f"Cannot {action} the bag {path}: it is {kind}.")


@contextmanager
def open_file(path: Path, content: Path | None = None) -> Iterator[BinaryIO]:
    """Open a bag for reading; if the bag is compressed, open the temporary file with its unpacked
    content.

    Raises
    ------
    RecordingError
        There is no such file, or it is not regular or cannot be read, or a damaged record is found
        within the context.
    """
    content = content or path
    try:
        require_regular(os.stat(content).st_mode, path)
        with content.open("rb") as file:
            yield file
    except FileNotFoundError as error:
        raise RecordingError(f"There is no bag at {path}.") from error
    except OSError as error:
        raise RecordingError(f"Cannot read the bag {path}: {reason(error)}.") from error
    except DAMAGE_ERRORS as error:
        why = str(error) or type(error).__name__
        raise RecordingError(f"The bag {path} is damaged: {why}.") from error


class RecordedChannel(NamedTuple):
    """A channel in a file (a topic from one publisher), and its type definition."""

    channel: Channel
    schema: Schema
    message_count: int
    """According to the file."""


class BagFile:
    """One MCAP file of a bag, and its summary.

    A file compressed as a whole, such as rosbag2's ``NAME.mcap.zstd``, is unpacked to a
    temporary file, which is deleted with this object.

    Parameters
    ----------
    path
        Path of the file; error messages include it.

    Raises
    ------
    RecordingError
        The file does not exist, cannot be read, is not an MCAP file, or is truncated.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._content = path
        with open_file(path) as file:
            if file.read(len(zstandard.FRAME_HEADER)) == zstandard.FRAME_HEADER:
                descriptor, name = tempfile.mkstemp(".mcap", "spacerobot_")
                self._content = Path(name)
                weakref.finalize(self, self._content.unlink, missing_ok=True)
                limit = ChunkUnpacker(file_size(file))
                file.seek(0)
                packed = zstandard.ZstdDecompressor().stream_reader(file, read_across_frames=True)
                with os.fdopen(descriptor, "wb") as unpacked:
                    while block := packed.read(_UNPACKED_AT_ONCE):
                        limit.count(len(block), 0)
                        unpacked.write(block)
        with self.open() as file:
            self.size = file_size(file)
            self.summary, self.statistics = _read_summary(path, file)
        counts, schemas = self.statistics.channel_message_counts, self.summary.schemas
        nothing = Schema(id=0, data=b"", encoding="", name="")
        self.channels = [
            RecordedChannel(each, schemas.get(each.schema_id, nothing), counts.get(each.id, 0))
            for each in self.summary.channels.values()
        ]

    @contextmanager
    def open(self) -> Iterator[BinaryIO]:
        """Open the file; report any defect as a one-sentence error.

        Raises
        ------
        RecordingError
            See the class; also raised if a damaged record is found while the context is open.
        """
        path, size = self.path, len(MCAP0_MAGIC)
        with open_file(path, self._content) as file:
            start = file.read(size)
            if not start:
                raise RecordingError(
                    f"The bag {path} is empty: its writer stopped before it wrote anything."
                )
            require_mcap(path, start)
            length = file_size(file)
            file.seek(max(length - size, 0))
            if length < 2 * size or file.read(size) != MCAP0_MAGIC:
                if _is_being_written(file):
                    raise RecordingError(
                        f"The bag {path} is still being written: stop its recorder first."
                    )
                raise RecordingError(
                    f"The bag {path} was cut short, because its writer was killed or its disk was "
                    f"full: 'spacerobot salvage {shlex.quote(str(path))}' recovers its content."
                )
            file.seek(0)
            yield file


def require_mcap(path: Path, start: bytes) -> None:
    """Raise RecordingError unless a file starts with the MCAP magic bytes; ``start`` may be cut."""
    if start.startswith(zstandard.FRAME_HEADER):
        raise RecordingError(f"The bag {path} is compressed: unpack it with 'zstd -d'.")
    if start == _SQLITE_MAGIC:
        raise RecordingError(
            f"The bag {path} is in SQLite: convert it with 'rosbags-convert --src "
            f"{shlex.quote(str(path.parent))} --dst NEW_FOLDER --dst-storage mcap', or with 'ros2 "
            "bag convert'."
        )
    if start != MCAP0_MAGIC[: len(start)]:
        raise RecordingError(f"{path} is not an MCAP file.")


def _is_being_written(file: BinaryIO) -> bool:
    """Whether a writer, which locks its bag, still has it open."""
    try:
        fcntl.flock(file.fileno(), fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:  # Some network file systems have no locks.
        return False
    fcntl.flock(file.fileno(), fcntl.LOCK_UN)
    return False


def file_size(file: BinaryIO) -> int:
    """Return the size of an open file in bytes."""
    return os.fstat(file.fileno()).st_size


# -- records ----------------------------------------------------------------------------------


def records(file: BinaryIO, start: int) -> Iterator[tuple[int, int, bytes]]:
    """Iterate over the records from a byte offset, and yield the start, opcode and bytes of each
    record."""
    end = file_size(file)
    while start < end:
        file.seek(start)
        head = file.read(_RECORD_HEAD.size)
        if len(head) < _RECORD_HEAD.size:
            raise ValueError(f"it ends inside the record at byte {start}")
        opcode, length = _RECORD_HEAD.unpack(head)
        left = end - start - len(head)
        if length > left:
            raise ValueError(
                f"the record at byte {start} declares {length} bytes, but only {left} remain"
            )
        yield start, opcode, head + file.read(length)
        start += len(head) + length


def records_in_chunk(data: bytes, place: int) -> Iterator[tuple[int, int]]:
    """Iterate over the records in the unpacked chunk at ``place``: the first byte of each record,
    and the byte after its end."""
    position, size = 0, len(data)
    unpack, head = _RECORD_HEAD.unpack_from, _RECORD_HEAD.size
    while position < size:
        if size - position < head:
            raise ValueError(f"the chunk at byte {place} ends inside a record")
        opcode, length = unpack(data, position)
        end = position + head + length
        if end > size:
            raise ValueError(f"a record extends beyond the chunk at byte {place}")
        if not opcode:
            # Otherwise a chunk of zeros would count as millions of records.
            raise ValueError(f"the chunk at byte {place} has records of unknown kinds")
        yield position, end
        position = end


def parse_record(record: bytes) -> McapRecord | None:
    """Return a record, or None if MCAP does not define its kind; a chunk is not unpacked."""
    if record[0] not in _OPCODES:
        return None
    return next(StreamReader(BytesIO(record), skip_magic=True, emit_chunks=True).records)


def read_record(file: BinaryIO, place: int, kind: type[RecordT]) -> RecordT:
    """Return the record of the given kind at byte ``place`` of a file."""
    found = next((parse_record(record) for _, _, record in records(file, place)), None)
    if not isinstance(found, kind):
        raise ValueError(f"the file has no {kind.__name__} record at byte {place}")
    return found


# -- chunks -----------------------------------------------------------------------------------


class ChunkUnpacker:
    """Unpacks the chunks of a file, up to a limit on the total uncompressed size."""

    def __init__(self, compressed: int) -> None:
        limit_mb = _DEFAULT_LIMIT_MB
        with suppress(ValueError):
            given = float(os.environ.get(INFLATED_SIZE_VARIABLE, limit_mb))
            limit_mb = given if 0.0 < given < 1e12 else limit_mb
        self.max_bytes = max(round(1e6 * limit_mb), _MAX_INFLATION_RATIO * compressed)
        """Largest total uncompressed size of all chunks, bytes."""
        self._inflated_size = 0

    def count(self, size: int, place: int) -> None:
        """Add the uncompressed size of the chunk at ``place`` to the total; raise ValueError if
        the total is too large."""
        if self._inflated_size + size > self.max_bytes:
            raise ValueError(
                f"with the chunk at byte {place} it inflates to {self._inflated_size + size} "
                f"bytes, more than the {self.max_bytes} allowed for its size (set "
                f"{INFLATED_SIZE_VARIABLE} to a larger number of MB if you trust it)"
            )
        self._inflated_size += size

    def unpack(self, chunk: Chunk, place: int) -> bytes:
        """Return the records of the chunk at ``place``; their size and checksum are verified."""
        size = chunk.uncompressed_size
        self.count(size, place)
        if chunk.compression not in _DECOMPRESSORS:
            raise ValueError(
                f"the compression {chunk.compression!r} of the chunk at byte {place} is unknown"
            )
        try:
            # One more byte shows whether the chunk is larger than stated.
            data = _DECOMPRESSORS[chunk.compression](chunk.data, size + 1) if size else chunk.data
        except DAMAGE_ERRORS as error:
            raise ValueError(f"the chunk at byte {place} cannot be unpacked: {error}") from error
        if len(data) != size:
            raise ValueError(
                f"the chunk at byte {place} does not contain the declared {size} bytes"
            )
        if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
            raise ValueError(f"the checksum of the chunk at byte {place} is wrong")
        return data

    def unpack_message(self, data: bytes, place: int) -> bytes:
        """Return a message of the chunk at ``place``, unpacked if rosbag2 compressed it on its own
        (``compression_mode: message``). No message in CDR starts like a zstd frame."""
        if not data.startswith(zstandard.FRAME_HEADER):
            return data
        self.count(max(zstandard.frame_content_size(data), 0), place)
        return zstandard.ZstdDecompressor().decompress(data)


_DECOMPRESSORS: dict[str, Callable[[bytes, int], bytes]] = {
    "zstd": lambda data, most: zstandard.ZstdDecompressor().stream_reader(data).read(most),
    "lz4": lambda data, most: lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=most),
    "": lambda data, _: data,
}
"""Decompressor by name, a function of the data and the maximum number of bytes to return."""


# -- summary ----------------------------------------------------------------------------------


def _read_summary(path: Path, file: BinaryIO) -> tuple[Summary, Statistics]:
    """Read schemas, channels, indexes and statistics from the end of a bag; RecordingError if it
    has none.
    """
    size = file_size(file)
    start = read_record(file, max(size - FOOTER_SIZE - MAGIC_SIZE, 0), Footer).summary_start
    if start > size:
        raise ValueError(f"its summary begins at byte {start}, beyond the end of the file")
    summary, chunks = Summary(), ChunkUnpacker(size)
    for _, _, record in records(file, start) if start else ():
        match parse_record(record):
            case Statistics() as statistics:
                summary.statistics = statistics
            case Schema() as schema:
                summary.schemas[schema.id] = schema
            case Channel() as channel:
                summary.channels[channel.id] = channel
            case AttachmentIndex() as attachment:
                summary.attachment_indexes.append(attachment)
            case ChunkIndex() as chunk:
                chunks.count(chunk.uncompressed_size, chunk.chunk_start_offset)
                summary.chunk_indexes.append(chunk)
            case MetadataIndex() as metadata:
                summary.metadata_indexes.append(metadata)
            case Footer():
                break
    if summary.statistics is None:
        raise RecordingError(
            f"The bag {path} has no summary: 'spacerobot salvage {shlex.quote(str(path))}' "
            "creates one."
        )
    return summary, summary.statistics


# -- messages ---------------------------------------------------------------------------------

Message = tuple[str, int, bytes]
"""A recorded message: its topic, log time (ns) and serialised bytes."""

_MESSAGE_HEAD = struct.Struct("<BQHIQQ")
"""Message header: opcode, length, channel, sequence, log time and publish time."""

LATEST_TIME_NS = 2**63 - 1
"""Latest time that int64 nanoseconds can represent: the year 2262."""


class _Section(NamedTuple):
    """A section of a file: a chunk with its index, or a whole file without a chunk index."""

    start_ns: int
    written: tuple[int, int]
    """File index, and byte offset in the file."""
    end_ns: int
    chunk: ChunkIndex | None


def blocks_in_time_order(
    files: Sequence[BagFile], topics: Iterable[str], start_ns: int = 0, end_ns: int = LATEST_TIME_NS
) -> Iterator[list[Message]]:
    """Iterate over the messages in a bag in log time order, and in write order for equal log times.

    Only messages on the given topics with log times in the given span (ns) are returned. A block
    contains the messages of chunks that overlap in time; only these chunks are in memory together.
    Errors: see :meth:`BagFile.open`.
    """
    wanted, end_ns = set(topics), min(end_ns, LATEST_TIME_NS)
    sections: list[_Section] = []
    channels = [
        {each.id: each.topic for each in file.summary.channels.values() if each.topic in wanted}
        for file in files
    ]
    for n, (file, topic_of) in enumerate(zip(files, channels, strict=True)):
        for index in file.summary.chunk_indexes:
            span = index.message_start_time, index.message_end_time
            if span[0] > end_ns or span[1] < start_ns:
                continue
            inside = index.message_index_offsets.keys()
            if not inside or inside & topic_of.keys():
                sections.append(_Section(span[0], (n, index.chunk_start_offset), span[1], index))
        if not file.summary.chunk_indexes:
            sections.append(_Section(0, (n, 0), LATEST_TIME_NS, None))
    unpackers = [ChunkUnpacker(file.size) for file in files]
    for cluster in _overlapping(sections):
        block: list[Message] = []
        for section in sorted(cluster, key=lambda each: each.written):
            n = section.written[0]
            unpack = unpackers[n].unpack_message
            with files[n].open() as opened:
                for place, data in _unpacked(opened, section.chunk):
                    block += (
                        (topic, time_ns, unpack(message, place))
                        for topic, time_ns, message in _messages_in(data, place, channels[n])
                        if start_ns <= time_ns <= end_ns
                    )
        yield sorted(block, key=itemgetter(1))


def _overlapping(sections: Iterable[_Section]) -> Iterator[list[_Section]]:
    """Group file sections so that the sections in a group overlap in time."""
    cluster: list[_Section] = []
    latest, farthest = 0, (0, 0)
    for section in sorted(sections, key=lambda each: each[:2]):
        # Among messages with equal times, those in earlier chunks come first.
        if cluster and section[:2] >= (latest, farthest):
            yield cluster
            cluster = []
        cluster.append(section)
        latest, farthest = max(latest, section.end_ns), max(farthest, section.written)
    if cluster:
        yield cluster


def _unpacked(opened: BinaryIO, index: ChunkIndex | None) -> Iterator[tuple[int, bytes]]:
    """Yield the records of an indexed chunk, or those of all chunks and all messages outside of
    chunks, each after its byte offset."""
    chunks = ChunkUnpacker(file_size(opened))
    if index is not None:
        place = index.chunk_start_offset
        chunk = read_record(opened, place, Chunk)
        if chunk.uncompressed_size != index.uncompressed_size:
            raise ValueError(f"the chunk at byte {place} and its index specify different sizes")
        yield place, chunks.unpack(chunk, place)
        return
    for place, opcode, record in records(opened, MAGIC_SIZE):
        if opcode == Opcode.CHUNK:
            yield place, chunks.unpack(cast("Chunk", parse_record(record)), place)
        elif opcode == Opcode.MESSAGE:
            yield place, record
        elif opcode == Opcode.DATA_END:
            return


def _messages_in(data: bytes, place: int, topic_of: Mapping[int, str]) -> Iterator[Message]:
    """Yield the messages in the chunk at ``place`` whose channels have topics, in record order."""
    for begin, end in records_in_chunk(data, place):
        if data[begin] == Opcode.MESSAGE:
            if end - begin < _MESSAGE_HEAD.size:
                raise ValueError(
                    f"a message of the chunk at byte {place} is shorter than its header"
                )
            _, _, channel, _, time_ns, _ = _MESSAGE_HEAD.unpack_from(data, begin)
            if channel in topic_of:
                yield topic_of[channel], time_ns, data[begin + _MESSAGE_HEAD.size : end]
