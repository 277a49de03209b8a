"""Serialised messages patched in place: what makes thousands of ticks a second possible.

rclpy spends most of a tick turning Python objects into bytes and back. A state message has the
same layout every tick, so it is serialised once and its numbers are written straight into the
bytes; a command is read the same way. Where a message does not have the expected layout (another
client, other strings) the reader deserialises it the ordinary way and learns the new layout.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Generic, Literal, TypeVar

import numpy as np
import numpy.typing as npt
from rclpy.publisher import Publisher
from rclpy.serialization import deserialize_message, serialize_message
from rosidl_parser.definition import (
    AbstractGenericString,
    AbstractSequence,
    Array,
    BasicType,
    NamespacedType,
)
from sensor_msgs.msg import JointState

from spacerobot_ros.errors import CommandError
from spacerobot_ros.model.description import Array as FloatArray
from spacerobot_ros.simulation.commands import joint_order, require_values
from spacerobot_ros.times import LATEST_NS, SECOND, read_stamp_ns

_ENCAPSULATION = 4
_BYTE_ORDER = 2
"""Bytes of the encapsulation that tell it."""

_LARGEST_ALIGNMENT = 8
_SIZES = {
    "boolean": 1, "octet": 1, "char": 1, "uint8": 1, "int8": 1, "uint16": 2, "int16": 2,
    "uint32": 4, "int32": 4, "float": 4, "uint64": 8, "int64": 8, "double": 8,
}  # fmt: skip
_TIME_SIZE = 8
"""Bytes of a time."""

_LONGEST = 10_000
"""A message with a longer sequence is not taken apart: that of a million joints takes a minute."""

_ROOM = 4096
"""Bytes for the header of a message of joints, and for a writer that packs it differently."""

M = TypeVar("M")

Quantity = Literal["position", "velocity", "effort"]
"""The numbers of a JointState."""


class UnreadableError(CommandError):
    """Bytes that are no message of their type; the clause says of which."""


class _TooLongError(Exception):
    """A message has a sequence that is too long to be taken apart."""


@dataclass
class Layout:
    """Where the fields of one serialised message lie (little-endian plain CDR).

    ``offsets`` maps a field path such as ``pose.pose.position.x`` (or ``markers[2].pose``) to its
    first byte, ``lengths`` that of a sequence to its number of elements; ``fixed`` are the spans of
    strings and lengths: another message has the same layout when it has the same size and equal
    bytes there.
    """

    offsets: dict[str, int] = field(default_factory=dict)
    fixed: list[tuple[int, int]] = field(default_factory=list)
    lengths: dict[str, int] = field(default_factory=dict)
    end: int = _ENCAPSULATION

    @classmethod
    def of(cls, message: Any) -> Layout:
        """Compute the layout of a message with the strings and lengths that it has now.

        Raises
        ------
        _TooLongError
            A sequence has more than 10000 elements.
        """
        layout = cls()
        layout._message(message, "")
        return layout

    def _align(self, size: int) -> None:
        self.end += -(self.end - _ENCAPSULATION) % size

    def _length(self) -> None:
        self._align(4)
        self.fixed.append((self.end, self.end + 4))
        self.end += 4

    def _message(self, message: Any, prefix: str) -> None:
        for name, kind in zip(
            message.get_fields_and_field_types(), message.SLOT_TYPES, strict=True
        ):
            self._field(getattr(message, name), kind, f"{prefix}{name}")

    def _field(self, value: Any, kind: Any, path: str) -> None:
        if isinstance(kind, BasicType):
            size = _SIZES[kind.typename]
            self._align(size)
            self.offsets[path] = self.end
            self.end += size
        elif isinstance(kind, AbstractGenericString):
            self._length()
            text = len(value.encode()) + 1
            self.fixed.append((self.end, self.end + text))
            self.end += text
        elif isinstance(kind, NamespacedType):
            before = len(self.offsets)
            self._message(value, f"{path}.")
            if len(self.offsets) > before:
                self.offsets[path] = next(
                    offset for key, offset in self.offsets.items() if key.startswith(f"{path}.")
                )
        elif isinstance(kind, (AbstractSequence, Array)):
            if isinstance(kind, AbstractSequence):
                self._length()
                self.lengths[path] = self.end - 4
            if len(value) > _LONGEST:
                raise _TooLongError
            for index, element in enumerate(value):
                self._field(element, kind.value_type, f"{path}[{index}]")
            if len(value) and f"{path}[0]" in self.offsets:
                self.offsets[path] = self.offsets[f"{path}[0]"]
        else:
            raise TypeError(f"no layout for {path} of type {kind}")


class MessageTemplate:
    """A message serialised once, whose numbers are then written in place.

    Every sequence must already have its final length and every string its final text.
    """

    def __init__(self, prototype: Any) -> None:
        self._buffer = bytearray(serialize_message(prototype))
        self._layout = Layout.of(prototype)
        self._feeds: list[tuple[slice, memoryview]] = []
        self._times = [
            slice(offset, offset + _TIME_SIZE)
            for path, offset in self._layout.offsets.items()
            if path in ("header.stamp.sec", "clock.sec") or path.endswith(".header.stamp.sec")
        ]

    def floats(self, path: str, count: int) -> FloatArray:
        """Return a writable view of the ``count`` float64 values from ``path`` on."""
        return np.frombuffer(self._buffer, np.float64, count, self._layout.offsets[path])

    def feed(self, path: str, source: FloatArray) -> None:
        """Copy ``source``, a contiguous array that stays in place, to ``path`` in every message."""
        start = self._layout.offsets[path]
        self._feeds.append((slice(start, start + source.nbytes), source.data.cast("B")))

    def serialised(self, stamp: bytes) -> bytes:
        """Return the message as it stands, with ``stamp`` (:func:`stamp_bytes`) in every header."""
        buffer = self._buffer
        for place, source in self._feeds:
            buffer[place] = source
        for place in self._times:
            buffer[place] = stamp
        return bytes(buffer)


def raw_publish(publisher: Publisher) -> Callable[[bytes], None]:
    """Return the function that publishes serialised messages.

    ``publisher.publish`` does the same after taking its handle and looking at the type, which
    costs as much again as the publication; the handle lives as long as the publisher.
    """
    function: Callable[[bytes], None] = publisher.handle.publish_raw
    return function


class TemplateReader(Generic[M]):
    """Reads float arrays and the stamp of serialised messages that repeat one layout.

    Parameters
    ----------
    message_type
        The ROS message class.
    spans
        Returns, for a deserialised message, the paths to read and how many float64 follow each:
        ``{"position": 3}``. Called only when the layout changes.
    largest
        Messages of another layout that are longer are refused unread, bytes.
    """

    def __init__(
        self,
        message_type: type[M],
        spans: Callable[[M], dict[str, int]],
        largest: float = math.inf,
    ) -> None:
        self._type = message_type
        self._spans = spans
        self._largest = largest
        self._size = -1
        self._raw = bytes(2)  # Of no message.
        self._fixed: list[tuple[slice, bytes]] = []
        self._stretches: list[tuple[slice, bytes]] = []
        self._reads: dict[str, tuple[int, int]] = {}
        self._stamp = 0
        self.prototype: M | None = None
        """The message whose layout is in use, deserialised."""
        self.changes = 0
        """How often the layout has changed."""

    def accept(self, raw: bytes) -> None:
        """Make ``raw`` the message to read from.

        Raises
        ------
        UnreadableError
            The bytes are not a message of the type; the message before stays.
        """
        if raw is self._raw:
            return
        if len(raw) == self._size:
            # One writer repeats its padding too: a few whole stretches are compared first.
            for place, text in self._stretches:
                if raw[place] != text:
                    break
            else:
                self._raw = raw
                return
            if all(raw[place] == text for place, text in self._fixed):
                self._raw = raw
                self._remember_stretches(raw)
                return
        self._learn(raw)

    def floats(self, path: str) -> FloatArray:
        """Return a read-only view of the values at ``path``."""
        offset, count = self._reads[path]
        return np.frombuffer(self._raw, np.float64, count, offset)

    def place(self, path: str) -> slice:
        """Return where the bytes of the values at ``path`` are in messages of this layout."""
        offset, count = self._reads[path]
        return slice(offset, offset + 8 * count)

    def has(self, path: str) -> bool:
        """Whether the accepted message has values at ``path``."""
        return path in self._reads

    @property
    def stamp_ns(self) -> int:
        """Header stamp of the accepted message, ns."""
        return read_stamp_ns(self._raw, self._stamp)

    def _remember_stretches(self, raw: bytes) -> None:
        """Keep the fixed spans joined where only padding can lie between them."""
        stretches: list[slice] = []
        for place, _ in self._fixed:
            if stretches and place.start - stretches[-1].stop < _LARGEST_ALIGNMENT:
                place = slice(stretches.pop().start, place.stop)
            stretches.append(place)
        self._stretches = [(place, raw[place]) for place in stretches]

    def _learn(self, raw: bytes) -> None:
        if len(raw) > self._largest:
            raise UnreadableError(
                f"it has {len(raw)} bytes, of which at most {self._largest} can be meant"
            )
        try:
            message = deserialize_message(raw, self._type)
        except RuntimeError as error:
            raise UnreadableError(f"its bytes are no {self._type.__name__}") from error
        try:
            layout = Layout.of(message)
        except _TooLongError:
            self._take_whole(message)
            return
        own = bytes(serialize_message(message))
        fixed = [(0, _BYTE_ORDER), *layout.fixed]
        # Another byte order, or strings that are not what they were read as: not read in place.
        foreign = len(raw) < layout.end or any(raw[a:b] != own[a:b] for a, b in fixed)
        self._raw = raw = own if foreign else raw
        self.prototype = message
        self._size = -1 if foreign else len(raw)
        self._fixed = [(slice(a, b), raw[a:b]) for a, b in fixed]
        self._stamp = layout.offsets["header.stamp.sec"]
        self._reads = {
            path: (layout.offsets[path], count)
            for path, count in self._spans(message).items()
            if count
        }
        self._remember_stretches(raw)
        self.changes += 1

    def _take_whole(self, message: M) -> None:
        """Offer the message itself: without a layout no numbers are read in place."""
        header = bytes(serialize_message(message.header))  # type: ignore[attr-defined]
        self.prototype, self._raw, self._stamp = message, header, _ENCAPSULATION
        self._size, self._fixed, self._stretches, self._reads = -1, [], [], {}
        self.changes += 1


class JointReader:
    """Takes one quantity of JointState messages into the order of the model's joints.

    Joints that a message does not name are left out (zero).

    Parameters
    ----------
    joint_names
        The model's joints.
    quantities
        What to read; the first is required in every message.
    complete
        Whether every joint must be named, as in a measured state.
    """

    def __init__(
        self,
        joint_names: Sequence[str],
        quantities: Sequence[Quantity],
        *,
        complete: bool = False,
    ) -> None:
        self._complete, self._joints, self._quantities = complete, list(joint_names), quantities
        largest = math.inf
        if complete:
            # Of each joint a name with its length and three numbers.
            largest = _ROOM + 2 * sum(len(name.encode()) + 32 for name in joint_names)
        self._reader = TemplateReader(JointState, self._spans, largest)
        self._changes = 0
        self._problem = ""
        self._required: bytes | None = None
        """The last message that was accepted: the same bytes are often received again."""
        self._order: npt.NDArray[np.intp] | None = None
        self._copies: list[tuple[memoryview, slice]] = []
        self.values = {name: np.zeros(len(joint_names)) for name in quantities}

    def accept(self, raw: bytes) -> int:
        """Read a message into ``values`` and return its stamp in ns.

        Raises
        ------
        CommandError
            A joint is unknown or named twice, or a length is wrong; of a measured state, its
            stamp is beyond what that of an answer can carry.
        """
        self.require(raw)
        stamp = self._reader.stamp_ns
        if stamp > LATEST_NS and self._complete:
            raise UnreadableError(f"no answer can carry its stamp of {stamp / SECOND:.10g} s")
        for target, place in self._copies:
            target[:] = raw[place]
        if self._order is not None:
            for name, values in self.values.items():
                if self._reader.has(name):
                    values[self._order] = self._reader.floats(name)
        return stamp

    def require(self, raw: bytes) -> None:
        """Refuse a message that :meth:`accept` would refuse; ``values`` stay.

        Raises
        ------
        CommandError
            As :meth:`accept` does.
        """
        if raw is self._required:
            return
        self._required = None
        self._reader.accept(raw)
        if self._reader.changes != self._changes:
            self._changes = self._reader.changes
            self._check()
        if self._problem:
            raise CommandError(self._problem)
        self._required = raw

    @property
    def stamp_ns(self) -> int:
        """Stamp of the last message given to :meth:`accept`, refused or not, ns."""
        return self._reader.stamp_ns

    def _spans(self, message: JointState) -> dict[str, int]:
        return {name: len(getattr(message, name)) for name in self._quantities}

    def _check(self) -> None:
        """Check names and lengths, once for every layout."""
        message = self._reader.prototype
        assert message is not None
        names = list(message.name)
        self._problem, self._order, self._copies = "", None, []
        try:
            order = joint_order(self._joints, names, complete=self._complete)
            for i, quantity in enumerate(self._quantities):
                count = len(getattr(message, quantity))
                if count or i == 0:
                    require_values(names, quantity, count)
                if count and not self._reader.has(quantity):
                    raise CommandError(f"it has more than {_LONGEST} numbers")
        except CommandError as error:
            self._problem = str(error)
            return
        for values in self.values.values():
            values[:] = 0.0
        # Joints in the model's order, as the stack's own nodes send them, are copied as bytes.
        if names == self._joints:
            self._copies = [
                (values.data.cast("B"), self._reader.place(name))
                for name, values in self.values.items()
                if self._reader.has(name)
            ]
        else:
            self._order = order
