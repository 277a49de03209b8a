"""The Python API of planning: from a robot and a goal to a gait."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from spacerobot_ros.errors import GoalError, ParameterError
from spacerobot_ros.model import RobotDescription, SpaceRobot
from spacerobot_ros.model.integration import DEFAULT_INTEGRATION_STEP
from spacerobot_ros.model.rotations import quaternion_from_rotvec
from spacerobot_ros.model.urdf import load_world
from spacerobot_ros.model.world import with_world
from spacerobot_ros.planning.core.clearance import DEFAULT_CLEARANCE, Clearance
from spacerobot_ros.planning.core.goal import EndEffectorGoal, Goal, RobotState, Tolerance
from spacerobot_ros.planning.core.method import END_EFFECTOR_METHOD, PATH_METHOD, PlanRequest
from spacerobot_ros.planning.core.schedule import GaitSchedule
from spacerobot_ros.planning.methods.registry import build_method, method_options
from spacerobot_ros.resources import robot_file

EndEffectorValues = npt.ArrayLike | Mapping[str, npt.ArrayLike]
"""Values of the goal of one end-effector, or of several by the names of their links."""

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

    With a goal of an end-effector, ``plan("three_joint_arm", end_effector_position=(2, 1, 0.5))``,
    the base is free except for the given parts of its pose.

    Parameters
    ----------
    robot
        The model, a URDF file, or the name of a robot of this package.
    goal
        The goal; or, of the base, ``position`` (3,) in m (the origin) and ``rotvec`` (3,) in rad
        (exponential coordinates; no rotation), and the final ``joint_positions`` (n,) in m or rad.
    end_effector_position, end_effector_pose
        Position (3,) in m, or position and quaternion (7,), of the link ``end_effector`` (its name;
        empty: the default one); or of several links, by name.
    end_effector_path
        Positions (K, 3) in m, or positions and quaternions (K, 7), through which one end-effector
        moves on straight lines; the last one is its goal.
    start
        The start: a state, or the shape (n,) with the base at the origin of W; None: zero, or as
        near to zero as the joint limits allow.
    linear_momentum, angular_momentum
        (3,) each in W, kg m/s and kg m^2/s, the second about the centre of mass; None: those of the
        start. Only ``optimal`` plans for robots that drift.
    method
        Name of a gait method; ``options`` are its own. None: ``resolved_rate`` for a goal with a
        path, otherwise ``optimal``.
    control_period, tolerance, integration_step
        Duration of a command (s), largest error at the goal, and longest step of the prediction
        (s). Use the plant's values for a flight that ends where the plan does.
    clearance
        Smallest distance of links during the motion, m; 0 disables collision checks. With
        obstacles, 0 means 0.01 m.
    world
        Obstacles that are fixed in the world (:func:`.load_world`), or their URDF file; None: those
        that the robot carries.

    Raises
    ------
    PlanningError
        The goal is refused or cannot be reached; the message says why.
    ParameterError
        The robot, the method or an option does not exist or is refused, or a momentum is refused.
    RobotDescriptionError
        The robot or the world is refused.
    """
    if not isinstance(robot, SpaceRobot):
        robot = SpaceRobot.from_file(robot_file(str(robot)))
    if goal is None:
        hands = end_effector_goals(
            end_effector_position, end_effector_pose, end_effector, path=end_effector_path
        )
        quaternion = None if rotvec is None else quaternion_from_rotvec(rotvec)
        if hands:
            goal = Goal.of_end_effectors(
                hands, position=position, quaternion=quaternion, joint_positions=joint_positions
            )
        else:
            goal = Goal.checked(
                (0.0, 0.0, 0.0) if position is None else position,
                (0.0, 0.0, 0.0, 1.0) if quaternion is None else quaternion,
                joint_positions,
            )
    goal = goal.for_robot(robot.description)
    method = method or (PATH_METHOD if goal.has_path else END_EFFECTOR_METHOD)
    options_of_method = {method: method_options(method, options)}
    planner = build_method(
        method,
        robot,
        control_period,
        integration_step,
        options_of_method,
        Clearance.wanted(_among_obstacles(robot, world), clearance),
    )
    state = _start_state(robot, start)
    for name, given in (
        ("linear_momentum", linear_momentum),
        ("angular_momentum", angular_momentum),
    ):
        if given is not None:
            state = replace(state, **{name: _momentum(name, given)})
    return planner.plan(PlanRequest(state, goal, tolerance))


def _momentum(name: str, given: npt.ArrayLike) -> npt.NDArray[np.float64]:
    momentum = np.asarray(given, dtype=float)
    if momentum.shape != (3,) or not np.all(np.isfinite(momentum)):
        raise ParameterError(f"The {name} is {momentum.tolist()}; it must be three finite numbers.")
    return momentum


def _among_obstacles(
    robot: SpaceRobot, world: RobotDescription | str | Path | None
) -> RobotDescription:
    if world is None:
        return robot.description
    if not isinstance(world, RobotDescription):
        world = load_world(world)
    return with_world(robot.description, world)


def end_effector_goals(
    position: EndEffectorValues | None,
    pose: EndEffectorValues | None,
    link: str = "",
    *,
    path: EndEffectorValues | None = None,
) -> tuple[EndEffectorGoal, ...]:
    """Return goals of end-effectors from positions, poses and paths: of one ``link``, or by name.

    Raises
    ------
    GoalError
        A goal is not a position or a pose, a link has two goals, or the link is given twice.
    """
    goals = []
    for values, count in ((position, 3), (pose, 7), (path, None)):
        if values is None:
            continue
        by_link = values if isinstance(values, Mapping) else {link: values}
        if link and isinstance(values, Mapping):
            raise GoalError(
                f"The goals of end-effectors are given by name, and '{link}' is named in addition."
            )
        for name, numbers in by_link.items():
            if count is None:
                goals.append(EndEffectorGoal.along(str(name), numbers))
                continue
            goal = EndEffectorGoal.checked(str(name), numbers)
            if len(goal.values) != count:
                kind = "a position has 3" if count == 3 else "a pose has 7"
                raise GoalError(
                    f"The goal of the end-effector has {len(goal.values)} numbers; {kind}."
                )
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
        q = np.asarray(start, dtype=float)
    if q.shape != (robot.n,):
        raise ParameterError(
            f"The start has {q.size} joint position(s); robot '{robot.description.name}' has "
            f"{robot.n} joints."
        )
    return RobotState(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), q)
