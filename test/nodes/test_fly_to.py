"""The actions of planner and controller through rclpy: sent, followed, cancelled, preempted.

``test_real_actions.py`` builds the packages of interfaces and runs these tests with them.
"""

from __future__ import annotations

import math
from typing import Any

import pytest
from builtin_interfaces.msg import Duration
from support.action_clients import Sender, SentGoal, base_at
from support.planner_flight import HERE, NEAR, TURNED, Flight, goal_at, values_of
from support.ros_harness import Harness

from spacerobot_ros.nodes.common.fly_to import action_class

FLY_TO = action_class("spacerobot_msgs", "FlyTo")
NAVIGATE = action_class("nav2_msgs", "NavigateToPose")

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(FLY_TO is None or NAVIGATE is None, reason="the packages are not built"),
]


class ActionFlight(Flight):
    """A plant and a planner with a client of each action."""

    def __init__(self, harness: Harness, planner: dict[str, Any] | None = None) -> None:
        super().__init__(harness, planner)
        self.fly_to = Sender(harness, self.probe, FLY_TO, "planner/fly_to")
        self.navigate = Sender(harness, self.probe, NAVIGATE, "planner/navigate_to_pose")
        self.fly_to.connect()
        self.navigate.connect()

    def decisions(self, goal_id: str) -> list[tuple[str, str]]:
        """State and message of the statuses that decide a goal."""
        return [
            (values_of(status)["state"], status.message)
            for status in self.probe.messages["planner/status"]
            if values_of(status).get("goal_id") == goal_id
            and values_of(status)["state"] in ("reached", "failed", "refused", "aborted")
        ]

    def check(self, sent: SentGoal) -> str:
        """Wait for the result of a goal of FlyTo, which is its status; return its outcome."""
        result = self.fly_to.end_of(sent)
        self.harness.spin_until(lambda: self.decisions(sent.goal_id), "the status")
        if self.planner.is_active:  # Nothing comes after it.
            self.ticks(5)
        assert self.decisions(sent.goal_id) == [(result.outcome, result.message)]
        assert len(sent.results) == 1
        return str(result.outcome)


def test_a_goal_of_fly_to_is_flown_and_told(harness: Harness) -> None:
    flight = ActionFlight(harness)
    flight.start()
    goal = {**base_at(goal_at(TURNED)), "position_tolerance": 2e-3, "attitude_tolerance": 3e-4}
    sent = flight.fly_to.send(**goal)
    assert flight.check(sent) == "reached"
    assert sent.state == "succeeded"
    distance, angle = flight.error_to(TURNED)
    assert distance <= 2e-3
    assert angle <= 3e-4
    errors = sent.result.errors
    assert errors.position == pytest.approx(distance, rel=1e-3, abs=1e-9)
    assert errors.attitude == pytest.approx(angle, rel=1e-3, abs=1e-9)
    assert math.isnan(errors.joints)
    assert math.isnan(errors.end_effector_position)
    phases = list(dict.fromkeys(each.phase for each in sent.feedback))
    assert "executing" in phases
    moving = [
        each.remaining_time.sec + each.remaining_time.nanosec * 1e-9
        for each in sent.feedback
        if each.phase == "executing"
    ]
    assert moving == sorted(moving, reverse=True)
    assert moving[0] > 2.0


def test_a_cancelled_goal_is_aborted(harness: Harness) -> None:
    flight = ActionFlight(harness)
    flight.start()
    sent = flight.fly_to.send(**base_at(goal_at(NEAR)))
    flight.wait("executing")
    flight.ticks(5)
    sent.handle.cancel_goal_async()
    assert flight.check(sent) == "aborted"
    assert sent.state == "canceled"
    assert sent.result.message.startswith("Aborted on request. The joints brake")


def test_a_goal_of_a_topic_replaces_one_of_an_action(harness: Harness) -> None:
    flight = ActionFlight(harness)
    flight.start()
    sent = flight.fly_to.send(**base_at(goal_at(NEAR)))
    flight.wait("executing")
    pose = goal_at(TURNED)
    pose.header.stamp.sec = 77
    flight.send(pose)
    assert flight.check(sent) == "aborted"
    assert sent.state == "aborted"
    assert sent.result.message == "Aborted: replaced by goal 77.000000000."
    assert values_of(flight.wait("reached"))["goal_id"] == "77.000000000"


def test_goals_that_are_refused_have_a_result(harness: Harness) -> None:
    flight = ActionFlight(harness)
    flight.start()
    for fields, words in (
        ({}, "The goal is empty"),
        (base_at(goal_at(NEAR, frame="moon")), "'moon'"),
        ({**base_at(goal_at(NEAR)), "joint_tolerance": math.nan}, "joint tolerance"),
        ({**base_at(goal_at(NEAR)), "time_limit": Duration(sec=-1)}, "time limit"),
        ({"end_effectors": ["hand"], "end_effector_poses": [goal_at(NEAR)]}, "'hand'"),
        ({"end_effectors": ["hand"]}, "1 end-effector(s) and 0 pose(s)"),
    ):
        sent = flight.fly_to.send(**fields)
        assert flight.check(sent) == "refused"
        assert sent.state == "aborted"
        assert words in sent.result.message
    assert flight.planner.trigger_deactivate()
    sent = flight.fly_to.send(**base_at(goal_at(NEAR)))
    assert flight.check(sent) == "refused"
    assert sent.result.message == "The goal is refused: this node is inactive."


def test_a_deactivated_planner_ends_the_goal(harness: Harness) -> None:
    flight = ActionFlight(harness)
    flight.start()
    sent = flight.fly_to.send(**base_at(goal_at(NEAR)))
    flight.wait("executing")
    flight.planner.trigger_deactivate()
    flight.planner.trigger_cleanup()
    assert flight.check(sent) == "aborted"
    assert sent.result.message == "Aborted: this node was deactivated."
    flight.planner.trigger_configure()
    flight.planner.trigger_activate()
    flight.fly_to.connect()
    assert flight.check(flight.fly_to.send(**base_at(goal_at(HERE)))) == "reached"


def test_the_time_limit_gives_a_goal_up(harness: Harness) -> None:
    flight = ActionFlight(harness)
    flight.start()
    limit = Duration(sec=1, nanosec=250_000_000)
    sent = flight.fly_to.send(**base_at(goal_at(NEAR)), time_limit=limit)
    assert flight.check(sent) == "aborted"
    assert sent.state == "aborted"
    assert sent.result.message.startswith("Aborted after its time limit of 1.25 s. The joints")


def test_navigate_to_pose_moves_the_base(harness: Harness) -> None:
    flight = ActionFlight(harness)
    flight.start()
    sent = flight.navigate.send(pose=goal_at(NEAR))
    result = flight.navigate.end_of(sent)
    assert (sent.state, result.error_code, result.error_msg) == ("succeeded", 0, "")
    assert max(flight.error_to(NEAR)) <= 1e-3
    times = [each.navigation_time.sec for each in sent.feedback]
    assert times == sorted(times)
    assert sent.feedback[0].distance_remaining == pytest.approx(0.06164414, rel=1e-4)
    assert sent.feedback[-1].current_pose.header.frame_id == "world"
    refused = flight.navigate.send(pose=goal_at(NEAR), behavior_tree="patrol")
    result = flight.navigate.end_of(refused)
    assert (refused.state, result.error_code) == ("aborted", 9000)
    assert "'patrol'" in result.error_msg
