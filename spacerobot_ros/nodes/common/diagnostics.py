"""The diagnostic message of every node: a level, a sentence, and what belongs to it by name."""

from __future__ import annotations

from collections.abc import Mapping

from diagnostic_msgs.msg import DiagnosticStatus, KeyValue


def diagnostic_status(
    name: str, level: bytes, sentence: str, values: Mapping[str, object]
) -> DiagnosticStatus:
    """Return the message about what goes by ``name``; values as texts."""
    return DiagnosticStatus(
        level=level,
        name=name,
        message=sentence,
        values=[KeyValue(key=key, value=str(value)) for key, value in values.items()],
    )
