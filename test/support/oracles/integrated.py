"""Motions by scipy: of a base that its joints move, by Pinocchio's twist, and of a free body."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation
from support.oracles.agreement import Array
from support.oracles.oracle import Oracle

from spacerobot_ros.model.description import Inertia
from spacerobot_ros.model.grasp import BodyMotion

IDENTITY = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])


def quaternion_rate(quaternion: Array, omega: Array) -> Array:
    """Return the rate (4,) of a quaternion (x, y, z, w) at an angular velocity in its body."""
    x, y, z, w = quaternion
    return 0.5 * np.array([[w, -z, y], [z, w, -x], [-y, x, w], [-x, -y, -z]]) @ omega


def carried(
    oracle: Oracle,
    q: Array,
    qdot: Array,
    duration: float,
    pose: Array = IDENTITY,
    momenta: npt.ArrayLike = (0, 0, 0, 0, 0, 0),
) -> Array:
    """Return the pose (7,) of the base after joints at constant rates, at constant momenta (6,)."""

    def rate(t: float, y: Array) -> Array:
        turn = Rotation.from_quat(y[3:])
        twist = oracle.base_twist(q + t * qdot, qdot, turn.as_quat(), momenta)
        return np.append(turn.apply(twist[:3]), quaternion_rate(y[3:], twist[3:]))

    return _end(rate, pose, np.array([duration]))[0]


def tumbled_body(
    inertia: Inertia,
    start: BodyMotion,
    times: Array,
    torque: Callable[[float, Rotation], Array] = lambda t, R: np.zeros(3),
) -> tuple[Rotation, Array, Array]:
    """Return attitudes, positions of the origin (K, 3), and angular velocities (K, 3) in the body,
    under a torque in the body about its centre of mass.
    """
    J, arm = inertia.about_com, start.R_WT @ inertia.com
    v = start.v + np.cross(start.omega, arm)

    def rate(t: float, y: Array) -> Array:
        omega = y[4:]
        moment = torque(t, Rotation.from_quat(y[:4])) - np.cross(omega, J @ omega)
        return np.append(quaternion_rate(y[:4], omega), np.linalg.solve(J, moment))

    quaternion = Rotation.from_matrix(start.R_WT).as_quat()
    found = _end(rate, np.append(quaternion, start.R_WT.T @ start.omega), np.asarray(times))
    R = Rotation.from_quat(found[:, :4])
    r = start.r_WT + arm + np.asarray(times)[:, np.newaxis] * v - R.apply(inertia.com)
    return R, r, found[:, 4:]


def _end(rate: Callable[[float, Array], Array], y: Array, times: Array) -> Array:
    span = (0.0, float(times[-1]) + 1e-9)
    solution = solve_ivp(rate, span, y, "DOP853", t_eval=times, rtol=1e-12, atol=1e-14)
    return np.asarray(solution.y.T)
