"""A clock that goes only when it is told to, for what measures its own durations."""

from __future__ import annotations

from types import SimpleNamespace


class Clock:
    """Stands in for the module ``time``: its clocks go when something advances or sleeps.

    Attributes
    ----------
    now
        Time of all its clocks, s.
    slept
        The durations that were asked of :meth:`sleep`, s.
    """

    def __init__(self, now: float = 1000.0) -> None:
        self.now = now
        self.slept: list[float] = []

    def _read(self) -> float:
        return self.now

    process_time = perf_counter = monotonic = _read

    def advance(self, duration: float) -> None:
        """Go on by a duration, s."""
        self.now += duration

    def sleep(self, duration: float) -> None:
        """Go on by a duration, s, and remember it."""
        self.slept.append(duration)
        self.advance(duration)


def named(**values: object) -> SimpleNamespace:
    """Return an object with these attributes, in the place of a module or of a stack."""
    return SimpleNamespace(**values)
