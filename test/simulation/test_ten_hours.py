"""Ten hours of simulated time."""

from __future__ import annotations

import numpy as np
import pytest
from support.effort_flights import without_stops
from support.oracles import Motion, PinocchioOracle

from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.resources import robot_file
from spacerobot_ros.simulation.actuators import build_plant
from spacerobot_ros.simulation.config import PlantConfig

HOURS = 36_000
P_W, L_W = (0.01, 0.0, -0.004), (0.02, 0.0, 0.05)
GIVEN = np.array([*P_W, *L_W])


@pytest.mark.slow
def test_momentum_is_what_it_was_after_ten_hours(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A robot that drifts and turns, its sliders driven to and fro."""
    monkeypatch.setenv("SPACEROBOT_COMPILE", "1")
    config = PlantConfig(
        robot="sliding_masses", tick_rate=20.0, linear_momentum=P_W, angular_momentum=L_W
    )
    plant = build_plant(SpaceRobot.from_file(robot_file("sliding_masses")), config, None)
    command = np.zeros(plant.robot.n)
    rng = np.random.default_rng(1)
    ticks = round(HOURS * config.tick_rate)
    for tick in range(ticks):
        if tick % (ticks // 200) == 0:
            command[:] = 1e-3 * rng.standard_normal(plant.robot.n)
        plant.step(command)
    plant.apply_active_faults()
    drift = np.abs(np.asarray(plant.momentum)[:6] - GIVEN)
    assert drift.max() < 1e-9
    assert abs(np.linalg.norm(np.asarray(plant.pose)[3:7]) - 1) < 1e-12
    assert np.all(np.isfinite(plant.q))


@pytest.mark.slow
def test_an_arm_that_motors_drive_for_ten_hours_keeps_both_momenta_and_at_last_its_energy(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Efforts of another direction every three minutes, with friction; in the last hour none.

    Without friction and motors the robot is left to itself, so its energy stays in that hour. What
    it is then is Pinocchio's answer, from the state alone.
    """
    monkeypatch.setenv("SPACEROBOT_COMPILE", "1")
    urdf = without_stops(robot_file("servicer").read_text("utf-8"))
    config = PlantConfig(
        robot_description=urdf,
        actuation="effort",
        tick_rate=20.0,
        linear_momentum=P_W,
        angular_momentum=L_W,
    )
    plant = build_plant(SpaceRobot.from_urdf(urdf), config, None)
    rng = np.random.default_rng(2)
    wanted, friction = np.zeros(plant.robot.n), np.array([2.0, 2.5, 1.5, 0.3, 0.25, 0.2])
    ticks, free = round(HOURS * config.tick_rate), round(0.9 * HOURS * config.tick_rate)
    fastest = 0.0
    for tick in range(ticks):
        if tick % 3600 == 0:
            wanted[:] = 0.05 * rng.uniform(-1.0, 1.0, plant.robot.n)
        plant.step(friction * (wanted - plant.qdot) if tick < free else np.zeros(plant.robot.n))
        if tick == free:
            energy = float(plant.momentum[6])
        fastest = max(fastest, float(np.abs(plant.qdot).max()))
    drift = np.abs(np.asarray(plant.momentum)[:6] - GIVEN).max()
    loss = abs(plant.momentum[6] / energy - 1.0)
    print(f"\nmomentum {drift:.2g}, energy {loss:.2g} in the last hour, joints up to {fastest:.2g}")
    assert fastest > 0.04
    assert drift < 1e-9
    assert loss < 1e-6
    assert abs(np.linalg.norm(np.asarray(plant.pose)[3:7]) - 1) < 1e-12
    oracle = PinocchioOracle(urdf, plant.robot.joint_names)
    v_WB_B, omega_WB_B = plant.twist[:3], plant.twist[3:]
    motion = Motion(plant.q, plant.qdot, plant.pose[3:], plant.pose[:3], np.zeros(3), omega_WB_B)
    p, L, kinetic = oracle.momentum(motion, v_WB_B=v_WB_B)
    assert np.abs(np.concatenate([p, L]) - GIVEN).max() < 1e-9
    assert kinetic == pytest.approx(energy, rel=1e-6)
