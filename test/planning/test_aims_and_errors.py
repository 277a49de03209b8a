"""Aims of plans for end-effectors, stamps and bounds of a path, and the time that was flown."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.planner_loop import TICK, robot_of

from spacerobot_ros.planning import BasePath, GaitSchedule, Goal, Tolerance
from spacerobot_ros.planning.core.goal import EndEffectorGoal
from spacerobot_ros.planning.execution.config import PlannerConfig
from spacerobot_ros.planning.execution.path_deviation import PathCheck

ARM = robot_of("three_joint_arm")
SHAPE = np.array([0.2, -0.6, 1.3])
END = Rotation.from_rotvec([0.2, 0.0, 0.4])
PLACE = np.array([1.0, 2.0, 3.0])
BEGIN_NS = 7_000_000_000


def checked_path(ticks: int = 20, goal: Goal | None = None, **config: Any) -> PathCheck:
    """Return the check of a path to :data:`PLACE` with a pose every two ticks."""
    time = np.linspace(0.0, TICK * ticks, ticks // 2 + 1)
    places = np.linspace(0.0, 1.0, len(time))[:, np.newaxis] * PLACE
    path = BasePath(time, places, np.tile(END.as_quat(), (len(time), 1)))
    shapes = np.tile(SHAPE, (ticks + 1, 1))
    shapes[:2] += 0.2
    goal = goal or Goal(PLACE, END.as_quat())
    schedule = GaitSchedule("stub", ARM.joint_names, TICK, shapes, path, goal)
    return PathCheck(ARM, schedule, BEGIN_NS, PlannerConfig(**config), average=1)


def hand_of_arm() -> tuple[str, np.ndarray, Rotation]:
    """Return the last link, its position in the world and its attitude at the end of the path."""
    link = ARM.description.links[-1].name
    shape = dict(zip(ARM.joint_names, SHAPE.tolist(), strict=True))
    pose = ARM.description.with_locked(shape).frames[link][1]
    return link, PLACE + END.as_matrix() @ pose.r, END * Rotation.from_matrix(pose.R)


WITHIN = Tolerance(0.5, 0.1)


@pytest.mark.parametrize("turned", [True, False])
@pytest.mark.parametrize(
    ("share", "angle", "late", "left"),
    [
        (0.59, 0.059, False, None),
        (0.61, 0.02, False, (0.4, 0.02)),
        (0.3, 0.061, False, (0.3, 0.04)),
        (0.79, 0.079, True, None),
        (0.81, 0.081, True, (0.6, 0.06)),
    ],
)
def test_the_aim_for_an_end_effector_leaves_a_share_of_each_tolerance(
    share: float, angle: float, late: bool, left: tuple[float, float] | None, turned: bool
) -> None:
    link, r_WE, R_WE = hand_of_arm()
    wanted = R_WE * Rotation.from_rotvec([0.0, 0.0, angle])
    aim_at = r_WE + np.array([0.3, -0.4, 0.0]) * share
    hand = EndEffectorGoal(link, aim_at, wanted.as_quat() if turned else None)
    goal = Goal(PLACE, END.as_quat(), None, (hand,), frozenset())
    check = checked_path(goal=goal)
    assert check.due(BEGIN_NS)
    moved = check.shift_goal(goal, WITHIN, frozenset({"end_effectors"}), late=late)
    if left is None or (not turned and share < 0.6):
        assert moved is None
        return
    assert moved is not None
    (given,) = moved.end_effectors
    apart = aim_at - given.position
    np.testing.assert_allclose(apart, np.array([0.3, -0.4, 0.0]) * left[0], atol=1e-12)
    assert given.link == link
    if not turned:
        assert given.quaternion is None
        return
    assert given.quaternion is not None
    turn = Rotation.from_quat(given.quaternion).inv() * wanted
    np.testing.assert_allclose(turn.as_rotvec(), [0.0, 0.0, left[1]], atol=1e-9)
