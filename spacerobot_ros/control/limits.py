"""Actuator, joint rate and reference limits.

A control law commands forces without regard to the resulting speeds. If a goal is far away, a
measurement is late or a thruster is stuck open, joints would exceed the rates of their motors, and
the rates that held commands can control. In such cases, :class:`JointRateLimits` lowers the joint
efforts.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import casadi as ca
import numpy as np

from spacerobot_ros.control.state import Actuation, ControlState, PoseReference
from spacerobot_ros.model.compilation import BufferedFunction, dense_function
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.dynamics import solve_positive_definite
from spacerobot_ros.model.rotations import matrix_from_quaternion
from spacerobot_ros.model.space_robot import SpaceRobot
from spacerobot_ros.parameters import parameter

REFERENCE_SHARE = 0.5
"""Fraction of thrust and joint efforts available to references; feedback and mass errors need the
rest."""


_MIN_PERIODS_TO_LIMIT = 2
"""Shortest time for a joint to reach its rate limit, in control periods: neither the held nor the
next efforts may bring the joint beyond the limit, even if the model is slightly wrong."""


@dataclass(frozen=True)
class MotionLimits:
    """Largest speeds and accelerations of pose and joint references.

    ``joint_speed`` and ``joint_acceleration`` apply to every joint (m or rad, s); the controller
    node does not have these parameters, because its goals are poses.
    """

    speed: float = parameter(0.1, "largest reference speed", "m/s", minimum=1e-06)
    acceleration: float = parameter(0.02, "largest reference acceleration", "m/s^2", minimum=1e-06)
    angular_speed: float = parameter(0.1, "largest reference angular speed", "rad/s", minimum=1e-06)
    angular_acceleration: float = parameter(
        0.02, "largest reference angular acceleration", "rad/s^2", minimum=1e-06
    )
    joint_speed: float = 0.1
    joint_acceleration: float = 0.02

    def within_thruster_limits(
        self, actuators: ActuatorLimits, robot: SpaceRobot, q: Array
    ) -> MotionLimits:
        """Return the limits with accelerations lowered to what the thrusters can produce.

        The robot is treated as one rigid body in the configuration ``q`` (n,): the linear
        acceleration is at most the force divided by the total mass, the angular acceleration at
        most the torque divided by the largest moment of inertia about the centre of mass. The
        thrusters can also balance the torque of their force if the centre of mass is not at the
        base origin. Without thrusters, the limits are unchanged.
        """
        force, torque = (REFERENCE_SHARE * x for x in (actuators.force, actuators.torque))
        lever = float(np.linalg.norm(robot.center_of_mass(q)))
        accelerations = [self.acceleration, force / robot.total_mass]
        if lever > 0:
            accelerations.append(torque / (robot.total_mass * lever))
        inertia = float(np.linalg.eigvalsh(robot.inertia_matrix(q)[3:6, 3:6])[-1])
        return replace(
            self,
            acceleration=_smallest_positive(accelerations),
            angular_acceleration=_smallest_positive([self.angular_acceleration, torque / inertia]),
        )


class Saturated(NamedTuple):
    """A command within the actuator limits: ``realised``, and ``excess`` (commanded minus
    realised).
    """

    realised: Actuation
    excess: Actuation

    @classmethod
    def of(cls, commanded: Actuation, realised: Actuation) -> Saturated:
        """Return the realised actuation and its difference from the command."""
        wrench = commanded.wrench_B - realised.wrench_B
        return cls(realised, Actuation(wrench, commanded.tau - realised.tau))

    @property
    def limited(self) -> bool:
        """Whether any limit has changed the command."""
        # It is read once per tick: storing it would take longer.
        return any(self.excess.wrench_B.tolist()) or any(self.excess.tau.tolist())


@dataclass(frozen=True)
class ActuatorLimits:
    """Thruster and joint limits.

    The thrusters produce any force up to ``force`` (N) and any torque up to ``torque`` (N m), both
    in Euclidean norm and independently of each other. A larger force or torque is scaled down to
    the limit, preserving its direction. Each joint produces up to its ``effort`` (n,), N m or N.
    Infinite means no limit.
    """

    force: float
    torque: float
    effort: Array

    def apply(self, commanded: Actuation) -> Saturated:
        """Return the command within the limits."""
        force = limit_norm(commanded.wrench_B[:3], self.force)
        torque = limit_norm(commanded.wrench_B[3:], self.torque)
        tau = np.clip(commanded.tau, -self.effort, self.effort)
        return Saturated.of(commanded, Actuation(np.concatenate([force, torque]), tau))

    def expression(self, actuation: ca.SX) -> ca.SX:
        """Return the realised part of a command ``[f; n; tau]`` (6 + n,), as :meth:`apply` does."""
        parts = []
        for vector, limit in ((actuation[:3], self.force), (actuation[3:6], self.torque)):
            size = ca.sqrt(ca.dot(vector, vector))
            within = not math.isfinite(limit)
            parts.append(vector if within else vector * ca.if_else(size <= limit, 1, limit / size))
        return ca.vertcat(*parts, ca.fmin(ca.fmax(actuation[6:], -self.effort), self.effort))


def limit_norm(vector: Array, limit: float) -> Array:
    """Return a vector scaled down to at most a given norm."""
    size = math.sqrt(vector.dot(vector))
    return vector if size <= limit else vector * (limit / size)


def _smallest_positive(accelerations: list[float]) -> float:
    return min(a for a in accelerations if a > 0 and math.isfinite(a))


class JointRateLimits:
    """Keeps joint rates within limits by predicting the dynamics over the next control periods.

    The joints obey ``Js(q) qddot + Fs = tau + G(q) wrench``: the last rows of paper 4, eq. (19),
    with the base acceleration eliminated. If a commanded acceleration would bring a joint beyond
    its rate within a few control periods, the acceleration is lowered, and the efforts are
    recomputed. If motors are too weak to hold joints against the thrust on the base, the thrust is
    lowered, preserving its direction.

    Parameters
    ----------
    robot
        The controller's robot model.
    rates
        Largest rates (n,), m/s or rad/s; zero or infinite: no limit.
    control_period
        Duration for which a command is held, s.
    """

    def __init__(self, robot: SpaceRobot, rates: Array, control_period: float) -> None:
        limited = (rates > 0) & np.isfinite(rates)
        self.rates = np.where(limited, rates, np.inf)
        """Largest rates (n,); infinite: no limit."""
        self._robot = robot
        self._control_period = control_period
        self._unlimited = not limited.any()
        self._dynamics = BufferedFunction(_joint_dynamics(robot))

    def apply(
        self, state: ControlState, given: Actuation, effort: Array, periods: int = 1
    ) -> Actuation:
        """Return a command that keeps the joint rates within limits: the given command if possible.

        ``effort`` (n,) are the joint effort limits, N m or N, which ``given`` satisfies;
        ``periods`` is the number of control periods for which the command will probably be held.
        """
        if self._unlimited:
            return given
        Js, Fs, G = self._evaluate_dynamics(state.q, state.omega_WB_B, state.qdot)
        pushed = G @ given.wrench_B
        qddot = np.linalg.solve(Js, given.tau + pushed - Fs)
        soonest = _MIN_PERIODS_TO_LIMIT * periods * self._control_period
        lowest = (-self.rates - state.qdot) / soonest
        highest = (self.rates - state.qdot) / soonest
        if np.all((lowest <= qddot) & (qddot <= highest)):
            return given
        wanted = Js @ np.clip(qddot, lowest, highest) + Fs
        share = _affordable_push_share(wanted, pushed, effort)
        tau = np.clip(wanted - share * pushed, -effort, effort)
        return Actuation(share * given.wrench_B, tau)

    def exceeds_limits_expression(
        self, omega: ca.SX, q: ca.SX, qdot: ca.SX, actuation: ca.SX
    ) -> ca.SX:
        """Return whether :meth:`apply` changes the command ``[f; n; tau]`` (6 + n,)."""
        if self._unlimited:
            return ca.SX(0)
        n, tau = self._robot.n, actuation[6:]
        flat, Fs, columns = self._dynamics.function(q, omega, qdot)
        Js, G = ca.reshape(flat, n, n).T, ca.reshape(columns, 6, n).T
        qddot = solve_positive_definite(Js, tau + G @ actuation[:6] - Fs)
        soonest = _MIN_PERIODS_TO_LIMIT * self._control_period
        beyond = []
        for i, rate in enumerate(self.rates.tolist()):
            if np.isfinite(rate):
                lowest, highest = (-rate - qdot[i]) / soonest, (rate - qdot[i]) / soonest
                beyond.append(ca.logic_or(qddot[i] < lowest, qddot[i] > highest))
        return ca.sum1(ca.vertcat(*beyond)) > 0

    def largest_rate_share(self, qdot: Array) -> float:
        """Return the largest ratio of the rates (n,) to their limits."""
        return float(np.abs(qdot * (1 / self.rates)).max(initial=0.0))

    def efforts(self, q: Array, qdot: Array, qddot: Array) -> Array:
        """Return the efforts (n,) for joint accelerations (n,) without thrust and base rotation."""
        Js, Fs, _ = self._evaluate_dynamics(q, np.zeros(3), qdot)
        return np.asarray(Js @ qddot + Fs)

    def holding_efforts(self, q: Array, base: PoseReference) -> Array:
        """Return the efforts (n,), N m or N, that hold joints at ``q`` (n,) as the base moves.

        The robot is a rigid body; ``base`` is the motion of the base in W, moved by thrust alone.
        """
        R_BW = matrix_from_quaternion(base.quaternion).T
        omega, alpha = R_BW @ base.angular_velocity, R_BW @ base.angular_acceleration
        r, inertia = self._robot.center_of_mass(q), self._robot.inertia_matrix(q)[3:6, 3:6]
        turning = np.cross(alpha, r) + np.cross(omega, np.cross(omega, r))
        force = self._robot.total_mass * (R_BW @ base.acceleration + turning)
        torque = inertia @ alpha + np.cross(omega, inertia @ omega) + np.cross(r, force)
        _, Fs, G = self._evaluate_dynamics(q, omega, np.zeros_like(q))
        return np.asarray(Fs - G @ np.concatenate([force, torque]))

    def _evaluate_dynamics(self, q: Array, omega: Array, qdot: Array) -> tuple[Array, Array, Array]:
        inputs = self._dynamics.inputs
        inputs[0][:], inputs[1][:], inputs[2][:] = q, omega, qdot
        self._dynamics.evaluate()
        Js, Fs, G = self._dynamics.outputs
        n = self._robot.n
        return Js.reshape((n, n)), Fs, G.reshape((n, 6))


def _affordable_push_share(wanted: Array, pushed: Array, effort: Array) -> float:
    """Return the largest fraction in [0, 1] of an added effort that keeps the sum within limits.

    Zero if there is none: motors that cannot brake joints are not loaded further.
    """
    low, high = 0.0, 1.0
    for tau, push, limit in zip(wanted.tolist(), pushed.tolist(), effort.tolist(), strict=True):
        if push == 0.0:
            if abs(tau) > limit:
                return 0.0
            continue
        ends = (tau - limit) / push, (tau + limit) / push
        low, high = max(low, min(ends)), min(high, max(ends))
    return high if low <= high else 0.0


def _joint_dynamics(robot: SpaceRobot) -> ca.Function:
    """Return ``(q, omega_WB_B, qdot) -> (Js, Fs, G)``, for any base velocity."""
    q, qdot = ca.SX.sym("q", robot.n), ca.SX.sym("qdot", robot.n)
    omega = ca.SX.sym("omega", 3)
    H = robot.function("inertia_matrix", compile=False)(q)
    C = robot.function("bias", compile=False)(q, ca.SX(3, 1), omega, qdot)
    J = robot.function(f"jacobian:{robot.base_link}", compile=False)(q)
    D, D_q, D_qq = H[3:6, 3:6], H[3:6, 6:], H[6:, 6:]
    # Generalised forces on omega and q due to a force and torque at the base origin.
    to_omega = ca.horzcat(J[:3, 3:6].T, ca.SX.eye(3))
    to_joints = ca.horzcat(J[:3, 6:].T, ca.SX(robot.n, 3))
    solved = solve_positive_definite(D, ca.horzcat(D_q, C[3:6], to_omega))
    n = robot.n
    outputs = {
        # CasADi stores columns; transposed, numpy reads rows.
        "Js": ca.reshape((D_qq - D_q.T @ solved[:, :n]).T, n * n, 1),
        "Fs": C[6:] - D_q.T @ solved[:, n],
        "G": ca.reshape((to_joints - D_q.T @ solved[:, n + 1 :]).T, 6 * n, 1),
    }
    return dense_function("joint_dynamics", {"q": q, "omega": omega, "qdot": qdot}, outputs)
