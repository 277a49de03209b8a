"""Serialised messages made without rclpy: one by one, or many of one layout from a table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Nodetype

from spacerobot_ros.bag.definitions import MessageTypes
from spacerobot_ros.bag.rosbag2 import message_definition
from spacerobot_ros.bag.series import places
from spacerobot_ros.times import SECOND

_NUMBERS = ("float32", "float64", "int8", "int16", "int32", "int64", "uint8", "uint16", "uint32",
            "uint64")  # fmt: skip


class MessageMaker:
    """Makes messages of the types that are installed, as ROS serialises them."""

    def __init__(self) -> None:
        self._types = MessageTypes()

    def blank(self, type_name: str) -> Any:
        """Return a message whose numbers are zero, whose texts and lists are empty.

        Raises
        ------
        RecordingError
            The type is not installed.
        """
        if type_name not in self._types.fields:
            self._types.decoder(type_name, message_definition(type_name).encode())
        return self._blank(type_name)

    def serialised(self, message: Any) -> bytes:
        """Return the bytes of a message."""
        return bytes(self._types.serialise(message))

    def stamped(
        self, message: Any, stamps_ns: NDArray[np.int64], columns: Mapping[str, NDArray[np.float64]]
    ) -> list[bytes]:
        """Return copies of a message with other numbers.

        Parameters
        ----------
        message
            What all have in common; every list has its final length.
        stamps_ns
            (N,) stamps of the headers, or of a clock, ns; a message without either has none.
        columns
            Numbers (N, size) by the path at which they begin.
        """
        prototype = self.serialised(message)
        at = places(prototype, message.__msgtype__, self._types.fields)
        table = np.tile(np.frombuffer(prototype, np.uint8), (len(stamps_ns), 1))
        clock = np.stack([stamps_ns // SECOND, stamps_ns % SECOND], axis=1).astype("<u4")
        for path in ("header.stamp.sec", "clock.sec"):
            if path in at:
                table[:, at[path].start : at[path].start + 8] = clock.view(np.uint8)
        for path, values in columns.items():
            data = np.ascontiguousarray(values, dtype="<f8").view(np.uint8)
            first = at[path].start
            table[:, first : first + data.shape[1]] = data
        return [row.tobytes() for row in table]

    def made(self, type_name: str, **values: Any) -> Any:
        """Return a message with some fields set."""
        message = self.blank(type_name)
        for name, value in values.items():
            setattr(message, name, value)
        return message

    def _blank(self, type_name: str) -> Any:
        kind = self._types.kind(type_name)
        fields: Sequence[tuple[str, Any]] = self._types.fields[type_name][1]
        return kind(**{name: self._value(node) for name, node in fields})

    def _value(self, node: Any) -> Any:
        kind, detail = node
        if kind == Nodetype.NAME:
            return self._blank(detail)
        if kind == Nodetype.BASE:
            base = detail[0]
            return "" if base == "string" else False if base == "bool" else 0
        (inner, name), count = detail
        if inner == Nodetype.BASE and name[0] in _NUMBERS:
            return np.zeros(count if kind == Nodetype.ARRAY else 0, dtype=name[0])
        return [self._value((inner, name)) for _ in range(count if kind == Nodetype.ARRAY else 0)]
