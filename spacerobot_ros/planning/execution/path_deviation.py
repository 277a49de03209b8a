"""Whether a flight keeps to the base path that its plan predicts."""

from __future__ import annotations

import numpy as np

from spacerobot_ros.model.description import Array
from spacerobot_ros.model.rotations import attitude_error
from spacerobot_ros.planning.core.schedule import GaitSchedule


class DriftWatch:
    """Compares measured poses with a predicted path, at the path's own instants.

    Parameters
    ----------
    schedule
        What is flown.
    start_ns
        Stamp of its first tick, ns.
    position, attitude
        How far off is too far, m and rad; 0: any.
    """

    def __init__(
        self, schedule: GaitSchedule, start_ns: int, position: float, attitude: float
    ) -> None:
        self._path = schedule.path
        self._position, self._attitude = position or np.inf, attitude or np.inf
        self._stamps = start_ns + (schedule.path.time * 1e9).round().astype(np.int64)
        self._slack = round(schedule.control_period * 0.5e9)
        self._next = 0
        self._used = position > 0 or attitude > 0

    def due(self, stamp_ns: int) -> bool:
        """Whether a pose at this time is to be looked at: one that the path predicts."""
        if not self._used:
            return False
        stamps = self._stamps
        while self._next < len(stamps) and stamps[self._next] < stamp_ns - self._slack:
            self._next += 1
        return self._next < len(stamps) and stamps[self._next] <= stamp_ns + self._slack

    def off(self, position: Array, quaternion: Array) -> tuple[float, float]:
        """Return how far a pose that was due is off the path: m, rad."""
        k = self._next
        turn = attitude_error(quaternion, self._path.quaternion[k])
        distance = np.linalg.norm(position - self._path.position[k])
        return float(distance), float(np.linalg.norm(turn))

    def too_far(self, distance: float, angle: float) -> bool:
        """Whether a pose that far off is."""
        return distance > self._position or angle > self._attitude
