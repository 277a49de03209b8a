"""The mission client: goals named by their stamps, and statuses of this goal only."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Path as PathMessage
from sensor_msgs.msg import JointState
from support.ros_harness import LATCHED, Harness, Probe

from spacerobot_ros.control.status import ControllerState, ControllerStatus
from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.measures import Outcome
from spacerobot_ros.nodes.common.messages import path_poses
from spacerobot_ros.planning import Goal
from spacerobot_ros.planning.core.goal import EndEffectorGoal
from spacerobot_ros.planning.execution.status import PlannerState, PlannerStatus
from spacerobot_ros.session.mission_client import MissionClient

NOW = 12_000_000_345
GOAL = Goal.checked([1.0, 2.0, 3.0], [0.0, 0.0, 0.0, 1.0])
TOPICS = {"goal_pose": PoseStamped, "end_effector/goal_pose": PoseStamped}
STATUS = {"planner": "planner/status", "coordinated_control": "controller/status"}


class Mission:
    """A client, and a commander that only listens and publishes what it is given."""

    def __init__(self, harness: Harness, decider: str) -> None:
        self.harness = harness
        self.client = MissionClient(
            decider,
            "world",
            lambda: NOW,
            joint_names=lambda: ("a", "b"),
            end_effectors=("",),
            context=harness.context,
        )
        harness.add(self.client.node)
        # A controller takes no joint positions, and goals are sent to it all the same.
        shapes = {"goal_joint_states": JointState} if decider == "planner" else {}
        self.commander: Probe = harness.probe({**TOPICS, **shapes})
        self.status = self.commander.create_publisher(DiagnosticStatus, STATUS[decider], LATCHED)
        harness.spin_until(lambda: self.client.is_connected() and self.client.has_goal_commander())
        harness.spin_until(lambda: self.status.get_subscription_count() == 1)

    def send(self, end_effector: Goal, goal: Goal = GOAL) -> str:
        """Send goals, and return their id as a commander makes it of the stamp."""
        before = self.commander.count("end_effector/goal_pose")
        self.client.send(goal, end_effector)
        self.harness.spin_until(
            lambda: (
                self.commander.count("end_effector/goal_pose") > before
                and self.commander.count("goal_pose") > before
            )
        )
        base, tool = (self.commander.last(topic) for topic in TOPICS)
        assert base.header == tool.header
        assert base.header.frame_id == "world"
        return f"{base.header.stamp.sec}.{base.header.stamp.nanosec:09d}"

    def report(self, status: PlannerStatus | ControllerStatus) -> None:
        """Publish a status, and wait for the client to receive it."""
        values = [KeyValue(key=key, value=value) for key, value in status.to_values().items()]
        self.status.publish(DiagnosticStatus(message=status.message, values=values))
        self.harness.spin_until(lambda: self.client.status == status)


@pytest.mark.parametrize("decider", STATUS)
def test_only_the_status_of_the_goal_that_was_sent_decides_it(
    harness: Harness, decider: str
) -> None:
    mission = Mission(harness, decider)
    failed: PlannerStatus | ControllerStatus
    kind, failed, reached = (
        (PlannerStatus, PlannerStatus(PlannerState.FAILED), PlannerState.REACHED)
        if decider == "planner"
        else (ControllerStatus, ControllerStatus(ControllerState.FAILED), ControllerState.REACHED)
    )
    mission.report(replace(failed, message="Failed."))
    assert mission.client.message == "Failed.", "there is no goal to follow yet"
    first = mission.send(GOAL)
    assert mission.client.message == ""
    assert first == "12.000000346"
    for other in ("", "unstamped-1", "12.000000345", "12.346"):
        mission.report(kind(reached, f"Reached {other}.", goal_id=other))  # type: ignore[arg-type]
        assert mission.client.outcome is None
        assert mission.client.message == ""
    waiting = PlannerState.IDLE if decider == "planner" else ControllerState.HOLDING
    mission.report(kind(waiting, "Waiting for the plant."))  # type: ignore[arg-type]
    assert mission.client.message == "Waiting for the plant."
    mission.report(kind(reached, "Reached.", goal_id=first))  # type: ignore[arg-type]
    assert mission.client.outcome is Outcome.REACHED
    assert mission.client.message == "Reached."


def test_every_goal_has_an_id_of_its_own_though_time_stands_still(harness: Harness) -> None:
    mission = Mission(harness, "planner")
    assert [mission.send(GOAL) for _ in range(3)] == [f"12.000000{346 + n}" for n in range(3)]


def test_the_first_gait_for_the_goal_is_kept(harness: Harness) -> None:
    mission = Mission(harness, "planner")
    assert mission.client.goal_id is None
    goal_id = mission.send(GOAL)
    assert mission.client.goal_id == goal_id
    statuses = [
        PlannerStatus(
            PlannerState.EXECUTING,
            goal_id=identity,
            method="auto",
            duration_s=duration,
            ends_at_s=9.0,
            manoeuvre_time_s=duration,
            notes={"c": [1.0, 2.0]},
        )
        for identity, duration in (("7.000000000", 1.0), (goal_id, 2.0), (goal_id, 3.0))
    ]
    for status in statuses:
        mission.report(status)
    assert mission.client.gait == statuses[1]
    assert mission.client.ends_at == 9.0
    assert mission.client.outcome is None


def test_a_follower_stops_when_its_look_is_true(harness: Harness) -> None:
    mission = Mission(harness, "planner")
    looks: list[int] = []

    def look() -> bool:
        looks.append(0)
        return len(looks) == 3

    outcome = mission.client.follow(harness.executor, look, 0.01)
    assert outcome is mission.client.outcome is Outcome.INTERRUPTED
    assert len(looks) == 3


def test_a_follower_raises_what_its_look_raises(harness: Harness) -> None:
    mission = Mission(harness, "planner")

    def fail() -> bool:
        raise SpaceRobotError("A node has ended.")

    with pytest.raises(SpaceRobotError, match="A node has ended"):
        mission.client.follow(harness.executor, fail, 0.01)
    assert mission.client.outcome is Outcome.INTERRUPTED


def test_the_pose_of_a_goal_is_that_of_the_message(harness: Harness) -> None:
    mission = Mission(harness, "planner")
    tool = Goal.checked([0.1, 0.2, 0.3], [0.0, 0.6, 0.0, 0.8])
    mission.send(tool)
    for topic, goal in (("goal_pose", GOAL), ("end_effector/goal_pose", tool)):
        pose = mission.commander.last(topic).pose
        p, o = pose.position, pose.orientation
        np.testing.assert_array_equal([p.x, p.y, p.z], goal.position)
        np.testing.assert_allclose([o.x, o.y, o.z, o.w], goal.quaternion, atol=1e-15)


def test_joint_positions_of_an_earlier_goal_are_not_those_of_the_next(harness: Harness) -> None:
    mission = Mission(harness, "planner")
    shaped = Goal.checked([0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0], np.array([0.5, -0.25]))
    for goal in (GOAL, shaped, GOAL):
        mission.send(GOAL, goal)
    shapes = mission.commander.messages["goal_joint_states"]
    assert [list(each.name) for each in shapes] == [[], ["a", "b"], []], "those of each goal"
    assert list(shapes[1].position) == [0.5, -0.25]


def test_a_goal_waits_for_a_commander_that_is_known_beside_a_viewer(
    harness: Harness, monkeypatch: pytest.MonkeyPatch
) -> None:
    client = Mission(harness, "planner").client
    assert client.is_connected()
    assert not client.is_connected(readers=2)
    # Another reader of goals is known, and not met yet: it may be the commander.
    known = client.node.count_subscribers("goal_pose") + 1
    monkeypatch.setattr(client.node, "count_subscribers", lambda topic: known)
    assert not client.is_connected()


def test_a_recorder_that_reads_goals_is_no_commander(harness: Harness) -> None:
    """It may be known before the commander: then a goal would be lost without a word."""
    client = MissionClient("planner", "world", lambda: NOW, context=harness.context)
    harness.add(client.node)
    recorder = harness.probe({"goal_pose": PoseStamped}, name="recorder")
    commander = harness.probe({}, name="commander")
    status = commander.create_publisher(DiagnosticStatus, "planner/status", LATCHED)
    harness.spin_until(lambda: status.get_subscription_count() and client.is_connected())
    harness.settle(recorder)
    assert not client.has_goal_commander()
    commander.watch("goal_pose", PoseStamped)
    harness.spin_until(lambda: client.has_goal_commander() and client.is_connected(2))
    client.send(GOAL)
    harness.spin_until(lambda: commander.count("goal_pose"), "the goal")


def test_a_path_of_an_end_effector_is_sent_on_its_topic(harness: Harness) -> None:
    """With the stamp of the goal, beside the goal of another link."""
    goal = Goal.of_end_effectors(
        [
            EndEffectorGoal.along("left", [[1.0, 2.0, 3.0], [1.5, -2.0, 0.3]]),
            EndEffectorGoal.checked("right", [0.1, 0.2, 0.3, 0.0, 0.6, 0.0, 0.8]),
        ]
    )
    assert goal.links_with_paths == {"left"}
    client = MissionClient(
        "planner",
        "world",
        lambda: NOW,
        end_effectors=("left", "right"),
        paths=goal.links_with_paths,
        context=harness.context,
    )
    harness.add(client.node)
    listener = harness.probe({"left/path": PathMessage, "right/goal_pose": PoseStamped})
    harness.spin_until(
        lambda: all(
            client.node.count_subscribers(topic) for topic in ("left/path", "right/goal_pose")
        )
    )
    client.send(goal)
    harness.spin_until(
        lambda: bool(listener.count("left/path") and listener.count("right/goal_pose"))
    )
    path, pose = listener.last("left/path"), listener.last("right/goal_pose")
    assert path.header == pose.header
    assert path_poses(path, "world", "the path").tolist() == [[1.0, 2.0, 3.0], [1.5, -2.0, 0.3]]
    assert (pose.pose.position.y, pose.pose.orientation.y) == (0.2, 0.6)
