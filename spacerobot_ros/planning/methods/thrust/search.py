"""Motions under thrust for goals: a guess, the shortest time, the least propellant, and clear.

The search is short, as base and arm are pushed in every direction: a straight guess leads to the
solution in most cases. It is solved for the shortest time, then in a longer time for the least
propellant, then again with the defects of its intervals until it flies exactly. Pairs that come too
near, by the exact check, get planes along a path that is clear of them, which bow away from
obstacles finds.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from spacerobot_ros.collision import Approach, BasePoses
from spacerobot_ros.collision.planes import support_distance
from spacerobot_ros.errors import PlanningError, Proof, UnreachableError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array, Pose, RobotDescription
from spacerobot_ros.model.inverse_kinematics import (
    REACHED_DISTANCE,
    FixedBaseArm,
    is_reached,
)
from spacerobot_ros.model.rotations import (
    attitude_error,
    compose_poses,
    matrices_from_quaternions,
    matrix_from_quaternion,
    quaternion_multiply,
    quaternions_from_rotvecs,
    relative_pose,
    rotvecs_from_quaternions,
)
from spacerobot_ros.model.wheels import ReactionWheels
from spacerobot_ros.model.world import with_world
from spacerobot_ros.parameters import parameter
from spacerobot_ros.planning.core.cancellation import NEVER, Cancellation
from spacerobot_ros.planning.core.clearance import DEFAULT_CLEARANCE, Clearance
from spacerobot_ros.planning.core.goal import end_effector_pose
from spacerobot_ros.planning.methods.optimal.multiple_shooting import DurationBounds, StopRule
from spacerobot_ros.planning.methods.optimal.problem import MotionLimits, MotionOptions
from spacerobot_ros.planning.methods.optimal.transcription import ConstraintBlock
from spacerobot_ros.planning.methods.thrust.motion import MotionFunctions, ThrustMotion
from spacerobot_ros.planning.methods.thrust.propulsion import Propulsion
from spacerobot_ros.planning.methods.thrust.solver import (
    KeptPairs,
    ThrustBoundary,
    ThrustKnots,
    ThrustSolver,
    Weights,
)
from spacerobot_ros.planning.methods.thrust.transcription import (
    EXACT_STEPS,
    ThrustStages,
    pair_block,
)

_REGULARISATION = 1e-3
"""Weight of the squares of levels, which makes solutions unique. 1e-2 costs 1 % of propellant, 1e-4
saves 0.1 % and takes twice the steps."""

_SMOOTHNESS = 1.0
"""Weight of the squares of joint accelerations: arms that swing as counterweights save 5 % of
propellant, and swing into their own robot."""

_TIME_REGULARISATION = 1e-5

_ROUNDINGS = (0.1, 0.01, 0.003)
"""Levels at which costs of norms are rounded off, one after the other: the last one alone takes
three times the steps."""

_EXACT_END, _MAX_CORRECTIONS = 1e-5, 10
"""Largest error at the end, m and rad, and the largest number of corrections that lead there."""

_NEAR_END = 1e-2
"""Error at the end from which on the nearest exact motion will do, m and rad."""

_LARGEST_END_ERROR = 1e-4
"""Error at the end beyond which a motion is no solution, m and rad."""

_END_REACH = 0.3
"""Distance of the joints at the end from the shape that inverse kinematics finds, m or rad."""

_INSTANTS = 2
"""Instants of an interval at which pairs are kept apart."""

_ROOM = 4e-3
"""Distance beyond the clearance at these instants: paths bend between them, m."""

_COST_OF_LACK = 1e3
"""Weight of a metre of distance that pairs lack."""

_LARGEST_LACK = 1e-4
"""Distance that pairs may lack in a solution that counts as clear before the exact check, m."""

_MAX_ROUNDS = 6
"""Times that a path is made clear of pairs by new planes."""

_LARGEST_STRETCH = 4.0
"""Largest factor of the time of a motion whose efforts are too large."""

_BOW_SHARES = (0.0, 0.25, 0.5, 0.75, 1.0, 1.5, 2.0)
_BOW_DIRECTIONS = 12
"""Heights of bows away from a straight line, as shares of the least that is worth a try, and
directions."""


@dataclass(frozen=True)
class ThrustOptions(MotionOptions):
    """The options of motions planned under thrust."""

    time_factor: float = parameter(
        1.5,
        "duration of a motion of least propellant, by the shortest possible; 1: in the shortest",
        minimum=1.0,
        maximum=1e3,
    )
    duration: float = parameter(
        0.0, "duration of a motion; 0: by time_factor", unit="s", minimum=0.0, maximum=1e5
    )
    reserve: float = parameter(
        0.2,
        "share of thrust and of joint efforts that is left to the feedback of the controller",
        minimum=0.0,
        maximum=0.9,
    )
    intervals: int = parameter(30, "steps of the problem", minimum=10, maximum=1000)
    iterations: int = parameter(
        300, "steps of the solver from one guess at most", minimum=1, maximum=100000
    )
    clearance: float = parameter(
        DEFAULT_CLEARANCE,
        "smallest distance of links and obstacles; 0: contacts are ignored",
        unit="m",
        minimum=0.0,
        maximum=1e3,
    )


@dataclass(frozen=True)
class ThrustStart:
    """Where a motion begins: pose (7,) of the base and its twist ``v_WB_B``, ``omega_WB_B`` (3,),
    positions and velocities (n,) of the joints.
    """

    pose: Array
    v_WB_B: Array
    omega_WB_B: Array
    q: Array
    qdot: Array

    @classmethod
    def at_rest(cls, pose: Array, q: Array) -> ThrustStart:
        """Return a start without velocities."""
        return cls(pose, np.zeros(3), np.zeros(3), q, np.zeros(len(q)))


@dataclass(frozen=True)
class ThrustGoal:
    """Where a motion ends, at rest.

    ``base`` and ``end_effector`` are poses (7,), position and quaternion in W, or None;
    ``shape`` are joint positions (n,), NaN for joints that are free, None for all free.
    """

    base: Array | None = None
    end_effector: Array | None = None
    shape: Array | None = None


class ThrustPlanner:
    """Plans motions of base and joints of one robot.

    Parameters
    ----------
    robot
        The model, with its world if it has one.
    propulsion
        What pushes its base, less the reserve.
    options
        The options.
    link
        Link of the end-effector; empty: none.

    Raises
    ------
    ParameterError
        An option does not fit the robot, or there is neither a base nor an end-effector to move.
    """

    def __init__(
        self,
        robot: SpaceRobot,
        propulsion: Propulsion,
        options: ThrustOptions = ThrustOptions(),
        link: str = "",
    ) -> None:
        self.robot, self.propulsion, self.options, self.link = robot, propulsion, options, link
        self.limits = MotionLimits.of(robot, options, "plan")
        self.clearance = Clearance.wanted(robot.description, options.clearance, "plan.clearance")
        wheels = ReactionWheels.of(robot.description)
        self._wheels = np.zeros(robot.n, dtype=bool)
        self._wheels[wheels.index] = True
        self._stages: dict[tuple[bool, str], ThrustStages] = {}
        self._solvers: dict[tuple[bool, str, _Kept], ThrustSolver] = {}
        self._rows: dict[tuple[int, int], ConstraintBlock] = {}

    def use_obstacles(self, world: RobotDescription | None) -> None:
        """Plan around other obstacles from now on; None: around none."""
        described = with_world(self.robot.description, world)
        self.clearance = Clearance.wanted(described, self.options.clearance, "plan.clearance")

    @cached_property
    def _functions(self) -> MotionFunctions:
        return MotionFunctions.of(self.robot, self.link)

    def plan(
        self, start: ThrustStart, goal: ThrustGoal, cancellation: Cancellation = NEVER
    ) -> ThrustMotion:
        """Return the motion of least propellant to a goal.

        Raises
        ------
        PlanningError
            There is none within the limits, or none is found; or it was cancelled.
        """
        boundary, end = self._boundary(start, goal)
        kinds = goal.base is not None, self.link if goal.end_effector is not None else ""
        self._solvers = {key: each for key, each in self._solvers.items() if not key[2]}
        stop = StopRule(self.options.iterations, cancellation)
        guess = self._guess(boundary, end, np.zeros(3))
        search = _Search(self, boundary, end, kinds, stop)
        return search.run(guess, end)

    def solver(self, kinds: tuple[bool, str], kept: _Kept = ()) -> ThrustSolver:
        """Return the solver of a kind of goals, with pairs that are kept apart at some instants."""
        key = (*kinds, kept)
        if key not in self._solvers:
            if kinds not in self._stages:
                self._stages[kinds] = ThrustStages.of(self.robot, self.propulsion, *kinds)
            numbers, places = tuple(n for n, _ in kept), tuple(at for _, at in kept)
            pairs = KeptPairs(numbers, tuple(map(self._pair_rows, numbers)), places, _INSTANTS)
            self._solvers[key] = ThrustSolver(self._stages[kinds], self.options.intervals, pairs)
        return self._solvers[key]

    def _pair_rows(self, pair: int) -> ConstraintBlock:
        assert self.clearance is not None
        geometry = self.clearance.geometry
        first, second = geometry.pairs[pair].tolist()
        # Those of a solid are the same for all obstacles.
        key = first, -1 if geometry.with_obstacles[pair] else second
        if key not in self._rows:
            center_of_mass = self.robot.function("center_of_mass", compile=False)
            distance = support_distance(geometry, pair, center_of_mass)
            self._rows[key] = pair_block(self.robot.n, distance)
        return self._rows[key]

    def motion(self, knots: ThrustKnots) -> ThrustMotion:
        """Return the motion that the controls of a solution fly."""
        return ThrustMotion(self._functions, self.propulsion, knots)

    # -- both ends ----------------------------------------------------------------------------

    def _boundary(self, start: ThrustStart, goal: ThrustGoal) -> tuple[ThrustBoundary, _End]:
        robot, n = self.robot, self.robot.n
        r_WB, X = start.pose[:3], start.pose[3:]
        p_W, L_W, _ = robot.momentum(X, start.q, start.v_WB_B, start.omega_WB_B, start.qdot)
        r_WC = r_WB + matrix_from_quaternion(X) @ robot.center_of_mass(start.q)
        state = np.concatenate([X, L_W, r_WC, p_W / robot.total_mass])
        shape = np.full(n, np.nan) if goal.shape is None else goal.shape.copy()
        shape[self._wheels] = np.nan
        base, q = goal.base, np.where(np.isfinite(shape), shape, start.q)
        if goal.end_effector is not None:
            hand = np.concatenate(end_effector_pose(robot, self.link, r_WB, X, start.q))
            if base is None:
                base = compose_poses(goal.end_effector, relative_pose(hand, start.pose))
        if base is None:
            base = start.pose
        given = np.isfinite(shape)
        shapes = np.where(given, shape, np.array([[-np.inf], [np.inf]]))
        if goal.end_effector is not None and goal.base is not None:
            q = np.where(given, q, self._shape_at(base, goal.end_effector, q))
            # Near to this family of shapes: others may lie beyond a contact of the arm.
            near = q + np.array([[-_END_REACH], [_END_REACH]])
            shapes = np.where(given | self._wheels, shapes, near)
        self._require_within(q)
        final_velocity = np.where(self._wheels, start.qdot, 0.0)
        spin = robot.inertia_matrix(q)[3:6, 6:] @ final_velocity
        goals = [each for each in (goal.base, goal.end_effector) if each is not None]
        return (
            ThrustBoundary(
                state,
                start.q,
                start.qdot,
                np.concatenate(goals) if goals else np.zeros(0),
                shapes,
                final_velocity,
                matrix_from_quaternion(base[3:]) @ spin,
            ),
            _End(base, q),
        )

    def _shape_at(self, base: Array, hand: Array, q: Array) -> Array:
        """Return the shape (n,) near to one in which the end-effector is at a pose."""
        poses = [Pose(matrix_from_quaternion(each[3:]), each[:3]) for each in (base, hand)]
        arm = FixedBaseArm(self.robot, self.link, poses[0])
        found, distance = arm.nearest_shape(q, poses[1])
        if distance > REACHED_DISTANCE:
            found, distance, angle = arm.search_shape(q, poses[1])
            if not is_reached(distance, angle):
                raise UnreachableError(
                    f"The goal of '{self.link}' is out of reach from that of the base: "
                    f"{distance:.3g} m and {angle:.3g} rad remain.",
                    Proof.LIMITS,
                )
        return found

    def _require_within(self, q: Array) -> None:
        for name, value, low, high in zip(
            self.robot.joint_names, q, self.limits.lower, self.limits.upper, strict=True
        ):
            if not low <= value <= high:
                raise UnreachableError(
                    f"Joint '{name}' would end at {value:.4g}, beyond its limits "
                    f"[{low:.4g}, {high:.4g}].",
                    Proof.LIMITS,
                )

    def _guess(self, boundary: ThrustBoundary, end: _End, bow: Array) -> ThrustKnots:
        """Return a straight line and geodesic of the base, straight ways of the joints, along a
        quintic at full thrust; half-way ``bow`` (3,), m, beside the line.
        """
        robot, N = self.robot, self.options.intervals
        u = np.linspace(0.0, 1.0, N + 1)[:, np.newaxis]
        s = u**3 * (10 + u * (6 * u - 15))
        X0 = boundary.state[:4]
        c0 = robot.center_of_mass(boundary.shape)
        r0 = boundary.state[7:10] - matrix_from_quaternion(X0) @ c0
        q = boundary.shape + s * (end.q - boundary.shape)
        turn = attitude_error(X0, end.base[3:])
        X = quaternion_multiply(X0, quaternions_from_rotvecs(s * turn))
        r_WB = r0 + s * (end.base[:3] - r0) + 16 * (u * (1 - u)) ** 2 * bow
        R = matrices_from_quaternions(X)
        c = robot.function("center_of_mass")(q.T).full().T
        r = r_WB + np.einsum("kij,kj->ki", R, c)
        # In one second; the time follows.
        h = 1.0 / N
        V, v = np.gradient(r, h, axis=0), np.gradient(q, h, axis=0)
        between = quaternion_multiply(X[:-1] * [-1.0, -1.0, -1.0, 1.0], X[1:])
        rates = rotvecs_from_quaternions(between) / h
        omega = np.vstack([rates[:1], (rates[1:] + rates[:-1]) / 2, rates[-1:]])
        H = np.array([robot.inertia_matrix(each)[3:6, 3:] for each in q])
        L_B = np.einsum("kij,kj->ki", H, np.hstack([omega, v]))
        L = np.einsum("kij,kj->ki", R, L_B)
        for each in (v, V, L):
            each[0] = each[-1] = 0.0
        f_B = np.einsum("kji,kj->ki", R[:-1], robot.total_mass * np.diff(V, axis=0) / h)
        n_B = np.einsum("kji,kj->ki", R[:-1], np.diff(L, axis=0) / h) + np.cross(c[:-1], f_B)
        wanted = np.hstack([f_B, n_B]) @ np.linalg.pinv(self.propulsion.wrenches).T
        speed = float(np.max(np.abs(v) / self.limits.velocity, initial=0.0))
        change = np.diff(v, axis=0) / h
        most = float(np.max(np.abs(change) / self.limits.acceleration, initial=0.0))
        time = max(speed, math.sqrt(most), math.sqrt(float(np.abs(wanted).max())), 1e-3)
        levels = np.clip(wanted / time**2, self.propulsion.lowest, 1.0)
        knots = ThrustKnots(h, X, q, v, L, r, V, change, wanted).stretched(time)
        return replace(knots, levels=levels)

    # -- bodies -------------------------------------------------------------------------------

    def base_poses(self, shapes: Array, X: Array, r_WC: Array) -> BasePoses:
        """Return the poses of the base from those of the centre of mass (K, ...)."""
        c = self.robot.function("center_of_mass")(shapes.T).full().T
        return BasePoses(r_WC - np.einsum("kij,kj->ki", matrices_from_quaternions(X), c), X)

    def along(self, knots: ThrustKnots) -> tuple[Array, BasePoses, Array]:
        """Return shapes, poses of the base and times from 0 to 1 in their intervals (N K,) at the
        instants at which pairs are kept apart.
        """
        N, h, K = len(knots.levels), knots.step, _INSTANTS
        tau = np.tile(np.arange(1, K + 1) / K, N)[:, np.newaxis]
        k = np.repeat(np.arange(N), K)
        q, v, V = knots.shapes, knots.velocities, knots.v_WC
        shapes = q[k] + h * (tau * v[k] + tau**2 / 2 * (v[k + 1] - v[k]))
        X = (1 - tau) * knots.quaternions[k] + tau * knots.quaternions[k + 1]
        X /= np.linalg.norm(X, axis=1, keepdims=True)
        r = knots.r_WC[k] + h * (tau * V[k] + tau**2 / 2 * (V[k + 1] - V[k]))
        return shapes, self.base_poses(shapes, X, r), tau

    def planes(
        self, kept: _Kept, room: Mapping[int, float], required: Array, knots: ThrustKnots
    ) -> Array:
        """Return the planes (R, 8) of pairs along a path, with the room of each, m."""
        assert self.clearance is not None
        geometry = self.clearance.geometry
        shapes, base, tau = self.along(knots)
        R, r = geometry.poses(shapes, base)
        found = []
        at_end = np.arange(len(tau)) >= len(tau) - _INSTANTS
        at_end |= np.arange(len(tau)) < _INSTANTS
        for pair, places in kept:
            at = list(places)
            _, planes = geometry.planes(pair, (R[at], r[at]))
            planes[:, 3] += required[pair] + np.where(at_end[at], 0.0, room[pair])
            found.append(np.hstack([planes, tau[at]]))
        return np.vstack(found)

    def places(self, pair: int, required: Array, knots: ThrustKnots) -> set[int]:
        """Return the instants of a path at which a pair is near, by the size of its first solid."""
        assert self.clearance is not None
        geometry = self.clearance.geometry
        shapes, base, _ = self.along(knots)
        distances = geometry.distances(pair, geometry.poses(shapes, base))
        reach = geometry.solids[geometry.pairs[pair][0]].enclosure.bounding_radius
        return set(np.flatnonzero(distances < required[pair] + reach).tolist())

    def approaches(self, motion: ThrustMotion, required: Array) -> list[Approach]:
        """Return the pairs that come too near in a motion, nearest first."""
        if self.clearance is None:
            return []
        shapes, base = motion.path()
        return self.clearance.approaches(
            shapes, required, base if self.clearance.has_obstacles else None
        )

    def reason(self, approach: Approach) -> str:
        """Return a clause about a motion that is not clear."""
        assert self.clearance is not None
        return f"no clear motion was found: {self.clearance.clause(approach, None)}"

    def bows(
        self, boundary: ThrustBoundary, end: _End, required: Array, near: Sequence[Approach]
    ) -> Iterator[ThrustKnots]:
        """Yield the straight guess and those beside it that are clear, the straightest first."""
        assert self.clearance is not None
        geometry, r0 = self.clearance.geometry, boundary.state[7:10]
        along = end.base[:3] - r0
        length = max(float(np.linalg.norm(along)), 1e-9)
        frame = np.linalg.svd(along[np.newaxis] / length)[2]
        angles = 2 * math.pi * np.arange(_BOW_DIRECTIONS) / _BOW_DIRECTIONS
        sides = np.outer(np.cos(angles), frame[1]) + np.outer(np.sin(angles), frame[2])
        in_way = any(each.place_on_obstacle is not None for each in near)
        pairs = {each.pair for each in near} | {*np.flatnonzero(geometry.with_obstacles).tolist()}
        for height in _BOW_SHARES if in_way else _BOW_SHARES[:1]:
            found = []
            for side in sides if height else sides[:1]:
                guess = self._guess(boundary, end, height * max(length / 2, 0.5) * side)
                shapes, base, _ = self.along(guess)
                poses = geometry.poses(shapes, base)
                lack = [
                    float((geometry.distances(pair, poses) - required[pair]).min())
                    for pair in pairs
                ]
                found.append((min(lack), guess))
            best, guess = max(found, key=lambda each: each[0])
            if best > 0:
                yield guess


_Kept = tuple[tuple[int, tuple[int, ...]], ...]
"""Pairs that are kept apart, and the instants at which they are."""


@dataclass(frozen=True)
class _End:
    """Pose (7,) of the base and joint positions (n,) at which a guess ends."""

    base: Array
    q: Array


_NEAREST = Weights(0.0, 0.0, 1.0, 1.0, _COST_OF_LACK)

_FREE_TIME = DurationBounds(1e-3, 1e5)


def _around(approach: Approach, intervals: int) -> set[int]:
    """Return the instants before and after an approach in an exactly integrated motion."""
    place = int(approach.tick / EXACT_STEPS * _INSTANTS) - 1
    return set(range(max(place, 0), min(place + 2, intervals * _INSTANTS)))


def _fixed(path: ThrustKnots) -> DurationBounds:
    return DurationBounds(path.duration, path.duration)


class _Search:
    """One search of a planner."""

    def __init__(
        self,
        planner: ThrustPlanner,
        boundary: ThrustBoundary,
        end: _End,
        kinds: tuple[bool, str],
        stop: StopRule,
    ) -> None:
        self.planner, self.boundary, self.kinds, self.stop = planner, boundary, kinds, stop
        options = planner.options
        self._is_timed = options.duration > 0 or options.time_factor > 1
        """Whether the duration is given, or follows from the shortest one."""
        self._effort_limit = (1.0 - options.reserve) * planner.robot.effort_limit
        self._room: dict[int, float] = {}
        """Room of the pairs that are kept apart, m."""
        self._places: dict[int, set[int]] = {}
        """Instants at which they are."""
        self._required = self._require_ends(end)

    def _require_ends(self, end: _End) -> Array:
        clearance, boundary = self.planner.clearance, self.boundary
        if clearance is None:
            return np.zeros(0)
        q, X, r = boundary.shape[np.newaxis], boundary.state[np.newaxis, :4], boundary.state[7:10]
        base = self.planner.base_poses(q, X, r[np.newaxis])
        required = clearance.required(boundary.shape, base if clearance.has_obstacles else None)
        if self.kinds[0]:
            goal, q = boundary.goals[np.newaxis, :7], end.q
            base = BasePoses(goal[:, :3], goal[:, 3:])
            clearance.require_shape(q, required, base if clearance.has_obstacles else None)
        return required

    def run(self, guess: ThrustKnots, end: _End) -> ThrustMotion:
        """Return the motion.

        Raises
        ------
        PlanningError
            There is none, or none is found.
        """
        fastest = self._fastest(guess)
        if fastest is None:
            raise PlanningError(self._failure("no motion to the goal was found"))
        time = self._time(fastest)
        for _ in range(_MAX_ROUNDS):
            motion = self._motion(fastest.stretched(time / fastest.duration), end)
            share = motion.effort_share(self._effort_limit)
            if share <= 1.0:
                return motion
            # Efforts of a motion at rest are about as the square of its speed.
            time = motion.duration * min(1.01 * math.sqrt(share), _LARGEST_STRETCH)
            self._is_timed = True
        raise PlanningError(
            self._failure(f"its joints need {share:.3g} times the efforts that a plan may use")
        )

    def _motion(self, path: ThrustKnots, end: _End) -> ThrustMotion:
        """Return the exact and clear motion near a path, in its time if that is given."""
        planner = self.planner
        self._room, self._places = {}, {}
        if self._is_timed:
            # Roughly, for a look at what is in the way.
            weights = self._cheap(path, _ROUNDINGS[0])
            path = self._solve(path, weights, _fixed(path), rough=True) or path
        near = planner.approaches(planner.motion(path), self._required)
        if not near:
            motion = self._exact(path)
            near = planner.approaches(motion, self._required)
            if not near:
                return motion
        path = self._clear(path, end, near)
        for _ in range(_MAX_ROUNDS):
            motion = self._exact(path, self._planes(path))
            approaches = planner.approaches(motion, self._required)
            if not approaches:
                return motion
            self._add(approaches, path)
        raise PlanningError(self._failure(planner.reason(approaches[0])))

    def _time(self, fastest: ThrustKnots) -> float:
        options = self.planner.options
        if 0 < options.duration < fastest.duration:
            raise UnreachableError(
                f"The motion takes {fastest.duration:.4g} s at least, and plan.duration is "
                f"{options.duration:g} s.",
                Proof.LIMITS,
            )
        return options.duration or options.time_factor * fastest.duration

    @property
    def _kept(self) -> _Kept:
        return tuple((pair, tuple(sorted(self._places[pair]))) for pair in sorted(self._places))

    def _planes(self, path: ThrustKnots) -> Array:
        return self.planner.planes(self._kept, self._room, self._required, path)

    def _add(self, approaches: Sequence[Approach], path: ThrustKnots) -> None:
        """Keep more pairs apart, where they are near along a path, and give those that are kept as
        much room as they lack.
        """
        for each in approaches:
            near = self.planner.places(each.pair, self._required, path)
            near |= _around(each, len(path.levels))
            self._places[each.pair] = self._places.get(each.pair, set()) | near
            lack = float(self._required[each.pair]) - each.distance
            before = self._room.get(each.pair)
            self._room[each.pair] = _ROOM if before is None else before + lack + _ROOM

    def _solve(
        self,
        guess: ThrustKnots,
        weights: Weights,
        duration: DurationBounds,
        defects: Array | None = None,
        planes: Array | None = None,
        center: ThrustKnots | None = None,
        *,
        rough: bool = False,
    ) -> ThrustKnots | None:
        self.stop.cancellation.raise_if_requested()
        solver = self.planner.solver(self.kinds, self._kept)
        limits, args = self.planner.limits, (self.stop, duration, defects, planes)
        return solver.solve(
            self.boundary, limits, guess, weights, *args, center=center, rough=rough
        )

    def _fastest(self, guess: ThrustKnots) -> ThrustKnots | None:
        return self._solve(guess, self._fast(guess), _FREE_TIME, rough=self._is_timed)

    def _fast(self, guess: ThrustKnots) -> Weights:
        """Return the weights of least time, in units of the guess."""
        small = _TIME_REGULARISATION
        return Weights(1 / guess.duration, 0.0, small, small, _COST_OF_LACK)

    def _cheap(self, guess: ThrustKnots, rounding: float) -> Weights:
        """Return the weights of least propellant, in units of the guess."""
        spent = guess.step * float(np.sum(self.planner.propulsion.cost_of(guess.levels)))
        small = _REGULARISATION
        return Weights(0.0, 1 / max(spent, 1e-12), _SMOOTHNESS, small, _COST_OF_LACK, rounding)

    def _exact(self, guess: ThrustKnots, planes: Array | None = None) -> ThrustMotion:
        """Return the motion of least propellant, or of least time, near a path, as it flies.

        Raises
        ------
        PlanningError
            None is found that ends at the goal.
        """
        planner, knots = self.planner, guess
        if self._is_timed:
            duration = _fixed(guess)
            roundings = _ROUNDINGS[1:] if planner.propulsion.norms else (1.0,)
            if planes is not None:
                roundings = roundings[:1]
            *others, last = (self._cheap(guess, each) for each in roundings)
        else:
            duration, others = _FREE_TIME, []
            last = self._fast(guess)
        for each in others:
            knots = self._solve(knots, each, duration, planes=planes) or knots
        defects, center, best, error = None, None, None, math.inf
        for _ in range(_MAX_CORRECTIONS):
            solved = self._solve(knots, last, duration, defects, planes, center)
            if solved is None:
                break
            knots, motion = solved, planner.motion(solved)
            found = self._end_error(motion)
            if found < error:
                best, error = motion, found
            if error < _EXACT_END:
                break
            defects = planner.solver(self.kinds, self._kept).defects(knots, defects)
            if self._is_timed and found < _NEAR_END:
                # The nearest controls that fly exactly: solutions of least propellant are flat.
                last, center = _NEAREST, knots
        if best is None:
            raise PlanningError(self._failure("no motion to the goal was found"))
        if error > _LARGEST_END_ERROR:
            least = planner.options.intervals
            raise PlanningError(
                self._failure(
                    f"its plan ends {error:.3g} m or rad beside it; set plan.intervals to more "
                    f"than {least}"
                )
            )
        return best

    def _end_error(self, motion: ThrustMotion) -> float:
        """Return the largest error of the poses at the end, m or rad."""
        last = motion.at(motion.duration)
        frames = [last.base] if self.kinds[0] else []
        if self.kinds[1] and last.end_effector is not None:
            frames.append(last.end_effector)
        errors = [0.0]
        for frame, goal in zip(frames, self.boundary.goals.reshape(-1, 7), strict=True):
            errors.append(float(np.linalg.norm(frame.position - goal[:3])))
            errors.append(float(np.linalg.norm(attitude_error(frame.quaternion, goal[3:]))))
        return max(errors)

    def _clear(self, path: ThrustKnots, end: _End, near: Sequence[Approach]) -> ThrustKnots:
        """Return a path that is clear of the pairs that came near, and of all others."""
        planner, time = self.planner, path.duration
        last = near[0]
        for guess in itertools.chain(
            planner.bows(self.boundary, end, self._required, near), [path]
        ):
            self._room, self._places = {}, {}
            at = guess.stretched(max(time / guess.duration, 1.0))
            self._add(near, at)
            for _ in range(_MAX_ROUNDS):
                planes = self._planes(at)
                weights = self._cheap(at, _ROUNDINGS[0]) if self._is_timed else self._fast(at)
                duration = _fixed(at) if self._is_timed else _FREE_TIME
                solved = self._solve(at, weights, duration, planes=planes)
                if solved is None:
                    break
                at = solved
                if planner.solver(self.kinds, self._kept).lack > _LARGEST_LACK:
                    continue
                approaches = planner.approaches(planner.motion(at), self._required)
                if not approaches:
                    return at
                last = approaches[0]
                self._add(approaches, at)
        raise PlanningError(self._failure(planner.reason(last)))

    def _failure(self, why: str) -> str:
        return f"The goal of robot '{self.planner.robot.description.name}' is not reached: {why}."
