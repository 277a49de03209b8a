"""The coordinated-control node while measurements of the base are missing, and after."""

from __future__ import annotations

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from sensor_msgs.msg import JointState
from support.control_loop import JOINTS, KP, STATUS, TICK_NS, Loop, pose
from support.ros_harness import Harness, nanoseconds
from support.sentences import assert_one_sentence

from spacerobot_ros.nodes import CoordinatedControlNode


def test_without_odom_the_base_is_estimated_and_then_the_thrusters_are_off(
    harness: Harness,
) -> None:
    loop = Loop(harness, estimation_time=0.05)
    loop.aim(base=pose([1.0, 0.0, 0.0]))
    measured = loop.answer()[0]
    loop.wait_for("tracking")
    # The first state without odom is known to be one when the next joints come; those are answered
    # at once, and so are all that follow.
    loop.show(odom=False)
    harness.settle(loop.probe)
    for _ in range(4):
        wrench, _ = loop.answer(odom=False)
        assert nanoseconds(loop.probe.last("base_wrench").header.stamp) == loop.tick * TICK_NS
        # Hardly anything moves in five ticks, nor does the command.
        np.testing.assert_allclose(wrench, measured, atol=0.15 * np.abs(measured).max())
        assert wrench[0] < measured[0]
        status = loop.wait_for("estimating")
        assert status.level == DiagnosticStatus.WARN
    loop.rates = np.array([0.1, -0.2])
    loop.show(odom=False)
    harness.spin_until(lambda: loop.status["state"] == "stopped", "the stop")
    assert loop.probe.last(STATUS).level == DiagnosticStatus.ERROR
    for _ in range(3):
        wrench, effort = loop.answer(odom=False)
        np.testing.assert_array_equal(wrench, np.zeros(6))
    # The joints are slowed: their efforts take energy out of them.
    assert effort @ loop.rates < 0.0
    assert_one_sentence(loop.probe.last(STATUS).message, "thrusters off")
    loop.rates = np.zeros(2)
    loop.show(odom=True)
    harness.spin_until(lambda: loop.status["state"] == "tracking", "the loop again")
    wrench, _ = loop.answer()
    np.testing.assert_allclose(wrench[:3], [KP, 0.0, 0.0], atol=1e-12)


def test_without_odom_from_the_beginning_nothing_is_thrust(harness: Harness) -> None:
    loop = Loop(harness)
    loop.aim(base=pose([1.0, 0.0, 0.0]))
    loop.show(odom=False)
    harness.settle(loop.probe)
    for _ in range(3):
        np.testing.assert_array_equal(loop.answer(odom=False)[0], np.zeros(6))
    assert loop.wait_for("waiting").level == DiagnosticStatus.OK
    loop.show(odom=True)
    loop.wait_for("tracking")
    np.testing.assert_allclose(loop.answer()[0][:3], [KP, 0.0, 0.0], atol=1e-12)


def test_a_pose_that_was_never_met_is_not_lost(harness: Harness) -> None:
    node = harness.make(
        CoordinatedControlNode, {"robot": "planar_manipulator", "tick_rate": 100.0}, name="control"
    )
    probe = harness.probe({STATUS: DiagnosticStatus}, latched=(STATUS,))
    joints = probe.create_publisher(JointState, "joint_states", 10)
    harness.matched(joints)
    for tick in range(1, 6):
        message = JointState(name=JOINTS, position=[0.1, 0.2], velocity=[0.0] * 2, effort=[0.0] * 2)
        message.header.stamp.nanosec = tick * TICK_NS
        joints.publish(message)
        harness.settle(probe)
    assert node.is_active
    states = {
        pair.value
        for status in probe.messages[STATUS]
        for pair in status.values
        if pair.key == "state"
    }
    assert states == {"waiting"}, "nothing is stopped before anything began"
    assert {status.level for status in probe.messages[STATUS]} == {DiagnosticStatus.OK}
