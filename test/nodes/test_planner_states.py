"""Robots and states that the planner node is told of, whole or not, in whatever order."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rcl_interfaces.msg import Log
from rclpy.lifecycle import TransitionCallbackReturn
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from support.planner_flight import (
    NEAR,
    PLANNER,
    PLANT,
    TOPICS,
    goal_at,
    pose_arrays,
    values_of,
)
from support.plant_rig import SLIDERS, TICK_NS
from support.ros_harness import LATCHED, Harness, Probe

from spacerobot_ros.nodes import PlannerNode, PlantNode

pytestmark = pytest.mark.usefixtures("one_plant")

URDF = Path(__file__).parents[2] / "urdf"


def test_without_a_robot_it_takes_the_one_of_the_plant(harness: Harness) -> None:
    planner = harness.make(PlannerNode, {**PLANNER, "robot": ""})
    probe = harness.probe(TOPICS)
    goals = probe.create_publisher(PoseStamped, "goal_pose", 10)
    harness.connect()
    assert planner.is_active
    goals.publish(goal_at(NEAR))
    harness.spin_until(
        lambda: any("robot_description" in s.message for s in probe.messages["planner/status"]),
        "a word that the goal waits for a robot",
    )
    harness.make(PlantNode, PLANT)
    harness.spin_until(
        lambda: values_of(probe.last("planner/status"))["state"] in ("reached", "failed"),
        "the goal is decided",
    )
    assert values_of(probe.last("planner/status"))["state"] == "reached"
    position, _ = pose_arrays(probe.last("odom").pose.pose)
    np.testing.assert_allclose(position, NEAR[0], atol=1e-3)


class FakePlant:
    """States and a description, published one by one as a test wants them."""

    def __init__(self, harness: Harness, parameters: dict[str, Any]) -> None:
        self.harness = harness
        self.planner = harness.make(
            PlannerNode, {**PLANNER, "plan_in_background": False, **parameters}, autostart=False
        )
        topics = {"joint_commands": JointState, "planner/status": DiagnosticStatus, "/rosout": Log}
        self.probe: Probe = harness.probe(topics)
        self.goals = self.probe.create_publisher(PoseStamped, "goal_pose", 10)
        self.description = self.probe.create_publisher(String, "robot_description", LATCHED)
        self.odom = self.probe.create_publisher(Odometry, "odom", 10)
        self.joints = self.probe.create_publisher(JointState, "joint_states", 10)
        assert self.planner.trigger_configure() is TransitionCallbackReturn.SUCCESS
        harness.connect()

    def describe(self, text: str | None = None) -> None:
        given = (URDF / "sliding_masses.urdf").read_text("utf-8") if text is None else text
        self.description.publish(String(data=given))

    def show(
        self,
        tick: int = 0,
        joints_first: bool = False,
        rates: bool = True,
        x: float = 0.0,
        **joints: float,
    ) -> None:
        odom = Odometry(child_frame_id="base_link")
        odom.pose.pose.position.x = x
        odom.header.frame_id = "world"
        odom.pose.pose.orientation.w = 1.0
        places = joints or dict.fromkeys(SLIDERS, 0.0)
        state = JointState(
            name=list(places),
            position=list(places.values()),
            velocity=[0.0] * len(places) if rates else [],
            effort=[0.0] * len(places),
        )
        for message in (odom, state):
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(tick * TICK_NS, 10**9)
        pairs = [(self.odom, odom), (self.joints, state)]
        for publisher, message in reversed(pairs) if joints_first else pairs:
            publisher.publish(message)

    def wait_for_log(self, part: str) -> None:
        self.harness.spin_until(
            lambda: any(part in line.msg for line in self.probe.messages["/rosout"]),
            f"a word with '{part}'",
        )

    def answers(self, count: int) -> list[JointState]:
        self.harness.spin_until(
            lambda: self.probe.count("joint_commands") >= count, f"{count} command(s)"
        )
        return list(self.probe.messages["joint_commands"])


def test_a_broken_description_is_refused_and_the_next_is_taken(harness: Harness) -> None:
    fake = FakePlant(harness, {"robot": ""})
    fake.planner.trigger_activate()
    fake.describe("<robot")
    fake.wait_for_log("not valid URDF")
    fake.describe()
    harness.settle(fake.probe)
    fake.show(0)
    fake.answers(1)


def test_a_state_from_before_the_description_is_answered(harness: Harness) -> None:
    # In lockstep the plant waits for that answer.
    fake = FakePlant(harness, {"robot": ""})
    fake.planner.trigger_activate()
    fake.show(0)
    harness.settle(fake.probe)
    fake.describe()
    fake.answers(1)


def test_a_state_from_before_the_activation_is_answered(harness: Harness) -> None:
    fake = FakePlant(harness, {})
    fake.show(0)
    harness.settle(fake.probe)
    assert fake.probe.count("joint_commands") == 0
    fake.planner.trigger_activate()
    fake.answers(1)


def test_another_description_replaces_the_robot_and_ends_its_goal(harness: Harness) -> None:
    """A goal of the robot before is not reached by the one that is there now."""
    fake = FakePlant(harness, {"robot": ""})
    fake.planner.trigger_activate()
    fake.describe()
    fake.describe()  # The same again changes nothing.
    harness.matched(fake.goals)
    fake.goals.publish(goal_at(NEAR))
    # The state is to come after the goal, however long the functions of the robot are compiled.
    fake.wait_for_log("Goal unstamped-1")
    harness.settle(fake.probe)
    fake.show(1)
    harness.spin_until(
        lambda: (
            fake.probe.count("planner/status")
            and values_of(fake.probe.last("planner/status"))["state"] == "executing"
        ),
        "the goal is pursued",
    )
    text = (URDF / "sliding_masses.urdf").read_text("utf-8")
    fake.describe(text.replace("slider_", "runner_"))
    harness.spin_until(
        lambda: values_of(fake.probe.last("planner/status"))["state"] == "aborted", "its end"
    )
    assert "another robot" in fake.probe.last("planner/status").message
    before = fake.probe.count("joint_commands")
    fake.show(2, runner_1=0.0, runner_2=0.0, runner_3=0.0)
    last = fake.answers(before + 1)[-1]
    assert list(last.name) == ["runner_1", "runner_2", "runner_3"]
    assert list(last.velocity) == [0.0] * 3
