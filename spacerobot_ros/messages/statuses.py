"""Conversion of statuses and events between diagnostic_msgs/DiagnosticStatus and plain values."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from spacerobot_ros.errors import printable
from spacerobot_ros.messages.layout import encode

STATUS = "diagnostic_msgs/msg/DiagnosticStatus"


@dataclass(frozen=True)
class StatusRecord:
    """Content of a DiagnosticStatus.

    Attributes
    ----------
    name
        Name of the node, or of one of its components.
    level
        0 OK, 1 WARN, 2 ERROR, 3 STALE.
    message
        One sentence for the user.
    values
        Values as strings by key.
    hardware_id
        Name of the robot or bag, or role of the node.
    """

    name: str
    level: int
    message: str
    values: Mapping[str, str] = field(default_factory=dict)
    hardware_id: str = ""

    @classmethod
    def of(cls, node: str, status: Any, level: int | None = None) -> StatusRecord:
        """Return the content for the status of a node; the level is that of the status by
        default."""
        given = status.level if level is None else level
        return cls(node, given, status.message, status.to_values())

    @property
    def fields(self) -> dict[str, Any]:
        """Message fields by name."""
        return {
            "level": self.level,
            "name": self.name,
            "message": self.message,
            "hardware_id": self.hardware_id,
            "values": [{"key": key, "value": value} for key, value in self.values.items()],
        }

    def encoded(self) -> bytes:
        """Return the serialised message."""
        return encode(STATUS, self.fields)


def key_values(pairs: Iterable[Any]) -> dict[str, str]:
    """Return diagnostic_msgs/KeyValue messages as a dictionary whose strings are printable."""
    return {printable(pair.key): printable(pair.value) for pair in pairs}


def read_status(message: Any) -> StatusRecord:
    """Return the printable content of a received or recorded DiagnosticStatus.

    If several pairs have the same key, the last one takes precedence.
    """
    level = message.level if isinstance(message.level, int) else message.level[0]
    return StatusRecord(
        name=printable(message.name),
        level=level,
        message=printable(message.message),
        values=key_values(message.values),
        hardware_id=printable(message.hardware_id),
    )
