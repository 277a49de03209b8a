"""The shortest detumbling, and the load of a grasp, against the equations of the robot alone."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from spacerobot_ros.control import ControlState
from spacerobot_ros.control.detumbling import (
    Detumbling,
    largest_feasible_share,
    shortest_detumbling,
)
from spacerobot_ros.control.limits import decay_rate
from spacerobot_ros.model import SpaceRobot, load_robot
from spacerobot_ros.model.description import Array, Inertia
from spacerobot_ros.model.grasp import Payload
from spacerobot_ros.resources import robot_file

PERIOD = 0.02
HELD = Payload(
    "end_effector",
    Inertia(
        7.0,
        np.array([0.3, -0.1, 0.2]),
        np.array([[0.9, 0.1, -0.05], [0.1, 0.7, 0.08], [-0.05, 0.08, 1.1]]),
    ),
)


def test_the_shortest_detumbling_is_momentum_over_torque() -> None:
    assert shortest_detumbling(3.0, 1.5) == 2.0
    assert shortest_detumbling(3.0, math.inf) == 0.0
    assert shortest_detumbling(0.0, 0.0) == 0.0
    assert shortest_detumbling(3.0, 0.0) == math.inf


def test_motion_decays_at_two_a_second_or_slower_with_long_periods() -> None:
    assert decay_rate(0.01) == 2.0
    assert decay_rate(1.0) == 0.5


@pytest.mark.parametrize(
    ("start", "change", "limit", "share"),
    [
        ([0.0, 3.0, 4.0], [0.0, 0.0, 0.0], 1.0, 1.0),
        ([1.0, 0.0, 0.0], [4.0, 0.0, 0.0], 3.0, 0.5),
        ([1.0, 0.0, 0.0], [0.0, 1.0, 0.0], 3.0, 1.0),
        ([0.0, 0.6, 0.0], [4.0, 0.0, 0.0], 1.0, 0.2),
        ([3.0, 0.0, 0.0], [-4.0, 0.0, 0.0], 1.0, 1.0),
        ([3.0, 0.0, 0.0], [-8.0, 0.0, 0.0], 1.0, 0.5),
        ([3.0, 0.0, 0.0], [-1.0, 0.0, 0.0], 1.0, 1.0),
        ([3.0, 0.0, 0.0], [1.0, 0.0, 0.0], 1.0, 0.0),
        ([3.0, 2.0, 0.0], [-6.0, 0.0, 0.0], 1.0, 0.5),
        ([3.0, 2.0, 0.0], [6.0, 0.0, 0.0], 1.0, 0.0),
    ],
)
def test_the_largest_share_of_a_change(
    start: list[float], change: list[float], limit: float, share: float
) -> None:
    assert largest_feasible_share(np.array(start), np.array(change), limit) == pytest.approx(share)


@given(st.tuples(*[st.floats(-3, 3)] * 3), st.tuples(*[st.floats(-3, 3)] * 3), st.floats(0.1, 4.0))
def test_no_larger_share_is_within_the_limit(
    start: tuple[float, ...], change: tuple[float, ...], limit: float
) -> None:
    first, more = np.array(start), np.array(change)
    share = largest_feasible_share(first, more, limit)
    sizes = np.linalg.norm(first + np.linspace(0, 1, 201)[:, None] * more, axis=1)
    size = float(np.linalg.norm(first + share * more))
    if sizes.min() < limit:
        assert size <= limit + 1e-6
        within = np.linspace(0, 1, 201)[sizes <= limit]
        assert share >= within.max() - 1e-9
    else:
        assert size <= sizes.min() + 1e-6


class Case:
    """A three-joint arm in motion, with and without the body that it holds."""

    def __init__(self) -> None:
        self.alone = SpaceRobot(load_robot(robot_file("three_joint_arm")))
        self.robot = HELD.attached_to(self.alone)
        self.q = np.array([0.4, -0.9, 0.7])
        self.state = ControlState(
            np.array([0.3, -0.2, 0.1]),
            np.array([0.1, -0.3, 0.2, math.sqrt(0.86)]),
            np.array([0.02, -0.05, 0.03]),
            np.array([0.05, 0.08, -0.04]),
            self.q,
            np.array([0.03, -0.06, 0.09]),
        )

    def rates(self, robot: SpaceRobot) -> Array:
        """Return [v_cm, omega, qdot] of a robot, base components."""
        J = robot.jacobian(robot.base_link, self.q)
        s = self.state
        v_cm = s.v_WB_B - J[:3, 3:6] @ s.omega_WB_B - J[:3, 6:] @ s.qdot
        return np.concatenate([v_cm, s.omega_WB_B, s.qdot])

    def accelerations(self, wrench: Array, tau: Array) -> Array:
        z = self.rates(self.robot)
        return self.robot.forward_dynamics(self.q, z[:3], z[3:6], z[6:], wrench, tau)


@pytest.fixture(scope="module")
def case() -> Case:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SPACEROBOT_COMPILE", "0")
        return Case()


def law(case: Case, force: float, torque: float, limit: float = 0.0) -> Detumbling:
    return Detumbling(case.robot, HELD, force, torque, limit, PERIOD)


def test_without_limits_momenta_and_joint_rates_decay_alike(case: Case) -> None:
    given = law(case, math.inf, math.inf)
    command = given.command(case.state)
    zdot, z = case.accelerations(command.wrench_B, command.tau), case.rates(case.robot)
    np.testing.assert_allclose(zdot[6:], -2.0 * z[6:], atol=1e-10)
    m = case.robot.total_mass
    np.testing.assert_allclose(command.wrench_B[:3], -2.0 * m * z[:3], rtol=1e-9)
    np.testing.assert_allclose(given.velocity(case.state), z[:3], rtol=1e-12)
    R = np.eye(3)
    _, L, _ = case.robot.momentum(
        [0, 0, 0, 1], case.q, case.state.v_WB_B, case.state.omega_WB_B, case.state.qdot
    )
    np.testing.assert_allclose(given.angular_momentum(case.state), R @ L, rtol=1e-10)
    about_cm = command.wrench_B[3:] - np.cross(
        case.robot.center_of_mass(case.q), command.wrench_B[:3]
    )
    np.testing.assert_allclose(about_cm, -2.0 * L, rtol=1e-9)


def test_the_torque_is_the_largest_one_against_the_angular_momentum(case: Case) -> None:
    given = law(case, 0.5, 0.3)
    command = given.command(case.state)
    L = given.angular_momentum(case.state)
    com = case.robot.center_of_mass(case.q)
    about_cm = command.wrench_B[3:] - np.cross(com, command.wrench_B[:3])
    np.testing.assert_allclose(about_cm, -0.3 * L / np.linalg.norm(L), rtol=1e-9)
    assert np.linalg.norm(command.wrench_B[3:]) <= 0.3 + 1e-9
    assert np.linalg.norm(command.wrench_B[:3]) <= 0.5 + 1e-12


def grasp_torque(case: Case, wrench: Array, tau: Array) -> Array:
    """Return force and torque on the robot alone that make it move as it does with the body."""
    robot, s = case.alone, case.state
    h = 1e-6
    z = case.rates(robot)
    zdot_c = case.accelerations(wrench, tau)

    # The rates of omega and the joints are those of both; that of its own centre of mass follows
    # from the motion of the base, differentiated numerically.
    def base_velocity(model: SpaceRobot, q: Array, v: Array, w: Array, u: Array) -> Array:
        J = model.jacobian(model.base_link, q)
        return np.asarray(v + J[:3, 3:6] @ w + J[:3, 6:] @ u)

    z_c, q1 = case.rates(case.robot), case.q + h * s.qdot
    later = z_c + h * zdot_c
    v_base_rate = (
        base_velocity(case.robot, q1, later[:3], later[3:6], later[6:])
        - base_velocity(case.robot, case.q, z_c[:3], z_c[3:6], z_c[6:])
    ) / h
    w1, u1 = later[3:6], later[6:]
    J1 = robot.jacobian(robot.base_link, q1)
    v1 = s.v_WB_B + h * v_base_rate
    v_cm_rate = (v1 - J1[:3, 3:6] @ w1 - J1[:3, 6:] @ u1 - z[:3]) / h
    zdot = np.concatenate([v_cm_rate, zdot_c[3:]])
    H, C = robot.inertia_matrix(case.q), robot.bias(case.q, z[:3], z[3:6], z[6:])
    J_B, J_E = robot.jacobian(robot.base_link, case.q), robot.jacobian("end_effector", case.q)
    Q = J_B.T @ wrench + np.concatenate([np.zeros(6), tau])
    return np.linalg.lstsq(J_E.T, H @ zdot + C - Q, rcond=None)[0]


@pytest.mark.parametrize("limit", [0.03, 0.05, 100.0])
def test_the_grasp_is_loaded_up_to_its_limit(case: Case, limit: float) -> None:
    """Its load is that on the robot alone, with opposite sign, by the equations of that robot."""
    given = law(case, 2.0, 0.5, limit)
    command = given.command(case.state)
    torque = grasp_torque(case, command.wrench_B, command.tau)[3:]
    found = float(np.linalg.norm(torque))
    assert found == pytest.approx(given.largest_grasp_torque, rel=1e-4)
    assert found == pytest.approx(limit, rel=1e-4) if limit < 1.0 else found < limit


def test_a_robot_that_holds_nothing_is_brought_to_rest_as_well(case: Case) -> None:
    free = Detumbling(case.alone, None, math.inf, math.inf, 0.001, PERIOD)
    z = case.rates(case.alone)
    np.testing.assert_allclose(
        free.command(case.state).wrench_B[:3], -2 * case.alone.total_mass * z[:3], rtol=1e-9
    )
    assert free.largest_grasp_torque == 0.0
