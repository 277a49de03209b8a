"""What may come too near in a motion under thrust: links, obstacles, and a target that tumbles.

Seen from a target its body is an obstacle that rests. So the exact check is that of obstacles, with
the base relative to the target; a plane between a link and the target is turned into W where the
target is at that time.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from spacerobot_ros.collision import Approach, BasePoses, CollisionGeometry
from spacerobot_ros.collision.planes import support_distance
from spacerobot_ros.errors import PlanningError, sentence_case
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.rotations import (
    compose_poses,
    matrices_from_quaternions,
    quaternion_inverse,
    quaternion_multiply,
    relative_pose,
)
from spacerobot_ros.planning.core.clearance import Clearance
from spacerobot_ros.planning.core.goal import end_effector_pose
from spacerobot_ros.planning.methods.optimal.transcription import ConstraintBlock
from spacerobot_ros.planning.methods.thrust.goals import Grapple
from spacerobot_ros.planning.methods.thrust.motion import ThrustMotion
from spacerobot_ros.planning.methods.thrust.solver import ThrustKnots
from spacerobot_ros.planning.methods.thrust.transcription import EXACT_STEPS, pair_block

INSTANTS = 2
"""Instants of an interval at which pairs are kept apart."""

KeptPlaces = tuple[tuple[int, tuple[int, ...]], ...]
"""Pairs that are kept apart, and the instants at which they are."""

_CONTACT_MARGIN = 1e-3
"""How much nearer than in the grasp the end-effector's body may come to the target, m."""


class Bodies:
    """The pairs of solids of one motion: those of a robot and its obstacles, then those of a robot
    and a target.

    Parameters
    ----------
    robot
        The model.
    clearance
        The distances of links and obstacles; None: they are not looked at.
    grapple
        The target, whose grapple frame ``link`` meets; None: there is none.
    """

    def __init__(
        self, robot: SpaceRobot, clearance: Clearance | None, link: str, grapple: Grapple | None
    ) -> None:
        self._robot, self._link = robot, link
        self._own, self._target, self._grapple = clearance, None, grapple
        if grapple is not None and grapple.description is not None and grapple.clearance > 0:
            self._target = Clearance(
                replace(robot.description, world=grapple.description),
                grapple.clearance,
                "target.clearance",
                obstacles_alone=True,
            )
        self._count = 0 if clearance is None else len(clearance.geometry.pairs)
        self.required = np.zeros(0)
        """Distances (P,) of all pairs, m."""

    def begin(self, shape: Array, pose: Array) -> None:
        """Require the distances of a motion from a shape (n,) and a pose (7,) of the base on.

        Raises
        ------
        PlanningError
            The start is too near, or the robot touches the target.
        """
        base = BasePoses(pose[np.newaxis, :3], pose[np.newaxis, 3:])
        required = [np.zeros(0)]
        if self._own is not None:
            required.append(self._own.required(shape, base if self._own.has_obstacles else None))
        if self._target is not None:
            required.append(self._target_distances(self._target, shape, base))
        self.required = np.concatenate(required)

    def _target_distances(self, target: Clearance, shape: Array, base: BasePoses) -> Array:
        geometry = target.geometry
        poses = geometry.poses(shape[np.newaxis], self._seen_from_target(base, np.zeros(1)))
        for pair in np.flatnonzero(geometry.lower_bounds(poses)[0] <= 0).tolist():
            if geometry.distances(pair, poses)[0] <= 0:
                first, second = geometry.links_of(pair)
                raise PlanningError(
                    f"{sentence_case('link')} '{first}' touches '{second}' of the target at the "
                    "start: move the robot away from it first."
                )
        required = target.required(shape, self._seen_from_target(base, np.zeros(1)))
        # The body that grasps comes as near as the grasp has it.
        at = compose_poses(self._grapple_in_target, self._base_from_hand(shape))
        poses = geometry.poses(shape[np.newaxis], BasePoses(at[np.newaxis, :3], at[np.newaxis, 3:]))
        for pair in self._of_hand(geometry):
            grasped = float(geometry.distances(pair, poses)[0]) - _CONTACT_MARGIN
            required[pair] = min(required[pair], grasped)
        return required

    def _of_hand(self, geometry: CollisionGeometry) -> list[int]:
        hand = self._robot.description.frames[self._link][0]
        return [k for k, (i, _) in enumerate(geometry.pairs) if geometry.solids[i].body == hand]

    def _base_from_hand(self, shape: Array) -> Array:
        still = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
        hand = np.concatenate(
            end_effector_pose(self._robot, self._link, still[:3], still[3:], shape)
        )
        return relative_pose(hand, still)

    @property
    def _grapple_in_target(self) -> Array:
        assert self._grapple is not None
        return self._grapple.motion.grapple_in_target

    def _seen_from_target(self, base: BasePoses, times: Array) -> BasePoses:
        """Return poses of the base relative to the target at times (K,) since the start, s."""
        assert self._grapple is not None
        X_WT, r_WT = self._grapple.motion.body_poses(times)
        R_TW = np.swapaxes(matrices_from_quaternions(X_WT), 1, 2)
        r_TB = np.einsum("kij,kj->ki", R_TW, base.position - r_WT)
        return BasePoses(r_TB, quaternion_multiply(quaternion_inverse(X_WT), base.quaternion))

    def require_end(self, shape: Array, pose: Array) -> None:
        """Refuse a goal, a shape (n,) and a pose (7,) of the base, where links are too near."""
        own = self._own
        if own is not None:
            base = BasePoses(pose[np.newaxis, :3], pose[np.newaxis, 3:])
            required = self.required[: self._count]
            own.require_shape(shape, required, base if own.has_obstacles else None)

    # -- rows of the program ------------------------------------------------------------------

    def _pair(self, number: int) -> tuple[CollisionGeometry, int, bool]:
        """Return the geometry of a pair, its number there, and whether it is of the target."""
        clearance = self._own if number < self._count else self._target
        assert clearance is not None
        of_target = clearance is self._target
        return clearance.geometry, number - of_target * self._count, of_target

    def row_key(self, number: int) -> tuple[int, int]:
        """Return what the rows of a pair depend on: both solids, or that before any obstacle."""
        geometry, pair, _ = self._pair(number)
        first, second = geometry.pairs[pair].tolist()
        return first, -1 if geometry.with_obstacles[pair] else second

    def rows(self, number: int) -> ConstraintBlock:
        """Derive the rows of a pair."""
        geometry, pair, _ = self._pair(number)
        center_of_mass = self._robot.function("center_of_mass", compile=False)
        return pair_block(self._robot.n, support_distance(geometry, pair, center_of_mass))

    def base_poses(self, shapes: Array, X: Array, r_WC: Array) -> BasePoses:
        """Return the poses of the base from those of the centre of mass (K, ...)."""
        c = self._robot.function("center_of_mass")(shapes.T).full().T
        return BasePoses(r_WC - np.einsum("kij,kj->ki", matrices_from_quaternions(X), c), X)

    def along(self, knots: ThrustKnots) -> tuple[Array, BasePoses, Array]:
        """Return shapes, poses of the base and times from 0 to 1 in their intervals (N K,) at the
        instants at which pairs are kept apart.
        """
        N, h, K = len(knots.levels), knots.step, INSTANTS
        tau = np.tile(np.arange(1, K + 1) / K, N)[:, np.newaxis]
        k = np.repeat(np.arange(N), K)
        q, v, V = knots.shapes, knots.velocities, knots.v_WC
        shapes = q[k] + h * (tau * v[k] + tau**2 / 2 * (v[k + 1] - v[k]))
        X = (1 - tau) * knots.quaternions[k] + tau * knots.quaternions[k + 1]
        X /= np.linalg.norm(X, axis=1, keepdims=True)
        r = knots.r_WC[k] + h * (tau * V[k] + tau**2 / 2 * (V[k + 1] - V[k]))
        return shapes, self.base_poses(shapes, X, r), tau

    def distances(self, number: int, knots: ThrustKnots) -> Array:
        """Return the distances (N K,) of a pair at these instants, m."""
        geometry, pair, of_target = self._pair(number)
        shapes, base, tau = self.along(knots)
        if of_target:
            base = self._seen_from_target(base, _times(knots, tau))
        return geometry.distances(pair, geometry.poses(shapes, base))

    def places(self, approach: Approach, knots: ThrustKnots) -> set[int]:
        """Return the instants of a path at which a pair is near, by the size of its first solid,
        and those around its approach in an exactly integrated motion.
        """
        geometry, pair, _ = self._pair(approach.pair)
        reach = geometry.solids[geometry.pairs[pair][0]].enclosure.bounding_radius
        near = self.distances(approach.pair, knots) < self.required[approach.pair] + reach
        place = int(approach.tick / EXACT_STEPS * INSTANTS) - 1
        near[max(place, 0) : place + 2] = True
        return set(np.flatnonzero(near).tolist())

    def planes(self, kept: KeptPlaces, room: Mapping[int, float], knots: ThrustKnots) -> Array:
        """Return the planes (R, 8) of pairs along a path, with the room of each, m."""
        shapes, base, tau = self.along(knots)
        found = []
        at_end = np.arange(len(tau)) >= len(tau) - INSTANTS
        at_start = np.arange(len(tau)) < INSTANTS
        for number, places in kept:
            at = list(places)
            geometry, pair, of_target = self._pair(number)
            seen = self._seen_from_target(base, _times(knots, tau)) if of_target else base
            R, r = geometry.poses(shapes, seen)
            _, planes = geometry.planes(pair, (R[at], r[at]))
            if of_target:
                planes = self._in_world(planes, _times(knots, tau)[at])
            required = self.required[number]
            wanted = np.where(at_end | at_start, required, required + room[number])
            if of_target and pair in self._of_hand(geometry):
                # Boxes around the hand would touch before it does.
                wanted[at_end] = -np.inf
            planes[:, 3] += np.maximum(wanted[at], -_NO_DISTANCE)
            found.append(np.hstack([planes, tau[at]]))
        return np.vstack(found)

    def _in_world(self, planes: Array, times: Array) -> Array:
        assert self._grapple is not None
        X_WT, r_WT = self._grapple.motion.body_poses(times)
        normal = np.einsum("kij,kj->ki", matrices_from_quaternions(X_WT), planes[:, :3])
        offset = planes[:, 3:4] + np.sum(normal * r_WT, axis=1, keepdims=True)
        return np.hstack([normal, offset, planes[:, 4:]])

    # -- the exact check ----------------------------------------------------------------------

    def approaches(self, motion: ThrustMotion) -> list[Approach]:
        """Return the pairs that come too near in a motion, nearest first."""
        shapes, base = motion.path()
        own = self._own
        found: list[Approach] = []
        if own is not None:
            required = self.required[: self._count]
            found += own.approaches(shapes, required, base if own.has_obstacles else None)
        if self._target is not None:
            times = np.linspace(0.0, motion.duration, len(shapes))
            seen = self._seen_from_target(base, times)
            for each in self._target.approaches(shapes, self.required[self._count :], seen):
                number = each.pair + self._count
                found.append(replace(each, pair=number, place_on_obstacle=None))
        return sorted(found, key=lambda each: each.distance)

    def obstacles(self) -> list[int]:
        """Return the numbers of pairs of a link and an obstacle or the target."""
        own: list[int] = []
        if self._own is not None:
            own = np.flatnonzero(self._own.geometry.with_obstacles).tolist()
        return [*own, *range(self._count, len(self.required))]

    def is_in_the_way(self, near: Sequence[Approach]) -> bool:
        """Whether an obstacle or the target is among pairs."""
        return any(each.place_on_obstacle is not None or each.pair >= self._count for each in near)

    def reason(self, approach: Approach) -> str:
        """Return a clause about a motion that is not clear."""
        clearance = self._own if approach.pair < self._count else self._target
        assert clearance is not None
        return f"no clear motion was found: {clearance.clause(approach, None)}"


_NO_DISTANCE = 1e3
"""m; rows of a plane that is as far away hold always."""


def _times(knots: ThrustKnots, tau: Array) -> Array:
    """Return the times (N K,) of instants, s."""
    k = np.repeat(np.arange(len(knots.levels)), INSTANTS)
    return np.asarray((k + tau[:, 0]) * knots.step)
