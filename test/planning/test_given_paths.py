"""Given paths of an end-effector with the base free, and the polylines that they are."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from planning.test_resolved_rate import ARM, ATTITUDE, HAND, PERIOD, PLACE, hand, method_of
from scipy.spatial.transform import Rotation, Slerp
from support.planner_loop import robot_of
from support.planners import assert_within

from spacerobot_ros.errors import GoalError, PlanningError
from spacerobot_ros.model.description import Array
from spacerobot_ros.planning import Goal, RobotState, Tolerance, plan
from spacerobot_ros.planning.core.goal import MAX_PATH_POSES, EndEffectorGoal
from spacerobot_ros.planning.core.method import PlanRequest
from spacerobot_ros.planning.core.schedule import GaitSchedule
from spacerobot_ros.planning.execution.goal_file import IdentifiedGoal
from spacerobot_ros.planning.execution.status import PlannerState, PlannerStatus
from spacerobot_ros.planning.methods.pose_path import PosePath, RoundedPath
from spacerobot_ros.planning.methods.resolved_rate import PathProgress

STILL = np.array([0.0, 0.0, 0.0, 1.0])
CORNER = np.array([[1.0, -2.0, 0.5], [1.0, -1.6, 0.8], [1.3, -1.6, 0.8], [1.3, -1.2, 0.4]])
TURNS = Rotation.from_rotvec([[0.1, 0.2, 0.3], [0.4, 0.2, 0.3], [0.4, 0.1, -0.2], [0.4, 0.1, -0.2]])


def at_rest(points: Any) -> PosePath:
    places = np.asarray(points, dtype=float)
    return PosePath.from_poses(places, np.tile(STILL, (len(places), 1)))


def turning() -> PosePath:
    return PosePath.from_poses(CORNER, TURNS.as_quat())


def distance_from(lines: Array, place: Array) -> float:
    """Return the distance of a place (n,) from a polyline (K, n)."""
    legs = np.diff(lines, axis=0)
    lengths = np.maximum((legs**2).sum(axis=1), 1e-30)
    share = np.clip(((place - lines[:-1]) * legs).sum(axis=1) / lengths, 0.0, 1.0)
    nearest = lines[:-1] + share[:, np.newaxis] * legs
    return float(np.linalg.norm(place - nearest, axis=1).min())


# -- lines --------------------------------------------------------------------------------------


def test_lengths_are_metres_and_radians_together() -> None:
    path = turning()
    turned = [(TURNS[k + 1] * TURNS[k].inv()).as_rotvec() for k in range(3)]
    np.testing.assert_allclose(path.turns, turned, atol=1e-12)
    np.testing.assert_allclose(path.chords, np.diff(CORNER, axis=0))
    expected: Any = [0.5 + np.linalg.norm(turned[0]), 0.3 + np.linalg.norm(turned[1]), 0.4 * 2**0.5]
    np.testing.assert_allclose(path.lengths, expected, atol=1e-12)
    np.testing.assert_allclose(path.lengths_at_poses, [0.0, *np.cumsum(expected)], atol=1e-12)


def test_equal_poses_in_succession_are_one() -> None:
    path = at_rest([[0, 0, 1], [0, 0, 1], [0, 2, 1], [0, 2, 1 + 5e-11], [0, 0, 1]])
    np.testing.assert_array_equal(path.positions[:, 1], [0, 2, 0])
    turned = PosePath.from_poses(CORNER[[0, 0]], TURNS.as_quat()[:2])
    assert len(turned.positions) == 2


def test_the_rest_of_a_path_begins_within_a_line() -> None:
    path = turning()
    rest = path.remaining_after(path.lengths_at_poses[1] + 0.25 * path.lengths[1])
    np.testing.assert_allclose(rest.positions[0], [1.075, -1.6, 0.8], atol=1e-12)
    np.testing.assert_allclose(rest.positions[1:], CORNER[2:])
    wanted = Slerp([0.0, 1.0], TURNS[1:3])(0.25)
    assert (wanted.inv() * Rotation.from_quat(rest.quaternions[0])).magnitude() < 1e-12
    assert len(path.remaining_after(path.lengths_at_poses[2]).positions) == 2
    for beyond in (path.lengths_at_poses[-1], 99.0):
        end = path.remaining_after(beyond)
        np.testing.assert_allclose(end.positions, CORNER[3:], atol=1e-12)
    np.testing.assert_allclose(path.remaining_after(-1.0).positions, CORNER)
    assert end.remaining_after(3.0) is end


# -- fewer poses --------------------------------------------------------------------------------


def test_poses_on_a_line_are_left_out_and_corners_stay() -> None:
    share = np.linspace(0, 1, 11)[:, np.newaxis]
    points = np.vstack([CORNER[0] + share * (CORNER[1] - CORNER[0]), CORNER[2:]])
    np.testing.assert_allclose(at_rest(points).simplified(0.0).positions, CORNER, atol=1e-12)
    bent = at_rest([[0, 0, 0], [1, 0.01, 0], [2, 0, 0]])
    assert len(bent.simplified(0.0099).positions) == 3
    assert len(bent.simplified(0.0101).positions) == 2


def test_attitudes_and_ways_back_count_as_corners() -> None:
    there_and_back = at_rest([[0, 0, 0], [1, 0, 0], [0.5, 0, 0]])
    assert len(there_and_back.simplified(0.1).positions) == 3
    turned = Rotation.from_rotvec([[0, 0, 0], [0, 0, 0.3], [0, 0, 0.2]]).as_quat()
    path = PosePath.from_poses(np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]]), turned)
    # Halfway in metres and radians together the line has turned by 0.13 rad.
    assert len(path.simplified(0.15).positions) == 3
    assert len(path.simplified(0.25).positions) == 2


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0.01, 0.3))
def test_simplified_paths_keep_near_all_poses(seed: int, tolerance: float) -> None:
    points = np.random.default_rng(seed).normal(size=(20, 3)).cumsum(axis=0) * 0.1
    lines = at_rest(points).simplified(tolerance).positions
    assert max(distance_from(lines, each) for each in points) <= tolerance + 1e-12
    np.testing.assert_array_equal(lines[[0, -1]], points[[0, -1]])


def test_too_many_corners_are_refused() -> None:
    zigzag = np.zeros((503, 3))
    zigzag[:, 0], zigzag[1::2, 1] = np.arange(503), 1.0
    with pytest.raises(
        PlanningError, match=r"^The path has more than 500 corners: give fewer poses"
    ):
        at_rest(zigzag).simplified(0.1)
    assert len(at_rest(zigzag[:502]).simplified(0.1).positions) == 502


# -- stops --------------------------------------------------------------------------------------


def test_the_motion_stops_at_sharp_corners_and_without_a_tolerance_at_all() -> None:
    path = at_rest([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0.4, 0.1, 0], [0.4, 0.1, 2]])
    # Corners of 90, 124 and 90 degrees.
    assert [len(x.positions) for x in path.split_at_reversals(0.01)] == [3, 3]
    np.testing.assert_array_equal(
        [x.positions[0] for x in path.split_at_reversals(0.01)], [[0, 0, 0], [1, 1, 0]]
    )
    assert [len(x.positions) for x in path.split_at_reversals(0.0)] == [2] * 4
    gentle = at_rest([[0, 0, 0], [1, 0, 0], [0.51, 0.85, 0]])  # 119.95 degrees.
    assert [len(x.positions) for x in gentle.split_at_reversals(0.01)] == [3]


# -- rounded ways -------------------------------------------------------------------------------


def test_a_blend_is_a_parabola_between_both_lines() -> None:
    path, tolerance = at_rest(CORNER[:3]), 0.03
    way = RoundedPath(path, tolerance, before=0.2, whole=7.0)
    d, total = 4 * tolerance, 0.8
    to, on = np.array([0.0, 0.8, 0.6]), np.array([1.0, 0.0, 0.0])
    for s in (0.1, 0.5 - d, 0.45, 0.5, 0.57, 0.5 + d, 0.8):
        t = np.clip((s - 0.5 + d) / (2 * d), 0.0, 1.0)
        place = 0.5 * to - d * (1 - t) ** 2 * to + d * t**2 * on
        if s < 0.5 - d:
            place = s * to
        if s > 0.5 + d:
            place = 0.5 * to + (s - 0.5) * on
        np.testing.assert_allclose(way.pose(s / total)[0], place, atol=1e-12)
    np.testing.assert_allclose(
        way.curvature_breaks * total, 0.5 + d * np.linspace(-1, 1, 5), atol=1e-12
    )
    assert (way.total_length, way.is_straight) == (7.0, False)
    assert way.travelled_length(0.5) == pytest.approx(0.6)
    assert RoundedPath(at_rest(CORNER[:2]), 0.1).is_straight
    assert RoundedPath(at_rest(CORNER[:2]), 0.1).total_length == pytest.approx(0.5)
    # Blends meet halfway on a short line.
    narrow = RoundedPath(path, 0.05)
    np.testing.assert_allclose(narrow.curvature_breaks[[0, -1]] * total, [0.35, 0.65], atol=1e-12)


@pytest.mark.parametrize("tolerance", [0.01, 0.2])
def test_rates_are_derivatives_and_corners_are_rounded(tolerance: float) -> None:
    path = turning()
    way, h = RoundedPath(path, tolerance), 1e-6
    shares = np.concatenate([np.linspace(0.003, 0.997, 40), way.curvature_breaks])
    for share in shares:
        (before, turned), (after, turned_on) = way.pose(share - h), way.pose(share + h)
        velocity, omega = way.derivative(share)
        np.testing.assert_allclose(velocity, (after - before) / (2 * h), atol=1e-3)
        spin = Rotation.from_quat(turned_on) * Rotation.from_quat(turned).inv()
        np.testing.assert_allclose(omega, spin.as_rotvec() / (2 * h), atol=1e-3)
    off = [distance_from(CORNER - CORNER[0], way.pose(share)[0]) for share in shares]
    assert max(off) <= tolerance
    place, turned = way.pose(1.0)
    np.testing.assert_allclose(place, CORNER[3] - CORNER[0], atol=1e-12)
    assert ((Rotation.from_quat(turned) * TURNS[0]).inv() * TURNS[3]).magnitude() < 1e-12
    np.testing.assert_allclose(way.pose(0.0)[1], STILL, atol=1e-15)


# -- given paths of an end-effector with the base free, held against Pinocchio's momentum --------


WAY = np.array([[0.05, 0.0, 0.02], [0.12, -0.1, 0.03], [0.02, -0.06, 0.1]])
"""From the start of the arm, m: the corner at the second is sharp."""
SHORT = np.array([[1.0, 1.0, 1.0], [1.0, 1.0, 1.1]])
STATE = RobotState(PLACE, ATTITUDE.as_quat(), ARM)
NEAR = Tolerance(1e-6, 1e-6)


@pytest.fixture(scope="module")
def start() -> Array:
    return hand(ARM[np.newaxis])[0]


@pytest.fixture(scope="module")
def flown(start: Array) -> GaitSchedule:
    return plan(
        "three_joint_arm",
        end_effector_path=start + WAY,
        start=STATE,
        control_period=PERIOD,
        corner_tolerance=0.02,
    )


@pytest.mark.slow
def test_the_hand_keeps_to_the_lines_within_the_tolerance(
    start: Array, flown: GaitSchedule
) -> None:
    lines, off, places = np.vstack([start, start + WAY]), [], []
    for tick in range(0, flown.ticks + 1, 3):
        shapes = flown.positions[: tick + 1]
        if tick:  # In the middle of a held command.
            shapes = np.vstack([shapes[:-1], shapes[-2:].mean(axis=0)])
        places.append(hand(shapes)[0])
        off.append(distance_from(lines, places[-1]))
    assert 0.002 < max(off) < 0.02
    near = [np.linalg.norm(np.array(places) - each, axis=1).min() for each in lines]
    assert max(near) < 0.03
    end = hand(flown.positions)[0]
    np.testing.assert_allclose(end, start + WAY[-1], atol=1e-8)


def test_the_limits_of_the_joints_are_kept_on_the_way(flown: GaitSchedule) -> None:
    limit = robot_of("three_joint_arm").velocity_limit
    assert_within(flown, limit, limit / 0.5)
    assert flown.method == "resolved_rate"
    assert float(str(flown.notes["least"])) <= float(str(flown.notes["at_start"]))


def test_the_hand_rests_at_a_sharp_corner_and_goes_on(start: Array, flown: GaitSchedule) -> None:
    # The sum of the squares of the rates is least there, but for the ends.
    speeds = np.linalg.norm(flown.velocities, axis=1)
    inner = np.arange(3, len(speeds) - 3)
    slowest = int(inner[np.argmin(speeds[inner])])
    there = [
        np.linalg.norm(hand(flown.positions[: k + 1])[0] - (start + WAY[1]))
        for k in (slowest, slowest + 1)
    ]
    assert min(there) < 1e-8


def test_a_hand_at_the_end_of_its_rest_stays(start: Array) -> None:
    aim = EndEffectorGoal.along(HAND, [start, start])
    goal = Goal.of_end_effectors([aim]).for_robot(robot_of("three_joint_arm").description)
    assert method_of().plan(PlanRequest(STATE, goal, NEAR)).ticks == 0


def test_auto_takes_the_method_that_follows_paths(start: Array) -> None:
    path = start + np.array([[0.0, 0.0, 0.0], [0.004, 0.0, 0.003]])
    schedule = plan("three_joint_arm", end_effector_path={HAND: path}, start=STATE, method="auto")
    assert schedule.method == "resolved_rate"
    assert str(schedule.notes["because"]).endswith(
        "is the only method that can plan for this goal."
    )


# -- refusals -----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["optimal", "area_loop"])
def test_another_method_refuses_before_it_plans(name: str) -> None:
    with pytest.raises(PlanningError, match=f"^{name} does not follow paths, but 'end_effector'"):
        plan("three_joint_arm", end_effector_path=SHORT, method=name)


def test_one_end_effector_follows_a_path_and_the_base_is_free() -> None:
    paths = {HAND: SHORT}
    with pytest.raises(PlanningError, match="moves one end-effector along a path, but the goal is"):
        plan(
            "three_joint_arm", end_effector_path=paths, end_effector_position={"link_3": [1, 1, 1]}
        )
    with pytest.raises(PlanningError, match="also requests the pose of the base"):
        plan("three_joint_arm", end_effector_path=paths, position=[0, 0, 0])
    with pytest.raises(GoalError, match="has 2 goals; only one is allowed"):
        plan("three_joint_arm", end_effector_path=paths, end_effector_position={HAND: [1, 1, 1]})


@pytest.mark.parametrize(
    ("path", "message"),
    [
        ([], "The path of 'hand' has no poses."),
        (np.zeros((0, 7)), "The path of 'hand' has no poses."),
        ([1.0, 2.0, 3.0], r"The path of 'hand' has shape \(3,\); each of its poses must have 3"),
        (np.ones((3, 4)), r"has shape \(3, 4\)"),
        (np.ones((2, 3, 3)), r"has shape \(2, 3, 3\)"),
        (np.zeros((MAX_PATH_POSES + 1, 3)), "has 10001 poses; at most 10000 are allowed."),
        (
            [[0, 0, 0], [0, np.nan, 0]],
            r"Pose 2 of the path of 'hand' is invalid: .* \[0.0, nan, 0.0\] is not finite",
        ),
        ([[0, 0, 0], [0, 0, 0], [2e12, 0, 0]], "Pose 3 of .* more than 1e\\+12 m from the origin"),
        ([[0, 0, 0, 0, 0, 0, 1], [1, 0, 0, 0, 0, 0, 0]], "Pose 2 of .* is a zero quaternion"),
        ("there", "The goal path of 'hand' 'there' is not a list of numbers"),
    ],
)
def test_paths_that_are_none_are_refused(path: Any, message: str) -> None:
    with pytest.raises(GoalError, match=message):
        EndEffectorGoal.along("hand", path)


# -- paths as goals -----------------------------------------------------------------------------


def test_a_path_is_a_goal_with_waypoints() -> None:
    aim = EndEffectorGoal.along("hand", [[1, 2, 3, 0, 0, 2, 0], [4, 5, 6, 0, 0, 0, -5]])
    assert aim.quaternion is not None
    np.testing.assert_array_equal(aim.quaternion, [0, 0, 0, -1])
    np.testing.assert_array_equal(aim.waypoints, [[1, 2, 3, 0, 0, 1, 0]])
    np.testing.assert_array_equal(aim.path_values[1], aim.values)
    one = EndEffectorGoal.along("hand", [[1, 2, 3]])
    assert (one.waypoints, one.quaternion) == (None, None)
    np.testing.assert_array_equal(one.path_values, [[1, 2, 3]])
    goal, other = (
        Goal.of_end_effectors([aim]),
        Goal.of_end_effectors([replace(aim, waypoints=None)]),
    )
    assert goal.has_path
    assert not other.has_path
    assert not goal.equals(other)
    assert goal.equals(Goal.of_end_effectors([EndEffectorGoal.along("hand", aim.path_values)]))
    for each, counts in ((goal, {"hand": 1}), (other, {})):
        status = PlannerStatus.of_goal(PlannerState.PLANNING, "", IdentifiedGoal(each))
        assert status.end_effector_waypoints == counts


def test_a_path_of_the_base_is_displaced() -> None:
    values = np.hstack([CORNER, TURNS.as_quat()])
    goal = Goal.through(values * [1, 1, 1, 2, 2, 2, 2])
    np.testing.assert_allclose(goal.path_values, values, atol=1e-15)
    assert not goal.equals(Goal.through(values[1:]))
    moved = goal.displaced(np.array([0.1, 0.2, -0.3])).path_values
    np.testing.assert_allclose(moved - values, [[0.1, 0.2, -0.3, 0, 0, 0, 0]] * 4, atol=1e-15)


@pytest.mark.parametrize(
    ("poses", "words"),
    [
        ([], "no poses"),
        ([[1.0, 2.0, 3.0]], "an orientation in each pose"),
        ([[1.0, 2.0, np.nan, 0.0, 0.0, 0.0, 1.0]], "Pose 1"),
        ([[1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0], [1.0] * 3 + [0.0] * 4], "Pose 2"),
    ],
)
def test_invalid_paths_of_the_base_are_refused(poses: Any, words: str) -> None:
    with pytest.raises(GoalError, match=words):
        Goal.through(poses)


def test_methods_for_the_joints_alone_refuse_waypoints() -> None:
    goal = Goal.through(np.hstack([CORNER, TURNS.as_quat()]))
    with pytest.raises(PlanningError, match="does not stop at waypoints"):
        plan("three_joint_arm", goal, method="optimal", control_period=PERIOD)


# -- as far as possible -------------------------------------------------------------------------


def test_a_path_is_followed_until_shortly_before_a_limit(start: Array) -> None:
    corner, beyond = start + WAY[1], start + WAY[1] + np.array([0.6, 2.5, -0.4])
    path: Any = {"end_effector_path": [corner, beyond], "start": STATE, "control_period": PERIOD}
    with pytest.raises(
        PlanningError, match=r" after [\d.]+ of 2\.7\d* m of the (line|path) of 'end_"
    ):
        plan("three_joint_arm", **path)
    schedule = plan("three_joint_arm", **path, as_far_as_possible=1)
    assert str(schedule.notes["stopped"]).count(" m of the ") == 1
    progress = schedule.progress
    assert isinstance(progress, PathProgress)
    done, whole = float(progress.travelled_lengths[-1]), float(progress.route.lengths_at_poses[-1])
    assert progress.route.lengths_at_poses[1] < done < whole
    end = hand(schedule.positions)[0]
    wanted = progress.route.remaining_after(done).positions[0]
    np.testing.assert_allclose(end, wanted, atol=1e-6)
    # From there the rest is refused with the same reason: the goal is given up.
    base = schedule.path
    state = RobotState(base.position[-1], base.quaternion[-1], schedule.positions[-1])
    method = method_of(as_far_as_possible=1)
    request = PlanRequest(state, schedule.goal, NEAR, correction=True, previous=schedule)
    with pytest.raises(PlanningError, match=r"optimal may reach"):
        method.plan(request)
