"""Direct multiple shooting: the optimal control problem as a nonlinear program, stage by stage.

Each knot k = 0..N contains an attitude X, a joint velocity v and a vertex s. The control of
interval k is its constant joint acceleration a. All intervals take the same time h, which is free.
In each interval, the shape runs from ``q_k = s_k - h v_k / 2`` to ``q_{k+1}`` along a parabola
whose tangents at both ends meet in the vertex ``s_k``. As the parabola lies in the triangle of
these points, simple bounds on s also enforce the joint limits between the knots. The dynamics are

``v+ = v + h a``, ``s+ = s + h v+``, ``X+ = X exp(Omega(s, h v, h v+))``.

Omega is the fourth-order Magnus expansion of the rates at two Gauss points of the interval; at zero
momentum, ``D(q) w + D_q(q) u = 0`` (paper 1, eq. 3). So the attitude follows from the shape path at
any speed, and the base position needs no state: the final shape and attitude determine it.

If a robot drifts, its angular momentum L about the centre of mass is constant in the world, so
``D(q) w + D_q(q) u = h X' L_0``, with L_0 in the initial base frame. X at a Gauss point is the
weighted mean of the quaternions at both knots, normalised, so the attitude is only second-order
accurate. These functions are derived only if a robot drifts.

All stages share their functions, whose derivatives are inserted into sparse matrices.

Method: H. G. Bock and K. J. Plitt, "A multiple shooting algorithm for direct solution of optimal
control problems", IFAC World Congress, 1984.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import pairwise

import casadi as ca
import numpy as np
import numpy.typing as npt

from spacerobot_ros.collision.planes import PLANE_SIZE, PlaneDistances
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.compilation import cached_function, compiled, source_hash
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.dynamics import momentum_derivatives, solve_positive_definite
from spacerobot_ros.model.symbolic_rotations import (
    quaternion_from_small_rotvec,
    quaternion_multiply,
    relative_vector,
)
from spacerobot_ros.planning.methods.optimal.problem import PathConstraints

GAUSS = (0.5 - math.sqrt(3) / 6, 0.5 + math.sqrt(3) / 6)
"""Gauss points of an interval, from 0 to 1."""

_DIRECTION_SIZE = 3
"""Number of components of ``keep_direction``, the first parameter of an interval."""

_LEAST_MULTIPLIER = 3e-2
"""Multiplier below which a distance has no effect, in durations or efforts (of about one) per m."""

Indices = npt.NDArray[np.int64]


@dataclass(frozen=True)
class ConstraintBlock:
    """Program rows that depend on a few variables z, with their derivatives.

    ``values`` is ``(z, p) -> g``, ``jacobian`` ``(z, p) -> g, J`` and ``hessian``
    ``(z, p, lambda) -> H``, the upper triangle of the Hessian of ``lambda' g``.
    """

    values: ca.Function
    jacobian: ca.Function
    hessian: ca.Function

    @property
    def rows(self) -> int:
        """Number of rows."""
        return int(self.values.size1_out(0))

    @classmethod
    def of(cls, name: str, z: ca.SX, p: ca.SX, g: ca.SX) -> ConstraintBlock:
        """Differentiate ``g`` (SX)."""
        multiplier = ca.SX.sym("lambda", g.shape[0])
        hessian = ca.hessian(ca.dot(multiplier, g), z)[0]
        return cls.with_derivatives(name, z, p, multiplier, g, ca.jacobian(g, z), hessian)

    @classmethod
    def cached(
        cls, name: str, facts: Sequence[str], derive: Callable[[], ConstraintBlock]
    ) -> ConstraintBlock:
        """Return a block from the cache, or derive it; the block depends only on ``facts``."""
        key, derived = hashlib.sha256("\n".join(facts).encode()).hexdigest(), cache(derive)
        jacobian = cached_function(f"{name}_jac", key, lambda: derived().jacobian)
        hessian = cached_function(f"{name}_hess", key, lambda: derived().hessian)
        return cls(cached_function(name, key, lambda: derived().values), jacobian, hessian)

    def compiled(self, *, builds: bool = True) -> ConstraintBlock:
        """Return the block with compiled derivatives; see :func:`.compiled`."""
        jacobian, hessian = (
            compiled(each, builds=builds) for each in (self.jacobian, self.hessian)
        )
        return replace(self, jacobian=jacobian, hessian=hessian)

    @classmethod
    def with_derivatives(
        cls,
        name: str,
        z: ca.SX,
        p: ca.SX,
        multiplier: ca.SX,
        g: ca.SX,
        J: ca.SX,
        H: ca.SX,
        *,
        repetitive: bool = True,
    ) -> ConstraintBlock:
        """Set the rows and derivatives; if ``repetitive``, find common subexpressions."""
        g, H = ca.densify(g), ca.triu(H)
        of_values, of_jacobian, of_hessian = (
            ca.cse(each) if repetitive else each for each in ([g], [g, J], [H])
        )
        return cls(
            ca.Function(name, [z, p], of_values),
            ca.Function(f"{name}_jac", [z, p], of_jacobian),
            ca.Function(f"{name}_hess", [z, p, multiplier], of_hessian),
        )


@dataclass(frozen=True)
class Stages:
    """Functions of one robot's problem, for any number of intervals.

    Attributes
    ----------
    joints
        n.
    beginning, interval, end
        Rows for the first knot, for two neighbouring knots, and for the last knot.
    path_row_count
        Number of inequality rows (``>= 0``) in the interval, which come last.
    rotation_of_step
        Rotation vector (3,) of a step (:func:`turn_function`).
    distances
        Distances of pairs from planes in an interval, plus a lack variable: rows ``>= 0``.
    """

    joints: int
    beginning: ConstraintBlock
    interval: ConstraintBlock
    end: ConstraintBlock
    path_row_count: int
    rotation_of_step: ca.Function
    distances: ConstraintBlock | None = None

    @property
    def drifting(self) -> bool:
        """Whether the angular momentum is an interval parameter; otherwise it is zero."""
        return self.interval.values.numel_in(1) > _DIRECTION_SIZE

    @classmethod
    def of(
        cls,
        robot: SpaceRobot,
        axes: Array,
        position: bool,
        constraints: PathConstraints,
        *,
        inequality: ca.Function | None = None,
        end_effectors: ca.Function | None = None,
        drifting: bool = False,
    ) -> Stages:
        """Derive the functions for a robot's problem, or read them from the cache.

        Parameters
        ----------
        robot
            The model.
        axes
            (m, 3) directions in the base frame along which the attitude must be reached.
        position
            Whether the centre of mass must end at ``center``, base components.
        constraints
            Constraints of the path.
        inequality
            Of SX: shape, velocities and accelerations of the joints, each (n,), and, if the robot
            drifts, its angular momentum (3,) about the centre of mass in the base. Its rows are
            nonnegative at both ends of every interval; None: there are none.
        end_effectors
            Of SX: ``(rotation (4,), shape (n,), parameters)``, rows that vanish at the end.
        drifting
            Whether the angular momentum is a parameter; else it is zero.
        """
        n = robot.n
        X, s = ca.SX.sym("X", 4), ca.SX.sym("s", n)
        turn, center = ca.SX.sym("turn", 4), ca.SX.sym("center", 3)
        reached = [ca.DM(axes) @ relative_vector(turn, X)]
        if position:
            center_of_mass = robot.function("center_of_mass", compile=False)
            reached.append(center_of_mass(s) - center)
        p = [turn, center]
        if end_effectors is not None:
            p.append(ca.SX.sym("end_effectors", end_effectors.size1_in(2)))
            reached.append(end_effectors(X, s, p[-1]))
        ends = ConstraintBlock.of("end", ca.vertcat(X, s), ca.vertcat(*p), ca.vertcat(*reached))
        direction = ca.SX.sym("direction", _DIRECTION_SIZE)
        on_knots = constraints.symbolic(s, X, direction)
        facts = [
            *dynamics_facts(robot),
            float(constraints.imposed_base_rate).hex(),
            ca.Function("on_knots", [s, X, direction], [on_knots]).serialize(),
            "" if inequality is None else inequality.serialize(),
            f"drifting {drifting}",
        ]
        derive = partial(_interval_block, robot, constraints, inequality, drifting=drifting)
        interval = ConstraintBlock.cached("interval", facts, derive)
        path = interval.rows - (2 * n + 4)
        turn = turn_function(robot, drifting=drifting)
        return cls(n, beginning_block(n), interval, ends, path, turn)

    def with_distances(self, rows: PlaneDistances, instants: int) -> Stages:
        """Return the problem that also keeps link pairs apart, at several instants per interval."""
        return replace(self, distances=_distance_block(self.joints, rows, instants))


def dynamics_facts(robot: SpaceRobot, *modules: str) -> tuple[str, str]:
    """Return what the dynamics of an interval depend on: the sources of these functions and of
    other modules, and a robot's equations.
    """
    sources = momentum_derivatives, solve_positive_definite, quaternion_multiply
    names = (__name__, *(each.__module__ for each in sources), *modules)
    return source_hash(*names), robot.equations_key


def beginning_block(joints: int) -> ConstraintBlock:
    """Return the rows for the first knot, in ``[h; s; v]``: the shape there is the start (n,)."""
    h, s, v = ca.SX.sym("h"), ca.SX.sym("s", joints), ca.SX.sym("v", joints)
    start = ca.SX.sym("start", joints)
    return ConstraintBlock.of("beginning", ca.vertcat(h, s, v), start, s - h * v / 2 - start)


def _interval_block(
    robot: SpaceRobot,
    constraints: PathConstraints,
    inequality: ca.Function | None,
    *,
    drifting: bool,
) -> ConstraintBlock:
    """Return the dynamics of an interval, then its path constraints."""
    n = robot.n
    X, s, v, a = (ca.SX.sym(name, size) for name, size in zip("Xsva", (4, n, n, n), strict=True))
    X_next, s_next, v_next = ca.SX.sym("X+", 4), ca.SX.sym("s+", n), ca.SX.sym("v+", n)
    h, direction = ca.SX.sym("h"), ca.SX.sym("direction", _DIRECTION_SIZE)
    L_0 = ca.SX.sym("L_0", 3 if drifting else 0)
    z = ca.vertcat(h, X, s, v, a, X_next, s_next, v_next)
    points = [state_within_interval(tau, s, h * v, h * v_next) for tau in GAUSS]
    if drifting:
        points = [
            ca.vertcat(point, h * momentum_in_base(tau, X, X_next, L_0))
            for tau, point in zip(GAUSS, points, strict=True)
        ]
    attitude = AttitudeRows.of(
        z, X, X_next, points, rotation_with_derivatives(robot, drifting=drifting)
    )
    motion = ca.vertcat(v_next - v - h * a, s_next - s - h * v_next)

    kept = _path_constraint_rows(n, constraints, inequality, z, attitude.rotations, direction, L_0)
    by_motion, by_path = ca.SX.sym("lambda_v", 2 * n), ca.SX.sym("lambda_g", kept.shape[0])
    plain = ca.dot(by_motion, motion) + ca.dot(by_path, kept)
    return ConstraintBlock.with_derivatives(
        "interval",
        z,
        ca.vertcat(direction, L_0),
        ca.vertcat(by_motion, attitude.multiplier, by_path),
        ca.vertcat(motion, attitude.rows, kept),
        ca.vertcat(ca.jacobian(motion, z), attitude.jacobian, ca.jacobian(kept, z)),
        ca.hessian(plain, z)[0] + attitude.hessian,
        repetitive=kept.numel() > 0,
    )


@dataclass(frozen=True)
class AttitudeRows:
    """Rows (4,) that vanish if attitudes follow from rotations at Gauss points, and derivatives.

    Attributes
    ----------
    rotations
        The rotations (3,) at the Gauss points, as if each lasted the whole interval.
    rows, jacobian
        The rows and their Jacobian.
    multiplier, hessian
        Multipliers (4,) of the rows, and the Hessian of their product with the rows.
    """

    rotations: list[ca.SX]
    rows: ca.SX
    jacobian: ca.SX
    multiplier: ca.SX
    hessian: ca.SX

    @classmethod
    def of(
        cls,
        z: ca.SX,
        X: ca.SX,
        X_next: ca.SX,
        points: Sequence[ca.SX],
        rotation: ca.Function,
        defect: ca.SX | None = None,
    ) -> AttitudeRows:
        """Derive the rows by the chain rule: only expressions with the robot's inertia are large.

        Parameters
        ----------
        z, X, X_next
            Variables of the interval, including the attitudes (4,) at its ends.
        points
            The arguments of ``rotation`` at the Gauss points.
        rotation
            Rotation, its Jacobian and the Hessian of its product with multipliers. Common
            subexpressions are searched for in this function; a search in the interval expressions
            takes several times as long, and finds only 1 % more.
        defect
            A parameter (3,) that is added to the rotation vector of the step; None: none.
        """
        weights = [ca.SX.sym(f"mu_{i}", 3) for i in range(len(points))]
        at_points = [rotation(point, mu) for point, mu in zip(points, weights, strict=True)]
        rates = [w for w, _, _ in at_points]
        w = [ca.SX.sym(f"w_{i}", 3) for i in range(len(points))]
        multiplier = ca.SX.sym("lambda_X", 4)
        inner = ca.vertcat(X, *w)
        step = magnus(*w) if defect is None else magnus(*w) + defect
        stepped = quaternion_multiply(X, quaternion_from_small_rotvec(step))
        outer_hess, outer_grad = ca.hessian(-ca.dot(multiplier, stepped), inner)
        stepped, outer_jac, outer_hess, outer_grad = ca.substitute(
            [stepped, ca.jacobian(stepped, inner), outer_hess, outer_grad], w, rates
        )
        by_rate = ca.vertsplit(outer_grad[4:], 3)
        point_jac = [ca.jacobian(point, z) for point in points]
        inner_jac = ca.vertcat(
            ca.jacobian(X, z), *(W @ P for (_, W, _), P in zip(at_points, point_jac, strict=True))
        )
        hessian = inner_jac.T @ outer_hess @ inner_jac
        for point, P, (_, W, H), mu in zip(points, point_jac, at_points, weights, strict=True):
            weight = ca.SX.sym("weight", point.numel())
            by_point = ca.densify(W.T @ mu)
            bend = ca.substitute(ca.hessian(ca.dot(weight, point), z)[0], weight, by_point)
            hessian += P.T @ H @ P + bend
        hessian = ca.substitute(hessian, ca.vertcat(*weights), ca.vertcat(*by_rate))
        jacobian = ca.jacobian(X_next, z) - outer_jac @ inner_jac
        return cls(rates, X_next - stepped, jacobian, multiplier, hessian)


def _distance_block(n: int, rows: PlaneDistances, instants: int) -> ConstraintBlock:
    """Return the distances at equally spaced instants of an interval, by the chain rule.

    The last instant is the end of the interval. The base rotation there is approximately the
    weighted mean of those at the knots; rows accept any norm. Each instant has its own planes.
    """
    # In MX, which calls the functions of the distances: built anew for every choice of pairs.
    h, s, v, v_next = ca.MX.sym("h"), *(ca.MX.sym(name, n) for name in ("s", "v", "v+"))
    X, X_next, lack = ca.MX.sym("X", 4), ca.MX.sym("X+", 4), ca.MX.sym("lack")
    z, count = ca.vertcat(h, X, s, v, X_next, v_next, lack), rows.values.size1_out(0)
    planes = ca.MX.sym("planes", PLANE_SIZE, count * instants)
    multipliers = ca.MX.sym("lambda", count * instants)
    values, measured, jacobian, hessian = [], [], [], ca.MX(z.numel(), z.numel())
    curved = _curved_where_it_counts(rows)
    parts = zip(ca.horzsplit(planes, count), ca.vertsplit(multipliers, count), strict=True)
    for number, (of_instant, multiplier) in enumerate(parts, 1):
        tau = number / instants
        # The point is s + h (b v + c v+).
        b, c = tau - 1 / 2 - tau**2 / 2, tau**2 / 2
        along = b * v + c * v_next
        y = ca.vertcat(s + h * along, (1 - tau) * X + tau * X_next)
        values.append(rows.values(y, of_instant) + lack)
        d, J = rows.jacobian(y, of_instant)
        measured.append(d + lack)
        slope, curvature = curved(y, of_instant, multiplier)
        slope = slope[:, :n]
        bend = ca.horzcat(ca.MX(1, 5 + n), b * slope, ca.MX(1, 4), c * slope)
        # The derivatives of [point; turn] by z: a column, and multiples of unit matrices.
        weights = (b * h, c * h)
        by_lack = ca.MX.ones(count, 1)
        jacobian.append(ca.horzcat(_point_derivative_columns(J, along, weights, tau, n), by_lack))
        half = _point_derivative_columns(curvature, along, weights, tau, n)
        by_point = ca.triu(_point_derivative_columns(half.T, along, weights, tau, n))
        by_point += ca.vertcat(bend, ca.MX(by_point.size1() - 1, by_point.size2()))
        hessian += ca.diagcat(by_point, ca.MX(1, 1))
    z_p = [z, ca.vec(planes)]
    return ConstraintBlock(
        ca.Function("distances", z_p, [ca.vertcat(*values)]),
        ca.Function("distances_jac", z_p, [ca.vertcat(*measured), ca.vertcat(*jacobian)]),
        ca.Function("distances_hess", [*z_p, multipliers], [hessian]),
    )


def _curved_where_it_counts(rows: PlaneDistances) -> ca.Function:
    """Return ``(y, planes, lambda) -> lambda' J, H``: zeros if all multipliers are negligible."""
    arguments = [ca.MX.sym(f"a{i}", rows.hessian.sparsity_in(i)) for i in range(3)]
    nothing = [ca.MX.zeros(rows.hessian.sparsity_out(i)) for i in range(2)]
    of_nothing = ca.Function("nothing", arguments, nothing)
    counts = ca.mmax(ca.fabs(arguments[2])) > _LEAST_MULTIPLIER
    chosen = ca.Function.if_else("chosen", rows.hessian, of_nothing)(counts, *arguments)
    return ca.Function("curved", arguments, chosen)


def _point_derivative_columns(
    A: ca.MX, along: ca.MX, weights: tuple[ca.MX, ca.MX], tau: float, n: int
) -> ca.MX:
    """Return ``A P``, P the derivatives of a point and its rotation by ``[h; X; s; v; X+; v+]``."""
    q, X, by_step = A[:, :n], A[:, n:], A[:, :n] @ along
    b, c = weights
    return ca.horzcat(by_step, (1 - tau) * X, q, b * q, tau * X, c * q)


def _path_constraint_rows(
    n: int,
    constraints: PathConstraints,
    inequality: ca.Function | None,
    z: ca.SX,
    rates: Sequence[ca.SX],
    direction: ca.SX,
    L_0: ca.SX,
) -> ca.SX:
    h, X, s, v, a, X_next, _, v_next = ca.vertsplit(
        z, np.cumsum([0, 1, 4, n, n, n, 4, n, n]).tolist()
    )
    rows = [ca.SX(0, 1), constraints.symbolic(s - h * v / 2, X, direction)]
    if math.isfinite(constraints.base_rate_limit):
        # Rates change linearly within an interval and are largest at its ends.
        fastest = h * constraints.imposed_base_rate
        first, second = rates
        for end in (0.0, 1.0):
            w = first + (end - GAUSS[0]) / (GAUSS[1] - GAUSS[0]) * (second - first)
            rows.append(1 - ca.sumsqr(w / fastest))
    if inequality is not None:
        for tau in (0.0, 1.0):
            point = state_within_interval(tau, s, h * v, h * v_next)
            drift = [momentum_in_base(tau, X, X_next, L_0)] if L_0.numel() else []
            rows.append(inequality(point[:n], point[n:] / h, a, *drift))
    return ca.vertcat(*rows)


def state_within_interval(tau: float, s: ca.SX, u: ca.SX, u_next: ca.SX) -> ca.SX:
    """Return shape and step (2 n,) at the fraction tau of an interval with vertex s."""
    change = u_next - u
    return ca.vertcat(s + (tau - 1 / 2) * u + tau**2 / 2 * change, u + tau * change)


def momentum_in_base(tau: float, X: ca.SX, X_next: ca.SX, L_0: ca.SX) -> ca.SX:
    """Return the angular momentum (3,), base components, at fraction tau between two attitudes."""
    mean = (1 - tau) * X + tau * X_next
    v, w = mean[:3], mean[3]
    # R(mean)' L_0 for a quaternion of any norm.
    turned = (w**2 - ca.sumsqr(v)) * L_0 + 2 * v * ca.dot(v, L_0) - 2 * w * ca.cross(v, L_0)
    return turned / ca.sumsqr(mean)


def _momentum_symbols(robot: SpaceRobot, drifting: bool) -> tuple[ca.SX, ...]:
    """Return q, u and l, which is empty at zero momentum, D and D_q, and ``D_q u - l``."""
    q, u, impulse = (
        ca.SX.sym(name, k) for name, k in zip("qul", (robot.n, robot.n, 3 * drifting), strict=True)
    )
    D, D_q = robot.function("locked_inertia", compile=False)(q)
    return q, u, impulse, D, D_q, D_q @ u - impulse if drifting else D_q @ u


def rotation_with_derivatives(robot: SpaceRobot, *, drifting: bool) -> ca.Function:
    """Return ``(point, mu) -> w, Jacobian, Hessian of mu' w``, of the rotation w.

    The derivatives follow from differentiating ``D w + D_q u = 0`` (or ``= l``) once and twice.
    """
    q, u, impulse, D, D_q, of_joints = _momentum_symbols(robot, drifting)
    w, mu, eta = (ca.SX.sym(name, 3) for name in ("w", "mu", "eta"))
    point = ca.vertcat(q, u, impulse)
    derivatives = robot.function("momentum_derivatives", compile=False)
    by_q, by_q_q, by_q_u, by_q_w = derivatives(q, w, u, eta)
    of_impulse = -ca.SX.eye(3)[:, : impulse.numel()]
    W = -solve_positive_definite(D, ca.horzcat(by_q, D_q, of_impulse))
    rest = point.numel() - robot.n
    mixed = ca.vertcat(by_q_w, ca.SX(rest, 3)) @ W
    by_q_rest = ca.horzcat(by_q_u, ca.SX(robot.n, rest - robot.n))
    plain = ca.blockcat([[by_q_q, by_q_rest], [by_q_rest.T, ca.SX(rest, rest)]])
    at, adjoint = -solve_positive_definite(D, of_joints), -solve_positive_definite(D, mu)
    W, hessian = ca.substitute([W, plain + mixed + mixed.T], [w, eta], [at, adjoint])
    return ca.Function("rotation", [point, mu], ca.cse([at, W, hessian]))


def magnus(first: ca.SX, second: ca.SX) -> ca.SX:
    """Return the rotation vector (3,) of a step from its rotations at the two Gauss points."""
    return (first + second) / 2 + math.sqrt(3) / 12 * ca.cross(first, second)


def turn_function(robot: SpaceRobot, *, drifting: bool = False) -> ca.Function:
    """Return ``(q, u, u+) -> Omega`` (3,): the rotation vector of a step, in the base frame.

    If the robot drifts, the fourth argument is the angular impulse (3,) of the step: the angular
    momentum in the base frame at about half of the step, times the step duration.
    """
    # The base's rotation, ``-D^-1 D_q u`` or ``D^-1 (l - D_q u)``.
    *point, D, _, of_joints = _momentum_symbols(robot, drifting)
    w = -solve_positive_definite(D, of_joints)
    rotation = ca.Function("rotation", [ca.vertcat(*point)], [w])
    q, u, u_next = (ca.SX.sym(name, robot.n) for name in ("q", "u", "u_next"))
    impulse = ca.SX.sym("impulse", 3 if drifting else 0)
    rates = [
        rotation(ca.vertcat(state_within_interval(tau, q + u / 2, u, u_next), impulse))
        for tau in GAUSS
    ]
    arguments = [q, u, u_next, impulse] if drifting else [q, u, u_next]
    return ca.Function("turn", arguments, [ca.cse(magnus(*rates))])


@dataclass(frozen=True)
class Layout:
    """Indices of variables of N intervals: the step, then states and controls knot by knot.

    If pairs are kept apart, the last variable is the distance by which they are closer than
    required, m (``has_lack``). ``states`` and ``controls`` are the sizes of the knot components.
    """

    states: tuple[int, ...]
    controls: tuple[int, ...]
    intervals: int
    has_lack: bool = False

    @classmethod
    def of(cls, stages: Stages, intervals: int) -> Layout:
        """Return the indices for a problem with these stages, whose knots are ``X, s, v, a``."""
        n = stages.joints
        return cls((4, n, n), (n,), intervals, stages.distances is not None)

    @property
    def size(self) -> int:
        """Number of variables."""
        of_states = sum(self.states) * (self.intervals + 1)
        return 1 + of_states + sum(self.controls) * self.intervals + self.has_lack

    def knots(self) -> tuple[Indices, ...]:
        """Return the indices of the states (N + 1, ...), then of the controls (N, ...)."""
        ends = np.cumsum([0, *self.states, *self.controls])
        first = 1 + ends[-1] * np.arange(self.intervals + 1)[:, np.newaxis]
        places = [first + np.arange(i, j) for i, j in pairwise(ends)]
        count = len(self.states)
        return (*places[:count], *(each[:-1] for each in places[count:]))


@dataclass(frozen=True)
class Program:
    """Functions of variables x and parameters p, as required by IPOPT; the bounds apply to g."""

    problem: dict[str, ca.MX]
    jac_g: ca.Function
    hess_lag: ca.Function
    lower: Array
    upper: Array


@dataclass(frozen=True)
class PlacedBlock:
    """A block placed at every interval, or at an end, of the program.

    ``variables`` and ``rows`` (count, ...) are the indices of its variables in x and of its rows in
    g, ``parameters`` its part of p: one column for all places, or one per place.
    """

    block: ConstraintBlock
    variables: Indices
    rows: Indices
    parameters: ca.MX

    @classmethod
    def after(
        cls,
        placed: Sequence[PlacedBlock],
        block: ConstraintBlock,
        variables: Indices,
        parameters: ca.MX,
    ) -> PlacedBlock:
        """Place a block after the rows of the other blocks."""
        count = len(variables)
        rows = sum(each.rows.size for each in placed)
        of_block = rows + np.arange(count * block.rows).reshape(count, block.rows)
        return cls(block, variables, of_block, parameters)

    def called(self, function: ca.Function, x: ca.MX, *more: ca.MX) -> list[ca.MX]:
        """Return the results at all places: the nonzeros place by place."""
        count = len(self.variables)
        z = ca.reshape(x[self.variables.ravel().tolist()], -1, count)
        p = self.parameters
        p = p if p.size2() == count else ca.repmat(p, 1, count)
        results = function.map(count)(z, p, *more)
        results = results if isinstance(results, (list, tuple)) else [results]
        # A single row of nonzeros becomes a column.
        return [ca.vec(result.nz[:]) for result in results]

    def multipliers(self, lam_g: ca.MX) -> ca.MX:
        """Return the multipliers of the block's rows, one column per place."""
        return ca.reshape(lam_g[self.rows.ravel().tolist()], -1, len(self.rows))


def program(stages: Stages, intervals: int) -> Program:
    """Assemble the program from the stages of a problem."""
    n, N = stages.joints, intervals
    layout = Layout.of(stages, N)
    X, s, v, a = layout.knots()
    x = ca.MX.sym("x", layout.size)
    goals = int(stages.end.values.size1_in(1)) - 7
    sizes = {"start": n, "turn": 4, "direction": 3, "center": 3, "end_effectors": goals}
    drift = int(stages.interval.values.numel_in(1)) - _DIRECTION_SIZE
    sizes |= {"typical": n, "weights": 2 + layout.has_lack, "angular_momentum": drift}
    if stages.distances is not None:
        sizes["distances"] = N * int(stages.distances.values.numel_in(1))
    p = {name: ca.MX.sym(name, size) for name, size in sizes.items()}
    zero = np.zeros((N, 1), dtype=np.int64)
    placed, equalities = place_stages(
        (stages.beginning, stages.interval, stages.end),
        (
            np.hstack([zero[:1], s[:1], v[:1]]),
            np.hstack([zero, X[:-1], s[:-1], v[:-1], a, X[1:], s[1:], v[1:]]),
            np.hstack([X[-1:], s[-1:]]),
        ),
        (
            p["start"],
            ca.vertcat(p["direction"], p["angular_momentum"]),
            ca.vertcat(p["turn"], p["center"], p["end_effectors"]),
        ),
        stages.path_row_count,
    )
    if stages.distances is not None:
        lack = np.full((N, 1), layout.size - 1)
        variables = np.hstack([zero, X[:-1], s[:-1], v[:-1], X[1:], v[1:], lack])
        of_places = ca.reshape(p["distances"], -1, N)
        placed.append(PlacedBlock.after(placed, stages.distances, variables, of_places))
    change = ca.reshape(x[a.ravel().tolist()], n, N) / ca.repmat(p["typical"], 1, N)
    f = p["weights"][0] * N * x[0] + p["weights"][1] * ca.sumsqr(change) / N
    if layout.has_lack:
        f += p["weights"][2] * x[-1]
    return assembled(x, ca.vertcat(*p.values()), f, placed, equalities)


def place_stages(
    blocks: tuple[ConstraintBlock, ConstraintBlock, ConstraintBlock],
    variables: tuple[Indices, Indices, Indices],
    parameters: tuple[ca.MX, ca.MX, ca.MX],
    path_row_count: int = 0,
) -> tuple[list[PlacedBlock], int]:
    """Place the blocks for the first knot, for all intervals and for the last knot.

    The last ``path_row_count`` rows of an interval are inequalities, which come after all
    equalities; their number is also returned.
    """
    beginning, interval, end = blocks
    N, first, dynamics = len(variables[1]), beginning.rows, interval.rows - path_row_count
    of_intervals = first + np.arange(N * dynamics).reshape(N, dynamics)
    equalities = first + N * dynamics + end.rows
    of_path = equalities + np.arange(N * path_row_count).reshape(N, path_row_count)
    rows = (
        np.arange(first)[np.newaxis],
        np.hstack([of_intervals, of_path]),
        first + N * dynamics + np.arange(end.rows)[np.newaxis],
    )
    each = zip(blocks, variables, rows, parameters, strict=True)
    return [PlacedBlock(*parts) for parts in each], equalities


def assembled(
    x: ca.MX, parameters: ca.MX, f: ca.MX, placed: Sequence[PlacedBlock], equalities: int
) -> Program:
    """Return the program for an objective f and blocks; rows after the equalities are ``>= 0``."""
    rows = sum(each.rows.size for each in placed)
    g = _gather_rows(rows, [(each.rows, each.called(each.block.values, x)[0]) for each in placed])
    values, jacobian = _jacobian(placed, x, rows)
    lam_f, lam_g = ca.MX.sym("lam_f"), ca.MX.sym("lam_g", rows)
    of_objective = ca.triu(ca.hessian(lam_f * f, x)[0])
    hessian = of_objective + _hessian(placed, x, lam_g)
    return Program(
        {"x": x, "p": parameters, "f": f, "g": g},
        ca.Function("jac_g", [x, parameters], [values, jacobian]),
        ca.Function("hess_lag", [x, parameters, lam_f, lam_g], [hessian]),
        np.zeros(rows),
        np.where(np.arange(rows) < equalities, 0.0, np.inf),
    )


def _gather_rows(rows: int, parts: Sequence[tuple[Indices, ca.MX]]) -> ca.MX:
    """Return rows (rows,) from their places and values, part after part."""
    order = np.empty(rows, dtype=np.int64)
    places = np.concatenate([places.ravel() for places, _ in parts])
    order[places] = np.arange(len(places))
    return ca.vertcat(*(values for _, values in parts))[order.tolist()]


def _jacobian(placed: Sequence[PlacedBlock], x: ca.MX, rows: int) -> tuple[ca.MX, ca.MX]:
    values, entries = [], []
    for each in placed:
        g, J = each.called(each.block.jacobian, x)
        values.append((each.rows, g))
        i, j = each.block.jacobian.sparsity_out(1).get_triplet()
        entries.append((each.rows[:, i], each.variables[:, j], J))
    return _gather_rows(rows, values), _scatter_nonzeros((rows, x.numel()), entries)


def _hessian(placed: Sequence[PlacedBlock], x: ca.MX, lam_g: ca.MX) -> ca.MX:
    """Return the upper triangle of the Hessian of ``lambda' g``."""
    entries = []
    for each in placed:
        (H,) = each.called(each.block.hessian, x, each.multipliers(lam_g))
        i, j = each.block.hessian.sparsity_out(0).get_triplet()
        row, column = np.sort([each.variables[:, i], each.variables[:, j]], axis=0)
        entries.append((row, column, H))
    return _scatter_nonzeros((x.numel(), x.numel()), entries)


def _scatter_nonzeros(
    shape: tuple[int, int], entries: Sequence[tuple[Indices, Indices, ca.MX]]
) -> ca.MX:
    """Return the sparse matrix of rows, columns and nonzeros; nonzeros of one entry are added."""
    rows, columns = (np.concatenate([each[k].ravel() for each in entries]) for k in (0, 1))
    places, number = np.unique(columns * shape[0] + rows, return_inverse=True)
    at_row, at_column = (each.tolist() for each in (places % shape[0], places // shape[0]))
    sparsity = ca.Sparsity.triplet(*shape, at_row, at_column)
    every = ca.vertcat(*(nonzeros for _, _, nonzeros in entries))
    add = ca.DM.triplet(
        number.tolist(), list(range(len(number))), ca.DM.ones(len(number)), len(places), len(number)
    )
    return ca.MX(sparsity, add @ every)
