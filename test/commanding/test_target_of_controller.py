"""What a controller hears of a target, and the tasks that are asked of it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commanding.commanders import Rig
from support.executive_loop import planar_manipulator
from support.sentences import assert_one_sentence

from spacerobot_ros.commanding.commander import ArrayDecoder, StateArrays
from spacerobot_ros.commanding.controller import ControllerCommander
from spacerobot_ros.control.config import ControllerConfig
from spacerobot_ros.control.servicing import Task
from spacerobot_ros.errors import CommandError, ParameterError
from spacerobot_ros.model.urdf import load_robot
from spacerobot_ros.parameters import configured
from spacerobot_ros.planning import Goal
from spacerobot_ros.simulation.status import PlantState, PlantStatus

TICK = 10_000_000
TARGET = load_robot(Path(__file__).parents[2] / "config" / "targets" / "block.urdf")
UPRIGHT = [0.0, 0.0, 0.0, 1.0]


class TargetRig(Rig):
    """A controller that hears of a target, every 10 ms."""

    def __init__(self, **settings: Any) -> None:
        given = {"tick_rate": 100.0, "status_period": 0.01, **settings}
        super().__init__(ControllerCommander, configured(ControllerConfig, given), 2)

    def begin(self) -> None:
        self.commander.use_robot(planar_manipulator(), ArrayDecoder())
        self.commander.activate()

    def target(self, tick: int) -> None:
        pose, twist = np.array([1.9, -0.6, 0.0, *UPRIGHT]), np.array([0.001, 0, 0, 0, 0, 0.002])
        message = StateArrays(tick * TICK, np.zeros(0), np.zeros(0), pose, twist)
        self.commander.receive_target(tick * TICK, message)

    def state(self, tick: int) -> None:
        q, pose = np.array([-1.0, 1.0]), np.array([0.0, 0.0, 0.0, *UPRIGHT])
        state = StateArrays(tick * TICK, q, np.zeros(2), pose, np.zeros(6))
        self.commander.receive_odom(tick * TICK, state)
        self.commander.receive_joints(tick * TICK, state)


def test_a_task_is_asked_of_an_active_controller() -> None:
    rig = TargetRig()
    with pytest.raises(CommandError, match="not active"):
        rig.commander.request(Task.DETUMBLE)
    rig.begin()
    assert_one_sentence(rig.commander.request(Task.DETUMBLE), "'detumble' begins")
    rig.state(1)
    assert rig.host.statuses[-1].task == "detumble"  # type: ignore[union-attr]
    latched = PlantStatus(PlantState.LATCHED, "Nothing moves.", "abort", "a fuse is blown")
    rig.commander.receive_plant_status(latched)
    with pytest.raises(CommandError, match="latched: a fuse is blown"):
        rig.commander.request(Task.APPROACH)


def test_a_task_that_does_not_exist_is_refused_with_the_robot() -> None:
    with pytest.raises(ParameterError) as refused:
        TargetRig(tasks="grab").begin()
    assert_one_sentence(str(refused.value), "Parameter 'tasks' names 'grab'")


# The arm of this rig grasps obliquely, past a corner of the block.
NEAR: dict[str, Any] = {"tasks": "approach", "target.clearance": 0.0}


def test_the_goal_waits_for_its_tasks() -> None:
    rig = TargetRig(**NEAR)
    rig.begin()
    rig.commander.use_target(TARGET)
    goal = Goal.checked([0.1, 0.0, 0.0], UPRIGHT)
    rig.commander.receive_goal("base", 0, 7, lambda: goal)
    rig.target(1)
    rig.state(1)
    last = rig.host.statuses[-1]
    assert (last.state.value, last.goal_id) == ("tracking", "0.000000007")
    assert last.task == "approach"  # type: ignore[union-attr]


def test_a_target_that_is_not_heard_of_any_more_is_lost() -> None:
    rig = TargetRig(**NEAR, **{"target.timeout": 0.025})
    rig.begin()
    rig.commander.use_target(TARGET)
    rig.commander.receive_goal("base", 0, 7, lambda: Goal.checked([0.1, 0.0, 0.0], UPRIGHT))
    rig.target(1)
    for tick in range(1, 5):
        rig.state(tick)
    assert rig.host.statuses[-1].state.value == "aborted"
    assert "the target is lost: its odometry is 0.03 s old" in rig.host.statuses[-1].message
    assert len(rig.host.commands) == 4
