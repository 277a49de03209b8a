"""Clearance of a plant during a flight: the smallest distance between links, and contacts.

A plant without MuJoCo has no contact forces: its robot moves through contacts, and the plant
reports them.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from spacerobot_ros.collision import BasePoses, CollisionGeometry, LinkPair, ObstaclePair
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
from spacerobot_ros.model.description import Array, RobotDescription
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
            *(self._begun(each, time_s) for each in sorted(touching - before)),
            *(_ended(each, time_s) for each in sorted(before - touching)),
        ]

    @property
    def contacts(self) -> tuple[str, ...]:
        """Links in contact in the last state, as in the plant's status."""
        return tuple(sorted(each.subject for each in self.touching))

    def _begun(self, links: LinkPair, time_s: float) -> Event:
        then = "push each other" if self._pushing else "the simulation continues through contact"
        joint = " and" if self._pushing else ";"
        message = f"{_subject(links)} touch{joint} {then}."
        return Event(EventKind.CONTACT, message, _ERROR, time_s, about=_names(links))


def _base(pose: Array) -> BasePoses:
    return BasePoses(pose[np.newaxis, :3], pose[np.newaxis, 3:])


def _subject(links: LinkPair) -> str:
    """Return two links, or a link and an obstacle, as the beginning of a sentence."""
    return links.subject[0].upper() + links.subject[1:]


def _ended(links: LinkPair, time_s: float) -> Event:
    message = f"{_subject(links)} no longer touch."
    return Event(EventKind.CONTACT_ENDED, message, _OK, time_s, about=_names(links))


def _names(links: LinkPair) -> dict[str, str]:
    return {"first": links.first, "second": links.second}
