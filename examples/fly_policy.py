"""Fly a policy of ``spacerobot/ReorientArm-v0`` through ROS, beside the environment it is from.

Run it with ``python examples/fly_policy.py [FILE]``; the policy is one of ``train_policy.py``.
"""

import sys
from pathlib import Path

import gymnasium
import numpy as np
import rclpy
from nav_msgs.msg import Odometry
from rclpy.experimental import EventsExecutor
from sensor_msgs.msg import JointState

import spacerobot_ros.environments  # noqa: F401 - registers the environments
from spacerobot_ros.environments.tasks import RobotStates, Task, action_scale, command_of
from spacerobot_ros.model.description import Array
from spacerobot_ros.nodes import PlantNode
from spacerobot_ros.scenario import load_scenario

HOLD, STEPS = 10, 20


class PolicyNode(rclpy.node.Node):
    """Answers each state of the plant with the action that the policy holds."""

    def __init__(self, task: Task, goal: Array, weights: Array) -> None:
        super().__init__("policy")
        self.task, self.goal, self.weights, self.ticks = task, goal, weights, 0
        self.observations: list[Array] = []
        self.scale = action_scale(task.robot, "velocity", 0.0, 0.0)
        self.commands = self.create_publisher(JointState, "joint_commands", 100)
        self.create_subscription(Odometry, "odom", self.on_odom, 100)
        self.create_subscription(JointState, "joint_states", self.on_joints, 100)

    def on_odom(self, message: Odometry) -> None:
        """Keep the pose, which comes before the joints of the same tick."""
        p, q = message.pose.pose.position, message.pose.pose.orientation
        self.pose = np.array([[p.x, p.y, p.z, q.x, q.y, q.z, q.w]])
        v, w = message.twist.twist.linear, message.twist.twist.angular
        self.twist = np.array([[v.x, v.y, v.z, w.x, w.y, w.z]])

    def on_joints(self, joints: JointState) -> None:
        """Observe at every tenth state, and command the policy's action for it."""
        if self.ticks % HOLD == 0:
            q, qdot = np.array([[joints.position], [joints.velocity]])
            states = RobotStates(self.pose, self.twist, q, qdot)
            seen = self.task.observe(states, self.task.remaining(states, self.goal))
            self.observations.append(seen[0])
            action = np.tanh(self.weights @ seen[0])
            self.command = command_of([action], self.scale, range(len(self.scale)))[0]
        self.ticks += 1
        velocity = self.command.tolist()
        self.commands.publish(JointState(header=joints.header, name=joints.name, velocity=velocity))


def main(file: Path) -> None:
    """Fly in the environment and through ROS, and print the largest difference."""
    weights, scenario = np.loadtxt(file), load_scenario("arm_attitude")
    env = gymnasium.make("spacerobot/ReorientArm-v0", hold=HOLD, tolerance=1e-9).unwrapped
    seen = [env.reset(options={"goal": scenario.goal.quaternion})[0]]
    while len(seen) <= STEPS:
        seen.append(env.step(np.tanh(weights @ seen[-1]))[0])
    rclpy.init()
    overrides = [rclpy.Parameter(k, value=v) for k, v in scenario.parameters("plant").items()]
    policy = PolicyNode(env.episodes.task, env.episodes.goals, weights)
    plant, executor = PlantNode(parameter_overrides=overrides), EventsExecutor()
    for node in (plant, policy):
        executor.add_node(node)
    while len(policy.observations) <= STEPS:
        executor.spin_once(timeout_sec=1.0)
    first, last = (np.linalg.norm(each[:3]) for each in (seen[0], policy.observations[STEPS]))
    print(f"{STEPS * HOLD} ticks\nerror from {first:.4f} to {last:.4f} rad")
    difference = np.array(policy.observations[: STEPS + 1]) - np.array(seen)
    print(f"largest difference between the environment and ROS: {np.abs(difference).max():.2g}")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if sys.argv[1:] else Path(__file__).parent / "policies/reorient_arm.txt")
