"""The records of an MCAP file that anybody may have written.

Nothing is believed before it is checked: a record lies inside of its file, a chunk holds as much as
it claims to, and all chunks of a bag together inflate to no more than a limit. What is wrong is a
``ValueError`` that says at which byte; :func:`open_bag` makes a sentence of it.
"""

from __future__ import annotations

import os
import shlex
import stat
import struct
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, TypeVar

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Chunk
from mcap.writer import MCAP0_MAGIC

from spacerobot_ros.errors import RecordingError

T = TypeVar("T")

LIMIT_VARIABLE = "SPACEROBOT_BAG_LIMIT"
"""Environment variable: how many MB a bag may inflate to, however small its file is."""

_LIMIT = 32.0
"""Its default, MB."""

_SWELLING = 200
"""What a bag may inflate to is this many times its file, where that is more. Telemetry compresses
by 3 to 40, what was made to fill memories by 1000 and more."""

RECORD_HEADER = struct.Struct("<BQ")
"""Opcode, and the length of the body."""

_LENGTH = struct.Struct("<Q")

_CHUNK = struct.Struct("<QQQI")
"""The head of a chunk: times, size and checksum of its content."""

DAMAGE = (
    McapError,
    ValueError,
    OverflowError,
    RuntimeError,
    MemoryError,
    struct.error,
    zstandard.ZstdError,
)
"""What reading a damaged record raises: the libraries have no error in common."""


# -- files ------------------------------------------------------------------------------------

_KINDS = (
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISFIFO, "a pipe"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)


def require_regular(mode: int, path: Path, act: str = "read") -> None:
    """Refuse paths that are no regular file: opening a pipe blocks, writing to a device does harm.

    Raises
    ------
    RecordingError
        ``mode``, of the inode at ``path``, is not that of a regular file.
    """
    if not stat.S_ISREG(mode):
        kind = next((words for test, words in _KINDS if test(mode)), "no file")
        raise RecordingError(f"Cannot {act} the bag {path}: it is {kind}.")


@contextmanager
def open_file(path: Path) -> Iterator[BinaryIO]:
    """Open a regular file for reading; never waits.

    Raises
    ------
    RecordingError
        There is no such file, it is no regular file, or it cannot be read while the context lasts.
    """
    try:
        require_regular(os.stat(path).st_mode, path)
        # It may have become a pipe meanwhile.
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        with open(descriptor, "rb") as file:
            require_regular(os.fstat(descriptor).st_mode, path)
            yield file
    except FileNotFoundError as error:
        raise RecordingError(f"There is no bag at {path}.") from error
    except OSError as error:
        raise RecordingError(f"Cannot read the bag {path}: {error.strerror or error}.") from error


@contextmanager
def open_bag(path: Path) -> Iterator[BinaryIO]:
    """Open a complete bag; turn every defect of it into an error of one sentence.

    Raises
    ------
    RecordingError
        There is no such file, it cannot be read, is not MCAP, was cut short, or a record turns out
        damaged while the context lasts.
    """
    with open_file(path) as file:
        try:
            _require_both_ends(path, file)
            yield file
        except MemoryError as error:
            raise RecordingError(
                f"The bag {path} is damaged: a record claims to be larger than the memory."
            ) from error
        except DAMAGE as error:
            reason = str(error) or type(error).__name__
            raise RecordingError(f"The bag {path} is damaged: {reason}.") from error


def _require_both_ends(path: Path, file: BinaryIO) -> None:
    size = len(MCAP0_MAGIC)
    start = file.read(size)
    if not start:
        raise RecordingError(f"The bag {path} is empty: its writer was stopped before it began.")
    if start != MCAP0_MAGIC[: len(start)]:
        raise RecordingError(f"{path} is not an MCAP file.")
    length = file.seek(0, os.SEEK_END)
    file.seek(max(length - size, 0))
    if length < 2 * size or file.read(size) != MCAP0_MAGIC:
        raise RecordingError(
            f"The bag {path} was cut short, its writer having been killed or its disk full: "
            f"'spacerobot salvage {shlex.quote(str(path))}' makes a complete bag of what is in it."
        )
    file.seek(0)


def file_size(file: BinaryIO) -> int:
    """Return how many bytes a file has; where it is read next stays."""
    place = file.tell()
    size = file.seek(0, os.SEEK_END)
    file.seek(place)
    return size


# -- records ----------------------------------------------------------------------------------


def records(file: BinaryIO, start: int, end: int) -> Iterator[tuple[int, int, bytes]]:
    """Go through the records between two places of a file: where each begins, opcode and body.

    Raises
    ------
    ValueError
        A record is larger than what is left.
    """
    while start < end:
        file.seek(start)
        opcode, length = _header(file, start, end)
        yield start, opcode, file.read(length)
        start += RECORD_HEADER.size + length


def records_in(data: bytes, place: int) -> Iterator[tuple[int, int, int]]:
    """Go through the records of the unpacked chunk at ``place``: opcode, and where each lies in it.

    Raises
    ------
    ValueError
        A record reaches out of the chunk.
    """
    position, size = 0, len(data)
    unpack, header = RECORD_HEADER.unpack_from, RECORD_HEADER.size
    while position < size:
        if size - position < header:
            raise ValueError(f"the chunk at byte {place} ends inside of a record")
        opcode, length = unpack(data, position)
        end = position + header + length
        if end > size:
            raise ValueError(f"a record reaches out of the chunk at byte {place}")
        if not opcode:
            # Or a chunk of zeros would be millions of them.
            raise ValueError(f"the chunk at byte {place} has records of no kind")
        yield opcode, position, end
        position = end


def record_at(file: BinaryIO, place: int, wanted: Opcode) -> bytes:
    """Return the body of the record that begins somewhere in a file.

    Raises
    ------
    ValueError
        There is no such record.
    """
    end = file_size(file)
    if place + RECORD_HEADER.size > end:
        raise ValueError(f"its index names byte {place}, and it has {end} bytes")
    file.seek(place)
    opcode, length = _header(file, place, end)
    if opcode != wanted:
        raise ValueError(f"there is no {wanted.name.lower()} at byte {place}")
    return file.read(length)


def _header(file: BinaryIO, place: int, end: int) -> tuple[int, int]:
    head = file.read(RECORD_HEADER.size)
    if len(head) < RECORD_HEADER.size:
        raise ValueError(f"it ends inside of the record at byte {place}")
    opcode, length = RECORD_HEADER.unpack(head)
    left = end - place - RECORD_HEADER.size
    if length > left:
        raise ValueError(
            f"the record at byte {place} claims {length} bytes, where {max(left, 0)} are left"
        )
    return opcode, length


def parsed(read: Callable[[ReadDataStream], T], body: bytes, place: int) -> T:
    """Return what a class of ``mcap.records`` reads from the body of the record at ``place``.

    Raises
    ------
    ValueError
        The body is damaged.
    """
    try:
        return read(ReadDataStream(BytesIO(body)))
    except DAMAGE as error:
        reason = str(error) or type(error).__name__
        raise ValueError(f"the record at byte {place} cannot be read ({reason})") from error


# -- chunks -----------------------------------------------------------------------------------


class Allowance:
    """How much the chunks of a file may inflate to, together.

    Parameters
    ----------
    compressed
        How large the file is, in bytes.
    """

    def __init__(self, compressed: int) -> None:
        self.most = max(round(1e6 * _limit()), _SWELLING * compressed)
        """In bytes."""
        self._taken = 0

    def take(self, size: int, place: int) -> None:
        """Count what the chunk at ``place`` inflates to.

        Raises
        ------
        ValueError
            That is too much.
        """
        if self._taken + size > self.most:
            raise ValueError(
                f"with the chunk at byte {place} it inflates to {self._taken + size} bytes, more "
                f"than the {self.most} that its size allows (set {LIMIT_VARIABLE} to more MB if "
                "you trust it)"
            )
        self._taken += size


def _limit() -> float:
    try:
        limit = float(os.environ.get(LIMIT_VARIABLE, _LIMIT))
    except ValueError:
        return _LIMIT
    return limit if 0.0 < limit < 1e12 else _LIMIT


def chunk_size(body: bytes) -> int:
    """Return how many bytes a chunk claims to hold.

    Raises
    ------
    struct.error
        The body is too short for a chunk.
    """
    return int(_CHUNK.unpack_from(body)[2])


def unpacked(body: bytes, place: int) -> bytes:
    """Return the records of a chunk, whose size was allowed.

    Raises
    ------
    ValueError
        It is damaged: its compression, its checksum, or it holds another number of bytes than it
        claims to.
    """
    chunk = parsed(Chunk.read, body, place)
    if chunk.compression not in _DECOMPRESSORS:
        raise ValueError(
            f"the compression {chunk.compression!r} of the chunk at byte {place} is unknown"
        )
    claimed = _LENGTH.unpack_from(body, _CHUNK.size + 4 + len(chunk.compression.encode()))[0]
    if claimed != len(chunk.data):
        raise ValueError(
            f"the chunk at byte {place} holds {len(chunk.data)} packed bytes, not the {claimed} "
            "that it claims"
        )
    size = chunk.uncompressed_size
    try:
        data = _DECOMPRESSORS[chunk.compression](chunk.data, size)
    except DAMAGE as error:
        reason = str(error) or type(error).__name__
        raise ValueError(f"the chunk at byte {place} cannot be unpacked ({reason})") from error
    if len(data) != size:
        more = "more" if len(data) > size else "less"
        raise ValueError(f"the chunk at byte {place} holds {more} than the {size} bytes it claims")
    if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
        raise ValueError(f"the checksum of the chunk at byte {place} is wrong")
    return data


def _unpack_zstd(data: bytes, size: int) -> bytes:
    if not data and not size:
        return b""
    # What a frame says of itself is what the library allocates.
    claimed = zstandard.frame_content_size(data)
    if claimed > size:
        raise ValueError(f"its frame claims {claimed} bytes")
    return zstandard.ZstdDecompressor().decompress(data, max_output_size=max(size, 1))


def _unpack_lz4(data: bytes, size: int) -> bytes:
    if not data and not size:
        return b""
    # One byte more shows that there is more.
    return bytes(lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size + 1))


_DECOMPRESSORS: dict[str, Callable[[bytes, int], bytes]] = {
    "zstd": _unpack_zstd,
    "lz4": _unpack_lz4,
    "": lambda data, _: data,
}
"""Each takes the compressed data and how large they were, and returns at most one byte more."""
