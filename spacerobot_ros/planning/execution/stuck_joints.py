"""Joints that do not follow their commands, found while a gait is executed."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from spacerobot_ros.model.description import Array

_STUCK_SHARE = 0.05
"""Share of the commanded range below which the motion of a joint counts as stuck."""

_FOLLOWS_SHARE = 0.5
"""Share of the commanded range above which a joint counts as following its commands. In between it
is slow, or noise hides its motion."""

_MAX_STANDSTILL_WINDOWS = 8
"""Number of windows without motion of any joint before joints count as stuck."""

_CHECK_PERIOD = 16
"""Ticks between two checks of joints that have all followed so far: a check takes time."""

_MIN_JOINT_ERROR = 1e-6
"""Joint errors below this count as rounding, m or rad."""


class StuckJointWatch:
    """Watches the joints while a schedule is tracked, tick by tick.

    Since it was last seen to follow, every joint has gone over some range and was commanded to go
    over another; a joint is stuck when it was commanded to move in N ticks or more and the first
    range is a small part of the second. So joints that are not commanded to move, slow ones, and
    ones whose measurements are noisy are not taken for stuck. Where no joint moves at all, or none
    has moved for half of N ticks although several were commanded to, they are watched for longer:
    a plant that is restarted takes a while to receive commands.

    Parameters
    ----------
    joints
        Their number.
    ticks
        N; 0: nothing is ever stuck.
    control_period
        Duration of a command, s.
    band
        Shape errors up to this are noise, m or rad.
    """

    def __init__(self, joints: int, ticks: int, control_period: float, band: float = 0.0) -> None:
        self._ticks, self._control_period = ticks, control_period
        self._band = max(band, _MIN_JOINT_ERROR)
        self._joints, self._max_window = joints, _MAX_STANDSTILL_WINDOWS * ticks
        self.restart()

    def restart(self) -> None:
        """Begin to watch the joints for a new schedule."""
        n = self._joints
        self._suspicious, self._ticks_without_check = False, 0
        self._moving_ticks = np.zeros(n, dtype=np.int64)
        self._window = np.full(n, self._ticks, dtype=np.int64)
        self._commanded = np.zeros(n)
        self._commanded_range, self._measured_range = np.zeros((2, n)), np.zeros((2, n))
        self._standstill_q, self._standstill_motion = np.full(n, np.inf), np.zeros(n)
        self._standstill_ticks = 0

    def find_stuck(self, q: Array, wanted: Array, velocity: Array) -> list[int]:
        """Return the indices of the joints that are stuck since this tick, mostly none.

        ``q`` and ``wanted`` (n,) are the measured and the wanted shape now, ``velocity`` (n,) the
        command until the next tick.
        """
        if not self._suspicious:
            self._ticks_without_check += 1
            if self._ticks_without_check % _CHECK_PERIOD or not self._ticks:
                return []
            if np.abs(wanted - q).max(initial=0.0) <= self._band:
                return []
            self._suspicious = True
            self._restart_joints(np.ones(self._joints, dtype=np.bool_), q)
        self._count_standstill(q, velocity)
        _widen_ranges(self._measured_range, q)
        self._commanded += velocity * self._control_period
        _widen_ranges(self._commanded_range, self._commanded)
        self._moving_ticks += (
            np.abs(velocity) * self._control_period > _MIN_JOINT_ERROR * _STUCK_SHARE
        )
        due = self._moving_ticks >= self._window
        if not due.any():
            return []
        commanded, measured = (
            np.diff(self._commanded_range, axis=0)[0],
            np.diff(self._measured_range, axis=0)[0],
        )
        stuck = due & (measured <= _STUCK_SHARE * commanded) & (commanded > self._band)
        moved = commanded > self._band
        still = measured[moved] <= _STUCK_SHARE * commanded[moved]
        none_moves = (np.count_nonzero(moved) > 1 and still.all()) or self._is_at_standstill
        if none_moves and self._window[due].max() < self._max_window:
            # Joints do not all jam at once: perhaps commands do not arrive for a while.
            stuck[:] = False
        follows = due & (measured >= _FOLLOWS_SHARE * commanded)
        # Joints between both shares are watched for a window twice as long.
        self._window[due] *= 2
        self._restart_joints(follows | stuck, q)
        return [int(i) for i in np.flatnonzero(stuck)]

    def _count_standstill(self, q: Array, velocity: Array) -> None:
        """Count the ticks without any motion, and sum the commanded motion of each joint."""
        if np.abs(q - self._standstill_q).max(initial=0.0) > self._band:
            self._standstill_q[:] = q
            self._standstill_motion[:] = 0.0
            self._standstill_ticks = 0
        self._standstill_motion += np.abs(velocity) * self._control_period
        self._standstill_ticks += 1

    @property
    def _is_at_standstill(self) -> bool:
        """Whether several joints had commands to move for a while, and no joint moved."""
        commanded = int(np.count_nonzero(self._standstill_motion > self._band))
        return commanded > 1 and 2 * self._standstill_ticks >= self._ticks

    def _restart_joints(self, joints: npt.NDArray[np.bool_], q: Array) -> None:
        self._moving_ticks[joints], self._window[joints] = 0, self._ticks
        self._commanded[joints] = 0.0
        self._commanded_range[:, joints], self._measured_range[:, joints] = 0.0, q[joints]


def _widen_ranges(ranges: Array, values: Array) -> None:
    np.minimum(ranges[0], values, out=ranges[0])
    np.maximum(ranges[1], values, out=ranges[1])
