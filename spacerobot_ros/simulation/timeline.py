"""Lines that describe what happens to a plant by time, such as faults and disturbances."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Generic, Protocol, TypeVar

from spacerobot_ros.errors import ParameterError

MAX_TIME = 1e9
"""Largest time in a line, s."""

_MAX_ENTRIES = 1000
"""Largest number of entries of a timeline: more take longer than a tick to search."""

Refusal = Callable[[str], ParameterError]
"""Returns the error that refuses a line for a reason, a clause."""


class Timed(Protocol):
    """An entry that is active from ``start`` s on and until before ``end`` s."""

    @property
    def start(self) -> float:
        """Begin, s."""

    @property
    def end(self) -> float:
        """End, s; infinite: never."""


def line_refusal(line: str, noun: str) -> Refusal:
    """Return the refusal of a line, which the message quotes."""
    return lambda reason: ParameterError(f"The {noun} '{line.strip()[:80]}' is refused: {reason}.")


def parse_number(text: str, refusal: Refusal) -> float:
    """Return a finite number of a line.

    Raises
    ------
    ParameterError
        The text is not one.
    """
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise refusal(f"'{text[:40]}' is not a finite number")
    return number


def parse_times(
    words: Sequence[str], before: str, now: float, refusal: Refusal
) -> tuple[float, float]:
    """Return begin and end (s) of the last words of a line, ``[at SECONDS] [until SECONDS]``.

    Parameters
    ----------
    words
        The words.
    before
        The words of the line before them, for messages.
    now
        Begin if the words name none, s.
    refusal
        Of the line.

    Raises
    ------
    ParameterError
        The words are no times, or they end before they begin.
    """
    times = {"at": now, "until": math.inf}
    if words[0::2] not in ([], ["at"], ["until"], ["at", "until"]) or len(words) % 2:
        raise refusal(f"after {before} come only 'at SECONDS' and 'until SECONDS'")
    for word, text in zip(words[0::2], words[1::2], strict=True):
        times[word] = parse_number(text, refusal)
        if abs(times[word]) > MAX_TIME:
            raise refusal(f"its time is {times[word]:g} s and must be at most {MAX_TIME:g} s")
    if not times["until"] > times["at"]:
        raise refusal(f"it ends at {times['until']:g} s and begins at {times['at']:g} s")
    return times["at"], times["until"]


def format_times(start: float, end: float) -> str:
    """Return begin and end as the last words of a line."""
    # With six digits, an entry that is short and late would begin and end at the same time.
    until = f" until {end:.12g}" if math.isfinite(end) else ""
    return f"at {start:.12g}{until}"


Entry = TypeVar("Entry", bound=Timed)


class Timeline(Generic[Entry]):
    """Entries of one plant by time.

    Parameters
    ----------
    lines
        One entry per line.
    parse
        Reads an entry from its line; the second argument is its begin if the line has none, s.
    noun
        Name of an entry, for messages.
    """

    def __init__(
        self, lines: Iterable[str], parse: Callable[[str, float], Entry], noun: str
    ) -> None:
        self._parse, self._noun = parse, noun
        self.entries: list[Entry] = []
        self.active: tuple[Entry, ...] = ()
        """Active entries; a new tuple object after every change."""
        self.next_change = -math.inf
        """Time of the next change of ``active``, s."""
        self.read(lines)

    def read(self, lines: Iterable[str], now: float = 0.0) -> None:
        """Add an entry per line; an entry without a time begins ``now`` (s).

        Raises
        ------
        ParameterError
            A line is refused, or there are too many; none is added.
        """
        added = [self._parse(line, now) for line in lines if line.strip()]
        if len(self.entries) + len(added) > _MAX_ENTRIES:
            raise ParameterError(
                f"{len(added)} more {self._noun}(s) are refused: there are {len(self.entries)}, "
                f"and at most {_MAX_ENTRIES}; inject 'clear' first."
            )
        self.entries += added
        self.next_change = -math.inf

    def inject(self, text: str, now: float) -> None:
        """Add the entries of a text, one per line, or remove all (``clear``), future ones too.

        Raises
        ------
        ParameterError
            As :meth:`read`.
        """
        if text.strip() == "clear":
            self.clear()
        else:
            self.read(text.splitlines(), now)

    def clear(self) -> None:
        """Remove all entries, including future entries."""
        self.entries.clear()
        self.next_change = -math.inf

    def at(self, time: float) -> tuple[Entry, ...]:
        """Return the entries that are active at a time (s), which must not run backwards."""
        if time >= self.next_change:
            active = tuple(each for each in self.entries if each.start <= time < each.end)
            if active != self.active:
                self.active = active
            edges = [
                edge for each in self.entries for edge in (each.start, each.end) if edge > time
            ]
            self.next_change = min(edges, default=math.inf)
        return self.active
