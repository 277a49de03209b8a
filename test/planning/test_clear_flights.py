"""Flights with noise, wrong masses and corrections: links keep apart, by Pinocchio's distances.

Pairs that a plan does not look at, since an SRDF disables them or they are in contact at the start,
are left out.
"""

from __future__ import annotations

import os
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from planning.test_clear_plans import CLEARANCE, Distances

from spacerobot_ros import fly
from spacerobot_ros.errors import PlanningError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.planning.core.clearance import Clearance
from spacerobot_ros.resources import robot_file

DRAWS = int(os.environ.get("SPACEROBOT_CLEAR_FLIGHTS", "2"))

_MOST_STATES = 1000
"""States of a flight at which Pinocchio measures distances."""

_LARGEST_TURN = {"area_loop": 0.05, "optimal": 0.15}
"""Goals turn the base by 0.02 rad up to this: loops take minutes."""

ERRORS = {
    "plant.sensors.joint_noise": 5e-4,
    "plant.sensors.attitude_noise": 2e-4,
    "plant.sensors.angular_velocity_noise": 1e-4,
    "planner.model_error": 0.2,
    "planner.averaging": 10,
    "planner.rest_tolerance": 1e-3,
    "planner.shape_deadband": 2e-3,
    "planner.attitude_tolerance": 2e-3,
    "planner.joint_tolerance": 1e-2,
    "planner.optimal.time_budget": 20.0,
}

ROBOTS = {
    "three_joint_arm": ((0.0, -0.8, 1.5), ("area_loop", "optimal")),
    "servicer": ((0.0, -1.2, 2.0, 0.0, 0.8, 0.0), ("optimal",)),
    "seven_joint_arm": ((0.0, -0.3, 0.0, -1.8, 0.0, 1.6, 0.4), ("optimal",)),
    "quadruped": ((), ("optimal",)),
}
"""Shape at the start, rad, and methods by robot."""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "method"), [(name, each) for name, (_, given) in ROBOTS.items() for each in given]
)
def test_flights_with_errors_keep_clear(name: str, method: str, tmp_path: Path) -> None:
    robot = SpaceRobot.from_file(robot_file(name))
    start = np.clip(np.array(ROBOTS[name][0] or np.zeros(robot.n)), robot.lower, robot.upper)
    distances = Distances(robot, Clearance(robot.description, CLEARANCE), start, tmp_path)
    rng = np.random.default_rng(77)
    nearest, outcomes, corrections = [], Counter[str](), 0
    for number in range(DRAWS):
        axis = rng.normal(size=3)
        turn = rng.uniform(0.02, _LARGEST_TURN[method]) * axis / np.linalg.norm(axis)
        parameters = {
            **ERRORS,
            "plant.initial_joint_positions": start.tolist(),
            "plant.sensors.seed": number,
            "planner.model_error_seed": number,
        }
        try:
            flight = fly(robot, rotvec=turn, method=method, parameters=parameters)
        except PlanningError as refusal:
            print(f"  {name}, {method}, draw {number}: {refusal}", flush=True)
            outcomes["refused"] += 1
            continue
        outcomes[flight.outcome.value] += 1
        corrections += flight.corrections
        every = 1 + len(flight.q) // _MOST_STATES
        nearest.append(distances.nearest_of(flight.q[::every]))
        print(f"  {name}, {method}, draw {number}: {nearest[-1]:.4f} m", flush=True)
        assert flight.measures.clearance <= nearest[-1] + 1e-5
    listed = ", ".join(f"{count} {outcome}" for outcome, count in outcomes.items())
    smallest = min(nearest, default=np.inf)
    print(
        f"{name}, {method}: {listed}, {corrections} corrections; smallest distance "
        f"{smallest:.4f} m, median {np.median(nearest) if nearest else np.inf:.4f} m",
        flush=True,
    )
    assert len(nearest) >= DRAWS / 2
    assert smallest > 0
