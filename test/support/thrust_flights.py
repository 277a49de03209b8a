"""Motions under thrust, flown by Pinocchio, and goals for them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pinocchio as pin
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation
from support.oracles.integrated import tumbled_body

from spacerobot_ros.collision import BasePoses, CollisionGeometry
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array, RobotDescription
from spacerobot_ros.model.grasp import BodyMotion, RobotMotion
from spacerobot_ros.planning.methods.thrust.problem import ThrustMotion

FOLDED = np.array([0.0, -1.2, 2.0, 0.0, 0.8, 0.0])
"""Joint positions of the arm of a servicer."""


def beyond(start: Array, displacement: Array, rotvec: Array) -> Array:
    """Return the pose that is displaced and rotated from one, in the components of its frame."""
    R = Rotation.from_quat(start[3:])
    turned = R * Rotation.from_rotvec(rotvec)
    return np.concatenate([start[:3] + R.apply(displacement), turned.as_quat()])


def configuration(model: pin.Model, robot: SpaceRobot, pose: Array, q: Array) -> Array:
    """Return the configuration of a model at a base pose (7,) and a shape (n,)."""
    found = pin.neutral(model)
    found[:7] = pose
    for name, value in zip(robot.joint_names, q, strict=True):
        joint = model.joints[model.getJointId(name)]
        found[joint.idx_q : joint.idx_q + joint.nq] = (
            [value] if joint.nq == 1 else [np.cos(value), np.sin(value)]
        )
    return np.asarray(found)


def flown_by_pinocchio(robot: SpaceRobot, motion: ThrustMotion, start: RobotMotion) -> Array:
    """Return where Pinocchio ends under the wrenches and efforts of a motion: q of its model."""
    model = pin.buildModelFromXML(robot.description.urdf, pin.JointModelFreeFlyer())
    model.gravity = pin.Motion.Zero()
    data = model.createData()
    places = [model.joints[model.getJointId(name)].idx_v for name in robot.joint_names]
    q0 = configuration(model, robot, start.pose, start.q)

    def rate(time: float, y: Array) -> Array:
        # On the tangent space of the start: its displacement moves with the velocity.
        q, v = y[: model.nq], y[model.nq :]
        q = pin.normalize(model, q)
        sample = motion.at(time)
        efforts = np.zeros(model.nv)
        efforts[places] = sample.tau
        external = [pin.Force.Zero() for _ in range(model.njoints)]
        external[1] = pin.Force(sample.wrench_B[:3], sample.wrench_B[3:])
        a = pin.aba(model, data, q, v, efforts, external)
        step = 1e-7
        qdot = (pin.integrate(model, q, v * step) - pin.integrate(model, q, -v * step)) / (2 * step)
        return np.concatenate([qdot, a])

    y = np.concatenate([q0, np.zeros(model.nv)])
    for k in range(len(motion.levels)):
        # Wrenches and accelerations jump between intervals.
        ends = k * motion.step + 1e-12, (k + 1) * motion.step - 1e-12
        y = solve_ivp(rate, ends, y, rtol=1e-8, atol=1e-9).y[:, -1]
    return np.asarray(y[: model.nq])


def tumbled(target: RobotDescription, motion: BodyMotion, times: Array) -> tuple[Array, Array]:
    """Return quaternions (K, 4) and positions (K, 3) of a free body's frame, by scipy."""
    R, r, _ = tumbled_body(target.bodies[0].inertia, motion, times)
    return np.asarray(R.as_quat()), r


def distance_from_target(
    robot: RobotDescription, target: RobotDescription, motion: ThrustMotion, free: BodyMotion
) -> float:
    """Return how near a robot comes to a target by coal, at 400 instants, m: but for the body of
    its end-effector.
    """
    times = np.linspace(0.0, motion.duration, 400)
    samples = [motion.at(time) for time in times]
    X, r = tumbled(target, free, times)
    back = Rotation.from_quat(X).inv()
    base = BasePoses(
        back.apply(np.array([each.base.position for each in samples]) - r),
        (back * Rotation.from_quat([each.base.quaternion for each in samples])).as_quat(),
    )
    geometry = CollisionGeometry(replace(robot, world=target), obstacles_alone=True)
    hand = robot.frames["end_effector"][0]
    poses = geometry.poses(np.array([each.q for each in samples]), base)
    others = [k for k, (i, _) in enumerate(geometry.pairs) if geometry.solids[i].body != hand]
    return min(float(geometry.distances(pair, poses).min()) for pair in others)
