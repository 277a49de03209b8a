"""Runge-Kutta 4 steps under held commands, as CasADi functions."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import casadi as ca

from spacerobot_ros.errors import ParameterError
from spacerobot_ros.model.composite_rigid_body import SymmetricFactor
from spacerobot_ros.model.dynamics import solve_positive_definite
from spacerobot_ros.model.symbolic_rotations import matrix_from_quaternion, quaternion_rate

DEFAULT_INTEGRATION_STEP = 0.01
"""Longest Runge-Kutta step for the attitude under held joint velocities, s."""


def count_steps(control_period: float, integration_step: float) -> int:
    """Return the smallest number of equal steps of at most ``integration_step`` s per control
    period.

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
    """Return one Runge-Kutta 4 step ``(x, held arguments of rate, h) -> x``.

    If ``p`` (mass properties) is the last argument of the rate, it stays last, after ``h``.

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
    """Return ``step`` applied ``count`` times to its first argument; other arguments are held.

    Each half is one function called twice: code size grows with the logarithm of ``count``.
    """
    if count == 1:
        return step
    x, held = _symbols_for_inputs(step)
    half = repeat_step(step, count // 2)
    x_next = half(half(x, *held), *held)
    if count % 2:
        x_next = step(x_next, *held)
    return ca.Function(f"{step.name()}_{count}", [x, *held], [x_next])


def attitude_step(locked_inertia: ca.Function) -> ca.Function:
    """Return one Runge-Kutta step ``(x, qdot, L_W, h) -> x`` of ``x = [q; quaternion_WB]``.

    This reconstructs the base motion from the joint motion, one held command at a time. Joint
    velocities are constant over the step (servos hold them), so the configuration is exact; the
    base position follows from the centre of mass. Only the attitude is integrated:
    ``R_WB_dot = R_WB hat(omega)``, ``omega = D^-1 (R_WB' L_W - D_q qdot)`` (paper 1, eq. 3, with an
    angular momentum that need not be zero), as a quaternion in R^4, normalised.

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

    def body_rate(stage: int, at: ca.SX) -> ca.SX:
        D, D_q = shapes[stage]
        L_B = matrix_from_quaternion(at).T @ L_W
        return _solution(D, L_B - D_q @ qdot, p)

    turned = _turned_quaternion(quaternion, h, body_rate)
    x_next = ca.vertcat(q + h * qdot, turned)
    return ca.Function("attitude_step", [x, qdot, L_W, h, *p], [ca.cse(x_next)])


def attitude_steps_without_momentum(locked_inertia: ca.Function, count: int) -> ca.Function:
    """Return ``count`` steps of :func:`attitude_step` at zero momentum, ``(x, qdot, h, p) -> x``.

    Together they span the time ``h``; ``locked_inertia`` takes the argument ``p``.

    The body rate is then ``-D^-1 D_q qdot``, independent of the attitude: it is computed once for
    the end of one step and the start of the next. This saves half of the operations; the results
    equal those of :func:`attitude_step`.
    """
    p = ca.SX.sym("p", locked_inertia.size1_in(1))
    n = locked_inertia.size1_in(0)
    x, qdot, h = ca.SX.sym("x", n + 4), ca.SX.sym("qdot", n), ca.SX.sym("h")
    beginning = ca.SX.sym("omega", 3)

    def body_rate(q: ca.SX) -> ca.SX:
        D, D_q = locked_inertia(q, p)
        return _solution(D, -(D_q @ qdot), [p])

    q, quaternion = x[:n], x[n:]
    rates = [beginning, body_rate(q + 0.5 * h * qdot), body_rate(q + h * qdot)]
    turned = _turned_quaternion(quaternion, h, lambda stage, at: rates[stage])
    results = ca.cse([ca.vertcat(q + h * qdot, turned, rates[-1])])
    # The state of the steps ends with the body rate of its shape.
    step = ca.Function("momentumless_step", [ca.vertcat(x, beginning), qdot, h, p], results)
    first = ca.Function("body_rate", [q, qdot, p], [ca.cse(body_rate(q))])
    held = [ca.MX.sym(name, size) for name, size in (("qdot", n), ("h", 1), ("p", p.numel()))]
    start = ca.MX.sym("x", n + 4)
    rate = first(start[:n], held[0], held[2])
    end = repeat_step(step, count)(ca.vertcat(start, rate), held[0], held[1] / count, held[2])
    return ca.Function(f"momentumless_steps_{count}", [start, *held], [end[: n + 4]])


def _solution(matrix: ca.SX, right: ca.SX, p: Sequence[ca.SX]) -> ca.SX:
    """Return x of ``matrix x = right``; ``p`` are symbols of mass properties, if there are any."""
    # The factor needs no roots and a quarter of the divisions, which take most of the time in
    # vector registers. Recorded flights used Cholesky's, which is equal up to rounding.
    return SymmetricFactor(matrix).solve(right) if p else solve_positive_definite(matrix, right)


def _turned_quaternion(
    quaternion: ca.SX, h: ca.SX, body_rate: Callable[[int, ca.SX], ca.SX]
) -> ca.SX:
    """Return the quaternion (4,) after a step of Runge-Kutta 4.

    ``body_rate`` gives the rate (3,) at the beginning (0), middle (1) or end (2) of the step, and
    at a quaternion.
    """
    k1 = quaternion_rate(quaternion, body_rate(0, quaternion))
    at = quaternion + h / 2 * k1
    k2 = quaternion_rate(at, body_rate(1, at))
    at = quaternion + h / 2 * k2
    k3 = quaternion_rate(at, body_rate(1, at))
    at = quaternion + h * k3
    k4 = quaternion_rate(at, body_rate(2, at))
    turned = quaternion + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return turned / ca.norm_2(turned)


def _symbols_for_inputs(function: ca.Function) -> tuple[ca.MX, list[ca.MX]]:
    x, *held = (
        ca.MX.sym(function.name_in(i), function.size1_in(i)) for i in range(function.n_in())
    )
    return x, held
