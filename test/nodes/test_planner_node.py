"""Managed life and parameters of the planner node, before and in flight."""

from __future__ import annotations

import math
from typing import Any

import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from rcl_interfaces.srv import SetParameters
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger
from support.planner_flight import (
    HERE,
    NEAR,
    PLANNER,
    TURNED,
    Flight,
    Place,
    goal_at,
    values_of,
)
from support.plant_rig import TICK_NS
from support.ros_harness import Harness, construction
from support.sentences import assert_one_sentence

from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.nodes import PlannerNode
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
    for step in ("deactivate", "cleanup"):
        assert getattr(flight.planner, f"trigger_{step}")() is TransitionCallbackReturn.SUCCESS
    outputs = ("joint_commands", "planner/status", "gait_schedule", "planned_path")
    harness.spin_until(
        lambda: not any(map(flight.probe.count_publishers, outputs)), "the end of its topics"
    )
    assert flight.planner.trigger_configure() is TransitionCallbackReturn.SUCCESS
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
    client = flight.probe.create_client(Trigger, "planner/abort")
    answer = harness.call(client, Trigger.Request())
    assert answer.success
    assert_one_sentence(answer.message, "brake along the planned path")
    status = flight.wait("aborted")
    assert status.level == DiagnosticStatus.WARN
    assert_one_sentence(status.message, answer.message)
    flight.ticks(10**9 // TICK_NS + 3)  # abort_time, and commands that were on their way.
    assert list(flight.probe.last("joint_states").velocity) == [0.0] * 3
    assert flight.states == ["idle", "executing", "aborted"]
    answer = harness.call(client, Trigger.Request())
    assert not answer.success
    assert answer.message


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


# -- without a stop ---------------------------------------------------------------------------
