"""What the joints may do while a manoeuvre is planned."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from spacerobot_ros.errors import ParameterError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array

_FREE_SPAN = np.pi
"""Half of the stroke that a guess uses of a joint without limits, rad or m."""


@dataclass(frozen=True)
class MotionLimits:
    """Bounds (n,) of the joints: ``lower`` and ``upper`` in m or rad, ``velocity`` a second,
    ``acceleration`` a second squared.
    """

    lower: Array
    upper: Array
    velocity: Array
    acceleration: Array

    @classmethod
    def of(
        cls,
        robot: SpaceRobot,
        max_velocity: Sequence[float] = (),
        max_acceleration: Sequence[float] = (),
        ramp_time: float = 0.5,
    ) -> MotionLimits:
        """Return the robot's own limits, narrowed by what is given for every joint.

        Without ``max_acceleration`` a joint takes ``ramp_time`` seconds to its full speed.

        Raises
        ------
        ParameterError
            A list has not one number a joint, or a joint without speed limit has none for its
            acceleration.
        """
        velocity = robot.velocity_limit.copy()
        if len(max_velocity):
            velocity = np.minimum(velocity, per_joint(robot, "max_velocity", max_velocity))
        if len(max_acceleration):
            acceleration = per_joint(robot, "max_acceleration", max_acceleration)
        else:
            acceleration = velocity / ramp_time
        for name, v, a in zip(robot.joint_names, velocity, acceleration, strict=True):
            if not (v > 0 and np.isfinite(a) and a > 0):
                raise ParameterError(
                    f"Joint '{name}' is limited to {v:.4g} a second and {a:.4g} a second squared; "
                    "optimal needs a speed above zero and a finite acceleration: see "
                    "optimal.max_acceleration."
                )
        return cls(robot.lower.copy(), robot.upper.copy(), velocity, acceleration)

    def within(self, margin: Array, *shapes: Array) -> MotionLimits:
        """Return limits that keep ``margin`` (n,) from the ends of the strokes.

        Shapes (n,) that are given are admitted all the same.
        """
        # Where two margins overlap the joint keeps to the middle of its stroke.
        with np.errstate(invalid="ignore"):
            room = np.where(
                np.isfinite(self.upper - self.lower), (self.upper - self.lower) / 2, np.inf
            )
        kept = np.minimum(margin, room)
        lower = np.min([self.lower + kept, *shapes], axis=0)
        upper = np.max([self.upper - kept, *shapes], axis=0)
        return replace(
            self, lower=np.maximum(lower, self.lower), upper=np.minimum(upper, self.upper)
        )

    def span(self, q: Array) -> tuple[Array, Array]:
        """Return middle and half width (n,) of the stroke that is finite round ``q`` (n,)."""
        lower = np.maximum(self.lower, q - 2 * _FREE_SPAN)
        upper = np.minimum(self.upper, q + 2 * _FREE_SPAN)
        middle = np.where(np.isfinite(self.lower) & np.isfinite(self.upper), (lower + upper) / 2, q)
        return middle, np.minimum((upper - lower) / 2, _FREE_SPAN)

    def excess(self, positions: Array, period: float) -> tuple[float, float]:
        """Return by what factor held commands would have to be slower, and what they overrun.

        ``positions`` (N + 1, n) are the shapes at ticks of ``period`` seconds, at rest before and
        after. The factor is at most 1 where velocities and accelerations keep their limits; the
        overrun is the farthest that a joint is beyond its stroke, m or rad.
        """
        rest = np.zeros((1, positions.shape[1]))
        rates = np.vstack([rest, np.diff(positions, axis=0) / period, rest])
        speed = np.abs(rates) / self.velocity
        change = np.abs(np.diff(rates, axis=0)) / period / self.acceleration
        beyond = np.maximum(self.lower - positions, positions - self.upper)
        factor = max(float(speed.max(initial=0.0)), float(np.sqrt(change.max(initial=0.0))))
        return factor, float(beyond.max(initial=0.0))


def per_joint(robot: SpaceRobot, option: str, values: Sequence[float]) -> Array:
    """Return an option's list as (n,) numbers.

    Raises
    ------
    ParameterError
        It has another length.
    """
    if len(values) != robot.n:
        raise ParameterError(
            f"optimal.{option} has {len(values)} number(s); robot '{robot.description.name}' has "
            f"{robot.n} joints ({', '.join(robot.joint_names)})."
        )
    return np.asarray(values, dtype=float)
