"""Faults of actuators: their lines, their times, and what a plant with them does."""

from __future__ import annotations

import itertools
from contextlib import suppress
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.effort_flights import random_urdf, robot_of, thrusts, tumbling
from support.oracles import Array, PinocchioOracle
from support.sentences import assert_one_sentence

from spacerobot_ros.errors import ParameterError, SpaceRobotError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.resources import robot_file
from spacerobot_ros.simulation import EffortPlant, VelocityPlant
from spacerobot_ros.simulation.actuators import PlantWithFaults, ThrusterPlant, build_plant
from spacerobot_ros.simulation.config import PlantConfig, SensorConfig
from spacerobot_ros.simulation.faults import FAULT_KINDS, FaultTargets, Timeline, parse_fault
from spacerobot_ros.simulation.sensors import Sensors

URDF = Path(__file__).parents[2] / "urdf"
TICK = 0.05
ARM = ("shoulder_yaw", "shoulder_pitch", "elbow_pitch")
TARGETS = FaultTargets(ARM, wrench=True, nozzles=("plus_x", "minus_x"))


def urdf(name: str) -> str:
    return (URDF / f"{name}.urdf").read_text("utf-8")


def faulty(
    plant: VelocityPlant | EffortPlant, *faults: str, seed: int = 0, **values: Any
) -> PlantWithFaults:
    """Return a plant with faults, and with thrusters if ``thrusters`` are among the values."""
    config = PlantConfig(
        actuation=plant.actuation,
        tick_rate=1 / plant.control_period,
        faults=faults,
        sensors=SensorConfig(seed=seed),
        **values,
    )
    return PlantWithFaults(ThrusterPlant(plant, config) if config.thrusters else plant, config)


def arm(*faults: str, seed: int = 0, tick: float = TICK) -> PlantWithFaults:
    """Return the three-joint arm under velocity commands."""
    plant = VelocityPlant(robot_of(urdf("three_joint_arm")), tick)
    return faulty(plant, *faults, seed=seed)


def momenta(robot: str, plant: PlantWithFaults) -> Array:
    """Return linear over angular momentum (6,), world, by Pinocchio."""
    oracle = PinocchioOracle(robot, plant.robot.joint_names)
    oracle.set_configuration(plant.q, plant.pose[3:], plant.pose[:3])
    oracle.move(oracle.base_velocities(plant.twist) + oracle.joint_velocities(plant.qdot))
    p, L, _ = oracle.momentum_W()
    return np.concatenate([p, L])


# -- lines and times --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("line", "written"),
    [
        ("joint_stuck elbow_pitch", "joint_stuck elbow_pitch at 7"),
        ("joint_stuck elbow_pitch at 10.0 until 50", "joint_stuck elbow_pitch at 10 until 50"),
        ("  joint_slow  shoulder_yaw 0.25 until 9 ", "joint_slow shoulder_yaw 0.25 at 7 until 9"),
        ("actuator_bias elbow_pitch -1e-3 at 0", "actuator_bias elbow_pitch -0.001 at 0"),
        ("thruster_off all at 1", "thruster_off all at 1"),
        ("thruster_stuck torque_z -2", "thruster_stuck torque_z -2 at 7"),
        ("nozzle_weak minus_x 0.5", "nozzle_weak minus_x 0.5 at 7"),
        ("sensor_bias attitude_y 0.01", "sensor_bias attitude_y 0.01 at 7"),
        ("sensor_dropout odom until 8", "sensor_dropout odom at 7 until 8"),
    ],
)
def test_a_line_is_read_and_written(line: str, written: str) -> None:
    fault = parse_fault(line, TARGETS, now=7.0)
    assert str(fault) == written
    assert parse_fault(str(fault), TARGETS) == fault


@pytest.mark.parametrize(
    ("line", "mentions"),
    [
        ("stuck", ("KIND TARGET", "'stuck'")),
        ("joint_broken elbow_pitch", ("'joint_broken'", "joint_stuck")),
        ("joint_stuck elbow", ("shoulder_yaw, shoulder_pitch, elbow_pitch",)),
        ("joint_slow elbow_pitch at 3", ("needs a value", "factor")),
        ("joint_slow elbow_pitch 1.5", ("1.5", "0 to 1")),
        ("nozzle_weak minus_x 1.5", ("1.5", "0 to 1")),
        ("actuator_noise elbow_pitch -1", ("-1", "from 0 to 1e+06")),
        ("sensor_noise position 1e200", ("1e+200", "from 0 to 1e+06")),
        ("sensor_noise joints 1e155", ("from 0 to 1e+06",)),
        ("sensor_bias attitude_x -1e300", ("from -1e+06 to 1e+06",)),
        ("sensor_bias elbow_pitch 1e7", ("from -1e+06 to 1e+06",)),
        ("actuator_noise elbow_pitch 1e160", ("from 0 to 1e+06",)),
        ("actuator_bias elbow_pitch 1e308", ("from -1e+06 to 1e+06",)),
        ("thruster_stuck force_x -1e200", ("from -1e+06 to 1e+06",)),
        ("sensor_delay odom 61", ("from 0 to 60",)),
        ("joint_stuck elbow_pitch at 1e300", ("its time is 1e+300 s",)),
        ("joint_stuck elbow_pitch at -3", ("its time is -3 s but must be from 0 to 1e+09 s",)),
        ("joint_stuck elbow_pitch until 1e10", ("its time is 1e+10 s",)),
        ("actuator_bias elbow_pitch much", ("'much'", "finite")),
        ("actuator_bias elbow_pitch nan", ("'nan'", "finite")),
        ("joint_stuck elbow_pitch 3", ("'at SECONDS'",)),
        ("joint_stuck elbow_pitch until 9 at 3", ("'at SECONDS'",)),
        ("joint_stuck elbow_pitch at", ("'at SECONDS'",)),
        ("joint_stuck elbow_pitch at 5 until 5", ("ends at 5 s", "begins at 5 s")),
        ("sensor_dropout joint_states", ("odom",)),
        ("nozzle_open nose", ("plus_x, minus_x",)),
    ],
)
def test_a_bad_line_is_refused_with_a_sentence(line: str, mentions: tuple[str, ...]) -> None:
    with pytest.raises(ParameterError) as refusal:
        parse_fault(line, TARGETS)
    assert_one_sentence(str(refusal.value), line, *mentions)


def test_a_long_line_is_quoted_in_part() -> None:
    for line in ("x" * 10**6 + " y", "actuator_bias elbow_pitch " + "9" * 10**6 + "x"):
        with pytest.raises(ParameterError) as refusal:
            parse_fault(line, TARGETS)
        assert len(str(refusal.value)) < 500


def test_times_of_a_long_flight_are_written_as_they_are() -> None:
    fault = parse_fault("joint_stuck elbow_pitch at 86400.05 until 86400.1", TARGETS)
    assert parse_fault(str(fault), TARGETS) == fault


@pytest.mark.parametrize("kind", FAULT_KINDS)
@pytest.mark.parametrize("actuation", ["velocity", "effort"])
def test_the_largest_faults_leave_numbers_finite_or_stop_the_plant_with_a_sentence(
    kind: str, actuation: str
) -> None:
    robot = SpaceRobot.from_file(robot_file("sliding_masses"))
    config = PlantConfig(actuation=actuation, tick_rate=20.0)
    plant = build_plant(robot, config)
    sensors = Sensors(plant, config)
    targets = FaultTargets(robot.joint_names, actuation == "effort").of(FAULT_KINDS[kind])
    extremes = (
        {FAULT_KINDS[kind].minimum, FAULT_KINDS[kind].maximum} if FAULT_KINDS[kind].value else {""}
    )
    commands = [np.full(3, 0.1), *([np.zeros(6)] if actuation == "effort" else [])]
    for value in extremes:
        for target in targets:
            plant.inject("clear")
            plant.reset()
            plant.inject(f"{kind} {target} {value}")
            with suppress(SpaceRobotError):
                for _ in range(3):
                    plant.step(*commands)
                    sensors.measure()
                    for numbers in (plant.pose, sensors.pose, sensors.twist, sensors.q):
                        assert np.all(np.isfinite(numbers)), (kind, target, value)


def test_a_plant_without_thrusters_has_no_faults_of_thrusters() -> None:
    for line in ("thruster_off all", "thruster_stuck force_x 1", "nozzle_open plus_x"):
        with pytest.raises(ParameterError, match="has no target for"):
            arm(line)


def test_faults_are_active_from_their_start_until_before_their_end() -> None:
    lines = [
        "joint_stuck elbow_pitch at 1 until 3",
        "thruster_off all at 2",
        "",
        "sensor_delay odom 1",
    ]
    timeline = Timeline(lines, lambda line, now: parse_fault(line, TARGETS, now))
    active = {t: [f.kind for f in timeline.at(t)] for t in (0.0, 0.999, 1.0, 2.0, 2.999, 3.0, 9.0)}
    assert active == {
        0.0: ["sensor_delay"],
        0.999: ["sensor_delay"],
        1.0: ["joint_stuck", "sensor_delay"],
        2.0: ["joint_stuck", "thruster_off", "sensor_delay"],
        2.999: ["joint_stuck", "thruster_off", "sensor_delay"],
        3.0: ["thruster_off", "sensor_delay"],
        9.0: ["thruster_off", "sensor_delay"],
    }


@pytest.mark.slow
@pytest.mark.parametrize("rate", [30, 50, 60, 7])
def test_times_of_faults_are_exact_where_a_tick_is_no_decimal_number(rate: int) -> None:
    """A fault from a to b is active in the ticks k with a <= k / rate < b, as fractions.

    111 / 30 is 3.7, and 111 times the float 1 / 30 is less; 8.3 over 1 / 30 is more than 249.
    """
    times = [Fraction(k, rate) for k in range(10 * rate) if (100 * Fraction(k, rate)) % 1 == 0]
    lines = [
        f"actuator_bias elbow_pitch {n} at {float(a)} until {float(b)}"
        for n, (a, b) in enumerate(itertools.pairwise(times))
    ]
    plant = arm(*lines, tick=1 / rate)
    for k in range(round(times[-1] * rate)):
        (fault,) = plant.active
        wanted = sum(1 for time in times if time <= Fraction(k, rate)) - 1
        assert fault.value == wanted, k
        plant.step(np.zeros(3))


# -- joints under velocity commands -----------------------------------------------------------


def test_a_stuck_joint_stays_and_the_others_go_on() -> None:
    plant = arm("joint_stuck shoulder_pitch at 0.2 until 0.4")
    command = np.array([0.1, -0.2, 0.3])
    shapes = [plant.q.copy()]
    for _ in range(12):
        plant.step(command)
        shapes.append(plant.q.copy())
    # Ticks 4 to 7 begin within [0.2, 0.4) s.
    moves = np.arange(13)[:, None] * TICK * command
    moves[:, 1] = command[1] * TICK * np.concatenate([np.arange(5), np.full(4, 4), np.arange(5, 9)])
    np.testing.assert_allclose(shapes, moves, atol=1e-14)
    np.testing.assert_allclose(momenta(urdf("three_joint_arm"), plant), 0.0, atol=1e-12)
    np.testing.assert_array_equal(command, [0.1, -0.2, 0.3])


def test_slow_joints_and_biased_actuators_do_what_their_values_say() -> None:
    plant = arm(
        "joint_slow shoulder_yaw 0.5",
        "actuator_bias elbow_pitch 0.02",
        "joint_slow elbow_pitch 0.1",
    )
    for _ in range(20):
        plant.step(np.array([0.1, 0.2, -0.1]))
    np.testing.assert_allclose(plant.q, [0.05, 0.2, -0.008], atol=1e-14)


def test_actuator_noise_has_its_sigma_and_its_seed() -> None:
    flights = []
    for seed in (1, 1, 2):
        plant = arm("actuator_noise shoulder_yaw 0.03", seed=seed, tick=0.01)
        rates = []
        for _ in range(3000):
            plant.step(np.array([0.0, 0.01, 0.0]))
            rates.append(plant.qdot.copy())
        flights.append(np.array(rates))
    np.testing.assert_array_equal(flights[0], flights[1])
    assert np.abs(flights[0] - flights[2])[:, 0].max() > 0.01
    yaw = flights[0][:, 0]
    assert yaw.std() == pytest.approx(0.03, rel=0.05)
    assert abs(yaw.mean()) < 4 * 0.03 / np.sqrt(len(yaw))
    np.testing.assert_array_equal(flights[0][:, 1:], np.tile([0.01, 0.0], (3000, 1)))


def test_a_plant_without_faults_is_the_plant_within() -> None:
    robot = robot_of(urdf("three_joint_arm"))
    bare, wrapped = (VelocityPlant(robot, TICK), faulty(VelocityPlant(robot, TICK)))
    rng = np.random.default_rng(3)
    for _ in range(20):
        command = rng.uniform(-1.0, 1.0, 3)
        assert bare.step(command) == wrapped.step(command)
    for part in ("pose", "twist", "q", "qdot", "momentum", "link_R", "link_r", "expected_momenta"):
        np.testing.assert_array_equal(getattr(bare, part), getattr(wrapped, part))
    assert all(np.array_equal(v, wrapped.limit_counts[k]) for k, v in bare.limit_counts.items())


# -- joints under efforts ---------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(3))
def test_a_joint_that_jams_changes_no_momentum_and_gains_no_energy(seed: int) -> None:
    text = random_urdf(seed)
    robot, rng = robot_of(text), np.random.default_rng(seed)
    jam = f"joint_stuck {robot.joint_names[1]} at 0.2 until 0.4"
    plant = faulty(EffortPlant(robot, 0.01, tumbling(robot, rng)), jam)
    before, places, energies = momenta(text, plant), [], []
    for effort, _ in thrusts(rng, robot.n, 60):
        plant.step(0.2 * effort)
        places.append(plant.q[1])
        energies.append(plant.momentum[6])
        if 20 <= plant.tick - 1 < 40:
            assert plant.qdot[1] == 0.0
    assert np.ptp(places[20:40]) == 0.0
    assert np.ptp(places[:20]) > 1e-4
    assert np.ptp(places[40:]) > 1e-5, "it moves again"
    np.testing.assert_allclose(momenta(text, plant), before, atol=1e-11)


def test_energy_is_lost_when_a_moving_joint_jams() -> None:
    text = random_urdf(4)
    robot = robot_of(text)
    start = tumbling(robot, np.random.default_rng(4))
    plant = faulty(EffortPlant(robot, 0.001, start))
    rest = np.zeros(robot.n)
    plant.step(rest)
    before = plant.momentum.copy()
    # Carnot: by the impulse, the energy of the difference of the rates is lost.
    H = robot.inertia_matrix(plant.q)
    K = H[6:, 6:] - H[6:, :6] @ np.linalg.solve(H[:6, :6], H[6:, :6].T)
    compliance = np.linalg.inv(K)
    lost = plant.qdot[0] ** 2 / compliance[0, 0] / 2
    plant.inject(f"joint_stuck {robot.joint_names[0]}")
    plant.step(rest)
    assert lost > 1e-4
    # Within the millisecond the free motion goes on, which changes the energy by nothing.
    assert before[6] - plant.momentum[6] == pytest.approx(lost, rel=1e-6)
    np.testing.assert_allclose(plant.momentum[:6], before[:6], atol=1e-12)


# -- thrusters --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("faults", "force"),
    [
        ((), [2.0, -1.0, 0.5]),
        (("thruster_stuck force_x 3",), [3.0, -1.0, 0.5]),
        (("thruster_off all",), [0.0, 0.0, 0.0]),
        (("thruster_off force_y", "thruster_weak force_x 0.25"), [0.5, 0.0, 0.5]),
        (("thruster_weak all 0.5", "thruster_stuck force_z -1"), [1.0, -0.5, -1.0]),
    ],
)
def test_the_momentum_is_what_the_faulty_thrusters_gave(
    faults: tuple[str, ...], force: list[float]
) -> None:
    # The sliders' robot has its centre of mass at the origin of its base: forces do not turn it.
    text = urdf("sliding_masses")
    plant = faulty(EffortPlant(robot_of(text), TICK), *faults)
    wrench = np.array([2.0, -1.0, 0.5, 0.0, 0.0, 0.0])
    for _ in range(10):
        plant.step(np.zeros(3), wrench)
    impulse = momenta(text, plant)[:3]
    # Sliders are left behind by a base that is pushed, but their momentum counts.
    np.testing.assert_allclose(impulse, 10 * TICK * np.array(force), atol=1e-9)
    np.testing.assert_allclose(plant.expected_momenta[:3], impulse, atol=1e-9)
    np.testing.assert_array_equal(wrench[:3], [2.0, -1.0, 0.5])


def test_nozzles_stay_open_closed_and_weak() -> None:
    plant = faulty(
        EffortPlant(robot_of(urdf("servicer")), 0.1),
        "nozzle_open plus_x_1",
        "nozzle_closed minus_x_1 until 1",
        "nozzle_weak minus_x_1 0.5 at 1",
        thrusters="urdf",
    )
    thrusters = plant.thrusters
    assert thrusters is not None
    opened, other = (thrusters.table.names.index(name) for name in ("plus_x_1", "minus_x_1"))
    back = np.array([-40.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    for _ in range(5):
        plant.step(np.zeros(plant.robot.n), back)
    assert thrusters.thrust[opened] == 10.0, "nobody asked for it"
    assert thrusters.thrust[other] == 0.0
    for _ in range(10):
        plant.step(np.zeros(plant.robot.n), back)
    assert thrusters.thrust[other] == pytest.approx(0.5 * 10.0 * thrusters.duty[other])
    assert thrusters.duty[other] > 0.9
    plant.inject("clear")
    plant.step(np.zeros(plant.robot.n), np.zeros(6))
    assert thrusters.thrust[opened] == 0.0
