"""The wall clock as the time of a plant."""

from __future__ import annotations

from spacerobot_ros.times import SECOND

_MAX_LATE_TICKS = 10
"""Largest number of late ticks that a real-time plant catches up; further ticks are lost."""

_MAX_TICKS_AT_ONCE = 2
"""Largest number of ticks that a late plant takes before it reads commands again."""


class RealTime:
    """Schedules ticks by the wall clock, and counts late ticks and commands.

    A tick is late if it is taken after the next one is due. A command is late if it arrives after
    the due time of the tick that follows its state.

    Parameters
    ----------
    period_ns
        Simulated duration of a tick, ns.
    factor
        Simulated over wall time.
    """

    def __init__(self, period_ns: int, factor: float = 1.0) -> None:
        self._period, self._pace = period_ns, period_ns / factor
        self._origin = 0.0
        self.ticks_lost = 0
        """Number of late ticks that the plant has skipped."""
        self.ticks = self.ticks_late = 0
        """Number of ticks, and number of ticks executed after the next tick was due."""
        self.commands = self.commands_late = 0
        """Number of states that received a command, and number of commands that arrived after the
        next tick was due."""
        self.worst_tick = self.worst_command = 0.0
        """Largest delay of a tick and of a command, s."""
        self._reported = 0, 0
        self._ticks_reported, self._reported_at, self._now = 0, 0, 0
        self._state_ns, self._answered_ns = 0, 0.0

    @property
    def period(self) -> float:
        """Wall time of a tick, s."""
        return self._pace / SECOND

    def start(self, now_ns: int, tick: int) -> None:
        """Start with a tick whose state is due now."""
        self._origin = now_ns - tick * self._pace

    def due_ticks(self, now_ns: int, tick: int) -> int:
        """Return the number of ticks due now, after ``tick``; lost ticks are dropped."""
        behind = int((now_ns - self._origin) / self._pace) - tick
        if behind > _MAX_LATE_TICKS:
            self.ticks_lost += behind - _MAX_LATE_TICKS
            self._origin += (behind - _MAX_LATE_TICKS) * self._pace
        return min(behind, _MAX_TICKS_AT_ONCE)

    def count_tick(self, now_ns: int, tick: int) -> None:
        """Count the tick after ``tick``, which is taken now."""
        self.ticks += 1
        self._now, self._state_ns = now_ns, tick * self._period
        late = now_ns - (self._origin + (tick + 2) * self._pace)
        if late > 0:
            self.ticks_late += 1
            self.worst_tick = max(self.worst_tick, late / SECOND)

    def count_command(self, now_ns: int, stamp_ns: float) -> None:
        """Count an active command for the state with a given stamp (simulated time)."""
        if stamp_ns <= self._answered_ns:
            return  # A refused command leaves the command in force unchanged.
        self._answered_ns = stamp_ns
        self.commands += 1
        late = now_ns - (self._origin + (stamp_ns / self._period + 1) * self._pace)
        if late > 0:
            self.commands_late += 1
            self.worst_command = max(self.worst_command, late / SECOND)

    @property
    def command_age(self) -> float:
        """Age of the state to which the active command refers, in s of simulated time."""
        return (self._state_ns - self._answered_ns) / SECOND

    def report(self) -> tuple[float, bool]:
        """Return the ticks per second of wall time since the last call, and whether there have been
        new delays since then.
        """
        late = self.ticks_late, self.commands_late
        worse, self._reported = late != self._reported, late
        elapsed = (self._now - self._reported_at) / SECOND
        rate = (self.ticks - self._ticks_reported) / elapsed if elapsed > 0 else 0.0
        self._ticks_reported, self._reported_at = self.ticks, self._now
        return rate, worse
