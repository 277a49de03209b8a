"""End-effectors along given lines while the base floats: resolved-rate motion.

At zero momentum the generalised Jacobian ``J*(q)`` maps the rates of the joints to the velocity of
an end-effector in the world (Umetani and Yoshida). The rates that take it along a line, straight
or through waypoints, the attitude about one axis, are ``qdot = J*^+ xdot``. Where ``J*`` loses
rank no rates do: a dynamic singularity. Whether the line meets one depends on the shape alone,
which depends on the path that led there (paper 4, section V; path-dependent workspaces).

The path is followed in its own length, not in time: its tangent is a vector of the null space of
``[J*, -x']``, which is finite up to the singularity, where the progress on the line becomes zero.
The motion along the path is the fastest within the limits of velocity and acceleration (a linear
program in the squares of the speed). Held commands move the shape on straight lines between ticks,
so the shape at each tick is corrected until the end-effectors are on their lines.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import ClassVar

import numpy as np

from spacerobot_ros.errors import ParameterError, PlanningError
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
from spacerobot_ros.parameters import parameter
from spacerobot_ros.planning.core.cancellation import NEVER, Cancellation
from spacerobot_ros.planning.core.controllability import sample_shapes
from spacerobot_ros.planning.core.goal import (
    Controlled,
    EndEffectorGoal,
    Goal,
    PoseError,
    RobotState,
    Tolerance,
    end_effector_pose,
)
from spacerobot_ros.planning.core.method import GaitMethod, PlanRequest
from spacerobot_ros.planning.core.schedule import GaitSchedule, Notes
from spacerobot_ros.planning.methods.optimal.end_effectors import (
    EndEffectorRows,
    reach_of_end_effector,
)
from spacerobot_ros.planning.methods.optimal.goal_specification import Turning
from spacerobot_ros.planning.methods.optimal.problem import MotionLimits, MotionOptions

_STEP = 0.02
"""Longest step along a path of the joints, rad of the fastest one."""

_FEWEST_STEPS = 20
"""Steps along a path at least."""

LEAST_PROGRESS = 0.01
"""Progress on the line below which a singularity is near: the line in reaches of the end-effector,
for a motion of the joints by one radian of the fastest one."""

_ZERO_PROGRESS = 1e-8
"""Progress below which the path has come to the singularity itself."""

_APPROACH = 0.25
"""Share of the way to a singularity that is a step at most."""

_ZERO_DISTANCE = 1e-10
"""Error of an end-effector that counts as zero, m or rad."""

_SAMPLED_SHAPES = 8
"""Shapes in general position at which the freedom of the joints is examined."""

_LENGTH_SAMPLES = 200
"""Places of a curved way from which its scaled length is estimated."""

_INTERVALS = 160
"""Intervals of the linear program."""

_USED_ACCELERATION = 0.99
"""Share of the limits of acceleration for the path; corrections of the ticks may use the rest."""

_ITERATIONS = 8
"""Newton steps at a tick, and attempts to keep the limits with more ticks."""

_LIMIT_ROUNDING = 1e-9
"""Largest excess over a limit: relative, or in joint coordinates."""


@dataclass(frozen=True)
class ResolvedRateOptions(MotionOptions):
    """The options of ``resolved_rate``."""

    keep_attitude: int = parameter(
        0,
        "1: the attitude of the base stays as it is (reaction null space), 0: the base turns as it "
        "must",
        minimum=0,
        maximum=1,
    )
    waypoints: tuple[float, ...] = parameter(
        (),
        "positions x, y, z in the world, one after the other, through which a smooth path leads "
        "the end-effector to its goal; []: the straight line",
        unit="m",
        minimum=-1e9,
        maximum=1e9,
    )
    as_far_as_possible: int = parameter(
        0,
        "1: a line that meets a singularity or a joint limit is followed until shortly before, "
        "0: it is refused",
        minimum=0,
        maximum=1,
    )


class _Way:
    """A smooth way through points (K, 3), m, from the origin: a natural cubic spline by the lengths
    of its chords, which through two points is the straight line.

    Attributes
    ----------
    length
        Of the chords together, m.
    """

    def __init__(self, points: Array) -> None:
        from scipy.interpolate import CubicSpline

        # A point that comes twice is no way.
        chords = np.linalg.norm(np.diff(points, axis=0), axis=1)
        kept = np.flatnonzero(np.append(np.inf, chords) > _ZERO_DISTANCE)
        along = np.append(0.0, np.cumsum(chords))[kept]
        self.is_straight = len(kept) <= 2
        self.length = float(along[-1])
        if len(kept) == 1:
            along, kept = np.array([0.0, 1.0]), np.array([0, 0])
        self._place = CubicSpline(along / along[-1], points[kept], bc_type="natural")
        self._rate = self._place.derivative()

    def place(self, share: float) -> Array:
        """Return the displacement (3,) after a share of the way."""
        return np.asarray(self._place(share))

    def rate(self, share: float) -> Array:
        """Return the derivative (3,) of the displacement by the share."""
        return np.asarray(self._rate(share))


@dataclass(frozen=True)
class _LinkLine:
    """The line of a link E, in the base B_0 at the start, seen from the centre of mass.

    Attributes
    ----------
    link
        Name of the link.
    displacements, rotations
        (k, 3) and (l, 3) directions in which the joints move and turn it, and in which it follows.
    r_CE, quaternion
        (3,) and (4,) of its pose at the start.
    way
        The way from the start to the goal.
    turn
        (3,) the rotation vector from the start to the goal, rad.
    """

    link: str
    displacements: Array
    rotations: Array
    r_CE: Array
    quaternion: Array
    way: _Way
    turn: Array

    def miss(self, R: Array, r: Array, progress: float) -> Array:
        """Return the errors (k + l,) of a pose to that after a share ``progress`` of the line."""
        turned = quaternion_from_rotvec(progress * self.turn)
        target = quaternion_multiply(turned, self.quaternion)
        found = quaternion_inverse(quaternion_from_matrix(R))
        rotation = rotvec_from_quaternion(quaternion_multiply(target, found))
        return np.concatenate(
            [
                self.displacements @ (self.r_CE + self.way.place(progress) - r),
                self.rotations @ rotation,
            ]
        )


class _Lines:
    """The lines of all links of a goal, and how the joints move the links along them.

    Rows are scaled by the reach of the links, joints by their velocity limits: all are radians of
    the fastest joint.

    Attributes
    ----------
    weights
        (n,) motion of each joint while the fastest one moves by a radian, m or rad.
    length
        Length of the lines together, scaled.
    """

    def __init__(self, robot: SpaceRobot, lines: Sequence[_LinkLine], limits: MotionLimits) -> None:
        self._robot, self._lines = robot, tuple(lines)
        fastest = float(limits.velocity.max())
        ones = np.ones(robot.n)
        self.weights = limits.velocity / fastest if math.isfinite(fastest) else ones
        scales = []
        for line in lines:
            reach = 1.0
            if len(line.displacements):
                reach = reach_of_end_effector(robot, limits.lower, limits.upper, line.link)
            scales += [1 / reach] * len(line.displacements) + [1.0] * len(line.rotations)
        self._scales = np.array(scales)
        self.is_straight = all(line.way.is_straight for line in lines)
        shares = np.linspace(0.0, 1.0, 2 if self.is_straight else _LENGTH_SAMPLES)
        self.length = float(np.mean([np.linalg.norm(self._rate(share)) for share in shares]))

    def _rate(self, share: float) -> Array:
        """Return the scaled derivative (m,) of the rows by the share of the lines."""
        rates = [
            np.append(x.displacements @ x.way.rate(share), x.rotations @ x.turn)
            for x in self._lines
        ]
        return np.asarray(np.concatenate(rates) * self._scales)

    def jacobian(self, q: Array, X: Array) -> Array:
        """Return the rows (m, n) of J* in B_0, for a shape and a turn (4,) of the base."""
        R_X = matrix_from_quaternion(X)
        rows = []
        for line in self._lines:
            J = self._robot.generalised_jacobian(line.link, q)
            rows += [line.displacements @ R_X @ J[:3], line.rotations @ R_X @ J[3:]]
        return np.vstack(rows)

    def scaled_jacobian(self, q: Array, X: Array) -> Array:
        """Return :meth:`jacobian` in radians of the fastest joint."""
        return np.asarray(self._scales[:, np.newaxis] * self.jacobian(q, X) * self.weights)

    def correction(self, q: Array, X: Array, progress: float) -> tuple[Array, float]:
        """Return the least motion (n,) of the joints to the lines, and the scaled error."""
        R_X, missing = matrix_from_quaternion(X), []
        r_BC = self._robot.center_of_mass(q)
        for line in self._lines:
            R, r = self._robot.link_pose(line.link, q)
            missing.append(line.miss(R_X @ R, R_X @ (r - r_BC), progress))
        miss = np.concatenate(missing) * self._scales
        least = np.linalg.lstsq(self.scaled_jacobian(q, X), miss, rcond=None)[0]
        return self.weights * least, float(np.linalg.norm(miss))

    def tangent(self, q: Array, X: Array, share: float) -> tuple[Array, Array, float]:
        """Return the path's tangent: (n,) of the shape, (4,) of the turn, and the progress.

        It is of unit length with the joints scaled, the shortest way of the joints, and makes a
        progress that is never negative.
        """
        M = np.column_stack([self.scaled_jacobian(q, X), -self._rate(share) / self.length])
        # Of the null space, the unit vector of most progress: the projection of the last axis.
        basis = np.linalg.qr(M.T, mode="complete")[0][:, len(M) :]
        progress = float(np.linalg.norm(basis[-1]))
        if progress < _ZERO_PROGRESS / 100:  # The joints cannot move without leaving the line.
            return np.zeros(len(q)), np.zeros(4), 0.0
        u = self.weights * (basis @ basis[-1])[:-1] / progress
        omega = -self._robot.connection(q)[3:] @ u
        X_rate = quaternion_multiply(X, np.append(omega, 0.0)) / 2
        return u, X_rate, progress

    def measure(self, q: Array, X: Array) -> tuple[str, float]:
        """Return the number that becomes zero at a singularity, with its name."""
        J = self.jacobian(q, X)
        if J.shape[0] == J.shape[1]:
            return "|det J*|", abs(float(np.linalg.det(J)))
        value = np.linalg.svd(self.scaled_jacobian(q, X), compute_uv=False)[-1]
        return "the smallest singular value of J* (scaled)", float(value)

    def place(self, share: float) -> str:
        """Return a share of the lines in words."""
        line = self._lines[0]
        way, kind = line.way.length, "line" if line.way.is_straight else "path"
        if way > _ZERO_DISTANCE:
            return f"after {share * way:.6g} of {way:.6g} m of the {kind} of '{line.link}'"
        turn = float(np.linalg.norm(line.turn))
        return f"after {share * turn:.6g} of {turn:.6g} rad of the turn of '{line.link}'"


@dataclass(frozen=True)
class JointPath:
    """A path of the shape that takes end-effectors along their lines.

    Attributes
    ----------
    length
        (K,) length of the path of the joints so far, rad of the fastest joint.
    shapes
        (K, n) shapes, m or rad.
    turns
        (K, 4) attitudes of the base in that at the start.
    shares
        (K,) shares of the lines, 0 to 1.
    progress
        (K,) progress on the lines a length of the path of the joints; zero at a singularity.
    """

    length: Array
    shapes: Array
    turns: Array
    shares: Array
    progress: Array

    @property
    def is_complete(self) -> bool:
        """Whether it gets to the ends of the lines."""
        return bool(self.shares[-1] == 1.0)

    def until(self, last: int) -> JointPath:
        """Return the path up to and with one of its places."""
        parts = {each.name: getattr(self, each.name)[: last + 1] for each in fields(self)}
        return JointPath(**parts)


def _trace(lines: _Lines, q: Array, cancellation: Cancellation) -> JointPath:
    """Follow lines from a shape (n,) to their ends, or to a singularity (Runge-Kutta 4)."""
    n, total = len(q), lines.length
    y = np.concatenate([q, [0.0, 0.0, 0.0, 1.0, 0.0]])

    def rate(y: Array) -> Array:
        X = y[n : n + 4] / np.linalg.norm(y[n : n + 4])
        u, X_rate, progress = lines.tangent(y[:n], X, min(float(y[-1]) / total, 1.0))
        return np.concatenate([u, X_rate, [progress]])

    k = rate(y)
    lengths, states, progress = [0.0], [y], [float(k[-1])]
    longest = min(_STEP, total / _FEWEST_STEPS / max(progress[0], _ZERO_PROGRESS))
    step = longest
    while progress[-1] > _ZERO_PROGRESS:
        cancellation.raise_if_requested()
        left = total - y[-1]
        step = min(longest, left / progress[-1])
        if len(progress) > 1 and (falls := progress[-2] - progress[-1]) > 0:
            slope = falls / (lengths[-1] - lengths[-2])
            step = min(step, _APPROACH * progress[-1] / slope)
        k2 = rate(y + step / 2 * k)
        k3 = rate(y + step / 2 * k2)
        k4 = rate(y + step * k3)
        there = y + step / 6 * (k + 2 * k2 + 2 * k3 + k4)
        there[n : n + 4] /= np.linalg.norm(there[n : n + 4])
        at_end = rate(there)
        # A singularity is a turning point of the path, which no step may go beyond: there the
        # tangent is the other way round, as progress is never negative.
        if min(float(x[:n] @ (k[:n] / lines.weights**2)) for x in (k2, k3, k4, at_end)) < 0:
            longest = step / 4
            if longest < _ZERO_PROGRESS**2:
                progress[-1] = 0.0
            continue
        y, k = there, at_end
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

    At K + 1 places that are ``interval`` apart, with the derivatives (K + 1, n) of the shape by the
    length. With ``x`` the square of the speed, ``x' / 2`` is the acceleration along the path, and
    ``q'' x + q' x' / 2`` that of the joints: limits are linear in ``x`` (Verscheure et al.), and
    the largest sum is the largest speed everywhere.
    """
    from scipy.optimize import linprog
    from scipy.sparse import coo_matrix, vstack

    K, n = len(slopes) - 1, slopes.shape[1]
    with np.errstate(divide="ignore"):
        fastest = (limits.velocity / np.abs(slopes)).min(axis=1) ** 2
        # The unit of the squares: the linear program has numbers near one.
        by_acceleration = (limits.acceleration / (np.abs(slopes) / interval + np.abs(bends))).min()
    unit = float(by_acceleration) * K
    fastest = np.minimum(fastest / unit, 1e6)
    fastest[[0, -1]] = 0.0
    rows, columns, values = [], [], []
    bound = np.tile(_USED_ACCELERATION * limits.acceleration / unit, 2 * K)
    intervals, joints = np.arange(K)[:, np.newaxis], np.arange(n)
    for end in (0, 1):  # Both ends of each interval, in which x' is constant.
        at = slopes[end : K + end] / (2 * interval), bends[end : K + end]
        row = (end * K + intervals) * n + joints
        before, after = -at[0] + (1 - end) * at[1], at[0] + end * at[1]
        rows += [row, row]
        columns += [np.broadcast_to(intervals + k, row.shape) for k in (0, 1)]
        values += [before, after]
    A = coo_matrix(
        (np.ravel(values), (np.ravel(rows), np.ravel(columns))), shape=(2 * K * n, K + 1)
    )

    found = linprog(
        -np.ones(K + 1),
        A_ub=vstack([A, -A]).tocsr(),
        b_ub=np.concatenate([bound, bound]),
        bounds=np.column_stack([np.zeros(K + 1), fastest]),
        method="highs",
    )
    if found.x is None:
        raise PlanningError("No motion along the line keeps the limits of the joints was found.")
    return np.maximum(np.asarray(found.x, dtype=float), 0.0) * unit


@dataclass(frozen=True)
class _TimedPath:
    """A path in time, as fast as velocities and accelerations allow.

    ``time`` (K + 1,) at lengths that are ``interval`` apart, ``speed`` (K + 1,) there.
    """

    path: JointPath
    time: Array
    speed: Array
    interval: float

    @classmethod
    def of(cls, path: JointPath, limits: MotionLimits) -> _TimedPath:
        """Return a path at its fastest."""
        from scipy.interpolate import CubicSpline

        shape = CubicSpline(path.length, path.shapes)
        places, interval = np.linspace(0.0, path.length[-1], _INTERVALS + 1, retstep=True)
        slopes, bends = shape(places, 1), shape(places, 2)
        speed = np.sqrt(_fastest_speeds(slopes, bends, limits, float(interval)))
        time = np.cumsum(np.append(0.0, 2 * interval / (speed[1:] + speed[:-1])))
        return cls(path, time, speed, float(interval))

    def at_ticks(self, ticks: int) -> tuple[Array, Array]:
        """Return the shapes (ticks + 1, n) and shares of the lines at equal intervals of time."""
        from scipy.interpolate import CubicSpline

        t = np.linspace(0.0, self.time[-1], ticks + 1)
        k = np.clip(np.searchsorted(self.time, t, side="right") - 1, 0, len(self.time) - 2)
        since, duration = t - self.time[k], self.time[k + 1] - self.time[k]
        change = (self.speed[k + 1] - self.speed[k]) / duration
        length = k * self.interval + self.speed[k] * since + change * since**2 / 2
        path = self.path
        of_length = CubicSpline(path.length, np.column_stack([path.shapes, path.shares]))
        found = of_length(np.minimum(length, path.length[-1]))
        shares = np.clip(found[:, -1], 0.0, 1.0)
        shares[-1] = path.shares[-1]
        return found[:, :-1], shares


class ResolvedRateGait(GaitMethod):
    """End-effectors on straight lines, or through waypoints, to their goals, with the base free.

    From rest to rest, as fast as the limits of the joints allow. Positions, or poses with a turn
    about one axis, of one end-effector or of several at once. Lines that meet a dynamic
    singularity or a limit of a joint are refused, or followed until shortly before; ``optimal``
    reaches most of their ends.
    """

    name: ClassVar[str] = "resolved_rate"
    plans_for_base: ClassVar[bool] = False
    plans_for_end_effectors: ClassVar[bool] = True
    Options: ClassVar[type[ResolvedRateOptions]] = ResolvedRateOptions
    options: ResolvedRateOptions

    controls: frozenset[Controlled] = frozenset({"end_effectors"})

    def _setup(self) -> None:
        self._limits = MotionLimits.of(self.robot, self.options, self.name)
        if len(self.options.waypoints) % 3:
            raise ParameterError(
                f"{self.name}.waypoints has {len(self.options.waypoints)} number(s); a waypoint "
                "has three."
            )

    @classmethod
    def require_suitable(cls, robot: SpaceRobot) -> None:
        """Refuse robots without joints; see :meth:`GaitMethod.require_suitable`."""
        if robot.n == 0:
            name = robot.description.name
            raise PlanningError(f"Robot '{name}' has no joints that could move an end-effector.")

    def plan(self, request: PlanRequest, cancellation: Cancellation = NEVER) -> GaitSchedule:
        """Plan the motion along the lines; see :meth:`GaitMethod.plan`."""
        self._require_rest(request.state)
        self.require_suitable(self.robot)
        q = np.clip(request.state.q, self.robot.lower, self.robot.upper)
        state = replace(request.state, q=q)
        goal = request.goal.for_robot(self.robot.description)
        self._require_goal_of_end_effectors(goal)
        error = PoseError.between(state.position, state.quaternion, goal, q, self.robot)
        waypoints = self._waypoints(request, goal)
        at_goal = Tolerance(_ZERO_DISTANCE, _ZERO_DISTANCE).admits(error, self.controls)
        if at_goal and not len(waypoints):
            return self._schedule(state, goal, q[np.newaxis], {})
        lines = self._lines(state, goal, request.tolerance, waypoints)
        if lines.length < _ZERO_DISTANCE:
            return self._schedule(state, goal, q[np.newaxis], {})
        path = _trace(lines, q, cancellation)
        notes: Notes = {}
        obstacle = self._find_obstacle(lines, path)
        if obstacle is not None:
            last, reason = obstacle
            if not (self.options.as_far_as_possible and last > 0):
                raise PlanningError(reason)
            path, notes = path.until(last), {"stopped": reason}
        positions = self._held_commands(lines, state, _TimedPath.of(path, self._limits))
        name, first = lines.measure(q, path.turns[0])
        least = min(
            lines.measure(shape, X)[1] for shape, X in zip(path.shapes, path.turns, strict=True)
        )
        notes |= {"singularity_measure": name, "at_start": first, "least": least}
        return self._schedule(state, goal, positions, notes)

    def path(self, request: PlanRequest, cancellation: Cancellation = NEVER) -> JointPath:
        """Return the path along the lines of a goal, to their ends or to a singularity.

        It is the same whatever the limits of the joints are, which may end it before.

        Raises
        ------
        PlanningError
            The goal is of another kind, or asks for too much; see :meth:`plan`.
        """
        goal = request.goal.for_robot(self.robot.description)
        self._require_goal_of_end_effectors(goal)
        waypoints = self._waypoints(request, goal)
        lines = self._lines(request.state, goal, request.tolerance, waypoints)
        return _trace(lines, request.state.q, cancellation)

    def _waypoints(self, request: PlanRequest, goal: Goal) -> Array:
        """Return the waypoints (K, 3) of a request, in the world: none of a correction."""
        if request.correction or not self.options.waypoints:
            return np.zeros((0, 3))
        if len(goal.end_effectors) > 1:
            raise PlanningError(
                f"{self.name}.waypoints lead one end-effector, and the goal is for "
                f"{len(goal.end_effectors)}: give a goal of one, or leave them out."
            )
        return np.reshape(self.options.waypoints, (-1, 3))

    def _require_goal_of_end_effectors(self, goal: Goal) -> None:
        if not goal.end_effectors:
            raise PlanningError(
                f"{self.name} moves end-effectors along straight lines, and the goal is for the "
                "base: optimal plans for it."
            )
        if goal.base or goal.joint_positions is not None:
            part = "the pose of the base" if goal.base else "joint positions"
            raise PlanningError(
                f"{self.name} has its joints follow the line of the end-effector, and the goal "
                f"asks for {part}, too: optimal plans for both."
            )

    def _lines(
        self, state: RobotState, goal: Goal, tolerance: Tolerance, waypoints: Array
    ) -> _Lines:
        """Return the lines of a goal, along directions in which the joints move the links.

        Raises
        ------
        PlanningError
            The goal lies off these directions, or has more of them than the joints can follow.
        """
        robot = self.robot
        turning = Turning.of(robot)
        axes = turning.axes if turning.loops else np.zeros((0, 3))
        goals = list(goal.end_effectors)
        if self.options.keep_attitude:
            goals.append(EndEffectorGoal(robot.base_link, state.position, state.quaternion))
        rows = EndEffectorRows(robot, [(x.link, x.quaternion is not None) for x in goals], axes)
        tolerances = tolerance.position, tolerance.attitude
        rows.require_directions(state, goals, tolerances)
        for point in waypoints:
            rows.require_directions(
                state, [replace(goals[0], position=point), *goals[1:]], tolerances
            )
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
            points = each.position[np.newaxis]
            if each is goals[0]:
                points = np.vstack([waypoints, points])
            line = _LinkLine(
                each.link,
                directions.displacements,
                directions.rotations,
                r_BE - r_BC,
                quaternion,
                _Way(np.vstack([np.zeros(3), (points - state.position) @ R_BW.T - r_BE])),
                turn,
            )
            if each.link == robot.base_link:  # Its attitude alone is kept.
                line = replace(line, displacements=np.zeros((0, 3)), turn=np.zeros(3))
            lines.append(line)
        found = _Lines(robot, lines, self._limits)
        self._require_freedom(found, goal)
        return found

    def _require_freedom(self, lines: _Lines, goal: Goal) -> None:
        X = np.array([0.0, 0.0, 0.0, 1.0])
        matrices = [lines.jacobian(q, X) for q in sample_shapes(self.robot, _SAMPLED_SHAPES)]
        rank = max(int(np.linalg.matrix_rank(J, tol=1e-6)) for J in matrices)
        wanted = len(matrices[0])
        if rank < wanted:
            names = " and ".join(f"'{each.link}'" for each in goal.end_effectors)
            still = " with the attitude of the base kept" if self.options.keep_attitude else ""
            less = ", or leave out resolved_rate.keep_attitude" if still else ""
            raise PlanningError(
                f"The line of {names}{still} asks for {wanted} independent coordinates, and the "
                f"joints of robot '{self.robot.description.name}' move no more than {rank}: ask "
                f"for a position instead of a pose{less}."
            )

    def _find_obstacle(self, lines: _Lines, path: JointPath) -> tuple[int, str] | None:
        """Return the last place of a path before the limits of the joints are left, or before a
        singularity is near, with the reason; None where the way is free.
        """
        robot = self.robot
        beyond = np.maximum(robot.lower - path.shapes, path.shapes - robot.upper)
        outside = np.flatnonzero(beyond.max(axis=1) > _LIMIT_ROUNDING)
        slow = np.flatnonzero(path.progress < LEAST_PROGRESS)
        if len(outside) and (not len(slow) or outside[0] < slow[0]):
            k = int(outside[0])
            joint = robot.description.movable_joints[int(np.argmax(beyond[k]))]
            return k - 1, (
                f"Joint '{joint.name}' is at its limit {lines.place(path.shares[k])}: optimal may "
                "reach the goal off the line, as may a line from another shape."
            )
        if not len(slow):
            return None
        nearest = int(np.argmin(path.progress))
        name, value = lines.measure(path.shapes[nearest], path.turns[nearest])
        first = lines.measure(path.shapes[0], path.turns[0])[1]
        shape = ", ".join(f"{x:.6g}" for x in path.shapes[nearest])
        meets, least, there = "meets", "zero", "no rates of the joints lead on"
        if path.is_complete:
            meets, least = "comes near to", f"{value:.3g}"
            there = "the joints would have to move fast for little progress"
        line = "straight line" if lines.is_straight else "path through the waypoints"
        return int(slow[0]) - 1, (
            f"The {line} {meets} a dynamic singularity "
            f"{lines.place(path.shares[nearest])}: {name} falls from {first:.6g} to {least} at the "
            f"shape ({shape}), where {there}. optimal may reach the goal off the line, as may a "
            "line from another shape."
        )

    def _held_commands(self, lines: _Lines, state: RobotState, timed: _TimedPath) -> Array:
        """Return the shapes (N + 1, n) at ticks, with the end-effectors on their lines at each.

        Raises
        ------
        PlanningError
            No number of ticks keeps the limits of the joints.
        """
        period = self.control_period
        ticks = max(1, math.ceil(timed.time[-1] / period - 1e-9))
        for _ in range(_ITERATIONS):
            positions = self._shapes_on_lines(lines, state, *timed.at_ticks(ticks))
            factor, overrun = self._limits.excess(positions, period)
            if overrun > _LIMIT_ROUNDING:
                break
            if factor <= 1 + _LIMIT_ROUNDING:
                return positions
            ticks = max(ticks + 1, math.ceil(ticks * factor))
        raise PlanningError(
            f"Held commands of {period:g} s on the line do not keep the limits of the joints: a "
            "higher tick_rate of the planner may help, or lower limits."
        )

    def _shapes_on_lines(
        self, lines: _Lines, state: RobotState, shapes: Array, shares: Array
    ) -> Array:
        """Return shapes (N + 1, n) at ticks, corrected for the motion in between."""
        positions = shapes.copy()
        X, at_rest = np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(3)
        positions[0] = state.q
        for k in range(1, len(shapes)):
            q = shapes[k] + (positions[k - 1] - shapes[k - 1])
            for _ in range(_ITERATIONS):
                between = np.vstack([positions[k - 1], q])
                turned = self._prediction.attitudes(between, X, at_rest)[-1]
                step, miss = lines.correction(q, turned, float(shares[k]))
                if miss < _ZERO_DISTANCE / 100:
                    break
                q = q + step
            between = np.vstack([positions[k - 1], q])
            X = self._prediction.attitudes(between, X, at_rest)[-1]
            positions[k] = q
        return positions

    def _schedule(
        self, state: RobotState, goal: Goal, positions: Array, notes: Notes
    ) -> GaitSchedule:
        path = self._prediction.path(state, positions)
        end = path.position[-1], path.quaternion[-1]
        left = PoseError.between(*end, goal, positions[-1], self.robot)
        notes = {
            **notes,
            "final_shape": positions[-1].tolist(),
            "final_position": path.position[-1].tolist(),
            "predicted_end_effector_position_error": left.farthest_end_effector,
            "predicted_end_effector_attitude_error": left.most_turned_end_effector,
        }
        for each in goal.end_effectors:
            r_WE, quaternion = end_effector_pose(self.robot, each.link, *end, positions[-1])
            notes[f"final_pose_of_{each.link}"] = [*r_WE.tolist(), *quaternion.tolist()]
        return self._schedule_of(goal, positions, path, notes)
