"""Goals: what is one, and when it is met."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from spacerobot_ros.errors import GoalError, PlanningError
from spacerobot_ros.model.rotations import quaternion_from_rotvec
from spacerobot_ros.planning import METHODS, Goal, PoseError, Tolerance
from spacerobot_ros.planning.core.goal import EndEffectorGoal


def test_methods_say_what_they_control() -> None:
    assert METHODS["square_path"].controls == {"attitude", "shape"}
    assert METHODS["lie_bracket"].controls == {"position", "attitude"}


def test_a_goal_is_judged_by_what_is_controlled() -> None:
    goal = Goal.checked([1, 0, 0], quaternion_from_rotvec([0, 0, 0.2]), [0.5, -0.5])
    here = np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0])
    error = PoseError.between(*here, goal, np.array([0.5, -0.4]))
    assert error.distance == 1.0
    assert error.angle == pytest.approx(0.2)
    assert error.max_joint_error == pytest.approx(0.1)
    for parts in itertools.chain.from_iterable(
        itertools.combinations(("position", "attitude", "shape"), k) for k in range(4)
    ):
        controls: Any = frozenset(parts)
        loose = {"position": 1.1, "attitude": 0.21, "shape": 0.11}
        assert Tolerance(**loose).admits(error, controls)
        for part in parts:
            assert not Tolerance(**{**loose, part: 0.05}).admits(error, controls)
    # Without a shape in the goal, or measured, no joint is wrong.
    assert PoseError.between(*here, goal).max_joint_error == 0.0
    unshaped = replace(goal, joint_positions=None)
    assert PoseError.between(*here, unshaped, np.ones(2)).max_joint_error == 0.0
    assert not Tolerance(0.5, 0.21).admits(error)


@pytest.mark.parametrize("part", ["position", "attitude", "shape"])
def test_each_part_of_a_goal_has_a_tolerance_of_its_own(part: str) -> None:
    names = ["position", "attitude", "shape"]
    # Each tolerance is once the smallest, once in the middle, once the largest of the three.
    for turn in range(3):
        values = np.roll([1e-3, 4e-3, 16e-3], turn)
        tolerance = Tolerance(**dict(zip(names, values.tolist(), strict=True)))
        for share, admitted in ((0.99, True), (1.01, False)):
            by = share * getattr(tolerance, part)
            error = {name: by * np.array([0.0, 0.0, name == part]) for name in names}
            remaining = PoseError(error["position"], error["attitude"], error["shape"])
            assert tolerance.admits(remaining, frozenset({"position", "attitude", "shape"})) is (
                admitted
            ), (tolerance, share)


@pytest.mark.parametrize(
    ("position", "quaternion", "mention"),
    [
        ([np.nan, 0, 0], [0, 0, 0, 1], "position"),
        ([0, 0, np.inf], [0, 0, 0, 1], "position"),
        ([0, 0, 0], [0, 0, np.nan, 1], "orientation"),
        ([0, 0, 0], [0, 0, 0, 0], "zero quaternion"),
        ([0, 0], [0, 0, 0, 1], "three numbers"),
        ([0, 0, 0], [0, 0, 1], "four"),
    ],
)
def test_what_is_no_pose_is_refused(
    position: list[float], quaternion: list[float], mention: str
) -> None:
    with pytest.raises(PlanningError, match=mention):
        Goal.checked(position, quaternion)


@pytest.mark.parametrize("shape", [[0.0, np.nan], [[0.0, 1.0]], 0.5])
def test_what_is_no_shape_is_refused(shape: npt.ArrayLike) -> None:
    with pytest.raises(PlanningError, match="goal shape"):
        Goal.checked([0, 0, 0], [0, 0, 0, 1], shape)


def test_a_goal_of_the_end_effector_without_a_name_is_refused_by_that() -> None:
    with pytest.raises(
        GoalError, match=r"^The goal of the end-effector is 2 number\(s\); it takes 3"
    ):
        EndEffectorGoal.checked("", [1.0, 0.0])
    with pytest.raises(GoalError, match=r"^The end-effector has 2 goals; it can have one\.$"):
        Goal.of_end_effectors([EndEffectorGoal.checked("", np.ones(3))] * 2)
