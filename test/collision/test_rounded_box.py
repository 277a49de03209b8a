"""Bounds by rounded boxes against distances by coal and by geometry."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from spacerobot_ros.collision.rounded_box import RoundedBox, separation
from spacerobot_ros.model.description import Array, Pose, Shape
from spacerobot_ros.model.rotations import matrix_from_rpy

coal = pytest.importorskip("coal")

Triple = tuple[float, float, float]
Form = tuple[str, tuple[float, ...]]

SIZES = st.floats(0.02, 1.5)
PLACES = st.tuples(*[st.floats(-2.0, 2.0)] * 3)
TURNS = st.tuples(*[st.floats(-3.0, 3.0)] * 3)
SHAPES = st.one_of(
    st.tuples(st.just("box"), st.tuples(SIZES, SIZES, SIZES)),
    st.tuples(st.just("sphere"), st.tuples(SIZES)),
    st.tuples(st.just("cylinder"), st.tuples(SIZES, SIZES)),
)
OFFSET = Pose(matrix_from_rpy([0.3, -0.7, 1.1]), np.array([0.2, -0.1, 0.4]))


def exact(kind: str, size: tuple[float, ...]) -> object:
    return {"box": coal.Box, "sphere": coal.Sphere, "cylinder": coal.Cylinder}[kind](*size)


def coal_distance(one: object, at: Pose, other: object, there: Pose) -> float:
    poses = [coal.Transform3s(pose.R, pose.r) for pose in (at, there)]
    return float(
        coal.distance(one, poses[0], other, poses[1], coal.DistanceRequest(), coal.DistanceResult())
    )


def bound(one: RoundedBox, at: Pose, other: RoundedBox, there: Pose) -> float:
    R_1, r_1, R_2, r_2 = (x[np.newaxis] for x in (at.R, at.r, there.R, there.r))
    return float(separation(one, R_1, r_1, other, R_2, r_2)[0])


@settings(max_examples=150, deadline=None)
@given(SHAPES, SHAPES, PLACES, TURNS)
def test_the_bound_is_not_above_the_exact_distance(
    one: Form, other: Form, place: Triple, turn: Triple
) -> None:
    shapes = [Shape(kind, size, OFFSET) for kind, size in (one, other)]
    link = Pose(matrix_from_rpy(turn), np.array(place))
    found = bound(RoundedBox.around(shapes[0]), Pose(), RoundedBox.around(shapes[1]), link)
    true = coal_distance(exact(*one), OFFSET, exact(*other), link @ OFFSET)
    # Depths of coal are those of an iteration.
    assert found <= max(true, 0.0) + 1e-5


@pytest.mark.slow
@settings(max_examples=150, deadline=None)
@given(st.tuples(SIZES, SIZES, SIZES), st.tuples(SIZES, SIZES, SIZES), PLACES, TURNS)
def test_the_bound_of_boxes_that_are_apart_is_their_distance(
    one: Triple, other: Triple, place: Triple, turn: Triple
) -> None:
    boxes = [RoundedBox(OFFSET, np.array(size) / 2) for size in (one, other)]
    link = Pose(matrix_from_rpy(turn), np.array(place))
    true = coal_distance(coal.Box(*one), OFFSET, coal.Box(*other), link @ OFFSET)
    found = bound(boxes[0], Pose(), boxes[1], link)
    assert found <= max(true, 0.0) + 1e-5
    if true > 0.05:
        assert found == pytest.approx(true, rel=0.05)


def test_capsules_at_right_angles_are_as_far_as_their_lines() -> None:
    one = RoundedBox(Pose(), np.array([0.5, 0.0, 0.0]), 0.1)
    other = RoundedBox(Pose(), np.array([0.0, 0.7, 0.0]), 0.2)
    assert bound(one, Pose(), other, Pose(r=np.array([0.3, 0.4, 0.9]))) == pytest.approx(0.6)
    # Beyond the end of the first: a corner of a triangle with sides 0.4 and 0.9.
    beyond = bound(one, Pose(), other, Pose(r=np.array([0.9, 0.1, -0.9])))
    assert beyond == pytest.approx(math.hypot(0.4, 0.9) - 0.3)


def test_the_bound_of_overlapping_boxes_is_minus_their_depth() -> None:
    one = RoundedBox(Pose(), np.array([1.0, 2.0, 3.0]))
    other = RoundedBox(Pose(), np.array([0.5, 0.4, 0.3]))
    assert bound(one, Pose(), other, Pose(r=np.array([1.3, 0.2, 0.1]))) == pytest.approx(-0.2)


def test_a_capsule_is_its_own_bound() -> None:
    radius, length = 0.2, 0.6
    box = RoundedBox.around(Shape("capsule", (radius, length), OFFSET))
    assert box.volume == pytest.approx(math.pi * radius**2 * (length + 4 / 3 * radius))
    # End to end, its balls are 0.9 m apart.
    along = Pose(r=OFFSET.R @ [0.0, 0.0, 0.9 + length])
    assert bound(box, Pose(), box, along) == pytest.approx(0.9 - 2 * radius)


def test_edges_that_cross_overlap_by_their_heights() -> None:
    """Beams that lie on their edges, one across the other at 30 degrees."""
    rest = Pose(matrix_from_rpy([math.pi / 4, 0.0, 0.0]))
    beam = RoundedBox(rest, np.array([2.0, 0.1, 0.1]))
    height = 0.1 * math.sqrt(2)
    for depth in (0.01, 0.03):
        above = Pose(matrix_from_rpy([0, 0, math.pi / 6]), np.array([0, 0, 2 * height - depth]))
        assert bound(beam, Pose(), beam, above) == pytest.approx(-depth)


@pytest.mark.parametrize("squash", [(1.0, 1.0, 1.0), (0.05, 0.05, 1.0), (1.0, 0.4, 0.0)])
def test_a_mesh_is_enclosed(squash: tuple[float, float, float]) -> None:
    rng = np.random.default_rng(5)
    points: Array = rng.normal(size=(40, 3)) * squash @ OFFSET.R.T + OFFSET.r
    box = RoundedBox.around(Shape("mesh", (1.0, 1.0, 1.0), OFFSET), points)
    local = (points - box.pose.r) @ box.pose.R
    outside = np.linalg.norm(np.maximum(np.abs(local) - box.half, 0.0), axis=1)
    assert outside.max() <= box.radius + 1e-12
    ball = np.linalg.norm(points - box.pose.r, axis=1).max()
    assert ball <= box.bounding_radius + 1e-12
    # As small as a box along the axes that the points were drawn along.
    plain = np.prod(np.ptp((points - OFFSET.r) @ OFFSET.R, axis=0))
    assert box.volume <= plain + 1e-12
