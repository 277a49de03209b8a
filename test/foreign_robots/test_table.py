"""The robots that are in no paper, and the table of their goals."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from foreign_robots.run import (
    OUT_OF_REACH,
    ROBOTS,
    TABLE,
    Outcome,
    classes,
    tasks,
)
from scipy.spatial.transform import Rotation

from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.urdf import load_robot
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


def test_positions_that_no_search_reaches_are_counted_apart() -> None:
    outcomes = [
        Outcome(0, "position", 0.1, "not found", beyond=0.02),
        Outcome(1, "position", 0.1, "not found", beyond=1e-5),
        Outcome(2, "attitude", 0.1, "not found"),
        Outcome(3, "attitude", 0.1, "met"),
    ]
    assert classes(outcomes) == {OUT_OF_REACH: 1, "not found": 2, "met": 1}
