"""The clearance during a flight: the smallest distance of the links from each other and from
obstacles, in the true states.

A flight without ROS reports clearances in the same way as the plant node:
:meth:`FlightClearance.statuses`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from spacerobot_ros.collision import Approach, BasePoses, CollisionGeometry, nearest_approach
from spacerobot_ros.model.description import Array, RobotDescription, Shape
from spacerobot_ros.model.meshes import TriangleMesh, shape_mesh
from spacerobot_ros.simulation.clearance import ClearanceStatus


@dataclass(frozen=True, eq=False)
class FlightClearance:
    """The smallest distance between robot links during a flight.

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
