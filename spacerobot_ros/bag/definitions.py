"""Message types from the definitions in a bag, which anybody may have written.

``rosbags`` writes Python code for every type, a line for each element of an array of messages, and
follows types that contain themselves for ever. So a definition is checked first: names, lengths,
nesting, and how many fields a message has when all messages inside of it are written out.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import lru_cache
from typing import Any

from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

_TYPE_NAME = re.compile(r"[A-Za-z]\w*/(msg|srv|action)/[A-Za-z]\w*", re.ASCII)
_LONGEST_TEXT = 262_144
_MOST_LINES = 5_000
_MOST_FIELDS = 1_000
"""Arrays of numbers count as one field, arrays of messages and strings with every element."""

_DEEPEST = 32


class MessageTypes:
    """The types of a bag's messages, as far as they have been asked for."""

    def __init__(self) -> None:
        self._store = get_typestore(Stores.EMPTY)

    @property
    def fields(self) -> dict[str, Any]:
        """Type name -> constants and fields, as ``rosbags`` parses a definition."""
        return self._store.fielddefs

    def kind(self, type_name: str) -> Any:
        """Return the class of the messages of a type that a decoder was asked for."""
        return self._store.types[type_name]

    def serialise(self, message: Any) -> memoryview | bytes:
        """Return a message as ROS serialises it."""
        return self._store.serialize_cdr(message, message.__msgtype__)

    def decoder(self, type_name: str, text: bytes) -> Callable[[bytes], Any]:
        """Return what decodes the messages of a type, given the text of its schema.

        Raises
        ------
        ValueError
            The definition is refused.
        """
        store, definition = _known(type_name, text)
        self._take(store)
        little, big = definition.deserialize_cdr_le, definition.deserialize_cdr_be

        def decode(data: bytes) -> Any:
            # Not `Typestore.deserialize_cdr`: that one refuses what rclpy serialises with an empty
            # list of float64, which has some meaningless bytes at its end.
            deserialise = little if data[1] & 1 else big
            return deserialise(data[4:], 0, definition.cls, store)[0]

        return decode

    def _take(self, store: Typestore) -> None:
        """Add the types of another store.

        Raises
        ------
        ValueError
            The bag has defined one of them otherwise.
        """
        own = self._store
        for name, (_, fields) in store.fielddefs.items():
            if name in own.fielddefs and _layout(own.fielddefs[name][1]) != _layout(fields):
                raise ValueError(f"Type '{name}' is already present with different definition.")
        for name in store.fielddefs.keys() - own.fielddefs.keys():
            own.fielddefs[name], own.types[name] = store.fielddefs[name], store.types[name]


def _layout(fields: Any) -> list[Any]:
    return [(name.lower(), kind) for name, kind in fields]


@lru_cache(maxsize=64)
def _known(type_name: str, text: bytes) -> tuple[Typestore, Any]:
    """Return a store of what a text defines, and the code for the type: made once for all bags.

    Raises
    ------
    ValueError
        The definition is refused.
    """
    parsed, store = _parsed(type_name, text), get_typestore(Stores.EMPTY)
    try:
        store.register(parsed)
        return store, store.get_msgdef(type_name)
    # Generated code has no errors of its own: names, syntax, keys, whatever is in the text.
    except Exception as error:
        raise ValueError(_one_line(error)) from error


def _parsed(type_name: str, text: bytes) -> Any:
    if not _TYPE_NAME.fullmatch(type_name):
        raise ValueError("a type is called 'package/msg/Type'")
    if len(text) > _LONGEST_TEXT or text.count(b"\n") > _MOST_LINES:
        raise ValueError(
            f"its text is longer than {_LONGEST_TEXT} bytes or {_MOST_LINES} lines, which no "
            "message needs"
        )
    try:
        types = get_types_from_msg(text.decode(), type_name)
    except Exception as error:
        raise ValueError(_one_line(error)) from error
    if type_name not in types:
        raise ValueError(f"it does not define {type_name}")
    _Sizes(types).of(type_name, 0)
    return types


def _one_line(error: Exception) -> str:
    words = " ".join(str(error).split()) or type(error).__name__
    return words if len(words) <= 200 else f"{words[:200]} ..."


class _Sizes:
    """How many fields each type has, with all messages inside of it written out."""

    def __init__(self, types: dict[str, Any]) -> None:
        self._types = types
        self._known: dict[str, int] = {}

    def of(self, name: str, depth: int) -> int:
        """Return the number for one type.

        Raises
        ------
        ValueError
            It has too many, is not defined, or contains itself.
        """
        if name in self._known:
            return self._known[name]
        if name not in self._types:
            raise ValueError(f"it does not define {name}")
        if depth > _DEEPEST:
            raise ValueError(f"its types are nested more than {_DEEPEST} deep, or in themselves")
        count = 0
        for field, (kind, detail) in self._types[name][1]:
            length = 1
            if kind == Nodetype.ARRAY:
                (kind, detail), length = detail
                if length < 1:
                    raise ValueError(f"the array {field} of {name} has no elements")
            elif kind == Nodetype.SEQUENCE:
                kind, detail = detail[0]
            if kind == Nodetype.NAME:
                count += length * self.of(detail, depth + 1)
            else:
                count += length if detail[0] == "string" else 1
            if count > _MOST_FIELDS:
                raise ValueError(
                    f"{name} has more than {_MOST_FIELDS} fields, counting those of the messages "
                    "in it"
                )
        self._known[name] = max(count, 1)
        return self._known[name]
