"""Rates of a robot's state, and fourth-order Runge-Kutta steps under held commands, as CasADi
functions.

:func:`state_rate` computes the motion under joint efforts and a base wrench, with the total momenta
as part of the state. The state is ``x = [q; quaternion_WB; qdot; p_W; L_W; r_WC_W]``, (2 n + 13,):
joint positions, attitude (x, y, z, w), joint rates, total linear momentum (kg m/s), total angular
momentum about the system's centre of mass (kg m^2/s), and position of the centre of mass (m), the
last three in W. The base twist is not a state: it follows from the momenta and joint rates. Without
thrusters, the momenta are therefore constant to the last bit, for any step size:

* ``p_W_dot = R_WB f``, ``L_W_dot = R_WB (n + (r_origin - c) x f)``, ``r_WC_W_dot = p_W / M``;
* ``K qddot = Q`` with the ``omega_WB_B`` that follows from the momenta.

The command is ``[tau; f; n]``, (n + 6,): joint efforts (N or N m), then force (N) and torque (N m)
at the base link origin, in the base frame. The attitude is integrated in R^4 and normalised
after each Runge-Kutta step.

Under external loads (:class:`.ExternalLoads`, derived in docs/theory/external_loads.md), the state
ends with the time (s), and the command ends with the load vector (:class:`LoadLayout`). Both
momenta change due to the load on the whole robot, uniform gravity and friction. All times are in
plant time. Frame W is in free fall on a circular orbit with mean motion n and does not rotate. The
orbital frame O has its x axis radially outward and its z axis along the orbit normal; ``R_WO`` is
the attitude of O at time zero, ``o`` the unit vector along the radius.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import TypeVar

import casadi as ca
import numpy as np

from spacerobot_ros.errors import ParameterError
from spacerobot_ros.model.compilation import dense_function
from spacerobot_ros.model.dynamics import (
    Composites,
    ExternalLoads,
    SymmetricFactor,
    composites,
    external_force,
    shape_forces,
    shape_system,
    solve_positive_definite,
)
from spacerobot_ros.model.inertial_parameters import rotational
from spacerobot_ros.model.kinematics import TreeKinematics
from spacerobot_ros.model.symbolic_rotations import matrix_from_quaternion, quaternion_rate

DEFAULT_INTEGRATION_STEP = 0.01
"""Longest Runge-Kutta step for the attitude under held joint velocities, s."""

Expression = TypeVar("Expression", ca.SX, ca.MX)


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


def runge_kutta(
    rate: Callable[[float, Expression], Expression], x: Expression, h: Expression
) -> Expression:
    """Return ``x`` after a step ``h`` without normalisation; ``rate(share, x)`` is the derivative
    at a share of the step."""
    k1 = rate(0.0, x)
    k2 = rate(0.5, x + h / 2 * k1)
    k3 = rate(0.5, x + h / 2 * k2)
    k4 = rate(1.0, x + h * k3)
    return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


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
    x_next = runge_kutta(lambda _, at: rate(at, *held), x, h)
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
    shapes = {share: locked_inertia(q + share * h * qdot, *p) for share in (0.0, 0.5, 1.0)}

    def rate(share: float, at: ca.SX) -> ca.SX:
        D, D_q = shapes[share]
        L_B = matrix_from_quaternion(at).T @ L_W - D_q @ qdot
        # The factor needs no roots and a quarter of the divisions, which take most of the time in
        # vector registers. Recorded flights used Cholesky's, which is equal up to rounding.
        solve = SymmetricFactor(D).solve if p else partial(solve_positive_definite, D)
        return quaternion_rate(at, solve(L_B))

    turned = runge_kutta(rate, quaternion, h)
    x_next = ca.vertcat(q + h * qdot, turned / ca.norm_2(turned))
    return ca.Function("attitude_step", [x, qdot, L_W, h, *p], [ca.cse(x_next)])


def _symbols_for_inputs(function: ca.Function) -> tuple[ca.MX, list[ca.MX]]:
    x, *held = (
        ca.MX.sym(function.name_in(i), function.size1_in(i)) for i in range(function.n_in())
    )
    return x, held


# -- rates ---------------------------------------------------------------------------------------


def state_slices(n: int) -> tuple[slice, ...]:
    """Return the state slices of ``q, quaternion_WB, qdot, p_W, L_W, r_WC_W``."""
    ends = [n, n + 4, 2 * n + 4, 2 * n + 7, 2 * n + 10, 2 * n + 13]
    return tuple(slice(a, b) for a, b in zip([0, *ends], ends, strict=False))


def shape_equations(kin: TreeKinematics, *, loaded: bool) -> ca.Function:
    """Return the function ``(x, command) -> (K, Q)`` of ``K qddot = Q``."""
    inputs, K, Q, *_ = _equations(kin, loaded=loaded)
    name = "loaded_shape_equations" if loaded else "shape_equations"
    return dense_function(name, inputs | kin.mass_properties.inputs, {"K": K, "Q": Q})


def state_rate(kin: TreeKinematics, *, holding: bool, loaded: bool) -> ca.Function:
    """Return the function ``(x, command) -> x_dot``.

    If ``holding``, the function takes a third argument ``free`` (n,): 1 for a moving joint, 0 for a
    joint held at its current rate. If ``loaded``, external loads are included.
    """
    inputs, K, Q, rates, later_rates = _equations(kin, loaded=loaded)
    if holding:
        inputs["free"] = free = ca.SX.sym("free", kin.n)
        # A held joint is absent from the equations of other joints; its own equation is qddot = 0.
        diagonal = ca.diag(K)
        K, Q = K * (free @ free.T), Q * free
        for j in range(kin.n):
            K[j, j] = diagonal[j]
    x_dot = ca.vertcat(*rates, SymmetricFactor(K).solve(Q), *later_rates)
    name = "holding_rate" if holding else "flight_rate"
    inputs |= kin.mass_properties.inputs
    return dense_function(f"loaded_{name}" if loaded else name, inputs, {"x_dot": x_dot})


def servo_rate(kin: TreeKinematics) -> ca.Function:
    """Return the function ``(x, qdot, loads) -> x_dot`` for a robot whose servos hold ``qdot``
    under external loads.

    ``x = [q; quaternion_WB; p_W; L_W; r_WC_W; time]``, (n + 14,); ``loads`` is a vector laid out by
    :class:`.LoadLayout`.
    """
    parts = {"quaternion": 4, "p_W": 3, "L_W": 3, "r_WC_W": 3, "time": 1}
    symbols = {name: ca.SX.sym(name, count) for name, count in parts.items()}
    quaternion, p_W, L_W, r_WC_W, time = symbols.values()
    qdot = ca.SX.sym("qdot", kin.n)
    vector = ca.SX.sym("loads", LoadLayout(len(kin.robot.links)).size)
    bodies = composites(kin)
    loads = external_loads(bodies, quaternion, r_WC_W, vector, time)
    R_WB = matrix_from_quaternion(quaternion)
    omega = SymmetricFactor(bodies.D).solve(R_WB.T @ L_W - bodies.D_q @ qdot)
    x_dot = ca.vertcat(
        qdot,
        quaternion_rate(quaternion, omega),
        *loads.momentum_rates(R_WB, p_W, L_W, kin.total_mass),
        p_W / kin.total_mass,
        1.0,
    )
    x = ca.vertcat(kin.q, *symbols.values())
    inputs = {"x": x, "qdot": qdot, "loads": vector, **kin.mass_properties.inputs}
    return dense_function("loaded_servo_rate", inputs, {"x_dot": x_dot})


def _equations(
    kin: TreeKinematics, *, loaded: bool
) -> tuple[dict[str, ca.SX], ca.SX, ca.SX, list[ca.SX], list[ca.SX]]:
    """Return the symbols ``x`` and ``command`` by name, ``K``, ``Q``, and the components of
    ``x_dot`` before and after ``qddot``."""
    sizes = {"quaternion": 4, "qdot": kin.n, "p_W": 3, "L_W": 3, "r_WC_W": 3}
    symbols = [ca.SX.sym(name, size) for name, size in sizes.items()]
    quaternion, qdot, p_W, L_W, r_WC_W = symbols
    command = ca.SX.sym("command", kin.n + 6)
    tau, wrench_B = command[: kin.n], command[kin.n :]
    x = ca.vertcat(kin.q, *symbols)
    system, loads = shape_system(kin), ExternalLoads.none(kin)
    if loaded:
        vector = ca.SX.sym("loads", LoadLayout(len(kin.robot.links)).size)
        time = ca.SX.sym("time")
        loads = external_loads(system.parts, quaternion, r_WC_W, vector, time)
        x, command = ca.vertcat(x, time), ca.vertcat(command, vector)
    external, R_WB = external_force(kin, wrench_B), matrix_from_quaternion(quaternion)
    omega = system.base_motion(R_WB.T @ L_W, qdot)
    Q, _ = shape_forces(system, omega, qdot, external, tau, loads)
    p_dot, L_dot = loads.momentum_rates(R_WB, p_W, L_W, kin.total_mass)
    later = [R_WB @ external[3:] + p_dot, R_WB @ external[:3] + L_dot, p_W / kin.total_mass]
    inputs, rates = {"x": x, "command": command}, [qdot, quaternion_rate(quaternion, omega)]
    return inputs, system.K, Q, rates, [*later, 1.0] if loaded else later


# -- external loads ------------------------------------------------------------------------------


class LoadLayout:
    """Slices of the load vector for a robot with L links.

    Attributes
    ----------
    in_link, in_world
        Force (N) and torque (N m) at the origin of every link, in link components and in W
        components: (6 L,) each.
    mean_motion
        Mean motion of the orbit, rad/s; zero if there is no gravity gradient.
    quaternion_WO
        Attitude (x, y, z, w) of the orbital frame in W at time zero.
    gravity_W
        Uniform acceleration (3,), m/s^2.
    friction
        Viscous friction force on a body divided by the body's momentum, 1/s.
    time
        Time at the beginning of the tick, s.
    size
        Length of the vector.
    """

    def __init__(self, links: int) -> None:
        ends = np.cumsum([6 * links, 6 * links, 1, 4, 3, 1, 1]).tolist()
        self.in_link, self.in_world, self.mean_motion, self.quaternion_WO, *rest = map(
            slice, [0, *ends], ends
        )
        self.gravity_W, self.friction, self.time = rest
        self.size: int = ends[-1]


def external_loads(
    parts: Composites, quaternion: ca.SX, r_WC_W: ca.SX, loads: ca.SX, time: ca.SX
) -> ExternalLoads:
    """Return the loads in a state.

    Parameters
    ----------
    parts
        The composites, in the base frame.
    quaternion
        (4,) of ``R_WB``.
    r_WC_W
        (3,) position of the system's centre of mass, m.
    loads
        The vector of :class:`LoadLayout`.
    time
        Time, s.
    """
    kin, links = parts.kin, [link.name for link in parts.kin.robot.links]
    layout = LoadLayout(len(links))
    R_BW = matrix_from_quaternion(quaternion).T
    forces = [ca.SX(6, 1) for _ in kin.robot.bodies]
    in_link, in_world = (
        ca.reshape(loads[part], 6, len(links)) for part in (layout.in_link, layout.in_world)
    )
    for i, link in enumerate(links):
        R_BL, r_BL_B, body = kin.frame(link)
        force = R_BL @ in_link[:3, i] + R_BW @ in_world[:3, i]
        torque = R_BL @ in_link[3:, i] + R_BW @ in_world[3:, i]
        forces[body] += ca.vertcat(torque + ca.cross(r_BL_B - kin.r_BC_B, force), force)
    n = loads[layout.mean_motion]
    angle = n * time
    radius_O = ca.vertcat(ca.cos(angle), ca.sin(angle), 0)
    o = R_BW @ (matrix_from_quaternion(loads[layout.quaternion_WO]) @ radius_O)
    r_WC_B = R_BW @ r_WC_W
    for k, J in enumerate(parts.J):
        arm = kin.com[k] - kin.r_BC_B
        r = r_WC_B + arm
        force = kin.mass(k) * n**2 * (3 * ca.dot(o, r) * o - r)
        moment = ca.cross(arm, force) + 3 * n**2 * ca.cross(o, rotational(J) @ o)
        forces[k] += ca.vertcat(moment, force)
    for k in range(kin.moving_body_count, 0, -1):
        forces[kin.parent(k)] += forces[k]
    return ExternalLoads(tuple(forces), loads[layout.gravity_W], loads[layout.friction])
