"""Loops of guesses, number by number: the formulas of the papers with the same random numbers."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from spacerobot_ros.planning.methods.optimal import initial_guesses
from spacerobot_ros.planning.methods.optimal.multiple_shooting import (
    MultipleShooting,
    _pack_parameters,
)
from spacerobot_ros.planning.methods.optimal.problem import (
    BoundaryConditions,
    MotionLimits,
    Trajectory,
    _largest_base_rate,
)
from spacerobot_ros.planning.methods.optimal.transcription import Layout

Array = npt.NDArray[np.float64]

S = np.linspace(0.0, 1.0, 25)


@pytest.mark.parametrize("seed", [3, 4])
def test_a_trigonometric_loop_has_three_harmonics_under_an_envelope(seed: int) -> None:
    found = initial_guesses._trigonometric_loop(np.random.default_rng(seed), S, 4)
    rng = np.random.default_rng(seed)
    first = int(rng.integers(1, 4))
    path = np.zeros((25, 4))
    for k in range(3):
        a, b = rng.normal(size=(2, 4))
        angle = np.outer(2 * np.pi * (first + k) * S, np.ones(4))
        path += (a * np.sin(angle) + b * np.cos(angle)) / (k + 1)
    np.testing.assert_allclose(found, path * np.sin(np.pi * S)[:, np.newaxis] ** 2, atol=1e-12)


def test_the_harmonics_begin_with_the_first_the_second_or_the_third() -> None:
    lowest = set()
    for seed in range(40):
        found = initial_guesses._trigonometric_loop(
            np.random.default_rng(seed), np.linspace(0, 1, 513)[:-1], 1
        )
        power = np.abs(np.fft.rfft(found[:, 0])) > 1e-9
        # The envelope spreads a harmonic to its neighbours.
        lowest.add(int(np.flatnonzero(power)[0]))
        assert np.flatnonzero(power)[-1] <= 6
    assert lowest == {0, 1, 2}


@pytest.mark.parametrize("joints", [2, 3, 5])
def test_a_loop_of_three_frequencies_is_a_cycle_of_paper_1(joints: int) -> None:
    found = initial_guesses._three_frequency_loop(np.random.default_rng(6), S, joints)
    rng = np.random.default_rng(6)
    b11, b12, b21, a22, a31 = rng.normal(size=5)
    order = rng.permutation(joints)[:3]
    fine = np.linspace(0.0, 2 * np.pi, 24 * 400 + 1)
    velocities = (
        b11 * np.sin(fine) + b12 * np.sin(2 * fine),
        b21 * np.sin(fine) + a22 * (np.cos(2 * fine) - np.cos(3 * fine)),
        a31 * (np.cos(fine) - np.cos(3 * fine)),
    )
    expected = np.zeros((25, joints))
    for joint, v in zip(order, velocities, strict=False):
        way = np.concatenate([[0.0], np.cumsum((v[1:] + v[:-1]) / 2)]) * fine[1]
        expected[:, joint] = way[::400]
    np.testing.assert_allclose(found, expected, atol=1e-6)


@pytest.mark.parametrize("joints", [1, 2, 4])
def test_a_square_loop_goes_to_its_corner_round_and_back(joints: int) -> None:
    counts = set()
    for seed in range(12):
        found = initial_guesses._square_loop(np.random.default_rng(seed), S, joints)
        rng = np.random.default_rng(seed)
        pair = rng.permutation(joints)[:2]
        m = len(pair)
        corner = rng.uniform(-1, 1, m)
        side = rng.uniform(0.5, 1.5, m) * rng.choice([-1.0, 1.0], m)
        rounds = int(rng.integers(1, 3))
        counts.add(rounds)
        knots = [np.zeros(m)]
        for _ in range(rounds):
            for leg in ([0, 0], [1, 0], [1, 1], [0, 1]):
                knots.append(corner + side * np.array(leg[:m]))
        knots += [corner, np.zeros(m)]
        expected = np.zeros((25, joints))
        for column, joint in enumerate(pair):
            at = np.linspace(0, 1, len(knots))
            expected[:, joint] = np.interp(S, at, np.array(knots)[:, column])
        np.testing.assert_allclose(found, expected, atol=1e-12)
    assert counts == {1, 2}


# -- numbers of the solver ----------------------------------------------------------------------

LIMITS = MotionLimits(
    np.array([-1.0, -2.0]), np.array([1.4, 2.0]), np.array([0.5, np.inf]), np.array([0.9, 0.7])
)


def test_the_first_variables_of_a_solver_are_those_of_the_guess() -> None:
    """The vertices of parabolas lie half a step on, along the velocities."""
    rng = np.random.default_rng(2)
    q, v, X = rng.normal(size=(4, 2)), rng.normal(size=(4, 2)), rng.normal(size=(4, 4))
    guess = Trajectory(0.3, q, v, X)
    made: Any = MultipleShooting.__new__(MultipleShooting)
    layout = Layout(2, 3)
    made._program = type("Program", (), {"layout": layout})()
    x = made._initial_variables(guess, 0.05)
    assert len(x) == layout.size == 1 + 3 * 10 + 8
    assert x[0] == 0.3
    for k in range(4):
        knot = x[1 + 10 * k : 11 + 10 * k]
        np.testing.assert_allclose(knot[:4], X[k])
        np.testing.assert_allclose(knot[4:6], q[k] + 0.15 * v[k])
        np.testing.assert_allclose(knot[6:8], v[k])
        if k < 3:
            np.testing.assert_allclose(knot[8:], (v[k + 1] - v[k]) / 0.3)
    back = made._unpack_trajectory(x)
    assert back.step == 0.3
    for found, given in ((back.shapes, q), (back.velocities, v), (back.quaternions, X)):
        np.testing.assert_allclose(found, given, atol=1e-15)
    # Where links are kept apart, the last variable is half of the largest lack of distance.
    made._program.layout = replace(layout, has_lack=True)
    np.testing.assert_allclose(made._initial_variables(guess, 0.05), [*x, 0.025])


def test_parameters_of_a_solver_are_the_ends_and_the_weights() -> None:
    turn, direction = np.array([0.1, 0.2, 0.3, 0.9]), np.array([0.6, 0.0, -0.8])
    boundary = BoundaryConditions(
        np.array([0.3, -0.5]), turn, np.zeros(2), direction=direction, end_effectors=np.arange(7.0)
    )
    guess = Trajectory(0.5, np.zeros((3, 2)), np.array([[0, 0], [0.2, -0.3], [0, 0]]), np.eye(4))
    fast = _pack_parameters(boundary, LIMITS, guess, fixed=False)
    # The joint without a speed limit counts by its acceleration.
    expected = [0.3, -0.5, *turn, *direction, 0, 0, 0, *range(7), 0.5, 0.7, 1.0, 0.0]
    np.testing.assert_allclose(fast, expected)
    centred = BoundaryConditions(*(boundary.start, turn, np.zeros(2)), center=np.array([4, 5, 6.0]))
    # The same for both intervals, or one for each; a lack of distance costs by the guess.
    for distances in ([[0.01, 0.02, 3.0]], [[0.01, 0.02, 3.0], [0.03, 0.04, 5.0]]):
        apart = replace(LIMITS, distances=np.array(distances))
        gentle = _pack_parameters(centred, apart, guess, fixed=True)
        effort = 2 * ((0.2 / 0.5 / 0.5) ** 2 + (0.3 / 0.5 / 0.7) ** 2) / 2
        expected = [0.3, -0.5, *turn, 0, 0, 0, 4, 5, 6, 0.5, 0.7, 0.0, 1 / effort, 300.0]
        np.testing.assert_allclose(gentle, [*expected, *distances[0], *distances[-1]])
        fast = _pack_parameters(centred, apart, guess, fixed=False)
        np.testing.assert_allclose(fast[-9:-6], [1.0, 0.0, 300.0 * 1.0])


def test_the_largest_rate_of_a_base_is_by_the_angle_between_attitudes() -> None:
    steps = [0.02, 0.9, 0.3]
    attitudes = [Rotation.from_rotvec([0.2, 0.1, -0.4])]
    for angle in steps:
        attitudes.append(attitudes[-1] * Rotation.from_rotvec(angle * np.array([0.6, 0.0, 0.8])))
    quaternions = np.array([each.as_quat(canonical=True) for each in attitudes])
    assert _largest_base_rate(quaternions, 0.25) == pytest.approx(0.9 / 0.25)
    assert _largest_base_rate(quaternions[:1], 0.25) == 0.0
