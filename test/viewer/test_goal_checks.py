"""The checks of goals with a stand-in for their process, their time, and the schedules of plans."""

from __future__ import annotations

import io
import math
import pickle
from collections.abc import Mapping
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from spacerobot_ros.errors import PlanningError
from spacerobot_ros.model import load_robot
from spacerobot_ros.planning import Goal, RobotState
from spacerobot_ros.planning.core.cancellation import Cancellation
from spacerobot_ros.planning.core.goal import Tolerance
from spacerobot_ros.planning.execution.status import PlannerState, PlannerStatus
from spacerobot_ros.resources import robot_file
from spacerobot_ros.viewer import reachability
from spacerobot_ros.viewer.reachability import (
    GoalCheck,
    GoalChecker,
    GoalQuestion,
    Planner,
    Verdict,
    _LastQuestion,
    _uncontrolled_text,
    make_question,
    planner_config,
)
from spacerobot_ros.viewer.state import Measured, Momenta, StackState

ATTITUDE = np.array([0.5, -0.1, 0.7, 0.5]) / np.linalg.norm([0.5, -0.1, 0.7, 0.5])
PLACE = np.array([0.3, -1.2, 2.0])
STATE = RobotState(PLACE, ATTITUDE, np.array([0.1, 0.2, -0.3]))
GOAL = Goal.checked([1.0, 2.0, 3.0], ATTITUDE)
HAND = Goal.checked([1.5, 2.5, 3.5], ATTITUDE)


def asked(number: float) -> GoalQuestion:
    return GoalQuestion("<robot/>", {"number": str(number)}, STATE, GOAL)


class Process:
    """A process that has answered already, whatever it will be asked."""

    def __init__(self, answers: list[Any]) -> None:
        self.stdin = io.BytesIO()
        self.stdout = io.BytesIO(b"".join(map(pickle.dumps, answers)))
        self.code: int | None = None
        self.ended = False

    def poll(self) -> int | None:
        return self.code

    @property
    def questions(self) -> list[tuple[int, str | None]]:
        """The numbers of the questions that came, each with what tells it from others."""
        found, stream = [], io.BytesIO(self.stdin.getvalue())
        while stream.tell() < len(self.stdin.getvalue()):
            number, question = pickle.load(stream)
            found.append((number, question and question.parameters["number"]))
        return found


class Stage:
    """Processes in the order in which they are started, and a clock that is set by hand."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *answers: list[Any]) -> None:
        self.now = 100.0
        self.processes = [Process(each) for each in answers]
        self.started: list[Process] = []
        self.checker = GoalChecker()
        clock = SimpleNamespace(monotonic=lambda: self.now)
        monkeypatch.setattr(reachability, "time", clock)
        monkeypatch.setattr(reachability, "start_child", self._start)
        monkeypatch.setattr(reachability, "end_child", self._end)

    def _start(self, words: list[str], **streams: int) -> Process:
        assert words == ["-c", "from spacerobot_ros.viewer.reachability import main; main()"]
        assert list(streams) == ["stdin", "stdout"]
        self.started.append(self.processes[len(self.started)])
        return self.started[-1]

    def _end(self, process: Process, reasons: Mapping[int, str]) -> None:
        process.ended, process.code = True, -15

    def ask(self, number: float) -> None:
        self.checker.ask(asked(number))
        thread = self.checker._answer_thread
        assert thread is not None
        thread.join(10.0)

    def look(self) -> tuple[str, str] | None:
        check = self.checker.latest_answer()
        return None if check is None else (check.verdict.value, check.message)


YES, NO = GoalCheck(Verdict.REACHABLE, "yes", 4.0), GoalCheck(Verdict.REFUSED, "no")


def test_the_time_of_a_plan_and_its_progress_are_told_until_its_answer(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    stage = Stage(monkeypatch, [(1, None), (1, "3 of 8 starts")])
    assert stage.look() is None
    stage.ask(7)
    assert stage.look() == ("planning", "Planning for 0 s: 3 of 8 starts.")
    stage.now += 61.6
    assert stage.look() == ("planning", "Planning for 62 s: 3 of 8 starts.")
    stage.checker._answers[1] = YES
    assert stage.look() == ("reachable", "yes")
    assert stage.look() is None
    assert stage.started[0].questions == [(1, "7")]


def test_a_newer_question_has_a_time_and_an_answer_of_its_own(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    stage = Stage(monkeypatch, [(1, None), (1, "slowly"), (1, NO), (2, None), (3, None), (3, YES)])
    stage.checker.ask(asked(7))
    stage.now += 30.0
    stage.checker.ask(asked(8))
    stage.now += 0.5
    stage.ask(9)
    assert stage.look() == ("reachable", "yes")
    # Answers of questions before it are forgotten.
    assert list(stage.checker._answers) == [3]
    assert stage.started[0].questions == [(1, "7"), (2, "8"), (3, "9")]
    assert len(stage.started) == 1


def test_a_process_that_begins_no_other_question_is_killed_after_two_seconds(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    stage = Stage(monkeypatch, [(1, None)], [(2, None), (2, NO)])
    stage.ask(7)
    stage.now += 5.0
    stage.ask(8)
    stage.now += 1.9
    assert stage.look() == ("planning", "Planning for 2 s.")
    assert not stage.started[0].ended
    stage.now += 0.1
    assert stage.look() == ("planning", "Planning for 2 s.")
    assert (stage.started[0].ended, len(stage.started)) == (True, 2)
    assert stage.started[1].questions == [(2, "8")]
    assert stage.checker._answer_thread is not None
    stage.checker._answer_thread.join(10.0)
    assert stage.look() == ("refused", "no")


def test_a_process_that_has_begun_the_next_question_is_left(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    stage = Stage(monkeypatch, [(1, None), (2, None)])
    stage.ask(7)
    stage.ask(8)
    stage.now += 2.5
    assert stage.look() == ("planning", "Planning for 2 s.")
    stage.now += 60.0
    assert stage.look() == ("planning", "Planning for 62 s.")
    assert (stage.started[0].ended, len(stage.started)) == (False, 1)


def test_an_ended_process_is_told_once_and_has_a_successor(monkeypatch: pytest.MonkeyPatch) -> None:
    stage = Stage(monkeypatch, [(1, None)], [(2, None), (2, YES)])
    stage.ask(7)
    stage.started[0].code = -9
    assert stage.look() == ("not checked", "The process that checks goals has ended.")
    assert stage.look() is None
    stage.ask(8)
    assert stage.look() == ("reachable", "yes")


def test_a_cancelled_question_is_told_to_the_process(monkeypatch: pytest.MonkeyPatch) -> None:
    stage = Stage(monkeypatch, [(1, None), (1, YES)])
    assert not stage.checker.cancel()
    stage.ask(7)
    assert stage.checker.cancel()
    assert not stage.checker.cancel()
    assert stage.look() is None
    assert stage.started[0].questions == [(1, "7"), (2, None)]
    stage.checker.close()
    stage.checker.close()
    assert stage.started[0].ended


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


# -- the answer ---------------------------------------------------------------------------------


def schedule(**changes: Any) -> Any:
    """A schedule that ends 0.3 m and 20 deg from the goal, and controls nothing."""
    turned = Goal.from_rotvec([0, 0, 0], [0, 0, math.radians(20)]).quaternion
    position = np.linspace([0.0, 0.0, 0.0], [1.0, 2.0, 2.7], 402)
    given = {
        "path": SimpleNamespace(position=position, quaternion=np.tile(turned, (402, 1))),
        "positions": np.array([[0.0, 0.0], [0.25, -0.5]]),
        "controls": frozenset(),
        "method": "gait",
        "partial": False,
        "expected_duration": 12.3456,
    }
    return SimpleNamespace(**{**given, **changes})


UPRIGHT = Goal.checked([1.0, 2.0, 3.0], [0.0, 0.0, 0.0, 1.0], [0.0, 0.0])
FINE = Tolerance(1e-3, 1e-3, 1e-3)


@pytest.mark.parametrize(
    ("changes", "goal", "tolerance", "text"),
    [
        (
            {},
            UPRIGHT,
            FINE,
            " 'gait' does not control the position: it ends 0.3 m off."
            " 'gait' does not control the attitude: it ends 20 deg off."
            " 'gait' does not control the final joint positions.",
        ),
        ({"controls": frozenset({"position", "attitude", "shape"})}, UPRIGHT, FINE, ""),
        (
            {"controls": frozenset({"shape", "attitude"})},
            UPRIGHT,
            FINE,
            " 'gait' does not control the position: it ends 0.3 m off.",
        ),
        (
            {"controls": frozenset({"position"})},
            replace(UPRIGHT, joint_positions=None),
            FINE,
            " 'gait' does not control the attitude: it ends 20 deg off.",
        ),
        ({}, replace(UPRIGHT, joint_positions=None), Tolerance(0.31, 0.36, 1.0), ""),
        (
            {},
            replace(UPRIGHT, joint_positions=None, base=frozenset({"attitude"})),
            FINE,
            " 'gait' does not control the attitude: it ends 20 deg off.",
        ),
    ],
)
def test_the_parts_of_a_goal_that_a_method_does_not_control_are_named(
    changes: dict[str, Any], goal: Goal, tolerance: Tolerance, text: str
) -> None:
    made = schedule(**changes)
    end = np.concatenate([made.path.position[-1], made.path.quaternion[-1]])
    assert _uncontrolled_text(made, end, goal, tolerance) == text


def test_an_answer_has_the_end_of_the_plan(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    built: list[str] = []
    planned: list[Any] = []

    class Worker:
        def __init__(self, robot: str, config: object) -> None:
            built.append(robot)

        def plan(self, task: Any, cancellation: Cancellation) -> Any:
            if not planned:
                planned.append(task)
                raise PlanningError("There is no way.")
            planned.append(task)
            return schedule(controls=frozenset({"position", "attitude", "shape"}))

    monkeypatch.setattr(reachability, "PlanningWorker", Worker)
    monkeypatch.setattr(reachability, "robot_from_text", lambda urdf, config: urdf)
    planner = Planner()
    question = GoalQuestion("one", {"attitude_tolerance": "0.25"}, STATE, UPRIGHT)
    refused = planner.answer(question, Cancellation())
    assert (refused.verdict, refused.message) == (Verdict.REFUSED, "There is no way.")
    assert (refused.shape, refused.base) == (None, None)
    answer = planner.answer(question, Cancellation())
    assert answer.verdict is Verdict.REACHABLE
    assert answer.message == "Reachable in 12.35 s by 'gait'."
    assert answer.duration_s == 12.3456
    assert answer.shape is not None
    assert answer.base is not None
    np.testing.assert_array_equal(answer.shape, [0.25, -0.5])
    np.testing.assert_allclose(answer.base[:3], [1.0, 2.0, 2.7])
    np.testing.assert_allclose(answer.base[3:], schedule().path.quaternion[0])
    assert planned[-1].request.tolerance.attitude == 0.25
    assert planned[-1].request.goal is UPRIGHT
    planner.answer(replace(question, urdf="two"), Cancellation())
    planner.answer(replace(question, urdf="two", goal=GOAL), Cancellation())
    planner.answer(replace(question, urdf="two", parameters={}), Cancellation())
    assert built == ["one", "two", "two"]


def test_the_last_question_is_taken_and_cancels_the_one_before() -> None:
    last = _LastQuestion()
    last.put((1, asked(1)))
    last.put((2, asked(2)))
    (number, _), first = last.take()
    assert number == 2
    assert not first.requested
    last.put((3, None))
    assert first.requested
    (number, question), second = last.take()
    assert (number, question) == (3, None)
    assert not second.requested
