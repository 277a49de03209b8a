"""Where a plan takes over from the schedule that is tracked, and from what state it begins.

A plan takes time. So it is made for a tick ahead: until then the schedule of now is tracked, and
the state at that tick follows from the one that is measured now. At zero momentum the base follows
the path of the shape, seen from where it is: a base that is off the predicted path by a rotation
and a displacement keeps to that path, rotated and displaced.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from spacerobot_ros.model.description import Array
from spacerobot_ros.model.rotations import (
    attitude_error,
    matrix_from_quaternion,
    quaternion_from_rotvec,
    quaternion_multiply,
)
from spacerobot_ros.planning.core.method import InitialMotion
from spacerobot_ros.planning.core.schedule import BasePath, GaitSchedule


@dataclass(frozen=True)
class TakeOver:
    """A tick of a schedule at which another one takes over.

    Attributes
    ----------
    stamp_ns
        Its stamp, ns.
    shapes
        (K + 1, n) from the tick now to that tick, m or rad.
    motion
        How the joints move then.
    """

    stamp_ns: int
    shapes: Array
    motion: InitialMotion

    @classmethod
    def of(
        cls, schedule: GaitSchedule, start_ns: int, stamp_ns: int, after: float
    ) -> TakeOver | None:
        """Return the first tick that is ``after`` s or later than now.

        None where the schedule, which began at ``start_ns``, is over by then.
        """
        period_ns = round(schedule.control_period * 1e9)
        now = max((stamp_ns - start_ns) // period_ns, 0)
        tick = now + max(1, math.ceil(after / schedule.control_period - 1e-9))
        if tick >= schedule.ticks:
            return None
        positions = schedule.positions
        motion = InitialMotion(schedule.velocities[tick - 1], positions[tick:])
        return cls(start_ns + tick * period_ns, positions[now : tick + 1].copy(), motion)


class PathDeviation:
    """By how much the measured base is off a predicted path, averaged over the last measurements.

    Parameters
    ----------
    path
        The prediction.
    count
        Measurements to average.
    """

    def __init__(self, path: BasePath, count: int) -> None:
        self._path = path
        self._recent: deque[Array] = deque(maxlen=count)

    def add(self, k: int, position: Array, quaternion: Array) -> None:
        """Add a measured position (3,) and attitude (4,) at instant k of the path."""
        predicted = self._path.quaternion[k]
        turn = matrix_from_quaternion(predicted) @ attitude_error(predicted, quaternion)
        self._recent.append(np.concatenate([position - self._path.position[k], turn]))

    def pose(self, k: int) -> tuple[Array, Array]:
        """Return where the base is at instant k: position (3,) and attitude (4,)."""
        mean = self._mean()
        turn = quaternion_from_rotvec(mean[3:])
        return (
            self._path.position[k] + mean[:3],
            quaternion_multiply(turn, self._path.quaternion[k]),
        )

    def end(self, k: int) -> tuple[Array, Array]:
        """Return where the base comes to if it goes on as predicted from instant k."""
        position, _ = self.pose(k)
        turn = quaternion_from_rotvec(self._mean()[3:])
        way = self._path.position[-1] - self._path.position[k]
        return (
            position + matrix_from_quaternion(turn) @ way,
            quaternion_multiply(turn, self._path.quaternion[-1]),
        )

    def _mean(self) -> Array:
        return np.asarray(np.mean(self._recent, axis=0)) if self._recent else np.zeros(6)
