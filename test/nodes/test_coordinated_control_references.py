"""References from outside for the controller: waited for, and taken in their own frames."""

from __future__ import annotations

import math

import numpy as np
from nav_msgs.msg import Odometry
from rclpy.lifecycle import TransitionCallbackReturn
from support.control_loop import KD, TICK_NS, Loop, pose
from support.executive_loop import Array
from support.ros_harness import Harness
from support.sentences import assert_one_sentence


class Referenced(Loop):
    """A loop in which somebody publishes a reference of the base before the node is active."""

    def __init__(self, harness: Harness) -> None:
        super().__init__(harness, activate=False)
        self.references = self.probe.create_publisher(Odometry, "base_reference", 10)
        harness.spin_until(lambda: self.node.count_publishers("base_reference"), "its discovery")
        harness.connect()
        assert self.node.trigger_activate() is TransitionCallbackReturn.SUCCESS

    def refer(self, tick: int, speed: float) -> None:
        """Publish the pose of the robot turned by 90 deg about z, moving along its own x."""
        message = Odometry()
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(tick * TICK_NS, 10**9)
        message.pose.pose.orientation.z = message.pose.pose.orientation.w = math.sqrt(0.5)
        message.twist.twist.linear.x = speed
        self.references.publish(message)

    def force(self, speed: float) -> Array:
        """Show a state and its reference; return the force on the base."""
        before = self.probe.count("joint_commands")
        self.show()
        self.harness.settle(self.probe)
        assert self.probe.count("joint_commands") == before, "it waits for the reference"
        self.refer(self.tick, speed)
        # The wrench is published first.
        self.harness.spin_until(lambda: self.probe.count("joint_commands") > before, "a command")
        return self.last_command[0][:3]


def test_a_moving_reference_is_waited_for_and_moves_along_its_own_axes(harness: Harness) -> None:
    loop = Referenced(harness)
    still, moving = loop.force(0.0), loop.force(0.2)
    # Its x is the y of the world, along which the robot has to be pushed.
    push = moving - still
    assert push[1] > 0.1 * 0.2 * KD
    np.testing.assert_allclose(push[[0, 2]], 0.0, atol=1e-9)


def test_the_goal_that_is_refused_is_named(harness: Harness) -> None:
    loop = Loop(harness)
    loop.answer()
    for group, name in (("base", "base"), ("end_effector", "end-effector")):
        loop.aim(**{group: pose([0.0, 0.0, 0.0], frame="moon")})
        status = loop.wait_for("refused")
        assert_one_sentence(status.message, f"The goal of the {name} is in frame 'moon'")
        loop.aim(base=pose([0.1, 0.0, 0.0]))
        loop.answer()
