"""Message types, and messages as bytes: little-endian CDR, as exchanged by ROS 2.

Types are defined by installed packages and by schemas in bags.
``rosbags`` generates Python code for every decoded type, with one line per element of a message
array, and never terminates if a type contains itself. Definitions in bags are untrusted, so
names, lengths, nesting and the number of fields are limited.
"""

from __future__ import annotations

import json
import math
import re
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Nodetype

from spacerobot_ros.errors import RecordingError
from spacerobot_ros.resources import installed_share_directory
from spacerobot_ros.times import SECOND

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

Fields: TypeAlias = dict[str, tuple[Any, list[tuple[str, Any]]]]
"""Type name -> constants and fields, as ``rosbags`` parses a definition."""

# -- installed types --------------------------------------------------------------------------

_SHORT_TYPE_NAME = re.compile(
    r"([a-zA-Z]\w*)/(?:(msg|srv|action)/)?([a-zA-Z][a-zA-Z0-9]*)(\w*)", re.ASCII
)

# rosbag2's own expression for the type at the start of a field or constant: with a different one,
# the schema text could differ from the text written by `ros2 bag record`.
_FIELD_TYPE = re.compile(r"(?:^|\n)\s*([a-zA-Z0-9_/]+)(?:\[[^\]]*\])?\s+", re.ASCII)

_EVENT = """\
service_msgs/ServiceEventInfo info
{0}_Request[<=1] request
{0}_Response[<=1] response
"""
_PARTS: dict[str, tuple[str, int | str]] = {
    "_Goal": ("action", 0),
    "_Result": ("action", 1),
    "_Feedback": ("action", 2),
    "_FeedbackMessage": ("action", "unique_identifier_msgs/UUID goal_id\n{0}_Feedback feedback\n"),
    "_SendGoal_Request": ("action", "unique_identifier_msgs/UUID goal_id\n{0}_Goal goal\n"),
    "_SendGoal_Response": ("action", "bool accepted\nbuiltin_interfaces/Time stamp\n"),
    "_SendGoal_Event": ("action", _EVENT.format("{0}_SendGoal")),
    "_GetResult_Request": ("action", "unique_identifier_msgs/UUID goal_id\n"),
    "_GetResult_Response": ("action", "int8 status\n{0}_Result result\n"),
    "_GetResult_Event": ("action", _EVENT.format("{0}_GetResult")),
    "_Request": ("srv", 0),
    "_Response": ("srv", 1),
    "_Event": ("srv", _EVENT),
}
"""Messages that rosidl generates from a service or an action, by name suffix.

Each value is the suffix of the declaring file, and either the section in that file or
a template in which the service or action name replaces the braces. Names in interface files contain
no underscores.
"""

_SECTION_END = re.compile(r"^---[ \t]*\r?\n?", re.MULTILINE)

DTYPES = {
    **{name: np.dtype(name).newbyteorder("<") for name in ("bool", "float32", "float64")},
    **{f"int{bits}": np.dtype(f"<i{bits // 8}") for bits in (8, 16, 32, 64)},
    **{f"uint{bits}": np.dtype(f"<u{bits // 8}") for bits in (8, 16, 32, 64)},
    **dict.fromkeys(("byte", "char"), np.dtype("u1")),
}
"""Number types in serialised messages, by their names in message definitions."""

_PRIMITIVES = {"string", "wstring", *DTYPES}


@cache
def message_definition(type_name: str) -> str:
    """Return the full definition of a message type as rosbag2 writes it to a schema.

    The definition consists of the ``.msg`` file and one section per nested type (the ``ros2msg``
    encoding): a separator line, ``MSG: package/Type`` and the definition. Sections are in
    depth-first, alphabetical order. Definitions of ROS 2 Jazzy types that are not installed contain
    no comments.

    Raises
    ------
    RecordingError
        The name is not a message type, or a required package is neither installed nor in Jazzy.
    """
    name = _InterfaceName.of(type_name)
    try:
        return _with_dependencies(name, set())
    except RecordingError as error:
        return _jazzy_with(name, error).generate_msgdef(name.full, ros_version=2)[0]


def _jazzy_with(name: _InterfaceName, error: RecordingError) -> Typestore:
    """Return the types of ROS 2 Jazzy, which replace missing packages; raise ``error`` if the type
    is not among them."""
    from rosbags.typesys import Stores, get_typestore

    jazzy = get_typestore(Stores.ROS2_JAZZY)
    if name.full not in jazzy.fielddefs:
        raise error
    return jazzy


def _with_dependencies(name: _InterfaceName, seen: set[str]) -> str:
    text = name.text()
    types = {
        found if "/" in found else f"{name.package}/{found}"
        for found in _FIELD_TYPE.findall(text)
        if found not in _PRIMITIVES
    }
    parts = [text]
    for dependency in sorted(types):
        if dependency not in seen:
            seen.add(dependency)
            definition = _with_dependencies(_InterfaceName.of(dependency), seen)
            parts.append(f"\n{'=' * 80}\nMSG: {dependency}\n{definition}")
    return "".join(parts)


@cache
def type_hash(type_name: str) -> str:
    """Return the type hash by which ROS 2 distinguishes message type versions.

    The hash is ``RIHS01_`` followed by 64 hexadecimal digits; it is empty if the package was
    installed without type descriptions (``share/<package>/msg/<Type>.json``). Raises as
    :func:`message_definition` does.
    """
    name = _InterfaceName.of(type_name)
    try:
        description = name.file().with_suffix(".json")
    except RecordingError as error:
        return _jazzy_with(name, error).hash_rihs01(name.full)
    if not description.is_file():
        return ""
    hashes = json.loads(description.read_bytes())["type_hashes"]
    return next((str(h["hash_string"]) for h in hashes if h["type_name"] == name.full), "")


def message_module(type_name: str) -> tuple[str, str, str]:
    """Return the Python module of an installed message type, and two class names. The first class
    is the interface that the module exports. The second class is the message; the two differ for
    service and action components. RecordingError: the name is not a message type, or the package is
    not installed.
    """
    name = _InterfaceName.of(type_name)
    name.file()
    return f"{name.package}.{name.kind}", name.interface, name.whole


@dataclass(frozen=True)
class _InterfaceName:
    """The name of a message type: ``pkg/action/Move_Feedback`` is of the interface ``Move``."""

    package: str
    kind: str
    """``msg``, ``srv`` or ``action``: folder and suffix of the file that declares the message."""
    interface: str
    part: str

    @classmethod
    def of(cls, type_name: str) -> _InterfaceName:
        match = _SHORT_TYPE_NAME.fullmatch(type_name)
        package, given, interface, part = match.groups() if match else ("",) * 4
        kind = _PARTS[part][0] if part in _PARTS else "msg"
        if match is None or given not in (None, kind):
            raise RecordingError(
                f"{type_name!r} is not the name of a message type: write it as 'package/msg/Type'."
            )
        return cls(package, kind, interface if kind != "msg" else interface + part, part)

    @property
    def whole(self) -> str:
        """Message name without its package."""
        return self.interface + (self.part if self.kind != "msg" else "")

    @property
    def full(self) -> str:
        """Message name with its package and folder."""
        return f"{self.package}/{self.kind}/{self.whole}"

    def file(self) -> Path:
        # Packages from pip are below the environment's prefix and set no search path.
        share = installed_share_directory(self.package) or Path(sys.prefix, "share", self.package)
        if not share.is_dir():
            raise RecordingError(
                f"The message package {self.package} is neither on AMENT_PREFIX_PATH nor in "
                f"{share.parent}: install it, or source the workspace that contains it."
            )
        path = share / self.kind / f"{self.interface}.{self.kind}"
        if not path.is_file():
            raise RecordingError(
                f"The package {self.package} in {share} has no message {self.whole}: "
                "check the name, or install a version that has it."
            )
        return path

    def text(self) -> str:
        """Return the message definition without the definitions of its field types."""
        text = self.file().read_bytes().decode()
        if self.kind == "msg":
            return text
        _, section = _PARTS[self.part]
        if isinstance(section, str):
            return section.format(f"{self.package}/{self.interface}")
        return [*_SECTION_END.split(text), "", ""][section]


# -- parsed types -----------------------------------------------------------------------------

_TYPE_NAME = re.compile(r"[A-Za-z]\w*/(msg|srv|action)/[A-Za-z]\w*", re.ASCII)
_MAX_TEXT_BYTES = 262_144
_MAX_LINES = 5_000
_MAX_FIELDS = 1_000
"""Largest number of fields; in arrays of messages and strings, every element is counted."""

_MAX_NESTING = 32


class MessageType:
    """A message type, as defined by an installed package or by a schema in a bag.

    Parameters
    ----------
    name
        Such as ``nav_msgs/msg/Odometry``.
    text
        The full definition, as returned by :func:`message_definition`; it may be untrusted.
    store
        Store that already has code for some of the nested types; None: a new one.

    Attributes
    ----------
    fields
        Definitions of the type and of all nested types.

    Raises
    ------
    ValueError
        The definition cannot be parsed or exceeds a limit.
    """

    def __init__(self, name: str, text: bytes, store: Typestore | None = None) -> None:
        # The parser is slow to import, and tools that read no messages do not need it.
        from rosbags.typesys import get_types_from_msg

        self.name, self._given_store = name, store
        if not _TYPE_NAME.fullmatch(name):
            raise ValueError("a type name must have the form 'package/msg/Type'")
        if len(text) > _MAX_TEXT_BYTES or text.count(b"\n") > _MAX_LINES:
            raise ValueError(
                f"its definition is longer than {_MAX_TEXT_BYTES} bytes or {_MAX_LINES} lines, "
                "more than any message needs"
            )
        # The parser would rename service types, but leaves names in the form of messages unchanged.
        parsed_name = name.replace("/srv/", "/msg/")
        with _as_value_errors():
            types = get_types_from_msg(text.decode(), parsed_name)
            self.fields: Fields = {
                name if each == parsed_name else each: of for each, of in types.items()
            }
            _count_fields(self.fields, name, {})

    def decode(self, data: bytes) -> Any:
        """Return a message from its serialised form; any defect raises an exception."""
        # Not `Typestore.deserialize_cdr`: that one refuses what rclpy serialises with an empty
        # list of float64, which has some meaningless bytes at its end.
        store = self._store
        definition = store.get_msgdef(self.name)
        little = data[1] & 1
        decode = definition.deserialize_cdr_le if little else definition.deserialize_cdr_be
        return decode(data[4:], 0, definition.cls, store)[0]

    def encode(self, message: Any) -> bytes:
        """Return the serialised form of a message of this type."""
        return bytes(self._store.serialize_cdr(message, self.name, little_endian=True))

    @property
    def classes(self) -> dict[str, Any]:
        """Classes of the type and of all nested types, by name."""
        return self._store.types

    @cached_property
    def _store(self) -> Typestore:
        """Code that ``rosbags`` generates, which takes longer than parsing the definition."""
        store = self._given_store or _new_store()
        with _as_value_errors():
            store.register(self.fields)
            store.get_msgdef(self.name)
        return store


message_type = lru_cache(maxsize=64)(MessageType)
"""Return a :class:`MessageType`; its code is generated once and shared by all bags."""


@cache
def installed_type(type_name: str) -> MessageType:
    """Return a message type of an installed package. Raises as :func:`message_definition` does."""
    return MessageType(type_name, message_definition(type_name).encode(), _installed_types())


def _new_store() -> Typestore:
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.EMPTY)


_installed_types = cache(_new_store)
"""Return the store of all installed types, which have most nested types in common."""


@contextmanager
def _as_value_errors() -> Iterator[None]:
    """Convert exceptions: the parser raises any kind of error, depending on the definition."""
    try:
        yield
    except Exception as error:
        words = " ".join(str(error).split()) or type(error).__name__
        raise ValueError(words if len(words) <= 200 else f"{words[:200]} ...") from error


def _count_fields(types: Fields, name: str, counts: dict[str, int], depth: int = 0) -> int:
    """Return the number of fields of a type; ValueError if too large, unknown or recursive."""
    if name in counts:
        return counts[name]
    if name not in types:
        raise ValueError(f"it does not define {name}")
    if depth > _MAX_NESTING:
        raise ValueError(f"its types are nested more than {_MAX_NESTING} deep, or recursive")
    count = 0
    for field, (kind, detail) in types[name][1]:
        length = 1
        if kind == Nodetype.ARRAY:
            (kind, detail), length = detail
            if length < 1:
                raise ValueError(f"the array {field} of {name} has no elements")
        elif kind == Nodetype.SEQUENCE:
            kind, detail = detail[0]
        if kind == Nodetype.NAME:
            count += length * _count_fields(types, detail, counts, depth + 1)
        else:
            count += length if detail[0] == "string" else 1
        if count > _MAX_FIELDS:
            raise ValueError(
                f"{name} has more than {_MAX_FIELDS} fields, including those of nested messages"
            )
    counts[name] = max(count, 1)
    return counts[name]


# -- the layout of serialised messages -----------------------------------------------------------

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

    On most topics, all messages have the same layout: the frame names and the number of joints are
    constant. A field then has the same position in every message and can be read or overwritten
    there.

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


def seconds_and_nanoseconds(times_ns: NDArray[np.int64]) -> NDArray[np.uint32]:
    """Convert times (N,) in ns to stamps of seconds and nanoseconds (N, 2)."""
    return np.stack([times_ns // SECOND, times_ns % SECOND], axis=1).astype("<u4")
