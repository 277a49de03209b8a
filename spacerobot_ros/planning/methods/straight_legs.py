"""Motions along straight legs of the shape, each from rest to rest (paper 3, section III).

Under ``u = (2 pi D / T^2) sin(2 pi t / T)``, eqs (12) to (18), a leg D is travelled as
``D (t/T - sin(2 pi t/T) / (2 pi))``: the peak speed is twice the mean.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from spacerobot_ros.errors import PlanningError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array

_NO_MOTION = 1e-9
"""A joint that is to move less than this, m or rad, rests."""


def straight_motion(
    robot: SpaceRobot,
    start: Array,
    ends: Sequence[tuple[Array, float]],
    control_period: float,
    longest: float,
) -> Array:
    """Return the shapes (N + 1, n) at the ticks from ``start`` (n,) through ``ends``.

    The ends are shapes (n,) and how long the legs to them are to take, s. A leg takes longer where
    a joint is slow, a whole number of ticks, and no time where nothing moves.

    Raises
    ------
    PlanningError
        All legs together take more than ``longest`` s.
    """
    starts = [start, *(end for end, _ in ends)]
    legs = [
        (before, end, _duration(robot, end - before, wanted))
        for before, (end, wanted) in zip(starts, ends, strict=False)
    ]
    total = sum(duration for _, _, duration in legs)
    if total > longest:
        slowest = int(np.argmin(robot.velocity_limit))
        joint = robot.description.movable_joints[slowest]
        raise PlanningError(
            f"A motion of {len(legs)} straight legs would take {total:.4g} s, more than longest = "
            f"{longest:.6g} s; the slowest joint is '{joint.name}', which does "
            f"{robot.velocity_limit[slowest]:.3g} {joint.unit}/s."
        )
    pieces = [start[np.newaxis]]
    for before, end, duration in legs:
        tau = np.linspace(0.0, 1.0, 1 + math.ceil(duration / control_period - 1e-9))[1:]
        progress = tau - np.sin(2 * math.pi * tau) / (2 * math.pi)
        pieces.append(before + progress[:, np.newaxis] * (end - before))
        pieces[-1][-1:] = end
    return np.vstack(pieces)


def _duration(robot: SpaceRobot, move: Array, wanted: float) -> float:
    """Return how long a leg takes, s: infinity if a joint without speed is to move."""
    active = np.abs(move) > _NO_MOTION
    if not active.any():
        return 0.0
    with np.errstate(divide="ignore"):
        slowest = np.max(2 * np.abs(move[active]) / robot.velocity_limit[active])
    return max(wanted, float(slowest))
