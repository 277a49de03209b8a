"""References that small thrusters can follow."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from spacerobot_ros.control.reference import MotionLimits
from spacerobot_ros.control.saturation import ActuatorLimits
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array

_SHARE = 0.5
"""Part of the thrust that a reference may ask for; the feedback, and masses that are not quite as
believed, need the rest."""


def within_thrust(
    motion: MotionLimits, actuators: ActuatorLimits, robot: SpaceRobot, q: Array
) -> MotionLimits:
    """Return ``motion`` with accelerations lowered to what the thrusters give at shape ``q`` (n,).

    The whole robot is taken as one body: force over total mass; torque over its largest moment of
    inertia about the center of mass; and the force, which acts at the base, needs torque too where
    the center of mass is elsewhere. A spacecraft without thrusters is left as it is.
    """
    torque = _SHARE * actuators.torque
    lever = float(np.linalg.norm(robot.center_of_mass(q)))
    accelerations = [motion.acceleration, _SHARE * actuators.force / robot.total_mass]
    if lever > 0:
        accelerations.append(torque / (robot.total_mass * lever))
    inertia = float(np.linalg.eigvalsh(robot.inertia_matrix(q)[3:6, 3:6])[-1])
    return replace(
        motion,
        acceleration=_smallest(accelerations),
        angular_acceleration=_smallest([motion.angular_acceleration, torque / inertia]),
    )


def _smallest(accelerations: list[float]) -> float:
    return min(a for a in accelerations if a > 0 and math.isfinite(a))
