"""Motions along straight legs of the shape, each from rest to rest (paper 3, section III).

Under ``u = (2 pi D / T^2) sin(2 pi t / T)``, eqs (12) to (18), a leg D is travelled as
``D (t/T - sin(2 pi t/T) / (2 pi))``: the peak speed is twice the mean.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array

NO_MOTION = 1e-9
"""A joint that is to move less than this, m or rad, rests."""


@dataclass(frozen=True)
class StraightLeg:
    """From shape ``start`` to ``end`` (n,) in ``duration`` seconds."""

    start: Array
    end: Array
    duration: float


def straight_legs(
    robot: SpaceRobot, start: Array, ends: Sequence[tuple[Array, float]]
) -> list[StraightLeg]:
    """Return the legs from ``start`` (n,) through shapes (n,) that are to take so many seconds.

    A leg takes longer where a joint is slow, for ever where it has no speed at all, and no time
    where nothing moves.
    """
    legs: list[StraightLeg] = []
    for end, wanted in ends:
        legs.append(StraightLeg(start, end, _duration(robot, end - start, wanted)))
        start = end
    return legs


def total_duration(legs: Sequence[StraightLeg]) -> float:
    """Return how long legs take together, s."""
    return sum(leg.duration for leg in legs)


def shapes_at_ticks(start: Array, legs: Sequence[StraightLeg], tick_period: float) -> Array:
    """Return the shapes (N + 1, n) at the ticks, each leg a whole number of them."""
    pieces = [start[np.newaxis]]
    for leg in legs:
        tau = np.linspace(0.0, 1.0, 1 + math.ceil(leg.duration / tick_period - 1e-9))[1:]
        progress = tau - np.sin(2 * math.pi * tau) / (2 * math.pi)
        pieces.append(leg.start + progress[:, np.newaxis] * (leg.end - leg.start))
        pieces[-1][-1:] = leg.end
    return np.vstack(pieces)


def _duration(robot: SpaceRobot, move: Array, wanted: float) -> float:
    active = np.abs(move) > NO_MOTION
    if not active.any():
        return 0.0
    # A joint without speed takes for ever.
    with np.errstate(divide="ignore"):
        slowest = np.max(2 * np.abs(move[active]) / robot.velocity_limit[active])
    return max(wanted, float(slowest))
