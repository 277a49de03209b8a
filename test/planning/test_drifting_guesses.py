"""Guesses for robots that drift and rates of twists, part by part."""

from __future__ import annotations

import itertools
from typing import Any

import casadi as ca
import numpy as np
import numpy.typing as npt
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation
from support.planner_loop import robot_of

from spacerobot_ros.errors import PlanningError
from spacerobot_ros.planning.execution.teleoperation import TwistCommand, TwistFollower, TwistFrame
from spacerobot_ros.planning.methods.optimal.initial_guesses import InitialGuesses
from spacerobot_ros.planning.methods.optimal.problem import (
    BoundaryConditions,
    MotionLimits,
    Trajectory,
)
from spacerobot_ros.planning.methods.resolved_rate import ResolvedRateOptions

Array = npt.NDArray[np.float64]

GAIN, INERTIA = np.array([0.3, -0.2, 0.25]), 4.0
L_0 = np.array([0.5, -0.8, 0.3])
LIMITS = MotionLimits(
    np.array([-1.0, -2.0, -np.inf]),
    np.array([1.4, 2.0, np.inf]),
    np.array([0.5, 0.8, 1.1]),
    np.array([0.9, 0.7, 1.3]),
)
START, FINAL = np.array([0.3, -0.5, 0.2]), np.array([-0.4, 0.9, 0.8])


@pytest.fixture(scope="module")
def guesses() -> InitialGuesses:
    """Guesses for a base that is a ball of 4 kg m^2, turned by the areas that its joints sweep."""
    q, u, u_next, impulse = (ca.SX.sym(name, 3) for name in ("q", "u", "u_next", "impulse"))
    mean = (u + u_next) / 2
    swept = ca.DM(GAIN) * ca.cross(q + mean / 2, mean) + impulse / INERTIA
    turn = ca.Function("turn", [q, u, u_next, impulse], [swept])
    curvature = np.zeros((6, 9))
    for j, k in itertools.product(range(3), range(3)):
        curvature[3:, 3 * j + k] = -2 * GAIN * np.cross(np.eye(3)[j], np.eye(3)[k])
    return InitialGuesses(turn, ca.Function("curvature", [q], [ca.DM(curvature)]), 60, L_0)


def test_a_ball_whose_joints_rest_turns_about_its_angular_momentum(guesses: InitialGuesses) -> None:
    still = Trajectory(0.2, np.tile(START, (11, 1)), np.zeros((11, 3)), np.zeros((11, 4)))
    found = guesses.resample(still)
    assert found.step == pytest.approx(2.0 / 60)
    for k in (1, 30, 60):
        expected = Rotation.from_rotvec(L_0 / INERTIA * k * found.step).as_quat()
        np.testing.assert_allclose(found.quaternions[k], expected, atol=1e-12)


def test_turns_of_joints_and_momentum_are_those_of_another_integration(
    guesses: InitialGuesses,
) -> None:
    """A sweep at constant rates, one after the other, while the base drifts."""
    duration, knots = 3.0, np.linspace(0.0, 1.0, 61)
    shapes = START + np.column_stack([knots**2, np.sin(2 * knots), -knots]) * 0.8
    rates = np.column_stack([2 * knots, 2 * np.cos(2 * knots), -np.ones(61)]) * 0.8 / duration
    found = guesses.resample(Trajectory(duration / 60, shapes, rates, np.zeros((61, 4))))

    def turning(t: float, x: Array) -> Array:
        s = t / duration
        q = START + np.array([s**2, np.sin(2 * s), -s]) * 0.8
        u = np.array([2 * s, 2 * np.cos(2 * s), -1.0]) * 0.8 / duration
        omega = GAIN * np.cross(q, u) + Rotation.from_quat(x).inv().apply(L_0) / INERTIA
        return 0.5 * np.append(x[3] * omega + np.cross(x[:3], omega), -x[:3] @ omega)

    exact = solve_ivp(turning, (0, duration), [0, 0, 0, 1.0], rtol=1e-10, atol=1e-12).y[:, -1]
    apart = Rotation.from_quat(found.quaternions[-1]) * Rotation.from_quat(exact).inv()
    # Of second order; a step that began with the attitude before it would be ten times as far off.
    assert apart.magnitude() < 2e-4
    assert np.linalg.norm(Rotation.from_quat(exact).as_rotvec()) > 0.5


def test_every_third_kind_of_guess_coasts_where_the_robot_drifts(guesses: InitialGuesses) -> None:
    boundary = BoundaryConditions(START, np.array([0.0, 0.0, 0.0, 1.0]), FINAL)
    still = [
        int(np.argmax(np.any(each.shapes != START, axis=1)))
        for each in itertools.islice(guesses.generate(boundary, LIMITS, FINAL), 8)
    ]
    coasting = [count > 1 for count in still]
    assert not any(c for k, c in enumerate(coasting) if k % 3 != 1)
    assert sum(coasting) >= 2


FOLLOWER = ResolvedRateOptions(max_acceleration=(0.6, 0.8, 1.1))
PERIOD = 0.04


def follower_of(**options: Any) -> TwistFollower:
    given = ResolvedRateOptions(**{**vars(FOLLOWER), **options})
    return TwistFollower(robot_of("three_joint_arm"), "end_effector", given, PERIOD)


def test_twists_are_turned_into_the_base_from_their_frame() -> None:
    R_WB = Rotation.from_rotvec([0.3, -0.5, 0.4]).as_matrix()
    R_BE = Rotation.from_rotvec([-0.7, 0.2, 1.1]).as_matrix()
    v, omega = np.array([0.1, -0.2, 0.3]), np.array([0.5, 0.7, -0.4])
    for frame, R in (
        (TwistFrame.WORLD, R_WB.T),
        (TwistFrame.BASE, np.eye(3)),
        (TwistFrame.LINK, R_BE),
    ):
        found = TwistCommand("end_effector", v, omega, frame).in_base(R_WB, R_BE)
        np.testing.assert_allclose(found, [R @ v, R @ omega], rtol=1e-12)


def test_a_hand_without_enough_joints_is_refused() -> None:
    arm = robot_of("three_joint_arm")
    with pytest.raises(PlanningError, match="too few to move 'end_effector' by twists and keep"):
        TwistFollower(arm, "end_effector", ResolvedRateOptions(keep_attitude=1), PERIOD)
    assert not follower_of().turns
