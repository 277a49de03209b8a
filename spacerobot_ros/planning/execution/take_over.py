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
from spacerobot_ros.planning.execution.mass_estimate import MassEstimate
from spacerobot_ros.times import SECOND


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
        period_ns = round(schedule.control_period * SECOND)
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
    sensitivity
        (K, 6, P) derivatives of the path by errors of masses and inertias, as
        :class:`.PathSensitivity` returns them; None: these errors are not estimated.
    masses
        The estimate of these errors, which the measurements improve.
    """

    def __init__(
        self,
        path: BasePath,
        count: int,
        sensitivity: Array | None = None,
        masses: MassEstimate | None = None,
    ) -> None:
        self._path = path
        self._recent: deque[tuple[int, Array]] = deque(maxlen=count)
        self._lag = np.zeros(6)
        if sensitivity is None or masses is None:
            sensitivity, masses = np.zeros((len(path.time), 6, 0)), MassEstimate(0)
        self._sensitivity, self._masses = sensitivity, masses
        masses.next_path()

    def add(self, k: int, position: Array, quaternion: Array, lag: Array | float = 0.0) -> None:
        """Add a measured position (3,) and attitude (4,) at instant k of the path.

        ``lag`` (6,) is the part of its deviation, displacement (m) and rotation vector (rad) in W,
        that comes from joints which lag behind the schedule. It vanishes when they catch up, so it
        is no part of the mean deviation.
        """
        predicted = self._path.quaternion[k]
        turn = matrix_from_quaternion(predicted) @ attitude_error(predicted, quaternion)
        deviation = np.concatenate([position - self._path.position[k], turn]) - lag
        self._lag[:] = lag
        self._recent.append((k, deviation))
        self._masses.add(self._sensitivity[k], deviation)

    def pose(self, k: int) -> tuple[Array, Array]:
        """Return where the base is at instant k: position (3,) and attitude (4,)."""
        return self._displaced(k, self._mean(k) + self._lag)

    def end(self, k: int) -> tuple[Array, Array]:
        """Return where the path leads to from instant k, if the base moves as predicted."""
        mean = self._mean(k)
        position, quaternion = self._displaced(k, mean)
        turn = quaternion_from_rotvec(mean[3:])
        way = self._path.position[-1] - self._path.position[k]
        ahead = attitude_error(self._path.quaternion[k], self._path.quaternion[-1])
        return (
            position + matrix_from_quaternion(turn) @ way,
            quaternion_multiply(quaternion, quaternion_from_rotvec(ahead)),
        )

    def expected_end(self, k: int) -> tuple[Array, Array]:
        """Return where the path leads to with the estimated errors of masses: (3,) and (4,)."""
        position, quaternion = self.end(k)
        more = self._of_masses(k, -1)
        turn = quaternion_from_rotvec(more[3:])
        return position + more[:3], quaternion_multiply(turn, quaternion)

    def _displaced(self, k: int, deviation: Array) -> tuple[Array, Array]:
        turn = quaternion_from_rotvec(deviation[3:])
        position = self._path.position[k] + deviation[:3]
        return position, quaternion_multiply(turn, self._path.quaternion[k])

    def _of_masses(self, begin: int, end: int) -> Array:
        """Return the change of the deviation (6,) between instants by errors of masses."""
        return np.asarray((self._sensitivity[end] - self._sensitivity[begin]) @ self._masses.errors)

    def _mean(self, k: int) -> Array:
        if not self._recent:
            return np.zeros(6)
        return np.asarray(np.mean([d + self._of_masses(i, k) for i, d in self._recent], axis=0))
