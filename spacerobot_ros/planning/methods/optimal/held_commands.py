"""Converts smooth trajectories to commands, each held for one tick, that end exactly at the goal.

The shapes at the ticks are points on the trajectory; between them, the shape moves along chords,
with velocities averaged over a tick. So joint positions, velocities and accelerations stay within
their limits, but loops of chords enclose slightly different areas from the curves, and the attitude
of the solution differs slightly from the attitude integrated by the plant. Newton's method adds a
few smooth waves to the path until the plant's own prediction ends at the goal. The first variation
of the final attitude is

``eta = R_f' sum_k R_k K(q_k)(dq_k, q_k' dt)`` (K is the curvature of the connection),

for a change ``dq`` that vanishes at both ends, with further terms if the robot drifts
(:class:`DriftVariation`). If these waves need more speed or acceleration than the limits allow, a
quadratic program finds the smallest change that keeps the commands within them. The unknowns are
the changes in all shapes at the ticks. To first order, the end of the motion is linear in these
changes, and a few successive programs reach the goal (sequential quadratic programming). If they do
not reach the goal, the manoeuvre takes a few ticks longer.

If the last shape is free, the program changes it as well, because loops of some robots do not
rotate the base. A manoeuvre of only a few ticks is a polygon that no longer resembles the curve.
With two or three ticks, it may have too few corners to end at the goal; one tick is then added.

The efforts under held commands (:class:`.JointEfforts`) are those of servos that follow the
commands; if the plant is driven by efforts, they are the efforts that a controller would command
without feedback. At zero momentum, efforts are quadratic in the speed: a motion whose efforts are
f^2 times their limits satisfies the limits if it takes f times as long.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import casadi as ca
import numpy as np

from spacerobot_ros.errors import ParameterError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.dynamics import solve_positive_definite
from spacerobot_ros.model.rotations import (
    attitude_error,
    matrices_from_quaternions,
    quaternion_from_rotvec,
    quaternion_multiply,
)
from spacerobot_ros.planning.core.clearance import Clearance
from spacerobot_ros.planning.core.prediction import BasePrediction
from spacerobot_ros.planning.core.schedule import HeldMotion, JointEfforts, given_effort_limits
from spacerobot_ros.planning.methods.optimal.end_effectors import EndEffectorRows
from spacerobot_ros.planning.methods.optimal.goal_specification import nearest_shape_for_center
from spacerobot_ros.planning.methods.optimal.problem import (
    BoundaryConditions,
    MotionLimits,
    OptimalOptions,
    PathConstraints,
    Trajectory,
    per_joint,
)
from spacerobot_ros.planning.methods.optimal.transcription import Stages

# -- effort limits ---------------------------------------------------------------------------------

_PLANNED_EFFORT_SHARE = 0.98
"""Fraction of the limits that a solution may use; the rest is reserved for path changes."""


class LimitedEfforts(JointEfforts):
    """Efforts of one robot, with limits that manoeuvres must satisfy."""

    @classmethod
    def of(cls, robot: SpaceRobot, options: OptimalOptions) -> LimitedEfforts | None:
        """Return the efforts that the options limit; None if there are none.

        Raises
        ------
        ParameterError
            A joint effort limit is not positive.
        """
        if options.effort_limits == 2:
            return None
        limit = robot.effort_limit.copy()
        if options.effort_limits == 0:
            given = given_effort_limits(robot)
            limit = np.full(robot.n, np.inf) if given is None else given
        most = per_joint(robot, "max_effort", options.max_effort, np.full(robot.n, np.inf))
        limit = np.minimum(limit, most)
        if options.effort_limits == 1:
            limit *= 1 - options.effort_reserve
        for name, value in zip(robot.joint_names, limit, strict=True):
            if not value > 0:
                raise ParameterError(
                    f"Joint '{name}' is limited to an effort of {value:g}, which cannot move it; "
                    "with optimal.effort_limits 2, efforts are not limited."
                )
        return cls(robot, limit) if np.any(np.isfinite(limit)) else None

    def slowed(self, trajectory: Trajectory, boundary: BoundaryConditions) -> Trajectory:
        """Return the trajectory, slowed along its path until its efforts satisfy the limits."""
        q, v = trajectory.shapes, trajectory.velocities
        a = np.diff(v, axis=0) / trajectory.step
        L_B = boundary.momenta_in_base(trajectory.quaternions)
        before, after = (None, None) if L_B is None else (L_B[:-1], L_B[1:])
        ends = np.vstack(
            [
                self._effort_shares(q[:-1], v[:-1], a, before),
                self._effort_shares(q[1:], v[1:], a, after),
            ]
        )
        peak = float(np.abs(ends).max()) / _PLANNED_EFFORT_SHARE
        return trajectory if peak <= 1 else trajectory.stretched(math.sqrt(peak))

    def inequality(self, *, drifting: bool = False) -> ca.Function:
        """Return the limits as an inequality of :meth:`.Stages.of`."""
        n = len(self.limit)
        q, qdot, qddot = (ca.SX.sym(name, n) for name in ("q", "qdot", "qddot"))
        arguments = [q, qdot, qddot, ca.SX.sym("L_B", 3)] if drifting else [q, qdot, qddot]
        limited = np.flatnonzero(np.isfinite(self.limit))
        efforts = self._drifting_function if drifting else self._function
        tau = efforts(*arguments)[limited.tolist()]
        share = tau / (_PLANNED_EFFORT_SHARE * self.limit[limited])
        return ca.Function("efforts", arguments, [ca.vertcat(1 - share, 1 + share)])


# -- held commands ---------------------------------------------------------------------------------

_WAVES_PER_JOINT = 6

_ATTITUDE_TOLERANCE = 1e-11  # rad
_MAX_NEWTON_STEPS = 25
_MAX_STRETCH_FACTOR = 1.25
"""Largest factor by which a manoeuvre is stretched; beyond it, other guesses are better."""

_MAX_PROGRAMS = 4
"""Number of durations, in ticks, tried if all shapes are changed to meet the limits."""

_PROGRAM_STRETCH = 1.01
"""Factor between these durations, rounded up to a tick."""

_MAX_PROGRAMS_IN_TURN = 6
_FIT_TOLERANCE = 1e-5
"""Error, rad, m or m/s, up to which one more program suffices; it leaves far less."""

_MIN_SMOOTH_TICKS = 20
"""Smallest number of ticks in a smooth manoeuvre; shorter manoeuvres are polygons."""

_TICK_ROUNDING = 0.02
"""Fraction of a tick by which a solver's duration may miss a whole number of ticks."""

_LIMIT_ROUNDING = 1e-9

_FADING_ZONE = 0.02
"""Distance from the ends of a joint's range, in half ranges, within which waves are reduced."""


@dataclass(frozen=True)
class HeldCommands:
    """Shapes ``positions`` (N + 1, n) at ticks, and ``quaternions`` (N + 1, 4) since the start."""

    positions: Array
    quaternions: Array


@dataclass(frozen=True)
class ManoeuvreModel:
    """Converts manoeuvres of one robot to held commands, using its model and constraints.

    Attributes
    ----------
    robot, prediction, control_period
        The model, the base motion prediction, and the command duration, s.
    axes
        (m, 3) directions in the base frame along which the attitude is reached.
    constraints, efforts, clearance
        Path constraints; efforts and distances are unlimited if None.
    end_effectors
        Rows for the end-effector goals that must be reached; None: none.
    """

    robot: SpaceRobot
    prediction: BasePrediction
    control_period: float
    axes: Array
    constraints: PathConstraints
    efforts: LimitedEfforts | None = None
    end_effectors: EndEffectorRows | None = None
    clearance: Clearance | None = None

    def stages(self, position: bool, drifting: bool, compiles: bool) -> Stages:
        """Return the functions of the optimal control problem.

        ``compiles``: whether they are compiled, which takes some seconds, if they are not yet.
        """
        stages = Stages.of(
            self.robot,
            self.axes,
            position,
            self.constraints,
            inequality=self.efforts and self.efforts.inequality(drifting=drifting),
            end_effectors=self.end_effectors and self.end_effectors.function,
            drifting=drifting,
        )
        return replace(stages, interval=stages.interval.compiled(builds=compiles))

    def hold(
        self,
        trajectory: Trajectory,
        boundary: BoundaryConditions,
        limits: MotionLimits,
        *,
        fixed: bool = False,
        before: Array | float | None = None,
    ) -> HeldCommands | None:
        """Return commands that follow a trajectory and end at the goal shape and attitude.

        The commands take the trajectory's time, rounded up to whole ticks, or longer if required by
        the limits (``fixed``: not longer); None if no such commands are found. If the boundary
        conditions leave the last shape free, it is the trajectory's last shape, or close to it.
        ``before`` are the velocities (n,) before the start; None: as in ``boundary``.
        """
        if before is not None:
            boundary = replace(boundary, velocity=before)
        final = np.clip(trajectory.shapes[-1], limits.lower, limits.upper)
        if boundary.final is not None:
            final = np.where(np.isfinite(boundary.final), boundary.final, final)
        if boundary.center is not None:
            nearest = nearest_shape_for_center(self.robot, limits, final, boundary.center)
            if nearest is None:
                return None
            final = nearest
        ticks = max(1, math.ceil(trajectory.duration / self.control_period - _TICK_ROUNDING))
        most = (
            ticks if fixed else max(_MIN_SMOOTH_TICKS, math.ceil(_MAX_STRETCH_FACTOR * ticks) + 4)
        )
        free = boundary.final is None and boundary.center is None
        # The last shape is that at which end-effectors are at their goals.
        moves_end, programs = free and self.end_effectors is not None, 0
        while ticks <= most:
            factor, too_fast = 1.0, True
            positions, s = trajectory.at_ticks(ticks), np.linspace(0.0, 1.0, ticks + 1)
            # The solver reaches the final shape only to its own precision.
            late = (s**3 * (10 - 15 * s + 6 * s**2))[:, np.newaxis]
            positions = positions + late * (final - positions[-1])
            positions = np.clip(positions, limits.lower, limits.upper)
            positions[0], positions[-1] = boundary.start, final
            held = self._adjust_to_goal(positions, boundary, limits, moves_end=moves_end)
            if held is not None:
                too_fast, factor = self._excess(held, boundary, limits)
                if not too_fast and factor <= 1 + _LIMIT_ROUNDING:
                    return held
            if too_fast and programs < _MAX_PROGRAMS:
                programs += 1
                fitted = self._fit_to_limits(positions, boundary, limits, moves_end=free)
                if fitted is not None:
                    return fitted
                if programs < _MAX_PROGRAMS:
                    factor = min(factor, _PROGRAM_STRETCH)
            # A polygon with more corners may reach the goal.
            if held is None and ticks >= _MIN_SMOOTH_TICKS:
                return None
            ticks = max(ticks + 1, math.ceil(ticks * factor - 1e-9))
        return None

    def slowed(self, guess: Trajectory, boundary: BoundaryConditions) -> Trajectory:
        """Return a trajectory, slowed until it satisfies the effort and base rate limits."""
        guess = self.constraints.slowed(guess)
        return guess if self.efforts is None else self.efforts.slowed(guess, boundary)

    def _motion(self, held: HeldCommands, boundary: BoundaryConditions) -> HeldMotion:
        before, after = boundary.velocity, boundary.final_velocity
        L_B = boundary.momenta_in_base(held.quaternions)
        return HeldMotion(held.positions, self.control_period, before, after, L_B)

    def _excess(
        self, held: HeldCommands, boundary: BoundaryConditions, limits: MotionLimits
    ) -> tuple[bool, float]:
        """Return whether commands exceed the motion limits, and the slowdown that meets all."""
        motion = self._motion(held, boundary)
        needed, overrun = limits.excess(motion)
        factor = max(needed, self.constraints.excess_rate(held.quaternions, self.control_period))
        if self.efforts is not None:
            factor = max(factor, self.efforts.excess(motion))
        return max(needed - 1, overrun) > _LIMIT_ROUNDING, factor

    def _fit_to_limits(
        self,
        positions: Array,
        boundary: BoundaryConditions,
        limits: MotionLimits,
        *,
        moves_end: bool,
    ) -> HeldCommands | None:
        """Return commands near shapes (N + 1, n), all variable, that meet the goal and limits."""
        for _ in range(_MAX_PROGRAMS_IN_TURN):
            held = self._with_attitudes(positions, boundary)
            error, rows = self._end_error(held, boundary), self._end_rows(held, boundary)
            motion = self._motion(held, boundary)
            change = _least_change(motion, rows, error, limits, moves_end=moves_end)
            if change is None:
                return None
            positions = np.clip(positions + change, limits.lower, limits.upper)
            if float(np.linalg.norm(error)) <= _FIT_TOLERANCE:
                break
        else:
            return None
        found = self._adjust_to_goal(positions, boundary, limits, moves_end=moves_end)
        if found is None:
            return None
        too_fast, factor = self._excess(found, boundary, limits)
        return None if too_fast or factor > 1 + _LIMIT_ROUNDING else found

    def _with_attitudes(self, positions: Array, boundary: BoundaryConditions) -> HeldCommands:
        """Return shapes (N + 1, n) at the ticks with the attitudes to which they lead."""
        start = np.array([0.0, 0.0, 0.0, 1.0])
        attitudes = self.prediction.attitudes(positions, start, boundary.angular_momentum)
        return HeldCommands(positions, attitudes)

    def corrected_end(
        self, trajectory: Trajectory, boundary: BoundaryConditions, ticks: int
    ) -> BoundaryConditions:
        """Return boundary conditions whose solution, in ``ticks`` commands, ends at the goal.

        The goal attitude is rotated by the difference between the end attitudes of a trajectory and
        of its commands. If the robot drifts, the solver's attitude is only second-order accurate.
        """
        reached = self._with_attitudes(trajectory.at_ticks(ticks), boundary).quaternions[-1]
        error = quaternion_from_rotvec(attitude_error(reached, trajectory.quaternions[-1]))
        return replace(boundary, goal_rotation=quaternion_multiply(boundary.goal_rotation, error))

    def _adjust_to_goal(
        self,
        positions: Array,
        boundary: BoundaryConditions,
        limits: MotionLimits,
        *,
        moves_end: bool,
    ) -> HeldCommands | None:
        """Add waves to shapes (N + 1, n) so that they end at the goal attitude; None on failure.

        ``moves_end``: the last shape is changed, too.
        """
        s = np.linspace(0.0, 1.0, len(positions))[:, np.newaxis]
        waves, best = self._build_waves(positions, limits), math.inf
        if moves_end:
            # The others compensate for joints at the end of their range.
            speed = limits.speeds(positions[0]) * self._fading(positions[-1:], limits)[0]
            ramps = (s**2 * (3 - 2 * s))[:, :, np.newaxis] * np.eye(self.robot.n) * speed
            waves = np.hstack([waves, ramps])
        for _ in range(_MAX_NEWTON_STEPS):
            held = self._with_attitudes(positions, boundary)
            error = self._end_error(held, boundary)
            miss = float(np.linalg.norm(error))
            if miss <= _ATTITUDE_TOLERANCE or (
                miss <= 1e3 * _ATTITUDE_TOLERANCE and miss > best / 2
            ):
                return held
            if miss > 2 * best:
                return None
            best = min(best, miss)
            J = np.einsum("mkn,kwn->mw", self._end_rows(held, boundary), waves)
            amplitudes = np.linalg.lstsq(J, error, rcond=1e-10)[0]
            positions = positions + np.einsum("kin,i->kn", waves, amplitudes)
        return None

    def _build_waves(self, positions: Array, limits: MotionLimits) -> Array:
        """Return waves (N + 1, w, n) of one joint each, in proportion to its speed."""
        s = np.linspace(0.0, 1.0, len(positions))[:, np.newaxis]
        order = np.arange(1, _WAVES_PER_JOINT + 1)
        shape = np.sin(math.pi * s) * np.sin(math.pi * s * order) / order
        fading = self._fading(positions, limits)
        joints = np.eye(self.robot.n) * limits.speeds(positions[0])
        waves = (
            shape[:, :, np.newaxis, np.newaxis] * (fading[:, np.newaxis] * joints)[:, np.newaxis]
        )
        return np.asarray(waves.reshape(len(positions), -1, self.robot.n))

    def _fading(self, positions: Array, limits: MotionLimits) -> Array:
        """Return factors (K, n) that vanish smoothly at the ends of the joints' ranges."""
        half = limits.joint_ranges(positions[0])[1]
        room = np.minimum(positions - limits.lower, limits.upper - positions)
        with np.errstate(divide="ignore", invalid="ignore"):
            share = np.clip(np.nan_to_num(room / (_FADING_ZONE * half), nan=0.0), 0.0, 1.0)
        return np.asarray(share**2 * (3 - 2 * share))

    def _end_error(self, held: HeldCommands, boundary: BoundaryConditions) -> Array:
        """Return the remaining error (m,) at the end, along the axes and of end-effectors."""
        error = self.axes @ attitude_error(held.quaternions[-1], boundary.goal_rotation)
        if self.end_effectors is None:
            return np.asarray(error)
        end = held.quaternions[-1:], held.positions[-1:]
        rows, _, _ = self.end_effectors.evaluate(*end, boundary.end_effectors)
        return np.concatenate([error, -rows[0]])

    def _end_rows(self, held: HeldCommands, boundary: BoundaryConditions) -> Array:
        """Return derivatives (m, N + 1, n) of the end values with respect to the shapes."""
        turns = self._turns_by_shapes(held, boundary)
        rows = np.tensordot(self.axes, turns, axes=1)
        if self.end_effectors is None:
            return rows
        end = held.quaternions[-1:], held.positions[-1:]
        _, by_turn, by_shape = self.end_effectors.evaluate(*end, boundary.end_effectors)
        others = np.tensordot(by_turn[0], turns, axes=1)
        others[:, -1] += by_shape[0]
        return np.concatenate([rows, others])

    def _turns_by_shapes(self, held: HeldCommands, boundary: BoundaryConditions) -> Array:
        """Return derivatives (3, N + 1, n) of the final attitude by all shapes, base components."""
        positions, quaternions = held.positions, held.quaternions
        moved = np.gradient(positions, axis=0)
        curvature = self.robot.function("curvature", compile=False)
        K = curvature(positions.T).full().reshape(6, len(positions), self.robot.n, -1)[3:]
        # The columns of one shape run over i fastest: K[axis, shape, j, i].
        R = matrices_from_quaternions(quaternions)
        turned = R @ np.einsum("akji,kj->kai", K, moved)
        L_B = boundary.momenta_in_base(quaternions)
        if L_B is not None:
            turned = self._drift.carried(positions, L_B, R, turned, self.control_period)
        by_shapes = R[-1].T @ turned
        # The last step of a change that does not vanish at the end rotates the base directly.
        by_shapes[-1] -= self.robot.connection(positions[-1])[3:]
        return np.asarray(by_shapes.transpose(1, 0, 2))

    @cached_property
    def _drift(self) -> DriftVariation:
        return DriftVariation(self.robot)


class DriftVariation:
    """First variation of the attitude of a robot with nonzero angular momentum.

    With ``w = D^-1 (L_B - D_q q')``, ``L_B = R' L``, ``A = D^-1 D_q`` and ``xi = R (eta + A dq)``,

    ``xi' = R (K(dq, q') + G dq + D^-1 (L_B x R' xi))``,
    ``G dq = d(D^-1 L_B)/dq dq + (D^-1 L_B) x A dq - D^-1 (L_B x A dq)``,

    where K is the curvature at zero momentum.
    """

    def __init__(self, robot: SpaceRobot) -> None:
        q, L_B = ca.SX.sym("q", robot.n), ca.SX.sym("L_B", 3)
        D, D_q = robot.function("locked_inertia", compile=False)(q)
        inverse, drift = solve_positive_definite(D, ca.SX.eye(3)), solve_positive_definite(D, L_B)
        A = inverse @ D_q
        G = ca.jacobian(drift, q) + ca.skew(drift) @ A - inverse @ ca.skew(L_B) @ A
        outputs = [ca.densify(ca.vec(G)), ca.densify(ca.vec(inverse @ ca.skew(L_B)))]
        self._function = ca.Function("drift_variation", [q, L_B], ca.cse(outputs))
        self._n = robot.n

    def carried(self, shapes: Array, L_B: Array, R: Array, turned: Array, duration: float) -> Array:
        """Return xi (K, 3, n) after K steps of equal ``duration``, by the change dq in each step.

        ``shapes`` (K, n), ``L_B`` (K, 3) and ``R`` (K, 3, 3) are the values at the steps, and
        ``turned`` (K, 3, n) the contribution of curvature to xi in each step.
        """
        columns = (each.full().T for each in self._function(shapes.T, L_B.T))
        G, M = (each.reshape(len(shapes), -1, 3).transpose(0, 2, 1) for each in columns)
        added = turned + duration * (R @ G)
        half = duration / 2 * (R @ M @ R.transpose(0, 2, 1))
        # The implicit midpoint rule of xi' = M xi + b, from the end: the steps after one act on
        # everything added before.
        after, xi = np.eye(3), np.empty_like(added)
        for k in reversed(range(len(added))):
            after = after @ np.linalg.inv(np.eye(3) - half[k])
            xi[k] = after @ added[k]
            after = after @ (np.eye(3) + half[k])
        return xi


# -- the least change in commands -----------------------------------------------------------------

_LIMIT_RESERVE = 1e-4
"""Fraction of the velocity and acceleration limits reserved for the last, small correction."""

_OPTIONS = {
    "error_on_fail": False,
    "print_time": False,
    "osqp": {
        "verbose": False,
        "eps_abs": 1e-7,
        "eps_rel": 1e-7,
        "eps_prim_inf": 1e-6,
        "max_iter": 4000,
        # By default the solver adapts to its own computing time: results would depend on it.
        "adaptive_rho_interval": 25,
    },
}


def _least_change(
    motion: HeldMotion, rows: Array, error: Array, limits: MotionLimits, *, moves_end: bool
) -> Array | None:
    """Return the smallest change (N + 1, n) in the shapes at ticks that satisfies all limits and
    changes m end values, with derivatives ``rows`` (m, N + 1, n), by ``error`` (m,); None: none.

    Smallest is the sum of squares of changes divided by joint speeds; the first shape is fixed.
    """
    positions, period = motion.positions, motion.period
    N, n = len(positions) - 1, positions.shape[1]
    moving = slice(1, N + 1 if moves_end else N)
    count = N - 1 + moves_end
    if count < 1:
        return None
    # Unknowns are fractions of a tick at full speed.
    scale = limits.speeds(positions[0]) * period
    scaled = (rows[:, moving] * scale).reshape(len(rows), count * n)
    weight = 1.0 / np.maximum(np.linalg.norm(scaled, axis=1), 1e-12)

    steps = ca.DM.eye(N + 1)[:, moving]
    first = steps[1:, :] - steps[:-1, :]
    second = ca.vertcat(first, ca.DM(1, count)) - ca.vertcat(ca.DM(1, count), first)
    speed_share = scale / (limits.velocity * period)
    change_share = scale / (limits.acceleration * period**2)
    A = ca.vertcat(
        weight[:, np.newaxis] * scaled,
        ca.kron(first, ca.diag(speed_share)),
        ca.kron(second, ca.diag(change_share)),
    )
    speeds, changes = motion.velocities[1:-1], motion.accelerations
    shares = np.concatenate(
        [(speeds / limits.velocity).ravel(), (changes / limits.acceleration).ravel()]
    )
    most = 1.0 - _LIMIT_RESERVE
    wanted = weight * error
    program = ca.conic(
        "commands", "osqp", {"h": ca.Sparsity.diag(count * n), "a": A.sparsity()}, _OPTIONS
    )
    found = program(
        h=ca.DM.eye(count * n),
        a=A,
        lba=np.concatenate([wanted, -most - shares]),
        uba=np.concatenate([wanted, most - shares]),
        lbx=((limits.lower - positions[moving]) / scale).ravel(),
        ubx=((limits.upper - positions[moving]) / scale).ravel(),
    )
    if not program.stats()["success"]:
        return None
    change = np.zeros_like(positions)
    change[moving] = found["x"].full().reshape(count, n) * scale
    return change
