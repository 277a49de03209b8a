"""Motions under thrust: closed forms, and Pinocchio under their wrenches and efforts."""

from __future__ import annotations

from dataclasses import fields
from functools import cache
from typing import Any

import coal
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.thrust_flights import FOLDED, beyond, box, flown_by_pinocchio, obstacles

from spacerobot_ros.errors import NotFoundError, ParameterError, PlanningError, UnreachableError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.grasp import RobotMotion
from spacerobot_ros.model.thrusters import ThrusterTable, find_thrusters
from spacerobot_ros.planning.methods.thrust.problem import (
    Propulsion,
    ThrustGoal,
    ThrustMotion,
    ThrustOptions,
)
from spacerobot_ros.planning.methods.thrust.search import ThrustPlanner
from spacerobot_ros.resources import robot_file

MASS, INERTIA, FORCE, TORQUE = 16.0, np.array([0.3, 0.35, 0.4]), 0.5, 0.05
CUBE = f"""<robot name="cube"><link name="base_link"><inertial><mass value="{MASS}"/>
<inertia ixx="{INERTIA[0]}" iyy="{INERTIA[1]}" izz="{INERTIA[2]}" ixy="0" ixz="0" iyz="0"/>
</inertial><collision><geometry><box size="0.4 0.3 0.2"/></geometry></collision></link></robot>"""

START = np.array([0.4, -1.3, 0.7, *Rotation.from_rotvec([0.5, -0.3, 1.1]).as_quat()])
GOAL = beyond(START, np.array([1.0, 0.4, -0.2]), np.array([0.1, -0.2, 0.5]))
REST = RobotMotion.at_rest(START, np.zeros(0))


def cube_planner(robot: SpaceRobot | None = None, **options: Any) -> ThrustPlanner:
    chosen = ThrustOptions(reserve=0.0, **options)
    robot = robot or SpaceRobot.from_urdf(CUBE)
    return ThrustPlanner(robot, chosen, force=FORCE, torque=TORQUE)


@cache
def servicer() -> ThrustPlanner:
    robot = SpaceRobot.from_file(robot_file("servicer"))
    return ThrustPlanner(robot, ThrustOptions(thrusters="urdf"), "end_effector")


@pytest.mark.parametrize("rotates", [False, True])
def test_shortest_times_and_least_impulses_are_those_of_closed_forms(rotates: bool) -> None:
    way, turn = np.array([0.0, 1.2, 0.0]), np.array([0.0, 0.0, 1.1])
    displacement, rotvec = (0 * way, turn) if rotates else (way, 0 * turn)
    distance, limit, inertia = (1.1, TORQUE, INERTIA[2]) if rotates else (1.2, FORCE, MASS)
    goal = ThrustGoal(beyond(START, displacement, rotvec))
    fastest = cube_planner(time_factor=1.0).plan(REST, goal)
    shortest = 2 * np.sqrt(distance * inertia / limit)
    assert fastest.duration == pytest.approx(shortest, rel=1e-3)
    cheapest = cube_planner(time_factor=1.5).plan(REST, goal)
    # One accelerates, coasts, and brakes for as long as one has accelerated.
    time = 1.5 * shortest
    burn = (time - np.sqrt(time**2 - 4 * distance * inertia / limit)) / 2
    assert cheapest.duration == pytest.approx(time, rel=1e-3)
    assert cheapest.spent == pytest.approx(2 * limit * burn, rel=5e-3)


def test_a_cube_turns_on_the_way_where_that_lets_more_thrusters_push() -> None:
    robot = SpaceRobot.from_file(robot_file("jet_cube"))
    table = find_thrusters("urdf", robot.description)
    # Along an axis of the body; other thrusters push along a diagonal.
    along = float(np.maximum(table.wrenches[0], 0.0).sum())
    straight = 2 * np.sqrt(1.2 * robot.total_mass / along)
    options = ThrustOptions(time_factor=1.0, clearance=0.0, reserve=0.0, thrusters="urdf")
    planner = ThrustPlanner(robot, options)
    upright, along_x = np.eye(7)[6], 1.2 * np.eye(7)[0]
    start = RobotMotion.at_rest(upright, np.zeros(0))
    motion = planner.plan(start, ThrustGoal(upright + along_x))
    assert motion.duration < 0.947 * straight
    turned = Rotation.from_quat(motion.at(motion.duration / 2).base.quaternion)
    assert turned.magnitude() > 0.2


def test_pinocchio_ends_at_the_goal_under_the_wrenches_and_efforts_of_a_plan() -> None:
    planner = servicer()
    start = RobotMotion.at_rest(START, FOLDED)
    goal, shape = GOAL, FOLDED + np.array([0.3, 0.2, -0.4, 0.5, -0.3, 0.6])
    motion = planner.plan(start, ThrustGoal(base=goal, shape=shape))
    ended = flown_by_pinocchio(planner.robot, motion, start)
    assert ended[:3] == pytest.approx(goal[:3], abs=1e-3)
    apart = Rotation.from_quat(goal[3:]).inv() * Rotation.from_quat(ended[3:7])
    assert apart.magnitude() < 1e-3
    last = motion.at(motion.duration)
    assert last.q == pytest.approx(shape, abs=1e-8)
    assert np.abs(np.concatenate(last.base[2:4])).max() < 1e-5
    assert motion.levels.min() >= -1e-7
    assert motion.levels.max() <= 1 + 1e-7
    straight = 2 * motion.duration / 1.5
    assert 0 < motion.spent < straight * planner.propulsion.cost.sum()


def test_a_joint_that_is_limited_to_no_effort_is_named() -> None:
    limited = "<parent link='base_link'/><child link='arm'/><axis xyz='0 0 1'/><limit lower='-1'"
    arm = f"""<joint name="elbow" type="revolute">{limited} upper="1" velocity="1" effort="0"/>
</joint><link name="arm"><inertial><origin xyz="0.5 0 0"/><mass value="2"/>
<inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link></robot>"""
    planner = cube_planner(SpaceRobot.from_urdf(CUBE.replace("</robot>", arm)), clearance=0.0)
    goal = ThrustGoal(beyond(START, np.array([0.3, 0.1, 0.0]), np.zeros(3)))
    with pytest.raises(PlanningError, match="joint 'elbow' is limited to an effort of 0"):
        planner.plan(RobotMotion.at_rest(START, np.zeros(1)), goal)


def test_an_arm_that_is_to_keep_its_shape_keeps_it_all_the_way() -> None:
    planner, start = servicer(), RobotMotion.at_rest(START, FOLDED)
    motion = planner.plan(start, ThrustGoal(GOAL, shape=FOLDED, keeps_shape=True))
    assert np.abs(motion.path()[0] - FOLDED).max() < 1e-9
    ended = flown_by_pinocchio(planner.robot, motion, start)
    assert ended[:3] == pytest.approx(GOAL[:3], abs=1e-3)


def test_hand_and_base_reach_their_poses_together() -> None:
    planner = servicer()
    pose = np.eye(7)[6]
    base = beyond(pose, np.array([1.0, 0.4, -0.2]), np.array([0.1, -0.2, 0.5]))
    hand = np.array([2.28, 1.85, 0.79, *Rotation.from_rotvec([-0.56, 0.95, 1.05]).as_quat()])
    motion = planner.plan(RobotMotion.at_rest(pose, FOLDED), ThrustGoal(base, hand))
    last = motion.at(motion.duration)
    for frame, goal in ((last.base, base), (last.end_effector, hand)):
        assert frame.position == pytest.approx(goal[:3], abs=1e-4)
        apart = Rotation.from_quat(goal[3:]).inv() * Rotation.from_quat(frame.quaternion)
        assert apart.magnitude() < 1e-4


def test_accelerations_are_the_derivatives_of_velocities() -> None:
    planner = servicer()
    goal = beyond(START, np.array([-0.5, 0.4, 0.3]), np.array([0.4, 0.1, -0.3]))
    motion = planner.plan(RobotMotion.at_rest(START, FOLDED), ThrustGoal(base=goal, shape=FOLDED))
    time, dt = 7.37 * motion.step, 1e-4
    before, at, after = (motion.at(time + by) for by in (-dt, 0.0, dt))
    for one, frame, other in zip(before[:2], at[:2], after[:2], strict=True):
        assert frame.velocity == pytest.approx((other.position - one.position) / (2 * dt), abs=1e-7)
        slope = (other.velocity - one.velocity) / (2 * dt)
        assert frame.acceleration == pytest.approx(slope, abs=1e-7)
        slope = (other.angular_velocity - one.angular_velocity) / (2 * dt)
        assert frame.angular_acceleration == pytest.approx(slope, abs=1e-7)


def test_a_box_in_the_way_is_passed_clear_of_it() -> None:
    goal = beyond(START, np.array([2.5, 0.3, -0.2]), np.array([0.3, 0.8, -0.5]))
    middle, size = (START[:3] + goal[:3]) / 2, np.array([0.5, 0.4, 0.3])
    rpy, planner = np.array([0.3, -0.2, 0.6]), cube_planner()
    free = planner.plan(REST, ThrustGoal(goal))
    planner.use_obstacles(obstacles(box=(box(size), middle, rpy)))
    motion = planner.plan(REST, ThrustGoal(goal))
    body, obstacle = coal.Box(0.4, 0.3, 0.2), coal.Box(*size)
    placed = coal.Transform3s(Rotation.from_euler("xyz", rpy).as_matrix(), middle)
    asked = coal.DistanceRequest(), coal.DistanceResult()

    def nearest(flight: ThrustMotion) -> float:
        frames = [flight.at(time).base for time in np.linspace(0, flight.duration, 400)]
        turns = Rotation.from_quat([each.quaternion for each in frames]).as_matrix()
        places = [coal.Transform3s(R, x.position) for R, x in zip(turns, frames, strict=True)]
        return float(min(coal.distance(body, at, obstacle, placed, *asked) for at in places))

    assert nearest(motion) >= 0.01 - 1e-6
    assert nearest(free) < 0
    assert motion.spent < 1.4 * free.spent


def test_what_cannot_be_planned_is_refused_in_a_sentence() -> None:
    goal = ThrustGoal(beyond(START, np.array([1.0, 0.0, 0.0]), np.zeros(3)))
    with pytest.raises(UnreachableError, match=r"takes at least 11\.3\d* s, but plan\.duration"):
        cube_planner(duration=5.0).plan(REST, goal)
    table = find_thrusters("urdf", servicer().robot.description)
    one_way = ThrusterTable(*(getattr(table, each.name)[:1] for each in fields(table)))
    with pytest.raises(ParameterError, match="cannot produce"):
        Propulsion.of_table(one_way, 0.0)
    with pytest.raises(ParameterError, match="set max_force"):
        ThrustPlanner(SpaceRobot.from_urdf(CUBE), ThrustOptions(), torque=1.0)
    far = np.array([9.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    with pytest.raises(NotFoundError, match="No joint positions were found that put"):
        servicer().plan(RobotMotion.at_rest(START, FOLDED), ThrustGoal(START, far))


BOOM = CUBE.replace(
    "</robot>",
    """<link name="boom"><inertial><origin xyz="0.4 0 0"/><mass value="2"/>
<inertia ixx="0.01" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="hinge" type="revolute"><parent link="base_link"/><child link="boom"/>
<origin xyz="0.2 0 0.1"/><axis xyz="0 0.6 0.8"/>
<limit lower="-2" upper="2" velocity="0.5" effort="4"/></joint></robot>""",
)


def test_options_bound_the_motion_of_joints_and_the_levels() -> None:
    robot = SpaceRobot.from_urdf(BOOM)
    start = RobotMotion.at_rest(START, np.array([0.3]))
    goal = ThrustGoal(beyond(START, np.array([0.4, 0.1, 0.0]), np.zeros(3)), shape=np.array([-1.2]))

    def planned(**options: Any) -> ThrustMotion:
        given = ThrustOptions(**{"time_factor": 1.0, "clearance": 0.0, "intervals": 16, **options})
        return ThrustPlanner(robot, given, force=3.75, torque=1.25).plan(start, goal)

    def fastest(motion: ThrustMotion) -> tuple[float, float, float]:
        times = np.linspace(0, motion.duration, 500, endpoint=False)
        samples = [motion.at(time) for time in times]
        rates = np.array([[s.qdot[0], s.qddot[0], s.tau[0]] for s in samples])
        speed, acceleration, effort = np.abs(rates).max(axis=0).tolist()
        return speed, acceleration, effort

    free = fastest(planned())
    assert 0.45 < free[0] <= 0.5 * (1 + 1e-6)
    assert free[1] <= 0.5 / 0.5 * (1 + 1e-6), "the limit of the URDF within ramp_time"
    assert fastest(planned(max_velocity=(0.2,)))[0] == pytest.approx(0.2, rel=1e-3)
    assert fastest(planned(max_acceleration=(0.3,)))[1] == pytest.approx(0.3, rel=1e-3)
    assert fastest(planned(ramp_time=2.5))[1] == pytest.approx(0.2, rel=1e-3)
    assert len(planned(intervals=14).levels) == 14
    assert fastest(planned(reserve=0.9))[2] <= 0.1 * 4 * (1 + 1e-3)
    with pytest.raises(PlanningError, match="no motion to the goal was found"):
        planned(iterations=1)
