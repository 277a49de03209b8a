"""Clearance of a plant during a flight: the smallest distance between links, and contacts.

A plant without MuJoCo has no contact forces: its robot moves through contacts, and the plant
reports them.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from spacerobot_ros.collision import (
    Approach,
    BasePoses,
    CollisionGeometry,
    LinkPair,
    ObstaclePair,
    nearest_approach,
)
from spacerobot_ros.errors import quantity
from spacerobot_ros.events import (
    SECONDS,
    Event,
    EventKind,
    KeyValueField,
    KeyValueFormat,
    number_format,
)
from spacerobot_ros.files import warn_first_time
from spacerobot_ros.model.compilation import cache_directory
from spacerobot_ros.model.description import Array, RobotDescription, Shape
from spacerobot_ros.model.meshes import TriangleMesh, shape_mesh
from spacerobot_ros.model.rotations import relative_pose
from spacerobot_ros.simulation.capture import CapturePlant

_LOG = logging.getLogger(__name__)

_OK, _ERROR = 0, 2

_OBSTACLE = "obstacle"
"""Value of key ``second_is`` if the second link of a pair is an obstacle."""


@dataclass(frozen=True)
class ClearanceStatus:
    """The smallest distance between two links at one time, as published on ``clearance``.

    Attributes
    ----------
    distance
        m; if the links touch, the negative contact depth.
    links
        The two links.
    time_s
        Simulated time, s.
    """

    distance: float
    links: LinkPair
    time_s: float

    @property
    def level(self) -> int:
        """Level of diagnostic_msgs/DiagnosticStatus: ERROR while links touch."""
        return _OK if self.distance > 0 else _ERROR

    @property
    def message(self) -> str:
        """The status as a sentence."""
        if self.distance > 0:
            return f"{_subject(self.links)} are {quantity(self.distance, 'm')} apart."
        return f"{_subject(self.links)} touch, {quantity(-self.distance, 'm')} deep."

    def to_values(self) -> dict[str, str]:
        """Return the status as key-value pairs of a DiagnosticStatus."""
        values = _FORMAT.to_values(self)
        values |= {"first": self.links.first, "second": self.links.second}
        if isinstance(self.links, ObstaclePair):
            values["second_is"] = _OBSTACLE
        return values

    @classmethod
    def from_values(cls, values: Mapping[str, str]) -> ClearanceStatus:
        """Return the status from the key-value pairs of :meth:`to_values`.

        Raises
        ------
        SpaceRobotError
            The pairs do not form a clearance status.
        """
        with _FORMAT.reading():
            kind = ObstaclePair if values.get("second_is") == _OBSTACLE else LinkPair
            links = kind(values["first"], values["second"])
        return _FORMAT.from_values(cls, values, links=links)


_FORMAT = KeyValueFormat(
    "clearance",
    KeyValueField("time_s", SECONDS, key="time"),
    KeyValueField("distance", number_format(".9g")),
)


class ClearanceMonitor:
    """Measures a robot's clearance in each state, and derives events from its contacts.

    Parameters
    ----------
    geometry
        The robot's solids; this geometry must contain at least one pair and compute exact
        distances.
    links
        The links, in the order of their poses.
    has_contact_forces
        Whether bodies in contact exert forces on each other; used in event messages.
    """

    def __init__(
        self,
        geometry: CollisionGeometry,
        links: tuple[str, ...],
        *,
        has_contact_forces: bool = False,
    ) -> None:
        self._geometry, self._pushing = geometry, has_contact_forces
        self._order = [links.index(each) for each in geometry.links]
        self.touching: frozenset[LinkPair] = frozenset()
        """Links in contact in the last state."""
        self._capturing: CapturePlant | None = None
        self._from_target: CollisionGeometry | None = None

    @classmethod
    def of(
        cls,
        robot: RobotDescription,
        links: tuple[str, ...],
        before: ClearanceMonitor | None = None,
        *,
        capturing: CapturePlant | None = None,
        has_contact_forces: bool = False,
    ) -> ClearanceMonitor | None:
        """Return a robot's monitor; None if no links can touch.

        ``before`` is the monitor for the previous obstacles, whose contacts either continue or end.
        While the target of ``capturing`` is free, only the end-effector body may touch it. If the
        package coal is not installed, a warning is logged and the result is None.
        """
        geometry = CollisionGeometry(robot)
        if not len(geometry.pairs):
            return None
        if not geometry.exact:
            warn_first_time(
                _LOG,
                cache_directory(),
                "warned_of_clearance",
                "The plant cannot measure clearance without the package coal.",
            )
            return None
        monitor = cls(geometry, links, has_contact_forces=has_contact_forces)
        if before is not None:
            monitor.touching = before.touching
        if capturing is not None:
            among = replace(robot, world=capturing.target.description)
            around = CollisionGeometry(among, obstacles_alone=True)
            bodies = np.array([around.solids[i].body for i, _ in around.pairs], dtype=int)
            around.pairs = around.pairs[bodies != robot.frames[capturing.link][0]]
            if len(around.pairs):
                monitor._capturing, monitor._from_target = capturing, around
        return monitor

    def measure(
        self, link_R: Array, link_r: Array, pose: Array, time_s: float
    ) -> tuple[ClearanceStatus, list[Event]]:
        """Return the clearance, and an event for each contact that began or ended.

        Parameters
        ----------
        link_R, link_r
            Attitudes (3, 3 L) and positions (3, L), m, of the links in B.
        pose
            (7,) position, m, and quaternion (x, y, z, w) of the base in W.
        time_s
            Simulated time, s.
        """
        R = link_R.reshape(1, 3, -1, 3).swapaxes(1, 2)[:, self._order]
        links = R, link_r.reshape(3, -1).T[np.newaxis, self._order]
        poses = self._geometry.with_world(links, _base(pose))
        (distance,), (pair,) = self._geometry.nearest_at(poses)
        status = ClearanceStatus(float(distance), self._geometry.links_of(pair), time_s)
        before, touching = self.touching, frozenset[LinkPair]()
        if distance <= 0:
            touching = self._geometry.links_in_contact(poses)
        if self._from_target is not None and self._capturing and self._capturing.payload is None:
            seen = relative_pose(self._capturing.target_pose, pose)
            among = self._from_target.with_world(links, _base(seen))
            touching |= self._from_target.links_in_contact(among)
        self.touching = touching
        return status, [
            *(self._event(each, time_s, begins=True) for each in sorted(touching - before)),
            *(self._event(each, time_s, begins=False) for each in sorted(before - touching)),
        ]

    @property
    def contacts(self) -> tuple[str, ...]:
        """Links in contact in the last state, as in the plant's status."""
        return tuple(sorted(each.subject for each in self.touching))

    def _event(self, links: LinkPair, time_s: float, *, begins: bool) -> Event:
        kind, level, then = EventKind.CONTACT_ENDED, _OK, "no longer touch."
        if begins:
            kind, level = EventKind.CONTACT, _ERROR
            then = "touch; the simulation continues through contact."
            if self._pushing:
                then = "touch and push each other."
        about = {"first": links.first, "second": links.second}
        return Event(kind, f"{_subject(links)} {then}", level, time_s, about=about)


def _base(pose: Array) -> BasePoses:
    return BasePoses(pose[np.newaxis, :3], pose[np.newaxis, 3:])


def _subject(links: LinkPair) -> str:
    """Return two links, or a link and an obstacle, as the beginning of a sentence."""
    return links.subject[0].upper() + links.subject[1:]


@dataclass(frozen=True, eq=False)
class FlightClearance:
    """The smallest distance of the links from each other and from obstacles in a flight.

    Attributes
    ----------
    geometry
        The robot's solids, with at least one pair to check.
    time
        (N,) times of the states, s; N is at least 1.
    shapes
        (N, n) true joint positions, m or rad.
    base
        The true base poses (N,); None without obstacles.
    """

    geometry: CollisionGeometry
    time: Array
    shapes: Array
    base: BasePoses | None = None

    @classmethod
    def of(
        cls,
        robot: RobotDescription,
        joint_names: Sequence[str],
        q: tuple[Array, Array],
        pose: tuple[Array, Array],
        mesh_of: Callable[[Shape], TriangleMesh] = shape_mesh,
    ) -> FlightClearance | None:
        """Return the clearance of a flight; None if the flight has no states, or if no link pair is
        checked.

        Parameters
        ----------
        robot
            The robot.
        joint_names
            The names of the columns of ``q``.
        q, pose
            Times (N,), s, and joint positions (N, n), m or rad; times (M,) and base poses (M, 7).
            If there are obstacles, only the times common to ``q`` and ``pose`` are used.
        mesh_of
            As for :class:`~spacerobot_ros.collision.geometry.CollisionGeometry`.
        """
        (time, shapes), names, base = q, list(joint_names), None
        if robot.world is not None:
            time, of_joints, of_base = np.intersect1d(time, pose[0], return_indices=True)
            shapes, poses = shapes[of_joints], pose[1][of_base]
            base = BasePoses(poses[:, :3], poses[:, 3:])
        if not len(time) or not set(robot.joint_names) <= set(names):
            return None
        geometry = CollisionGeometry(robot, mesh_of)
        if not len(geometry.pairs):
            return None
        columns = [names.index(name) for name in robot.joint_names]
        return cls(geometry, time, shapes[:, columns], base)

    @cached_property
    def nearest(self) -> Approach:
        """The smallest distance between two links, including times between the states."""
        found = nearest_approach(self.geometry, self.shapes, self.base)
        assert found is not None
        return found

    def statuses(self, every: int) -> list[ClearanceStatus]:
        """Return the clearance of every ``every``-th state, as the plant publishes it."""
        distances, pairs = self._nearest_at(slice(None, None, every))
        return [
            ClearanceStatus(distance, self.geometry.links_of(pair), time)
            for distance, pair, time in zip(
                distances.tolist(), pairs.tolist(), self.time[::every].tolist(), strict=True
            )
        ]

    def _nearest_at(
        self, rows: slice | npt.NDArray[np.int64]
    ) -> tuple[Array, npt.NDArray[np.int64]]:
        """Return the smallest distances, m, and their pairs in some states."""
        base = None if self.base is None else self.base.rows(rows)
        return self.geometry.nearest_along(self.shapes[rows], base)

    @property
    def nearest_time(self) -> float:
        """Time of the smallest distance, s."""
        return float(np.interp(self.nearest.tick, np.arange(len(self.time)), self.time))

    def over_time(self, most: int) -> tuple[Array, Array]:
        """Return times (K,), s, and the smallest distances (K,) over all pairs, m.

        The distances are evaluated in ``most`` states at approximately equal intervals, and in the
        state with the smallest distance.
        """
        rows = np.unique(np.linspace(0, len(self.time) - 1, most).round().astype(int))
        distances, _ = self._nearest_at(rows)
        time = self.time[rows]
        place = int(np.searchsorted(time, self.nearest_time))
        return (
            np.insert(time, place, self.nearest_time),
            np.insert(distances, place, self.nearest.distance),
        )
