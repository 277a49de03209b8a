"""Robots and commands for flights under efforts."""

from __future__ import annotations

import re
from collections.abc import Iterator
from functools import cache

import numpy as np
from support.oracles import Array
from support.random_robots import random_robot_urdf

from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.simulation import InitialState


def without_stops(urdf: str) -> str:
    """Return a URDF whose joints never come near the ends of their strokes."""
    return re.sub(r'lower="[^"]*" upper="[^"]*"', 'lower="-1e9" upper="1e9"', urdf)


def with_effort_limit(urdf: str, limit: float) -> str:
    """Return a URDF with one effort limit (N or N m) for all joints."""
    return re.sub(r'effort="[^"]*"', f'effort="{limit!r}"', urdf)


@cache
def robot_of(urdf: str) -> SpaceRobot:
    """Return the model of a robot, built once, since that takes longer than a flight."""
    return SpaceRobot.from_urdf(urdf)


@cache
def random_urdf(seed: int) -> str:
    """Return a random robot of three to six joints without ends to their strokes."""
    return without_stops(random_robot_urdf(np.random.default_rng(seed), joints=3 + seed % 4))


def tumbling(robot: SpaceRobot, rng: np.random.Generator, momentum: float = 1.0) -> InitialState:
    """Return a start anywhere, turned anyhow, with momenta and joint rates."""
    return InitialState(
        position=rng.uniform(-2.0, 2.0, 3),
        quaternion=rng.normal(size=4),
        joint_positions=rng.uniform(-1.0, 1.0, robot.n),
        linear_momentum=momentum * rng.uniform(-1.0, 1.0, 3),
        angular_momentum=momentum * rng.uniform(-1.0, 1.0, 3),
        joint_velocities=rng.uniform(-0.1, 0.1, robot.n),
    )


def thrusts(rng: np.random.Generator, n: int, count: int) -> Iterator[tuple[Array, Array]]:
    """Yield random efforts (n,) and wrenches (6,)."""
    for _ in range(count):
        yield rng.uniform(-1.0, 1.0, n), rng.uniform(-2.0, 2.0, 6)
