"""First scenario for a user's robot: notes on the URDF, a goal, and the scenario file."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from xml.etree.ElementTree import fromstring

import numpy as np

from spacerobot_ros.errors import PlanningError, counted
from spacerobot_ros.flight.trials import PlanningProblem
from spacerobot_ros.model import RobotDescription, SpaceRobot
from spacerobot_ros.model.description import Array, Joint
from spacerobot_ros.model.rotations import quaternion_from_rotvec, rotvec_from_quaternion
from spacerobot_ros.model.thrusters import IN_URDF, find_thrusters
from spacerobot_ros.model.urdf import describe_inertia_flaw, mesh_file
from spacerobot_ros.planning import Goal
from spacerobot_ros.planning.core.clearance import usual_clearance
from spacerobot_ros.planning.execution.config import PlannerConfig
from spacerobot_ros.planning.methods.optimal.goal_specification import BaseRotations
from spacerobot_ros.simulation import InitialState

_LARGEST_FIRST_ROTATION = math.radians(5.0)  # rad
_MAX_USUAL_LIMIT = 4 * math.pi  # rad; larger ones may be in degrees

_LARGEST_SHARE_OF_DISTANCE_TO_LIMIT = 0.5
"""Maximum fraction of the distance between a joint and its limits that the first rotation uses."""

_LARGEST_COUNTED_DISTANCE_TO_LIMIT = 1.0
"""Maximum distance, m or rad, that a joint moves towards its limit; beyond this, linearisation
fails.
"""

_LEAST_ROTATION_WITHOUT_LOOPS = math.radians(0.2)
"""Smallest first rotation without joint loops, rad."""

_ROTATION_TO_TOLERANCE = 50.0

_LEAST_BASE_MASS_RATIO, _LARGEST_BASE_MASS_RATIO = 0.2, 500.0
"""Usual ratios of the base mass to the mass of all other bodies."""

_LEAST_USUAL_SPEED, _LARGEST_USUAL_SPEED = 1e-3, 50.0
"""Usual joint speeds, m/s or rad/s."""


def has_thrusters(robot: RobotDescription) -> bool:
    """Whether the URDF has ``<thruster>`` elements."""
    return fromstring(robot.urdf).find("thruster") is not None


def urdf_remarks(robot: RobotDescription) -> Iterator[str]:
    """Yield notes on unusual values in a URDF, each with a remedy.

    The robot can still fly; errors are reported when the URDF is read.
    """
    carried = robot.total_mass - robot.bodies[0].inertia.mass
    base = robot.bodies[0].inertia
    if carried > 0 and base.mass < _LEAST_BASE_MASS_RATIO * carried:
        yield (
            f"The base '{robot.base_link}' has a mass of {base.mass:.4g} kg and carries "
            f"{carried:.4g} kg, so the base moves more than its load. If the base represents a "
            f"mount, "
            "give it the mass and inertia of the spacecraft."
        )
    if carried > 0 and base.mass > _LARGEST_BASE_MASS_RATIO * carried:
        yield (
            f"The base '{robot.base_link}' has a mass of {base.mass:.4g} kg, "
            f"{base.mass / carried:.3g} times its load: the joints hardly move it."
        )
    if base.mass > 0 and not np.any(base.about_com):
        yield (
            f"The base '{robot.base_link}' is a point mass: give it an <inertia> (for a box "
            "with sides a, b and c: ixx = m (b^2 + c^2) / 12, and so on)."
        )
    if has_thrusters(robot) and (missing := find_thrusters(IN_URDF, robot).missing()):
        yield f"The thrusters cannot produce {missing}."
    found: dict[int, list[str]] = {}
    for joint in robot.movable_joints:
        for kind, remark in _joint_remarks(joint, is_wheel=joint.name in robot.wheel_names):
            found.setdefault(kind, []).append(remark)
    for _, remarks in sorted(found.items()):
        others = counted(len(remarks) - 1, "other joint")
        yield remarks[0] + (f" The same applies to {others}." if remarks[1:] else "")
    for link in robot.links:
        # A body with such an inertia is refused; a welded link is not.
        if flaw := describe_inertia_flaw(link.inertia.about_com):
            yield (
                f"The inertia of link '{link.name}' {flaw} The links welded to it compensate for "
                "this."
            )
    # Notes on distances name the meshes that contacts need.
    pictures = {
        shape.resource: None
        for link in robot.links
        for shape in link.shapes
        if shape.kind == "mesh" and link.collisions
    }
    solid = {shape.resource for link in robot.links for shape in link.collisions or link.shapes}
    absent = [each for each in pictures if each not in solid and mesh_file(each) is None]
    if absent:
        more = f" (and {len(absent) - 1} more)" if len(absent) > 1 else ""
        yield (
            f"The mesh '{absent[0]}' was not found{more}: give a path relative to the URDF, or "
            "source the workspace of its package. Only pictures need it."
        )
    coloured = [
        link.get("name", "")
        for link in fromstring(robot.urdf).iterfind("link")
        if any(len(visual.findall("material")) > 1 for visual in link.iterfind("visual"))
    ]
    if coloured:
        more = f" (and {counted(len(coloured) - 1, 'other link')})" if coloured[1:] else ""
        yield (
            f"A <visual> of link '{coloured[0]}'{more} has several <material> elements, of which "
            "the first is used. Only pictures need it."
        )
    if not any(link.shapes for link in robot.links):
        yield "No link has a <visual>: the robot is drawn as lines between its joints."
    if not robot.end_effector():
        yield (
            "No link is named 'end_effector': for coordinated control, set the parameter "
            "coordinated_control.end_effector_frame."
        )


def _joint_remarks(joint: Joint, *, is_wheel: bool) -> Iterator[tuple[int, str]]:
    limits, unit, speed = joint.limits, joint.unit, joint.limits.velocity
    if speed == 0:
        yield (
            0,
            f"The joint '{joint.name}' has a velocity limit of 0, so it cannot move: give "
            f'<limit velocity="..."/> in {unit}/s.',
        )
    elif math.isinf(speed):
        yield (
            1,
            f"The joint '{joint.name}' has no velocity limit, which planning requires: give "
            f'<limit velocity="..." effort="..."/> in {unit}/s and '
            f"{'N' if unit == 'm' else 'N m'}.",
        )
    elif not (is_wheel or _LEAST_USUAL_SPEED <= speed <= _LARGEST_USUAL_SPEED):
        yield (
            2,
            f"The joint '{joint.name}' moves at up to {speed:.4g} {unit}/s: check the unit of "
            "its velocity limit.",
        )
    if unit == "rad" and _MAX_USUAL_LIMIT < max(-limits.lower, limits.upper) < math.inf:
        yield (
            3,
            f"The joint '{joint.name}' ranges from {limits.lower:.4g} to {limits.upper:.4g} rad: "
            "URDF limits are in rad, not in degrees.",
        )
    if limits.effort == 0:
        yield (
            4,
            f"The joint '{joint.name}' has an effort limit of 0: it moves under velocity commands, "
            'but not under effort commands. Give <limit effort="..."/> in N or N m.',
        )


def first_shape(robot: SpaceRobot) -> Array:
    """Return joint positions (n,), m or rad, far from all limits; for narrow ranges, the middle.

    Joints that can move by a third of their range in both directions from zero stay at zero, the
    position in which URDFs are usually drawn.
    """
    lower, upper = robot.lower, robot.upper
    bounded = np.isfinite(lower) & np.isfinite(upper)
    middle = np.where(bounded, (np.where(bounded, lower, 0) + np.where(bounded, upper, 0)) / 2, 0)
    room = np.minimum(-lower, upper)
    near = bounded & (room < np.where(bounded, upper - lower, 0) / 3)
    shape = np.where(near, middle, 0.0)
    return np.asarray(np.round(np.clip(shape, lower, upper), 3))


def first_problem(
    name: str, robot: SpaceRobot, file: Path, *, clear: bool = True
) -> PlanningProblem:
    """Return the problem of a small base rotation about an axis that joint motion can produce.

    If ``clear`` is true, the plan avoids contacts between links, which requires the link meshes.

    Raises
    ------
    PlanningError
        The joints cannot rotate the base.
    """
    turning = BaseRotations.of(robot)
    if not len(turning.axes):
        how = (
            "only back and forth along one curve of attitudes"
            if turning.turns_base
            else "not at all"
        )
        raise PlanningError(
            f"The joints of '{robot.description.name}' rotate its base {how}: there is no "
            f"attitude goal, so no scenario is written. `spacerobot analyze` says more."
        )
    shape = first_shape(robot)
    turn = first_turn(robot, shape, turning.axes)
    angle = float(np.linalg.norm(turn))
    goal = Goal.checked([0.0, 0.0, 0.0], quaternion_from_rotvec(turn))
    config = PlannerConfig(robot=str(file)).for_robot(robot.description)
    tolerance = min(config.attitude_tolerance, float(f"{angle / _ROTATION_TO_TOLERANCE:.1g}"))
    clearance = usual_clearance(robot.description) if clear else 0.0
    config = replace(config, attitude_tolerance=tolerance, clearance=clearance)
    return PlanningProblem(name, robot, InitialState(joint_positions=shape), goal, config)


def first_turn(robot: SpaceRobot, shape: Array, axes: Array) -> Array:
    """Return a base rotation (3,), rad, that the joints produce without loops.

    The rotation is 5 degrees about z, y or x, or about the only axis in ``axes`` (m, 3), if
    half of the joint ranges around a configuration (n,) suffice to first order. If the arms are
    too light for this, the rotation is smaller, about the axis with the largest rotation.
    """
    room = np.minimum(robot.upper - shape, shape - robot.lower)
    F = robot.connection(shape)[3:] * np.minimum(room, _LARGEST_COUNTED_DISTANCE_TO_LIMIT)
    usual = _LARGEST_FIRST_ROTATION * (axes if len(axes) == 1 else np.eye(3)[::-1])
    for turn in usual:
        ways = np.linalg.pinv(F, rcond=1e-6) @ turn
        if (
            np.allclose(F @ ways, turn, atol=1e-9)
            and np.abs(ways).max() <= _LARGEST_SHARE_OF_DISTANCE_TO_LIMIT
        ):
            return np.asarray(turn)
    U, sizes, _ = np.linalg.svd(F, full_matrices=False)
    angle = min(_LARGEST_FIRST_ROTATION, _LARGEST_SHARE_OF_DISTANCE_TO_LIMIT * float(sizes[0]))
    if angle < _LEAST_ROTATION_WITHOUT_LOOPS:
        return np.asarray(usual[0])
    axis = np.round(U[:, 0] * np.sign(U[np.argmax(np.abs(U[:, 0])), 0]), 3) + 0.0
    degrees = float(f"{math.degrees(angle):.2g}")
    return np.asarray(math.radians(degrees) * axis / np.linalg.norm(axis))


def scenario_text(problem: PlanningProblem, method: str, robot_path: str) -> str:
    """Return a parameter file for a flight that solves a problem with a method; see
    docs/own_robot.md.
    """
    x, y, z, w = (float(value) for value in problem.goal.quaternion)
    assert problem.initial.joint_positions is not None
    shape = ", ".join(repr(float(q)) for q in problem.initial.joint_positions)
    joints = ", ".join(problem.robot.joint_names)
    rate, config = 1.0 / problem.control_period, problem.config
    turn = rotvec_from_quaternion(problem.goal.quaternion)
    angle = math.degrees(float(np.linalg.norm(turn)))
    axis = ", ".join(f"{each:.3g}" for each in turn / np.linalg.norm(turn) + 0.0)
    name = problem.robot.description.name
    clearance = ""
    if config.clearance < PlannerConfig.clearance:
        why = (
            "for a small robot"
            if config.clearance
            else "contacts are not detected: meshes of <collision> are missing"
        )
        clearance = f"    clearance: {config.clearance!r}   # m; {why}\n"
    start = f"    initial_joint_positions: [{shape}]   # {joints}\n" if problem.robot.n else ""
    return f"""\
# The first flight of {name}: its joints rotate its base.

scenario:
  ros__parameters:
    description: The joints of {name} rotate its base
    # {angle:.3g} deg about ({axis})
    goal_orientation: [{x!r}, {y!r}, {z!r}, {w!r}]   # x y z w; or goal_rotvec, rad
    # goal_position: [0.0, 0.0, 0.0]         # m
    # goal_joint_positions: [{shape}]   # final joint positions

/**/plant:
  ros__parameters:
    robot: {robot_path}
    tick_rate: {rate!r}
{start}
/**/planner:
  ros__parameters:
    robot: {robot_path}
    method: {method}
    attitude_tolerance: {config.attitude_tolerance!r}   # rad
    position_tolerance: {config.position_tolerance!r}   # m
{clearance}"""


def thruster_scenario_text(robot: SpaceRobot, robot_path: str) -> str:
    """Return a parameter file for a flight in which thrusters move and rotate a robot without
    joints.
    """
    name, thrusters = robot.description.name, ""
    limits = """\
    max_force: 0.0    # N, of the thrusters; 0: no limit
    max_torque: 0.0   # N m
"""
    if has_thrusters(robot.description):
        thrusters = "    thrusters: urdf\n"
        # Pulses leave larger errors than the default tolerances.
        limits = "    position_tolerance: 0.005   # m\n    attitude_tolerance: 0.01    # rad\n"
        if not find_thrusters(IN_URDF, robot.description).missing():
            limits += "    profile: planned\n    plan.thrusters: urdf\n"
    return f"""\
# The first flight of {name}, which has no joints: thrusters move and rotate it.

scenario:
  ros__parameters:
    description: Thrusters move {name} by 0.2 m and rotate it by 10 deg
    goal_position: [0.2, 0.0, 0.0]   # m
    goal_rotvec: [0.0, 0.0, {math.radians(10.0):.4g}]   # rad

/**/plant:
  ros__parameters:
    robot: {robot_path}
    tick_rate: 50.0
    actuation: effort
{thrusters}
/**/coordinated_control:
  ros__parameters:
    robot: {robot_path}
    tick_rate: 50.0
{limits}"""
