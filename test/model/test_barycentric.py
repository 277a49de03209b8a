"""Barycentric vectors and numbers of papers, and motion in orbit."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from support.oracles import (
    Array,
    MujocoOracle,
    PinocchioOracle,
    assert_agrees,
    random_motion,
)
from support.random_robots import random_robot_urdf

from spacerobot_ros.model import RobotDescription, SpaceRobot, parse_robot
from spacerobot_ros.model.external_loads import (
    mean_motion_at,
)

SEEDS = range(50, 54)


@cache
def random_tree(seed: int) -> tuple[RobotDescription, PinocchioOracle, Array]:
    return _with_shape(seed, random_robot_urdf(np.random.default_rng(seed), 3 + seed % 3))


def _with_shape(seed: int, urdf: str) -> tuple[RobotDescription, PinocchioOracle, Array]:
    description = parse_robot(urdf)
    oracle = PinocchioOracle(urdf, description.joint_names)
    shape = np.random.default_rng(seed + 1000).uniform(-1.5, 1.5, len(description.joint_names))
    return description, oracle, shape


def assert_energy_is_that_of_the_bodies(seed: int) -> None:
    """``T = 1/2 z0dot' H+ z0dot``, eq. (14), is what the bodies have one by one."""
    description, oracle, _ = random_tree(seed)
    robot = SpaceRobot(description)
    motion = random_motion(np.random.default_rng(seed + 2000), robot.n)
    energy = 0.5 * motion.z0dot @ robot.inertia_matrix(motion.q) @ motion.z0dot
    # The ledger takes the velocity of the base's origin: the one at which the centre of mass
    # of the system has that of the motion.
    v_WB_B = robot.jacobian(robot.base_link, motion.q)[:3] @ motion.z0dot
    p_W, _, of_bodies = robot.momentum(
        motion.quaternion_WB, motion.q, v_WB_B, motion.omega_WB_B, motion.qdot
    )
    assert_agrees(energy, of_bodies)
    assert_agrees(np.linalg.norm(p_W), robot.total_mass * np.linalg.norm(motion.v_cm_B))
    for engine in (oracle, MujocoOracle(description.urdf, robot.joint_names)):
        assert_agrees(energy, engine.momentum(motion)[2])


@pytest.mark.parametrize("seed", SEEDS)
def test_energy_of_the_inertia_matrix(seed: int) -> None:
    assert_energy_is_that_of_the_bodies(seed)


def test_energy_of_the_compiled_inertia_matrix(compiled_code: Path) -> None:
    assert_energy_is_that_of_the_bodies(51)


# -- numbers of papers 2 to 4 (paper 1: ``test_curvature``), and the robots in ``urdf/`` ---------


URDF = Path(__file__).parents[2] / "urdf"
ROBOTS = ("planar_chain", "planar_manipulator", "sliding_masses", "three_joint_arm")


def load(name: str) -> SpaceRobot:
    return SpaceRobot.from_file(URDF / f"{name}.urdf")


# -- the robots -------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ROBOTS)
def test_robot_is_physically_valid(name: str) -> None:
    robot = load(name)
    assert robot.description.name == name
    assert robot.base_link == "base_link"
    for link in robot.description.links:
        moments = np.linalg.eigvalsh(link.inertia.about_com)
        assert moments[2] <= moments[0] + moments[1] + 1e-12, link.name
        assert link.shapes or link.name == "end_effector"
    assert np.all(np.isfinite(robot.velocity_limit) & (robot.velocity_limit > 0))
    assert np.all(np.isfinite(robot.effort_limit) & (robot.effort_limit > 0))
    assert np.all(robot.lower < robot.upper)


@pytest.mark.parametrize("name", ROBOTS)
def test_robot_has_the_connection_of_pinocchio(name: str) -> None:
    robot = load(name)
    oracle = PinocchioOracle((URDF / f"{name}.urdf").read_text("utf-8"), robot.joint_names)
    for q in np.random.default_rng(40).uniform(-1.5, 1.5, (5, robot.n)):
        assert_agrees(robot.connection(q), oracle.connection(q))


# -- paper 2: a three-joint arm turns the spacecraft ------------------------------------------


def test_curvature_of_the_representative_arm_is_well_conditioned() -> None:
    K = load("three_joint_arm").curvature(np.radians([0.0, -45.0, 90.0]))
    M = np.column_stack([K[3:, 0, 1], K[3:, 1, 2], K[3:, 2, 0]])
    assert round(float(np.linalg.cond(M)), 2) == 3.60


# -- paper 3: a planar chain ------------------------------------------------------------------


def closed_forms(psi: Array) -> Array:
    """Return ``s = (N_1, N_2) / D``, section IV as printed."""
    one, two, both = np.cos(psi[0]), np.cos(psi[1]), np.cos(psi[0] + psi[1])
    N_1 = 17.5 + 7.5 * one + 10.5 * two + 2.5 * both
    N_2 = 3.75 + 5.25 * two + 2.5 * both
    D = 32.5 + 15 * one + 10.5 * two + 5 * both
    return np.array([N_1, N_2]) / D


@pytest.mark.parametrize("psi", np.random.default_rng(41).uniform(-np.pi, np.pi, (8, 2)))
def test_connection_of_the_planar_chain_is_the_printed_one(psi: Array) -> None:
    robot = load("planar_chain")
    A = robot.connection(psi)
    # theta1dot = -s' psidot, about z and nothing else.
    assert_agrees(A[5], closed_forms(psi))
    assert_agrees(A[2:5], np.zeros((3, 2)))
    # The base's centre of mass is its origin: the system's stays where it is.
    oracle = PinocchioOracle(robot.description.urdf, robot.joint_names)
    assert_agrees(A, oracle.connection(psi))


def test_compiled_connection_of_the_planar_chain(compiled_code: Path) -> None:
    robot, psi = load("planar_chain"), np.array([2.0, -1.0])
    assert_agrees(robot.connection(psi)[5], closed_forms(psi))
    assert robot.function("connection").class_name() == "External"


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
    step = 1e-5
    e_1, e_2 = step * np.eye(2)
    H = (
        (closed_forms(psi + e_1) - closed_forms(psi - e_1))[1]
        - (closed_forms(psi + e_2) - closed_forms(psi - e_2))[0]
    ) / (2 * step)
    assert round(float(H), 4) == height
    K = load("planar_chain").curvature(psi)[:, 0, 1]
    # In a plane rotations commute, and the curvature is the phase density alone: the base turns by
    # minus the integral of s' dpsi.
    assert_agrees(K[5], -H, tolerance=1e-8)
    assert_agrees(K[2:5], np.zeros(3))


# -- paper 4: spacecraft and manipulator ------------------------------------------------------


def test_start_of_the_planar_manipulator() -> None:
    robot = load("planar_manipulator")
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
    robot = load("planar_manipulator")
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
