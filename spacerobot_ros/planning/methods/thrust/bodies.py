"""Bodies that may come too close in a motion under thrust: links, obstacles, and a tumbling target.

Relative to a target frame, the target body is an obstacle at rest. So the exact check for obstacles
is used,
with the base pose relative to the target; a plane between a link and the target is transformed to W
by the target pose at that time.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from spacerobot_ros.collision import Approach, BasePoses
from spacerobot_ros.collision.geometry import Poses
from spacerobot_ros.collision.planes import support_distance
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.grasp import RobotMotion
from spacerobot_ros.model.rotations import (
    matrices_from_quaternions,
    quaternion_inverse,
    quaternion_multiply,
)
from spacerobot_ros.model.target_motion import TorqueFreeMotion
from spacerobot_ros.planning.core.clearance import Clearance
from spacerobot_ros.planning.methods.optimal.transcription import ConstraintBlock
from spacerobot_ros.planning.methods.thrust.goals import Grapple, base_for_hand
from spacerobot_ros.planning.methods.thrust.motion import EXACT_STEPS, ThrustMotion, base_poses
from spacerobot_ros.planning.methods.thrust.transcription import (
    INSTANTS,
    KeptPlaces,
    ThrustKnots,
    pair_block,
    state_parts,
)

_ROOM = 4e-3
"""Distance, m, in excess of the required distance at these instants, because paths bend between the
instants."""

_NO_DISTANCE = 1e3
"""m; rows for a plane this far away are always satisfied."""


class _Samples(NamedTuple):
    """A path at instants: shapes (K, n), poses of the base, and times (K,) since its start, s."""

    shapes: Array
    base: BasePoses
    times: Array


class _Surroundings:
    """The distances of links and of obstacles that rest in W or, if there is one, on a target.

    Its first pair is number ``first`` of all pairs of a motion.
    """

    def __init__(self, clearance: Clearance, first: int, target: TorqueFreeMotion | None) -> None:
        self.clearance, self.first, self.target = clearance, first, target
        self.geometry = clearance.geometry
        self.of_hand = np.zeros(len(self.geometry.pairs), dtype=bool)
        """Whether each pair (P,) is the body that grasps and the target."""
        self.required = np.zeros(0)
        """Distances (P,), m."""

    def base(self, path: _Samples) -> BasePoses:
        """Return the base poses in the frame in which the obstacles are at rest."""
        if self.target is None:
            return path.base
        X_WT, r_WT = self.target.body_poses(path.times)
        R_WT = matrices_from_quaternions(X_WT)
        r_TB = np.einsum("kji,kj->ki", R_WT, path.base.position - r_WT)
        return BasePoses(r_TB, quaternion_multiply(quaternion_inverse(X_WT), path.base.quaternion))

    def poses(self, path: _Samples) -> Poses:
        return self.geometry.poses(path.shapes, self.base(path))

    def planes(self, pair: int, path: _Samples, at: npt.NDArray[np.int64]) -> Array:
        """Return planes (K, 7) of a pair at instants (K,) of a path; obstacle planes are in W."""
        R, r = self.poses(path)
        _, planes = self.geometry.planes(pair, (R[at], r[at]))
        if self.target is not None and self.geometry.with_obstacles[pair]:
            X_WT, r_WT = self.target.body_poses(path.times[at])
            normal = np.einsum("kij,kj->ki", matrices_from_quaternions(X_WT), planes[:, :3])
            planes[:, 3] += np.sum(normal * r_WT, axis=1)
            planes[:, :3] = normal
        return planes


class Bodies:
    """Pairs of solids for one motion: first the pairs of a robot and its obstacles, then those of
    the robot and a target.

    Parameters
    ----------
    robot
        The model.
    clearance
        Distances between links and obstacles; None: not checked.
    start
        Where the motion begins.
    link, grapple
        The link that meets a target, and the target; None: there is none.

    Raises
    ------
    PlanningError
        Links are too close at the start, or the robot touches an obstacle or the target.
    """

    def __init__(
        self,
        robot: SpaceRobot,
        clearance: Clearance | None,
        start: RobotMotion,
        link: str,
        grapple: Grapple | None,
    ) -> None:
        self._robot = robot
        self._around = [] if clearance is None else [_Surroundings(clearance, 0, None)]
        if grapple is not None and grapple.description is not None and grapple.clearance > 0:
            among = replace(robot.description, world=grapple.description)
            distance, name = grapple.clearance, "target.clearance"
            kept = Clearance(among, distance, name, obstacles_alone=True)
            first = sum(len(each.geometry.pairs) for each in self._around)
            self._around.append(_Surroundings(kept, first, grapple.motion))
        self.rows = cache(self._derived_rows)
        """Returns the rows of a pair with a given number."""
        self._kept: dict[int, tuple[float, Array]] = {}
        """Room of the pairs that are kept apart, m, and whether each is kept apart at each instant
        (N K,)."""
        shape = start.q[np.newaxis]
        begin = _Samples(shape, _poses(start.pose), np.zeros(1))
        for each in self._around:
            each.required = each.clearance.required(start.q, each.base(begin))
            if each.target is not None:
                # The body that grasps comes as near as the grasp has it.
                hand, solids = robot.description.frames[link][0], each.geometry.solids
                each.of_hand[:] = [solids[i].body == hand for i, _ in each.geometry.pairs]
                at = base_for_hand(robot, link, start.q, each.target.grapple_in_target)
                grasp = each.geometry.poses(shape, _poses(at))
                for pair in np.flatnonzero(each.of_hand).tolist():
                    grasped = float(each.geometry.distances(pair, grasp)[0]) / 2
                    each.required[pair] = min(each.required[pair], grasped)

    def require_end(self, shape: Array, pose: Array) -> None:
        """Reject a goal, given by a shape (n,) and a base pose (7,), at which links are too
        close."""
        for each in self._around:
            each.clearance.require_shape(shape, each.required, _poses(pose))

    def _pair(self, number: int) -> tuple[_Surroundings, int]:
        """Return the surroundings of a pair, and its number there."""
        around = next(each for each in reversed(self._around) if each.first <= number)
        return around, number - around.first

    # -- rows of the program ------------------------------------------------------------------

    def _derived_rows(self, number: int) -> ConstraintBlock:
        around, pair = self._pair(number)
        center_of_mass = self._robot.function("center_of_mass", compile=False)
        distance = support_distance(around.geometry, pair, center_of_mass)
        return pair_block(self._robot.n, distance)

    def _along(self, knots: ThrustKnots) -> _Samples:
        """Return a path at the instants (N K,) at which pairs are kept apart."""
        N, h = len(knots.levels), knots.step
        tau = np.tile(np.arange(1, INSTANTS + 1) / INSTANTS, N)[:, np.newaxis]
        k = np.repeat(np.arange(N), INSTANTS)
        # A copy, whose parts are views.
        states = (1 - tau) * knots.states[k] + tau * knots.states[k + 1]
        X, _, r, _, q, _ = state_parts(states)
        X /= np.linalg.norm(X, axis=1, keepdims=True)
        _, _, r_0, V, q_0, v = state_parts(knots.states)
        q[:] = q_0[k] + h * (tau * v[k] + tau**2 / 2 * (v[k + 1] - v[k]))
        r[:] = r_0[k] + h * (tau * V[k] + tau**2 / 2 * (V[k + 1] - V[k]))
        return _Samples(q, base_poses(self._robot, states), (k + tau[:, 0]) * h)

    def distances(self, number: int, knots: ThrustKnots) -> Array:
        """Return the distances (N K,) of a pair at these instants, m."""
        around, pair = self._pair(number)
        return around.geometry.distances(pair, around.poses(self._along(knots)))

    def room(self, knots: ThrustKnots, pairs: Collection[int] | None = None) -> float:
        """Return the smallest difference between actual and required distance along a path, m, for
        obstacles, the target and some other pairs (None: all).
        """
        path, least = self._along(knots), np.inf
        for around in self._around:
            required = around.required.copy()
            if pairs is not None:
                numbers = around.first + np.arange(len(required))
                counted = around.geometry.with_obstacles | np.isin(numbers, list(pairs))
                required[~counted] = -np.inf
            found, _ = around.geometry.nearest_along(path.shapes, around.base(path), required)
            least = min(least, float(found.min()))
        return least

    def keep(self, near: Sequence[Approach], knots: ThrustKnots) -> None:
        """Keep more pairs apart: at the instants of a path at which they are closer than the size
        of the first solid, and around their approaches in an exactly integrated motion. Pairs that
        are already kept apart are given the missing room.
        """
        for approach in near:
            around, pair = self._pair(approach.pair)
            first = around.geometry.solids[around.geometry.pairs[pair][0]]
            reach = around.required[pair] + first.enclosure.bounding_radius
            places = self.distances(approach.pair, knots) < reach
            place = int(approach.tick / EXACT_STEPS * INSTANTS) - 1
            places[max(place, 0) : place + 2] = True
            room, known = self._kept.get(approach.pair, (None, False))
            lack = float(around.required[pair]) - approach.distance
            more = _ROOM if room is None else room + lack + _ROOM
            self._kept[approach.pair] = more, places | known

    def keep_none(self) -> None:
        """Keep no pairs apart."""
        self._kept = {}

    @property
    def kept(self) -> KeptPlaces:
        """The pairs that are kept apart, and their places."""
        numbers = sorted(self._kept)
        return tuple((k, tuple(np.flatnonzero(self._kept[k][1]).tolist())) for k in numbers)

    def planes(self, knots: ThrustKnots) -> Array:
        """Return the planes (R, 8) of the pairs that are kept apart along a path."""
        path = self._along(knots)
        found, last = [np.zeros((0, 8))], len(path.times) - INSTANTS
        for number, places in self.kept:
            at = np.array(places)
            around, pair = self._pair(number)
            planes = around.planes(pair, path, at)
            at_ends = (at < INSTANTS) | (at >= last)
            wanted = around.required[pair] + np.where(at_ends, 0.0, self._kept[number][0])
            if around.of_hand[pair]:
                # Boxes around the hand would touch before it does.
                wanted[at >= last] = -np.inf
            planes[:, 3] += np.maximum(wanted, -_NO_DISTANCE)
            found.append(np.column_stack([planes, (at % INSTANTS + 1) / INSTANTS]))
        return np.vstack(found)

    # -- the exact check ----------------------------------------------------------------------

    def approaches(self, motion: ThrustMotion) -> list[Approach]:
        """Return the pairs that come too close in a motion, nearest first."""
        shapes, base = motion.path()
        path = _Samples(shapes, base, np.linspace(0.0, motion.duration, len(shapes)))
        found: list[Approach] = []
        for around in self._around:
            for each in around.clearance.approaches(shapes, around.required, around.base(path)):
                place = each.place_on_obstacle if around.target is None else None
                found.append(replace(each, pair=each.pair + around.first, place_on_obstacle=place))
        return sorted(found, key=lambda each: each.distance)

    def is_in_the_way(self, near: Sequence[Approach]) -> bool:
        """Whether an obstacle or the target is among the pairs."""
        pairs = [self._pair(each.pair) for each in near]
        return any(around.geometry.with_obstacles[pair] for around, pair in pairs)

    def reason(self, approach: Approach) -> str:
        """Return a clause that describes a motion that is not clear."""
        around, _ = self._pair(approach.pair)
        return f"no clear motion was found: {around.clearance.clause(approach, None)}"


def _poses(pose: Array) -> BasePoses:
    return BasePoses(pose[np.newaxis, :3], pose[np.newaxis, 3:])
