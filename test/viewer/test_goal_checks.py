"""The checks of goals with a stand-in for their process, their time, and the schedules of plans."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from spacerobot_ros.model import load_robot
from spacerobot_ros.planning import Goal
from spacerobot_ros.planning.execution.status import PlannerState, PlannerStatus
from spacerobot_ros.resources import robot_file
from spacerobot_ros.viewer.reachability import (
    GoalQuestion,
    make_question,
    planner_config,
)
from spacerobot_ros.viewer.state import Measured, Momenta, StackState

ATTITUDE = np.array([0.5, -0.1, 0.7, 0.5]) / np.linalg.norm([0.5, -0.1, 0.7, 0.5])
PLACE = np.array([0.3, -1.2, 2.0])
GOAL = Goal.checked([1.0, 2.0, 3.0], ATTITUDE)
HAND = Goal.checked([1.5, 2.5, 3.5], ATTITUDE)


# -- the question -------------------------------------------------------------------------------


SERVICER = load_robot(robot_file("servicer"))
MEASURED = Measured(3.0, np.concatenate([PLACE, ATTITUDE]), *np.arange(18.0).reshape(3, 6))
PLANNING = StackState(MEASURED, planner=PlannerStatus(PlannerState.IDLE))


@pytest.mark.parametrize(
    ("state", "known", "reason"),
    [
        (StackState(), True, "No state received yet."),
        (replace(PLANNING, absent=frozenset({"planner"})), True, "The planner is offline."),
        (
            replace(PLANNING, planner=PlannerStatus(PlannerState.PLANNING)),
            True,
            "The planner is busy planning.",
        ),
        (PLANNING, False, "The planner's parameters have not been received yet."),
    ],
)
def test_why_no_question_is_asked(state: StackState, known: bool, reason: str) -> None:
    parameters = {"planner": {"tick_rate": "20.0"}} if known else {"controller": {}}
    assert make_question(state, {"base": GOAL}, SERVICER, parameters) == reason
    assert make_question(state, {"base": GOAL}, None, parameters) == "No state received yet."


def test_a_question_has_the_measured_state_and_the_momenta() -> None:
    momenta = Momenta(np.arange(6.0), np.zeros(6), 2.0)
    parameters = {"planner": {"tick_rate": "20.0"}, "controller": {"law": '"step"'}}
    for given, expected in ((momenta, np.arange(6.0)), (None, np.zeros(6))):
        question = make_question(
            replace(PLANNING, momenta=given), {"base": GOAL}, SERVICER, parameters
        )
        assert isinstance(question, GoalQuestion)
        start = question.state
        np.testing.assert_array_equal(start.position, PLACE)
        np.testing.assert_array_equal(start.quaternion, ATTITUDE)
        np.testing.assert_array_equal(start.q, MEASURED.q)
        found = np.concatenate([start.linear_momentum, start.angular_momentum])
        np.testing.assert_array_equal(found, expected)
        assert (question.urdf, question.parameters) == (SERVICER.urdf, parameters["planner"])
        assert (question.goal, question.tool, question.link) == (GOAL, None, "")


def test_the_question_of_a_controller_is_for_its_end_effector() -> None:
    state = StackState(MEASURED, momenta=Momenta(np.ones(6), None, 0.0))
    goals = {"base": GOAL, "end_effector": HAND}
    question = make_question(state, goals, SERVICER, {})
    assert isinstance(question, GoalQuestion)
    assert (question.goal, question.tool, question.link) == (GOAL, HAND, SERVICER.end_effector())
    elbow = {"controller": {"end_effector_frame": '"forearm"'}, "planner": {"a": "1"}}
    known = [name for name in SERVICER.frames if name != SERVICER.end_effector()][-1]
    elbow["controller"]["end_effector_frame"] = f'"{known}"'
    other = make_question(state, goals, SERVICER, elbow)
    assert isinstance(other, GoalQuestion)
    assert (other.link, other.parameters) == (known, {})
    absent = {"controller": {"end_effector_frame": '"nobody"'}}
    answer = make_question(state, goals, SERVICER, absent)
    assert answer == "The end-effector is not a link of the robot."


def test_the_robot_of_a_planner_is_that_of_the_page() -> None:
    texts = {"robot": '"other"', "world": '"strut.urdf"', "robot_description": '"<robot/>"'}
    config = planner_config(
        {**texts, "tick_rate": "17.0", "averaging": "null", "no_parameter": "{"}
    )
    assert (config.robot, config.world, config.robot_description) == ("", "", "")
    assert config.tick_rate == 17.0
    assert config.averaging == type(config)().averaging
