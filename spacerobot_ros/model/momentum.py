"""Momentum of the whole system and the base motion that it implies."""

from __future__ import annotations

import casadi as ca

from spacerobot_ros.model.barycentric import BarycentricInertia
from spacerobot_ros.model.connection import solve_positive_definite
from spacerobot_ros.model.kinematics import TreeKinematics


def rotation_from_quaternion(quaternion: ca.SX) -> ca.SX:
    """Return ``R_WB`` (3, 3) of a unit quaternion (x, y, z, w)."""
    x, y, z, w = ca.vertsplit(quaternion)
    return ca.blockcat(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def momentum_of_bodies(
    kin: TreeKinematics, v_WB_B: ca.SX, omega_WB_B: ca.SX, qdot: ca.SX
) -> tuple[ca.SX, ca.SX, ca.SX]:
    """Return linear momentum (3,), angular momentum about the system's centre of mass (3,) and
    kinetic energy, in base components, summed body by body.

    This does not go through ``H+``: it is the ledger that the motion is held against.
    """
    linear, angular, energy = ca.SX(3, 1), ca.SX(3, 1), ca.SX(0)
    omegas, origin_velocities = [omega_WB_B], [v_WB_B]
    for k in range(1, kin.n + 1):
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
    inertia: BarycentricInertia,
    qdot: ca.SX,
    p_B: ca.SX,
    L_B: ca.SX,
) -> tuple[ca.SX, ca.SX]:
    """Return ``(v_WB_B, omega_WB_B)`` that carry linear momentum ``p_B`` (kg m/s) and angular
    momentum ``L_B`` about the system's centre of mass (kg m^2/s), both in base components.

    With both zero it is ``-A(q) qdot``.
    """
    omega = solve_positive_definite(inertia.D, L_B - inertia.D_q @ qdot)
    c = kin.r_BC_B
    v = p_B / inertia.mass - ca.cross(omega, c) - ca.jtimes(c, kin.q, qdot)
    return v, omega
