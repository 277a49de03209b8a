"""Pairs of links, and of links and obstacles, that a solver keeps apart: only those that a solution
without has brought near.

Rows for all pairs would be dear, and few of them matter. So a problem is solved without any first.
Where held commands bring links too near, by the exact check, the problem with rows for these pairs
is solved from there, and so on until none is too near. Rows are near to the distances but no bounds
of them: a pair that is still too near is given as much more room as it lacked.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from spacerobot_ros.collision import Approach, BasePoses
from spacerobot_ros.collision.rows import CompiledRows, DistanceRows, world_pose_parameters
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.rotations import matrix_from_quaternion, quaternion_multiply
from spacerobot_ros.planning.core.clearance import Clearance
from spacerobot_ros.planning.core.prediction import BasePrediction
from spacerobot_ros.planning.methods.optimal.problem import BoundaryConditions, MotionLimits

ROUNDS = 6
"""Solutions from one guess, each with more pairs or more room, before it is given up."""

_INITIAL_MARGIN = 2e-3
"""Room beyond the clearance that a pair is given: held commands change the path, m."""

_NO_TURN = np.array([0.0, 0.0, 0.0, 1.0])

_MAX_ACTIVE_DISTANCE = 0.05
"""Distance beyond the clearance at which the rows of a pair are no longer compared with it, m."""

_END_MARGIN = 1e-4
"""Smallest margin at the ends, where the shape is given, m."""


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
        self._rows: dict[int, DistanceRows] = {}

    def of(self, pairs: Sequence[int]) -> list[DistanceRows]:
        """Return the rows of pairs."""
        for pair in pairs:
            if pair not in self._rows:
                self._rows[pair] = self._derive(pair)
        return [self._rows[pair] for pair in pairs]

    @cached_property
    def _compiled(self) -> CompiledRows | None:
        return CompiledRows.of(self.clearance.geometry)

    def _derive(self, pair: int) -> DistanceRows:
        geometry = self.clearance.geometry
        if not geometry.with_obstacles[pair]:
            compiled = self._compiled
            return compiled.rows(pair) if compiled else DistanceRows.of(geometry, [pair])
        center_of_mass = self._robot.function("center_of_mass", compile=False)
        return DistanceRows.from_obstacles(geometry, pair, center_of_mass)

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

    def message(self, approach: Approach, control_period: float) -> str:
        """Return a clause about a path that comes too near."""
        return self._library.clearance.clause(approach, control_period)

    def include(self, other: KeptDistances) -> None:
        """Keep the pairs of another search apart, too, with their margins."""
        for pair, room in other._room.items():
            self._room[pair] = max(room, self._room.get(pair, 0.0))

    def copy(self) -> KeptDistances:
        """Return a copy, to which pairs can be added."""
        other = KeptDistances(
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

    def within(self, limits: MotionLimits) -> MotionLimits:
        """Return limits with the distances that the rows keep."""
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
        return replace(limits, distances=np.array(least), world=world)
