"""Ten hours of simulated time."""

from __future__ import annotations

import numpy as np
import pytest

from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.resources import robot_file
from spacerobot_ros.simulation.building import build_plant
from spacerobot_ros.simulation.config import PlantConfig

HOURS = 36_000


@pytest.mark.slow
def test_momentum_is_what_it_was_after_ten_hours(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A robot that drifts and turns, its sliders driven to and fro."""
    monkeypatch.setenv("SPACEROBOT_COMPILE", "1")
    p, L = (0.01, 0.0, 0.0), (0.0, 0.0, 0.05)
    config = PlantConfig(
        robot="sliding_masses", tick_rate=20.0, linear_momentum=p, angular_momentum=L
    )
    plant = build_plant(SpaceRobot.from_file(robot_file("sliding_masses")), config, None)
    command = np.zeros(plant.robot.n)
    rng = np.random.default_rng(1)
    ticks = round(HOURS * config.tick_rate)
    for tick in range(ticks):
        if tick % (ticks // 200) == 0:
            command[:] = 1e-3 * rng.standard_normal(plant.robot.n)
        plant.step(command)
    plant.look()
    drift = np.abs(np.asarray(plant.momentum)[:6] - np.array([*p, *L]))
    assert drift.max() < 1e-9
    assert abs(np.linalg.norm(np.asarray(plant.pose)[3:7]) - 1) < 1e-12
    assert np.all(np.isfinite(plant.q))
