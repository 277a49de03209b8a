"""Motions under thrust: options, goals, propulsion of the base, and planned motions over time."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import casadi as ca
import numpy as np

from spacerobot_ros.collision import BasePoses
from spacerobot_ros.errors import NotFoundError, ParameterError, Proof, UnreachableError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model import symbolic_rotations as symbolic
from spacerobot_ros.model.compilation import BufferedFunction
from spacerobot_ros.model.description import Array, Pose, RobotDescription
from spacerobot_ros.model.dynamics import solve_positive_definite
from spacerobot_ros.model.grasp import combined_momenta
from spacerobot_ros.model.integration import runge_kutta_step
from spacerobot_ros.model.inverse_kinematics import REACHED_DISTANCE, FixedBaseArm, is_reached
from spacerobot_ros.model.rotations import (
    compose_poses,
    matrices_from_quaternions,
    matrix_from_quaternion,
    quaternion_inverse,
    quaternion_multiply,
    relative_pose,
    rotvecs_from_quaternions,
)
from spacerobot_ros.model.target_motion import TorqueFreeMotion
from spacerobot_ros.model.thrusters import ThrusterTable
from spacerobot_ros.parameters import parameter
from spacerobot_ros.planning.core.clearance import DEFAULT_CLEARANCE
from spacerobot_ros.planning.core.goal import end_effector_pose
from spacerobot_ros.planning.methods.optimal.problem import MotionOptions

DEFECT_SIZE = 12
"""Length of an interval's defect: rotation vector, then L, r and V at its end."""

EXACT_STEPS = 8
"""Runge-Kutta steps per exactly integrated interval."""


@dataclass(frozen=True)
class ThrustOptions(MotionOptions):
    """Options of motions planned under thrust."""

    time_factor: float = parameter(
        1.5,
        "duration of a least-propellant motion, relative to the shortest motion; 1: the shortest "
        "motion",
        minimum=1.0,
        maximum=1e3,
    )
    duration: float = parameter(
        0.0,
        "duration of a motion; 0: determined by time_factor",
        unit="s",
        minimum=0.0,
        maximum=1e5,
    )
    reserve: float = parameter(
        0.2,
        "fraction of thrust and joint efforts reserved for the controller's feedback",
        minimum=0.0,
        maximum=0.9,
    )
    intervals: int = parameter(30, "steps of the problem", minimum=10, maximum=1000)
    iterations: int = parameter(
        300, "largest number of solver steps from one guess", minimum=1, maximum=100000
    )
    clearance: float = parameter(
        DEFAULT_CLEARANCE,
        "smallest distance between links, and between links and obstacles; 0: contacts are ignored",
        unit="m",
        minimum=0.0,
        maximum=1e3,
    )
    thrusters: str = parameter(
        "",
        "thruster table for plans: 'urdf' or a YAML file; '': any wrench within max_force and "
        "max_torque",
    )


@dataclass(frozen=True)
class Propulsion:
    """Levels (m,) whose wrench on the base is ``wrenches @ levels``, and their cost.

    Attributes
    ----------
    wrenches
        (6, m) force (N), then torque (N m) at the base link origin, in the base frame, at level
        one.
    cost
        (m,) cost per second at level one: kg of propellant if there is a table, else N s of
        impulse.
    is_table
        Whether the levels are those of thrusters, from 0 to 1. Otherwise they are the components of
        a force and a torque, each with a Euclidean norm of at most one.
    """

    wrenches: Array
    cost: Array
    is_table: bool

    @property
    def lowest(self) -> float:
        """Lowest level of each component."""
        return 0.0 if self.is_table else -1.0

    @classmethod
    def of_table(cls, table: ThrusterTable, reserve: float) -> Propulsion:
        """Return the propulsion for a thruster table, with a fraction of the levels reserved for
        feedback.

        Raises
        ------
        ParameterError
            The thrusters cannot produce every wrench.
        """
        missing = table.missing()
        if missing:
            raise ParameterError(
                f"The thrusters cannot produce {missing}; motions under thrust are planned for "
                "bases that can be pushed and rotated in every direction."
            )
        share = 1.0 - reserve
        return cls(share * table.wrenches, share * table.mass_flow, is_table=True)

    @classmethod
    def within(cls, force: float, torque: float, reserve: float) -> Propulsion:
        """Return the propulsion for bounds on the Euclidean norms of force (N) and torque (N m).

        Raises
        ------
        ParameterError
            A limit is not positive, or not finite.
        """
        for name, value in (("force", force), ("torque", torque)):
            if not (value > 0 and math.isfinite(value)):
                raise ParameterError(
                    f"The thruster {name} limit is {value:g}; motions under thrust require a "
                    f"finite limit: set max_{name}."
                )
        limits = (1.0 - reserve) * np.repeat([force, torque], 3)
        return cls(np.diag(limits), limits, is_table=False)

    def largest_force(self) -> float:
        """Return a bound on the force in any direction, N."""
        force = self.wrenches[:3]
        if not self.is_table:
            return float(force.max())
        one_way = np.maximum(force.clip(0.0).sum(axis=1), -force.clip(None, 0.0).sum(axis=1))
        return float(np.linalg.norm(one_way))

    def cost_of(self, levels: ca.MX | ca.DM, rounding: ca.MX | float = 0.0) -> ca.MX | ca.DM:
        """Return the cost of levels (m, N), each held for a second; norms are smoothed below the
        level ``rounding``.
        """
        if self.is_table:
            return ca.sum2(ca.DM(self.cost).T @ levels)
        sizes = (ca.sqrt(ca.sum1(each**2) + rounding**2) for each in ca.vertsplit(levels, 3))
        of_force, of_torque = (ca.sum2(each - rounding) for each in sizes)
        return self.cost[0] * of_force + self.cost[3] * of_torque


@dataclass(frozen=True)
class Grapple:
    """The goal to meet a target at any time, with the end-effector at the pose and the velocities
    of the grapple frame.

    Attributes
    ----------
    motion
        Target motion, beginning at the start of the robot's motion.
    description
        Target body, one link, from which the robot keeps clear; None: unknown.
    clearance
        Distance from the target body, m; 0: not checked.
    horizon
        Time within which the target must be met, s.
    detumbles
        Whether the total angular momentum of the robot and the target at the grasp must be zero or
        minimal.
    standoff
        (3,) position in the grapple frame, m, from which the end-effector would approach in a
        straight line.
    corridor_angle, corridor_length
        Half-angle, rad, of the cone about the direction of the standoff that the end-effector does
        not leave within a distance from the grapple frame, m; length 0: none.
    """

    motion: TorqueFreeMotion
    description: RobotDescription | None = None
    clearance: float = 0.0
    horizon: float = 120.0
    detumbles: bool = False
    standoff: tuple[float, ...] = (-0.3, 0.0, 0.0)
    corridor_angle: float = 0.0
    corridor_length: float = 0.0

    def require_in_time(self, center: Array, mass: float, force: float, arm: float) -> None:
        """Reject a target that a robot cannot meet within the horizon, given the position and the
        velocity (6,) of its centre of mass in W, its mass, its largest force and its reach, SI.
        """
        away = self.motion.center_of_mass(0.0) - center[:3]
        distance = float(np.linalg.norm(away))
        leaving = float((self.motion.velocity - center[3:]) @ away) / max(distance, 1e-9)
        near = max(distance - arm - self.motion.arm_length, 0.0)
        # From rest to the velocity of a body at this distance.
        a = force / mass
        least = max(leaving + 2 * math.sqrt(leaving**2 / 2 + a * near), abs(leaving)) / a
        if least > self.horizon:
            raise UnreachableError(
                f"The target is {distance:.3g} m away and recedes at {leaving:.3g} m/s: with a "
                f"force of {force:.3g} N, the robot meets it after {least:.4g} s at the earliest, "
                f"and 'target.horizon' is {self.horizon:g} s.",
                Proof.LIMITS,
            )


@dataclass(frozen=True)
class ThrustGoal:
    """Goal of a motion that ends at rest.

    ``base`` and ``end_effector`` are poses (7,), position and quaternion in W; ``end_effector`` may
    be None. ``shape`` contains joint positions (n,); NaN: a free joint; None: all joints are free.
    ``keeps_shape``: joints that are not free keep their initial positions throughout.
    """

    base: Array
    end_effector: Array | None = None
    shape: Array | None = None
    keeps_shape: bool = False


def base_for_hand(robot: SpaceRobot, link: str, shape: Array, hand: Array) -> Array:
    """Return the base pose (7,) for which a link has a given pose (7,) in a shape (n,)."""
    still = np.eye(7)[6]
    there = np.concatenate(end_effector_pose(robot, link, still[:3], still[3:], shape))
    return compose_poses(hand, relative_pose(there, still))


def shape_for_hand(robot: SpaceRobot, link: str, base: Array, hand: Array, q: Array) -> Array:
    """Return the shape (n,) close to ``q`` in which a link has the pose ``hand`` (7,), with the
    base at the pose ``base`` (7,).

    Raises
    ------
    NotFoundError
        No such shape was found.
    """
    poses = [Pose(matrix_from_quaternion(each[3:]), each[:3]) for each in (base, hand)]
    arm = FixedBaseArm(robot, link, poses[0])
    found, distance = arm.nearest_shape(q, poses[1])
    if distance > REACHED_DISTANCE:
        found, distance, angle = arm.search_shape(q, poses[1])
        if not is_reached(distance, angle):
            raise NotFoundError(
                f"No joint positions were found that put '{link}' at its goal while the base is at "
                f"its goal: {distance:.3g} m and {angle:.3g} rad remain."
            )
    return found


def state_parts(states: Array) -> list[Array]:
    """Return ``X, L, r, V, q, qdot`` of states (..., 13 + 2 n) as views."""
    return np.split(states, [4, 7, 10, 13, (states.shape[-1] + 13) // 2], axis=-1)


def with_joints_moved(states: Array, time: float) -> Array:
    """Return states whose joints have moved at their velocities for a given time, s."""
    moved = states.copy()
    *_, q, qdot = state_parts(moved)
    q += time * qdot
    return moved


@dataclass(frozen=True)
class ThrustKnots:
    """N intervals of ``step`` seconds: states at N + 1 knots, controls in N intervals.

    ``states`` (N + 1, 13 + 2 n) are ``[X; L; r; V; q; qdot]``: the quaternion of R_WB, the angular
    momentum about the centre of mass, N m s, its position and velocity, all in W, and positions and
    velocities of the joints. ``accelerations`` (N, n) are joint accelerations, ``levels`` (N, m)
    propulsion levels, and ``defects`` (N, 12) the interval defects. A solution has the multipliers
    of its variables and of its rows; its pairs are closer than required by at most ``lack``, m.
    """

    step: float
    states: Array
    accelerations: Array
    levels: Array
    defects: Array
    multipliers: tuple[Array, Array] | None = None
    lack: float = 0.0

    @property
    def duration(self) -> float:
        """s."""
        return self.step * len(self.levels)

    def stretched(self, factor: float) -> ThrustKnots:
        """Return the same path in ``factor`` times its duration."""
        X, L, r, V, q, qdot = state_parts(self.states)
        return ThrustKnots(
            self.step * factor,
            np.hstack([X, L / factor, r, V / factor, q, qdot / factor]),
            self.accelerations / factor**2,
            self.levels / factor**2,
            np.zeros_like(self.defects),
        )


def state_symbols(n: int) -> tuple[ca.SX, list[ca.SX]]:
    """Return a knot, and its components ``X, L, r, V, s, v``."""
    x = ca.SX.sym("x", 13 + 2 * n)
    return x, ca.vertsplit(x, [0, 4, 7, 10, 13, 13 + n, 13 + 2 * n])


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

    def __init__(self, robot: SpaceRobot, link: str) -> None:
        self.robot = robot
        names = ("inertia_matrix", "center_of_mass", "link_poses")
        x, (X, L, r, V, q, qdot) = state_symbols(robot.n)
        H, c, (R_all, r_all) = (robot.function(name, compile=False)(q) for name in names)
        qddot, force, torque = (ca.SX.sym(*each) for each in (("a", robot.n), ("f", 3), ("n", 3)))
        R, controls = symbolic.matrix_from_quaternion(X), ca.vertcat(qddot, force, torque)
        v, omega = R.T @ V, solve_positive_definite(H[3:6, 3:6], R.T @ L - H[3:6, 6:] @ qdot)
        of_base = symbolic.quaternion_rate(X, omega), R @ (torque - ca.cross(c, force)), V
        x_dot = ca.vertcat(*of_base, R @ force / robot.total_mass, qdot, qddot)

        def jacobian(name: str) -> ca.SX:
            return robot.function(f"jacobian:{name}", compile=False)(q)

        def frame(name: str) -> ca.SX:
            i = robot.link_names.index(name)
            quaternion = symbolic.quaternion_from_matrix(R @ R_all[:, 3 * i : 3 * i + 3])
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
