"""Rows of distances along an interval: the points that they are taken at, and their derivatives."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from spacerobot_ros.collision.planes import PlaneDistance
from spacerobot_ros.planning.methods.optimal.transcription import _distance_block

N = 2


def planes_of_links() -> PlaneDistance:
    q, plane, multiplier = ca.SX.sym("q", N), ca.SX.sym("plane", 7), ca.SX.sym("lambda")
    d = ca.sin(q[0]) * q[1] * plane[1] + q[0] ** 2 - plane[3]
    return PlaneDistance(
        ca.Function("d", [q, plane], [d]),
        ca.Function("J", [q, plane], [ca.jacobian(d, q)]),
        ca.Function("H", [q, plane, multiplier], [ca.hessian(multiplier * d, q)[0]]),
    )


def planes_of_obstacles() -> PlaneDistance:
    y, plane, multiplier = ca.SX.sym("y", N + 4), ca.SX.sym("plane", 7), ca.SX.sym("lambda")
    d = y[0] * y[3] + ca.cos(y[1]) * y[5] * plane[2] + plane[6] * y[2] * y[4]
    return PlaneDistance(
        ca.Function("d", [y, plane], [d]),
        ca.Function("J", [y, plane], [ca.jacobian(d, y)]),
        ca.Function("H", [y, plane, multiplier], [ca.hessian(multiplier * d, y)[0]]),
        is_of_obstacle=True,
    )


H, START = 0.4, np.array([0.3, -0.7])
V, V_NEXT = np.array([0.5, -0.2]), np.array([-0.1, 0.6])
X, X_NEXT = np.array([0.1, -0.2, 0.3, 0.9]), np.array([0.2, -0.1, 0.25, 0.92])
# The variable s of a knot is q + h v / 2.
LACK = 0.03
Z = np.concatenate([[H], X, START + H * V / 2, V, X_NEXT, V_NEXT, [LACK]])
PLANES = np.random.default_rng(5).normal(size=(3, 2, 7))
ROWS = [planes_of_links(), planes_of_obstacles()]


def by_hand(z: np.ndarray) -> np.ndarray:
    """Return the rows at thirds of an interval in which velocities change linearly."""
    h, X0, s, v, X1, v1, lack = z[0], z[1:5], z[5:7], z[7:9], z[9:13], z[13:15], z[15]
    found = []
    for tau, (first, second) in zip((1 / 3, 2 / 3, 1.0), PLANES, strict=True):
        t = tau * h
        q = s - h * v / 2 + v * t + (v1 - v) / h * t**2 / 2
        y = np.concatenate([q, (1 - tau) * X0 + tau * X1])
        found.append(np.sin(q[0]) * q[1] * first[1] + q[0] ** 2 - first[3] + lack)
        of_obstacle = y[0] * y[3] + np.cos(y[1]) * y[5] * second[2] + second[6] * y[2] * y[4]
        found.append(of_obstacle + lack)
    return np.array(found)


def test_rows_are_those_of_the_shapes_between_the_knots() -> None:
    block, p = _distance_block(N, ROWS, 3), PLANES.ravel()
    np.testing.assert_allclose(block.values(Z, p).full().ravel(), by_hand(Z), atol=1e-13)
    values, J = block.jacobian(Z, p)
    np.testing.assert_allclose(values.full().ravel(), by_hand(Z), atol=1e-13)
    step = 1e-6
    differences = [(by_hand(Z + e) - by_hand(Z - e)) / (2 * step) for e in step * np.eye(len(Z))]
    np.testing.assert_allclose(J.full(), np.column_stack(differences), atol=1e-8)


def test_second_derivatives_are_those_of_differences() -> None:
    block, p = _distance_block(N, ROWS, 3), PLANES.ravel()
    multipliers = np.array([0.7, -1.2, 0.4, 2.0, -0.6, 1.1])

    def gradient(z: np.ndarray) -> np.ndarray:
        return np.asarray(block.jacobian(z, p)[1].full().T @ multipliers)

    step = 1e-6
    expected = np.column_stack(
        [(gradient(Z + e) - gradient(Z - e)) / (2 * step) for e in step * np.eye(len(Z))]
    )
    upper = block.hessian(Z, p, multipliers).full()
    np.testing.assert_allclose(np.triu(upper), np.triu(expected), atol=1e-8)
    assert np.abs(np.tril(upper, -1)).max() == pytest.approx(0.0, abs=1e-12)
