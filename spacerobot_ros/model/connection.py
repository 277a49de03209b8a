"""Momentum, the base motion that it implies, and the mechanical connection (papers 1 and 2).

With zero total momentum the base moves only because the shape does: ``[v; omega]_B = -A(q) qdot``.
A closed loop of the shape leaves a net motion of the base: to first order, the curvature times
the area of the loop.
"""

from __future__ import annotations

import casadi as ca

from spacerobot_ros.model.composite_rigid_body import Composites, Factor
from spacerobot_ros.model.dynamics import solve_positive_definite
from spacerobot_ros.model.kinematics import TreeKinematics


def momentum_of_bodies(
    kin: TreeKinematics, v_WB_B: ca.SX, omega_WB_B: ca.SX, qdot: ca.SX
) -> tuple[ca.SX, ca.SX, ca.SX]:
    """Return linear momentum (3,), angular momentum about the system's centre of mass (3,) and
    kinetic energy, in base components, summed body by body.

    This does not go through ``H+``: it is the momentum balance that the motion is held against.
    """
    linear, angular, energy = ca.SX(3, 1), ca.SX(3, 1), ca.SX(0)
    qdot = kin.spread(qdot)
    omegas, origin_velocities = [omega_WB_B], [v_WB_B]
    for k in range(1, kin.moving + 1):
        parent = kin.parent(k)
        v = origin_velocities[parent] + ca.cross(omegas[parent], kin.p[k] - kin.p[parent])
        omega = omegas[parent]
        if kin.is_revolute(k):
            omega = omega + kin.axis[k] * qdot[k - 1]
        else:
            v = v + kin.axis[k] * qdot[k - 1]
        omegas.append(omega)
        origin_velocities.append(v)
    for k, (v, omega) in enumerate(zip(origin_velocities, omegas, strict=True)):
        v_com = v + ca.cross(omega, kin.com[k] - kin.p[k])
        spin = kin.inertia[k] @ omega
        linear = linear + kin.mass(k) * v_com
        angular = angular + spin + kin.mass(k) * ca.cross(kin.com[k] - kin.r_BC_B, v_com)
        energy = energy + (ca.dot(omega, spin) + kin.mass(k) * ca.dot(v_com, v_com)) / 2
    return linear, angular, energy


def base_twist(
    kin: TreeKinematics,
    inertia: Composites,
    qdot: ca.SX,
    p_B: ca.SX,
    L_B: ca.SX,
) -> tuple[ca.SX, ca.SX]:
    """Return ``(v_WB_B, omega_WB_B)`` that carry linear momentum ``p_B`` (kg m/s) and angular
    momentum ``L_B`` about the system's centre of mass (kg m^2/s), both in base components.

    With both zero it is ``-A(q) qdot``.
    """
    excess = L_B - inertia.D_q @ qdot
    if kin.mass_properties.inputs:
        omega = Factor(inertia.D).solve(excess)
    else:
        omega = solve_positive_definite(inertia.D, excess)
    c = kin.r_BC_B
    v = p_B / inertia.mass - ca.cross(omega, c) - ca.jtimes(c, kin.q, qdot)
    return v, omega


def connection(kin: TreeKinematics, inertia: Composites) -> ca.SX:
    """Return ``A(q)`` (6, n) of ``[v_WB_B; omega_WB_B] = -A(q) qdot``, zero momentum (paper 1, 3).

    The lower half is ``D^-1 D_q``; the upper keeps the system's centre of mass at rest:
    ``v = -omega x c - dc/dq qdot`` with ``c = r_BC_B``.
    """
    A_omega = solve_positive_definite(inertia.D, inertia.D_q)
    A_v = ca.skew(kin.r_BC_B) @ A_omega + ca.jacobian(kin.r_BC_B, kin.q)
    return ca.vertcat(A_v, A_omega)


def body_bracket(a: ca.SX, b: ca.SX) -> ca.SX:
    """Return the se(3) bracket of two body twists ``[v; omega]``, each (6,)."""
    return ca.vertcat(
        ca.cross(a[3:], b[:3]) + ca.cross(a[:3], b[3:]),
        ca.cross(a[3:], b[3:]),
    )


def curvature(A: ca.SX, q: ca.SX) -> list[list[ca.SX]]:
    """Return the curvature ``K[i][j]`` (6,) of ``qdot -> [v; omega]_B = F qdot``, ``F = -A``.

    ``K_ij = dF_j/dq_i - dF_i/dq_j + [F_i, F_j]``. A small loop counter-clockwise in the plane
    (q_i, q_j) moves the base by ``exp(K_ij * area)`` in body coordinates (paper 2, with the
    bracket that its flat surface integral leaves out).
    """
    F = -A
    n = q.shape[0]
    dF = [ca.reshape(ca.jacobian(F[:, j], q), 6, n) for j in range(n)]
    K = [[ca.SX(6, 1) for _ in range(n)] for _ in range(n)]
    for i in range(n):
        for j in range(i + 1, n):
            K[i][j] = dF[j][:, i] - dF[i][:, j] + body_bracket(F[:, i], F[:, j])
            K[j][i] = -K[i][j]
    return K
