"""Resolved-rate motion of end-effectors along given lines, with a floating base.

At zero momentum, the generalised Jacobian ``J*(q)`` maps joint rates to the velocity of
an end-effector in the world (Umetani and Yoshida). The rates that move it along a line (straight,
through waypoints, or a given path) are ``qdot = J*^+ xdot``. If ``J*`` loses rank, there are no
such rates: a dynamic singularity. Whether the line meets one depends only on the configuration,
which depends on the path that led there (paper 4, section V; path-dependent workspaces).

The path is parametrised by its length, not by time: its tangent is a vector in the null space of
``[J*, -x']``, which is finite up to the singularity, where the progress along the line becomes
zero. The motion along the path is the fastest possible within the velocity and acceleration limits
(a linear program in the squared speed). Held commands move the shape along straight lines between
ticks, so the shape at each tick is corrected until the end-effectors are on their lines.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import ClassVar

import numpy as np
import numpy.typing as npt
from typing_extensions import override

from spacerobot_ros.errors import ParameterError, PlanningError, counted
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.rotations import (
    matrix_from_quaternion,
    quaternion_from_matrix,
    quaternion_from_rotvec,
    quaternion_inverse,
    quaternion_multiply,
    rotvec_from_quaternion,
)
from spacerobot_ros.parameters import nonnegative, parameter
from spacerobot_ros.planning.core.cancellation import NEVER, Cancellation
from spacerobot_ros.planning.core.controllability import sample_shapes
from spacerobot_ros.planning.core.goal import (
    Controlled,
    EndEffectorGoal,
    Goal,
    RobotState,
    end_effector_pose,
)
from spacerobot_ros.planning.core.method import GaitMethod, PlanRequest
from spacerobot_ros.planning.core.schedule import GaitSchedule, HeldMotion, Notes
from spacerobot_ros.planning.methods.optimal.end_effectors import EndEffectorRows
from spacerobot_ros.planning.methods.optimal.goal_specification import BaseRotations
from spacerobot_ros.planning.methods.optimal.motion_bounds import reach_of_end_effector
from spacerobot_ros.planning.methods.optimal.problem import MotionLimits, MotionOptions
from spacerobot_ros.planning.methods.pose_path import PosePath, RoundedPath

_TRACE_STEP = 0.02
"""Longest step along a joint path, rad of the fastest joint."""

_MIN_TRACE_STEPS, _MAX_TRACE_STEPS = 20, 30_000
"""Smallest and largest number of steps along a joint path."""

MIN_PROGRESS_RATE = 0.01
"""Progress below which a singularity is near, in reaches per radian of the fastest joint."""

_ZERO_PROGRESS_RATE = 1e-8
"""Progress below which the path has reached the singularity."""

_SINGULARITY_STEP_SHARE = 0.25

_KNOT_TOLERANCE = 1e-6
"""Fraction of the path within which a curvature jump counts as passed."""

_ZERO_DISTANCE = 1e-10  # m or rad

_SAMPLED_SHAPES = 8
"""Number of shapes at which the degrees of freedom of the joints are examined."""

_PATH_LENGTH_SAMPLES = 200
_TIMING_INTERVALS = 160
_MAX_TIMING_INTERVALS = 1600
_MAX_TICKS = 500_000

_USED_ACCELERATION_SHARE = 0.99
"""Fraction of the acceleration limits for the path; corrections at the ticks may use the rest."""

_MAX_CORRECTION_ITERATIONS = 8
"""Number of Newton steps per tick, and number of attempts to satisfy the limits with more ticks."""

_LIMIT_ROUNDING = 1e-9
"""Largest excess over a limit: relative, or in joint coordinates."""


@dataclass(frozen=True)
class ResolvedRateOptions(MotionOptions):
    """The options of ``resolved_rate``."""

    keep_attitude: int = nonnegative(
        0,
        "1: the base keeps its attitude (reaction null space), 0: base attitude is free",
        maximum=1,
    )
    waypoints: tuple[float, ...] = parameter(
        (),
        "successive positions x, y, z in the world on a smooth end-effector path to its goal; []: "
        "a straight line",
        "m",
        minimum=-1e9,
        maximum=1e9,
    )
    as_far_as_possible: int = nonnegative(
        0,
        "if a line meets a singularity, a joint limit or a contact: 1: stop shortly before, 0: "
        "reject the goal",
        maximum=1,
    )
    corner_tolerance: float = nonnegative(
        0.005,
        "largest deviation at the rounded corners of a path: this value in m, and the same value "
        "in rad; 0: stop at every corner",
        "m",
        maximum=1000.0,
    )


class _SmoothPath:
    """A path through points (K, 3), m, from the origin: a natural cubic spline over chord length.

    ``turn`` (3,) is the rotation vector from the start to the end, in step with the way, rad;
    ``total_length`` is that of the chords, m; its curvature has no jumps (``curvature_breaks``).
    """

    curvature_breaks = np.zeros(0)

    def __init__(self, points: Array, turn: npt.ArrayLike = (0.0, 0.0, 0.0)) -> None:
        from scipy.interpolate import CubicSpline

        # A repeated point adds no length.
        chords = np.linalg.norm(np.diff(points, axis=0), axis=1)
        kept = np.flatnonzero(np.append(np.inf, chords) > _ZERO_DISTANCE)
        along = np.append(0.0, np.cumsum(chords))[kept]
        self.is_straight = len(kept) <= 2
        self.total_length = float(along[-1])
        self._turn = np.asarray(turn, dtype=float)
        if len(kept) == 1:
            along, kept = np.array([0.0, 1.0]), np.array([0, 0])
        self._place = CubicSpline(along / along[-1], points[kept], bc_type="natural")
        self._rate = self._place.derivative()

    def pose(self, share: float) -> tuple[Array, Array]:
        """Return displacement (3,), m, and rotation (4,) from the start at a share of the way."""
        return np.asarray(self._place(share)), quaternion_from_rotvec(share * self._turn)

    def derivative(self, share: float) -> tuple[Array, Array]:
        """Return their derivatives by the share: velocity (3,), m, angular velocity (3,), rad."""
        return np.asarray(self._rate(share)), self._turn

    def travelled_length(self, share: float) -> float:
        """Return the length, m, of a fraction of the path."""
        return share * self.total_length


@dataclass(frozen=True)
class _LinkPath:
    """The line of a link E in the initial base frame B_0, relative to the centre of mass.

    ``displacements`` (k, 3) and ``rotations`` (l, 3) are the directions in which the joints move
    and rotate it; ``start_position`` (3,) and ``start_attitude`` (4,) are its first pose.
    """

    link: str
    displacements: Array
    rotations: Array
    start_position: Array
    start_attitude: Array
    path_from_start: _SmoothPath | RoundedPath


def unit_of_motion(robot: SpaceRobot, limits: MotionLimits, link: str) -> float:
    """Return the reach of a link, m, with the ranges of long or unlimited sliders shortened."""
    middle, half = limits.joint_ranges(np.clip(0.0, limits.lower, limits.upper))
    return reach_of_end_effector(robot, middle - half, middle + half, link)


class _LinkPaths:
    """The lines of all links of a goal, and how the joints move the links along them.

    Rows are scaled by the reach of the links, joints by their velocity limits: all are radians of
    the fastest joint. ``joint_scales`` (n,) is the motion of each joint while the fastest one moves
    by a radian, m or rad; ``length`` is the scaled length of all lines; ``curvature_breaks`` are
    the fractions of the lines at which their curvature jumps.
    """

    def __init__(self, robot: SpaceRobot, lines: Sequence[_LinkPath], limits: MotionLimits) -> None:
        self._robot, self._lines, self._limits = robot, tuple(lines), limits
        fastest = float(limits.velocity.max())
        ones = np.ones(robot.n)
        self.joint_scales = limits.velocity / fastest if math.isfinite(fastest) else ones
        scales = []
        for line in lines:
            reach = 1.0
            if len(line.displacements):
                reach = unit_of_motion(robot, limits, line.link)
            scales += [1 / reach] * len(line.displacements) + [1.0] * len(line.rotations)
        self._row_scales = np.array(scales)
        self.is_straight = all(line.path_from_start.is_straight for line in lines)
        self.curvature_breaks = np.unique(
            np.concatenate([line.path_from_start.curvature_breaks for line in lines])
        )
        shares = np.linspace(0.0, 1.0, 2 if self.is_straight else _PATH_LENGTH_SAMPLES)
        self.length = float(
            np.mean([np.linalg.norm(self._scaled_derivative(share)) for share in shares])
        )

    def _scaled_derivative(self, share: float) -> Array:
        """Return the scaled derivative (m,) of the rows by the fraction of the lines."""
        rates: list[Array] = []
        for line in self._lines:
            velocity, omega = line.path_from_start.derivative(share)
            rates += [line.displacements @ velocity, line.rotations @ omega]
        return np.asarray(np.concatenate(rates) * self._row_scales)

    def jacobian(self, q: Array, X: Array) -> Array:
        """Return the rows (m, n) of J* in B_0, for a shape and a base rotation (4,)."""
        R_X = matrix_from_quaternion(X)
        rows = []
        for line in self._lines:
            J = self._robot.generalised_jacobian(line.link, q)
            rows += [line.displacements @ R_X @ J[:3], line.rotations @ R_X @ J[3:]]
        return np.vstack(rows)

    def scaled_jacobian(self, q: Array, X: Array) -> Array:
        """Return :meth:`jacobian` per radian of the fastest joint."""
        return np.asarray(self._row_scales[:, np.newaxis] * self.jacobian(q, X) * self.joint_scales)

    def beyond_limits(self, q: Array) -> Array:
        """Return how far joints (n,) are beyond their limits, m or rad; negative within them."""
        return np.asarray(np.maximum(self._limits.lower - q, q - self._limits.upper))

    def least_correction(self, q: Array, X: Array, progress: float) -> tuple[Array, float]:
        """Return the least joint motion (n,) that puts links on their lines, and scaled error."""
        R_X, missing = matrix_from_quaternion(X), list[Array]()
        r_BC = self._robot.center_of_mass(q)
        for line in self._lines:
            R, r = self._robot.link_pose(line.link, q)
            displacement, turn = line.path_from_start.pose(progress)
            target = quaternion_multiply(turn, line.start_attitude)
            found = quaternion_inverse(quaternion_from_matrix(R_X @ R))
            rotation = rotvec_from_quaternion(quaternion_multiply(target, found))
            left = line.start_position + displacement - R_X @ (r - r_BC)
            missing += [line.displacements @ left, line.rotations @ rotation]
        miss = np.concatenate(missing) * self._row_scales
        least = np.linalg.lstsq(self.scaled_jacobian(q, X), miss, rcond=None)[0]
        return self.joint_scales * least, float(np.linalg.norm(miss))

    def tangent(self, q: Array, X: Array, share: float) -> tuple[Array, Array, float]:
        """Return the path's tangent: shape (n,), rotation (4,), and progress."""
        M = np.column_stack(
            [self.scaled_jacobian(q, X), -self._scaled_derivative(share) / self.length]
        )
        # The unit vector of most progress in the null space: the projection of the last axis.
        basis = np.linalg.qr(M.T, mode="complete")[0][:, len(M) :]
        progress = float(np.linalg.norm(basis[-1]))
        if progress < _ZERO_PROGRESS_RATE / 100:  # The joints cannot move without leaving the line.
            return np.zeros(len(q)), np.zeros(4), 0.0
        u = self.joint_scales * (basis @ basis[-1])[:-1] / progress
        omega = -self._robot.connection(q)[3:] @ u
        X_rate = quaternion_multiply(X, np.append(omega, 0.0)) / 2
        return u, X_rate, progress

    def singularity_measure(self, q: Array, X: Array) -> tuple[str, float]:
        """Return the value that becomes zero at a singularity, with its name."""
        J = self.jacobian(q, X)
        if J.shape[0] == J.shape[1]:
            return "|det J*|", abs(float(np.linalg.det(J)))
        value = np.linalg.svd(self.scaled_jacobian(q, X), compute_uv=False)[-1]
        return "the smallest singular value of J* (scaled)", float(value)

    def position_text(self, share: float) -> str:
        link, path = self._lines[0].link, self._lines[0].path_from_start
        whole, kind = path.total_length, "line" if path.is_straight else "path"
        if whole > _ZERO_DISTANCE:
            done = path.travelled_length(share)
            return f"after {done:.6g} of {whole:.6g} m of the {kind} of '{link}'"
        turn = float(np.linalg.norm(path.derivative(share)[1]))
        return f"after {share * turn:.6g} of {turn:.6g} rad of the rotation of '{link}'"


@dataclass(frozen=True)
class JointPath:
    """A shape path that moves end-effectors along their lines.

    Attributes
    ----------
    arc_length
        (K,) length of the joint path so far, rad of the fastest joint.
    shapes
        (K, n) shapes, m or rad.
    turns
        (K, 4) base attitudes relative to the initial attitude.
    path_fractions
        (K,) fractions of the lines, 0 to 1.
    progress_rate
        (K,) progress along the lines per length of the joint path; zero at a singularity.
    """

    arc_length: Array
    shapes: Array
    turns: Array
    path_fractions: Array
    progress_rate: Array

    def truncated(self, last: int) -> JointPath:
        """Return the path up to and including one of its points."""
        parts = {each.name: getattr(self, each.name)[: last + 1] for each in fields(self)}
        return JointPath(**parts)


def trace_joint_path(lines: _LinkPaths, q: Array, cancellation: Cancellation) -> JointPath:
    """Follow lines to their ends, a singularity or the nearest point, or a joint limit (RK4).

    Beyond these points, the joints may turn for long with hardly any progress along the lines.
    """
    n, total = len(q), lines.length
    breaks = lines.curvature_breaks * total
    y = np.concatenate([q, [0.0, 0.0, 0.0, 1.0, 0.0]])

    def rate(y: Array) -> Array:
        X = y[n : n + 4] / np.linalg.norm(y[n : n + 4])
        u, X_rate, progress = lines.tangent(y[:n], X, min(float(y[-1]) / total, 1.0))
        return np.concatenate([u, X_rate, [progress]])

    k = rate(y)
    lengths, states, progress = [0.0], [y], [float(k[-1])]
    longest = min(_TRACE_STEP, total / _MIN_TRACE_STEPS / max(progress[0], _ZERO_PROGRESS_RATE))
    share = 1.0
    while progress[-1] > _ZERO_PROGRESS_RATE:
        cancellation.raise_if_requested()
        falls = progress[-2] - progress[-1] if len(progress) > 1 else 0.0
        rises_again = falls < 0 and progress[-2] < MIN_PROGRESS_RATE
        if rises_again or lines.beyond_limits(y[:n]).max() > _LIMIT_ROUNDING:
            break
        if len(lengths) > _MAX_TRACE_STEPS:
            raise PlanningError(
                f"The line is too long: the joints move by {lengths[-1]:.4g} rad or m "
                f"{lines.position_text(y[-1] / total)}; send nearer goals one after the other."
            )
        left = total - y[-1]
        ahead = breaks[breaks > y[-1] + _KNOT_TOLERANCE * total] - y[-1]
        # Steps end where the curvature of the path jumps.
        step = min(longest, left / progress[-1], *ahead[:1] / progress[-1])
        if falls > 0:
            slope = falls / (lengths[-1] - lengths[-2])
            step = min(step, _SINGULARITY_STEP_SHARE * progress[-1] / slope)
        step *= share
        k2 = rate(y + step / 2 * k)
        k3 = rate(y + step / 2 * k2)
        k4 = rate(y + step * k3)
        there = y + step / 6 * (k + 2 * k2 + 2 * k3 + k4)
        there[n : n + 4] /= np.linalg.norm(there[n : n + 4])
        at_end = rate(there)
        # A singularity is a turning point of the path, which no step may go beyond: there, the
        # tangent is reversed, as progress is never negative.
        if min(float(x[:n] @ (k[:n] / lines.joint_scales**2)) for x in (k2, k3, k4, at_end)) < 0:
            share /= 4
            if step < _ZERO_PROGRESS_RATE**2:
                progress[-1] = 0.0
            continue
        y, k, share = there, at_end, min(2 * share, 1.0)
        lengths.append(lengths[-1] + step)
        states.append(y)
        progress.append(float(k[-1]))
        if total - y[-1] <= 1e-9 * total:
            y[-1] = total
            break
    found = np.array(states)
    return JointPath(
        np.array(lengths), found[:, :n], found[:, n:-1], found[:, -1] / total, np.array(progress)
    )


def _fastest_speeds(slopes: Array, bends: Array, limits: MotionLimits, interval: float) -> Array:
    """Return the squares (K + 1,) of the fastest speed on a path, from rest to rest.

    At K + 1 points ``interval`` apart, with the derivatives (K + 1, n) of the shape by the path
    length. With ``x`` the square of the speed, ``x' / 2`` is the acceleration along the path, and
    ``q'' x + q' x' / 2`` that of the joints: limits are linear in ``x`` (Verscheure et al.), and
    the largest sum is the largest speed everywhere.
    """
    from scipy.optimize import linprog
    from scipy.sparse import csr_matrix, vstack

    K, n = len(slopes) - 1, slopes.shape[1]
    with np.errstate(divide="ignore"):
        fastest = (limits.velocity / np.abs(slopes)).min(axis=1) ** 2
        # Unit of the squares, so that the linear program has numbers near one.
        by_acceleration = (limits.acceleration / (np.abs(slopes) / interval + np.abs(bends))).min()
    unit = float(by_acceleration) * K
    fastest = np.minimum(fastest / unit, 1e6)
    fastest[[0, -1]] = 0.0
    bound = np.tile(_USED_ACCELERATION_SHARE * limits.acceleration / unit, 2 * K)
    # Rows for both ends of each interval, in which x' is constant, depend on x at these ends.
    values = []
    for end in (0, 1):
        slope, bend = slopes[end : K + end] / (2 * interval), bends[end : K + end]
        values.append(np.stack([(1 - end) * bend - slope, slope + end * bend], axis=-1))
    columns = np.tile(np.repeat(np.arange(K)[:, np.newaxis] + [0, 1], n, axis=0), (2, 1))
    entries = np.ravel(values), columns.ravel(), 2 * np.arange(len(columns) + 1)
    A = csr_matrix(entries, shape=(len(columns), K + 1))
    found = linprog(
        -np.ones(K + 1),
        A_ub=vstack([A, -A]).tocsr(),
        b_ub=np.concatenate([bound, bound]),
        bounds=np.column_stack([np.zeros(K + 1), fastest]),
        method="highs",
    )
    if found.x is None:
        raise PlanningError("No motion along the line was found within the joint limits.")
    return np.maximum(np.asarray(found.x, dtype=float), 0.0) * unit


class _TimedPath:
    """A path in time, as fast as velocities and accelerations allow."""

    def __init__(self, path: JointPath, limits: MotionLimits, intervals: int) -> None:
        from scipy.interpolate import CubicSpline

        self._end, self._length = path.path_fractions[-1], path.arc_length[-1]
        values = np.column_stack([path.shapes, path.path_fractions])
        self._by_length = CubicSpline(path.arc_length, values)
        places, self._interval = np.linspace(0.0, self._length, intervals + 1, retstep=True)
        slopes, bends = (self._by_length(places, order)[:, :-1] for order in (1, 2))
        self._speed = np.sqrt(_fastest_speeds(slopes, bends, limits, float(self._interval)))
        mean_speed = (self._speed[1:] + self._speed[:-1]) / 2
        self.time = np.cumsum(np.append(0.0, self._interval / mean_speed))
        """Times (K + 1,), s, at equal distances along the path."""

    def at_ticks(self, ticks: int) -> tuple[Array, Array]:
        """Return the shapes (ticks + 1, n) and fractions of the lines at equal time intervals."""
        t = np.linspace(0.0, self.time[-1], ticks + 1)
        k = np.clip(np.searchsorted(self.time, t, side="right") - 1, 0, len(self.time) - 2)
        since, duration = t - self.time[k], self.time[k + 1] - self.time[k]
        change = (self._speed[k + 1] - self._speed[k]) / duration
        length = k * self._interval + self._speed[k] * since + change * since**2 / 2
        found = self._by_length(np.minimum(length, self._length))
        shares = np.clip(found[:, -1], 0.0, 1.0)
        shares[-1] = self._end
        return found[:, :-1], shares


@dataclass(frozen=True)
class PathProgress:
    """Progress of a schedule along a given path.

    Attributes
    ----------
    route
        The path in W, from the initial end-effector pose.
    travelled_lengths
        (M + 1,) length of the route completed at the last M + 1 ticks, metres plus radians.
    """

    route: PosePath
    travelled_lengths: Array


class ResolvedRateGait(GaitMethod):
    """Moves end-effectors along straight lines or paths to their goals, with the base free.

    The motion is from rest to rest, as fast as the joint limits allow. Handles goal positions, or
    goal poses with a rotation about one axis, of one or more end-effectors; only a single
    end-effector can follow a given path. Lines that meet a dynamic singularity, a joint limit or a
    contact are rejected or followed until shortly before; ``optimal`` reaches most of their ends.
    """

    name: ClassVar[str] = "resolved_rate"
    plans_for_base: ClassVar[bool] = False
    plans_for_end_effectors: ClassVar[bool] = True
    follows_paths: ClassVar[bool] = True
    Options: ClassVar[type[ResolvedRateOptions]] = ResolvedRateOptions
    options: ResolvedRateOptions

    controls: frozenset[Controlled] = frozenset({"end_effectors"})

    @override
    def setup(self) -> None:
        self._limits = MotionLimits.of(self.robot, self.options, self.name)
        if len(self.options.waypoints) % 3:
            raise ParameterError(
                f"{self.name}.waypoints has {counted(len(self.options.waypoints), 'number')}; a "
                "waypoint has three."
            )

    @classmethod
    @override
    def require_suitable(cls, robot: SpaceRobot) -> None:
        """Reject robots without joints; see :meth:`GaitMethod.require_suitable`."""
        if robot.n == 0:
            name = robot.description.name
            raise PlanningError(f"Robot '{name}' has no joints that could move an end-effector.")

    @override
    def plan(self, request: PlanRequest, cancellation: Cancellation = NEVER) -> GaitSchedule:
        """Plan the motion along the lines; see :meth:`GaitMethod.plan`."""
        self.require_rest(request.state)
        self.require_suitable(self.robot)
        q = np.clip(request.state.q, self.robot.lower, self.robot.upper)
        request = self._with_resolved_goal(replace(request, state=replace(request.state, q=q)))
        if request.goal.has_path:
            return self._plan_along_path(request, cancellation)
        lines = self._link_paths(request, self._waypoints(request))
        if lines.length < _ZERO_DISTANCE:
            return self._schedule(request, q[np.newaxis], {})
        positions, _, notes = self._trace_without_contact(lines, request.state, cancellation)
        return self._schedule(request, positions, notes)

    def _plan_along_path(self, request: PlanRequest, cancellation: Cancellation) -> GaitSchedule:
        """Plan along the path of the goal, with a rest at each of its sharp corners."""
        now, tolerance = request.state, self.options.corner_tolerance / 2
        route = self._route(request, tolerance)
        whole = float(np.linalg.norm(route.chords, axis=1).sum())
        positions, along, metres = [now.q[np.newaxis]], [np.zeros(1)], 0.0
        notes: Notes = {}
        least = math.inf
        for piece in route.split_at_reversals(tolerance) if len(route.positions) > 1 else ():
            way = (piece, metres, whole)
            lines = self._link_paths(replace(request, state=now), piece.positions[1:-1], way)
            shapes, shares, found = self._trace_without_contact(lines, now, cancellation)
            least = min(least, float(str(found["least"])))
            notes = {**found, **notes, "least": least}
            positions.append(shapes[1:])
            along.append(along[-1][-1] + shares[1:] * piece.lengths_at_poses[-1])
            if "stopped" in found:
                break
            metres += float(np.linalg.norm(piece.chords, axis=1).sum())
            base = self._prediction.path(now, shapes)
            now = RobotState(base.position[-1], base.quaternion[-1], shapes[-1])
        progress = PathProgress(route, np.concatenate(along))
        return self._schedule(request, np.vstack(positions), notes, progress)

    def _route(self, request: PlanRequest, tolerance: float) -> PosePath:
        """Return the path of a request in W, from the current end-effector pose."""
        state, goal = request.state, request.goal
        if len(goal.end_effectors) > 1:
            raise PlanningError(
                f"{self.name} moves one end-effector along a path, but the goal is for "
                f"{len(goal.end_effectors)}: send their paths one after the other."
            )
        (aim,) = goal.end_effectors
        r, quaternion = end_effector_pose(
            self.robot, aim.link, state.position, state.quaternion, state.q
        )
        before, progress = request.previous, None
        if before is not None and isinstance(before.progress, PathProgress):
            progress, done = before.progress, before.progress.travelled_lengths
            off = np.linalg.norm(before.positions[-len(done) :] - state.q, axis=1)
            rest = progress.route.remaining_after(float(done[np.argmin(off)]))
        else:
            points = aim.path_values[-1:] if request.correction else aim.path_values
            # Without an attitude, any will do: it does not rotate.
            any_ = np.tile([0.0, 0.0, 0.0, 1.0], (len(points), 1))
            rest = PosePath(points[:, :3], any_ if aim.quaternion is None else points[:, 3:])
        if aim.quaternion is None:
            quaternion = rest.quaternions[0]
        route = PosePath.from_poses(
            np.vstack([r, rest.positions]), np.vstack([quaternion, rest.quaternions])
        )
        return route.simplified(tolerance) if progress is None else route

    def _trace_without_contact(
        self, lines: _LinkPaths, state: RobotState, cancellation: Cancellation
    ) -> tuple[Array, Array, Notes]:
        """Return shapes (N + 1, n) and fractions of the lines (N + 1,) at ticks, with notes."""
        path = trace_joint_path(lines, state.q, cancellation)
        notes: Notes = {}
        obstacle = self._find_obstacle(lines, path)
        if self.options.as_far_as_possible:
            obstacle = self._find_contact(state, path, obstacle)
        if obstacle is not None:
            last, reason = obstacle
            if not (self.options.as_far_as_possible and last > 0):
                raise PlanningError(reason)
            path, notes = path.truncated(last), {"stopped": reason}
        intervals = _TIMING_INTERVALS
        if len(lines.curvature_breaks):
            intervals = min(max(_TIMING_INTERVALS, len(path.arc_length) - 1), _MAX_TIMING_INTERVALS)
        timed = _TimedPath(path, self._limits, intervals)
        positions, shares = self._held_commands(lines, state, timed)
        name, first = lines.singularity_measure(state.q, path.turns[0])
        least = min(
            lines.singularity_measure(shape, X)[1]
            for shape, X in zip(path.shapes, path.turns, strict=True)
        )
        notes |= {"singularity_measure": name, "at_start": first, "least": least}
        return positions, shares, notes

    def _find_contact(
        self, state: RobotState, path: JointPath, obstacle: tuple[int, str] | None
    ) -> tuple[int, str] | None:
        """Return the last point before links come too close, with the reason; or ``obstacle``."""
        last = len(path.shapes) - 1 if obstacle is None else obstacle[0]
        attitudes = quaternion_multiply(state.quaternion, path.turns)

        def clause(until: int) -> str:
            shapes = path.shapes[: until + 1]
            base = self._base_poses(state, shapes, attitudes[: until + 1])
            return self._too_near(shapes, base, at_ticks=False)

        if last < 1 or not (found := clause(last)):
            return obstacle
        free, met = 0, last
        while met - free > 1:
            middle = (free + met) // 2
            if nearer := clause(middle):
                met, found = middle, nearer
            else:
                free = middle
        return free, f"On the way {found}."

    def path(self, request: PlanRequest, cancellation: Cancellation = NEVER) -> JointPath:
        """Return the path along the lines of a goal, to their ends, a singularity or a joint limit.

        A path in the goal is ignored: the lines lead straight to the end of that path.

        Raises
        ------
        PlanningError
            The goal is of an unsupported kind, or requests too much; see :meth:`plan`.
        """
        request = self._with_resolved_goal(request)
        lines = self._link_paths(request, self._waypoints(request))
        return trace_joint_path(lines, request.state.q, cancellation)

    def _waypoints(self, request: PlanRequest) -> Array:
        """Return the waypoints (K, 3) of a request, in the world: none for a correction."""
        goal = request.goal
        if request.correction or not self.options.waypoints:
            return np.zeros((0, 3))
        if len(goal.end_effectors) > 1:
            raise PlanningError(
                f"{self.name}.waypoints are for one end-effector, but the goal is for "
                f"{len(goal.end_effectors)}: give a goal for one end-effector, or omit the "
                f"waypoints."
            )
        return np.reshape(self.options.waypoints, (-1, 3))

    def _with_resolved_goal(self, request: PlanRequest) -> PlanRequest:
        """Return a request whose goal names links of the robot; reject goals for the base."""
        goal = request.goal.for_robot(self.robot.description)
        if not goal.end_effectors:
            raise PlanningError(
                f"{self.name} moves end-effectors along straight lines, but the goal is for the "
                "base: use optimal for it."
            )
        if goal.base or goal.joint_positions is not None:
            part = "the pose of the base" if goal.base else "joint positions"
            raise PlanningError(
                f"{self.name} moves the joints along the line of the end-effector, but the goal "
                f"also requests {part}: use optimal for both."
            )
        return replace(request, goal=goal)

    def _link_paths(
        self,
        request: PlanRequest,
        waypoints: Array,
        piece: tuple[PosePath, float, float] | None = None,
    ) -> _LinkPaths:
        """Return the lines of a goal, along directions in which the joints move the links.

        ``piece`` is a part of a given path that the first link follows, the metres before it and in
        the whole path; None: it goes through the waypoints to the goal. PlanningError if
        the goal lies off these directions, or has more of them than the joints can follow.
        """
        robot, state, goal = self.robot, request.state, request.goal
        goals = list(goal.end_effectors)
        if self.options.keep_attitude:
            goals.append(EndEffectorGoal(robot.base_link, state.position, state.quaternion))
        links = [(x.link, x.quaternion is not None) for x in goals]
        rows = EndEffectorRows(robot, links, BaseRotations.of(robot).loop_axes)
        for point in (goals[0].position, *waypoints):
            at_point = [replace(goals[0], position=point), *goals[1:]]
            rows.require_directions(state, at_point, request.tolerance)
        if piece is None and not self.options.as_far_as_possible:
            rows.require_within_reach(self._limits, state, goal.end_effectors)
        from_start, r_BC = quaternion_inverse(state.quaternion), robot.center_of_mass(state.q)
        R_BW = matrix_from_quaternion(state.quaternion).T
        lines = []
        for each, directions in zip(goals, rows.directions, strict=True):
            R_BE, r_BE = robot.link_pose(each.link, state.q)
            quaternion, turn = quaternion_from_matrix(R_BE), np.zeros(3)
            if each.quaternion is not None:
                wanted = quaternion_multiply(from_start, each.quaternion)
                between = quaternion_multiply(wanted, quaternion_inverse(quaternion))
                turn = rotvec_from_quaternion(between)
            is_base, is_led = each.link == robot.base_link, each is goals[0]
            points = np.vstack([waypoints, each.position] if is_led else [each.position])
            way: _SmoothPath | RoundedPath
            if is_led and piece is not None:
                path, before, whole = piece
                seen = PosePath(
                    path.positions @ R_BW.T, quaternion_multiply(from_start, path.quaternions)
                )
                way = RoundedPath(seen, self.options.corner_tolerance / 2, before, whole)
            else:
                points = np.vstack([np.zeros(3), (points - state.position) @ R_BW.T - r_BE])
                way = _SmoothPath(points) if is_base else _SmoothPath(points, turn)
            # Only the attitude of the base is kept.
            moved = np.zeros((0, 3)) if is_base else directions.displacements
            lines.append(
                _LinkPath(each.link, moved, directions.rotations, r_BE - r_BC, quaternion, way)
            )
        found = _LinkPaths(robot, lines, self._limits)
        self._require_freedom(found, goal)
        return found

    def _require_freedom(self, lines: _LinkPaths, goal: Goal) -> None:
        X = np.array([0.0, 0.0, 0.0, 1.0])
        matrices = [lines.jacobian(q, X) for q in sample_shapes(self.robot, _SAMPLED_SHAPES)]
        rank = max(int(np.linalg.matrix_rank(J, tol=1e-6)) for J in matrices)
        wanted = len(matrices[0])
        if rank < wanted:
            names = " and ".join(f"'{each.link}'" for each in goal.end_effectors)
            still = " with the base attitude kept" if self.options.keep_attitude else ""
            less = ", or omit resolved_rate.keep_attitude" if still else ""
            raise PlanningError(
                f"The line of {names}{still} requires {wanted} independent coordinates, but the "
                f"joints of robot '{self.robot.description.name}' move no more than {rank}: "
                f"request a position instead of a pose{less}."
            )

    def _find_obstacle(self, lines: _LinkPaths, path: JointPath) -> tuple[int, str] | None:
        """Return the last point before a joint limit or a singularity, and which; None if free."""
        beyond = lines.beyond_limits(path.shapes[-1])
        slow = np.flatnonzero(path.progress_rate < MIN_PROGRESS_RATE)
        if not len(slow) and beyond.max() > _LIMIT_ROUNDING:
            joint = self.robot.description.movable_joints[int(np.argmax(beyond))]
            return len(path.shapes) - 2, (
                f"Joint '{joint.name}' is at its limit "
                f"{lines.position_text(path.path_fractions[-1])}: optimal may reach the goal "
                f"without following the line; so may a line from another shape."
            )
        if not len(slow):
            return None
        nearest = int(np.argmin(path.progress_rate))
        name, value = lines.singularity_measure(path.shapes[nearest], path.turns[nearest])
        first = lines.singularity_measure(path.shapes[0], path.turns[0])[1]
        shape = ", ".join(f"{x:.6g}" for x in path.shapes[nearest])
        meets, least, there = "meets", "zero", "no joint rates continue the motion along the line"
        if path.progress_rate[-1] > _ZERO_PROGRESS_RATE:
            meets, least = "comes near to", f"{value:.3g}"
            there = "the joints would have to move fast for little progress"
        line = "straight line" if lines.is_straight else "path through the waypoints"
        return int(slow[0]) - 1, (
            f"The {line} {meets} a dynamic singularity "
            f"{lines.position_text(path.path_fractions[nearest])}: {name}, "
            f"{first:.6g} at the start, is {least} at the shape ({shape}), where {there}. optimal "
            "may reach the goal without following the line; so may a line from another shape."
        )

    def _held_commands(
        self, lines: _LinkPaths, state: RobotState, timed: _TimedPath
    ) -> tuple[Array, Array]:
        """Return shapes (N + 1, n) with links on their lines at ticks, and shares (N + 1,)."""
        period, duration = self.control_period, float(timed.time[-1])
        if duration > _MAX_TICKS * period:
            raise PlanningError(
                f"The motion along the line takes {duration:.4g} s, more than {_MAX_TICKS} ticks "
                f"of {period:g} s: use a nearer goal, higher joint limits or a lower tick_rate."
            )
        ticks = max(1, math.ceil(duration / period - 1e-9))
        for _ in range(_MAX_CORRECTION_ITERATIONS):
            shapes, shares = timed.at_ticks(ticks)
            positions = self._shapes_on_lines(lines, state, shapes, shares)
            factor, overrun = self._limits.excess(HeldMotion(positions, period))
            if overrun > _LIMIT_ROUNDING:
                break
            if factor <= 1 + _LIMIT_ROUNDING:
                return positions, shares
            ticks = max(ticks + 1, math.ceil(ticks * factor))
        raise PlanningError(
            f"Held commands of {period:g} s along the line violate the joint limits: a higher "
            "tick_rate of the planner, or lower limits, may help."
        )

    def _shapes_on_lines(
        self, lines: _LinkPaths, state: RobotState, shapes: Array, shares: Array
    ) -> Array:
        """Return shapes (N + 1, n) at ticks, corrected for the motion in between."""
        positions = shapes.copy()
        X, positions[0] = np.array([0.0, 0.0, 0.0, 1.0]), state.q
        for k in range(1, len(shapes)):
            before = positions[k - 1]
            q = shapes[k] + (before - shapes[k - 1])
            turned = self._turned(X, before, q)
            for _ in range(_MAX_CORRECTION_ITERATIONS):
                step, miss = lines.least_correction(q, turned, float(shares[k]))
                if miss < _ZERO_DISTANCE / 100:
                    break
                q = q + step
                turned = self._turned(X, before, q)
            X, positions[k] = turned, q
        return positions

    def _turned(self, X: Array, before: Array, after: Array) -> Array:
        """Return the attitude (4,) after a tick between two shapes (n,), from another attitude."""
        return self._prediction.attitudes(np.vstack([before, after]), X, np.zeros(3))[-1]

    def _schedule(
        self,
        request: PlanRequest,
        positions: Array,
        notes: Notes,
        progress: PathProgress | None = None,
    ) -> GaitSchedule:
        goal, path = request.goal, self._prediction.path(request.state, positions)
        end = path.position[-1], path.quaternion[-1]
        notes = {**notes, **self._end_notes(goal, positions[-1], *end, self.controls)}
        return self.schedule_of(goal, positions, path, notes, progress=progress)
