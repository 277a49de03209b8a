"""Pairs of links, and of links and obstacles, that a solver keeps apart: only pairs that come too
close in a solution without such constraints.

Rows for all pairs would be expensive, and few of them matter. So a problem is first solved without
such rows. If the exact check finds links too close under held commands, rows are added for these
pairs. The rows contain distances from planes between the links
(:mod:`spacerobot_ros.collision.planes`), which are valid only near the path for which they were
computed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import copy
from dataclasses import replace

import numpy as np

from spacerobot_ros.collision import Approach, BasePoses
from spacerobot_ros.collision.geometry import Poses
from spacerobot_ros.collision.planes import PLANE_SIZE
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.rotations import matrix_from_quaternion, quaternion_multiply
from spacerobot_ros.planning.core.clearance import Clearance
from spacerobot_ros.planning.core.prediction import BasePrediction
from spacerobot_ros.planning.methods.optimal.problem import (
    BoundaryConditions,
    MotionLimits,
    Trajectory,
)

INITIAL_ROOM = 2e-3
"""Room beyond the clearance that is added for a pair, because held commands change the path, m."""

_NO_TURN = np.array([0.0, 0.0, 0.0, 1.0])

_MIN_INSTANTS = 80
"""Smallest number of instants in a manoeuvre at which links are kept apart. With 160 on the full
grid, a solver step took twice as long, and paths were no sooner clear in between."""

_SHARE_OF_ENDS = 0.1
"""Fraction of a path, at an end with a given shape, where pairs need no room."""


def instants_of(intervals: int) -> int:
    """Return the number of instants per interval at which pairs are kept apart."""
    return math.ceil(_MIN_INSTANTS / intervals)


class KeptDistances:
    """Pairs kept apart in one search, each by planes along a path: none initially.

    Parameters
    ----------
    clearance
        The clearance of plans.
    robot, prediction
        The model, and the base motion prediction.
    boundary
        Both ends of the motion.
    turn_is_known
        Whether the boundary conditions give the base rotation at the end.

    Raises
    ------
    PlanningError
        Links are too close at an end.
    """

    def __init__(
        self,
        clearance: Clearance,
        robot: SpaceRobot,
        prediction: BasePrediction,
        boundary: BoundaryConditions,
        *,
        turn_is_known: bool,
    ) -> None:
        self.clearance = clearance
        self._robot, self._prediction, self._boundary = robot, prediction, boundary
        self._room: dict[int, float] = {}
        base = self._base_poses(boundary.start[np.newaxis], _NO_TURN[np.newaxis])
        self._required = clearance.required(boundary.start, base)
        if boundary.final is not None:
            base = None
            if turn_is_known:
                end, turn = boundary.final[np.newaxis], boundary.goal_rotation[np.newaxis]
                base = self._base_poses(end, turn)
            clearance.require_shape(boundary.final, self._required, base)

    def _base_poses(self, shapes: Array, turns: Array) -> BasePoses | None:
        """Return the base poses at shapes (K, n) and rotations (K, 4) since the start.

        None if there are no obstacles, so that the base pose does not matter.
        """
        state = self._boundary.state
        if state is None or not self.clearance.has_obstacles:
            return None
        attitudes = quaternion_multiply(state.quaternion, turns)
        return self._prediction.poses(state, shapes, attitudes)

    def planes(self, pair: int, poses: Poses) -> tuple[Array, Array]:
        """Return the distances (K,) of a pair, m, and its planes (K, 7) in row form."""
        geometry = self.clearance.geometry
        distances, planes = geometry.planes(pair, poses)
        if geometry.with_obstacles[pair]:
            # From W to the centre-of-mass frame with the initial base attitude.
            state = self._boundary.state
            assert state is not None
            R_W0 = matrix_from_quaternion(state.quaternion)
            r_WC = state.position + R_W0 @ self._robot.center_of_mass(state.q)
            planes[:, 3] -= planes[:, :3] @ r_WC
            planes[:, :3] = planes[:, :3] @ R_W0
        return distances, planes

    @property
    def pairs(self) -> tuple[int, ...]:
        """Pair numbers."""
        return tuple(sorted(self._room))

    def approaches(self, positions: Array, turns: Array, margin: float = 0.0) -> list[Approach]:
        """Return the pairs whose distance during held commands (N + 1, n) falls below the required
        distance plus a margin, m, nearest first.

        ``turns`` (N + 1, 4) are the base rotations since the start.
        """
        base = self._base_poses(positions, turns)
        return self.clearance.approaches(positions, self._required + margin, base)

    def beside(self, path: Trajectory, margin: float = 0.0) -> KeptDistances:
        """Return kept distances for the same ends, with the pairs that come closer along a path
        than required plus a margin, m; pairs that are already kept apart keep their room.
        """
        kept = copy(self)
        near = (each.pair for each in self.approaches_of(path, margin))
        kept._room = {pair: self._room.get(pair, INITIAL_ROOM) for pair in near}
        return kept

    def add(self, near: Sequence[Approach]) -> None:
        """Add pairs that came too close."""
        for each in near:
            self._room.setdefault(each.pair, INITIAL_ROOM)

    def widen(self, near: Sequence[Approach]) -> None:
        """Add pairs that came too close; pairs that are already kept apart are given the missing
        room."""
        for each in near:
            if each.pair in self._room:
                self._room[each.pair] += self._required[each.pair] - each.distance
        self.add(near)

    def along(self, path: Trajectory) -> tuple[Array, Array]:
        """Return shapes (N K, n) and base rotations (N K, 4) since the start at the K instants of
        all N intervals at which pairs are kept apart.
        """
        return path.within_intervals(instants_of(len(path.shapes) - 1))

    def is_clear(self, path: Trajectory) -> bool:
        """Whether no pair comes too close along a path."""
        # Most paths in collision are so at their knots, which costs a fiftieth to check.
        knots_are_clear = self.clearance.is_clear(path.shapes, self._required)
        return knots_are_clear and not self.approaches_of(path)

    def approaches_of(self, path: Trajectory, margin: float = 0.0) -> list[Approach]:
        """Return the pairs that come too close along a path, as in :meth:`approaches`."""
        shapes, turns = self.along(path)
        shapes = np.vstack([path.shapes[:1], shapes])
        return self.approaches(shapes, np.vstack([path.quaternions[:1], turns]), margin)

    def within(
        self, limits: MotionLimits, path: Trajectory, *, pushing: bool = False
    ) -> MotionLimits:
        """Return limits with planes between all pairs at all instants in N intervals of a path.

        Planes are shifted by the required distances of pairs plus their room, or by the current
        distances if these are smaller. So a clear path satisfies its own planes. ``pushing``:
        whether pairs must have this room, except at the ends, whose shapes are given.
        """
        if not self.pairs:
            return limits
        shapes, turns = self.along(path)
        poses = self.clearance.geometry.poses(shapes, self._base_poses(shapes, turns))
        found = np.empty((len(shapes), len(self.pairs), PLANE_SIZE))
        place = np.arange(len(shapes)) / len(shapes)
        if self._boundary.final is not None:
            place = np.minimum(place, 1 - place)
        at_ends = place < _SHARE_OF_ENDS
        for number, pair in enumerate(self.pairs):
            distances, found[:, number] = self.planes(pair, poses)
            wanted = self._required[pair] + self._room[pair]
            left_as_it_is = distances >= self._required[pair]
            if pushing:
                left_as_it_is &= at_ends
            found[:, number, 3] += np.where(left_as_it_is, np.minimum(distances, wanted), wanted)
        return replace(limits, distances=found.reshape(len(path.shapes) - 1, -1))
