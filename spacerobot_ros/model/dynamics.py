"""The papers' equations in closed form: dynamics (paper 4), connection (papers 1 and 2).

Equations of motion ``H+ zddot + C+ = Q`` (paper 4, eqs 8-10 and 18-21). The independent velocities
are ``z0dot = [v_cm; omega; qdot]``, of which the first two are in the base frame (eq. 8), so that
the equations do not depend on the robot pose. Inertias are composite-rigid-body inertias
(:mod:`.composite_rigid_body`).

Momentum determines the base motion: at zero total momentum, the base moves only if the shape
changes, by the mechanical connection ``[v; omega]_B = -A(q) qdot`` (paper 1). A closed shape loop
causes a net base motion: to first order, the curvature times the loop area (paper 2).
"""

from __future__ import annotations

import casadi as ca

from spacerobot_ros.model.composite_rigid_body import Composites, SymmetricFactor, motion_forces
from spacerobot_ros.model.kinematics import TreeKinematics


def point_jacobian(kin: TreeKinematics, link: str) -> ca.SX:
    """Return ``0J+`` (6, 6 + n) for the origin of a link frame, eq. (10), in the base frame.

    The matrix maps ``[v_cm; omega; qdot]`` to the linear velocity of the point and the angular
    velocity of its body. ``J_12`` is the derivative of ``rho = sum_i v_ik,m`` with respect to q;
    for revolute joints, it is the paper's ``-sum_i skew(v_ik,m) F_i``.
    """
    _, point, body = kin.frame(link)
    rho = point - kin.r_BC_B
    J_11 = -ca.skew(rho)
    J_12 = ca.jacobian(rho, kin.q)
    J_22 = kin.angular_jacobian(body)
    return ca.blockcat([[ca.SX.eye(3), J_11, J_12], [ca.SX(3, 3), ca.SX.eye(3), J_22]])


def bias(parts: Composites, v_cm: ca.SX, omega: ca.SX, qdot: ca.SX) -> ca.SX:
    """Return ``C+`` (6 + n,) by d'Alembert's principle: the generalised force that keeps ``z0ddot``
    at zero, so that the centre of mass accelerates only by ``omega x v_cm``.
    """
    kin = parts.kin
    f = motion_forces(parts, omega, qdot)
    # There, the base origin does not accelerate, but the centre of mass does.
    acceleration = f[0][3:] * kin.per_mass
    along = (
        ca.dot(S, force) - ca.dot(P[3:], acceleration)
        for S, P, force in zip(parts.S[1:], parts.P[1:], f[1:], strict=True)
    )
    rows = kin.gather(ca.vertcat(*along))
    return ca.vertcat(kin.total_mass * ca.cross(omega, v_cm), f[0][:3], rows)


def solve_positive_definite(matrix: ca.SX, right: ca.SX) -> ca.SX:
    """Solve ``matrix x = right`` for a symmetric positive definite matrix (Cholesky)."""
    upper = ca.chol(matrix)
    return ca.solve(upper, ca.solve(upper.T, right))


def momentum_of_bodies(
    kin: TreeKinematics, v_WB_B: ca.SX, omega_WB_B: ca.SX, qdot: ca.SX
) -> tuple[ca.SX, ca.SX, ca.SX]:
    """Return the linear momentum (3,), the angular momentum about the system's centre of mass (3,)
    and the kinetic energy, in the base frame, summed body by body.

    ``H+`` is not used: the result is an independent check of the motion.
    """
    linear, angular, energy = ca.SX(3, 1), ca.SX(3, 1), ca.SX(0)
    qdot = kin.spread(qdot)
    omegas, origin_velocities = [omega_WB_B], [v_WB_B]
    for k in range(1, kin.moving_body_count + 1):
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
        spin = kin.mass_properties.inertia(k, kin.R[k]) @ omega
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
    """Return ``(v_WB_B, omega_WB_B)`` for linear momentum ``p_B`` (kg m/s) and angular
    momentum ``L_B`` about the system's centre of mass (kg m^2/s), both in the base frame.

    If both are zero, the result is ``-A(q) qdot``.
    """
    excess = L_B - inertia.D_q @ qdot
    if kin.mass_properties.inputs:
        omega = SymmetricFactor(inertia.D).solve(excess)
    else:
        omega = solve_positive_definite(inertia.D, excess)
    c = kin.r_BC_B
    v = p_B / kin.total_mass - ca.cross(omega, c) - ca.jtimes(c, kin.q, qdot)
    return v, omega


def connection(kin: TreeKinematics, inertia: Composites) -> ca.SX:
    """Return ``A(q)`` (6, n) in ``[v_WB_B; omega_WB_B] = -A(q) qdot`` at zero momentum (papers 1,
    3).

    The lower half is ``D^-1 D_q``; the upper half keeps the system's centre of mass at rest:
    ``v = -omega x c - dc/dq qdot`` with ``c = r_BC_B``.
    """
    A_omega = solve_positive_definite(inertia.D, inertia.D_q)
    A_v = ca.skew(kin.r_BC_B) @ A_omega + ca.jacobian(kin.r_BC_B, kin.q)
    return ca.vertcat(A_v, A_omega)


def curvature(A: ca.SX, q: ca.SX) -> list[list[ca.SX]]:
    """Return the curvature ``K[i][j]`` (6,) of ``qdot -> [v; omega]_B = F qdot``, ``F = -A``.

    ``K_ij = dF_j/dq_i - dF_i/dq_j + [F_i, F_j]``. A small counter-clockwise loop in the plane
    (q_i, q_j) moves the base by ``exp(K_ij * area)`` in body coordinates (paper 2, plus the bracket
    that the paper's flat surface integral omits).
    """
    F = -A
    n = q.shape[0]
    # All columns at once: their derivatives share most of their operations.
    dF = [ca.reshape(each, 6, n) for each in ca.vertsplit(ca.jacobian(ca.vec(F), q), 6)]
    K = [[ca.SX(6, 1) for _ in range(n)] for _ in range(n)]
    for i in range(n):
        for j in range(i + 1, n):
            a, b = F[:, i], F[:, j]
            bracket = ca.vertcat(
                ca.cross(a[3:], b[:3]) + ca.cross(a[:3], b[3:]), ca.cross(a[3:], b[3:])
            )
            K[i][j] = dF[j][:, i] - dF[i][:, j] + bracket
            K[j][i] = -K[i][j]
    return K


def momentum_derivatives(
    parts: Composites, omega: ca.SX, qdot: ca.SX, eta: ca.SX
) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX]:
    """Return the derivatives at a configuration and zero linear momentum: ``dL/dq`` (3, n) of the
    angular momentum L, and the second derivatives of ``eta' L`` with respect to q and q (n, n), q
    and qdot (n, n), and q and omega (n, 3).

    ``eta' L`` is a sum over the bodies of products of two motions: ``rigid``, the rotation of the
    whole system at ``eta``, and ``motion``, at ``omega`` and ``qdot``. If joint i moves, the former
    changes by ``a_i`` and the latter, at the joint, by ``b_i``; the momenta of the bodies that the
    joint carries change by ``y1_i`` and ``y2_i``. Second derivatives for joints on different
    branches are zero, except for products of linear momenta, which keep the centre of mass at rest.
    The formulas, derived in docs/theory/model.md, need a tenth of the operations of CasADi's
    derivatives.

    Parameters
    ----------
    parts
        The composites at the configuration.
    omega, qdot
        Angular velocity (3,) of the base, in the base frame, and joint rates (n,).
    eta
        (3,) weights of the momentum components.
    """
    kin, S, P = parts.kin, parts.S, parts.P
    joints = range(1, kin.moving_body_count + 1)
    rates = kin.spread(qdot)
    linear = sum((P[k][3:] * rates[k - 1] for k in joints), ca.SX(3, 1))
    rigid = ca.vertcat(eta, ca.SX(3, 1))
    motion = {0: ca.vertcat(omega, -linear * kin.per_mass)}
    for k in joints:
        motion[k] = motion[kin.parent(k)] + S[k] * rates[k - 1]
    # Momenta of the bodies beyond joint k due to the joints beyond it.
    beyond = {k: ca.SX(6, 1) for k in range(len(joints) + 1)}
    for k in reversed(joints):
        beyond[kin.parent(k)] += beyond[k] + P[k] * rates[k - 1]
    a, b, y1, y2 = ({} for _ in range(4))
    for k in joints:
        inertia = parts.composite[k]
        a[k], b[k] = _cross_motion(rigid, S[k]), _cross_motion(motion[kin.parent(k)], S[k])
        y1[k] = _cross_force(S[k], inertia @ rigid) + inertia @ a[k]
        y2[k] = _cross_force(S[k], inertia @ motion[k] + beyond[k]) + inertia @ b[k]

    m = len(joints)
    by_q_q, by_q_qdot = ca.SX(m, m), ca.SX(m, m)
    for j in joints:
        carriers = kin.ancestors(j)
        for i in joints:
            by_q_qdot[i - 1, j - 1] -= ca.dot(y1[i][3:], P[j][3:]) * kin.per_mass
            if i > j:
                continue
            shared = ca.dot(y1[i][3:], y2[j][3:]) + ca.dot(y2[i][3:], y1[j][3:])
            value = -shared * kin.per_mass
            if i in carriers:
                value += ca.dot(a[i], y2[j]) + ca.dot(b[i], y1[j])
                by_q_qdot[i - 1, j - 1] += ca.dot(a[i], P[j])
                if i != j:
                    by_q_qdot[j - 1, i - 1] += ca.dot(S[i], y1[j])
            by_q_q[i - 1, j - 1] = by_q_q[j - 1, i - 1] = value

    def columns(of: dict[int, ca.SX]) -> ca.SX:
        return ca.horzcat(ca.SX(3, 0), *(of[k][:3] for k in joints))

    return (
        kin.gather(columns(y2).T).T,
        kin.gather(kin.gather(by_q_q).T),
        kin.gather(kin.gather(by_q_qdot).T).T,
        kin.gather(columns(y1).T),
    )


def _cross_motion(V: ca.SX, S: ca.SX) -> ca.SX:
    """Return the motion ``V x S`` (6,) (Featherstone, eq. 2.31)."""
    return ca.vertcat(ca.cross(V[:3], S[:3]), ca.cross(V[3:], S[:3]) + ca.cross(V[:3], S[3:]))


def _cross_force(V: ca.SX, h: ca.SX) -> ca.SX:
    """Return the force ``V x* h`` (6,) (Featherstone, eq. 2.32)."""
    return ca.vertcat(ca.cross(V[:3], h[:3]) + ca.cross(V[3:], h[3:]), ca.cross(V[:3], h[3:]))
