"""Plants under wrenches on their links, against Pinocchio's Jacobians, impulses and work."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.integrate import simpson
from scipy.spatial.transform import Rotation
from support.effort_flights import random_urdf, robot_of, tumbling
from support.oracles import Array, PinocchioOracle, assert_agrees, random_motion

from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.simulation import EffortPlant, InitialState, VelocityPlant
from spacerobot_ros.simulation.loads import PlantLoads

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


def test_a_constant_force_at_the_centre_of_mass_is_a_parabola() -> None:
    robot = robot_of(random_urdf(3))
    start = InitialState(linear_momentum=np.array([0.2, 0.0, -0.4]))
    plant, loads = VelocityPlant(robot, 0.25, start), PlantLoads(robot)
    base = robot.link_names.index(robot.base_link)
    force = np.array([0.3, -0.2, 0.1])
    loads.in_world[base] = [*force, *np.cross(robot.center_of_mass(plant.q), force)]
    plant.load(loads)
    center = robot.center_of_mass(plant.q)
    for _ in range(4):
        plant.step(np.zeros(robot.n))
    np.testing.assert_allclose(plant.twist[3:], 0.0, atol=1e-15)
    way = (start.linear_momentum + force / 2) / robot.total_mass
    np.testing.assert_allclose(plant.pose[:3] + center, center + way, atol=1e-12)


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
