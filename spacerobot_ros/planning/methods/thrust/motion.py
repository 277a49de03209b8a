"""Motion under thrust over time: exact states, accelerations and efforts."""

from __future__ import annotations

from typing import NamedTuple

import casadi as ca
import numpy as np

from spacerobot_ros.collision import BasePoses
from spacerobot_ros.model import SpaceRobot
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
from spacerobot_ros.planning.methods.thrust.propulsion import Propulsion
from spacerobot_ros.planning.methods.thrust.transcription import (
    ThrustKnots,
    state_parts,
    state_symbols,
)

EXACT_STEPS = 8
"""Runge-Kutta steps per exactly integrated interval."""


class FrameSample(NamedTuple):
    """Motion of a frame in W: position (3,), m, quaternion (4,), and their velocities and
    accelerations (3,), in world components.
    """

    position: Array
    quaternion: Array
    velocity: Array
    angular_velocity: Array
    acceleration: Array
    angular_acceleration: Array


class MotionSample(NamedTuple):
    """A motion at one instant: frames of the base and the end-effector (None if there is none),
    joint positions, velocities and accelerations (n,), the wrench (6,) at the base origin in base
    components, and the joint efforts (n,).
    """

    base: FrameSample
    end_effector: FrameSample | None
    q: Array
    qdot: Array
    qddot: Array
    wrench_B: Array
    tau: Array


class MotionFunctions(NamedTuple):
    """The functions of one robot's motions, with an end-effector if ``link`` names one: one step of
    the integration, the steps of an interval, and a sample of the motion.
    """

    robot: SpaceRobot
    link: str
    step: ca.Function
    interval: ca.Function
    sample: ca.Function

    @classmethod
    def of(cls, robot: SpaceRobot, link: str = "") -> MotionFunctions:
        """Derive the functions."""
        step = runge_kutta_step(_flight_rate(robot), attitude=slice(4))
        return cls(robot, link, step, step.mapaccum(EXACT_STEPS), _sample(robot, link))


def base_poses(robot: SpaceRobot, states: Array) -> BasePoses:
    """Return the poses of the base in states (K, 13 + 2 n)."""
    X, _, r, _, q, _ = state_parts(states)
    c = robot.function("center_of_mass")(q.T).full().T
    return BasePoses(r - np.einsum("kij,kj->ki", matrices_from_quaternions(X), c), X)


class ThrustMotion:
    """A planned motion as it results from its controls, integrated from the start.

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
        self.levels = knots.levels
        """Propulsion levels (N, m), each held for :attr:`step` seconds."""
        self.step = knots.step
        qddot = np.diff(state_parts(knots.states)[5], axis=0) / knots.step
        self._controls = np.hstack([qddot, knots.levels @ propulsion.wrenches.T])
        states = [knots.states[:1]]
        for k in range(len(knots.levels)):
            states.append(self._through(k, states[-1][-1]))
        self._grid = np.vstack(states)
        """States (N EXACT_STEPS + 1, 13 + 2 n) at equal time intervals."""

    @property
    def joints(self) -> int:
        """n."""
        return self._functions.robot.n

    @property
    def duration(self) -> float:
        """s."""
        return self._knots.duration

    @property
    def spent(self) -> float:
        """Cost of the levels: kg of propellant with a thruster table, else N s."""
        return self.step * float(self.propulsion.cost_of(ca.DM(self.levels.T)))

    def _through(self, k: int, state: Array) -> Array:
        """Return the states (EXACT_STEPS, 13 + 2 n) on an interval that begins in one."""
        begin = np.concatenate([state[:13], self._knots.states[k, 13:]])
        controls = np.tile(self._controls[k], (EXACT_STEPS, 1)).T
        t = np.full((1, EXACT_STEPS), self.step / EXACT_STEPS)
        return np.asarray(self._functions.interval(begin, controls, t).full().T)

    def defects(self) -> Array:
        """Return the defects (N, 12) with which the knots would be exact states of a flight."""
        states = self._knots.states
        ends = np.array([self._through(k, x)[-1] for k, x in enumerate(states[:-1])])
        # Knots obey the program with their own defects: what they miss is the rest.
        turn = quaternion_multiply(quaternion_inverse(states[1:, :4]), ends[:, :4])
        rest = np.hstack([rotvecs_from_quaternions(turn), ends[:, 4:13] - states[1:, 4:13]])
        return rest if self._knots.defects is None else self._knots.defects + rest

    def at(self, time: float) -> MotionSample:
        """Return the motion at a time since its start, s; after its end, the final state."""
        time = min(max(time, 0.0), self.duration)
        t = self.step / EXACT_STEPS
        row = min(int(time / t), len(self._grid) - 2)
        controls = self._controls[row // EXACT_STEPS]
        state = self._functions.step(self._grid[row], controls, time - row * t).full().ravel()
        numbers = self._functions.sample(state, controls)
        base, hand, tau = (each.full().ravel() for each in numbers)
        frames = [FrameSample(*np.split(each, [3, 7, 10, 13, 16])) for each in (base, hand)]
        *_, q, qdot = state_parts(state)
        qddot, wrench = np.split(controls, [self.joints])
        return MotionSample(
            frames[0], frames[1] if self._functions.link else None, q, qdot, qddot, wrench, tau
        )

    def effort_share(self, limit: Array) -> float:
        """Return the largest ratio of a joint effort to its limit (n,)."""
        limited = np.isfinite(limit)
        controls = np.repeat(self._controls, EXACT_STEPS, axis=0)
        efforts = self._functions.sample.map(len(controls))
        ends = (efforts(x.T, controls.T)[2].full() for x in (self._grid[:-1], self._grid[1:]))
        tau = np.abs(np.hstack(list(ends))[limited])
        return float(np.max(tau / limit[limited, np.newaxis], initial=0.0))

    def path(self) -> tuple[Array, BasePoses]:
        """Return shapes (K, n) and base poses at all instants of the exact integration."""
        return state_parts(self._grid)[4], base_poses(self._functions.robot, self._grid)

    def joined_momentum(self, target: TorqueFreeMotion) -> Array:
        """Return the final angular momentum (3,) of the robot and a target about their common
        centre of mass, in W, N m s; the target motion begins at the same time as this motion.
        """
        _, L, r, V, *_ = state_parts(self.final_state)
        at, mass = target.numbers(self.duration), self._functions.robot.total_mass
        L_T, r_T, V_T, of_target = at[5:8], at[8:11], at[11:14], float(at[14])
        momenta = np.concatenate([mass * V, L]), np.concatenate([of_target * V_T, L_T])
        return combined_momenta((mass, of_target), (r, r_T), momenta)[3:]

    @property
    def final_state(self) -> Array:
        """State (13 + 2 n,) at the end."""
        return np.asarray(self._grid[-1])


def _sample(robot: SpaceRobot, link: str) -> ca.Function:
    """Return ``(x, [qddot; wrench]) -> (base, end_effector, tau)``: numbers of frames (19,), zeros
    without an end-effector, and efforts.
    """
    n = robot.n
    qddot, wrench = ca.SX.sym("qddot", n), ca.SX.sym("wrench", 6)
    x, (X, L, r, V, q, qdot) = state_symbols(n)
    R, force, torque = matrix_from_quaternion(X), wrench[:3], wrench[3:]
    H = robot.function("inertia_matrix", compile=False)(q)
    c = robot.function("center_of_mass", compile=False)(q)
    D, D_q, v = H[3:6, 3:6], H[3:6, 6:], R.T @ V
    omega = solve_positive_definite(D, R.T @ L - D_q @ qdot)
    C = robot.function("bias", compile=False)(q, v, omega, qdot)
    alpha = solve_positive_definite(D, torque - ca.cross(c, force) - D_q @ qddot - C[3:6])
    velocities = ca.vertcat(v, omega, qdot)
    rates = ca.vertcat(force / robot.total_mass - ca.cross(omega, v), alpha, qddot)
    R_all, r_all = robot.function("link_poses", compile=False)(q)

    def jacobian(name: str) -> ca.SX:
        return robot.function(f"jacobian:{name}", compile=False)(q)

    def frame(name: str) -> ca.SX:
        """Return a link frame as numbers."""
        i, z = robot.link_names.index(name), ca.SX.sym("z", 6 + n)
        moving = ca.substitute(ca.jtimes(jacobian(name) @ z, q, qdot), z, velocities)
        twist, rate = jacobian(name) @ velocities, jacobian(name) @ rates + moving
        # The base, in whose components they are, rotates.
        rate += ca.vertcat(*(ca.cross(omega, each) for each in ca.vertsplit(twist, 3)))
        return ca.vertcat(
            r + R @ (r_all[:, i] - c),
            quaternion_from_matrix(R @ R_all[:, 3 * i : 3 * i + 3]),
            *(R @ each for each in ca.vertsplit(ca.vertcat(twist, rate), 3)),
        )

    base = frame(robot.base_link)
    base[3:7] = X
    to_joints = jacobian(robot.base_link)[:3, 6:]
    tau = H[6:, 3:6] @ alpha + H[6:, 6:] @ qddot + C[6:] - to_joints.T @ force
    outputs = [ca.densify(each) for each in (base, frame(link) if link else ca.SX(19, 1), tau)]
    return ca.Function("thrust_sample", [x, ca.vertcat(qddot, wrench)], ca.cse(outputs))


def _flight_rate(robot: SpaceRobot) -> ca.Function:
    """Return ``(x, [qddot; wrench]) -> x_dot``, with the wrench in the base."""
    x, (X, L, _, V, q, qdot) = state_symbols(robot.n)
    qddot, force, torque = (ca.SX.sym(*each) for each in (("qddot", robot.n), ("f", 3), ("n", 3)))
    D, D_q = robot.function("locked_inertia", compile=False)(q)
    R, c = matrix_from_quaternion(X), robot.function("center_of_mass", compile=False)(q)
    omega = solve_positive_definite(D, R.T @ L - D_q @ qdot)
    turning, twisted = quaternion_rate(X, omega), R @ (torque - ca.cross(c, force))
    x_dot = ca.vertcat(turning, twisted, V, R @ force / robot.total_mass, qdot, qddot)
    controls = ca.vertcat(qddot, force, torque)
    return ca.Function("flight_rate", [x, controls], [ca.densify(ca.cse(x_dot))])
