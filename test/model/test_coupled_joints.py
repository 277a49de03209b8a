"""Joints that follow others: the same robot without the coupling, in Pinocchio, with q imposed."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
from support.oracles import Array, Motion, PinocchioOracle, assert_agrees, random_motion
from support.random_robots import random_robot_urdf

from spacerobot_ros.model import SpaceRobot, parse_robot
from spacerobot_ros.model.kinematics import ForwardKinematics
from spacerobot_ros.model.rotations import matrix_from_quaternion

SEEDS = range(5)


@dataclass(frozen=True)
class Coupled:
    """A random robot of five joints two of which follow others; how, the test itself decides.

    The moving joints of the robot without coupling are at ``G q + b``.
    """

    robot: SpaceRobot
    engine: PinocchioOracle
    G: Array
    b: Array
    motion: Motion

    @property
    def imposed(self) -> Motion:
        """The motion of the robot without coupling."""
        m = self.motion
        return replace(m, q=self.G @ m.q + self.b, qdot=self.G @ m.qdot)

    @property
    def reduction(self) -> Array:
        """(6 + m, 6 + n) matrix that takes ``[v_cm; omega; qdot]`` to that without coupling."""
        m, n = self.G.shape
        return np.block([[np.eye(6), np.zeros((6, n))], [np.zeros((m, 6)), self.G]])


@cache
def coupled_robot(seed: int) -> Coupled:
    rng = np.random.default_rng(seed)
    urdf = random_robot_urdf(rng, joints=5)
    names = parse_robot(urdf).joint_names
    leader, other, follower, chained, last = rng.permutation(5)
    k, offset, k2 = 1.7, 0.3, -0.6
    text = urdf
    for joint, mimic in (
        (follower, f'<mimic joint="{names[leader]}" multiplier="{k}" offset="{offset}"/>'),
        (chained, f'<mimic joint="{names[follower]}" multiplier="{k2}"/>'),
    ):
        opening = f'<joint name="{names[joint]}"'
        head, tail = text.split(opening, 1)
        text = head + opening + tail.replace("</joint>", f"{mimic}</joint>", 1)
    robot = SpaceRobot.from_urdf(text)
    independent = sorted([leader, other, last])
    G, b = np.zeros((5, 3)), np.zeros(5)
    for column, row in enumerate(independent):
        G[row, column] = 1.0
    G[follower], b[follower] = k * G[leader], offset
    G[chained], b[chained] = k2 * G[follower], k2 * offset
    assert robot.joint_names == tuple(names[i] for i in independent)
    return Coupled(robot, PinocchioOracle(urdf, names), G, b, random_motion(rng, 3))


@pytest.fixture(params=SEEDS, ids=lambda seed: f"robot{seed}")
def case(request: pytest.FixtureRequest) -> Coupled:
    return coupled_robot(request.param)


def test_inertia_matrix(case: Coupled) -> None:
    expected = case.reduction.T @ case.engine.mass_matrix(case.imposed) @ case.reduction
    assert_agrees(case.robot.inertia_matrix(case.motion.q), expected)


def test_bias(case: Coupled) -> None:
    m = case.motion
    found = case.robot.bias(m.q, m.v_cm_B, m.omega_WB_B, m.qdot)
    assert_agrees(found, case.reduction.T @ case.engine.bias(case.imposed))


def test_forward_dynamics(case: Coupled) -> None:
    """The coupling's forces do no work: the reduced equations are those of d'Alembert."""
    m, rng = case.motion, np.random.default_rng(1)
    wrench_B, tau = rng.uniform(-5, 5, 6), rng.uniform(-3, 3, 3)
    free = case.engine.forward_dynamics(case.imposed, wrench_B, np.zeros(5))
    H = case.engine.mass_matrix(case.imposed)
    T = case.reduction
    force = T.T @ (H @ free) + np.concatenate([np.zeros(6), tau])
    expected = np.linalg.solve(T.T @ H @ T, force)
    found = case.robot.forward_dynamics(m.q, m.v_cm_B, m.omega_WB_B, m.qdot, wrench_B, tau)
    assert_agrees(found, expected)


def test_connection_center_of_mass_poses_and_jacobians(case: Coupled) -> None:
    q = case.motion.q
    imposed = case.imposed
    assert_agrees(case.robot.connection(q), case.engine.connection(imposed.q) @ case.G)
    assert_agrees(case.robot.center_of_mass(q), case.engine.center_of_mass(imposed.q))
    for link in case.robot.link_names:
        R, r = case.robot.link_pose(link, q)
        R_expected, r_expected = case.engine.link_pose(link, imposed.q)
        assert_agrees(R, R_expected)
        assert_agrees(r, r_expected)
        expected = case.engine.jacobian(link, imposed) @ case.reduction
        assert_agrees(case.robot.jacobian(link, q), expected)


def test_momentum_and_energy(case: Coupled) -> None:
    m, v_WB_B = case.motion, np.array([0.3, -0.2, 0.5])
    found = case.robot.momentum(m.quaternion_WB, m.q, v_WB_B, m.omega_WB_B, m.qdot)
    expected = case.engine.momentum(case.imposed, v_WB_B)
    for index in range(3):
        assert_agrees(found[index], expected[index])


def test_efforts_of_a_motion_at_zero_momentum_are_those_that_cause_it(case: Coupled) -> None:
    m, qddot = case.motion, np.array([0.4, -0.7, 0.2])
    zero = np.zeros(3)
    _, omega_WB_B = case.robot.base_twist(m.quaternion_WB, m.q, m.qdot, zero, zero)
    tau = case.robot.joint_efforts(m.q, m.qdot, qddot)
    caused = case.robot.forward_dynamics(m.q, zero, omega_WB_B, m.qdot, np.zeros(6), tau)
    assert_agrees(caused[6:], qddot)


def test_limits_of_joints_that_follow_are_kept() -> None:
    case = coupled_robot(0)
    description = case.robot.description
    moving = description.moving_joints
    for what, sign in (("lower", 1.0), ("upper", -1.0)):
        q = description.limits(what)
        for i in range(3):
            inside = np.zeros(3)
            if not np.isfinite(q[i]):
                continue
            inside[i] = q[i] + sign * 1e-9
            for joint, position in zip(moving, case.G @ inside + case.b, strict=True):
                assert joint.limits.lower <= position <= joint.limits.upper
    rates = np.abs(case.G) @ np.diag(description.limits("velocity"))
    assert rates.max() <= max(joint.limits.velocity for joint in moving) * (1 + 1e-12)


def test_a_locked_leader_locks_what_follows() -> None:
    case = coupled_robot(1)
    name = case.robot.joint_names[0]
    q = np.array([0.4, -0.2, 0.6])
    locked = SpaceRobot(case.robot.description.with_locked({name: 0.4}))
    assert locked.n == 2
    for link in case.robot.link_names:
        for found, expected in zip(
            locked.link_pose(link, q[1:]), case.robot.link_pose(link, q), strict=True
        ):
            assert_agrees(found, expected)


def test_frames_of_links_follow(case: Coupled) -> None:
    kinematics = ForwardKinematics(case.robot.description)
    transforms = kinematics.transforms_at(case.motion.q)
    for (parent, child), pose in zip(kinematics.moving, transforms, strict=True):
        R_p, r_p = case.engine.link_pose(parent, case.imposed.q)
        R_c, r_c = case.engine.link_pose(child, case.imposed.q)
        assert_agrees(pose[:3], R_p.T @ (r_c - r_p))
        assert_agrees(matrix_from_quaternion(pose[3:]), R_p.T @ R_c)
    for link, R, r in zip(kinematics.links, *kinematics.link_poses(case.motion.q), strict=True):
        assert_agrees(R, case.engine.link_pose(link, case.imposed.q)[0])
        assert_agrees(r, case.engine.link_pose(link, case.imposed.q)[1])
