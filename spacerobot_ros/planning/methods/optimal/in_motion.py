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
from spacerobot_ros.planning.core.method import InitialMotion
from spacerobot_ros.planning.core.prediction import BasePrediction
from spacerobot_ros.planning.methods.optimal.goal_specification import nearest_for_center
from spacerobot_ros.planning.methods.optimal.held_commands import CommandHolder, HeldCommands
from spacerobot_ros.planning.methods.optimal.initial_guesses import InitialGuesses
from spacerobot_ros.planning.methods.optimal.joint_efforts import JointEfforts
from spacerobot_ros.planning.methods.optimal.multiple_shooting import MultipleShooting, StopRule
from spacerobot_ros.planning.methods.optimal.problem import (
    BoundaryConditions,
    CandidateError,
    MotionLimits,
    PathConstraints,
    Trajectory,
)

_ROOMS = (0.98, 1.0)
"""Shares of accelerations that are planned with, one after the other: bends of a path take the
rest, but a joint near its limit may need all to come to rest in time."""

_SLOWER = 0.02
"""Share of velocities that is left for the same reason, at most: a joint at full speed is slowed
down to the rest in a quarter of a control period."""

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
    constraints, efforts
        What the path must keep; no efforts: any.
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
        efforts: JointEfforts | None,
        solver: Callable[[int, bool], MultipleShooting],
    ) -> None:
        self._robot, self._period, self._constraints = robot, control_period, constraints
        self._holder = CommandHolder(robot, prediction, control_period, axes, efforts)
        self._solver = solver

    def search(
        self,
        boundary: BoundaryConditions,
        limits: MotionLimits,
        quaternion: Array,
        intervals: int,
        budget: MotionBudget,
        motion: InitialMotion,
        cancellation: Cancellation = NEVER,
    ) -> MovingManoeuvre:
        """Return the fastest manoeuvre found from attitude ``quaternion`` (4,) of R_WB.

        What remains of the motion so far is the first guess.

        Raises
        ------
        PlanningError
            None was found.
        PlanningCancelled
            The search was cancelled.
        """
        boundary = replace(boundary, velocity=self._velocity(motion, limits))
        found: list[HeldCommands] = []
        starts, rejection = 0, ""
        solver = self._solver(intervals, boundary.center is not None)
        for guess in self._guesses(boundary, limits, solver, motion.remaining):
            try:
                held = self._manoeuvre(
                    solver, boundary, limits, guess, motion, budget, cancellation
                )
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

    def _speed(self, limits: MotionLimits) -> Array:
        """Return the velocities (n,) that are planned with at most."""
        given_up = np.minimum(_SLOWER * limits.velocity, limits.acceleration * self._period / 4)
        return np.where(np.isfinite(limits.velocity), limits.velocity - given_up, limits.velocity)

    def _velocity(self, motion: InitialMotion, limits: MotionLimits) -> Array:
        """Return the velocities (n,) at the start: between those that are held before and after."""
        between = motion.velocity
        if len(motion.remaining) > 1:
            after = (motion.remaining[1] - motion.remaining[0]) / self._period
            between = (motion.velocity + after) / 2
        speed = self._speed(limits)
        return np.clip(between, -speed, speed)

    def _manoeuvre(
        self,
        solver: MultipleShooting,
        boundary: BoundaryConditions,
        limits: MotionLimits,
        guess: Trajectory,
        motion: InitialMotion,
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
        duration, fastest_used = budget.duration, self._speed(limits)
        for room in _ROOMS:
            narrowed = replace(
                limits, velocity=fastest_used, acceleration=room * limits.acceleration
            )
            if duration > 0:
                break
            fastest = solver.solve(
                boundary, narrowed, guess, stop, shortest=4 * self._period, longest=budget.longest
            )
            cancellation.raise_if_requested()
            if fastest is not None:
                guess, duration = fastest, fastest.duration
        if duration == 0:
            raise CandidateError("the solver came to no way that keeps the limits")
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
            held = self._holder.hold(
                solution, boundary, final, limits, fixed=True, before=motion.velocity
            )
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
