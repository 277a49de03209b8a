"""Motion under thrust over time: exact states, accelerations and efforts."""

from __future__ import annotations

from functools import cached_property
from typing import NamedTuple

import casadi as ca
import numpy as np

from spacerobot_ros.collision import BasePoses
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.compilation import BufferedFunction
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.dynamics import solve_positive_definite
from spacerobot_ros.model.grasp import combined_momenta
from spacerobot_ros.model.integration import runge_kutta_step
from spacerobot_ros.model.rotations import (
    matrices_from_quaternions,
    quaternion_inverse,
    quaternion_multiply,
    rotvecs_from_quaternions,
)
from spacerobot_ros.model.symbolic_rotations import (
    matrix_from_quaternion,
    quaternion_from_matrix,
    quaternion_rate,
)
from spacerobot_ros.model.target_motion import TorqueFreeMotion
from spacerobot_ros.planning.methods.thrust.problem import Propulsion
from spacerobot_ros.planning.methods.thrust.transcription import (
    ThrustKnots,
    state_parts,
    state_symbols,
)

EXACT_STEPS = 8
"""Runge-Kutta steps per exactly integrated interval."""


class FrameSample(NamedTuple):
    """Motion of a frame in W: position (3,), m, quaternion (4,), and their velocities and
    accelerations (3,), in the world frame.
    """

    position: Array
    quaternion: Array
    velocity: Array
    angular_velocity: Array
    acceleration: Array
    angular_acceleration: Array


class MotionSample(NamedTuple):
    """A motion at one instant: frames of the base and the end-effector (the base if there is none),
    joint positions, velocities and accelerations (n,), the wrench (6,) at the base origin in base
    components, and the joint efforts (n,).
    """

    base: FrameSample
    end_effector: FrameSample
    q: Array
    qdot: Array
    qddot: Array
    wrench_B: Array
    tau: Array


class MotionFunctions:
    """Functions of states (:class:`.ThrustKnots`) and controls ``[qddot; wrench]`` of one robot: a
    Runge-Kutta ``step``, the steps of an ``interval``, and a ``sample``.

    The sample contains the frames of the base and of an end-effector link as numbers (19,), and the
    joint efforts. Without a link, the base is the end-effector.
    """

    def __init__(self, robot: SpaceRobot, link: str = "") -> None:
        self.robot = robot
        names = ("inertia_matrix", "center_of_mass", "link_poses")
        x, (X, L, r, V, q, qdot) = state_symbols(robot.n)
        H, c, (R_all, r_all) = (robot.function(name, compile=False)(q) for name in names)
        qddot, force, torque = (ca.SX.sym(*each) for each in (("a", robot.n), ("f", 3), ("n", 3)))
        R, controls = matrix_from_quaternion(X), ca.vertcat(qddot, force, torque)
        v, omega = R.T @ V, solve_positive_definite(H[3:6, 3:6], R.T @ L - H[3:6, 6:] @ qdot)
        of_base = quaternion_rate(X, omega), R @ (torque - ca.cross(c, force)), V
        x_dot = ca.vertcat(*of_base, R @ force / robot.total_mass, qdot, qddot)

        def jacobian(name: str) -> ca.SX:
            return robot.function(f"jacobian:{name}", compile=False)(q)

        def frame(name: str) -> ca.SX:
            i = robot.link_names.index(name)
            quaternion = quaternion_from_matrix(R @ R_all[:, 3 * i : 3 * i + 3])
            twist = ca.vec(R @ ca.reshape(jacobian(name) @ ca.vertcat(v, omega, qdot), 3, 2))
            place = r + R @ (r_all[:, i] - c)
            return ca.vertcat(place, quaternion, twist, ca.jtimes(twist, x, x_dot))

        base = frame(robot.base_link)
        base[3:7] = X
        C = robot.function("bias", compile=False)(q, v, omega, qdot)
        tau = H[6:, 3:6] @ ca.jtimes(omega, x, x_dot) + H[6:, 6:] @ qddot + C[6:]
        tau -= jacobian(robot.base_link)[:3, 6:].T @ force
        sample = ca.cse([base, frame(link) if link else base, tau])
        rate = ca.Function("flight_rate", [x, controls], [ca.densify(ca.cse(x_dot))])
        self.step = runge_kutta_step(rate, attitude=slice(4))
        self.interval = self.step.mapaccum(EXACT_STEPS)
        self.sample = ca.Function("sample", [x, controls], [ca.densify(each) for each in sample])
        x, controls, h = (
            ca.MX.sym(*each) for each in (("x", *x.shape), ("u", *controls.shape), "h")
        )
        later = self.step(x, controls, h)
        self.sample_after = ca.Function(
            "sample_after", [x, controls, h], [later, *self.sample(later, controls)]
        )


def base_poses(robot: SpaceRobot, X: Array, r: Array, q: Array) -> BasePoses:
    """Return base poses at attitudes (K, 4), centres of mass (K, 3) and shapes (K, n)."""
    c = robot.function("center_of_mass")(q.T).full().T
    return BasePoses(r - np.einsum("kij,kj->ki", matrices_from_quaternions(X), c), X)


class Samples(NamedTuple):
    """A path at instants: shapes (K, n), poses of the base, and times (K,) since its start, s."""

    shapes: Array
    base: BasePoses
    times: Array

    def at(self, ticks: Array) -> Samples:
        """Return the path, interpolated linearly, at fractional indices (M,) of its instants."""
        k = np.minimum(ticks.astype(int), len(self.times) - 2)
        share = (ticks - k)[:, np.newaxis]
        shapes = (1 - share) * self.shapes[k] + share * self.shapes[k + 1]
        times = np.interp(ticks, np.arange(len(self.times)), self.times)
        return Samples(shapes, self.base.between(k, share), times)


class ThrustMotion:
    """A planned motion, obtained by integrating its controls from the start.

    Parameters
    ----------
    functions
        Functions of its robot.
    propulsion
        Propulsion of its base.
    knots
        A solution, whose first knot is the start.
    """

    def __init__(
        self, functions: MotionFunctions, propulsion: Propulsion, knots: ThrustKnots
    ) -> None:
        self.propulsion = propulsion
        self._functions, self._knots, self.joints = functions, knots, functions.robot.n
        self.levels, self.step, self.duration = knots.levels, knots.step, knots.duration
        """Propulsion levels (N, m), each held for :attr:`step` seconds, and the duration, s."""
        self.spent = self.step * float(propulsion.cost_of(ca.DM(self.levels.T)))
        """Cost of the levels: kg of propellant with a thruster table, else N s."""
        qddot = np.diff(state_parts(knots.states)[5], axis=0) / knots.step
        self._controls = np.hstack([qddot, knots.levels @ propulsion.wrenches.T])
        states = [knots.states[:1]]
        for k in range(len(knots.levels)):
            states.append(self._through(k, states[-1][-1]))
        self._grid = np.vstack(states)
        """States (N EXACT_STEPS + 1, 13 + 2 n) at equal time intervals."""
        self.final_state: Array = self._grid[-1]
        """State (13 + 2 n,) at the end."""

    def _through(self, k: int, state: Array) -> Array:
        """Return the states (EXACT_STEPS, 13 + 2 n) on an interval that begins in one."""
        begin = np.concatenate([state[:13], self._knots.states[k, 13:]])
        controls = np.tile(self._controls[k], (EXACT_STEPS, 1)).T
        t = np.full((1, EXACT_STEPS), self.step / EXACT_STEPS)
        return np.asarray(self._functions.interval(begin, controls, t).full().T)

    def defects(self) -> Array:
        """Return the defects (N, 12) with which the knots would be exact flight states."""
        states = self._knots.states
        ends = np.array([self._through(k, x)[-1] for k, x in enumerate(states[:-1])])
        # Knots satisfy the program with their own defects: this is the remaining difference.
        turn = quaternion_multiply(quaternion_inverse(states[1:, :4]), ends[:, :4])
        rest = np.hstack([rotvecs_from_quaternions(turn), ends[:, 4:13] - states[1:, 4:13]])
        return np.asarray(self._knots.defects + rest)

    def at(self, time: float) -> MotionSample:
        """Return the motion at a time since its start, s; after its end, the final state."""
        time = min(max(time, 0.0), self.duration)
        t = self.step / EXACT_STEPS
        row = min(int(time / t), len(self._grid) - 2)
        controls = self._controls[row // EXACT_STEPS]
        state, *frames, tau = self._sample_after(self._grid[row], controls, time - row * t)
        base, hand = (
            FrameSample(f[:3], f[3:7], f[7:10], f[10:13], f[13:16], f[16:]) for f in frames
        )
        q, qdot = np.split(state[13:], 2)
        return MotionSample(base, hand, q, qdot, controls[:-6], controls[-6:], tau)

    @cached_property
    def _sample_after(self) -> BufferedFunction:
        # Not shared with other motions, which other threads may plan.
        return BufferedFunction(self._functions.sample_after)

    def effort_share(self, limit: Array) -> float:
        """Return the largest ratio of a joint effort to its limit (n,)."""
        limited = np.isfinite(limit)
        controls = np.repeat(self._controls, EXACT_STEPS, axis=0)
        efforts = self._functions.sample.map(len(controls))
        ends = [efforts(x.T, controls.T)[2].full() for x in (self._grid[:-1], self._grid[1:])]
        tau = np.abs(np.hstack(ends)[limited])
        return float(np.max(tau / limit[limited, np.newaxis], initial=0.0))

    def path(self) -> Samples:
        """Return the motion at all instants of the exact integration."""
        X, _, r, _, q, _ = state_parts(self._grid)
        times = np.linspace(0.0, self.duration, len(q))
        return Samples(q, base_poses(self._functions.robot, X, r, q), times)

    def joined_momentum(self, target: TorqueFreeMotion) -> Array:
        """Return the final angular momentum (3,) of the robot and a target about their common
        centre of mass, in W, N m s; the target motion begins at the same time as this motion.
        """
        _, L, r, V, *_ = state_parts(self.final_state)
        at, mass = target.numbers(self.duration), self._functions.robot.total_mass
        L_T, r_T, V_T, of_target = at[5:8], at[8:11], at[11:14], float(at[14])
        momenta = np.concatenate([mass * V, L]), np.concatenate([of_target * V_T, L_T])
        return combined_momenta((mass, of_target), (r, r_T), momenta)[3:]
