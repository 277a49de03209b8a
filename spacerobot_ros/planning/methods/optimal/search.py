"""The search for the fastest manoeuvre: guesses, solutions, held commands, until time is up."""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass, field, replace

import numpy as np

from spacerobot_ros.errors import PlanningError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.rotations import quaternion_multiply
from spacerobot_ros.planning.core.cancellation import Cancellation
from spacerobot_ros.planning.core.prediction import BasePrediction
from spacerobot_ros.planning.methods.optimal.constraints import PathConstraints
from spacerobot_ros.planning.methods.optimal.held_commands import CommandHolder, HeldCommands
from spacerobot_ros.planning.methods.optimal.initial_guesses import InitialGuesses
from spacerobot_ros.planning.methods.optimal.limits import MotionLimits
from spacerobot_ros.planning.methods.optimal.optimal_control import ManoeuvreProblem
from spacerobot_ros.planning.methods.optimal.reach import nearest_for_center
from spacerobot_ros.planning.methods.optimal.trajectory import Task, Trajectory
from spacerobot_ros.planning.methods.optimal.transcription import turn_function

_LOG = logging.getLogger(__name__)

_FEWEST_TICKS = 20
"""A manoeuvre has at least as many: chords of fewer are no image of a curve."""

_LAST_CALL = 5.0
"""Without anything found, a search goes on for this many times its time budget."""

_UNHURRIED = 4.0
"""A gentle manoeuvre is the path of least effort in this many times the time of its guess, then as
fast as the limits allow."""

_ROOM_IN_GIVEN_TIME = 0.99
"""Share of velocities and accelerations that is planned with where the time cannot stretch."""


@dataclass(frozen=True)
class Effort:
    """How long and how hard to search; times in s.

    ``duration`` 0 is the least time; ``gentle`` prefers the path of least effort, whose turn of the
    base depends least on masses that are not quite known.
    """

    duration: float
    longest: float
    starts: int
    answers: int
    time_budget: float
    gentle: bool = False


@dataclass(frozen=True)
class Found:
    """A manoeuvre that takes ``duration`` seconds, how many ``starts`` were made for it, and the
    durations of all ``answers``, s. ``solution_time`` is what it took before it was made into held
    commands.
    """

    held: HeldCommands
    duration: float
    solution_time: float
    starts: int = 1
    answers: list[float] = field(default_factory=list)


class ManoeuvreSearch:
    """Searches for manoeuvres of one robot.

    Parameters
    ----------
    robot, prediction, control_period
        The model, the base motion that commands cause, and how long each is held, s.
    axes
        (m, 3) directions in the base along which the attitude is met.
    constraints
        What the path must keep.
    """

    def __init__(
        self,
        robot: SpaceRobot,
        prediction: BasePrediction,
        control_period: float,
        axes: Array,
        constraints: PathConstraints,
    ) -> None:
        self._robot, self._period = robot, control_period
        self._axes, self._constraints = axes, constraints
        self._holder = CommandHolder(robot, prediction, control_period, axes)
        self._problems: dict[tuple[int, bool], ManoeuvreProblem] = {}

    def search(
        self,
        task: Task,
        limits: MotionLimits,
        quaternion: Array,
        intervals: int,
        effort: Effort,
        cancellation: Cancellation,
    ) -> Found:
        """Return the fastest manoeuvre found from attitude ``quaternion`` (4,) of R_WB.

        Raises
        ------
        PlanningError
            None was found, or the search was cancelled.
        """
        began = time.monotonic()
        deadline = began + effort.time_budget
        problem = self._problem(intervals, task.center is not None)
        curvature = self._robot.function("curvature", compile=False)
        guesses = InitialGuesses(turn_function(self._robot), curvature, intervals)
        found: list[Found] = []
        reasons: list[str] = []
        for guess in guesses.of(task, limits, task.likely):
            # Until something is found the search may go on beyond its time.
            last_call = deadline if found else began + _LAST_CALL * effort.time_budget
            trajectory = self._solved(
                problem, task, limits, guess, deadline, last_call, effort, cancellation
            )
            cancellation.raise_if_requested()
            answer = self._checked(trajectory, task, limits, quaternion, effort)
            now = time.monotonic()
            _LOG.info(
                "start %d: %s after %.2f s, %d steps of the solver",
                len(found) + len(reasons) + 1,
                answer if isinstance(answer, str) else f"{answer.duration:.6g} s",
                now - began,
                problem.iterations,
            )
            if isinstance(answer, str):
                reasons.append(answer)
            else:
                found.append(answer)
            starts = len(found) + len(reasons)
            if len(found) >= effort.answers or starts >= effort.starts:
                break
            if now >= (deadline if found else began + _LAST_CALL * effort.time_budget):
                break
        if not found:
            raise PlanningError(
                f"No manoeuvre to the goal was found from {len(reasons)} start(s) in "
                f"{time.monotonic() - began:.3g} s: {reasons[-1]}. A longer optimal.time_budget or "
                "optimal.longest, more optimal.intervals, or a smaller goal may help."
            )
        best = min(found, key=lambda one: one.duration)
        return replace(best, starts=starts, answers=[one.duration for one in found])

    def _checked(
        self,
        trajectory: Trajectory | None,
        task: Task,
        limits: MotionLimits,
        quaternion: Array,
        effort: Effort,
    ) -> Found | str:
        """Return a solution as held commands, or what is wrong with it."""
        if trajectory is None:
            return "the solver came to no way that keeps the limits"
        held = self._held(trajectory, task, limits, effort)
        if held is None:
            return "held commands could not be brought to the goal within the limits"
        attitudes = np.array([quaternion_multiply(quaternion, x) for x in held.quaternions])
        broken = self._constraints.violation(held.positions, attitudes, self._period)
        if broken:
            return broken
        duration = (len(held.positions) - 1) * self._period
        return Found(held, duration, trajectory.duration)

    def _problem(self, intervals: int, position: bool) -> ManoeuvreProblem:
        key = intervals, position
        if key not in self._problems:
            self._problems[key] = ManoeuvreProblem(
                self._robot, intervals, self._axes, position, self._constraints
            )
        return self._problems[key]

    def _solved(
        self,
        problem: ManoeuvreProblem,
        task: Task,
        limits: MotionLimits,
        guess: Trajectory,
        deadline: float,
        last_call: float,
        effort: Effort,
        cancellation: Cancellation,
    ) -> Trajectory | None:
        shortest = _FEWEST_TICKS * self._period
        guess = self._constraints.slowed(guess)
        if effort.duration > 0:
            limits = replace(
                limits,
                velocity=_ROOM_IN_GIVEN_TIME * limits.velocity,
                acceleration=_ROOM_IN_GIVEN_TIME * limits.acceleration,
            )
            T = max(round(effort.duration / self._period), 1) * self._period
        elif effort.gentle:
            T = max(_UNHURRIED * guess.duration, shortest)
        else:
            solution = problem.solve(
                task,
                limits,
                guess,
                shortest=shortest,
                longest=effort.longest,
                deadline=deadline,
                last_call=last_call,
                cancellation=cancellation,
            )
            if solution is None or problem.converged or self._constraints.base_rate > 0:
                return solution
            # What was cut short has time to spare.
            return solution.hurried(limits, shortest)
        guess = guess.retimed(T / guess.duration)
        solution = problem.solve(
            task,
            limits,
            guess,
            shortest=T,
            longest=T,
            effort=True,
            deadline=deadline,
            last_call=last_call,
            cancellation=cancellation,
        )
        if solution is None or not effort.gentle:
            return solution
        return solution.hurried(limits, shortest)

    def _held(
        self, trajectory: Trajectory, task: Task, limits: MotionLimits, effort: Effort
    ) -> HeldCommands | None:
        final = task.final
        if final is None:
            final = np.clip(trajectory.shapes[-1], limits.lower, limits.upper)
        if task.center is not None:
            found = nearest_for_center(self._robot, limits, final, task.center)
            if found is None:
                return None
            final = found
        return self._holder.hold(trajectory, task, final, limits, fixed=effort.duration > 0)
