"""Motions under thrust, flown by Pinocchio, and goals for them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pinocchio as pin
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation
from support.oracles.integrated import tumbled_body
from support.oracles.pinocchio_oracle import PinocchioOracle

from spacerobot_ros.collision import BasePoses, CollisionGeometry
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array, RobotDescription
from spacerobot_ros.model.grasp import BodyMotion, RobotMotion
from spacerobot_ros.model.urdf import parse_world
from spacerobot_ros.planning.methods.thrust.problem import ThrustMotion

FOLDED = np.array([0.0, -1.2, 2.0, 0.0, 0.8, 0.0])
"""Joint positions of the arm of a servicer."""


def beyond(start: Array, displacement: Array, rotvec: Array) -> Array:
    """Return the pose that is displaced and rotated from one, in the components of its frame."""
    R = Rotation.from_quat(start[3:])
    turned = R * Rotation.from_rotvec(rotvec)
    return np.concatenate([start[:3] + R.apply(displacement), turned.as_quat()])


def obstacles(**solids: tuple[str, Array, Array]) -> RobotDescription:
    """Return bodies at rest by name: elements of their shapes, positions and rpy angles."""
    elements = '<link name="w"/>'
    for name, (shape, place, rpy) in solids.items():
        xyz, angles = (" ".join(map(str, each)) for each in (place, rpy))
        elements += (
            f'<link name="{name}"><collision><geometry>{shape}</geometry></collision></link>'
            f'<joint name="to_{name}" type="fixed"><parent link="w"/><child link="{name}"/>'
            f'<origin xyz="{xyz}" rpy="{angles}"/></joint>'
        )
    return parse_world(f'<robot name="w">{elements}</robot>')


def box(size: Array) -> str:
    return '<box size="{} {} {}"/>'.format(*size)


def flown_by_pinocchio(robot: SpaceRobot, motion: ThrustMotion, start: RobotMotion) -> Array:
    """Return where Pinocchio ends under the wrenches and efforts of a motion: q of its model."""
    oracle = pinocchio(robot)
    oracle.set_configuration(start.q, start.pose[3:], start.pose[:3])
    model = oracle.model

    def rate(time: float, y: Array) -> Array:
        # On the tangent space of the start: its displacement moves with the velocity.
        q, v = pin.normalize(model, y[: model.nq]), y[model.nq :]
        oracle.q, oracle.u = q, v
        sample, step = motion.at(time), 1e-7
        a = oracle.own_acceleration(sample.wrench_B, sample.tau)
        qdot = (pin.integrate(model, q, v * step) - pin.integrate(model, q, -v * step)) / (2 * step)
        return np.concatenate([qdot, a])

    y = np.concatenate([oracle.q, np.zeros(model.nv)])
    for k in range(len(motion.levels)):
        # Wrenches and accelerations jump between intervals.
        ends = k * motion.step + 1e-12, (k + 1) * motion.step - 1e-12
        y = solve_ivp(rate, ends, y, rtol=1e-8, atol=1e-9).y[:, -1]
    return np.asarray(y[: model.nq])


def pinocchio(robot: SpaceRobot) -> PinocchioOracle:
    return PinocchioOracle(robot.description.urdf, robot.joint_names)


def distance_from_target(
    robot: RobotDescription, target: RobotDescription, motion: ThrustMotion, free: BodyMotion
) -> float:
    """Return how near a robot comes to a target by coal, at 400 instants, m: but for the body of
    its end-effector.
    """
    times = np.linspace(0.0, motion.duration, 400)
    samples = [motion.at(time) for time in times]
    R, r, _ = tumbled_body(target.bodies[0].inertia, free, times)
    back = R.inv()
    base = BasePoses(
        back.apply(np.array([each.base.position for each in samples]) - r),
        (back * Rotation.from_quat([each.base.quaternion for each in samples])).as_quat(),
    )
    geometry = CollisionGeometry(replace(robot, world=target), obstacles_alone=True)
    hand = robot.frames["end_effector"][0]
    poses = geometry.poses(np.array([each.q for each in samples]), base)
    others = [k for k, (i, _) in enumerate(geometry.pairs) if geometry.solids[i].body != hand]
    return min(float(geometry.distances(pair, poses).min()) for pair in others)
