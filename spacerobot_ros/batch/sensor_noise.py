"""What sensors measure with errors in flights on vector registers; drawn as the plant draws it."""

from __future__ import annotations

import numpy as np

from spacerobot_ros.batch.flights import Controlled, Counts, Flights, SensorErrors
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.rotations import quaternion_from_rotvec, quaternion_multiply


class SensorNoise:
    """The random numbers of the sensors of a block's flights, as :class:`.Sensors` draws them."""

    def __init__(self, flights: Flights, rows: Counts) -> None:
        self._errors: SensorErrors | None = flights.sensors
        self._whole = isinstance(flights.program, Controlled)
        self._instants = flights.instants
        self._n = flights.robot.n
        self._rows = rows
        if self._errors is None:
            return
        self._used = self._errors.used[rows] & self._errors.noise[rows].any(axis=1)
        self._generators = [
            np.random.default_rng(int(seed)) if used else None
            for seed, used in zip(self._errors.seeds[rows], self._used, strict=True)
        ]
        self._at_instants = np.zeros((len(rows), len(self._instants), 12 + 2 * self._n))

    @property
    def commanded_by(self) -> bool:
        """Whether commands follow from what is measured with errors: schedules look at joints."""
        errors = self._errors
        if errors is None:
            return False
        joints = errors.noise[self._rows, 4].any() or errors.joint_bias[self._rows].any()
        return bool(self._whole or joints)

    def drawn(self, begin: int, end: int, alive: Array) -> Array | None:
        """Draw for the states at the ticks from ``begin`` to before ``end``; return what falls to
        joint positions, (groups, ticks, n, lanes), or with a controller to everything. None where
        no command follows from it. ``alive`` (groups, lanes): others need none any more.
        """
        if self._errors is None:
            return None
        ticks, width = end - begin, 12 + 2 * self._n
        columns = slice(0, width) if self._whole else slice(12, 12 + self._n)
        kept = None
        if self.commanded_by:
            kept = np.zeros((len(self._rows), ticks, columns.stop - columns.start))
        chosen = [(i, tick - begin) for i, tick in enumerate(self._instants) if begin <= tick < end]
        drawn = np.empty((ticks, width))
        for index, generator in enumerate(self._generators):
            if generator is None or not alive.flat[index]:
                continue
            generator.standard_normal(out=drawn)
            if kept is not None:
                kept[index] = drawn[:, columns]
            for instant, tick in chosen:
                self._at_instants[index, instant] = drawn[tick]
        if kept is None:
            return None
        grouped = kept.reshape(-1, alive.shape[1], *kept.shape[1:])
        return np.ascontiguousarray(np.moveaxis(grouped, 1, 3))

    def measured(self, pose: Array, q: Array) -> tuple[Array, Array]:
        """Return what is measured of poses (count, I, 7) and shapes (count, I, n)."""
        if self._errors is None:
            return pose, q
        rows, count = self._rows[: len(pose)], len(pose)
        noise = self._errors.noise[rows][:, None]
        bias, drawn = self._errors.pose_bias[rows][:, None], self._at_instants[:count]
        measured = pose.copy()
        measured[..., :3] += bias[..., :3] + noise[..., :1] * drawn[..., :3]
        turns = bias[..., 3:] + noise[..., 1:2] * drawn[..., 3:6]
        for index in np.argwhere(turns.any(axis=2)):
            at = tuple(index)
            measured[at][3:] = quaternion_multiply(pose[at][3:], quaternion_from_rotvec(turns[at]))
        of_joints = noise[..., 4:5] * drawn[..., 12 : 12 + self._n]
        return measured, q + self._errors.joint_bias[rows][:, None] + of_joints
