"""Relative motion on a circular orbit, against integrations of two bodies."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from spacerobot_ros.errors import ParameterError
from spacerobot_ros.model.external_loads import (
    EARTH_GRAVITATION,
    EARTH_RADIUS,
    mean_motion_at,
    relative_acceleration,
    relative_motion,
)

Array = npt.NDArray[np.float64]

R0, V0 = np.array([3.0, -7.0, 2.0]), np.array([0.02, -0.01, 0.015])


def test_the_period_of_low_and_geosynchronous_orbits() -> None:
    assert 2 * np.pi / mean_motion_at(400e3) == pytest.approx(5553.6, abs=0.1)
    assert 2 * np.pi / mean_motion_at(35786e3) == pytest.approx(86164.0, abs=1.0)


@pytest.mark.parametrize("n", [0.0011, 0.7])
def test_the_solution_solves_the_equations(n: float) -> None:
    def rate(_: float, x: Array) -> Array:
        return np.concatenate([x[3:], relative_acceleration(n, x[:3], x[3:])])

    times = np.array([0.3, 1.1, 5.0]) / n
    flown = solve_ivp(rate, (0.0, times[-1]), [*R0, *V0], t_eval=times, rtol=1e-12, atol=1e-12)
    r, v = relative_motion(n, R0, V0, times)
    np.testing.assert_allclose(r, flown.y[:3].T, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(v, flown.y[3:].T, rtol=1e-8, atol=1e-8)
    one, _ = relative_motion(n, R0, V0, float(times[1]))
    np.testing.assert_array_equal(one, r[1])


def test_two_bodies_in_an_inverse_square_field_part_like_this() -> None:
    """To first order in the distance over the radius of the orbit: 6800 km against 10 m."""
    radius = EARTH_RADIUS + 400e3
    n = mean_motion_at(400e3)
    circle = np.array([radius, 0.0, 0.0]), np.array([0.0, radius * n, 0.0])
    spin = np.array([0.0, 0.0, n])

    def rate(_: float, x: Array) -> Array:
        return np.concatenate([x[3:], -EARTH_GRAVITATION * x[:3] / np.linalg.norm(x[:3]) ** 3])

    def flown(r: Array, v: Array, t: float) -> Array:
        return np.asarray(solve_ivp(rate, (0.0, t), [*r, *v], rtol=1e-13, atol=1e-9).y[:, -1])

    t = 900.0
    other = flown(circle[0] + R0, circle[1] + V0 + np.cross(spin, R0), t)
    c, s = np.cos(n * t), np.sin(n * t)
    R_IO = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    apart = (other - flown(*circle, t)).reshape(2, 3) @ R_IO
    r, v = relative_motion(n, R0, V0, t)
    np.testing.assert_allclose(r, apart[0], atol=1e-4)
    np.testing.assert_allclose(v, apart[1] - np.cross(spin, apart[0]), atol=1e-6)


@given(st.floats(1e-4, 2.0), st.floats(0.0, 3.0), st.floats(0.0, 3.0))
def test_motions_follow_each_other(n: float, first: float, second: float) -> None:
    halfway = relative_motion(n, R0, V0, first / n)
    r, v = relative_motion(n, *halfway, second / n)
    whole_r, whole_v = relative_motion(n, R0, V0, (first + second) / n)
    np.testing.assert_allclose(r, whole_r, rtol=1e-9, atol=1e-9 * (1 + 0.02 / n))
    np.testing.assert_allclose(v, whole_v, rtol=1e-9, atol=1e-9)


def test_without_an_orbit_bodies_go_straight() -> None:
    r, v = relative_motion(0.0, R0, V0, [0.0, 2.0])
    np.testing.assert_allclose(r, [R0, R0 + 2 * V0], rtol=1e-15)
    np.testing.assert_allclose(v, [V0, V0], rtol=1e-15)
    near, _ = relative_motion(1e-7, R0, V0, 2.0)
    np.testing.assert_allclose(near, r[1], rtol=1e-6)


def test_accelerations_of_many_states_have_their_shape() -> None:
    found = relative_acceleration(0.5, [R0, 2 * R0], [V0, V0])
    np.testing.assert_allclose(found[0], [0.75 * 3.0 - 0.01, -0.02, -0.25 * 2.0])
    np.testing.assert_allclose(found[1], [0.75 * 6.0 - 0.01, -0.02, -0.25 * 4.0])


@pytest.mark.parametrize("n", [-0.1, np.nan, np.inf])
def test_a_bad_mean_motion_is_refused(n: float) -> None:
    with pytest.raises(ParameterError) as refused:
        relative_motion(n, R0, V0, 1.0)
    assert str(refused.value) == f"The mean motion is {n:g} rad/s; it must be finite and from 0."


@pytest.mark.parametrize("bad", [(R0 * np.nan, V0, 1.0), (R0, V0 * np.inf, 1.0), (R0, V0, np.nan)])
def test_bad_numbers_are_refused(bad: tuple[Array, Array, float]) -> None:
    with pytest.raises(ParameterError) as refused:
        relative_motion(0.1, *bad)
    assert str(refused.value) == (
        "Position, velocity and times of a relative motion must be finite."
    )
