"""A pytest of one's own with the nodes in one executor: they are ordinary rclpy nodes.

Run it with ``pytest examples/test_nodes_in_one_executor.py``.
"""

from collections.abc import Iterator

import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from rclpy.experimental import EventsExecutor
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile

from spacerobot_ros.nodes import PlannerNode, PlantNode


@pytest.fixture
def executor() -> Iterator[EventsExecutor]:
    """An executor with a plant, which waits for each command, and a planner."""
    rclpy.init()
    robot = Parameter("robot", value="sliding_masses")
    lockstep = [robot, Parameter("time_mode", value="lockstep")]
    method = [Parameter("method", value="lie_bracket")]
    nodes = [PlantNode(parameter_overrides=lockstep), PlannerNode(parameter_overrides=method)]
    executor = EventsExecutor()
    for node in nodes:
        executor.add_node(node)
    yield executor
    for node in nodes:
        node.destroy_node()
    rclpy.shutdown()


def test_a_goal_is_reached(executor: EventsExecutor) -> None:
    """Send a goal, spin until the planner says that it is reached."""
    client = rclpy.create_node("client")
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    states: list[str] = []

    def on_status(message: DiagnosticStatus) -> None:
        states.append({pair.key: pair.value for pair in message.values}["state"])
        print(states[-1], message.message)

    client.create_subscription(DiagnosticStatus, "planner/status", on_status, latched)
    goals = client.create_publisher(PoseStamped, "goal_pose", latched)
    goal = PoseStamped()
    goal.header.frame_id = "world"
    goal.pose.position.x, goal.pose.orientation.w = 0.05, 1.0
    goals.publish(goal)
    executor.add_node(client)
    end = client.get_clock().now().nanoseconds + 30_000_000_000
    while "reached" not in states and client.get_clock().now().nanoseconds < end:
        executor.spin_once(timeout_sec=1.0)
    client.destroy_node()
    assert "reached" in states
