"""A custom planner on the stack's topics: state feedback from odom and joint_states.

Run it with ``python examples/fly_own_planner.py``.
"""

from typing import Any

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from geometry_msgs.msg import Point, Pose, PoseStamped
from nav_msgs.msg import Odometry
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import JointState

from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.nodes import PlantNode
from spacerobot_ros.resources import robot_file


def arrays(pose: Pose) -> tuple[Array, Rotation]:
    """Return the position and attitude in a message."""
    p, o = pose.position, pose.orientation
    return np.array([p.x, p.y, p.z]), Rotation.from_quat([o.x, o.y, o.z, o.w])


class FeedbackPlanner(rclpy.node.Node):
    """Commands joint rates such that the base error decays as ``exp(-t)``."""

    def __init__(self, robot: SpaceRobot, **options: Any) -> None:
        super().__init__("planner", **options)
        self.robot, self.tolerance, self.state = robot, 1e-3, "idle"
        self.odom: Odometry | None = None
        self.commands = self.create_publisher(JointState, "joint_commands", 10)
        self.statuses = self.create_publisher(DiagnosticStatus, "planner/status", 10)
        self.create_subscription(PoseStamped, "goal_pose", self.on_goal, 10)
        self.create_subscription(Odometry, "odom", self.on_odom, 10)
        self.create_subscription(JointState, "joint_states", self.on_joints, 10)

    def on_goal(self, message: PoseStamped) -> None:
        """Fly to another goal."""
        self.goal = arrays(message.pose)
        self.tell("executing")

    def on_odom(self, message: Odometry) -> None:
        """Store the base state, which arrives before the joints with the same stamp."""
        self.odom = message

    def on_joints(self, joints: JointState) -> None:
        """Respond to every state with its stamp: the plant refuses any other."""
        names, rates, odom = self.robot.joint_names, np.zeros(self.robot.n), self.odom
        if self.state == "executing" and odom and odom.header.stamp == joints.header.stamp:
            q = np.array([joints.position[joints.name.index(name)] for name in names])
            (r_WB, R_WB), (r_goal, R_goal) = arrays(odom.pose.pose), self.goal
            error_B = R_WB.inv().apply(r_goal - r_WB), (R_WB.inv() * R_goal).as_rotvec()
            if max(map(np.linalg.norm, error_B)) <= self.tolerance:
                self.tell("reached")
            else:  # Momentum is conserved: the twist of the base is -A(q) times the rates.
                rates = -np.linalg.pinv(self.robot.connection(q)) @ np.concatenate(error_B)
        self.commands.publish(JointState(header=joints.header, name=names, velocity=rates.tolist()))

    def tell(self, state: str) -> None:
        """Publish the goal state, for planner clients."""
        self.state, values = state, [KeyValue(key="state", value=state)]
        self.statuses.publish(DiagnosticStatus(name="planner", message=state, values=values))


if __name__ == "__main__":
    rclpy.init()
    given = {"robot": "sliding_masses", "time_mode": "lockstep"}
    plant = PlantNode(parameter_overrides=[rclpy.Parameter(k, value=v) for k, v in given.items()])
    planner = FeedbackPlanner(SpaceRobot.from_file(robot_file(given["robot"])))
    planner.on_goal(PoseStamped(pose=Pose(position=Point(x=0.05, y=-0.03))))
    executor = rclpy.executors.SingleThreadedExecutor()
    for node in (plant, planner):
        executor.add_node(node)
    while planner.state != "reached":
        executor.spin_once(timeout_sec=1.0)
    print(planner.state, f"{plant.time_ns / 1e9:g} s", plant.plant.pose, plant.plant.q, sep="\n")
