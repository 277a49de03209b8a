"""Goals of motions under thrust."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array, RobotDescription
from spacerobot_ros.model.rotations import compose_poses, relative_pose
from spacerobot_ros.model.target_motion import TorqueFreeMotion
from spacerobot_ros.planning.core.goal import end_effector_pose


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
    still = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    there = np.concatenate(end_effector_pose(robot, link, still[:3], still[3:], shape))
    return compose_poses(hand, relative_pose(there, still))
