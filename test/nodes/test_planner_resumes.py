"""A planner that is started again, before it knows its robot: the goal in its file."""

from __future__ import annotations

from pathlib import Path

import pytest
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger
from support.planner_flight import NEAR, TURNED, Flight, goal_at, values_of
from support.ros_harness import Harness

from spacerobot_ros.nodes.common.messages import goal_of
from spacerobot_ros.planning.execution.goal_file import BASE_GOAL_KEY, GoalFile, IdentifiedGoal

pytestmark = pytest.mark.usefixtures("one_plant")


def interrupted(harness: Harness, path: Path) -> Flight:
    """Start a planner whose predecessor was flying to a goal; time stands still."""
    goal = goal_of(goal_at(TURNED), "world")
    GoalFile(str(path)).save({BASE_GOAL_KEY: IdentifiedGoal(goal, "7.000000000")})
    flight = Flight(harness, {"robot": "", "resume_file": str(path)})
    status = flight.wait("waiting")
    assert values_of(status)["goal_id"] == "7.000000000"
    assert path.exists()
    return flight


def abort(flight: Flight) -> Trigger.Response:
    client = flight.probe.create_client(Trigger, "planner/abort")
    return flight.harness.call(client, Trigger.Request())


def test_a_goal_is_flown_to_once_the_robot_is_known(harness: Harness, tmp_path: Path) -> None:
    path = tmp_path / "goal.json"
    flight = interrupted(harness, path)
    flight.start()
    assert values_of(flight.wait("reached"))["goal_id"] == "7.000000000"
    assert max(flight.error_to(TURNED)) <= 1e-3
    assert not path.exists()


def test_a_goal_that_is_aborted_before_is_not_flown_to(harness: Harness, tmp_path: Path) -> None:
    path = tmp_path / "goal.json"
    flight = interrupted(harness, path)
    answer = abort(flight)
    assert answer.success
    # Who follows the goal learns of its end.
    status = flight.wait("aborted")
    assert values_of(status)["goal_id"] == "7.000000000"
    assert answer.message == status.message
    assert not path.exists()
    flight.start()
    flight.ticks(20)
    assert "executing" not in flight.states
    assert list(flight.probe.last("joint_states").velocity) == [0.0] * 3
    assert not abort(flight).success, "nothing is pursued"
    # A new goal is.
    assert values_of(flight.decide(NEAR))["state"] == "reached"
    assert max(flight.error_to(NEAR)) <= 1e-3


def test_a_goal_has_the_shape_that_was_wanted_before_it(harness: Harness, tmp_path: Path) -> None:
    path = tmp_path / "goal.json"
    flight = Flight(harness, {"resume_file": str(path)})
    shapes = flight.probe.create_publisher(JointState, "goal_joint_states", 10)
    harness.connect()
    names = ["slider_3", "slider_1", "slider_2"]
    shapes.publish(JointState(name=names, position=[0.3, 0.1, 0.2]))
    harness.spin_until(lambda: flight.planner._shape is not None, "the shape is received")
    flight.send(NEAR)
    flight.start()
    harness.spin_until(path.exists, "the goal is pursued")
    goal = GoalFile(str(path)).load()[BASE_GOAL_KEY].goal
    assert goal.joint_positions is not None
    assert goal.joint_positions.tolist() == [0.1, 0.2, 0.3]
    # A message without joints lets later goals end in any.
    shapes.publish(JointState())
    harness.spin_until(lambda: flight.planner._shape is None, "the shape is free")
