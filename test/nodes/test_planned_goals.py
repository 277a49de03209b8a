"""Goals whose motions are planned for thrusters, by the nodes, one while another is flown."""

from __future__ import annotations

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node
from scipy.spatial.transform import Rotation

from spacerobot_ros.nodes import FlightNode
from spacerobot_ros.testing import Stack

FIRST = [1.2, -0.4, 0.2], [0.2, -0.1, 0.8]
SECOND = [0.3, -0.9, 0.6], [-0.4, 0.3, 0.2]
MASS, THRUST = 16.0, 0.4 * np.sqrt(3)
"""Of the cube, kg, and a bound of the force of its thrusters in any direction, N."""


def pose(node: Node, goal: tuple[list[float], list[float]]) -> PoseStamped:
    message = PoseStamped()
    message.header.frame_id = "world"
    message.header.stamp = node.get_clock().now().to_msg()
    place, attitude = message.pose.position, message.pose.orientation
    place.x, place.y, place.z = goal[0]
    attitude.x, attitude.y, attitude.z, attitude.w = Rotation.from_rotvec(goal[1]).as_quat()
    return message


def mine(context: rclpy.Context) -> Node:
    return Node("mine", context=context)


def test_a_goal_in_flight_is_flown_from_where_the_robot_is_without_a_stop() -> None:
    with Stack("free_flyer", nodes=("plant", "coordinated_control", mine)) as stack:
        node = stack.nodes["mine"]
        states: list[Odometry] = []
        reached: list[str] = []
        node.create_subscription(Odometry, "odom", states.append, 100)
        node.create_subscription(
            DiagnosticStatus,
            "controller/status",
            lambda status: reached.extend(v.key for v in status.values if v.value == "reached"),
            10,
        )
        goals = node.create_publisher(PoseStamped, "goal_pose", 10)
        for name in ("coordinated_control", "plant"):
            flown = stack.nodes[name]
            assert isinstance(flown, FlightNode)
            flown.require_transition(flown.trigger_activate)
        stack.spin_until(lambda: bool(states) and goals.get_subscription_count() > 0)
        goals.publish(pose(node, FIRST))
        stack.spin_until(lambda: states[-1].pose.pose.position.x > 0.4)
        flying = len(states)
        goals.publish(pose(node, SECOND))
        stack.spin_until(lambda: bool(reached))
    place, attitude = states[-1].pose.pose.position, states[-1].pose.pose.orientation
    assert np.linalg.norm(np.array([place.x, place.y, place.z]) - SECOND[0]) < 5e-3
    ended = Rotation.from_quat([attitude.x, attitude.y, attitude.z, attitude.w])
    assert (ended.inv() * Rotation.from_rotvec(SECOND[1])).magnitude() < 1e-2
    twists = [each.twist.twist for each in states]
    omega = np.array([[t.angular.x, t.angular.y, t.angular.z] for t in twists])
    speeds = np.linalg.norm([[t.linear.x, t.linear.y, t.linear.z] for t in twists], axis=1)
    # The second motion begins at the speed of the first: it does not brake to rest before.
    assert speeds[flying] > 0.02
    assert speeds[flying : flying + 100].min() > 0.2 * speeds[flying]
    assert np.linalg.norm(omega[-1]) < 1e-2
    stamps = np.array([s.header.stamp.sec + 1e-9 * s.header.stamp.nanosec for s in states])
    changes = np.abs(np.diff(speeds)) / np.diff(stamps)
    assert changes.max() < THRUST / MASS * 1.5
