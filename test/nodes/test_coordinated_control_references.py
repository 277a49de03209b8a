"""References from outside for the controller: waited for, and taken in their own frames."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from nav_msgs.msg import Odometry
from rclpy.lifecycle import TransitionCallbackReturn
from support.control_loop import KD, STATUS, TICK_NS, Loop, pose
from support.executive_loop import Array
from support.ros_harness import Harness, nanoseconds
from support.sentences import assert_one_sentence


class Referenced(Loop):
    """A loop in which somebody publishes a reference of the base before the node is active."""

    def __init__(self, harness: Harness, **settings: Any) -> None:
        super().__init__(harness, activate=False, **settings)
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


def test_a_silent_reference_is_done_without_until_it_comes_again(harness: Harness) -> None:
    """A plant in lockstep: its time stands still until each state is answered."""
    loop = Referenced(harness, reference_timeout=0.3)
    # Its publisher has sent nothing yet.
    np.testing.assert_allclose(np.concatenate(loop.answer()), 0.0, atol=1e-9)
    said = " No reference comes on base_reference."
    harness.spin_until(lambda: loop.probe.last(STATUS).message.endswith(said), "a status")
    assert loop.status["state"] == "holding"
    loop.place = np.array([0.1, 0.0, 0.0])
    assert abs(loop.answer()[0][0]) > 1.0, "the pose of the first state is held, without a delay"
    loop.refer(loop.tick, 0.0)
    harness.settle(loop.probe)
    assert abs(loop.force(0.2)[1]) > 0.1 * 0.2 * KD
    harness.spin_until(
        lambda: loop.probe.last(STATUS).message.startswith("Following references; "), "a status"
    )
    # It is silent again: the robot holds where it is.
    np.testing.assert_allclose(np.concatenate(loop.answer()), 0.0, atol=1e-9)
    harness.spin_until(
        lambda: loop.probe.last(STATUS).message.startswith("Waiting for a goal; holding, 0 m"),
        "a status",
    )


def test_a_goal_is_reached_although_a_reference_is_silent(harness: Harness) -> None:
    loop = Referenced(harness, reference_timeout=0.2, settle_time=0.02)
    loop.aim(base=pose([0.0, 0.0, 0.0]))
    for _ in range(4):
        loop.answer()
    assert "base_reference" in loop.wait_for("reached").message


def test_in_real_time_a_silent_reference_costs_no_answer_and_odom_is_not_blamed(
    harness: Harness,
) -> None:
    """States go on: each is answered when the next one comes, until the reference is given up."""
    loop = Referenced(harness, reference_timeout=0.05)
    for _ in range(10):
        loop.show()
        harness.settle(loop.probe)
    stamps = [nanoseconds(each.header.stamp) for each in loop.probe.messages["base_wrench"]]
    assert stamps == [TICK_NS * tick for tick in range(1, 11)]
    states = [value_of(each, "state") for each in loop.probe.messages[STATUS]]
    assert set(states) == {"waiting", "holding"}
    assert loop.probe.last(STATUS).message.endswith(" No reference comes on base_reference.")


def test_without_a_timeout_states_wait_for_references(harness: Harness) -> None:
    loop = Referenced(harness, reference_timeout=0.0)
    loop.force(0.0)


def value_of(status: DiagnosticStatus, key: str) -> str:
    return next(pair.value for pair in status.values if pair.key == key)


def test_the_goal_that_is_refused_is_named(harness: Harness) -> None:
    loop = Loop(harness)
    loop.answer()
    for group, name in (("base", "base"), ("end_effector", "end-effector")):
        loop.aim(**{group: pose([0.0, 0.0, 0.0], frame="moon")})
        status = loop.wait_for("refused")
        assert_one_sentence(status.message, f"The goal of the {name} is in frame 'moon'")
        loop.aim(base=pose([0.1, 0.0, 0.0]))
        loop.answer()
