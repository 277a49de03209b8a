"""The fast dynamics against the paper's, Pinocchio and MuJoCo."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from support.oracles import (
    ENGINES,
    Array,
    Motion,
    PinocchioOracle,
    assert_agrees,
    random_motion,
    relative_deviation,
)
from support.oracles.barycentric import barycentric_inertia, forward_dynamics
from support.random_robots import random_chain_urdf, random_robot_urdf

from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.compilation import BufferedFunction
from spacerobot_ros.model.composite_rigid_body import composites, state_slices
from spacerobot_ros.model.kinematics import tree_kinematics
from spacerobot_ros.model.rotations import matrix_from_quaternion
from spacerobot_ros.resources import share_directory

SEEDS = range(10)
SERVICER = share_directory() / "urdf" / "servicer.urdf"


@dataclass(frozen=True)
class Case:
    """A robot in a random state, with forces on it."""

    urdf: str
    robot: SpaceRobot
    motion: Motion
    wrench_B: Array
    tau: Array

    def arguments(self) -> tuple[Array, ...]:
        m = self.motion
        return m.q, m.v_cm_B, m.omega_WB_B, m.qdot, self.wrench_B, self.tau

    def dynamics(self) -> Array:
        return self.robot.forward_dynamics(*self.arguments())

    def barycentric_dynamics(self) -> Array:
        kin = tree_kinematics(self.robot.description)
        return forward_dynamics(kin)(*self.arguments()).full().ravel()


def case_of(urdf: str, rng: np.random.Generator) -> Case:
    robot = SpaceRobot.from_urdf(urdf)
    motion = random_motion(rng, robot.n)
    return Case(urdf, robot, motion, rng.uniform(-10, 10, 6), rng.uniform(-5, 5, robot.n))


@cache
def random_case(seed: int) -> Case:
    rng = np.random.default_rng(seed)
    return case_of(random_robot_urdf(rng, joints=3 + seed % 4), rng)


@pytest.fixture(params=SEEDS, ids=lambda seed: f"robot{seed}")
def case(request: pytest.FixtureRequest) -> Case:
    return random_case(request.param)


def test_the_inertia_matrix_is_the_barycentric_one(case: Case) -> None:
    kin = tree_kinematics(case.robot.description)
    paper = ca.Function("H", [kin.q], [barycentric_inertia(kin).H_plus])
    assert_agrees(case.robot.inertia_matrix(case.motion.q), paper(case.motion.q).full(), 1e-13)


def test_a_chain_of_24_joints_takes_few_operations() -> None:
    rng = np.random.default_rng(24)
    urdf = random_chain_urdf(rng, 24)
    robot = SpaceRobot.from_urdf(urdf)
    q = rng.uniform(-1.5, 1.5, 24)
    H = robot.function("inertia_matrix", compile=False)(q).full()
    motion = replace(random_motion(rng, 24), q=q)
    assert_agrees(H, PinocchioOracle(urdf, robot.joint_names).mass_matrix(motion), 1e-11)
    kin = tree_kinematics(robot.description)
    parts = composites(kin)
    # By the barycentric form they are more than 85,000.
    assert ca.Function("locked", [kin.q], ca.cse([parts.D, parts.D_q])).n_instructions() < 10_000


def test_same_as_the_paper(case: Case) -> None:
    assert_agrees(case.dynamics(), case.barycentric_dynamics(), 1e-12)


@pytest.mark.parametrize("engine", ENGINES)
def test_same_as_the_engines(case: Case, engine: type) -> None:
    oracle = engine(case.urdf, case.robot.joint_names)
    assert_agrees(case.dynamics(), oracle.forward_dynamics(case.motion, case.wrench_B, case.tau))


@pytest.mark.parametrize("engine", ENGINES)
def test_bodies_with_axes_of_symmetry(engine: type) -> None:
    """They are built from fewer directions than others."""
    case = case_of(SERVICER.read_text(encoding="utf-8"), np.random.default_rng(21))
    oracle = engine(case.urdf, case.robot.joint_names)
    assert_agrees(case.dynamics(), oracle.forward_dynamics(case.motion, case.wrench_B, case.tau))


@pytest.mark.parametrize("joints", [0, 1, 2, 12])
def test_chains(joints: int) -> None:
    rng = np.random.default_rng(100 + joints)
    case = case_of(random_chain_urdf(rng, joints), rng)
    assert_agrees(case.dynamics(), case.barycentric_dynamics(), 1e-12)


def test_shape_equations_are_the_schur_complement(case: Case) -> None:
    """Of the paper's ``H+`` with respect to the base, at momenta that do not matter."""
    robot, n = case.robot, case.robot.n
    x = np.zeros(2 * n + 13)
    shape, attitude, rates, *_ = state_slices(n)
    x[shape], x[attitude], x[rates] = case.motion.q, case.motion.quaternion_WB, case.motion.qdot
    K, _ = robot.buffered("shape_equations")(x, np.zeros(n + 6))
    H = robot.inertia_matrix(case.motion.q)
    assert_agrees(K, H[6:, 6:] - H[6:, :6] @ np.linalg.solve(H[:6, :6], H[:6, 6:]), 1e-12)
    assert_agrees(K, K.T, 0.0)


def test_shape_forces_from_the_papers_acceleration(case: Case) -> None:
    """``K qddot`` at the momenta of the state is ``Q``."""
    robot, m = case.robot, case.motion
    L_W = matrix_from_quaternion(m.quaternion_WB) @ robot.inertia_matrix(m.q)[3:6] @ m.z0dot
    x = np.concatenate([m.q, m.quaternion_WB, m.qdot, np.zeros(3), L_W, np.zeros(3)])
    K, Q = robot.buffered("shape_equations")(x, np.concatenate([case.tau, case.wrench_B]))
    assert_agrees(K @ robot.forward_dynamics(*case.arguments())[6:], Q, 1e-12)


@pytest.mark.parametrize("engine", ENGINES)
def test_efforts_of_a_motion_at_zero_momentum(case: Case, engine: type) -> None:
    """An engine's robot at zero momentum accelerates under them as they were asked for."""
    robot, n = case.robot, case.robot.n
    oracle = engine(case.urdf, robot.joint_names)
    H = oracle.mass_matrix(case.motion)
    qdot, qddot = case.motion.qdot, np.linspace(2.0, -3.0, n)
    omega = -np.linalg.solve(H[3:6, 3:6], H[3:6, 6:] @ qdot)
    motion = replace(case.motion, v_cm_B=np.zeros(3), omega_WB_B=omega)
    tau = robot.joint_efforts(motion.q, qdot, qddot)
    reached = oracle.forward_dynamics(motion, np.zeros(6), tau)
    assert_agrees(reached[6:], qddot, 1e-9)
    # The same path in half the time takes four times the efforts.
    assert_agrees(robot.joint_efforts(motion.q, 2 * qdot, 4 * qddot), 4 * tau, 1e-12)


def test_costs_less_than_half_of_the_papers() -> None:
    robot = SpaceRobot.from_file(SERVICER)
    fast = robot.function("forward_dynamics", compile=False)
    slow = forward_dynamics(tree_kinematics(robot.description)).expand()
    assert fast.n_nodes() < 0.45 * slow.n_nodes()


def test_compiled_numbers(compiled_code: Path) -> None:
    interpreted = random_case(0)
    robot = SpaceRobot(interpreted.robot.description)
    function = robot.function("forward_dynamics")
    assert function.class_name() == "External"
    (compiled,) = BufferedFunction(function)(*interpreted.arguments())
    expected = interpreted.barycentric_dynamics()
    assert relative_deviation(compiled, expected) < 1e-12
