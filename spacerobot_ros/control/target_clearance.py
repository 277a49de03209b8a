"""Distances of a robot from the body of a target on the way to it.

Seen from the target its body is an obstacle that stands still, and the robot moves. So the checks
of obstacles serve: the target is the world of the robot, and the base has its pose relative to it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from spacerobot_ros.collision import BasePoses, CollisionGeometry, LinkPair
from spacerobot_ros.control.target_motion import FrameMotion
from spacerobot_ros.model.description import Array, Pose, RobotDescription
from spacerobot_ros.model.rotations import quaternion_from_matrix


@dataclass(frozen=True)
class NearestLinks:
    """The smallest distance in a motion, m; the links of robot and target; and the sample."""

    distance: float
    links: LinkPair
    sample: int


class TargetClearance:
    """Distances between the links of a robot and those of a target.

    Parameters
    ----------
    robot
        The robot.
    link
        Its end-effector, whose rigid body may touch the target once it closes in.
    target
        The target, one rigid body.
    grapple
        Pose of the grapple frame in the frame T of the target.
    least
        The distance that is to be kept, m.
    """

    def __init__(
        self,
        robot: RobotDescription,
        link: str,
        target: RobotDescription,
        grapple: Pose,
        least: float,
    ) -> None:
        self.least = least
        self._grapple = grapple
        self._geometry = CollisionGeometry(replace(robot, world=target), obstacles_alone=True)
        hand = robot.frames[link][0]
        bodies = np.array([self._geometry.solids[i].body for i, _ in self._geometry.pairs])
        self._of_hand = bodies == hand

    def nearest(
        self, base: Pose, shapes: Array, grapple: FrameMotion, closes: int
    ) -> NearestLinks | None:
        """Return the nearest approach of a motion; None: nothing can touch.

        Parameters
        ----------
        base
            Pose of the base in W, which stays.
        shapes
            (K, n) joint positions, m or rad.
        grapple
            The grapple frame at the same times.
        closes
            The sample from which on the end-effector closes in.
        """
        geometry = self._geometry
        if not len(geometry.pairs):
            return None
        poses = geometry.poses(shapes, self._base_in_target(base, grapple))
        bounds = geometry.lower_bounds(poses)
        bounds[closes:, self._of_hand] = np.inf
        found: NearestLinks | None = None
        for pair in np.argsort(bounds.min(axis=0), kind="stable").tolist():
            at = np.flatnonzero(bounds[:, pair] < (np.inf if found is None else found.distance))
            if len(at):
                distances = geometry.distances(pair, (poses[0][at], poses[1][at]))
                k = int(distances.argmin())
                if found is None or distances[k] < found.distance:
                    links = geometry.links_of(pair)
                    found = NearestLinks(float(distances[k]), links, int(at[k]))
        return found

    def _base_in_target(self, base: Pose, grapple: FrameMotion) -> BasePoses:
        """Return the poses of the base in T."""
        R_TW = self._grapple.R @ np.swapaxes(grapple.R, 1, 2)
        r_TB = np.einsum("kij,kj->ki", R_TW, base.r - grapple.r) + self._grapple.r
        R_TB = R_TW @ base.R
        return BasePoses(r_TB, np.array([quaternion_from_matrix(R) for R in R_TB]))
