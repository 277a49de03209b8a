"""Curvature, numbers of the papers, derivatives of momenta, rates that leave the base still."""

from __future__ import annotations

from functools import cache

import casadi as ca
import numpy as np
import numpy.typing as npt
import pinocchio as pin
import pytest
from model.test_coupled_joints import coupled_robot
from planning.sliding_robots import random_sliding_robot
from support.oracles import Array, PinocchioOracle, assert_agrees
from support.planar_manoeuvres import closed_forms, phase_density
from support.random_robots import random_robot_urdf
from support.slow import some_fast

from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Inertia
from spacerobot_ros.model.grasp import Payload
from spacerobot_ros.model.rotations import matrix_from_rpy
from spacerobot_ros.resources import robot_file
from spacerobot_ros.simulation.loads import mean_motion_at

SEEDS = range(20, 24)


def of_package(name: str) -> SpaceRobot:
    return SpaceRobot.from_file(robot_file(name))


@cache
def random_case(seed: int) -> tuple[SpaceRobot, PinocchioOracle, Array]:
    rng = np.random.default_rng(seed)
    urdf = random_robot_urdf(rng, joints=3 + seed % 2)
    robot = SpaceRobot.from_urdf(urdf)
    return robot, PinocchioOracle(urdf, robot.joint_names), rng.uniform(-1.0, 1.0, robot.n)


def twist_matrix(twist: npt.ArrayLike) -> Array:
    """Return the element (4, 4) of se(3) of a body twist ``[v; omega]``."""
    v, (x, y, z) = np.split(np.asarray(twist, dtype=float), 2)
    return np.array([[0, -z, y, v[0]], [z, 0, -x, v[1]], [-y, x, 0, v[2]], [0, 0, 0, 0]])


def twist_of(matrix: Array) -> Array:
    return np.array([*matrix[:3, 3], matrix[2, 1], matrix[0, 2], matrix[1, 0]])


# -- definition -------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", SEEDS)
def test_curvature_is_the_derivative_and_bracket_of_the_connection(seed: int) -> None:
    robot, oracle, q = random_case(seed)
    step, n = 2e-3, robot.n

    def F(shape: Array) -> Array:
        return -oracle.connection(shape)

    # Central differences of fourth order.
    dF = np.stack(
        [
            (8 * (F(q + e) - F(q - e)) - (F(q + 2 * e) - F(q - 2 * e))) / (12 * step)
            for e in step * np.eye(n)
        ]
    )
    base = [twist_matrix(column) for column in F(q).T]
    expected = np.empty((6, n, n))
    for i in range(n):
        for j in range(n):
            bracket = twist_of(base[i] @ base[j] - base[j] @ base[i])
            expected[:, i, j] = dF[i][:, j] - dF[j][:, i] + bracket
    assert_agrees(robot.curvature(q), expected, tolerance=1e-10)


# -- paper 1 ----------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", [30, 31, 32])
def test_brackets_and_connection_of_sliders_anywhere(seed: int) -> None:
    """Eqs (3) and (7), the derivatives by central differences of fourth order."""
    rng = np.random.default_rng(seed)
    paper = random_sliding_robot(rng, 3)
    robot = SpaceRobot.from_urdf(paper.urdf)
    z, step = rng.uniform(-1.5, 1.5, 3), 2e-3

    def F(z: Array) -> Array:
        return paper.base_rate(np.tile(z, (3, 1)), np.eye(3))

    assert_agrees(-robot.connection(z)[3:], F(z).T)
    dF = [
        (8 * (F(z + e) - F(z - e)) - (F(z + 2 * e) - F(z - 2 * e))) / (12 * step)
        for e in step * np.eye(3)
    ]
    expected = np.empty((3, 3, 3))
    for i in range(3):
        for j in range(3):
            expected[:, i, j] = np.cross(F(z)[j], F(z)[i]) + dF[j][i] - dF[i][j]
    assert_agrees(-robot.curvature(z)[3:], expected)


PAPERS = ("planar_chain", "planar_manipulator", "sliding_masses", "three_joint_arm")


@pytest.mark.parametrize("name", PAPERS)
def test_robots_of_the_papers_have_limits_shapes_and_the_connection_of_pinocchio(name: str) -> None:
    robot = of_package(name)
    assert robot.description.name == name
    assert all(link.shapes or link.name == "end_effector" for link in robot.description.links)
    assert np.all(np.isfinite(robot.velocity_limit) & (robot.velocity_limit > 0))
    assert np.all(np.isfinite(robot.effort_limit) & (robot.effort_limit > 0))
    assert np.all(robot.lower < robot.upper)
    oracle = PinocchioOracle(robot.description.urdf, robot.joint_names)
    for q in np.random.default_rng(40).uniform(-1.5, 1.5, (5, robot.n)):
        assert_agrees(robot.connection(q), oracle.connection(q))


# -- paper 2: a three-joint arm turns the spacecraft ------------------------------------------


def test_curvature_of_the_representative_arm_is_well_conditioned() -> None:
    K = of_package("three_joint_arm").curvature(np.radians([0.0, -45.0, 90.0]))
    M = np.column_stack([K[3:, 0, 1], K[3:, 1, 2], K[3:, 2, 0]])
    assert round(float(np.linalg.cond(M)), 2) == 3.60


# -- paper 3: a planar chain ------------------------------------------------------------------


@pytest.mark.parametrize("psi", np.random.default_rng(41).uniform(-np.pi, np.pi, (8, 2)))
def test_connection_of_the_planar_chain_is_the_printed_one(psi: Array) -> None:
    A = of_package("planar_chain").connection(psi)
    # theta1dot = -s' psidot, about z and nothing else.
    assert_agrees(A[5], closed_forms(psi))
    assert_agrees(A[2:5], np.zeros((3, 2)))


@pytest.mark.parametrize(
    ("psi", "height"),
    [
        (np.array([5 * np.pi / 6, 2 * np.pi / 3]), 0.5357),
        (np.array([2 * np.pi / 3, 5 * np.pi / 6]), 0.3003),
        (np.radians([153.0, 121.0]), 0.5376),
        (np.radians([-153.0, -121.0]), -0.5376),
    ],
)
def test_phase_density_of_the_planar_chain(psi: Array, height: float) -> None:
    H = phase_density(psi)
    assert round(float(H), 4) == height
    K = of_package("planar_chain").curvature(psi)[:, 0, 1]
    # In a plane rotations commute, and the curvature is the phase density alone: the base turns by
    # minus the integral of s' dpsi.
    assert_agrees(K[5], -H, tolerance=1e-8)
    assert_agrees(K[2:5], np.zeros(3))


# -- paper 4: spacecraft and manipulator ------------------------------------------------------


def test_start_of_the_planar_manipulator() -> None:
    robot = of_package("planar_manipulator")
    theta, q = np.radians(21.0), np.radians([-58.0, 60.3])
    R_WB = np.array(
        [
            [np.cos(theta), -np.sin(theta), 0.0],
            [np.sin(theta), np.cos(theta), 0.0],
            [0.0, 0.0, 1.0],
        ]
    )
    # The system's centre of mass is the origin of the world.
    spacecraft = -R_WB @ robot.center_of_mass(q)
    end_effector = spacecraft + R_WB @ robot.link_pose("end_effector", q)[1]
    assert np.round(spacecraft, 5).tolist() == [-0.18380, 0.02471, 0.0]
    assert np.round(end_effector, 5).tolist() == [2.00008, -0.00237, 0.0]


def test_table_of_the_planar_manipulator() -> None:
    robot = of_package("planar_manipulator")
    bodies = robot.description.bodies
    assert [body.inertia.mass for body in bodies] == [40.0, 4.0, 3.0]
    assert [body.inertia.about_com[2, 2] for body in bodies] == [6.667, 0.333, 0.250]
    # Stretched out: spacecraft, its end, the joints and the end-effector half a metre from each
    # centre of mass.
    for link, x in (("link_1", 0.5), ("link_2", 1.5), ("end_effector", 2.5)):
        assert_agrees(robot.link_pose(link, [0.0, 0.0])[1], [x, 0.0, 0.0])
    for body in bodies[1:]:
        assert body.inertia.com.tolist() == [0.5, 0.0, 0.0]


def test_the_period_of_low_and_geosynchronous_orbits() -> None:
    assert 2 * np.pi / mean_motion_at(400e3) == pytest.approx(5553.6, abs=0.1)
    assert 2 * np.pi / mean_motion_at(35786e3) == pytest.approx(86164.0, abs=1.0)


# -- derivatives of the angular momentum in closed form against those by CasADi ------------------


def compare(robot: SpaceRobot, seed: int) -> None:
    q, qdot = ca.SX.sym("q", robot.n), ca.SX.sym("qdot", robot.n)
    omega, eta = ca.SX.sym("omega", 3), ca.SX.sym("eta", 3)
    D, D_q = robot.function("locked_inertia", compile=False)(q)
    momentum = D @ omega + D_q @ qdot
    weighted = ca.dot(eta, momentum)
    slope = ca.gradient(weighted, q)
    wanted = [ca.jacobian(momentum, q), *(ca.jacobian(slope, x) for x in (q, qdot, omega))]
    symbols = [q, omega, qdot, eta]
    of_casadi = ca.Function("of_casadi", symbols, [ca.densify(x) for x in wanted])
    ours = robot.function("momentum_derivatives", compile=False)
    rng = np.random.default_rng(seed)
    for _ in range(3):
        at = [rng.uniform(-1.5, 1.5, x.numel()) for x in symbols]
        for found, expected in zip(ours(*at), of_casadi(*at), strict=True):
            assert found.shape == expected.shape
            scale = np.abs(expected.full()).max()
            assert scale > 1e-3
            assert found.full() == pytest.approx(expected.full(), abs=1e-13 * scale)


def test_branches_sliders_and_joints_that_follow() -> None:
    robot = coupled_robot(0).robot
    assert robot.description.has_mimic_joints
    compare(robot, 2)


@pytest.mark.parametrize("name", some_fast(["seven_joint_arm", "quadruped"]))
def test_robots_of_the_package(name: str) -> None:
    compare(of_package(name), 4)


# -- joint rates that leave the base still, alone and after a capture ---------------------------


TURN = matrix_from_rpy([0.4, -0.7, 1.1])
BODY = Inertia(23.0, np.array([0.3, -0.2, 0.4]), TURN @ np.diag([2.1, 3.9, 5.4]) @ TURN.T)
SHAPE = np.array([0.3, -0.7, 0.5, 1.1, -0.4, 0.8, -0.6])


def base_rate(robot: SpaceRobot, held: Inertia | None, q: Array, qdot: Array) -> Array:
    """The angular velocity of the base at zero momentum, by Pinocchio."""
    oracle = PinocchioOracle(robot.description.urdf, robot.joint_names)
    if held is not None:
        model = oracle.model
        wrist = model.frames[model.getFrameId("link_7", pin.FrameType.BODY)]
        inertia = pin.Inertia(held.mass, held.com, held.about_com)
        model.appendBodyToJoint(wrist.parentJoint, inertia, wrist.placement)
        oracle.data = model.createData()
    return oracle.base_twist(q, qdot)[3:]


@pytest.fixture(scope="module")
def arm() -> SpaceRobot:
    return of_package("seven_joint_arm")


@pytest.mark.parametrize("held", [None, BODY], ids=["alone", "after a capture"])
def test_the_base_is_still_while_the_joints_move(arm: SpaceRobot, held: Inertia | None) -> None:
    robot = arm if held is None else Payload("link_7", held).attached_to(arm)
    q, wanted = SHAPE.copy(), np.array([0.5, -0.2, 0.4, 0.3, -0.6, 0.2, 0.7])
    for _ in range(6):
        N = robot.reaction_null_space(q)
        assert N.shape == (7, 4)
        np.testing.assert_allclose(N.T @ N, np.eye(4), atol=1e-12)
        rates = N @ (N.T @ wanted)
        assert np.linalg.norm(rates) > 0.2
        assert np.linalg.norm(base_rate(robot, held, q, rates)) < 1e-9
        # The wanted rates themselves turn it, and so do those for the other robot.
        assert np.linalg.norm(base_rate(robot, held, q, wanted)) > 1e-2
        other = BODY if held is None else None
        assert np.linalg.norm(base_rate(robot, other, q, rates)) > 1e-3
        q = q + 0.2 * rates


@pytest.mark.parametrize(
    ("name", "joints", "free"), [("planar_manipulator", 2, 1), ("three_joint_arm", 3, 1)]
)
def test_the_dimension_is_that_of_the_joints_beyond_the_independent_turns(
    name: str, joints: int, free: int
) -> None:
    robot = of_package(name)
    assert robot.reaction_null_space(np.array([0.4, -0.9, 1.1])[:joints]).shape == (joints, free)
