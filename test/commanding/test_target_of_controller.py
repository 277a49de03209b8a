"""What a controller hears of a target, and the tasks that are asked of it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.executive_loop import planar_manipulator
from support.sentences import assert_one_sentence

from spacerobot_ros.commanding.commander import ArrayDecoder, StateArrays
from spacerobot_ros.commanding.controller import ControllerCommander
from spacerobot_ros.commanding.goal_follower import Status
from spacerobot_ros.control.config import ControllerConfig
from spacerobot_ros.control.servicing import Task
from spacerobot_ros.errors import ParameterError
from spacerobot_ros.events import Event
from spacerobot_ros.model.description import Inertia
from spacerobot_ros.model.grasp import Payload
from spacerobot_ros.model.urdf import load_robot
from spacerobot_ros.parameters import configured
from spacerobot_ros.planning import Goal
from spacerobot_ros.simulation.status import PlantState, PlantStatus

TICK = 10_000_000
TARGET = load_robot(Path(__file__).parents[2] / "config" / "targets" / "block.urdf")
UPRIGHT = [0.0, 0.0, 0.0, 1.0]
HELD = Payload("end_effector", Inertia(10.0, np.array([0.3, 0.0, 0.0]), np.eye(3)))


class Rig:
    """A controller, and a list of what it does."""

    def __init__(self, **settings: Any) -> None:
        self.commands: list[int] = []
        self.statuses: list[Status] = []
        self.publishers = {"odom"}
        given = {"tick_rate": 100.0, "status_period": 0.01, **settings}
        self.commander = ControllerCommander(configured(ControllerConfig, given), self)

    def begin(self) -> None:
        self.commander.use_robot(planar_manipulator(), ArrayDecoder())
        self.commander.activate()

    def send_command(self, stamp_ns: int) -> None:
        self.commands.append(stamp_ns // TICK)

    def publish_status(self, status: Status) -> None:
        self.statuses.append(status)

    def report_event(self, event: Event) -> None:
        pass

    def publish_start(self, start: Any) -> None:
        pass

    def log(self, level: str, message: str) -> None:
        pass

    def has_publisher(self, topic: str) -> bool:
        return topic in self.publishers

    def waiting_states(self) -> tuple[list[Any], list[Any]]:
        return [], []

    def target(self, tick: int) -> None:
        pose, twist = np.array([1.9, -0.6, 0.0, *UPRIGHT]), np.array([0.001, 0, 0, 0, 0, 0.002])
        message = StateArrays(tick * TICK, np.zeros(0), np.zeros(0), pose, twist)
        self.commander.receive_target(tick * TICK, message)

    def state(self, tick: int) -> None:
        q, pose = np.array([-1.0, 1.0]), np.array([0.0, 0.0, 0.0, *UPRIGHT])
        state = StateArrays(tick * TICK, q, np.zeros(2), pose, np.zeros(6))
        self.commander.receive_odom(tick * TICK, state)
        self.commander.receive_joints(tick * TICK, state)


def test_the_latest_odometry_of_the_target_is_read_with_a_state_that_waits_for_none() -> None:
    rig = Rig(tasks="approach")
    rig.begin()
    rig.commander.use_target(TARGET)
    rig.target(0)
    rig.target(1)
    rig.state(1)
    assert rig.commands == [1]
    executive = rig.commander.executive
    assert executive is not None
    measured = executive.servicing.target
    assert measured.time == pytest.approx(0.01)
    assert measured.why_unknown == ""
    assert measured.motion is not None
    np.testing.assert_allclose(measured.motion.r_WT, [1.9, -0.6, 0.0])
    np.testing.assert_allclose(measured.motion.omega, [0.0, 0.0, 0.002])
    rig.state(2)
    assert rig.commands == [1, 2]


def test_a_target_is_measured_for_an_approach_alone() -> None:
    rig = Rig(tasks="detumble")
    rig.begin()
    rig.target(1)
    rig.state(1)
    executive = rig.commander.executive
    assert executive is not None
    assert executive.servicing.target.motion is None
    rig = Rig(tasks="approach")
    rig.begin()
    rig.target(1)
    rig.state(1)
    rig.commander.receive_plant_status(PlantStatus(PlantState.RUNNING))
    rig.commander.receive_plant_status(PlantStatus(PlantState.RUNNING, payload=HELD.to_text()))
    executive = rig.commander.executive
    assert executive is not None
    assert executive.servicing.payload is not None
    assert executive.servicing.payload.inertia.mass == 10.0
    rig.target(2)
    rig.state(2)
    assert executive.servicing.target.time == pytest.approx(0.01)
    rig.commander.receive_plant_status(PlantStatus(PlantState.RUNNING))
    assert executive.servicing.payload is None


def test_a_controller_that_is_built_later_knows_the_target_and_what_is_held() -> None:
    rig = Rig()
    rig.commander.use_target(TARGET)
    rig.commander.receive_plant_status(PlantStatus(PlantState.RUNNING, payload=HELD.to_text()))
    rig.begin()
    executive = rig.commander.executive
    assert executive is not None
    assert executive.servicing.target.body is not None
    np.testing.assert_allclose(executive.servicing.target.body.grapple.r, [-0.3, 0.0, 0.0])
    assert executive.servicing.payload is not None


def test_a_task_is_asked_of_an_active_controller() -> None:
    rig = Rig()
    accepted, message = rig.commander.request(Task.DETUMBLE)
    assert not accepted
    assert_one_sentence(message, "not active")
    rig.begin()
    accepted, message = rig.commander.request(Task.DETUMBLE)
    assert accepted
    assert_one_sentence(message, "'detumble' begins")
    rig.state(1)
    assert rig.statuses[-1].task == "detumble"  # type: ignore[union-attr]
    latched = PlantStatus(PlantState.LATCHED, "Nothing moves.", "abort", "a fuse is blown")
    rig.commander.receive_plant_status(latched)
    accepted, message = rig.commander.request(Task.APPROACH)
    assert not accepted
    assert "latched: a fuse is blown" in message


def test_a_task_that_does_not_exist_is_refused_with_the_robot() -> None:
    with pytest.raises(ParameterError) as refused:
        Rig(tasks="grab").begin()
    assert_one_sentence(str(refused.value), "Parameter 'tasks' names 'grab'")


# The arm of this rig grasps obliquely, past a corner of the block.
NEAR: dict[str, Any] = {"tasks": "approach", "target.clearance": 0.0}


def test_the_goal_waits_for_its_tasks() -> None:
    rig = Rig(**NEAR)
    rig.begin()
    rig.commander.use_target(TARGET)
    goal = Goal.checked([0.1, 0.0, 0.0], UPRIGHT)
    rig.commander.receive_goal("base", 0, 7, lambda: goal)
    rig.target(1)
    rig.state(1)
    last = rig.statuses[-1]
    assert (last.state.value, last.goal_id) == ("tracking", "0.000000007")
    assert last.task == "approach"  # type: ignore[union-attr]


def test_a_target_that_is_not_heard_of_any_more_is_lost() -> None:
    rig = Rig(**NEAR, **{"target.timeout": 0.025})
    rig.begin()
    rig.commander.use_target(TARGET)
    rig.commander.receive_goal("base", 0, 7, lambda: Goal.checked([0.1, 0.0, 0.0], UPRIGHT))
    rig.target(1)
    for tick in range(1, 5):
        rig.state(tick)
    assert rig.statuses[-1].state.value == "aborted"
    assert "the target is lost: its odometry is 0.03 s old" in rig.statuses[-1].message
    assert rig.commands == [1, 2, 3, 4]
