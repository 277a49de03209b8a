"""What an optimal control problem asks, and what its solution is."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from spacerobot_ros.model.description import Array
from spacerobot_ros.planning.methods.optimal.limits import MotionLimits


@dataclass(frozen=True)
class Task:
    """A motion from rest to rest, seen from the attitude that it starts at.

    ``start`` and ``final`` (n,) are shapes (``final`` None: any), ``likely`` (n,) one to end in for
    all that is known before, ``turn`` (4,) is the quaternion of the goal attitude in the starting
    one, ``center`` (3,) where the system's centre of mass is to be in the base at the end, m (None:
    anywhere), ``direction`` (3,) the kept direction of the path constraints in the starting base.
    """

    start: Array
    turn: Array
    likely: Array
    final: Array | None = None
    center: Array | None = None
    direction: Array = field(default_factory=lambda: np.zeros(3))


@dataclass(frozen=True)
class Trajectory:
    """N steps of ``step`` seconds with constant accelerations.

    ``shapes`` and ``velocities`` (N + 1, n) at the knots between them, and the attitude
    ``quaternions`` (N + 1, 4) in the one at the start.
    """

    step: float
    shapes: Array
    velocities: Array
    quaternions: Array

    @property
    def duration(self) -> float:
        """s."""
        return self.step * (len(self.shapes) - 1)

    def at_ticks(self, ticks: int) -> Array:
        """Return the shapes (ticks + 1, n) at equal intervals from the start to the end."""
        steps = len(self.shapes) - 1
        place = np.linspace(0.0, steps, ticks + 1)
        k = np.minimum(place.astype(int), steps - 1)
        tau = (place - k)[:, np.newaxis]
        q, v0, v1 = self.shapes[k], self.velocities[k], self.velocities[k + 1]
        return np.asarray(q + self.step * (v0 * tau + (v1 - v0) * tau**2 / 2))

    def retimed(self, factor: float) -> Trajectory:
        """Return the same path, travelled in ``factor`` times the time."""
        return replace(self, step=self.step * factor, velocities=self.velocities / factor)

    def hurried(self, limits: MotionLimits, shortest: float) -> Trajectory:
        """Return the same path, as fast as the limits allow, in ``shortest`` seconds or more."""
        speed = float((np.abs(self.velocities) / limits.velocity).max())
        change = np.abs(np.diff(self.velocities, axis=0)) / self.step / limits.acceleration
        factor = max(speed, float(np.sqrt(change.max())), shortest / self.duration)
        return self.retimed(factor)
