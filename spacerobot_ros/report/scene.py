"""Flight scene: bodies with their solids, colours and poses over time.

Pictures (:mod:`.solids`) and the 3D view (:mod:`.player`) draw the same bodies; the live page draws
the same solids (:mod:`spacerobot_ros.model.meshes`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from matplotlib.colors import to_hex

from spacerobot_ros.model.description import Array, Pose, RobotDescription
from spacerobot_ros.model.meshes import TriangleMesh, Visual, visuals_of
from spacerobot_ros.model.rotations import quaternion_from_matrix
from spacerobot_ros.report.figures import GHOST_COLOUR, colour
from spacerobot_ros.report.flight import FlightReport
from spacerobot_ros.report.signals import continuous, link_poses

_BASE_COLOUR = "#c4c9d2"

_FLATNESS_STATES = 25
"""Number of states in which links are checked for motion in a horizontal plane."""


@dataclass(frozen=True, eq=False)
class Body:
    """A rigid body in the scene.

    Attributes
    ----------
    name
        Its unique name.
    visuals
        Solids of the body, in the body frame.
    poses
        World poses (K, 7) of the body at the scene instants, m and quaternion; (1, 7) if it is at
        rest.
    color
        ``#rrggbb``; empty if each solid has its own color.
    """

    name: str
    visuals: tuple[Visual, ...]
    poses: Array
    color: str = ""

    def color_of(self, visual: Visual) -> str:
        """Return the colour of a solid, ``#rrggbb``."""
        return self.color or to_hex(visual.shape.rgba[:3])


def robot_bodies(
    robot: RobotDescription,
    meshes: Mapping[str, TriangleMesh],
    base: Array,
    q: Array,
    most: int,
) -> list[Body]:
    """Return the robot links that have solids, with the colours of the joints that move them.

    Parameters
    ----------
    robot
        The robot.
    meshes
        Triangles of its meshes, by URI.
    base, q
        (K, 7) base poses in the world, and (K, n) joint positions, m or rad.
    most
        Largest number of mesh faces.
    """
    visuals = visuals_of(robot, meshes, most)
    found = []
    for link, poses in link_poses(robot, base, q).items():
        solids = tuple(each for each in visuals if each.link == link)
        body = robot.frames[link][0]
        if solids:
            color = _BASE_COLOUR if body == 0 else colour(body - 1)
            found.append(Body(link, solids, poses, color))
    return found


def bodies_of(flight: FlightReport, rows: Sequence[int], most: int) -> list[Body]:
    """Return the robot and the target in a flight, at selected recorded states.

    ``most``: largest number of mesh faces.
    """
    assert flight.robot is not None
    at = np.asarray(rows)
    base = continuous(flight.pose)[at]
    found = robot_bodies(flight.robot, flight.meshes, base, flight.joints[at], most)
    target, seen = flight.target, flight.target_pose
    if target is not None and len(seen):
        times = np.searchsorted(seen.time, flight.time[at] - 1e-9)
        poses = continuous(seen.values)[np.minimum(times, len(seen) - 1)]
        solids = [_moved(x, target.frames[x.link][1]) for x in visuals_of(target, {}, most)]
        found.append(Body("target", tuple(solids), poses))
    return found


def obstacles_of(flight: FlightReport) -> list[Body]:
    """Return the obstacles around a robot, with the geometry used to measure distances."""
    return [
        Body(
            f"obstacle {number} {visual.link}",
            (visual,),
            np.concatenate([pose.r, quaternion_from_matrix(pose.R)])[np.newaxis],
        )
        for number, (visual, pose) in enumerate(flight.obstacles)
    ]


def goal_of_base(flight: FlightReport, most: int) -> Body | None:
    """Return a robot's base at its goal; None if the base has no goal.

    If the goal specifies only the attitude, the base is drawn at its last position.
    """
    goal, robot = flight.base_goal, flight.robot
    if goal is None or robot is None or not flight.controls("base"):
        return None
    position = goal.position if flight.position_counts else flight.pose[-1, :3]
    pose = np.concatenate([position, goal.quaternion])[np.newaxis]
    solids = tuple(
        _moved(each, robot.frames[each.link][1])
        for each in visuals_of(robot, flight.meshes, most)
        if each.body == 0
    )
    return Body("goal", solids, pose, GHOST_COLOUR)


def is_flat(flight: FlightReport) -> bool:
    """Whether every link of a robot stays in a plane z = const in the world."""
    bodies = bodies_of(flight, flight.samples(_FLATNESS_STATES), 1)
    poses = np.array([each.poses for each in bodies])
    # Tilt of the z axis: 1 - cos.
    tilt = 2 * (poses[..., 3] ** 2 + poses[..., 4] ** 2)
    return bool((tilt < 1e-9).all() and np.ptp(poses[..., 2], axis=1).max() < 1e-6)


def _moved(visual: Visual, frame: Pose) -> Visual:
    """Return a solid in the frame in which its link has the pose ``frame``."""
    shape = replace(visual.shape, pose=frame @ visual.shape.pose)
    return replace(visual, shape=shape, mesh=visual.mesh.moved(frame))
