"""Message type definitions, from installed packages and from schemas in bags.

``rosbags`` generates Python code for every decoded type, with one line per element of a message
array, and never terminates if a type contains itself. Definitions in bags are untrusted, so
names, lengths, nesting and the number of fields are limited.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from rosbags.interfaces import Nodetype

from spacerobot_ros.errors import RecordingError
from spacerobot_ros.resources import installed_share_directory

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
    "_FeedbackMessage": (
        "action",
        "unique_identifier_msgs/UUID goal_id\n{0}_Feedback feedback\n",
    ),
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

    Attributes
    ----------
    fields
        Definitions of the type and of all nested types.

    Raises
    ------
    ValueError
        The definition cannot be parsed or exceeds a limit.
    """

    def __init__(self, name: str, text: bytes) -> None:
        # The parser is slow to import, and tools that read no messages do not need it.
        from rosbags.typesys import get_types_from_msg

        self.name = name
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
        from rosbags.typesys import Stores, get_typestore

        store = get_typestore(Stores.EMPTY)
        with _as_value_errors():
            store.register(self.fields)
            store.get_msgdef(self.name)
        return store


message_type = lru_cache(maxsize=64)(MessageType)
"""Return a :class:`MessageType`; its code is generated once and shared by all bags."""


@cache
def installed_type(type_name: str) -> MessageType:
    """Return a message type of an installed package. Raises as :func:`message_definition` does."""
    return message_type(type_name, message_definition(type_name).encode())


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
