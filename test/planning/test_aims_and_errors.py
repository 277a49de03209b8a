"""Aims of plans for end-effectors, stamps and bounds of a path, and the time that was flown."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.planner_loop import TICK, robot_of

from spacerobot_ros.planning import BasePath, GaitSchedule, Goal, RobotState, Tolerance
from spacerobot_ros.planning.core.goal import EndEffectorGoal, PoseError
from spacerobot_ros.planning.execution.config import PlannerConfig
from spacerobot_ros.planning.execution.path_deviation import PathCheck
from spacerobot_ros.planning.execution.status import (
    PlannerState,
    PlannerStatus,
    manoeuvre_time,
)

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


def test_a_pose_of_a_path_is_due_within_half_a_tick_of_its_stamp() -> None:
    """Poses are two ticks apart; between them, and after the last, none is due."""
    tick = round(TICK * 1e9)
    check = checked_path()
    for stamp, due in (
        (-tick // 2 - 1, False),
        (-tick // 2, True),
        (tick // 2, True),
        (tick // 2 + 1, False),
        (2 * tick - tick // 2 - 1, False),
        (2 * tick, True),
        (20 * tick + tick // 2, True),
        (20 * tick + tick // 2 + 1, False),
    ):
        assert bool(check.due(BEGIN_NS + stamp)) is due, stamp


@pytest.mark.parametrize(
    ("off", "angle", "found"),
    [(0.5, 0.25, False), (0.51, 0.0, True), (0.0, 0.26, True), (0.51, 0.26, True)],
)
def test_a_path_is_left_beyond_either_bound(off: float, angle: float, found: bool) -> None:
    check = checked_path(drift_position=0.505, drift_attitude=0.255)
    assert check.due(BEGIN_NS)
    turned = END * Rotation.from_rotvec([angle, 0.0, 0.0])
    error = check.error(RobotState(np.array([0.0, off, 0.0]), turned.as_quat(), SHAPE))
    assert (error is not None) is found
    if error is not None:
        assert (error.distance, error.angle) == pytest.approx((off, angle))


@pytest.mark.parametrize(
    ("last", "end", "flown"),
    [
        # The planner counts whole schedules; the flight was cut off 1.5 s before the last one.
        ((PlannerState.EXECUTING, 10.0), 6.5, 8.5),
        ((PlannerState.EXECUTING, 10.0), 8.0, 10.0),
        ((PlannerState.EXECUTING, 10.0), 9.0, 10.0),
        ((PlannerState.REACHED, 10.0), 3.0, 10.0),
        # After an abort nothing is counted: the time since the beginning.
        ((PlannerState.ABORTED, 0.0), 30.0, 3.0),
        ((PlannerState.EXECUTING, 1.0), 4.5, 3.5),
        ((PlannerState.REFUSED, 10.0), 9.0, 4.0),
    ],
)
def test_the_time_that_was_flown_is_the_planners_count_less_what_was_cut_off(
    last: tuple[PlannerState, float], end: float, flown: float
) -> None:
    begun = PlannerStatus(PlannerState.EXECUTING, duration_s=4.0, manoeuvre_time_s=4.0)
    state, counted = last
    again = replace(begun, state=state, manoeuvre_time_s=counted)
    assert manoeuvre_time([(1.0, begun), (4.0, again)], end) == pytest.approx(flown)
    assert manoeuvre_time([(4.0, replace(begun, state=PlannerState.REFUSED))], end) is None


def test_the_worst_parts_of_an_error_are_named() -> None:
    hands = (
        PoseError(np.array([0.0, 3.0, 4.0]), np.array([0.0, 0.1, 0.0])),
        PoseError(np.array([0.0, 0.0, 1.0]), np.array([0.3, 0.4, 0.0])),
    )
    error = PoseError(np.array([2.0, 3.0, 6.0]), np.zeros(3), np.array([0.1, -0.7]), hands)
    assert (error.distance, error.angle, error.max_joint_error) == (7.0, 0.0, 0.7)
    assert error.largest_end_effector_distance == 5.0
    assert error.largest_end_effector_angle == 0.5
    alone = PoseError(np.zeros(3), np.zeros(3))
    assert (alone.max_joint_error, alone.largest_end_effector_distance) == (0.0, 0.0)
    assert alone.largest_end_effector_angle == 0.0
