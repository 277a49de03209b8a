"""Goals of any numbers: refused with a sentence, or planned for with finite numbers."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest
from geometry_msgs.msg import Point, Pose, PoseStamped, Quaternion
from hypothesis import strategies as st
from sensor_msgs.msg import JointState
from support.fuzzing import NUMBERS, TEXTS, VALUES, attempt, fuzz
from support.planners import planner_of

from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.nodes.common.messages import goal_of, shape_of
from spacerobot_ros.planning import Goal, RobotState, Tolerance
from spacerobot_ros.resources import robot_file

ROBOTS = {
    "lie_bracket": "sliding_masses",
    "square_path": "three_joint_arm",
    "area_loop": "planar_chain",
}
VECTORS = st.lists(NUMBERS, min_size=3, max_size=3)
NEAR = st.lists(st.floats(-0.2, 0.2), min_size=3, max_size=3)
QUATERNIONS = st.lists(NUMBERS, min_size=4, max_size=4)


@lru_cache
def robot(name: str) -> SpaceRobot:
    return SpaceRobot.from_file(robot_file(name))


def assert_sound(goal: Goal | None) -> None:
    if goal is not None:
        assert np.all(np.isfinite(goal.position))
        assert abs(np.linalg.norm(goal.quaternion) - 1.0) < 1e-9
        assert goal.joint_positions is None or np.all(np.isfinite(goal.joint_positions))


@fuzz("goal message", VECTORS, QUATERNIONS, TEXTS, fast=30, long=800)
def test_a_goal_pose_message(position: list[float], orientation: list[float], frame: str) -> None:
    pose = Pose(
        position=Point(**dict(zip("xyz", position, strict=True))),
        orientation=Quaternion(**dict(zip("xyzw", orientation, strict=True))),
    )
    message = PoseStamped(pose=pose)
    message.header.frame_id = frame
    assert_sound(attempt("goal message", goal_of, message, "world"))


@fuzz("goal shape", st.lists(TEXTS, max_size=4), st.lists(NUMBERS, max_size=4), fast=30, long=800)
def test_a_goal_shape_message(names: list[str], positions: list[float]) -> None:
    joints = robot("sliding_masses").joint_names
    message = JointState(name=[*joints, *names], position=positions)
    shape = attempt("goal shape", shape_of, message, joints)
    assert shape is None or (shape.shape == (3,) and np.all(np.isfinite(shape)))


@fuzz("goal of a program", VALUES, VALUES, VALUES, fast=30, long=800)
def test_a_goal_of_anything(position: object, quaternion: object, shape: object) -> None:
    assert_sound(attempt("goal of a program", Goal.checked, position, quaternion, shape))


@fuzz("goal of a program", VECTORS, st.lists(NUMBERS, max_size=5), fast=30, long=400)
def test_a_goal_of_a_rotation_vector(position: list[float], rotvec: list[float]) -> None:
    assert_sound(attempt("goal of a program", Goal.from_rotvec, position, rotvec))


@pytest.mark.parametrize("method", ROBOTS)
@fuzz(
    "planned goal",
    st.one_of(NEAR, NEAR, VECTORS, st.just([0.0, 0.0, 0.0])),
    st.one_of(
        st.tuples(NEAR, st.just(1.0)).map(lambda parts: [*parts[0], parts[1]]),
        st.floats(-1.0, 1.0).map(lambda z: [0.0, 0.0, z, 1.0]),
        QUATERNIONS,
    ),
    st.none() | st.lists(st.floats(-0.4, 0.4), min_size=2, max_size=3) | VECTORS,
    st.lists(st.floats(-0.3, 0.3), min_size=3, max_size=3),
    fast=6,
    long=100,
)
def test_a_plan_for_a_goal(
    method: str,
    position: list[float],
    quaternion: list[float],
    shape: list[float] | None,
    start: list[float],
) -> None:
    goal = attempt("planned goal", Goal.checked, position, quaternion, shape)
    if goal is None:
        return
    model = robot(ROBOTS[method])
    planner = planner_of(method, model, 0.05, Tolerance(1e-3, 1e-3), 0.01)
    q = np.clip(start[: model.n], model.lower, model.upper)
    state = RobotState(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), q)
    schedule = attempt("planned goal", planner.plan, state, goal)
    if schedule is not None:
        for numbers in (schedule.positions, schedule.path.position, schedule.path.quaternion):
            assert np.all(np.isfinite(numbers))
        assert np.all(schedule.positions >= model.lower - 1e-9)
        assert np.all(schedule.positions <= model.upper + 1e-9)
