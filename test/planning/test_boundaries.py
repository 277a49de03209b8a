"""Boundaries of planning, exactly: limits that are just kept and just not."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from spacerobot_ros.planning.methods.optimal.problem import (
    PathConstraints,
    UnusableCandidateError,
)

Array = npt.NDArray[np.float64]


def turning(rate: float) -> Array:
    """Return attitudes at three ticks of 0.5 s, the last two apart by a rate."""
    angles = np.array([0.0, 0.01, 0.01 + rate * 0.5])
    return Rotation.from_rotvec(angles[:, np.newaxis] * [0.6, 0.0, 0.8]).as_quat()


def test_a_base_may_turn_at_its_bound_and_a_millionth_more() -> None:
    bound = PathConstraints(base_rate_limit=0.2)
    shapes = np.zeros((3, 2))
    bound.check(shapes, turning(0.2 * (1 + 0.9e-6)), 0.5)
    with pytest.raises(UnusableCandidateError, match=r"^the base turns at 0\.2001 rad/s$"):
        bound.check(shapes, turning(0.2001), 0.5)
    PathConstraints().check(shapes, turning(9.0), 0.5)
    assert bound.imposed_base_rate == pytest.approx(0.196)


def test_an_axis_may_touch_its_cone() -> None:
    axis, sun = np.array([0.0, 1.0, 0.0]), np.array([1.0, 0.0, 0.0])
    attitudes = Rotation.from_rotvec([[0, 0, 0.0], [0, 0, -0.9], [0, 0, -0.4]]).as_quat()
    shapes = np.zeros((3, 2))
    nearest = np.pi / 2 - 0.9
    PathConstraints(axis_B=axis, direction_W=sun, cone_half_angle=nearest).check(
        shapes, attitudes, 0.5
    )
    wider = PathConstraints(axis_B=axis, direction_W=sun, cone_half_angle=nearest + 1e-6)
    with pytest.raises(UnusableCandidateError) as refusal:
        wider.check(shapes, attitudes, 0.5)
    assert str(refusal.value) == f"the axis comes within {nearest:.4g} rad of keep_direction"


def test_shapes_may_touch_a_box_and_its_first_entry_is_told() -> None:
    boxes = np.array([[[0.1, -0.5], [0.4, 0.5]]])
    kept = PathConstraints(keep_out_boxes=boxes)
    attitudes = np.tile([0.0, 0.0, 0.0, 1.0], (4, 1))
    kept.check(np.array([[0.1, 0.0], [0.4, 0.0], [0.2, 0.5], [0.2, -0.5]]), attitudes, 0.5)
    inside = np.array([[0.0, 0.0], [0.05, 0.0], [0.2, 0.1], [0.3, 0.2]])
    with pytest.raises(
        UnusableCandidateError, match=r"^the shape enters a box of keep_out at 1 s$"
    ):
        kept.check(inside, attitudes, 0.5)
