"""Plants from their configuration: which steps are refused, and what the steps do."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from spacerobot_ros.errors import ParameterError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.resources import robot_file
from spacerobot_ros.simulation.actuators import PLANTS, build_plant
from spacerobot_ros.simulation.config import PlantConfig
from spacerobot_ros.simulation.plant import InitialState

ARM = SpaceRobot.from_file(robot_file("three_joint_arm"))


def config(**parameters: Any) -> PlantConfig:
    return PlantConfig(**{"tick_rate": 10.0, **parameters})


@pytest.mark.parametrize("step", [0.9e-5, 1e-300])
def test_steps_that_lose_more_than_they_gain_are_refused(step: float) -> None:
    with pytest.raises(ParameterError, match=r"must be 0 .* or at least 1e-05 s"):
        build_plant(ARM, config(integration_step=step))


def test_more_steps_in_a_tick_than_anybody_waits_for_are_refused() -> None:
    with pytest.raises(ParameterError, match=r"more than 1e\+06 steps in a tick of 10.1 s"):
        build_plant(ARM, config(tick_rate=1 / 10.1, integration_step=1e-5))


def test_steps_of_the_configuration_are_taken() -> None:
    """One Runge-Kutta step of half a second is off by its fifth power; shorter ones are not."""
    ends = {}
    for step in (0.0, 0.5, 0.25, 0.01):
        plant = build_plant(
            ARM, config(tick_rate=2.0, integration_step=step, angular_momentum=(30.0, -50.0, 40.0))
        )
        for _ in range(4):
            plant.step(np.array([0.4, -0.3, 0.45]))
        ends[step] = plant.pose[3:].copy()
    exact = ends[0.01]
    errors = {step: float(np.abs(end - exact).max()) for step, end in ends.items()}
    assert errors[0.5] > 4 * errors[0.25] > 4e-9
    assert errors[0.0] < errors[0.25], "the default is a short step"


def test_an_initial_state_takes_the_place_of_that_of_the_configuration() -> None:
    given = config(initial_joint_positions=(0.1, -0.2, 0.3), initial_position=(1.0, 2.0, 3.0))
    assert build_plant(ARM, given).q.tolist() == [0.1, -0.2, 0.3]
    other = InitialState(joint_positions=np.array([0.3, -0.1, 0.2]))
    assert build_plant(ARM, given, other).q.tolist() == [0.3, -0.1, 0.2]


def test_thrusters_need_a_plant_that_takes_a_wrench() -> None:
    assert {name: kind.wrench for name, kind in PLANTS.items()} == {
        "velocity": False,
        "effort": True,
    }
    with pytest.raises(ParameterError, match="has no wrench on the base"):
        build_plant(ARM, config(actuation="velocity", thrusters="urdf"))
