"""Random cases of robots that drift: most are planned, and Pinocchio ends where plans say."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pytest
from planning.drifting import END_ERROR, angle_between, flown_by_pinocchio

from spacerobot_ros.errors import NotFoundError, PlanningError, UnreachableError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.rotations import (
    quaternion_from_rotvec,
    quaternion_multiply,
    rotvec_from_quaternion,
)
from spacerobot_ros.planning import RobotState, plan
from spacerobot_ros.resources import robot_file

CASES = int(os.environ.get("SPACEROBOT_DRIFTING_CASES", "1"))
"""Cases of each robot and drift."""

ROBOTS = ("three_joint_arm", "seven_joint_arm", "servicer")

LEAST_PLANNED = {3.0: 0.95, 10.0: 0.95, 30.0: 0.80}
"""Least share of planned cases by the drift over the manoeuvre, deg."""


@dataclass(frozen=True)
class Case:
    """A start that drifts and a goal, from which a robot at rest takes ``at_rest`` s, CPU ``cpu``
    s."""

    robot: SpaceRobot
    state: RobotState
    rotvec: np.ndarray
    at_rest: float
    cpu: float


def cases(name: str, drift: float, count: int) -> Iterator[Case]:
    robot = SpaceRobot.from_file(robot_file(name))
    rng = np.random.default_rng([ROBOTS.index(name), round(drift), 2026])
    low, high = np.maximum(robot.lower, -0.6), np.minimum(robot.upper, 0.6)
    found = 0
    while found < count:
        q, quaternion = rng.uniform(low, high), quaternion_from_rotvec(rng.normal(size=3))
        turn, about = rng.normal(size=(2, 3))
        turn *= rng.uniform(0.05, 0.5) / np.linalg.norm(turn)
        goal = quaternion_from_rotvec(turn)
        p = rng.normal(size=3) * 0.01 * robot.total_mass
        rotvec = rotvec_from_quaternion(quaternion_multiply(quaternion, goal))
        rest = RobotState(rng.normal(size=3), quaternion, q)
        began = time.process_time()
        try:
            schedule = plan(robot, rotvec=rotvec, start=rest, cache=0, base_position=2)
        except PlanningError:
            continue
        cpu = time.process_time() - began
        omega = about / np.linalg.norm(about) * np.radians(drift) / schedule.duration
        L = robot.momentum(quaternion, q, np.zeros(3), omega, np.zeros(robot.n))[1]
        state = RobotState(rest.position, quaternion, q, p, L)
        found += 1
        yield Case(robot, state, rotvec, schedule.duration, cpu)


@pytest.mark.slow
@pytest.mark.parametrize("drift", LEAST_PLANNED)
def test_robots_that_drift_are_planned_for(drift: float) -> None:
    planned, count = 0, 0
    for name in ROBOTS:
        for case in cases(name, drift, CASES):
            count += 1
            began = time.process_time()
            try:
                schedule = plan(
                    case.robot, rotvec=case.rotvec, start=case.state, cache=0, base_position=2
                )
            except (NotFoundError, UnreachableError) as refusal:
                print(f"{name}, {drift:g} deg: {refusal}", flush=True)
                continue
            cpu = time.process_time() - began
            r_WB, quaternion = flown_by_pinocchio(name, schedule, case.state)
            off = angle_between(quaternion, schedule.path.quaternion[-1])
            missed = angle_between(quaternion, quaternion_from_rotvec(case.rotvec))
            print(
                f"{name}, {drift:g} deg: {schedule.duration:.4g} s, {case.at_rest:.4g} s at rest; "
                f"CPU {cpu:.3g} s, {case.cpu:.3g} s at rest; off by {off:.1e} rad",
                flush=True,
            )
            assert max(off, missed) < END_ERROR
            np.testing.assert_allclose(r_WB, schedule.path.position[-1], atol=END_ERROR)
            planned += 1
    print(f"{drift:g} deg: planned {planned} of {count}", flush=True)
    assert planned >= LEAST_PLANNED[drift] * count - (CASES < 7)
