"""The check of goals in the background with a stand-in for its process, and a clock by hand."""

from __future__ import annotations

import io
import json
import pickle
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from spacerobot_ros.model import load_robot
from spacerobot_ros.planning import Goal
from spacerobot_ros.planning.execution.status import PlannerState, PlannerStatus
from spacerobot_ros.resources import robot_file
from spacerobot_ros.viewer.reachability import (
    GoalCheck,
    GoalChecker,
    GoalQuestion,
    Verdict,
    make_question,
    planner_config,
)
from spacerobot_ros.viewer.state import Measured, StackState

IDENTITY = [0.0, 0.0, 0.0, 1.0]


class Checker(GoalChecker):
    """A checker whose processes are stand-ins, which receive but never answer by themselves."""

    def __init__(self) -> None:
        super().__init__()
        self.sent: list[tuple[int, Any]] = []
        self.started = 0
        self.ended: int | None = None

    def _running_process(self) -> Any:
        if self._process is None:
            self.started += 1
            self._begun = 0
            self._process = SimpleNamespace(poll=lambda: self.ended)  # type: ignore[assignment]
        return self._process

    def _send_question(self, process: Any, question: Any) -> None:
        assert process is self._process
        self.sent.append((self._number, question))

    def close(self) -> None:
        self._process = None
        self._cancelled_at = None

    def receive(self, number: int, answer: Any) -> None:
        self._receive_answers(io.BytesIO(pickle.dumps((number, answer))))


@pytest.fixture
def now(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    time = [100.0]
    monkeypatch.setattr("time.monotonic", lambda: time[0])
    return time


def question(name: str) -> Any:
    return GoalQuestion(name, {}, None, None)  # type: ignore[arg-type]


def said(checker: Checker) -> tuple[Verdict, str] | None:
    """Return the verdict and the sentence of the latest answer."""
    check = checker.latest_answer()
    return None if check is None else (check.verdict, check.message)


FOUND = GoalCheck(Verdict.REACHABLE, "There.", 4.0)


def test_questions_are_numbered_and_the_last_one_is_answered_once(now: list[float]) -> None:
    checker = Checker()
    assert checker.latest_answer() is None
    assert not checker.cancel()
    checker.ask(question("a"))
    checker.ask(question("b"))
    assert [(number, each.urdf) for number, each in checker.sent] == [(1, "a"), (2, "b")]
    now[0] += 1.4
    checker.receive(1, FOUND)
    assert said(checker) == (Verdict.PLANNING, "Planning for 1 s.")
    checker.receive(2, None)
    checker.receive(2, "start 4 of 24")
    now[0] += 0.2
    # The cancellation of the first question was heard: its process goes on.
    assert said(checker) == (Verdict.PLANNING, "Planning for 2 s: start 4 of 24.")
    checker.receive(2, FOUND)
    assert checker.latest_answer() is not None
    assert checker.latest_answer() is None
    assert checker.started == 1
    assert not checker.cancel()
    checker.ask(question("c"))
    assert checker._cancelled_at is None, "nothing was in progress"
    checker.receive(3, None)
    assert said(checker) == (Verdict.PLANNING, "Planning for 0 s.")


def test_a_cancelled_question_has_no_answer(now: list[float]) -> None:
    checker = Checker()
    checker.ask(question("a"))
    assert checker.cancel()
    assert checker.sent[-1] == (2, None)
    assert not checker.cancel()
    checker.receive(1, FOUND)
    assert checker.latest_answer() is None
    checker.ask(question("b"))
    assert [number for number, _ in checker.sent] == [1, 2, 3]
    # The first cancellation counts.
    assert checker._cancelled_at == 100.0


@pytest.mark.parametrize(("later", "restarts"), [(1.99, False), (2.0, True)])
def test_a_process_that_ignores_a_cancellation_is_replaced(
    now: list[float], later: float, restarts: bool
) -> None:
    checker = Checker()
    checker.ask(question("a"))
    checker.receive(1, None)
    now[0] += 5.0
    checker.ask(question("b"))
    now[0] += later
    assert said(checker) == (Verdict.PLANNING, "Planning for 2 s.")
    assert checker.started == 1 + restarts
    assert [each.urdf for _, each in checker.sent] == ["a", "b", "b"][: 2 + restarts]
    # Once is enough.
    now[0] += 9.0
    checker.latest_answer()
    assert checker.started == 2


def test_a_process_that_has_begun_the_last_question_is_not_replaced(now: list[float]) -> None:
    checker = Checker()
    checker.ask(question("a"))
    checker.ask(question("b"))
    checker.receive(2, None)
    now[0] += 60.0
    assert said(checker) == (Verdict.PLANNING, "Planning for 60 s.")
    assert checker.started == 1


def test_a_process_that_has_ended_is_told(now: list[float]) -> None:
    checker = Checker()
    checker.ask(question("a"))
    checker.ended = -9
    assert said(checker) == (Verdict.UNCHECKED, "The process that checks goals has ended.")
    assert checker.latest_answer() is None


# -- sentences ------------------------------------------------------------------------------------


BASE = Goal.checked([0.0, 0.0, 0.0], IDENTITY)


def test_why_a_goal_cannot_be_checked() -> None:
    robot = load_robot(robot_file("servicer"))
    tool, link = Goal.checked([1.0, 0.0, 0.0], IDENTITY), robot.links[1].name
    pose = np.array([1.0, 2.0, 3.0, 0.0, 0.6, 0.0, 0.8])
    measured = Measured(0.0, pose, np.arange(6.0), *np.zeros((2, 6)))
    state = StackState(measured)
    idle, busy = PlannerStatus(PlannerState.IDLE), PlannerStatus(PlannerState.PLANNING)
    known = {"planner": {"a": "1"}}

    def asked(state: StackState, goals: Any, parameters: Any = known) -> Any:
        return make_question(state, goals, robot, parameters)

    goals = {"base": BASE}
    assert asked(StackState(), goals) == "No state received yet."
    assert asked(state, {"end_effector": tool}) == "The goal is for a planner, and none is running."
    assert asked(state, goals) == (
        "No planner is running: a controller flies the base to any pose."
    )
    wrong = {"controller": {"end_effector_frame": '"hand"'}}
    both = {**goals, "end_effector": tool}
    assert asked(state, both, wrong) == "The end-effector is not a link of the robot."
    arm = asked(state, both, {"controller": {"end_effector_frame": f'"{link}"'}})
    assert (arm.link, arm.tool) == (link, tool)
    np.testing.assert_array_equal(arm.state.position, [1.0, 2.0, 3.0])
    np.testing.assert_array_equal(arm.state.quaternion, [0.0, 0.6, 0.0, 0.8])
    np.testing.assert_array_equal(arm.state.q, np.arange(6.0))
    assert asked(state, both, {}).link == robot.end_effector()
    gone = replace(state, planner=idle, absent=frozenset({"planner"}))
    assert asked(gone, goals) == "The planner is offline."
    assert asked(replace(state, planner=busy), goals) == "The planner is busy planning."
    ready = replace(state, planner=idle)
    assert asked(ready, goals, {}) == ("The planner's parameters have not been received yet.")
    planned = asked(ready, goals)
    np.testing.assert_array_equal(planned.state.linear_momentum, 0.0)
    moving = replace(ready, momenta=SimpleNamespace(actual=np.arange(6.0)))  # type: ignore[arg-type]
    planned = asked(moving, goals)
    np.testing.assert_array_equal(planned.state.linear_momentum, [0.0, 1.0, 2.0])
    np.testing.assert_array_equal(planned.state.angular_momentum, [3.0, 4.0, 5.0])
    assert planned.goal.equals(BASE)


def test_parameters_of_a_planner_are_read_but_for_its_robot_and_what_is_null() -> None:
    values: dict[str, object] = {
        "tick_rate": 7.0, "robot": "elsewhere", "world": "there", "robot_description": "<robot/>",
        "use_sim_time": True, "clearance": None,
    }  # fmt: skip
    config = planner_config({name: json.dumps(value) for name, value in values.items()})
    assert config.tick_rate == 7.0
    assert (config.robot, config.world, config.robot_description) == ("", "", "")
    assert config.clearance == planner_config({}).clearance
