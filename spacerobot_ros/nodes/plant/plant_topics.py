"""The plant's state as messages, each patched in place and published as bytes."""

from __future__ import annotations

from typing import Any

from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, MultiArrayDimension

from spacerobot_ros.errors import ParameterError
from spacerobot_ros.model.rotations import matrix_from_quaternion, quaternion_from_matrix
from spacerobot_ros.nodes.common.cdr import MessageTemplate, stamp_bytes
from spacerobot_ros.nodes.common.markers import LinkMarkers
from spacerobot_ros.nodes.common.node import FlightNode
from spacerobot_ros.simulation.plant import Plant
from spacerobot_ros.simulation.sensors import Sensors

MOMENTUM_LABEL = "linear_x linear_y linear_z angular_x angular_y angular_z kinetic_energy"
"""What the seven numbers of the momentum topic are (kg m/s, kg m^2/s, J; world components)."""

EXPECTED_LABEL = " ".join(MOMENTUM_LABEL.split()[:6])
"""What the six numbers of momentum_expected are: momenta at the start, and by the thrusters."""

DEFAULT_END_EFFECTOR = "end_effector"


class PlantTopics:
    """Publishers of one plant and the serialised messages behind them.

    Parameters
    ----------
    node
        The node that owns the publishers.
    plant
        Whose state they show.
    sensors
        What odom and joint_states carry as soon as they err; the truth then goes to odom_true and
        joint_states_true.
    world_frame, end_effector_frame
        Frame names; an empty end-effector frame means the link ``end_effector``, if there is one.

    Raises
    ------
    ParameterError
        The robot has no link of the name ``end_effector_frame``.
    """

    def __init__(
        self,
        node: FlightNode,
        plant: Plant,
        sensors: Sensors,
        world_frame: str,
        end_effector_frame: str,
        *,
        thrusters: bool,
    ) -> None:
        self._node, self._plant, self._sensors = node, plant, sensors
        self._world_frame = world_frame
        robot = plant.robot

        clock = MessageTemplate(Clock())
        odom = self._odom_template(plant)
        joints = self._joints_template(plant)
        pose_message = PoseStamped()
        pose_message.header.frame_id = world_frame
        base_pose = MessageTemplate(pose_message)
        momentum = MessageTemplate(_labelled(MOMENTUM_LABEL))
        base_pose.feed("pose.position.x", plant.pose)
        momentum.feed("data", plant.momentum)
        # The clock first: whoever sees a state has seen its time.
        self._streams = [
            (node.send_raw(kind, topic), template)
            for kind, topic, template in (
                (Clock, "/clock", clock),
                (PoseStamped, "base_pose", base_pose),
                (Float64MultiArray, "momentum", momentum),
                (Odometry, "odom", odom),
                (JointState, "joint_states", joints),
            )
        ]
        if thrusters:
            expected = MessageTemplate(_labelled(EXPECTED_LABEL))
            expected.feed("data", plant.expected_momenta)
            stream = node.send_raw(Float64MultiArray, "momentum_expected")
            self._streams.insert(3, (stream, expected))
        self._end_effector: tuple[int, Any] | None = None
        self._add_end_effector(node, world_frame, end_effector_frame, pose_message)
        self._base_pose = base_pose
        self._prepare()
        self._measured_odom: MessageTemplate | None = None
        if sensors.used:
            self._show_measurements()
        self._markers = LinkMarkers(node, robot.description, world_frame)

    def _prepare(self) -> None:
        self._without_pose = [each for each in self._streams if each[1] is not self._base_pose]

    def _show_measurements(self) -> None:
        """From now on publish what is measured, and before it the truth on topics of its own."""
        (odom_topic, odom), (joints_topic, joints) = self._streams[-2:]
        self._measured_odom = self._odom_template(self._sensors)
        self._streams[-2:] = [
            (self._node.send_raw(Odometry, "odom_true"), odom),
            (self._node.send_raw(JointState, "joint_states_true"), joints),
            (odom_topic, self._measured_odom),
            (joints_topic, self._joints_template(self._sensors)),
        ]
        self._prepare()

    def _odom_template(self, source: Plant | Sensors) -> MessageTemplate:
        message = Odometry(child_frame_id=self._plant.robot.base_link)
        message.header.frame_id = self._world_frame
        template = MessageTemplate(message)
        template.feed("pose.pose.position.x", source.pose)
        template.feed("twist.twist.linear.x", source.twist)
        return template

    def _joints_template(self, source: Plant | Sensors) -> MessageTemplate:
        robot = self._plant.robot
        zeros = [0.0] * robot.n
        message = JointState(
            name=list(robot.joint_names), position=zeros, velocity=zeros, effort=zeros
        )
        message.header.frame_id = robot.base_link
        template = MessageTemplate(message)
        if robot.n:
            template.feed("position", source.q)
            template.feed("velocity", source.qdot)
            template.feed("effort", self._plant.effort)
        return template

    def publish(self, time_ns: int, *, with_pose: bool) -> None:
        """Publish the plant's state, stamped ``time_ns``; ``with_pose``: base_pose too."""
        if self._end_effector is not None:
            index, target = self._end_effector
            R_WB, r_WB = self._base()
            target[:3] = r_WB + R_WB @ self._plant.link_r[:, index]
            R_WE = R_WB @ self._plant.link_R[:, 3 * index : 3 * index + 3]
            target[3:] = quaternion_from_matrix(R_WE)
        if self._sensors.used and self._measured_odom is None:
            self._show_measurements()
        lost = self._measured_odom if self._sensors.dropout else None
        stamp = stamp_bytes(time_ns)
        for stream, template in self._streams if with_pose else self._without_pose:
            if template is not lost:
                stream.take(template.serialised(stamp))

    def publish_markers(self, time_ns: int) -> None:
        """Publish the links' shapes where they are."""
        self._markers.publish(time_ns, self._base(), self._plant.link_R, self._plant.link_r)

    def readers(self) -> int:
        """Return how many subscriptions the state topics have now."""
        return sum(stream.readers() for stream, _ in self._streams)

    def _base(self) -> tuple[Any, Any]:
        return matrix_from_quaternion(self._plant.pose[3:]), self._plant.pose[:3]

    def _add_end_effector(
        self, node: FlightNode, world_frame: str, name: str, prototype: PoseStamped
    ) -> None:
        links = self._plant.robot.link_names
        if not name and DEFAULT_END_EFFECTOR not in links:
            return
        name = name or DEFAULT_END_EFFECTOR
        if name not in links:
            raise ParameterError(
                f"Parameter 'end_effector_frame' is '{name}', but the robot has no such link; "
                f"it has {', '.join(links)}."
            )
        template = MessageTemplate(prototype)
        stream = node.send_raw(PoseStamped, "end_effector_pose")
        # Before odom and joint_states, which set the commanders off.
        self._streams.insert(2, (stream, template))
        self._end_effector = links.index(name), template.floats("pose.position.x", 7)


def _labelled(label: str) -> Float64MultiArray:
    """Return an array with one number for each word of its label."""
    size = len(label.split())
    message = Float64MultiArray(data=[0.0] * size)
    message.layout.dim = [MultiArrayDimension(label=label, size=size, stride=size)]
    return message
