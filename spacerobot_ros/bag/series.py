"""One topic in a bag as time series."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator, KeysView, Sequence
from copy import copy
from dataclasses import dataclass
from functools import cached_property
from operator import attrgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Nodetype
from rosbags.serde import SerdeError

from spacerobot_ros.errors import RecordingError
from spacerobot_ros.messages.definitions import DTYPES, LITTLE_ENDIAN, Layout, MessageType
from spacerobot_ros.times import SECOND

JOINT_STATE = "sensor_msgs/msg/JointState"
_BY_JOINT = ("name", "position", "velocity", "effort")
_MAX_JOINTS = 50
"""Largest number of joint names on a topic, relative to the size of its longest message."""

_HEADER = (Nodetype.NAME, "std_msgs/msg/Header")

_DECODING_ERRORS = (SerdeError, ValueError, IndexError, OverflowError, TypeError, struct.error)


class TopicSeries:
    """The messages on one topic in log time order; ``bag[topic]`` returns it.

    Attributes
    ----------
    topic, type_name
        Topic name and message type.
    time_ns
        Non-decreasing log times in nanoseconds, shape (N,), read-only.
    data
        Serialised messages.
    """

    def __init__(
        self,
        topic: str,
        kind: MessageType,
        time_ns: NDArray[np.int64],
        data: Sequence[bytes],
        max_decoded_bytes: float = math.inf,
    ) -> None:
        self.topic = topic
        self.type_name = kind.name
        self.time_ns = time_ns
        # An in-place change would affect every reader of the array.
        self.time_ns.flags.writeable = False
        self.data = data
        self._kind, self._fields = kind, kind.fields
        self._max_decoded_bytes = max_decoded_bytes

    def __len__(self) -> int:
        return len(self.data)

    def __repr__(self) -> str:
        span = f", {self.time[0]:.6g} to {self.time[-1]:.6g} s" if len(self) else ""
        return (
            f"<{self.topic}: {len(self)} {self.type_name}{span}; fields: {', '.join(self.paths)}>"
        )

    @property
    def paths(self) -> list[str]:
        """Field paths, for :meth:`field`; a field that is a list of messages has one path."""
        return list(self._leaf_paths(self.type_name, ""))

    def _leaf_paths(self, type_name: str, prefix: str) -> Iterator[str]:
        for name, (kind, detail) in self._fields[type_name][1]:
            if kind == Nodetype.NAME:
                yield from self._leaf_paths(detail, f"{prefix}{name}.")
            else:
                yield prefix + name

    def element_type(self, path: str) -> str:
        """Return the type of a message field or of the messages in a list; empty for other fields.

        Raises
        ------
        RecordingError
            There is no such field.
        """
        return self._resolve_path(path)[3] or ""

    @property
    def time(self) -> NDArray[np.float64]:
        """Log times in seconds, shape (N,), a copy."""
        return np.asarray(self.time_ns / SECOND)

    @property
    def stamp(self) -> NDArray[np.float64]:
        """Header stamps in seconds (N,), a copy; log times if messages have no header."""
        return np.asarray(self.stamp_ns / SECOND)

    @cached_property
    def stamp_ns(self) -> NDArray[np.int64]:
        """Header stamps in nanoseconds (N,), read-only; log times if messages have no header."""
        if not self.stamped:
            return self.time_ns
        seconds, nanoseconds = self.field("header.stamp.sec"), self.field("header.stamp.nanosec")
        stamps = np.asarray(seconds, np.int64) * SECOND + np.asarray(nanoseconds, np.int64)
        stamps.flags.writeable = False
        return np.asarray(stamps)

    @property
    def stamped(self) -> bool:
        """Whether the messages have a header."""
        return dict(self._fields[self.type_name][1]).get("header") == _HEADER

    def field(self, path: str) -> Any:
        """Return one field of all messages.

        Parameters
        ----------
        path
            Field path, such as ``pose.pose.position.x``. The path may lead through a list of
            messages, as ``points.positions`` does.

        Returns
        -------
        An array of shape (N,) for a number, or (N, k) for k numbers per message; integers are
        64-bit, other numbers float64. A list of N values for everything else: strings, lists,
        messages, arrays of varying length. Joint state arrays and names are in :attr:`joint_names`
        order; joints missing from a message are nan.

        Raises
        ------
        RecordingError
            There is no such field, or a message is damaged.
        """
        dtype, is_array, in_list, type_name = self._resolve_path(path)
        if path in _BY_JOINT and self.joint_names and not self._names_are_constant:
            return self._values_by_joint(path)
        if self._columns is not None and path in self._columns.paths:
            try:
                return self._columns[path]
            except UnicodeDecodeError as error:
                raise self._damage_error(error) from error
        # Callers receive copies, because they may change the arrays.
        fresh = in_list or type_name is not None
        messages = [m for _, m in self.messages()] if fresh else self._messages
        if in_list:
            return [_values_in_lists(message, path.split(".")) for message in messages]
        values = list(map(attrgetter(path), messages))
        if dtype is None or (is_array and len(set(map(len, values))) > 1):
            return [copy(value) for value in values] if is_array and not fresh else values
        if is_array and not values:
            return np.empty((0, 0), dtype)
        return np.array(values, dtype)

    @cached_property
    def joint_names(self) -> list[str]:
        """Joint or thruster names in joint states, in order of first appearance.

        Positions, velocities and efforts have one column per name. Empty for other message types,
        or if names are missing or repeated.
        """
        if self.type_name != JOINT_STATE or not len(self):
            return []
        if self._names_are_constant:
            named = [self._decode_message(self.data[0]).name]
        else:
            named = [message.name for message in self._messages]
        joints = list(dict.fromkeys(name for names in named for name in names))
        repeated = any(len(set(names)) < len(names) for names in named)
        return [] if repeated or len(joints) > _MAX_JOINTS * max(map(len, named)) else joints

    @cached_property
    def _names_are_constant(self) -> bool:
        return self._columns is not None and self._columns.constant("name")

    def of_joints(self, path: str, names: Sequence[str]) -> NDArray[np.float64]:
        """Return a joint state array of shape (N, n), with one column per joint; nan if a joint is
        missing.

        ``path`` is ``position``, ``velocity`` or ``effort``, and ``names`` are n joint names.
        """
        found = _field_matrix(self.field(path), len(self.joint_names))
        places = {name: k for k, name in enumerate(self.joint_names)}
        made = np.full((len(self), len(names)), np.nan)
        for k, name in enumerate(names):
            if name in places:
                made[:, k] = found[:, places[name]]
        return made

    def _values_by_joint(self, path: str) -> Any:
        """Return a joint state array, or the names, if the joint names vary between messages."""
        if path == "name":
            return [list(self.joint_names) for _ in self.data]
        places = {name: k for k, name in enumerate(self.joint_names)}
        given = [getattr(message, path) for message in self._messages]
        if not any(map(len, given)):
            return np.empty((len(self), 0))
        made = np.full((len(self), len(places)), np.nan)
        for row, message, values in zip(made, self._messages, given, strict=True):
            if len(values) == len(message.name):
                row[[places[name] for name in message.name]] = values
        return made

    def table(self, fields: Sequence[str], width: int | None = None) -> NDArray[np.float64]:
        """Return numeric fields of all messages as a matrix with one row per message.

        Parameters
        ----------
        fields
            Paths as in :meth:`field`, all of scalars or all of arrays.
        width
            Number of columns, the same for all fields; by default one per field.

        Returns
        -------
        Shape (N, width). If a field has a different number of values in a message, the columns of
        the field are nan in the row of that message.

        Raises
        ------
        RecordingError
            There is no such field, or a message is damaged.
        """
        each = 1 if width is None else width // max(len(fields), 1)
        if not each:
            return np.empty((len(self), 0))
        return np.column_stack([_field_matrix(self.field(path), each) for path in fields])

    def messages(self) -> Iterator[tuple[int, Any]]:
        """Iterate over the messages without caching them.

        Yields
        ------
        Log time in nanoseconds, message.

        Raises
        ------
        RecordingError
            A message is damaged, or the messages are much larger than the bag's file.
        """
        size = sum(map(len, self.data))
        if size > self._max_decoded_bytes:
            raise RecordingError(
                f"The messages on {self.topic} total {size} bytes; the limit "
                f"for a bag of this size is {self._max_decoded_bytes:.0f} bytes."
            )
        for time_ns, data in zip(self.time_ns.tolist(), self.data, strict=True):
            yield time_ns, self._decode_message(data)

    @cached_property
    def _messages(self) -> list[Any]:
        return [message for _, message in self.messages()]

    @cached_property
    def _columns(self) -> Columns | None:
        return read_columns(self.data, self._kind)

    def _decode_message(self, data: bytes) -> Any:
        try:
            return self._kind.decode(data)
        except _DECODING_ERRORS as error:
            raise self._damage_error(error) from error

    def _damage_error(self, error: Exception) -> RecordingError:
        reason = str(error) or type(error).__name__
        return RecordingError(f"A message on {self.topic} is not a {self.type_name}: {reason}.")

    def _resolve_path(self, path: str) -> tuple[np.dtype[Any] | None, bool, bool, str | None]:
        """Resolve a field's path: type of its numbers if any, whether it is an array, whether it is
        inside a list, type of its messages if any.
        """
        type_name: str | None = self.type_name
        dtype, is_array, in_list = None, False, False
        for part in path.split("."):
            fields = dict(self._fields[type_name][1]) if type_name is not None else {}
            if part not in fields:
                known = f"{type_name} has {', '.join(fields)}" if fields else "it goes too far"
                raise RecordingError(
                    f"Messages on {self.topic} ({self.type_name}) have no field {path!r}: {known}."
                )
            in_list |= is_array
            kind, detail = fields[part]
            is_array = kind in (Nodetype.ARRAY, Nodetype.SEQUENCE)
            if is_array:
                kind, detail = detail[0]
            type_name = detail if kind == Nodetype.NAME else None
            dtype = DTYPES.get(detail[0]) if kind == Nodetype.BASE else None
        return None if dtype is None else column_dtype(dtype), is_array, in_list, type_name


def _field_matrix(values: Any, width: int) -> NDArray[np.float64]:
    """Return a field's values (N, width); nan for messages with a different number of values."""
    if isinstance(values, np.ndarray) and values.size == len(values) * width:
        return np.asarray(values, dtype=float).reshape(len(values), width)
    rows = [np.asarray(value, dtype=float).reshape(-1) for value in values]
    return np.array([row if row.size == width else np.full(width, np.nan) for row in rows])


def _values_in_lists(value: Any, path: Sequence[str]) -> Any:
    for depth, name in enumerate(path):
        if isinstance(value, list):
            return [_values_in_lists(element, path[depth:]) for element in value]
        value = getattr(value, name)
    return value


# -- columns --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Columns:
    """Fields with the same position in all messages of a list, as arrays with one entry per
    message.

    The values of a field are a slice of one byte matrix; reading them is about a hundred times
    faster than decoding each message.

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
