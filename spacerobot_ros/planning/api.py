"""Python planning API: from a robot and a goal to a gait."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from spacerobot_ros.errors import GoalError, ParameterError, counted
from spacerobot_ros.model import RobotDescription, SpaceRobot
from spacerobot_ros.model.integration import DEFAULT_INTEGRATION_STEP
from spacerobot_ros.model.rotations import quaternion_from_rotvec
from spacerobot_ros.model.urdf import load_world, with_world
from spacerobot_ros.parameters import as_numbers
from spacerobot_ros.planning.core.clearance import DEFAULT_CLEARANCE, Clearance
from spacerobot_ros.planning.core.goal import (
    EndEffectorGoal,
    Goal,
    RobotState,
    Tolerance,
    warn_of_large_angles,
)
from spacerobot_ros.planning.core.method import END_EFFECTOR_METHOD, PATH_METHOD, PlanRequest
from spacerobot_ros.planning.core.schedule import GaitSchedule
from spacerobot_ros.planning.methods.registry import build_method, method_options
from spacerobot_ros.resources import robot_file

EndEffectorValues = npt.ArrayLike | Mapping[str, npt.ArrayLike]
"""Goal values of one end-effector, or of several end-effectors by link name."""

_DEFAULT_TOLERANCE = Tolerance(1e-6, 1e-6, 1e-6)


def plan(
    robot: SpaceRobot | str | Path,
    goal: Goal | None = None,
    *,
    position: npt.ArrayLike | None = None,
    rotvec: npt.ArrayLike | None = None,
    joint_positions: npt.ArrayLike | None = None,
    end_effector_position: EndEffectorValues | None = None,
    end_effector_pose: EndEffectorValues | None = None,
    end_effector_path: EndEffectorValues | None = None,
    end_effector: str = "",
    start: RobotState | npt.ArrayLike | None = None,
    linear_momentum: npt.ArrayLike | None = None,
    angular_momentum: npt.ArrayLike | None = None,
    method: str | None = None,
    control_period: float = 0.05,
    tolerance: Tolerance = _DEFAULT_TOLERANCE,
    integration_step: float = DEFAULT_INTEGRATION_STEP,
    clearance: float = DEFAULT_CLEARANCE,
    world: RobotDescription | str | Path | None = None,
    **options: Any,
) -> GaitSchedule:
    """Plan a gait: ``plan("sliding_masses", position=(0.3, 0, 0.1), rotvec=(0.5, 0, 0))``.

    With an end-effector goal, as in ``plan("three_joint_arm", end_effector_position=(2, 1, 0.5))``,
    the base is free except for the given components of its pose.

    Parameters
    ----------
    robot
        The model, a URDF file, or the name of a robot in this package.
    goal
        The goal, or instead of it a base goal given by ``position`` (3,) in m (default: the origin)
        and ``rotvec`` (3,) in rad (exponential coordinates; default: no rotation), and the final
        ``joint_positions`` (n,) in m or rad.
    end_effector_position, end_effector_pose
        Position (3,) in m, or position and quaternion (7,), of the link ``end_effector`` (a name;
        empty: the default end-effector); or a mapping from several link names to such values.
    end_effector_path
        Positions (K, 3) in m, or positions and quaternions (K, 7), through which one end-effector
        moves along straight lines; the last position or pose is the goal.
    start
        The start: a state, or a shape (n,) at the origin of W; None: joints as near 0 as allowed.
    linear_momentum, angular_momentum
        (3,) each in W, kg m/s and kg m^2/s; angular momentum is about the centre of mass; None: the
        momenta of the start state. Only ``optimal`` plans for drifting robots.
    method
        Name of a gait method with ``options``. None: ``resolved_rate`` for paths, else ``optimal``.
    control_period, tolerance, integration_step
        Command duration (s), largest error at the goal, and longest prediction step (s). Use the
        plant's values so that the flight ends where planned.
    clearance
        Smallest distance between links, m; 0: none is checked, but 0.01 m if there are obstacles.
    world
        Obstacles in the world (:func:`.load_world`), or their URDF; None: those of the robot.

    Raises
    ------
    PlanningError
        The goal is invalid or cannot be reached; the message says why.
    ParameterError
        The robot, the method or an option does not exist or is invalid, or a momentum is invalid.
    RobotDescriptionError
        The robot or the world is invalid.
    """
    if not isinstance(robot, SpaceRobot):
        robot = SpaceRobot.from_file(robot_file(str(robot)))
    if goal is None:
        hands = end_effector_goals(
            end_effector_position, end_effector_pose, end_effector, path=end_effector_path
        )
        quaternion = None if rotvec is None else quaternion_from_rotvec(rotvec)
        if rotvec is not None:
            warn_of_large_angles(rotvec)
        if hands:
            goal = Goal.of_end_effectors(
                hands, position=position, quaternion=quaternion, joint_positions=joint_positions
            )
        else:
            goal = Goal.checked(position, quaternion, joint_positions)
    goal = goal.for_robot(robot.description)
    method = method or (PATH_METHOD if goal.has_path else END_EFFECTOR_METHOD)
    options_of_method = {method: method_options(method, options)}
    described = robot.description
    if world is not None:
        world = world if isinstance(world, RobotDescription) else load_world(world)
        described = with_world(described, world)
    planner = build_method(
        method,
        robot,
        control_period,
        integration_step,
        options_of_method,
        Clearance.wanted(described, clearance),
    )
    momenta = {"linear_momentum": linear_momentum, "angular_momentum": angular_momentum}
    given = {name: _momentum(name, each) for name, each in momenta.items() if each is not None}
    state = replace(_start_state(robot, start), **given)
    return planner.plan(PlanRequest(state, goal, tolerance))


def _momentum(name: str, given: npt.ArrayLike) -> npt.NDArray[np.float64]:
    momentum = np.asarray(given, dtype=float)
    if momentum.shape != (3,) or not np.all(np.isfinite(momentum)):
        raise ParameterError(f"The {name} is {momentum.tolist()}; it must be three finite numbers.")
    return momentum


def end_effector_goals(
    position: EndEffectorValues | None,
    pose: EndEffectorValues | None,
    link: str = "",
    *,
    path: EndEffectorValues | None = None,
) -> tuple[EndEffectorGoal, ...]:
    """Return end-effector goals from positions, poses and paths, of one ``link`` or by link name.

    Raises
    ------
    GoalError
        A goal is neither a position nor a pose, a link has two goals, or the link is given twice.
    """
    goals = []
    for values, count in ((position, 3), (pose, 7), (path, None)):
        if values is None:
            continue
        by_link = values if isinstance(values, Mapping) else {link: values}
        if link and isinstance(values, Mapping):
            raise GoalError(
                f"The end-effector goals are given by name, but '{link}' is also given as a link."
            )
        for name, numbers in by_link.items():
            if count is None:
                goals.append(EndEffectorGoal.along(str(name), numbers))
                continue
            goal = EndEffectorGoal.checked(str(name), numbers)
            if len(goal.values) != count:
                kind = "a position has 3" if count == 3 else "a pose has 7"
                raise GoalError(f"The end-effector goal has {len(goal.values)} numbers; {kind}.")
            goals.append(goal)
    if goals:
        Goal.of_end_effectors(goals)
    elif link:
        raise GoalError(f"The end-effector '{link}' has no goal: give its position or its pose.")
    return tuple(goals)


def _start_state(robot: SpaceRobot, start: RobotState | npt.ArrayLike | None) -> RobotState:
    if isinstance(start, RobotState):
        return start
    q = np.clip(np.zeros(robot.n), robot.lower, robot.upper)
    if start is not None:
        q = as_numbers(start, "The start")
    if q.shape != (robot.n,):
        raise ParameterError(
            f"The start has {counted(q.size, 'joint position')}, but robot "
            f"'{robot.description.name}' has {counted(robot.n, 'joint')}."
        )
    for k in np.flatnonzero(~((robot.lower - 1e-6 <= q) & (q <= robot.upper + 1e-6)))[:1]:
        raise ParameterError(
            f"The start of joint '{robot.joint_names[k]}', {q[k]:g}, is outside its limits "
            f"[{robot.lower[k]:g}, {robot.upper[k]:g}]."
        )
    return RobotState(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), q)
