"""Barycentric vectors (paper 4, eqs 1-3) and the energy of the inertia they give (eq. 14)."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from support.oracles import (
    Array,
    MujocoOracle,
    PinocchioOracle,
    assert_agrees,
    random_motion,
)
from support.oracles.barycentric import barycentric_vectors
from support.random_robots import random_chain_urdf, random_robot_urdf

from spacerobot_ros.model import RobotDescription, SpaceRobot, parse_robot
from spacerobot_ros.model.kinematics import tree_kinematics

SEEDS = range(50, 54)


@cache
def random_tree(seed: int) -> tuple[RobotDescription, PinocchioOracle, Array]:
    return _with_shape(seed, random_robot_urdf(np.random.default_rng(seed), 3 + seed % 3))


@cache
def random_chain(seed: int) -> tuple[RobotDescription, PinocchioOracle, Array]:
    return _with_shape(seed, random_chain_urdf(np.random.default_rng(seed), 4))


def _with_shape(seed: int, urdf: str) -> tuple[RobotDescription, PinocchioOracle, Array]:
    description = parse_robot(urdf)
    oracle = PinocchioOracle(urdf, description.joint_names)
    shape = np.random.default_rng(seed + 1000).uniform(-1.5, 1.5, len(description.joint_names))
    return description, oracle, shape


def vectors(description: RobotDescription, q: Array) -> Array:
    """Return ``v[i, k]`` (N + 1, N + 1, 3) at a shape."""
    kinematics = tree_kinematics(description)
    rows = barycentric_vectors(kinematics)
    stacked = ca.vertcat(*(ca.horzcat(*row).T for row in rows))
    count = len(rows)
    values = np.array(ca.Function("v", [kinematics.q], [stacked])(q))
    return values.reshape(count, count, 3)


def mass_centres(oracle: PinocchioOracle, links: list[str], q: Array) -> tuple[Array, Array]:
    """Return masses (N + 1,) and mass centres (N + 1, 3) of the bodies that carry these links,
    in the base, as Pinocchio has them.
    """
    oracle.set_configuration(q)
    model, data = oracle.model, oracle.data
    frames = [model.frames[model.getFrameId(link)] for link in links]
    # Its name is another since Pinocchio 3.
    parent = "parentJoint" if hasattr(frames[0], "parentJoint") else "parent"
    joints = [getattr(frame, parent) for frame in frames]
    masses = [model.inertias[joint].mass for joint in joints]
    centres = [data.oMi[joint].act(model.inertias[joint].lever) for joint in joints]
    return np.array(masses), np.array(centres)


@pytest.mark.parametrize("seed", SEEDS)
def test_barycentric_vectors_of_each_body_balance(seed: int) -> None:
    """``sum_k m_k v_ik = 0``: the vectors start at the barycentre of the augmented body."""
    description, oracle, q = random_tree(seed)
    masses, _ = mass_centres(oracle, [body.name for body in description.bodies], q)
    v = vectors(description, q)
    moments = np.einsum("k,ika->ia", masses, v)
    assert np.abs(v).max() > 0.1
    assert_agrees(moments, np.zeros_like(moments), tolerance=1e-10)


@pytest.mark.parametrize("seed", SEEDS)
def test_barycentric_vectors_reach_every_mass_centre(seed: int) -> None:
    """``rho_k = sum_i v_ik``, eq. (1)."""
    description, oracle, q = random_tree(seed)
    masses, centres = mass_centres(oracle, [body.name for body in description.bodies], q)
    rho = centres - masses @ centres / masses.sum()
    assert_agrees(vectors(description, q).sum(axis=0), rho)


@pytest.mark.parametrize("seed", SEEDS)
def test_barycentric_vectors_of_a_chain_are_the_papers(seed: int) -> None:
    """Eqs (3a) and (3b), from the joints and mass centres that Pinocchio has."""
    description, oracle, q = random_chain(seed)
    names = [body.name for body in description.bodies]
    masses, centres = mass_centres(oracle, names, q)
    model, data = oracle.model, oracle.data
    joints = [model.getJointId(joint.name) for joint in description.movable_joints]
    points = np.array([data.oMi[joint].translation for joint in joints])
    last, M = len(names) - 1, masses.sum()
    # l_i and r_i run from the mass centre of body i to its inboard and its outboard joint; the
    # ends of the chain have but one, and eq. (3b) gives the other no weight.
    l = np.vstack([np.zeros(3), points - centres[1:]])
    r = np.vstack([points - centres[:-1], np.zeros(3)])
    inboard = np.concatenate([[0.0], np.cumsum(masses)[:-1]]) / M
    c = l * inboard[:, None] + r * (1 - np.cumsum(masses) / M)[:, None]

    v = vectors(description, q)
    expected = np.array(
        [
            [-c[i] if i == k else (r[i] if i < k else l[i]) - c[i] for k in range(last + 1)]
            for i in range(last + 1)
        ]
    )
    assert_agrees(v, expected)


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
