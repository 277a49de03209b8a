"""Flights of schedules at constant momentum, integrated with Pinocchio's momentum matrix."""

from __future__ import annotations

import numpy as np
from support.oracles import PinocchioOracle

from spacerobot_ros.model.description import Array
from spacerobot_ros.planning import GaitSchedule, RobotState
from spacerobot_ros.resources import robot_file

END_ERROR = 1e-6
"""Largest difference between a plan's end and that of Pinocchio's flight, m or rad."""

_LONGEST_STEP = 0.0125


def turn_rate_in_pinocchio(
    name: str, q: Array, quaternion: Array, qdot: Array, L_W: Array, names: tuple[str, ...]
) -> Array:
    """Return the angular velocity (3,) of the base in W at rates of the joints and a momentum about
    the centre of mass, which rests.
    """
    urdf = name if name.startswith("<") else robot_file(name).read_text()
    oracle = PinocchioOracle(urdf, names)
    oracle.place(q, quaternion, np.zeros(3))
    A = oracle.momentum_matrix_W()
    momenta = np.concatenate([np.zeros(3), L_W])
    return np.asarray(np.linalg.solve(A[:, :6], momenta - A @ oracle.joint_velocities(qdot))[3:])


def angle_between(first: Array, second: Array) -> float:
    """Return the angle between two attitudes (4,), rad."""
    # |a - b| is twice the sine of a quarter of the angle.
    apart = min(np.linalg.norm(first - second), np.linalg.norm(first + second))
    return float(4 * np.arcsin(apart / 2))


def flown_by_pinocchio(
    name: str, schedule: GaitSchedule, state: RobotState, longest_step: float = _LONGEST_STEP
) -> tuple[Array, Array]:
    """Return position (3,) and attitude (4,) of the base after a schedule.

    The momenta of the state stay; the twist of the base follows from them and the joint rates.
    ``name`` is that of a robot, or its URDF; Runge-Kutta steps are at most so long, s.
    """
    urdf = name if name.startswith("<") else robot_file(name).read_text()
    oracle = PinocchioOracle(urdf, schedule.joint_names)
    momenta = np.concatenate([state.linear_momentum, state.angular_momentum])

    def rate(x: Array, q: Array, qdot: Array) -> Array:
        quaternion = x[3:] / np.linalg.norm(x[3:])
        oracle.place(q, quaternion, x[:3])
        A = oracle.momentum_matrix_W()
        v, w = np.split(np.linalg.solve(A[:, :6], momenta - A @ oracle.joint_velocities(qdot)), 2)
        vector, scalar = quaternion[:3], quaternion[3]
        spin = np.append(scalar * w + np.cross(vector, w), -vector @ w) / 2
        turned = v + 2 * np.cross(vector, np.cross(vector, v) + scalar * v)
        return np.concatenate([turned, spin])

    x = np.concatenate([state.position, state.quaternion])
    steps = max(1, int(np.ceil(schedule.control_period / longest_step)))
    h = schedule.control_period / steps
    for q, qdot in zip(schedule.positions, schedule.velocities, strict=False):
        for step in range(steps):
            at = [q + (step + part) * h * qdot for part in (0.0, 0.5, 1.0)]
            k1 = rate(x, at[0], qdot)
            k2 = rate(x + h / 2 * k1, at[1], qdot)
            k3 = rate(x + h / 2 * k2, at[1], qdot)
            k4 = rate(x + h * k3, at[2], qdot)
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
            x[3:] /= np.linalg.norm(x[3:])
    return x[:3], x[3:]
