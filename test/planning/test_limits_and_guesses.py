"""Limits of joints, constraints on paths, and initial guesses, as functions of numbers alone."""

from __future__ import annotations

import itertools
import re
from typing import Any

import casadi as ca
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from spacerobot_ros.errors import ParameterError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.planning.methods.optimal.initial_guesses import (
    InitialGuesses,
)
from spacerobot_ros.planning.methods.optimal.problem import (
    BoundaryConditions,
    MotionLimits,
    OptimalOptions,
    PathConstraints,
    Trajectory,
    UnusableCandidateError,
)
from spacerobot_ros.resources import robot_file

LIMITS = MotionLimits(
    np.array([-1.0, -0.25, -np.inf]),
    np.array([0.5, 0.75, np.inf]),
    np.array([2.0, 0.5, 4.0]),
    np.array([8.0, 1.0, 2.0]),
)
IDENTITY = np.array([0.0, 0.0, 0.0, 1.0])


@pytest.fixture(scope="module")
def arm() -> SpaceRobot:
    return SpaceRobot.from_file(robot_file("three_joint_arm"))


# -- limits -------------------------------------------------------------------------------------


def test_speeds_and_accelerations_are_counted_as_shares_of_their_limits() -> None:
    """By hand: rates (0, -.5, 1.5, .5, 0) of the first joint at a period of 0.5 s."""
    positions = np.array([[0.0, 0, 0], [-0.25, 0, 0], [0.5, 0.125, -1.0], [0.75, 0.125, -1.0]])
    speed, change = LIMITS.limit_shares(positions, 0.5)
    np.testing.assert_allclose(speed[:, 0], np.array([0.0, 0.5, 1.5, 0.5, 0.0]) / 2.0)
    np.testing.assert_allclose(speed[:, 1], np.array([0.0, 0.0, 0.25, 0.0, 0.0]) / 0.5)
    np.testing.assert_allclose(change[:, 0], np.array([1.0, 4.0, 2.0, 1.0]) / 8.0)
    np.testing.assert_allclose(change[:, 2], np.array([0.0, 4.0, 4.0, 0.0]) / 2.0)
    assert LIMITS.excess(positions, 0.5) == pytest.approx((np.sqrt(2.0), 0.25))
    assert LIMITS.excess(positions - [0.25, 0, 0], 0.5)[1] == 0.0
    moving, _ = LIMITS.limit_shares(positions, 0.5, np.array([-1.0, 0.0, 8.0]))
    assert moving[0].tolist() == [0.5, 0.0, 2.0]
    slow = LIMITS.excess(positions[:1], 0.5, np.array([1.0, 0.0, 0.0]))
    assert slow == pytest.approx((0.5, 0.0)), "it stops within a tick"


@pytest.mark.parametrize(
    ("margin", "shapes", "lower", "upper"),
    [
        ([0.25, 0.0, 1.0], [], [-0.75, -0.25], [0.25, 0.75]),
        # Margins that overlap leave the middle of the range.
        ([2.0, 0.625, 0.0], [], [-0.25, 0.25], [-0.25, 0.25]),
        ([0.25, 0.25, 0.0], [[0.375, -0.125, 9.0]], [-0.75, -0.125], [0.375, 0.5]),
        ([0.25, 0.25, 0.0], [[0.625, -0.5, 9.0]], [-0.75, -0.25], [0.5, 0.5]),
    ],
)
def test_margins_are_kept_except_where_a_shape_is_in_them(
    margin: list[float], shapes: list[Any], lower: list[float], upper: list[float]
) -> None:
    kept = LIMITS.within(np.array(margin), *map(np.array, shapes))
    assert kept.lower.tolist() == [*lower, -np.inf]
    assert kept.upper.tolist() == [*upper, np.inf]
    assert kept.velocity is LIMITS.velocity


def test_the_span_of_guesses_is_finite_round_the_present_shape() -> None:
    middle, half = LIMITS.joint_ranges(np.array([0.0, 0.5, 7.0]))
    assert middle.tolist() == [-0.25, 0.25, 7.0]
    assert half == pytest.approx([0.75, 0.5, np.pi])
    wide = MotionLimits(np.array([-20.0]), np.array([10.0]), np.ones(1), np.ones(1))
    middle, half = wide.joint_ranges(np.array([9.0]))
    assert (middle[0], half[0]) == pytest.approx(((9.0 - 2 * np.pi + 10.0) / 2, np.pi))
    one_end = MotionLimits(np.array([-1.0]), np.array([np.inf]), np.ones(1), np.ones(1))
    middle, half = one_end.joint_ranges(np.array([2.0]))
    assert (middle[0], half[0]) == pytest.approx((2.0, np.pi))


def test_limits_are_the_robots_narrowed_by_options(arm: SpaceRobot) -> None:
    own = arm.velocity_limit
    plain = MotionLimits.of(arm, OptimalOptions(ramp_time=0.25))
    assert plain.velocity.tolist() == own.tolist()
    assert plain.acceleration == pytest.approx(own * 4.0)
    options = OptimalOptions(
        max_velocity=tuple(own * [0.5, 2.0, 1.0]), max_acceleration=(1.0, 2.0, 3.0)
    )
    found = MotionLimits.of(arm, options)
    assert found.velocity == pytest.approx(own * [0.5, 1.0, 1.0])
    assert found.acceleration.tolist() == [1.0, 2.0, 3.0]
    for wrong, words in (
        ({"max_velocity": (1.0,)}, "1 number(s); robot 'three_joint_arm' has 3 joints ("),
        ({"max_velocity": (1.0, 0.0, 1.0)}, f"'{arm.joint_names[1]}' is limited to 0 a second"),
        ({"max_acceleration": (1.0, 0.0, 1.0)}, "and 0 a second squared; area_loop needs"),
    ):
        with pytest.raises(ParameterError, match=re.escape(words)):
            MotionLimits.of(arm, OptimalOptions(**wrong), "area_loop")


# -- trajectories -------------------------------------------------------------------------------


def parabola(steps: int, acceleration: float, first: float) -> Trajectory:
    """Return constant acceleration of one joint in steps of half a second."""
    time = 0.5 * np.arange(steps + 1.0)[:, np.newaxis]
    shapes = first * time + acceleration * time**2 / 2
    return Trajectory(0.5, shapes, first + acceleration * time, np.tile(IDENTITY, (steps + 1, 1)))


def test_shapes_at_ticks_are_those_of_constant_accelerations() -> None:
    motion = parabola(4, -3.0, 2.0)
    assert motion.duration == 2.0
    time = np.linspace(0.0, 2.0, 8)
    np.testing.assert_allclose(motion.at_ticks(7)[:, 0], 2.0 * time - 1.5 * time**2, atol=1e-12)
    slower = motion.stretched(2.0)
    assert slower.duration == 4.0
    np.testing.assert_allclose(slower.at_ticks(7), motion.at_ticks(7), atol=1e-12)
    assert slower.velocities[:, 0].tolist() == (motion.velocities[:, 0] / 2).tolist()


@pytest.mark.parametrize(
    ("velocity", "acceleration", "shortest", "factor"),
    [(2.0, 100.0, 0.1, 2.0), (100.0, 12.0, 0.1, 0.5), (100.0, 100.0, 6.0, 3.0)],
)
def test_full_speed_is_that_of_the_first_limit_that_is_met(
    velocity: float, acceleration: float, shortest: float, factor: float
) -> None:
    """The motion goes at up to 4 a second, and speeds up by 3 a second squared."""
    limits = MotionLimits(-np.ones(1), np.ones(1), np.array([velocity]), np.array([acceleration]))
    assert parabola(4, -3.0, 2.0).at_full_speed(limits, shortest).duration == pytest.approx(
        2.0 * factor
    )


# -- constraints on paths -----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"keep_axis": (0.0, 0.0, 2.0)}, "takes all of optimal.keep_axis, optimal.keep_direction"),
        ({"keep_angle": 0.5}, "takes all of optimal.keep_axis"),
        (
            {"keep_axis": (0.0, 0.0, 0.0), "keep_direction": (1.0, 0.0, 0.0), "keep_angle": 0.5},
            "optimal.keep_axis is (0.0, 0.0, 0.0); it must be three numbers, not all zero.",
        ),
        (
            {"keep_axis": (1.0, 0.0, 0.0), "keep_direction": (1.0, 0.0), "keep_angle": 0.5},
            "optimal.keep_direction is (1.0, 0.0); it must be three numbers",
        ),
        (
            {"keep_out": (1.0, 2.0, 3.0)},
            "has 3 numbers; a box of shapes has 3 lower and 3 upper ones.",
        ),
        ({"keep_out": (0.0, 0.0, 0.0, 1.0, 0.0, 1.0)}, "lower bound is not below its upper."),
        ({"keep_out": (-9e6,) * 3 + (9e6,) * 3}, "holds all shapes of the robot."),
    ],
)
def test_constraints_that_make_no_sense_are_refused(
    arm: SpaceRobot, options: dict[str, Any], words: str
) -> None:
    with pytest.raises(ParameterError, match=re.escape(words)):
        PathConstraints.of(arm, OptimalOptions(**options))


def test_no_constraint_is_none(arm: SpaceRobot) -> None:
    none = PathConstraints.of(arm, OptimalOptions())
    assert none.knot_inequality_count == 0
    assert none.symbolic(ca.SX.sym("q", 3), ca.SX.sym("x", 4), ca.SX.sym("d", 3)).shape[0] == 0
    none.check(np.zeros((2, 3)), np.tile(IDENTITY, (2, 1)), 0.5)
    guess = parabola(4, -3.0, 2.0)
    assert none.slowed(guess) is guess


def turning(angles: list[float]) -> np.ndarray:
    """Return attitudes turned about x by angles, rad."""
    return Rotation.from_rotvec(np.outer(angles, [1.0, 0.0, 0.0])).as_quat()


def test_a_base_that_turns_too_fast_or_an_axis_too_near_is_refused(arm: SpaceRobot) -> None:
    shapes = np.zeros((3, 3))
    calm = PathConstraints.of(arm, OptimalOptions(max_base_rate=0.5))
    calm.check(shapes, turning([0.0, 0.2, 0.45]), 0.5)
    with pytest.raises(UnusableCandidateError, match=r"the base turns at 0\.6 rad/s"):
        calm.check(shapes, turning([0.0, 0.2, 0.5]), 0.5)
    assert calm.imposed_base_rate == pytest.approx(0.49)
    quick = Trajectory(0.5, shapes, shapes + 1.0, turning([0.0, 0.49, 0.5]))
    assert calm.slowed(quick).step == pytest.approx(0.5 * 0.98 / 0.49)
    easy = Trajectory(0.5, shapes, shapes + 1.0, turning([0.0, 0.1, 0.2]))
    assert calm.slowed(easy).step == 0.5
    # The axis z comes from y by a turn about x: at 60 deg it is 30 deg from -y.
    cone: dict[str, Any] = {"keep_axis": (0.0, 0.0, 3.0), "keep_direction": (0.0, -2.0, 0.0)}
    angle = np.pi / 6
    away = PathConstraints.of(arm, OptimalOptions(**cone, keep_angle=angle - 1e-6))
    away.check(shapes, turning([0.0, np.pi / 3, 0.5]), 1.0)
    inside = PathConstraints.of(arm, OptimalOptions(**cone, keep_angle=angle + 1e-6))
    with pytest.raises(UnusableCandidateError, match=r"comes within 0\.5236 rad of keep_direction"):
        inside.check(shapes, turning([0.0, np.pi / 3, 0.5]), 1.0)
    assert (away.knot_inequality_count, away.base_rate_limit) == (1, 0.0)
    q, x, d = ca.SX.sym("q", 3), ca.SX.sym("x", 4), ca.SX.sym("d", 3)
    value = ca.Function("value", [q, x, d], [away.symbolic(q, x, d)])
    assert away.direction_W is not None
    for turn in (0.0, np.pi / 3, np.pi / 2):
        room = float(value(np.zeros(3), turning([turn])[0], away.direction_W))
        assert room == pytest.approx(np.cos(1.02 * angle) - np.sin(turn), abs=1e-5)


def test_a_box_of_shapes_is_left_out_with_a_body_round_it(arm: SpaceRobot) -> None:
    """Of a joint whose whole range is in the box nothing is asked."""
    low, high = (-0.5, 0.25, -50.0), (0.5, 0.75, 50.0)
    constraints = PathConstraints.of(arm, OptimalOptions(keep_out=(*low, *high)))
    bounded = [i for i in range(3) if low[i] > arm.lower[i] or high[i] < arm.upper[i]]
    assert constraints.smooth_keep_out_bodies[0].joints == bounded
    assert 2 not in bounded
    outside = np.array([[0.0, 0.2, 0.0], [-0.5, 0.5, 0.0], [0.0, 0.75, 0.0]])
    constraints.check(outside, np.tile(IDENTITY, (3, 1)), 0.5)
    entering = np.vstack([outside[:2], [[0.0, 0.5, 9.0]]])
    with pytest.raises(UnusableCandidateError, match=r"enters a box of keep_out at 1 s"):
        constraints.check(entering, np.tile(IDENTITY, (3, 1)), 0.5)
    q, x, d = ca.SX.sym("q", 3), ca.SX.sym("x", 4), ca.SX.sym("d", 3)
    value = ca.Function("value", [q, x, d], [constraints.symbolic(q, x, d)])

    def room(shape: tuple[float, float, float]) -> float:
        return float(value(shape, IDENTITY, np.zeros(3)))

    # The body passes 2 % beyond the corners of the box, whatever the free joint does.
    for shape in ((0.51, 0.755, 3.0), (-0.51, 0.245, -3.0)):
        assert room(shape) == pytest.approx(0.001, abs=1e-3)
    assert room((0.5, 0.75, 0.0)) < 0.0 < room((0.53, 0.77, 0.0))
    assert room((0.0, 0.5, 0.0)) == pytest.approx(np.log(1e-3))


# -- guesses ------------------------------------------------------------------------------------

TURN = np.array([[0.5, -0.2, 0.1], [0.0, 0.3, -0.4], [0.2, 0.1, 0.6]])


@pytest.fixture(scope="module")
def guesses() -> InitialGuesses:
    """Guesses of a robot whose base turns in proportion to its steps, on ten intervals."""
    q, u, v = (ca.SX.sym(name, 3) for name in "quv")
    turn = ca.Function("turn", [q, u, v], [TURN @ (u + v) / 2])
    return InitialGuesses(turn, ca.Function("K", [q], [ca.SX.zeros(6, 9)]), 10)


START, FINAL = np.array([-0.5, 0.25, 2.0]), np.array([0.25, 0.5, 1.0])


def test_guesses_go_from_start_to_end_as_fast_as_the_limits_allow(guesses: InitialGuesses) -> None:
    boundary = BoundaryConditions(START, IDENTITY, FINAL)
    found = list(itertools.islice(guesses.generate(boundary, LIMITS, FINAL), 6))
    again = list(itertools.islice(guesses.generate(boundary, LIMITS, FINAL), 6))
    assert len({each.shapes.tobytes() for each in found}) == 6
    for guess, same in zip(found, again, strict=True):
        np.testing.assert_array_equal(guess.shapes, same.shapes)
        np.testing.assert_allclose(guess.shapes[[0, -1]], [START, FINAL], atol=1e-12)
        assert np.all(guess.shapes >= LIMITS.lower)
        assert np.all(guess.shapes <= LIMITS.upper)
        assert not guess.velocities[[0, -1]].any()
        speed = np.abs(guess.velocities) / LIMITS.velocity
        change = np.abs(np.diff(guess.velocities, axis=0)) / guess.step / LIMITS.acceleration
        assert max(speed.max(), np.sqrt(change.max())) == pytest.approx(1.0)
        inner = (guess.shapes[2:] - guess.shapes[:-2]) / (2 * guess.step)
        np.testing.assert_allclose(guess.velocities[1:-1], inner, atol=1e-12)
        # Turns of the steps, one after the other.
        attitude = Rotation.identity()
        for v0, v1 in itertools.pairwise(guess.velocities):
            attitude = attitude * Rotation.from_rotvec(TURN @ (v0 + v1) / 2 * guess.step)
        assert (attitude.inv() * Rotation.from_quat(guess.quaternions[-1])).magnitude() < 1e-9
        np.testing.assert_array_equal(guess.quaternions[0], IDENTITY)


def test_a_guess_through_shapes_passes_them_at_equal_intervals(guesses: InitialGuesses) -> None:
    via = np.array([START, [0.0, 0.25, 3.0], FINAL])
    shapes = guesses.from_shapes(via, LIMITS).shapes
    np.testing.assert_allclose(shapes[[0, 5, 10]], via)
    np.testing.assert_allclose(shapes[2], START + 0.4 * (via[1] - START))


def test_ticks_of_a_schedule_are_a_guess_that_goes_on_with_their_velocity(
    guesses: InitialGuesses,
) -> None:
    positions = START + np.linspace(0.0, 1.0, 6)[:, np.newaxis] ** 2 * (FINAL - START)
    velocity = np.array([0.25, -0.125, 0.5])
    guess = guesses.from_ticks(positions, velocity, 0.4)
    assert (guess.step, guess.duration) == pytest.approx((0.2, 2.0))
    np.testing.assert_allclose(guess.shapes[::2], positions)
    np.testing.assert_allclose(guess.velocities[0], velocity)
    assert not guess.velocities[-1].any()
    rates = (positions[2] - positions[0]) / 0.8
    np.testing.assert_allclose(guess.velocities[2], rates)
    coarse = Trajectory(0.4, positions, guess.velocities[::2], guess.quaternions[::2])
    finer = guesses.resample(coarse)
    assert finer.duration == pytest.approx(2.0)
    np.testing.assert_allclose(finer.velocities, guess.velocities, atol=1e-12)
    np.testing.assert_allclose(finer.shapes, coarse.at_ticks(10), atol=1e-12)


def test_a_guess_may_begin_with_a_velocity_that_it_loses_soon(guesses: InitialGuesses) -> None:
    """After four times the braking time of the joint that brakes longest it is as before."""
    through = guesses.from_shapes(np.array([START, FINAL]), LIMITS)
    rest = through.stretched(2.0 / through.duration)
    assert guesses.with_initial_velocity(rest, np.zeros(3), LIMITS) is rest
    velocity = np.array([0.5, -0.125, 0.25])  # Braking takes 1/16, 1/8 and 1/8 s.
    moving = guesses.with_initial_velocity(rest, velocity, LIMITS)
    np.testing.assert_allclose(moving.velocities[0], velocity)
    np.testing.assert_array_equal(moving.shapes[0], rest.shapes[0])
    later = np.arange(11) * rest.step >= 0.5
    assert later.any()
    assert not later[1]
    np.testing.assert_allclose(moving.shapes[later], rest.shapes[later], atol=1e-12)
    np.testing.assert_allclose(moving.velocities[later], rest.velocities[later], atol=1e-12)
    time = rest.step
    share = time / 0.5
    np.testing.assert_allclose(
        moving.shapes[1] - rest.shapes[1], velocity * time * (1 - share) ** 2, atol=1e-12
    )
