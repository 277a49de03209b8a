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
from spacerobot_ros.planning.methods.resolved_rate import MIN_PROGRESS_RATE, ResolvedRateOptions

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


class Shares:
    """A generator of random numbers with given ones."""

    def __init__(self, shares: Array) -> None:
        self.shares, self.asked = shares, (0.0, 0.0, 0)

    def uniform(self, low: float, high: float, count: int) -> Array:
        self.asked = low, high, count
        return self.shares


def test_joints_that_coast_first_begin_later_and_go_the_same_way(guesses: InitialGuesses) -> None:
    instants = np.linspace(0.0, 1.0, 61)
    paths = np.array([START + np.outer(instants**p, FINAL - START) for p in (1.0, 2.0)])
    shares = Shares(np.array([0.25, 0.6]))
    found = guesses._loops_after_coasting(paths, shares)  # type: ignore[arg-type]
    assert shares.asked == (0.0, 0.6, 2)
    for path, share, power in zip(found, shares.shares, (1.0, 2.0), strict=True):
        assert np.all(path[instants <= share] == START)
        s = np.clip((instants - share) / (1 - share), 0, 1)
        np.testing.assert_allclose(path, START + np.outer(s**power, FINAL - START), atol=2e-3)
        np.testing.assert_allclose(path[-1], FINAL, atol=1e-12)


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


def test_a_joint_that_brakes_at_each_tick_comes_to_rest_within_its_room() -> None:
    """Rates are held for a tick; from each to the next they change by what the joint can."""
    follower, room = follower_of(), np.array([0.3, 0.02, 0.7])
    a, h = np.array([0.6, 0.8, 1.1]), PERIOD
    rates = follower._rates_that_can_stop(room)
    # Uniform braking, v^2 / 2 a, half a tick at full rate, and what rounding to ticks adds.
    np.testing.assert_allclose(rates**2 / (2 * a) + rates * h / 2 + a * h**2 / 8, room, rtol=1e-12)
    for rate, one, most in zip(rates, room, a, strict=True):
        moved, now = 0.0, float(rate)
        while now > 0:
            moved, now = moved + now * h, now - most * h
        # From the middle of the first tick on.
        assert moved - rate * h / 2 <= one
        assert moved > 0.9 * (one - rate * h)
    np.testing.assert_array_equal(follower._rates_that_can_stop(np.array([-0.1, 0.0, 1e-5])), 0.0)


def test_rates_change_together_and_by_no_more_than_accelerations_allow() -> None:
    follower, q = follower_of(), np.array([0.4, -0.9, 1.1])
    before, wanted = np.array([0.01, -0.02, 0.0]), np.array([0.11, 0.03, 0.2])
    found = follower._limited(wanted, q, before)
    # 0.2 rad/s of the third joint take more than 1.1 rad/s^2 x 0.04 s; the others follow its share.
    share = min(0.6 * PERIOD / 0.1, 0.8 * PERIOD / 0.05, 1.1 * PERIOD / 0.2)
    np.testing.assert_allclose(found, before + share * (wanted - before), rtol=1e-12)
    near = before + 0.1 * (wanted - before)
    np.testing.assert_allclose(follower._limited(near, q, before), near, rtol=1e-12)


def test_the_progress_near_a_singularity_decides_the_share_of_a_twist(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    follower, q = follower_of(), np.array([0.4, -0.9, 1.1])
    twist = TwistCommand("end_effector", np.array([0.01, 0, 0]), np.zeros(3), TwistFrame.BASE)
    rates, pose = np.array([0.02, -0.01, 0.005]), np.array([0, 0, 0, 0, 0, 0, 1.0])
    asked: list[Array] = []

    def progress(now: float, ahead: float) -> None:
        def solution(at: Array, motion: Array) -> tuple[Array, float]:
            asked.append(at)
            return rates, now if np.array_equal(at, q) else ahead

        monkeypatch.setattr(follower, "_solution", solution)

    for share in (0.25, 0.8):
        progress(MIN_PROGRESS_RATE * (1 + share), MIN_PROGRESS_RATE)
        found, reason = follower._wanted(twist, pose, q)
        np.testing.assert_allclose(found, share * rates, rtol=1e-9)
        assert reason.startswith("'end_effector' is near a dynamic singularity: it moves by ")
    # A thousandth of a radian of the joint that is fastest by its limit is looked ahead.
    weights = follower._weights
    np.testing.assert_allclose(asked[-1], q + 1e-3 * rates / np.abs(rates / weights).max())
    progress(MIN_PROGRESS_RATE * 0.5, MIN_PROGRESS_RATE * 0.4)
    assert not np.any(follower._wanted(twist, pose, q)[0])
    progress(MIN_PROGRESS_RATE * 0.5, MIN_PROGRESS_RATE * 0.6)
    found, reason = follower._wanted(twist, pose, q)
    np.testing.assert_array_equal(found, rates)
    assert not reason
    progress(MIN_PROGRESS_RATE * 2.0, 0.0)
    assert not follower._wanted(twist, pose, q)[1]
    rates = np.zeros(3)
    progress(0.0, 1.0)
    assert "0 of its reach" in follower._wanted(twist, pose, q)[1]


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
