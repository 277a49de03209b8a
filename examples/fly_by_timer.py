"""A commander on a wall timer, without `use_sim_time`, that swings a joint.

Run it with ``python examples/fly_by_timer.py``. A command responds to a plant state, so its
stamp is that of a state, or zero for the current state. The plant refuses wall clock stamps.
"""

import math
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from sensor_msgs.msg import JointState

from spacerobot_ros.nodes import PlantNode

PERIOD, FREQUENCY, AMPLITUDE = 0.1, 0.5, 0.2  # s, Hz, m/s


class TimedCommander(rclpy.node.Node):
    """Commands velocities ten times per second, independent of the plant's rate."""

    def __init__(self, **options: Any) -> None:
        super().__init__("commander", **options)
        self.names: list[str] = []
        self.stamped = False  # With the time of this node
        self.refused = 0
        self.commands = self.create_publisher(JointState, "joint_commands", 10)
        self.create_subscription(JointState, "joint_states", self.on_state, 10)
        self.create_subscription(DiagnosticArray, "/diagnostics", self.on_diagnostics, 10)
        self.create_timer(PERIOD, self.on_time)

    def on_state(self, state: JointState) -> None:
        """Store the joint names: a command must name all joints."""
        self.names = list(state.name)

    def on_time(self) -> None:
        """Send a command; if no commands arrive, the joints come to rest after a while."""
        if not self.names:
            return
        now = self.get_clock().now()
        swing = AMPLITUDE * math.sin(2 * math.pi * FREQUENCY * now.nanoseconds * 1e-9)
        velocity = [swing] + [0.0] * (len(self.names) - 1)
        command = JointState(name=self.names, velocity=velocity)
        if self.stamped:
            command.header.stamp = now.to_msg()
        self.commands.publish(command)

    def on_diagnostics(self, message: DiagnosticArray) -> None:
        """Count the commands refused by the plant."""
        for status in message.status:
            if status.name.endswith("plant: commands"):
                values = {each.key: each.value for each in status.values}
                self.refused = int(values["refused"])


if __name__ == "__main__":
    rclpy.init(args=["--ros-args", "-p", "robot:=sliding_masses"])
    plant, commander = PlantNode(), TimedCommander()
    executor = rclpy.executors.SingleThreadedExecutor()
    for node in (plant, commander):
        executor.add_node(node)
    for stamped, end in ((False, 3.0), (True, 6.0)):
        commander.stamped = stamped
        before, at = plant.plant.q.copy(), commander.refused
        while plant.simulated_time_s < end:
            executor.spin_once()
        stamps = "of the wall clock" if stamped else "zero"
        print(f"stamps {stamps}: {commander.refused - at} commands refused")
        print(f"  joint 1 from {before[0]:.4f} to {plant.plant.q[0]:.4f} m")
