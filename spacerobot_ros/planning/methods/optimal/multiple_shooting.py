"""Direct multiple shooting: the optimal control problem as a nonlinear program, solved by IPOPT.

Knots k = 0..N carry shape q, velocity v, step ``u = h v`` and attitude X; between them the
acceleration is constant, and all steps take the same time h, which is free:

``q+ = q + (u + u+)/2``, ``|v+ - v| <= h a_max``, ``X+ = X exp(Omega)``.

Omega is the Magnus expansion, order four, of the rates at two Gauss points of the step, where
momentum is zero: ``D(q) w + D_q(q) u = 0`` (paper 1, eq. 3). So the attitude follows from the path
of the shape, however fast it is travelled, and the base's position needs no state: the centre of
mass rests, and the last shape and attitude tell where the base is.

All of the robot is in the momentum, at shapes and steps that are linear in the variables. Its
derivatives are made once for one point, with shared subexpressions, and put in their places;
differentiating the whole program by sweeps takes four times as long for a six-joint arm.

Method: H. G. Bock and K. J. Plitt, "A multiple shooting algorithm for direct solution of optimal
control problems", IFAC World Congress, 1984.
"""

from __future__ import annotations

import math
import os
import time
from dataclasses import dataclass

import casadi as ca
import numpy as np

from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.dynamics import solve_positive_definite
from spacerobot_ros.model.symbolic_rotations import (
    quaternion_from_small_rotvec,
    quaternion_multiply,
    relative_vector,
)
from spacerobot_ros.planning.core.cancellation import NEVER, Cancellation
from spacerobot_ros.planning.methods.optimal.problem import (
    BoundaryConditions,
    MotionLimits,
    PathConstraints,
    Trajectory,
)

GAUSS = (0.5 - math.sqrt(3) / 6, 0.5 + math.sqrt(3) / 6)
"""Gauss points of a step, from 0 to 1."""

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
}


@dataclass(frozen=True)
class Program:
    """Functions of variables x and parameters p, as IPOPT takes them; the bounds are those of g."""

    problem: dict[str, ca.MX]
    jac_g: ca.Function
    hess_lag: ca.Function
    lower: Array
    upper: Array


class Transcription:
    """Builds the program of one robot.

    Parameters
    ----------
    robot, intervals
        The model, and the number of steps N.
    axes
        (m, 3) directions in the base along which the attitude is to be reached.
    position
        Whether the centre of mass is to end at ``center`` in the base.
    constraints
        What the path must keep.
    """

    def __init__(
        self,
        robot: SpaceRobot,
        intervals: int,
        axes: Array,
        position: bool,
        constraints: PathConstraints,
    ) -> None:
        self._robot, self._axes, self._position = robot, axes, position
        self._constraints = constraints
        n, N = robot.n, intervals
        self._N = N
        self._h = ca.MX.sym("h")
        self._q, self._v, self._u = (ca.MX.sym(name, n, N + 1) for name in ("q", "v", "u"))
        self._X = ca.MX.sym("X", 4, N + 1)
        self._w = [ca.MX.sym(f"w_{i}", 3, N) for i in range(len(GAUSS))]
        parts = (self._h, self._q, self._v, self._u, self._X, *self._w)
        self._x = ca.vertcat(*(ca.vec(part) for part in parts))
        self._a_max, self._turn = ca.MX.sym("a_max", n), ca.MX.sym("turn", 4)
        self._direction, self._center = ca.MX.sym("direction", 3), ca.MX.sym("center", 3)
        self._typical = ca.MX.sym("typical", n)
        self._weights = ca.MX.sym("weights", 2)
        self._lower, self._upper = ca.MX.sym("lower", n), ca.MX.sym("upper", n)
        self._p = ca.vertcat(
            self._a_max,
            self._turn,
            self._direction,
            self._center,
            self._lower,
            self._upper,
            self._typical,
            self._weights,
        )

    def program(self) -> Program:
        """Return the program."""
        x, p = self._x, self._p
        f = self._objective()
        equality, inequality = self._equality_constraints(), self._inequality_constraints()
        # Shape, step and rate at all Gauss points, points one after the other: linear in x.
        at_points = self._at_points()
        select = _constant_jacobian(at_points, x)
        size = 2 * self._robot.n + 3
        points = ca.reshape(at_points, size, -1)
        momentum, momentum_jac, momentum_hess = self._momentum()
        count = points.shape[1]
        left = momentum.map(count)(points)
        g = ca.vertcat(equality, ca.vec(left), inequality)

        jac_blocks = ca.horzsplit(momentum_jac.map(count)(points), size)
        jac = ca.vertcat(
            ca.jacobian(equality, x), ca.diagcat(*jac_blocks) @ select, ca.jacobian(inequality, x)
        )
        lam_f, lam_g = ca.MX.sym("lam_f"), ca.MX.sym("lam_g", g.shape[0])
        equalities = equality.shape[0]
        splits = [0, equalities, equalities + 3 * count, g.shape[0]]
        lam_equality, lam_momentum, lam_inequality = ca.vertsplit(lam_g, splits)
        plain = lam_f * f + ca.dot(lam_equality, equality) + ca.dot(lam_inequality, inequality)
        hess_blocks = ca.horzsplit(
            momentum_hess.map(count)(points, ca.reshape(lam_momentum, 3, count)), size
        )
        hessian = ca.hessian(plain, x)[0] + select.T @ ca.diagcat(*hess_blocks) @ select
        lower = np.zeros(g.shape[0])
        upper = np.where(np.arange(len(lower)) < splits[2], 0.0, np.inf)
        return Program(
            {"x": x, "p": p, "f": f, "g": g},
            ca.Function("jac_g", [x, p], [g, jac]),
            ca.Function("hess_lag", [x, p, lam_f, lam_g], [ca.triu(hessian)]),
            lower,
            upper,
        )

    def _objective(self) -> ca.MX:
        change = self._v[:, 1:] - self._v[:, :-1]
        work = ca.sumsqr(change / ca.repmat(self._typical, 1, self._N)) / (self._N * self._h**2)
        return self._weights[0] * self._N * self._h + self._weights[1] * work

    def _equality_constraints(self) -> ca.MX:
        q, u, X = self._q, self._u, self._X
        X_next = _step().map(self._N)(X[:, :-1], *self._w)
        parts = [
            q[:, 1:] - q[:, :-1] - (u[:, :-1] + u[:, 1:]) / 2,
            u[:, 1:-1] - self._h * self._v[:, 1:-1],
            X[:, 1:] - X_next,
            ca.DM(self._axes) @ relative_vector(self._turn, X[:, -1]),
        ]
        if self._position:
            center_of_mass = self._robot.function("center_of_mass", compile=False)
            parts.append(center_of_mass(q[:, -1]) - self._center)
        return ca.vertcat(*(ca.vec(part) for part in parts))

    def _inequality_constraints(self) -> ca.MX:
        q, v, X, N = self._q, self._v, self._X, self._N
        change, bound = v[:, 1:] - v[:, :-1], ca.repmat(self._a_max * self._h, 1, N)
        # With the knots, the control points of the parabolas keep these within the joint limits.
        control = q[:, :-1] + self._u[:, :-1] / 2
        below, above = (
            np.flatnonzero(np.isfinite(ends)).tolist()
            for ends in (self._robot.lower, self._robot.upper)
        )
        parts = [
            bound - change,
            bound + change,
            control[below, :] - ca.repmat(self._lower[below, :], 1, N),
            ca.repmat(self._upper[above, :], 1, N) - control[above, :],
        ]
        if self._constraints.on_knots:
            kept = self._keeps().map(N - 1)
            parts.append(kept(q[:, 1:-1], X[:, 1:-1], ca.repmat(self._direction, 1, N - 1)))
        if self._constraints.base_rate > 0:
            # Rates change steadily within a step and are largest at its ends.
            fastest = self._h * self._constraints.imposed_base_rate
            first, second = self._w
            for end in (0.0, 1.0):
                w = first + (end - GAUSS[0]) / (GAUSS[1] - GAUSS[0]) * (second - first)
                parts.append(1 - ca.sum1((w / fastest) ** 2))
        return ca.vertcat(*(ca.vec(part) for part in parts))

    def _at_points(self) -> ca.MX:
        q, now, later = self._q[:, :-1], self._u[:, :-1], self._u[:, 1:]
        points = [
            ca.vertcat(q + tau * now + tau**2 / 2 * (later - now), now + tau * (later - now), w)
            for tau, w in zip(GAUSS, self._w, strict=True)
        ]
        return ca.vec(ca.horzcat(*points))

    def _momentum(self) -> tuple[ca.Function, ca.Function, ca.Function]:
        """Return the momentum (3,) of ``[q; u; w]``, its Jacobian, and a multiplier's Hessian."""
        locked_inertia = self._robot.function("locked_inertia", compile=False)
        n = self._robot.n
        point, multiplier = ca.SX.sym("point", 2 * n + 3), ca.SX.sym("multiplier", 3)
        D, D_q = locked_inertia(point[:n])
        # About one, whatever the robot's size.
        typical = float(np.trace(locked_inertia(np.zeros(n))[0].full())) / 3
        momentum = ca.cse((D @ point[2 * n :] + D_q @ point[n : 2 * n]) / typical)
        jacobian = ca.cse(ca.densify(ca.jacobian(momentum, point)))
        hessian = ca.hessian(ca.dot(multiplier, momentum), point)[0]
        return (
            ca.Function("momentum", [point], [momentum]),
            ca.Function("momentum_jac", [point], [jacobian]),
            ca.Function("momentum_hess", [point, multiplier], [ca.cse(ca.densify(hessian))]),
        )

    def _keeps(self) -> ca.Function:
        q, X, direction = ca.SX.sym("q", self._robot.n), ca.SX.sym("X", 4), ca.SX.sym("d", 3)
        return ca.Function(
            "keeps", [q, X, direction], [self._constraints.symbolic(q, X, direction)]
        )


def magnus(first: ca.SX, second: ca.SX) -> ca.SX:
    """Return the rotation vector (3,) of a step from its rotations at the two Gauss points."""
    return (first + second) / 2 + math.sqrt(3) / 12 * ca.cross(first, second)


def _step() -> ca.Function:
    """Return ``(X, w_1, w_2) -> X+``."""
    X, first, second = ca.SX.sym("X", 4), ca.SX.sym("w_1", 3), ca.SX.sym("w_2", 3)
    X_next = quaternion_multiply(X, quaternion_from_small_rotvec(magnus(first, second)))
    return ca.Function("step", [X, first, second], [ca.cse(X_next)])


def _constant_jacobian(expression: ca.MX, x: ca.MX) -> ca.DM:
    """Return the Jacobian of an expression that is linear in x."""
    return ca.Function("linear", [x], [ca.jacobian(expression, x)])(0)


def turn_function(robot: SpaceRobot) -> ca.Function:
    """Return ``(q, u, u+) -> Omega`` (3,): the rotation vector of a step, base components."""
    locked_inertia = robot.function("locked_inertia", compile=False)
    q, u, u_next = (ca.SX.sym(name, robot.n) for name in ("q", "u", "u_next"))

    def rotation(tau: float) -> ca.SX:
        D, D_q = locked_inertia(q + tau * u + tau**2 / 2 * (u_next - u))
        return -solve_positive_definite(D, D_q @ (u + tau * (u_next - u)))

    return ca.Function("turn", [q, u, u_next], [ca.cse(magnus(*map(rotation, GAUSS)))])


@dataclass(frozen=True)
class StopRule:
    """When a solver stops before it has converged.

    Attributes
    ----------
    iterations
        Steps that it takes at most.
    cancellation
        Stops it at its next iterate.
    deadline, last_call
        ``time.monotonic()``, s, at which it stops with a feasible iterate, and without one;
        infinite where no wall time limits the search.
    """

    iterations: int
    cancellation: Cancellation = NEVER
    deadline: float = math.inf
    last_call: float = math.inf

    def expired(self, *, found: bool) -> bool:
        """Whether the wall time is used up; ``found``: there is a feasible iterate."""
        end = self.deadline if found else self.last_call
        return end < math.inf and time.monotonic() > end


class MultipleShooting:
    """Solves the problem of one robot for many boundary conditions.

    Parameters are those of :class:`Transcription`.
    """

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
        boundary: BoundaryConditions,
        limits: MotionLimits,
        guess: Trajectory,
        stop: StopRule,
        *,
        shortest: float,
        longest: float,
        least_effort: bool = False,
    ) -> Trajectory | None:
        """Return the fastest trajectory near ``guess``, or that of least effort; None if none.

        Parameters
        ----------
        boundary, limits, guess
            The problem, and where the solver begins.
        stop
            When the solver stops early.
        shortest, longest
            Bounds of the duration, s; equal for least effort in a given time.
        least_effort
            Whether the mean square of the accelerations, over the joints' speeds, is minimised.
        """
        n, N = self.robot.n, self.intervals
        lower, upper = (np.tile(x, (N + 1, 1)) for x in (limits.lower, limits.upper))
        lower[0] = upper[0] = boundary.start
        if boundary.final is not None:
            lower[N] = upper[N] = boundary.final
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
        self._watch.begin(stop)
        result = self._solver(
            x0=self._start(guess),
            lbx=least,
            ubx=most,
            lbg=self._program.lower,
            ubg=self._program.upper,
            p=_parameters(boundary, limits, guess if least_effort else None),
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


def _parameters(
    boundary: BoundaryConditions, limits: MotionLimits, gentle: Trajectory | None
) -> Array:
    typical = np.where(np.isfinite(limits.velocity), limits.velocity, limits.acceleration)
    weights = np.array([1.0, 0.0])
    if gentle is not None:
        # In units of the guess, so that the solver sees numbers of about one.
        change = np.diff(gentle.velocities, axis=0) / gentle.step / typical
        weights = np.array([0.0, 1.0 / max(float(np.sum(change**2)) / len(change), 1e-300)])
    # Joints without limits are not constrained by them: zeros stand for them.
    ends = (np.nan_to_num(x, posinf=0.0, neginf=0.0) for x in (limits.lower, limits.upper))
    center = np.zeros(3) if boundary.center is None else boundary.center
    return np.concatenate(
        [limits.acceleration, boundary.turn, boundary.direction, center, *ends, typical, weights]
    )


def _packed(step: float, *knots: Array) -> Array:
    # Row by row is knot by knot: the columns of CasADi's matrices.
    return np.concatenate([[step], *(rows.ravel() for rows in knots)])


class _Watch(ca.Callback):
    """Receives every iterate: keeps the best feasible one, and stops the solver."""

    def __init__(self, problem: dict[str, ca.MX], lower: Array, upper: Array) -> None:
        ca.Callback.__init__(self)
        nx, ng, np_ = (problem[name].numel() for name in ("x", "g", "p"))
        self._sizes = {"x": nx, "f": 1, "g": ng, "lam_x": nx, "lam_g": ng, "lam_p": np_}
        self._lower, self._upper = lower, upper
        self.best: Array | None = None
        self.construct("watch", {})

    def begin(self, stop: StopRule) -> None:
        """Begin with the next problem."""
        self.best, self._least, self._stop, self._iterates = None, math.inf, stop, 0

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
        self._iterates += 1
        stops = (
            # The first iterate is the guess itself.
            self._iterates > self._stop.iterations
            or self._stop.cancellation.requested
            or self._stop.expired(found=self.best is not None)
        )
        return [float(stops)]
