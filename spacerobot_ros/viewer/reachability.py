"""Whether a goal is reachable, found out by planning for it in a process of its own.

The process is of lower priority, so that neither the page nor the plant waits for it. It has one
goal at a time: a newer one cancels the plan that is being made. Requests and answers are lines of
JSON on its standard input and output.
"""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import threading
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from enum import Enum
from typing import IO, Any

import numpy as np

from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.shared_parameters import robot_from_text
from spacerobot_ros.model.urdf import parse_robot
from spacerobot_ros.parameters import configured, declared
from spacerobot_ros.planning import Goal, PoseError
from spacerobot_ros.planning.core.cancellation import Cancellation, PlanningCancelled
from spacerobot_ros.planning.core.goal import RobotState, Tolerance
from spacerobot_ros.planning.core.method import PlanRequest
from spacerobot_ros.planning.core.progress import reported
from spacerobot_ros.planning.core.schedule import GaitSchedule
from spacerobot_ros.planning.execution.config import PlannerConfig
from spacerobot_ros.planning.execution.worker import PlanningTask, PlanningWorker
from spacerobot_ros.termination import Terminated, child_options, guarded
from spacerobot_ros.viewer.arm_shape import arm_shape, is_near

_NICE = 10
"""What is added to the niceness of the process: everything else goes first."""

_LONGEST_CANCELLATION = 2.0
"""Wall s that a plan may take to end after its cancellation before the process is killed."""

_MOST_POINTS = 200
"""Of the path that is sent back."""


class Verdict(str, Enum):
    """What is known of a goal."""

    UNCHECKED = "unchecked"
    """Nobody plans for it: the page is not to check, or only a controller flies."""
    PLANNING = "planning"
    REACHABLE = "reachable"
    REFUSED = "refused"


@dataclass(frozen=True, eq=False)
class Check:
    """What a check has come to.

    Attributes
    ----------
    verdict
        Of the goal.
    sentence
        The same for people, with the reason of a refusal.
    duration_s
        Of the manoeuvre, s; 0 where there is none.
    shape
        (n,) joints at its end, m or rad; None where there is none.
    path
        (k, 3) of the base, m; None likewise.
    """

    verdict: Verdict
    sentence: str = ""
    duration_s: float = 0.0
    shape: Array | None = None
    path: Array | None = None


@dataclass(frozen=True)
class Question:
    """What is to be planned.

    Attributes
    ----------
    urdf
        The robot.
    parameters
        The planner's own, as JSON texts by their names.
    state, goal
        From where, and to where.
    tool, link
        Where a link is to be, for a controller, which plans nothing: then it is asked whether there
        is a shape in which it is there. None: a planner flies.
    """

    urdf: str
    parameters: Mapping[str, str]
    state: RobotState
    goal: Goal
    tool: Goal | None = None
    link: str = ""

    def to_json(self, number: int) -> str:
        """Return the line that asks it."""
        state, goal, tool = self.state, self.goal, self.tool
        return json.dumps(
            {
                "number": number,
                "urdf": self.urdf,
                "parameters": dict(self.parameters),
                "state": [
                    each.tolist()
                    for each in (
                        *(state.position, state.quaternion, state.q),
                        *(state.linear_momentum, state.angular_momentum),
                    )
                ],
                "goal": [goal.position.tolist(), goal.quaternion.tolist(), _listed(goal)],
                "tool": tool and [tool.position.tolist(), tool.quaternion.tolist()],
                "link": self.link,
            }
        )


def _listed(goal: Goal) -> list[float] | None:
    """Return the joint positions of a goal."""
    return None if goal.joint_positions is None else goal.joint_positions.tolist()


class GoalChecker:
    """Answers questions in the background, the last one only."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._reader: threading.Thread | None = None
        self._number = self._begun = 0
        self._last = self._progress = ""
        self._asked_at = 0.0
        self._cancelled_at: float | None = None
        self._answered = True
        self._answers: dict[int, Check] = {}
        self._lock = threading.Lock()

    def ask(self, question: Question) -> None:
        """Drop what is being planned, and plan for this."""
        process = self._running()
        self._number += 1
        if not self._answered and self._cancelled_at is None:
            self._cancelled_at = time.monotonic()
        self._answered, self._asked_at = False, time.monotonic()
        self._last = question.to_json(self._number)
        self._send(process, self._last)

    def cancel(self) -> bool:
        """Drop what is being planned; return whether anything was."""
        if self._process is None or self._answered:
            return False
        self._number += 1
        self._cancelled_at = self._cancelled_at or time.monotonic()
        self._answered = True
        self._send(self._process, json.dumps({"number": self._number}))
        return True

    def look(self) -> Check | None:
        """Return the answer to the last question, once; before, how long it has been planned."""
        if self._answered:
            return None
        with self._lock:
            answer = self._answers.get(self._number)
            self._answers = {n: a for n, a in self._answers.items() if n >= self._number}
        if answer is not None:
            self._answered, self._cancelled_at = True, None
            return answer
        if self._process is not None and self._process.poll() is not None:
            self._answered = True
            return Check(Verdict.UNCHECKED, "The process that checks goals has ended.")
        if self._stuck():
            # A solver, or a compiler, that does not look for its cancellation.
            self.close()
            self._send(self._running(), self._last)
        seconds, found = time.monotonic() - self._asked_at, self._progress
        return Check(Verdict.PLANNING, f"Planning for {seconds:.0f} s{found}.")

    def close(self) -> None:
        """End the process."""
        process, self._process = self._process, None
        self._cancelled_at = None
        if process is not None:
            with suppress(OSError):
                os.killpg(process.pid, 9)
            process.wait()
            for stream in (process.stdin, process.stdout):
                if stream is not None:
                    with suppress(OSError):
                        stream.close()

    def _stuck(self) -> bool:
        since = self._cancelled_at
        if since is None or time.monotonic() - since < _LONGEST_CANCELLATION:
            return False
        with self._lock:
            begun = self._begun
        self._cancelled_at = None
        return begun != self._number

    def _running(self) -> subprocess.Popen[bytes]:
        if self._process is None or self._process.poll() is not None:
            self.close()
            self._begun = 0
            self._process = subprocess.Popen(
                [sys.executable, "-m", __name__],
                **child_options(),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                start_new_session=True,
            )
            assert self._process.stdout is not None
            self._reader = threading.Thread(
                target=self._read, args=(self._process.stdout,), daemon=True
            )
            self._reader.start()
        return self._process

    def _send(self, process: subprocess.Popen[bytes], line: str) -> None:
        assert process.stdin is not None
        with suppress(OSError):  # It has ended, which the next look notices.
            process.stdin.write(line.encode() + b"\n")
            process.stdin.flush()

    def _read(self, lines: IO[bytes]) -> None:
        with suppress(ValueError, OSError):  # Closed.
            for line in lines:
                answer = json.loads(line)
                with self._lock:
                    if "progress" in answer:
                        self._progress = f": {answer['progress']}"
                    elif "verdict" in answer:
                        self._answers[answer["number"]] = _check_of(answer)
                    else:
                        self._begun, self._progress = answer["number"], ""


def _check_of(answer: Mapping[str, Any]) -> Check:
    shape, path = answer.get("shape"), answer.get("path")
    return Check(
        Verdict(answer["verdict"]),
        answer["sentence"],
        answer.get("duration_s", 0.0),
        None if shape is None else np.array(shape, float),
        None if path is None else np.array(path, float).reshape(-1, 3),
    )


# -- in the process -----------------------------------------------------------------------------


class Planner:
    """Plans as the planner of a stack would, from rest; keeps what was built for the last one."""

    def __init__(self) -> None:
        self._built: tuple[str, Mapping[str, str]] | None = None

    def answer(self, question: Mapping[str, Any], cancellation: Cancellation) -> dict[str, Any]:
        """Return what the plan comes to, as a line carries it.

        Raises
        ------
        PlanningCancelled
            A newer question has come.
        """
        try:
            if question["tool"] is not None:
                return _of_arm(question)
            built = question["urdf"], question["parameters"]
            if built != self._built:
                self._build(*built)
                self._built = built
            r, o, q, p, L = (np.array(each, float) for each in question["state"])
            state = RobotState(r, o, q, p, L)
            goal = Goal.checked(*question["goal"])
            request = PlanRequest(state, goal, self._config.tolerance)
            schedule = self._worker.plan(PlanningTask(request), cancellation)
        except PlanningCancelled:
            raise
        except SpaceRobotError as error:
            return {"verdict": Verdict.REFUSED.value, "sentence": str(error)}
        path = schedule.path.position
        step = max(1, len(path) // _MOST_POINTS)
        duration = schedule.expected_duration
        sentence = f"Reachable in {duration:.4g} s by '{schedule.method}'."
        return {
            "verdict": Verdict.REACHABLE.value,
            "sentence": f"{sentence}{_left_out(schedule, goal, request.tolerance)}",
            "duration_s": duration,
            "shape": schedule.positions[-1].tolist(),
            "path": np.vstack([path[:-1:step], path[-1:]]).tolist(),
        }

    def _build(self, urdf: str, parameters: Mapping[str, str]) -> None:
        self._built = None
        known = {each.name for each in declared(PlannerConfig)}
        values = {name: json.loads(text) for name, text in parameters.items() if name in known}
        values = {name: value for name, value in values.items() if value is not None}
        # The robot is that of the stack; the planner may have it from there as well.
        self._config = configured(PlannerConfig, {**values, "robot_description": "", "robot": ""})
        self._worker = PlanningWorker(robot_from_text(urdf, self._config), self._config)


def _left_out(schedule: GaitSchedule, goal: Goal, tolerance: Tolerance) -> str:
    """Return which parts of a goal a schedule does not heed, and how far off its end is there."""
    path, controls = schedule.path, schedule.controls
    error = PoseError.between(path.position[-1], path.quaternion[-1], goal)
    parts = []
    if "position" not in controls and error.distance > tolerance.position:
        parts.append(("position", f"{error.distance:.3g} m"))
    if "attitude" not in controls and error.angle > tolerance.attitude:
        parts.append(("attitude", f"{math.degrees(error.angle):.3g} deg"))
    if "shape" not in controls and goal.joint_positions is not None:
        parts.append(("final joint positions", ""))
    return "".join(
        f" '{schedule.method}' does not heed the {part}"
        # Where later schedules end is not known yet.
        + (f": it ends {off} off." if off and not schedule.partial else ".")
        for part, off in parts
    )


def _of_arm(question: Mapping[str, Any]) -> dict[str, Any]:
    """Return whether there is a shape in which the end-effector is at its goal."""
    robot = parse_robot(question["urdf"])
    base, tool = (Goal.checked(*question[name]) for name in ("goal", "tool"))
    q = np.array(question["state"][2], float)
    shape, distance, angle = arm_shape(robot, question["link"], base, tool, q)
    found = {"shape": shape.tolist()}
    if is_near(distance, angle):
        sentence = "The end-effector can be at its goal there."
        return {"verdict": Verdict.REACHABLE.value, "sentence": sentence, **found}
    sentence = (
        f"No shape was found in which the end-effector is at its goal: it is {distance:.3g} m and "
        f"{angle:.3g} rad off in the nearest."
    )
    return {"verdict": Verdict.REFUSED.value, "sentence": sentence, **found}


class _LastQuestion:
    """The last question, for the thread that plans; a new one cancels the plan being made."""

    def __init__(self) -> None:
        self._condition = threading.Condition()
        self._question: dict[str, Any] | None = None
        self._cancellation = Cancellation()

    def put(self, question: dict[str, Any]) -> None:
        with self._condition:
            self._question = question
            self._cancellation.cancel()
            self._condition.notify()

    def take(self) -> tuple[dict[str, Any], Cancellation]:
        with self._condition:
            while self._question is None:
                # Bounded, so that signals are noticed.
                self._condition.wait(0.5)
            question, self._question = self._question, None
            self._cancellation = Cancellation()
            return question, self._cancellation


def main() -> None:
    """Answer questions until standard input ends."""
    with guarded(), suppress(Terminated):
        os.nice(_NICE)
        # What libraries print is not to be among the answers.
        answers = os.fdopen(os.dup(1), "w")
        os.dup2(2, 1)
        last = _LastQuestion()

        def read() -> None:
            for line in sys.stdin:
                last.put(json.loads(line))
            os._exit(0)

        def say(**words: Any) -> None:
            answers.write(json.dumps(words) + "\n")
            answers.flush()

        threading.Thread(target=read, daemon=True).start()
        planner, number = Planner(), 0
        with reported(lambda progress: say(number=number, progress=progress.sentence)):
            while True:
                question, cancellation = last.take()
                number = question["number"]
                say(number=number)
                if "urdf" in question:
                    with suppress(PlanningCancelled):
                        say(number=number, **planner.answer(question, cancellation))


if __name__ == "__main__":
    main()
