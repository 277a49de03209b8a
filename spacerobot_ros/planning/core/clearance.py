"""Plan clearance: smallest distances between the bodies of a robot, and to obstacles."""

from __future__ import annotations

import logging
from dataclasses import replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from spacerobot_ros.collision import (
    Approach,
    BasePoses,
    CollisionGeometry,
    LinkPair,
    ObstaclePair,
    nearest_approaches,
    unread_mesh_notes,
)
from spacerobot_ros.errors import (
    ParameterError,
    PlanningError,
    Proof,
    UnreachableError,
    UnreadMeshError,
    sentence_case,
)
from spacerobot_ros.files import warn_once
from spacerobot_ros.model.description import Array, RobotDescription

_LOG = logging.getLogger(__name__)

DEFAULT_CLEARANCE = 0.01
"""Smallest distance between two links in a plan, m; 0: contacts are ignored."""

_CLEARANCE_OF_OBSTACLES = 0.01
"""Smallest distance if there are obstacles and none is requested, m."""

_LARGEST_SHARE_OF_SIZE = 0.05
"""Largest usual ratio of the clearance to the robot's diameter of gyration."""

_DISTANCE_ERROR = 1e-6
"""Numerical error of a computed distance, m."""

_CLEARANCE_FACTOR_FOR_LOOPS = 5.0

_MIN_START_SHARE = 0.5
"""Fraction of the clearance below which a start near an obstacle is rejected, since a flight that
ended at the clearance may be slightly closer, and fraction of their distance that links keep if
they are that close: fingers, for instance, are by design."""


def usual_clearance(robot: RobotDescription) -> float:
    """Return the default clearance, or a smaller one if the robot is smaller than 0.2 m, in m."""
    return float(f"{min(DEFAULT_CLEARANCE, _LARGEST_SHARE_OF_SIZE * robot.size):.1g}")


class Clearance:
    """Smallest distance that plans keep between links of a robot, and from its links to obstacles.

    Parameters
    ----------
    robot
        The robot, with its world.
    distance
        Smallest distance between unconnected links, and between links and obstacles, m.
    parameter
        Parameter name, for messages.
    obstacles_alone
        Whether distances between two links of the robot are ignored.
    """

    def __init__(
        self,
        robot: RobotDescription,
        distance: float,
        parameter: str = "planner.clearance",
        *,
        obstacles_alone: bool = False,
    ) -> None:
        self._robot, self._parameter = robot, parameter
        self._obstacles_alone = obstacles_alone
        self.distance = distance
        self._warned: set[str] = set()

    @classmethod
    def wanted(
        cls, robot: RobotDescription, distance: float, parameter: str = "planner.clearance"
    ) -> Clearance | None:
        """Return the requested clearance for a robot; None if the distance is zero.

        If there are obstacles, a distance of zero means 0.01 m.

        Raises
        ------
        ParameterError
            The distance is negative or not finite.
        """
        if not 0.0 <= distance < np.inf:
            raise ParameterError(f"clearance is {distance}; it must be a distance in m, 0 or more.")
        if robot.world is not None:
            distance = distance or _CLEARANCE_OF_OBSTACLES
        return cls(robot, distance, parameter) if distance else None

    def of(self, robot: RobotDescription) -> Clearance:
        """Return the same clearance for another robot among the same obstacles."""
        return Clearance(replace(robot, world=self._robot.world), self.distance, self._parameter)

    @cached_property
    def geometry(self) -> CollisionGeometry:
        """Solids of the robot."""
        return CollisionGeometry(self._robot, obstacles_alone=self._obstacles_alone)

    @property
    def has_obstacles(self) -> bool:
        """Whether the base motion must be considered, because there are obstacles."""
        return bool(self.geometry.with_obstacles.any())

    @property
    def facts(self) -> Array:
        """The values that affect plans: the distance, the pairs, and the solids around bodies."""
        geometry = self.geometry
        solids = [each.enclosure for each in geometry.solids]
        return np.concatenate(
            [
                [self.distance, float(geometry.exact)],
                geometry.pairs.ravel(),
                *(np.concatenate([x.pose.R.ravel(), x.pose.r, x.half, [x.radius]]) for x in solids),
            ]
        )

    def required(self, start: Array, base: BasePoses | None = None) -> Array:
        """Return the required distances (P,), m, of all pairs for a motion from a start (n,).

        If a pair is closer than the clearance at the start, its distance there is required instead.
        Links in contact at the start are ignored (minus infinity), with a warning. ``base`` is the
        base pose at the start; None: obstacles are ignored.

        Raises
        ------
        PlanningError
            Links are much closer than the clearance at the start, a link touches an obstacle, or
            the mesh of a ``<collision>`` cannot be read; the message names them.
        """
        geometry = self.geometry
        self._require_declared_meshes()
        required = np.full(len(geometry.pairs), self.distance)
        if not len(required):
            return required
        poses = geometry.poses(start[np.newaxis], base)
        for pair in np.flatnonzero(geometry.lower_bounds(poses)[0] <= self.distance).tolist():
            distance = float(geometry.distances(pair, poses)[0])
            links = geometry.links_of(pair)
            near = f"are {distance:.3g} m apart at the start"
            limit = f"closer than {self._parameter} = {self.distance:g} m"
            if distance >= _MIN_START_SHARE * self.distance:
                required[pair] = min(self.distance, distance)
            elif isinstance(links, ObstaclePair):
                if distance <= 0:
                    raise PlanningError(
                        f"{sentence_case(links.subject)} touch at the start: move the robot away "
                        f"first, or set {self._parameter} to 0."
                    )
                raise PlanningError(
                    f"{sentence_case(links.subject)} {near}, {limit}: reduce this value."
                )
            elif distance <= 0:
                required[pair] = -np.inf
                self._warn(links, "are in contact at the start: their contact is ignored")
            else:
                required[pair] = _MIN_START_SHARE * distance
                self._warn(links, f"{near}, {limit}: they are kept half as far apart")
        return required - _DISTANCE_ERROR

    def _require_declared_meshes(self) -> None:
        """Reject a robot with a ``<collision>`` whose mesh cannot be read, unless an SRDF disables
        all pairs of its link. Other meshes that cannot be read are named in the log.
        """
        robot = self._robot
        names = {link.name for link in robot.links}
        for each in self.geometry.unread_meshes:
            pairs = {frozenset({each.link, other}) for other in names - {each.link}}
            if (
                each.is_collision_shape
                and each.link in names
                and not pairs <= robot.disabled_collisions
            ):
                raise UnreadMeshError(
                    f"Contacts of link '{each.link}' cannot be checked: {each.reason} Or disable "
                    f"its pairs in an SRDF (planner.srdf), or set {self._parameter} to 0."
                )
        for note in unread_mesh_notes(self.geometry.unread_meshes):
            warn_once(note)

    def _warn(self, links: LinkPair, text: str) -> None:
        if links.subject not in self._warned:
            self._warned.add(links.subject)
            _LOG.warning(
                "%s %s. If this is by design, disable the pair in an SRDF (planner.srdf).",
                sentence_case(links.subject),
                text,
            )

    def is_roomy(self, shapes: Array) -> npt.NDArray[np.bool_]:
        """Return, for each configuration (N, n), whether all links have room for loops (N,)."""
        room = _CLEARANCE_FACTOR_FOR_LOOPS * self.distance
        return np.asarray(self.geometry.nearest_along(shapes, None, room, most=0.0)[0] >= 0.0)

    def is_clear(self, shapes: Array, required: Array) -> bool:
        """Whether pairs keep the ``required`` distances (P,), m, in all configurations (N, n).

        Obstacles are ignored.
        """
        return self.geometry.keep_apart(self.geometry.poses(shapes), required)

    def approaches(
        self, positions: Array, required: Array | None = None, base: BasePoses | None = None
    ) -> list[Approach]:
        """Return the nearest approaches of pairs that come too close, nearest first.

        Parameters
        ----------
        positions
            (N + 1, n) shapes at the ticks, m or rad.
        required
            (P,) required distances, m; None: as returned by :meth:`required` for the first shape.
        base
            Base poses at the ticks; None: obstacles are ignored.
        """
        if not len(self.geometry.pairs):
            return []
        if required is None:
            required = self.required(positions[0], None if base is None else base.rows(slice(1)))
        return nearest_approaches(self.geometry, positions, required, base)

    def clause(self, approach: Approach, control_period: float | None) -> str:
        """Return a clause about an approach that is too close, with times if a period is given."""
        when = ""
        if control_period is not None:
            when = f" after {approach.tick * control_period:.4g} s,"
        shape = np.round(approach.shape, 3).tolist()
        # A robot without joints has no shape.
        where = f" at the shape {shape}" if shape else ""
        return f"{approach}{when}{where}, and {self._setting}"

    @property
    def _setting(self) -> str:
        """The value of the parameter, and a better one if it is unusual for the robot's size."""
        usual = usual_clearance(self._robot)
        hint = "" if self.distance <= usual else f"; {usual:g} m would suit the robot's size"
        return f"{self._parameter} is {self.distance:g} m{hint}"

    def require_shape(self, shape: Array, required: Array, base: BasePoses | None = None) -> None:
        """Check that links are not too close in the shape (n,) of a goal.

        ``required`` (P,) are the distances that pairs must keep, m; ``base`` the pose, if known.

        Raises
        ------
        UnreachableError
            Links are too close; the message names them.
        """
        found = self.approaches(shape[np.newaxis], required, base)
        if found:
            subject = "shape" if found[0].place_on_obstacle is None else "pose"
            raise UnreachableError(
                f"The {subject} of the goal is in collision: {found[0]}; {self._setting}.",
                Proof.COLLISION,
            )
