"""The nonlinear program of direct multiple shooting (:mod:`.transcription`), solved by IPOPT."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import casadi as ca
import numpy as np

from spacerobot_ros.model.description import Array
from spacerobot_ros.planning.core.cancellation import NEVER, Cancellation
from spacerobot_ros.planning.methods.optimal.problem import (
    BoundaryConditions,
    MotionLimits,
    Trajectory,
)
from spacerobot_ros.planning.methods.optimal.transcription import Layout, Program, Stages, program

_FEASIBILITY_TOLERANCE = 1e-4
"""Constraint violation below which an iterate is accepted as a trajectory, SI units."""

_INFEASIBLE = "Infeasible_Problem_Detected"
"""Solver status if the solver ends at a minimum of the constraint violation."""

TOLERANCE = 1e-5
"""Durations are accurate to a thousandth of a control period for manoeuvres of several seconds."""

_IPOPT_OPTIONS = {
    "print_time": False,
    # All derivatives are given: the solver must not derive more.
    "no_nlp_grad": True,
    "calc_lam_p": False,
    "ipopt.print_level": 0,
    "ipopt.sb": "yes",
    "ipopt.linear_solver": "mumps",
    # Approximate minimum degree: the matrices are banded, and the choice of MUMPS fills them in.
    "ipopt.mumps_pivot_order": 0,
    # A matching of large entries to the diagonal first undoes that order: legged robots took up to
    # thirty times as long per step.
    "ipopt.mumps_permuting_scaling": 0,
    "ipopt.mu_strategy": "monotone",
    "ipopt.constr_viol_tol": 1e-6,
    # Iterative refinement of steps is off.
    "ipopt.fast_step_computation": "yes",
    # A diverging solve ends here: beyond it the factors fill in, and a step takes a second.
    "ipopt.max_hessian_perturbation": 1e6,
}


_WARM_OPTIONS = {"ipopt.mu_init": 3e-3, "ipopt.bound_push": 1e-3, "ipopt.bound_frac": 1e-3}
"""With distances: the guess is a solution without some of the distances; the solver must stay near
it."""

_REFINING_OPTIONS = {"ipopt.mu_init": 1e-3}
"""The guess is a solution on a coarser grid."""

_WARM_STRETCH = 1.5
"""With distances: factor by which the duration of the guess is multiplied. At full speed,
velocities and accelerations are at their limits, which leaves the solver no room to move around
obstacles."""

_LARGEST_REACH, _LARGEST_REACH_SHARE = 0.3, 0.15
"""Largest reach of a neighbourhood, rad or m, and as a fraction of a joint's range."""

_COST_OF_LACK = 300.0
"""Cost per metre of missing clearance, in durations or efforts of the guess."""


@dataclass(frozen=True)
class StopRule:
    """Conditions under which a solver stops before convergence.

    Attributes
    ----------
    iterations
        Largest number of solver steps.
    cancellation
        Stops the solver at its next iterate.
    is_over
        Returns whether the wall time is used up; the argument says whether there is a feasible
        iterate.
    watch
        Called at every iterate.
    """

    iterations: int
    cancellation: Cancellation = NEVER
    is_over: Callable[[bool], bool] = lambda feasible: False
    watch: Callable[[], None] = lambda: None


@dataclass(frozen=True)
class DurationBounds:
    """Bounds on the duration of a trajectory, s."""

    shortest: float
    longest: float

    @property
    def fixed(self) -> bool:
        """Whether the duration is given."""
        return self.shortest == self.longest


class Neighbourhood(NamedTuple):
    """Neighbourhood of a guess in which a solver searches for a path without collisions.

    Attributes
    ----------
    share
        Largest shape change anywhere on the path, as a fraction of the largest reach.
    largest_lack
        Distance by which links may be closer than required, m. The cost of this distance is high,
        so that it vanishes if the solver finds a path.
    """

    share: float
    largest_lack: float = 0.0


class MultipleShooting:
    """Solves one robot's problem for many boundary conditions.

    Parameters
    ----------
    stages, intervals
        Problem functions, and number of intervals N.
    tolerance
        Tolerance on the optimality conditions at which the solver stops.
    """

    def __init__(self, stages: Stages, intervals: int, tolerance: float = TOLERANCE) -> None:
        self.intervals = intervals
        self.feasible = False
        """Whether the last solution satisfies the constraints."""
        self.converged = False
        """Whether the solver converged to the last solution."""
        self.lack = 0.0
        """Distance by which links are closer than required in the last solution, m."""
        self.turn = stages.rotation_of_step
        self._drifting = stages.drifting
        self._layout, of_program = Layout.of(stages, intervals), program(stages, intervals)
        self.nonzeros = int(of_program.jac_g.nnz_out(1))
        """Number of nonzeros in the constraint Jacobian; the computing time of a step is
        proportional to it."""
        self._has_distances = stages.distances is not None
        options = {"": _WARM_OPTIONS if self._has_distances else {}, "refining": _REFINING_OPTIONS}
        self._solver = ProgramSolver(
            "manoeuvre",
            of_program,
            {kind: {**each, "ipopt.tol": tolerance} for kind, each in options.items()},
        )

    def solve(
        self,
        boundary: BoundaryConditions,
        limits: MotionLimits,
        guess: Trajectory,
        stop: StopRule,
        duration: DurationBounds,
        near: Neighbourhood | None = None,
        *,
        refining: bool = False,
    ) -> Trajectory | None:
        """Return the fastest trajectory near ``guess``; None if none is found.

        If links may be closer than required, it may be the last iterate, which is not
        :attr:`feasible`.

        For a fixed time, return the trajectory of least effort, that is, of the least mean square
        of accelerations divided by joint speeds.

        Parameters
        ----------
        boundary, limits, guess
            The problem, and the start of the solver.
        stop
            Conditions under which the solver stops early.
        duration
            Bounds on the duration.
        near
            Neighbourhood of the guess for the solution; None: anywhere.
        refining
            Whether the guess is a solution on a coarser grid.
        """
        N, layout = self.intervals, self._layout
        vertices = np.array([np.tile(x, (N + 1, 1)) for x in (limits.lower, limits.upper)])
        if near is not None:
            middle = np.clip(guess.shapes + guess.step * guess.velocities / 2, *vertices)
            width = limits.upper - limits.lower
            reach = near.share * np.minimum(_LARGEST_REACH, _LARGEST_REACH_SHARE * width)
            vertices = np.clip(middle + np.multiply.outer([-1.0, 1.0], reach)[:, None], *vertices)
        if boundary.final is not None:
            given = np.isfinite(boundary.final)
            vertices[:, N, given] = boundary.final[given]
        velocities = np.multiply.outer([-1.0, 1.0], np.tile(limits.velocity, (N + 1, 1)))
        velocities[:, 0], velocities[:, N] = boundary.velocity, boundary.final_velocity
        attitudes = np.multiply.outer([-1.0, 1.0], np.full((N + 1, 4), 1.1))
        attitudes[:, 0] = [0.0, 0.0, 0.0, 1.0]
        accelerations = np.array([-limits.acceleration, limits.acceleration])
        lack = 0.0 if near is None else near.largest_lack
        bounds = knot_bounds(layout, duration, lack, attitudes, vertices, velocities, accelerations)
        slower = self._has_distances and not duration.fixed and not boundary.is_timed
        first = guess.stretched(_WARM_STRETCH) if slower else guess
        parameters = _pack_parameters(
            boundary, limits, guess, fixed=duration.fixed, drifting=self._drifting
        )
        h, v = first.step, first.velocities
        a = np.diff(v, axis=0) / h
        x = pack_knots(layout, h, first.quaternions, first.shapes + h * v / 2, v, a)
        if layout.has_lack:
            x[-1] = lack / 2
        found = self._solver.solve(
            "refining" if refining and not self._has_distances else "", stop, x, bounds, parameters
        )
        self.converged, self.feasible, x = found.converged, found.feasible, found.x
        # If the goal drifts away, no duration compensates for the violations in each interval.
        infeasible = self._drifting and found.status == _INFEASIBLE
        if not self.converged and (infeasible or not (self.feasible or lack)):
            return None
        self.lack = float(x[-1]) if layout.has_lack else 0.0
        h, (X, s, v, _) = float(x[0]), (x[each] for each in layout.knots())
        return Trajectory(h, s - h * v / 2, v, X)


def _pack_parameters(
    boundary: BoundaryConditions,
    limits: MotionLimits,
    guess: Trajectory,
    *,
    fixed: bool,
    drifting: bool = False,
) -> Array:
    typical = np.where(np.isfinite(limits.velocity), limits.velocity, limits.acceleration)
    weights = np.array([1.0, 0.0, _COST_OF_LACK * guess.duration])
    if fixed:
        # In units of the guess, so that the solver sees numbers of about one.
        change = np.diff(guess.velocities, axis=0) / guess.step / typical
        effort = max(float(np.sum(change**2)) / len(change), 1e-300)
        weights = np.array([0.0, 1.0 / effort, _COST_OF_LACK])
    return np.concatenate(
        [
            *(boundary.start, boundary.goal_rotation, boundary.direction),
            np.zeros(3) if boundary.center is None else boundary.center,
            *(boundary.end_effectors, typical, weights if limits.distances.size else weights[:2]),
            boundary.angular_momentum if drifting else np.zeros(0),
            limits.distances.ravel(),
        ]
    )


def pack_knots(layout: Layout, step: float, *knots: Array) -> Array:
    """Return the variables for a step and for the components of all knots
    (:meth:`.Layout.knots`)."""
    x = np.zeros(layout.size)
    x[0] = step
    for places, values in zip(layout.knots(), knots, strict=True):
        x[places] = values
    return x


def knot_bounds(
    layout: Layout, duration: DurationBounds, lack: float, *ranges: Array
) -> tuple[Array, Array]:
    """Return the smallest and the largest variables for a duration, the ``ranges`` (2, ...) of the
    components of all knots, and a lack of at most ``lack``, m.
    """
    spans = zip((duration.shortest, duration.longest), *ranges, strict=True)
    least, most = (pack_knots(layout, each[0] / layout.intervals, *each[1:]) for each in spans)
    if layout.has_lack:
        most[-1] = lack
    return least, most


class Solution(NamedTuple):
    """End of a solve.

    ``x`` are the last variables or, if the solver did not converge, those of the best feasible
    iterate, if any; ``feasible``: whether they are feasible. ``multipliers`` are those of the
    variables and of the rows, and ``status`` is that of the solver.
    """

    x: Array
    converged: bool
    feasible: bool
    multipliers: tuple[Array, Array]
    status: str


class ProgramSolver:
    """Solves a program by IPOPT.

    Parameters
    ----------
    name, program
        Name of the solver functions, and the program.
    options
        IPOPT options, in addition to the common ones, by the kind of guess.
    """

    def __init__(
        self, name: str, program: Program, options: Mapping[str, Mapping[str, object]]
    ) -> None:
        monitor = _Monitor(program)
        common = {**_IPOPT_OPTIONS, "jac_g": program.jac_g, "hess_lag": program.hess_lag}
        # The solver's matrices are small: threads of its linear algebra would wait for each other.
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

        @cache
        def of_kind(kind: str) -> ca.Function:
            given = {**common, **options[kind], "iteration_callback": monitor}
            return ca.nlpsol(name, "ipopt", program.problem, given)

        self.rows = len(program.lower)
        """Number of constraint rows."""
        self._bounds = {"lbg": program.lower, "ubg": program.upper}
        self._monitor, self._ipopt = monitor, of_kind

    def solve(
        self,
        kind: str,
        stop: StopRule,
        x0: Array,
        bounds: tuple[Array, Array],
        parameters: Array,
        **multipliers: Array,
    ) -> Solution:
        """Solve the program from a guess of some kind.

        ``bounds`` are the smallest and largest variables, and ``multipliers`` those of the guess,
        ``lam_x0`` and ``lam_g0``.
        """
        solver, (least, most) = self._ipopt(kind), bounds
        self._monitor.begin(stop)
        result = solver(x0=x0, lbx=least, ubx=most, p=parameters, **self._bounds, **multipliers)
        best, stats = self._monitor.end(), solver.stats()
        x, *found = (result[name].full().ravel() for name in ("x", "lam_x", "lam_g"))
        converged = bool(stats["success"])
        if not converged and best is not None:
            x = best
        is_feasible = converged or best is not None
        return Solution(x, converged, is_feasible, (found[0], found[1]), stats["return_status"])


class _Monitor(ca.Callback):
    """Receives every iterate, keeps the best feasible iterate, and stops the solver."""

    def __init__(self, program: Program) -> None:
        ca.Callback.__init__(self)
        nx, ng, np_ = (program.problem[name].numel() for name in ("x", "g", "p"))
        self._sizes = {"x": nx, "f": 1, "g": ng, "lam_x": nx, "lam_g": ng, "lam_p": np_}
        self._lower, self._upper = program.lower, program.upper
        self._best: Array | None = None
        self.construct("watch", {})

    def begin(self, stop: StopRule) -> None:
        """Discard the iterates of earlier solves, and set the stop conditions of the next solve."""
        self._best, self._least, self._stop, self._iterates = None, math.inf, stop, 0

    def end(self) -> Array | None:
        """Return the best feasible iterate, or None; the stop conditions are released."""
        # They refer to the search, which refers to its solvers.
        del self._stop
        return self._best

    def get_n_in(self) -> int:
        """Return the number of values that a solver reports."""
        return int(ca.nlpsol_n_out())

    def get_n_out(self) -> int:
        """Return 1, the number of outputs; the output says whether to stop."""
        return 1

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        """Return the size of a reported value."""
        return ca.Sparsity.dense(self._sizes[ca.nlpsol_out(i)])

    def has_eval_buffer(self) -> bool:
        """Return True, so that the thousands of iterates are read from the solver's memory."""
        return True

    def eval_buffer(
        self, arguments: tuple[memoryview, ...], results: tuple[memoryview, ...]
    ) -> int:
        """Process an iterate; return whether the solver stops."""
        x, f, g = (np.frombuffer(each) for each in arguments[:3])
        if f[0] < self._least:
            worst = max((self._lower - g).max(), (g - self._upper).max())
            if worst <= _FEASIBILITY_TOLERANCE:
                self._best, self._least = x.copy(), float(f[0])
        self._iterates += 1
        self._stop.watch()
        stops = (
            # The first iterate is the guess itself.
            self._iterates > self._stop.iterations
            or self._stop.cancellation.requested
            or self._stop.is_over(self._best is not None)
        )
        np.frombuffer(results[0])[:] = stops
        return 0
