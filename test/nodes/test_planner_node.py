"""Managed life and parameters of the planner node, before and in flight."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rcl_interfaces.msg import Log
from rcl_interfaces.srv import SetParameters
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from std_srvs.srv import Trigger
from support.planner_flight import (
    HERE,
    NEAR,
    PLANNER,
    PLANT,
    TOPICS,
    TURNED,
    Flight,
    Place,
    goal_at,
    pose_arrays,
    stamp_of,
    values_of,
)
from support.plant_rig import SLIDERS, TICK_NS
from support.ros_harness import LATCHED, Harness, Probe, construction
from support.sentences import assert_one_sentence

from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.nodes import PlannerNode, PlantNode
from spacerobot_ros.nodes.common.fly_to import action_class

pytestmark = pytest.mark.usefixtures("one_plant")


# -- managed life -----------------------------------------------------------------------------


def test_a_deactivated_planner_is_silent_and_goes_on_when_activated(harness: Harness) -> None:
    flight = Flight(harness)
    flight.send(NEAR)
    flight.start()
    flight.wait("executing")
    flight.ticks(10)
    flight.planner.trigger_deactivate()
    harness.settle(flight.probe)
    commands = flight.probe.count("joint_commands")
    flight.send(TURNED)
    harness.settle(flight.probe)
    assert flight.probe.count("joint_commands") == commands
    flight.planner.trigger_activate()
    flight.ticks(5)
    assert list(flight.probe.last("joint_states").velocity) == [0.0] * 3, "the goal was given up"
    assert values_of(flight.decide(NEAR))["state"] == "reached"


def test_a_planner_is_cleaned_up_and_configured_again(harness: Harness) -> None:
    flight = Flight(harness)
    flight.decide(NEAR)
    flight.plant.trigger_deactivate()
    for name in ("deactivate", "cleanup"):
        getattr(flight.planner, f"trigger_{name}")()
    harness.spin_until(
        lambda: not flight.probe.count_publishers("joint_commands"), "the end of joint_commands"
    )
    for topic in ("planner/status", "gait_schedule", "planned_path"):
        assert flight.probe.count_publishers(topic) == 0
    assert flight.planner.trigger_configure() is TransitionCallbackReturn.SUCCESS
    harness.connect()
    assert flight.planner.trigger_activate() is TransitionCallbackReturn.SUCCESS
    assert values_of(flight.decide(TURNED))["state"] == "reached"


def test_a_planner_that_is_configured_again_in_flight_is_shown_the_state_it_has_missed(
    harness: Harness,
) -> None:
    flight = Flight(harness)
    flight.send(NEAR)
    flight.start()
    flight.wait("executing")
    # No time between these: the plant sees as many subscriptions as before.
    for name in ("deactivate", "cleanup", "configure", "activate"):
        trigger = getattr(flight.planner, f"trigger_{name}")
        assert trigger() is TransitionCallbackReturn.SUCCESS
    harness.connect()
    flight.ticks(5)
    assert values_of(flight.decide(NEAR))["state"] == "reached"


# -- parameters -------------------------------------------------------------------------------


BAD: dict[str, tuple[dict[str, Any], tuple[str, ...]]] = {
    "method": ({"method": "wings"}, ("'method'", "wings", "lie_bracket")),
    "robot": ({"robot": "octopus"}, ("'robot'", "octopus")),
    "description": ({"robot_description": "<robot/>"}, ("robot",)),
    "tick rate": ({"tick_rate": -1.0}, ("'tick_rate'", "Hz")),
    "slow tick rate": ({"tick_rate": 1e-4}, ("'tick_rate'", "0.001 Hz")),
    "position tolerance": ({"position_tolerance": -1e-3}, ("'position_tolerance'", "m")),
    "attitude tolerance": ({"attitude_tolerance": math.nan}, ("'attitude_tolerance'",)),
    "corrections": ({"max_corrections": 1.5}, ("'max_corrections'", "whole number")),
    "shape gain": ({"shape_gain": "strong"}, ("'shape_gain'", "strong")),
    "option of the method": ({"lie_bracket.t1": 0.0}, ("'lie_bracket.t1'", "s")),
    "whole option": ({"lie_bracket.n1": 1.5}, ("'lie_bracket.n1'", "whole number")),
    "option as text": ({"lie_bracket.cycle_period": "3 s"}, ("'lie_bracket.cycle_period'",)),
}


@pytest.mark.parametrize(("parameters", "mentions"), BAD.values(), ids=BAD)
def test_a_bad_parameter_is_refused_with_a_sentence_that_names_it(
    ros_context: rclpy.Context, parameters: dict[str, Any], mentions: tuple[str, ...]
) -> None:
    with pytest.raises(SpaceRobotError) as refusal:
        PlannerNode(**construction(ros_context, {**PLANNER, **parameters}))
    assert_one_sentence(str(refusal.value), *mentions)


def test_a_planner_that_is_configured_again_finds_its_robot_again(harness: Harness) -> None:
    flight = Flight(harness, {"robot": ""})
    assert values_of(flight.decide(NEAR))["state"] == "reached"
    flight.plant.trigger_deactivate()
    for step in ("deactivate", "cleanup", "configure"):
        assert getattr(flight.planner, f"trigger_{step}")() is TransitionCallbackReturn.SUCCESS
    harness.connect()
    assert flight.planner.trigger_activate() is TransitionCallbackReturn.SUCCESS
    assert values_of(flight.decide(HERE))["state"] == "reached"
    assert flight.error_to(HERE)[0] < 1e-3


def test_without_the_package_of_the_action_the_planner_says_so(harness: Harness) -> None:
    if action_class("control_msgs", "FollowJointTrajectory") is not None:
        pytest.skip("control_msgs is installed")
    with pytest.raises(SpaceRobotError, match="requires the package control_msgs: install it"):
        harness.make(PlannerNode, {"robot": "sliding_masses", "output": "trajectory"})


# -- services ---------------------------------------------------------------------------------


def test_abortion_brings_the_joints_to_rest(harness: Harness) -> None:
    flight = Flight(harness)
    flight.send(NEAR)
    flight.start()
    flight.wait("executing")
    flight.ticks(15)
    assert any(flight.probe.last("joint_states").velocity)
    client = flight.probe.create_client(Trigger, "planner/abort")
    answer = harness.call(client, Trigger.Request())
    assert answer.success
    assert_one_sentence(answer.message, "brake along the planned path")
    status = flight.wait("aborted")
    assert status.level == DiagnosticStatus.WARN
    assert_one_sentence(status.message, answer.message)
    flight.ticks(10**9 // TICK_NS + 3)  # abort_time, and commands that were on their way.
    place = list(flight.probe.last("joint_states").position)
    flight.ticks(60)
    assert list(flight.probe.last("joint_states").position) == place
    assert list(flight.probe.last("joint_states").velocity) == [0.0] * 3
    assert flight.states == ["idle", "executing", "aborted"]
    answer = harness.call(client, Trigger.Request())
    assert not answer.success
    assert answer.message
    flight.decide(NEAR)
    assert flight.states[-1] == "reached"
    assert max(flight.error_to(NEAR)) <= 1e-3


# -- corrections ------------------------------------------------------------------------------


def test_a_tolerance_that_is_tightened_in_flight_makes_corrections_happen(harness: Harness) -> None:
    # Wide tolerances and one large cycle: a first order that is some way off.
    flight = Flight(
        harness,
        {
            "position_tolerance": 0.1,
            "attitude_tolerance": 0.1,
            "lie_bracket.loop_area": 10.0,
            "max_corrections": 5,
        },
    )
    flight.send(TURNED)
    flight.start()
    flight.wait("executing")
    request = SetParameters.Request(
        parameters=[
            Parameter(f"{what}_tolerance", value=1e-6).to_parameter_msg()
            for what in ("position", "attitude")
        ]
    )
    client = flight.probe.create_client(SetParameters, "planner/set_parameters")
    assert [r.successful for r in harness.call(client, request).results] == [True, True]
    status = flight.wait("reached", "failed")
    assert values_of(status)["state"] == "reached", status.message
    assert max(flight.error_to(TURNED)) <= 1e-6
    corrections = int(values_of(status)["corrections"])
    assert corrections >= 1
    assert flight.states == ["idle", "executing", *["executing"] * corrections, "reached"]
    assert len(flight.probe.messages["gait_schedule"]) == 1 + corrections


def test_a_bad_change_in_flight_is_refused(harness: Harness) -> None:
    flight = Flight(harness)
    flight.send(NEAR)
    flight.start()
    flight.wait("executing")
    cases: list[tuple[str, Any, str]] = [
        ("position_tolerance", -1.0, "position_tolerance"),
        ("max_corrections", -1, "max_corrections"),
        ("attitude_tolerance", "small", "'attitude_tolerance' is 'small'; it must be a number"),
        ("max_corrections", 2.5, "'max_corrections' is 2.5; it must be a whole number"),
        ("tick_rate", 50.0, "tick_rate"),
    ]
    for name, value, mention in cases:
        before = flight.planner.get_parameter(name).value
        (result,) = flight.planner.set_parameters([Parameter(name, value=value)])
        assert not result.successful
        assert mention in result.reason
        assert flight.planner.get_parameter(name).value == before
    flight.wait("reached")
    assert max(flight.error_to(NEAR)) <= 1e-3


# -- ids --------------------------------------------------------------------------------------


def stamped(place: Place, sec: int, nanosec: int) -> PoseStamped:
    goal = goal_at(place)
    goal.header.stamp.sec, goal.header.stamp.nanosec = sec, nanosec
    return goal


def ids_of(flight: Flight) -> list[tuple[str, str]]:
    """States with the ids of the goals that they speak of."""
    values = [values_of(status) for status in flight.probe.messages["planner/status"]]
    found = [(value["state"], value.get("goal_id", "")) for value in values]
    return [each for each in found if each[0] not in ("idle", "planning", "waiting")]


def test_statuses_name_the_goal_by_its_stamp(harness: Harness) -> None:
    flight = Flight(harness)
    flight.decide(stamped(NEAR, 3, 5))
    flight.decide(NEAR)
    refused = stamped(NEAR, 4, 123456789)
    refused.header.frame_id = "moon"
    flight.decide(refused)
    assert ids_of(flight) == [
        ("executing", "3.000000005"),
        ("reached", "3.000000005"),
        ("executing", "unstamped-1"),
        ("reached", "unstamped-1"),
        ("refused", "4.123456789"),
    ]


@pytest.mark.slow
def test_a_planner_that_starts_again_resumes_its_goal_by_its_id(
    harness: Harness, tmp_path: Path
) -> None:
    flight = Flight(harness, {"resume_file": str(tmp_path / "goal.json")})
    flight.send(stamped(TURNED, 7, 0))
    flight.start()
    flight.wait("executing")
    flight.ticks(15)
    for step in ("deactivate", "cleanup", "configure"):
        assert getattr(flight.planner, f"trigger_{step}")() is TransitionCallbackReturn.SUCCESS
    harness.connect()
    flight.planner.trigger_activate()
    flight.wait("reached")
    assert max(flight.error_to(TURNED)) <= 1e-3
    assert ids_of(flight)[2:] == [("executing", "7.000000000"), ("reached", "7.000000000")]
    assert not (tmp_path / "goal.json").exists()


# -- without a stop ---------------------------------------------------------------------------


@pytest.mark.slow
def test_a_goal_that_is_changed_in_flight_causes_no_stop(harness: Harness) -> None:
    chain: dict[str, Any] = {"robot": "planar_chain"}
    optimal = {"method": "optimal", "optimal.cache": 0, "optimal.answers": 1, "takeover_time": 0.3}
    plant = {**chain, "initial_joint_positions": [0.3, -0.2]}
    flight = Flight(harness, {**chain, **optimal}, plant)
    flight.send(([math.nan] * 3, [0.0, 0.0, 1.2]))
    flight.start()
    flight.wait("executing")
    flight.ticks(6)
    first = flight.probe.last("gait_schedule")
    flight.send(([math.nan] * 3, [0.0, 0.0, 1.4]))
    schedules = flight.probe.messages["gait_schedule"]
    harness.spin_until(lambda: len(schedules) == 2, "the plan takes over")
    second = flight.probe.last("gait_schedule")
    begins = stamp_of(second)
    # The first shape of the second is on the first, at the tick that its stamp says.
    tick = (begins - stamp_of(first)) // TICK_NS
    assert list(second.points[0].positions) == pytest.approx(
        list(first.points[tick].positions), abs=1e-9
    )
    flight.wait("reached", "failed")
    assert flight.states == ["idle", "executing", "aborted", "executing", "reached"]
    assert flight.error_to(([math.nan] * 3, [0.0, 0.0, 1.4]))[1] < 1e-3
    near = [
        max(map(abs, message.velocity))
        for message in flight.probe.messages["joint_commands"]
        if abs(stamp_of(message) - begins) <= 4 * TICK_NS
    ]
    assert len(near) == 9
    assert min(near) > 0.1, "it never stops"


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
