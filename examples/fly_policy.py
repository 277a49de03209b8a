"""Fly a policy for ``spacerobot/ReorientArm-v0`` over ROS, and compare it with the environment.

Run it with ``python examples/fly_policy.py [FILE]``; the policy comes from ``train_policy.py``.
"""

import sys
from pathlib import Path

import gymnasium
import numpy as np
import rclpy
from nav_msgs.msg import Odometry
from policies.network import Policy
from rclpy.experimental import EventsExecutor
from sensor_msgs.msg import JointState

import spacerobot_ros.environments  # noqa: F401 - registers the environments
from spacerobot_ros.environments.tasks import RobotStates, Task, action_scale, command_of
from spacerobot_ros.model.description import Array
from spacerobot_ros.nodes import PlantNode
from spacerobot_ros.scenario import load_scenario

HOLD, STEPS = 5, 60


class PolicyNode(rclpy.node.Node):
    """Responds to each plant state with the action that the policy holds."""

    def __init__(self, task: Task, goal: Array, policy: Policy) -> None:
        super().__init__("policy")
        self.task, self.goal, self.policy, self.ticks = task, goal, policy, 0
        self.odoms, self.observations = list[Odometry](), list[Array]()
        self.scale = action_scale(task.robot, "velocity", 0.0, 0.0)
        self.commands = self.create_publisher(JointState, "joint_commands", 100)
        self.create_subscription(Odometry, "odom", self.odoms.append, 100)
        self.create_subscription(JointState, "joint_states", self.on_joints, 100)

    def on_joints(self, joints: JointState) -> None:
        """Observe every fifth state, and command the policy's action for it."""
        rates = np.zeros(len(joints.name))
        if self.odoms and self.odoms[-1].header.stamp == joints.header.stamp:  # Odom comes first.
            if self.ticks % HOLD == 0:
                base, twist = self.odoms[-1].pose.pose, self.odoms[-1].twist.twist
                p, o, v, w = base.position, base.orientation, twist.linear, twist.angular
                pose, rate = [p.x, p.y, p.z, o.x, o.y, o.z, o.w], [v.x, v.y, v.z, w.x, w.y, w.z]
                parts = pose, rate, joints.position, joints.velocity
                states = RobotStates(*(np.array([part]) for part in parts))
                seen = self.task.observe(states, self.task.remaining(states, self.goal))
                self.observations.append(seen[0])
                self.held = command_of(self.policy(seen), self.scale, range(len(self.scale)))[0]
            self.ticks, rates = self.ticks + 1, self.held
        answer = JointState(header=joints.header, name=joints.name, velocity=rates.tolist())
        self.commands.publish(answer)


def main(file: Path) -> None:
    """Fly in the environment and over ROS, and print the largest difference."""
    trained, scenario = Policy.load(file), load_scenario("arm_attitude")
    env = gymnasium.make("spacerobot/ReorientArm-v0", hold=HOLD, tolerance=1e-9).unwrapped
    seen = [env.reset(options={"goal": scenario.goal.quaternion})[0]]
    while len(seen) <= STEPS:
        seen.append(env.step(trained(seen[-1]))[0])
    rclpy.init()
    overrides = [rclpy.Parameter(k, value=v) for k, v in scenario.parameters("plant").items()]
    policy = PolicyNode(env.episodes.task, env.episodes.goals, trained)
    plant, executor = PlantNode(parameter_overrides=overrides), EventsExecutor()
    for node in (plant, policy):
        executor.add_node(node)
    while len(policy.observations) <= STEPS:
        executor.spin_once(timeout_sec=1.0)
    flown = np.array(policy.observations[: STEPS + 1])
    errors, difference = np.linalg.norm(flown[:, :3], axis=1), np.abs(flown - seen).max()
    print(f"{STEPS * HOLD} ticks\nerror from {errors[0]:.4f} to {errors.min():.4f} rad")
    print(f"largest difference between the environment and ROS: {difference:.2g}")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if sys.argv[1:] else Path(__file__).parent / "policies/reorient_arm.npz")
