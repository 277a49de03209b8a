"""First and second derivatives of the angular momentum with respect to the configuration, in closed
form.

At zero linear momentum, the angular momentum about the centre of mass is ``L = D(q) omega + D_q(q)
qdot`` (paper 1, eq. 3). For a vector ``eta``, ``eta' L`` is a sum over the bodies of
``V1' I_k V2_k``, where V1 is the motion of a rigid system that rotates at ``eta``, and V2_k the
motion of body k at ``omega`` and ``qdot``. Spatial vectors and inertias are as in
:mod:`.composite_rigid_body`: angular part first, base components, at the system's centre of mass.

Joint i moves all bodies that it carries. Relative to those bodies, the rest of the system moves in
the opposite direction: V1 changes by ``a_i = V1 x S_i``, and the motion V2 of the carrier of joint
i by ``b_i = V2 x S_i``. Let ``h1_i = I^c_i V1`` and ``h2_i = sum_k I_k V2_k`` be the momenta of the
bodies that joint i carries, ``S x*`` the cross product of motion and force, and P_j the momentum
due to a unit rate of joint j. Then the momenta change by

* ``y1_i = S_i x* h1_i + I^c_i a_i`` and ``y2_i = S_i x* h2_i + I^c_i b_i``,

and if joint i carries joint j or is joint j, the second derivatives are

* by q_i and q_j: ``a_i' y2_j + b_i' y1_j``;
* by q_i and qdot_j: ``a_i' P_j``; by q_j and qdot_i: ``S_i' y1_j``;
* by q_i and omega: the angular part of ``y1_i``.

The second derivatives are zero for joints on different branches. All derivatives are for a given
motion of the centre of mass. To keep the centre of mass at rest, subtract
``(f1_x' f2_y + f2_x' f1_y) / M``, where f1 and f2 are the linear momenta of the two motions, and
subscripts denote derivatives with respect to x and y.

These formulas need a tenth of the operations of CasADi's derivatives. The formulas are derived
here; the derivative of a subtree's momentum with respect to its joint is from R. Featherstone,
Rigid Body Dynamics Algorithms, 2008, section 2.9.
"""

from __future__ import annotations

import casadi as ca

from spacerobot_ros.model.composite_rigid_body import Composites


def momentum_derivatives(
    parts: Composites, omega: ca.SX, qdot: ca.SX, eta: ca.SX
) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX]:
    """Return the derivatives in a configuration, at zero linear momentum: ``dL/dq`` (3, n) of the
    angular momentum L, and the second derivatives of ``eta' L`` with respect to q and q (n, n), q
    and qdot (n, n), and q and omega (n, 3).

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
