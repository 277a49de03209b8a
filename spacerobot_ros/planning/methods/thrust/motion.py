"""A motion under thrust over time: exact states, accelerations and efforts."""

from __future__ import annotations

from typing import NamedTuple

import casadi as ca
import numpy as np

from spacerobot_ros.collision import BasePoses
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.compilation import BufferedFunction
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.dynamics import solve_positive_definite
from spacerobot_ros.model.rotations import (
    matrices_from_quaternions,
    quaternion_multiply,
    rotvecs_from_quaternions,
)
from spacerobot_ros.model.symbolic_rotations import (
    matrix_from_quaternion,
    quaternion_from_matrix,
    quaternion_rate,
)
from spacerobot_ros.planning.methods.thrust.propulsion import Propulsion
from spacerobot_ros.planning.methods.thrust.solver import ThrustKnots

EXACT_STEPS = 8
"""Steps of Runge-Kutta in an interval that is integrated exactly."""


class FrameSample(NamedTuple):
    """The motion of a frame in W: position (3,), m, quaternion (4,), and their velocities and
    accelerations (3,), in world components.
    """

    position: Array
    quaternion: Array
    velocity: Array
    angular_velocity: Array
    acceleration: Array
    angular_acceleration: Array


class MotionSample(NamedTuple):
    """A motion at one instant: frames of the base and of the end-effector (None: there is none),
    positions, velocities and accelerations (n,) of the joints, the wrench (6,) at the origin of the
    base in its components, and the joint efforts (n,).
    """

    base: FrameSample
    end_effector: FrameSample | None
    q: Array
    qdot: Array
    qddot: Array
    wrench_B: Array
    tau: Array


class MotionFunctions(NamedTuple):
    """The functions of one robot's motions, with an end-effector if ``link`` names one: a step of
    the integration, a sample of the motion, and the centre of mass in the base.
    """

    step: BufferedFunction
    sample: BufferedFunction
    center_of_mass: ca.Function
    link: str

    @classmethod
    def of(cls, robot: SpaceRobot, link: str = "") -> MotionFunctions:
        """Derive the functions."""
        step, sample = BufferedFunction(_flight_step(robot)), BufferedFunction(_sample(robot, link))
        return cls(step, sample, robot.function("center_of_mass", compile=False), link)


class ThrustMotion:
    """A planned motion as flown by its controls: integrated from the start.

    Parameters
    ----------
    functions
        Those of its robot.
    propulsion
        What pushes its base.
    knots
        A solution, whose first knot is the start.
    """

    def __init__(
        self, functions: MotionFunctions, propulsion: Propulsion, knots: ThrustKnots
    ) -> None:
        self.propulsion = propulsion
        self._functions, self._knots = functions, knots
        self._q, self._qdot = knots.shapes, knots.velocities
        self._qddot = np.diff(knots.velocities, axis=0) / knots.step
        self._wrenches = knots.levels @ propulsion.wrenches.T
        self.levels = knots.levels
        """Levels (N, m) of the propulsion, each held for :attr:`step` seconds."""
        self.step = knots.step
        states = [knots.states[:1]]
        for k in range(len(knots.levels)):
            states.append(self._through(k, states[-1][-1]))
        self._grid = np.vstack(states)
        """States (N EXACT_STEPS + 1, 13) at equal distances in time."""

    @property
    def joints(self) -> int:
        """n."""
        return int(self._q.shape[1])

    @property
    def duration(self) -> float:
        """s."""
        return self.step * len(self.levels)

    @property
    def spent(self) -> float:
        """Cost of the levels: kg of propellant of thrusters in a table, else N s."""
        return self.step * float(np.sum(self.propulsion.cost_of(self.levels)))

    def _through(self, k: int, state: Array) -> Array:
        """Return the states (EXACT_STEPS, 13) on an interval that begins in one."""
        t, states = self.step / EXACT_STEPS, []
        for number in range(EXACT_STEPS):
            state = self._advanced(state, k, number * t, t)
            states.append(state)
        return np.array(states)

    def defects(self) -> Array:
        """Return the defects (N, 12) with which the knots would be an exact flight."""
        knots, states = self._knots, self._knots.states
        ends = np.array([self._through(k, x)[-1] for k, x in enumerate(states[:-1])])
        # Knots obey the program with their own defects: what they miss is the rest.
        inverse = states[1:, :4] * [-1.0, -1.0, -1.0, 1.0]
        turn = rotvecs_from_quaternions(quaternion_multiply(inverse, ends[:, :4]))
        rest = np.hstack([turn, ends[:, 4:] - states[1:, 4:]])
        return rest if knots.defects is None else knots.defects + rest

    def _joints(self, k: int, since: float) -> tuple[Array, Array]:
        q, qdot, qddot = self._q[k], self._qdot[k], self._qddot[k]
        return q + since * qdot + since**2 / 2 * qddot, qdot + since * qddot

    def _advanced(self, state: Array, k: int, since: float, t: float) -> Array:
        q, qdot = self._joints(k, since)
        (reached,) = self._functions.step(state, q, qdot, self._qddot[k], self._wrenches[k], t)
        return reached

    def at(self, time: float) -> MotionSample:
        """Return the motion at a time since its start, s; after its end, the state at the end."""
        N, h = len(self.levels), self.step
        time = min(max(time, 0.0), self.duration)
        k = min(int(time / h), N - 1)
        since = time - k * h
        t = h / EXACT_STEPS
        number = min(int(since / t), EXACT_STEPS - 1)
        state = self._advanced(
            self._grid[k * EXACT_STEPS + number], k, number * t, since - number * t
        )
        q, qdot = self._joints(k, since)
        qddot, wrench = self._qddot[k], self._wrenches[k]
        base, hand, tau = self._functions.sample(state, q, qdot, qddot, wrench)
        frames = [FrameSample(*np.split(each, [3, 7, 10, 13, 16])) for each in (base, hand)]
        return MotionSample(
            frames[0], frames[1] if self._functions.link else None, q, qdot, qddot, wrench, tau
        )

    def effort_share(self, limit: Array) -> float:
        """Return the largest ratio of a joint effort to its limit (n,), at both ends of intervals
        and in their middle.
        """
        limited = np.isfinite(limit)
        if not limited.any():
            return 0.0
        share = 0.0
        for k in range(len(self.levels)):
            for part in (0.0, 0.5, 1.0 - 1e-9):
                tau = self.at((k + part) * self.step).tau
                share = max(share, float(np.max(np.abs(tau[limited]) / limit[limited])))
        return share

    def path(self) -> tuple[Array, BasePoses]:
        """Return shapes (K, n) and poses of the base at all instants of the exact integration."""
        steps = np.arange(EXACT_STEPS) * self.step / EXACT_STEPS
        t = steps[np.newaxis, :, np.newaxis]
        q = self._q[:-1, np.newaxis] + t * self._qdot[:-1, np.newaxis]
        q = q + t**2 / 2 * self._qddot[:, np.newaxis]
        shapes = np.vstack([q.reshape(q.shape[0] * q.shape[1], self.joints), self._q[-1:]])
        X, r = self._grid[:, :4], self._grid[:, 7:10]
        c = self._functions.center_of_mass(shapes.T).full().T
        r_WB = r - np.einsum("kij,kj->ki", matrices_from_quaternions(X), c)
        return shapes, BasePoses(r_WB, X)

    @property
    def final_state(self) -> Array:
        """``[X; L; r; V]`` (13,) at the end."""
        return np.asarray(self._grid[-1])

    @property
    def last_knot(self) -> Array:
        """``[h; X; s; v; L; r; V]`` at the end, of which the rows of the end are."""
        X, momenta = np.split(self.final_state, [4])
        s = self._q[-1] + self.step * self._qdot[-1] / 2
        return np.concatenate([[self.step], X, s, self._qdot[-1], momenta])


def _sample(robot: SpaceRobot, link: str) -> ca.Function:
    """Return ``(x, q, qdot, qddot, wrench) -> (base, end_effector, tau)``: numbers of frames (19,),
    zeros without an end-effector, and efforts.
    """
    n, m = robot.n, robot.total_mass
    x, wrench = ca.SX.sym("x", 13), ca.SX.sym("wrench", 6)
    q, qdot, qddot = (ca.SX.sym(name, n) for name in ("q", "qdot", "qddot"))
    X, L, r, V = ca.vertsplit(x, [0, 4, 7, 10, 13])
    R, force, torque = matrix_from_quaternion(X), wrench[:3], wrench[3:]

    def rate(of: ca.SX) -> ca.SX:
        """Differentiate an expression of q and qdot with respect to time."""
        return ca.jtimes(of, ca.vertcat(q, qdot), ca.vertcat(qdot, qddot))

    H = robot.function("inertia_matrix", compile=False)(q)
    c = robot.function("center_of_mass", compile=False)(q)
    D, D_q = H[3:6, 3:6], H[3:6, 6:]
    omega = solve_positive_definite(D, R.T @ L - D_q @ qdot)
    C = robot.function("bias", compile=False)(q, R.T @ V, omega, qdot)
    alpha = solve_positive_definite(D, torque - ca.cross(c, force) - D_q @ qddot - C[3:6])
    to_joints = robot.function(f"jacobian:{robot.base_link}", compile=False)(q)[:3, 6:]
    tau = H[6:, 3:6] @ alpha + H[6:, 6:] @ qddot + C[6:] - to_joints.T @ force

    def frame(e: ca.SX, R_BE: ca.SX, omega_BE: ca.SX) -> ca.SX:
        """Return the numbers of a frame at e from the centre of mass, in B."""
        edot = rate(e)
        a = ca.cross(omega, ca.cross(omega, e) + 2 * edot) + ca.cross(alpha, e) + rate(edot)
        turning = alpha + rate(omega_BE) + ca.cross(omega, omega_BE)
        return ca.vertcat(
            r + R @ e,
            quaternion_from_matrix(R @ R_BE),
            V + R @ (ca.cross(omega, e) + edot),
            R @ (omega + omega_BE),
            R @ (force / m + a),
            R @ turning,
        )

    base = frame(-c, ca.SX.eye(3), ca.SX(3, 1))
    base = ca.vertcat(base[:3], X, base[7:])
    hand = ca.SX(19, 1)
    if link:
        R_all, r_all = robot.function("link_poses", compile=False)(q)
        i = robot.link_names.index(link)
        J = robot.function(f"jacobian:{link}", compile=False)(q)
        hand = frame(r_all[:, i] - c, R_all[:, 3 * i : 3 * i + 3], J[3:6, 6:] @ qdot)
    outputs = [ca.densify(each) for each in (base, hand, tau)]
    return ca.Function("thrust_sample", [x, q, qdot, qddot, wrench], ca.cse(outputs))


def _flight_step(robot: SpaceRobot) -> ca.Function:
    """Return ``(x, q, qdot, qddot, wrench, t) -> x+``: a step of Runge-Kutta 4 of
    ``x = [X; L; r; V]`` over t seconds, with joints on a parabola and a wrench held in the base.
    """
    n, m = robot.n, robot.total_mass
    x, wrench, t = ca.SX.sym("x", 13), ca.SX.sym("wrench", 6), ca.SX.sym("t")
    q, qdot, qddot = (ca.SX.sym(name, n) for name in ("q", "qdot", "qddot"))
    center_of_mass = robot.function("center_of_mass", compile=False)
    locked_inertia = robot.function("locked_inertia", compile=False)

    def slope(at: ca.SX, tau: float) -> ca.SX:
        X, L, _, V = ca.vertsplit(at, [0, 4, 7, 10, 13])
        elapsed = tau * t
        q_at, qdot_at = q + elapsed * qdot + elapsed**2 / 2 * qddot, qdot + elapsed * qddot
        D, D_q = locked_inertia(q_at)
        R = matrix_from_quaternion(X)
        omega = solve_positive_definite(D, R.T @ L - D_q @ qdot_at)
        twisted = R @ (wrench[3:] - ca.cross(center_of_mass(q_at), wrench[:3]))
        return ca.vertcat(quaternion_rate(X, omega), twisted, V, R @ wrench[:3] / m)

    first = slope(x, 0.0)
    second = slope(x + t / 2 * first, 0.5)
    third = slope(x + t / 2 * second, 0.5)
    fourth = slope(x + t * third, 1.0)
    reached = x + t / 6 * (first + 2 * second + 2 * third + fourth)
    reached[:4] /= ca.norm_2(reached[:4])
    return ca.Function("flight_step", [x, q, qdot, qddot, wrench, t], [ca.cse(reached)])
