"""Polylines of poses and their rounded ways, against SciPy's rotations and by hand."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from spacerobot_ros.errors import PlanningError
from spacerobot_ros.planning.methods.pose_path import PosePath, RoundedPath

Array = npt.NDArray[np.float64]

STILL = np.array([0.0, 0.0, 0.0, 1.0])
CORNER = np.array([[1.0, -2.0, 0.5], [1.0, -1.6, 0.8], [1.3, -1.6, 0.8], [1.3, -1.2, 0.4]])
TURNS = Rotation.from_rotvec([[0.1, 0.2, 0.3], [0.4, 0.2, 0.3], [0.4, 0.1, -0.2], [0.4, 0.1, -0.2]])


def at_rest(points: Any) -> PosePath:
    places = np.asarray(points, dtype=float)
    return PosePath.from_poses(places, np.tile(STILL, (len(places), 1)))


def turning() -> PosePath:
    return PosePath.from_poses(CORNER, TURNS.as_quat())


def distance_from(lines: Array, place: Array) -> float:
    """Return the distance of a place (3,) from a polyline (K, 3), m."""
    found = []
    for a, b in pairwise(lines):
        share = np.clip((place - a) @ (b - a) / ((b - a) @ (b - a)), 0.0, 1.0)
        found.append(np.linalg.norm(a + share * (b - a) - place))
    return float(min(found))


# -- lines --------------------------------------------------------------------------------------


def test_lengths_are_metres_and_radians_together() -> None:
    path = turning()
    turned = [(TURNS[k + 1] * TURNS[k].inv()).as_rotvec() for k in range(3)]
    np.testing.assert_allclose(path.turns, turned, atol=1e-12)
    np.testing.assert_allclose(path.chords, np.diff(CORNER, axis=0))
    expected: Any = [0.5 + np.linalg.norm(turned[0]), 0.3 + np.linalg.norm(turned[1]), 0.4 * 2**0.5]
    np.testing.assert_allclose(path.lengths, expected, atol=1e-12)
    np.testing.assert_allclose(path.lengths_at_poses, [0.0, *np.cumsum(expected)], atol=1e-12)


def test_equal_poses_in_succession_are_one() -> None:
    path = at_rest([[0, 0, 1], [0, 0, 1], [0, 2, 1], [0, 2, 1 + 5e-11], [0, 0, 1]])
    np.testing.assert_array_equal(path.positions[:, 1], [0, 2, 0])
    turned = PosePath.from_poses(CORNER[[0, 0]], TURNS.as_quat()[:2])
    assert len(turned.positions) == 2


def test_the_rest_of_a_path_begins_within_a_line() -> None:
    path = turning()
    rest = path.remaining_after(path.lengths_at_poses[1] + 0.25 * path.lengths[1])
    np.testing.assert_allclose(rest.positions[0], [1.075, -1.6, 0.8], atol=1e-12)
    np.testing.assert_allclose(rest.positions[1:], CORNER[2:])
    wanted = Slerp([0.0, 1.0], TURNS[1:3])(0.25)
    assert (wanted.inv() * Rotation.from_quat(rest.quaternions[0])).magnitude() < 1e-12
    assert len(path.remaining_after(path.lengths_at_poses[2]).positions) == 2
    for beyond in (path.lengths_at_poses[-1], 99.0):
        end = path.remaining_after(beyond)
        np.testing.assert_allclose(end.positions, CORNER[3:], atol=1e-12)
    np.testing.assert_allclose(path.remaining_after(-1.0).positions, CORNER)
    assert end.remaining_after(3.0) is end


# -- fewer poses --------------------------------------------------------------------------------


def test_poses_on_a_line_are_left_out_and_corners_stay() -> None:
    share = np.linspace(0, 1, 11)[:, np.newaxis]
    points = np.vstack([CORNER[0] + share * (CORNER[1] - CORNER[0]), CORNER[2:]])
    np.testing.assert_allclose(at_rest(points).simplified(0.0).positions, CORNER, atol=1e-12)
    bent = at_rest([[0, 0, 0], [1, 0.01, 0], [2, 0, 0]])
    assert len(bent.simplified(0.0099).positions) == 3
    assert len(bent.simplified(0.0101).positions) == 2


def test_attitudes_and_ways_back_count_as_corners() -> None:
    there_and_back = at_rest([[0, 0, 0], [1, 0, 0], [0.5, 0, 0]])
    assert len(there_and_back.simplified(0.1).positions) == 3
    turned = Rotation.from_rotvec([[0, 0, 0], [0, 0, 0.3], [0, 0, 0.2]]).as_quat()
    path = PosePath.from_poses(np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]]), turned)
    # Halfway in metres and radians together the line has turned by 0.13 rad.
    assert len(path.simplified(0.15).positions) == 3
    assert len(path.simplified(0.25).positions) == 2


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0.01, 0.3))
def test_simplified_paths_keep_near_all_poses(seed: int, tolerance: float) -> None:
    points = np.random.default_rng(seed).normal(size=(20, 3)).cumsum(axis=0) * 0.1
    lines = at_rest(points).simplified(tolerance).positions
    assert max(distance_from(lines, each) for each in points) <= tolerance + 1e-12
    np.testing.assert_array_equal(lines[[0, -1]], points[[0, -1]])


def test_too_many_corners_are_refused() -> None:
    zigzag = np.zeros((503, 3))
    zigzag[:, 0], zigzag[1::2, 1] = np.arange(503), 1.0
    with pytest.raises(
        PlanningError, match=r"^The path has more than 500 corners: give fewer poses"
    ):
        at_rest(zigzag).simplified(0.1)
    assert len(at_rest(zigzag[:502]).simplified(0.1).positions) == 502


# -- stops --------------------------------------------------------------------------------------


def test_the_motion_stops_at_sharp_corners_and_without_a_tolerance_at_all() -> None:
    path = at_rest([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0.4, 0.1, 0], [0.4, 0.1, 2]])
    # Corners of 90, 124 and 90 degrees.
    assert [len(x.positions) for x in path.split_at_reversals(0.01)] == [3, 3]
    np.testing.assert_array_equal(
        [x.positions[0] for x in path.split_at_reversals(0.01)], [[0, 0, 0], [1, 1, 0]]
    )
    assert [len(x.positions) for x in path.split_at_reversals(0.0)] == [2] * 4
    gentle = at_rest([[0, 0, 0], [1, 0, 0], [0.51, 0.85, 0]])  # 119.95 degrees.
    assert [len(x.positions) for x in gentle.split_at_reversals(0.01)] == [3]


# -- rounded ways -------------------------------------------------------------------------------


def test_a_blend_is_a_parabola_between_both_lines() -> None:
    path, tolerance = at_rest(CORNER[:3]), 0.03
    way = RoundedPath(path, tolerance, before=0.2, whole=7.0)
    d, total = 4 * tolerance, 0.8
    to, on = np.array([0.0, 0.8, 0.6]), np.array([1.0, 0.0, 0.0])
    for s in (0.1, 0.5 - d, 0.45, 0.5, 0.57, 0.5 + d, 0.8):
        t = np.clip((s - 0.5 + d) / (2 * d), 0.0, 1.0)
        place = 0.5 * to - d * (1 - t) ** 2 * to + d * t**2 * on
        if s < 0.5 - d:
            place = s * to
        if s > 0.5 + d:
            place = 0.5 * to + (s - 0.5) * on
        np.testing.assert_allclose(way.displacement(s / total), place, atol=1e-12)
    np.testing.assert_allclose(
        way.curvature_breaks * total, 0.5 + d * np.linspace(-1, 1, 5), atol=1e-12
    )
    assert way.length == pytest.approx(0.8)
    assert (way.total_length, way.is_straight) == (7.0, False)
    assert way.travelled_length(0.5) == pytest.approx(0.6)
    assert RoundedPath(at_rest(CORNER[:2]), 0.1).is_straight
    assert RoundedPath(at_rest(CORNER[:2]), 0.1).total_length == pytest.approx(0.5)
    # Blends meet halfway on a short line.
    narrow = RoundedPath(path, 0.05)
    np.testing.assert_allclose(narrow.curvature_breaks[[0, -1]] * total, [0.35, 0.65], atol=1e-12)


@pytest.mark.parametrize("tolerance", [0.01, 0.2])
def test_rates_are_derivatives_and_corners_are_rounded(tolerance: float) -> None:
    path = turning()
    way, h = RoundedPath(path, tolerance), 1e-6
    shares = np.concatenate([np.linspace(0.003, 0.997, 40), way.curvature_breaks])
    for share in shares:
        slope = (way.displacement(share + h) - way.displacement(share - h)) / (2 * h)
        np.testing.assert_allclose(way.displacement_derivative(share), slope, atol=1e-3)
        ends = [Rotation.from_quat(way.rotation(share + x)) for x in (-h, h)]
        spin = (ends[1] * ends[0].inv()).as_rotvec() / (2 * h)
        np.testing.assert_allclose(way.rotation_derivative(share), spin, atol=1e-3)
    off = [distance_from(CORNER - CORNER[0], way.displacement(share)) for share in shares]
    assert max(off) <= tolerance
    np.testing.assert_allclose(way.displacement(1.0), CORNER[3] - CORNER[0], atol=1e-12)
    ended = Rotation.from_quat(way.rotation(1.0)) * TURNS[0]
    assert (ended.inv() * TURNS[3]).magnitude() < 1e-12
    np.testing.assert_allclose(way.rotation(0.0), STILL, atol=1e-15)
