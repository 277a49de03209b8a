"""Solutions of the optimal control problem (:mod:`.transcription`) by IPOPT."""

from __future__ import annotations

import math
import os
import time

import casadi as ca
import numpy as np

from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.planning.core.cancellation import NEVER, Cancellation
from spacerobot_ros.planning.methods.optimal.constraints import PathConstraints
from spacerobot_ros.planning.methods.optimal.limits import MotionLimits
from spacerobot_ros.planning.methods.optimal.trajectory import Task, Trajectory
from spacerobot_ros.planning.methods.optimal.transcription import GAUSS, Transcription

_FEASIBLE = 1e-4
"""Violation of the constraints below which an iterate counts as a trajectory, SI units."""

_OPTIONS = {
    "print_time": False,
    "ipopt.print_level": 0,
    "ipopt.sb": "yes",
    "ipopt.linear_solver": "mumps",
    "ipopt.mu_strategy": "adaptive",
    "ipopt.tol": 1e-4,
    "ipopt.constr_viol_tol": 1e-6,
    "ipopt.max_iter": 1000,
}


class ManoeuvreProblem:
    """The problem of one robot, for many tasks; parameters are those of :class:`Transcription`."""

    def __init__(
        self,
        robot: SpaceRobot,
        intervals: int,
        axes: Array,
        position: bool,
        constraints: PathConstraints,
    ) -> None:
        self.robot = robot
        self.intervals = intervals
        self._program = Transcription(robot, intervals, axes, position, constraints).program()
        # The solver's matrices are small: threads of its linear algebra would wait for each other.
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
        self._watch = _Watch(self._program.problem, self._program.lower, self._program.upper)
        self._solver = ca.nlpsol(
            "manoeuvre",
            "ipopt",
            self._program.problem,
            {
                **_OPTIONS,
                "jac_g": self._program.jac_g,
                "hess_lag": self._program.hess_lag,
                "iteration_callback": self._watch,
            },
        )

    @property
    def iterations(self) -> int:
        """Steps that the last solution took."""
        return int(self._solver.stats()["iter_count"])

    @property
    def converged(self) -> bool:
        """Whether the last solution is one, and not what the search was cut short at."""
        return bool(self._solver.stats()["success"])

    def solve(
        self,
        task: Task,
        limits: MotionLimits,
        guess: Trajectory,
        *,
        deadline: float,
        last_call: float,
        shortest: float,
        longest: float,
        effort: bool = False,
        cancellation: Cancellation = NEVER,
    ) -> Trajectory | None:
        """Return the fastest trajectory near ``guess``, or that of least effort; None if none.

        Parameters
        ----------
        deadline
            ``time.monotonic()`` at which to stop if anything feasible was seen.
        last_call
            ``time.monotonic()`` at which to stop whatever was seen.
        shortest, longest
            Bounds of the duration, s; equal for least effort in a given time.
        cancellation
            Stops the solver at its next step.
        effort
            Whether the mean square of the accelerations, over the joints' speeds, is minimised.
        """
        n, N = self.robot.n, self.intervals
        lower, upper = (np.tile(x, (N + 1, 1)) for x in (limits.lower, limits.upper))
        lower[0] = upper[0] = task.start
        if task.final is not None:
            lower[N] = upper[N] = task.final
        fastest = np.tile(limits.velocity, (N + 1, 1))
        anything = np.full((N + 1, n), np.inf)
        fastest[[0, N]] = anything[[0, N]] = 0.0
        turned, rates = np.full((N + 1, 4), 1.1), np.full((len(GAUSS) * N, 3), np.inf)
        identity = np.array([0.0, 0.0, 0.0, 1.0])
        bounds = fastest, anything, turned, rates
        least = _packed(shortest / N, lower, *(-bound for bound in bounds))
        most = _packed(longest / N, upper, *bounds)
        first = 1 + 3 * n * (N + 1)
        least[first : first + 4] = most[first : first + 4] = identity
        self._watch.begin(deadline, last_call, cancellation)
        result = self._solver(
            x0=self._start(guess),
            lbx=least,
            ubx=most,
            lbg=self._program.lower,
            ubg=self._program.upper,
            p=_parameters(task, limits, guess if effort else None),
        )
        x = result["x"].full().ravel()
        if not self.converged:
            if self._watch.best is None:
                return None
            x = self._watch.best
        return self._trajectory(x)

    def _start(self, guess: Trajectory) -> Array:
        """Return the variables of a guess."""
        h = guess.step
        steps = h * guess.velocities
        A = self.robot.function("connection", compile=False)
        rates = []
        for tau in GAUSS:
            now, later = steps[:-1], steps[1:]
            shapes = guess.shapes[:-1] + tau * now + tau**2 / 2 * (later - now)
            F = -A(shapes.T).full()[3:].reshape(3, len(shapes), -1)
            rates.append(np.einsum("akj,kj->ka", F, now + tau * (later - now)))
        return _packed(h, guess.shapes, guess.velocities, steps, guess.quaternions, *rates)

    def _trajectory(self, x: Array) -> Trajectory:
        n, knots = self.robot.n, self.intervals + 1
        ends = 1 + np.cumsum([n * knots, n * knots, n * knots, 4 * knots])
        _, shapes, velocities, _, quaternions, _ = np.split(x, [1, *ends])
        return Trajectory(
            float(x[0]),
            shapes.reshape(knots, n),
            velocities.reshape(knots, n),
            quaternions.reshape(knots, 4),
        )


def _parameters(task: Task, limits: MotionLimits, gentle: Trajectory | None) -> Array:
    typical = np.where(np.isfinite(limits.velocity), limits.velocity, limits.acceleration)
    weights = np.array([1.0, 0.0])
    if gentle is not None:
        # In units of the guess, so that the solver sees numbers of about one.
        change = np.diff(gentle.velocities, axis=0) / gentle.step / typical
        weights = np.array([0.0, 1.0 / max(float(np.sum(change**2)) / len(change), 1e-300)])
    # Joints without an end of stroke are not asked about it: zeros stand for it.
    ends = (np.nan_to_num(x, posinf=0.0, neginf=0.0) for x in (limits.lower, limits.upper))
    center = np.zeros(3) if task.center is None else task.center
    return np.concatenate(
        [limits.acceleration, task.turn, task.direction, center, *ends, typical, weights]
    )


def _packed(step: float, *knots: Array) -> Array:
    # Row by row is knot by knot: the columns of CasADi's matrices.
    return np.concatenate([[step], *(rows.ravel() for rows in knots)])


class _Watch(ca.Callback):
    """Sees every iterate: keeps the best feasible one; stops at the deadline, or cancelled."""

    def __init__(self, problem: dict[str, ca.MX], lower: Array, upper: Array) -> None:
        ca.Callback.__init__(self)
        nx, ng, np_ = (problem[name].numel() for name in ("x", "g", "p"))
        self._sizes = {"x": nx, "f": 1, "g": ng, "lam_x": nx, "lam_g": ng, "lam_p": np_}
        self._lower, self._upper = lower, upper
        self.best: Array | None = None
        self.construct("watch", {})

    def begin(self, deadline: float, last_call: float, cancellation: Cancellation) -> None:
        """Forget the problem before."""
        self.best, self._least = None, math.inf
        self._deadline, self._last_call = deadline, last_call
        self._cancellation = cancellation

    def get_n_in(self) -> int:
        """Return the number of what a solver reports."""
        return int(ca.nlpsol_n_out())

    def get_n_out(self) -> int:
        """Return one: whether to stop."""
        return 1

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        """Return the size of a report."""
        return ca.Sparsity.dense(self._sizes[ca.nlpsol_out(i)])

    def eval(self, arguments: list[ca.DM]) -> list[float]:
        """Look at an iterate."""
        f = float(arguments[1])
        if f < self._least:
            g = arguments[2].full().ravel()
            worst = max(float((self._lower - g).max()), float((g - self._upper).max()))
            if worst <= _FEASIBLE:
                self.best, self._least = arguments[0].full().ravel(), f
        stop = self._last_call if self.best is None else self._deadline
        return [float(time.monotonic() > stop or self._cancellation.requested)]
