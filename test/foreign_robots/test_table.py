"""The robots that are in no paper, and the table of their goals."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from foreign_robots.run import (
    OUT_OF_REACH,
    ROBOTS,
    TABLE,
    TOLERANCE,
    Outcome,
    Trials,
    classes,
    integrated,
    out_of_reach,
    tasks,
    worst_error,
)
from scipy.spatial.transform import Rotation

from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.urdf import load_robot
from spacerobot_ros.planning import plan
from spacerobot_ros.resources import robot_file

JOINTS = {
    "free_flyer": 6,
    "solar_booms": 6,
    "seven_joint_arm": 7,
    "station_arm": 7,
    "quadruped": 12,
    "dual_arm": 14,
}


def test_the_table_is_of_the_robots_that_there_are() -> None:
    assert set(ROBOTS) == set(JOINTS)
    rows = json.loads(TABLE.read_text("utf-8"))
    assert [row["robot"] for row in rows] == list(ROBOTS)
    for row in rows:
        assert row["met"] + sum(row["refused"].values()) == row["goals"] > 0
        assert sum(row["methods"].values()) == row["met"]
        # Whatever is planned is right.
        assert "missed" not in row["refused"]
        assert row["joints"] == JOINTS[row["robot"]]


@pytest.mark.parametrize("name", JOINTS)
def test_the_robots_are_read_as_another_library_reads_them(name: str) -> None:
    robot = load_robot(robot_file(name))
    model = pin.buildModelFromUrdf(str(robot_file(name)), pin.JointModelFreeFlyer())
    assert len(robot.movable_joints) == JOINTS[name] == model.nv - 6
    mass = sum(body.inertia.mass for body in robot.bodies)
    assert mass == pytest.approx(pin.computeTotalMass(model))
    for body in robot.bodies:
        assert np.linalg.eigvalsh(body.inertia.about_com).min() > 0
    for joint in robot.movable_joints:
        assert 0 < joint.limits.velocity < np.inf
        assert 0 < joint.limits.effort < np.inf


def test_tasks_are_the_same_every_time_and_of_all_kinds() -> None:
    robot = SpaceRobot.from_file(Path(robot_file("solar_booms")))
    first, again = list(tasks(robot, 9)), list(tasks(robot, 6))
    assert [task.kind for task in first] == ["attitude", "shape", "position"] * 3
    for one, two in zip(first, again, strict=False):
        np.testing.assert_array_equal(one.goal.quaternion, two.goal.quaternion)
        np.testing.assert_array_equal(one.state.q, two.state.q)
        turn = Rotation.from_quat(one.state.quaternion).inv() * Rotation.from_quat(
            one.goal.quaternion
        )
        assert turn.magnitude() == pytest.approx(one.size)


@pytest.mark.slow
def test_a_long_search_finds_the_positions_that_shapes_bring() -> None:
    """The position of a shape is within reach; one far beyond the longest arm is not."""
    robot = SpaceRobot.from_file(Path(robot_file("seven_joint_arm")))
    task = next(each for each in tasks(robot, 12) if each.kind == "position")
    lower, upper = robot.lower, robot.upper
    shape = lower + 0.4 * (np.clip(upper, None, 3.0) - lower)
    start, turned = task.state, Rotation.from_quat(task.goal.quaternion)
    center = Rotation.from_quat(start.quaternion).apply(robot.center_of_mass(start.q))
    within = center - turned.apply(robot.center_of_mass(shape))
    for goal, nearest in ((within, 0.0), (within + 100 * center / np.linalg.norm(center), 99.0)):
        asked = replace(task, goal=replace(task.goal, position=goal))
        found = out_of_reach(robot, asked, starts=2)
        assert found < 1e-4 if nearest == 0 else found > nearest


def test_positions_that_no_search_reaches_are_counted_apart() -> None:
    outcomes = [
        Outcome(0, "position", 0.1, "not found", beyond=0.02),
        Outcome(1, "position", 0.1, "not found", beyond=1e-5),
        Outcome(2, "attitude", 0.1, "not found"),
        Outcome(3, "attitude", 0.1, "met"),
    ]
    assert classes(outcomes) == {OUT_OF_REACH: 1, "not found": 2, "met": 1}


@pytest.mark.slow
def test_the_second_integration_notices_what_is_wrong() -> None:
    trials = Trials("solar_booms")
    schedule = plan(trials.robot, rotvec=(0.02, 0.0, 0.01), starts=2, answers=1, cache=0)
    task = next(tasks(trials.robot, 1))
    state = task.state
    state = type(state)(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), schedule.positions[0])
    end = integrated(trials._oracle, state, schedule)
    assert worst_error(end, schedule.goal, schedule) < 1e-2
    turned = Rotation.from_quat(end.quaternion) * Rotation.from_rotvec([0, 0, 1.5e-3])
    off = type(end)(end.position, turned.as_quat(), end.q)
    assert worst_error(off, schedule.goal, schedule) == pytest.approx(
        1.5e-3 / TOLERANCE.attitude, rel=0.02
    )


@pytest.mark.slow
def test_commands_near_the_ends_of_joints_are_bent_within_them() -> None:
    """Fast legs move far within a tick: what makes up for chords must not leave the limits."""
    trials = Trials("quadruped")
    task = list(tasks(trials.robot, 3))[2]
    schedule = plan(trials.robot, task.goal, start=task.state, base_position=1, starts=2, cache=0)
    assert schedule.duration < 3.0
    assert np.all(schedule.positions >= trials.robot.lower - 1e-9)
    assert np.all(schedule.positions <= trials.robot.upper + 1e-9)
    end = integrated(trials._oracle, task.state, schedule)
    assert worst_error(end, task.goal, schedule) <= 1.0
