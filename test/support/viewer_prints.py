"""The viewer's page as users see it in three situations that are made up, on a stand-in server."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from typing import Any
from unittest.mock import patch

import numpy as np
from support.page_elements import Server

from spacerobot_ros.bag.playback import ReplayStatus
from spacerobot_ros.control.status import ControllerState, ControllerStatus
from spacerobot_ros.model import load_robot
from spacerobot_ros.model.description import RobotDescription
from spacerobot_ros.model.thrusters import find_thrusters
from spacerobot_ros.planning import Goal
from spacerobot_ros.planning.execution.status import PlannerState, PlannerStatus
from spacerobot_ros.resources import robot_file
from spacerobot_ros.simulation.faults import FaultTargets
from spacerobot_ros.simulation.status import PlantState, PlantStatus
from spacerobot_ros.viewer import goal_editor, page
from spacerobot_ros.viewer.page import Page
from spacerobot_ros.viewer.reachability import GoalCheck, Verdict
from spacerobot_ros.viewer.server import ViewerConfig
from spacerobot_ros.viewer.state import Firing, Measured, Momenta, Notice, StackState

_GOAL = Goal.checked([1.0, -2.0, 0.5], [0.5, -0.1, 0.7, 0.5])


class _Situation:
    """A page with a robot, and time that passes for it."""

    def __init__(self, robot: str, *, dark: bool = False) -> None:
        self.server, self.now = Server(), 100.0
        self.robot: RobotDescription = load_robot(robot_file(robot))
        self.page = Page(self.server, ViewerConfig(dark=dark))  # type: ignore[arg-type]
        self.page.show_robot(self.robot)
        self.actions: list[str] = []

    def measured(self, time_s: float, x: float) -> Measured:
        """Return a state whose numbers all differ."""
        n = np.arange(1.0, len(self.robot.joint_names) + 1)
        pose = np.array([x, 0.2 - x, -0.3, 0.1, -0.7, 0.1, 0.7])
        return Measured(time_s, pose, 0.1 * n - x, 0.01 * n, -0.5 * n)

    def show(self, state: StackState, after: float = 0.6) -> None:
        """Draw a state after some wall time."""
        self.now += after
        for action in self.page.update(state, self.now):
            values = getattr(action, "goals", None)
            text = {part: goal.position.tolist() for part, goal in values.items()} if values else ""
            self.actions.append(f"{type(action).__name__} {text or action}")

    def shown(self) -> dict[str, Any]:
        return {**self.server.shown(), "actions": self.actions, "themes": self.server.gui.themes}


def _planned() -> dict[str, Any]:
    """A planner flies the servicer, a fault is active, and a user sends goals and faults."""
    seen = _Situation("servicer")
    act = seen.page
    names = seen.robot.joint_names
    table = find_thrusters("urdf", seen.robot)
    act.show_thrusters(table)
    act.faults.offer(FaultTargets(names, wrench=True, nozzles=table.names))
    act.note(Notice("A mesh is missing.", 1))
    flying = StackState(
        measured=seen.measured(4.0, 0.0),
        age_s=0.1,
        momenta=Momenta(np.arange(6.0) / 100, None),
        firing=Firing((table.names[0], table.names[3], "unknown"), np.array([0.5, 0.0, 1.0])),
        plant=PlantStatus(PlantState.RUNNING, "It flies.", faults=("joint_stuck shoulder",)),
        planner=PlannerStatus(
            PlannerState.EXECUTING, "Flies.", manoeuvre_time_s=8.0, ends_at_s=10.0
        ),
        planned_path=np.array([[0.0, 0.0, 0.0], [0.5, 0.25, 0.0], [1.0, -2.0, 0.5]]),
        goals={"base": _GOAL},
        silent={"/recorder": 3.7},
        inactive=("/other",),
    )
    seen.show(flying)
    gui = seen.server.gui
    gui.named("Goal (m)").use(seen.server, (1.5, -0.5, 0.25))
    gui.named("Roll, pitch, yaw (deg)").use(seen.server, (10.0, -20.0, 30.0))
    gui.named("Final joint positions").use(seen.server, True)
    gui.named("Fly").use(seen.server)
    gui.named("Plant").use(seen.server, "Stop all")
    gui.named("Inject").use(seen.server)  # Its number is still 0.
    gui.named("Fault").use(seen.server, "actuator_bias")
    seen.show(replace(flying, measured=seen.measured(4.25, 0.0625)), 0.0625)
    gui.named("Value").value = 0.75
    gui.named("For (s), 0: permanently").value = 2.5
    gui.named("Inject").use(seen.server)
    gui.named("Clear faults").use(seen.server)
    gui.named("Look at the robot").use(seen.server)
    seen.server.camera.position, seen.server.camera.look_at = np.arange(3.0), np.ones(3)
    gui.named("Follow the robot").use(seen.server, True)
    gui.named("Dark or light").use(seen.server)
    later = replace(flying, measured=seen.measured(5.5, 0.125))
    seen.show(replace(later, momenta=Momenta(np.arange(6.0) / 90, None)))
    act.editor.show_check(
        GoalCheck(Verdict.REACHABLE, "In 8 s.", np.linspace(0.1, 0.6, len(names)))
    )
    seen.show(replace(flying, measured=seen.measured(7.0, 0.25)))
    return seen.shown()


def _controlled() -> dict[str, Any]:
    """A controller flies base and end-effector of a planar robot, which others show in dark."""
    seen = _Situation("planar_manipulator", dark=True)
    hand = np.array([1.0, 0.5, -0.25, 0.0, 0.6, 0.0, 0.8])
    flying = StackState(
        measured=seen.measured(2.0, 0.5),
        tool=hand,
        age_s=0.1,
        momenta=Momenta(np.arange(6.0), np.arange(6.0) + 1e-6),
        controller=ControllerStatus(ControllerState.HOLDING, "Holds <this>."),
        goals={"base": _GOAL, "end_effector": _GOAL},
        absent=frozenset({"controller"}),
    )
    seen.show(flying)
    seen.server.scene.named("/goal").position = np.array([0.25, 0.5, 0.75])
    seen.server.scene.named("/goal").use(seen.server)
    seen.show(replace(flying, measured=seen.measured(3.0, 0.75)))
    seen.server.gui.named("Fly").use(seen.server)
    seen.server.gui.named("Goal for the end-effector").use(seen.server, False)
    seen.server.gui.named("Goal").use(seen.server, "Abort goal")
    seen.server.gui.named("Fly").use(seen.server)
    seen.page.editor.show_check(GoalCheck(Verdict.REFUSED, "Too far."))
    seen.show(replace(flying, measured=seen.measured(4.0, 1.0)))
    seen.server.gui.named("Goal to the robot").use(seen.server)
    seen.server.gui.named("View from").use(seen.server, "Top")
    for name in ("Names", "Frames"):
        seen.server.gui.named(name).use(seen.server, True)
    for name in ("Paths", "Ghost", "Plumes"):
        seen.server.gui.named(name).use(seen.server, False)
    seen.server.gui.named("Setting").use(seen.server, "Grid")
    seen.show(replace(flying, measured=seen.measured(5.0, 1.5)))
    return seen.shown()


def _replayed() -> dict[str, Any]:
    """A recording of sliding masses, in which a user jumps."""
    seen = _Situation("sliding_masses")
    replay = ReplayStatus(3.0, 41.5, state="playing", rate=2.0)
    state = StackState(measured=seen.measured(13.0, 0.0), age_s=2.5, replay=replay)
    seen.show(state)
    group = next(e for e in seen.server.gui.elements if e.shown.get("options") == ("Play", "Hold"))
    group.use(seen.server, "Hold")
    seen.server.gui.named("Time (s)").use(seen.server, 20.25)
    seen.show(replace(state, measured=seen.measured(14.0, 0.25)))
    seen.show(replace(state, replay=replace(replay, position_s=50.0)), 0.25)
    return seen.shown()


SITUATIONS: dict[str, Callable[[], dict[str, Any]]] = {
    "planned": _planned,
    "controlled": _controlled,
    "replayed": _replayed,
}


def viewer_prints(name: str) -> dict[str, Any]:
    """Return the page in a situation."""
    clock = type("Clock", (), {"monotonic": staticmethod(lambda: 101.0)})
    with patch.object(goal_editor, "time", clock), patch.object(page, "time", clock):
        return dict(json.loads(json.dumps(SITUATIONS[name]())))
