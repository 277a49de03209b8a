"""Search for the fastest manoeuvre, from guesses to held commands, in the order of this file.

1. **Guesses**: the direct path with loops; if the joints move at the start, the first guess is the
   remainder of their motion.
2. **Coarse solutions**: solutions are computed from the guesses on a coarse grid, at a small
   fraction of the cost of the full grid, until some solutions agree.
3. **Full grid**: the best solution is refined; if that fails, the next best one.
4. **Held commands**: a solution is converted to commands that end at the goal. If the duration
   matters (the robot drifts, or joints move at the start or the end), the solution cannot be
   stretched to whole control periods. So the path of least effort is computed for that number of
   periods, or a few more.
5. **Clear**: if held commands bring links too close to each other or to obstacles, clear paths are
   searched for near these commands, then near other solutions, then near guesses; these paths are
   then made faster.

J. Schulman et al., "Motion planning with sequential convex optimization and convex collision
checking", International Journal of Robotics Research 33, 2014, make paths collision-free in steps,
each of which is a quadratic program; here, each step is the full problem of the manoeuvre.
"""

from __future__ import annotations

import itertools
import logging
import math
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cache, lru_cache, partial
from typing import NamedTuple

import numpy as np

from spacerobot_ros.collision import Approach
from spacerobot_ros.collision.planes import PlaneDistances
from spacerobot_ros.errors import NotFoundError, PlanningError, counted
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.rotations import quaternion_multiply
from spacerobot_ros.model.wheels import ReactionWheels
from spacerobot_ros.planning.core.cancellation import NEVER, Cancellation
from spacerobot_ros.planning.core.method import InitialMotion, PlanRequest
from spacerobot_ros.planning.core.progress import (
    SearchClock,
    SearchPhase,
    SearchProgress,
    log_progress,
)
from spacerobot_ros.planning.methods.optimal.held_commands import HeldCommands, ManoeuvreModel
from spacerobot_ros.planning.methods.optimal.initial_guesses import InitialGuesses
from spacerobot_ros.planning.methods.optimal.kept_distances import (
    INITIAL_ROOM,
    KeptDistances,
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

_LOG = logging.getLogger(__name__)

_NO_PATH_FOUND = "the solver found no path within the limits"
_NO_HELD_COMMANDS = "held commands could not be brought to the goal within the limits"

# -- constants, each with its reason --------------------------------------------------------------

_MIN_TICKS = 2
"""Smallest number of ticks in a manoeuvre: one tick to start and one to stop."""

_GENTLE_TICKS, _GENTLE_TIME = 20, 1.0
"""Ticks or time, s, of a gentle manoeuvre, whichever is less: it corrects a small error, whereas a
faster one would leave a larger error."""

_GENTLE_DURATION_FACTOR = 4.0
"""A gentle manoeuvre is the path of least effort in this multiple of its guess's duration, then
made as fast as the limits allow."""

_COARSE_GRID_RATIO, _MIN_COARSE_INTERVALS = 5, 8
"""Ratio of the full grid to the coarse grid, and the smallest number of intervals of a coarse grid;
with fewer, there is no coarse grid."""

_COARSE_TOLERANCE = 1e-4
"""Tolerance on a coarse grid, whose solutions differ more from later ones."""

_SAME_COST_TOLERANCE, _AGREEING_COST_TOLERANCE = 1e-3, 3e-3
"""Relative cost differences up to which two solutions are considered the same, and up to which they
agree: the coarse grid and the solver's tolerance cause such differences."""

_MAX_FULL_GRID_STARTS = 3
"""Number of other paths that are made clear only on the full grid, which is the most expensive."""

_MAX_ITERATIONS_OF_STOPS = 120
"""Solver steps from a guess in which wheels stop the base: most take twenty. With 300, one of nine
took 22 instead of 2 s of CPU."""

_ADDITIONAL_TICKS, _ADDITIONAL_SHARES = (0, 0, 1, 3, 7), (0.03, 0.08)
"""Control periods, then fractions of the duration, added if held commands miss the goal or a limit;
the second time, the end is corrected. Wheels that stop the base use their torque throughout."""

_HELD_SHARE_OF_STOPS = 0.99
"""Share of velocity and acceleration limits for solutions in whole ticks if wheels stop the base:
the rest is for held commands. Without it, they need 1.3 to 2.3 times as long in three of nine."""

_HELD_REACH_SHARE = 0.3
"""Fraction of the largest reach by which a clear path may change in a solution in whole ticks."""

_CLEARING_TIME_FACTOR, _RESAMPLED_TIME_FACTOR, _RECLEARED_TIME_FACTOR = 2.0, 1.2, 1.1
"""Duration of a path to be made clear, relative to the duration of a path in collision, and to that
of a clear path on a coarse grid: slow joints leave room to move around obstacles."""

_MAX_CLEARING_ITERATIONS = 80
"""Largest number of solver steps between paths with new planes: more steps diverge."""

_MAX_CLEARING_ROUNDS, _MIN_SHORTENING_ROUNDS, _MAX_SHORTENING_ROUNDS = 20, 5, 10
"""Largest number of paths on the way to a clear path, and smallest and largest number on the way to
a fast one: with 15 of the first, a path for two arms lacked 0.1 mm at the end; with 3 or 6 of the
second, plans for two arms took 10 instead of 8 or 31 instead of 28 s of CPU."""

_NEAR = 0.1
"""Distance beyond the required one, m, up to which pairs beside a clear path are kept apart while
the path is made faster. Pairs that were only in the way of earlier paths are dropped: with all 20,
two arms took up to six times the solver steps, each of twice the time."""

_NO_LACK, _LARGEST_LACK = 1e-3, 0.15
"""Missing clearance, m, below which all planes are kept, and the largest one on the way to a clear
path: with 0.3, a quadruped's plan took 1.75 instead of 1.00 s."""

_MAX_WORK_PER_ITERATION, _WORK_FACTOR_WITHOUT_PATH = 8e4, 3.0
"""Largest work on clear paths, in Jacobian nonzeros over all solver steps, per step that
``optimal.iterations`` allows from one guess, and its factor if there is no clear path yet:
6 and 18 s of an idle core (0.25 us per nonzero). With 1.25e5, two arms took 60 % more."""

_MAX_STALLED_ROUNDS, _STALLED_SHARE = 3, 0.9
"""Number of successive paths, on the way to a clear path, that still lack more than this
fraction of the smallest previous lack: a path for two arms lacked 55 mm in twelve rounds."""

_GOOD_TIME_FACTOR, _ENOUGH_CLEAR_PATHS, _SHARE_OF_CHOICE = 1.1, 3, 0.25
"""Duration of a path that is clear on the coarse grid, relative to the one in collision, up to
which it is refined at once. Otherwise, the fastest of this number is, of fewer if this fraction of
the work is used up: with three more paths, six of eleven manoeuvres became 1 to 26 % shorter."""

_MIN_GAIN = 0.01
"""Relative time gain below which a clear path is no longer made faster, at the full reach."""

_REACH_DIVISOR, _REACH_FACTOR, _MIN_REACH_SHARE = 3.0, 2.0, 0.02
"""Divisor of the reach if a faster path is not clear, its factor if it is, and the fraction of the
largest reach at which paths are no longer made faster."""

_REACH_FROM_GUESS = 4.0
"""Factor applied to the largest reach from a guess, which is far from the goal."""

_MAX_CLEAR_STARTS, _MAX_CLEAR_STARTS_IN_MOTION = 16, 1
"""Largest number of guesses near whose solutions clear manoeuvres are searched for; in motion, only
the rest of the motion, as others are found sooner from rest. With 8, a plan took 40 % longer."""

_KEPT_SOLVERS = 16
"""Number of solvers that are kept for later plans: with two arms, each takes 12 MB."""

_REPORT_PERIOD = 1.0
"""Wall time, s, after which a solver reports that it is still busy."""


class NoClearPathError(NotFoundError):
    """Manoeuvres to the goal were found, but no clear one."""


@dataclass(frozen=True)
class Manoeuvre:
    """A manoeuvre that was found: held commands and search results.

    Attributes
    ----------
    held
        Its commands.
    duration
        s.
    solution
        Trajectory converted to held commands.
    starts
        Guesses that were tried.
    cut_short
        Whether the wall time was used up before the search was complete.
    coasting
        (k, n) shapes at the ticks before, while the robot coasts with its joints at rest.
    """

    held: HeldCommands
    duration: float
    solution: Trajectory
    starts: int = 1
    cut_short: bool = False
    coasting: Array = field(default_factory=lambda: np.zeros((0, 0)))

    @property
    def positions(self) -> Array:
        """Shapes (N + 1, n) at all ticks."""
        if not len(self.coasting):
            return self.held.positions
        return np.vstack([self.coasting, self.held.positions])


@dataclass(frozen=True)
class SearchProblem:
    """Problem of a search.

    Attributes
    ----------
    request
        The request. If the joints move, the remainder of their motion is the first guess.
    boundary, limits
        Both ends of the motion, and the joint limits.
    options
        The options of this search.
    clock, cancellation
        The wall time of the plan, and its cancellation.
    max_failed_starts
        Number of guesses without any solution after which the search ends.
    keeps_clear
        Whether links keep apart; a manoeuvre that need not only tells how long one takes.
    """

    request: PlanRequest
    boundary: BoundaryConditions
    limits: MotionLimits
    options: OptimalOptions
    clock: SearchClock
    cancellation: Cancellation = NEVER
    max_failed_starts: int = sys.maxsize
    keeps_clear: bool = True

    @property
    def motion(self) -> InitialMotion | None:
        """Motion of the joints at the start; None: at rest."""
        return self.request.motion

    @property
    def velocity(self) -> Array | float:
        """Joint velocities (n,) held before the start."""
        return self.boundary.velocity if self.motion is None else self.motion.velocity

    @property
    def is_timed(self) -> bool:
        """Whether the end of the motion depends on its duration."""
        return self.boundary.is_timed or self.motion is not None

    @property
    def gentle(self) -> bool:
        """Whether the manoeuvre follows the path of least effort, whose base rotation is least
        sensitive to mass errors.
        """
        # During a gentle manoeuvre, the base of a drifting robot keeps rotating.
        return self.request.correction and not self.is_timed

    @property
    def hastens(self) -> bool:
        """Whether the search is for the fastest manoeuvre."""
        return self.options.duration == 0 and not self.gentle

    def within_time(self, seconds: float) -> SearchProblem:
        """Return the problem of a manoeuvre that takes no longer than a time, s."""
        longest = min(self.options.longest, seconds)
        return replace(self, options=replace(self.options, longest=longest))

    def cost(self, trajectory: Trajectory) -> float:
        """Return the cost: the duration, or the effort if the duration is given."""
        if self.options.duration == 0:
            return trajectory.duration
        scale = np.where(np.isfinite(self.limits.velocity), self.limits.velocity, 1.0)
        change = np.diff(trajectory.velocities, axis=0) / trajectory.step / scale
        return float(np.mean(np.sum(change**2, axis=1)))

    def solutions_agree(self, solutions: Sequence[Trajectory]) -> bool:
        """Whether enough solutions agree with the best one."""
        costs = np.array([self.cost(each) for each in solutions])
        same = int(np.sum(costs <= costs.min(initial=math.inf) * (1 + _AGREEING_COST_TOLERANCE)))
        return 0 < self.options.agreeing <= same


class _Grid(NamedTuple):
    """A number of intervals, and the tolerance of solutions."""

    intervals: int
    tolerance: float = TOLERANCE


class ManoeuvreSearch:
    """Searches for a robot's manoeuvres, and keeps its solvers for later searches.

    Parameters
    ----------
    model
        Model and constraints for the manoeuvres.
    """

    def __init__(self, model: ManoeuvreModel) -> None:
        self._model = model
        # No function refers to this object, so that solvers are released together with it.
        stages_of = cache(model.stages)

        @lru_cache(_KEPT_SOLVERS)
        def solver(
            position: bool, drifting: bool, grid: _Grid, pairs: tuple[int, ...]
        ) -> MultipleShooting:
            # Most of the time is spent on clear paths.
            stages = stages_of(position, drifting, bool(pairs))
            if pairs and model.clearance is not None:
                rows = PlaneDistances.of(model.clearance.geometry, pairs)
                stages = stages.with_distances(rows, instants_of(grid.intervals))
            return MultipleShooting(stages, *grid)

        self._solvers = solver

    def search(self, problem: SearchProblem) -> Manoeuvre:
        """Return the fastest manoeuvre found.

        Raises
        ------
        NotFoundError
            None was found; if others were found, but no clear one, a :class:`NoClearPathError`.
        PlanningError
            No manoeuvre is as short as requested, or links are too close at the start or the end.
        PlanningCancelled
            The search was cancelled.
        """
        options, model = problem.options, self._model
        if options.longest < _MIN_TICKS * model.control_period:
            raise PlanningError(
                f"Manoeuvres take at least {_MIN_TICKS} control periods of "
                f"{model.control_period:g} s, more than optimal.longest = {options.longest:g} s."
            )
        if problem.motion is not None:
            most = problem.limits.velocity
            velocity = np.clip(problem.motion.mean_velocity(model.control_period), -most, most)
            problem = replace(problem, boundary=replace(problem.boundary, velocity=velocity))
        kept = None
        if model.clearance is not None and problem.keeps_clear:
            about = model.clearance, model.robot, model.prediction, problem.boundary
            kept = KeptDistances(*about, turn_is_known=len(model.axes) == 3)
        search = _Search(model, problem, self._solvers)
        found, refusal = search.search_from_guesses(), NotFoundError
        if found is not None and kept is not None:
            found, refusal = search.keep_clear(kept, found), NoClearPathError
        cut_short = problem.clock.is_over(found=found is not None)
        if found is None:
            within = f" within optimal.time_budget {options.time_budget:g} s" if cut_short else ""
            in_motion = "" if problem.motion is None else " that begins in motion"
            limit = "duration" if options.duration > 0 else "longest"
            longer = "A longer optimal.time_budget, more" if cut_short else "More"
            raise refusal(
                f"No manoeuvre to the goal{in_motion} was found from "
                f"{counted(search.starts, 'start')}{within}: {search.rejection}. {longer} "
                "optimal.starts, optimal.iterations or optimal.intervals, "
                f"a longer optimal.{limit}, or a closer goal may help."
            )
        return replace(found, starts=search.starts, cut_short=cut_short)


class _Search:
    """One search.

    Attributes
    ----------
    starts
        Number of guesses that were tried.
    rejection
        Reason why the last candidate was rejected.
    """

    def __init__(
        self,
        model: ManoeuvreModel,
        problem: SearchProblem,
        solvers: Callable[[bool, bool, _Grid, tuple[int, ...]], MultipleShooting],
    ) -> None:
        self._model, self._period, boundary = model, model.control_period, problem.boundary
        self._solver = partial(solvers, boundary.center is not None, boundary.drifts)
        self._wheels = ReactionWheels.of(model.robot.description)
        self._wheels_stop_base = (
            len(self._wheels) > 0 and problem.boundary.is_timed and problem.motion is None
        )
        if self._wheels_stop_base:
            # Guesses with wheels are close to solutions.
            iterations = min(problem.options.iterations, _MAX_ITERATIONS_OF_STOPS)
            options = replace(problem.options, answers=1, iterations=iterations)
            problem = replace(problem, options=options)
        self._problem = problem
        self._full = self._coarse = _Grid(problem.options.intervals)
        coarse = _Grid(problem.options.intervals // _COARSE_GRID_RATIO, _COARSE_TOLERANCE)
        # On a coarse grid, the attitude of a base stopped by wheels is too inaccurate.
        if coarse.intervals >= _MIN_COARSE_INTERVALS and not self._wheels_stop_base:
            self._coarse = coarse
            # In motion, a single answer is requested for the rest of a manoeuvre, which is short.
            if problem.motion is not None and problem.options.answers == 1:
                self._full = coarse
        # A timed motion is too inaccurate on a coarse grid: joints overrun in long intervals.
        is_coarse = self._coarse != self._full
        self._clears_coarsely = problem.hastens and is_coarse and not problem.is_timed
        self.starts, self.rejection = 0, ""
        self._phase, self._reported = SearchPhase.SEARCHING, 0.0
        # Of the clear paths, once paths in collision have been found.
        self._best, self._is_clearing, self._work = math.inf, False, 0.0
        self._coarse_solutions: list[Trajectory | None] = []

    # -- 1. guesses -------------------------------------------------------------------------------

    def _guesses(
        self, grid: _Grid, is_clear: Callable[[Trajectory], bool] | None = None
    ) -> Iterator[Trajectory]:
        """Yield guesses on a grid endlessly, in the same order for equal problems; those that
        are clear, if ``is_clear`` is given."""
        problem, source = self._problem, self._source(grid)
        boundary, limits, motion = problem.boundary, problem.limits, problem.motion
        if motion is not None:
            velocity = np.broadcast_to(boundary.velocity, boundary.start.shape)
            if len(motion.remaining) > 1:
                yield source.from_ticks(motion.remaining, velocity, self._period)
            for guess in source.generate(boundary, limits, is_clear):
                yield source.with_initial_velocity(guess, velocity, limits)
        if len(self._wheels) and len(self._model.axes):
            robot = self._model.robot
            yield from source.generate_with_wheels(self._wheels, boundary, limits, robot)
        yield from source.generate(boundary, limits, is_clear)

    def _source(self, grid: _Grid) -> InitialGuesses:
        boundary = self._problem.boundary
        curvature = self._model.robot.function("curvature", compile=False)
        L_0 = boundary.angular_momentum if boundary.drifts else None
        turn = self._solver(grid, ()).turn
        return InitialGuesses(turn, curvature, grid.intervals, L_0)

    # -- 2. coarse solutions ----------------------------------------------------------------------

    def search_from_guesses(self) -> Manoeuvre | None:
        """Return a manoeuvre that need not be clear, starting from guesses on a coarse grid; None
        if none is found.
        """
        self._report("begun")
        problem, enough = self._problem, self._problem.options.answers
        # A single answer from rest costs less without a coarse grid.
        grid = self._full if enough == 1 else self._coarse
        solutions: list[Trajectory] = []
        for guess in itertools.islice(self._guesses(grid), problem.options.starts):
            solution = self._solve_start(grid, guess, found=bool(solutions))
            if grid == self._coarse:
                self._coarse_solutions.append(solution)
            if solution is not None:
                solutions.append(solution)
            # A search may also be cut short within its last start.
            cut_short = problem.clock.is_over(found=bool(solutions)) or not (
                solutions or self.starts < problem.max_failed_starts
            )
            if cut_short or len(solutions) >= enough or problem.solutions_agree(solutions):
                found = self._refine_best(solutions, grid)
                if found is not None or cut_short:
                    return found
                # These solutions failed; the next ones are tried one by one.
                solutions, enough = [], 1
        return self._refine_best(solutions, grid)

    def _solve_start(
        self, grid: _Grid, guess: Trajectory, *, found: bool = False
    ) -> Trajectory | None:
        """Return the solution from the next guess; None: none was found."""
        self._begin(SearchPhase.SEARCHING)
        self.starts += 1
        with self._attempt():
            solution = self._solve_from_guess(grid, guess, found=found)
            duration = math.inf if self._is_clearing else solution.duration
            self._report(f"start {self.starts}, {solution.duration:.6g} s", duration)
            return solution
        return None

    def _solve_from_guess(
        self, grid: _Grid, guess: Trajectory, *, found: bool = False, refining: bool = False
    ) -> Trajectory:
        """Return the solution from a guess: the fastest one, that of least effort in the time that
        is given, or a gentle one; UnusableCandidateError if none was found.
        """
        problem, slowed = self._problem, self._model.slowed
        shortest, T = self._shortest_duration, problem.options.duration
        guess = slowed(guess, problem.boundary)
        if problem.hastens:
            longest = problem.options.longest
            return self._solve(grid, guess, shortest, longest, found=found, refining=refining)
        if T == 0:
            T = max(_GENTLE_DURATION_FACTOR * guess.duration, shortest)
            solution = self._solve(grid, guess, T, found=found)
            return slowed(solution.at_full_speed(problem.limits, shortest), problem.boundary)
        return self._solve(grid, guess, self._given_duration, found=found)

    # -- 3. full grid -----------------------------------------------------------------------------

    def _refine_best(self, solutions: list[Trajectory], grid: _Grid) -> Manoeuvre | None:
        """Return a manoeuvre from the best solution on a grid, refined on the full grid, or from
        the next one if that fails; None: from none of them.
        """
        self._begin(SearchPhase.REFINING)
        for solution in sorted(solutions, key=self._problem.cost):
            with self._attempt():
                if grid != self._full:
                    guess = self._source(self._full).resample(solution)
                    solution = self._solve_from_guess(self._full, guess, refining=True)
                return self._make_held_commands(solution)
        return None

    # -- 4. held commands -------------------------------------------------------------------------

    def _make_held_commands(
        self, trajectory: Trajectory, kept: KeptDistances | None = None
    ) -> Manoeuvre:
        """Return a solution as held commands, close to it if pairs are kept apart;
        UnusableCandidateError if none reach the goal within the constraints.
        """
        problem, model = self._problem, self._model
        if problem.is_timed:
            held = self._hold_in_whole_ticks(trajectory, kept)
        else:
            fixed = problem.options.duration > 0
            held = model.hold(trajectory, problem.boundary, problem.limits, fixed=fixed)
        if held is None:
            raise UnusableCandidateError(_NO_HELD_COMMANDS)
        attitudes = quaternion_multiply(problem.request.state.quaternion, held.quaternions)
        model.constraints.check(held.positions, attitudes, self._period)
        duration = (len(held.positions) - 1) * self._period
        self._report(f"manoeuvre of {duration:.6g} s")
        return Manoeuvre(held, duration, trajectory)

    def _hold_in_whole_ticks(
        self, trajectory: Trajectory, kept: KeptDistances | None
    ) -> HeldCommands | None:
        """Return a solution whose duration matters as held commands; None if that fails.

        Stretched to whole control periods, it would rotate the base farther, or start at other
        rates. So the path of least effort is computed for that number of periods, or a few more.
        """
        problem, limits, near = self._problem, self._problem.limits, None
        if self._wheels_stop_base:
            velocity, acceleration = limits.velocity, limits.acceleration
            share = _HELD_SHARE_OF_STOPS
            limits = replace(limits, velocity=share * velocity, acceleration=share * acceleration)
        if kept is not None and kept.pairs:
            near = Neighbourhood(_HELD_REACH_SHARE)
        grid = _Grid(len(trajectory.shapes) - 1)
        ticks = max(_MIN_TICKS, math.ceil(trajectory.duration / self._period - 1e-6))
        guess, boundary, aim = trajectory, problem.boundary, problem.boundary
        # If the duration is given, only the first one is possible.
        longer = [math.ceil(share * ticks) for share in _ADDITIONAL_SHARES]
        for more in [*_ADDITIONAL_TICKS, *longer][: 2 if problem.options.duration > 0 else None]:
            T = (ticks + more) * self._period
            try:
                guess = self._solve(grid, guess, T, aim=aim, limits=limits, kept=kept, near=near)
            except UnusableCandidateError:
                continue
            held = self._model.hold(
                guess, boundary, problem.limits, fixed=True, before=problem.velocity
            )
            if held is not None:
                return held
            aim = self._model.corrected_end(guess, boundary, ticks + more)
        return None

    # -- 5. clear ---------------------------------------------------------------------------------

    def keep_clear(self, kept: KeptDistances, found: Manoeuvre) -> Manoeuvre | None:
        """Return a clear manoeuvre: the one that was found, if it is clear; otherwise, one near it
        or near other paths; None if none is found.
        """
        if not kept.approaches(found.held.positions, found.held.quaternions):
            return found
        self._best, self._is_clearing = math.inf, True
        paths = itertools.chain([(found.solution, 1.0)], self._other_paths(kept, found.solution))
        most = None if self._clears_coarsely else 1 + _MAX_FULL_GRID_STARTS
        good, enough = _GOOD_TIME_FACTOR * found.duration, _ENOUGH_CLEAR_PATHS
        clear: list[tuple[Trajectory, KeptDistances]] = []
        for path, reach in itertools.islice(paths, most):
            if reach <= 1 and any(path.duration >= each.duration for each, _ in clear):
                continue
            beside, slower = kept.beside(path), _CLEARING_TIME_FACTOR
            with self._attempt():
                if not self._clears_coarsely:
                    return self._clear_on_full_grid(beside, path, reach, slower)
                path, _ = self._clear(beside, self._coarse, path, slower * path.duration, reach)
                path, _ = self._shorten(beside.beside(path, _NEAR), self._coarse, path, None)
                clear.append((path, beside.beside(path, _NEAR)))
            is_over = self._is_over(found=True, share=_SHARE_OF_CHOICE)
            if clear and (is_over or len(clear) >= enough or clear[-1][0].duration <= good):
                made = self._refine_best_clear(clear)
                if made is not None:
                    return made
                # These paths failed; the next ones are refined one by one.
                clear, enough = [], 1
        return self._refine_best_clear(clear)

    def _other_paths(
        self, kept: KeptDistances, known: Trajectory
    ) -> Iterator[tuple[Trajectory, float]]:
        """Yield other paths, with the fraction of the largest reach to search for clear paths,
        alternately: solutions that need not keep clear, from guesses on a coarse grid, and guesses
        that keep clear, but do not end at the goal.
        """
        problem = self._problem
        moves = problem.motion is not None
        if problem.boundary.drifts and not (moves and len(self._wheels)):
            # A drifting robot finds more of them sooner after braking and coasting.
            solved = 0 if moves else len(self._coarse_solutions)
            yield from ((path, 1.0) for path in self._other_solutions(known, solved))
            return
        brakes = moves and not problem.boundary.drifts
        most = _MAX_CLEAR_STARTS_IN_MOTION if brakes else _MAX_CLEAR_STARTS
        starts = min(problem.options.starts, most)
        guesses = itertools.islice(self._guesses(self._coarse, kept.is_clear), starts)
        clear = (each for each in guesses if kept.is_clear(each))
        left = [(self._other_solutions(known, starts), 1.0), (clear, _REACH_FROM_GUESS)]
        while left and not self._is_over(found=False):
            paths, reach = left.pop(0)
            for path in itertools.islice(paths, 1):
                yield path, reach
                left.append((paths, reach))

    def _other_solutions(self, known: Trajectory, starts: int) -> Iterator[Trajectory]:
        """Yield solutions from guesses on the coarse grid that differ from the known one."""
        grid, costs = self._coarse, [self._problem.cost(known)]
        others = itertools.islice(self._guesses(grid), len(self._coarse_solutions), starts)
        solved = (self._solve_start(grid, guess) for guess in others)
        for solution in filter(None, itertools.chain(self._coarse_solutions[:starts], solved)):
            cost = self._problem.cost(solution)
            if all(abs(cost - other) > _SAME_COST_TOLERANCE * other for other in costs):
                costs.append(cost)
                yield solution

    def _refine_best_clear(self, clear: list[tuple[Trajectory, KeptDistances]]) -> Manoeuvre | None:
        """Return a clear manoeuvre from the fastest path that is clear on the coarse grid, or from
        the next one if that fails; None: from none of them.
        """
        # Such a path is mostly clear on the full grid, too, and as fast.
        reach = 1 / _REACH_DIVISOR
        for path, kept in sorted(clear, key=lambda each: each[0].duration):
            with self._attempt():
                path = path.stretched(_RESAMPLED_TIME_FACTOR)
                path, made = self._shorten(kept, self._full, path, None, reach)
                # From a nearly clear path, larger steps lead away: one plan took twice as long.
                return made or self._clear_on_full_grid(kept, path, reach, _RECLEARED_TIME_FACTOR)
        return None

    def _clear_on_full_grid(
        self, kept: KeptDistances, path: Trajectory, reach: float, slower: float
    ) -> Manoeuvre:
        """Return a clear manoeuvre close to a path on the full grid, which is first made
        ``slower`` by a factor if no duration is given; UnusableCandidateError if none was found.
        """
        options, duration = self._problem.options, slower * path.duration
        if options.duration > 0:
            duration = self._given_duration
        path, made = self._clear(kept, self._full, path, duration, reach)
        if options.duration == 0:
            beside = kept.beside(path, _NEAR)
            _, made = self._shorten(beside, self._full, path, made, min(reach, 1.0))
        assert made is not None
        if made.duration > max(options.longest, options.duration) + self._period / 2:
            raise UnusableCandidateError(_NO_PATH_FOUND)
        return made

    def _clear(
        self, kept: KeptDistances, grid: _Grid, path: Trajectory, duration: float, reach: float
    ) -> tuple[Trajectory, Manoeuvre | None]:
        """Return a clear path close to another, in a given duration (s), and its held commands, in
        steps of a fraction of the largest reach. UnusableCandidateError if none was found.
        """
        self._begin(SearchPhase.CLEARING)
        around = Neighbourhood(reach, _LARGEST_LACK)
        least, stalled, no_lack = math.inf, 0, _NO_LACK
        for _ in range(_MAX_CLEARING_ROUNDS):
            path = self._solve_apart(kept, grid, path, duration, around)
            lack = self._lack
            # An infeasible path near a solution has better planes than that solution; from a guess,
            # such paths took most of the time, and none of them led to a clear one.
            if reach > 1 and not self._feasible:
                raise UnusableCandidateError(_NO_PATH_FOUND)
            near, made = self._approaches(kept, grid, path)
            if not near:
                return path, made
            stalled = stalled + 1 if lack > max(_STALLED_SHARE * least, no_lack) else 0
            if stalled >= _MAX_STALLED_ROUNDS and lack < INITIAL_ROOM:
                # The planes keep the clearance; links that turn between instants need more room.
                stalled, no_lack = 0, INITIAL_ROOM
            least, before = min(least, lack), kept.pairs
            (kept.widen if lack < no_lack else kept.add)(near)
            if kept.pairs != before:
                least, stalled = math.inf, 0
            is_over = grid != self._full and self._is_over(found=False)
            if is_over or stalled >= _MAX_STALLED_ROUNDS:
                break
        period = None if made is None else self._period
        raise UnusableCandidateError(kept.clearance.clause(near[0], period))

    def _shorten(
        self,
        kept: KeptDistances,
        grid: _Grid,
        path: Trajectory,
        made: Manoeuvre | None,
        reach: float = 1.0,
    ) -> tuple[Trajectory, Manoeuvre | None]:
        """Return a faster path close to a clear one, and its held commands; else the clear one.

        The first step is a share, ``reach``, of the largest reach. On the full grid, a path without
        held commands may be replaced by a faster one that is not clear.
        """
        self._begin(SearchPhase.SHORTENING)
        for number in range(_MAX_SHORTENING_ROUNDS):
            self._report("clear path", path.duration)
            is_over = number >= _MIN_SHORTENING_ROUNDS and self._is_over(found=True)
            if is_over or reach < _MIN_REACH_SHARE or self._problem.clock.is_over(found=True):
                break
            try:
                faster = self._solve_apart(kept, grid, path, None, Neighbourhood(reach))
                near, found = self._approaches(kept, grid, faster)
            except UnusableCandidateError:
                reach /= _REACH_DIVISOR
                continue
            gain = 1 - faster.duration / path.duration
            # A solver that ran out of steps may end with a slower path.
            if near or gain < -_MIN_GAIN:
                reach /= _REACH_DIVISOR
                kept.widen(near)
                if near and made is None and grid == self._full:
                    # The path is not clear by its held commands, either, but this one is faster.
                    return faster, None
                continue
            if gain > 0:
                path, made = faster, found
            if gain < _MIN_GAIN * reach:
                break
            reach = min(_REACH_FACTOR * reach, 1.0)
        return path, made

    def _approaches(
        self, kept: KeptDistances, grid: _Grid, path: Trajectory
    ) -> tuple[list[Approach], Manoeuvre | None]:
        """Return the pairs that come too close along a path, or else, on the full grid, along its
        held commands, and these commands."""
        near = kept.approaches_of(path)
        if near or grid != self._full:
            return near, None
        made = self._make_held_commands(path, kept)
        return kept.approaches(made.held.positions, made.held.quaternions), made

    def _solve_apart(
        self,
        kept: KeptDistances,
        grid: _Grid,
        guess: Trajectory,
        duration: float | None,
        near: Neighbourhood,
    ) -> Trajectory:
        """Return a solution close to a guess that keeps pairs of links apart, in a duration, s
        (None: the fastest one); UnusableCandidateError if none was found.
        """
        problem, boundary = self._problem, self._problem.boundary
        if duration is not None:
            guess = guess.stretched(duration / guess.duration)
        if len(guess.shapes) != grid.intervals + 1:
            guess = self._source(grid).resample(guess)
        if problem.motion is not None and duration is not None:
            # A longer path begins at the same velocities.
            lacking = boundary.velocity - guess.velocities[0]
            guess = self._source(grid).with_initial_velocity(guess, lacking, problem.limits)
        longest = problem.options.longest if duration is None else None
        shortest = duration or self._shortest_duration
        return self._solve(grid, guess, shortest, longest, kept=kept, near=near, found=True)

    # -- shared by the steps ----------------------------------------------------------------------

    def _solve(
        self,
        grid: _Grid,
        guess: Trajectory,
        shortest: float,
        longest: float | None = None,
        *,
        aim: BoundaryConditions | None = None,
        limits: MotionLimits | None = None,
        kept: KeptDistances | None = None,
        near: Neighbourhood | None = None,
        found: bool = False,
        refining: bool = False,
    ) -> Trajectory:
        """Return the fastest solution near a guess, at most ``longest``, s; None: that of least
        effort in the ``shortest`` time.

        ``aim`` and ``limits`` replace those of the problem, ``kept`` pairs stay apart, ``found``:
        whether there is a manoeuvre. UnusableCandidateError if none was found.
        """
        problem, pairs = self._problem, () if kept is None else kept.pairs
        limits = limits or problem.limits
        solver = self._solver(grid, pairs)
        if longest is None:
            guess = guess.stretched(shortest / guess.duration)
        if kept is not None and near is not None:
            limits = kept.within(limits, guess, pushing=near.largest_lack > 0)
        stop = self._stop_rule(found=found, work=solver.nonzeros if pairs else 0)
        bounds = DurationBounds(shortest, shortest if longest is None else longest)
        solution = solver.solve(
            aim or problem.boundary, limits, guess, stop, bounds, near, refining=refining
        )
        problem.cancellation.raise_if_requested()
        self._lack, self._feasible = solver.lack, solver.feasible
        if solution is None:
            raise UnusableCandidateError(_NO_PATH_FOUND)
        if pairs:
            apart, lack = counted(len(pairs), "pair"), f"{1e3 * solver.lack:.3g} mm too close"
            self._report(f"{apart} apart, {solution.duration:.6g} s, {lack}")
        return solution

    @property
    def _shortest_duration(self) -> float:
        """Shortest duration of a manoeuvre, s."""
        gentle = min(_GENTLE_TICKS * self._period, _GENTLE_TIME) if self._problem.gentle else 0.0
        return max(_MIN_TICKS * self._period, gentle)

    @property
    def _given_duration(self) -> float:
        """The requested duration in whole ticks, s."""
        return max(round(self._problem.options.duration / self._period), 1) * self._period

    def _is_over(self, *, found: bool, share: float = 1.0) -> bool:
        """Whether the time, or the work on clear paths, is used up; ``found``: if there is one."""
        factor = share if found else _WORK_FACTOR_WITHOUT_PATH
        most = factor * _MAX_WORK_PER_ITERATION * self._problem.options.iterations
        return self._work > most or self._problem.clock.is_over(found=found)

    def _stop_rule(self, *, found: bool, work: int) -> StopRule:
        """Return the solver's stop conditions in this phase; ``work`` is the work per step."""
        problem, iterations = self._problem, self._problem.options.iterations
        if self._is_clearing and work:
            iterations = min(iterations, _MAX_CLEARING_ITERATIONS)

        def is_over(feasible: bool) -> bool:
            # An intermediate path to a clear one is not a manoeuvre.
            is_manoeuvre = self._phase is not SearchPhase.CLEARING and (found or feasible)
            return problem.clock.is_over(found=is_manoeuvre)

        def watch() -> None:
            self._work += work
            if problem.clock.elapsed >= self._reported + _REPORT_PERIOD:
                self._report("going on")

        return StopRule(iterations, problem.cancellation, is_over, watch)

    def _begin(self, phase: SearchPhase) -> None:
        """Begin a phase and report it."""
        if phase is not self._phase:
            self._phase = phase
            self._report("begun")

    def _report(self, result: str, duration: float = math.inf) -> None:
        """Report a result; ``duration`` is the duration, s, of a path that may be the best."""
        self._best = min(self._best, duration)
        self._reported = elapsed = self._problem.clock.elapsed
        most = self._problem.options.starts
        progress = SearchProgress(self.starts, most, self._best, self._phase, elapsed)
        log_progress(_LOG, progress, f"{self._phase.value}: {result} after {elapsed:.2f} s")

    @contextmanager
    def _attempt(self) -> Iterator[None]:
        """Record the reason why there is no manoeuvre, instead of raising an error."""
        try:
            yield
        except UnusableCandidateError as reason:
            self.rejection = str(reason)
            self._report(self.rejection)
        self._problem.cancellation.raise_if_requested()
