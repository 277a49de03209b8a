"""Robots that differ in what their bodies weigh: one model with that as an argument."""

from __future__ import annotations

import dataclasses

import casadi as ca
import numpy as np
import pytest
from support.oracles import PinocchioOracle, assert_agrees
from support.random_robots import random_robot_urdf
from support.slow import some_fast

from spacerobot_ros.control import LAWS, ControlState, Gains, Reference
from spacerobot_ros.model import (
    InertialParameters,
    SpaceRobot,
    load_robot,
    model_functions,
    parse_robot,
)
from spacerobot_ros.model.description import RobotDescription
from spacerobot_ros.resources import share_directory
from spacerobot_ros.simulation import EffortPlant, InitialState, VelocityPlant


@pytest.fixture(autouse=True)
def _interpreted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SPACEROBOT_COMPILE", "0")


def drawn(robot: RobotDescription, rng: np.random.Generator) -> InertialParameters:
    """Return other masses, centres and inertias, products of inertia among them."""
    nominal = InertialParameters.of(robot)
    bodies = len(nominal.masses)
    halves = 0.1 * rng.normal(size=(bodies, 3, 3)) * nominal.masses[:, None, None] ** 0.5
    second = halves @ np.swapaxes(halves, 1, 2) + nominal.second_moments
    trace = np.trace(second, axis1=1, axis2=2)[:, None, None]
    return InertialParameters(
        nominal.masses * rng.uniform(0.8, 1.2, bodies),
        nominal.centers + rng.normal(scale=0.05, size=(bodies, 3)),
        trace * np.eye(3) - second,
    )


@pytest.mark.slow
@pytest.mark.parametrize("seed", some_fast(range(2), 1))
def test_numbers_given_as_an_argument_are_those_compiled_in(seed: int) -> None:
    rng = np.random.default_rng(seed)
    description = parse_robot(random_robot_urdf(rng, joints=5))
    parameters = drawn(description, rng)
    robot = SpaceRobot(description).with_inertial(parameters)
    other = SpaceRobot(parameters.apply_to_description(description))
    q, qdot, qddot = rng.uniform(-1.0, 1.0, (3, 5))
    quaternion = np.array([0.1, -0.5, 0.3, 0.8]) / np.linalg.norm([0.1, -0.5, 0.3, 0.8])
    v, omega, wrench = rng.normal(size=3), rng.normal(size=3), rng.normal(size=6)
    x = np.concatenate([q, quaternion, qdot, rng.normal(size=9)])
    command = np.concatenate([qddot, wrench])
    for name, arguments in {
        "center_of_mass": (q,),
        "locked_inertia": (q,),
        "inertia_matrix": (q,),
        "connection": (q,),
        "bias": (q, v, omega, qdot),
        "forward_dynamics": (q, v, omega, qdot, wrench, qddot),
        "joint_efforts": (q, qdot, qddot),
        "momentum": (quaternion, q, v, omega, qdot),
        "base_twist": (quaternion, q, qdot, v, omega),
        "shape_equations": (x, command),
        "flight_step": (x, command, 0.01),
        "holding_step": (x, command, np.array([1.0, 0, 1, 1, 0]), 0.01),
        "velocity_step:2": (x[:9], qdot, omega, 0.1),
    }.items():
        here, there = robot.buffered(name)(*arguments), other.buffered(name)(*arguments)
        for one, two in zip(here, there, strict=True):
            np.testing.assert_allclose(one, two, rtol=1e-12, atol=1e-12, err_msg=name)
    assert robot.total_mass == pytest.approx(other.total_mass, rel=1e-15)


def test_momentum_is_that_of_pinocchio() -> None:
    rng = np.random.default_rng(5)
    urdf = random_robot_urdf(rng, joints=4)
    description = parse_robot(urdf)
    factors = rng.uniform(0.5, 1.5, len(description.bodies))
    robot = SpaceRobot(description).with_inertial(
        InertialParameters.of(description).scaled(factors)
    )
    oracle = PinocchioOracle(urdf, list(description.joint_names))
    model = oracle.model
    by_joint = {
        body.joint.name: factor
        for body, factor in zip(description.bodies, factors, strict=True)
        if body.joint
    }
    for index, name in enumerate(model.names):
        factor = by_joint.get(name, factors[0])
        inertia = model.inertias[index]
        inertia.mass, inertia.inertia = factor * inertia.mass, factor * inertia.inertia
        model.inertias[index] = inertia
    q, qdot = rng.uniform(-1, 1, (2, 4))
    p, L = rng.normal(size=3), rng.normal(size=3)
    v, omega = robot.base_twist([0, 0, 0, 1], q, qdot, p, L)
    oracle.set_configuration(q, np.array([0.0, 0, 0, 1]), np.zeros(3))
    oracle.move(oracle.base_velocities(np.concatenate([v, omega])) + oracle.joint_velocities(qdot))
    assert_agrees(np.concatenate(oracle.momentum_W()[:2]), np.concatenate([p, L]))


def test_one_compilation_serves_every_draw(monkeypatch: pytest.MonkeyPatch) -> None:
    built: list[str] = []

    def counted(function: ca.Function) -> ca.Function:
        built.append(function.name())
        return function

    model_functions._models_of_key.cache_clear()
    monkeypatch.setattr(model_functions, "compiled", counted)
    robot = SpaceRobot(load_robot(share_directory() / "urdf" / "sliding_masses.urdf"))
    heavy = robot.inertial.scaled(1.5)
    poses = []
    for factor in (0.9, 1.0, 1.1):
        draw = robot.with_inertial(heavy.scaled(factor))
        plant = VelocityPlant(draw, 0.1)
        EffortPlant(draw, 0.1, InitialState())
        for _ in range(5):
            plant.step(np.array([0.1, 0.2, 0.3]))
        poses.append(plant.pose.copy())
    # Of another build's robot, read anew, as well.
    again = SpaceRobot(load_robot(share_directory() / "urdf" / "sliding_masses.urdf"))
    VelocityPlant(again.with_inertial(heavy), 0.1)
    ticks = [name for name in built if "tick" in name]
    assert sorted(ticks) == ["effort_tick_100", "velocity_tick_10"]
    assert len({tuple(pose) for pose in poses}) == 3


@pytest.mark.parametrize("law", ["model_based", "computed_torque"])
def test_a_controller_commands_by_what_it_believes_the_bodies_weigh(law: str) -> None:
    rng = np.random.default_rng(8)
    description = load_robot(share_directory() / "urdf" / "planar_manipulator.urdf")
    robot = SpaceRobot(description)
    believed = robot.with_inertial(robot.inertial.scaled([1.3, 0.8, 1.4]))
    compiled_in = SpaceRobot(believed.inertial.apply_to_description(description))
    state = ControlState(
        r_WB=rng.normal(size=3),
        quaternion_WB=np.array([0.0, 0.0, 0.6, 0.8]),
        v_WB_B=rng.normal(size=3),
        omega_WB_B=rng.normal(size=3),
        q=np.array([0.4, -0.9]),
        qdot=rng.normal(size=2),
    )
    commands = []
    for each in (believed, compiled_in, robot):
        outputs = LAWS[law].default_outputs(each, "end_effector")
        controller = LAWS[law](each, outputs, Gains.uniform(2.0, 3.0))
        other = dataclasses.replace(state, q=state.q + 0.1)
        reference = Reference.present(each, other, "end_effector")
        actuation = controller.command(state, reference)
        commands.append(np.concatenate([actuation.wrench_B, actuation.tau]))
    np.testing.assert_allclose(commands[0], commands[1], rtol=1e-12, atol=1e-12)
    assert np.abs(commands[0] - commands[2]).max() > 0.01


def test_a_robot_with_its_own_numbers_is_itself() -> None:
    robot = SpaceRobot(load_robot(share_directory() / "urdf" / "planar_chain.urdf"))
    assert robot.with_inertial(robot.inertial) is robot
    assert robot.with_inertial(robot.inertial.scaled(1.0)) is robot
    other = robot.with_inertial(robot.inertial.scaled(2.0))
    # The joints that are left when one is locked still carry the other masses.
    name = robot.joint_names[0]
    locked = SpaceRobot(other.description.with_locked({name: 0.0}))
    assert locked.total_mass == pytest.approx(2 * robot.total_mass)
