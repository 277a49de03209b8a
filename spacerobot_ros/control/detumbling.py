"""Detumbling: brings a robot that has captured a target to rest without overloading its grasp.

The torque ``n`` about the centre of mass changes the angular momentum ``L`` of the robot and the
target at a rate of at most ``n_max``; so no control can bring ``L`` to zero in less than
``|L0| / n_max``. A torque of that magnitude opposite to ``L`` takes exactly this time, and leaves
the direction of ``L`` in W unchanged.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import casadi as ca
import numpy as np

from spacerobot_ros.control.limits import limit_norm
from spacerobot_ros.control.state import Actuation, ControlState
from spacerobot_ros.model.compilation import BufferedFunction, dense_function
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.grasp import Payload
from spacerobot_ros.model.space_robot import SpaceRobot
from spacerobot_ros.parameters import nonnegative, parameter

_REST_RATE = 2.0
"""Decay rate of joint rates and momenta while a robot is brought to rest, 1/s."""

_REST_RATE_PER_PERIOD = 0.5
"""Largest product of this decay rate and the control period."""


@dataclass(frozen=True)
class DetumbleOptions:
    """Limit on the grasp load while a robot is brought to rest, and criteria for rest."""

    grapple_torque_limit: float = nonnegative(
        0.0, "largest grasp torque on the target; 0: no limit", "N m"
    )
    rate: float = parameter(
        0.002, "largest base and joint rates of a robot at rest", "rad/s or m/s", minimum=1e-9
    )
    speed: float = parameter(
        0.002, "largest centre-of-mass speed of a robot at rest", "m/s", minimum=1e-9
    )
    settle_time: float = nonnegative(1.0, "time at rest", "s")


def decay_rate(control_period: float) -> float:
    """Return the decay rate (1/s) of motion while a robot is brought to rest."""
    return min(_REST_RATE, _REST_RATE_PER_PERIOD / control_period)


def shortest_detumbling(momentum: float, torque: float) -> float:
    """Return ``|L0| / n_max``, s: no torque of that magnitude detumbles in less time.

    Parameters
    ----------
    momentum
        Angular momentum about the centre of mass, N m s.
    torque
        Largest torque, N m; infinite: no limit.
    """
    if momentum == 0.0 or math.isinf(torque):
        return 0.0
    return momentum / torque if torque > 0.0 else math.inf


def largest_feasible_share(start: Array, change: Array, limit: float) -> float:
    """Return the largest fraction ``s`` in [0, 1] with ``|start + s change| <= limit``.

    If there is no such fraction, return the one that minimises the norm.
    """
    square, along = float(change @ change), float(start @ change)
    if square == 0.0:
        return 1.0
    inside = along**2 - square * (float(start @ start) - limit**2)
    if inside < 0.0:
        return min(max(-along / square, 0.0), 1.0)
    root = math.sqrt(inside)
    lowest, highest = (-along - root) / square, (-along + root) / square
    if highest < 0.0 or lowest > 1.0:
        return 0.0 if highest < 0.0 else 1.0
    return min(highest, 1.0)


def _grasp_wrench(robot: SpaceRobot, payload: Payload) -> ca.Function:
    """Return ``(q, z, zdot) -> wrench`` of a grasp on its body, by Newton and Euler.

    The wrench is force over torque (6,) at the end-effector, ``z`` are the velocities
    ``[v_cm; omega; qdot]`` (6 + n,), all in the base frame. The robot's model includes the body.
    """
    N = 6 + robot.n
    q, z, zdot = ca.SX.sym("q", robot.n), ca.SX.sym("z", N), ca.SX.sym("zdot", N)
    J = robot.function(f"jacobian:{payload.link}", compile=False)(q)
    R, _ = robot.function(f"link_pose:{payload.link}", compile=False)(q)
    twist = J @ z
    # The rate of the twist in B, whose axes rotate with the base.
    rate = J @ zdot + ca.jtimes(twist, q, z[6:])
    omega_WB, v, omega = z[3:6], twist[:3], twist[3:]
    a = rate[:3] + ca.cross(omega_WB, v)
    alpha = rate[3:] + ca.cross(omega_WB, omega)
    inertia = payload.inertia
    c, about = R @ inertia.com, R @ inertia.about_com @ R.T
    force = inertia.mass * (a + ca.cross(alpha, c) + ca.cross(omega, ca.cross(omega, c)))
    torque = about @ alpha + ca.cross(omega, about @ omega) + ca.cross(c, force)
    inputs = {"q": q, "z": z, "zdot": zdot}
    return dense_function("grasp_wrench", inputs, {"wrench": ca.vertcat(force, torque)})


class Detumbling:
    """Brings a robot to rest with limited grasp torque.

    Angular momentum is removed first, with the largest opposing torque, then linear momentum with
    the remaining thrust; joints are braked. If the grasp would be overloaded, the whole command is
    scaled down, and the angular, linear and joint motions decay together.

    Parameters
    ----------
    robot
        Robot model including the held body; a gyrostat if there are wheels.
    payload
        That body; None: the grasp torque is not limited.
    force, torque
        Largest thruster force, N, and base torque, N m; infinite: no limit.
    torque_limit
        Largest grasp torque, N m; 0: no limit.
    control_period
        Duration for which a command is held, s.
    """

    def __init__(
        self,
        robot: SpaceRobot,
        payload: Payload | None,
        force: float,
        torque: float,
        torque_limit: float,
        control_period: float,
    ) -> None:
        self._robot, self._rate = robot, decay_rate(control_period)
        self._force, self.torque = force, torque
        self._limit = torque_limit or math.inf
        self._grasp = None if payload is None else BufferedFunction(_grasp_wrench(robot, payload))
        self.largest_grasp_torque = 0.0
        """Largest grasp torque due to a command, N m."""

    def angular_momentum(self, state: ControlState) -> Array:
        """Return the angular momentum (3,) about the centre of mass, N m s, in the base frame."""
        H = self._robot.inertia_matrix(state.q)
        return np.asarray(H[3:6, 3:6] @ state.omega_WB_B + H[3:6, 6:] @ state.qdot)

    def velocity(self, state: ControlState) -> Array:
        """Return the centre-of-mass velocity (3,), m/s, in the base frame."""
        J = self._robot.jacobian(self._robot.base_link, state.q)
        return np.asarray(state.v_WB_B - J[:3, 3:6] @ state.omega_WB_B - J[:3, 6:] @ state.qdot)

    def command(self, state: ControlState) -> Actuation:
        """Return the base wrench and the joint efforts."""
        robot, r = self._robot, self._rate
        H, J = robot.inertia_matrix(state.q), robot.jacobian(robot.base_link, state.q)
        v_cm = self.velocity(state)
        z = np.concatenate([v_cm, state.omega_WB_B, state.qdot])
        C = robot.bias(state.q, v_cm, state.omega_WB_B, state.qdot)
        # A force on the base also rotates the robot about its centre of mass.
        to_cm = J[:3, 3:6].T
        n = limit_norm(-r * self.angular_momentum(state), self.torque)
        f = limit_norm(-r * robot.total_mass * v_cm, self._force)
        f = f * largest_feasible_share(n, -(to_cm @ f), self.torque) if f.any() else f
        wanted = np.concatenate([f, n, -r * state.qdot])

        def accelerations(share: float) -> Array:
            zdot = np.concatenate([np.zeros(6), share * wanted[6:]])
            rest = share * wanted[:6] - C[:6] - H[:6, 6:] @ zdot[6:]
            zdot[:6] = np.linalg.solve(H[:6, :6], rest)
            return zdot

        share = 1.0
        if self._grasp is not None:
            free = self._grasp(state.q, z, accelerations(0.0))[0][3:].copy()
            change = self._grasp(state.q, z, accelerations(1.0))[0][3:] - free
            share = (
                largest_feasible_share(free, change, self._limit) if self._limit < math.inf else 1.0
            )
            loaded = float(np.linalg.norm(free + share * change))
            self.largest_grasp_torque = max(self.largest_grasp_torque, loaded)
        zdot = accelerations(share)
        force = share * f
        torque = share * n - to_cm @ force
        tau = H[6:] @ zdot + C[6:] - J[:3, 6:].T @ force
        return Actuation(np.concatenate([force, torque]), tau)
