"""Limits the rate of log lines; keeps the last line and counts the omitted ones."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

BURST = 20
"""Lines that pass at once after a quiet time: those of a goal with its corrections."""

PERIOD = 1.0
"""Time per line once the burst is used up, s."""


@dataclass(frozen=True)
class Line:
    """Severity and text of one line."""

    level: Literal["debug", "info", "warning", "error"]
    message: str


class LogRateLimiter:
    """Passes a burst of log lines at once, and then one line in each period.

    A line that has to wait is replaced by the next one; the line that passes at last tells how
    many were left out. So the log ends with the last line, whatever came before.
    """

    def __init__(self) -> None:
        self._free, self._counted_s = float(BURST), 0.0
        self._waiting: Line | None = None
        self._left_out = 0

    def offer(self, now_s: float, line: Line) -> Line | None:
        """Return the line to write now; None if the line waits.

        Parameters
        ----------
        now_s
            Wall time, s.
        line
            The new line.
        """
        if self._waiting is not None:
            self._left_out += 1
        self._waiting = line
        return self.due(now_s)

    def due(self, now_s: float) -> Line | None:
        """Return the waiting line once it may be written."""
        self._free = min(BURST, self._free + (now_s - self._counted_s) / PERIOD)
        self._counted_s = now_s
        line, count = self._waiting, self._left_out
        if line is None or self._free < 1.0:
            return None
        self._free -= 1.0
        self._waiting, self._left_out = None, 0
        if not count:
            return line
        return replace(line, message=f"{line.message} ({count} line(s) about goals left out.)")
