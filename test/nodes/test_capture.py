"""Targets: captured and released on request, and the tasks that lead to that."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from nav_msgs.msg import Odometry
from rclpy.lifecycle import TransitionCallbackReturn
from std_msgs.msg import Float64MultiArray, String
from support.control_loop import TICK_NS, Loop
from support.made_bags import array, joint_states, made_bag, odometry
from support.planner_flight import values_of
from support.plant_rig import Rig, pose_of, twist_of
from support.ros_harness import Harness
from support.sentences import assert_one_sentence
from visualization_msgs.msg import MarkerArray

from spacerobot_ros.nodes import PlantNode
from spacerobot_ros.nodes.common.node import LATCHED
from spacerobot_ros.resources import share_directory

BLOCK = share_directory() / "config" / "targets" / "block.urdf"
JOINTS = ["shoulder", "elbow"]
PARAMETERS: dict[str, Any] = {
    "robot": "planar_manipulator",
    "initial_center_of_mass": [0.0, 0.0, 0.0],
    "initial_orientation": [0.0, 0.0, 0.18223552549214747, 0.9832549075639546],
    "initial_joint_positions": [-1.0122909661567112, 1.0524335389525807],
    "marker_period": 0.05,
    "target.robot": str(BLOCK),
    "target.position": [2.3000768148, -0.0023734357, 0.0],
    "target.velocity": [-0.05, 0.02, 0.0],
    "target.angular_velocity": [0.0, 0.0, 0.1],
    "capture.angle": 0.5,
    "capture.rate": 0.2,
}
TARGET_TOPICS = {
    "target/odom": Odometry,
    "target/robot_description": String,
    "momentum_expected": Float64MultiArray,
    "plant/status": DiagnosticStatus,
    "events": DiagnosticStatus,
    "markers": MarkerArray,
}


def events_of(rig: Rig) -> list[tuple[str, str]]:
    found = [values_of(each) for each in rig.probe.messages["events"]]
    return [
        (each["event"], each["time"])
        for each in found
        if each["event"] in ("captured", "released", "reset")
    ]


def test_a_target_is_captured_and_released_on_request(harness: Harness) -> None:
    rig = Rig(harness, PARAMETERS, topics=TARGET_TOPICS)
    assert rig.wait("target/robot_description", 1).data == BLOCK.read_text(encoding="utf-8")
    refused = rig.trigger("plant/release")
    assert (refused.success, refused.message) == (False, "'end_effector' does not hold a target.")
    first = rig.wait("target/odom", 1)
    assert (first.header.frame_id, first.child_frame_id) == ("world", "block")
    assert first.pose.pose.position.x == pytest.approx(2.3000768148)
    assert first.twist.twist.linear.y == pytest.approx(0.02)

    captured = rig.trigger("plant/capture")
    assert captured.success
    assert captured.message.startswith("The target is captured by an impulse of 0.1286 N s and ")
    again = rig.trigger("plant/capture")
    assert not again.success
    assert again.message.startswith("'end_effector' already holds the target 'block'")
    rig.step([0.0, 0.0], JOINTS)
    harness.spin_until(lambda: bool(events_of(rig)), "the event of the capture")
    assert events_of(rig) == [("captured", "0.000000000")]
    assert '"mass": 10.0' in values_of(rig.probe.last("plant/status"))["payload"]
    momentum = rig.wait("momentum", 2).data
    np.testing.assert_allclose(momentum[:6], [-0.5, 0.2, 0, 0, 0, 0.4783324], atol=1e-7)
    expected = rig.wait("momentum_expected", 2).data
    np.testing.assert_allclose(expected, momentum[:6], rtol=0, atol=1e-14)
    assert rig.diagnosis("momentum").level == DiagnosticStatus.OK

    assert rig.trigger("plant/release").success
    rig.step([0.0, 0.0], JOINTS)
    harness.spin_until(lambda: len(events_of(rig)) == 2, "the event of the release")
    assert events_of(rig)[1] == ("released", "0.050000000")
    assert "payload" not in values_of(rig.probe.last("plant/status"))
    # The last visual of the robot is followed by the two of the target.
    markers = rig.wait("markers", 3).markers
    assert [each.ns for each in markers[-2:]] == ["target", "target"]
    at = rig.wait("target/odom", 3).pose.pose.position
    assert markers[-2].pose.position.x == pytest.approx(at.x)
    assert markers[-2].pose.position.y == pytest.approx(at.y)


@pytest.mark.parametrize("held", [True, False])
def test_a_plant_that_was_killed_goes_on_with_the_body_that_it_holds(
    harness: Harness, tmp_path: Path, held: bool
) -> None:
    rig = Rig(harness, PARAMETERS, topics=TARGET_TOPICS)
    if held:
        assert rig.trigger("plant/capture").success
    for _ in range(3):
        rig.step([0.0, 0.0], JOINTS)
    rig.wait("target/odom", 4)
    harness.settle(rig.probe)
    before = {name: rig.probe.last(name) for name in ("odom", "target/odom", "plant/status")}
    bag = tmp_path / "cut.mcap"
    with made_bag(bag) as (_, say):
        for topic in ("plant/status", "momentum", "odom", "joint_states", "target/odom"):
            for message in rig.probe.messages[topic]:
                say(f"/{topic}", message, 0.15)
        # What a plant says that was started meanwhile counts for nothing.
        rig.plant.trigger_deactivate()
        harness.spin_until(
            lambda: values_of(rig.probe.last("plant/status"))["state"] == "inactive", "its end"
        )
        say("/plant/status", rig.probe.last("plant/status"), 0.2)
    parameters = {**PARAMETERS, "resume_bag": str(bag), "time_mode": "lockstep"}
    again = harness.make(PlantNode, parameters, name="again", autostart=False)
    assert again.trigger_configure() is TransitionCallbackReturn.SUCCESS
    assert again.tick == 3
    capturing = again.plant.capturing
    assert capturing is not None
    told = values_of(before["plant/status"]).get("payload", "")
    payload = capturing.payload.to_text() if capturing.payload is not None else ""
    assert payload == told
    assert bool(payload) is held
    for name, pose, twist in (
        ("odom", again.plant.pose, again.plant.twist),
        ("target/odom", capturing.target_pose, capturing.target_twist),
    ):
        was = before[name]
        np.testing.assert_allclose(np.concatenate(pose_of(was)), pose, atol=1e-14)
        np.testing.assert_allclose(np.concatenate(twist_of(was)), twist, atol=1e-14)


def test_a_bag_without_the_target_is_not_gone_on_with(harness: Harness, tmp_path: Path) -> None:
    bag = tmp_path / "a.mcap"
    with made_bag(bag) as (_, say):
        say("/momentum", array(*([0.0] * 7)), 0.05)
        say("/odom", odometry(0.05, 0, 0, 0, 0, 0, 0, 1, *([0.0] * 6)), 0.05)
        say("/joint_states", joint_states(0.05, JOINTS, [0.0, 0.0], [0.0, 0.0]), 0.05)
    parameters = {**PARAMETERS, "resume_bag": str(bag)}
    plant = harness.make(PlantNode, parameters, name="plant", autostart=False)
    plant.trigger_configure()
    assert "whose last state has no target: set 'target.robot' as in that" in str(plant.fault)


def test_a_latched_paused_or_stopped_plant_captures_nothing_but_a_paused_one(
    harness: Harness,
) -> None:
    rig = Rig(harness, PARAMETERS)
    rig.trigger("plant/abort")
    latched = rig.trigger("plant/capture")
    assert (latched.success, latched.message) == (
        False,
        "A fault is latched: stopped on request; rearm the plant first.",
    )
    rig.trigger("plant/rearm")
    rig.pause(True)
    assert rig.trigger("plant/capture").success
    assert rig.trigger("plant/reset").success
    rig.plant.trigger_deactivate()
    stopped = rig.trigger("plant/capture")
    assert (stopped.success, stopped.message) == (False, "The plant is inactive: nothing moves.")


def test_a_plant_without_a_target_captures_nothing(harness: Harness) -> None:
    rig = Rig(harness)
    for service in ("capture", "release"):
        answer = rig.trigger(f"plant/{service}")
        assert (answer.success, answer.message) == (
            False,
            "There is no target: set parameter 'target.robot' to its URDF.",
        )


def test_an_approach_without_a_target_is_refused(harness: Harness) -> None:
    loop = Loop(harness)
    loop.answer()
    refused = loop.trigger("approach")
    assert not refused.success
    assert_one_sentence(refused.message, "no target to approach", "'target/robot_description'")
    assert loop.trigger("detumble").success, "which needs none"


def test_tasks_are_done_on_request(harness: Harness) -> None:
    # The arm grasps obliquely, past a corner of the block.
    loop = Loop(harness, activate=False, **{"target.clearance": 0.0})
    odom = loop.probe.create_publisher(Odometry, "target/odom", 10)
    described = loop.probe.create_publisher(String, "target/robot_description", LATCHED)
    described.publish(String(data=BLOCK.read_text("utf-8")))
    harness.connect()
    assert loop.trigger("approach").success is False
    assert loop.node.trigger_activate() is TransitionCallbackReturn.SUCCESS
    loop.answer()
    assert loop.trigger("approach").success is True

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
    assert loop.trigger("detumble").message.startswith("The task 'detumble' has started")
    answer()
    harness.spin_until(lambda: loop.status.get("task") == "detumble", "the task")
