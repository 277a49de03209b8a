"""A custom pytest that runs the stack's nodes and a custom node in one executor.

Run it with ``pytest examples/test_nodes_in_one_executor.py``.
"""

import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.qos import DurabilityPolicy, QoSProfile

from spacerobot_ros.testing import Stack

LATCHED = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class Listener(rclpy.node.Node):
    """Stores the planner's states in order."""

    def __init__(self, context: rclpy.Context) -> None:
        super().__init__("listener", context=context)
        self.states: list[str] = []
        self.create_subscription(DiagnosticStatus, "planner/status", self.on_status, LATCHED)

    def on_status(self, message: DiagnosticStatus) -> None:
        """Store the state in a status."""
        self.states.append({pair.key: pair.value for pair in message.values}["state"])


def test_a_goal_is_reached() -> None:
    """Fly in lockstep, as fast as possible; the second goal starts where the first one ended."""
    method = {"planner": {"method": "lie_bracket"}}
    with Stack("sliding_masses", ["plant", "planner", Listener], method) as stack:
        assert stack.fly_to(x=0.05).reached
        assert stack.fly_to(y=0.02, rotvec=(0.0, 0.0, 0.01)).reached
        assert not stack.fly_to(x=9.0).reached
        states = stack.nodes["listener"].states
        stack.spin_until(lambda: states[-1] == "refused")
    assert states.count("reached") == 2
