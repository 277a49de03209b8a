"""The program of a motion under thrust (:mod:`.transcription`), solved by IPOPT."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import casadi as ca
import numpy as np

from spacerobot_ros.model.description import Array
from spacerobot_ros.planning.methods.optimal.multiple_shooting import (
    DurationBounds,
    SolverMonitor,
    StopRule,
    build_solver,
    pack_knots,
)
from spacerobot_ros.planning.methods.optimal.transcription import ConstraintBlock
from spacerobot_ros.planning.methods.thrust.transcription import (
    DEFECT_SIZE,
    ThrustStages,
    thrust_program,
)

_TOLERANCE = 1e-6

_CONTINUED = {
    "ipopt.mu_init": 1e-5,
    "ipopt.tol": 1e-5,
    "ipopt.warm_start_init_point": "yes",
    **{
        f"ipopt.warm_start_{of}": 1e-7
        for of in (
            *("bound_push", "bound_frac", "slack_bound_push", "slack_bound_frac"),
            "mult_bound_push",
        )
    },
}

_OPTIONS: Mapping[str, Mapping[str, object]] = {
    "": {},
    # A shortest time that another time follows from, or a look at what is in the way.
    "rough": {"ipopt.tol": 1e-4, "ipopt.constr_viol_tol": 1e-5},
    # The guess is clear of its planes, or nearly so; planes made anew follow its solution.
    "clear": {
        "ipopt.mu_init": 1e-2,
        "ipopt.bound_push": 1e-3,
        "ipopt.bound_frac": 1e-3,
        "ipopt.tol": 1e-3,
        "ipopt.dual_inf_tol": 1e-1,
    },
    # The guess is a solution with other weights, planes or pairs.
    "continued": _CONTINUED,
    # The guess is a solution with other defects.
    "corrected": {
        **_CONTINUED,
        "ipopt.mu_init": 1e-9,
        "ipopt.constr_viol_tol": 1e-9,
        "ipopt.tol": 1e-8,
    },
}
"""Options of IPOPT by its starting point."""


def state_parts(states: Array) -> list[Array]:
    """Return ``X, L, r, V, q, qdot`` of states (..., 13 + 2 n) as views."""
    return np.split(states, [4, 7, 10, 13, (states.shape[-1] + 13) // 2], axis=-1)


def with_joints_moved(states: Array, time: float) -> Array:
    """Return states whose joints are where they would be in a time at their velocities."""
    moved = states.copy()
    *_, q, qdot = state_parts(moved)
    q += time * qdot
    return moved


@dataclass(frozen=True)
class ThrustKnots:
    """N intervals of ``step`` seconds: states at N + 1 knots, controls of N intervals.

    ``states`` (N + 1, 13 + 2 n) are ``[X; L; r; V; q; qdot]``: the quaternion of R_WB, the angular
    momentum about the centre of mass, N m s, its position and velocity, all in W, and positions and
    velocities of the joints. ``accelerations`` (N, n) are those of the joints, ``levels`` (N, m)
    those of the propulsion. A solution has the multipliers of its variables and of its rows.
    ``defects`` (N, 12) are those of the intervals; None: zero.
    """

    step: float
    states: Array
    accelerations: Array
    levels: Array
    multipliers: tuple[Array, Array] | None = None
    defects: Array | None = None

    @property
    def duration(self) -> float:
        """s."""
        return self.step * len(self.levels)

    def stretched(self, factor: float) -> ThrustKnots:
        """Return the same path in ``factor`` times its duration."""
        X, L, r, V, q, qdot = state_parts(self.states)
        return ThrustKnots(
            self.step * factor,
            np.hstack([X, L / factor, r, V / factor, q, qdot / factor]),
            self.accelerations / factor**2,
            self.levels / factor**2,
        )


@dataclass(frozen=True)
class ThrustBoundary:
    """Both ends of a motion, in W.

    Attributes
    ----------
    start
        (13 + 2 n,) state at the start (:class:`ThrustKnots`).
    goals
        Values that are given at the end (:class:`.EndKind`).
    bounds
        (2, N + 1, 13 + 2 n) least and largest states at the knots, with the vertices of the joints'
        parabolas in place of their positions.
    """

    start: Array
    goals: Array
    bounds: Array


class Weights(NamedTuple):
    """Weights of the terms that a motion minimises.

    They are those of the duration (1/s), of the cost of propulsion, of the squares of joint
    accelerations over their limits, and of those of levels; of the missing distance of pairs (1/m),
    and the level at which the cost of a norm is rounded off.
    """

    duration: float
    cost: float
    accelerations: float
    levels: float
    lack: float = 0.0
    rounding: float = 1.0


class ThrustSolver:
    """Solves the problem of one robot for many boundary conditions.

    Parameters
    ----------
    stages, intervals
        The functions of the problem, and the number of intervals N.
    acceleration
        (n,) largest accelerations of the joints.
    rows, places
        The distances of pairs that are kept apart, and where (:data:`KeptPlaces`).
    """

    def __init__(
        self,
        stages: ThrustStages,
        intervals: int,
        acceleration: Array,
        rows: Sequence[ConstraintBlock] = (),
        places: Sequence[Sequence[int]] = (),
    ) -> None:
        self.stages, self._acceleration = stages, acceleration
        self._layout, self._program = thrust_program(stages, intervals, rows, places)
        program = self._program
        self._rows_of_pairs = sum(map(len, places))
        self._monitor = SolverMonitor(program.problem, program.lower, program.upper)
        self._built: dict[str, ca.Function] = {}

    def _ipopt(self, begins: str) -> ca.Function:
        if begins not in self._built:
            options = {"ipopt.tol": _TOLERANCE, **_OPTIONS[begins]}
            program, monitor = self._program, self._monitor
            self._built[begins] = build_solver("thrust", program, monitor, options)
        return self._built[begins]

    def solve(
        self,
        boundary: ThrustBoundary,
        guess: ThrustKnots,
        weights: Weights,
        stop: StopRule,
        duration: DurationBounds,
        planes: Array | None = None,
        center: ThrustKnots | None = None,
        *,
        rough: bool = False,
        corrected: bool = False,
    ) -> ThrustKnots | None:
        """Return the best motion near ``guess``; None if none.

        The solver continues at a guess that is a solution, also one without the pairs.

        Parameters
        ----------
        boundary, guess, weights
            The problem, and the start of the solver.
        stop, duration
            Conditions on which it stops early, and bounds of the duration.
        planes
            (R, 8) planes of the pairs at their places; None: there are no pairs.
        center
            Controls whose differences are squared; None: zero.
        rough
            Whether another solve starts from the solution.
        corrected
            Whether the guess is a solution with other defects.
        """
        layout, propulsion = self._layout, self.stages.propulsion
        N, most = layout.intervals, self._acceleration
        vertices = with_joints_moved(guess.states, guess.step / 2)
        x0 = pack_knots(layout, guess.step, vertices, guess.accelerations, guess.levels)
        begin = {"x0": x0}
        begins = "clear" if self._rows_of_pairs else "rough" if rough else ""
        if guess.multipliers is not None:
            begins = "corrected" if corrected else "continued"
            begin |= self._known(*guess.multipliers)
        parameters = [
            *(state_parts(boundary.start)[4], boundary.goals),
            propulsion.wrenches.ravel(order="F"),
            np.zeros(DEFECT_SIZE * N) if guess.defects is None else guess.defects.ravel(),
            *(most, np.array(weights)),
            np.zeros(sum(layout.controls) * N)
            if center is None
            else np.hstack([center.accelerations, center.levels]).ravel(),
            np.zeros(0) if planes is None else planes.ravel(),
        ]
        least, largest = (
            pack_knots(layout, span / N, bounds, acceleration, levels)
            for span, bounds, acceleration, levels in (
                (duration.shortest, boundary.bounds[0], -most, propulsion.lowest),
                (duration.longest, boundary.bounds[1], most, np.ones(propulsion.size)),
            )
        )
        if layout.has_lack:
            largest[-1] = np.inf
        solver = self._ipopt(begins)
        self._monitor.begin(stop)
        result = solver(
            **begin,
            lbx=least,
            ubx=largest,
            lbg=self._program.lower,
            ubg=self._program.upper,
            p=np.concatenate(parameters),
        )
        if not solver.stats()["success"]:
            return None
        x, *multipliers = (result[name].full().ravel() for name in ("x", "lam_x", "lam_g"))
        step, (states, accelerations, levels) = float(x[0]), (x[at] for at in layout.knots())
        states = with_joints_moved(states, -step / 2)
        known = multipliers[0], multipliers[1]
        return ThrustKnots(step, states, accelerations, levels, known, guess.defects)

    def _known(self, of_variables: Array, of_rows: Array) -> dict[str, Array]:
        """Return the first multipliers of the solver from those of a solution: of all rows, if it
        has the same ones, else of those without pairs.
        """
        x, g = np.zeros(self._layout.size), np.zeros(len(self._program.lower))
        shared = min(len(x), len(of_variables))
        x[:shared] = of_variables[:shared]
        same = len(g) if len(of_rows) == len(g) else len(g) - self._rows_of_pairs
        g[:same] = of_rows[:same]
        return {"lam_x0": x, "lam_g0": g}
