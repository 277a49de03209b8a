"""The search for the fastest manoeuvre: guesses, solutions, held commands."""

from __future__ import annotations

import logging
import math
import time
from dataclasses import dataclass, field, replace

import numpy as np

from spacerobot_ros.errors import NotFoundError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.rotations import quaternion_multiply
from spacerobot_ros.planning.core.cancellation import NEVER, Cancellation
from spacerobot_ros.planning.core.prediction import BasePrediction
from spacerobot_ros.planning.methods.optimal.goal_specification import nearest_for_center
from spacerobot_ros.planning.methods.optimal.held_commands import CommandHolder, HeldCommands
from spacerobot_ros.planning.methods.optimal.initial_guesses import InitialGuesses
from spacerobot_ros.planning.methods.optimal.multiple_shooting import MultipleShooting, StopRule
from spacerobot_ros.planning.methods.optimal.problem import (
    BoundaryConditions,
    CandidateError,
    MotionLimits,
    PathConstraints,
    Trajectory,
)
from spacerobot_ros.planning.methods.optimal.transcription import Stages

_LOG = logging.getLogger(__name__)

_FEWEST_TICKS = 2
"""A manoeuvre has at least as many: one begins to move, another one stops."""

_GENTLE_TICKS, _GENTLE_TIME = 20, 1.0
"""A gentle manoeuvre has as many ticks or takes as long, s, whichever is less: it corrects what is
left, and haste would leave more."""

_LAST_CALL = 5.0
"""Without anything found, a search goes on for this many times its time budget."""

_UNHURRIED = 4.0
"""A gentle manoeuvre is the path of least effort in this many times the time of its guess, then as
fast as the limits allow."""

_ROOM_IN_GIVEN_TIME = 0.99
"""Share of velocities and accelerations that is planned with where the time cannot stretch."""


@dataclass(frozen=True)
class SearchBudget:
    """How hard to search.

    Attributes
    ----------
    duration
        What a manoeuvre is to take, s; 0: the least time.
    longest
        Longest manoeuvre, s.
    starts, solutions
        Guesses that are tried at most, and manoeuvres that are enough.
    iterations
        Steps of the solver from each guess at most.
    time_budget
        Wall time, s; 0: no limit, and the result depends on the counts above alone.
    gentle
        Prefer the path of least effort, whose turn of the base depends least on masses that are
        not quite known.
    """

    duration: float
    longest: float
    starts: int
    solutions: int
    iterations: int
    time_budget: float
    gentle: bool = False


@dataclass(frozen=True)
class Manoeuvre:
    """A manoeuvre that was found.

    Attributes
    ----------
    held
        Its commands.
    duration
        s.
    solution_time
        What it took before it was made into held commands, s.
    starts
        Guesses that were tried.
    solutions
        Durations of all manoeuvres that were found, s.
    cut_short
        Whether the wall time was used up before the search had come to its end.
    """

    held: HeldCommands
    duration: float
    solution_time: float
    starts: int = 1
    solutions: list[float] = field(default_factory=list)
    cut_short: bool = False


class ManoeuvreSearch:
    """Searches for manoeuvres of one robot.

    Parameters
    ----------
    robot, prediction, control_period
        The model, the base motion that commands cause, and how long each is held, s.
    axes
        (m, 3) directions in the base along which the attitude is reached.
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
        self._solvers: dict[tuple[int, bool], MultipleShooting] = {}

    def search(
        self,
        boundary: BoundaryConditions,
        limits: MotionLimits,
        quaternion: Array,
        intervals: int,
        budget: SearchBudget,
        cancellation: Cancellation = NEVER,
    ) -> Manoeuvre:
        """Return the fastest manoeuvre found from attitude ``quaternion`` (4,) of R_WB.

        Raises
        ------
        NotFoundError
            None was found.
        PlanningCancelled
            The search was cancelled.
        """
        began = time.monotonic()
        deadline = last_call = math.inf
        if budget.time_budget > 0:
            deadline, last_call = (began + x * budget.time_budget for x in (1.0, _LAST_CALL))
        solver = self.solver(intervals, boundary.center is not None)
        curvature = self._robot.function("curvature", compile=False)
        guesses = InitialGuesses(solver.turn, curvature, intervals)
        found: list[Manoeuvre] = []
        starts, rejection = 0, ""
        for guess in guesses.of(boundary, limits, boundary.likely):
            # Until something is found the search may go on beyond its time.
            last = deadline if found else last_call
            stop = StopRule(budget.iterations, cancellation, deadline, last)
            try:
                solution = self._solution(solver, boundary, limits, guess, stop, budget)
                cancellation.raise_if_requested()
                manoeuvre = self._commanded(solution, boundary, limits, quaternion, budget)
                result = f"{manoeuvre.duration:.6g} s"
                found.append(manoeuvre)
            except CandidateError as reason:
                result = rejection = str(reason)
            starts += 1
            _LOG.info(
                "start %d: %s after %.2f s, %d steps of the solver",
                starts,
                result,
                time.monotonic() - began,
                solver.iterations,
            )
            # What was cut short within its last start is no less so.
            cut_short = stop.expired(found=bool(found))
            if cut_short or len(found) >= budget.solutions or starts >= budget.starts:
                break
        if not found:
            within = f" within optimal.time_budget {budget.time_budget:g} s" if cut_short else ""
            longer = "A longer optimal.time_budget, more" if cut_short else "More"
            raise NotFoundError(
                f"No manoeuvre to the goal was found from {starts} start(s){within}: {rejection}. "
                f"{longer} optimal.starts, optimal.iterations or optimal.intervals, a longer "
                "optimal.longest, or a smaller goal may help."
            )
        best = min(found, key=lambda one: one.duration)
        durations = [one.duration for one in found]
        return replace(best, starts=starts, solutions=durations, cut_short=cut_short)

    def solver(self, intervals: int, position: bool) -> MultipleShooting:
        """Return what solves the problem on so many intervals, with or without a position."""
        key = intervals, position
        if key not in self._solvers:
            stages = Stages.of(self._robot, self._axes, position, self._constraints)
            self._solvers[key] = MultipleShooting(stages, intervals)
        return self._solvers[key]

    def _solution(
        self,
        solver: MultipleShooting,
        boundary: BoundaryConditions,
        limits: MotionLimits,
        guess: Trajectory,
        stop: StopRule,
        budget: SearchBudget,
    ) -> Trajectory | None:
        """Return what the solver makes of a guess, None if nothing."""
        shortest = _FEWEST_TICKS * self._period
        if budget.gentle:
            shortest = max(shortest, min(_GENTLE_TICKS * self._period, _GENTLE_TIME))
        guess = self._constraints.slowed(guess)
        if budget.duration > 0:
            limits = replace(
                limits,
                velocity=_ROOM_IN_GIVEN_TIME * limits.velocity,
                acceleration=_ROOM_IN_GIVEN_TIME * limits.acceleration,
            )
            T = max(round(budget.duration / self._period), 1) * self._period
        elif budget.gentle:
            T = max(_UNHURRIED * guess.duration, shortest)
        else:
            solution = solver.solve(
                boundary, limits, guess, stop, shortest=shortest, longest=budget.longest
            )
            if solution is None or solver.converged or self._constraints.base_rate > 0:
                return solution
            # What was cut short has time to spare.
            return solution.hurried(limits, shortest)
        guess = guess.retimed(T / guess.duration)
        solution = solver.solve(
            boundary, limits, guess, stop, shortest=T, longest=T, least_effort=True
        )
        if solution is None or not budget.gentle:
            return solution
        return solution.hurried(limits, shortest)

    def _commanded(
        self,
        trajectory: Trajectory | None,
        boundary: BoundaryConditions,
        limits: MotionLimits,
        quaternion: Array,
        budget: SearchBudget,
    ) -> Manoeuvre:
        """Return a solution as held commands.

        Raises
        ------
        CandidateError
            There is no solution, or none that commands reach within the constraints.
        """
        if trajectory is None:
            raise CandidateError("the solver came to no way that keeps the limits")
        final = boundary.final
        if final is None:
            final = np.clip(trajectory.shapes[-1], limits.lower, limits.upper)
        if boundary.center is not None:
            final = nearest_for_center(self._robot, limits, final, boundary.center)
        fixed = budget.duration > 0
        held = None
        if final is not None:
            held = self._holder.hold(trajectory, boundary, final, limits, fixed=fixed)
        if held is None:
            raise CandidateError("held commands could not be brought to the goal within the limits")
        attitudes = np.array([quaternion_multiply(quaternion, x) for x in held.quaternions])
        self._constraints.check(held.positions, attitudes, self._period)
        duration = (len(held.positions) - 1) * self._period
        return Manoeuvre(held, duration, trajectory.duration)
