"""From a schedule and the measured shape to the command of each tick."""

from __future__ import annotations

import numpy as np

from spacerobot_ros.model.description import Array
from spacerobot_ros.planning.core.schedule import GaitSchedule
from spacerobot_ros.planning.execution.braking import BrakingFollower

_ARRIVED = 1e-6
"""A schedule has ended when every joint is this near its last position, m or rad."""

_LONGEST_SETTLING = 5.0
"""... or this long after its last tick, s."""


class GaitFollower:
    """Flies one schedule by its stamps, so that a missed tick delays nothing that follows.

    Parameters
    ----------
    schedule
        What to fly.
    start_ns
        Stamp of its first tick, ns.
    shape_gain
        Feedback from shape error to velocity, 1/s; what the plant could not do in time is made up.
    deadband
        Shape errors up to this are noise and not fed back, m or rad.
    """

    def __init__(
        self, schedule: GaitSchedule, start_ns: int, shape_gain: float, deadband: float = 0.0
    ) -> None:
        self.schedule = schedule
        self._start_ns = start_ns
        self._period_ns = round(schedule.control_period * 1e9)
        self._last_tick = schedule.ticks
        self._end_ns = start_ns + self._last_tick * self._period_ns
        self._gain = min(shape_gain, 1.0 / schedule.control_period)
        self._positions = schedule.positions
        # At rest after the last tick. The part of the feedback that is known beforehand is added
        # here: qdot = qdot_k + gain (q_k - q), and q alone is measured.
        velocities = np.vstack([schedule.velocities, np.zeros(len(schedule.joint_names))])
        self._feedforward = velocities + self._gain * self._positions
        self._velocities, self._deadband = velocities, deadband

    def ended(self, stamp_ns: int, q: Array) -> bool:
        """Whether the schedule is over and the shape ``q`` (n,) has arrived."""
        late = stamp_ns - self._end_ns
        if late < 0:
            return False
        far = np.abs(self._positions[-1] - q).max(initial=0.0) > max(_ARRIVED, self._deadband)
        return not far or late > _LONGEST_SETTLING * 1e9

    def braking(self, stamp_ns: int, duration: float) -> BrakingFollower:
        """Return what comes to rest along this schedule within ``duration`` s from now."""
        return BrakingFollower(self.schedule, self._start_ns, stamp_ns, duration, self._gain)

    def command(self, stamp_ns: int, q: Array, position: Array, velocity: Array) -> None:
        """Write the wanted shape now (n,) and the velocities to hold from now (n,)."""
        k = (stamp_ns - self._start_ns) // self._period_ns
        k = 0 if k < 0 else min(k, self._last_tick)
        position[:] = self._positions[k]
        if self._deadband:
            error = position - q
            error -= np.clip(error, -self._deadband, self._deadband)
            velocity[:] = self._velocities[k] + self._gain * error
            return
        np.multiply(q, -self._gain, out=velocity)
        velocity += self._feedforward[k]
