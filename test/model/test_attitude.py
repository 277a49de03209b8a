"""Attitude arithmetic against scipy's rotations, on whatever hypothesis comes up with."""

from __future__ import annotations

import math
from collections.abc import Callable

import casadi as ca
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from support.oracles import Array

from spacerobot_ros.model import symbolic_rotations as symbolic
from spacerobot_ros.model.rotations import (
    attitude_error,
    hat,
    matrix_about_axis,
    matrix_from_quaternion,
    matrix_from_rpy,
    quaternion_from_rotvec,
    quaternion_inverse,
    quaternion_multiply,
    rotvec_from_quaternion,
    rotvecs_from_quaternions,
    rpy_from_matrix,
    swing_angle,
    unit_quaternion,
)

# The same examples every time, however long one takes.
repeatable = settings(derandomize=True, deadline=None, max_examples=60)


def assert_near(actual: npt.ArrayLike, expected: npt.ArrayLike, within: float = 1e-14) -> None:
    assert np.shape(actual) == np.shape(expected)
    assert float(np.abs(np.subtract(actual, expected)).max()) <= within


def vectors(limit: float) -> st.SearchStrategy[Array]:
    return st.tuples(*3 * [st.floats(-limit, limit)]).map(np.array)


@st.composite
def rotation_vectors(draw: st.DrawFn) -> Array:
    """A rotation vector of any angle up to pi, tiny ones and ones just short of half a turn too."""
    direction = draw(vectors(1.0).filter(lambda v: np.linalg.norm(v) > 1e-3))
    angle = draw(
        st.one_of(
            st.floats(0.0, math.pi),
            st.floats(-16, -1).map(lambda e: 10**e),
            st.floats(-9, -1).map(lambda e: math.pi - 10**e),
        )
    )
    return np.asarray(angle * direction / np.linalg.norm(direction))


@st.composite
def quaternions(draw: st.DrawFn) -> Array:
    """A unit quaternion (x, y, z, w) of either sign."""
    q = Rotation.from_rotvec(draw(rotation_vectors())).as_quat()
    return np.asarray(q * draw(st.sampled_from([-1.0, 1.0])))


@repeatable
@given(a=vectors(1e3), b=vectors(1e3))
def test_hat_is_the_cross_product(a: Array, b: Array) -> None:
    assert np.array_equal(hat(a), -hat(a).T)
    assert_near(hat(a) @ b, np.cross(a, b), within=1e-9)


@repeatable
@given(rpy=vectors(7.0))
@example(rpy=np.array([0.3, math.pi / 2, 0.8]))
@example(rpy=np.array([0.3, -math.pi / 2, 0.8]))
def test_matrix_from_rpy_and_back(rpy: Array) -> None:
    # URDF: about the fixed axes x, y, z in that order.
    expected = Rotation.from_euler("xyz", rpy).as_matrix()
    assert_near(matrix_from_rpy(rpy), expected)
    # At a pitch of 90 deg the angles are badly conditioned, like the arcsine.
    assert_near(matrix_from_rpy(rpy_from_matrix(expected)), expected, within=2e-7)


@repeatable
@given(q=quaternions())
def test_matrix_from_quaternion(q: Array) -> None:
    assert_near(matrix_from_quaternion(q), Rotation.from_quat(q).as_matrix())


@repeatable
@given(a=quaternions(), b=quaternions())
def test_quaternion_product_is_the_product_of_rotations(a: Array, b: Array) -> None:
    expected = (Rotation.from_quat(a) * Rotation.from_quat(b)).as_matrix()
    product = quaternion_multiply(a, b)
    assert_near(np.linalg.norm(product), 1.0)
    assert_near(Rotation.from_quat(product).as_matrix(), expected)


@repeatable
@given(q=quaternions())
def test_quaternion_inverse(q: Array) -> None:
    expected = Rotation.from_quat(q).inv().as_matrix()
    inverse = quaternion_inverse(q)
    assert_near(Rotation.from_quat(inverse).as_matrix(), expected)
    assert_near(quaternion_multiply(q, inverse), [0, 0, 0, 1])


@repeatable
@given(vector=vectors(20.0))
def test_quaternion_from_rotvec(vector: Array) -> None:
    q = quaternion_from_rotvec(vector)
    assert_near(np.linalg.norm(q), 1.0)
    expected = Rotation.from_rotvec(vector).as_matrix()
    assert_near(Rotation.from_quat(q).as_matrix(), expected, within=1e-13)


@repeatable
@given(q=quaternions())
def test_rotvec_from_quaternion(q: Array) -> None:
    vector = rotvec_from_quaternion(q)
    assert np.linalg.norm(vector) <= math.pi + 1e-15
    expected = Rotation.from_quat(q).as_rotvec()
    # At half a turn both ends of the axis are right.
    if np.linalg.norm(expected) > math.pi - 1e-8 and np.dot(vector, expected) < 0:
        expected = -expected
    np.testing.assert_allclose(vector, expected, rtol=1e-12, atol=1e-15)


@repeatable
@given(a=quaternions(), b=quaternions())
def test_attitude_error_turns_one_attitude_into_the_other(a: Array, b: Array) -> None:
    error = attitude_error(a, b)
    assert np.linalg.norm(error) <= math.pi + 1e-15
    # In body components: the turn is applied on the right.
    reached = (Rotation.from_quat(a) * Rotation.from_rotvec(error)).as_matrix()
    assert_near(reached, Rotation.from_quat(b).as_matrix())


@repeatable
@given(q=quaternions(), scale=st.floats(1e-5, 1e5))
def test_unit_quaternion(q: Array, scale: float) -> None:
    assert_near(unit_quaternion(scale * q), q)


@pytest.mark.parametrize(
    "q", [[0, 0, 0, 0], [1e-9, 0, 0, 0], [0, 0, 0, math.nan], [math.inf, 0, 0, 1]]
)
def test_unit_quaternion_refuses_what_is_no_rotation(q: list[float]) -> None:
    with pytest.raises(ValueError, match="is not a rotation"):
        unit_quaternion(q)


@pytest.mark.slow
@repeatable
@given(st.lists(st.tuples(quaternions(), quaternions()), min_size=1, max_size=5))
def test_many_attitudes_at_once_are_what_they_are_one_by_one(
    pairs: list[tuple[Array, Array]],
) -> None:
    a, b = (np.array(each) for each in zip(*pairs, strict=True))
    products = quaternion_multiply(a, quaternion_inverse(b))
    assert_near(products, [quaternion_multiply(x, quaternion_inverse(y)) for x, y in pairs], 0.0)
    one = quaternion_multiply(a[0], b)
    assert_near(one, [quaternion_multiply(a[0], y) for y in b], 0.0)
    assert_near(rotvecs_from_quaternions(a), [rotvec_from_quaternion(x) for x in a])


@repeatable
@given(quaternions(), rotation_vectors().filter(lambda v: np.linalg.norm(v) > 1e-6))
def test_the_swing_is_what_no_twist_takes_away(quaternion: Array, about: Array) -> None:
    axis = about / np.linalg.norm(about)
    turn = Rotation.from_quat(quaternion)
    swing = swing_angle(quaternion, axis[np.newaxis])
    # Swing and twist take the axis where the whole rotation takes it.
    carried = float(np.clip(axis @ turn.apply(axis), -1.0, 1.0))
    assert math.cos(swing) == pytest.approx(carried, abs=1e-12)
    assert swing_angle(quaternion, np.empty((0, 3))) == pytest.approx(turn.magnitude(), abs=1e-7)
    assert swing_angle(quaternion, np.eye(3)) == pytest.approx(0.0, abs=1e-12)


# -- with symbols ------------------------------------------------------------------------------


def evaluated(build: Callable[..., ca.SX], *arguments: npt.ArrayLike) -> Array:
    """Return a symbolic function's value at numbers."""
    symbols = [ca.SX.sym(f"x{i}", np.size(x)) for i, x in enumerate(arguments)]
    return np.array(ca.Function("f", symbols, [build(*symbols)])(*arguments)).squeeze()


@repeatable
@given(quaternions(), quaternions(), vectors(3.0))
def test_symbolic_quaternions_agree_with_scipy(a: Array, b: Array, omega: Array) -> None:
    A, B = Rotation.from_quat(a), Rotation.from_quat(b)
    assert_near(evaluated(symbolic.matrix_from_quaternion, a), A.as_matrix())
    product = evaluated(symbolic.quaternion_multiply, a, b)
    assert_near(Rotation.from_quat(product).as_matrix(), (A * B).as_matrix())
    vector = evaluated(symbolic.relative_vector, a, b)
    assert abs(np.linalg.norm(vector) - math.sin((A.inv() * B).magnitude() / 2)) <= 1e-14
    h = 1e-5
    after, before = ((A * Rotation.from_rotvec(x * omega)).as_quat() for x in (h, -h))
    after, before = (x * np.sign(x @ a) for x in (after, before))
    assert_near(evaluated(symbolic.quaternion_rate, a, omega), (after - before) / (2 * h), 1e-8)


@repeatable
@given(rotation_vectors())
def test_symbolic_rotation_vectors_agree_with_scipy(rotvec: Array) -> None:
    turned = Rotation.from_rotvec(rotvec).as_matrix()
    quaternion = evaluated(symbolic.quaternion_from_rotvec, rotvec)
    assert_near(Rotation.from_quat(quaternion).as_matrix(), turned)
    small = evaluated(symbolic.quaternion_from_small_rotvec, rotvec / 10)
    exact = Rotation.from_rotvec(rotvec / 10).as_quat()
    assert_near(small, exact * np.sign(exact[3]), 1e-9)
    angle = float(np.linalg.norm(rotvec))
    if angle > 1e-9:
        axis = rotvec / angle
        assert_near(matrix_about_axis(axis, angle), turned)
        assert_near(evaluated(lambda x: symbolic.matrix_about_axis(axis, x), angle), turned)


@repeatable
@given(quaternions(), quaternions())
def test_the_symbolic_error_is_the_shortest_turn_in_world_components(a: Array, b: Array) -> None:
    error = evaluated(symbolic.rotation_error, a, b)
    assert np.linalg.norm(error) <= math.pi + 1e-12
    reached = Rotation.from_rotvec(error) * Rotation.from_quat(a)
    assert_near(reached.as_matrix(), Rotation.from_quat(b).as_matrix(), 1e-13)
