"""What may come too near in a motion under thrust: links, obstacles, and a tumbling target.

Relative to a target, its body is an obstacle at rest. So the exact check is the one for obstacles,
with the pose of the base relative to the target; a plane between a link and the target is
transformed to W by the pose of the target at that time.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from spacerobot_ros.collision import Approach, BasePoses
from spacerobot_ros.collision.geometry import CollisionGeometry, Poses
from spacerobot_ros.collision.planes import support_distance
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.rotations import (
    matrices_from_quaternions,
    quaternion_inverse,
    quaternion_multiply,
)
from spacerobot_ros.model.target_motion import TorqueFreeMotion
from spacerobot_ros.planning.core.clearance import Clearance
from spacerobot_ros.planning.methods.optimal.transcription import ConstraintBlock
from spacerobot_ros.planning.methods.thrust.goals import Grapple, base_for_hand
from spacerobot_ros.planning.methods.thrust.motion import EXACT_STEPS, ThrustMotion
from spacerobot_ros.planning.methods.thrust.solver import ThrustKnots
from spacerobot_ros.planning.methods.thrust.transcription import INSTANTS, KeptPlaces, pair_block

_NO_DISTANCE = 1e3
"""m; rows of a plane this far away are always satisfied."""


class _Samples(NamedTuple):
    """A path at instants: shapes (K, n), poses of the base, and times (K,) since its start, s."""

    shapes: Array
    base: BasePoses
    times: Array


@dataclass(frozen=True)
class _Surroundings:
    """The distances of links and of obstacles that rest in W or, if there is one, on a target."""

    clearance: Clearance
    target: TorqueFreeMotion | None = None

    @property
    def geometry(self) -> CollisionGeometry:
        return self.clearance.geometry

    def base(self, path: _Samples) -> BasePoses:
        """Return the poses of the base in the frame in which the obstacles rest."""
        if self.target is None:
            return path.base
        X_WT, r_WT = self.target.body_poses(path.times)
        R_WT = matrices_from_quaternions(X_WT)
        r_TB = np.einsum("kji,kj->ki", R_WT, path.base.position - r_WT)
        return BasePoses(r_TB, quaternion_multiply(quaternion_inverse(X_WT), path.base.quaternion))

    def poses(self, path: _Samples) -> Poses:
        return self.geometry.poses(path.shapes, self.base(path))

    def in_world(self, planes: Array, times: Array) -> Array:
        """Return planes (K, 7) of obstacles in W at times (K,)."""
        if self.target is None:
            return planes
        X_WT, r_WT = self.target.body_poses(times)
        normal = np.einsum("kij,kj->ki", matrices_from_quaternions(X_WT), planes[:, :3])
        offset = planes[:, 3:4] + np.sum(normal * r_WT, axis=1, keepdims=True)
        return np.hstack([normal, offset, planes[:, 4:]])


class Bodies:
    """The pairs of solids of one motion: those of a robot and its obstacles, then those of a robot
    and a target.

    Parameters
    ----------
    robot
        The model.
    clearance
        The distances of links and obstacles; None: they are not checked.
    grapple
        The target, whose grapple frame ``link`` meets; None: there is none.
    """

    def __init__(
        self, robot: SpaceRobot, clearance: Clearance | None, link: str, grapple: Grapple | None
    ) -> None:
        self._robot, self._link = robot, link
        self._around = [] if clearance is None else [_Surroundings(clearance)]
        if grapple is not None and grapple.description is not None and grapple.clearance > 0:
            among = replace(robot.description, world=grapple.description)
            distance, name = grapple.clearance, "target.clearance"
            kept = Clearance(among, distance, name, obstacles_alone=True)
            self._around.append(_Surroundings(kept, grapple.motion))
        counts = [len(each.geometry.pairs) for each in self._around]
        self._first = np.cumsum([0, *counts]).tolist()
        self.required = np.zeros(0)
        """Distances (P,) of all pairs, m."""

    def begin(self, shape: Array, pose: Array) -> None:
        """Set the distances required of a motion that starts in a shape (n,) and a pose (7,) of the
        base.

        Raises
        ------
        PlanningError
            The start is too near, or the robot touches an obstacle or the target.
        """
        start = _Samples(shape[np.newaxis], _poses(pose), np.zeros(1))
        found = [np.zeros(0)]
        for each in self._around:
            required = each.clearance.required(shape, each.base(start))
            if each.target is not None:
                # The body that grasps comes as near as the grasp has it.
                grapple = each.target.grapple_in_target
                at = base_for_hand(self._robot, self._link, shape, grapple)
                grasp = each.geometry.poses(shape[np.newaxis], _poses(at))
                for pair in np.flatnonzero(self._is_of_hand(each)).tolist():
                    grasped = float(each.geometry.distances(pair, grasp)[0]) / 2
                    required[pair] = min(required[pair], grasped)
            found.append(required)
        self.required = np.concatenate(found)

    def _is_of_hand(self, around: _Surroundings) -> Array:
        hand, solids = self._robot.description.frames[self._link][0], around.geometry.solids
        return np.array([solids[i].body == hand for i, _ in around.geometry.pairs], dtype=bool)

    def require_end(self, shape: Array, pose: Array) -> None:
        """Refuse a goal, a shape (n,) and a pose (7,) of the base, at which links are too near."""
        for each, required in zip(self._around, self._by_surroundings(), strict=True):
            each.clearance.require_shape(shape, required, _poses(pose))

    def _by_surroundings(self) -> list[Array]:
        return [self.required[i:j] for i, j in zip(self._first, self._first[1:], strict=False)]

    def _pair(self, number: int) -> tuple[_Surroundings, int]:
        """Return the surroundings of a pair, and its number there."""
        k = int(np.searchsorted(self._first, number, side="right")) - 1
        return self._around[k], number - self._first[k]

    # -- rows of the program ------------------------------------------------------------------

    def row_key(self, number: int) -> tuple[int, int]:
        """Return what the rows of a pair depend on: both solids, or the first and any obstacle."""
        around, pair = self._pair(number)
        first, second = around.geometry.pairs[pair].tolist()
        return first, -1 if around.geometry.with_obstacles[pair] else second

    def rows(self, number: int) -> ConstraintBlock:
        """Derive the rows of a pair."""
        around, pair = self._pair(number)
        center_of_mass = self._robot.function("center_of_mass", compile=False)
        distance = support_distance(around.geometry, pair, center_of_mass)
        return pair_block(self._robot.n, distance)

    def base_poses(self, shapes: Array, X: Array, r_WC: Array) -> BasePoses:
        """Return the poses of the base from those of the centre of mass (K, ...)."""
        c = self._robot.function("center_of_mass")(shapes.T).full().T
        return BasePoses(r_WC - np.einsum("kij,kj->ki", matrices_from_quaternions(X), c), X)

    def _along(self, knots: ThrustKnots) -> _Samples:
        """Return a path at the instants (N K,) at which pairs are kept apart."""
        N, h = len(knots.levels), knots.step
        tau = np.tile(np.arange(1, INSTANTS + 1) / INSTANTS, N)[:, np.newaxis]
        k = np.repeat(np.arange(N), INSTANTS)
        q, v, V = knots.shapes, knots.velocities, knots.v_WC
        shapes = q[k] + h * (tau * v[k] + tau**2 / 2 * (v[k + 1] - v[k]))
        X = (1 - tau) * knots.quaternions[k] + tau * knots.quaternions[k + 1]
        X /= np.linalg.norm(X, axis=1, keepdims=True)
        r = knots.r_WC[k] + h * (tau * V[k] + tau**2 / 2 * (V[k + 1] - V[k]))
        return _Samples(shapes, self.base_poses(shapes, X, r), (k + tau[:, 0]) * h)

    def distances(self, number: int, knots: ThrustKnots) -> Array:
        """Return the distances (N K,) of a pair at these instants, m."""
        around, pair = self._pair(number)
        return around.geometry.distances(pair, around.poses(self._along(knots)))

    def room(self, knots: ThrustKnots, pairs: Collection[int] = ()) -> float:
        """Return by how much obstacles, the target and some other pairs are farther away along a
        path than required, at least, m.
        """
        path, least = self._along(knots), np.inf
        parts = zip(self._around, self._by_surroundings(), self._first, strict=False)
        for around, required, first in parts:
            geometry = around.geometry
            R, r = around.poses(path)
            bounds = geometry.lower_bounds((R, r)) - required
            # Pairs that may be the nearest come first, so that most others need not be looked at.
            for pair in np.argsort(bounds.min(axis=0), kind="stable").tolist():
                at = np.flatnonzero(bounds[:, pair] < least)
                if len(at) and (geometry.with_obstacles[pair] or first + pair in pairs):
                    found = geometry.distances(pair, (R[at], r[at])) - required[pair]
                    least = min(least, float(found.min()))
        return least

    def places(self, approach: Approach, knots: ThrustKnots) -> set[int]:
        """Return the instants of a path at which a pair is near, by the size of its first solid,
        and those around its approach in an exactly integrated motion.
        """
        around, pair = self._pair(approach.pair)
        first = around.geometry.solids[around.geometry.pairs[pair][0]]
        reach = self.required[approach.pair] + first.enclosure.bounding_radius
        near = self.distances(approach.pair, knots) < reach
        place = int(approach.tick / EXACT_STEPS * INSTANTS) - 1
        near[max(place, 0) : place + 2] = True
        return set(np.flatnonzero(near).tolist())

    def planes(self, kept: KeptPlaces, room: Mapping[int, float], knots: ThrustKnots) -> Array:
        """Return the planes (R, 8) of pairs along a path, with the room of each, m."""
        path = self._along(knots)
        found, last = [], len(path.times) - INSTANTS
        for number, places in kept:
            at = np.array(places)
            around, pair = self._pair(number)
            R, r = around.poses(path)
            _, planes = around.geometry.planes(pair, (R[at], r[at]))
            if around.geometry.with_obstacles[pair]:
                planes = around.in_world(planes, path.times[at])
            at_ends = (at < INSTANTS) | (at >= last)
            wanted = self.required[number] + np.where(at_ends, 0.0, room[number])
            if around.target is not None and self._is_of_hand(around)[pair]:
                # Boxes around the hand would touch before it does.
                wanted[at >= last] = -np.inf
            planes[:, 3] += np.maximum(wanted, -_NO_DISTANCE)
            found.append(np.column_stack([planes, (at % INSTANTS + 1) / INSTANTS]))
        return np.vstack(found)

    # -- the exact check ----------------------------------------------------------------------

    def approaches(self, motion: ThrustMotion) -> list[Approach]:
        """Return the pairs that come too near in a motion, nearest first."""
        shapes, base = motion.path()
        path = _Samples(shapes, base, np.linspace(0.0, motion.duration, len(shapes)))
        found: list[Approach] = []
        parts = zip(self._around, self._by_surroundings(), self._first, strict=False)
        for around, required, first in parts:
            for each in around.clearance.approaches(shapes, required, around.base(path)):
                place = each.place_on_obstacle if around.target is None else None
                found.append(replace(each, pair=each.pair + first, place_on_obstacle=place))
        return sorted(found, key=lambda each: each.distance)

    def is_in_the_way(self, near: Sequence[Approach]) -> bool:
        """Whether an obstacle or the target is among pairs."""
        return any(self.row_key(each.pair)[1] < 0 for each in near)

    def reason(self, approach: Approach) -> str:
        """Return a clause about a motion that is not clear."""
        around, _ = self._pair(approach.pair)
        return f"no clear motion was found: {around.clearance.clause(approach, None)}"


def _poses(pose: Array) -> BasePoses:
    return BasePoses(pose[np.newaxis, :3], pose[np.newaxis, 3:])
