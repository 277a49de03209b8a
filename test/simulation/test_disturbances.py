"""Loads from outside: disturbances, and loads along a flight."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from scipy.integrate import simpson
from scipy.spatial.transform import Rotation
from support.effort_flights import random_urdf, robot_of, tumbling
from support.oracles import Array, PinocchioOracle, assert_agrees, random_motion

from spacerobot_ros.errors import CommandError, ParameterError, RobotDescriptionError
from spacerobot_ros.events import EventKind
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.rotations import matrix_from_quaternion
from spacerobot_ros.resources import robot_file
from spacerobot_ros.simulation import EffortPlant, InitialState, VelocityPlant
from spacerobot_ros.simulation.actuators import PlantWithFaults, ThrusterPlant, build_plant
from spacerobot_ros.simulation.commands import CommandValidator
from spacerobot_ros.simulation.config import PlantConfig
from spacerobot_ros.simulation.faults import Disturbance, parse_disturbance
from spacerobot_ros.simulation.loads import PlantLoads
from spacerobot_ros.simulation.sensors import ReportedState
from spacerobot_ros.simulation.status import PlantMonitor, PlantState, PlantStatus

LINKS = ("base", "hand")
SLIDERS = SpaceRobot.from_file(robot_file("sliding_masses"))
LINK = SLIDERS.link_names[-1]


def plant_with(*disturbances: str, **parameters: Any) -> PlantWithFaults:
    return build_plant(SLIDERS, PlantConfig(disturbances=disturbances, **parameters))


@pytest.mark.parametrize(
    ("line", "expected", "text"),
    [
        (
            "hand force 1 -2 0.5",
            Disturbance("hand", force=(1.0, -2.0, 0.5), start=3.0),
            "hand force 1 -2 0.5 in world at 3",
        ),
        (
            "base torque 0 0 0.25 in link at 10 until 50",
            Disturbance("base", torque=(0.0, 0.0, 0.25), in_link=True, start=10.0, end=50.0),
            "base torque 0 0 0.25 in link at 10 until 50",
        ),
        (
            "  hand torque 1 2 3 force 4 5 6 in world until 7.5",
            Disturbance("hand", (4.0, 5.0, 6.0), (1.0, 2.0, 3.0), start=3.0, end=7.5),
            "hand force 4 5 6 torque 1 2 3 in world at 3 until 7.5",
        ),
        ("hand force 1e6 0 0 at 0", Disturbance("hand", (1e6, 0.0, 0.0)), None),
    ],
)
def test_a_line_is_a_disturbance(line: str, expected: Disturbance, text: str | None) -> None:
    found = parse_disturbance(line, LINKS, now=3.0)
    assert found == expected
    assert parse_disturbance(str(found), LINKS) == found
    assert text is None or str(found) == text


FORM = (
    "it must be LINK [force X Y Z] [torque X Y Z] [in world|link] [at SECONDS] [until SECONDS], "
    "with a force or a torque"
)


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ("", FORM),
        ("hand", FORM),
        ("hand at 3", FORM),
        ("hand force 1 2", FORM),
        ("nose force 1 2 3", "the robot has no link 'nose'; it has base, hand"),
        ("hand force 1 2 nan", "'nan' is not a finite number"),
        ("hand force 1 2 at 4", "'at' is not a finite number"),
        ("hand torque 1 inf 2", "'inf' is not a finite number"),
        ("hand force 1 -2e6 0", "components of its force must be at most 1e+06"),
        ("hand force 1 2 3 torque 0 0 -1.1e6", "components of its torque must be at most 1e+06"),
        ("hand force 1 2 3 in space", "its frame must be world or link"),
        ("hand force 1 2 3 in", "its frame must be world or link"),
        ("hand force 1 2 3 at -1", "its time is -1 s but must be from 0 to 1e+09 s"),
        ("hand force 1 2 3 at 5 until 5", "it ends at 5 s but begins at 5 s"),
        ("hand force 1 2 3 at nan", "'nan' is not a finite number"),
        ("hand force 1 2 3 until 2e9", "its time is 2e+09 s but must be from 0 to 1e+09 s"),
        ("hand torque 1 2 3 for 5", "only 'at SECONDS' and 'until SECONDS' may follow the torque"),
        (
            "hand force 1 2 3 force 1 2 3",
            "only 'at SECONDS' and 'until SECONDS' may follow the force",
        ),
    ],
)
def test_a_bad_line_is_refused_with_a_sentence(line: str, reason: str) -> None:
    with pytest.raises(ParameterError) as refused:
        parse_disturbance(line, LINKS)
    assert str(refused.value) == f"The disturbance '{line}' is refused: {reason}."


@pytest.mark.parametrize("actuation", ["velocity", "effort"])
def test_a_disturbance_acts_from_its_begin_to_its_end(actuation: str) -> None:
    """At 20 ticks a second, ticks 3 to 6 begin within [0.15, 0.35) s."""
    plant = plant_with(f"{LINK} force 0.5 -1 2 at 0.15 until 0.35", actuation=actuation)
    commands = (np.zeros(3), np.zeros(6)) if actuation == "effort" else (np.zeros(3),)
    momenta, seen = [], []
    for _ in range(10):
        seen.append(bool(plant.disturbances))
        plant.step(*commands)
        momenta.append(plant.momentum[:3].copy())
    acted = np.clip(np.arange(1, 11) - 3, 0, 4)
    np.testing.assert_allclose(momenta, 0.05 * acted[:, None] * [0.5, -1.0, 2.0], atol=1e-14)
    assert seen == [k in range(3, 7) for k in range(10)]


def test_disturbances_of_a_link_add_up_and_are_injected_and_cleared() -> None:
    plant = plant_with(f"{LINK} force 1 0 0 at 0")
    assert plant.loads is not None
    plant.step(np.zeros(3))
    before = plant.injected
    plant.disturb(f"{LINK} force 2 3 0 torque 0 0 1\n{LINK} torque 0.5 0 0 in link at 0.1")
    assert plant.injected is not before
    assert [str(each) for each in plant.disturbances] == [
        f"{LINK} force 1 0 0 in world at 0",
        f"{LINK} force 2 3 0 torque 0 0 1 in world at 0.05",
    ]
    np.testing.assert_array_equal(plant.loads.in_world[-1], [3, 3, 0, 0, 0, 1])
    plant.step(np.zeros(3))
    np.testing.assert_array_equal(plant.loads.in_link[-1], [0, 0, 0, 0.5, 0, 0])
    with pytest.raises(ParameterError, match="no link 'nose'"):
        plant.disturb(f"{LINK} force 9 9 9\nnose force 1 0 0")
    assert len(plant.disturbances) == 3
    plant.inject("joint_stuck slider_1")
    assert len(plant.injected) == 4
    plant.disturb("clear")
    assert not plant.disturbances
    assert not plant.loads.in_link.any()
    assert not plant.loads.in_world.any()
    assert [str(each) for each in plant.injected] == ["joint_stuck slider_1 at 0.1"]
    momentum = plant.momentum[:6].copy()
    plant.step(np.zeros(3))
    np.testing.assert_allclose(plant.momentum[:6], momentum, atol=1e-14)


def test_a_plant_that_is_disturbed_later_goes_on_as_it_was() -> None:
    """Arrays stay the same objects, and what was, is kept to the last bit."""
    plain, disturbed = plant_with(), plant_with()
    pose, momentum = disturbed.pose, disturbed.momentum
    rates = np.array([0.1, -0.2, 0.3])
    for _ in range(3):
        plain.step(rates)
        disturbed.step(rates)
    assert disturbed.loads is None
    disturbed.disturb(f"{LINK} force 0 0 1 at 100")
    for _ in range(3):
        plain.step(rates)
        disturbed.step(rates)
    assert disturbed.pose is pose
    assert disturbed.momentum is momentum
    np.testing.assert_allclose(disturbed.pose, plain.pose, atol=1e-15)
    np.testing.assert_allclose(disturbed.effort, plain.effort, atol=1e-15)


def test_a_tick_that_the_owner_sets_is_the_time_of_disturbances() -> None:
    plant = plant_with(f"{LINK} force 1 0 0 at 10 until 20")
    plant.start_at(20 * 15)
    plant.step(np.zeros(3))
    assert plant.momentum[0] == pytest.approx(0.05)
    assert plant.loads is not None
    assert plant.loads.time == pytest.approx(15.0)


def test_a_reset_keeps_time_and_disturbances() -> None:
    plant = plant_with(f"{LINK} force 1 0 0")
    plant.step(np.zeros(3))
    plant.reset()
    np.testing.assert_array_equal(plant.expected_momenta, 0.0)
    plant.step(np.zeros(3))
    assert plant.expected_momenta[0] == pytest.approx(0.05)
    assert plant.tick == 2


# -- reports ----------------------------------------------------------------------------------


def test_status_and_events_name_disturbances() -> None:
    config = PlantConfig(time_mode="lockstep", disturbances=(f"{LINK} torque 0 0 0.5 until 0.1",))
    plant = build_plant(SLIDERS, config)
    monitor = PlantMonitor(CommandValidator(plant, config), plant, config)
    line = f"{LINK} torque 0 0 0.5 in world at 0 until 0.1"
    event, running = monitor.update(PlantState.RUNNING, 0.0)
    assert (event.kind, event.level) == (EventKind.DISTURBANCE, 1)
    told = f"{LINK} torque 0 0 0.5 in world at 0 s until 0.1 s"
    assert event.message == f"A disturbance begins: {told}."
    assert event.about == {"disturbance": line}
    assert running.kind is EventKind.RUNNING
    status = monitor.status
    assert (status.disturbances, status.level) == ((line,), 1)
    assert PlantStatus.from_values(status.to_values(), status.message) == status
    plant.step(np.zeros(3))
    plant.step(np.zeros(3))
    (ended,) = monitor.update(PlantState.RUNNING, 0.1)
    assert (ended.kind, ended.level) == (EventKind.DISTURBANCE_ENDED, 0)
    assert ended.message == f"A disturbance has ended: {told}."
    assert monitor.status.level == 0
    assert "disturbances" not in monitor.status.to_values()


def test_expected_momenta_are_published_as_soon_as_loads_act() -> None:
    plant = plant_with()
    reported = ReportedState(plant, PlantConfig())
    assert "expected_momenta" not in reported.quantities
    assert not reported.update()
    plant.disturb(f"{LINK} force 1 0 0")
    assert reported.update()
    assert reported.quantities["expected_momenta"] is plant.expected_momenta
    assert not reported.update()
    assert math.isfinite(plant.expected_momenta.sum())


# -- plants under wrenches on their links, against Pinocchio's Jacobians, impulses and work ------


TICK = 0.01


def wrenches(rng: np.random.Generator, robot: SpaceRobot) -> PlantLoads:
    """Return wrenches on the second link and the last, the one in its frame, the other in W."""
    loads = PlantLoads(robot)
    loads.in_link[1], loads.in_world[-1] = rng.uniform(-2.0, 2.0, (2, 6))
    loads.in_world[1, 4] = 0.7
    return loads


def force_on(oracle: PinocchioOracle, robot: SpaceRobot, loads: PlantLoads) -> Array:
    """Return the loads as forces (6 + n,) along the engine's velocities, at its configuration."""
    total = np.zeros(6 + oracle.n)
    for link, own, world in zip(robot.link_names, loads.in_link, loads.in_world, strict=True):
        R_WL, _ = oracle.frame_W(link)
        wrench = world + np.concatenate([R_WL @ own[:3], R_WL @ own[3:]])
        total += oracle.frame_jacobian_W(link).T @ wrench
    return total


class Watch:
    """Pinocchio beside a plant under loads: the rates of its momenta, and their power."""

    def __init__(self, urdf: str, plant: EffortPlant | VelocityPlant, loads: PlantLoads) -> None:
        self.oracle = PinocchioOracle(urdf, plant.robot.joint_names)
        self.plant, self.loads = plant, loads

    def rates(self) -> Array:
        """Return force, moment about the centre of mass, both in W, and power: (7,)."""
        plant, oracle = self.plant, self.oracle
        oracle.set_configuration(plant.q, plant.pose[3:], plant.pose[:3])
        u = oracle.base_velocities(plant.twist) + oracle.joint_velocities(plant.qdot)
        force, moment, center = np.zeros(3), np.zeros(3), oracle.center_of_mass_W()
        for link, own, world in zip(
            plant.robot.link_names, self.loads.in_link, self.loads.in_world, strict=True
        ):
            R_WL, r_WL_W = oracle.frame_W(link)
            f, n = world[:3] + R_WL @ own[:3], world[3:] + R_WL @ own[3:]
            force, moment = force + f, moment + n + np.cross(r_WL_W - center, f)
        return np.concatenate([force, moment, [force_on(oracle, plant.robot, self.loads) @ u]])


@pytest.mark.parametrize("seed", [1, 6])
def test_the_shape_accelerates_as_by_pinocchios_transposed_jacobians(seed: int) -> None:
    rng, urdf = np.random.default_rng(seed), random_urdf(seed)
    robot = robot_of(urdf)
    oracle, n = PinocchioOracle(urdf, robot.joint_names), robot.n
    loads, motion = wrenches(rng, robot), random_motion(rng, robot.n)
    tau, wrench = rng.uniform(-1.0, 1.0, n), rng.uniform(-1.0, 1.0, 6)
    bare = oracle.forward_dynamics(motion, wrench, tau)
    extra = np.linalg.solve(oracle.own_mass_matrix(), force_on(oracle, robot, loads))
    expected = bare + oracle.to_z0dot() @ extra
    _, L_W, _ = oracle.momentum_W()
    center = oracle.center_of_mass_W()
    state = [motion.q, motion.quaternion_WB, motion.qdot, rng.normal(size=3), L_W, center]
    x, command = np.append(np.concatenate(state), 7.5), np.concatenate([tau, wrench, loads.vector])
    K, Q = robot.buffered("loaded_shape_equations")(x, command)
    assert_agrees(np.linalg.solve(K.reshape(n, n), Q), expected[6:], 1e-10)


def flown(plant: Any, watch: Watch, commands: list[Array], ticks: int) -> tuple[Array, Array]:
    """Return the change of momenta and energy (7,), and what loads and actuators explain."""
    before, rates, work = plant.momentum.copy(), [watch.rates()], 0.0
    for _ in range(ticks):
        q = plant.q.copy()
        plant.step(*commands)
        work += plant.effort @ (plant.q - q)
        rates.append(watch.rates())
    explained = simpson(np.array(rates), dx=plant.control_period, axis=0)
    explained[6] += work
    return plant.momentum - before, explained


def test_momenta_grow_by_the_impulses_and_the_energy_by_the_work_under_efforts() -> None:
    rng, urdf = np.random.default_rng(5), random_urdf(3)
    robot = robot_of(urdf)
    plant = EffortPlant(robot, TICK, tumbling(robot, rng))
    loads = wrenches(rng, robot)
    plant.load(loads)
    effort = 0.3 * rng.uniform(-1.0, 1.0, robot.n)
    plant.step(effort)
    gained, explained = flown(plant, Watch(urdf, plant, loads), [effort], 20)
    assert np.abs(gained).min() > 1e-3
    assert_agrees(gained, explained, 1e-7)
    assert_agrees(plant.expected_momenta, plant.momentum[:6], 1e-12)


def test_momenta_are_states_under_held_velocities_too() -> None:
    rng, urdf = np.random.default_rng(8), random_urdf(2)
    robot = robot_of(urdf)
    start = InitialState(
        position=np.array([0.3, -0.1, 0.2]),
        quaternion=rng.normal(size=4),
        linear_momentum=np.array([0.1, 0.2, -0.3]),
        angular_momentum=np.array([0.3, -0.2, 0.1]),
    )
    plant, loads = VelocityPlant(robot, TICK / 10, start), wrenches(rng, robot)
    plant.load(loads)
    rates = rng.uniform(-0.5, 0.5, robot.n)
    plant.step(rates)
    gained, explained = flown(plant, Watch(urdf, plant, loads), [rates], 20)
    assert np.abs(gained[:6]).min() > 1e-3
    assert_agrees(gained[:6], explained[:6], 1e-9)
    # The published efforts are those of the beginning of each tick.
    assert_agrees(gained[6:], explained[6:], 0.01)
    assert_agrees(plant.expected_momenta, plant.momentum[:6], 1e-12)


def test_servos_hold_joints_against_a_wrench() -> None:
    """A robot at rest: the efforts cancel the wrench beside what accelerates the whole robot."""
    urdf = random_urdf(2)
    robot = robot_of(urdf)
    plant, loads = VelocityPlant(robot, 1e-9), wrenches(np.random.default_rng(4), robot)
    plant.load(loads)
    plant.step(np.zeros(robot.n))
    oracle = PinocchioOracle(urdf, robot.joint_names)
    oracle.set_configuration(plant.q, plant.pose[3:], plant.pose[:3])
    force, M = force_on(oracle, robot, loads), oracle.own_mass_matrix()
    joints = np.array([oracle.joint_velocities(e) for e in np.eye(robot.n)])
    base = np.array([oracle.base_velocities(e) for e in np.eye(6)])
    rigid = np.linalg.solve(base @ M @ base.T, base @ force)
    expected = joints @ (M @ base.T @ rigid - force)
    assert np.abs(expected).min() > 0.01
    assert_agrees(plant.effort, expected, 1e-9)


def test_loads_are_felt_at_stops_and_by_held_joints() -> None:
    """A joint that is held or on its stop: the momenta change by the impulse all the same."""
    rng, urdf = np.random.default_rng(2), random_urdf(3)
    robot = robot_of(urdf)
    plant, loads = EffortPlant(robot, TICK, tumbling(robot, rng)), PlantLoads(robot)
    loads.in_world[-1] = 0.5, -1.0, 0.7, 0.2, 0.3, -0.4
    plant.load(loads)
    watch = Watch(urdf, plant, loads)
    held = np.zeros(robot.n, dtype=np.bool_)
    held[1] = True
    plant.hold(held)
    plant.step(np.zeros(robot.n))
    place = plant.q[1]
    gained, explained = flown(plant, watch, [np.zeros(robot.n)], 10)
    assert plant.q[1] == place
    assert np.abs(gained[:6]).min() > 1e-3
    assert_agrees(gained[:6], explained[:6], 1e-8)
    assert_agrees(plant.expected_momenta, plant.momentum[:6], 1e-12)


def test_a_body_turns_by_a_torque_in_its_frame() -> None:
    """The torque turns with the link: about a principal axis, at constant acceleration."""
    robot = SpaceRobot.from_urdf(
        '<robot name="top"><link name="top"><inertial><mass value="2.0"/><inertia ixx="1.0" '
        'iyy="1.2" izz="0.5" ixy="0" ixz="0" iyz="0"/></inertial></link></robot>'
    )
    turned = Rotation.from_rotvec([0.4, -0.3, 0.2])
    plant = EffortPlant(robot, 0.5, InitialState(quaternion=turned.as_quat()))
    loads = PlantLoads(robot)
    loads.in_link[0, 5] = 0.1
    plant.load(loads)
    for _ in range(6):
        plant.step(np.zeros(0))
    expected = turned * Rotation.from_rotvec([0.0, 0.0, 0.1 / 0.5 * 3.0**2 / 2])
    assert (expected.inv() * Rotation.from_quat(plant.pose[3:])).magnitude() < 1e-9
    np.testing.assert_allclose(plant.expected_momenta[3:], turned.apply([0.0, 0.0, 0.3]))


ROOT = Path(__file__).parents[2]
SERVICER = (ROOT / "urdf" / "servicer.urdf").read_text(encoding="utf-8")

SHAPE = np.array([0.0, -1.2, 2.0, 0.0, 0.8, 0.0])
CONFIG = PlantConfig(actuation="effort", tick_rate=1 / TICK, thrusters="urdf")


def flying(
    robot: SpaceRobot | None = None, initial: InitialState | None = None, excluded: str = ""
) -> ThrusterPlant:
    start = initial or InitialState(joint_positions=SHAPE)
    plant = EffortPlant(robot or robot_of(SERVICER), TICK, start)
    return ThrusterPlant(plant, dataclasses.replace(CONFIG, thrusters_excluded=excluded))


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
    assert 24 < plant.modulator.pulses.sum() < 300 * 6
    assert plant.modulator.unmet_periods == 0


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


def test_propellant_is_what_the_thrust_took_whatever_was_commanded() -> None:
    """By hand: F dt / (g0 Isp) of every thruster, weak, dead and stuck ones too."""
    plant = flying()
    plant.thruster_health[:] = np.linspace(0.0, 1.0, 24)
    plant.stuck_on[-2] = True
    used, rng = 0.0, np.random.default_rng(8)
    for _ in range(40):
        plant.step(np.zeros(6), wanted(rng))
        np.testing.assert_allclose(plant.thrust, 10.0 * plant.thruster_health * plant.duty)
        used += TICK * float(plant.thrust.sum()) / (9.80665 * 290.0)
        assert plant.duty[-2] == 1.0, "though nobody asked for it"
    assert plant.propellant == pytest.approx(used, rel=1e-12)
    assert plant.duty.min() == 0.0 < used
    # What they put in is what the system has.
    np.testing.assert_allclose(plant.momentum[:6], plant.expected_momenta, atol=1e-12)


def test_allocation_that_knows_of_a_dead_thruster_gives_the_whole_wrench() -> None:
    push = np.array([15.0, 0.0, 0.0, 0.0, 1.0, 0.0])
    plant = flying(excluded="plus_x_1 plus_y_3")
    plant.modulator.exclude("minus_z_2")
    assert plant.modulator.missing == ""
    impulse = np.zeros(6)
    for _ in range(100):
        plant.step(np.zeros(6), push)
        impulse += TICK * plant.wrench
    np.testing.assert_allclose(impulse, push, atol=6 * 0.2)
    assert plant.modulator.unmet_periods == 0
    names = plant.table.names
    dead = [names.index(name) for name in ("plus_x_1", "plus_y_3", "minus_z_2")]
    assert plant.on_time[dead].tolist() == [0.0] * 3


def test_too_much_is_counted_and_reset_keeps_what_was_used() -> None:
    plant = flying()
    for _ in range(10):
        plant.step(np.zeros(6), [0.0, 0.0, 500.0, 0.0, 0.0, 0.0])
    assert plant.modulator.unmet_periods > 5
    # Four thrusters of 10 N push along z.
    assert plant.modulator.unmet[2] == pytest.approx(460.0)
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
    robot = robot_of(SERVICER)
    table = tmp_path / "one.yaml"
    one = {"name": "main", "position": [-0.6, 0, 0], "force": 22, "isp": 230}
    table.write_text(yaml.safe_dump({"thrusters": [one]}), encoding="utf-8")
    config = PlantConfig(actuation="effort", thrusters=str(table))
    thrusters = build_plant(robot, config).thrusters
    assert thrusters is not None
    assert "negative force along x" in thrusters.modulator.missing
    with pytest.raises(ParameterError, match="no thruster 'nose'"):
        build_plant(robot, dataclasses.replace(config, thrusters_excluded="nose"))
    bare = SERVICER.replace("<thruster", "<!--").replace("</thruster>", "-->")
    with pytest.raises(RobotDescriptionError, match="has no <thruster> elements"):
        build_plant(robot_of(bare), PlantConfig(actuation="effort", thrusters="urdf"))


def test_faults_of_the_wrench_act_on_the_thrusters_and_not_on_what_is_asked_of_them() -> None:
    """A component that is stuck, off or weak is so in every tick, whatever pulses begin."""
    faults = ("thruster_stuck force_y 3.5", "thruster_off torque_x", "thruster_weak force_x 0.5")
    sound, inner = flying(), flying()
    broken = PlantWithFaults(inner, dataclasses.replace(CONFIG, faults=faults))
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
