"""Guesses of ``optimal``: their loops, their ends, their speed, and the turn that they predict."""

from __future__ import annotations

import itertools
from dataclasses import replace

import casadi as ca
import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from spacerobot_ros.planning.methods.optimal.initial_guesses import InitialGuesses
from spacerobot_ros.planning.methods.optimal.problem import (
    MotionLimits,
    Trajectory,
)

Array = npt.NDArray[np.float64]

GAIN = np.array([0.3, -0.2, 0.25])
LIMITS = MotionLimits(
    np.array([-1.0, -2.0, -np.inf]),
    np.array([1.4, 2.0, np.inf]),
    np.array([0.5, 0.8, 1.1]),
    np.array([0.9, 0.7, 1.3]),
)
START, FINAL = np.array([0.3, -0.5, 0.2]), np.array([-0.4, 0.9, 0.8])


def swept(q: Array, u: Array) -> Array:
    """Return a turn (3,) of the base by a step ``u``: twice the areas that it sweeps, scaled."""
    return GAIN * np.cross(q, u)


@pytest.fixture(scope="module")
def guesses() -> InitialGuesses:
    q, u, u_next = (ca.SX.sym(name, 3) for name in ("q", "u", "u_next"))
    mean = (u + u_next) / 2
    turn = ca.Function("turn", [q, u, u_next], [ca.DM(GAIN) * ca.cross(q + mean / 2, mean)])
    # The connection A(q) u = -GAIN (q x u) has the constant curvature -2 GAIN e_i . (e_j x e_k).
    curvature = np.zeros((6, 9))
    for j, k in itertools.product(range(3), range(3)):
        curvature[3:, 3 * j + k] = -2 * GAIN * np.cross(np.eye(3)[j], np.eye(3)[k])
    return InitialGuesses(turn, ca.Function("curvature", [q], [ca.DM(curvature)]), 60)


def attitude(trajectory: Trajectory) -> Rotation:
    """Return the last attitude of a trajectory, integrated with a tenth of its steps."""
    found = Rotation.identity()
    knots = np.arange(len(trajectory.shapes), dtype=float)
    fine = np.linspace(0.0, knots[-1], 10 * (len(knots) - 1) + 1)
    shapes = np.column_stack([np.interp(fine, knots, column) for column in trajectory.shapes.T])
    for before, after in itertools.pairwise(shapes):
        found *= Rotation.from_rotvec(swept((before + after) / 2, after - before))
    return found


def assert_rest_to_rest(path: Trajectory) -> None:
    np.testing.assert_array_equal(path.velocities[[0, -1]], 0.0)


def test_shapes_at_equal_intervals_become_the_fastest_guess_through_them(
    guesses: InitialGuesses,
) -> None:
    s = np.linspace(0.0, 1.0, 61)[:, np.newaxis]
    shapes = START + (FINAL - START) * s**2 * (3 - 2 * s)
    same = guesses.from_shapes(shapes, LIMITS)
    np.testing.assert_allclose(same.shapes, shapes, atol=1e-14)
    assert_rest_to_rest(same)
    coarse = guesses.from_shapes(shapes[::5], LIMITS)
    np.testing.assert_allclose(coarse.shapes[::5], shapes[::5], atol=1e-14)
    np.testing.assert_allclose(
        coarse.shapes[2], 0.6 * shapes[0] + 0.4 * shapes[5], atol=1e-14
    )  # Linear in between.
    faster = replace(LIMITS, velocity=4 * LIMITS.velocity, acceleration=16 * LIMITS.acceleration)
    quick = guesses.from_shapes(shapes, faster)
    assert quick.duration == pytest.approx(same.duration / 4)


def test_positions_at_ticks_keep_their_duration_and_their_first_velocity(
    guesses: InitialGuesses,
) -> None:
    period, ticks = 0.04, 90
    t = period * np.arange(ticks + 1)[:, np.newaxis]
    positions = START + np.array([0.2, -0.1, 0.3]) * np.sin(t) * (1 - t / t[-1]) ** 2
    velocity = np.array([0.21, -0.09, 0.31])
    found = guesses.from_ticks(positions, velocity, period)
    assert found.duration == pytest.approx(period * ticks)
    np.testing.assert_allclose(found.shapes[[0, -1]], positions[[0, -1]], atol=1e-14)
    np.testing.assert_allclose(found.shapes[20], positions[30], atol=1e-12)
    np.testing.assert_allclose(found.velocities[[0, -1]], [velocity, np.zeros(3)], atol=1e-14)
    middle = (positions[31] - positions[29]) / (2 * period)
    np.testing.assert_allclose(found.velocities[20], middle, atol=1e-12)
    end = Rotation.from_quat(found.quaternions[-1])
    assert (attitude(found).inv() * end).magnitude() < 5e-3


def test_a_guess_is_changed_to_begin_with_a_velocity(guesses: InitialGuesses) -> None:
    s = np.linspace(0.0, 1.0, 61)[:, np.newaxis]
    guess = guesses.from_shapes(START + (FINAL - START) * s**3 * (10 - 15 * s + 6 * s**2), LIMITS)
    velocity = np.array([0.1, -0.15, 0.05])
    moving = guesses.with_initial_velocity(guess, velocity, LIMITS)
    assert (moving.step, len(moving.shapes)) == (guess.step, len(guess.shapes))
    np.testing.assert_allclose(moving.velocities[0], velocity)
    np.testing.assert_allclose(moving.shapes[0], START)
    # The second joint brakes longest, in 0.15 / 0.7 s; after four times that all are back.
    back = 4 * 0.15 / 0.7
    time = guess.step * np.arange(61)
    off = np.abs(moving.shapes - guess.shapes).max(axis=1)
    assert np.all(off[time >= back] < 1e-12)
    assert np.all(off[(time > 0) & (time < 0.95 * back)] > 1e-6)
    np.testing.assert_allclose(moving.velocities[time >= back], guess.velocities[time >= back])
    # Velocities are the derivatives of the shapes: a cubic, whose extreme is at a third.
    peak = 4 / 27 * back * velocity
    at = np.array(
        [np.interp(back / 3, time, column) for column in (moving.shapes - guess.shapes).T]
    )
    np.testing.assert_allclose(at, peak, rtol=0.03)
    assert guesses.with_initial_velocity(guess, np.zeros(3), LIMITS) is guess


def test_a_solution_on_another_grid_keeps_its_duration(guesses: InitialGuesses) -> None:
    s = np.linspace(0.0, 1.0, 31)[:, np.newaxis]
    rates = (FINAL - START) * 6 * s * (1 - s) / (30 * 0.2)
    # Constant accelerations between the knots.
    steps = 0.2 * (rates[1:] + rates[:-1]) / 2
    shapes = START + np.vstack([np.zeros(3), np.cumsum(steps, axis=0)])
    coarse = Trajectory(0.2, shapes, rates, np.zeros((31, 4)))
    fine = guesses.resample(coarse)
    assert len(fine.shapes) == 61
    assert fine.duration == pytest.approx(6.0)
    np.testing.assert_allclose(fine.shapes[::2], shapes, atol=1e-12)
    np.testing.assert_allclose(fine.velocities[::2], rates, atol=1e-12)
    end = Rotation.from_quat(fine.quaternions[-1])
    assert (attitude(fine).inv() * end).magnitude() < 2e-3
