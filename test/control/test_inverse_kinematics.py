"""Inverse kinematics with a base that stays: nearest shapes of an arm, and errors they leave."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.executive_loop import planar_manipulator

from spacerobot_ros.control.inverse_kinematics import FixedBaseArm, is_reached
from spacerobot_ros.model.description import Array, Pose

LINK = "end_effector"
LEVERS = np.array([0.5, 1.0, 1.0])


def turned(*rotvec: float) -> Array:
    return np.asarray(Rotation.from_rotvec(rotvec).as_matrix())


def end_position(base: Array, angle: float, shape: Array) -> Array:
    """Return the end of the planar arm (2,) by its three levers, whose angles add up."""
    angles = np.cumsum([angle, *shape])
    return base[:2] + np.array([LEVERS @ np.cos(angles), LEVERS @ np.sin(angles)])


@pytest.mark.parametrize(
    ("distance", "angle", "reached"),
    [
        *((2e-4, 4e-4, True), (2.01e-4, 0.0, False), (0.0, 4.01e-4, False)),
        *((0.0, 0.0, True), (1.9e-4, 3.9e-4, True)),
    ],
)
def test_an_arm_reaches_its_goal_within_a_fifth_of_a_millimetre(
    distance: float, angle: float, reached: bool
) -> None:
    assert is_reached(distance, angle) is reached


def test_the_errors_of_the_nearest_shape_are_in_metres_and_radians() -> None:
    """A planar arm stays in its plane, and its end at the tilt of its base."""
    base, q = Pose(np.eye(3), np.array([0.3, -0.2, 0.1])), np.zeros(2)
    arm = FixedBaseArm(planar_manipulator(), LINK, base)
    place = np.array([*end_position(base.r, 0.0, q), 0.1])
    lifted = Pose(turned(0.3, 0.0, 0.0), place + np.array([0.0, 0.0, 0.04]))
    _, distance, angle = arm.search_shape(q, lifted)
    assert distance == pytest.approx(0.04, abs=2e-3)
    assert angle == pytest.approx(0.3, abs=5e-3)
    shape, distance, angle = arm.search_shape(q, Pose(np.eye(3), place))
    assert max(distance, angle) < 1e-9
    np.testing.assert_array_equal(shape, q)


def test_the_shape_nearest_to_a_pose_out_of_reach_has_no_nearer_neighbour() -> None:
    q, base = np.array([0.3, -0.4]), Pose(turned(0.0, 0.0, 0.5), np.array([0.4, -0.2, 0.0]))
    arm = FixedBaseArm(planar_manipulator(), LINK, base)
    away = base.r + np.array([7.0, 0.0, 0.0])
    shape, distance, angle = arm.search_shape(q, Pose(base.R, away))
    again = arm.search_shape(q, Pose(base.R, away))
    np.testing.assert_array_equal(shape, again[0])
    left = away[:2] - end_position(base.r, 0.5, shape)
    assert distance == pytest.approx(float(np.linalg.norm(left)), rel=1e-6)
    assert angle == pytest.approx(abs(float(shape.sum())), rel=1e-6)
    weighted = distance**2 + (0.5 * angle) ** 2
    for step in 1e-3 * np.vstack([np.eye(2), -np.eye(2)]):
        left = away[:2] - end_position(base.r, 0.5, shape + step)
        assert left @ left + (0.5 * float((shape + step).sum())) ** 2 >= weighted - 1e-9


def test_the_derivative_of_the_error_is_that_of_finite_differences() -> None:
    """The base turns the errors of a small motion, and the axes that do not count are left out."""
    base = Pose(turned(0.2, -0.4, 0.5), np.array([0.4, -0.2, 0.3]))
    arm = FixedBaseArm(planar_manipulator(), LINK, base, ("x", "z", "rx", "ry", "rz"))
    q, step = np.array([0.7, -1.1]), 1e-6
    R_BE, r_BE = planar_manipulator().link_pose(LINK, q)
    goal = Pose(base.R @ R_BE, base.r + base.R @ r_BE)
    error, J = arm.error(q, goal)
    np.testing.assert_allclose(error, 0.0, atol=1e-12)
    changes = [arm.error(q + step * each, goal)[0] for each in np.eye(2)]
    np.testing.assert_allclose(J, -np.transpose(changes) / step, atol=2e-6)
    assert np.abs(J).min(axis=1).max() > 0.1


def test_from_the_present_shape_on_the_elbow_keeps_its_side() -> None:
    base = Pose()
    arm = FixedBaseArm(planar_manipulator(), LINK, base, ("x", "y"))
    for side in (1.0, -1.0):
        there = side * np.array([-0.5, 1.2])
        goal = Pose(r=np.array([*end_position(base.r, 0.0, there), 0.0]))
        shape, distance = arm.nearest_shape(there + np.array([0.3, -0.25]), goal)
        assert distance < 1e-4
        np.testing.assert_allclose(shape, there, atol=1e-3)
    beyond = Pose(r=np.array([3.0, 0.0, 0.0]))
    assert math.isclose(arm.nearest_shape(np.array([0.1, 0.1]), beyond)[1], 0.5, abs_tol=0.01)
