"""Motions under thrust, flown by Pinocchio, and goals for them."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.planning.methods.thrust.motion import ThrustMotion
from spacerobot_ros.planning.methods.thrust.search import ThrustStart


def beyond(start: Array, displacement: Array, rotvec: Array) -> Array:
    """Return the pose that is displaced and rotated from one, in the components of its frame."""
    R = Rotation.from_quat(start[3:])
    turned = R * Rotation.from_rotvec(rotvec)
    return np.concatenate([start[:3] + R.apply(displacement), turned.as_quat()])


def flown_by_pinocchio(robot: SpaceRobot, motion: ThrustMotion, start: ThrustStart) -> Array:
    """Return where Pinocchio ends under the wrenches and efforts of a motion: q of its model."""
    model = pin.buildModelFromXML(robot.description.urdf, pin.JointModelFreeFlyer())
    model.gravity = pin.Motion.Zero()
    data = model.createData()
    ids = [model.getJointId(name) for name in robot.joint_names]
    q0 = pin.neutral(model)
    q0[:7] = start.pose
    for index, value in zip(ids, start.q, strict=True):
        joint = model.joints[index]
        q0[joint.idx_q : joint.idx_q + joint.nq] = (
            [value] if joint.nq == 1 else [np.cos(value), np.sin(value)]
        )

    def rate(time: float, y: Array) -> Array:
        # On the tangent space of the start: its displacement moves with the velocity.
        q, v = y[: model.nq], y[model.nq :]
        q = pin.normalize(model, q)
        sample = motion.at(time)
        efforts = np.zeros(model.nv)
        for index, tau in zip(ids, sample.tau, strict=True):
            efforts[model.joints[index].idx_v] = tau
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
