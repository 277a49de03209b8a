"""The plant's state as messages, each patched in place and published as bytes."""

from __future__ import annotations

from typing import Any

from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, MultiArrayDimension

from spacerobot_ros.errors import ParameterError
from spacerobot_ros.model.attitude import matrix_from_quaternion, quaternion_from_matrix
from spacerobot_ros.nodes.cdr import MessageTemplate, raw_publish, stamp_bytes
from spacerobot_ros.nodes.flight_node import STREAM
from spacerobot_ros.nodes.markers import LinkMarkers
from spacerobot_ros.simulation.plant import Plant

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
    world_frame, end_effector_frame
        Frame names; an empty end-effector frame means the link ``end_effector``, if there is one.

    Raises
    ------
    ParameterError
        The robot has no link of the name ``end_effector_frame``.
    """

    def __init__(
        self,
        node: Node,
        plant: Plant,
        world_frame: str,
        end_effector_frame: str,
        *,
        thrusters: bool,
    ) -> None:
        self._plant = plant
        robot = plant.robot
        n = robot.n

        clock = MessageTemplate(Clock())
        odom_message = Odometry(child_frame_id=robot.base_link)
        odom_message.header.frame_id = world_frame
        odom = MessageTemplate(odom_message)
        pose_message = PoseStamped()
        pose_message.header.frame_id = world_frame
        base_pose = MessageTemplate(pose_message)
        joints_message = JointState(
            name=list(robot.joint_names), position=[0.0] * n, velocity=[0.0] * n, effort=[0.0] * n
        )
        joints_message.header.frame_id = robot.base_link
        joints = MessageTemplate(joints_message)
        momentum = MessageTemplate(_labelled(MOMENTUM_LABEL))

        odom.feed("pose.pose.position.x", plant.pose)
        odom.feed("twist.twist.linear.x", plant.twist)
        base_pose.feed("pose.position.x", plant.pose)
        momentum.feed("data", plant.momentum)
        if n:
            joints.feed("position", plant.q)
            joints.feed("velocity", plant.qdot)
            joints.feed("effort", plant.effort)
        # The clock first: whoever sees a state has seen its time.
        self._streams = [
            (node.create_publisher(kind, topic, STREAM), template)
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
            publisher = node.create_publisher(Float64MultiArray, "momentum_expected", STREAM)
            self._streams.insert(3, (publisher, expected))
        self._end_effector: tuple[int, Any] | None = None
        self._add_end_effector(node, world_frame, end_effector_frame, pose_message)
        self._sends = [(raw_publish(publisher), template) for publisher, template in self._streams]
        self._sends_without_pose = [send for send in self._sends if send[1] is not base_pose]
        self._markers = LinkMarkers(node, robot.description, world_frame)

    def publish(self, time_ns: int, *, with_pose: bool) -> None:
        """Publish the plant's state, stamped ``time_ns``; ``with_pose``: base_pose too."""
        if self._end_effector is not None:
            index, target = self._end_effector
            R_WB, r_WB = self._base()
            target[:3] = r_WB + R_WB @ self._plant.link_r[:, index]
            R_WE = R_WB @ self._plant.link_R[:, 3 * index : 3 * index + 3]
            target[3:] = quaternion_from_matrix(R_WE)
        stamp = stamp_bytes(time_ns)
        for send, template in self._sends if with_pose else self._sends_without_pose:
            send(template.serialised(stamp))

    def publish_markers(self, time_ns: int) -> None:
        """Publish the links' shapes where they are."""
        self._markers.publish(time_ns, self._base(), self._plant.link_R, self._plant.link_r)

    def readers(self) -> int:
        """Return how many subscriptions the state topics have now."""
        return sum(publisher.get_subscription_count() for publisher, _ in self._streams)

    def _base(self) -> tuple[Any, Any]:
        return matrix_from_quaternion(self._plant.pose[3:]), self._plant.pose[:3]

    def _add_end_effector(
        self, node: Node, world_frame: str, name: str, prototype: PoseStamped
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
        publisher = node.create_publisher(PoseStamped, "end_effector_pose", STREAM)
        # Before odom and joint_states, which set the commanders off.
        self._streams.insert(2, (publisher, template))
        self._end_effector = links.index(name), template.floats("pose.position.x", 7)


def _labelled(label: str) -> Float64MultiArray:
    """Return an array with one number for each word of its label."""
    size = len(label.split())
    message = Float64MultiArray(data=[0.0] * size)
    message.layout.dim = [MultiArrayDimension(label=label, size=size, stride=size)]
    return message
