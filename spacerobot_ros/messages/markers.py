"""Markers for a robot, its target, obstacles, goal and planned path, for viewers.

All markers are in the world frame, so that a viewer needs no transforms.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

from spacerobot_ros.messages.layout import encode
from spacerobot_ros.messages.readers import MessageTemplate
from spacerobot_ros.model.description import Array, Pose, RobotDescription, Shape
from spacerobot_ros.model.kinematics import LinkPlacement
from spacerobot_ros.model.rotations import matrix_from_quaternion, quaternion_from_matrix
from spacerobot_ros.times import stamp_bytes

if TYPE_CHECKING:
    from spacerobot_ros.planning import BasePath, Goal

MARKER_ARRAY = "visualization_msgs/msg/MarkerArray"

_TYPES = {"box": 1, "sphere": 2, "cylinder": 3, "mesh": 10, "capsule": 11}
"""Marker ``type`` values by geometry kind: CUBE ... TRIANGLE_LIST."""

_LINE_STRIP = 4
_DELETE = 2
"""Value of ``action`` that deletes a Marker."""

_GHOST_ALPHA = 0.25
_LINE_WIDTH, _LINE_COLOR = 0.005, (0.95, 0.6, 0.1, 1.0)
"""Width (m) and color of path lines."""


def _pose(r: Array, R: Array) -> dict[str, Any]:
    return {
        "position": dict(zip("xyz", r, strict=True)),
        "orientation": dict(zip("xyzw", quaternion_from_matrix(R), strict=True)),
    }


_NO_TURN = {"orientation": {"w": 1.0}}


def shape_marker(shape: Shape, frame: str, namespace: str, number: int) -> dict[str, Any]:
    """Return the marker fields of a URDF visual, with an identity pose."""
    size, points = shape.size, []
    if shape.kind == "cylinder":
        size = (2 * size[0], 2 * size[0], size[1])
    elif shape.kind == "sphere":
        size = (2 * size[0],) * 3
    elif shape.kind == "capsule":
        from spacerobot_ros.model.visuals import solid_mesh  # Few shapes are capsules.

        size, mesh = (1.0, 1.0, 1.0), solid_mesh(replace(shape, pose=Pose()))
        corners = mesh.vertices[mesh.faces].reshape(-1, 3).tolist()
        points = [dict(zip("xyz", corner, strict=True)) for corner in corners]
    return {
        "header": {"frame_id": frame},
        "ns": namespace,
        "id": number,
        "type": _TYPES[shape.kind],
        "pose": _NO_TURN,
        "scale": dict(zip("xyz", size, strict=True)),
        "color": dict(zip("rgba", shape.rgba, strict=True)),
        "points": points,
        "mesh_resource": shape.resource,
    }


def _erased(namespace: str, number: int) -> dict[str, Any]:
    return {"ns": namespace, "id": number, "action": _DELETE, "pose": _NO_TURN}


def _line(namespace: str, number: int, places: Array, frame: str) -> dict[str, Any]:
    """Return the marker fields of a line through points (K, 3)."""
    return {
        "header": {"frame_id": frame},
        "ns": namespace,
        "id": number,
        "type": _LINE_STRIP,
        "pose": _NO_TURN,
        "scale": {"x": _LINE_WIDTH},
        "color": dict(zip("rgba", _LINE_COLOR, strict=True)),
        "points": [dict(zip("xyz", place, strict=True)) for place in places.tolist()],
    }


def goal_markers(goal: Goal, path: BasePath, robot: RobotDescription, frame: str) -> bytes:
    """Return markers for the base at its goal, the planned base path as a line, and an
    end-effector's goal path.

    The goal pose is drawn with the visuals of the base link and of the links fixed to it.
    """
    markers: list[dict[str, Any]] = []
    base = Pose(matrix_from_quaternion(goal.quaternion), goal.position)
    for link in robot.links:
        body, link_pose = robot.frames[link.name]
        for shape in link.shapes if body == 0 else ():
            marker = shape_marker(shape, frame, "goal", len(markers))
            placed = base @ link_pose @ shape.pose
            marker["color"] |= {"a": _GHOST_ALPHA}
            markers.append({**marker, "pose": _pose(placed.r, placed.R)})
    markers.append(_line("planned_path", len(markers), path.position, frame))
    given = [each.path_values for each in goal.end_effectors if each.waypoints is not None]
    if given:
        markers.append(_line("given_path", 0, given[0][:, :3], frame))
    else:  # The path of an earlier goal is deleted.
        markers.append(_erased("given_path", 0))
    return encode(MARKER_ARRAY, {"markers": markers})


class RobotMarkers:
    """All visuals of a robot, its target and its obstacles as one marker array.

    Parameters
    ----------
    robot, target
        The robot and the target; None if it does not exist.
    frame
        Name of the world frame.
    """

    def __init__(self, robot: RobotDescription, target: RobotDescription | None, frame: str):
        self._robot, self._target, self._frame = robot, target, frame
        self._drawn: set[tuple[str, int]] = set()
        """Namespaces and IDs of all markers created so far."""
        self.use_obstacles(robot.world)

    def use_obstacles(self, world: RobotDescription | None) -> None:
        """Replace the obstacles to draw; None: none."""
        robot, target, frame = self._robot, self._target, self._frame
        poses: list[tuple[int, Pose]] = []
        markers: list[dict[str, Any]] = []
        for index, link in enumerate(robot.links):
            for shape in link.shapes:
                markers.append(shape_marker(shape, frame, link.name, len(markers)))
                poses.append((index, shape.pose))
        self._of_target: list[Pose] = []
        """Poses of the target's visuals in the frame of its root link."""
        for link in () if target is None else target.links:
            for shape in link.shapes:
                markers.append(shape_marker(shape, frame, link.name, len(markers)))
                assert target is not None
                self._of_target.append(target.frames[link.name][1] @ shape.pose)
        for link in () if world is None else world.links:
            for shape in link.shapes or link.collisions:
                marker = shape_marker(shape, frame, link.name, len(markers))
                assert world is not None
                at = world.frames[link.name][1] @ shape.pose
                markers.append({**marker, "pose": _pose(at.r, at.R)})
        present = {(marker["ns"], marker["id"]) for marker in markers}
        markers += [_erased(*each) for each in sorted(self._drawn - present)]
        self._drawn |= present
        self.draws_anything = bool(markers)
        """Whether there are any markers; the robot, the target and the obstacles may all lack
        visuals."""
        self._template = MessageTemplate(MARKER_ARRAY, encode(MARKER_ARRAY, {"markers": markers}))
        moved = len(poses) + len(self._of_target)
        self._places = [
            self._template.floats(f"markers[{i}].pose.position.x", 7) for i in range(moved)
        ]
        self._placement = LinkPlacement(len(robot.links), poses)

    def message(
        self, time_ns: int, base: Array, link_R: Array, link_r: Array, target: Array | None
    ) -> bytes:
        """Return the markers at one time.

        Parameters
        ----------
        time_ns
            The stamp, ns.
        base, target
            Poses (7,) of the base and the target in the world.
        link_R, link_r
            Attitudes (3, 3 L) and positions (3, L) of the links in the base frame, m.
        """
        self._placement.update(base, link_R, link_r)
        count = len(self._placement.poses)
        for place, pose in zip(self._places[:count], self._placement.poses, strict=True):
            place[:] = pose
        if target is not None:
            at = Pose(matrix_from_quaternion(target[3:]), target[:3])
            for place, fixed in zip(self._places[count:], self._of_target, strict=True):
                shape = at @ fixed
                place[:3], place[3:] = shape.r, quaternion_from_matrix(shape.R)
        return self._template.serialised(stamp_bytes(time_ns))
