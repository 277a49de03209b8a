"""Search for motions under thrust to goals: a guess, then the shortest time, the least propellant,
and clearance.

The search is short, because the base and the arm can be pushed in every direction: in most cases, a
straight guess leads to the solution. The problem is solved for the shortest time, then in a longer
time for the least propellant, then again with the interval defects until it is exact. For pairs
that come too close in the exact check, planes are added along a clear path, which bends away from
obstacles.
"""

from __future__ import annotations

import itertools
import logging
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import cache, cached_property, partial

import casadi as ca
import numpy as np

from spacerobot_ros.errors import PlanningError, Proof, UnreachableError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array, RobotDescription
from spacerobot_ros.model.grasp import RobotMotion
from spacerobot_ros.model.rotations import (
    attitude_error,
    matrices_from_quaternions,
    matrix_from_quaternion,
    quaternion_from_matrix,
    quaternion_multiply,
    quaternions_from_rotvecs,
)
from spacerobot_ros.model.thrusters import find_thrusters
from spacerobot_ros.model.urdf import with_world
from spacerobot_ros.model.wheels import ReactionWheels
from spacerobot_ros.planning.core.cancellation import NEVER, Cancellation
from spacerobot_ros.planning.core.clearance import Clearance
from spacerobot_ros.planning.core.progress import SearchPhase, SearchProgress, log_progress
from spacerobot_ros.planning.methods.optimal.initial_guesses import rates_between
from spacerobot_ros.planning.methods.optimal.motion_bounds import reach_of_end_effector
from spacerobot_ros.planning.methods.optimal.multiple_shooting import DurationBounds, StopRule
from spacerobot_ros.planning.methods.optimal.problem import MotionLimits
from spacerobot_ros.planning.methods.thrust.bodies import Bodies
from spacerobot_ros.planning.methods.thrust.problem import (
    DEFECT_SIZE,
    Grapple,
    MotionFunctions,
    Propulsion,
    ThrustGoal,
    ThrustKnots,
    ThrustMotion,
    ThrustOptions,
    base_for_hand,
    base_poses,
    shape_for_hand,
    state_parts,
    with_joints_moved,
)
from spacerobot_ros.planning.methods.thrust.transcription import (
    EndKind,
    KeptPlaces,
    ThrustBoundary,
    ThrustSolver,
    Weights,
    thrust_stages,
)

_LOG = logging.getLogger(__name__)

_REGULARISATION, _SMOOTHNESS, _TIME_REGULARISATION = 1e-3, 1.0, 1e-5
"""Weights of the squared levels, which make solutions unique (1e-2 costs 1 % of propellant, 1e-4
saves 0.1 % and takes twice the steps); of the squares of joint accelerations, since arms swinging
as counterweights save 5 % of propellant, but swing into their own robot; and of both in the
shortest time."""

_ROUNDINGS = (0.1, 0.01, 0.003)
"""Levels at which norm costs are smoothed, in turn: the last one alone takes three times the
steps."""

_NEAREST = Weights(0.0, 0.0, 1e4, 1e4)
"""Weights of the nearest motion, so large that the barrier pushes no levels off their bounds."""

_EXACT_END, _NEAR_END, _LARGEST_END_ERROR, _MAX_CORRECTIONS = 1e-5, 1e-2, 1e-3, 10
"""Errors at the end, m and rad: to be achieved, below which the nearest exact motion is searched
for, and above which a motion is not a solution; and the largest number of corrections."""

_END_REACH, _GRASP_REACH = 0.3, 0.6
"""Largest distance of the final joint positions from the shape found by inverse kinematics, and of
the joints from their initial shape on the way to a grasp, m or rad: the base moves, and the arm
stays clear of it."""

_LARGEST_LACK, _SHALLOW = 1e-4, 0.1
"""Missing clearance between pairs up to which a solution counts as clear before the exact check,
and contact depth on a path to a target up to which planes along this path are tried first, m."""

_MAX_ROUNDS, _MOST_OPTIMA, _LARGEST_STRETCH = 6, 4, 4.0
"""Number of times that new planes are computed to clear a path or that a motion with excessive
efforts is slowed down; after how many motions of least cost that were not clear the nearest one to
a clear path is taken; and largest factor applied to a duration."""

_SHARES_LEFT = (0.0, 0.25, 0.5)
"""Fractions of the angular momentum that may be left after a grasp, in the order in which they are
tried."""

_MEETING_PERIOD, _LATER = 1.0, 0.3
"""Interval between the times at which guesses meet a target, s, and relative to the time of a guess
that led nowhere."""

_BOW_SHARES, _BOW_DIRECTIONS = (0.0, 0.25, 0.5, 0.75, 1.0, 1.5, 2.0), 12
"""Heights of bends away from a straight line, relative to the smallest height worth trying, and
number of directions."""


class ThrustPlanner:
    """Plans base and joint motions of one robot.

    Parameters
    ----------
    robot
        The model, including its world, if any.
    options
        The options.
    link
        End-effector link; empty: none.
    force, torque
        Largest force (N) and torque (N m) on the base, used if there is no thruster table.

    Raises
    ------
    ParameterError
        An option does not fit the robot, the thrusters cannot produce every wrench, or, without a
        table, the thrust has no limits.
    """

    def __init__(
        self,
        robot: SpaceRobot,
        options: ThrustOptions,
        link: str = "",
        force: float = math.inf,
        torque: float = math.inf,
    ) -> None:
        self.robot, self.options, self.link = robot, options, link
        if options.thrusters:
            table = find_thrusters(options.thrusters, robot.description)
            self.propulsion = Propulsion.of_table(table, options.reserve)
        else:
            self.propulsion = Propulsion.within(force, torque, options.reserve)
        self.limits = MotionLimits.of(robot, options, "plan")
        self.clearance = Clearance.wanted(robot.description, options.clearance, "plan.clearance")
        self._wheels = np.zeros(robot.n, dtype=bool)
        self._wheels[ReactionWheels.of(robot.description).index] = True
        self.effort_limit = (1.0 - options.reserve) * robot.effort_limit
        """(n,) efforts that a plan may use."""
        self.stages = cache(partial(thrust_stages, robot, len(self.propulsion.cost)))
        self._solvers: dict[tuple[EndKind, KeptPlaces], ThrustSolver] = {}

    def use_obstacles(self, world: RobotDescription | None) -> None:
        """Use other obstacles from the next plan on; None: no obstacles."""
        described = with_world(self.robot.description, world)
        self.clearance = Clearance.wanted(described, self.options.clearance, "plan.clearance")

    @cached_property
    def motion(self) -> Callable[[ThrustKnots], ThrustMotion]:
        """Returns the motion produced by a solution's controls."""
        return partial(ThrustMotion, MotionFunctions(self.robot, self.link), self.propulsion)

    def plan(
        self, start: RobotMotion, goal: ThrustGoal | Grapple, cancellation: Cancellation = NEVER
    ) -> ThrustMotion:
        """Return the least-propellant motion to a goal.

        Raises
        ------
        PlanningError
            No motion exists within the limits, none was found, or the search was cancelled.
        """
        self._solvers = {key: each for key, each in self._solvers.items() if not key[1]}
        grapple = goal if isinstance(goal, Grapple) else None
        bodies = Bodies(self.robot, self.clearance, start, self.link, grapple)
        stop = StopRule(self.options.iterations, cancellation)
        if isinstance(goal, Grapple):
            return self._plan_grapple(start, goal, bodies, stop)
        boundary, q = self._boundary(start, goal)
        bodies.require_end(q, goal.base)
        kind = EndKind("" if goal.end_effector is None else self.link)
        guess = self.guess(boundary, goal.base, q)
        return _Search(self, boundary, kind, stop, bodies).run(guess)

    def _plan_grapple(
        self, start: RobotMotion, grapple: Grapple, bodies: Bodies, stop: StopRule
    ) -> ThrustMotion:
        """Return the motion to a target: with no angular momentum left, or as little as there is
        a motion for.
        """
        boundary = self._start(start, np.zeros(0))
        force, limits = self.propulsion.largest_force(), self.limits
        arm = reach_of_end_effector(self.robot, limits.lower, limits.upper, self.link)
        grapple.require_in_time(boundary.start[7:13], self.robot.total_mass, force, arm)
        s, reach = state_parts(boundary.bounds)[4], np.where(self._wheels, np.inf, _GRASP_REACH)
        s[:] = np.clip(s, start.q - reach, start.q + reach)
        kind = EndKind(self.link, target=True)
        plain = _Search(self, boundary, kind, stop, bodies, grapple)
        motion = plain.run(plain.first_meeting())
        left, path = motion.joined_momentum(grapple.motion), plain.path
        shares = list(_SHARES_LEFT) if grapple.detumbles else []
        while shares:
            share = shares.pop(0)
            search = replace(plain, kind=kind._replace(momentum=True), left=share * left)
            try:
                motion, path = search.run_near(path), search.path
            except PlanningError:
                stop.cancellation.raise_if_requested()
            else:
                # A path with less momentum leads to motions with even less.
                shares = [each for each in _SHARES_LEFT if each < share]
        return motion

    def solver(self, kind: EndKind, bodies: Bodies) -> ThrustSolver:
        """Return the solver for a kind of goal, with the pairs that are kept apart."""
        key, N, acceleration = (kind, bodies.kept), self.options.intervals, self.limits.acceleration
        if key not in self._solvers:
            pairs = [(bodies.rows(pair), at) for pair, at in bodies.kept]
            self._solvers[key] = ThrustSolver(
                self.stages(kind), self.propulsion, N, acceleration, pairs
            )
        return self._solvers[key]

    # -- both ends ----------------------------------------------------------------------------

    def _start(self, start: RobotMotion, goals: Array) -> ThrustBoundary:
        """Return a motion from a start within the limits of the joints, with any end."""
        robot, N, X = self.robot, self.options.intervals, start.pose[3:]
        p_W, L_W, _ = robot.momentum(X, start.q, start.twist[:3], start.twist[3:], start.qdot)
        r_WC = start.pose[:3] + start.R_WB @ robot.center_of_mass(start.q)
        state = np.concatenate([X, L_W, r_WC, p_W / robot.total_mass, start.q, start.qdot])
        bounds = np.multiply.outer([-1.0, 1.0], np.full((N + 1, len(state)), np.inf))
        quaternions, *_, s, v = state_parts(bounds)
        quaternions[0], quaternions[1] = -1.1, 1.1
        s[0], s[1] = self.limits.lower, self.limits.upper
        v[0], v[1] = -self.limits.velocity, self.limits.velocity
        bounds[:, 0, :13], v[:, 0] = state[:13], start.qdot
        v[:, -1, self._wheels] = start.qdot[self._wheels]
        return ThrustBoundary(state, goals, bounds)

    def _boundary(self, start: RobotMotion, goal: ThrustGoal) -> tuple[ThrustBoundary, Array]:
        """Return both ends of a motion, and the shape (n,) at its end."""
        robot, hand, limits = self.robot, goal.end_effector, self.limits
        shape = np.full(robot.n, np.nan) if goal.shape is None else goal.shape
        given = np.isfinite(shape) & ~self._wheels
        q, reach = np.where(given, shape, start.q), np.where(given, 0.0, np.inf)
        if hand is not None:
            q = np.where(given, q, shape_for_hand(robot, self.link, goal.base, hand, q))
            # Close to this family of shapes: others may lie beyond a contact of the arm.
            reach[~given & ~self._wheels] = _END_REACH
        for i in np.flatnonzero((q < limits.lower) | (q > limits.upper))[:1]:
            raise UnreachableError(
                f"Joint '{robot.joint_names[i]}' would end at {q[i]:.4g}, beyond its limits "
                f"[{limits.lower[i]:.4g}, {limits.upper[i]:.4g}].",
                Proof.LIMITS,
            )
        boundary = self._start(start, np.append(goal.base, [] if hand is None else hand))
        _, L, _, V, s, v = state_parts(boundary.bounds)
        last = np.where(self._wheels, start.qdot, 0.0)
        L[:, -1] = matrix_from_quaternion(goal.base[3:]) @ robot.inertia_matrix(q)[3:6, 6:] @ last
        V[:, -1], v[:, -1], s[:, -1] = 0.0, last, np.clip(s[:, -1], q - reach, q + reach)
        if goal.keeps_shape:
            # Both ends are given by other rows.
            s[:, 1:-2, given] = start.q[given]
        return boundary, q

    def guess(
        self, boundary: ThrustBoundary, base: Array, end: Array, bow: Array | float = 0.0
    ) -> ThrustKnots:
        """Return a guess at full thrust along a quintic: the base moves along a straight line and a
        geodesic to a pose (7,), and the joints move straight to a shape (n,). Half-way, the base is
        displaced from the line by ``bow`` (3,), m.
        """
        robot, N = self.robot, self.options.intervals
        u = np.linspace(0.0, 1.0, N + 1)[:, np.newaxis]
        s = u**3 * (10 + u * (6 * u - 15))
        X0, _, r_WC, _, shape, _ = state_parts(boundary.start)
        r0 = r_WC - matrix_from_quaternion(X0) @ robot.center_of_mass(shape)
        q = shape + s * (end - shape)
        X = quaternion_multiply(X0, quaternions_from_rotvecs(s * attitude_error(X0, base[3:])))
        r_WB = r0 + s * (base[:3] - r0) + 16 * (u * (1 - u)) ** 2 * bow
        R = matrices_from_quaternions(X)
        c = robot.function("center_of_mass")(q.T).full().T
        r = r_WB + np.einsum("kij,kj->ki", R, c)
        # For a duration of one second; the actual duration follows.
        h = 1.0 / N
        V, v = np.gradient(r, h, axis=0), np.gradient(q, h, axis=0)
        omega = rates_between(X, h)
        H = np.array([robot.inertia_matrix(each)[3:6, 3:] for each in q])
        L_B = np.einsum("kij,kj->ki", H, np.hstack([omega, v]))
        L = np.einsum("kij,kj->ki", R, L_B)
        for each in (v, V, L):
            each[0] = each[-1] = 0.0
        f_B = np.einsum("kji,kj->ki", R[:-1], robot.total_mass * np.diff(V, axis=0) / h)
        n_B = np.einsum("kji,kj->ki", R[:-1], np.diff(L, axis=0) / h) + np.cross(c[:-1], f_B)
        wanted = np.hstack([f_B, n_B]) @ np.linalg.pinv(self.propulsion.wrenches).T
        change = np.diff(v, axis=0) / h
        time = max(self.limits.slowdown(v, change), math.sqrt(float(np.abs(wanted).max())), 1e-3)
        states = np.hstack([X, L, r, V, q, v])
        knots = ThrustKnots(h, states, change, wanted, np.zeros((N, DEFECT_SIZE))).stretched(time)
        return replace(knots, levels=np.clip(knots.levels, self.propulsion.lowest, 1.0))


@dataclass
class _Search:
    """One search of a planner; ``left`` is the final angular momentum of the robot and the target,
    N m s.
    """

    planner: ThrustPlanner
    boundary: ThrustBoundary
    kind: EndKind
    stop: StopRule
    bodies: Bodies
    grapple: Grapple | None = None
    left: Array = field(default_factory=lambda: np.zeros(3))
    path: ThrustKnots = field(init=False)
    """The knots of the last exact motion."""
    is_timed: bool = False
    """Whether the duration is given, or follows from the shortest one."""
    earliest: float = 0.0
    latest: float = 0.0
    """Time at which a target is met, s."""

    def _ways(self, base: Array, shape: Array, sides: Array, time: float) -> Iterator[ThrustKnots]:
        """Yield clear guesses to a base pose (7,) and a shape (n,) in a time, or longer without a
        target, the straightest first: each bows out to the side (3,) with the most room.
        """
        longest = math.inf if self.grapple is None else time + 1e-6
        bow = max(float(np.linalg.norm(base[:3] - self.boundary.start[7:10])) / 2, 0.5)
        for height in _BOW_SHARES:
            best, room = None, 0.0
            for side in sides if height else sides[:1]:
                guess = self.planner.guess(self.boundary, base, shape, height * bow * side)
                if guess.duration > longest:
                    continue
                guess = guess.stretched(max(time / guess.duration, 1.0))
                if (found := self.bodies.room(guess)) > room:
                    best, room = guess, found
            if best is not None:
                yield best
            if room == math.inf:
                return

    def _bows(self, path: ThrustKnots) -> Iterator[ThrustKnots]:
        """Yield guesses to the end of a path, then the path."""
        X, _, r, _, q, _ = state_parts(path.states[-1:])
        base = np.hstack(base_poses(self.planner.robot, X, r, q))[0]
        yield from self._ways(base, q[0], self._sides(base), path.duration)
        yield path

    def _sides(self, base: Array) -> Array:
        """Return directions (M, 3) across the way to a base pose (7,)."""
        frame = np.linalg.svd((base[:3] - self.boundary.start[7:10])[np.newaxis])[2]
        angles = 2 * math.pi * np.arange(_BOW_DIRECTIONS) / _BOW_DIRECTIONS
        return np.outer(np.cos(angles), frame[1]) + np.outer(np.sin(angles), frame[2])

    def _meeting(self, time: float) -> tuple[Array, Array, Array]:
        """Return the base pose (7,) to meet a target at a time in the shape (n,) of the start, this
        shape, and the side (1, 3) of the fixture.
        """
        planner, grapple, shape = self.planner, self.grapple, state_parts(self.boundary.start)[4]
        assert grapple is not None
        frame = grapple.motion.grapple([time])
        there = np.concatenate([frame.r[0], quaternion_from_matrix(frame.R[0])])
        side = frame.R @ grapple.standoff / max(float(np.linalg.norm(grapple.standoff)), 1e-9)
        return base_for_hand(planner.robot, planner.link, shape, there), shape, side

    def first_meeting(self) -> ThrustKnots:
        """Return the guess that meets a target at the earliest time possible for the robot."""
        # One exists: target distances grow with time, the distance at full thrust with its square.
        for time in itertools.count(_MEETING_PERIOD, _MEETING_PERIOD):
            base, shape, _ = self._meeting(time)
            guess = self.planner.guess(self.boundary, base, shape)
            if guess.duration <= time:
                break
        return guess.stretched(time / guess.duration)

    def _meetings(self, latest: float) -> Iterator[ThrustKnots]:
        """Yield clear guesses at a target, first on the side of its fixture, then past it: from a
        time on, each one much later than the one before, which was in vain, then earlier ones.
        """
        assert self.grapple is not None

        def guess_at(time: float, past: bool) -> ThrustKnots | None:
            base, shape, fixture = self._meeting(time)
            return next(self._ways(base, shape, self._sides(base) if past else fixture, time), None)

        for past in (False, True):
            time = latest
            while time < self.grapple.horizon:
                wait = _MEETING_PERIOD
                if (guess := guess_at(time, past)) is not None:
                    yield guess
                    wait = max(wait, _LATER * time)
                time += wait
            time = latest
            while (time := time / (1 + _LATER)) >= self.earliest:
                if (guess := guess_at(time, past)) is not None:
                    yield guess

    def run(self, guess: ThrustKnots) -> ThrustMotion:
        planner, options = self.planner, self.planner.options
        for name, limit in zip(planner.robot.joint_names, planner.effort_limit, strict=True):
            if limit == 0:
                why = f"joint '{name}' is limited to an effort of 0, which cannot move it"
                raise self._failure(why)
        self._begin(SearchPhase.SEARCHING)
        is_timed = options.duration > 0 or options.time_factor > 1
        fastest = self._solve(guess, self._weights(guess), begins="rough" * is_timed)
        if fastest is None:
            raise self._failure("no motion to the goal was found")
        horizon = math.inf if self.grapple is None else self.grapple.horizon
        limits = {"plan.duration": options.duration or math.inf, "target.horizon": horizon}
        for name, limit in limits.items():
            if fastest.duration > limit:
                raise UnreachableError(
                    f"The motion takes at least {fastest.duration:.4g} s, but {name} is {limit:g} "
                    "s: increase it.",
                    Proof.LIMITS,
                )
        self.is_timed, self.earliest = is_timed, fastest.duration
        time = min(options.duration or options.time_factor * fastest.duration, horizon)
        for _ in range(_MAX_ROUNDS):
            motion = self._motion(fastest, time)
            share = motion.effort_share(planner.effort_limit)
            if share <= 1.0:
                return motion
            # Efforts of a motion from rest scale approximately with its squared speed.
            self.earliest = motion.duration * min(1.01 * math.sqrt(share), _LARGEST_STRETCH)
            time = self.earliest if self.grapple is None else max(self.earliest, time)
            self.is_timed = True
        raise self._failure(f"its joints need {share:.3g} times the efforts that a plan may use")

    def run_near(self, path: ThrustKnots) -> ThrustMotion:
        """Return a motion near a path, with the same duration."""
        self.is_timed, path = True, replace(path, multipliers=None)
        self.earliest = self.latest = path.duration
        path = self._solve(path, _NEAREST, center=path) or path
        motion = self._settled(self._cleared(path) or path)
        if motion.effort_share(self.planner.effort_limit) > 1.0:
            raise self._failure("its joints need more than the efforts that a plan may use")
        return motion

    def _motion(self, fastest: ThrustKnots, time: float) -> ThrustMotion:
        """Return the exact and clear motion near the fastest one, in a time if one is given; for a
        target, by that time.
        """
        bodies, failure, self.latest = self.bodies, None, time
        self._begin(SearchPhase.REFINING)
        bodies.keep_none()
        first = time if self.grapple is None else self.earliest
        path = fastest.stretched(first / fastest.duration)
        if self.is_timed:
            # A rough solution, to find obstacles in the way.
            path = self._solve(path, self._weights(path, _ROUNDINGS[0]), begins="rough") or path
        near = bodies.approaches(self.planner.motion(path))
        guesses = self._bows(path) if self.grapple is None else self._meetings(path.duration)
        if not near or (self.grapple is not None and near[0].distance > -_SHALLOW):
            guesses = itertools.chain([path], guesses)
        for guess in guesses:
            bodies.keep_none()
            bodies.keep(near, guess)
            cleared = self._cleared(guess) if near else guess
            try:
                if cleared is not None:
                    return self._settled(cleared)
            except PlanningError as error:
                self.stop.cancellation.raise_if_requested()
                failure = error
        raise failure or self._failure(bodies.reason(near[0]))

    def _settled(self, path: ThrustKnots) -> ThrustMotion:
        """Return the exact motion near a clear path, which is clear, too."""
        self._begin(SearchPhase.REFINING)
        for number in range(_MAX_ROUNDS):
            motion = self._exact(path, nearest=self.is_timed and number >= _MOST_OPTIMA)
            near = self.bodies.approaches(motion)
            if not near:
                return motion
            self.bodies.keep(near, path)
        raise self._failure(self.bodies.reason(near[0]))

    def _solve(
        self,
        guess: ThrustKnots,
        weights: Weights,
        planes: Array | None = None,
        center: ThrustKnots | None = None,
        begins: str = "",
    ) -> ThrustKnots | None:
        """Return the best motion near a guess: in its time, in any time if none is given yet, and
        to a target by the latest time if nothing is in the way. Planes are those along the guess,
        unless others are given.
        """
        self.stop.cancellation.raise_if_requested()
        duration = DurationBounds(guess.duration, guess.duration)
        if not self.is_timed:
            duration = DurationBounds(1e-3, 1e5)
        elif self.grapple is not None and center is None and not self.bodies.kept:
            duration = DurationBounds(self.earliest, self.latest)
        boundary = self.boundary._replace(goals=self._goals(guess.duration))
        planes = self.bodies.planes(guess) if planes is None else planes
        solver = self.planner.solver(self.kind, self.bodies)
        return solver.solve(boundary, guess, weights, self.stop, duration, planes, center, begins)

    def _weights(self, guess: ThrustKnots, rounding: float = 1.0) -> Weights:
        """Return the weights of least propellant, or of least time, in units of the guess."""
        if not self.is_timed:
            return Weights(1 / guess.duration, 0.0, _TIME_REGULARISATION, _TIME_REGULARISATION)
        spent = guess.step * float(self.planner.propulsion.cost_of(ca.DM(guess.levels.T)))
        return Weights(0.0, 1 / max(spent, 1e-12), _SMOOTHNESS, _REGULARISATION, rounding)

    def _exact(self, guess: ThrustKnots, *, nearest: bool) -> ThrustMotion:
        """Return the exactly integrated motion of least propellant or time near a path, or the
        nearest one.
        """
        planner, knots, planes = self.planner, guess, self.bodies.planes(guess)
        is_rounded = not planner.propulsion.is_table and self.is_timed and not len(planes)
        roundings = _ROUNDINGS[1:] if is_rounded else _ROUNDINGS[1:2]
        *others, weights = (self._weights(guess, each) for each in roundings)
        for each in others:
            knots = self._solve(knots, each, planes) or knots
        center, best, error = None, None, math.inf
        if nearest:
            weights, center = _NEAREST, guess
        for number in range(_MAX_CORRECTIONS):
            begins = "corrected" * (number > 0)
            solved = self._solve(knots, weights, planes, center, begins)
            if solved is None:
                break
            motion = planner.motion(solved)
            found = self._end_error(motion)
            if found < error:
                best, error, self.path = motion, found, solved
            if error < _EXACT_END:
                break
            knots = replace(solved, defects=motion.defects())
            if self.is_timed and found < _NEAR_END:
                # The nearest controls with an exact flight: least-propellant optima are flat.
                weights, center = _NEAREST, knots
        if best is None:
            raise self._failure("no motion to the goal was found")
        if error > _LARGEST_END_ERROR:
            raise self._failure(
                f"its plan ends {error:.3g} m or rad from the goal; set plan.intervals to more "
                f"than {planner.options.intervals}"
            )
        return best

    def _goals(self, duration: float) -> Array:
        """Return the end parameters; for a target, those of a motion of about this duration."""
        if self.grapple is None:
            return self.boundary.goals
        numbers = self.grapple.motion.numbers(duration)
        return np.concatenate([[self.planner.options.intervals], numbers, self.left])

    def _end_error(self, motion: ThrustMotion) -> float:
        """Return the largest error at the end, m, rad, m/s, except that of angular momenta."""
        last = np.append(motion.step, with_joints_moved(motion.final_state, motion.step / 2))
        rows = self.planner.stages(self.kind)[2].values(last, self._goals(motion.duration))
        of_poses = 9 if self.kind.target else rows.numel()
        return float(np.abs(rows.full()[:of_poses]).max(initial=0.0))

    def _cleared(self, at: ThrustKnots) -> ThrustKnots | None:
        """Return a path near one that keeps pairs apart, and all others that come too close."""
        bodies, lack = self.bodies, math.inf
        self._begin(SearchPhase.CLEARING)
        for _ in range(_MAX_ROUNDS):
            solved = self._solve(at, self._weights(at, _ROUNDINGS[0]))
            if solved is None:
                return None
            if solved.lack > _LARGEST_LACK:
                if solved.lack > lack / 2:
                    return None
                at, lack = solved, solved.lack
                continue
            motion = self.planner.motion(solved)
            near, solved = bodies.approaches(motion), replace(solved, defects=motion.defects())
            if not near:
                return solved
            known = {pair for pair, _ in bodies.kept}
            fell_in = [e.pair for e in near if e.distance < 0 and e.pair not in known]
            bodies.keep(near, solved)
            if not fell_in or min(bodies.distances(pair, at).min() for pair in fell_in) <= 0:
                # Else their planes are computed along the previous path, which is clear of them.
                at = solved
        return None

    def _begin(self, phase: SearchPhase) -> None:
        progress = SearchProgress(0, 0, self.earliest or math.inf, phase)
        log_progress(_LOG, progress, f"{phase.value} a motion")

    def _failure(self, why: str) -> PlanningError:
        name = self.planner.robot.description.name
        return PlanningError(f"The goal of robot '{name}' is not reached: {why}.")
