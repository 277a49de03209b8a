"""Shapes at which end-effectors are at their goals: where their search begins, and its steps.

Rows and inverse kinematics are stand-ins, so that each count and share is a number of the test.
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from spacerobot_ros.errors import NotFoundError
from spacerobot_ros.planning.methods.optimal.end_effectors import EndEffectorSpecification
from spacerobot_ros.planning.methods.optimal.problem import MotionLimits

Array = npt.NDArray[np.float64]

START = np.array([0.2, -0.4])
IDENTITY = np.array([0.0, 0.0, 0.0, 1.0])
TURN = np.array([0.0, 0.6, 0.0, 0.8])
"""That of the base on any way of the stand-in."""
LIMITS = MotionLimits(
    np.array([-1.0, -2.0]), np.array([1.4, 3.0]), np.array([0.5, np.inf]), np.array([1.0, 1.0])
)
MIDDLE, HALF = np.array([0.2, 0.5]), np.array([1.2, 2.5])


def specification(*, attitude: bool = False, rows: Any = None) -> Any:
    """Return a specification with stand-ins for its rows."""
    made: Any = object.__new__(EndEffectorSpecification)
    robot = SimpleNamespace(description=SimpleNamespace(name="stand-in"))
    rows = rows or SimpleNamespace(
        robot=robot,
        links=[("left", True), ("right", False)],
        turns_along_direct_path=lambda start, shapes: np.tile(TURN, (len(shapes), 1)),
    )
    parts = {"rows": rows, "attitude": attitude, "overdetermined": False}
    for name, value in parts.items():
        object.__setattr__(made, name, value)
    return made


class Kinematics:
    """Answers of inverse kinematics, one after the other, and the questions."""

    def __init__(self, *answers: tuple[list[list[float]], list[float]]) -> None:
        self.answers = list(answers)
        self.asked: list[tuple[Array, Any, bool]] = []

    def __call__(
        self, shapes: Array, start: Array, limits: Any, parameters: Any, turns: Any, *, fixed: bool
    ) -> tuple[Array, Array, Array]:
        assert start is START
        assert limits is LIMITS
        assert parameters == "goals"
        self.asked.append((shapes, turns, fixed))
        ends, miss = self.answers.pop(0) if self.answers else ([[0.0, 0.0]], [0.5])
        turns = np.tile(IDENTITY, (len(ends), 1)) + np.arange(float(len(ends)))[:, np.newaxis]
        return np.array(ends), turns, np.array(miss)


def ends_of(kinematics: Kinematics, *, attitude: bool = False) -> Any:
    made = specification(attitude=attitude)
    object.__setattr__(made, "_inverse_kinematics", kinematics)
    return made._find_possible_ends(START, LIMITS, "goals", IDENTITY)


def test_ends_are_sought_from_the_start_from_nearby_and_from_anywhere() -> None:
    kinematics = Kinematics(([[0.0, 0.0]], [0.7]), ([[0.0, 0.0]], [0.3]), ([[0.0, 0.0]], [0.4]))
    with pytest.raises(NotFoundError) as refusal:
        ends_of(kinematics)
    assert str(refusal.value).startswith(
        "No shape of robot 'stand-in' that puts 'left' and 'right' to the goal was found from 128 "
        "shapes; the nearest is 0.3 m or rad away."
    )
    assert [len(shapes) for shapes, _, _ in kinematics.asked] == [16, 16, 96]
    # First the base follows from the joints; then loops may turn it further.
    (_, follows, _), *others = kinematics.asked
    assert follows is None
    for shapes, turns, _ in others:
        np.testing.assert_array_equal(turns, np.tile(TURN, (len(shapes), 1)))
    assert not any(fixed for _, _, fixed in kinematics.asked)
    rng = np.random.default_rng(0)
    for shapes, _, _ in kinematics.asked:
        anywhere = MIDDLE + HALF * rng.uniform(-1, 1, shapes.shape)
        share = np.arange(len(shapes))[:, np.newaxis] / (len(shapes) - 1)
        np.testing.assert_allclose(shapes, START + share * (anywhere - START), atol=1e-12)


def test_a_given_attitude_of_the_base_is_that_of_all_ends() -> None:
    kinematics = Kinematics()
    with pytest.raises(NotFoundError):
        ends_of(kinematics, attitude=True)
    for shapes, turns, fixed in kinematics.asked:
        np.testing.assert_array_equal(turns, np.tile(IDENTITY, (len(shapes), 1)))
        assert fixed


def test_ends_that_are_soonest_reached_come_first_and_same_ones_once() -> None:
    shapes = [
        [0.8, -0.4],  # 0.6 rad at 0.5 rad/s: 1.2 s.
        [0.2, 0.6],  # 1 rad of a joint without limit, at half of its range a second: 0.4 s.
        [0.25, 0.65],  # 0.042 and 0.02 of the ranges from the one before.
        [0.2, 0.74],  # 0.056 of its range: another one, 0.456 s.
        [0.1, -0.4],  # 0.2 s, but it is not at the goal.
        [0.3, -0.4],  # 0.2 s.
    ]
    kinematics = Kinematics((shapes, [1e-3, 1.9e-3, 1e-9, 2e-3, 2.1e-3, 0.0]))
    found = ends_of(kinematics)
    assert [end.shape.tolist() for end in found] == [shapes[k] for k in (5, 1, 3, 0)]
    assert [end.base_rotation[0] for end in found] == [5.0, 1.0, 3.0, 0.0]
    assert len(kinematics.asked) == 1


def test_there_are_at_most_six_ends() -> None:
    kinematics = Kinematics(([[0.2 + 0.1 * k, -0.4] for k in range(9)], [0.0] * 9))
    assert [end.shape[0] for end in ends_of(kinematics)] == pytest.approx(
        [0.2, 0.3, 0.4, 0.5, 0.6, 0.7]
    )


class Plane:
    """Rows of a point that two joints move by ``A q`` and the base by ``turn`` about z."""

    A = np.array([[1.0, 0.3], [-0.2, 0.8]])
    axes = np.array([[0.0, 0.0, 1.0]])

    def __init__(self, turns: bool = False) -> None:
        self.turns, self.steps, self.columns = turns, 0, 2
        self.robot = SimpleNamespace(function=lambda *_, **__: self.connection)

    def connection(self, _: Array) -> Any:
        return SimpleNamespace(full=lambda: np.zeros((6, self.columns)))

    def turns_along_direct_path(self, start: Array, shapes: Array) -> Array:
        self.columns = 2 * len(shapes)
        return np.tile(IDENTITY, (len(shapes), 1))

    def evaluate(self, X: Array, shapes: Array, goal: Array) -> tuple[Array, Array, Array]:
        self.steps += 1
        angle = Rotation.from_quat(X).as_rotvec()[:, 2:]
        lever = np.array([0.0, 0.5]) if self.turns else np.zeros(2)
        values = shapes @ self.A.T + angle * lever - goal
        by_rotation = np.tile(np.array([[0, 0, x] for x in lever]), (len(shapes), 1, 1))
        return values, by_rotation, np.tile(self.A, (len(shapes), 1, 1))


def solved(
    rows: Plane, goal: Array, first: list[list[float]], turn: Array | None, *, fixed: bool
) -> tuple[Array, Array, Array]:
    turns = None if turn is None else np.tile(turn, (len(first), 1))
    found = specification(rows=rows)._inverse_kinematics(
        np.array(first), START, LIMITS, goal, turns, fixed=fixed
    )
    return found[0], found[1], found[2]


@pytest.mark.parametrize("turn", [IDENTITY, None])
def test_steps_of_inverse_kinematics_are_those_of_newton(turn: Any) -> None:
    rows, end = Plane(), np.array([0.6, 0.1])
    shapes, X, miss = solved(rows, rows.A @ end, [[0.2, -0.3], [0.5, 0.4]], turn, fixed=True)
    np.testing.assert_allclose(shapes, [end, end], atol=1e-3)
    np.testing.assert_array_equal(X, [IDENTITY, IDENTITY])
    assert np.all(miss <= 2e-4)
    # Linear rows: a step or two, and a look at its result twice.
    assert rows.steps <= 4


def test_steps_are_no_longer_than_half_a_radian() -> None:
    rows, end = Plane(), np.array([1.3, 2.9])
    shapes, _, _ = solved(rows, rows.A @ end, [[-0.9, -1.9]], IDENTITY, fixed=True)
    np.testing.assert_allclose(shapes, [end], atol=1e-3)
    # 4.8 rad of the second joint take ten steps of 0.5 rad, and two more looks.
    assert 11 <= rows.steps <= 14


def test_joints_at_their_limits_leave_the_rest_to_others() -> None:
    """The goal is 0.3 rad beyond the first joint: the second one comes as near as it can."""
    rows, beyond = Plane(), np.array([1.7, 0.5])
    shapes, _, miss = solved(rows, rows.A @ beyond, [[1.4, 0.2], [0.0, 0.1]], IDENTITY, fixed=True)
    column = rows.A[:, 1]
    best = 0.5 + column @ rows.A[:, 0] * 0.3 / (column @ column)
    np.testing.assert_allclose(shapes, [[1.4, best], [1.4, best]], atol=1e-3)
    residual = rows.A @ np.array([1.4, best]) - rows.A @ beyond
    np.testing.assert_allclose(miss, np.abs(residual).max(), atol=1e-3)
    below = np.array([-1.2, 0.5])
    shapes, _, _ = solved(rows, rows.A @ below, [[-1.0, 0.2]], IDENTITY, fixed=True)
    best = 0.5 - column @ rows.A[:, 0] * 0.2 / (column @ column)
    np.testing.assert_allclose(shapes, [[-1.0, best]], atol=1e-3)


def test_a_base_that_loops_turn_helps_where_nothing_is_given() -> None:
    rows = Plane(turns=True)
    goal = np.array([0.5, 2.8])
    shapes, X, miss = solved(rows, goal, [[0.2, 0.1]], IDENTITY, fixed=False)
    assert miss[0] <= 2e-4
    angle = Rotation.from_quat(X[0]).as_rotvec()
    np.testing.assert_allclose(
        shapes[0] @ rows.A.T + angle[2] * np.array([0, 0.5]), goal, atol=1e-3
    )
    # The least motion of all: along the rows.
    J = np.column_stack([rows.A, [0.0, 0.5]])
    least = np.linalg.pinv(J) @ (goal - rows.A @ np.array([0.2, 0.1]))
    np.testing.assert_allclose([*(shapes[0] - [0.2, 0.1]), angle[2]], least, atol=2e-3)
