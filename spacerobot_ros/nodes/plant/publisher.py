"""The state of a plant as messages, each serialised once and patched in place."""

from __future__ import annotations

import time
from typing import Any

from rclpy.duration import Duration
from rclpy.serialization import serialize_message
from std_msgs.msg import String
from visualization_msgs.msg import Marker, MarkerArray

from spacerobot_ros.messages.builders import state_message
from spacerobot_ros.messages.readers import MessageTemplate
from spacerobot_ros.messages.transforms import STATIC_TRANSFORMS, TRANSFORMS, RobotTransforms
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Pose
from spacerobot_ros.model.rotations import matrix_from_quaternion, quaternion_from_matrix
from spacerobot_ros.nodes.common.messages import message_class, shape_marker, transform_class
from spacerobot_ros.nodes.common.node import LATCHED, STREAM, FlightNode
from spacerobot_ros.nodes.common.streams import RawOutput
from spacerobot_ros.simulation.config import PlantConfig
from spacerobot_ros.simulation.plant import Plant
from spacerobot_ros.simulation.sensors import ReportedState
from spacerobot_ros.times import stamp_bytes
from spacerobot_ros.topics import TOPICS, Topic

MARKERS = "visualization_msgs/msg/MarkerArray"

_PATIENCE = 0.5
"""Longest wait for readers, wall s."""


class StatePublisher:
    """Publishes the state topics that the table of topics lists for a plant.

    Parameters
    ----------
    node
        The node that owns the publishers.
    robot
        Whose state it is.
    state
        What it reports.
    config
        Names of the frames.
    """

    def __init__(
        self, node: FlightNode, robot: SpaceRobot, state: ReportedState, config: PlantConfig
    ) -> None:
        self._node, self._robot, self._state = node, robot, state
        self._world = config.world_frame
        self._base = config.frame_prefix + robot.base_link
        self._outputs: dict[str, RawOutput] = {}
        self._readers: frozenset[bytes] = frozenset()
        self._matched = 0
        self._description = node.create_publisher(String, "robot_description", LATCHED)
        self.rebuild()

    def rebuild(self) -> None:
        """Publish from now on the quantities that the state has now."""
        clock = TOPICS["/clock"]
        streams = [
            (topic, self._output(topic), self._template(topic))
            for topic in (clock, *self._state.topics)
        ]
        self._all = [(output, template) for _, output, template in streams]
        self._every_tick = [
            (output, template) for topic, output, template in streams if topic.every_tick
        ]
        (self._odom,) = (template for topic, _, template in streams if topic.name == "odom")

    def publish_description(self) -> None:
        """Publish the URDF."""
        self._description.publish(String(data=self._robot.description.urdf))

    def publish(self, time_ns: int, *, all_topics: bool) -> None:
        """Publish the state, stamped ``time_ns``.

        ``all_topics``: those too that are not published in every tick.
        """
        lost = self._odom if self._state.sensors.dropout else None
        stamp = stamp_bytes(time_ns)
        for output, template in self._all if all_topics else self._every_tick:
            if template is not lost:
                output.take(template.serialised(stamp))

    def has_new_readers(self) -> bool:
        """Whether the state has a subscriber that it did not have at the last call.

        Takes a millisecond. A subscription that is replaced by another leaves their number; one
        that is known of may be matched later.
        """
        outputs = self._outputs.values()
        readers = frozenset(
            bytes(reader.endpoint_gid)
            for output in outputs
            for reader in self._node.get_subscriptions_info_by_topic(output.topic)
        )
        matched = sum(output.readers() for output in outputs)
        new = bool(readers - self._readers) or matched > self._matched
        self._readers, self._matched = readers, matched
        return new

    def await_readers(self) -> None:
        """Wait until all readers have received the states, but not for one that has stopped."""
        end = time.monotonic() + _PATIENCE
        for output in self._outputs.values():
            left = max(0.0, end - time.monotonic())
            if not output.await_readers(Duration(seconds=left)):
                return

    def _output(self, topic: Topic) -> RawOutput:
        if topic.name not in self._outputs:
            self._outputs[topic.name] = self._node.send_raw(message_class(topic.type), topic.name)
        return self._outputs[topic.name]

    def _template(self, topic: Topic) -> MessageTemplate:
        """Return the message of a topic, fed with the quantities that it carries."""
        names = self._state.names(topic)
        prototype = state_message(topic, names, self._world, self._base)
        template = MessageTemplate(topic.type, prototype)
        if topic.name == "odom" and self._state.sensors.used:
            template.feed("pose.covariance", self._state.sensors.pose_covariance)
            template.feed("twist.covariance", self._state.sensors.twist_covariance)
        for field in topic.state:
            values = self._state.quantities[field.quantity]
            if values.size:
                template.feed(field.columns[0], values)
        return template


class TransformPublisher:
    """The measured frames of a robot on /tf, and those that do not move on /tf_static.

    Without ``tf2_msgs`` there is nothing to publish with; bags have transforms all the same.
    """

    def __init__(
        self, node: FlightNode, robot: SpaceRobot, state: ReportedState, config: PlantConfig
    ) -> None:
        self._state, self._kind = state, transform_class()
        if self._kind is None or not config.tf_period:
            self.publishes = False
            return
        self.publishes = True
        self._frames = RobotTransforms(
            robot.description, config.world_frame, config.frame_prefix, links=config.tf_links
        )
        self._stream = node.send_raw(self._kind, TRANSFORMS)
        self._static: RawOutput | None = None
        if self._frames.static_message(0) is not None:
            self._static = node.send_raw(self._kind, STATIC_TRANSFORMS, LATCHED)

    def publish_static(self, time_ns: int) -> None:
        """Publish what does not move."""
        if self._static is not None:
            self._static.take(self._frames.static_message(time_ns) or b"")

    def publish(self, time_ns: int) -> None:
        """Publish the state that was reported last; without a pose there is nothing to say."""
        if not self._state.sensors.dropout:
            quantities = self._state.quantities
            self._stream.take(
                self._frames.message(time_ns, quantities["measured_pose"], quantities["measured_q"])
            )


class LinkMarkers:
    """All visuals of a robot as one marker array in the world frame.

    World poses, not link frames: a viewer then needs no transforms.
    """

    def __init__(self, node: FlightNode, plant: Plant, world_frame: str) -> None:
        self._plant = plant
        self._poses: list[tuple[int, Pose]] = []
        markers: list[Marker] = []
        for index, link in enumerate(plant.robot.description.links):
            for shape in link.shapes:
                markers.append(shape_marker(shape, world_frame, link.name, len(markers)))
                self._poses.append((index, shape.pose))
        self._publisher: Any = node.create_publisher(MarkerArray, "markers", STREAM)
        self._template = MessageTemplate(MARKERS, serialize_message(MarkerArray(markers=markers)))
        self._targets = [
            self._template.floats(f"markers[{i}].pose.position.x", 7) for i in range(len(markers))
        ]

    def publish(self, time_ns: int) -> None:
        """Publish every shape where it is."""
        if not self._targets:
            return
        plant = self._plant
        R_WB, r_WB = matrix_from_quaternion(plant.pose[3:]), plant.pose[:3]
        for (index, pose), target in zip(self._poses, self._targets, strict=True):
            R_BL = plant.link_R[:, 3 * index : 3 * index + 3]
            target[:3] = r_WB + R_WB @ (plant.link_r[:, index] + R_BL @ pose.r)
            target[3:] = quaternion_from_matrix(R_WB @ R_BL @ pose.R)
        self._publisher.publish(self._template.serialised(stamp_bytes(time_ns)))
