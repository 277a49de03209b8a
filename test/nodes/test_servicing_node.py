"""The controller's node hears of a target, and does tasks on request."""

from __future__ import annotations

from typing import Any

import pytest
from nav_msgs.msg import Odometry
from rclpy.lifecycle import TransitionCallbackReturn
from std_msgs.msg import String
from std_srvs.srv import Trigger
from support.control_loop import TICK_NS, Loop
from support.ros_harness import Harness
from support.sentences import assert_one_sentence

from spacerobot_ros.nodes.common.node import LATCHED
from spacerobot_ros.resources import share_directory

BLOCK = (share_directory() / "config" / "targets" / "block.urdf").read_text()


def asked(loop: Loop, task: str) -> Any:
    client = loop.probe.create_client(Trigger, f"control/{task}")
    return loop.harness.call(client, Trigger.Request())


def test_an_approach_without_a_target_is_refused(harness: Harness) -> None:
    loop = Loop(harness)
    loop.answer()
    refused = asked(loop, "approach")
    assert not refused.success
    assert_one_sentence(refused.message, "no target to approach", "'target/robot_description'")
    assert asked(loop, "detumble").success, "which needs none"


def test_tasks_are_done_on_request(harness: Harness, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SPACEROBOT_COMPILE", "0")
    # The arm grasps obliquely, past a corner of the block.
    loop = Loop(harness, activate=False, **{"target.clearance": 0.0})
    odom = loop.probe.create_publisher(Odometry, "target/odom", 10)
    described = loop.probe.create_publisher(String, "target/robot_description", LATCHED)
    described.publish(String(data=BLOCK))
    harness.connect()
    assert asked(loop, "approach").success is False
    assert loop.node.trigger_activate() is TransitionCallbackReturn.SUCCESS
    loop.answer()
    assert asked(loop, "approach").success is True

    def answer() -> None:
        state = Odometry(child_frame_id="block")
        stamp = divmod((loop.tick + 1) * TICK_NS, 10**9)
        state.header.stamp.sec, state.header.stamp.nanosec = stamp
        state.pose.pose.position.x, state.pose.pose.position.y = 1.9, -0.6
        state.pose.pose.orientation.w = 1.0
        odom.publish(state)
        harness.settle(loop.probe)
        loop.answer()

    answer()  # From now on the target is heard of.
    assert loop.wait_for("tracking").message == "Approaching the target."
    answer()
    answer()
    status = loop.wait_for("tracking")
    assert loop.status["task"] == "approach"
    # The handle is 0.3 m on this side of the block.
    assert "Approaching the target: the end-effector is 0.502 m" in status.message, status
    assert asked(loop, "detumble").message.startswith("The task 'detumble' begins")
    answer()
    harness.spin_until(lambda: loop.status.get("task") == "detumble", "the task")
