"""Equations of the papers in closed form: dynamics (paper 4), connection (papers 1 and 2).

Inertia and equations of motion, ``H+ zddot + C+ = Q`` (paper 4, eqs 1-3, 8-10 and 14-21). The
independent velocities are ``z0dot = [v_cm; omega; qdot]``, the first two in base components
(eq. 8), so that nothing depends on where the robot is or how it is turned. The paper writes
barycentric vectors for a chain of revolute joints. Here they stand for any tree: the vector from
the mass centre of body i to its joint *towards body k* takes the place of the paper's ``r_i`` (k
outboard) and ``l_i`` (k inboard). A prismatic joint makes that vector grow along its axis, which
adds the slide terms below; without prismatic joints they vanish and the paper's formulas remain.

Momentum, and the base motion that it implies. With zero total momentum the base moves only because
the shape does: ``[v; omega]_B = -A(q) qdot``, the mechanical connection (paper 1). A closed loop of
the shape leaves a net motion of the base: to first order, the curvature times the area of the loop
(paper 2).
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from spacerobot_ros.model.composite_rigid_body import Composites, SymmetricFactor, inertia_matrix
from spacerobot_ros.model.kinematics import TreeKinematics


@dataclass(frozen=True)
class BarycentricInertia:
    """Blocks of ``H+`` (eq. 15) in base components.

    ``D`` (3, 3) system inertia about the system's centre of mass, ``D_q`` (3, n), ``D_qq``
    (n, n); ``v[i][k]`` are the barycentric vectors, each (3,).
    """

    mass: float | ca.SX
    D: ca.SX
    D_q: ca.SX
    D_qq: ca.SX
    v: tuple[tuple[ca.SX, ...], ...]

    @property
    def H_plus(self) -> ca.SX:
        """The inertia matrix (6 + n, 6 + n) of ``[v_cm; omega; qdot]``, eq. (15)."""
        return inertia_matrix(self.mass, self.D, self.D_q, self.D_qq)


def barycentric_vectors(kin: TreeKinematics) -> tuple[tuple[ca.SX, ...], ...]:
    """Return ``v[i][k]``, eqs (3a) and (3b): ``rho_k = sum_i v[i][k]`` is the mass centre of body k
    from that of the system, base components.
    """
    bodies = range(kin.moving_body_count + 1)
    M = kin.total_mass
    outboard = [set(kin.outboard(k)) for k in bodies]
    # towards[i][j]: vector from the mass centre of i to its joint with neighbour j, and the mass
    # beyond that joint.
    towards: list[dict[int, tuple[ca.SX, float | ca.SX]]] = [{} for _ in bodies]
    for k in bodies[1:]:
        i = kin.parent(k)
        beyond = sum(kin.mass(b) for b in outboard[k])
        towards[i][k] = (kin.p[k] - kin.com[i], beyond)
        towards[k][i] = (kin.p[k] - kin.com[k], M - beyond)
    c = [sum((d * (m / M) for d, m in towards[i].values()), ca.SX(3, 1)) for i in bodies]

    def next_body(i: int, k: int) -> int:
        if k not in outboard[i]:
            return kin.parent(i)
        return next(j for j in towards[i] if j != kin.parent(i) and k in outboard[j])

    return tuple(
        tuple(-c[i] if i == k else towards[i][next_body(i, k)][0] - c[i] for k in bodies)
        for i in bodies
    )


def barycentric_inertia(kin: TreeKinematics) -> BarycentricInertia:
    """Return the blocks of ``H+`` (eqs 14-17), with the slide terms of prismatic joints."""
    n, M = kin.moving_body_count, kin.total_mass
    bodies = range(n + 1)
    v = barycentric_vectors(kin)
    one = ca.SX.eye(3)

    # Eq. (17): D_ij couples the rotations of bodies i and j.
    D_ij: dict[tuple[int, int], ca.SX] = {}
    for i in bodies:
        D_ii = kin.inertia[i]
        for k in bodies:
            D_ii = D_ii + kin.mass(k) * (ca.dot(v[i][k], v[i][k]) * one - v[i][k] @ v[i][k].T)
        D_ij[i, i] = D_ii
        for j in range(i):
            D_ij[i, j] = -M * (ca.dot(v[j][i], v[i][j]) * one - v[j][i] @ v[i][j].T)
            D_ij[j, i] = D_ij[i, j].T

    # E_ij couples the rotation of body i and the slide j: sum_k m_k v_ik x ds_k/dq_j, where
    # sum_k m_k v_ik = 0 leaves only the bodies that the slide carries.
    outboard = [kin.outboard(j) for j in bodies]
    slides = [j for j in bodies[1:] if not kin.is_revolute(j)]
    turns = [j for j in bodies[1:] if kin.is_revolute(j)]
    E = {
        (i, j): ca.cross(
            sum((kin.mass(k) * v[i][k] for k in outboard[j]), ca.SX(3, 1)), kin.axis[j]
        )
        for i in bodies
        for j in slides
    }

    # Eqs (16a, 16b). Joint j turns every body it carries, so F_i' D_ij F_j is summed over the
    # bodies beyond each joint (column[j][i]) before its axis is applied.
    D = sum((D_ij[i, j] for i in bodies for j in bodies), ca.SX(3, 3))
    column = {
        (i, b): sum((D_ij[i, j] for j in outboard[b]), ca.SX(3, 3)) @ kin.axis[b]
        for i in bodies
        for b in turns
    } | {(i, b): E[i, b] for i in bodies for b in slides}
    D_q = ca.SX(3, n)
    D_qq = ca.SX(n, n)
    for b in bodies[1:]:
        D_q[:, b - 1] = sum((column[i, b] for i in bodies), ca.SX(3, 1))
        for a in turns:
            moment = sum((column[i, b] for i in outboard[a]), ca.SX(3, 1))
            D_qq[a - 1, b - 1] = ca.dot(kin.axis[a], moment)
            D_qq[b - 1, a - 1] = D_qq[a - 1, b - 1]
    for a in slides:
        for b in slides:
            carried = [sum(kin.mass(k) for k in outboard[j]) for j in (a, b)]
            shared = sum(kin.mass(k) for k in set(outboard[a]) & set(outboard[b]))
            reduced = shared - carried[0] * carried[1] / M
            D_qq[a - 1, b - 1] = reduced * ca.dot(kin.axis[a], kin.axis[b])
    D_q, D_qq = kin.gather(D_q.T).T, kin.gather(kin.gather(D_qq).T)
    return BarycentricInertia(M, D, D_q, D_qq, v)


def point_jacobian(kin: TreeKinematics, link: str) -> ca.SX:
    """Return ``0J+`` (6, 6 + n) of a link's frame origin, eq. (10), in base components.

    It maps ``[v_cm; omega; qdot]`` to the linear velocity of the point over the angular velocity
    of its body. ``J_12`` is the shape derivative of ``rho = sum_i v_ik,m``, which for revolute
    joints is the paper's ``-sum_i skew(v_ik,m) F_i``.
    """
    _, point, body = kin.frame(link)
    rho = point - kin.r_BC_B
    J_11 = -ca.skew(rho)
    J_12 = ca.jacobian(rho, kin.q)
    J_22 = kin.angular_jacobian(body)
    return ca.blockcat([[ca.SX.eye(3), J_11, J_12], [ca.SX(3, 3), ca.SX.eye(3), J_22]])


def bias(kin: TreeKinematics, v_cm: ca.SX, omega: ca.SX, qdot: ca.SX) -> ca.SX:
    """Return ``C+`` (6 + n,) by d'Alembert: the generalised force that keeps ``z0ddot`` at zero.

    Outward recursion of the velocity-product accelerations, inward sum of their inertia forces.
    Accelerations are taken relative to the system's centre of mass, whose own is ``omega x v_cm``.
    """
    M, qdot = kin.total_mass, kin.spread(qdot)
    omegas, alphas, accelerations = [omega], [ca.SX(3, 1)], [ca.SX(3, 1)]
    for k in range(1, kin.moving_body_count + 1):
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
    for k in range(kin.moving_body_count + 1):
        arm = kin.com[k] - kin.p[k]
        com_accelerations.append(
            accelerations[k]
            + ca.cross(alphas[k], arm)
            + ca.cross(omegas[k], ca.cross(omegas[k], arm))
        )
    mean = sum((kin.mass(k) / M * a for k, a in enumerate(com_accelerations)), ca.SX(3, 1))

    # Force and moment of each body about the system's centre of mass, then of its subtree.
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
    joint_rows = [ca.SX(1, 1) for _ in range(kin.moving_body_count)]
    for k in range(kin.moving_body_count, 0, -1):
        if kin.is_revolute(k):
            about_joint = moments[k] - ca.cross(kin.p[k] - kin.r_BC_B, forces[k])
            joint_rows[k - 1] = ca.dot(kin.axis[k], about_joint)
        else:
            joint_rows[k - 1] = ca.dot(kin.axis[k], forces[k])
        i = kin.parent(k)
        forces[i] = forces[i] + forces[k]
        moments[i] = moments[i] + moments[k]
    rows = kin.gather(ca.vertcat(*joint_rows))
    return ca.vertcat(M * ca.cross(omega, v_cm), moments[0], rows)


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


def solve_positive_definite(matrix: ca.SX, right: ca.SX) -> ca.SX:
    """Solve ``matrix x = right`` for a symmetric positive definite matrix (Cholesky)."""
    upper = ca.chol(matrix)
    return ca.solve(upper, ca.solve(upper.T, right))


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
        omega = SymmetricFactor(inertia.D).solve(excess)
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
    # All columns at once: their derivatives share most of their operations.
    dF = [ca.reshape(each, 6, n) for each in ca.vertsplit(ca.jacobian(ca.vec(F), q), 6)]
    K = [[ca.SX(6, 1) for _ in range(n)] for _ in range(n)]
    for i in range(n):
        for j in range(i + 1, n):
            K[i][j] = dF[j][:, i] - dF[i][:, j] + body_bracket(F[:, i], F[:, j])
            K[j][i] = -K[i][j]
    return K
