"""The actions of planner and controller through rclpy: sent, followed, cancelled, preempted.

``test_layouts.py`` builds the packages of interfaces and runs these tests with them.
"""

from __future__ import annotations

import math
import threading
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from action_msgs.msg import GoalStatus
from builtin_interfaces.msg import Duration
from geometry_msgs.msg import PoseStamped
from rclpy.action import ActionClient
from rclpy.node import Node
from rosbags.highlevel import AnyReader
from sensor_msgs.msg import JointState
from support.hand_motion import end_of_motion
from support.planner_flight import (
    DECIDED,
    NEAR,
    PLANT,
    TURNED,
    Array,
    Flight,
    goal_at,
    joint_values,
    position_goal,
    values_of,
)
from support.ros_harness import Harness

from spacerobot_ros.bag import read_bag
from spacerobot_ros.nodes import CoordinatedControlNode, PlantNode, RecorderNode, ReplayNode
from spacerobot_ros.nodes.common.messages import interface_class
from spacerobot_ros.planning import GaitSchedule
from spacerobot_ros.planning.methods.lie_bracket import LieBracketGait
from spacerobot_ros.resources import robot_file

STATES = {
    GoalStatus.STATUS_SUCCEEDED: "succeeded",
    GoalStatus.STATUS_ABORTED: "aborted",
    GoalStatus.STATUS_CANCELED: "canceled",
}


@dataclass
class SentGoal:
    """A goal that was sent: its id in statuses, its feedback, and its results."""

    goal_id: str
    handle: Any = None
    feedback: list[Any] = field(default_factory=list)
    results: list[tuple[str, Any]] = field(default_factory=list)
    """State and message of each result: there is to be one."""

    @property
    def state(self) -> str:
        return self.results[0][0]

    @property
    def result(self) -> Any:
        return self.results[0][1]


class Sender:
    """A client of one action whose server is there."""

    def __init__(self, harness: Harness, node: Node, kind: Any, name: str) -> None:
        self.harness, self.kind = harness, kind
        self.client = ActionClient(node, kind, name)
        harness.spin_until(self.client.server_is_ready, f"the action {kind}")

    def send(self, **fields: Any) -> SentGoal:
        """Send a goal, and return it once the server has accepted it."""
        sent = SentGoal("")

        def on_result(future: Any) -> None:
            response = future.result()
            sent.results.append((STATES[response.status], response.result))

        def on_answer(future: Any) -> None:
            sent.handle = future.result()
            sent.goal_id = bytes(sent.handle.goal_id.uuid).hex()
            if sent.handle.accepted:
                sent.handle.get_result_async().add_done_callback(on_result)

        future = self.client.send_goal_async(
            self.kind.Goal(**fields),
            feedback_callback=lambda message: sent.feedback.append(message.feedback),
        )
        future.add_done_callback(on_answer)
        self.harness.spin_until(lambda: sent.handle is not None, "the goal is accepted")
        return sent

    def end_of(self, sent: SentGoal) -> Any:
        """Wait for a result, and return its message."""
        self.harness.spin_until(lambda: sent.results, "the result")
        return sent.result


def base_at(pose: PoseStamped) -> dict[str, Any]:
    """Return the fields of a goal of FlyTo for the base."""
    return {"base_pose": [pose]}


FLY_TO = interface_class("spacerobot_msgs.action", "FlyTo")
NAVIGATE = interface_class("nav2_msgs.action", "NavigateToPose")

pytestmark = [
    pytest.mark.study,
    pytest.mark.skipif(FLY_TO is None or NAVIGATE is None, reason="the packages are not built"),
]


NAMES = ("shoulder_yaw", "shoulder_pitch", "elbow_pitch")
START, END = [0.4, -0.9, 1.1], [-0.2, -0.5, 1.6]
PLANAR = {"robot": "planar_manipulator", "tick_rate": 50.0}


class ActionFlight(Flight):
    """A plant and a planner with a client of each action."""

    def __init__(
        self,
        harness: Harness,
        planner: dict[str, Any] | None = None,
        plant: dict[str, Any] | None = None,
    ) -> None:
        super().__init__(harness, planner, plant)
        self.fly_to = Sender(harness, self.probe, FLY_TO, "planner/fly_to")
        self.navigate = Sender(harness, self.probe, NAVIGATE, "planner/navigate_to_pose")

    def decisions(self, goal_id: str) -> list[tuple[str, str]]:
        """State and message of the statuses that decide a goal."""
        about = ((values_of(s), s.message) for s in self.probe.messages["planner/status"])
        return [
            (values["state"], message)
            for values, message in about
            if values.get("goal_id") == goal_id and values["state"] in DECIDED
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


def test_feedback_is_recorded_and_replayed(
    harness: Harness, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    flight = ActionFlight(harness)
    bag = tmp_path / "flight.mcap"
    recorder = harness.make(RecorderNode, {"bag": str(bag)})
    feedback, status = (f"/planner/fly_to/_action/{name}" for name in ("feedback", "status"))
    harness.spin_until(lambda: {feedback, status, "/odom"} <= recorder.topics, "the recorder")
    harness.connect()
    flight.start()
    sent = flight.fly_to.send(**base_at(goal_at(TURNED)))
    assert flight.check(sent) == "reached"
    flight.plant.trigger_deactivate()
    harness.settle(flight.probe)
    recorder.trigger_deactivate()
    recorder.trigger_cleanup()
    assert "is not recorded" not in capfd.readouterr().err
    with AnyReader([bag]) as reader:
        connections = [each for each in reader.connections if each.topic == feedback]
        assert [each.msgtype for each in connections] == [
            "spacerobot_msgs/action/FlyTo_FeedbackMessage"
        ]
        read: list[Any] = [
            reader.deserialize(raw, connection.msgtype)
            for connection, _, raw in reader.messages(connections)
        ]
    assert [each.feedback.phase for each in read] == [each.phase for each in sent.feedback]
    assert [each.feedback.errors.position for each in read] == [
        each.errors.position for each in sent.feedback
    ]
    phases = read_bag(bag)[feedback].field("feedback.phase")
    assert list(phases) == [each.phase for each in sent.feedback]

    replayed: list[str] = []
    again = {"bag": str(bag), "topics": feedback, "remap": f"{feedback}:=/again", "rate": 10.0}
    harness.make(ReplayNode, again)
    assert FLY_TO is not None
    kind = FLY_TO.Impl.FeedbackMessage
    flight.probe.create_subscription(
        kind, "/again", lambda message: replayed.append(message.feedback.phase), 1000
    )
    harness.spin_until(lambda: len(replayed) == len(read), "the replay")
    assert replayed == [each.phase for each in sent.feedback]


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


def arm_flight(harness: Harness) -> ActionFlight:
    arm = {"robot": "three_joint_arm"}
    quick = {"optimal.answers": 1, "optimal.intervals": 30, "optimal.cache": 0}
    planner = {**arm, "method": "optimal", **quick}
    flight = ActionFlight(harness, planner, {**arm, "initial_joint_positions": START})
    flight.start()
    return flight


def end_of(shapes: npt.ArrayLike) -> Array:
    """Return where Pinocchio has the end-effector after a motion of the joints from the start."""
    urdf = robot_file("three_joint_arm").read_text("utf-8")
    return end_of_motion(urdf, NAMES, np.array(shapes), ["end_effector"])["end_effector"][0]


@pytest.mark.parametrize("name", ["", "end_effector"])
def test_an_end_effector_is_brought_to_a_place(harness: Harness, name: str) -> None:
    flight = arm_flight(harness)
    way = START + np.linspace(0, 1, 40)[:, np.newaxis] * np.subtract(END, START)
    place = end_of(way)
    sent = flight.fly_to.send(
        end_effectors=[name], end_effector_poses=[position_goal(place)], position_tolerance=1e-4
    )
    assert flight.check(sent) == "reached"
    flown = joint_values(flight.probe.messages["joint_states"], NAMES)
    np.testing.assert_allclose(end_of(flown), place, atol=1e-4)
    assert sent.result.errors.end_effector_position <= 1e-4
    for left_open in ("position", "attitude", "end_effector_attitude", "joints"):
        assert math.isnan(getattr(sent.result.errors, left_open)), left_open
    begun, *_, last = sent.feedback
    farthest = float(np.linalg.norm(place - end_of([START, START])))
    assert begun.errors.end_effector_position == pytest.approx(farthest, rel=1e-6)
    assert last.errors.end_effector_position < farthest


def test_a_tolerance_for_a_part_that_the_method_leaves_open_is_refused(harness: Harness) -> None:
    flight = arm_flight(harness)
    turned = base_at(goal_at(([0.01, 0.0, 0.0], [0.0, 0.0, 0.02])))
    sent = flight.fly_to.send(**turned, position_tolerance=0.1, attitude_tolerance=0.1)
    assert flight.check(sent) == "refused"
    assert "a tolerance for its position, which optimal does not control" in sent.result.message
    sent = flight.fly_to.send(**turned, attitude_tolerance=1e-4)
    assert flight.check(sent) == "reached_partly"
    assert sent.state == "aborted"
    assert "but for its position, which is " in sent.result.message
    assert sent.result.errors.attitude <= 1e-4
    assert sent.result.errors.position > 1e-3
    # A position of NaN is not asked for.
    turned = base_at(goal_at(([math.nan] * 3, [0.0, 0.0, 0.02])))
    sent = flight.fly_to.send(**turned, attitude_tolerance=1e-4)
    assert flight.check(sent) == "reached"
    assert sent.state == "succeeded"
    assert math.isnan(sent.result.errors.position)
    result = flight.navigate.end_of(flight.navigate.send(pose=goal_at(([1.0, 0, 0], [0, 0, 0.02]))))
    assert (result.error_code, "but for its position" in result.error_msg) == (9000, True)


def test_a_goal_is_cancelled_while_it_is_planned(
    harness: Harness, monkeypatch: pytest.MonkeyPatch
) -> None:
    planned, plan = threading.Event(), LieBracketGait.plan

    def wait(gait: LieBracketGait, request: Any, cancellation: Any) -> GaitSchedule:
        planned.set()
        while True:  # A plan without end, but for its cancellation.
            cancellation.raise_if_requested()

    monkeypatch.setattr(LieBracketGait, "plan", wait)
    flight = ActionFlight(harness, plant={"time_mode": "realtime"})
    flight.start()
    sent = flight.fly_to.send(**base_at(goal_at(NEAR)))
    harness.spin_until(planned.is_set, "the planner plans")
    sent.handle.cancel_goal_async()
    assert flight.check(sent) == "aborted"
    assert sent.state == "canceled"
    assert sent.result.message == "Aborted on request. The joints rest."
    monkeypatch.setattr(LieBracketGait, "plan", plan)
    assert flight.check(flight.fly_to.send(**base_at(goal_at(NEAR)))) == "reached"


def controller_client(harness: Harness) -> Sender:
    """Return a client of a controller that flies a plant."""
    shape = {"initial_joint_positions": [0.7, -1.1]}
    harness.make(PlantNode, {**PLANT, **PLANAR, "actuation": "effort", **shape})
    settings = {"settle_time": 0.1, "status_period": 0.5}
    harness.make(CoordinatedControlNode, {**PLANAR, **settings}, name="controller")
    sender = Sender(harness, harness.probe({}), FLY_TO, "controller/fly_to")
    harness.connect()
    return sender


def test_a_controller_takes_goals_of_base_and_end_effector(harness: Harness) -> None:
    sender = controller_client(harness)
    loose = {"position_tolerance": 5e-3, "attitude_tolerance": 4e-3}
    # The end-effector is at (2.186, 0.255) while the base is at the origin, turned by -0.4 rad.
    hand = [goal_at(([2.21, 0.24, 0.0], [0.0, 0.0, -0.38]))]
    for fields, controlled, others in (
        (
            {**base_at(goal_at(([0.02, -0.01, 0.0], [0.0, 0.0, 0.03]))), **loose},
            ("position", "attitude"),
            ("end_effector_position", "end_effector_attitude", "joints"),
        ),
        (
            {"end_effectors": [""], "end_effector_poses": hand, "position_tolerance": 5e-3},
            ("end_effector_position",),
            ("position", "attitude", "joints"),
        ),
    ):
        sent = sender.send(**fields)
        result = sender.end_of(sent)
        assert (sent.state, result.outcome) == ("succeeded", "reached"), result.message
        for name in controlled:
            assert getattr(result.errors, name) <= 5e-3, name
        for name in others:
            assert math.isnan(getattr(result.errors, name)), name
    # Its law has the end-effector's position alone: an attitude within a tolerance is refused.
    sent = sender.send(end_effectors=[""], end_effector_poses=hand, attitude_tolerance=0.1)
    assert sender.end_of(sent).outcome == "refused"
    assert sent.result.message.startswith("The goal gives a tolerance for its attitude, which the")


@pytest.mark.parametrize("kind", ["base", "end_effector"])
def test_a_controller_is_preempted_and_cancelled(harness: Harness, kind: str) -> None:
    sender = controller_client(harness)
    fields = {
        "base": base_at(goal_at(([0.3, 0.2, 0.0], [0.0, 0.0, 0.1]))),
        "end_effector": {
            "end_effectors": ["end_effector"],
            "end_effector_poses": [goal_at(([2.3, 0.1, 0.0], [0.0, 0.0, -0.3]))],
        },
    }[kind]
    first = sender.send(**fields)
    harness.spin_until(lambda: len(first.feedback) > 2, "it is flown")
    second = sender.send(**fields)
    assert sender.end_of(first).message == f"Aborted: replaced by goal {second.goal_id}."
    assert first.state == "aborted"
    harness.spin_until(lambda: len(second.feedback) > 2, "it is flown")
    second.handle.cancel_goal_async()
    assert sender.end_of(second).message == "Aborted on request; the robot holds its pose."
    assert second.state == "canceled"
    assert {each.phase for each in first.feedback + second.feedback} <= {"waiting", "tracking"}
    assert [len(each.results) for each in (first, second)] == [1, 1]


def test_goals_that_are_refused_have_a_result(harness: Harness) -> None:
    flight = ActionFlight(harness)
    flight.start()
    joints = JointState(name=["slider_1"], position=[0.1])
    for fields, words in (
        ({}, "The goal is empty"),
        (base_at(goal_at(NEAR, frame="moon")), "'moon'"),
        ({**base_at(goal_at(NEAR)), "joint_tolerance": math.nan}, "joint tolerance"),
        ({**base_at(goal_at(NEAR)), "time_limit": Duration(sec=-1)}, "time limit"),
        ({"end_effectors": ["hand"], "end_effector_poses": [goal_at(NEAR)]}, "'hand'"),
        ({"end_effectors": ["hand"]}, "1 end-effector and 0 poses"),
        ({"joint_positions": joints}, "The goal has only joint positions: add a base pose"),
        (
            {**base_at(goal_at(NEAR)), "joint_positions": JointState(position=[0.1])},
            "0 joint names and 1",
        ),
    ):
        sent = flight.fly_to.send(**fields)
        assert flight.check(sent) == "refused"
        assert sent.state == "aborted"
        assert words in sent.result.message
    assert flight.planner.trigger_deactivate()
    sent = flight.fly_to.send(**base_at(goal_at(NEAR)))
    assert flight.check(sent) == "refused"
    assert sent.result.message == "The goal is refused: this node is inactive."


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
