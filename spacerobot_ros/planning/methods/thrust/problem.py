"""Options and goals of motions under thrust, and the propulsion of the base."""

from __future__ import annotations

import math
from dataclasses import dataclass

import casadi as ca
import numpy as np

from spacerobot_ros.errors import NotFoundError, ParameterError, Proof, UnreachableError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array, Pose, RobotDescription
from spacerobot_ros.model.inverse_kinematics import REACHED_DISTANCE, FixedBaseArm, is_reached
from spacerobot_ros.model.rotations import compose_poses, matrix_from_quaternion, relative_pose
from spacerobot_ros.model.target_motion import TorqueFreeMotion
from spacerobot_ros.model.thrusters import ThrusterTable
from spacerobot_ros.parameters import parameter
from spacerobot_ros.planning.core.clearance import DEFAULT_CLEARANCE
from spacerobot_ros.planning.core.goal import end_effector_pose
from spacerobot_ros.planning.methods.optimal.problem import MotionOptions


@dataclass(frozen=True)
class ThrustOptions(MotionOptions):
    """Options of motions planned under thrust."""

    time_factor: float = parameter(
        1.5,
        "duration of a least-propellant motion, relative to the shortest motion; 1: the shortest "
        "motion",
        minimum=1.0,
        maximum=1e3,
    )
    duration: float = parameter(
        0.0,
        "duration of a motion; 0: determined by time_factor",
        unit="s",
        minimum=0.0,
        maximum=1e5,
    )
    reserve: float = parameter(
        0.2,
        "fraction of thrust and joint efforts reserved for the controller's feedback",
        minimum=0.0,
        maximum=0.9,
    )
    intervals: int = parameter(30, "steps of the problem", minimum=10, maximum=1000)
    iterations: int = parameter(
        300, "largest number of solver steps from one guess", minimum=1, maximum=100000
    )
    clearance: float = parameter(
        DEFAULT_CLEARANCE,
        "smallest distance between links, and between links and obstacles; 0: contacts are ignored",
        unit="m",
        minimum=0.0,
        maximum=1e3,
    )
    thrusters: str = parameter(
        "",
        "thruster table for plans: 'urdf' or a YAML file; '': any wrench within max_force and "
        "max_torque",
    )


@dataclass(frozen=True)
class Propulsion:
    """Levels (m,) whose wrench on the base is ``wrenches @ levels``, and their cost.

    Attributes
    ----------
    wrenches
        (6, m) force (N), then torque (N m) at the base link origin, in the base frame, at level
        one.
    cost
        (m,) cost per second at level one: kg of propellant if there is a table, else N s of
        impulse.
    is_table
        Whether the levels are those of thrusters, from 0 to 1. Otherwise they are the components of
        a force and a torque, each with a Euclidean norm of at most one.
    """

    wrenches: Array
    cost: Array
    is_table: bool

    @property
    def lowest(self) -> float:
        """Lowest level of each component."""
        return 0.0 if self.is_table else -1.0

    @classmethod
    def of_table(cls, table: ThrusterTable, reserve: float) -> Propulsion:
        """Return the propulsion for a thruster table, with a fraction of the levels reserved for
        feedback.

        Raises
        ------
        ParameterError
            The thrusters cannot produce every wrench.
        """
        missing = table.missing()
        if missing:
            raise ParameterError(
                f"The thrusters cannot produce {missing}; motions under thrust are planned for "
                "bases that can be pushed and rotated in every direction."
            )
        share = 1.0 - reserve
        return cls(share * table.wrenches, share * table.mass_flow, is_table=True)

    @classmethod
    def within(cls, force: float, torque: float, reserve: float) -> Propulsion:
        """Return the propulsion for bounds on the Euclidean norms of force (N) and torque (N m).

        Raises
        ------
        ParameterError
            A limit is not positive, or not finite.
        """
        for name, value in (("force", force), ("torque", torque)):
            if not (value > 0 and math.isfinite(value)):
                raise ParameterError(
                    f"The thruster {name} limit is {value:g}; motions under thrust require a "
                    f"finite limit: set max_{name}."
                )
        limits = (1.0 - reserve) * np.repeat([force, torque], 3)
        return cls(np.diag(limits), limits, is_table=False)

    def largest_force(self) -> float:
        """Return a bound on the force in any direction, N."""
        force = self.wrenches[:3]
        if not self.is_table:
            return float(force.max())
        one_way = np.maximum(force.clip(0.0).sum(axis=1), -force.clip(None, 0.0).sum(axis=1))
        return float(np.linalg.norm(one_way))

    def cost_of(self, levels: ca.MX | ca.DM, rounding: ca.MX | float = 0.0) -> ca.MX | ca.DM:
        """Return the cost of levels (m, N), each held for a second; norms are smoothed below the
        level ``rounding``.
        """
        if self.is_table:
            return ca.sum2(ca.DM(self.cost).T @ levels)
        sizes = (ca.sqrt(ca.sum1(each**2) + rounding**2) for each in ca.vertsplit(levels, 3))
        of_force, of_torque = (ca.sum2(each - rounding) for each in sizes)
        return self.cost[0] * of_force + self.cost[3] * of_torque


@dataclass(frozen=True)
class Grapple:
    """The goal to meet a target at any time, with the end-effector at the pose and the velocities
    of the grapple frame.

    Attributes
    ----------
    motion
        Target motion, beginning at the start of the robot's motion.
    description
        Target body, one link, from which the robot keeps clear; None: unknown.
    clearance
        Distance from the target body, m; 0: not checked.
    horizon
        Time within which the target must be met, s.
    detumbles
        Whether the total angular momentum of the robot and the target at the grasp must be zero or
        minimal.
    standoff
        (3,) position in the grapple frame, m, from which the end-effector would approach in a
        straight line.
    corridor_angle, corridor_length
        Half-angle, rad, of the cone about the direction of the standoff that the end-effector does
        not leave within a distance from the grapple frame, m; length 0: none.
    """

    motion: TorqueFreeMotion
    description: RobotDescription | None = None
    clearance: float = 0.0
    horizon: float = 120.0
    detumbles: bool = False
    standoff: tuple[float, ...] = (-0.3, 0.0, 0.0)
    corridor_angle: float = 0.0
    corridor_length: float = 0.0

    def require_in_time(self, center: Array, mass: float, force: float, arm: float) -> None:
        """Reject a target that a robot cannot meet within the horizon, given the position and the
        velocity (6,) of its centre of mass in W, its mass, its largest force and its reach, SI.
        """
        away = self.motion.center_of_mass(0.0) - center[:3]
        distance = float(np.linalg.norm(away))
        leaving = float((self.motion.velocity - center[3:]) @ away) / max(distance, 1e-9)
        near = max(distance - arm - self.motion.arm_length, 0.0)
        # From rest to the velocity of a body at this distance.
        a = force / mass
        least = max(leaving + 2 * math.sqrt(leaving**2 / 2 + a * near), abs(leaving)) / a
        if least > self.horizon:
            raise UnreachableError(
                f"The target is {distance:.3g} m away and recedes at {leaving:.3g} m/s: with a "
                f"force of {force:.3g} N, the robot meets it after {least:.4g} s at the earliest, "
                f"and 'target.horizon' is {self.horizon:g} s.",
                Proof.LIMITS,
            )


@dataclass(frozen=True)
class ThrustGoal:
    """Goal of a motion that ends at rest.

    ``base`` and ``end_effector`` are poses (7,), position and quaternion in W; ``end_effector`` may
    be None. ``shape`` contains joint positions (n,); NaN: a free joint; None: all joints are free.
    ``keeps_shape``: joints that are not free keep their initial positions throughout.
    """

    base: Array
    end_effector: Array | None = None
    shape: Array | None = None
    keeps_shape: bool = False


def base_for_hand(robot: SpaceRobot, link: str, shape: Array, hand: Array) -> Array:
    """Return the base pose (7,) for which a link has a given pose (7,) in a shape (n,)."""
    still = np.eye(7)[6]
    there = np.concatenate(end_effector_pose(robot, link, still[:3], still[3:], shape))
    return compose_poses(hand, relative_pose(there, still))


def shape_for_hand(robot: SpaceRobot, link: str, base: Array, hand: Array, q: Array) -> Array:
    """Return the shape (n,) close to ``q`` in which a link has the pose ``hand`` (7,), with the
    base at the pose ``base`` (7,).

    Raises
    ------
    NotFoundError
        No such shape was found.
    """
    poses = [Pose(matrix_from_quaternion(each[3:]), each[:3]) for each in (base, hand)]
    arm = FixedBaseArm(robot, link, poses[0])
    found, distance = arm.nearest_shape(q, poses[1])
    if distance > REACHED_DISTANCE:
        found, distance, angle = arm.search_shape(q, poses[1])
        if not is_reached(distance, angle):
            raise NotFoundError(
                f"No joint positions were found that put '{link}' at its goal while the base is at "
                f"its goal: {distance:.3g} m and {angle:.3g} rad remain."
            )
    return found
