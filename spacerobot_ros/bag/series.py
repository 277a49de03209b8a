"""One topic of a bag as time series."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Sequence
from functools import cached_property
from operator import attrgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Nodetype
from rosbags.serde import SerdeError

from spacerobot_ros.bag.columns import DTYPES, Columns, Fields, columns, widened
from spacerobot_ros.bag.errors import RecordingError

_HEADER = (Nodetype.NAME, "std_msgs/msg/Header")


class TopicSeries:
    """The messages of one topic, by log time.

    Args:
        topic: its name.
        type_name: the type of its messages.
        time_ns: log times in nanoseconds, not decreasing, shape (N,).
        data: the N serialised messages.
        fields: definitions of the type and of those it uses.
        decode: makes a message of its serialised form.
    """

    def __init__(
        self,
        topic: str,
        type_name: str,
        time_ns: NDArray[np.int64],
        data: Sequence[bytes],
        fields: Fields,
        decode: Callable[[bytes], Any],
    ) -> None:
        self.topic = topic
        self.type_name = type_name
        self.time_ns = time_ns
        self._data = data
        self._fields = fields
        self._decode = decode

    def __len__(self) -> int:
        return len(self._data)

    @cached_property
    def time(self) -> NDArray[np.float64]:
        """Log times in seconds, shape (N,)."""
        return np.asarray(self.time_ns / 1e9)

    @cached_property
    def stamp(self) -> NDArray[np.float64]:
        """Stamps of the headers in seconds, shape (N,); the log times where messages have none."""
        return np.asarray(self.stamp_ns / 1e9)

    @cached_property
    def stamp_ns(self) -> NDArray[np.int64]:
        """The same in nanoseconds."""
        if not self.stamped:
            return self.time_ns
        seconds, nanoseconds = self.field("header.stamp.sec"), self.field("header.stamp.nanosec")
        return np.asarray(seconds, np.int64) * 10**9 + np.asarray(nanoseconds, np.int64)

    @property
    def stamped(self) -> bool:
        """Whether the messages have a header."""
        return dict(self._fields[self.type_name][1]).get("header") == _HEADER

    def field(self, path: str) -> Any:
        """Give one field of all messages.

        Args:
            path: the way to it, such as `pose.pose.position.x`. It may lead through a list of
                messages, as `points.positions` does.

        Returns:
            An array of shape (N,) for a number, of shape (N, k) for k numbers in each message, with
            whole numbers as 64-bit integers and others as float64. A list of N of what the messages
            hold for everything else: strings, lists, messages, arrays that differ in length.

        Raises:
            RecordingError: there is no such field, or a message is damaged.
        """
        dtype, is_array, in_list = self._resolve(path)
        if self._columns is not None and path in self._columns.paths:
            return self._columns[path]
        messages = self._messages
        if in_list:
            return [_values(message, path.split(".")) for message in messages]
        values = list(map(attrgetter(path), messages))
        if dtype is None or (is_array and len(set(map(len, values))) > 1):
            return values
        if is_array and not values:
            return np.empty((0, 0), dtype)
        return np.array(values, dtype)

    def messages(self) -> Iterator[tuple[int, Any]]:
        """Go through the messages, without keeping them.

        Yields:
            Log time in nanoseconds, message.

        Raises:
            RecordingError: a message is damaged.
        """
        for time_ns, data in zip(self.time_ns.tolist(), self._data, strict=True):
            yield time_ns, self._decoded(data)

    @cached_property
    def _messages(self) -> list[Any]:
        return [self._decoded(data) for data in self._data]

    @cached_property
    def _columns(self) -> Columns | None:
        return columns(self._data, self.type_name, self._fields)

    def _decoded(self, data: bytes) -> Any:
        try:
            return self._decode(data)
        except (SerdeError, ValueError, IndexError, struct.error) as error:
            raise RecordingError(
                f"A message on {self.topic} is no {self.type_name}: {error}."
            ) from error

    def _resolve(self, path: str) -> tuple[np.dtype[Any] | None, bool, bool]:
        """Follow a path: type of its numbers if any, whether an array, whether inside of a list."""
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
        return None if dtype is None else widened(dtype), is_array, in_list


def _values(value: Any, path: Sequence[str]) -> Any:
    for depth, name in enumerate(path):
        if isinstance(value, list):
            return [_values(element, path[depth:]) for element in value]
        value = getattr(value, name)
    return value
