"""Flights on thrusters as they are: ledger, propellant, faults, refusals."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import yaml
from support.effort_flights import robot_of, tumbling
from support.oracles import Array

from spacerobot_ros.errors import CommandError, ParameterError, RobotDescriptionError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.rotations import matrix_from_quaternion
from spacerobot_ros.simulation import EffortPlant, InitialState
from spacerobot_ros.simulation.actuators import (
    PlantWithFaults,
    ThrusterPlant,
    thrusters_in,
    with_thrusters,
)

ROOT = Path(__file__).parents[2]
SERVICER = (ROOT / "urdf" / "servicer.urdf").read_text(encoding="utf-8")
TICK = 0.01
SHAPE = np.array([0.0, -1.2, 2.0, 0.0, 0.8, 0.0])


def flying(
    robot: SpaceRobot | None = None, initial: InitialState | None = None, excluded: str = ""
) -> ThrusterPlant:
    start = initial or InitialState(joint_positions=SHAPE)
    plant = EffortPlant(robot or robot_of(SERVICER), TICK, start)
    thrusters = thrusters_in(with_thrusters(plant, TICK, "urdf", excluded))
    assert thrusters is not None
    return thrusters


def wanted(rng: np.random.Generator) -> Array:
    return rng.uniform(-1.0, 1.0, 6) * [8.0, 8.0, 8.0, 3.0, 3.0, 3.0]


def test_momenta_are_what_the_thrusters_put_in() -> None:
    robot, rng = robot_of(SERVICER), np.random.default_rng(2)
    plant = flying(robot, tumbling(robot, rng, momentum=5.0))
    impulse, linear = np.zeros(3), plant.momentum[:3].copy()
    used, on_time = 0.0, np.zeros(24)
    force_B = plant.table.direction_B * plant.table.force[:, None]
    for tick in range(300):
        if tick % 20 == 0:
            wrench, effort = wanted(rng), rng.uniform(-1.0, 1.0, robot.n)
        middle = plant.pose[3:].copy()
        plant.step(effort, wrench)
        middle = middle + plant.pose[3:] * math.copysign(1.0, middle @ plant.pose[3:])
        R_WB = matrix_from_quaternion(middle / np.linalg.norm(middle))
        # By hand from what each thruster gave, through the attitude in the middle of the tick.
        impulse += TICK * R_WB @ (plant.duty @ force_B)
        used += TICK * float(np.sum(plant.thrust / (9.80665 * 290.0)))
        on_time += TICK * plant.duty
        ledger, expected = plant.momentum[:6], plant.expected_momenta
        assert np.linalg.norm(ledger - expected) <= 1e-12 * np.linalg.norm(ledger)
    np.testing.assert_allclose(plant.momentum[:3] - linear, impulse, atol=1e-5)
    assert np.linalg.norm(impulse) > 1.0
    assert plant.propellant == pytest.approx(used, rel=1e-12)
    assert plant.propellant == pytest.approx(on_time.sum() * 10.0 / (9.80665 * 290.0), rel=1e-12)
    np.testing.assert_allclose(plant.on_time, on_time, rtol=1e-12)
    assert 24 < plant.pulses.sum() < 300 * 6
    assert plant.unmet_ticks == 0


@pytest.mark.slow
def test_thrusters_follow_the_ideal_wrench() -> None:
    """With pulses as short as one likes they give the wanted wrench to rounding; with 20 ms they
    end near the ideal flight."""
    instant = SERVICER.replace('min_on_time="0.02"', 'min_on_time="0"')
    start = InitialState(joint_positions=SHAPE)
    ideal = EffortPlant(robot_of(SERVICER), TICK, start)
    exact, pulsed = flying(robot_of(instant)), flying()
    rng = np.random.default_rng(4)
    nothing = np.zeros(6)
    for tick in range(300):
        if tick % 60 == 0:
            wrench = wanted(rng)
        for plant in (ideal, exact, pulsed):
            plant.step(nothing, wrench)
    np.testing.assert_allclose(exact.pose, ideal.pose, atol=1e-9)
    np.testing.assert_allclose(exact.wrench, wrench, atol=1e-9)
    moved = np.linalg.norm(ideal.pose[:3])
    assert moved > 0.03
    # A shortest pulse is 0.2 N s, 0.44 mm/s of this spacecraft.
    assert np.linalg.norm(pulsed.pose[:3] - ideal.pose[:3]) < 5.0 * 0.44e-3
    assert not np.array_equal(pulsed.pose, ideal.pose)


def test_a_thruster_may_be_weak_dead_or_stuck() -> None:
    push = np.array([20.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    sound, broken = flying(), flying()
    by_name = {name: i for i, name in enumerate(broken.table.names)}
    broken.thruster_health[by_name["plus_x_1"]] = 0.5
    broken.thruster_health[by_name["plus_x_2"]] = 0.0
    broken.stuck_on[by_name["minus_y_1"]] = True
    for _ in range(50):
        sound.step(np.zeros(6), push)
        broken.step(np.zeros(6), push)
    change = broken.thrust - sound.thrust
    assert change[by_name["minus_y_1"]] == pytest.approx(10.0)
    assert change[by_name["plus_x_1"]] == pytest.approx(-0.5 * sound.thrust[by_name["plus_x_1"]])
    assert broken.thrust[by_name["plus_x_2"]] == 0.0
    assert broken.on_time[by_name["minus_y_1"]] == pytest.approx(0.5)
    # What they put in is what the system has.
    np.testing.assert_allclose(broken.momentum[:6], broken.expected_momenta, atol=1e-12)
    assert broken.momentum[1] == pytest.approx(-10.0 * 0.5, rel=0.05)


def test_propellant_is_what_the_thrust_took_whatever_was_commanded() -> None:
    """By hand: F dt / (g0 Isp) of every thruster, weak, dead and stuck ones too."""
    plant = flying()
    plant.thruster_health[:] = np.linspace(0.0, 1.0, 24)
    plant.stuck_on[5] = True
    used, rng = 0.0, np.random.default_rng(8)
    for _ in range(40):
        plant.step(np.zeros(6), wanted(rng))
        np.testing.assert_allclose(plant.thrust, 10.0 * plant.thruster_health * plant.duty)
        used += TICK * float(plant.thrust.sum()) / (9.80665 * 290.0)
    assert plant.propellant == pytest.approx(used, rel=1e-12)
    assert used > 0.0


def test_allocation_that_knows_of_a_dead_thruster_gives_the_whole_wrench() -> None:
    push = np.array([15.0, 0.0, 0.0, 0.0, 1.0, 0.0])
    plant = flying(excluded="plus_x_1 plus_y_3")
    plant.exclude("minus_z_2")
    assert plant.missing == ""
    impulse = np.zeros(6)
    for _ in range(100):
        plant.step(np.zeros(6), push)
        impulse += TICK * plant.wrench
    np.testing.assert_allclose(impulse, push, atol=6 * 0.2)
    assert plant.unmet_ticks == 0
    names = plant.table.names
    dead = [names.index(name) for name in ("plus_x_1", "plus_y_3", "minus_z_2")]
    assert plant.on_time[dead].tolist() == [0.0] * 3


def test_too_much_is_counted_and_reset_keeps_what_was_used() -> None:
    plant = flying()
    for _ in range(10):
        plant.step(np.zeros(6), [0.0, 0.0, 500.0, 0.0, 0.0, 0.0])
    assert plant.unmet_ticks > 5
    # Four thrusters of 10 N push along z.
    assert plant.unmet[2] == pytest.approx(460.0)
    used, on_time = plant.propellant, plant.on_time.copy()
    plant.reset()
    assert plant.wrench.tolist() == [0.0] * 6
    np.testing.assert_allclose(plant.pose[:3], 0.0, atol=1e-15)
    plant.step(np.zeros(6))
    assert (plant.propellant, plant.on_time.tolist()) == (used, on_time.tolist())


def test_commands_that_are_not_finite_are_refused_before_anything_fires() -> None:
    plant = flying()
    for effort, wrench in ((np.zeros(6), np.full(6, np.nan)), (np.full(6, np.inf), np.ones(6))):
        with pytest.raises(CommandError, match="not finite"):
            plant.step(effort, wrench)
    assert plant.propellant == 0.0
    assert plant.momentum.tolist() == [0.0] * 7


def test_where_thrusters_come_from(tmp_path: Path) -> None:
    plant = EffortPlant(robot_of(SERVICER), TICK)
    assert with_thrusters(plant, TICK, "") is plant
    assert thrusters_in(plant) is None
    table = tmp_path / "one.yaml"
    one = {"name": "main", "position": [-0.6, 0, 0], "force": 22, "isp": 230}
    table.write_text(yaml.safe_dump({"thrusters": [one]}), encoding="utf-8")
    thrusters = with_thrusters(plant, TICK, str(table))
    assert isinstance(thrusters, ThrusterPlant)
    assert "negative force along x" in thrusters.missing
    assert thrusters_in(PlantWithFaults(thrusters, (), TICK, wrench=True)) is thrusters
    with pytest.raises(ParameterError, match="no thruster 'nose'"):
        with_thrusters(plant, TICK, str(table), "nose")
    bare = SERVICER.replace("<thruster", "<!--").replace("</thruster>", "-->")
    with pytest.raises(RobotDescriptionError, match="has no <thruster> elements"):
        with_thrusters(EffortPlant(robot_of(bare), TICK), TICK, "urdf")


def test_faults_of_the_wrench_act_on_the_thrusters_and_not_on_what_is_asked_of_them() -> None:
    """A component that is stuck, off or weak is so in every tick, whatever pulses begin."""
    faults = ("thruster_stuck force_y 3.5", "thruster_off torque_x", "thruster_weak force_x 0.5")
    sound, inner = flying(), flying()
    broken = PlantWithFaults(inner, faults, TICK, wrench=True)
    rng = np.random.default_rng(4)
    for _ in range(40):
        command = wanted(rng)
        sound.step(np.zeros(6), command)
        broken.step(np.zeros(6), command)
        np.testing.assert_array_equal(inner.duty, sound.duty)
        expected = sound.wrench * [0.5, 0.0, 1.0, 0.0, 1.0, 1.0] + [0.0, 3.5, 0.0, 0.0, 0.0, 0.0]
        np.testing.assert_array_equal(inner.wrench, expected)
    np.testing.assert_allclose(broken.momentum[:6], broken.expected_momenta, atol=1e-12)
    broken.inject("clear")
    broken.step(np.zeros(6), command)
    assert inner.wrench_fault is None
