"""The mechanical connection and its curvature (papers 1 and 2).

With zero total momentum the base moves only because the shape does: ``[v; omega]_B = -A(q) qdot``.
A closed loop of the shape leaves a net motion of the base: to first order, the curvature times
the area of the loop.
"""

from __future__ import annotations

import casadi as ca

from spacerobot_ros.model.barycentric import BarycentricInertia
from spacerobot_ros.model.kinematics import TreeKinematics, skew


def solve_positive_definite(matrix: ca.SX, right: ca.SX) -> ca.SX:
    """Solve ``matrix x = right`` for a symmetric positive definite matrix (Cholesky)."""
    upper = ca.chol(matrix)
    return ca.solve(upper, ca.solve(upper.T, right))


def connection(kin: TreeKinematics, inertia: BarycentricInertia) -> ca.SX:
    """Return ``A(q)`` (6, n) of ``[v_WB_B; omega_WB_B] = -A(q) qdot``, zero momentum (paper 1, 3).

    The lower half is ``D^-1 D_q``; the upper keeps the system's centre of mass at rest:
    ``v = -omega x c - dc/dq qdot`` with ``c = r_BC_B``.
    """
    A_omega = solve_positive_definite(inertia.D, inertia.D_q)
    A_v = skew(kin.r_BC_B) @ A_omega + ca.jacobian(kin.r_BC_B, kin.q)
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
