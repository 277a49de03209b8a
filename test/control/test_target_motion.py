"""Predictions of a free target against an independent integration, and paths beside it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from spacerobot_ros.control.state import PoseReference
from spacerobot_ros.control.target_motion import (
    FrameMotion,
    RelativeMotionOverTime,
    RelativePath,
    TorqueFreeMotion,
)
from spacerobot_ros.model.description import Array, Inertia, Pose
from spacerobot_ros.model.grasp import BodyMotion, TargetBody

INERTIA = np.array([[30.0, 2.0, -1.5], [2.0, 45.0, 3.0], [-1.5, 3.0, 22.0]])
GRAPPLE_R = Rotation.from_rotvec([0.4, -0.9, 0.3])
BODY = TargetBody(
    Inertia(200.0, np.array([0.1, -0.05, 0.2]), INERTIA),
    Pose(GRAPPLE_R.as_matrix(), np.array([-0.6, 0.3, 0.25])),
)
START = BodyMotion(
    Rotation.from_rotvec([0.2, 0.5, -1.1]).as_matrix(),
    np.array([2.5, -0.4, 0.7]),
    np.array([0.02, -0.01, 0.015]),
    np.array([0.06, -0.05, 0.03]),
)
TIMES = np.array([0.0, 0.7, 13.3, 61.9, 140.0])


def integrated(times: Array) -> tuple[Array, Array, Array]:
    """Return centre of mass, attitude and angular velocity (T) by scipy's DOP853."""

    def rate(_: float, x: Array) -> Array:
        R, w = x[:9].reshape(3, 3), x[9:]
        cross = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
        return np.concatenate(
            [(R @ cross).ravel(), np.linalg.solve(INERTIA, np.cross(INERTIA @ w, w))]
        )

    R0 = START.R_WT
    begin = np.concatenate([R0.ravel(), R0.T @ START.omega])
    found = solve_ivp(rate, (0, 150), begin, "DOP853", t_eval=times, rtol=1e-11, atol=1e-13).y.T
    arm = R0 @ BODY.inertia.com
    velocity = START.v + np.cross(START.omega, arm)
    return (
        START.r_WT + arm + times[:, None] * velocity,
        found[:, :9].reshape(-1, 3, 3),
        found[:, 9:],
    )


def test_the_grapple_frame_moves_as_an_independent_integration_has_it() -> None:
    centre, R, omega_T = integrated(TIMES)
    motion = TorqueFreeMotion(BODY, START).grapple(TIMES)
    arm = BODY.grapple.r - BODY.inertia.com
    np.testing.assert_allclose(motion.R, R @ GRAPPLE_R.as_matrix(), atol=2e-8)
    np.testing.assert_allclose(motion.r, centre + R @ arm, atol=2e-8)
    np.testing.assert_allclose(motion.omega, np.einsum("kij,kj->ki", R, omega_T), atol=1e-9)
    np.testing.assert_allclose(motion.body_motion(0).v, START.at(BODY.grapple).v, atol=1e-14)
    turned = np.linalg.norm(motion.R[3] - motion.R[0])
    assert turned > 1.0, "the target tumbles on the way"
    constant = START.r_WT + TIMES[3] * START.v
    assert np.linalg.norm(motion.r[3] - constant) > 0.3, "it is no motion at constant velocity"


def numerical(motion: FrameMotion, h: float) -> tuple[Array, Array, Array, Array]:
    """Return rates and accelerations in the middle of three samples."""
    v = (motion.r[2] - motion.r[0]) / (2 * h)
    a = (motion.r[2] - 2 * motion.r[1] + motion.r[0]) / h**2
    turn = Rotation.from_matrix(motion.R[2] @ motion.R[0].T).as_rotvec()
    return v, turn / (2 * h), a, (motion.omega[2] - motion.omega[0]) / (2 * h)


@pytest.mark.parametrize("time", [0.0, 3.3, 6.9])
def test_rates_and_accelerations_of_a_path_beside_the_target_are_those_of_its_poses(
    time: float,
) -> None:
    target, h = TorqueFreeMotion(BODY, START), 1e-3
    held = PoseReference(np.array([1.0, 0.2, 0.3]), np.array([0.0, 0.6, 0.0, 0.8]))
    begin = RelativeMotionOverTime.between(target.grapple([2.0]), FrameMotion.of_reference(held))
    path = RelativePath(begin, np.array([-0.3, 0.1, 0.05]), 7.0)
    times = np.array([time, time + h, time + 2 * h])
    motion = target.grapple(2.0 + times).with_relative_motion(path.at(times))
    v, omega, a, alpha = numerical(motion, h)
    np.testing.assert_allclose(motion.v[1], v, atol=1e-6)
    np.testing.assert_allclose(motion.omega[1], omega, atol=1e-6)
    np.testing.assert_allclose(motion.a[1], a, atol=1e-5)
    np.testing.assert_allclose(motion.alpha[1], alpha, atol=1e-5)


def test_a_path_begins_in_the_motion_of_the_held_pose_and_ends_with_the_grapple_frame() -> None:
    target = TorqueFreeMotion(BODY, START)
    held = PoseReference(
        np.array([1.0, 0.2, 0.3]),
        np.array([0.0, 0.6, 0.0, 0.8]),
        np.array([0.01, 0.02, -0.03]),
        np.array([0.05, -0.02, 0.01]),
        np.array([0.003, -0.002, 0.001]),
        np.array([-0.004, 0.002, 0.003]),
    )
    begin = RelativeMotionOverTime.between(target.grapple([2.0]), FrameMotion.of_reference(held))
    standoff = np.array([-0.3, 0.1, 0.05])
    path = RelativePath(begin, standoff, 7.0)
    first = target.grapple([2.0]).with_relative_motion(path.at([0.0]))
    for name in (
        "position",
        "velocity",
        "angular_velocity",
        "acceleration",
        "angular_acceleration",
    ):
        np.testing.assert_allclose(
            getattr(first.reference(), name), getattr(held, name), atol=1e-12, err_msg=name
        )
    assert abs(first.reference().quaternion @ held.quaternion) == pytest.approx(1.0, abs=1e-14)
    for end in (7.0, 9.5):
        grapple = target.grapple([2.0 + end])
        last = grapple.with_relative_motion(path.at([end]))
        np.testing.assert_allclose(last.R, grapple.R, atol=1e-14)
        np.testing.assert_allclose(last.omega, grapple.omega, atol=1e-14)
        np.testing.assert_allclose(last.r[0], grapple.r[0] + grapple.R[0] @ standoff, atol=1e-14)
        arm = grapple.R[0] @ standoff
        np.testing.assert_allclose(
            last.v[0], grapple.v[0] + np.cross(grapple.omega[0], arm), atol=1e-14
        )


def test_small_and_large_turns_have_one_formula() -> None:
    """Near no turn, where the functions of the angle are series, nothing jumps."""
    phidot, phiddot = np.array([[0.3, -0.2, 0.5]]), np.array([[-0.1, 0.4, 0.2]])
    zero = np.zeros((1, 3))
    direction = np.array([[0.6, 0.0, -0.8]])
    found = [
        RelativeMotionOverTime(zero, zero, zero, angle * direction, phidot, phiddot)
        for angle in (0.9999e-3, 1.0001e-3)
    ]
    for before, after in zip(found[0].rotation, found[1].rotation, strict=True):
        np.testing.assert_allclose(before, after, atol=1e-6)
