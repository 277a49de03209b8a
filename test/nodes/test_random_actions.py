"""Random actions of operators on stacks; what they publish is checked state by state.

`make actions` does many. A violation names the seed, the last actions and the last messages;
`make actions SEED=... ONLY=...` does the same actions again (in lockstep with the same states).
"""

from __future__ import annotations

import os

import pytest
from support.random_actions.flight import RandomFlight, random_flights
from support.random_actions.setups import SETUPS
from support.ros_harness import Harness

SEED = int(os.environ.get("SPACEROBOT_ACTIONS_SEED", "1"))
COUNT = int(os.environ.get("SPACEROBOT_ACTIONS", "2000"))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("setup", "real_time"),
    [("planar_manipulator", False), ("sliding_masses", True)],
    ids=["lockstep", "real_time"],
)
def test_some_random_actions_leave_every_state_as_specified(
    harness: Harness, setup: str, real_time: bool
) -> None:
    flight = RandomFlight(harness, SETUPS[setup], seed=3, real_time=real_time)
    flight.run(20)
    assert not flight.figures.violations, flight.figures.violations[0]
    assert flight.figures.states > 100
    assert flight.figures.samples > 3


@pytest.mark.parametrize(
    ("setup", "seed", "count"),
    [("three_joint_arm", 22, 2), ("wheels_and_target", 16, 34)],
    ids=["a twist of 1e308 m/s", "a plant stops before an abort is answered"],
)
def test_actions_that_once_found_a_defect_find_none(
    harness: Harness, setup: str, seed: int, count: int
) -> None:
    flight = RandomFlight(harness, SETUPS[setup], seed, real_time=False)
    flight.run(count)
    assert not flight.figures.violations, flight.figures.violations[0]


@pytest.mark.study
@pytest.mark.parametrize("real_time", [False, True], ids=["lockstep", "real_time"])
@pytest.mark.parametrize("setup", list(SETUPS))
def test_many_random_actions_leave_every_state_as_specified(
    ros_domain: int, setup: str, real_time: bool
) -> None:
    count = -(-COUNT // len(SETUPS))
    figures = random_flights(ros_domain, SETUPS[setup], SEED, count, real_time=real_time)
    print(f"\n{setup}, {'real time' if real_time else 'lockstep'}: {figures}")
    assert not figures.violations, figures.violations[0]
