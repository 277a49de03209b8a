"""The model against Pinocchio, MuJoCo and the paper on random robots, compiled and not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.oracles import (
    ENGINES,
    Array,
    Motion,
    Oracle,
    PinocchioOracle,
    assert_agrees,
    random_motion,
)
from support.oracles.barycentric import barycentric_inertia
from support.random_robots import random_chain_urdf, random_robot_urdf

from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.dynamics import composites
from spacerobot_ros.model.integration import state_slices
from spacerobot_ros.model.kinematics import ForwardKinematics, tree_kinematics
from spacerobot_ros.model.rotations import matrix_from_quaternion
from spacerobot_ros.resources import robot_file

SEEDS = range(10)

_DISTURBED = 1e-5
"""Share of a disturbance of order one by which a motion is disturbed."""


@dataclass(frozen=True)
class Case:
    """A random robot in a random state, with forces on it, and the engines that know it too."""

    robot: SpaceRobot
    motion: Motion
    v_WB_B: Array
    wrench_B: Array
    tau: Array
    momentum_W: Array
    engines: dict[str, Oracle]

    def dynamics(self) -> Array:
        m = self.motion
        return self.robot.forward_dynamics(
            m.q, m.v_cm_B, m.omega_WB_B, m.qdot, self.wrench_B, self.tau
        )


@cache
def random_case(seed: int) -> Case:
    rng = np.random.default_rng(seed)
    return case_of(random_robot_urdf(rng, joints=3 + seed % 4), rng)


def case_of(urdf: str, rng: np.random.Generator) -> Case:
    robot = SpaceRobot.from_urdf(urdf)
    return Case(
        robot=robot,
        motion=random_motion(rng, robot.n),
        v_WB_B=rng.uniform(-1.0, 1.0, 3),
        wrench_B=rng.uniform(-10.0, 10.0, 6),
        tau=rng.uniform(-5.0, 5.0, robot.n),
        momentum_W=rng.uniform(-5.0, 5.0, 6),
        engines={engine.__name__: engine(urdf, robot.joint_names) for engine in ENGINES},
    )


@pytest.fixture(params=SEEDS, ids=lambda seed: f"robot{seed}")
def case(request: pytest.FixtureRequest) -> Case:
    return random_case(request.param)


@pytest.fixture(params=[engine.__name__ for engine in ENGINES])
def engine(request: pytest.FixtureRequest, case: Case) -> Oracle:
    return case.engines[request.param]


def test_inertia_matrix(case: Case, engine: Oracle) -> None:
    H = case.robot.inertia_matrix(case.motion.q)
    assert_agrees(H, engine.mass_matrix(case.motion))
    assert np.linalg.eigvalsh(H)[0] > 0


def test_bias(case: Case, engine: Oracle) -> None:
    m = case.motion
    C = case.robot.bias(m.q, m.v_cm_B, m.omega_WB_B, m.qdot)
    assert_agrees(C, engine.bias(m))


def test_forward_dynamics(case: Case, engine: Oracle) -> None:
    assert_agrees(case.dynamics(), engine.forward_dynamics(case.motion, case.wrench_B, case.tau))


def test_connection(case: Case, engine: Oracle) -> None:
    assert_agrees(case.robot.connection(case.motion.q), engine.connection(case.motion.q))


def test_base_twist(case: Case, engine: Oracle) -> None:
    m = case.motion
    p_W, L_W = np.split(case.momentum_W, 2)
    twist = np.concatenate(case.robot.base_twist(m.quaternion_WB, m.q, m.qdot, p_W, L_W))
    assert_agrees(twist, engine.base_twist(m.q, m.qdot, m.quaternion_WB, case.momentum_W))


def test_center_of_mass(case: Case, engine: Oracle) -> None:
    assert_agrees(case.robot.center_of_mass(case.motion.q), engine.center_of_mass(case.motion.q))


def test_link_poses(case: Case, engine: Oracle) -> None:
    for link in case.robot.link_names:
        R, r = case.robot.link_pose(link, case.motion.q)
        R_expected, r_expected = engine.link_pose(link, case.motion.q)
        assert_agrees(R, R_expected)
        assert_agrees(r, r_expected)


def test_link_poses_of_many_shapes_without_compilation(case: Case, engine: Oracle) -> None:
    shapes = np.stack([case.motion.q, -0.7 * case.motion.q, np.zeros(case.robot.n)])
    kinematics = ForwardKinematics(case.robot.description)
    R, r = kinematics.link_poses(shapes.reshape(3, 1, -1))
    assert set(kinematics.links) == set(case.robot.link_names)
    for k, q in enumerate(shapes):
        for i, link in enumerate(kinematics.links):
            R_expected, r_expected = engine.link_pose(link, q)
            assert_agrees(R[k, 0, i], R_expected)
            assert_agrees(r[k, 0, i], r_expected)


@pytest.mark.slow
def test_link_jacobians(case: Case, engine: Oracle) -> None:
    for link in case.robot.link_names:
        assert_agrees(case.robot.jacobian(link, case.motion.q), engine.jacobian(link, case.motion))


def test_momentum_and_energy(case: Case, engine: Oracle) -> None:
    m = case.motion
    found = case.robot.momentum(m.quaternion_WB, m.q, case.v_WB_B, m.omega_WB_B, m.qdot)
    expected = engine.momentum(m, case.v_WB_B)
    for index in range(3):
        assert_agrees(found[index], expected[index])


QUANTITIES: dict[str, Callable[[SpaceRobot, Case], Array]] = {
    "center_of_mass": lambda robot, c: robot.center_of_mass(c.motion.q),
    "link_poses": lambda robot, c: np.column_stack(robot.link_pose("tool_frame", c.motion.q)),
    "inertia_matrix": lambda robot, c: robot.inertia_matrix(c.motion.q),
    "bias": lambda robot, c: robot.bias(
        c.motion.q, c.motion.v_cm_B, c.motion.omega_WB_B, c.motion.qdot
    ),
    "forward_dynamics": lambda robot, c: replace(c, robot=robot).dynamics(),
    "jacobian:tool_frame": lambda robot, c: robot.jacobian("tool_frame", c.motion.q),
    "connection": lambda robot, c: robot.connection(c.motion.q),
    "momentum": lambda robot, c: np.concatenate(
        [
            np.atleast_1d(x)
            for x in robot.momentum(
                c.motion.quaternion_WB, c.motion.q, c.v_WB_B, c.motion.omega_WB_B, c.motion.qdot
            )
        ]
    ),
    "base_twist": lambda robot, c: np.concatenate(
        robot.base_twist(
            c.motion.quaternion_WB, c.motion.q, c.motion.qdot, *np.split(c.momentum_W, 2)
        )
    ),
}


@pytest.mark.slow
def test_compiled_and_interpreted_numbers_agree(
    compiled_code: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    case = random_case(0)
    compiled = SpaceRobot(case.robot.description)
    numbers = {name: evaluate(compiled, case) for name, evaluate in QUANTITIES.items()}
    assert {compiled.function(name).class_name() for name in QUANTITIES} == {"External"}
    assert len(list(compiled_code.glob("*.so"))) >= len(QUANTITIES)

    monkeypatch.setenv("SPACEROBOT_COMPILE", "0")
    interpreted = SpaceRobot(case.robot.description)
    for name, evaluate in QUANTITIES.items():
        assert_agrees(numbers[name], evaluate(interpreted, case), tolerance=1e-14)
        assert interpreted.function(name).class_name() != "External"


def test_buffers_keep_the_last_arguments_and_results_in_place() -> None:
    case = random_case(0)
    buffer = case.robot.buffered("inertia_matrix")
    (H,) = buffer.outputs
    for shape in (case.motion.q, -case.motion.q):
        buffer.inputs[0][:] = shape
        buffer.evaluate()
        assert_agrees(H, case.robot.inertia_matrix(shape), tolerance=0.0)
        plain = case.robot.function("inertia_matrix")(shape)
        assert isinstance(plain, ca.DM)
        assert_agrees(H, np.array(plain), tolerance=0.0)


def test_unknown_link_is_named() -> None:
    robot = random_case(0).robot
    with pytest.raises(KeyError, match=r"no link 'thumb'; it has .*base_link"):
        robot.link_pose("thumb", np.zeros(robot.n))
    with pytest.raises(KeyError, match="no link 'thumb'"):
        robot.jacobian("thumb", np.zeros(robot.n))


def test_one_joint_keeps_its_shapes() -> None:
    rng = np.random.default_rng(11)
    urdf = random_chain_urdf(rng, 1)
    robot = SpaceRobot.from_urdf(urdf)
    q = np.array([0.4])
    for engine in ENGINES:
        assert_agrees(robot.connection(q), engine(urdf, robot.joint_names).connection(q))
    assert not robot.curvature(q).any()
    assert robot.curvature(q).shape == (6, 1, 1)


def test_a_body_without_joints() -> None:
    robot = SpaceRobot.from_urdf(random_chain_urdf(np.random.default_rng(12), 0))
    inertia = robot.description.bodies[0].inertia
    assert robot.connection([]).shape == (6, 0)
    R, r = robot.link_pose("base_link", [])
    assert_agrees(R, np.eye(3))
    assert_agrees(r, np.zeros(3))
    # Euler's equations: a torque turns it, the gyroscopic moment of its own spin remains.
    omega, torque = np.array([0.3, -0.7, 0.5]), np.array([1.0, 2.0, -1.0])
    rate = np.linalg.solve(inertia.about_com, torque - np.cross(omega, inertia.about_com @ omega))
    z0ddot = robot.forward_dynamics([], np.zeros(3), omega, [], [0, 0, 0, *torque], [])
    assert_agrees(z0ddot, [0, 0, 0, *rate])


# -- equations of motion --------------------------------------------------------------------------


def test_the_inertia_matrix_is_the_barycentric_one(case: Case) -> None:
    kin = tree_kinematics(case.robot.description)
    paper = ca.Function("H", [kin.q], [barycentric_inertia(kin)])
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


@pytest.mark.parametrize("joints", [1, 2, 12, None])
@pytest.mark.parametrize("engine", ENGINES)
def test_chains_and_bodies_with_axes_of_symmetry(engine: type, joints: int | None) -> None:
    """Symmetric bodies, as the servicer's, are built from fewer directions than others."""
    rng = np.random.default_rng(21 if joints is None else 100 + joints)
    servicer = robot_file("servicer").read_text("utf-8")
    case = case_of(servicer if joints is None else random_chain_urdf(rng, joints), rng)
    oracle = case.engines[engine.__name__]
    assert_agrees(case.dynamics(), oracle.forward_dynamics(case.motion, case.wrench_B, case.tau))


def test_shape_equations_are_the_schur_complement(case: Case) -> None:
    """Of the paper's ``H+`` with respect to the base, at momenta that do not matter."""
    robot, n = case.robot, case.robot.n
    x = np.zeros(2 * n + 13)
    shape, attitude, rates, *_ = state_slices(n)
    m = case.motion
    x[shape], x[attitude], x[rates] = m.q, m.quaternion_WB, m.qdot
    K, _ = robot.buffered("shape_equations")(x, np.zeros(n + 6))
    H = robot.inertia_matrix(m.q)
    assert_agrees(K, H[6:, 6:] - H[6:, :6] @ np.linalg.solve(H[:6, :6], H[:6, 6:]), 1e-12)
    assert_agrees(K, K.T, 0.0)


def test_shape_forces_from_the_papers_acceleration(case: Case) -> None:
    """``K qddot`` at the momenta of the state is ``Q``."""
    robot, m = case.robot, case.motion
    L_W = matrix_from_quaternion(m.quaternion_WB) @ robot.inertia_matrix(m.q)[3:6] @ m.z0dot
    x = np.concatenate([m.q, m.quaternion_WB, m.qdot, np.zeros(3), L_W, np.zeros(3)])
    K, Q = robot.buffered("shape_equations")(x, np.concatenate([case.tau, case.wrench_B]))
    assert_agrees(K @ case.dynamics()[6:], Q, 1e-12)


def test_efforts_of_a_motion_at_zero_momentum(case: Case, engine: Oracle) -> None:
    """An engine's robot at zero momentum accelerates under them as they were asked for."""
    robot, n = case.robot, case.robot.n
    H = engine.mass_matrix(case.motion)
    qdot, qddot = case.motion.qdot, np.linspace(2.0, -3.0, n)
    omega = np.asarray(-np.linalg.solve(H[3:6, 3:6], H[3:6, 6:] @ qdot), np.float64)
    motion = replace(case.motion, v_cm_B=np.zeros(3), omega_WB_B=omega)
    tau = robot.joint_efforts(motion.q, qdot, qddot)
    reached = engine.forward_dynamics(motion, np.zeros(6), tau)
    assert_agrees(reached[6:], qddot, 1e-9)
    # The same path in half the time takes four times the efforts.
    assert_agrees(robot.joint_efforts(motion.q, 2 * qdot, 4 * qddot), 4 * tau, 1e-12)


def test_the_linearised_equations_lead_away_from_a_motion_as_pinocchio_does(case: Case) -> None:
    """A motion that is disturbed in every part, integrated by Pinocchio beside the undisturbed."""
    oracle, m, n = case.engines[PinocchioOracle.__name__], case.motion, case.robot.n
    assert isinstance(oracle, PinocchioOracle)
    A, B = case.robot.linearised(m.q, case.v_WB_B, m.omega_WB_B, m.qdot, case.wrench_B, case.tau)
    rng = np.random.default_rng(8)
    dx, du = rng.uniform(-1.0, 1.0, 12 + 2 * n), rng.uniform(-1.0, 1.0, 6 + n)

    def flown(scale: float, time: float) -> tuple[Array, Array, Array, Array, Array]:
        """Return r_WB, R_WB, q, and the velocities of both, after ``time``."""
        R_WB = Rotation.from_quat(m.quaternion_WB) * Rotation.from_rotvec(scale * dx[3:6])
        r_WB = m.r_WB_W + Rotation.from_quat(m.quaternion_WB).apply(scale * dx[:3])
        q = m.q + scale * dx[6 : 6 + n]
        twist = np.concatenate([case.v_WB_B, m.omega_WB_B]) + scale * dx[6 + n : 12 + n]
        qdot = m.qdot + scale * dx[12 + n :]
        oracle.set_configuration(q, R_WB.as_quat(), r_WB)
        u = oracle.base_velocities(twist) + oracle.joint_velocities(qdot)
        oracle.move(u)
        rates = oracle.own_acceleration(case.wrench_B + scale * du[:6], case.tau + scale * du[6:])
        # To second order in time, which differences about time zero cancel.
        u = u + time * rates
        velocities = oracle.selection @ u
        oracle.set_configuration(q, R_WB.as_quat(), r_WB)
        mean = R_WB * Rotation.from_rotvec(time / 2 * twist[3:])
        return (
            r_WB + time * mean.apply(twist[:3]),
            (R_WB * Rotation.from_rotvec(time * twist[3:])).as_matrix(),
            q + time * qdot,
            np.concatenate([u[:3], velocities[:3]]),
            velocities[3:],
        )

    def distance(time: float) -> Array:
        r_0, R_0, q_0, twist_0, qdot_0 = flown(0.0, time)
        r_1, R_1, q_1, twist_1, qdot_1 = flown(_DISTURBED, time)
        turned = Rotation.from_matrix(R_0.T @ R_1).as_rotvec()
        parts = R_0.T @ (r_1 - r_0), turned, q_1 - q_0, twist_1 - twist_0, qdot_1 - qdot_0
        return np.concatenate(parts) / _DISTURBED

    rate = (distance(1e-4) - distance(-1e-4)) / 2e-4
    np.testing.assert_allclose(rate, A @ dx + B @ du, rtol=1e-4, atol=1e-4 * np.abs(rate).max())
