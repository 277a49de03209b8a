"""The inertia by the barycentric vectors of paper 4, eqs (1) to (3) and (14) to (17).

The paper writes barycentric vectors for a chain of revolute joints. Here they stand for any tree:
the vector from the mass centre of body i to its joint *towards body k* takes the place of the
paper's ``r_i`` (k outboard) and ``l_i`` (k inboard). A prismatic joint makes that vector grow along
its axis, which adds the slide terms below; without prismatic joints they vanish and the paper's
formulas remain.
"""

from __future__ import annotations

import casadi as ca

from spacerobot_ros.model.kinematics import TreeKinematics


def barycentric_vectors(kin: TreeKinematics) -> tuple[tuple[ca.SX, ...], ...]:
    """Return ``v[i][k]``, eqs (3a) and (3b): ``rho_k = sum_i v[i][k]`` is the mass centre of body k
    from that of the system, base components.
    """
    bodies = range(kin.moving_body_count + 1)
    M = kin.total_mass
    outboard = [set(_outboard(kin, k)) for k in bodies]
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


def barycentric_inertia(kin: TreeKinematics) -> ca.SX:
    """Return ``H+`` (6 + n, 6 + n) of ``[v_cm; omega; qdot]`` in base components.

    Eqs (14-17), with the slide terms of prismatic joints.
    """
    n, M = kin.moving_body_count, kin.total_mass
    bodies = range(n + 1)
    v = barycentric_vectors(kin)
    one = ca.SX.eye(3)

    # Eq. (17): D_ij couples the rotations of bodies i and j.
    D_ij: dict[tuple[int, int], ca.SX] = {}
    for i in bodies:
        D_ii = kin.mass_properties.inertia(i, kin.R[i])
        for k in bodies:
            D_ii = D_ii + kin.mass(k) * (ca.dot(v[i][k], v[i][k]) * one - v[i][k] @ v[i][k].T)
        D_ij[i, i] = D_ii
        for j in range(i):
            D_ij[i, j] = -M * (ca.dot(v[j][i], v[i][j]) * one - v[j][i] @ v[i][j].T)
            D_ij[j, i] = D_ij[i, j].T

    # E_ij couples the rotation of body i and the slide j: sum_k m_k v_ik x ds_k/dq_j, where
    # sum_k m_k v_ik = 0 leaves only the bodies that the slide carries.
    outboard = [_outboard(kin, j) for j in bodies]
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
    turning = ca.blockcat([[D, D_q], [D_q.T, D_qq]])
    return ca.diagcat(M * one, turning)


def _outboard(kin: TreeKinematics, j: int) -> list[int]:
    """Return the bodies outboard of joint j, body j first."""
    return [k for k in range(len(kin.robot.bodies)) if j == 0 or j in kin.ancestors(k)]
