"""Plans to goals with a position or a shape are hardly longer than those of long searches."""

from __future__ import annotations

import os
import statistics
import time

import numpy as np
import pytest

from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.rotations import matrix_from_quaternion, quaternion_from_rotvec
from spacerobot_ros.planning import Goal, PlanRequest, RobotState, Tolerance
from spacerobot_ros.planning.methods.optimal.method import OptimalGait
from spacerobot_ros.planning.methods.optimal.problem import OptimalOptions
from spacerobot_ros.resources import robot_file

GOALS = int(os.environ.get("SPACEROBOT_LONG_SEARCHES", "1"))
"""Goals of each robot."""

ROBOTS = ("seven_joint_arm", "servicer", "three_joint_arm")
"""Arms that control the position of the base, and one that does not."""

STARTS = 60
"""Guesses of a long search, which no agreement ends."""

PERIOD = 0.05


def goal_of(robot: SpaceRobot, start: Array, number: int, rng: np.random.Generator) -> Goal:
    """Return an attitude with a shape or, every second time, with a reachable position."""
    last = rng.uniform(np.maximum(robot.lower, -1.2), np.minimum(robot.upper, 1.2))
    axis = rng.normal(size=3)
    turn = quaternion_from_rotvec(axis / np.linalg.norm(axis) * rng.uniform(0.1, 0.8))
    if number % 2:
        return Goal.checked(np.zeros(3), turn, last)
    there = matrix_from_quaternion(turn) @ robot.center_of_mass(last)
    return Goal.checked(robot.center_of_mass(start) - there, turn)


@pytest.mark.slow
def test_plans_are_as_short_as_those_of_long_searches() -> None:
    """At least 97 % of the durations are within 2 % of those by a search from sixty guesses."""
    ratios: list[float] = []
    for name in ROBOTS:
        robot = SpaceRobot.from_file(robot_file(name))
        rng = np.random.default_rng([ROBOTS.index(name), 604])
        plain = OptimalGait(robot, PERIOD, options=OptimalOptions(cache=0))
        options = OptimalOptions(cache=0, starts=STARTS, answers=STARTS, agreeing=0)
        long = OptimalGait(robot, PERIOD, options=options)
        times: list[float] = []
        for number in range(GOALS):
            q = rng.uniform(np.maximum(robot.lower, -1.2), np.minimum(robot.upper, 1.2))
            state = RobotState(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), q)
            goal = goal_of(robot, q, number, rng)
            request = PlanRequest(state, goal, Tolerance(np.inf if number % 2 else 2e-3, 2e-3))
            began = time.process_time()
            here = plain.plan(request).duration
            times.append(time.process_time() - began)
            there = long.plan(request).duration
            ratios.append(here / there)
            kind = "shape" if number % 2 else "position"
            print(
                f"{name}, {kind}: {here:.5g} s, {there:.5g} s by a search from {STARTS} guesses, "
                f"{times[-1]:.2f} s of CPU time",
                flush=True,
            )
        slowest = max(times) / statistics.median(times)
        print(f"{name}: the slowest plan takes {slowest:.1f} times the median", flush=True)
    within = np.mean(np.array(ratios) <= 1.02)
    print(f"{len(ratios)} goals: {within:.1%} within 2 %, the worst {max(ratios):.3f} times")
    assert within >= 0.97
