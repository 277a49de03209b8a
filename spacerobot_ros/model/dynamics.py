"""Equations of motion under forces (paper 4, eqs 18, 19 and 21): ``H+ zddot + C+ = Q``.

The independent velocities are ``z0dot = [v_cm; omega; qdot]``, the first two in base components
(eq. 8), so that nothing depends on where the robot is or how it is turned.
"""

from __future__ import annotations

import casadi as ca

from spacerobot_ros.model.barycentric import BarycentricInertia, point_jacobian
from spacerobot_ros.model.connection import solve_positive_definite
from spacerobot_ros.model.kinematics import TreeKinematics


def bias(kin: TreeKinematics, v_cm: ca.SX, omega: ca.SX, qdot: ca.SX) -> ca.SX:
    """Return ``C+`` (6 + n,) by d'Alembert: the generalised force that keeps ``z0ddot`` at zero.

    Outward recursion of the velocity-product accelerations, inward sum of their inertia forces.
    Accelerations are taken relative to the system's centre of mass, whose own is ``omega x v_cm``.
    """
    M = kin.robot.total_mass
    omegas, alphas, accelerations = [omega], [ca.SX(3, 1)], [ca.SX(3, 1)]
    for k in range(1, kin.n + 1):
        i = kin.parent(k)
        arm = kin.p[k] - kin.p[i]
        rate = kin.axis[k] * qdot[k - 1]
        acceleration = (
            accelerations[i]
            + ca.cross(alphas[i], arm)
            + ca.cross(omegas[i], ca.cross(omegas[i], arm))
        )
        if kin.is_revolute(k):
            omegas.append(omegas[i] + rate)
            alphas.append(alphas[i] + ca.cross(omegas[i], rate))
        else:
            omegas.append(omegas[i])
            alphas.append(alphas[i])
            acceleration = acceleration + 2 * ca.cross(omegas[i], rate)
        accelerations.append(acceleration)

    com_accelerations = []
    for k in range(kin.n + 1):
        arm = kin.com[k] - kin.p[k]
        com_accelerations.append(
            accelerations[k]
            + ca.cross(alphas[k], arm)
            + ca.cross(omegas[k], ca.cross(omegas[k], arm))
        )
    mean = sum((kin.mass(k) / M * a for k, a in enumerate(com_accelerations)), ca.SX(3, 1))

    # Force and moment about the system's centre of mass of each body, then of all it carries.
    forces, moments = [], []
    for k, a in enumerate(com_accelerations):
        force = kin.mass(k) * (a - mean)
        spin = kin.inertia[k] @ omegas[k]
        forces.append(force)
        moments.append(
            ca.cross(kin.com[k] - kin.r_BC_B, force)
            + kin.inertia[k] @ alphas[k]
            + ca.cross(omegas[k], spin)
        )
    joint_rows = [ca.SX(1, 1) for _ in range(kin.n)]
    for k in range(kin.n, 0, -1):
        if kin.is_revolute(k):
            about_joint = moments[k] - ca.cross(kin.p[k] - kin.r_BC_B, forces[k])
            joint_rows[k - 1] = ca.dot(kin.axis[k], about_joint)
        else:
            joint_rows[k - 1] = ca.dot(kin.axis[k], forces[k])
        i = kin.parent(k)
        forces[i] = forces[i] + forces[k]
        moments[i] = moments[i] + moments[k]
    return ca.vertcat(M * ca.cross(omega, v_cm), moments[0], *joint_rows)


def generalised_forces(kin: TreeKinematics, wrench_B: ca.SX, tau: ca.SX) -> ca.SX:
    """Return ``Q`` (6 + n,), eqs (18) and (21), of a wrench on the base and of joint efforts.

    ``wrench_B`` is force (N) over torque (N m) at the origin of the base link, in base components.
    """
    J_base = point_jacobian(kin, kin.robot.base_link)
    return J_base.T @ wrench_B + ca.vertcat(ca.SX(6, 1), tau)


def forward_dynamics(inertia: BarycentricInertia, C_plus: ca.SX, Q: ca.SX) -> ca.SX:
    """Return ``z0ddot = H+^-1 (Q - C+)`` (6 + n,), eq. (19).

    The translation of the centre of mass decouples; rotation and shape are solved together.
    """
    force = Q - C_plus
    H = ca.blockcat([[inertia.D, inertia.D_q], [inertia.D_q.T, inertia.D_qq]])
    return ca.vertcat(force[:3] / inertia.mass, solve_positive_definite(H, force[3:]))
