"""The robot as markers for RViz and Foxglove."""

from __future__ import annotations

from rclpy.node import Node
from visualization_msgs.msg import Marker, MarkerArray

from spacerobot_ros.model.description import Array, Pose, RobotDescription, Shape
from spacerobot_ros.model.rotations import quaternion_from_matrix
from spacerobot_ros.nodes.common.cdr import MessageTemplate, stamp_bytes
from spacerobot_ros.nodes.common.node import STREAM

_KINDS = {
    "box": Marker.CUBE,
    "cylinder": Marker.CYLINDER,
    "sphere": Marker.SPHERE,
    "mesh": Marker.MESH_RESOURCE,
}


def shape_marker(shape: Shape, frame: str, namespace: str, number: int) -> Marker:
    """Return the marker of a URDF visual, its pose left open."""
    marker = Marker(ns=namespace, id=number, type=_KINDS[shape.kind], action=Marker.ADD)
    marker.header.frame_id = frame
    size = shape.size
    if shape.kind == "cylinder":
        size = (2 * size[0], 2 * size[0], size[1])
    elif shape.kind == "sphere":
        size = (2 * size[0],) * 3
    marker.scale.x, marker.scale.y, marker.scale.z = (float(x) for x in size)
    marker.color.r, marker.color.g, marker.color.b, marker.color.a = (float(x) for x in shape.rgba)
    marker.mesh_resource = shape.resource
    return marker


class LinkMarkers:
    """All visuals of a robot as one marker array in the world frame.

    World poses, not link frames: a viewer then needs no transforms.
    """

    def __init__(self, node: Node, robot: RobotDescription, world_frame: str) -> None:
        self._poses: list[tuple[int, Pose]] = []
        markers: list[Marker] = []
        for index, link in enumerate(robot.links):
            for shape in link.shapes:
                markers.append(shape_marker(shape, world_frame, link.name, len(markers)))
                self._poses.append((index, shape.pose))
        self._publisher = node.create_publisher(MarkerArray, "markers", STREAM)
        self._template = MessageTemplate(MarkerArray(markers=markers))
        self._targets = [
            self._template.floats(f"markers[{i}].pose.position.x", 7) for i in range(len(markers))
        ]

    def publish(
        self, time_ns: int, base: tuple[Array, Array], link_R: Array, link_r: Array
    ) -> None:
        """Publish every shape at ``base`` = (R_WB, r_WB) and the links' poses in B."""
        if not self._targets:
            return
        R_WB, r_WB = base
        for (index, pose), target in zip(self._poses, self._targets, strict=True):
            R_BL = link_R[:, 3 * index : 3 * index + 3]
            target[:3] = r_WB + R_WB @ (link_r[:, index] + R_BL @ pose.r)
            target[3:] = quaternion_from_matrix(R_WB @ R_BL @ pose.R)
        self._publisher.publish(self._template.serialised(stamp_bytes(time_ns)))
