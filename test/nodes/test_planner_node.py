"""Managed life and parameters of the planner node."""

from __future__ import annotations

import math
from typing import Any

import pytest
import rclpy
from rclpy.lifecycle import TransitionCallbackReturn
from support.planner_flight import HERE, NEAR, PLANNER, TURNED, Flight, values_of
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
    with pytest.raises(SpaceRobotError, match="needs the package control_msgs: install it"):
        harness.make(PlannerNode, {"robot": "sliding_masses", "output": "trajectory"})
