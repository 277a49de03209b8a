"""Fields of many serialised messages at once, where all of them have the same layout.

Most topics repeat one layout: the same frame names, the same number of joints. There a field lies
at the same place in every message, and a whole column of it is one slice of a matrix of bytes, some
hundred times faster than decoding every message to pick one number from each.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Nodetype

Fields: TypeAlias = dict[str, tuple[Any, list[tuple[str, Any]]]]
"""Type name -> constants and fields, as `rosbags` parses a definition."""

DTYPES = {
    "bool": np.dtype("?"),
    "byte": np.dtype("u1"),
    "char": np.dtype("u1"),
    "int8": np.dtype("i1"),
    "uint8": np.dtype("u1"),
    "int16": np.dtype("<i2"),
    "uint16": np.dtype("<u2"),
    "int32": np.dtype("<i4"),
    "uint32": np.dtype("<u4"),
    "int64": np.dtype("<i8"),
    "uint64": np.dtype("<u8"),
    "float32": np.dtype("<f4"),
    "float64": np.dtype("<f8"),
}
"""The numbers of a message as they are serialised."""

_HEADER_SIZE = 4
_LITTLE_ENDIAN_CDR = b"\x00\x01"


def widened(dtype: np.dtype[Any]) -> np.dtype[Any]:
    """Give the type in which a column of `dtype` is handed out: one that does not soon overflow."""
    if dtype.kind == "f":
        return np.dtype(np.float64)
    if dtype.kind in "iu" and dtype.itemsize < 8:
        return np.dtype(np.int64)
    return dtype.newbyteorder("=")


@dataclass(frozen=True)
class _Leaf:
    """Where a field lies in every message; no `dtype` for a string, shape () for one number."""

    offset: int
    size: int
    dtype: np.dtype[Any] | None
    shape: tuple[int, ...]


class Columns:
    """The fields that lie at a fixed place in all of some messages."""

    def __init__(self, matrix: NDArray[np.uint8], leaves: dict[str, _Leaf]) -> None:
        self._matrix = matrix
        self._leaves = leaves

    @property
    def paths(self) -> Collection[str]:
        """The fields, such as `pose.pose.position.x`."""
        return self._leaves.keys()

    def __getitem__(self, path: str) -> NDArray[Any] | list[str]:
        leaf = self._leaves[path]
        rows = np.ascontiguousarray(self._matrix[:, leaf.offset : leaf.offset + leaf.size])
        if leaf.dtype is None:
            return [row.tobytes().decode() for row in rows]
        column = rows.reshape(-1).view(leaf.dtype).reshape(len(rows), *leaf.shape)
        return column.astype(widened(leaf.dtype))


def columns(messages: Sequence[bytes], type_name: str, fields: Fields) -> Columns | None:
    """Find the fields that lie at the same place in every message.

    Args:
        messages: serialised messages of one type (CDR with its header).
        type_name: such as `nav_msgs/msg/Odometry`.
        fields: definitions of that type and of those it uses.

    Returns:
        All fields outside of lists of messages and of strings; None if the layouts differ.
    """
    if not messages or len(set(map(len, messages))) != 1:
        return None
    layout = _Layout(messages[0], fields)
    try:
        layout.walk(type_name, "")
    except (IndexError, KeyError):
        return None
    matrix = np.frombuffer(b"".join(messages), np.uint8).reshape(len(messages), -1)
    if layout.position > matrix.shape[1] or messages[0][:2] != _LITTLE_ENDIAN_CDR:
        return None
    fixed = [slice(0, 2), *(slice(start, start + 4) for start in layout.lengths)]
    if any((matrix[:, part] != matrix[0, part]).any() for part in fixed):
        return None
    return Columns(matrix, layout.leaves)


class _Layout:
    """Walks through one message: where its fields and the lengths in it lie."""

    def __init__(self, message: bytes, fields: Fields) -> None:
        self.position = _HEADER_SIZE
        self.lengths: list[int] = []
        self.leaves: dict[str, _Leaf] = {}
        self._message = message
        self._fields = fields

    def walk(self, type_name: str, prefix: str | None) -> None:
        """Go through a message; `prefix` is its path and a dot, None inside of a list."""
        for name, (kind, detail) in self._fields[type_name][1]:
            path = None if prefix is None else prefix + name
            if kind == Nodetype.BASE:
                self._value(detail[0], path)
            elif kind == Nodetype.NAME:
                self.walk(detail, None if path is None else f"{path}.")
            else:
                element, count = detail
                self._elements(
                    element, self._length() if kind == Nodetype.SEQUENCE else count, path
                )

    def _elements(self, element: tuple[Any, Any], count: int, path: str | None) -> None:
        kind, detail = element
        if kind == Nodetype.BASE and detail[0] != "string":
            self._numbers(DTYPES[detail[0]], path, (count,))
            return
        for _ in range(count):
            if kind == Nodetype.NAME:
                self.walk(detail, None)
            else:
                self._value(detail[0], None)

    def _value(self, base: str, path: str | None) -> None:
        if base != "string":
            self._numbers(DTYPES[base], path, ())
            return
        length = self._length()
        if path is not None:
            # The serialised string ends with a zero.
            self.leaves[path] = _Leaf(self.position, max(length - 1, 0), None, ())
        self.position += length

    def _numbers(self, dtype: np.dtype[Any], path: str | None, shape: tuple[int, ...]) -> None:
        size = dtype.itemsize * int(np.prod(shape))
        if size:
            self._align(dtype.itemsize)
        if path is not None:
            self.leaves[path] = _Leaf(self.position, size, dtype, shape)
        self.position += size

    def _length(self) -> int:
        self._align(4)
        self.lengths.append(self.position)
        word = self._message[self.position : self.position + 4]
        if len(word) < 4:
            raise IndexError("the message ends inside of a length")
        self.position += 4
        return int.from_bytes(word, "little")

    def _align(self, size: int) -> None:
        # Counted from the end of the header.
        self.position += -(self.position - _HEADER_SIZE) % size
