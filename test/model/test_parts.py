"""Parts of models by themselves: integration steps, borders of rotations, and faces of meshes."""

from __future__ import annotations

import math

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from spacerobot_ros.errors import ParameterError
from spacerobot_ros.model import integration, meshes, rotations
from spacerobot_ros.model.description import Pose
from spacerobot_ros.model.integration import count_steps, repeat_step
from spacerobot_ros.model.kinematics import LinkPlacement


@pytest.mark.parametrize(
    ("period", "step", "count"),
    [
        (0.05, 0.01, 5),
        (0.05, 0.0099, 6),
        (0.05, 0.02, 3),
        (0.01, 0.05, 1),
        (0.3, 0.1, 3),
        (1e-12, 1.0, 1),
        (1.0 + 5e-10, 1.0, 1),
        (1.0 + 5e-9, 1.0, 2),
    ],
)
def test_a_period_has_the_least_number_of_steps(period: float, step: float, count: int) -> None:
    assert count_steps(period, step) == count


@pytest.mark.parametrize(
    ("period", "step", "sentence"),
    [
        (0.0, 0.1, "The control period must be positive, not 0.0 s."),
        (0.1, -0.1, "The integration step must be positive, not -0.1 s."),
        (math.inf, 0.1, "The control period must be positive, not inf s."),
        (0.1, math.nan, "The integration step must be positive, not nan s."),
    ],
)
def test_durations_are_positive(period: float, step: float, sentence: str) -> None:
    with pytest.raises(ParameterError) as refusal:
        count_steps(period, step)
    assert str(refusal.value) == sentence


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 6, 7, 11])
def test_a_step_is_repeated_as_often_as_wanted(count: int) -> None:
    x, a = ca.MX.sym("x", 2), ca.MX.sym("a")
    step = ca.Function("step", [x, a], [ca.vertcat(x[0] + a, 2 * x[1])], ["x", "a"], ["y"])
    found = np.array(repeat_step(step, count)([1.0, 1.0], 0.25)).ravel()
    assert found.tolist() == [1.0 + 0.25 * count, 2.0**count]


@pytest.mark.parametrize("with_p", [False, True])
def test_a_runge_kutta_step_is_of_fourth_order_and_scales_the_attitude(with_p: bool) -> None:
    """x' = c x has after h the Taylor polynomial of degree 4 of exp(c h)."""
    x, c, p = ca.MX.sym("x", 3), ca.MX.sym("c"), ca.MX.sym("p")
    names = ["x", "c", "p"] if with_p else ["x", "c"]
    inputs = [x, c, p] if with_p else [x, c]
    rate = ca.Function("a_rate", inputs, [c * x * (p if with_p else 1)], names, ["r"])
    step = integration.runge_kutta_step(rate, slice(1, 3))
    assert step.name() == "a_step"
    z = 0.5 * 0.4 * (3.0 if with_p else 1.0)
    more = [3.0] if with_p else []
    found = np.array(step([2.0, 3.0, 4.0], 0.5, 0.4, *more)).ravel()
    polynomial = 1 + z + z**2 / 2 + z**3 / 6 + z**4 / 24
    np.testing.assert_allclose(found, [2.0 * polynomial, 0.6, 0.8], rtol=1e-14)


@pytest.mark.parametrize("with_p", [False, True])
def test_attitudes_follow_from_rates_and_momenta(with_p: bool) -> None:
    """Against SciPy's integration of the same momentum, in rotation matrices."""
    q, p = ca.SX.sym("q", 2), ca.SX.sym("p")
    D = ca.diag(ca.vertcat(4 + q[0], 5.0, 6 - q[1])) * (p if with_p else 2.0)
    D_q = ca.horzcat(ca.vertcat(0.3, q[1], 0.1), ca.vertcat(0.2, -0.4, q[0]))
    function = ca.Function("locked", [q, p] if with_p else [q], [D, D_q])
    start, turned = np.array([0.3, -0.2]), Rotation.from_rotvec([0.4, -0.7, 0.2])
    qdot, L_W, h = np.array([0.5, -0.8]), np.array([1.0, -2.0, 0.5]), 0.05

    def rate(t: float, flat: np.ndarray) -> np.ndarray:
        R, shape = flat.reshape(3, 3), start + t * qdot
        inertia = 2.0 * np.diag([4 + shape[0], 5.0, 6 - shape[1]])
        moving = np.array([[0.3, 0.2], [shape[1], -0.4], [0.1, shape[0]]]) @ qdot
        x, y, z = np.linalg.solve(inertia, R.T @ L_W - moving)
        return np.asarray(R @ np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])).ravel()

    exact = solve_ivp(rate, (0, h), turned.as_matrix().ravel(), rtol=1e-12, atol=1e-13)
    step = integration.attitude_step(function)
    more = [2.0] if with_p else []
    found = np.array(step(np.append(start, turned.as_quat()), qdot, L_W, h, *more)).ravel()
    np.testing.assert_allclose(found[:2], start + h * qdot, rtol=1e-14)
    assert np.linalg.norm(found[2:]) == pytest.approx(1.0, abs=1e-14)
    R = Rotation.from_quat(found[2:]).as_matrix()
    np.testing.assert_allclose(R, exact.y[:, -1].reshape(3, 3), atol=1e-8)


@pytest.mark.parametrize("count", [1, 2, 5])
def test_attitudes_without_momentum_follow_from_rates_alone(count: int) -> None:
    """Against SciPy; and the numbers of steps that are told that the momentum is zero."""
    q, p = ca.SX.sym("q", 2), ca.SX.sym("p")
    D = ca.diag(ca.vertcat(4 + q[0], 5.0, 6 - q[1])) * p
    D_q = ca.horzcat(ca.vertcat(0.3, q[1], 0.1), ca.vertcat(0.2, -0.4, q[0]))
    locked = ca.Function("locked", [q, p], [D, D_q])
    start, turned = np.array([0.3, -0.2]), Rotation.from_rotvec([0.4, -0.7, 0.2])
    qdot, h, x = np.array([0.5, -0.8]), 0.05, np.append([0.3, -0.2], turned.as_quat())

    def rate(t: float, flat: np.ndarray) -> np.ndarray:
        shape = start + t * qdot
        columns = [[0.3, shape[1], 0.1], [0.2, -0.4, shape[0]]]
        moving = np.array(columns).T @ qdot / np.array([4 + shape[0], 5.0, 6 - shape[1]]) / 2.0
        return np.asarray(flat.reshape(3, 3) @ np.cross(-moving, np.eye(3)).T).ravel()

    exact = solve_ivp(rate, (0, h), turned.as_matrix().ravel(), rtol=1e-12, atol=1e-13)
    steps = integration.attitude_steps_without_momentum(locked, count)
    found = np.array(steps(x, qdot, h, 2.0)).ravel()
    R = Rotation.from_quat(found[2:]).as_matrix()
    np.testing.assert_allclose(R, exact.y[:, -1].reshape(3, 3), atol=1e-8)
    told = integration.repeat_step(integration.attitude_step(locked), count)
    expected = np.array(told(x, qdot, np.zeros(3), h / count, 2.0)).ravel()
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("axis", [[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 2, 2], [2, -1, 2]])
@pytest.mark.parametrize("angle", [1e-9, 0.3, math.pi / 2, 2.2, math.pi - 1e-9, math.pi])
def test_quaternions_of_matrices_keep_their_digits(axis: list[int], angle: float) -> None:
    turn = Rotation.from_rotvec(angle * np.array(axis) / np.linalg.norm(axis))
    found = rotations.quaternion_from_matrix(turn.as_matrix())
    assert abs(found @ turn.as_quat()) == pytest.approx(1.0, abs=1e-14)
    assert rotations.rotation_angles(turn.as_matrix()) == pytest.approx(angle, abs=1e-9)
    assert np.linalg.norm(found) == pytest.approx(1.0, abs=1e-14)


def test_frames_on_links_are_placed_in_the_world() -> None:
    """Against SciPy, at turns of which each of the four components is the largest."""
    rng = np.random.default_rng(5)
    turns = [Rotation.random(rng=rng) for _ in range(4)]
    turns += [Rotation.from_quat(np.roll([0.97, 0.2, -0.1, 0.05], k)) for k in range(4)]
    offsets = rng.normal(size=(8, 3))
    frames = [(k % 3, Pose(turns[k].as_matrix(), offsets[k])) for k in range(8)]
    frames.append((2, Pose()))
    placement = LinkPlacement(3, frames)
    for _ in range(20):
        base, links = Rotation.random(rng=rng), Rotation.random(3, rng=rng)
        r_WB, r_BL = rng.normal(size=3), rng.normal(size=(3, 3))
        link_R = np.hstack(list(links.as_matrix()))
        placement.update(np.append(r_WB, base.as_quat()), link_R, r_BL.T)
        for (link, pose), found in zip(frames, placement.poses, strict=True):
            position = r_WB + base.apply(r_BL[link] + links[link].apply(pose.r))
            np.testing.assert_allclose(found[:3], position, atol=1e-14)
            turn = base * links[link] * Rotation.from_matrix(pose.R)
            assert abs(found[3:] @ turn.as_quat()) == pytest.approx(1.0, abs=1e-14)


def test_rotation_vectors_of_the_smallest_turns_are_twice_their_quaternions() -> None:
    sines = [0.0, 1e-13, 1e-12, 3e-12, 1e-6]
    quaternions = np.array([[0.6 * s, 0.0, -0.8 * s, 1.0] for s in sines])
    wanted = [[1.2 * s, 0.0, -1.6 * s] for s in sines]
    np.testing.assert_allclose(rotations.rotvecs_from_quaternions(quaternions), wanted, rtol=1e-9)
    for quaternion, vector in zip(quaternions, wanted, strict=True):
        np.testing.assert_allclose(rotations.rotvec_from_quaternion(quaternion), vector, rtol=1e-9)
        np.testing.assert_allclose(rotations.rotvec_from_quaternion(-quaternion), vector, rtol=1e-9)
    half = np.array([[0.0, 1.0, 0.0, 0.0]])
    np.testing.assert_allclose(rotations.rotvecs_from_quaternions(half), [[0.0, math.pi, 0.0]])


def test_quaternions_may_have_any_size_but_none() -> None:
    for size in (1.1e-6, 1e-3, 1.0, 1e5, 1e200):
        found = rotations.unit_quaternion(size * np.array([0.0, 0.6, 0.0, -0.8]))
        np.testing.assert_allclose(found, [0.0, 0.6, 0.0, -0.8])
    for bad in ([0.0, 0.9e-6, 0.0, 0.0], [math.inf, 0.0, 0.0, 1.0], [0.0, math.nan, 0.0, 1.0]):
        with pytest.raises(ValueError, match=r"^the quaternion \[.*\] is not a rotation$"):
            rotations.unit_quaternion(bad)


def test_a_swing_is_what_is_left_beside_the_axes() -> None:
    x, y, z = np.eye(3)
    turn = rotations.quaternion_from_rotvec([0.6, 0.0, 0.0])
    for axes, angle in (
        (np.zeros((0, 3)), 0.6),
        (np.array([y]), 0.6),
        (np.array([x]), 0.0),
        (np.array([y, z]), 0.6),
        (np.array([z, x]), 0.0),
    ):
        assert rotations.swing_angle(turn, axes) == pytest.approx(angle, abs=1e-12)


def test_matrices_about_axes_and_products_of_many() -> None:
    axis = np.array([2.0, -1.0, 2.0]) / 3
    np.testing.assert_allclose(
        rotations.matrix_about_axis(axis, 0.7), Rotation.from_rotvec(0.7 * axis).as_matrix()
    )
    a, b = Rotation.random(5, random_state=1), Rotation.random(5, random_state=2)
    np.testing.assert_allclose(
        rotations.matrices_from_quaternions(a.as_quat().reshape(5, 1, 4))[:, 0], a.as_matrix()
    )
    product = rotations.quaternion_multiply(a.as_quat(), b.as_quat())
    np.testing.assert_allclose(rotations.matrices_from_quaternions(product), (a * b).as_matrix())
    np.testing.assert_allclose(
        rotations.quaternions_from_rotvecs(a.as_rotvec()),
        [rotations.quaternion_from_rotvec(vector) for vector in a.as_rotvec()],
    )


# -- meshes --------------------------------------------------------------------------------------


def test_equal_corners_are_one_whatever_the_sign_of_their_zeros() -> None:
    corners = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0], [-0.0, 0, 1], [0, 1, -0.0], [2, 2, 2]])
    mesh = meshes.mesh_from_corners(corners)
    assert len(mesh.vertices) == 4
    np.testing.assert_array_equal(mesh.vertices[mesh.faces].reshape(-1, 3), corners)
    none = meshes.mesh_from_corners(np.zeros((0, 3)))
    assert (none.vertices.shape, none.faces.shape) == ((0, 3), (0, 3))
