"""The plant under efforts: limits of motors, and reaction wheels."""

from __future__ import annotations

import itertools
import math
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import simpson
from support.effort_flights import (
    random_urdf,
    robot_of,
    thrusts,
    tumbling,
    with_effort_limit,
    without_stops,
)
from support.oracles import Array, Motion, PinocchioOracle, assert_agrees
from support.wheels import HULL, WHEELS, text, wheeled_robot

from spacerobot_ros.errors import CommandError, ParameterError, SpaceRobotError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.compilation import BufferedFunction
from spacerobot_ros.model.integration import repeat_step, state_slices
from spacerobot_ros.model.rotations import matrix_from_quaternion
from spacerobot_ros.parameters import configured
from spacerobot_ros.resources import robot_file
from spacerobot_ros.simulation import EffortPlant, InitialState, VelocityPlant
from spacerobot_ros.simulation.actuators import build_plant
from spacerobot_ros.simulation.commands import CommandValidator
from spacerobot_ros.simulation.config import PlantConfig
from spacerobot_ros.simulation.effort_plant import DEFAULT_INTEGRATION_STEP, JointStops

SERVICER = (Path(__file__).parents[2] / "urdf" / "servicer.urdf").read_text(encoding="utf-8")
TICK = 0.01


def drifts(plant: EffortPlant, ticks: int) -> Array:
    """Return the largest relative changes, unforced: linear and angular momentum, energy."""
    series = [plant.momentum.copy()]
    nothing = np.zeros(plant.robot.n)
    for _ in range(ticks):
        plant.step(nothing)
        series.append(plant.momentum.copy())
    ledger = np.array(series)
    parts = (ledger[:, :3], ledger[:, 3:6], ledger[:, 6:])
    change = [np.linalg.norm(part - part[0], axis=1).max() for part in parts]
    return np.array(change) / [np.linalg.norm(part[0]) for part in parts]


# -- without thrust ---------------------------------------------------------------------------


@pytest.mark.parametrize("urdf", [without_stops(SERVICER), random_urdf(1)], ids=["servicer", "any"])
def test_tumbling_keeps_momentum_and_energy(urdf: str) -> None:
    robot = robot_of(urdf)
    start = tumbling(robot, np.random.default_rng(5), 10.0 if robot.total_mass > 100 else 1.0)
    linear, angular, energy = drifts(EffortPlant(robot, 0.1, start), ticks=100)
    assert linear <= 1e-12
    assert angular <= 1e-12
    assert energy <= 1e-11


def test_momenta_are_constant_to_the_last_bit() -> None:
    robot = robot_of(random_urdf(2))
    rng = np.random.default_rng(8)
    x = rng.uniform(-1.0, 1.0, 2 * robot.n + 13)
    x[robot.n : robot.n + 4] /= np.linalg.norm(x[robot.n : robot.n + 4])
    command = np.append(rng.uniform(-1.0, 1.0, robot.n), np.zeros(6))
    after = BufferedFunction(repeat_step(robot.function("flight_step"), 50))(x, command, 0.01)[0]
    *_, p_W, L_W, _ = state_slices(robot.n)
    assert after[p_W].tolist() == x[p_W].tolist()
    assert after[L_W].tolist() == x[L_W].tolist()
    assert np.abs(after - x)[: robot.n].min() > 1e-3


# -- with thrust ------------------------------------------------------------------------------


def test_energy_grows_by_the_work_and_momenta_by_the_impulse() -> None:
    robot = robot_of(random_urdf(3))
    rng = np.random.default_rng(31)
    plant = EffortPlant(robot, TICK, tumbling(robot, rng))
    for effort, wrench in thrusts(rng, robot.n, 5):
        rates: list[Array] = []
        before, q = plant.momentum.copy(), plant.q.copy()
        for tick in range(21):
            if tick:
                plant.step(effort, wrench)
            R_WB = matrix_from_quaternion(plant.pose[3:])
            moment = wrench[3:] + np.cross(-robot.center_of_mass(plant.q), wrench[:3])
            power = wrench @ plant.twist
            rates.append(np.concatenate([R_WB @ wrench[:3], R_WB @ moment, [power]]))
        gained = simpson(np.array(rates), dx=TICK, axis=0)
        # Held efforts do the work of their way.
        gained[6] += effort @ (plant.q - q)
        assert_agrees(plant.momentum - before, gained, 1e-8)


# -- integration ------------------------------------------------------------------------------


def test_error_falls_with_the_fourth_power_of_the_step() -> None:
    robot = robot_of(random_urdf(1))
    rng = np.random.default_rng(61)
    start = tumbling(robot, rng, momentum=5.0)
    effort, wrench = next(thrusts(rng, robot.n, 1))

    def end(step: float) -> Array:
        plant = EffortPlant(robot, 0.64, start, step)
        plant.step(effort, wrench)
        return np.concatenate([plant.pose, plant.q, plant.qdot])

    exact = end(0.0025)
    errors = [float(np.linalg.norm(end(step) - exact)) for step in (0.08, 0.04, 0.02)]
    orders = [math.log2(a / b) for a, b in itertools.pairwise(errors)]
    assert errors[0] > 1e-9
    assert all(3.7 < order < 4.3 for order in orders), (errors, orders)


def test_a_long_tick_is_many_short_ones_in_little_code() -> None:
    robot = robot_of(random_urdf(0))
    rng = np.random.default_rng(71)
    start = tumbling(robot, rng)
    effort, wrench = next(thrusts(rng, robot.n, 1))
    count = 1237
    long = EffortPlant(robot, count * DEFAULT_INTEGRATION_STEP, start)
    short = EffortPlant(robot, DEFAULT_INTEGRATION_STEP, start)
    long.step(effort, wrench)
    for _ in range(count):
        short.step(effort, wrench)
    np.testing.assert_allclose(long.pose, short.pose, atol=1e-11)
    np.testing.assert_allclose(long.q, short.q, atol=1e-11)

    def code(repetitions: int) -> int:
        generator = ca.CodeGenerator("march", {"with_header": False})
        generator.add(repeat_step(robot.function("flight_step", compile=False), repetitions))
        return len(generator.dump())

    assert code(count) < 1.4 * code(1)


# -- the plant under efforts: clipped commands, start and reset, refusals ------------------------


def test_efforts_are_clipped_and_counted() -> None:
    urdf = with_effort_limit(random_urdf(0), 0.5)
    limited, plant = (EffortPlant(robot_of(text), TICK) for text in (urdf, random_urdf(0)))
    assert limited.step([0.5, -2.0, math.sqrt(2)], [1, 2, 3, 4, 5, 6]) is True
    assert plant.step([0.5, -0.5, 0.5], [1, 2, 3, 4, 5, 6]) is False
    assert limited.effort.tolist() == plant.effort.tolist() == [0.5, -0.5, 0.5]
    assert limited.wrench.tolist() == [1, 2, 3, 4, 5, 6]
    assert limited.qdot.tolist() == plant.qdot.tolist()
    assert limited.step([0.0, -2.0, 0.0]) is True
    assert limited.wrench.tolist() == [0.0] * 6
    assert limited.limit_counts["effort"].tolist() == [0, 2, 1]
    assert plant.limit_counts["effort"].tolist() == [0, 0, 0]
    assert limited.limit_counts["stroke"].tolist() == [0, 0, 0]


def test_no_limit_is_none() -> None:
    urdf = with_effort_limit(random_urdf(0), math.inf)
    plant = EffortPlant(robot_of(urdf), 1e-4)
    assert plant.step([1e6, -1e6, 1e6]) is False
    assert plant.effort.tolist() == [1e6, -1e6, 1e6]


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_commands_that_are_not_finite_are_refused(bad: float) -> None:
    plant = EffortPlant(robot_of(random_urdf(0)), TICK)
    plant.step([0.1, 0.2, -0.1], [0.3, 0, 0, 0, 0, 0.1])
    before = plant.pose.tolist() + plant.momentum.tolist()
    for effort, wrench in (([0.1, bad, 0.1], np.zeros(6)), (np.zeros(3), [0, 0, bad, 0, 0, 0])):
        with pytest.raises(CommandError, match="not finite"):
            plant.step(effort, wrench)
        assert plant.pose.tolist() + plant.momentum.tolist() == before
        assert plant.effort.tolist() == [0.0] * 3
    plant.step([0.1, 0.2, -0.1])
    assert np.all(np.isfinite(plant.pose))
    assert plant.limit_counts["effort"].tolist() == [0, 0, 0]


def test_a_tick_without_limits_is_taken_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Stops are only looked at where a joint touches one: a tick is one compiled function."""
    plant = EffortPlant(robot_of(random_urdf(0)), TICK)
    taken: list[Any] = []
    advance = JointStops.advance

    def counted(*arguments: Any) -> Any:
        taken.append(arguments)
        return advance(*arguments)

    monkeypatch.setattr(JointStops, "advance", counted)
    for _ in range(20):
        assert plant.step([0.01, -0.02, 0.01], [0.1, 0, 0, 0, 0, 0]) is False
    assert taken == []
    plant.hold(np.array([False, True, False]))
    plant.step([0.01, -0.02, 0.01])
    assert len(taken) == 1


def test_motion_beyond_numbers_is_refused_and_undone() -> None:
    plant = EffortPlant(robot_of(with_effort_limit(random_urdf(0), math.inf)), TICK)
    before = plant.pose.tolist()
    with pytest.raises(SpaceRobotError, match="no longer finite"):
        plant.step([1e200, 1e200, 1e200])
    assert plant.pose.tolist() == before


@pytest.mark.parametrize("plant", [EffortPlant, VelocityPlant])
@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf])
def test_durations_must_be_positive(plant: Any, value: float) -> None:
    robot = robot_of(random_urdf(0))
    with pytest.raises(ParameterError, match="control period must be positive"):
        plant(robot, value)
    with pytest.raises(ParameterError, match="integration step must be positive"):
        plant(robot, TICK, integration_step=value)


# -- reaction wheels of a plant under efforts: at their largest rate, at rest, and their ---------


SPIN = np.array([199.99, -300.5, 0.0, -20.0])


@pytest.fixture(scope="module")
def plant() -> EffortPlant:
    return EffortPlant(wheeled_robot(), 0.02, InitialState(joint_velocities=SPIN), 0.01)


@pytest.mark.slow
def test_a_wheel_at_its_largest_rate_gets_no_faster_and_is_braked(plant: EffortPlant) -> None:
    plant.reset()
    counted = plant.limit_counts["effort"].copy()
    assert plant.step([0.3, -0.2, 0.0, 0.0])
    np.testing.assert_allclose(plant.effort, [0.3, 0.0, 0.0, 0.0])
    assert plant.qdot[0] > 200.0, "the torque of a tick is held"
    assert plant.step([0.3, -0.2, 0.0, -0.5])
    np.testing.assert_allclose(plant.effort, [0.0, 0.0, 0.0, -0.3])
    assert (plant.limit_counts["effort"] - counted).tolist() == [1, 2, 0, 1]
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


HOUR = 3_600
P_W, L_W = (0.01, 0.0, -0.004), (0.02, 0.0, 0.05)
GIVEN = np.array([*P_W, *L_W])


@pytest.mark.slow
def test_an_arm_that_motors_drive_for_an_hour_keeps_both_momenta_and_at_last_its_energy(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Efforts of another direction every three minutes, with friction; in the last minutes none.

    Without friction and motors the robot is left to itself, so its energy stays then. What
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
    ticks, free = round(HOUR * config.tick_rate), round(0.9 * HOUR * config.tick_rate)
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
    print(f"\nmomentum {drift:.2g}, energy {loss:.2g} at last, joints up to {fastest:.2g}")
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
