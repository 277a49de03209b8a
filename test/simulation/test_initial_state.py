"""Where a run starts, and what is refused."""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import numpy as np
import pytest
from support.oracles import PinocchioOracle
from support.random_robots import random_robot_urdf

from spacerobot_ros.errors import ParameterError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.simulation import EffortPlant, InitialState, VelocityPlant
from spacerobot_ros.simulation.config import PlantConfig

URDF = random_robot_urdf(np.random.default_rng(0), joints=3)
PLANTS = (EffortPlant, VelocityPlant)


@cache
def robot() -> SpaceRobot:
    return SpaceRobot.from_urdf(URDF)


@pytest.mark.parametrize("plant", PLANTS)
def test_center_of_mass_is_where_it_is_put(plant: Any) -> None:
    rng = np.random.default_rng(1)
    center = np.array([1.0, -2.0, 0.5])
    start = InitialState(
        quaternion=rng.normal(size=4),
        joint_positions=rng.uniform(-1, 1, 3),
        center_of_mass=center,
    )
    built = plant(robot(), 0.01, start)
    oracle = PinocchioOracle(URDF, robot().joint_names)
    oracle.set_configuration(built.q, built.pose[3:], built.pose[:3])
    np.testing.assert_allclose(oracle.center_of_mass_W(), center, atol=1e-13)


def test_position_given_twice_is_refused() -> None:
    with pytest.raises(ParameterError, match="given twice"):
        InitialState(position=np.array([0.0, 0.1, 0.0]), center_of_mass=np.zeros(3))
    assert InitialState(center_of_mass=np.zeros(3)).center_of_mass is not None


def test_joints_under_velocity_commands_start_at_rest() -> None:
    with pytest.raises(ParameterError, match="start at rest"):
        VelocityPlant(robot(), 0.01, InitialState(joint_velocities=np.array([0.0, 0.1, 0.0])))
    plant = VelocityPlant(robot(), 0.01, InitialState(joint_velocities=np.zeros(3)))
    assert plant.qdot.tolist() == [0.0] * 3


@pytest.mark.parametrize("plant", PLANTS)
@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        ({"joint_positions": np.zeros(2)}, r"joint positions are 2 numbers; robot 'random' has 3"),
        ({"joint_positions": np.array([0.0, 3.5, 3.5])}, "outside its limits"),
        ({"joint_positions": np.array([0.0, math.nan, 0.0])}, "positions must be finite"),
        ({"joint_positions": np.array([math.inf] * 3)}, "positions must be finite"),
        ({"joint_velocities": np.zeros(4)}, "joint velocities are 4 numbers"),
        ({"joint_velocities": np.array([0.0, math.inf, 0.0])}, "velocities must be finite"),
        ({"quaternion": np.zeros(4)}, "initial orientation is refused"),
        ({"position": np.array([0.0, math.nan, 0.0])}, "initial position must be finite"),
        ({"center_of_mass": np.array([math.inf, 0.0, 0.0])}, "initial position must be finite"),
        ({"linear_momentum": np.array([0.0, math.nan, 0.0])}, "initial momenta must be finite"),
        ({"angular_momentum": np.array([0.0, 0.0, math.inf])}, "initial momenta must be finite"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else None,
)
def test_refusals(plant: Any, given: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ParameterError, match=sentence):
        plant(robot(), 0.01, InitialState(**given))


def test_what_a_configuration_leaves_open_is_zero_and_the_identity() -> None:
    nothing = dict.fromkeys(
        ("initial_position", "initial_orientation", "linear_momentum", "angular_momentum"), ()
    )
    for config in (PlantConfig(), PlantConfig(**nothing)):  # type: ignore[arg-type]
        start = InitialState.of(config)
        assert start.position.tolist() == [0.0, 0.0, 0.0]
        assert start.quaternion.tolist() == [0.0, 0.0, 0.0, 1.0]
        assert start.linear_momentum.tolist() == [0.0, 0.0, 0.0]
        assert start.angular_momentum.tolist() == [0.0, 0.0, 0.0]
        assert start.joint_positions is start.joint_velocities is start.center_of_mass is None
