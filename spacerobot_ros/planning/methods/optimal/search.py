"""The search for the fastest manoeuvre: guesses, solutions, held commands.

From rest, many guesses are solved on a coarse grid, at a small part of the cost of the full one.
The best solution, and the next if it is about as good, are guesses for the full grid.

In motion, the first held command follows the one before it, so neither the beginning nor the
duration of a solution can be stretched to whole control periods. The fastest trajectory is found
first; then the one of least effort in as many control periods, or a few more, is solved for from
there, and made into held commands within the limits.
"""

from __future__ import annotations

import itertools
import logging
import math
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from spacerobot_ros.collision.planes import PlaneDistance
from spacerobot_ros.errors import NotFoundError, PlanningError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.rotations import quaternion_multiply
from spacerobot_ros.model.wheels import ReactionWheels
from spacerobot_ros.planning.core.cancellation import NEVER, Cancellation
from spacerobot_ros.planning.core.method import InitialMotion
from spacerobot_ros.planning.core.progress import SearchProgress, log_progress
from spacerobot_ros.planning.methods.optimal.held_commands import (
    CommandHolder,
    HeldCommands,
    ManoeuvreModel,
)
from spacerobot_ros.planning.methods.optimal.initial_guesses import InitialGuesses, move_to_ends
from spacerobot_ros.planning.methods.optimal.joint_efforts import EffortLimitedShooting
from spacerobot_ros.planning.methods.optimal.kept_distances import (
    KeptDistances,
    PathClearing,
    instants_of,
)
from spacerobot_ros.planning.methods.optimal.multiple_shooting import (
    TOLERANCE,
    DurationBounds,
    MultipleShooting,
    Neighbourhood,
    StopRule,
)
from spacerobot_ros.planning.methods.optimal.problem import (
    BoundaryConditions,
    MotionLimits,
    OptimalOptions,
    Trajectory,
    UnusableCandidateError,
)
from spacerobot_ros.planning.methods.optimal.transcription import PathInequality, Stages

_LOG = logging.getLogger(__name__)

_NO_PATH_FOUND = "the solver found no path within the limits"
_NO_HELD_COMMANDS = "held commands could not be brought to the goal within the limits"

_MIN_TICKS = 2
"""Fewest ticks of a manoeuvre: one begins to move, another one stops."""

_GENTLE_TICKS, _GENTLE_TIME = 20, 1.0
"""A gentle manoeuvre has as many ticks or takes as long, s, whichever is less: it corrects a
small error, and haste would leave a larger one."""

_BUDGET_FACTOR_WITHOUT_SOLUTION = 5.0

_GENTLE_DURATION_FACTOR = 4.0
"""A gentle manoeuvre is the path of least effort in this many times the time of its guess, then as
fast as the limits allow."""

_COARSE_GRID_RATIO = 5

_COARSE_TOLERANCE = 1e-4

_MIN_COARSE_INTERVALS = 8
"""Fewest intervals of a coarse grid; with fewer there is none."""

_MAX_REFINED_SOLUTIONS = 2

_MAX_REFINED_COST_RATIO = 1.1
"""Largest ratio of the cost of a coarse solution to the best one at which it is refined, too: the
coarse grid underestimates some costs by more than others."""

_MAX_CLEARING_ITERATIONS = 80
"""Steps of the solver between paths that planes are made for at most."""

_MAX_CLEAR_STARTS, _CLEAR_ANSWERS = 16, 2
"""Further guesses near which manoeuvres that keep clear are looked for at most, and the number of
solutions that ends the search."""

_CLEARING_TIME_FACTOR, _RESAMPLED_TIME_FACTOR = 2.0, 1.2
"""Ratios of the time of a path that is to become clear to that of a path in collision, and to that
of a clear path on a coarse grid: slow joints leave room to go round."""

_SAME_COST_TOLERANCE = 1e-3

_AGREEING_COST_TOLERANCE = 3e-3
"""Solutions whose costs are this near, relative, agree: the coarse grid and the tolerance of the
solver leave as much between them."""

_AGREEING_SOLUTIONS_WITH_GUESS = 2

_MAX_ITERATIONS_OF_STOPS = 120
"""Steps of the solver from a guess in which wheels stop the base: most take twenty."""

_MAX_FULL_GRID_STARTS = 3
"""Number of guesses on the full grid after a coarse grid without solutions."""

_HELD_REACH_SHARE = 0.3
"""Share of the largest reach by which a clear path may change where it is solved for in whole
ticks."""

_LIMIT_SHARE_IN_GIVEN_TIME = 0.99
"""Share of velocity and acceleration limits for manoeuvres of a given duration."""


_ACCELERATION_SHARES_IN_MOTION = (0.98, 1.0)
"""In motion: shares of accelerations that are planned with, one after the other: changes of a path
take the rest, but a joint near its limit may need all to come to rest in time."""

_VELOCITY_RESERVE_IN_MOTION = 0.02
"""In motion: share of velocities that is left for the same reason, at most: a joint at full speed
is slowed down to the rest in a quarter of a control period."""

_COARSE_GRID_RATIO_IN_MOTION, _MIN_COARSE_INTERVALS_IN_MOTION = 4, 10
"""As ``_COARSE_GRID_RATIO``, ``_MIN_COARSE_INTERVALS``, in motion."""

_MAX_REFINED_SOLUTIONS_IN_MOTION = 3
"""In motion: largest number of solutions that are made into commands, fastest first, until one
keeps all limits."""

_AGREEING_SOLUTIONS_IN_MOTION = 3
"""In motion: solutions of the same duration that end the search."""

_MAX_RATE_EXCESS, _RATE_RESERVE = 1.1, 1.002
"""Largest excess of the base rate of held commands over its bound at which they are made slower, as
the bound is imposed at the steps of a solution alone, and the factor of that excess."""

_CLEARING_TIME_FACTORS_IN_MOTION = (1.4, 2.5)
"""As ``_CLEARING_TIME_FACTOR``, in motion, one after the other: joints run on farther in long
intervals, but slow ones need the time."""

_MIN_TICKS_IN_MOTION = 4

_ADDITIONAL_TICKS = (0, 1, 3, 7)
"""Control periods that lengthen a manoeuvre in motion whose commands exceed a limit."""

_ADDITIONAL_TICKS_OF_DRIFT = (0, 0, 1, 3, 7)
"""Additional control periods where the robot drifts; the second time, the end is corrected."""


_ADDITIONAL_SHARES_OF_STOPS = (0.03, 0.08)
"""And shares of its duration where wheels stop the base: they use their torque all the time."""


@dataclass(frozen=True)
class Manoeuvre:
    """A found manoeuvre, as held commands with results of its search.

    Attributes
    ----------
    held
        Its commands.
    duration
        s.
    solution
        The trajectory that was made into held commands.
    starts
        Guesses that were tried.
    solutions
        Durations of all manoeuvres that were found, s.
    cut_short
        Whether the wall time was used up before the search had come to its end.
    """

    held: HeldCommands
    duration: float
    solution: Trajectory
    starts: int = 1
    solutions: list[float] = field(default_factory=list)
    cut_short: bool = False

    @property
    def positions(self) -> Array:
        """(N + 1, n) shapes at the ticks, m or rad."""
        return self.held.positions

    @property
    def quaternions(self) -> Array:
        """(N + 1, 4) turns of the base since the start there."""
        return self.held.quaternions

    @property
    def solution_time(self) -> float:
        """Duration before it was made into held commands, s."""
        return self.solution.duration


@dataclass
class _SearchState:
    """One search: its problem, as of :meth:`ManoeuvreSearch.search`, and its progress.

    ``starts`` guesses were tried, ``rejection`` is the reason against the last candidate,
    ``shortest`` the duration of the fastest solution so far, s; without any, the search ends after
    ``max_failed_starts``. The pairs of links ``kept`` are kept apart; None: no clearance is asked
    for.
    """

    boundary: BoundaryConditions
    limits: MotionLimits
    quaternion: Array
    options: OptimalOptions
    cancellation: Cancellation
    guess: Array | None
    gentle: bool
    max_failed_starts: int = sys.maxsize
    starts: int = 0
    rejection: str = ""
    shortest: float = math.inf
    kept: KeptDistances | None = None
    _began: float = field(default_factory=lambda: time.monotonic())

    def stop_rule(self, *, found: bool) -> StopRule:
        deadline = last_call = math.inf
        if self.options.time_budget > 0:
            deadline, last_call = (
                self._began + x * self.options.time_budget
                for x in (1.0, _BUDGET_FACTOR_WITHOUT_SOLUTION)
            )
        last = deadline if found else last_call
        return StopRule(self.options.iterations, self.cancellation, deadline, last)

    @property
    def hastens(self) -> bool:
        return self.options.duration == 0 and not self.gentle

    def clearing(self) -> _SearchState:
        """Return the same with no pairs yet that are kept apart, and fewer steps of the solver."""
        assert self.kept is not None
        iterations = min(self.options.iterations, _MAX_CLEARING_ITERATIONS)
        options = replace(self.options, iterations=iterations)
        return replace(self, options=options, kept=self.kept.anew())

    def cut_short(self, *, found: bool) -> bool:
        """Whether the wall time is used up."""
        return self.stop_rule(found=found).is_expired(found=found)

    def report(self, step: str, result: str, iterations: int) -> None:
        seconds = time.monotonic() - self._began
        # Without a coarse solution, some guesses are tried on the full grid as well.
        most = max(self.options.starts, self.starts)
        log_progress(
            _LOG,
            SearchProgress(self.starts, most, self.shortest),
            f"{step}: {result} after {seconds:.2f} s, {iterations} steps of the solver",
        )

    def solutions_agree(self, solutions: list[Trajectory]) -> bool:
        costs = np.array([self.cost(each) for each in solutions])
        agreeing = self.options.agreeing
        if self.guess is not None:
            agreeing = min(agreeing, _AGREEING_SOLUTIONS_WITH_GUESS)
        same = int(np.sum(costs <= costs.min(initial=math.inf) * (1 + _AGREEING_COST_TOLERANCE)))
        return 0 < agreeing <= same

    def cost(self, trajectory: Trajectory) -> float:
        """Return the cost: the duration, or the effort where the duration is given."""
        if self.options.duration == 0:
            return trajectory.duration
        scale = np.where(np.isfinite(self.limits.velocity), self.limits.velocity, 1.0)
        change = np.diff(trajectory.velocities, axis=0) / trajectory.step / scale
        return float(np.mean(np.sum(change**2, axis=1)))


class ManoeuvreSearch:
    """Searches for manoeuvres of one robot.

    Parameters
    ----------
    model
        Model and constraints of the manoeuvres.
    """

    def __init__(self, model: ManoeuvreModel) -> None:
        self._robot, self._period, self._axes = model.robot, model.control_period, model.axes
        self._constraints, self._efforts = model.constraints, model.efforts
        self._end_effectors = model.end_effectors
        self._distances = model.distances
        self._begin = model.begin
        self._wheels = ReactionWheels.of(model.robot.description)
        self._holder = CommandHolder(model)
        self._stages: dict[tuple[bool, bool, bool], Stages] = {}
        self._solvers: dict[tuple[int, bool, float, tuple[int, ...], bool], MultipleShooting] = {}

    def search(
        self,
        boundary: BoundaryConditions,
        limits: MotionLimits,
        quaternion: Array,
        intervals: int,
        options: OptimalOptions,
        cancellation: Cancellation = NEVER,
        guess: Array | None = None,
        *,
        gentle: bool = False,
        max_failed_starts: int = sys.maxsize,
    ) -> Manoeuvre:
        """Return the fastest manoeuvre found from attitude ``quaternion`` (4,) of R_WB.

        The shapes (M, n) of a ``guess``, moved to the ends, come before all other guesses. A
        ``gentle`` manoeuvre takes the path of least effort, whose turn of the base depends least on
        errors of masses. After ``max_failed_starts`` guesses without any solution the search ends.

        Raises
        ------
        NotFoundError
            None was found.
        PlanningError
            None is as short as is asked for, or links are too near at an end.
        PlanningCancelled
            The search was cancelled.
        """
        if options.longest < _MIN_TICKS * self._period:
            raise PlanningError(
                f"Manoeuvres take at least {_MIN_TICKS} control periods of {self._period:g} s, "
                f"more than optimal.longest = {options.longest:g} s."
            )
        kept = self._begin(boundary)
        progress = _SearchState(
            boundary, limits, quaternion, options, cancellation, guess, gentle, max_failed_starts
        )
        found = self._search_on_grids(progress, intervals)
        if found and kept is not None:
            progress.kept = kept
            found = self._keep_clear(progress, found, intervals)
        cut_short = progress.cut_short(found=bool(found))
        if not found:
            within = f" within optimal.time_budget {options.time_budget:g} s" if cut_short else ""
            limit = "duration" if options.duration > 0 else "longest"
            longer = "A longer optimal.time_budget, more" if cut_short else "More"
            raise NotFoundError(
                f"No manoeuvre to the goal was found from {progress.starts} start(s){within}: "
                f"{progress.rejection}. {longer} optimal.starts, optimal.iterations or "
                f"optimal.intervals, a longer optimal.{limit}, or a smaller goal may help."
            )
        best = min(found, key=lambda one: one.duration)
        durations = [one.duration for one in found]
        return replace(best, starts=progress.starts, solutions=durations, cut_short=cut_short)

    def _search_on_grids(self, progress: _SearchState, intervals: int) -> list[Manoeuvre]:
        """Return manoeuvres with a number of intervals, from guesses on a coarse grid first."""
        options = progress.options
        full = self._get_solver(progress, intervals)
        coarser = intervals // _COARSE_GRID_RATIO
        # A single answer costs less without a coarse grid, on which the attitude of a base that is
        # to be stopped is too far off; guesses with wheels are near to solutions.
        if len(self._wheels) and progress.boundary.is_timed:
            iterations = min(options.iterations, _MAX_ITERATIONS_OF_STOPS)
            brief = replace(options, answers=1, iterations=iterations)
            progress.options = brief
            return self._search_from_guesses(progress, full, full, options.starts)
        if options.answers > 1 and coarser >= _MIN_COARSE_INTERVALS:
            coarse = self._get_solver(progress, coarser, _COARSE_TOLERANCE)
            found = self._search_from_guesses(progress, coarse, full, options.starts)
            ends = progress.starts >= progress.max_failed_starts or progress.cut_short(found=False)
            if found or ends:
                return found
            return self._search_from_guesses(
                progress, full, full, min(options.starts, _MAX_FULL_GRID_STARTS)
            )
        return self._search_from_guesses(progress, full, full, options.starts)

    def _keep_clear(
        self, progress: _SearchState, found: list[Manoeuvre], intervals: int
    ) -> list[Manoeuvre]:
        """Return manoeuvres that keep clear: those that were found, if the fastest one does, or
        others near to them, or others from new guesses; none where none is found.
        """
        kept = progress.kept
        assert kept is not None
        in_order = sorted(found, key=lambda one: one.duration)
        if not kept.approaches(in_order[0].held.positions, in_order[0].held.quaternions):
            return found
        freed: list[Manoeuvre] = []
        for each in in_order:
            if freed and each.duration >= min(one.duration for one in freed):
                break
            freed += self._make_clear(progress, each, intervals)
        # A robot that drifts finds others sooner after it has coasted.
        if freed or progress.boundary.drifts:
            return freed
        known, clear = [each.solution for each in found], []
        for path in self._other_paths(progress, intervals, known):
            with self._attempt(progress):
                clear.append(self._clear_coarsely(progress.clearing(), path, intervals))
            if len(clear) == _CLEAR_ANSWERS:
                break
        for state, path in sorted(clear, key=lambda each: each[1].duration):
            with self._attempt(progress):
                return [self._clear_finely(state, path, intervals)]
        return []

    def _other_paths(
        self, progress: _SearchState, intervals: int, known: Sequence[Trajectory]
    ) -> Iterator[Trajectory]:
        """Yield other solutions that need not keep clear, from guesses on a coarse grid, then those
        guesses that led to known solutions.
        """
        costs = [progress.cost(each) for each in known]
        free = replace(progress, kept=None)
        grid = self._get_solver(free, *self._coarse_grid(progress, intervals))
        guesses = _build_guesses(self._robot, grid, progress.boundary)
        boundary, limits = progress.boundary, progress.limits
        unused: list[Trajectory] = []
        for guess in itertools.islice(
            guesses.generate(boundary, limits, boundary.likely_final_shape),
            min(progress.options.starts, _MAX_CLEAR_STARTS),
        ):
            if progress.cut_short(found=False):
                return
            solution = self._solve_from_guess(free, grid, guess, progress.stop_rule(found=False))
            progress.cancellation.raise_if_requested()
            progress.starts += 1
            result = _NO_PATH_FOUND if solution is None else f"{solution.duration:.6g} s"
            progress.report(f"start {progress.starts}", result, grid.iterations)
            if solution is None:
                continue
            cost = progress.cost(solution)
            if any(abs(cost - other) <= _SAME_COST_TOLERANCE * other for other in costs):
                unused.append(guess)
            else:
                costs.append(cost)
                yield solution
        yield from unused

    def _coarse_grid(self, progress: _SearchState, intervals: int) -> tuple[int, float]:
        """Return the intervals of the coarse grid and the tolerance on it; of the full grid where
        there is none.
        """
        coarser = intervals // _COARSE_GRID_RATIO
        # On a coarse grid the attitude of a robot that drifts is too far off.
        if progress.boundary.is_timed or coarser < _MIN_COARSE_INTERVALS:
            return intervals, TOLERANCE
        return coarser, _COARSE_TOLERANCE

    @contextmanager
    def _attempt(self, progress: _SearchState) -> Iterator[None]:
        """Note the reason why there is no manoeuvre, instead of raising an error."""
        try:
            yield
        except UnusableCandidateError as reason:
            progress.rejection = str(reason)
        progress.cancellation.raise_if_requested()

    def _make_clear(
        self, progress: _SearchState, manoeuvre: Manoeuvre, intervals: int
    ) -> list[Manoeuvre]:
        """Return a manoeuvre near to one that keeps clear; that one itself, if it does; or none."""
        kept = progress.kept
        assert kept is not None
        if not kept.approaches(manoeuvre.positions, manoeuvre.quaternions):
            return [manoeuvre]
        with self._attempt(progress):
            state = progress.clearing()
            coarse = self._clear_coarsely(state, manoeuvre.solution, intervals)
            return [self._clear_finely(*coarse, intervals)]
        return []

    def _clear_coarsely(
        self, progress: _SearchState, path: Trajectory, intervals: int
    ) -> tuple[_SearchState, Trajectory]:
        """Return a fast path near to another one that keeps clear on a coarse grid, with the search
        whose pairs it keeps apart; the same path where it is for the full grid alone.
        UnusableCandidateError if none was found."""
        coarser, tolerance = self._coarse_grid(progress, intervals)
        if not progress.hastens or coarser == intervals:
            return progress, path
        clearing = self._path_clearing(progress, coarser, tolerance)
        slow, _ = clearing.clear(path, _CLEARING_TIME_FACTOR * path.duration)
        fast, _ = clearing.shorten(slow, None)
        progress.report("clear path", f"{fast.duration:.6g} s", 0)
        return progress, fast.stretched(_RESAMPLED_TIME_FACTOR)

    def _clear_finely(self, progress: _SearchState, path: Trajectory, intervals: int) -> Manoeuvre:
        """Return a manoeuvre near to a path that keeps clear, by the full grid.
        UnusableCandidateError if none was found."""
        options, kept = progress.options, progress.kept
        assert kept is not None
        clearing = self._path_clearing(
            progress, intervals, TOLERANCE, partial(self._make_held_commands, progress)
        )
        shortest = self._shortest_duration(progress)
        duration = path.duration if kept.pairs else _CLEARING_TIME_FACTOR * path.duration
        if options.duration > 0:
            duration = self._given_duration(options)
        elif progress.gentle:
            path = self._slow_to_effort_limits(path, progress.boundary)
            duration = max(_GENTLE_DURATION_FACTOR * path.duration, shortest)
        path, made = clearing.clear(path, duration)
        if progress.hastens:
            path, made = clearing.shorten(path, made)
        elif progress.gentle:
            fast = path.at_full_speed(progress.limits, shortest)
            made = self._make_held_commands(
                progress, self._slow_to_effort_limits(fast, progress.boundary)
            )
            if near := kept.approaches(made.positions, made.quaternions):
                raise UnusableCandidateError(kept.message(near[0], self._period))
        assert made is not None
        if made.duration > max(options.longest, options.duration) + self._period / 2:
            raise UnusableCandidateError(_NO_PATH_FOUND)
        progress.report("manoeuvre that keeps clear", f"{made.duration:.6g} s", 0)
        return made

    def _path_clearing(
        self,
        progress: _SearchState,
        intervals: int,
        tolerance: float,
        hold: Callable[[Trajectory], Manoeuvre] | None = None,
    ) -> PathClearing[Manoeuvre]:
        """Return the clearing of paths on a grid, as held commands or as they are."""
        kept, limits = progress.kept, progress.limits
        assert kept is not None
        solve = partial(self._solve_apart, progress, intervals, tolerance)
        return PathClearing(kept, limits, solve, self._period, hold)

    def _solve_apart(
        self,
        progress: _SearchState,
        intervals: int,
        tolerance: float,
        guess: Trajectory,
        duration: float | None,
        near: Neighbourhood,
    ) -> tuple[Trajectory, float]:
        """Return a solution near to a guess that keeps pairs of links apart, in a duration, s
        (None: the fastest one), and by how much they are too near all the same, m.
        UnusableCandidateError if no such solution was found."""
        kept, boundary, limits = progress.kept, progress.boundary, progress.limits
        assert kept is not None
        if progress.options.duration > 0:
            limits = _narrowed(limits)
        solver = self._get_solver(progress, intervals, tolerance)
        if len(guess.shapes) != intervals + 1:
            guess = _build_guesses(self._robot, solver, boundary).resample(guess)
        shortest = self._shortest_duration(progress)
        bounds = DurationBounds(shortest, progress.options.longest)
        if duration is not None:
            bounds = DurationBounds(duration, duration)
        within = kept.within(limits, guess, pushing=near.largest_lack > 0)
        # On the same grid, a solver continues at its own last solution.
        stop = progress.stop_rule(found=False)
        solution = solver.solve(boundary, within, guess, stop, bounds, near)
        progress.cancellation.raise_if_requested()
        result = _NO_PATH_FOUND
        if solution is not None:
            result = f"{solution.duration:.6g} s, {1e3 * solver.lack:.3g} mm too near"
        progress.report(f"{len(kept.pairs)} pair(s) apart", result, solver.iterations)
        if solution is None:
            raise UnusableCandidateError(_NO_PATH_FOUND)
        if duration is None and not solver.converged and self._constraints.base_rate_limit == 0:
            # A solution without convergence is not yet as fast as possible.
            solution = solution.at_full_speed(limits, shortest)
            solution = self._slow_to_effort_limits(solution, boundary)
        return solution, solver.lack

    def _get_solver(
        self, progress: _SearchState, intervals: int, tolerance: float = TOLERANCE
    ) -> MultipleShooting:
        pairs = progress.kept.pairs if progress.kept is not None else ()
        return self.solver(
            intervals,
            progress.boundary.center is not None,
            tolerance,
            pairs,
            drifting=progress.boundary.drifts,
        )

    def _search_from_guesses(
        self, progress: _SearchState, grid: MultipleShooting, full: MultipleShooting, starts: int
    ) -> list[Manoeuvre]:
        """Return manoeuvres from at most ``starts`` guesses on a grid; none where none is found."""
        guesses = _build_guesses(self._robot, grid, progress.boundary)
        boundary, limits = progress.boundary, progress.limits
        of_boundary = guesses.generate(boundary, limits, boundary.likely_final_shape)
        if len(self._wheels) and len(self._axes):
            of_boundary = guesses.generate_with_wheels(self._wheels, boundary, limits, self._robot)
        if progress.guess is not None:
            moved = move_to_ends(progress.guess, boundary, limits)
            of_boundary = itertools.chain([guesses.from_shapes(moved, limits)], of_boundary)
        solutions: list[Trajectory] = []
        enough = progress.options.answers
        for number, guess in enumerate(itertools.islice(of_boundary, starts), 1):
            stop = progress.stop_rule(found=bool(solutions))
            solution = self._solve_from_guess(progress, grid, guess, stop)
            progress.cancellation.raise_if_requested()
            progress.starts += 1
            result = _NO_PATH_FOUND if solution is None else f"{solution.duration:.6g} s"
            if solution is not None:
                progress.shortest = min(progress.shortest, solution.duration)
            progress.report(f"start {progress.starts}", result, grid.iterations)
            if solution is None:
                progress.rejection = _NO_PATH_FOUND
            else:
                solutions.append(solution)
            # A search may also be cut short within its last start.
            cut_short = progress.cut_short(found=bool(solutions))
            going_on = len(solutions) < enough and not progress.solutions_agree(solutions)
            cut_short = cut_short or not (solutions or progress.starts < progress.max_failed_starts)
            if going_on and number < starts and not cut_short:
                continue
            found = self._refine_solutions(progress, solutions, grid, full)
            if found or cut_short:
                return found
            # These are none; the next ones count one by one.
            solutions, enough = [], 1
        return []

    def _refine_solutions(
        self,
        progress: _SearchState,
        solutions: list[Trajectory],
        grid: MultipleShooting,
        full: MultipleShooting,
    ) -> list[Manoeuvre]:
        """Return manoeuvres from the best solutions on a grid, refined on the full grid.

        Where the search ended because solutions agree, the next one is refined only if it promises
        a shorter time than the refined best one.
        """
        found: list[Manoeuvre] = []
        costs: list[float] = []
        solutions_agree = progress.solutions_agree(solutions)
        for solution in sorted(solutions, key=progress.cost):
            cost = progress.cost(solution)
            if found and (
                len(found) == _MAX_REFINED_SOLUTIONS or cost > _MAX_REFINED_COST_RATIO * costs[0]
            ):
                break
            least = min((one.solution_time for one in found), default=math.inf)
            if solutions_agree and solution.duration > (1 - _SAME_COST_TOLERANCE) * least:
                break
            if any(abs(cost - other) <= _SAME_COST_TOLERANCE * other for other in costs):
                continue
            try:
                refined: Trajectory | None = solution
                if grid is not full:
                    guess = _build_guesses(self._robot, full, progress.boundary).resample(solution)
                    stop = progress.stop_rule(found=bool(found))
                    refined = self._solve_from_guess(progress, full, guess, stop, refining=True)
                    progress.cancellation.raise_if_requested()
                manoeuvre = self._make_held_commands(progress, refined)
                found.append(manoeuvre)
                costs.append(cost)
                result = f"{manoeuvre.duration:.6g} s"
            except UnusableCandidateError as reason:
                result = progress.rejection = str(reason)
            progress.report("manoeuvre", result, full.iterations)
        return found

    def solver(
        self,
        intervals: int,
        position: bool,
        tolerance: float = TOLERANCE,
        pairs: tuple[int, ...] = (),
        *,
        drifting: bool = False,
    ) -> MultipleShooting:
        """Return the solver with a number of intervals, with or without a position, which keeps
        pairs of links apart; ``drifting``, for an angular momentum that is not zero.
        """
        key = intervals, position, tolerance, pairs, drifting
        if key not in self._solvers:
            rows = partial(self._distances.of, pairs) if pairs and self._distances else None
            of = partial(self._get_stages, position, rows, instants_of(intervals), drifting)
            self._solvers[key] = (
                MultipleShooting(of(), intervals, tolerance)
                if self._efforts is None
                else EffortLimitedShooting(
                    of, intervals, self._efforts, tolerance, drifting=drifting
                )
            )
        return self._solvers[key]

    def _get_stages(
        self,
        position: bool,
        rows: Callable[[], list[PlaneDistance]] | None,
        instants: int,
        drifting: bool,
        inequalities: Sequence[PathInequality] = (),
    ) -> Stages:
        key = position, bool(inequalities), drifting
        if key not in self._stages:
            self._stages[key] = Stages.of(
                self._robot,
                self._axes,
                position,
                self._constraints,
                inequalities,
                end_effectors=self._end_effectors and self._end_effectors.function,
                drifting=drifting,
            )
        if rows is None:
            return self._stages[key]
        return self._stages[key].with_distances(rows(), instants)

    def _solve_from_guess(
        self,
        progress: _SearchState,
        solver: MultipleShooting,
        guess: Trajectory,
        stop: StopRule,
        *,
        refining: bool = False,
    ) -> Trajectory | None:
        boundary, limits, options = progress.boundary, progress.limits, progress.options
        shortest = self._shortest_duration(progress)
        guess = self._constraints.slowed(guess)
        if options.duration > 0:
            limits, T = _narrowed(limits), self._given_duration(options)
        elif progress.gentle:
            guess = self._slow_to_effort_limits(guess, boundary)
            T = max(_GENTLE_DURATION_FACTOR * guess.duration, shortest)
        else:
            duration = DurationBounds(shortest, options.longest)
            solution = solver.solve(boundary, limits, guess, stop, duration, refining=refining)
            if solution is None or solver.converged or self._constraints.base_rate_limit > 0:
                return solution
            # A solution without convergence is not yet as fast as possible.
            return self._slow_to_effort_limits(solution.at_full_speed(limits, shortest), boundary)
        guess = guess.stretched(T / guess.duration)
        solution = solver.solve(boundary, limits, guess, stop, DurationBounds(T, T))
        if solution is None or not progress.gentle:
            return solution
        return self._slow_to_effort_limits(solution.at_full_speed(limits, shortest), boundary)

    def _shortest_duration(self, progress: _SearchState) -> float:
        """Return the duration that a manoeuvre has at least, s."""
        gentle = min(_GENTLE_TICKS * self._period, _GENTLE_TIME) if progress.gentle else 0.0
        return max(_MIN_TICKS * self._period, gentle)

    def _given_duration(self, options: OptimalOptions) -> float:
        """Return the duration that is asked for in whole ticks, s."""
        return max(round(options.duration / self._period), 1) * self._period

    def _slow_to_effort_limits(
        self, trajectory: Trajectory, boundary: BoundaryConditions
    ) -> Trajectory:
        return trajectory if self._efforts is None else self._efforts.slowed(trajectory, boundary)

    def _make_held_commands(
        self, progress: _SearchState, trajectory: Trajectory | None
    ) -> Manoeuvre:
        """Return a solution as held commands; UnusableCandidateError if there is no solution, or
        none that commands reach within the constraints."""
        if trajectory is None:
            raise UnusableCandidateError(_NO_PATH_FOUND)
        fixed = progress.options.duration > 0
        if progress.boundary.is_timed:
            held = self._hold_in_whole_ticks(progress, trajectory)
        else:
            held = self._holder.hold(trajectory, progress.boundary, progress.limits, fixed=fixed)
            if held is not None and not fixed:
                excess = self._constraints.excess_rate(held.quaternions, self._period)
                if 1 < excess <= _MAX_RATE_EXCESS:
                    # At zero momentum the base turns as much slower as the joints move.
                    slower = trajectory.stretched(excess * _RATE_RESERVE)
                    held = self._holder.hold(slower, progress.boundary, progress.limits)
        if held is None:
            raise UnusableCandidateError(_NO_HELD_COMMANDS)
        attitudes = quaternion_multiply(progress.quaternion, held.quaternions)
        self._constraints.check(held.positions, attitudes, self._period)
        duration = (len(held.positions) - 1) * self._period
        return Manoeuvre(held, duration, trajectory)

    def _hold_in_whole_ticks(
        self, progress: _SearchState, trajectory: Trajectory
    ) -> HeldCommands | None:
        """Return a solution whose duration matters as held commands; None where that fails.

        Were it stretched to whole control periods, the base would turn on meanwhile, or the wheels
        begin at other rates. So the trajectory of least effort in as many control periods, or a few
        more, is solved for.
        """
        boundary, limits, kept = progress.boundary, progress.limits, progress.kept
        narrowed, near = _narrowed(limits), None
        if kept is not None and kept.pairs:
            narrowed = kept.within(narrowed, trajectory)
            near = Neighbourhood.within(limits, _HELD_REACH_SHARE)
        solver = self._get_solver(progress, len(trajectory.shapes) - 1)
        ticks = max(_MIN_TICKS, math.ceil(trajectory.duration / self._period - 1e-6))
        guess, aim = trajectory, boundary
        # In a given time there is no other than the first.
        additional = list(_ADDITIONAL_TICKS_OF_DRIFT)
        if len(self._wheels):
            additional += [math.ceil(share * ticks) for share in _ADDITIONAL_SHARES_OF_STOPS]
        most = 2 if progress.options.duration > 0 else len(additional)
        for more in additional[:most]:
            T = (ticks + more) * self._period
            guess = guess.stretched(T / guess.duration)
            stop = progress.stop_rule(found=False)
            solution = solver.solve(aim, narrowed, guess, stop, DurationBounds(T, T), near)
            progress.cancellation.raise_if_requested()
            if solution is None:
                continue
            held = self._holder.hold(solution, boundary, limits, fixed=True)
            if held is not None:
                return held
            guess = solution
            aim = self._holder.corrected_end(solution, boundary, ticks + more)
        return None


def _narrowed(limits: MotionLimits) -> MotionLimits:
    """Return the limits of manoeuvres of a given duration."""
    return replace(
        limits,
        velocity=_LIMIT_SHARE_IN_GIVEN_TIME * limits.velocity,
        acceleration=_LIMIT_SHARE_IN_GIVEN_TIME * limits.acceleration,
    )


class MotionSearch:
    """Searches for manoeuvres of one robot that begin in motion.

    Parameters
    ----------
    model
        Model and constraints of the manoeuvres.
    solver
        Returns the solver (:meth:`ManoeuvreSearch.solver`).
    """

    def __init__(self, model: ManoeuvreModel, solver: Callable[..., MultipleShooting]) -> None:
        self._robot, self._period = model.robot, model.control_period
        self._constraints, self._begin = model.constraints, model.begin
        self._holder = CommandHolder(model)
        self._solver = solver

    def search(
        self,
        boundary: BoundaryConditions,
        limits: MotionLimits,
        quaternion: Array,
        intervals: int,
        options: OptimalOptions,
        motion: InitialMotion,
        cancellation: Cancellation = NEVER,
    ) -> Manoeuvre:
        """Return the fastest manoeuvre found from attitude ``quaternion`` (4,) of R_WB.

        The rest of the motion so far is the first guess.

        Raises
        ------
        NotFoundError
            None was found.
        PlanningCancelled
            The search was cancelled.
        """
        boundary = replace(boundary, velocity=self._initial_velocity(motion, limits))
        kept = self._begin(boundary)
        coarser = intervals
        if intervals >= _COARSE_GRID_RATIO_IN_MOTION * _MIN_COARSE_INTERVALS_IN_MOTION:
            coarser = intervals // _COARSE_GRID_RATIO_IN_MOTION
        coarse = self._solver(
            coarser, boundary.center is not None, TOLERANCE, (), drifting=boundary.drifts
        )
        stop = StopRule(options.iterations, cancellation)
        # The remaining motion is short, so a coarse grid is fine enough.
        finer = coarser if options.answers == 1 else intervals
        candidates: list[Trajectory] = []
        tried: list[float] = []
        starts, rejection = 0, _NO_PATH_FOUND
        guesses = itertools.islice(
            self._guesses(boundary, limits, coarse, motion.remaining), options.starts
        )
        while True:
            for guess in guesses:
                starts += 1
                if options.duration > 0:
                    candidates.append(guess)
                else:
                    solution = self._find_fastest(coarse, boundary, limits, guess, stop, options)
                    candidates += [] if solution is None else [solution]
                cancellation.raise_if_requested()
                if len(candidates) >= options.answers or _durations_agree(candidates) or tried:
                    break
            else:
                if tried or not candidates:
                    break
            for candidate in _fastest_others(candidates, tried):
                tried.append(candidate.duration)
                try:
                    held = self._keep_clear(
                        finer, boundary, limits, candidate, motion, options, stop, kept
                    )
                    attitudes = quaternion_multiply(quaternion, held.quaternions)
                    self._constraints.check(held.positions, attitudes, self._period)
                except UnusableCandidateError as reason:
                    rejection = str(reason)
                    continue
                finally:
                    cancellation.raise_if_requested()
                duration = (len(held.positions) - 1) * self._period
                durations = [each.duration for each in candidates]
                return Manoeuvre(held, duration, candidate, starts, durations)
            if kept is None:
                break
        raise NotFoundError(
            f"No manoeuvre to the goal that begins in motion was found from {starts} start(s): "
            f"{rejection}."
        )

    def _keep_clear(
        self,
        intervals: int,
        boundary: BoundaryConditions,
        limits: MotionLimits,
        candidate: Trajectory,
        motion: InitialMotion,
        options: OptimalOptions,
        stop: StopRule,
        kept: KeptDistances | None,
    ) -> HeldCommands:
        """Return a candidate as held commands that keep clear; UnusableCandidateError if there are
        none that reach the goal within the limits."""
        position, drifting = boundary.center is not None, boundary.drifts
        free = self._solver(intervals, position, TOLERANCE, (), drifting=drifting)
        guesses = _build_guesses(self._robot, free, boundary)
        path, duration = guesses.resample(candidate), options.duration
        if duration == 0:
            path = self._find_fastest(free, boundary, limits, path, stop, options) or path
            duration = path.duration
        held = self._hold(free, boundary, limits, path, duration, motion, options, stop)
        if kept is None or not kept.approaches(held.positions, held.quaternions):
            return held
        kept = kept.anew()
        brief = replace(stop, iterations=min(stop.iterations, _MAX_CLEARING_ITERATIONS))

        def solver() -> MultipleShooting:
            return self._solver(intervals, position, TOLERANCE, kept.pairs, drifting=drifting)

        def solve(
            guess: Trajectory, duration: float | None, near: Neighbourhood
        ) -> tuple[Trajectory, float]:
            bounds = self._duration_bounds(options)
            if duration is not None:
                bounds = DurationBounds(duration, duration)
            narrowed = self._narrow_limits(limits, _ACCELERATION_SHARES_IN_MOTION[-1])
            within = kept.within(narrowed, guess, pushing=near.largest_lack > 0)
            apart = solver()
            solution = apart.solve(boundary, within, guess, brief, bounds, near)
            stop.cancellation.raise_if_requested()
            if solution is None:
                raise UnusableCandidateError(_NO_PATH_FOUND)
            return solution, apart.lack

        def hold(path: Trajectory) -> HeldCommands:
            apart, within = solver(), kept.within(limits, path)
            near = Neighbourhood.within(limits, _HELD_REACH_SHARE)
            return self._hold(
                apart, boundary, within, path, path.duration, motion, options, brief, near
            )

        clearing = PathClearing(kept, limits, solve, self._period, hold)
        if options.duration > 0:
            _, clear = clearing.clear(path, duration)
            assert clear is not None
            return clear
        for factor in _CLEARING_TIME_FACTORS_IN_MOTION:
            slower = path.stretched(factor)
            lacking = boundary.velocity - slower.velocities[0]
            slower = guesses.with_initial_velocity(slower, lacking, limits)
            try:
                _, clear = clearing.shorten(*clearing.clear(slower, slower.duration))
            except UnusableCandidateError:
                if factor == _CLEARING_TIME_FACTORS_IN_MOTION[-1]:
                    raise
                continue
            break
        assert clear is not None
        return clear

    def _planned_speed_limit(self, limits: MotionLimits) -> Array:
        """Return the largest planned velocities (n,)."""
        given_up = np.minimum(
            _VELOCITY_RESERVE_IN_MOTION * limits.velocity, limits.acceleration * self._period / 4
        )
        return np.where(np.isfinite(limits.velocity), limits.velocity - given_up, limits.velocity)

    def _initial_velocity(self, motion: InitialMotion, limits: MotionLimits) -> Array:
        """Return the velocities (n,) at the start: between those that are held before and after."""
        between = motion.velocity
        if len(motion.remaining) > 1:
            after = (motion.remaining[1] - motion.remaining[0]) / self._period
            between = (motion.velocity + after) / 2
        speed = self._planned_speed_limit(limits)
        return np.clip(between, -speed, speed)

    def _find_fastest(
        self,
        solver: MultipleShooting,
        boundary: BoundaryConditions,
        limits: MotionLimits,
        guess: Trajectory,
        stop: StopRule,
        options: OptimalOptions,
    ) -> Trajectory | None:
        duration = self._duration_bounds(options)
        for room in _ACCELERATION_SHARES_IN_MOTION:
            narrowed = self._narrow_limits(limits, room)
            solution = solver.solve(boundary, narrowed, guess, stop, duration)
            if solution is not None or stop.cancellation.requested:
                return solution
        return None

    def _duration_bounds(self, options: OptimalOptions) -> DurationBounds:
        shortest = min(_MIN_TICKS_IN_MOTION * self._period, options.longest)
        return DurationBounds(shortest, options.longest)

    def _narrow_limits(self, limits: MotionLimits, room: float) -> MotionLimits:
        velocity = self._planned_speed_limit(limits)
        return replace(limits, velocity=velocity, acceleration=room * limits.acceleration)

    def _hold(
        self,
        solver: MultipleShooting,
        boundary: BoundaryConditions,
        limits: MotionLimits,
        path: Trajectory,
        duration: float,
        motion: InitialMotion,
        options: OptimalOptions,
        stop: StopRule,
        near: Neighbourhood | None = None,
    ) -> HeldCommands:
        """Return a path as held commands, in a duration (s) or a few more control periods.
        UnusableCandidateError if there are none that reach the goal within the limits."""
        most = 1 if options.duration > 0 else len(_ADDITIONAL_TICKS)
        ticks = max(1, math.ceil(duration / self._period - 1e-6))
        aim = boundary
        for more, room in itertools.product(
            _ADDITIONAL_TICKS[:most], _ACCELERATION_SHARES_IN_MOTION
        ):
            T = (ticks + more) * self._period
            solution = solver.solve(
                aim,
                self._narrow_limits(limits, room),
                replace(path, step=T / solver.intervals),
                stop,
                DurationBounds(T, T),
                near,
            )
            if stop.cancellation.requested:
                break
            held = None
            if solution is not None:
                held = self._holder.hold(
                    solution, boundary, limits, fixed=True, before=motion.velocity
                )
            if held is not None:
                return held
            if solution is not None and boundary.drifts:
                aim = self._holder.corrected_end(solution, boundary, ticks + more)
        raise UnusableCandidateError(_NO_HELD_COMMANDS)

    def _guesses(
        self,
        boundary: BoundaryConditions,
        limits: MotionLimits,
        solver: MultipleShooting,
        remaining: Array,
    ) -> Iterator[Trajectory]:
        """Yield the rest of the motion so far, then guesses with loops, from its velocity."""
        velocity = np.broadcast_to(boundary.velocity, boundary.start.shape)
        guesses = _build_guesses(self._robot, solver, boundary)
        if len(remaining) > 1:
            yield guesses.from_ticks(remaining, velocity, self._period)
        for guess in guesses.generate(boundary, limits, boundary.likely_final_shape):
            yield guesses.with_initial_velocity(guess, velocity, limits)


def _build_guesses(
    robot: SpaceRobot, solver: MultipleShooting, boundary: BoundaryConditions
) -> InitialGuesses:
    curvature = robot.function("curvature", compile=False)
    L_0 = boundary.angular_momentum if boundary.drifts else None
    return InitialGuesses(solver.turn, curvature, solver.intervals, L_0)


def _fastest_others(found: Sequence[Trajectory], tried: Sequence[float]) -> list[Trajectory]:
    """Return the fastest trajectories, of those that are the same one, and none of ``tried``
    durations, s.
    """
    chosen: list[Trajectory] = []
    for each in sorted(found, key=lambda one: one.duration):
        known = [*tried, *(one.duration for one in chosen)]
        if all(abs(each.duration - other) > _SAME_COST_TOLERANCE * other for other in known):
            chosen.append(each)
    return chosen[:_MAX_REFINED_SOLUTIONS_IN_MOTION]


def _durations_agree(found: list[Trajectory]) -> bool:
    durations = np.array([each.duration for each in found])
    return (
        int(np.sum(durations <= durations.min(initial=math.inf) * (1 + _SAME_COST_TOLERANCE)))
        >= _AGREEING_SOLUTIONS_IN_MOTION
    )
