"""Parts of resolved_rate on made-up lines, whose ways, rates and singularities are known."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from spacerobot_ros.errors import PlanningError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.planning.core.cancellation import NEVER
from spacerobot_ros.planning.methods.resolved_rate import (
    ResolvedRateGait,
    trace_joint_path,
)

Array = npt.NDArray[np.float64]


# -- the trace ----------------------------------------------------------------------------------


class Arc:
    """A line along x that a joint follows by ``x = radius sin q``: singular at a quarter turn.

    A second joint moves along, with another weight, and its motion is no progress.
    """

    def __init__(self, length: float, radius: float = 1.0) -> None:
        self.length, self.radius = length, radius
        self.joint_scales, self.curvature_breaks = np.array([1.0, 0.25]), np.zeros(0)
        self.asked: list[float] = []

    def tangent(self, q: Array, X: Array, share: float) -> tuple[Array, Array, float]:
        self.asked.append(share)
        forward = math.copysign(1.0, math.cos(q[0]))
        omega = np.array([0.0, 0.0, 0.4 * forward])
        x, y, z, w = X
        X_rate = np.array([y * omega[2], -x * omega[2], w * omega[2], -z * omega[2]]) / 2
        return forward * np.array([1.0, 0.5]), X_rate, self.radius * abs(math.cos(q[0]))


def test_a_line_before_the_singularity_is_followed_to_its_end() -> None:
    arc: Any = Arc(0.5)
    path = trace_joint_path(arc, np.array([0.0, 0.2]), NEVER)
    assert path.is_complete
    assert path.path_fractions[-1] == 1.0
    assert path.shapes[-1] == pytest.approx([math.asin(0.5), 0.2 + 0.5 * math.asin(0.5)], abs=1e-7)
    assert path.arc_length[-1] == pytest.approx(math.asin(0.5), abs=1e-7)
    np.testing.assert_allclose(path.path_fractions, 2 * np.sin(path.shapes[:, 0]), atol=1e-7)
    np.testing.assert_allclose(path.progress_rate, np.cos(path.shapes[:, 0]), atol=1e-12)
    np.testing.assert_allclose(path.arc_length, path.shapes[:, 0], atol=1e-9)
    turned = [[0.0, 0.0, 0.4 * s] for s in path.arc_length]
    expected = Rotation.from_rotvec(turned)
    assert (expected.inv() * Rotation.from_quat(path.turns)).magnitude().max() < 1e-7
    np.testing.assert_allclose(np.linalg.norm(path.turns, axis=1), 1.0, atol=1e-14)
    np.testing.assert_allclose(np.diff(path.arc_length)[:26], 0.02, atol=1e-12)
    assert max(arc.asked) <= 1.0


def test_a_short_line_is_followed_in_twenty_steps() -> None:
    path = trace_joint_path(Arc(0.3, radius=2.0), np.zeros(2), NEVER)  # type: ignore[arg-type]
    np.testing.assert_allclose(np.diff(path.arc_length)[:19], 0.3 / 20 / 2.0, atol=1e-12)
    assert path.is_complete


def test_a_trace_ends_at_the_singularity_and_never_beyond() -> None:
    arc: Any = Arc(3.0, radius=1.5)
    path = trace_joint_path(arc, np.array([0.1, 0.0]), NEVER)
    assert not path.is_complete
    assert path.shapes[-1, 0] == pytest.approx(math.pi / 2, abs=1e-6)
    assert path.shapes[:, 0].max() <= math.pi / 2 + 1e-9
    assert path.path_fractions[-1] == pytest.approx((1.5 - 1.5 * math.sin(0.1)) / 3.0, abs=1e-7)
    assert 0.0 <= path.progress_rate[-1] <= 1e-8
    steps = np.diff(path.arc_length)
    assert np.all(steps > 0)
    # On the way there no step is longer than a quarter of what is left.
    left = math.pi / 2 - path.shapes[:-1, 0]
    near = (left < 0.1) & (left > 1e-3)
    assert near.sum() > 5
    assert np.all(steps[near] < 0.3 * left[near])
    assert np.all(steps[near] > 0.15 * left[near])


def test_the_path_up_to_a_place_has_that_place() -> None:
    path = trace_joint_path(Arc(0.5), np.zeros(2), NEVER)  # type: ignore[arg-type]
    part = path.truncated(3)
    assert [len(x) for x in vars(part).values()] == [4] * 5
    np.testing.assert_array_equal(part.shapes[-1], path.shapes[3])
    assert not part.is_complete


# -- ticks --------------------------------------------------------------------------------------


def test_a_robot_without_joints_moves_no_hand() -> None:
    link = """<link name="{}"><inertial><mass value="2"/>
      <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>"""
    joint = """<joint name="slide" type="prismatic"><parent link="hull"/><child link="rod"/>
      <limit lower="-1" upper="1" velocity="1" effort="1"/></joint>"""
    with pytest.raises(PlanningError, match="'stone' has no joints"):
        ResolvedRateGait.require_suitable(
            SpaceRobot.from_urdf(f'<robot name="stone">{link.format("hull")}</robot>')
        )
    parts = link.format("hull") + joint + link.format("rod")
    ResolvedRateGait.require_suitable(SpaceRobot.from_urdf(f'<robot name="one">{parts}</robot>'))
