"""Starts and goals of motions under thrust."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array, RobotDescription
from spacerobot_ros.model.grasp import combined_momenta
from spacerobot_ros.model.rotations import compose_poses, relative_pose
from spacerobot_ros.model.target_motion import TorqueFreeMotion
from spacerobot_ros.planning.core.goal import end_effector_pose
from spacerobot_ros.planning.methods.thrust.motion import ThrustMotion


@dataclass(frozen=True)
class ThrustStart:
    """Start of a motion: pose (7,) of the base and its twist ``v_WB_B``, ``omega_WB_B`` (3,),
    positions and velocities (n,) of the joints.
    """

    pose: Array
    v_WB_B: Array
    omega_WB_B: Array
    q: Array
    qdot: Array

    @classmethod
    def at_rest(cls, pose: Array, q: Array) -> ThrustStart:
        """Return a start without velocities."""
        return cls(pose, np.zeros(3), np.zeros(3), q, np.zeros(len(q)))


@dataclass(frozen=True)
class Grapple:
    """A target that the end-effector meets at any time: it then has the pose and the velocities of
    the grapple frame.

    Attributes
    ----------
    motion
        The motion of the target, beginning at the start of the robot's.
    description
        Its body, one link, from which the robot keeps clear; None: it is not known.
    clearance
        Distance from its body, m; 0: it is not checked.
    horizon
        Time within which it is met, s.
    detumbles
        Whether the total angular momentum of robot and target at the grasp must be zero or minimal.
    standoff
        (3,) a position in the grapple frame from which the end-effector would come straight, m.
    """

    motion: TorqueFreeMotion
    description: RobotDescription | None = None
    clearance: float = 0.0
    horizon: float = 120.0
    detumbles: bool = False
    standoff: tuple[float, ...] = (-0.3, 0.0, 0.0)

    def joined_momentum(self, mass: float, motion: ThrustMotion) -> Array:
        """Return the angular momentum (3,) of a robot of a mass (kg) and the target about their
        centre of mass, in W, after a motion to it, N m s.
        """
        state, at = motion.final_state, self.motion.numbers(motion.duration)
        L, r, v, of_target = at[5:8], at[8:11], at[11:14], float(at[14])
        momenta = (
            np.concatenate([mass * state[10:], state[4:7]]),
            np.concatenate([of_target * v, L]),
        )
        return combined_momenta((mass, of_target), (state[7:10], r), momenta)[3:]


@dataclass(frozen=True)
class ThrustGoal:
    """Goal of a motion, at rest or with a target.

    ``base`` and ``end_effector`` are poses (7,), position and quaternion in W, or None;
    ``shape`` are joint positions (n,), NaN for joints that are free, None for all free;
    ``keeps_shape``: joints that are not free keep the positions of the start all the way;
    ``grapple`` is a target instead of the others.
    """

    base: Array | None = None
    end_effector: Array | None = None
    shape: Array | None = None
    keeps_shape: bool = False
    grapple: Grapple | None = None


def base_for_hand(robot: SpaceRobot, link: str, shape: Array, hand: Array) -> Array:
    """Return the pose (7,) of the base with which a link, in a shape (n,), has a pose (7,)."""
    still = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    there = np.concatenate(end_effector_pose(robot, link, still[:3], still[3:], shape))
    return compose_poses(hand, relative_pose(there, still))


def shortest_catch(distance: float, leaving: float, acceleration: float) -> float:
    """Return the least time (s) in which a body at rest meets one that is ``distance`` m away and
    recedes at a speed (m/s, negative: it approaches), with equal velocity, at an acceleration
    (m/s^2).
    """
    slack = leaving**2 / 2 + acceleration * max(distance, 0.0)
    return max((leaving + 2 * math.sqrt(slack)) / acceleration, abs(leaving) / acceleration)
