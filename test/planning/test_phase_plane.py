"""The turn of a planar robot by two joints in closed form, against other ways to integrate it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import dblquad, quad

from spacerobot_ros.planning.methods.geometric_phase import (
    PhasePlane,
    centre_box,
    curvature_peaks,
    square_corners,
)

C = np.array(
    [
        [[0.3, 0.2, -0.1], [0.4, -0.3, 0.15], [0.05, 0.1, 0.2]],
        [[0.6, -0.2, 0.1], [0.1, 0.25, -0.05], [-0.3, 0.15, 0.1]],
        [[4.0, 0.3, 0.2], [0.4, 0.2, -0.1], [-0.2, 0.1, 0.3]],
    ]
)
"""Of the momenta by the joints and by the base: asymmetric, and the last one always positive."""
PLANE = PhasePlane(C)


def rates(x: float, y: float) -> tuple[float, float]:
    """Return the turn of the base per angle of each joint, from the polynomials written out."""
    left, right = np.array([1, np.cos(x), np.sin(x)]), np.array([1, np.cos(y), np.sin(y)])
    first, second, whole = (float(left @ each @ right) for each in C)
    return first / whole, second / whole


def test_the_curvature_is_the_turn_of_small_loops() -> None:
    rng = np.random.default_rng(3)
    for x, y in rng.uniform(-4.0, 4.0, (6, 2)):
        h = 1e-5
        by_x = (rates(x + h, y)[1] - rates(x - h, y)[1]) / (2 * h)
        by_y = (rates(x, y + h)[0] - rates(x, y - h)[0]) / (2 * h)
        assert PLANE.curvature(np.array([x, y])) == pytest.approx(by_y - by_x, abs=1e-8)
    grid = rng.uniform(-4.0, 4.0, (3, 5, 2))
    found = PLANE.curvature(grid)
    assert found.shape == (3, 5)
    assert found[2, 4] == PLANE.curvature(grid[2, 4])


def test_a_square_turns_the_base_by_its_curvature_and_by_its_sides() -> None:
    centres, sides = np.array([[0.4, -0.7], [2.0, 1.0]]), np.array([1.3, 0.6])
    found = PLANE.turns_by_squares(centres, sides)
    for (x, y), side, turn in zip(centres, sides, found, strict=True):
        ends = x - side / 2, x + side / 2, y - side / 2, y + side / 2
        area, _ = dblquad(lambda b, a: float(PLANE.curvature(np.array([a, b]))), *ends)
        assert turn == pytest.approx(area, abs=1e-9)
        low, high, near, far = ends
        legs = [
            quad(lambda a, y=near: -rates(a, y)[0], low, high)[0],
            quad(lambda b, x=high: -rates(x, b)[1], near, far)[0],
            quad(lambda a, y=far: rates(a, y)[0], low, high)[0],
            quad(lambda b, x=low: rates(x, b)[1], near, far)[0],
        ]
        assert turn == pytest.approx(sum(legs), abs=1e-9)


def test_corners_go_round_counter_clockwise() -> None:
    corners = square_corners(np.array([[1.0, 2.0], [0.0, 0.0]]), np.array([2.0, 0.5]))
    assert corners[0].tolist() == [[0.0, 1.0], [2.0, 1.0], [2.0, 3.0], [0.0, 3.0]]
    assert corners[1].tolist() == [[-0.25, -0.25], [0.25, -0.25], [0.25, 0.25], [-0.25, 0.25]]


@pytest.mark.parametrize(
    ("at", "lower", "upper", "box"),
    [
        ([0.2, 0.1], [-1.0, -0.5], [1.5, 0.7], [[-1.0, -0.5], [1.5, 0.7]]),
        ([9.0, 1.0], [-np.inf, -1.0], [np.inf, 1.0], [[9.0 - np.pi, -1.0], [9.0 + np.pi, 1.0]]),
        ([4.5, -4.0], [-5.0, -5.0], [5.0, 5.0], [[5.0 - 2 * np.pi, -5.0], [5.0, -5.0 + 2 * np.pi]]),
        ([1.0, 0.0], [-5.0, -0.1], [5.0, 0.1], [[1.0 - np.pi, -0.1], [1.0 + np.pi, 0.1]]),
    ],
)
def test_a_box_holds_every_point_once(
    at: list[float], lower: list[float], upper: list[float], box: list[list[float]]
) -> None:
    found = centre_box(*map(np.array, (at, lower, upper)))
    np.testing.assert_allclose(found, box, atol=1e-12)


def test_peaks_are_the_largest_curvatures_in_their_boxes() -> None:
    whole, part = [[-3.0, -3.0], [3.0, 3.0]], [[0.5, 0.2], [1.1, 0.9]]
    boxes = np.array([whole, part, whole])
    at = np.array([0.1, -0.2])
    found = curvature_peaks(PLANE, at, boxes)
    np.testing.assert_array_equal(found[0], found[2])
    for point, (low, high) in zip(found, boxes, strict=True):
        assert np.all((point >= low) & (point <= high))
        grid = np.array(np.meshgrid(*np.linspace(low, high, 161).T)).reshape(2, -1).T
        heights = np.abs(PLANE.curvature(grid))
        assert abs(float(PLANE.curvature(point))) >= heights.max() * (1 - 1e-4)
        np.testing.assert_allclose(point, grid[heights.argmax()], atol=0.05)


def test_of_equal_peaks_the_nearest_is_taken_and_the_last_of_mirror_images() -> None:
    """A curvature of sin x sin y has four equal peaks a turn, at odd multiples of 90 degrees."""
    flat = np.zeros((3, 3, 3))
    flat[0, 2, 1] = 1.0
    flat[2, 0, 0] = 1.0
    plane = PhasePlane(flat)
    box = np.array([[[-np.pi, -np.pi], [np.pi, np.pi]]])
    half = np.pi / 2
    for at, peak in (
        ([0.3, 0.4], [half, half]), ([-0.3, 0.4], [-half, half]), ([0.3, -0.4], [half, -half]),
        ([0.0, 0.0], [half, half]), ([-0.2, 0.0], [-half, half]),
    ):  # fmt: skip
        found = curvature_peaks(plane, np.array(at), box)
        np.testing.assert_allclose(found, [peak], atol=2e-3)
