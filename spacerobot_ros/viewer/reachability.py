"""Checks in a child process whether a goal is reachable, by planning or by inverse kinematics of an
arm.

The process has low priority, so that neither the page nor the plant waits for it. It works on
one goal at a time: a newer goal cancels the plan in progress. Questions and answers are numbered.

A controller accepts any pose; only in flight does it report that the arm is too short. Goals for a
controller are checked by a search for joint positions at which both the base and the end-effector
are at their goals.
"""

from __future__ import annotations

import json
import os
import subprocess
import threading
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from enum import Enum
from functools import lru_cache, reduce
from multiprocessing.connection import Connection, Pipe
from queue import SimpleQueue

import numpy as np

from spacerobot_ros.control.outputs import default_selection
from spacerobot_ros.errors import GoalError, SpaceRobotError, quantity
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import DEFAULT_END_EFFECTOR, Array, Pose, RobotDescription
from spacerobot_ros.model.inverse_kinematics import AXES, FixedBaseArm, is_reached
from spacerobot_ros.model.rotations import matrix_from_quaternion
from spacerobot_ros.model.shared_parameters import (
    DEFAULT_POSITION_TOLERANCE,
    automatic_tolerance,
    robot_from_text,
)
from spacerobot_ros.model.urdf import parse_robot
from spacerobot_ros.parameters import configured, known_values
from spacerobot_ros.planning import Goal, PoseError
from spacerobot_ros.planning.core.cancellation import Cancellation, PlanningCancelled
from spacerobot_ros.planning.core.goal import RobotState, Tolerance, missed_parts
from spacerobot_ros.planning.core.method import PlanRequest
from spacerobot_ros.planning.core.prediction import coasting_positions
from spacerobot_ros.planning.core.progress import SearchProgress, report_progress
from spacerobot_ros.planning.core.schedule import GaitSchedule
from spacerobot_ros.planning.execution.config import PlannerConfig
from spacerobot_ros.planning.execution.goal_file import BASE_GOAL_KEY
from spacerobot_ros.planning.execution.status import PlannerState
from spacerobot_ros.planning.execution.worker import PlanningTask, PlanningWorker
from spacerobot_ros.termination import Terminated, end_child, guarded, start_child
from spacerobot_ros.viewer.state import Part, StackState

_NICENESS = 10
"""Niceness increment of the process, so that all other processes run first."""

_MAX_CANCELLATION_S = 2.0
"""Wall time, s, from the cancellation of a plan until the process is killed."""


class Verdict(Enum):
    """Verdict on a goal."""

    UNCHECKED = "not checked"
    """Not checked: checks are disabled, or only a controller is running."""
    PLANNING = "planning"
    REACHABLE = "reachable"
    PARTLY = "partly reachable"
    """Goal components that the method does not control end outside the tolerance."""
    REFUSED = "refused"


@dataclass(frozen=True, eq=False)
class GoalCheck:
    """Result of a goal check.

    Attributes
    ----------
    verdict
        The verdict.
    message
        Message for the user, including the reason if the goal is rejected.
    shape, base
        Predicted (n,) joint positions, m or rad, and (7,) base pose at the end; None if
        there is no prediction.
    source
        The planned motion on which the result is based, if this motion is already being executed.
    """

    verdict: Verdict
    message: str = ""
    shape: Array | None = None
    base: Array | None = None
    source: Array | None = None


@dataclass(frozen=True)
class GoalQuestion:
    """A goal to check, and the data on which the check is based.

    Attributes
    ----------
    urdf
        Description of the robot.
    parameters
        Planner parameters, as JSON strings by name.
    state, goal
        Start state of the robot, and the goal for its base, its links, or both.
    tool, link
        Link goal for a controller. A controller does not plan, so the check is whether the arm can
        reach this goal. None: a planner flies.
    axes
        Link axes that the controller controls; errors along other axes are ignored.
    """

    urdf: str
    parameters: Mapping[str, str]
    state: RobotState
    goal: Goal
    tool: Goal | None = None
    link: str = ""
    axes: tuple[str, ...] = AXES


def make_question(
    state: StackState,
    goals: Mapping[Part, Goal],
    robot: RobotDescription | None,
    parameters: Mapping[str, Mapping[str, str]],
) -> GoalQuestion | str:
    """Return a reachability question for goals, or the reason why no question is possible.

    Parameters
    ----------
    state, goals
        The state of the stack, and the goals by robot part.
    robot
        The robot; None: unknown.
    parameters
        Parameters of ``planner`` and ``controller``, as JSON strings by name, if known.
    """
    measured = state.measured
    if measured is None or robot is None:
        return "No state received yet."
    pose, q = (measured.pose[:3], measured.pose[3:]), measured.q
    if state.planner is None:
        goal, tool = goals.get(BASE_GOAL_KEY), goals.get(DEFAULT_END_EFFECTOR)
        if goal is None:
            return "The goal is for a planner, but none is running."
        if tool is None or tool.end_effectors:
            return "No planner is running: a controller flies the base to any pose."
        known = parameters.get("controller", {})
        link = robot.end_effector(json.loads(known.get("end_effector_frame", '""')))
        if link not in robot.frames:
            return "The end-effector is not a robot link."
        axes = json.loads(known.get("end_effector_outputs", '""')).split()
        axes = axes or default_selection(robot, link).end_effector or AXES
        return GoalQuestion(robot.urdf, {}, RobotState(*pose, q), goal, tool, link, tuple(axes))
    if "planner" in state.absent:
        return "The planner is offline."
    if state.planner.state is PlannerState.PLANNING:
        return "The planner is busy planning."
    if "planner" not in parameters:
        return "The planner's parameters have not been received yet."
    momenta = np.zeros(6) if state.momenta is None else state.momenta.actual
    start = RobotState(*pose, q, momenta[:3], momenta[3:])
    return GoalQuestion(robot.urdf, parameters["planner"], start, planned_goal(goals))


def planned_goal(goals: Mapping[Part, Goal]) -> Goal:
    """Combine goals by robot part into one planner goal, without controller goals.

    Raises
    ------
    GoalError
        None of the goals is for a planner.
    """
    planned = [g for part, g in goals.items() if part == BASE_GOAL_KEY or g.end_effectors]
    if not planned:
        raise GoalError(
            "The goal is for a controller's end-effector only: there is nothing to plan."
        )
    return reduce(Goal.joined_with, planned)


def planner_config(parameters: Mapping[str, str]) -> PlannerConfig:
    """Return the planner parameters contained in JSON strings by name; other values are omitted.

    Raises
    ------
    SpaceRobotError
        A value is refused.
    """
    values = {name: json.loads(x) for name, x in known_values(PlannerConfig, parameters).items()}
    values = {name: value for name, value in values.items() if value is not None}
    # The robot is the viewer's, wherever the planner takes its own from.
    elsewhere = {"robot_description": "", "robot": "", "world": ""}
    return configured(PlannerConfig, {**values, **elsewhere})


def goal_tolerance(
    parameters: Mapping[str, str] | None, robot: RobotDescription | None
) -> Tolerance | None:
    """Return the goal tolerance in the parameters of a planner or controller, if known."""
    names = ("position_tolerance", "attitude_tolerance", "joint_tolerance")
    if parameters is None or not all(name in parameters for name in names):
        return None
    position, attitude, joints = (float(json.loads(parameters[name])) for name in names)
    if not position and robot is not None:
        position = automatic_tolerance(robot)
    return Tolerance(position or DEFAULT_POSITION_TOLERANCE, attitude, joints)


def planned_links(
    parameters: Mapping[str, str] | None, robot: RobotDescription | None
) -> tuple[str, ...]:
    """Return the robot links for which a planner with these parameters accepts goals."""
    if parameters is None or robot is None:
        return ()
    try:
        names = planner_config(parameters).goal_links
    except SpaceRobotError:
        return ()  # The check of each goal reports the error.
    return tuple(name for name in names if name in robot.frames and name != robot.base_link)


class GoalChecker:
    """Checks goals in the background; a new question replaces the previous one."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._number = self._begun = 0
        self._last: GoalQuestion | None = None
        self._progress = ""
        self._asked_at = 0.0
        self._answered = True

    def ask(self, question: GoalQuestion) -> None:
        """Cancel the check in progress, and start checking a question."""
        self._require_process()
        self._number += 1
        self._answered, self._asked_at = False, time.monotonic()
        self._last = question
        self._send_question(question)

    def cancel(self) -> bool:
        """Cancel the check in progress; return whether a check was in progress."""
        if self._process is None or self._answered:
            return False
        self._number += 1
        self._answered = True
        self._send_question(None)
        return True

    def latest_answer(self) -> GoalCheck | None:
        """Return the answer to the last question, once; until the answer is available, return
        the time spent so far."""
        if self._answered:
            return None
        answer = self._received_answer()
        if answer is not None:
            self._answered = True
            return answer
        if self._process is not None and self._process.poll() is not None:
            self._answered = True
            return GoalCheck(Verdict.UNCHECKED, "The process that checks goals has terminated.")
        seconds, found = time.monotonic() - self._asked_at, self._progress
        if 0 < self._begun < self._number and seconds > _MAX_CANCELLATION_S:
            # A solver or compiler for an earlier goal does not check for cancellation.
            self.close()
            self._require_process()
            self._send_question(self._last)
        return GoalCheck(Verdict.PLANNING, f"Planning for {seconds:.0f} s{found}.")

    def close(self) -> None:
        """Terminate the child process that checks goals."""
        process, self._process = self._process, None
        if process is not None:
            end_child(process, {})

    def _require_process(self) -> None:
        if self._process is None or self._process.poll() is not None:
            self.close()
            self._begun = 0
            self._connection, theirs = Pipe()
            words = ["-c", f"from {__name__} import main; main({theirs.fileno()})"]
            # Output of libraries goes to standard error.
            self._process = start_child(words, pass_fds=[theirs.fileno()], stdout=2)
            theirs.close()

    def _send_question(self, question: GoalQuestion | None) -> None:
        """Send a numbered question; None cancels the earlier question."""
        with suppress(OSError):  # The process has ended; latest_answer notices it.
            self._connection.send((self._number, question))

    def _received_answer(self) -> GoalCheck | None:
        """Return the answer to the last question, if available; record earlier messages."""
        with suppress(OSError, EOFError):  # The process has ended.
            while self._connection.poll():
                number, answer = self._connection.recv()
                if answer is None:
                    self._begun, self._progress = number, ""
                elif isinstance(answer, str):
                    self._progress = f": {answer}"
                elif number == self._number:
                    return answer
        return None


# -- in the process -----------------------------------------------------------------------------


def answer_question(question: GoalQuestion, cancellation: Cancellation) -> GoalCheck:
    """Return the check result, planned from rest like by the planner of the stack.

    Raises
    ------
    PlanningCancelled
        A newer question has arrived.
    """
    try:
        if question.tool is not None:
            return _check_arm(question, question.tool)
        parameters = tuple(question.parameters.items())
        config, robot, worker = _build_planner(question.urdf, parameters)
        request = PlanRequest(question.state, question.goal, config.tolerance)
        schedule = worker.plan(PlanningTask(request), cancellation)
    except PlanningCancelled:
        raise
    except SpaceRobotError as error:
        return GoalCheck(Verdict.REFUSED, str(error))
    base = _predicted_end(robot, request, schedule)
    left_out = _uncontrolled_text(schedule, base, question.goal, request.tolerance)
    time_s, method = f"{schedule.expected_duration:.4g} s", schedule.method
    message = f"Reachable in {time_s} with '{method}'.{left_out}"
    verdict = Verdict.PARTLY if left_out else Verdict.REACHABLE
    return GoalCheck(verdict, message, schedule.positions[-1], base)


@lru_cache(maxsize=1)
def _build_planner(
    urdf: str, parameters: tuple[tuple[str, str], ...]
) -> tuple[PlannerConfig, SpaceRobot, PlanningWorker]:
    config = planner_config(dict(parameters))
    robot = robot_from_text(urdf, config)
    return config, robot, PlanningWorker(robot, config)


def _predicted_end(robot: SpaceRobot, request: PlanRequest, schedule: GaitSchedule) -> Array:
    """Return the predicted final base pose (7,), including later schedules.

    Later schedules bring the controlled components to the goal; an uncontrolled position follows
    from the centre of mass, which coasts.
    """
    position, quaternion = schedule.path.position[-1], schedule.path.quaternion[-1]
    if schedule.partial:
        goal = request.goal
        if "attitude" in schedule.controls:
            quaternion = goal.quaternion
        if "position" in schedule.controls:
            position = goal.position
        else:
            end = np.array([schedule.expected_duration]), schedule.positions[-1:]
            (position,) = coasting_positions(robot, request.state, *end, quaternion[np.newaxis])
    return np.concatenate([position, quaternion])


def _uncontrolled_text(
    schedule: GaitSchedule, base: Array, goal: Goal, tolerance: Tolerance
) -> str:
    """Return a sentence on each goal component the method does not control, with its error.

    ``base`` (7,) is the predicted final base pose.
    """
    controls, error = schedule.controls, PoseError.between(base[:3], base[3:], goal)
    missed = missed_parts(goal, error, controls, tolerance)
    parts = [f"{part}: it ends {off} off" for part, off in missed.items()]
    if "shape" not in controls and goal.joint_positions is not None:
        parts.append("final joint positions")
    return "".join(f" '{schedule.method}' does not control the {part}." for part in parts)


def _check_arm(question: GoalQuestion, tool: Goal) -> GoalCheck:
    goals = (question.goal, tool)
    base, end = (Pose(matrix_from_quaternion(g.quaternion), g.position) for g in goals)
    arm = FixedBaseArm(SpaceRobot(parse_robot(question.urdf)), question.link, base, question.axes)
    shape, distance, angle = arm.search_shape(question.state.q, end)
    if is_reached(distance, angle):
        message = "The end-effector can reach its goal there."
        return GoalCheck(Verdict.REACHABLE, message, shape=shape)
    message = (
        "The end-effector cannot reach its goal: at the nearest joint positions found, it misses "
        f"by {quantity(distance, 'm')} and {quantity(angle, 'rad')}."
    )
    return GoalCheck(Verdict.REFUSED, message, shape=shape)


def main(descriptor: int) -> None:
    """Answer questions on a connection until it closes."""
    with guarded(), suppress(Terminated):
        os.nice(_NICENESS)
        connection = Connection(descriptor)
        questions: SimpleQueue[tuple[int, GoalQuestion | None, Cancellation]] = SimpleQueue()

        def receive_questions() -> None:
            cancellation = Cancellation()
            with suppress(EOFError, OSError):
                while True:
                    number, question = connection.recv()
                    cancellation.cancel()
                    cancellation = Cancellation()
                    questions.put((number, question, cancellation))
            os._exit(0)

        threading.Thread(target=receive_questions, daemon=True).start()
        number = 0

        def send_progress(progress: SearchProgress) -> None:
            connection.send((number, f"{progress.message}, {progress.elapsed_s:.0f} s"))

        with report_progress(send_progress):
            while True:
                number, question, cancellation = questions.get()
                connection.send((number, None))
                if question is not None and not cancellation.requested:
                    with suppress(PlanningCancelled):
                        connection.send((number, answer_question(question, cancellation)))
