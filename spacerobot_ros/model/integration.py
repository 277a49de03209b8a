"""Fourth-order Runge-Kutta steps under held commands, as CasADi functions."""

from __future__ import annotations

import math
from functools import partial

import casadi as ca

from spacerobot_ros.errors import ParameterError
from spacerobot_ros.model.composite_rigid_body import SymmetricFactor
from spacerobot_ros.model.dynamics import solve_positive_definite
from spacerobot_ros.model.symbolic_rotations import matrix_from_quaternion, quaternion_rate

DEFAULT_INTEGRATION_STEP = 0.01
"""Longest Runge-Kutta step for the attitude under held joint velocities, s."""


def count_steps(control_period: float, integration_step: float) -> int:
    """Return the smallest number of equal steps per control period, each of at most
    ``integration_step`` s.

    Raises
    ------
    ParameterError
        A duration is not positive.
    """
    for name, value in (("control period", control_period), ("integration step", integration_step)):
        if not (math.isfinite(value) and value > 0):
            raise ParameterError(f"The {name} must be positive, not {value} s.")
    return max(1, math.ceil(control_period / integration_step - 1e-9))


def runge_kutta_step(rate: ca.Function, attitude: slice) -> ca.Function:
    """Return one fourth-order Runge-Kutta step ``(x, held arguments of rate, h) -> x``.

    If ``p`` (mass properties) is the last argument of the rate, it remains the last argument, after
    ``h``.

    ``attitude`` is the slice of ``x`` that holds the quaternion, which is integrated in R^4 and
    normalised after the step. The four stages call one function: inlined code would be 6 % faster
    but take six times as long to compile.
    """
    x, held = _symbols_for_inputs(rate)
    h = ca.MX.sym("h")
    k1 = rate(x, *held)
    k2 = rate(x + h / 2 * k1, *held)
    k3 = rate(x + h / 2 * k2, *held)
    k4 = rate(x + h * k3, *held)
    x_next = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    x_next[attitude] = x_next[attitude] / ca.norm_2(x_next[attitude])
    p = [held.pop()] if rate.name_in(rate.n_in() - 1) == "p" else []
    inputs = [x, *held, h, *p]
    return ca.Function(rate.name().replace("rate", "step"), inputs, [x_next])


def repeat_step(step: ca.Function, count: int) -> ca.Function:
    """Return ``step`` applied ``count`` times to its first argument; the other arguments are held
    constant.

    A function that computes half of the steps is called twice, so the code size grows with the
    logarithm of ``count``.
    """
    if count == 1:
        return step
    x, held = _symbols_for_inputs(step)
    half = repeat_step(step, count // 2)
    x_next = half(half(x, *held), *held)
    if count % 2:
        x_next = step(x_next, *held)
    return ca.Function(f"{step.name()}_{count}", [x, *held], [x_next])


def divided_step(name: str, step: ca.Function, count: int) -> ca.Function:
    """Return the function that divides a step ``(x, u, loads, h) -> x`` into ``count`` equal
    steps."""
    x, (u, loads, h, *p) = _symbols_for_inputs(step)
    x_next = repeat_step(step, count)(x, u, loads, h / count, *p)
    return ca.Function(name, [x, u, loads, h, *p], [x_next])


def attitude_step(locked_inertia: ca.Function) -> ca.Function:
    """Return one Runge-Kutta step ``(x, qdot, L_W, h) -> x`` of ``x = [q; quaternion_WB]``.

    This step reconstructs the base motion from the joint motion, one held command at a time. Joint
    velocities are constant over the step (servos hold them), so the configuration is exact; the
    base position follows from the centre of mass. Only the attitude is integrated:
    ``R_WB_dot = R_WB hat(omega)``, ``omega = D^-1 (R_WB' L_W - D_q qdot)`` (paper 1, eq. 3,
    extended to nonzero angular momentum), as a quaternion in R^4, normalised.

    ``locked_inertia`` is the function ``q -> (D, D_q)``; if it takes a second argument ``p`` (mass
    properties), so does the step, as its last argument.
    """
    p = [ca.SX.sym("p", locked_inertia.size1_in(1))] if locked_inertia.n_in() > 1 else []
    n = locked_inertia.size1_in(0)
    x = ca.SX.sym("x", n + 4)
    qdot, L_W, h = ca.SX.sym("qdot", n), ca.SX.sym("L_W", 3), ca.SX.sym("h")
    q, quaternion = x[:n], x[n:]
    # Two of the four stages are evaluated at the middle of the step.
    shapes = [locked_inertia(q + fraction * h * qdot, *p) for fraction in (0.0, 0.5, 1.0)]

    def rate(stage: int, at: ca.SX) -> ca.SX:
        D, D_q = shapes[stage]
        L_B = matrix_from_quaternion(at).T @ L_W - D_q @ qdot
        # The factor needs no roots and a quarter of the divisions, which take most of the time in
        # vector registers. Recorded flights used Cholesky's, which is equal up to rounding.
        solve = SymmetricFactor(D).solve if p else partial(solve_positive_definite, D)
        return quaternion_rate(at, solve(L_B))

    k1 = rate(0, quaternion)
    k2 = rate(1, quaternion + h / 2 * k1)
    k3 = rate(1, quaternion + h / 2 * k2)
    k4 = rate(2, quaternion + h * k3)
    turned = quaternion + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    x_next = ca.vertcat(q + h * qdot, turned / ca.norm_2(turned))
    return ca.Function("attitude_step", [x, qdot, L_W, h, *p], [ca.cse(x_next)])


def _symbols_for_inputs(function: ca.Function) -> tuple[ca.MX, list[ca.MX]]:
    x, *held = (
        ca.MX.sym(function.name_in(i), function.size1_in(i)) for i in range(function.n_in())
    )
    return x, held
