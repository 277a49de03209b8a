"""The mission client: goals named by their stamps, and statuses of this goal only."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Path as PathMessage
from rclpy.publisher import Publisher
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import JointState
from support.hand_motion import end_of_motion
from support.ros_harness import LATCHED, TIMEOUT, Harness, Probe

from spacerobot_ros.bag import read_bag
from spacerobot_ros.control.status import ControllerState, ControllerStatus
from spacerobot_ros.errors import ParameterError, SpaceRobotError
from spacerobot_ros.flight.reading import read_run
from spacerobot_ros.measures import Outcome
from spacerobot_ros.nodes.common.messages import path_poses
from spacerobot_ros.nodes.common.node import endpoints_of
from spacerobot_ros.nodes.common.process import FASTDDS_FILE_VARIABLES
from spacerobot_ros.planning import Goal
from spacerobot_ros.planning.core.goal import EndEffectorGoal
from spacerobot_ros.planning.execution.status import PlannerState, PlannerStatus
from spacerobot_ros.resources import robot_file
from spacerobot_ros.scenario import Scenario, load_scenario, scenario_or_robot, scenario_text
from spacerobot_ros.session.mission_client import MissionClient
from spacerobot_ros.session.run import run_scenario

NOW = 12_000_000_345
GOAL = Goal.checked([1.0, 2.0, 3.0], [0.0, 0.0, 0.0, 1.0])
TOPICS = {"goal_pose": PoseStamped, "end_effector/goal_pose": PoseStamped}
STATUS = {"planner": "planner/status", "coordinated_control": "controller/status"}
Report = PlannerStatus | ControllerStatus


def status_of(decider: str, state: str, message: str = "", **about: Any) -> Report:
    """Return a status of a commander."""
    if decider == "planner":
        return PlannerStatus(PlannerState(state), message, **about)
    return ControllerStatus(ControllerState(state), message, **about)


class Mission:
    """A client, and a commander that only listens and publishes what it is given."""

    def __init__(self, harness: Harness, decider: str) -> None:
        self.harness = harness
        self.client = MissionClient(
            decider,
            "world",
            lambda: NOW,
            GOAL,
            GOAL,
            joint_names=("a", "b"),
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

    def report(self, status: Report) -> None:
        """Publish a status, and wait for the client to receive it."""
        self.publish(status)
        self.harness.spin_until(lambda: self.client.status == status)

    def publish(self, status: Report) -> None:
        values = [KeyValue(key=key, value=value) for key, value in status.to_values().items()]
        self.status.publish(DiagnosticStatus(message=status.message, values=values))


@pytest.mark.parametrize("decider", STATUS)
def test_only_the_status_of_the_goal_that_was_sent_decides_it(
    harness: Harness, decider: str
) -> None:
    mission = Mission(harness, decider)
    mission.report(status_of(decider, "failed", "Failed."))
    assert mission.client.message == "Failed.", "there is no goal to follow yet"
    first = mission.send(GOAL)
    assert mission.client.message == ""
    assert first == "12.000000346"
    for other in ("", "unstamped-1", "12.000000345", "12.346"):
        mission.report(status_of(decider, "reached", f"Reached {other}.", goal_id=other))
        assert mission.client.outcome is None
        assert mission.client.message == ""
    waiting = "idle" if decider == "planner" else "holding"
    mission.report(status_of(decider, waiting, "Waiting for the plant."))
    assert mission.client.message == "Waiting for the plant."
    mission.report(status_of(decider, "reached", "Reached.", goal_id=first))
    assert mission.client.outcome is Outcome.REACHED
    assert mission.client.message == "Reached."


@pytest.mark.parametrize("decider", STATUS)
def test_a_goal_that_its_commander_no_longer_has_is_lost(harness: Harness, decider: str) -> None:
    mission = Mission(harness, decider)
    goal_id = mission.send(GOAL)
    flies = "executing" if decider == "planner" else "tracking"
    waits = status_of(decider, "idle" if decider == "planner" else "holding", "Waiting.")
    mission.report(waits)
    assert not mission.client.lost, "it may not have arrived"
    for message in ("It flies.", "It flies again."):
        mission.report(status_of(decider, flies, message, goal_id=goal_id))
        assert not mission.client.lost
        mission.report(waits)
        assert mission.client.lost == (
            f"'{decider}' was started again and has no goal: send the goal again."
        )
    mission.report(status_of(decider, flies, "It flies.", goal_id=goal_id))
    mission.commander.destroy_publisher(mission.status)
    harness.spin_until(lambda: mission.client.lost.startswith(f"'{decider}' has ended: "))


@pytest.mark.parametrize("decider", STATUS)
def test_the_end_of_a_replaced_goal_counts_though_the_next_status_comes_at_once(
    harness: Harness, decider: str
) -> None:
    mission = Mission(harness, decider)
    goal_id, later = mission.send(GOAL), "12.9"
    replaced, waiting = f"Aborted: replaced by goal {later}.", "Waiting for the plant."
    flying = "executing" if decider == "planner" else "tracking"
    mission.publish(status_of(decider, "aborted", replaced, goal_id=goal_id))
    mission.publish(status_of(decider, flying, "Flying.", goal_id=later))
    mission.report(status_of(decider, "waiting", waiting))
    assert mission.client.outcome is Outcome.ABORTED
    assert mission.client.message == replaced


def mission_with_events(harness: Harness, decider: str) -> tuple[Mission, Publisher, str]:
    """Return a mission with a goal, the publisher of its commander's events, and the goal's id."""
    mission = Mission(harness, decider)
    events = mission.commander.create_publisher(DiagnosticStatus, "events", 10)
    harness.spin_until(events.get_subscription_count)
    return mission, events, mission.send(GOAL)


def event(node: str, kind: str, goal_id: str) -> DiagnosticStatus:
    values = [KeyValue(key="event", value=kind), KeyValue(key="goal_id", value=goal_id)]
    return DiagnosticStatus(name=node, message=f"{kind}.", values=values)


@pytest.mark.parametrize("decider", STATUS)
def test_a_verdict_whose_status_is_lost_is_known_from_its_event(
    harness: Harness, decider: str
) -> None:
    """As when a later goal's status replaces it before a busy client has received it."""
    mission, events, goal_id = mission_with_events(harness, decider)
    for node, kind, identity in (
        ("/other", "goal_failed", goal_id),
        (f"/{decider}", "goal_failed", "12.9"),
        (f"/{decider}", "goal_accepted", goal_id),
        (f"/{decider}", "goal_reached", goal_id),
    ):
        events.publish(event(node, kind, identity))
    late = time.monotonic() + TIMEOUT
    outcome = mission.client.follow(harness.executor, lambda: time.monotonic() > late, 0.01)
    assert outcome is Outcome.REACHED
    assert mission.client.message == "goal_reached."


@pytest.mark.parametrize("decider", STATUS)
def test_a_status_that_comes_after_its_event_is_kept_for_what_it_says(
    harness: Harness, decider: str
) -> None:
    mission, events, goal_id = mission_with_events(harness, decider)
    about: dict[str, Any] = {"corrections": 3} if decider == "planner" else {"task": "x"}
    status = status_of(decider, "failed", "Failed.", goal_id=goal_id, **about)
    events.publish(event(f"/{decider}", "goal_failed", goal_id))
    looks = []

    def look() -> bool:
        looks.append(time.monotonic())
        mission.publish(status)
        return len(looks) > 10

    assert mission.client.follow(harness.executor, look, 1.0) is Outcome.FAILED
    assert mission.client.status == status


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
    client = Mission(harness, "planner").client
    looks = iter([False, False, True])
    outcome = client.follow(harness.executor, lambda: next(looks), 0.01)
    assert outcome is client.outcome is Outcome.INTERRUPTED
    assert list(looks) == []


def test_a_follower_raises_what_its_look_raises(harness: Harness) -> None:
    client = Mission(harness, "planner").client

    def fail() -> bool:
        raise SpaceRobotError("A node has ended.")

    with pytest.raises(SpaceRobotError, match="A node has ended"):
        client.follow(harness.executor, fail, 0.01)
    assert client.outcome is Outcome.INTERRUPTED


def test_the_pose_of_a_goal_is_that_of_the_message_and_its_id_is_its_own(harness: Harness) -> None:
    """Though time stands still."""
    mission = Mission(harness, "planner")
    tool = Goal.checked([0.1, 0.2, 0.3], [0.0, 0.6, 0.0, 0.8])
    assert [mission.send(tool) for _ in range(3)] == [f"12.000000{346 + n}" for n in range(3)]
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
    goal = Goal.of_end_effectors([EndEffectorGoal.checked("left", [0.1, 0.2, 0.3])])
    client = MissionClient("planner", "world", lambda: NOW, goal, context=harness.context)
    harness.add(client.node)
    topics = {"goal_pose": PoseStamped, "left/goal_pose": PoseStamped}
    recorder = harness.probe(topics, name="recorder")
    commander = harness.probe({}, name="commander")
    status = commander.create_publisher(DiagnosticStatus, "planner/status", LATCHED)
    harness.spin_until(lambda: status.get_subscription_count() and client.is_connected())
    harness.settle(recorder)
    assert not client.has_goal_commander()
    commander.watch("goal_pose", PoseStamped)
    harness.settle(commander)
    assert not client.has_goal_commander(), "which the named link has none of, either"
    commander.watch("left/goal_pose", PoseStamped)
    harness.spin_until(lambda: client.has_goal_commander() and client.is_connected(2))
    client.send(goal)
    harness.spin_until(lambda: commander.count("left/goal_pose"), "the goal")


NAMELESS = """
import sys

import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from rclpy.qos import DurabilityPolicy, QoSProfile

rclpy.init()
planner, recorder = rclpy.create_node("planner"), rclpy.create_node("recorder")
latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
status = planner.create_publisher(DiagnosticStatus, "planner/status", latched)
goals = recorder.create_subscription(PoseStamped, "goal_pose", lambda message: None, 10)
sys.stdin.read()
"""
"""A planner that reads no goals yet, and a recorder that does."""

WITHOUT_NAMES = """<?xml version="1.0" encoding="UTF-8"?>
<dds xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles">
  <profiles>
    <data_writer profile_name="ros_discovery_info">
      <qos><ownership><kind>EXCLUSIVE</kind></ownership></qos>
    </data_writer>
  </profiles>
</dds>
"""
"""Fast DDS settings with which no other process learns which node an endpoint belongs to."""


def test_nodes_whose_names_have_not_come_yet_are_no_commander(
    harness: Harness, ros_domain: int, tmp_path: Path
) -> None:
    """The planner and the recorder would pass for one node, and the goal would be lost."""
    settings = tmp_path / "fastdds.xml"
    settings.write_text(WITHOUT_NAMES, "utf-8")
    environment = {
        **os.environ,
        **dict.fromkeys(FASTDDS_FILE_VARIABLES, str(settings)),
        "ROS_DOMAIN_ID": str(ros_domain),
    }
    client = MissionClient("planner", "world", lambda: NOW, GOAL, context=harness.context)
    harness.add(client.node)
    words = [sys.executable, "-c", NAMELESS]
    with subprocess.Popen(words, env=environment, stdin=subprocess.PIPE) as nodes:
        harness.spin_until(
            lambda: (
                {"/goal_pose", "/planner/status"}
                <= {end.topic for end in endpoints_of(client.node) if end.matched}
            )
        )
        assert not client.has_goal_commander()
        nodes.communicate()


def test_a_path_of_an_end_effector_is_sent_on_its_topic(harness: Harness) -> None:
    """With the stamp of the goal, beside the goal of another link."""
    goal = Goal.of_end_effectors(
        [
            EndEffectorGoal.along("left", [[1.0, 2.0, 3.0], [1.5, -2.0, 0.3]]),
            EndEffectorGoal.checked("right", [0.1, 0.2, 0.3, 0.0, 0.6, 0.0, 0.8]),
        ]
    )
    assert goal.links_with_paths == {"left"}
    client = MissionClient("planner", "world", lambda: NOW, goal, context=harness.context)
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


QUICK = {"optimal.answers": 1, "optimal.intervals": 20, "optimal.cache": 0}


def quick(name: str) -> Scenario:
    return load_scenario(name).with_overrides("planner", QUICK)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["reach", "two_hands"])
def test_the_hands_end_at_their_goals(name: str, tmp_path: Path) -> None:
    scenario, bag = quick(name), tmp_path / "run.mcap"
    result = run_scenario(scenario, bag)
    assert result.succeeded
    flight = read_run(bag)
    aims = {each.link: each for each in scenario.goal.end_effectors}
    robot = str(scenario.plant.robot)
    found = end_of_motion(
        *(robot_file(robot).read_text("utf-8"), flight.joint_names, flight.q, list(aims))
    )
    for link, (r, R) in found.items():
        np.testing.assert_allclose(r, aims[link].position, atol=1e-6)
        quaternion = aims[link].quaternion
        if quaternion is not None:
            assert (R.inv() * Rotation.from_quat(quaternion)).magnitude() < 1e-6
        assert result.summary["end_effectors"][link]["position_error_m"] < 1e-9
    assert result.summary["goal"] is None
    assert result.summary["position_error_m"] is None
    assert flight.outcome is Outcome.REACHED
    assert flight.end_effector_errors.keys() == aims.keys()
    assert flight.error is None


def test_a_scenario_may_have_paths_of_end_effectors(tmp_path: Path) -> None:
    """A list of positions or poses: as it is written, and in the records of a bag."""
    way = [[0.4, 0.1, 0.8], [0.5, -0.1, 0.7]]
    aims = [
        EndEffectorGoal.along("link_5", way),
        EndEffectorGoal.checked("link_7", [0.4, 0.1, 1.8]),
    ]
    scenario, file = load_scenario("reach").with_end_effectors(aims), tmp_path / "again.yaml"
    file.write_text(scenario_text(scenario), "utf-8")
    for again in (scenario, load_scenario(str(file))):
        assert again.goal.links_with_paths == {"link_5"}
        assert again.planner.end_effectors == ("link_7", "link_5")
        given = json.loads(again.records(())["scenario"]["end_effector_goals"])
        assert given == {"link_5": way, "link_7": [0.4, 0.1, 1.8]}


@pytest.mark.usefixtures("own_domain")
@pytest.mark.slow
def test_a_path_is_flown_and_in_the_bag(tmp_path: Path) -> None:
    """Nodes are sent it as a path; the hand passes its corner, by the poses of the bag."""
    way = [[1.5, 0.7, 1.3], [1.3, 0.9, 0.8]]
    robot = scenario_or_robot("three_joint_arm").with_overrides(
        "plant", {"initial_joint_positions": [0.4, -0.9, 1.1]}
    )
    scenario = robot.with_end_effectors([EndEffectorGoal.along("", way)])
    result = run_scenario(scenario, tmp_path / "path.mcap", nodes=True)
    assert result.succeeded
    series = read_bag(tmp_path / "path.mcap")["/end_effector_pose"]
    places = series.table([f"pose.position.{axis}" for axis in "xyz"], 3)
    assert np.linalg.norm(places[-1] - way[1]) < 1e-6
    assert np.linalg.norm(places - way[0], axis=1).min() < 0.03
    flight = read_run(tmp_path / "path.mcap")
    assert flight.scenario.goal.links_with_paths
    assert flight.outcome is Outcome.REACHED


def test_another_end_effector_is_heard_by_the_planner_without_being_listed() -> None:
    aim = EndEffectorGoal.checked("link_5", [0.4, 0.1, 0.8])
    scenario = load_scenario("reach").with_end_effectors([aim])
    assert scenario.planner.end_effectors == ("link_7", "link_5")
    assert scenario.goal_links == ("link_5",)
    # Another goal of the base takes its place.
    assert not scenario.with_goal(rotvec=[0.0, 0.0, 0.1]).goal.end_effectors


@pytest.mark.parametrize(
    ("goals", "message"),
    [
        ("{link_7: [1.0, 2.0]}", r"give 3 \(a position\) or 7"),
        ("{link_7: [0, 0, 1, 0, 0, 0, 0]}", "zero quaternion"),
        ("[1.0, 2.0, 3.0]", r"must map names to poses, not \[1.0, 2.0, 3.0\]\.$"),
        ("1.5", r"must map names to poses, not 1.5\.$"),
        ("{link_7: far}", "is not a list of numbers"),
        ("{link_7: [[0, 0, 1], [0, 0, 1, 0]]}", "is not a list of numbers"),
        ("{link_7: [[0, 0, 1, 0], [0, 0, 1, 0]]}", "each of its poses must have 3 numbers"),
    ],
)
def test_goals_of_a_file_that_are_none_are_refused(
    tmp_path: Path, goals: str, message: str
) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text(
        f"scenario: {{ros__parameters: {{end_effector_goals: {goals}}}}}\n"
        "plant: {ros__parameters: {robot: seven_joint_arm}}\n"
    )
    with pytest.raises(ParameterError, match=message):
        load_scenario(str(file))


@pytest.mark.usefixtures("own_domain")
def test_a_part_of_the_base_is_not_sent_with_an_end_effector(tmp_path: Path) -> None:
    aim = EndEffectorGoal.checked("link_7", [0.4, 0.1, 0.8])
    scenario = load_scenario("reach").with_end_effectors([aim], frozenset({"attitude"}))
    with pytest.raises(ParameterError, match="whole base pose or none"):
        run_scenario(scenario, tmp_path / "run.mcap", nodes=True)
