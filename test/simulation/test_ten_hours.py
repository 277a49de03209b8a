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
@pytest.mark.parametrize(
    ("robot", "settings"),
    [
        ("sliding_masses", {"actuation": "velocity", "tick_rate": 20.0}),
        ("planar_manipulator", {"actuation": "effort", "tick_rate": 10.0}),
    ],
)
def test_momentum_is_what_it_was_after_ten_hours(
    robot: str, settings: dict[str, object], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A robot that drifts and turns, its joints driven to and fro."""
    monkeypatch.setenv("SPACEROBOT_COMPILE", "1")
    given = {"linear_momentum": (0.01, 0.0, 0.0), "angular_momentum": (0.0, 0.0, 0.05)}
    config = PlantConfig(robot=robot, **given, **settings)  # type: ignore[arg-type]
    plant = build_plant(SpaceRobot.from_file(robot_file(robot)), config, None)
    commands = [np.zeros(plant.robot.n)]
    if settings["actuation"] == "effort":
        commands.append(np.zeros(6))
    rng = np.random.default_rng(1)
    ticks = round(HOURS * config.tick_rate)
    for tick in range(ticks):
        if tick % (ticks // 200) == 0:
            commands[0][:] = 1e-3 * rng.standard_normal(plant.robot.n)
        plant.step(*commands)
    plant.look()
    drift = np.abs(np.asarray(plant.momentum)[:6] - np.ravel(list(given.values())))
    assert drift.max() < 1e-9
    assert abs(np.linalg.norm(np.asarray(plant.pose)[3:7]) - 1) < 1e-12
    assert np.all(np.isfinite(plant.q))
