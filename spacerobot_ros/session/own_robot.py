"""A scenario of a robot that nobody has flown yet: what to mind, a goal to begin with, its file."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from spacerobot_ros.errors import PlanningError
from spacerobot_ros.model import RobotDescription, SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.rotations import quaternion_from_rotvec
from spacerobot_ros.model.urdf import mesh_file
from spacerobot_ros.planning import Goal
from spacerobot_ros.planning.execution.config import PlannerConfig
from spacerobot_ros.planning.methods.optimal.goal_specification import Turning
from spacerobot_ros.simulation import InitialState
from spacerobot_ros.simulation.trials import Problem, Trial

_FIRST_TURN = math.radians(5.0)
"""How far the base turns in the first scenario of a robot, rad."""

_LIGHT_BASE, _HEAVY_BASE = 0.2, 500.0
"""Masses of the base, over that of all it carries, between which the base moves visibly and is no
mere appendage."""

_SLOWEST, _FASTEST = 1e-3, 50.0
"""Joint speeds (m/s or rad/s) that are usual."""


def remarks(robot: RobotDescription) -> Iterator[str]:
    """Yield what an author of a URDF may want to mend, a sentence each with how.

    Nothing of it keeps the robot from flying: what does is refused when the file is read.
    """
    carried = robot.total_mass - robot.bodies[0].inertia.mass
    base = robot.bodies[0].inertia
    if carried > 0 and base.mass < _LIGHT_BASE * carried:
        yield (
            f"The base '{robot.base_link}' has {base.mass:.4g} kg and carries {carried:.4g} kg: it "
            "moves more than what it carries. If it stands for a mount, give it the mass and "
            "inertia of the spacecraft."
        )
    if carried > 0 and base.mass > _HEAVY_BASE * carried:
        yield (
            f"The base '{robot.base_link}' has {base.mass:.4g} kg, {base.mass / carried:.3g} times "
            "what it carries: the joints hardly move it."
        )
    if base.mass > 0 and not np.any(base.about_com):
        yield (
            f"The base '{robot.base_link}' is a point mass: give it an <inertia>, for a box of "
            "sides a, b, c ixx = m (b^2 + c^2) / 12 and so on."
        )
    for joint in robot.movable_joints:
        limits = joint.limits
        if limits.velocity == 0:
            yield (
                f"The joint '{joint.name}' has the velocity limit 0, so that it cannot move: give "
                f'<limit velocity="..."/> in {joint.unit}/s.'
            )
        elif math.isfinite(limits.velocity) and not _SLOWEST <= limits.velocity <= _FASTEST:
            yield (
                f"The joint '{joint.name}' moves at up to {limits.velocity:.4g} {joint.unit}/s: "
                f"check the unit of its velocity limit."
            )
        if limits.effort == 0:
            yield (
                f"The joint '{joint.name}' has the effort limit 0: driven by velocities it moves, "
                'driven by efforts it cannot. Give <limit effort="..."/> in N or N m.'
            )
    yield from _about_looks(robot)


def _about_looks(robot: RobotDescription) -> Iterator[str]:
    missing = [
        shape.resource
        for link in robot.links
        for shape in link.shapes
        if shape.kind == "mesh" and mesh_file(shape.resource) is None
    ]
    if missing:
        more = f" and {len(missing) - 1} more" if len(missing) > 1 else ""
        yield (
            f"The mesh '{missing[0]}'{more} was not found: give a path beside the URDF, or source "
            "the workspace of its package. It is only a matter of looks."
        )
    if not any(link.shapes for link in robot.links):
        yield "No link has a <visual>: the robot is drawn as lines between its joints."
    if not robot.end_effector():
        yield (
            "No link is called 'end_effector': for coordinated control name one by the parameter "
            "end_effector_frame."
        )


def first_shape(robot: SpaceRobot) -> Array:
    """Return a shape (n,), m or rad, with room to all sides: the middle of narrow joint limits.

    Joints that reach both ways from zero by a third of their range stay at zero, where a URDF is
    usually drawn.
    """
    lower, upper = robot.lower, robot.upper
    bounded = np.isfinite(lower) & np.isfinite(upper)
    middle = np.where(bounded, (np.where(bounded, lower, 0) + np.where(bounded, upper, 0)) / 2, 0)
    room = np.minimum(-lower, upper)
    near = bounded & (room < np.where(bounded, upper - lower, 0) / 3)
    shape = np.where(near, middle, 0.0)
    return np.asarray(np.round(np.clip(shape, lower, upper), 3))


def first_problem(name: str, robot: SpaceRobot, file: Path) -> Problem:
    """Return the problem to turn the base a little, about an axis that its joints turn it about.

    Raises
    ------
    PlanningError
        The joints do not turn the base.
    """
    turning = Turning.of(robot)
    if not len(turning.axes):
        how = "only to and fro along one curve of attitudes" if turning.moves else "not at all"
        raise PlanningError(
            f"The joints of '{robot.description.name}' turn its base {how}: there is no attitude "
            "to fly to, and so no scenario is written. `spacerobot analyze` says more."
        )
    axis = turning.axes[0] if len(turning.axes) == 1 else np.array([0.0, 0.0, 1.0])
    goal = Goal.checked([0.0, 0.0, 0.0], quaternion_from_rotvec(_FIRST_TURN * axis))
    config = PlannerConfig(robot=str(file))
    initial = InitialState(joint_positions=first_shape(robot))
    return Problem(name, robot, initial, goal, config)


def fastest(found: Mapping[str, object]) -> Trial | None:
    """Return the trial that reaches its goal in the shortest time, None if none does."""
    reached = [each for each in found.values() if isinstance(each, Trial) and each.reached]
    return min(reached, key=lambda trial: trial.duration, default=None)


def scenario_text(problem: Problem, method: str, robot_path: str) -> str:
    """Return a parameter file that flies a problem by a method; see docs/own_robot.md."""
    x, y, z, w = (float(value) for value in problem.goal.quaternion)
    assert problem.initial.joint_positions is not None
    shape = ", ".join(repr(float(q)) for q in problem.initial.joint_positions)
    joints = ", ".join(problem.robot.joint_names)
    rate, config = problem.config.tick_rate, problem.config
    lines = [
        f"# The first flight of {problem.robot.description.name}: its joints turn its base.",
        "",
        "scenario:",
        "  ros__parameters:",
        f"    description: The joints of {problem.robot.description.name} turn its base",
        f"    goal_orientation: [{x!r}, {y!r}, {z!r}, {w!r}]   # x y z w; or goal_rotvec, rad",
        "    # goal_position: [0.0, 0.0, 0.0]         # m",
        f"    # goal_joint_positions: [{shape}]   # the shape to end in",
        "",
        "/**/plant:",
        "  ros__parameters:",
        f"    robot: {robot_path}",
        f"    tick_rate: {rate!r}",
    ]
    if problem.robot.n:
        lines.append(f"    initial_joint_positions: [{shape}]   # {joints}")
    lines += [
        "",
        "/**/planner:",
        "  ros__parameters:",
        f"    robot: {robot_path}",
        f"    tick_rate: {rate!r}",
        f"    method: {method}",
        f"    attitude_tolerance: {config.attitude_tolerance!r}   # rad",
        f"    position_tolerance: {config.position_tolerance!r}   # m",
        "",
    ]
    return "\n".join(lines)
