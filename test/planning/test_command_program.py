"""The least change of shapes at ticks against closed forms and another solver."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest
from scipy.optimize import minimize

from spacerobot_ros.model.description import Array
from spacerobot_ros.planning.methods.optimal.held_commands import least_change
from spacerobot_ros.planning.methods.optimal.problem import MotionLimits

PERIOD = 0.3
N = 6
LIMITS = MotionLimits(
    lower=np.array([-1.0, -0.4]),
    upper=np.array([0.9, 2.0]),
    velocity=np.array([0.8, 2.0]),
    acceleration=np.array([1.5, 4.0]),
)
SPEED = LIMITS.velocity * PERIOD


def path() -> Array:
    s = np.linspace(0.0, 1.0, N + 1)[:, np.newaxis]
    return np.asarray(np.hstack([0.3 * s**2 * (3 - 2 * s), -0.2 * np.sin(np.pi * s)]))


def rows(seed: int = 3) -> Array:
    return np.random.default_rng(seed).normal(size=(3, N + 1, 2))


def change(error: Array, limits: MotionLimits = LIMITS, **settings: Any) -> Array | None:
    given = {"before": 0.0, "moves_end": False, **settings}
    return least_change(
        path(), rows(), error, limits, PERIOD, given["before"], moves_end=given["moves_end"]
    )


@pytest.mark.parametrize("moves_end", [False, True])
def test_a_small_change_is_that_of_least_squares(moves_end: bool) -> None:
    """Of all changes that meet the error, the one nearest to none over the joints' speeds."""
    error = np.array([0.002, -0.003, 0.001])
    found = change(error, moves_end=moves_end)
    assert found is not None
    free = slice(1, N + moves_end)
    A = (rows()[:, free] * SPEED).reshape(3, -1)
    expected = (np.linalg.pinv(A) @ error).reshape(-1, 2) * SPEED
    np.testing.assert_allclose(found[free], expected, atol=1e-6)
    assert not found[0].any()
    assert moves_end or not found[-1].any()


@pytest.mark.parametrize(("before", "size"), [(0.0, 0.5), (np.array([0.1, -0.3]), 0.45)])
def test_a_large_change_keeps_all_limits_as_another_solver_finds_it(
    before: Any, size: float
) -> None:
    limits = MotionLimits(
        LIMITS.lower, np.array([0.305, 2.0]), LIMITS.velocity, LIMITS.acceleration
    )
    error = size * np.array([0.4, -0.7, 0.5])
    found = change(error, limits, before=before)
    assert found is not None
    factor, overrun = limits.excess(path() + found, PERIOD, before)
    assert factor <= 1.0
    assert overrun <= 1e-6
    np.testing.assert_allclose(np.einsum("mkn,kn->m", rows(), found), error, atol=1e-6)
    assert factor > 0.99, "no limit is active"

    def with_change(x: Array) -> Array:
        positions = path()
        positions[1:-1] += x.reshape(-1, 2) * SPEED
        return positions

    def room(x: Array) -> Array:
        positions = with_change(x)
        speed, turn = limits.limit_shares(positions, PERIOD, before)
        most = 1 - 1e-4
        return np.concatenate(
            [
                (most - speed[1:-1]).ravel(),
                (most - turn).ravel(),
                (positions - limits.lower).ravel(),
                (limits.upper - positions).ravel(),
            ]
        )

    other = minimize(
        lambda x: 0.5 * x @ x,
        np.zeros(2 * (N - 1)),
        jac=lambda x: x,
        method="SLSQP",
        constraints=[
            {"type": "ineq", "fun": room},
            {
                "type": "eq",
                "fun": lambda x: np.einsum("mkn,kn->m", rows(), with_change(x) - path()) - error,
            },
        ],
        options={"maxiter": 500, "ftol": 1e-12},
    )
    assert other.success
    np.testing.assert_allclose(path() + found, with_change(other.x), atol=2e-5)


def test_there_is_none_beyond_the_limits() -> None:
    assert change(np.array([9.0, -9.0, 9.0])) is None


def test_there_is_none_without_shapes_that_may_change() -> None:
    shapes, by_shapes = path()[[0, -1]], rows()[:, [0, -1]]
    error = np.array([1e-3, 0.0, 0.0])
    assert least_change(shapes, by_shapes, error, LIMITS, PERIOD, 0.0, moves_end=False) is None
    found = least_change(shapes, by_shapes[:1], error[:1], LIMITS, 2.0, 0.0, moves_end=True)
    assert found is not None
    assert found[1] @ by_shapes[0, 1] == pytest.approx(1e-3, abs=1e-6)


def test_a_joint_without_a_speed_limit_changes_by_shares_of_its_range() -> None:
    limits = MotionLimits(LIMITS.lower, LIMITS.upper, np.array([0.8, np.inf]), LIMITS.acceleration)
    error = np.array([0.002, -0.003, 0.001])
    found = change(error, limits)
    assert found is not None
    scale = np.array([0.8, 1.2]) * PERIOD
    A = (rows()[:, 1:N] * scale).reshape(3, -1)
    expected = (np.linalg.pinv(A) @ error).reshape(-1, 2) * scale
    np.testing.assert_allclose(found[1:N], expected, atol=1e-6)


def test_without_the_solver_there_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    assert change(np.full(3, 1e-3)) is not None
    monkeypatch.setattr(ca, "has_conic", lambda name: name != "osqp")
    assert change(np.full(3, 1e-3)) is None
