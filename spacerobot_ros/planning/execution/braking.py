"""The end of a gait that is broken off: to rest along its own path."""

from __future__ import annotations

import math

import numpy as np

from spacerobot_ros.model.description import Array
from spacerobot_ros.planning.core.schedule import GaitSchedule


class BrakingFollower:
    """Goes on along a schedule ever more slowly, and holds the shape where it comes to rest.

    The gait's time runs at the rate ``1 - t/T``: the shape stays on the gait's path, and so does
    the base, which at zero momentum follows the path of the shape and not its speed.

    Parameters
    ----------
    schedule
        What was flown.
    start_ns
        Stamp of its first tick, ns.
    stamp_ns
        When the braking begins, ns.
    duration
        T, s; the gait goes on for half of it.
    shape_gain
        Feedback from shape error to velocity, 1/s.
    """

    def __init__(
        self,
        schedule: GaitSchedule,
        start_ns: int,
        stamp_ns: int,
        duration: float,
        shape_gain: float,
    ) -> None:
        self.schedule = schedule
        self._begin = (stamp_ns - start_ns) / 1e9
        self._stamp_ns, self._duration = stamp_ns, duration
        self._gain = min(shape_gain, 1.0 / schedule.control_period)

    def ended(self, stamp_ns: int, q: Array) -> bool:
        """Whether the shape is at rest."""
        return (stamp_ns - self._stamp_ns) / 1e9 >= self._duration

    def command(self, stamp_ns: int, q: Array, position: Array, velocity: Array) -> None:
        """Write the wanted shape now (n,) and the velocities to hold from now (n,)."""
        since = (stamp_ns - self._stamp_ns) / 1e9
        position[:] = self._shape(since)
        tick = self.schedule.control_period
        velocity[:] = (self._shape(since + tick) - position) / tick + self._gain * (position - q)

    def shapes(self, stamp_ns: int) -> Array:
        """Return the wanted shapes (N + 1, n) at the ticks from now until the rest."""
        tick = self.schedule.control_period
        since = (stamp_ns - self._stamp_ns) / 1e9
        ticks = max(1, math.ceil((self._duration - since) / tick - 1e-9))
        return np.array([self._shape(since + k * tick) for k in range(ticks + 1)])

    def _shape(self, since: float) -> Array:
        tau = min(since / self._duration, 1.0)
        ticks = (self._begin + self._duration * (tau - tau**2 / 2)) / self.schedule.control_period
        positions = self.schedule.positions
        k = min(max(int(ticks), 0), len(positions) - 1)
        ahead = positions[min(k + 1, len(positions) - 1)] - positions[k]
        return np.asarray(positions[k] + (ticks - k) * ahead)
