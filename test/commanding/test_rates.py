"""Commanders and plants of any rate: the parameter tick_rate, the plant's status, stamps alone."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commanding.commanders import GOAL, Rig
from support.executive_loop import planar_manipulator
from support.sentences import assert_one_sentence

from spacerobot_ros.commanding.controller import ControllerCommander
from spacerobot_ros.commanding.host import ArrayDecoder, StateArrays
from spacerobot_ros.commanding.planner import PlannerCommander
from spacerobot_ros.control.config import ControllerConfig
from spacerobot_ros.control.servicing import Task
from spacerobot_ros.errors import CommandError, ParameterError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.urdf import load_robot
from spacerobot_ros.parameters import configured
from spacerobot_ros.planning import Goal
from spacerobot_ros.planning.execution.config import PlannerConfig
from spacerobot_ros.planning.execution.goal_file import BASE_GOAL_KEY
from spacerobot_ros.resources import robot_file
from spacerobot_ros.simulation.status import PlantState, PlantStatus

KINDS = {
    "planner": (PlannerCommander, PlannerConfig, "sliding_masses", "velocity"),
    "controller": (ControllerCommander, ControllerConfig, "planar_manipulator", "effort"),
}


class RateRig(Rig):
    """A commander, and a robot at rest whose states come at a rate."""

    def __init__(self, kind: str, **settings: Any) -> None:
        make, kind_of_config, robot, self.actuation = KINDS[kind]
        model = SpaceRobot(load_robot(robot_file(robot)))
        super().__init__(make, configured(kind_of_config, settings), model.n)
        self.time = 40.0
        self.use(model)
        self.commander.activate()

    def states(self, count: int, rate: float) -> None:
        for _ in range(count):
            self.time += 1 / rate
            self.wall += 1 / rate
            state = replace(self.message(0), stamp_ns=round(self.time * 1e9))
            self.commander.receive_odom(state.stamp_ns, state)
            self.commander.receive_joints(state.stamp_ns, state)
            self.commander.take_accepted_jump()

    def plant_says(self, **about: Any) -> None:
        given = {"actuation": self.actuation, "time_mode": "realtime", **about}
        self.commander.receive_plant_status(PlantStatus(PlantState.RUNNING, "A test.", **given))

    @property
    def warnings(self) -> list[str]:
        return [line for level, line in self.host.lines if level in ("warning", "error")]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("rate", [2.0, 10.0, 50.0, 200.0])
def test_states_of_any_rate_are_answered_from_the_third_on(kind: str, rate: float) -> None:
    rig = RateRig(kind)
    rig.states(30, rate)
    assert len(rig.host.commands) == 28
    assert rig.commander.config.control_period == pytest.approx(1 / rate, rel=1e-6)
    assert not rig.warnings


@pytest.mark.parametrize("kind", KINDS)
def test_a_rate_that_differs_from_the_parameter_is_followed_and_said_once(kind: str) -> None:
    rig = RateRig(kind, tick_rate=100.0)
    rig.states(60, 20.0)
    assert len(rig.host.commands) == 60
    assert rig.commander.config.tick_rate == pytest.approx(20.0)
    (line,) = rig.warnings
    assert_one_sentence(line.split(". Set")[0] + ".", "'tick_rate'", "100 Hz", "20 Hz")


@pytest.mark.parametrize("kind", KINDS)
def test_states_that_are_skipped_do_not_change_the_rate(kind: str) -> None:
    """As under load, where only the last of several states is answered."""
    rig = RateRig(kind)
    rig.states(5, 20.0)
    for skipped in (2, 2, 3, 2, 2, 1, 2, 2, 1, 2):
        rig.states(1, 20.0 / skipped)
        assert rig.commander.config.tick_rate == pytest.approx(20.0)
    assert not rig.warnings


@pytest.mark.parametrize("kind", KINDS)
def test_the_first_state_of_a_plant_in_lockstep_is_answered(kind: str) -> None:
    rig = RateRig(kind)
    rig.plant_says(tick_rate_hz=25.0, time_mode="lockstep")
    rig.states(1, 25.0)
    assert len(rig.host.commands) == 1
    assert rig.commander.config.tick_rate == 25.0
    assert not rig.warnings


@pytest.mark.parametrize(("rate", "other"), [(5.0, 40.0), (40.0, 8.0)])
def test_plans_have_the_period_of_the_plant(rate: float, other: float) -> None:
    """Also one that is restarted with another rate."""
    method = {"method": "lie_bracket", "lie_bracket.t1": 2.0, "lie_bracket.n1": 1}
    rig = RateRig("planner", **method)
    for each in (rate, other):
        rig.plant_says(tick_rate_hz=each, time_mode="lockstep")
        rig.states(3, each)
        stamp = round(rig.time)
        rig.commander.receive_goal(BASE_GOAL_KEY, stamp, 0, lambda: GOAL)
        rig.states(2, each)
        assert rig.host.starts[-1].schedule.control_period == pytest.approx(1 / each)
    assert rig.host.statuses[-1].state.value == "executing"


@pytest.mark.parametrize("kind", KINDS)
def test_a_plant_of_other_commands_is_named_once_and_goals_are_refused(kind: str) -> None:
    rig = RateRig(kind)
    rig.plant_says(actuation="auto")
    assert not rig.warnings
    other = "velocity" if rig.actuation == "effort" else "effort"
    for _ in range(3):
        rig.plant_says(actuation=other, tick_rate_hz=20.0)
        rig.states(5, 20.0)
    (line,) = rig.warnings
    assert_one_sentence(line, "actuation:=")
    rig.commander.receive_goal(BASE_GOAL_KEY, 7, 0, lambda: GOAL)
    assert rig.host.statuses[-1].state.value == "refused"
    assert rig.host.statuses[-1].message == line


@pytest.mark.parametrize("kind", KINDS)
def test_a_rate_near_zero_is_refused(kind: str) -> None:
    with pytest.raises(ParameterError) as refusal:
        configured(KINDS[kind][1], {"tick_rate": 1e-4})
    assert_one_sentence(str(refusal.value), "'tick_rate'", "Hz")


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
    assert_one_sentence(rig.commander.request(Task.DETUMBLE), "'detumble' has started")
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
