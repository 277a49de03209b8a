"""Motions under thrust as a nonlinear program, by direct multiple shooting, solved by IPOPT.

A knot is ``x = [X; L; r; V; s; v]``: the attitude X, the vertices s and the velocities v of the
joints' parabolas (:mod:`spacerobot_ros.planning.methods.optimal.transcription`), and the angular
momentum L about the centre of mass, its position r and its velocity V, in W. The controls of an
interval are the joint accelerations a and the levels u of the propulsion, whose wrench ``(f, n) = W
u`` is constant in the base frame. With ``R_i``, ``c_i`` the attitude and the centre of mass in
base components at the Gauss points tau_i of an interval,

``V+ = V + h/m sum R_i f / 2``, ``r+ = r + h V + h^2/m sum (1 - tau_i) R_i f / 2``,
``L+ = L + h sum R_i (n - c_i x f) / 2``, ``X+ = X exp(Omega)``,

and Omega is the Magnus expansion of the rates at the Gauss points, ``D w + D_q u = h R_i' L_i``.
With the momenta as states, conservation is exact: without thrust, both momenta are constant for any
joint motion. Every interval has a defect parameter that is added to its end: the precomputed
difference from an exact integration of the same controls. So solutions satisfy the exact equations,
not just their discretisation (deferred correction).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import casadi as ca
import numpy as np

from spacerobot_ros.collision.planes import PLANE_SIZE
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.integration import runge_kutta
from spacerobot_ros.model.symbolic_rotations import (
    half_angle_vector,
    matrix_from_quaternion,
    relative_vector,
)
from spacerobot_ros.model.target_motion import TARGET_SIZE, TargetExpression
from spacerobot_ros.planning.methods.optimal.multiple_shooting import (
    DurationBounds,
    ProgramSolver,
    StopRule,
    knot_bounds,
    pack_knots,
)
from spacerobot_ros.planning.methods.optimal.transcription import (
    GAUSS,
    AttitudeRows,
    ConstraintBlock,
    Layout,
    PlacedBlock,
    Program,
    assembled,
    beginning_block,
    dynamics_facts,
    momentum_in_base,
    place_stages,
    rotation_with_derivatives,
    state_within_interval,
)
from spacerobot_ros.planning.methods.thrust.problem import (
    DEFECT_SIZE,
    Propulsion,
    ThrustKnots,
    state_parts,
    state_symbols,
    with_joints_moved,
)

INSTANTS = 2
"""Instants in an interval at which pairs are kept apart."""

KeptPlaces = tuple[tuple[int, tuple[int, ...]], ...]
"""Pairs that are kept apart, and their places among all K instants of the N intervals, from 0 to N
K - 1.
"""

_COST_OF_LACK = 1e3
"""Weight of missing clearance between pairs, per metre."""

_PUSHES = ("bound_push", "bound_frac", "slack_bound_push", "slack_bound_frac", "mult_bound_push")
_CONTINUED = {
    "ipopt.mu_init": 1e-5,
    "ipopt.tol": 1e-5,
    "ipopt.warm_start_init_point": "yes",
    **{f"ipopt.warm_start_{each}": 1e-7 for each in _PUSHES},
}
_EXACT = {"ipopt.mu_init": 1e-9, "ipopt.constr_viol_tol": 1e-9, "ipopt.tol": 1e-8}
_NEAR_BOUNDS = {"ipopt.mu_init": 1e-2, "ipopt.bound_push": 1e-3, "ipopt.bound_frac": 1e-3}

_OPTIONS: Mapping[str, Mapping[str, object]] = {
    "": {"ipopt.tol": 1e-6},
    # A shortest time that determines another time, or a search for obstacles in the way.
    "rough": {"ipopt.tol": 1e-4, "ipopt.constr_viol_tol": 1e-5},
    # The guess is clear of its planes, or nearly so; new planes follow its solution.
    "clear": {**_NEAR_BOUNDS, "ipopt.tol": 1e-3, "ipopt.dual_inf_tol": 1e-1},
    # The guess is a solution with other weights, planes or pairs; then one with other defects.
    "continued": _CONTINUED,
    "corrected": {**_CONTINUED, **_EXACT},
}
"""IPOPT options by starting point."""


class ThrustBoundary(NamedTuple):
    """Both ends of a motion, in W: the state at the start (13 + 2 n,), the values prescribed at the
    end (:class:`.EndKind`), and the smallest and largest states (2, N + 1, 13 + 2 n) at the knots,
    with the vertices of the joints' parabolas in place of their positions.
    """

    start: Array
    goals: Array
    bounds: Array


class Weights(NamedTuple):
    """Weights of the terms in the objective: of the duration (1/s), of the propulsion cost, of the
    squares of joint accelerations relative to their limits, and of the squares of levels; and the
    level below which the cost of a norm is smoothed.
    """

    duration: float
    cost: float
    accelerations: float
    levels: float
    rounding: float = 1.0


class EndKind(NamedTuple):
    """Quantities prescribed at the end of a motion: the base pose and a link pose (empty: none);
    or, with a target, the pose and the velocities of its grapple frame for the link, and optionally
    the total angular momentum of the robot and the target.

    The parameters are the poses (7 each); or, with a target, the number of intervals, the target
    parameters (:meth:`.TorqueFreeMotion.numbers`), and the angular momentum (3).
    """

    link: str = ""
    target: bool = False
    momentum: bool = False


Stages = tuple[ConstraintBlock, ConstraintBlock, ConstraintBlock]
"""Rows of the first knot, of two neighbouring knots, and of the last knot."""


def thrust_stages(robot: SpaceRobot, levels: int, kind: EndKind) -> Stages:
    """Derive the functions of a robot's problem, or read them from the cache.

    The wrenches of the levels are parameters, so the functions stay the same if thrusters fail.
    """
    of_target = TargetExpression.__module__, runge_kutta.__module__
    facts = [*dynamics_facts(robot, __name__, *of_target), f"levels {levels}"]
    cached = ConstraintBlock.cached
    return (
        beginning_block(robot.n),
        cached("thrust", facts, lambda: _interval_block(robot, levels)).compiled(),
        cached("thrust_end", [*facts, str(kind)], lambda: _end_block(robot, kind)),
    )


def _end_block(robot: SpaceRobot, kind: EndKind) -> ConstraintBlock:
    """Return the rows of the last knot, of ``[h; x]``."""
    size = 4 + TARGET_SIZE if kind.target else 7 * (1 + bool(kind.link))
    h, goals = ca.SX.sym("h"), ca.SX.sym("goals", size)
    x, (X, L, r, V, s, v) = state_symbols(robot.n)
    q, R = s - h * v / 2, matrix_from_quaternion(X)
    c = robot.function("center_of_mass", compile=False)(q)
    reached = [] if kind.target else [r - R @ c - goals[:3], relative_vector(goals[3:7], X)]
    if kind.link:
        R_all, r_all = robot.function("link_poses", compile=False)(q)
        i = robot.link_names.index(kind.link)
        e, R_E = r_all[:, i] - c, R @ R_all[:, 3 * i : 3 * i + 3]
    if kind.target:
        goal = TargetExpression.at(goals[1:-3], goals[0] * h)
        J = robot.function(f"jacobian:{kind.link}", compile=False)(q)
        omega = R.T @ goal.omega - J[3:6, 6:] @ v
        D, D_q = robot.function("locked_inertia", compile=False)(q)
        reached += [
            r + R @ e - goal.r,
            half_angle_vector(R_E @ goal.R.T),
            V + R @ (J[:3, 3:6] @ omega + J[:3, 6:] @ v) - goal.v,
            L - R @ (D @ omega + D_q @ v),
        ]
        if kind.momentum:
            reduced = robot.total_mass * goal.mass / (robot.total_mass + goal.mass)
            orbiting = reduced * ca.cross(goal.center - r, goal.center_velocity - V)
            reached.append(L + goal.L + orbiting - goals[-3:])
    elif kind.link:
        turned = R_E @ matrix_from_quaternion(goals[-4:]).T
        reached += [r + R @ e - goals[-7:-4], half_angle_vector(turned)]
    return ConstraintBlock.of("thrust_end", ca.vertcat(h, x), goals, ca.vertcat(*reached))


def _interval_block(robot: SpaceRobot, levels: int) -> ConstraintBlock:
    """Return the dynamics of an interval, of ``[h; x; a; u; x+]``."""
    n = robot.n
    h, a, u = ca.SX.sym("h"), ca.SX.sym("a", n), ca.SX.sym("u", levels)
    x, (X, L, r, V, s, v) = state_symbols(n)
    x_next, (X_next, L_next, r_next, V_next, s_next, v_next) = state_symbols(n)
    z = ca.vertcat(h, x, a, u, x_next)
    defect, wrenches = ca.SX.sym("defect", DEFECT_SIZE), ca.SX.sym("wrenches", 6, levels)
    points = [state_within_interval(tau, s, h * v, h * v_next) for tau in GAUSS]
    impulses = [h * momentum_in_base(tau, X, X_next, (1 - tau) * L + tau * L_next) for tau in GAUSS]
    attitude = AttitudeRows.of(
        z,
        X,
        X_next,
        [ca.vertcat(*both) for both in zip(points, impulses, strict=True)],
        rotation_with_derivatives(robot, drifting=True),
        defect[:3],
    )
    center_of_mass = robot.function("center_of_mass", compile=False)
    wrench = wrenches @ u
    force, torque = wrench[:3], wrench[3:]
    pushed, shifted, twisted = ca.SX(3, 1), ca.SX(3, 1), ca.SX(3, 1)
    for tau, point in zip(GAUSS, points, strict=True):
        mean = (1 - tau) * X + tau * X_next
        R = matrix_from_quaternion(mean / ca.norm_2(mean))
        f_W = R @ force / 2
        pushed += f_W
        shifted += (1 - tau) * f_W
        twisted += R @ (torque - ca.cross(center_of_mass(point[:n]), force)) / 2
    m = robot.total_mass
    plain = ca.vertcat(
        v_next - v - h * a,
        s_next - s - h * v_next,
        L_next - L - h * twisted - defect[3:6],
        r_next - r - h * V - h**2 / m * shifted - defect[6:9],
        V_next - V - h / m * pushed - defect[9:],
    )
    multiplier = ca.SX.sym("lambda", plain.numel())
    return ConstraintBlock.with_derivatives(
        "thrust",
        z,
        ca.vertcat(defect, ca.vec(wrenches)),
        ca.vertcat(multiplier, attitude.multiplier),
        ca.vertcat(plain, attitude.rows),
        ca.vertcat(ca.jacobian(plain, z), attitude.jacobian),
        ca.hessian(ca.dot(multiplier, plain), z)[0] + attitude.hessian,
    )


def pair_block(joints: int, distance: ca.Function) -> ConstraintBlock:
    """Return the distance of a pair from a plane at an instant in an interval, plus the lack.

    ``distance`` is :func:`.support_distance`. The variables are ``[h; x; x+; lack]``, the
    parameters the plane and a point, in W if one body of the pair is an obstacle, and the instant
    from 0 to 1.
    """
    h, lack, p = ca.SX.sym("h"), ca.SX.sym("lack"), ca.SX.sym("p", PLANE_SIZE + 1)
    x, (X, _, r, V, s, v) = state_symbols(joints)
    x_next, (X_next, _, _, V_next, _, v_next) = state_symbols(joints)
    z, plane, tau = ca.vertcat(h, x, x_next, lack), p[:PLANE_SIZE], p[PLANE_SIZE]
    at = state_within_interval(tau, s, h * v, h * v_next)[:joints]
    if distance.size1_in(0) > joints:
        place = r + h * (tau * V + tau**2 / 2 * (V_next - V))
        at = ca.vertcat(at, (1 - tau) * X + tau * X_next, place)
    # By the chain rule, as the distance depends on few of the variables.
    y, multiplier = ca.SX.sym("y", at.numel()), ca.SX.sym("lambda")
    bend, slope = ca.substitute(list(ca.hessian(distance(y, plane), y)), [y], [at])
    P, weight = ca.jacobian(at, z), ca.SX.sym("weight", at.numel())
    of_place = ca.substitute(ca.hessian(ca.dot(weight, at), z)[0], weight, slope)
    return ConstraintBlock.with_derivatives(
        "pair",
        z,
        p,
        multiplier,
        distance(at, plane) + lack,
        slope.T @ P + ca.jacobian(lack, z),
        multiplier * (P.T @ bend @ P + of_place),
    )


class ThrustSolver:
    """Solves the problem of one robot for many boundary conditions.

    Parameters
    ----------
    stages, propulsion, intervals
        The functions of the problem, the base propulsion, and the number of intervals N.
    acceleration
        (n,) largest accelerations of the joints.
    pairs
        Distances of the pairs kept apart, and their places (:data:`KeptPlaces`).
    """

    def __init__(
        self,
        stages: Stages,
        propulsion: Propulsion,
        intervals: int,
        acceleration: Array,
        pairs: Sequence[tuple[ConstraintBlock, Sequence[int]]],
    ) -> None:
        self._propulsion, self._acceleration = propulsion, acceleration
        n, m = len(acceleration), len(propulsion.cost)
        self._layout = Layout((13 + 2 * n,), (n, m), intervals, bool(pairs))
        self._solver = ProgramSolver("thrust", self._assembled(stages, pairs), _OPTIONS)

    def _assembled(
        self, stages: Stages, pairs: Sequence[tuple[ConstraintBlock, Sequence[int]]]
    ) -> Program:
        """Assemble the program. Its parameters are the initial shape (n,), the end parameters
        (:class:`EndKind`), the defects (12, N), the :class:`Weights`, the centres of the
        squares (n + m, N), and the planes (8,) of every pair at its places.
        """
        layout, propulsion, N = self._layout, self._propulsion, self._layout.intervals
        (n, m), counts = layout.controls, [len(at) for _, at in pairs]
        knot, a, u = layout.knots()
        x = ca.MX.sym("x", layout.size)
        sizes = {"start": n, "goals": stages[2].values.size1_in(1), "weights": len(Weights._fields)}
        start, goals, w = (ca.MX.sym(*each) for each in sizes.items())
        defects, centers = ca.MX.sym("defects", DEFECT_SIZE, N), ca.MX.sym("centers", n + m, N)
        planes = [ca.MX.sym("planes", PLANE_SIZE + 1, count) for count in counts]
        wrenches = ca.repmat(ca.vec(ca.DM(propulsion.wrenches)), 1, N)
        zero = np.zeros((N, 1), dtype=np.int64)
        placed, equalities = place_stages(
            stages,
            (
                np.hstack([zero[:1], knot[:1, 13:]]),
                np.hstack([zero, knot[:-1], a, u, knot[1:]]),
                np.hstack([zero[:1], knot[-1:]]),
            ),
            (start, ca.vertcat(defects, wrenches), goals),
        )
        if not propulsion.is_table:
            group = ca.SX.sym("u", 3)
            norm = ConstraintBlock.of("norm", group, ca.SX(0, 1), 1 - ca.sumsqr(group))
            groups = np.vstack(np.hsplit(u, 2))
            placed.append(PlacedBlock.after(placed, norm, groups, ca.MX(0, 1)))
        variables = np.hstack([zero, knot[:-1], knot[1:], np.full((N, 1), layout.size - 1)])
        for (block, at), of_pair in zip(pairs, planes, strict=True):
            places = variables[np.array(at) // INSTANTS]
            placed.append(PlacedBlock.after(placed, block, places, of_pair))
        controls = ca.reshape(x[np.hstack([a, u]).ravel().tolist()], n + m, N)
        scale = ca.DM(np.concatenate([self._acceleration, np.ones(m)]))
        change = (controls - centers) / ca.repmat(scale, 1, N)
        spent = propulsion.cost_of(controls[n:, :], w[4])
        f = w[0] * N * x[0] + w[1] * x[0] * spent
        f += (w[2] * ca.sumsqr(change[:n, :]) + w[3] * ca.sumsqr(change[n:, :])) / N
        if pairs:
            f += _COST_OF_LACK * x[-1]
        parameters = [start, goals, defects, w, centers, *planes]
        return assembled(x, ca.vertcat(*map(ca.vec, parameters)), f, placed, equalities)

    def solve(
        self,
        boundary: ThrustBoundary,
        guess: ThrustKnots,
        weights: Weights,
        stop: StopRule,
        duration: DurationBounds,
        planes: Array,
        center: ThrustKnots | None = None,
        begins: str = "",
    ) -> ThrustKnots | None:
        """Return the best motion near ``guess``; None if none is found.

        If the guess is a solution, even without the pairs, the solver continues from it.

        Parameters
        ----------
        boundary, guess, weights
            The problem, and the start of the solver.
        stop, duration
            Conditions on which it stops early, and bounds of the duration.
        planes
            (R, 8) planes of the pairs at their places.
        center
            Controls whose differences are squared; None: zero.
        begins
            ``rough`` if another solve starts from the solution, ``corrected`` if the guess is a
            solution with other defects.
        """
        layout, propulsion = self._layout, self._propulsion
        N, most, rows = layout.intervals, self._acceleration, self._solver.rows
        vertices = with_joints_moved(guess.states, guess.step / 2)
        x0 = pack_knots(layout, guess.step, vertices, guess.accelerations, guess.levels)
        multipliers = dict[str, Array]()
        if guess.multipliers is not None:
            begins = begins if begins == "corrected" else "continued"
            of_variables, of_rows = guess.multipliers
            # Multipliers of all rows if they are the same, else of those without pairs.
            same = rows if len(of_rows) == rows else rows - len(planes)
            # The last variable may be the lack.
            multipliers["lam_x0"] = np.append(of_variables, 0.0)[: layout.size]
            multipliers["lam_g0"] = np.append(of_rows[:same], np.zeros(rows - same))
        elif layout.has_lack:
            begins = "clear"
        centers = np.zeros((N, sum(layout.controls)))
        if center is not None:
            centers = np.hstack([center.accelerations, center.levels])
        shape, goals, defects = state_parts(boundary.start)[4], boundary.goals, guess.defects
        parameters = (shape, goals, defects.ravel(), weights, centers.ravel(), planes.ravel())
        ranges = boundary.bounds, np.array([-most, most]), np.array([propulsion.lowest, 1.0])
        bounds = knot_bounds(layout, duration, np.inf, *ranges)
        found = self._solver.solve(
            begins, stop, x0, bounds, np.concatenate(parameters), **multipliers
        )
        if not found.feasible:
            return None
        x, solved = found.x, found.multipliers if found.converged else None
        step, lack = float(x[0]), float(x[-1]) * layout.has_lack
        states, accelerations, levels = (x[at] for at in layout.knots())
        states = with_joints_moved(states, -step / 2)
        return ThrustKnots(step, states, accelerations, levels, defects, solved, lack)
