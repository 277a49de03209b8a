"""How well a plant in real time keeps to the clock, and its commander to the plant."""

from __future__ import annotations

from diagnostic_msgs.msg import DiagnosticStatus

from spacerobot_ros.nodes.common.cdr import NANOSECONDS
from spacerobot_ros.nodes.common.diagnostics import diagnostic_status

_NS_PER_MS = 1e6


class Deadlines:
    """Counts ticks and commands that come too late, by the wall clock.

    A tick has missed its deadline when it is taken after the next one is due; a command, when it
    comes after the tick that follows the state it answers is due.

    Parameters
    ----------
    name
        What the diagnostics call it.
    period_ns
        Wall time of a tick, ns.
    """

    def __init__(self, name: str, period_ns: float) -> None:
        self._name, self._period = name, period_ns
        self.ticks = self.ticks_late = self.answers = self.answers_late = 0
        self.worst_tick = self.worst_answer = 0.0
        """How far the deadline was exceeded at most, ns."""
        self._reported = 0, 0
        self._ticks_reported, self._reported_at, self._now = 0, 0, 0
        self._state_ns, self._answered_ns = 0, 0.0

    def tick(self, now_ns: int, due_ns: float, state_ns: int) -> None:
        """Note that the tick after a state (simulated time) is taken."""
        self.ticks += 1
        self._now, self._state_ns = now_ns, state_ns
        late = now_ns - due_ns - self._period
        if late > 0:
            self.ticks_late += 1
            self.worst_tick = max(self.worst_tick, late)

    def answer(self, now_ns: int, state_due_ns: float, state_ns: float) -> None:
        """Note that the command in force answers a state (simulated time) that was due then."""
        if state_ns <= self._answered_ns:
            return  # A command that was refused has changed nothing.
        self._answered_ns = state_ns
        self.answers += 1
        late = now_ns - state_due_ns - self._period
        if late > 0:
            self.answers_late += 1
            self.worst_answer = max(self.worst_answer, late)

    def status(self) -> DiagnosticStatus:
        """Return all that was counted, and the rate of ticks since the last call."""
        late = self.ticks_late, self.answers_late
        worse, self._reported = late != self._reported, late
        elapsed = (self._now - self._reported_at) / NANOSECONDS
        rate = (self.ticks - self._ticks_reported) / elapsed if elapsed > 0 else 0.0
        self._ticks_reported, self._reported_at = self.ticks, self._now
        return diagnostic_status(
            self._name,
            DiagnosticStatus.WARN if worse else DiagnosticStatus.OK,
            "deadlines were missed" if worse else "in time",
            {
                "tick_rate_Hz": f"{rate:.6g}",
                "ticks": self.ticks,
                "ticks_late": self.ticks_late,
                "worst_tick_ms": f"{self.worst_tick / _NS_PER_MS:.3f}",
                "commands": self.answers,
                "commands_late": self.answers_late,
                "worst_command_ms": f"{self.worst_answer / _NS_PER_MS:.3f}",
                "command_age_s": f"{(self._state_ns - self._answered_ns) / NANOSECONDS:.6g}",
            },
        )
