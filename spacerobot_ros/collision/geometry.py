"""Collision geometry: pairs of solids that may come into contact, and their nearest approaches.

A pair is omitted if its solids belong to one body or to neighbouring bodies, if an SRDF disables
it, or if its solids touch in all of 1000 random configurations (a modelling artefact).

While a command is held, two solids move relative to each other by at most v per tick
(``CollisionGeometry.largest_lever_arms``). So their distance during the tick is at least
``(d_0 + d_1 - v) / 2``, where d_0 and d_1 are the distances at the ends of the tick. Ticks for
which this bound is below the clearance are bisected until v is small. For obstacles, the base
motion also matters: within a tick, the base moves along a straight line and rotates about one axis.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from spacerobot_ros.collision.distances import (
    WORLD_BODY,
    DistanceFunction,
    Solid,
    distance_function,
    nearest_points,
    solids_of,
    unread_mesh_notes,
)
from spacerobot_ros.errors import numbers, quantity
from spacerobot_ros.model.description import Array, Joint, JointKind, Pose, RobotDescription, Shape
from spacerobot_ros.model.kinematics import ForwardKinematics
from spacerobot_ros.model.meshes import TriangleMesh, shape_mesh
from spacerobot_ros.model.rotations import matrices_from_quaternions

_SHAPES, _SEED = 1000, 0
"""Number and seed of the random configurations used to find pairs that are always in contact."""

_COAXIAL_TOLERANCE = 1e-9
"""Largest offset (m) and tilt (rad) of a body of revolution from its joint axis."""

_UNKNOWN_BASE_DISTANCE = 1e9
"""Distance to obstacles if the base pose is unknown, m; large, so that obstacles are ignored."""

_MOTION_RESOLUTION = 5e-4
"""Largest relative motion of a pair between two evaluations of its distance, m."""


class LinkPair(NamedTuple):
    """Names of two links."""

    first: str
    second: str

    def __str__(self) -> str:
        return f"'{self.first}' and '{self.second}'"

    @property
    def subject(self) -> str:
        """Both names, worded as the subject of a sentence, in lower case."""
        return f"links {self}"


class ObstaclePair(LinkPair):
    """Names of a robot link and an obstacle (a link of the world)."""

    __slots__ = ()

    @property
    def subject(self) -> str:
        """Both names, worded as the subject of a sentence, in lower case."""
        return f"link '{self.first}' and obstacle '{self.second}'"


class BasePoses(NamedTuple):
    """Base poses in the world: ``r_WB`` (N, 3), m, and quaternions (N, 4) of ``R_WB``."""

    position: Array
    quaternion: Array

    def rows(self, rows: npt.NDArray[np.int64] | slice) -> BasePoses:
        """Return the selected poses."""
        return BasePoses(self.position[rows], self.quaternion[rows])

    def between(self, before: npt.NDArray[np.int64], share: Array) -> BasePoses:
        """Return poses (K,) at shares (K, 1) of the way from poses ``before`` to the next ones."""
        r, x = self
        position = (1 - share) * r[before] + share * r[before + 1]
        next_ = (
            x[before + 1] * np.where(np.sum(x[before] * x[before + 1], axis=1) < 0, -1, 1)[:, None]
        )
        quaternion = (1 - share) * x[before] + share * next_
        return BasePoses(position, quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True))


Poses = tuple[Array, Array]
"""Attitudes ``R_BL`` (N, L, 3, 3) and positions ``r_BL_B`` (N, L, 3) of robot links; if there are
obstacles, the last entry is the world."""


class CollisionGeometry:
    """Solids of a robot and of the obstacles around it, and the distances between them.

    Parameters
    ----------
    robot
        The robot, with its world.
    mesh_of
        Returns the triangles of a ``mesh`` visual in its link frame; if this raises a
        :class:`.MeshError`, the mesh is omitted.
    obstacles_alone
        Whether to omit pairs of two robot links.

    Attributes
    ----------
    solids
        All solids, link by link.
    pairs
        (P, 2) indices of the solids in each checked pair.
    ignored_pairs
        Reason why a pair of links is ignored, unless on the same body or on neighbouring bodies.
    notes
        Notes on links whose geometry may be unexpected, one sentence each.
    unread_meshes
        Meshes that are omitted.
    """

    def __init__(
        self,
        robot: RobotDescription,
        mesh_of: Callable[[Shape], TriangleMesh] = shape_mesh,
        *,
        obstacles_alone: bool = False,
    ) -> None:
        self.robot = robot
        self._kinematics = ForwardKinematics(robot)
        self.solids, self.notes, self.unread_meshes = solids_of(robot, mesh_of)
        if robot.world is not None:
            obstacles, notes, unread = solids_of(robot.world, mesh_of)
            frames = robot.world.frames
            self.solids += tuple(_solid_in_world(each, frames[each.link][1]) for each in obstacles)
            self.notes += notes
            self.unread_meshes += unread
        self.notes += tuple(unread_mesh_notes(self.unread_meshes))
        self.ignored_pairs: dict[LinkPair, str] = {}
        links = self._kinematics.links
        self._link_of = np.array(
            [len(links) if each.is_obstacle else links.index(each.link) for each in self.solids],
            dtype=int,
        )
        self._centers = np.array([each.enclosure.pose.r for each in self.solids]).reshape(-1, 3)
        self._radii = np.array([each.enclosure.bounding_radius for each in self.solids])
        self.pairs = self._distinct_pairs()
        if obstacles_alone:
            self.pairs = self.pairs[[self.solids[j].is_obstacle for _, j in self.pairs]]
            return
        contact = self._pairs_always_in_contact()
        for pair in np.flatnonzero(contact).tolist():
            self.ignored_pairs.setdefault(self.links_of(pair), "always in contact")
        self.pairs = self.pairs[~contact]

    @cached_property
    def distance_function(self) -> DistanceFunction:
        """Distances between two solids, exact if the package coal is installed."""
        # If bounding spheres never come close, the distance library need not be imported.
        return distance_function(self.solids)

    @property
    def exact(self) -> bool:
        """Whether distances are computed for the shapes, not for their enclosures."""
        return self.distance_function.exact

    @property
    def links(self) -> tuple[str, ...]:
        """Link names, in the order of :meth:`poses`."""
        return self._kinematics.links

    def links_of(self, pair: int) -> LinkPair:
        """Return the links in a pair."""
        first, second = (self.solids[i] for i in self.pairs[pair])
        kind = ObstaclePair if second.is_obstacle else LinkPair
        return kind(first.link, second.link)

    @cached_property
    def with_obstacles(self) -> npt.NDArray[np.bool_]:
        """Whether each pair (P,) consists of a link and an obstacle."""
        return np.array([self.solids[j].is_obstacle for _, j in self.pairs], dtype=np.bool_)

    def poses(self, shapes: Array, base: BasePoses | None = None) -> Poses:
        """Return the poses of all links, and of the world if there is one.

        Parameters
        ----------
        shapes
            (..., n), m or rad; with a base (N, n).
        base
            Base poses; None: obstacles are ignored.
        """
        return self.with_world(self._kinematics.link_poses(shapes), base)

    def with_world(self, links: Poses, base: BasePoses | None) -> Poses:
        """Return poses of links with that of the world appended, if there is one."""
        if self.robot.world is None:
            return links
        R, r = links
        at = r.shape[:-2]
        R_BW = np.broadcast_to(np.eye(3), (*at, 3, 3))
        r_BW = np.full((*at, 3), _UNKNOWN_BASE_DISTANCE)
        if base is not None:
            R_BW = np.swapaxes(matrices_from_quaternions(base.quaternion), 1, 2)
            r_BW = -np.einsum("nab,nb->na", R_BW, base.position)
        return (
            np.concatenate([R, R_BW[..., np.newaxis, :, :]], axis=-3),
            np.concatenate([r, r_BW[..., np.newaxis, :]], axis=-2),
        )

    def nearest_point_on_obstacle(self, pair: int, shape: Array, base: BasePoses) -> Array:
        """Return the approximate point (3,) in W, m, at which a link is nearest to an obstacle.

        ``shape`` is (n,), and ``base`` has a single pose.
        """
        R, r = self.poses(shape[np.newaxis], base)
        i, j = self.pairs[pair]
        first, second = self.solids[i].enclosure, self.solids[j].enclosure
        link, R_BW, r_BW = self._link_of[i], R[:, -1], r[:, -1]
        r_BP = nearest_points(first, R[:, link], r[:, link], second, R_BW, r_BW)
        return np.asarray(R_BW[0].T @ (r_BP - r_BW)[0])

    def lower_bounds(self, poses: Poses) -> Array:
        """Return lower bounds (N, P), m, on the distances of all pairs, from bounding spheres."""
        R, r = poses
        centers = r[:, self._link_of] + np.einsum(
            "nsab,sb->nsa", R[:, self._link_of], self._centers
        )
        first, second = self.pairs.T
        apart = np.linalg.norm(centers[:, first] - centers[:, second], axis=2)
        return np.asarray(apart - self._radii[first] - self._radii[second])

    def distances(self, pair: int, poses: Poses) -> Array:
        """Return the distances (N,) of a pair, m; negative: penetration depths."""
        R, r = poses
        i, j = self.pairs[pair]
        a, b = self._link_of[i], self._link_of[j]
        return self.distance_function(i, R[:, a], r[:, a], j, R[:, b], r[:, b])

    def planes(self, pair: int, poses: Poses) -> tuple[Array, Array]:
        """Return the distances (N,) of a pair, m, with planes and points (N, 7).

        Planes are in the first link frame, points in the second link frame
        (:meth:`.ExactDistances.planes`). For an obstacle, planes belong to it and are in W.
        """
        R, r = poses
        i, j = self.pairs[pair]
        if self.with_obstacles[pair]:
            i, j = j, i
        a, b = self._link_of[i], self._link_of[j]
        return self.distance_function.planes(i, R[:, a], r[:, a], j, R[:, b], r[:, b])

    def nearest_along(
        self,
        shapes: Array,
        base: BasePoses | None = None,
        required: Array | float = 0.0,
        most: float = np.inf,
    ) -> tuple[Array, npt.NDArray[np.int64]]:
        """Return the smallest distances (N,) for configurations (N, n), m, and their pairs (N,).

        ``required`` (P,), m, is subtracted from the distances of the pairs; a pair with minus
        infinity is ignored. ``most``, m, limits results; without base poses, obstacles are ignored.
        """
        return self.nearest_at(self.poses(shapes, base), required, most)

    def nearest_at(
        self, poses: Poses, required: Array | float = 0.0, most: float = np.inf
    ) -> tuple[Array, npt.NDArray[np.int64]]:
        """Return the smallest distances, as in :meth:`nearest_along`, given the link poses."""
        R, r = poses
        distances = np.full(len(R), most)
        pairs = np.zeros(len(R), dtype=np.int64)
        if not len(self.pairs) or not len(R):
            return distances, pairs
        required = np.broadcast_to(required, len(self.pairs))
        bounds = self.lower_bounds(poses) - required
        least = bounds.min(axis=0)
        # Pairs that may be the nearest come first, so that most others need not be checked.
        for pair in np.argsort(least, kind="stable").tolist():
            if least[pair] >= distances.max():
                break
            at = np.flatnonzero(bounds[:, pair] < distances)
            found = self.distances(pair, (R[at], r[at])) - required[pair]
            nearer = found < distances[at]
            distances[at[nearer]], pairs[at[nearer]] = found[nearer], pair
        return distances, pairs

    def keep_apart(self, poses: Poses, required: Array) -> bool:
        """Whether all pairs keep their ``required`` distances (P,), m, at all sets of poses."""
        R, r = poses
        bounds = self.lower_bounds(poses) - required
        least = bounds.min(axis=0)
        for pair in np.argsort(least, kind="stable")[: np.count_nonzero(least < 0)].tolist():
            at = np.flatnonzero(bounds[:, pair] < 0)
            if (self.distances(pair, (R[at], r[at])) < required[pair]).any():
                return False
        return True

    def links_in_contact(self, poses: Poses) -> frozenset[LinkPair]:
        """Return the pairs of links in contact at one set of poses."""
        near = np.flatnonzero(self.lower_bounds(poses)[0] <= 0).tolist()
        return frozenset(
            self.links_of(pair) for pair in near if self.distances(pair, poses)[0] <= 0
        )

    def distances_of_links(self, shape: Array) -> dict[LinkPair, float]:
        """Return the distances between links in a configuration (n,), m, smallest first."""
        poses = self.poses(shape[np.newaxis])
        found: dict[LinkPair, float] = {}
        for pair in range(len(self.pairs)):
            links, distance = self.links_of(pair), float(self.distances(pair, poses)[0])
            found[links] = min(distance, found.get(links, np.inf))
        return dict(sorted(found.items(), key=lambda each: each[1]))

    # -- pairs --------------------------------------------------------------------------------

    def _distinct_pairs(self) -> npt.NDArray[np.int64]:
        """Return pairs of solids on different bodies, not connected by a joint or disabled."""
        disabled = self.robot.disabled_collisions
        parents = [body.parent for body in self.robot.bodies]
        found = []
        for j, second in enumerate(self.solids):
            for i, first in enumerate(self.solids[:j]):
                if second.is_obstacle:
                    found += [] if first.is_obstacle else [(i, j)]
                    continue
                a, b = first.body, second.body
                if a == b or parents[a] == b or parents[b] == a:
                    continue
                if frozenset({first.link, second.link}) in disabled:
                    self.ignored_pairs[LinkPair(first.link, second.link)] = "disabled by the SRDF"
                    continue
                found.append((i, j))
        return np.array(found, dtype=np.int64).reshape(-1, 2)

    def _pairs_always_in_contact(self) -> npt.NDArray[np.bool_]:
        """Return whether each pair (P,) is in contact in every random shape."""
        contact = np.ones(len(self.pairs), dtype=np.bool_)
        if not len(self.pairs):
            return contact
        low, high = self.robot.shape_box
        shapes = np.random.default_rng(_SEED).uniform(low, high, (_SHAPES, len(low)))
        poses = self.poses(shapes)
        contact[self.lower_bounds(poses).max(axis=0) > 0] = False
        R, r = poses
        for pair in np.flatnonzero(contact):
            # Most pairs separate within the first few shapes.
            for part in (slice(0, 10), slice(10, 100), slice(100, None)):
                if self.distances(int(pair), (R[part], r[part])).max() > 0:
                    contact[pair] = False
                    break
        return contact

    # -- motion -------------------------------------------------------------------------------

    def largest_lever_arms(self, shapes: Array) -> tuple[Array, Array]:
        """Return lever arms: pairs move relative to each other by up to ``reaches @ |dtheta|``, m.

        ``reaches`` (P, m) is the largest distance of any point of the pair from each moving joint
        between the two solids, over all configurations (N, n). It is zero for other joints,
        and for joints that rotate a body of revolution, such as a reaction wheel, about its axis.
        Also return the largest distances (P,) from the base, zero for pairs without obstacles.
        """
        bodies, joints = self.robot.bodies, self.robot.moving_joints
        travel = np.abs(self.moving_positions(shapes)).max(axis=0)
        reach = np.zeros((len(self.solids), len(bodies) - 1))
        carried = np.zeros(reach.shape, dtype=np.bool_)
        from_base = np.zeros(len(self.solids))
        for number, solid in enumerate(self.solids):
            if solid.is_obstacle:
                continue
            _, pose = self.robot.frames[solid.link]
            middle = pose @ solid.enclosure.pose
            far = float(np.linalg.norm(middle.r)) + solid.enclosure.bounding_radius
            index = solid.body
            while index > 0:
                body, joint = bodies[index], joints[index - 1]
                slides = joint.kind is JointKind.PRISMATIC
                carried[number, index - 1] = True
                spins = index == solid.body and _spins_in_place(solid, pose, joint)
                reach[number, index - 1] = 1.0 if slides else far * (not spins)
                far += float(np.linalg.norm(body.origin.r)) + slides * travel[index - 1]
                index = body.parent
            from_base[number] = far
        first, second = reach[self.pairs[:, 0]], reach[self.pairs[:, 1]]
        together = carried[self.pairs[:, 0]] & carried[self.pairs[:, 1]]
        apart = np.where(together, 0.0, first + second)
        return apart, np.where(self.with_obstacles, from_base[self.pairs[:, 0]], 0.0)

    def moving_positions(self, shapes: Array) -> Array:
        """Return the positions (N, m) of all moving joints for configurations (N, n), m or rad."""
        G, b = self.robot.coupling
        return np.asarray(shapes @ G.T + b)


def _spins_in_place(solid: Solid, link_pose: Pose, joint: Joint) -> bool:
    """Whether a solid is a body of revolution about the axis of a joint that rotates it.

    ``link_pose`` is the pose of its link in the frame of the joint's body.
    """
    kind = solid.shape.kind
    if joint.kind is JointKind.PRISMATIC or kind not in ("cylinder", "capsule", "sphere"):
        return False
    placed = link_pose @ solid.shape.pose
    beside = float(np.linalg.norm(np.cross(joint.axis, placed.r)))
    tilted = float(np.linalg.norm(np.cross(joint.axis, placed.R[:, 2])))
    return max(beside, 0.0 if kind == "sphere" else tilted) < _COAXIAL_TOLERANCE


def _solid_in_world(obstacle: Solid, pose: Pose) -> Solid:
    box, vertices = obstacle.enclosure, obstacle.vertices
    return replace(
        obstacle,
        body=WORLD_BODY,
        shape=replace(obstacle.shape, pose=pose @ obstacle.shape.pose),
        enclosure=replace(box, pose=pose @ box.pose),
        vertices=None if vertices is None else vertices @ pose.R.T + pose.r,
    )


# -- nearest approaches while commands are held ----------------------------------------------------


@dataclass(frozen=True)
class Approach:
    """Nearest approach of a pair.

    Attributes
    ----------
    links
        Names of the links.
    pair
        Index of the pair in :attr:`CollisionGeometry.pairs`.
    distance
        m; negative: penetration depth.
    tick
        Time of the approach, in ticks from the first configuration.
    shape
        (n,) configuration at that time, m or rad.
    place_on_obstacle
        (3,) nearest obstacle point in W, m; None for two links.
    """

    links: LinkPair
    pair: int
    distance: float
    tick: float
    shape: Array
    place_on_obstacle: Array | None = None

    def __str__(self) -> str:
        where = ""
        if self.place_on_obstacle is not None:
            where = f" near ({numbers(self.place_on_obstacle, 3)}) m"
        if self.distance <= 0:
            return f"{self.links.subject} touch, {quantity(-self.distance, 'm')} deep{where}"
        return f"{self.links.subject} come within {quantity(self.distance, 'm')}{where}"


class _Path:
    """A path of shapes (N + 1, n) at the ticks, with the base poses if obstacles matter, else None.

    ``largest_motions`` (N, P) are the largest relative motions of pairs in each tick, m, and
    ``lower_bounds`` (N, P) lower bounds on their distances in each tick, m.
    """

    def __init__(
        self, geometry: CollisionGeometry, positions: Array, base: BasePoses | None
    ) -> None:
        if len(positions) == 1:
            twice = np.zeros(2, dtype=np.int64)
            positions, base = positions[twice], None if base is None else base.rows(twice)
        bounds = geometry.lower_bounds(geometry.poses(positions, base))
        reaches, from_base = geometry.largest_lever_arms(positions)
        moved = np.abs(np.diff(geometry.moving_positions(positions), axis=0))
        motion = moved @ reaches.T
        if base is not None and geometry.with_obstacles.any():
            straight = np.linalg.norm(np.diff(base.position, axis=0), axis=1)
            # Quaternions contain half the angle.
            chord = np.linalg.norm(np.diff(base.quaternion, axis=0), axis=1)
            turned = 4 * np.arcsin(np.minimum(np.minimum(chord, np.sqrt(4 - chord**2)) / 2, 1.0))
            motion += np.outer(turned, from_base) + np.outer(straight, geometry.with_obstacles)
        self.positions, self.base, self.largest_motions = positions, base, motion
        self.lower_bounds = (bounds[:-1] + bounds[1:] - motion) / 2

    def interpolated(self, ticks: Array) -> tuple[Array, BasePoses | None]:
        """Return configurations (K, n) and base poses at times (K,) in ticks."""
        before = np.minimum(ticks.astype(int), len(self.positions) - 2)
        share = (ticks - before)[:, np.newaxis]
        shapes = (1 - share) * self.positions[before] + share * self.positions[before + 1]
        return shapes, None if self.base is None else self.base.between(before, share)


def nearest_approaches(
    geometry: CollisionGeometry, positions: Array, required: Array, base: BasePoses | None = None
) -> list[Approach]:
    """Return the nearest approaches of all pairs that come closer than allowed, nearest first.

    Parameters
    ----------
    geometry
        The solids and pairs.
    positions
        (N + 1, n) configurations at the ticks, interpolated linearly in between, m or rad.
    required
        (P,) smallest allowed distances of the pairs, m; minus infinity: any distance.
    base
        Base poses at the ticks; None: obstacles are ignored.
    """
    if not len(geometry.pairs):
        return []
    path = _Path(geometry, positions, base)
    near = np.flatnonzero(path.lower_bounds.min(axis=0) < required)
    found = (_nearest(geometry, path, p, required[p]) for p in near.tolist())
    return sorted((each for each in found if each), key=lambda each: each.distance)


def nearest_approach(
    geometry: CollisionGeometry, positions: Array, base: BasePoses | None = None
) -> Approach | None:
    """Return the nearest approach of all pairs along a path (N + 1, n); None: no pairs.

    ``base`` contains the base poses at the ticks; None: obstacles are ignored.
    """
    if not len(geometry.pairs):
        return None
    path = _Path(geometry, positions, base)
    least = path.lower_bounds.min(axis=0)
    best: Approach | None = None
    for pair in np.argsort(least, kind="stable").tolist():
        if best is not None and least[pair] >= best.distance:
            break
        limit = np.inf if best is None else best.distance
        best = _nearest(geometry, path, pair, limit) or best
    return best


def _nearest(geometry: CollisionGeometry, path: _Path, pair: int, limit: float) -> Approach | None:
    """Return the nearest approach of a pair; None if it does not come nearer than limit."""

    def distances(ticks: Array) -> Array:
        return geometry.distances(pair, geometry.poses(*path.interpolated(ticks)))

    close = path.lower_bounds[:, pair] < limit
    starts = np.flatnonzero(close)
    if not len(starts):
        return None
    ticks = np.flatnonzero(np.append(close, False) | np.append(False, close)).astype(float)
    known = distances(ticks)
    least = int(np.argmin(known))
    best, at = float(known[least]), float(ticks[least])
    index = np.searchsorted(ticks, starts)
    left, right = starts.astype(float), starts + 1.0
    d_0, d_1, v = known[index], known[index + 1], path.largest_motions[starts, pair]
    while True:
        # Only where the distance may be smaller than all known ones, and relevant.
        open_ = ((d_0 + d_1 - v) / 2 < min(best, limit)) & (v > _MOTION_RESOLUTION)
        if not open_.any():
            break
        left, right, d_0, d_1, v = (x[open_] for x in (left, right, d_0, d_1, v))
        middle = (left + right) / 2
        d = distances(middle)
        least = int(np.argmin(d))
        if d[least] < best:
            best, at = float(d[least]), float(middle[least])
        left, right = np.concatenate([left, middle]), np.concatenate([middle, right])
        d_0, d_1 = np.concatenate([d_0, d]), np.concatenate([d, d_1])
        v = np.concatenate([v, v]) / 2
    if best >= limit:
        return None
    shapes, base = path.interpolated(np.array([at]))
    place = None
    if base is not None and geometry.with_obstacles[pair]:
        place = geometry.nearest_point_on_obstacle(pair, shapes[0], base)
    return Approach(geometry.links_of(pair), pair, best, at, shapes[0], place)
