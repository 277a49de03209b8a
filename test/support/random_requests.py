"""Random plan requests of robots of the package."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.rotations import matrix_from_quaternion, quaternion_from_rotvec
from spacerobot_ros.planning import Goal, PlanRequest, RobotState, Tolerance

_MIN_GOAL_ANGLE = 0.05
"""Smallest rotation of a goal, rad."""

_START_SCATTER = 0.3
"""Largest difference of a start's joint position from the case's, m or rad."""


@dataclass(frozen=True)
class Case:
    """A robot's start, options, and kind of goals.

    Attributes
    ----------
    start
        Joint positions, m or rad, near which the plans start.
    options
        Options of the method.
    angle
        Largest rotation of a goal, rad.
    planar
        Whether goals are rotated about the third axis only.
    sliding
        Whether the position of a goal counts as well.
    """

    start: tuple[float, ...]
    options: dict[str, Any]
    angle: float = 1.0
    planar: bool = False
    sliding: bool = False


CASES = {
    "planar_chain": Case((0.0, 0.0), {}, angle=3.0, planar=True),
    "sliding_masses": Case(
        (0.0, 0.0, 0.0),
        {"max_velocity": (0.0647, 0.1871, 0.6550), "max_acceleration": (0.228, 0.643, 3.564)},
        sliding=True,
    ),
    "three_joint_arm": Case((0.0, -math.pi / 4, math.pi / 2), {}),
    "servicer": Case((0.0, -1.2, 2.0, 0.0, 0.8, 0.0), {}),
}
"""Cases by the names of their robots."""


def requests(robot: SpaceRobot, case: Case, count: int, seed: int) -> Iterator[PlanRequest]:
    """Yield random plan requests of a case; the same seed gives the same ones."""
    rng = np.random.default_rng(seed)
    for _ in range(count):
        scattered = np.array(case.start) + rng.uniform(-_START_SCATTER, _START_SCATTER, robot.n)
        q = np.clip(scattered, robot.lower, robot.upper)
        axis = rng.normal(size=3)
        if case.planar:
            axis = np.array([0.0, 0.0, axis[2]])
        angle = rng.uniform(_MIN_GOAL_ANGLE, case.angle)
        turn = quaternion_from_rotvec(axis / np.linalg.norm(axis) * angle)
        position = np.zeros(3)
        if case.sliding:
            last = np.clip(q + rng.uniform(-1.0, 1.0, robot.n), robot.lower, robot.upper)
            there = matrix_from_quaternion(turn) @ robot.center_of_mass(last)
            position = robot.center_of_mass(q) - there
        state = RobotState(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), q)
        yield PlanRequest(state, Goal.checked(position, turn), Tolerance(2e-3, 2e-3))
