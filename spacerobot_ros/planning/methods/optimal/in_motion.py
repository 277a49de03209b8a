"""Manoeuvres that begin while the joints move.

The first held command follows the one before it, so neither the beginning nor the duration of a
solution can be stretched to whole control periods. The fastest trajectory is found first; then the
one of least effort in as many control periods, or a few more, is solved for from there, and made
into held commands within the limits.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from spacerobot_ros.errors import NotFoundError
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.rotations import quaternion_multiply
from spacerobot_ros.planning.core.cancellation import NEVER, Cancellation
from spacerobot_ros.planning.core.method import InitialMotion
from spacerobot_ros.planning.methods.optimal.goal_specification import nearest_for_center
from spacerobot_ros.planning.methods.optimal.held_commands import (
    CommandHolder,
    HeldCommands,
    ManoeuvreModel,
)
from spacerobot_ros.planning.methods.optimal.initial_guesses import InitialGuesses
from spacerobot_ros.planning.methods.optimal.multiple_shooting import (
    DurationBounds,
    MultipleShooting,
    StopRule,
)
from spacerobot_ros.planning.methods.optimal.problem import (
    BoundaryConditions,
    CandidateError,
    MotionLimits,
    Trajectory,
)

_ROOMS = (0.98, 1.0)
"""Shares of accelerations that are planned with, one after the other: bends of a path take the
rest, but a joint near its limit may need all to come to rest in time."""

_SLOWER = 0.02
"""Share of velocities that is left for the same reason, at most: a joint at full speed is slowed
down to the rest in a quarter of a control period."""

_COARSER, _FEWEST_INTERVALS = 4, 10
"""The grid on which solutions are looked for is coarser by this factor, and has at least as many
intervals."""

_REFINED = 3
"""Largest number of solutions that are made into commands, fastest first, until one keeps all
limits."""

_SAME, _AGREED = 1e-3, 3
"""Solutions of the same duration, relative, that end the search."""

_FEWEST_TICKS = 4
"""Control periods that a manoeuvre takes at least."""

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
    model
        What they must obey.
    solver
        Returns what solves the problem on so many intervals, with or without a position.
    """

    def __init__(
        self, model: ManoeuvreModel, solver: Callable[[int, bool], MultipleShooting]
    ) -> None:
        self._robot, self._period = model.robot, model.control_period
        self._constraints = model.constraints
        self._holder = CommandHolder(model)
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
        NotFoundError
            None was found.
        PlanningCancelled
            The search was cancelled.
        """
        boundary = replace(boundary, velocity=self._velocity(motion, limits))
        full = self._solver(intervals, boundary.center is not None)
        coarse = full
        if intervals >= _COARSER * _FEWEST_INTERVALS:
            coarse = self._solver(intervals // _COARSER, boundary.center is not None)
        stop = StopRule(budget.iterations, cancellation)
        candidates: list[Trajectory] = []
        starts, rejection = 0, "the solver came to no way that keeps the limits"
        guesses = self._guesses(boundary, limits, coarse, motion.remaining)
        for guess in itertools.islice(guesses, budget.starts):
            starts += 1
            if budget.duration > 0:
                candidates.append(guess)
            else:
                solution = self._fastest(coarse, boundary, limits, guess, stop, budget)
                candidates += [] if solution is None else [solution]
            cancellation.raise_if_requested()
            if len(candidates) >= budget.solutions or _agreed(candidates):
                break
        # What is left of a motion is short: the coarse grid is fine enough for it.
        fine = coarse if budget.solutions == 1 else full
        for candidate in sorted(candidates, key=lambda each: each.duration)[:_REFINED]:
            try:
                held = self._commanded(fine, boundary, limits, candidate, motion, budget, stop)
                attitudes = quaternion_multiply(quaternion, held.quaternions)
                self._constraints.check(held.positions, attitudes, self._period)
            except CandidateError as reason:
                rejection = str(reason)
                continue
            finally:
                cancellation.raise_if_requested()
            return MovingManoeuvre(held, starts, [each.duration for each in candidates])
        raise NotFoundError(
            f"No manoeuvre to the goal that begins in motion was found from {starts} start(s): "
            f"{rejection}."
        )

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

    def _fastest(
        self,
        solver: MultipleShooting,
        boundary: BoundaryConditions,
        limits: MotionLimits,
        guess: Trajectory,
        stop: StopRule,
        budget: MotionBudget,
    ) -> Trajectory | None:
        """Return the fastest trajectory near a guess, None if there is none."""
        shortest = min(_FEWEST_TICKS * self._period, budget.longest)
        duration = DurationBounds(shortest, budget.longest)
        for room in _ROOMS:
            narrowed = self._narrowed(limits, room)
            solution = solver.solve(boundary, narrowed, guess, stop, duration)
            if solution is not None or stop.cancellation.requested:
                return solution
        return None

    def _narrowed(self, limits: MotionLimits, room: float) -> MotionLimits:
        velocity = self._speed(limits)
        return replace(limits, velocity=velocity, acceleration=room * limits.acceleration)

    def _commanded(
        self,
        solver: MultipleShooting,
        boundary: BoundaryConditions,
        limits: MotionLimits,
        candidate: Trajectory,
        motion: InitialMotion,
        budget: MotionBudget,
        stop: StopRule,
    ) -> HeldCommands:
        """Return a candidate as held commands.

        Raises
        ------
        CandidateError
            There are none that reach the goal within the limits.
        """
        guesses = self._initial_guesses(solver)
        guess, duration = guesses.refined(candidate), budget.duration
        most = 1 if duration > 0 else len(_MORE_TICKS)
        if duration == 0:
            finer = self._fastest(solver, boundary, limits, guess, stop, budget)
            guess = guess if finer is None else finer
            duration = guess.duration
        ticks = max(1, math.ceil(duration / self._period - 1e-6))
        for more, room in itertools.product(_MORE_TICKS[:most], _ROOMS):
            T = (ticks + more) * self._period
            solution = solver.solve(
                boundary,
                self._narrowed(limits, room),
                replace(guess, step=T / solver.intervals),
                stop,
                DurationBounds(T, T),
            )
            if stop.cancellation.requested:
                break
            held = None if solution is None else self._held(solution, boundary, limits, motion)
            if held is not None:
                return held
        raise CandidateError("held commands could not be brought to the goal within the limits")

    def _held(
        self,
        solution: Trajectory,
        boundary: BoundaryConditions,
        limits: MotionLimits,
        motion: InitialMotion,
    ) -> HeldCommands | None:
        final = boundary.final
        if final is None:
            final = np.clip(solution.shapes[-1], limits.lower, limits.upper)
        if boundary.center is not None:
            final = nearest_for_center(self._robot, limits, final, boundary.center)
        if final is None:
            return None
        return self._holder.hold(
            solution, boundary, final, limits, fixed=True, before=motion.velocity
        )

    def _guesses(
        self,
        boundary: BoundaryConditions,
        limits: MotionLimits,
        solver: MultipleShooting,
        remaining: Array,
    ) -> Iterator[Trajectory]:
        """Yield what remains of the motion so far, then guesses with loops, from its velocity."""
        velocity = np.broadcast_to(boundary.velocity, boundary.start.shape)
        guesses = self._initial_guesses(solver)
        if len(remaining) > 1:
            yield guesses.along(remaining, velocity, self._period)
        for guess in guesses.of(boundary, limits, boundary.likely):
            yield guesses.moving(guess, velocity, limits)

    def _initial_guesses(self, solver: MultipleShooting) -> InitialGuesses:
        curvature = self._robot.function("curvature", compile=False)
        return InitialGuesses(solver.turn, curvature, solver.intervals)


def _agreed(found: list[Trajectory]) -> bool:
    """Whether the fastest trajectory was found often enough."""
    durations = np.array([each.duration for each in found])
    return int(np.sum(durations <= durations.min(initial=math.inf) * (1 + _SAME))) >= _AGREED
