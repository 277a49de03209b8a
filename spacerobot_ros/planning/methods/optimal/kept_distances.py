"""Pairs of links, and of links and obstacles, that a solver keeps apart: only those that a solution
without has brought near.

Rows for all pairs would be dear, and few of them matter. So a problem is solved without any first.
Where held commands bring links too near, by the exact check, the problem with rows for these pairs
is solved from there, and so on until none is too near. Rows are of two kinds
(:mod:`spacerobot_ros.collision.rows`).

Smooth rows are near to the distances but are no bounds of them: a pair that is still too near is
given as much more room as it lacked. They lead far round in one solution, but are dear where many
pairs are near, and fail from some paths.

Distances from planes (:class:`KeptByPlanes`, :class:`PathClearing`) hold near the path that they
are made for alone. So a clear path is looked for in small changes, in more time and with little
effort; links may be nearer than they ought to be at first, at a cost. A clear path is then made
faster in the same way, by changes that keep it clear.

J. Schulman et al., "Motion planning with sequential convex optimization and convex collision
checking", International Journal of Robotics Research 33, 2014, whose steps are quadratic programs;
here they are the manoeuvre's own problem.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Generic, Protocol, TypeVar

import numpy as np

from spacerobot_ros.collision import Approach, BasePoses
from spacerobot_ros.collision.geometry import Poses
from spacerobot_ros.collision.rows import (
    PLANE_SIZE,
    CompiledRows,
    DistanceRows,
    world_pose_parameters,
)
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.rotations import matrix_from_quaternion, quaternion_multiply
from spacerobot_ros.planning.core.clearance import Clearance
from spacerobot_ros.planning.core.prediction import BasePrediction
from spacerobot_ros.planning.methods.optimal.multiple_shooting import Neighbourhood
from spacerobot_ros.planning.methods.optimal.problem import (
    BoundaryConditions,
    MotionLimits,
    Trajectory,
    UnusableCandidateError,
)

ROUNDS = 6
"""Solutions from one guess, each with more pairs or more room, before it is given up."""

_INITIAL_MARGIN = 2e-3
"""Room beyond the clearance that a pair is given: held commands change the path, m."""

_NO_TURN = np.array([0.0, 0.0, 0.0, 1.0])

_MAX_ACTIVE_DISTANCE = 0.05
"""Distance beyond the clearance at which the rows of a pair are no longer compared with it, m."""

_END_MARGIN = 1e-4
"""Smallest margin at the ends, where the shape is given, m."""


_MIN_INSTANTS = 80
"""Instants of a manoeuvre at which links are kept apart on a grid at least: between the knots of a
coarse one they would come too near."""

_SHARE_OF_ENDS = 0.1
"""Share of a path at either end where pairs need not have room."""

_MAX_CLEARING_ROUNDS, _MAX_SHORTENING_ROUNDS = 15, 10
"""Paths on the way to a clear one, and from there to a fast one, at most."""

_MIN_LARGEST_LACK, _LACK_PER_DEPTH = 0.1, 2.0
"""Distance by which links on the way to a clear path may be nearer than they ought to be, m: at
least, and as a multiple of the depth of their contact."""

_NO_LACK = 1e-3
"""Lack of distance below which all planes are kept, m."""

_PROGRESS_SHARE = 0.9
"""Largest ratio of the lack of distance to the one two paths before at which it is going on."""

_MIN_GAIN = 0.01
"""Relative gain of time below which a clear path is not made faster any more."""

_REACH_DIVISOR, _REACH_FACTOR, _MIN_REACH_SHARE = 3.0, 2.0, 0.02
"""Divisor of the reach where a faster path is not clear, its factor where it is, and the share of
the largest reach at which paths are not made faster any more."""


def instants_of(intervals: int) -> int:
    """Return at how many instants of each interval pairs are kept apart."""
    return max(2, math.ceil(_MIN_INSTANTS / intervals))


K = TypeVar("K", bound="KeptDistances")


class DistanceLibrary:
    """The rows of pairs of one robot, derived where they are needed.

    Parameters
    ----------
    clearance
        The clearance of plans.
    robot, prediction
        The model, and the prediction of the base motion.
    """

    def __init__(self, clearance: Clearance, robot: SpaceRobot, prediction: BasePrediction) -> None:
        self.clearance = clearance
        self._robot, self._prediction = robot, prediction
        self._rows: dict[tuple[int, bool], DistanceRows] = {}

    def of(self, pairs: Sequence[int], *, planes: bool = False) -> list[DistanceRows]:
        """Return the smooth rows of pairs, or their distances from planes."""
        for pair in pairs:
            if (pair, planes) not in self._rows:
                self._rows[pair, planes] = self._derive(pair, planes=planes)
        return [self._rows[pair, planes] for pair in pairs]

    @cached_property
    def _compiled(self) -> CompiledRows | None:
        return CompiledRows.of(self.clearance.geometry)

    def _derive(self, pair: int, *, planes: bool) -> DistanceRows:
        geometry = self.clearance.geometry
        if not planes and not geometry.with_obstacles[pair]:
            compiled = self._compiled
            return compiled.rows(pair) if compiled else DistanceRows.of(geometry, [pair])
        center_of_mass = self._robot.function("center_of_mass", compile=False)
        derive = DistanceRows.of_planes if planes else DistanceRows.from_obstacles
        return derive(geometry, pair, center_of_mass)

    def begin(self, boundary: BoundaryConditions, *, turn_is_known: bool) -> KeptDistances:
        """Return the pairs that are kept apart between two ends: none yet.

        ``turn_is_known``: the turn of the base at the end is that of the boundary conditions.

        Raises
        ------
        PlanningError
            Links are too near at an end.
        """
        start = boundary.start[np.newaxis]
        required = self.clearance.required(
            boundary.start, self.base_poses(boundary, start, _NO_TURN[np.newaxis])
        )
        if boundary.final is not None:
            base = None
            if turn_is_known:
                end, turn = boundary.final[np.newaxis], boundary.goal_rotation[np.newaxis]
                base = self.base_poses(boundary, end, turn)
            self.clearance.require_shape(boundary.final, required, base)
        return KeptDistances(self, boundary, required, turn_is_known=turn_is_known)

    def base_poses(
        self, boundary: BoundaryConditions, shapes: Array, turns: Array
    ) -> BasePoses | None:
        """Return the poses of the base at shapes (K, n) and turns (K, 4) since the start.

        None: there are no obstacles, so that it does not count.
        """
        if boundary.state is None or not self.clearance.has_obstacles:
            return None
        attitudes = quaternion_multiply(boundary.state.quaternion, turns)
        return self._prediction.poses(boundary.state, shapes, attitudes)

    def world(self, boundary: BoundaryConditions) -> Array:
        """Return the numbers (12,) of the pose of the world (:func:`.world_pose_parameters`)."""
        state = boundary.state
        assert state is not None
        R_0W = matrix_from_quaternion(state.quaternion).T
        r_WC = state.position + R_0W.T @ self._robot.center_of_mass(state.q)
        return world_pose_parameters(R_0W, -R_0W @ r_WC)

    def planes(self, boundary: BoundaryConditions, pair: int, poses: Poses) -> tuple[Array, Array]:
        """Return the distances (K,) of a pair, m, and its planes (K, 7) as rows take them."""
        geometry = self.clearance.geometry
        distances, planes = geometry.planes(pair, poses)
        if geometry.with_obstacles[pair]:
            # From W to the centre of mass with the attitude of the base at the start.
            world = self.world(boundary)
            R_0W, r_0W = world[:9].reshape(3, 3).T, world[9:]
            planes[:, :3] = planes[:, :3] @ R_0W.T
            planes[:, 3] += planes[:, :3] @ r_0W
        return distances, planes


class KeptDistances:
    """The pairs that are kept apart in one search.

    Parameters
    ----------
    library
        The rows.
    boundary
        Both ends.
    required
        (P,) the distances that all pairs are to keep, m.
    turn_is_known
        As for :meth:`DistanceLibrary.begin`.
    """

    def __init__(
        self,
        library: DistanceLibrary,
        boundary: BoundaryConditions,
        required: Array,
        *,
        turn_is_known: bool,
    ) -> None:
        self._library, self._boundary, self._required = library, boundary, required
        self._turn_is_known = turn_is_known
        self._room: dict[int, float] = {}

    has_planes = False
    """Whether rows are distances from planes."""

    @property
    def pairs(self) -> tuple[int, ...]:
        """Their numbers."""
        return tuple(sorted(self._room))

    def approaches(self, positions: Array, turns: Array) -> list[Approach]:
        """Return the pairs that come too near along held commands (N + 1, n), nearest first.

        ``turns`` (N + 1, 4) are those of the base since the start.
        """
        base = self._library.base_poses(self._boundary, positions, turns)
        return self._library.clearance.approaches(positions, self._required, base)

    def message(self, approach: Approach, control_period: float | None) -> str:
        """Return a clause about a path that comes too near; no control period: of no times."""
        return self._library.clearance.clause(approach, control_period)

    def include(self, other: KeptDistances) -> None:
        """Keep the pairs of another search apart, too, with their margins."""
        for pair, room in other._room.items():
            self._room[pair] = max(room, self._room.get(pair, 0.0))

    def copy(self: K) -> K:
        """Return a copy, to which pairs can be added."""
        other = type(self)(
            self._library, self._boundary, self._required, turn_is_known=self._turn_is_known
        )
        other._room = dict(self._room)
        return other

    def add(self, near: Sequence[Approach]) -> None:
        """Add pairs that have come too near; pairs that are kept already get a larger margin."""
        for each in near:
            if each.pair in self._room:
                lacking = max(self._required[each.pair] - each.distance, 0.0)
                self._room[each.pair] += lacking + _INITIAL_MARGIN
            else:
                self._room[each.pair] = min(self._row_error(each), 0.0) + _INITIAL_MARGIN

    def _row_error(self, approach: Approach) -> float:
        """Return the row of a pair less its distance, m; zero for an obstacle."""
        (rows,) = self._library.of([approach.pair])
        if rows.is_of_obstacle:
            return 0.0
        value = float(rows.values(approach.shape[:, np.newaxis]).full().min())
        return value - approach.distance

    def reduce_margins(self, positions: Array, turns: Array) -> bool:
        """Set margins to the errors of the rows where pairs are nearest along held
        commands, (N + 1, n) and (N + 1, 4); return whether any margin decreases.
        """
        library, base = self._library, self._library.base_poses(self._boundary, positions, turns)
        spent = False
        for each in library.clearance.approaches(
            positions, self._required + _MAX_ACTIVE_DISTANCE, base
        ):
            if each.pair not in self._room:
                continue
            if library.clearance.geometry.with_obstacles[each.pair]:
                continue
            room = self._row_error(each) + _INITIAL_MARGIN
            if room < self._room[each.pair] - _INITIAL_MARGIN:
                self._room[each.pair], spent = room, True
        return spent

    def by_planes(self) -> KeptByPlanes:
        """Return no pairs yet that planes keep apart between the same ends."""
        return KeptByPlanes(
            self._library, self._boundary, self._required, turn_is_known=self._turn_is_known
        )

    def within(self, limits: MotionLimits, path: Trajectory | None = None) -> MotionLimits:
        """Return limits with the distances that the rows keep, wherever a path is."""
        ends, turns = [self._boundary.start], [_NO_TURN]
        if self._boundary.final is not None:
            ends.append(self._boundary.final)
            turns.append(self._boundary.goal_rotation)
        known = len(ends) if self._turn_is_known else 1
        shapes, turned = np.array(ends).T, np.hstack([ends, turns])[:known].T
        least, world = [], np.zeros(0)
        for pair, rows in zip(self.pairs, self._library.of(self.pairs), strict=True):
            if rows.is_of_obstacle:
                world = self._library.world(self._boundary)
                values = rows.values(turned, np.tile(world[:, np.newaxis], turned.shape[1]))
            else:
                values = rows.values(shapes)
            at_ends = float(values.full().min()) - _END_MARGIN
            least.append(min(self._required[pair] + self._room[pair], at_ends))
        return replace(limits, distances=np.array([[*least, *world]]))


class KeptByPlanes(KeptDistances):
    """Pairs that planes keep apart."""

    has_planes = True

    def add(self, near: Sequence[Approach]) -> None:
        """Add pairs that have come too near."""
        for each in near:
            self._room.setdefault(each.pair, _INITIAL_MARGIN)

    def widen(self, near: Sequence[Approach]) -> None:
        """Add pairs that have come too near; those that are kept get as much room as they lack."""
        kept = set(self._room)
        self.add(near)
        for each in near:
            if each.pair in kept:
                self._room[each.pair] += self._required[each.pair] - each.distance

    def along(self, path: Trajectory) -> tuple[Array, Array]:
        """Return shapes (N K, n) and turns (N K, 4) of the base since the start at the K instants
        of all N intervals at which pairs are kept apart.
        """
        intervals = len(path.shapes) - 1
        instants, X = instants_of(intervals), path.quaternions[:, np.newaxis]
        tau = np.arange(1, instants + 1)[:, np.newaxis] / instants
        turns = (1 - tau) * X[:-1] + tau * X[1:]
        turns /= np.linalg.norm(turns, axis=2, keepdims=True)
        return path.at_ticks(intervals * instants)[1:], turns.reshape(-1, 4)

    def approaches_of(self, path: Trajectory) -> list[Approach]:
        """Return the pairs that come too near along a path, nearest first."""
        shapes, turns = self.along(path)
        return self.approaches(
            np.vstack([path.shapes[:1], shapes]), np.vstack([path.quaternions[:1], turns])
        )

    def within(
        self, limits: MotionLimits, path: Trajectory | None = None, *, pushing: bool = False
    ) -> MotionLimits:
        """Return limits with planes between all pairs at all instants of N intervals of a path.

        Planes are shifted by the distances that pairs ought to keep with their room, or by those
        that they have, where there is less room: so a clear path keeps to its own planes.
        ``pushing``: pairs are to have their room, but for the ends, whose shapes are given.
        """
        assert path is not None
        shapes, turns = self.along(path)
        poses = self._library.clearance.geometry.poses(
            shapes, self._library.base_poses(self._boundary, shapes, turns)
        )
        found = np.empty((len(shapes), len(self.pairs), PLANE_SIZE))
        place = np.arange(len(shapes)) / len(shapes)
        at_ends = np.minimum(place, 1 - place) < _SHARE_OF_ENDS
        for number, pair in enumerate(self.pairs):
            distances, found[:, number] = self._library.planes(self._boundary, pair, poses)
            wanted = self._required[pair] + self._room[pair]
            left_as_it_is = distances >= self._required[pair]
            if pushing:
                left_as_it_is &= at_ends
            found[:, number, 3] += np.where(left_as_it_is, np.minimum(distances, wanted), wanted)
        return replace(limits, distances=found.reshape(len(path.shapes) - 1, -1))


class Held(Protocol):
    """A path as held commands (:class:`.HeldCommands`)."""

    @property
    def positions(self) -> Array:
        """(N + 1, n) shapes at the ticks, m or rad."""
        ...

    @property
    def quaternions(self) -> Array:
        """(N + 1, 4) turns of the base since the start there."""
        ...


H = TypeVar("H", bound=Held)


@dataclass(frozen=True)
class PathClearing(Generic[H]):
    """Makes paths clear, and clear paths fast, on one grid.

    Attributes
    ----------
    kept
        The pairs that are kept apart; those that come too near on the way are added.
    limits
        Limits of the joints.
    solve
        Returns the solution near a guess, in a given duration (s; None: the fastest one) and its
        lack of distance, m; raises an :class:`.UnusableCandidateError` where there is none.
    control_period
        s.
    hold
        Returns a path as held commands, which are what is to keep clear; raises the same. None:
        the path itself is.
    """

    kept: KeptByPlanes
    limits: MotionLimits
    solve: Callable[[Trajectory, float | None, Neighbourhood], tuple[Trajectory, float]]
    control_period: float
    hold: Callable[[Trajectory], H] | None = None

    def clear(self, path: Trajectory, duration: float) -> tuple[Trajectory, H | None]:
        """Return a clear path near to one, in a given duration (s), and its held commands.

        Raises
        ------
        UnusableCandidateError
            None was found.
        """
        kept, lacks = self.kept, [math.inf, math.inf]
        near, held = kept.approaches_of(path), None
        for _ in range(_MAX_CLEARING_ROUNDS):
            (kept.widen if lacks[-1] < _NO_LACK else kept.add)(near)
            guess = path.stretched(duration / path.duration)
            deepest = min((each.distance for each in near), default=0.0)
            largest_lack = max(_MIN_LARGEST_LACK, -_LACK_PER_DEPTH * deepest)
            around = Neighbourhood.within(self.limits, largest_lack=largest_lack)
            path, lack = self.solve(guess, duration, around)
            near, held = self._approaches(path)
            if not near:
                return path, held
            lacks.append(lack)
            if lack >= _NO_LACK and lack > _PROGRESS_SHARE * lacks[-3]:
                break
        period = None if held is None else self.control_period
        raise UnusableCandidateError(kept.message(near[0], period))

    def shorten(self, path: Trajectory, held: H | None) -> tuple[Trajectory, H | None]:
        """Return a faster path near to a clear one, and its held commands; else that one itself."""
        reach = 1.0
        for _ in range(_MAX_SHORTENING_ROUNDS):
            if reach < _MIN_REACH_SHARE:
                break
            try:
                faster, _ = self.solve(path, None, Neighbourhood.within(self.limits, reach))
                near, found = self._approaches(faster)
            except UnusableCandidateError:
                reach /= _REACH_DIVISOR
                continue
            if near:
                # A pair that is new has no planes yet.
                if all(each.pair in self.kept.pairs for each in near):
                    reach /= _REACH_DIVISOR
                self.kept.add(near)
                continue
            gain = 1 - faster.duration / path.duration
            if gain > 0:
                path, held = faster, found
            if gain < _MIN_GAIN and reach == 1.0:
                break
            reach = min(_REACH_FACTOR * reach, 1.0)
        return path, held

    def _approaches(self, path: Trajectory) -> tuple[list[Approach], H | None]:
        """Return the pairs that come too near along a path, as held commands if there are any."""
        if self.hold is None:
            return self.kept.approaches_of(path), None
        held = self.hold(path)
        return self.kept.approaches(held.positions, held.quaternions), held
