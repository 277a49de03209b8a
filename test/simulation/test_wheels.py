"""Reaction wheels of a plant under efforts: at their largest rate, at rest, and their momentum."""

from __future__ import annotations

import numpy as np
import pytest
from support.wheels import HULL, WHEELS, text, wheeled_robot

from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.parameters import configured
from spacerobot_ros.simulation import EffortPlant, InitialState
from spacerobot_ros.simulation.commands import CommandValidator
from spacerobot_ros.simulation.config import PlantConfig

SPIN = np.array([199.99, -300.5, 0.0, -20.0])


@pytest.fixture(scope="module")
def plant() -> EffortPlant:
    return EffortPlant(wheeled_robot(), 0.02, InitialState(joint_velocities=SPIN), 0.01)


@pytest.mark.slow
def test_a_wheel_at_its_largest_rate_gets_no_faster(plant: EffortPlant) -> None:
    plant.reset()
    counted = plant.effort_limited.copy()
    assert plant.step([0.3, -0.2, 0.0, 0.0])
    np.testing.assert_allclose(plant.effort, [0.3, 0.0, 0.0, 0.0])
    assert plant.qdot[0] > 200.0, "the torque of a tick is held"
    assert plant.step([0.3, -0.2, 0.0, -0.5])
    np.testing.assert_allclose(plant.effort, [0.0, 0.0, 0.0, -0.3])
    assert (plant.effort_limited - counted).tolist() == [1, 2, 0, 1]


@pytest.mark.slow
def test_a_wheel_at_its_largest_rate_is_braked(plant: EffortPlant) -> None:
    plant.reset()
    plant.step([-0.4, 0.4, 0.0, 0.0])
    np.testing.assert_allclose(plant.effort, [-0.3, 0.2, 0.0, 0.0])
    assert plant.qdot[0] < 199.9
    assert plant.qdot[1] > -300.5


@pytest.mark.parametrize(
    ("parts", "moving"), [((), (2,)), ((HULL, *WHEELS[:2]), ())], ids=["arm", "wheels alone"]
)
def test_wheels_go_on_spinning_when_joints_are_braked(
    parts: tuple[str, ...], moving: tuple[int, ...], plant: EffortPlant
) -> None:
    if parts:
        robot = SpaceRobot.from_urdf(text(*parts))
        plant = EffortPlant(robot, 0.02, InitialState(joint_velocities=SPIN[:2]), 0.01)
    plant.reset()
    plant.qdot[list(moving)], plant.twist[:] = 0.1, 0.0
    validator = CommandValidator(plant, configured(PlantConfig, {"actuation": "effort"}))
    validator.rest()
    effort, _ = validator.begin_step()
    assert np.flatnonzero(effort).tolist() == list(moving)
    assert all(effort[list(moving)] < 0)
