"""Closed paths along joint axes: the areas that they enclose, by line integrals."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from spacerobot_ros.planning.methods.area_loop import EdgePath, edge_path

Array = npt.NDArray[np.float64]

LONG = np.full(3, 100.0)

areas_of_either_sign = st.tuples(
    *(st.floats(0.05, 3.0).flatmap(lambda size: st.sampled_from([size, -size])) for _ in range(3))
).map(np.array)


def enclosed(path: EdgePath) -> Array:
    """Return the areas (3,) in the planes 12, 23, 31: closed integrals of (x dy - y dx) / 2."""
    total = np.zeros(3)
    for loop in path.loops:
        for plane, (i, j) in enumerate([(0, 1), (1, 2), (2, 0)]):
            x, y = loop[:, i], loop[:, j]
            total[plane] += 0.5 * np.sum(x[:-1] * np.diff(y) - y[:-1] * np.diff(x))
    return total


def edges(path: EdgePath) -> Array:
    return np.vstack([np.diff(loop, axis=0) for loop in path.loops])


@given(areas=areas_of_either_sign)
def test_six_edges_enclose_all_areas_at_once(areas: Array) -> None:
    path = edge_path(areas, LONG)
    assert path.kind == "cube"
    np.testing.assert_allclose(enclosed(path), areas, rtol=1e-9)
    steps = edges(path)
    assert len(steps) == 6
    # Each along one joint, every joint there and back.
    np.testing.assert_array_equal(np.count_nonzero(np.abs(steps) > 1e-12, axis=1), 1)
    np.testing.assert_allclose(steps[:3], -steps[3:], atol=1e-12)
    assert path.edge_ratio == pytest.approx(np.abs(steps).max() / 100.0)


@given(areas=areas_of_either_sign, zeros=st.sets(st.integers(0, 2), min_size=1, max_size=2))
def test_rectangles_enclose_the_areas_that_are_not_zero(areas: Array, zeros: set[int]) -> None:
    areas = areas.copy()
    areas[sorted(zeros)] = 0.0
    path = edge_path(areas, LONG)
    assert path.kind == "rectangles"
    assert len(path.loops) == 3 - len(zeros)
    np.testing.assert_allclose(enclosed(path), areas, rtol=1e-9, atol=1e-12)


@given(
    areas=areas_of_either_sign,
    longest=st.tuples(*[st.floats(0.1, 2.0)] * 3).map(np.array),
)
def test_scaled_by_its_excess_a_path_fits(areas: Array, longest: Array) -> None:
    path = edge_path(areas, longest)
    np.testing.assert_allclose(enclosed(path), areas, rtol=1e-9)
    worst = np.max(np.abs(edges(path)) / longest)
    assert path.edge_ratio == pytest.approx(worst, rel=1e-9)
    smaller = edge_path(areas * min(1.0, path.edge_ratio**-2), longest)
    assert np.all(np.abs(edges(smaller)) <= longest * (1 + 1e-9))


@given(areas=areas_of_either_sign, longest=st.tuples(*[st.floats(0.1, 2.0)] * 3).map(np.array))
def test_every_loop_lies_round_the_origin_and_closes(areas: Array, longest: Array) -> None:
    loops = edge_path(areas, longest).loops
    assert len(loops)
    for loop in loops:
        np.testing.assert_allclose(loop[0], loop[-1], atol=1e-15)
        np.testing.assert_allclose(loop.max(axis=0), -loop.min(axis=0), atol=1e-12)


def test_the_directions_that_the_formulas_need() -> None:
    # d1 d2 = 1, d2 d3 = 2, -d1 d3 = -8: forwards; all three negated: backwards.
    forwards = edge_path(np.array([1.0, 2.0, -8.0]), LONG)
    np.testing.assert_allclose(edges(forwards)[:3], np.diag([2.0, 0.5, 4.0]), atol=1e-12)
    backwards = edge_path(-np.array([1.0, 2.0, -8.0]), LONG)
    np.testing.assert_allclose(edges(backwards), -edges(forwards)[::-1], atol=1e-12)


def test_an_area_near_zero_makes_no_endless_edge() -> None:
    # The cube would have edges of 1e4 and 1e-4; rectangles have sides of one.
    path = edge_path(np.array([1.0, 1e-4, 1.0]), np.ones(3))
    assert path.kind == "rectangles"
    assert np.abs(edges(path)).max() == pytest.approx(1.0)
    # Below rounding of the others it is none.
    assert len(edge_path(np.array([1.0, 1e-9, 1.0]), np.ones(3)).loops) == 2


def test_rectangles_are_as_long_as_the_room_of_each_joint() -> None:
    path = edge_path(np.array([0.5, 0.0, 0.0]), np.array([2.0, 0.5, 1.0]))
    sides = np.abs(edges(path)).max(axis=0)
    assert sides[0] / sides[1] == pytest.approx(4.0)


def test_no_area_is_no_path() -> None:
    path = edge_path(np.zeros(3), LONG)
    assert (path.kind, path.loops, path.edge_ratio) == ("nothing", (), 0.0)
