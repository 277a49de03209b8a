"""Manoeuvres that begin while the joints move.

The first held command follows the one before it, so neither the beginning nor the duration of a
solution can be stretched to whole control periods. The fastest trajectory is found first; then the
one of least effort in as many control periods, or a few more, is solved for from there, and made
into held commands within the limits.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from spacerobot_ros.errors import PlanningError
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

ROOM = 0.98
"""Share of velocities and accelerations that is planned with: bends of a path take the rest."""

_MORE_TICKS = (0, 1, 3, 7)
"""Control periods by which a manoeuvre is made longer where its commands exceed a limit."""


@dataclass(frozen=True)
class MotionBudget:
    """How hard to search for a manoeuvre that begins in motion.

    Attributes
    ----------
    duration
        What it is to take, s; 0: the least time.
    longest
        Longest manoeuvre, s.
    starts, solutions
        Guesses that are tried at most, and manoeuvres that are enough.
    iterations
        Steps of the solver from each guess at most.
    """

    duration: float
    longest: float
    starts: int
    solutions: int
    iterations: int


@dataclass(frozen=True)
class MovingManoeuvre:
    """A manoeuvre that was found, as held commands; the guesses tried, and all durations, s."""

    held: HeldCommands
    starts: int
    durations: list[float]


class MotionSearch:
    """Searches for manoeuvres of one robot that begin in motion.

    Parameters
    ----------
    robot, prediction, control_period
        The model, the base motion that commands cause, and how long each is held, s.
    axes
        (m, 3) directions in the base along which the attitude is reached.
    constraints
        What the path must keep.
    solver
        Returns what solves the problem on so many intervals, with or without a position.
    """

    def __init__(
        self,
        robot: SpaceRobot,
        prediction: BasePrediction,
        control_period: float,
        axes: Array,
        constraints: PathConstraints,
        solver: Callable[[int, bool], MultipleShooting],
    ) -> None:
        self._robot, self._period, self._constraints = robot, control_period, constraints
        self._holder = CommandHolder(robot, prediction, control_period, axes)
        self._solver = solver

    def search(
        self,
        boundary: BoundaryConditions,
        limits: MotionLimits,
        quaternion: Array,
        intervals: int,
        budget: MotionBudget,
        remaining: Array,
        cancellation: Cancellation = NEVER,
    ) -> MovingManoeuvre:
        """Return the fastest manoeuvre found from attitude ``quaternion`` (4,) of R_WB.

        ``remaining`` (M + 1, n) is the first guess: the shapes at the ticks so far.

        Raises
        ------
        PlanningError
            None was found.
        PlanningCancelled
            The search was cancelled.
        """
        found: list[HeldCommands] = []
        starts, rejection = 0, ""
        solver = self._solver(intervals, boundary.center is not None)
        for guess in self._guesses(boundary, limits, solver, remaining):
            try:
                held = self._manoeuvre(solver, boundary, limits, guess, budget, cancellation)
                attitudes = np.array([quaternion_multiply(quaternion, x) for x in held.quaternions])
                self._constraints.check(held.positions, attitudes, self._period)
                found.append(held)
            except CandidateError as reason:
                rejection = str(reason)
            cancellation.raise_if_requested()
            starts += 1
            if len(found) >= budget.solutions or starts >= budget.starts:
                break
        if not found:
            raise PlanningError(
                f"No manoeuvre to the goal that begins in motion was found from {starts} start(s): "
                f"{rejection}."
            )
        durations = [(len(held.positions) - 1) * self._period for held in found]
        return MovingManoeuvre(min(found, key=lambda held: len(held.positions)), starts, durations)

    def _manoeuvre(
        self,
        solver: MultipleShooting,
        boundary: BoundaryConditions,
        limits: MotionLimits,
        guess: Trajectory,
        budget: MotionBudget,
        cancellation: Cancellation,
    ) -> HeldCommands:
        """Return held commands from a guess.

        Raises
        ------
        CandidateError
            There are none that reach the goal within the limits.
        """
        stop = StopRule(budget.iterations, cancellation)
        # What is held at the start must be admitted all the same.
        narrowed = replace(
            limits,
            velocity=np.maximum(ROOM * limits.velocity, np.abs(boundary.velocity)),
            acceleration=ROOM * limits.acceleration,
        )
        duration = budget.duration
        if duration == 0:
            fastest = solver.solve(
                boundary,
                narrowed,
                guess,
                stop,
                shortest=4 * self._period,
                longest=budget.longest,
            )
            if fastest is None:
                raise CandidateError("the solver came to no way that keeps the limits")
            guess, duration = fastest, fastest.duration
        ticks = max(1, math.ceil(duration / self._period - 1e-6))
        for more in _MORE_TICKS if budget.duration == 0 else (0,):
            T = (ticks + more) * self._period
            solution = solver.solve(
                boundary,
                narrowed,
                replace(guess, step=T / solver.intervals),
                stop,
                shortest=T,
                longest=T,
                least_effort=True,
            )
            cancellation.raise_if_requested()
            if solution is None:
                continue
            final = boundary.final
            if final is None:
                final = np.clip(solution.shapes[-1], limits.lower, limits.upper)
            if boundary.center is not None:
                final = nearest_for_center(self._robot, limits, final, boundary.center)
            if final is None:
                continue
            held = self._holder.hold(solution, boundary, final, limits, fixed=True)
            if held is not None:
                return held
        raise CandidateError("held commands could not be brought to the goal within the limits")

    def _guesses(
        self,
        boundary: BoundaryConditions,
        limits: MotionLimits,
        solver: MultipleShooting,
        remaining: Array,
    ) -> Iterator[Trajectory]:
        """Yield what remains of the motion so far, then guesses with loops, from its velocity."""
        velocity = np.broadcast_to(boundary.velocity, boundary.start.shape)
        curvature = self._robot.function("curvature", compile=False)
        guesses = InitialGuesses(solver.turn, curvature, solver.intervals)
        if len(remaining) > 1:
            yield guesses.along(remaining, velocity, self._period)
        for guess in guesses.of(boundary, limits, boundary.likely):
            yield guesses.moving(guess, velocity, limits)
