"""The Python API of planning: from a robot and a goal to a gait."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from spacerobot_ros.errors import ParameterError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.integration import DEFAULT_INTEGRATION_STEP
from spacerobot_ros.model.rotations import quaternion_from_rotvec
from spacerobot_ros.planning.core.goal import Goal, RobotState, Tolerance
from spacerobot_ros.planning.core.method import PlanRequest
from spacerobot_ros.planning.core.schedule import GaitSchedule
from spacerobot_ros.planning.methods.registry import build_method, method_options
from spacerobot_ros.resources import robot_file

_DEFAULT_TOLERANCE = Tolerance(1e-6, 1e-6, 1e-6)


def plan(
    robot: SpaceRobot | str | Path,
    goal: Goal | None = None,
    *,
    position: npt.ArrayLike = (0.0, 0.0, 0.0),
    rotvec: npt.ArrayLike = (0.0, 0.0, 0.0),
    joint_positions: npt.ArrayLike | None = None,
    start: RobotState | npt.ArrayLike | None = None,
    method: str = "optimal",
    control_period: float = 0.05,
    tolerance: Tolerance = _DEFAULT_TOLERANCE,
    integration_step: float = DEFAULT_INTEGRATION_STEP,
    **options: Any,
) -> GaitSchedule:
    """Plan a gait: ``plan("sliding_masses", position=(0.3, 0, 0.1), rotvec=(0.5, 0, 0))``.

    Parameters
    ----------
    robot
        The model, a URDF file, or the name of a robot of this package.
    goal
        Goal of the base; or ``position`` (3,) in m, ``rotvec`` (3,) in rad (exponential
        coordinates), and the final ``joint_positions`` (n,) in m or rad.
    start
        The start: a state, or the shape (n,) alone with the base at the origin of W; None is the
        shape zero, or as near to it as the joint limits allow.
    method
        Name of a gait method; ``options`` are its own.
    control_period, tolerance, integration_step
        Duration of a command (s), largest error at the goal, and longest step of the prediction
        (s): the plant's, for a flight that ends where the plan does.

    Raises
    ------
    PlanningError
        The goal is refused or cannot be reached; the message says why.
    ParameterError
        There is no such robot, method or option, or one is refused.
    """
    if not isinstance(robot, SpaceRobot):
        robot = SpaceRobot.from_file(robot_file(str(robot)))
    if goal is None:
        goal = Goal.checked(position, quaternion_from_rotvec(rotvec), joint_positions)
    options_of_method = {method: method_options(method, options)}
    planner = build_method(method, robot, control_period, integration_step, options_of_method)
    return planner.plan(PlanRequest(_start_state(robot, start), goal, tolerance))


def _start_state(robot: SpaceRobot, start: RobotState | npt.ArrayLike | None) -> RobotState:
    if isinstance(start, RobotState):
        return start
    q = np.clip(np.zeros(robot.n), robot.lower, robot.upper)
    if start is not None:
        q = np.asarray(start, dtype=float)
    if q.shape != (robot.n,):
        raise ParameterError(
            f"The start has {q.size} joint position(s); robot '{robot.description.name}' has "
            f"{robot.n} joints."
        )
    return RobotState(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), q)
