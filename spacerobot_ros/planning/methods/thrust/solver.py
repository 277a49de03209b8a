"""The program of a motion under thrust (:mod:`.transcription`), solved by IPOPT."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
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
from spacerobot_ros.planning.methods.optimal.problem import MotionLimits
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


@dataclass(frozen=True)
class ThrustKnots:
    """N intervals of ``step`` seconds: states at N + 1 knots, controls of N intervals.

    ``quaternions`` (N + 1, 4) of R_WB; ``shapes``, ``velocities`` (N + 1, n) of the joints;
    ``L_W`` (N + 1, 3) about the centre of mass, N m s; ``r_WC``, ``v_WC`` (N + 1, 3) of the centre
    of mass, m; ``accelerations`` (N, n) and ``levels`` (N, m). A solution has the multipliers of
    its variables and of its rows. ``defects`` (N, 12) are those of the intervals; None: zero.
    """

    step: float
    quaternions: Array
    shapes: Array
    velocities: Array
    L_W: Array
    r_WC: Array
    v_WC: Array
    accelerations: Array
    levels: Array
    multipliers: tuple[Array, Array] | None = None
    defects: Array | None = None

    @property
    def duration(self) -> float:
        """s."""
        return self.step * len(self.levels)

    @property
    def states(self) -> Array:
        """``[X; L; r; V]`` (N + 1, 13)."""
        return np.hstack([self.quaternions, self.L_W, self.r_WC, self.v_WC])

    def stretched(self, factor: float) -> ThrustKnots:
        """Return the same path in ``factor`` times its duration."""
        return replace(
            self,
            step=self.step * factor,
            velocities=self.velocities / factor,
            L_W=self.L_W / factor,
            v_WC=self.v_WC / factor,
            accelerations=self.accelerations / factor**2,
            levels=self.levels / factor**2,
            multipliers=None,
            defects=None,
        )


@dataclass(frozen=True)
class ThrustBoundary:
    """Both ends of a motion, in W.

    Attributes
    ----------
    state, shape, velocity
        ``[X; L; r; V]`` (13,), positions and velocities (n,) of the joints at the start.
    goals
        Values that are given at the end (:class:`.EndKind`).
    shapes, final_shapes
        (2, n) least and largest joint positions on the way and at the end; infinite for joints that
        are free.
    final_velocity, final_momentum
        (n,) velocities of the joints, NaN for those that are free, and angular momentum (3,) at the
        end, where the centre of mass rests: zero, except for wheels that keep spinning. None: the
        momenta are free, too.
    keeps_shape
        Whether joints with a given final position hold it throughout the motion.
    """

    state: Array
    shape: Array
    velocity: Array
    goals: Array
    shapes: Array
    final_shapes: Array
    final_velocity: Array
    final_momentum: Array | None
    keeps_shape: bool = False


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
    rows, places
        The distances of pairs that are kept apart, and where (:data:`KeptPlaces`).
    """

    def __init__(
        self,
        stages: ThrustStages,
        intervals: int,
        rows: Sequence[ConstraintBlock] = (),
        places: Sequence[Sequence[int]] = (),
    ) -> None:
        self.stages, self.intervals = stages, intervals
        self.iterations, self.converged = 0, False
        self.lack = 0.0
        """Distance by which pairs are nearer in the last solution than required, m."""
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
        limits: MotionLimits,
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
        boundary, limits, guess, weights
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
        N, layout, propulsion = self.intervals, self._layout, self.stages.propulsion
        places = layout.knots()
        least, most = np.full(layout.size, -np.inf), np.full(layout.size, np.inf)
        X, s, v, L, r, V, a, u = places
        least[0], most[0] = duration.shortest / N, duration.longest / N
        least[X], most[X] = -1.1, 1.1
        least[s] = np.maximum(limits.lower, boundary.shapes[0])
        most[s] = np.minimum(limits.upper, boundary.shapes[1])
        least[v], most[v] = -limits.velocity, limits.velocity
        least[a], most[a] = -limits.acceleration, limits.acceleration
        least[u], most[u] = propulsion.lowest, 1.0
        start = np.split(boundary.state, [4, 7, 10])
        for place, value in zip((X, L, r, V), start, strict=True):
            least[place[0]] = most[place[0]] = value
        least[v[0]] = most[v[0]] = boundary.velocity
        if boundary.final_momentum is not None:
            least[V[N]] = most[V[N]] = 0.0
            least[L[N]] = most[L[N]] = boundary.final_momentum
        given = np.isfinite(boundary.final_velocity)
        least[v[N, given]] = most[v[N, given]] = boundary.final_velocity[given]
        if layout.has_lack:
            least[-1] = 0.0
        least[s[N]] = np.maximum(least[s[N]], boundary.final_shapes[0])
        most[s[N]] = np.minimum(most[s[N]], boundary.final_shapes[1])
        if boundary.keeps_shape:
            # Both ends are given by other rows.
            held = np.isfinite(boundary.final_shapes[0])
            least[s[1 : N - 1, held]] = most[s[1 : N - 1, held]] = boundary.shape[held]
        x0 = pack_knots(
            layout,
            guess.step,
            *(guess.quaternions, guess.shapes + guess.step * guess.velocities / 2),
            *(guess.velocities, guess.L_W, guess.r_WC, guess.v_WC),
            *(guess.accelerations, guess.levels),
        )
        begin = {"x0": x0}
        begins = "clear" if self._rows_of_pairs else "rough" if rough else ""
        if guess.multipliers is not None:
            begins = "corrected" if corrected else "continued"
            begin |= self._known(*guess.multipliers)
        solver = self._ipopt(begins)
        self._monitor.begin(stop)
        defects = np.zeros((N, DEFECT_SIZE)) if guess.defects is None else guess.defects
        parameters = np.concatenate(
            [
                *(boundary.shape, boundary.goals, propulsion.wrenches.ravel(order="F")),
                *(defects.ravel(), limits.acceleration, list(weights)),
                np.hstack([center.accelerations, center.levels]).ravel()
                if center is not None
                else np.zeros(a.size + u.size),
                np.zeros(0) if planes is None else planes.ravel(),
            ]
        )
        result = solver(
            **begin,
            lbx=least,
            ubx=most,
            lbg=self._program.lower,
            ubg=self._program.upper,
            p=parameters,
        )
        stats = solver.stats()
        self.iterations, self.converged = int(stats["iter_count"]), bool(stats["success"])
        x = result["x"].full().ravel()
        if not self.converged:
            if self._monitor.best is None:
                return None
            x = self._monitor.best
        X_, s_, v_, L_, r_, V_, a_, u_ = (x[place] for place in places)
        h, self.lack = float(x[0]), float(x[-1]) if layout.has_lack else 0.0
        known = tuple(result[each].full().ravel() for each in ("lam_x", "lam_g"))
        multipliers = (known[0], known[1]) if self.converged else None
        shapes = s_ - h * v_ / 2
        return ThrustKnots(h, X_, shapes, v_, L_, r_, V_, a_, u_, multipliers, guess.defects)

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
