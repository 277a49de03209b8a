"""Pairs of links that a solver keeps apart: only those that a solution without has brought near.

Rows for all pairs would be dear, and few of them matter. So a problem is solved without any first.
Where held commands bring links too near, by the exact check, the problem with rows for these pairs
is solved from there, and so on until none is too near. Rows are near to the distances but no bounds
of them: a pair that is still too near is given as much more room as it lacked.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from spacerobot_ros.collision import Approach
from spacerobot_ros.collision.rows import DistanceRows
from spacerobot_ros.model.description import Array
from spacerobot_ros.planning.core.clearance import Clearance
from spacerobot_ros.planning.methods.optimal.problem import BoundaryConditions, MotionLimits

ROUNDS = 6
"""Solutions from one guess, each with more pairs or more room, before it is given up."""

_ROOM = 2e-3
"""Room beyond the clearance that a pair is given: held commands change the path, m."""

_AT_ENDS = 1e-4
"""Least room at the ends, where the shape is given, m."""


class DistanceLibrary:
    """The rows of pairs of one robot, derived where they are needed.

    Parameters
    ----------
    clearance
        The clearance of plans.
    """

    def __init__(self, clearance: Clearance) -> None:
        self.clearance = clearance
        self._rows: dict[int, DistanceRows] = {}

    def of(self, pairs: Sequence[int]) -> list[DistanceRows]:
        """Return the rows of pairs."""
        for pair in pairs:
            if pair not in self._rows:
                self._rows[pair] = DistanceRows.of(self.clearance.geometry, [pair])
        return [self._rows[pair] for pair in pairs]

    def begin(self, boundary: BoundaryConditions) -> KeptDistances:
        """Return the pairs that are kept apart between two ends: none yet.

        Raises
        ------
        PlanningError
            Links are too near at an end.
        """
        required = self.clearance.required(boundary.start)
        if boundary.final is not None:
            self.clearance.require_shape(boundary.start, boundary.final)
        return KeptDistances(self, boundary, required)


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
    """

    def __init__(
        self, library: DistanceLibrary, boundary: BoundaryConditions, required: Array
    ) -> None:
        self._library, self._boundary, self._required = library, boundary, required
        self._room: dict[int, float] = {}

    @property
    def pairs(self) -> tuple[int, ...]:
        """Their numbers."""
        return tuple(sorted(self._room))

    def approaches(self, positions: Array) -> list[Approach]:
        """Return the pairs that come too near along held commands (N + 1, n), nearest first."""
        return self._library.clearance.approaches(positions, self._required)

    def message(self, approach: Approach, control_period: float) -> str:
        """Return a clause about a path that comes too near."""
        return self._library.clearance.clause(approach, control_period)

    def include(self, other: KeptDistances) -> None:
        """Keep the pairs of another search apart, too, with the room that it gave them."""
        for pair, room in other._room.items():
            self._room[pair] = max(room, self._room.get(pair, 0.0))

    def copy(self) -> KeptDistances:
        """Return the same pairs, to add others to."""
        other = KeptDistances(self._library, self._boundary, self._required)
        other._room = dict(self._room)
        return other

    def add(self, near: Sequence[Approach]) -> None:
        """Keep pairs apart that have come too near; those that are kept already get more room."""
        for each in near:
            lacking = self._required[each.pair] - each.distance if each.pair in self._room else 0.0
            self._room[each.pair] = self._room.get(each.pair, 0.0) + max(lacking, 0.0) + _ROOM

    def within(self, limits: MotionLimits) -> MotionLimits:
        """Return limits with the distances that the rows keep."""
        ends = [self._boundary.start]
        if self._boundary.final is not None:
            ends.append(self._boundary.final)
        least = []
        for pair, rows in zip(self.pairs, self._library.of(self.pairs), strict=True):
            at_ends = float(rows.values(np.array(ends).T).full().min()) - _AT_ENDS
            least.append(min(self._required[pair] + self._room[pair], at_ends))
        return replace(limits, distances=np.array(least))
