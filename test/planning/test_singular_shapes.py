"""The parts of the search for singular shapes: equations, steps within bounds, and unions."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.planning.core.workspaces import (
    Workspaces,
    _bounds,
    _Equations,
    _least_solution,
    _Search,
    _union,
)
from spacerobot_ros.resources import robot_file

Array = npt.NDArray[np.float64]

TOOL = "end_effector"


@pytest.fixture(scope="module")
def arm() -> SpaceRobot:
    return SpaceRobot.from_file(robot_file("three_joint_arm"))


@pytest.fixture(scope="module")
def equations(arm: SpaceRobot) -> _Equations:
    return _Equations.of(arm, TOOL)


@pytest.mark.parametrize(
    ("intervals", "gap", "union"),
    [
        ([[0.5, 0.7], [0.1, 0.2], [0.25, 0.4]], 0.04, [(0.1, 0.2), (0.25, 0.4), (0.5, 0.7)]),
        ([[0.5, 0.7], [0.1, 0.2], [0.25, 0.4]], 0.06, [(0.1, 0.4), (0.5, 0.7)]),
        ([[0.5, 0.75], [0.0, 0.25], [0.5, 0.5]], 0.25, [(0.0, 0.75)]),
        ([[0.1, 0.9], [0.2, 0.3]], 0.0, [(0.1, 0.9)]),
    ],
)
def test_a_union_closes_gaps_up_to_a_width(
    intervals: list[list[float]], gap: float, union: list[tuple[float, float]]
) -> None:
    assert _union(np.array(intervals), gap) == union


def test_path_independent_distances_are_the_rest_of_the_reach_but_for_slivers() -> None:
    found = Workspaces(TOOL, True, (0.2, 2.0), ((0.2, 0.5), (0.9, 1.4), (1.4039, 1.6)), 3, 7)
    # Gaps of 0.2 % of 2 m are closed.
    assert found.path_independent == ((0.5, 0.9), (1.6, 2.0))
    wider = Workspaces(TOOL, True, (0.2, 2.0), ((0.2, 0.5), (0.9, 1.4), (1.4041, 2.0)), 3, 7)
    assert wider.path_independent == ((0.5, 0.9), (1.4, 1.4041))
    assert Workspaces(TOOL, True, (0.2, 2.0), (), 3, 7).path_independent == ((0.2, 2.0),)


def test_least_solutions_keep_what_is_not_free() -> None:
    rng = np.random.default_rng(1)
    A, b = rng.normal(size=(4, 2, 5)), rng.normal(size=(4, 2))
    free = np.ones((4, 5))
    free[1, 2] = free[2, [0, 4]] = 0.0
    found = _least_solution(A, b, free)
    for k in range(4):
        exact = np.linalg.pinv(A[k] * free[k]) @ b[k]
        np.testing.assert_allclose(found[k], exact, atol=1e-9)
    assert found[1, 2] == found[2, 0] == found[2, 4] == 0.0


def test_the_equations_are_those_of_the_least_direction_of_the_generalised_jacobian(
    arm: SpaceRobot, equations: _Equations
) -> None:
    assert (equations.dimensions, equations.rank) == (3, 3)
    rng = np.random.default_rng(2)
    z = rng.uniform(-1.0, 1.0, (2, 6))
    g, by_z, r, by_r = equations.evaluate(z)
    centers = [arm.link_pose(TOOL, x)[1] - arm.center_of_mass(x) for x in equations.samples]
    largest = max(float(np.linalg.norm(x)) for x in centers)
    for k in range(2):
        q, u = z[k, :3], z[k, 3:]
        J = arm.generalised_jacobian(TOOL, q)[:3]
        place = arm.link_pose(TOOL, q)[1] - arm.center_of_mass(q)
        assert r[k] == pytest.approx(float(np.linalg.norm(place)))
        # Along an orthonormal basis of their own: its rows times J are J* of the module.
        J_star = np.asarray(equations.jacobian(q))
        np.testing.assert_allclose(J_star.T @ J_star, J.T @ J, atol=1e-9)
        np.testing.assert_allclose(g[k, :3], J_star.T @ u / largest, atol=1e-12)
        assert g[k, 3] == pytest.approx(u @ u - 1)
        for i in range(6):
            h = 1e-6 * np.eye(6)[i]
            after, before = (equations.evaluate((z[k] + s * h)[np.newaxis]) for s in (1, -1))
            slope = (after[0][0] - before[0][0]) / 2e-6
            np.testing.assert_allclose(by_z[k, :, i], slope, atol=1e-8)
            assert by_r[k, i] == pytest.approx((after[2][0] - before[2][0]) / 2e-6, abs=1e-8)
    starts = equations.starts(z[:, :3])
    for k in range(2):
        J_star = np.asarray(equations.jacobian(z[k, :3]))
        least = np.linalg.svd(J_star, compute_uv=False)[-1]
        assert np.linalg.norm(J_star.T @ starts[k, 3:]) == pytest.approx(least, abs=1e-9)
        assert np.linalg.norm(starts[k, 3:]) == pytest.approx(1.0)
    np.testing.assert_array_equal(starts[:, :3], z[:, :3])


def test_the_reach_has_no_nearer_and_no_farther_shape(
    arm: SpaceRobot, equations: _Equations
) -> None:
    lower, upper = np.array([-1.0, -0.6, 0.2]), np.array([0.8, 0.9, 1.5])
    (near, far), shapes = equations.reach(lower, upper)
    assert np.all((shapes >= lower) & (shapes <= upper))
    grid = np.array(np.meshgrid(*np.linspace(lower, upper, 7).T)).reshape(3, -1).T
    z = np.hstack([grid, np.zeros((len(grid), 3))])
    distances = equations.evaluate(z)[2]
    assert near <= distances.min() + 1e-9
    assert far >= distances.max() - 1e-9
    assert near == pytest.approx(distances.min(), abs=0.08)
    assert far == pytest.approx(distances.max(), abs=0.08)
    ends = equations.evaluate(np.hstack([shapes, np.zeros((2, 3))]))[2]
    np.testing.assert_allclose(ends, [near, far], atol=1e-9)


@pytest.fixture(scope="module")
def bounded(equations: _Equations) -> Any:
    return _Search(equations, np.array([-1.0, -0.6, 0.2]), np.array([0.8, 0.9, 1.5]))


def test_a_step_may_not_leave_the_bounds(bounded: Any) -> None:
    z = np.array([[-1.0, 0.9, 0.5, 9.0, -9.0, 0.0]] * 2)
    out, inside = np.array([-1.0, 1.0, 1, 1, -1, 1]), np.array([1.0, -1.0, -1, 1, -1, 1])
    found = bounded._free_coordinates(z, np.array([out, inside]))
    np.testing.assert_array_equal(found, [[0, 0, 1, 1, 1, 1], [1, 1, 1, 1, 1, 1]])
    near = z + np.array([2e-12, -2e-12, 0, 0, 0, 0])
    np.testing.assert_array_equal(bounded._free_coordinates(near, np.array([out, out])), 1.0)
    at = z + np.array([0.5e-12, -0.5e-12, 0, 0, 0, 0])
    np.testing.assert_array_equal(bounded._free_coordinates(at, np.array([out, out]))[:, :2], 0.0)


def test_singular_shapes_are_solved_for_within_bounds(bounded: Any, equations: _Equations) -> None:
    rng = np.random.default_rng(3)
    shapes = rng.uniform([-1.0, -0.6, 0.2], [0.8, 0.9, 1.5], (12, 3))
    z = bounded._project_to_singular_shapes(equations.starts(shapes), 40)
    g = np.linalg.norm(equations.evaluate(z)[0], axis=1)
    assert np.all((z[:, :3] >= [-1.0, -0.6, 0.2]) & (z[:, :3] <= [0.8, 0.9, 1.5]))
    free = _Search(equations, np.full(3, -np.inf), np.full(3, np.inf))
    anywhere = free._project_to_singular_shapes(equations.starts(shapes), 40)
    found = np.linalg.norm(equations.evaluate(anywhere)[0], axis=1) < 1e-9
    assert found.mean() > 0.8
    assert (g < 1e-9).mean() <= found.mean()
    for shape in anywhere[found][:, :3]:
        J = np.asarray(equations.jacobian(shape))
        assert np.linalg.svd(J, compute_uv=False)[-1] < 1e-8
    # From a singular shape it goes on, to larger and to smaller distances, along singular ones.
    z = anywhere[found][:4]
    start = equations.evaluate(z)[2]
    for sign in (1.0, -1.0):
        end = free._follow_singular_curve(z, sign)
        after, missing = equations.evaluate(end)[2], equations.evaluate(end)[0]
        assert np.all(sign * (after - start) >= 0)
        assert np.max(sign * (after - start)) > 0.05
        assert np.linalg.norm(missing, axis=1).max() < 1e-9


def test_bounds_of_joints_that_turn_are_infinite_without_limits(arm: SpaceRobot) -> None:
    lower, upper = _bounds(arm, True)
    np.testing.assert_array_equal([lower, upper], [arm.lower, arm.upper])
    lower, upper = _bounds(arm, False)
    assert np.all(np.isneginf(lower) & np.isposinf(upper))
    sliders = SpaceRobot.from_file(robot_file("sliding_masses"))
    for within in (True, False):
        np.testing.assert_array_equal(_bounds(sliders, within), [sliders.lower, sliders.upper])
    with pytest.raises(KeyError, match="hand"):
        _Equations.of(arm, "hand")
