"""The executive of a controller, with a test in the place of the plant; no ROS."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from spacerobot_ros.control import ControlState, Reference
from spacerobot_ros.control.config import ControllerConfig
from spacerobot_ros.control.controller import build_controller
from spacerobot_ros.control.executive import ControlExecutive
from spacerobot_ros.control.goals import GOAL_KEYS
from spacerobot_ros.control.status import ControllerState, ControllerStatus
from spacerobot_ros.events import Event
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.parameters import configured
from spacerobot_ros.planning import Goal
from spacerobot_ros.planning.execution.goal_file import GoalFile, IdentifiedGoal, PursuedGoals

Array = npt.NDArray[np.float64]

URDF = Path(__file__).parents[2] / "urdf" / "planar_manipulator.urdf"
AIM = np.array([0.5, 0.25, 0.0])
SHAPE = np.array([-1.0, 1.0])
SHAPE_IS_CONTROLLED: dict[str, Any] = {"base_outputs": "x y rz", "joint_outputs": "shoulder elbow"}
# The links are a metre long and the shoulder is half a metre from the centre of the base.
TIP = np.array([0.5 + math.cos(-1.0) + 1.0, math.sin(-1.0), 0.0])
KP, KD = 30.0, 60.0
STEP: dict[str, Any] = {
    "profile": "step",
    **{
        f"gains.{group}.{name}": gain
        for group in (
            "base_position",
            "base_attitude",
            "end_effector_position",
            "end_effector_attitude",
        )
        for name, gain in (("kp", KP), ("kd", KD))
    },
    "gains.joints.kp": 4.0,
    "gains.joints.kd": 4.0,
}
"""Parameters of the controller whose commands tests compute: goals at once, gains given."""

UPRIGHT = np.array([0.0, 0.0, 0.0, 1.0])
PERIOD = 0.01


@cache
def planar_manipulator() -> SpaceRobot:
    return SpaceRobot.from_file(URDF)


def goal_at(
    position: npt.ArrayLike, goal_id: str = "", shape: Array | None = None
) -> IdentifiedGoal:
    return IdentifiedGoal(Goal(np.asarray(position, dtype=float), UPRIGHT, shape), goal_id)


class ExecutiveLoop:
    """A controller of the planar manipulator, and a robot that is where it is put.

    Its axes are the world's. At rest the law (29) then commands the force ``Kp`` times the errors
    of base and end-effector together, since the work of a force on the base moves both.
    """

    def __init__(self, goal_file: Path | None = None, **settings: Any) -> None:
        defaults = {"tick_rate": 1 / PERIOD, "status_period": 0.01, **STEP}
        self.config = configured(ControllerConfig, {**defaults, **settings})
        self._statuses: list[ControllerStatus] = []
        self._events: list[Event] = []
        self.warnings: list[str] = []
        self.file = GoalFile(str(goal_file or ""), GOAL_KEYS)
        controller = build_controller(planar_manipulator(), self.config)
        self.executive = ControlExecutive(controller, self.config)
        self.tick = 0
        self.place, self.velocity, self.rates = np.zeros(3), np.zeros(3), np.zeros(2)

    def aim(self, **goals: IdentifiedGoal) -> None:
        for key, goal in goals.items():
            self.executive.submit(key, goal)

    def configure(self, **settings: Any) -> None:
        self.config = replace(self.config, **settings)
        self.executive.configure(self.config)

    def answer(
        self, ticks: int = 1, *, measured: bool = True, reference: Reference | None = None
    ) -> tuple[Array, Array]:
        """Show states; return the wrench and the efforts for the last one."""
        for _ in range(ticks):
            self.tick += 1
            state = ControlState(self.place, UPRIGHT, self.velocity, np.zeros(3), SHAPE, self.rates)
            result = self.executive.command(
                self.tick * PERIOD, state if measured else None, SHAPE, self.rates, reference
            )
            self.executive.evaluate(self.tick * PERIOD, result)
            self.take()
        return result.realised.wrench_B, result.realised.tau

    def take(self) -> None:
        while self.executive.outputs:
            match self.executive.outputs.popleft():
                case Event() as event:
                    self._events.append(event)
                case PursuedGoals() as pursued:
                    if problem := self.file.pursue(pursued):
                        self.warnings.append(problem)
                case ControllerStatus() as status:
                    self._statuses.append(status)
                    if status.state.decided:
                        refused = status.state is ControllerState.REFUSED
                        self.file.end(status.goal_id, refused=refused)

    @property
    def statuses(self) -> list[ControllerStatus]:
        """What was reported of goals so far."""
        self.take()
        return self._statuses

    @property
    def events(self) -> list[Event]:
        """The events so far."""
        self.take()
        return self._events

    @property
    def status(self) -> ControllerStatus:
        return self.statuses[-1]

    @property
    def state(self) -> str:
        return self.status.state.value
