"""Which measured states are of the plant's present time, judged by their stamps."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

from spacerobot_ros.times import HEADER_STAMP, SECOND, first_time_ns

LONGEST_DOUBT = 0.2
"""Wall s after which a state of another time is believed that no state of the old time follows."""

_STEP_SLACK = 1.5
"""States follow each other within this many steps, a step being a control period."""

_PACE_SLACK = 2.0
"""Lost states are believed while time has not run faster than this many times its pace."""

_LOOKS = 2
"""Looks without a state of the old time before another time is believed."""

_NONE = -1
"""The stamp of no state."""

_LONGEST_STEP = 100
"""Control periods that the states of a plant with another rate may be apart."""


@dataclass
class _Doubtful:
    """A state that was set aside."""

    since: float
    """Wall s when the first state of its time came."""
    joint_states: bytes
    stamp_ns: int
    looks: int = 0
    """How often :meth:`StateTimes.believed` was asked since then."""


class StateTimes:
    """Tells the states of the plant's present time from those that are stamped with another one.

    A stamp is plausible

    * within 1.5 control periods after the state before, or equal to it: no message was lost;
    * further ahead by no more than twice of what the time went on in as much wall time before:
      messages were lost, or this node was stopped for a while.

    Any other state is a *time jump*: it is set aside. When a state of the old time follows it is
    ignored, and counted. When none does for 0.2 s of wall time (and for four states) the time has
    really changed, as after a restart of the plant: then it is believed. A plant in lockstep waits
    that long for its answer.

    Parameters
    ----------
    control_period
        Time between two states, s.
    clock
        Returns the wall time, s.
    """

    def __init__(self, control_period: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._period = round(control_period * SECOND)
        self._step = self._period
        """Time between two states as far as is known, ns."""
        self._longest = -1
        """Largest plausible step without a loss, ns; negative before the first state."""
        self._last_ns, self._before_ns, self._wall = 0, _NONE, 0.0
        self._origin_ns, self._origin_wall = 0, 0.0
        """The first state of this time, from which its pace is measured."""
        self._doubtful: _Doubtful | None = None
        self._doubtful_odom = b""
        self._jump_ns = 0
        """The last jump that was believed, ns."""
        self.ignored = 0
        """States and poses that were ignored because of their stamps."""
        self.last_ignored = ""
        """Why the last one was, as a sentence."""

    @property
    def now_ns(self) -> int:
        """The stamp of the last state that was admitted, ns; 0 before the first."""
        return self._last_ns

    def admits(self, joint_states: bytes) -> bool:
        """Return whether a joint_states message is of the present time; else it is set aside."""
        stamp = first_time_ns(joint_states)
        if not 0 <= stamp - self._last_ns <= self._longest and not self._explained(stamp):
            self._doubt(joint_states, stamp)
            return False
        self._before_ns, self._last_ns = self._last_ns, stamp
        self._wall = self._clock()
        if self._doubtful is not None or self._doubtful_odom:
            self._ignore()
        return True

    def would_admit(self, joint_states: bytes) -> bool:
        """Return whether a joint_states message is of the present time, and change nothing."""
        ahead = first_time_ns(joint_states) - self._last_ns
        return 0 <= ahead <= max(self._longest, self._loss(self._clock()))

    def withdraw(self) -> None:
        """Take back the state that was admitted last: it is not one of the robot."""
        if self._before_ns == _NONE:
            self._longest, self._last_ns = -1, 0
        else:
            self._last_ns = self._origin_ns = self._before_ns
            self._origin_wall = self._wall

    def admits_odom(self, odom: bytes) -> bool:
        """Return whether an odom message is of the present time; else it is set aside.

        Odom comes before the joint_states of its stamp, or after them.
        """
        stamp = first_time_ns(odom)
        ahead = stamp - self._last_ns
        if -self._longest <= ahead <= self._longest or self._longest < 0:
            return True
        if 0 <= ahead <= self._loss(self._clock()):
            return True
        self._doubtful_odom = odom
        return False

    def believed(self) -> tuple[bytes, bytes] | None:
        """Return odom (maybe empty) and joint_states that were set aside and prove to be true."""
        doubtful = self._doubtful
        if doubtful is None:
            return None
        # While this node itself stood still states of the old time may have come, unseen yet.
        doubtful.looks += 1
        if doubtful.looks < _LOOKS or self._clock() - doubtful.since < self._patience:
            return None
        return self._jump(doubtful)

    def _explained(self, stamp: int) -> bool:
        """Whether a stamp is that of a first state, or lost messages explain it."""
        now = self._clock()
        if self._longest < 0:
            self._longest = round(_STEP_SLACK * self._step)
            self._origin_ns, self._origin_wall = stamp, now
            self._last_ns = _NONE
            return True
        return 0 <= stamp - self._last_ns <= self._loss(now)

    def _loss(self, now: float) -> float:
        """Return how far ahead a state may be at a wall time, ns."""
        return self._longest + _PACE_SLACK * self._pace * (now - self._wall)

    @property
    def _pace(self) -> float:
        """Simulated ns per wall s of this time so far."""
        elapsed = self._wall - self._origin_wall
        return (self._last_ns - self._origin_ns) / elapsed if elapsed > 0 else 0.0

    @property
    def _patience(self) -> float:
        """For how long no state of the old time may come, wall s."""
        pace = self._pace
        return max(LONGEST_DOUBT, 4 * self._step / pace if pace > 0 else 0.0)

    def _doubt(self, joint_states: bytes, stamp: int) -> None:
        """Set a state aside; it replaces the one before."""
        before = self._doubtful
        if before is not None and 0 <= stamp - before.stamp_ns <= self._longest:
            before.joint_states, before.stamp_ns = joint_states, stamp
        else:
            self._doubtful = _Doubtful(self._clock(), joint_states, stamp)

    def _jump(self, doubtful: _Doubtful) -> tuple[bytes, bytes]:
        """Go on with another time."""
        stamp, now = doubtful.stamp_ns, self._clock()
        jump = stamp - self._last_ns
        if jump == self._jump_ns and 0 < jump <= _LONGEST_STEP * self._period:
            # The plant's rate is another one than this node's.
            self._step = jump
            self._longest = round(_STEP_SLACK * jump)
        self._jump_ns = jump
        self._before_ns, self._last_ns, self._wall = self._last_ns, stamp, now
        self._origin_ns, self._origin_wall = stamp, now
        odom, self._doubtful, self._doubtful_odom = self._doubtful_odom, None, b""
        same = odom[HEADER_STAMP] == doubtful.joint_states[HEADER_STAMP]
        return (odom if same else b""), doubtful.joint_states

    def _ignore(self) -> None:
        """Count the states that were set aside as ignored, because the old time continues."""
        parts = [
            (name, raw)
            for name, raw in (
                ("joint_states", b"" if self._doubtful is None else self._doubtful.joint_states),
                ("odom", self._doubtful_odom),
            )
            if raw and first_time_ns(raw) != self._last_ns
        ]
        self._doubtful, self._doubtful_odom = None, b""
        for name, raw in parts:
            ahead = (first_time_ns(raw) - self._last_ns) / SECOND
            self.ignored += 1
            self.last_ignored = (
                f"A message on '{name}' is ignored: its stamp is {abs(ahead):.4g} s "
                f"{'ahead of' if ahead > 0 else 'behind'} the time of the states."
            )
