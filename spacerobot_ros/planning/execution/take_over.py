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


_PRIOR = 0.02
"""Weight of no error of the model, rad^2: noise of a milliradian, and errors of a few per cent."""

_WINDOW = 8
"""Instants of a path from the turns between which the error of the model is learnt."""


class TurnModelError:
    """By how much a base turns otherwise than predicted, since its masses are not quite known.

    Where the prediction is the rotation vector w, in base components, it turns by ``w + E w``. The
    estimate of E is that of least squares over all measurements.
    """

    def __init__(self) -> None:
        self._squares, self._products = _PRIOR * np.eye(3), np.zeros((3, 3))

    def add(self, predicted: Array, error: Array) -> None:
        """Add that the base turned by ``predicted + error`` instead of ``predicted``, (3,) each."""
        self._squares += np.outer(predicted, predicted)
        self._products += np.outer(error, predicted)

    def expected(self, predicted: Array) -> Array:
        """Return E w (3,) for a turn w that is predicted."""
        return np.asarray(self._products @ np.linalg.solve(self._squares, predicted))


class PathDeviation:
    """By how much the measured base is off a predicted path, averaged over the last measurements.

    Parameters
    ----------
    path
        The prediction.
    count
        Measurements to average.
    model
        What is known of the robot's turns, and is learnt from these measurements.
    """

    def __init__(self, path: BasePath, count: int, model: TurnModelError | None = None) -> None:
        self._path = path
        self._recent: deque[Array] = deque(maxlen=count)
        self._model = model or TurnModelError()
        self._window: deque[tuple[int, Array]] = deque(maxlen=_WINDOW)

    def add(self, k: int, position: Array, quaternion: Array) -> None:
        """Add a measured position (3,) and attitude (4,) at instant k of the path."""
        predicted = self._path.quaternion[k]
        turn = matrix_from_quaternion(predicted) @ attitude_error(predicted, quaternion)
        self._recent.append(np.concatenate([position - self._path.position[k], turn]))
        self._window.append((k, turn))
        if len(self._window) == _WINDOW:
            begin, offset = self._window[0]
            to_base = matrix_from_quaternion(self._path.quaternion[begin]).T
            turned = attitude_error(self._path.quaternion[begin], predicted)
            self._model.add(turned, to_base @ (turn - offset))

    def pose(self, k: int) -> tuple[Array, Array]:
        """Return where the base is at instant k: position (3,) and attitude (4,)."""
        mean = self._mean()
        turn = quaternion_from_rotvec(mean[3:])
        return (
            self._path.position[k] + mean[:3],
            quaternion_multiply(turn, self._path.quaternion[k]),
        )

    def end(self, k: int) -> tuple[Array, Array]:
        """Return where the path leads to from instant k, if the base turns as predicted."""
        position, quaternion = self.pose(k)
        turn = quaternion_from_rotvec(self._mean()[3:])
        way = self._path.position[-1] - self._path.position[k]
        return (
            position + matrix_from_quaternion(turn) @ way,
            quaternion_multiply(quaternion, quaternion_from_rotvec(self._ahead(k))),
        )

    def extra_turn(self, k: int) -> Array:
        """Return by what rotation vector (3,) the base will turn more from instant k to the end."""
        attitudes, extra = self._path.quaternion, np.zeros(3)
        to_end = matrix_from_quaternion(attitudes[-1]).T
        for i in range(k, len(attitudes) - 1, _WINDOW):
            following = attitudes[min(i + _WINDOW, len(attitudes) - 1)]
            more = self._model.expected(attitude_error(attitudes[i], following))
            extra += to_end @ matrix_from_quaternion(following) @ more
        return extra

    def _ahead(self, k: int) -> Array:
        return attitude_error(self._path.quaternion[k], self._path.quaternion[-1])

    def _mean(self) -> Array:
        return np.asarray(np.mean(self._recent, axis=0)) if self._recent else np.zeros(6)
