"""Field positions in serialised messages: little-endian CDR, as exchanged by ROS 2.

On most topics, all messages have the same layout: the frame names and the number of joints are
constant. A field then has the same position in every message and can be read or overwritten there.
The values of a field in many messages are a slice of one byte matrix; reading them is about a
hundred times faster than decoding each message.
"""

from __future__ import annotations

import math
import struct
from collections.abc import KeysView, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Nodetype

from spacerobot_ros.messages.definitions import DTYPES, MessageType, installed_type
from spacerobot_ros.times import SECOND

ENCAPSULATION = 4
"""Length of the CDR header, bytes; alignment is relative to the end of the header."""

LITTLE_ENDIAN = b"\x00\x01"
"""First two bytes of a little-endian CDR message."""

_TIME_TYPES = ("builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration")


@dataclass(frozen=True)
class Leaf:
    """Position of a number, a numeric array or a string in a message.

    Attributes
    ----------
    offset, size
        First byte and number of bytes; for a string, excluding the terminating zero.
    dtype
        Type of the numbers; None for a string.
    shape
        ``()`` for one number or string, ``(k,)`` for an array.
    """

    offset: int
    size: int
    dtype: np.dtype[Any] | None
    shape: tuple[int, ...]


class Layout:
    """Field positions in one serialised message.

    Another message of this type has the same layout if its size and its ``lengths`` bytes are
    identical, and the same strings if its ``fixed`` bytes are identical.

    Parameters
    ----------
    message
        The serialised message, little-endian.
    kind
        Type of the message.
    elements
        Whether to include the fields inside lists, with paths such as
        ``markers[2].pose.position.x``.

    Attributes
    ----------
    leaves
        Fields by path, such as ``pose.pose.position.x``.
    counts
        Number of strings or messages in each list.
    texts
        Byte span of each list of strings.
    lengths
        First bytes of the length fields (uint32) of strings and lists.
    fixed
        Byte spans of all length fields and strings, in message order.
    end
        First byte after the last field.

    Raises
    ------
    IndexError
        The message ends before its last field.
    """

    def __init__(
        self, message: bytes | bytearray, kind: MessageType, *, elements: bool = False
    ) -> None:
        self.leaves: dict[str, Leaf] = {}
        self.counts: dict[str, int] = {}
        self.texts: dict[str, slice] = {}
        self.lengths: list[int] = []
        self.fixed: list[tuple[int, int]] = []
        self.end = ENCAPSULATION
        self._message, self._elements = message, elements
        self._fields = kind.fields
        self._walk(kind.name, "")

    def _walk(self, type_name: str, prefix: str | None) -> None:
        """Add the fields of a type below ``prefix``; None if the fields get no paths."""
        for name, node in self._fields[type_name][1]:
            self._add(node, None if prefix is None else prefix + name)

    def _add(self, node: Any, path: str | None) -> None:
        kind, detail = node
        if kind == Nodetype.NAME:
            self._walk(detail, None if path is None else f"{path}.")
        elif kind != Nodetype.BASE:
            element, count = detail
            self._add_list(
                element, self._read_length() if kind == Nodetype.SEQUENCE else count, path
            )
        elif detail[0] == "string":
            self._add_string(path)
        else:
            self._add_numbers(DTYPES[detail[0]], path, ())

    def _add_list(self, element: tuple[Any, Any], count: int, path: str | None) -> None:
        kind, detail = element
        if kind == Nodetype.BASE and detail[0] != "string":
            self._add_numbers(DTYPES[detail[0]], path, (count,))
            return
        begin, named = self.end, self._elements and path is not None
        for i in range(count):
            self._add(element, f"{path}[{i}]" if named else None)
        if path is not None:
            self.counts[path] = count
            if kind == Nodetype.BASE:
                self.texts[path] = slice(begin, self.end)

    def _add_string(self, path: str | None) -> None:
        length = self._read_length()
        self.fixed.append((self.end, self.end + length))
        begin = self.end
        self._advance(length)
        if path is not None:
            # A serialised string ends with a zero; without it, middlewares use all bytes.
            zero = length > 0 and self._message[self.end - 1] == 0
            self.leaves[path] = Leaf(begin, length - zero, None, ())

    def _add_numbers(self, dtype: np.dtype[Any], path: str | None, shape: tuple[int, ...]) -> None:
        size = dtype.itemsize * math.prod(shape)
        if size:
            self._align(dtype.itemsize)
        if path is not None:
            self.leaves[path] = Leaf(self.end, size, dtype, shape)
        self._advance(size)

    def _advance(self, size: int) -> None:
        self.end += size
        if self.end > len(self._message):
            # Without this check a false count of 4e9 messages would be accepted.
            raise IndexError("the message ends before its last field")

    def _read_length(self) -> int:
        self._align(4)
        word = self._message[self.end : self.end + 4]
        if len(word) < 4:
            raise IndexError("the message ends inside a length field")
        self.lengths.append(self.end)
        self.fixed.append((self.end, self.end + 4))
        self.end += 4
        return int.from_bytes(word, "little")

    def _align(self, size: int) -> None:
        self.end += -(self.end - ENCAPSULATION) % size


# -- making messages --------------------------------------------------------------------------


def encode(type_name: str, values: Mapping[str, Any] | None = None) -> bytes:
    """Return a message as ROS 2 serialises it.

    Parameters
    ----------
    type_name
        Such as ``sensor_msgs/msg/JointState``.
    values
        Fields by name: numbers, strings, arrays, mappings for messages, and lists of these; a time
        or duration may also be given in integer nanoseconds, and a ``byte`` is signed. All other
        fields are zero or empty.

    Raises
    ------
    KeyError
        The type has no such field.
    ValueError
        An array has the wrong shape.
    RecordingError
        The type is not installed.
    """
    kind = installed_type(type_name)
    return kind.encode(_message(kind, type_name, values or {}))


def _message(kind: MessageType, type_name: str, values: Any) -> Any:
    if type_name in _TIME_TYPES and isinstance(values, int):
        values = dict(zip(("sec", "nanosec"), divmod(values, SECOND), strict=True))
    fields = dict(kind.fields[type_name][1])
    unknown = values.keys() - fields.keys()
    if unknown:
        raise KeyError(f"{type_name} has no field {min(unknown)}")
    given = {name: _field_value(kind, node, values.get(name)) for name, node in fields.items()}
    return kind.classes[type_name](**given)


def _field_value(kind: MessageType, node: Any, value: Any) -> Any:
    node_type, detail = node
    if node_type == Nodetype.NAME:
        return _message(kind, detail, {} if value is None else value)
    if node_type == Nodetype.BASE:
        zero = "" if detail[0] == "string" else 0
        return zero if value is None else value
    element, count = detail
    if node_type == Nodetype.SEQUENCE:
        count = 0 if value is None else len(value)
    if element[0] == Nodetype.NAME or element[1][0] == "string":
        elements = [None] * count if value is None else value
        return [_field_value(kind, element, each) for each in elements]
    given = np.zeros(count) if value is None else value
    numbers = np.asarray(given, DTYPES[element[1][0]], order="C")
    if numbers.shape != (count,):
        raise ValueError(f"{count} numbers are required; the shape is {numbers.shape}")
    return numbers


def encode_list(
    type_name: str,
    values: Mapping[str, Any],
    name: str,
    element: Mapping[str, Any],
    columns: Mapping[str, NDArray[Any]],
) -> bytes:
    """Return a message whose last field is a list of many messages with one layout.

    Parameters
    ----------
    type_name, values
        Values of the message without the list, as in :func:`encode`.
    name
        Field of the list.
    element
        Values common to all elements; arrays have their final lengths.
    columns
        Numbers (N, size), one row per element, keyed by the path of the first field in an element.
    """
    count = len(next(iter(columns.values())))
    if not count:
        return encode(type_name, values)
    # Three elements show the layout: only the padding of the first may differ.
    few = [encode(type_name, {**values, name: [element] * k}) for k in range(4)]
    none, _, second, _ = map(len, few)
    leaves = Layout(few[3], installed_type(type_name), elements=True).leaves
    head = bytearray(few[1])
    struct.pack_into("<I", head, none - 4, count)
    rows = np.tile(np.frombuffer(few[3][second:], np.uint8), (count - 1, 1))
    for path, column in columns.items():
        data = np.ascontiguousarray(column).view(np.uint8).reshape(count, -1)
        size = data.shape[1]
        begin = leaves[f"{name}[0].{path}"].offset
        head[begin : begin + size] = data[0].tobytes()
        begin = leaves[f"{name}[2].{path}"].offset - second
        rows[:, begin : begin + size] = data[1:]
    return bytes(head) + rows.tobytes()


def seconds_and_nanoseconds(times_ns: NDArray[np.int64]) -> NDArray[np.uint32]:
    """Convert times (N,) in ns to stamps of seconds and nanoseconds (N, 2)."""
    return np.stack([times_ns // SECOND, times_ns % SECOND], axis=1).astype("<u4")


# -- reading columns --------------------------------------------------------------------------


@dataclass(frozen=True)
class Columns:
    """Fields with the same position in all messages of a list, as arrays with one entry per
    message.

    Attributes
    ----------
    matrix
        The messages, one per row.
    layout
        Layout of each message.
    """

    matrix: NDArray[np.uint8]
    layout: Layout

    @property
    def paths(self) -> KeysView[str]:
        """The fields, such as ``pose.pose.position.x``."""
        return self.layout.leaves.keys()

    def constant(self, path: str) -> bool:
        """Whether a list of strings is identical in all messages."""
        part = self.layout.texts.get(path)
        return part is not None and bool((self.matrix[:, part] == self.matrix[0, part]).all())

    def __getitem__(self, path: str) -> NDArray[Any] | list[str]:
        leaf = self.layout.leaves[path]
        rows = np.ascontiguousarray(self.matrix[:, leaf.offset : leaf.offset + leaf.size])
        if leaf.dtype is None:
            return [row.tobytes().decode() for row in rows]
        column = rows.reshape(-1).view(leaf.dtype).reshape(len(rows), *leaf.shape)
        return column.astype(column_dtype(leaf.dtype))


def column_dtype(dtype: np.dtype[Any]) -> np.dtype[Any]:
    """Return the wider number type in which a column of ``dtype`` is stored."""
    if dtype.kind == "f":
        return np.dtype(np.float64)
    if dtype.kind in "iu" and dtype.itemsize < 8:
        return np.dtype(np.int64)
    return dtype.newbyteorder("=")


def read_columns(messages: Sequence[bytes], kind: MessageType) -> Columns | None:
    """Return the fields that have the same position in every message of one type.

    Fields in lists of messages or strings are omitted. None if the layouts differ.
    """
    if not messages or len(set(map(len, messages))) != 1:
        return None
    try:
        layout = Layout(messages[0], kind)
    except (IndexError, KeyError):
        return None
    if messages[0][:2] != LITTLE_ENDIAN:
        return None
    matrix = np.frombuffer(b"".join(messages), np.uint8).reshape(len(messages), -1)
    fixed = [slice(0, 2), *(slice(start, start + 4) for start in layout.lengths)]
    if any((matrix[:, part] != matrix[0, part]).any() for part in fixed):
        return None
    return Columns(matrix, layout)
