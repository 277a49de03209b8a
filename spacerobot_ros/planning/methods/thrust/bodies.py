"""Bodies that may come too close in a motion under thrust: links, obstacles, and a tumbling target.

Relative to a target frame, the target body is an obstacle at rest. So the exact check for obstacles
is used, with the base pose relative to the target; a plane between a link and the target is
transformed to W by the target pose at that time. The corridor of an approach is one more pair: the
end-effector and a cone that moves with the target.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import casadi as ca
import numpy as np
import numpy.typing as npt

from spacerobot_ros.collision import Approach, BasePoses
from spacerobot_ros.collision.geometry import LinkPair, Poses
from spacerobot_ros.collision.planes import PLANE_SIZE, support_distance
from spacerobot_ros.errors import PlanningError, quantity
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.grasp import RobotMotion
from spacerobot_ros.model.rotations import (
    matrices_from_quaternions,
    quaternion_inverse,
    quaternion_multiply,
)
from spacerobot_ros.model.symbolic_rotations import matrix_from_quaternion
from spacerobot_ros.model.target_motion import TorqueFreeMotion
from spacerobot_ros.planning.core.clearance import Clearance
from spacerobot_ros.planning.core.goal import end_effector_pose
from spacerobot_ros.planning.methods.optimal.problem import Trajectory
from spacerobot_ros.planning.methods.optimal.transcription import ConstraintBlock
from spacerobot_ros.planning.methods.thrust.problem import (
    EXACT_STEPS,
    Grapple,
    Samples,
    ThrustKnots,
    ThrustMotion,
    base_for_hand,
    base_poses,
    state_parts,
)
from spacerobot_ros.planning.methods.thrust.transcription import INSTANTS, KeptPlaces, pair_block

_ROOM = 4e-3
"""Distance, m, in excess of the required distance at these instants, because paths bend between the
instants."""

_NO_DISTANCE = 1e3
"""m; rows for a plane this far away are always satisfied."""

_CORRIDOR_RADIUS, _CORRIDOR_ROOM, _CORRIDOR_ROUNDING, _CORRIDOR_RESOLUTION = 0.02, 0.01, 1e-3, 5e-4
"""Radius of a corridor at its fixture, distance from its surface at these instants, length over
which its axis is smoothed, and largest motion between two checks, m."""

_LEAST_SLOPE = 1e-3
"""Least sine of the half-angle of a corridor, because its direction is scaled by it."""


class _Surroundings:
    """The distances of links and of obstacles that rest in W or, if there is one, on a target."""

    def __init__(self, clearance: Clearance, target: TorqueFreeMotion | None = None) -> None:
        self.clearance, self.target, self.geometry = clearance, target, clearance.geometry
        self.of_hand = np.zeros(len(self.geometry.pairs), dtype=bool)
        """Whether each pair (P,) consists of the grasping body and the target."""
        self.required = np.zeros(0)
        """Distances (P,), m."""

    def base(self, path: Samples) -> BasePoses:
        """Return the base poses in the frame in which the obstacles are at rest."""
        if self.target is None:
            return path.base
        X_WT, r_WT = self.target.body_poses(path.times)
        R_WT = matrices_from_quaternions(X_WT)
        r_TB = np.einsum("kji,kj->ki", R_WT, path.base.position - r_WT)
        return BasePoses(r_TB, quaternion_multiply(quaternion_inverse(X_WT), path.base.quaternion))

    def poses(self, path: Samples) -> Poses:
        return self.geometry.poses(path.shapes, self.base(path))

    def distance_function(self, pair: int, center_of_mass: ca.Function) -> ca.Function:
        return support_distance(self.geometry, pair, center_of_mass)

    def distances(self, pair: int, path: Samples) -> Array:
        return self.geometry.distances(pair, self.poses(path))

    def is_near(self, pair: int, path: Samples) -> npt.NDArray[np.bool_]:
        """Return at which instants (K,) a pair on a path is closer than its first solid's size."""
        first = self.geometry.solids[self.geometry.pairs[pair][0]]
        reach = self.required[pair] + first.enclosure.bounding_radius
        return np.asarray(self.distances(pair, path) < reach)

    def room(self, path: Samples) -> float:
        required = np.where(self.geometry.with_obstacles, self.required, -np.inf)
        return float(self.geometry.nearest_at(self.poses(path), required)[0].min())

    def approaches(self, path: Samples) -> list[Approach]:
        found = self.clearance.approaches(path.shapes, self.required, self.base(path))
        return found if self.target is None else [replace(e, place_on_obstacle=None) for e in found]

    def clause(self, approach: Approach) -> str:
        return self.clearance.clause(approach, None)

    def planes(self, pair: int, path: Samples, at: npt.NDArray[np.int64]) -> Array:
        """Return planes (K, 7) of a pair at instants (K,) of a path; obstacle planes are in W."""
        R, r = self.poses(path)
        _, planes = self.geometry.planes(pair, (R[at], r[at]))
        if self.target is not None and self.geometry.with_obstacles[pair]:
            X_WT, r_WT = self.target.body_poses(path.times[at])
            normal = np.einsum("kij,kj->ki", matrices_from_quaternions(X_WT), planes[:, :3])
            planes[:, 3] += np.sum(normal * r_WT, axis=1)
            planes[:, :3] = normal
        return planes


class _Corridor:
    """The cone through which an end-effector approaches the grapple frame of a target, within some
    distance of it; its axis is the direction of the standoff.

    It is one pair, whose distance is that of the end-effector origin from the surface of the cone
    or, if that is more, from the sphere in which the cone counts; negative: it is outside the cone.
    """

    def __init__(self, robot: SpaceRobot, link: str, grapple: Grapple, start: Samples) -> None:
        self._robot, self._link, self._grapple = robot, link, grapple
        self._slope = max(float(np.sin(grapple.corridor_angle)), _LEAST_SLOPE)
        self._length, self.of_hand = grapple.corridor_length, np.zeros(1, dtype=bool)
        # A start a little beside it need not come nearer.
        self.required = np.minimum(self.distances(0, start), 0.0)
        if self.required[0] < -_CORRIDOR_RADIUS:
            raise PlanningError(
                f"At the start, {self._beside(self.required[0])}: move the robot away from the "
                "target first."
            )

    def distance_function(self, _pair: int, center_of_mass: ca.Function) -> ca.Function:
        """Return ``([q; X; r], [s; wanted; apex]) -> d``, m, of the base rotation and the centre of
        mass: as :func:`.support_distance`, with a cone in place of a plane. The length of its axis
        s is the sine of its half-angle; a half-angle of 90 deg is a plane.
        """
        n = self._robot.n
        y, cone = ca.SX.sym("y", n + 7), ca.SX.sym("cone", PLANE_SIZE)
        (q, X, r), axis = ca.vertsplit(y, [0, n, n + 4, n + 7]), cone[:3]
        at = self._robot.link_names.index(self._link)
        e = self._robot.function("link_poses", compile=False)(q)[1][:, at] - center_of_mass(q)
        from_apex = r + matrix_from_quaternion(X / ca.norm_2(X)) @ e - cone[4:]
        square = ca.sumsqr(axis)
        beside = ca.sumsqr(from_apex - ca.dot(axis, from_apex) / square * axis)
        room = _CORRIDOR_RADIUS - _CORRIDOR_ROOM - ca.sqrt(beside + _CORRIDOR_ROUNDING**2)
        d = ca.dot(axis, from_apex) + ca.sqrt(ca.fmax(1 - square, 0)) * room - cone[3]
        return ca.Function("corridor", [y, cone], [d])

    def _places(self, path: Samples) -> tuple[Array, Array, Array, Array, Array]:
        """Return positions of the end-effector from the fixture, the fixture, and axes of the cone
        (K, 3); distances (K,) from the surface of the cone and from the sphere.
        """
        frame = self._grapple.motion.grapple(path.times)
        samples = zip(*path.base, path.shapes, strict=True)
        hand = [end_effector_pose(self._robot, self._link, r, X, q)[0] for r, X, q in samples]
        p, axis = np.array(hand) - frame.r, frame.R @ self._grapple.standoff
        axis /= np.maximum(np.linalg.norm(axis, axis=1, keepdims=True), 1e-9)
        along = np.sum(p * axis, axis=1, keepdims=True)
        beside = np.hypot(np.linalg.norm(p - along * axis, axis=1), _CORRIDOR_ROUNDING)
        inside = self._slope * along[:, 0]
        inside += np.sqrt(1 - self._slope**2) * (_CORRIDOR_RADIUS - beside)
        return p, frame.r, axis, inside, np.linalg.norm(p, axis=1) - self._length

    def planes(self, _pair: int, path: Samples, at: npt.NDArray[np.int64]) -> Array:
        """Return cones (K, 7) at instants (K,) of a path or, where it is nearer to the outside of
        the sphere than to the cone, planes that touch the sphere."""
        p, apex, axis, inside, outside = self._places(path)
        within = inside >= outside
        # Also at the instant before: between the two, the sphere is entered within the cone.
        within |= np.append(within[1:], True)
        normal = p / np.maximum(np.linalg.norm(p, axis=1, keepdims=True), 1e-9)
        chosen = within[:, np.newaxis]
        offset = np.where(chosen, 0.0, self._length + _CORRIDOR_ROOM)
        return np.hstack([np.where(chosen, self._slope * axis, normal), offset, apex])[at]

    def distances(self, _pair: int, path: Samples) -> Array:
        *_, inside, outside = self._places(path)
        return np.maximum(inside, outside)

    def is_near(self, _pair: int, path: Samples) -> npt.NDArray[np.bool_]:
        """Return at which instants (K,) of a path an end-effector is near or inside the sphere."""
        return np.asarray(self._places(path)[-1] < 0.1 * self._length)

    def approaches(self, path: Samples) -> list[Approach]:
        """Return where the end-effector is farthest outside, if it is outside; this includes its
        motion between the instants of a path.
        """
        ticks = np.arange(len(path.times), dtype=float)
        while True:
            here = path.at(ticks)
            distances, hand = self.distances(0, here), self._places(here)[0]
            k = int(np.argmin(distances))
            moved = np.linalg.norm(np.diff(hand, axis=0), axis=1)
            least = (distances[:-1] + distances[1:] - moved) / 2
            open_ = (least < self.required[0]) & (moved > _CORRIDOR_RESOLUTION)
            if distances[k] < self.required[0]:
                links = LinkPair(self._link, self._link)
                return [Approach(links, 0, float(distances[k]), float(ticks[k]), here.shapes[k])]
            if not open_.any():
                return []
            ticks = np.sort(np.append(ticks, (ticks[:-1] + ticks[1:])[open_] / 2))

    def clause(self, approach: Approach) -> str:
        return f"{self._beside(approach.distance)}; widen the corridor or shorten it"

    def _beside(self, distance: float) -> str:
        angle, length = self._grapple.corridor_angle, self._length
        return (
            f"'{self._link}' is {quantity(-distance, 'm')} outside its corridor, with "
            f"target.corridor_angle = {angle:g} rad and target.corridor_length = {length:g} m"
        )


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
        begin = Samples(start.q[np.newaxis], _poses(start.pose), np.zeros(1))
        self._solid = [] if clearance is None else [_Surroundings(clearance)]
        if grapple is not None and grapple.description is not None and grapple.clearance > 0:
            among = replace(robot.description, world=grapple.description)
            distance, name = grapple.clearance, "target.clearance"
            kept = Clearance(among, distance, name, obstacles_alone=True)
            self._solid.append(_Surroundings(kept, grapple.motion))
        for each in self._solid:
            each.required = each.clearance.required(start.q, each.base(begin))
            if each.target is not None:
                # The grasping body comes as close as the grasp requires.
                hand, solids = robot.description.frames[link][0], each.geometry.solids
                each.of_hand[:] = [solids[i].body == hand for i, _ in each.geometry.pairs]
                at = base_for_hand(robot, link, start.q, each.target.grapple_in_target)
                grasp = each.geometry.poses(begin.shapes, _poses(at))
                for pair in np.flatnonzero(each.of_hand).tolist():
                    grasped = float(each.geometry.distances(pair, grasp)[0]) / 2
                    each.required[pair] = min(each.required[pair], grasped)
        self._around: list[_Surroundings | _Corridor] = [*self._solid]
        if grapple is not None and grapple.corridor_length > 0:
            self._around.append(_Corridor(robot, link, grapple, begin))
        self._pairs = [(each, k) for each in self._around for k in range(len(each.required))]
        """Surroundings of each pair, and its number there."""
        center_of_mass = robot.function("center_of_mass", compile=False)
        pairs = self._pairs

        @cache
        def rows(number: int) -> ConstraintBlock:
            around, pair = pairs[number]
            return pair_block(robot.n, around.distance_function(pair, center_of_mass))

        self.rows = rows
        """Returns the rows of a pair with a given number."""
        self._kept: dict[int, tuple[float, npt.NDArray[np.bool_]]] = {}
        """Room of the pairs that are kept apart, m, and whether each is kept apart at each instant
        (N K,)."""

    def require_end(self, shape: Array, pose: Array) -> None:
        """Reject a goal, given by a shape (n,) and a base pose (7,), at which links are too
        close."""
        for each in self._solid:
            each.clearance.require_shape(shape, each.required, _poses(pose))

    # -- rows of the program ------------------------------------------------------------------

    def _along(self, knots: ThrustKnots) -> Samples:
        """Return a path at the instants (N K,) at which pairs are kept apart."""
        X, _, r, V, q, v = state_parts(knots.states)
        path = Trajectory(knots.step, np.hstack([q, r]), np.hstack([v, V]), X)
        places, X = path.within_intervals(INSTANTS)
        q, r = np.split(places, [self._robot.n], axis=1)
        times = np.linspace(0.0, knots.duration, len(X) + 1)[1:]
        return Samples(q, base_poses(self._robot, X, r, q), times)

    def distances(self, number: int, knots: ThrustKnots) -> Array:
        """Return the distances (N K,) of a pair at these instants, m."""
        around, pair = self._pairs[number]
        return around.distances(pair, self._along(knots))

    def room(self, knots: ThrustKnots) -> float:
        """Return the smallest difference between the actual and the required distance of obstacles
        and the target along a path, m.
        """
        path = self._along(knots)
        return min((each.room(path) for each in self._solid), default=np.inf)

    def keep(self, near: Sequence[Approach], knots: ThrustKnots) -> None:
        """Keep more pairs apart: at the instants of a path at which they are closer than the size
        of the first solid, and around their approaches in an exactly integrated motion. Pairs that
        are already kept apart are given the missing room.
        """
        path = self._along(knots)
        for approach in near:
            around, pair = self._pairs[approach.pair]
            places = around.is_near(pair, path)
            place = int(approach.tick / EXACT_STEPS * INSTANTS) - 1
            places[max(place, 0) : place + 2] = True
            room, known = self._kept.get(approach.pair, (None, False))
            lack = float(around.required[pair]) - approach.distance
            more = _ROOM if room is None else room + lack + _ROOM
            if isinstance(around, _Corridor):
                # Its rows have room; what a path misses says little of how far to make others.
                more = 0.0 if room is None else room + min(lack, _ROOM) + _ROOM
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
            around, pair = self._pairs[number]
            planes = around.planes(pair, path, at)
            at_ends = (at < INSTANTS) | (at >= last)
            wanted = around.required[pair] + np.where(at_ends, 0.0, self._kept[number][0])
            if around.of_hand[pair]:
                # At the grasp, the boxes around the hand touch.
                wanted[at > last] = -np.inf
            planes[:, 3] += np.maximum(wanted, -_NO_DISTANCE)
            found.append(np.column_stack([planes, (at % INSTANTS + 1) / INSTANTS]))
        return np.vstack(found)

    # -- the exact check ----------------------------------------------------------------------

    def approaches(self, motion: ThrustMotion) -> list[Approach]:
        """Return the pairs that come too close in a motion, nearest first."""
        path = motion.path()
        found = list[Approach]()
        for around in self._around:
            near = around.approaches(path)
            found += [replace(e, pair=self._pairs.index((around, e.pair))) for e in near]
        return sorted(found, key=lambda each: each.distance)

    def reason(self, approach: Approach) -> str:
        """Return a clause that describes a motion that is not clear."""
        around, _ = self._pairs[approach.pair]
        return f"no clear motion was found: {around.clause(approach)}"


def _poses(pose: Array) -> BasePoses:
    return BasePoses(pose[np.newaxis, :3], pose[np.newaxis, 3:])
