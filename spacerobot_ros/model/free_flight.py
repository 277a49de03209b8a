"""Motion under joint efforts and a base wrench, with the total momenta among the states.

The state is ``x = [q; quaternion_WB; qdot; p_W; L_W; r_WC_W]``, (2 n + 13,): shape, attitude
(x, y, z, w), joint rates, total linear momentum (kg m/s), total angular momentum about the system's
centre of mass (kg m^2/s), and position of that centre (m), the last three in W. The base's
twist is no state: it follows from the momenta and the joint rates. What no thruster changes is
therefore constant to the last bit, whatever the step:

* ``p_W_dot = R_WB f``, ``L_W_dot = R_WB (n + (r_origin - c) x f)``, ``r_WC_W_dot = p_W / M``;
* ``K qddot = Q`` at the ``omega_WB_B`` that the momenta imply
  (:mod:`spacerobot_ros.model.composite_rigid_body`).

The command is ``[tau; f; n]``, (n + 6,): joint efforts (N or N m), then force (N) and torque (N m)
at the origin of the base link, base components. The attitude is integrated in R^4 and normalised
after each Runge-Kutta step.
"""

from __future__ import annotations

import casadi as ca

from spacerobot_ros.model.compilation import dense_function
from spacerobot_ros.model.composite_rigid_body import (
    Factor,
    ShapeSystem,
    external_force,
    shape_forces,
    shape_system,
)
from spacerobot_ros.model.kinematics import TreeKinematics
from spacerobot_ros.model.momentum import rotation_from_quaternion
from spacerobot_ros.model.reconstruction import quaternion_rate


def state_slices(n: int) -> tuple[slice, ...]:
    """Return where ``q, quaternion_WB, qdot, p_W, L_W, r_WC_W`` are in the state."""
    ends = [n, n + 4, 2 * n + 4, 2 * n + 7, 2 * n + 10, 2 * n + 13]
    return tuple(slice(a, b) for a, b in zip([0, *ends], ends, strict=False))


def shape_equations(kin: TreeKinematics) -> ca.Function:
    """Return the function ``(x, command) -> (K, Q)`` of ``K qddot = Q``."""
    x, command = _symbols(kin)
    system, _, _, Q = _equations(kin, x, command)
    names = (["x", "command"], ["K", "Q"])
    return dense_function("shape_equations", [x, command], [system.K, Q], names)


def state_rate(kin: TreeKinematics, *, holding: bool = False) -> ca.Function:
    """Return the function ``(x, command) -> x_dot``.

    With ``holding`` it takes a third argument ``free`` (n,): 1 for a joint that moves, 0 for one
    that something holds at the rate it has.
    """
    x, command = _symbols(kin)
    free = ca.SX.sym("free", kin.n) if holding else ca.DM.ones(kin.n)
    _, quaternion, qdot, p_W, _, _ = (x[part] for part in state_slices(kin.n))
    system, omega, external, Q = _equations(kin, x, command)
    # A held joint takes no part in the others' equations, and its own says that qddot is zero.
    K = system.K * (free @ free.T)
    for j in range(kin.n):
        K[j, j] = system.K[j, j]
    R_WB = rotation_from_quaternion(quaternion)
    x_dot = ca.vertcat(
        qdot,
        quaternion_rate(quaternion, omega),
        Factor(K).solve(Q * free),
        R_WB @ external[3:],
        R_WB @ external[:3],
        p_W / kin.robot.total_mass,
    )
    if holding:
        names = ["x", "command", "free"]
        return dense_function("holding_rate", [x, command, free], [x_dot], (names, ["x_dot"]))
    return dense_function("flight_rate", [x, command], [x_dot], (["x", "command"], ["x_dot"]))


def _symbols(kin: TreeKinematics) -> tuple[ca.SX, ca.SX]:
    parts = [
        kin.q if name == "q" else ca.SX.sym(name, part.stop - part.start)
        for name, part in zip(
            ("q", "quaternion", "qdot", "p_W", "L_W", "r_WC_W"), state_slices(kin.n), strict=True
        )
    ]
    return ca.vertcat(*parts), ca.SX.sym("command", kin.n + 6)


def _equations(
    kin: TreeKinematics, x: ca.SX, command: ca.SX
) -> tuple[ShapeSystem, ca.SX, ca.SX, ca.SX]:
    """Return the shape's system, ``omega_WB_B``, the external moment over force, and ``Q``."""
    _, quaternion, qdot, _, L_W, _ = (x[part] for part in state_slices(kin.n))
    tau, wrench_B = command[: kin.n], command[kin.n :]
    system = shape_system(kin)
    external = external_force(kin, wrench_B)
    omega = system.base_rate(rotation_from_quaternion(quaternion).T @ L_W, qdot)
    Q, _ = shape_forces(system, omega, qdot, external, tau)
    return system, omega, external, Q
