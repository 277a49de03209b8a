"""Obstacles that a planner receives: taken once, refused with a sentence, and kept."""

from __future__ import annotations

import pytest
from commanding.test_commander import METHOD, Rig, config

from spacerobot_ros.commanding.planner import PlannerCommander
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.urdf import load_robot
from spacerobot_ros.planning.execution.config import PlannerConfig
from spacerobot_ros.planning.execution.worker import PlanningWorker
from spacerobot_ros.resources import robot_file

BALL = (
    '<robot name="w"><link name="w"/><link name="ball"><collision><geometry><sphere radius="0.3"/>'
    '</geometry></collision></link><joint name="a" type="fixed"><parent link="w"/>'
    '<child link="ball"/></joint></robot>'
)


@pytest.fixture(scope="module")
def robot() -> SpaceRobot:
    return SpaceRobot(load_robot(robot_file("sliding_masses")))


@pytest.fixture
def rig(robot: SpaceRobot) -> Rig:
    rig = Rig(PlannerCommander, config(PlannerConfig, **METHOD), robot.n)
    rig.use(robot)
    rig.commander.activate()
    return rig


def worker_of(rig: Rig) -> PlanningWorker:
    worker = rig.commander.executive._worker
    assert isinstance(worker, PlanningWorker)
    return worker


def obstacles_of(rig: Rig) -> list[str]:
    clearance = worker_of(rig).clearance
    world = None if clearance is None else clearance._robot.world
    return [] if world is None else [each.name for each in world.links if each.collisions]


def test_plans_go_round_the_obstacles_that_came_last(rig: Rig) -> None:
    assert obstacles_of(rig) == []
    rig.commander.receive_obstacles(BALL)
    assert obstacles_of(rig) == ["ball"]
    worker = worker_of(rig)
    rig.commander.receive_obstacles(BALL)
    assert worker_of(rig) is worker, "the same ones came again"
    rig.commander.receive_obstacles(BALL.replace("ball", "stone"))
    assert obstacles_of(rig) == ["stone"]
    rig.commander.receive_obstacles("")
    assert obstacles_of(rig) == []
    assert rig.host.lines == [
        ("info", "Plans go round 1 obstacle(s): ball."),
        ("info", "Plans go round 1 obstacle(s): stone."),
        ("info", "Plans go round 0 obstacle(s)."),
    ]


def test_refused_obstacles_are_told_of_and_those_so_far_stay(rig: Rig) -> None:
    rig.commander.receive_obstacles(BALL)
    worker = worker_of(rig)
    rig.commander.receive_obstacles(BALL.replace('"fixed"', '"floating"'))
    assert worker_of(rig) is worker
    level, line = rig.host.lines[-1]
    assert level == "error"
    assert line.startswith("obstacles: ")
    assert line.endswith(" The obstacles so far stay.")
    assert "'a'" in line
    assert line.isprintable()
    # They may come again after a refusal.
    rig.commander.receive_obstacles("")
    assert obstacles_of(rig) == []


def test_obstacles_that_come_before_the_robot_wait_for_it(robot: SpaceRobot) -> None:
    rig = Rig(PlannerCommander, config(PlannerConfig, **METHOD), robot.n)
    rig.commander.receive_obstacles(BALL)
    rig.use(robot)
    assert obstacles_of(rig) == ["ball"]
