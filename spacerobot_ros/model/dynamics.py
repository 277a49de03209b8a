"""The papers' equations in closed form: dynamics (paper 4), connection (papers 1 and 2).

Equations of motion ``H+ zddot + C+ = Q`` (paper 4, eqs 8-10 and 18-21). The independent velocities
are ``z0dot = [v_cm; omega; qdot]``, of which the first two are in the base frame (eq. 8), so that
the equations do not depend on the robot pose.

Momentum determines the base motion: at zero total momentum, the base moves only if the shape
changes, by the mechanical connection ``[v; omega]_B = -A(q) qdot`` (paper 1). A closed shape loop
causes a net base motion: to first order, the curvature times the loop area (paper 2).

Composite rigid bodies, with the base eliminated analytically, compute ``z0ddot`` (eq. 19) with 44
to 84 % of the operations that barycentric vectors require, depending on the robot. Spatial vectors
follow Featherstone, Rigid Body Dynamics Algorithms (2008), with the angular part first: motions
``[omega; v]`` and forces ``[n; f]``. All these vectors are in the base frame at one common point,
the system's centre of mass, so that no body needs a transform and the inertia of the whole system
is ``diag(D, M 1)``.

Because that inertia is block-diagonal, the base can be eliminated joint by joint. A unit rate of
joint j gives the joint's composite (all bodies that the joint carries) the momentum ``P_j = I^c_j
S_j``; to cancel this momentum, the whole system moves by ``-B_j``, ``B_j = diag(D, M 1)^-1 P_j``.
So ``S_j - B_j`` is the motion of the bodies outboard of joint j if the base is free, and

* ``K_ij = (S_i - B_i)' P_j``: joint inertia matrix at a given momentum (if joint i carries joint j;
  without the ``S_i`` term if neither joint carries the other);
* ``omega = D^-1 L - sum_j B_j qdot_j`` (angular parts): the base rate at angular momentum L;
* ``K qddot = Q``, ``Q_j = tau_j - S_j' f_j + B_j' (f_0 - f_external)``, where ``f_j`` is the force
on composite j required by the motion alone, at ``qddot = 0``. For the load ``F_k`` on composite
k and the friction d, ``S_j' F_j - B_j' F_0 - d (K qdot)_j`` is added to ``Q_j``.

For chains of up to about eight joints, this method takes fewer operations than the articulated-body
algorithm, although the cost of the latter grows only linearly.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from spacerobot_ros.model.inertial_parameters import rotational, sparse_constant, symmetric
from spacerobot_ros.model.kinematics import TreeKinematics


@dataclass(frozen=True)
class SpatialInertia:
    """Inertia about the system's centre of mass: ``mass`` (kg), ``h`` (3,) first moment of mass
    (kg m), ``J`` (3, 3) second moment of mass (kg m^2; the rotational inertia is ``tr(J) 1 - J``).
    """

    mass: float | ca.SX
    h: ca.SX
    J: ca.SX

    def __add__(self, other: SpatialInertia) -> SpatialInertia:
        """Return the inertia of two bodies as one rigid body."""
        return SpatialInertia(self.mass + other.mass, self.h + other.h, self.J + other.J)

    def __matmul__(self, motion: ca.SX) -> ca.SX:
        """Return the momentum (6,) of a motion (6,) (Featherstone, eq. 2.61)."""
        omega, v = motion[:3], motion[3:]
        return ca.vertcat(
            ca.cross(self.h, v) + rotational(self.J) @ omega,
            self.mass * v + ca.cross(omega, self.h),
        )


class SymmetricFactor:
    """The factorisation ``L D L'`` of a symmetric positive definite matrix."""

    def __init__(self, matrix: ca.SX) -> None:
        n = self._n = matrix.shape[0]
        rest = [[matrix[i, j] for j in range(n)] for i in range(n)]
        self._L: list[list[ca.SX]] = [[None] * n for _ in range(n)]
        self._inverse: list[ca.SX] = []
        for j in range(n):
            # CasADi rewrites x * (1/d) as x/d, and there are many x; it leaves |1/d| as it is,
            # which is the same because pivots are positive.
            self._inverse.append(ca.fabs(1 / rest[j][j]))
            for i in range(j + 1, n):
                self._L[i][j] = rest[i][j] * self._inverse[j]
                for k in range(j + 1, i + 1):
                    rest[i][k] = rest[i][k] - self._L[i][j] * rest[k][j]

    def solve(self, right: ca.SX) -> ca.SX:
        """Solve ``matrix x = right`` for x (n,)."""
        x = [right[i] for i in range(self._n)]
        for i in range(self._n):
            for j in range(i):
                x[i] = x[i] - self._L[i][j] * x[j]
        x = [a * b for a, b in zip(x, self._inverse, strict=True)]
        for i in reversed(range(self._n)):
            for j in range(i + 1, self._n):
                x[i] = x[i] - self._L[j][i] * x[j]
        return ca.vertcat(*x)


@dataclass(frozen=True)
class Composites:
    """Composite rigid bodies outboard of each joint, in the base frame; see the module docstring
    for the symbols.

    ``J[k]`` (3, 3) is the second moment of mass of body k about its own centre. ``S[j]`` (6,) is
    the unit-rate motion of the joint that carries body j, and ``P[j]`` (6,) is the momentum of the
    joint's composite (both zero for the base); ``D`` (3, 3) is the locked inertia about the
    system's centre of mass, kg m^2 (paper 4, eq. 16a). ``composite[k]`` is the inertia of body k
    and of all bodies that it carries.
    """

    kin: TreeKinematics
    J: tuple[ca.SX, ...]
    composite: tuple[SpatialInertia, ...]
    S: tuple[ca.SX, ...]
    P: tuple[ca.SX, ...]
    D: ca.SX

    @property
    def D_q(self) -> ca.SX:
        """Angular momentum (3, n) about the centre of mass per unit joint rate (paper 4, eq. 16a).

        This momentum does not depend on the motion of the centre of mass, so it equals the momentum
        of the composites at the common point.
        """
        return self.kin.gather(ca.horzcat(ca.SX(3, 0), *(P[:3] for P in self.P[1:])).T).T

    @property
    def D_qq(self) -> ca.SX:
        """Joint inertia matrix (n, n) with the base and the centre of mass at rest (eq. 16b)."""
        m = self.kin.moving_body_count
        D_qq = ca.SX(m, m)
        for j in range(1, m + 1):
            carriers = self.kin.ancestors(j)
            for i in range(1, j + 1):
                carried = ca.dot(self.S[i], self.P[j]) if i in carriers else 0
                shared = ca.dot(self.P[i][3:], self.P[j][3:]) / self.kin.total_mass
                D_qq[i - 1, j - 1] = D_qq[j - 1, i - 1] = carried - shared
        return self.kin.gather(self.kin.gather(D_qq).T)

    @property
    def H_plus(self) -> ca.SX:
        """Inertia matrix (6 + n, 6 + n) of ``[v_cm; omega; qdot]`` (paper 4, eq. 15)."""
        n, D_q = self.kin.n, self.D_q
        return ca.blockcat(
            [
                [self.kin.total_mass * ca.SX.eye(3), ca.SX(3, 3), ca.SX(3, n)],
                [ca.SX(3, 3), self.D, D_q],
                [ca.SX(n, 3), D_q.T, self.D_qq],
            ]
        )


def composites(kin: TreeKinematics) -> Composites:
    """Sum the body inertias inward (Featherstone, table 6.2)."""
    n, c = kin.moving_body_count, kin.r_BC_B
    J = tuple(kin.mass_properties.second_moment(k, kin.R[k]) for k in range(n + 1))
    composite = []
    for k in range(n + 1):
        rho = kin.com[k] - c
        h = kin.mass(k) * rho
        composite.append(SpatialInertia(kin.mass(k), h, J[k] + symmetric(h @ rho.T)))
    S, P = ([ca.SX(6, 1)] * (n + 1) for _ in range(2))
    for k in range(n, 0, -1):
        S[k] = ca.vertcat(ca.SX(3, 1), kin.axis[k])
        if kin.is_revolute(k):
            S[k] = ca.vertcat(kin.axis[k], ca.cross(kin.p[k] - c, kin.axis[k]))
        P[k] = composite[k] @ S[k]
        composite[kin.parent(k)] += composite[k]
    return Composites(kin, J, tuple(composite), tuple(S), tuple(P), rotational(composite[0].J))


@dataclass(frozen=True)
class ShapeSystem:
    """Shape inertia with the free base eliminated; see the module docstring for the symbols.

    ``B[j]`` (6,) belongs to the joint that carries body j (zero for the base); ``D`` is the
    factorised rotational inertia of the system, ``K`` (n, n) the shape inertia matrix.
    """

    parts: Composites
    B: tuple[ca.SX, ...]
    D: SymmetricFactor
    K: ca.SX

    def base_motion(self, moment: ca.SX, rates: ca.SX) -> ca.SX:
        """Return ``omega_WB_B`` (3,) for an angular momentum (3,) and joint rates (n,), or its
        derivative for a moment and joint accelerations.
        """
        rates = self.parts.kin.spread(rates)
        reaction = (B[:3] * rates[j] for j, B in enumerate(self.B[1:]))
        return self.D.solve(moment) - sum(reaction, ca.SX(3, 1))


def shape_system(kin: TreeKinematics) -> ShapeSystem:
    """Eliminate the base from the composites."""
    parts = composites(kin)
    S, P, n = parts.S, parts.P, kin.moving_body_count
    D = SymmetricFactor(parts.D)
    B = [ca.vertcat(D.solve(p[:3]), p[3:] * kin.per_mass) for p in P]
    K = ca.SX(n, n)
    for j in range(1, n + 1):
        carriers = kin.ancestors(j)
        for i in range(1, j + 1):
            motion = S[i] - B[i] if i in carriers else -B[i]
            K[i - 1, j - 1] = K[j - 1, i - 1] = ca.dot(motion, P[j])
    return ShapeSystem(parts, tuple(B), D, kin.gather(kin.gather(K).T))


def motion_forces(
    parts: Composites, omega: ca.SX, qdot: ca.SX, qddot: ca.SX | None = None
) -> tuple[ca.SX, ...]:
    """Return ``f_k`` (6,) for every composite k: the force required by the composite's motion at
    the rates ``omega_WB_B`` (3,) and ``qdot`` (n,), constant ``omega``, and joint accelerations
    ``qddot`` (n,), by default zero.

    This is the recursive Newton-Euler algorithm (Featherstone, table 5.1). If body k has the
    angular velocity ``omega_k`` and acceleration ``alpha_k``, its point x accelerates by ``A_k x``,
    ``A_k = hat(alpha_k) + hat(omega_k)^2``, relative to the body's origin. The base origin is
    assumed not to accelerate: in ``Q_j``, a common acceleration cancels between ``S_j' f_j`` and
    ``B_j' f_0``.
    """
    kin, qdot = parts.kin, parts.kin.spread(qdot)
    qddot = kin.spread(ca.SX(kin.n, 1) if qddot is None else qddot)
    omegas, alphas = [omega], [ca.SX(3, 1)]
    A, accelerations = [_angular_operator(omega, ca.SX(3, 1))], [ca.SX(3, 1)]
    for k in range(1, kin.moving_body_count + 1):
        i = kin.parent(k)
        rate = kin.axis[k] * qdot[k - 1]
        push = kin.axis[k] * qddot[k - 1]
        # A difference of origins would keep CasADi from cancelling and sharing terms.
        arm = kin.R[i] @ sparse_constant(kin.robot.bodies[k].origin.r)
        if kin.is_revolute(k):
            accelerations.append(accelerations[i] + A[i] @ arm)
            omegas.append(omegas[i] + rate)
            alphas.append(alphas[i] + ca.cross(omegas[i], rate) + push)
            A.append(_angular_operator(omegas[k], alphas[k]))
        else:
            arm = arm + kin.axis[k] * kin.theta[k - 1]
            accelerations.append(
                accelerations[i] + A[i] @ arm + 2 * ca.cross(omegas[i], rate) + push
            )
            omegas.append(omegas[i])
            alphas.append(alphas[i])
            A.append(A[i])

    forces = []
    for k in range(kin.moving_body_count + 1):
        arm = kin.R[k] @ kin.mass_properties.centers[k]
        force = kin.mass(k) * (accelerations[k] + A[k] @ arm)
        # The moment is the integral of rho x A rho over the body: the axial vector of A J.
        AJ = A[k] @ parts.J[k]
        spin = ca.vertcat(AJ[2, 1] - AJ[1, 2], AJ[0, 2] - AJ[2, 0], AJ[1, 0] - AJ[0, 1])
        forces.append(ca.vertcat(ca.cross(kin.com[k] - kin.r_BC_B, force) + spin, force))
    for k in range(kin.moving_body_count, 0, -1):
        forces[kin.parent(k)] += forces[k]
    return tuple(forces)


@dataclass(frozen=True)
class ExternalLoads:
    """Loads in a state, as expressions in the base frame.

    Attributes
    ----------
    composites
        Moment and force (6,) about the system's centre of mass on every composite (a body and all
        bodies that it carries), due to the wrenches and the gravity gradient.
    gravity_W, friction
        Uniform acceleration (3,) in W, m/s^2, and friction divided by momentum, 1/s. Both loads are
        proportional to mass, so they affect momenta and joints independently.
    """

    composites: tuple[ca.SX, ...]
    gravity_W: ca.SX
    friction: ca.SX

    @classmethod
    def none(cls, kin: TreeKinematics) -> ExternalLoads:
        """Return loads that are zero."""
        return cls((ca.SX(6, 1),) * len(kin.robot.bodies), ca.SX(3, 1), ca.SX(1, 1))

    def momentum_rates(
        self, R_WB: ca.SX, p_W: ca.SX, L_W: ca.SX, mass: float | ca.SX
    ) -> tuple[ca.SX, ca.SX]:
        """Return the rates of change of both total momenta due to the loads, N and N m, in W."""
        moment, force = self.composites[0][:3], self.composites[0][3:]
        return (
            R_WB @ force + mass * self.gravity_W - self.friction * p_W,
            R_WB @ moment - self.friction * L_W,
        )


def shape_forces(
    system: ShapeSystem,
    omega: ca.SX,
    qdot: ca.SX,
    external: ca.SX,
    tau: ca.SX,
    loads: ExternalLoads,
) -> tuple[ca.SX, ca.SX]:
    """Return ``Q`` (n,) of ``K qddot = Q`` and the remaining moment (3,) on the base.

    ``external`` (6,) is the external moment (N m) and force (N) on the base, in the base frame,
    about the system's centre of mass; ``tau`` (n,) are the joint efforts (N or N m).
    """
    kin, moving = system.parts.kin, range(1, system.parts.kin.moving_body_count + 1)
    of_motion = motion_forces(system.parts, omega, qdot)
    f = [force - load for force, load in zip(of_motion, loads.composites, strict=True)]
    excess = f[0] - external
    by_joint = ca.vertcat(ca.SX(0, 1), *(ca.dot(system.parts.S[k], f[k]) for k in moving))
    by_base = ca.vertcat(ca.SX(0, 1), *(ca.dot(system.B[k], excess) for k in moving))
    tau = tau - loads.friction * (system.K @ qdot)
    if kin.robot.has_mimic_joints:
        return tau + kin.gather(by_base - by_joint), -excess[:3]
    return tau - by_joint + by_base, -excess[:3]


def joint_efforts(
    kin: TreeKinematics, qdot: ca.SX, qddot: ca.SX, L_B: ca.SX, loads: ExternalLoads
) -> ca.SX:
    """Return the efforts (n,), N or N m, of a free robot for joint rates ``qdot`` (n,) and
    accelerations ``qddot`` (n,): inverse dynamics.

    ``L_B`` (3,) is the angular momentum about the system's centre of mass, kg m^2/s in base
    components. The base rotates and accelerates such that both momenta are constant:
    its acceleration is ``-diag(D, M 1)^-1 f_0``, where ``f_0`` is the external force that the joint
    motion alone would require. So ``tau_j = S_j' f_j - P_j' diag(D, M 1)^-1 f_0``, and no joint
    inertia matrix is needed. At zero momentum, the same path in half the time requires four times
    the efforts.
    """
    parts = composites(kin)
    D = SymmetricFactor(parts.D)
    of_motion = motion_forces(parts, D.solve(L_B - parts.D_q @ qdot), qdot, qddot)
    f = [force - load for force, load in zip(of_motion, loads.composites, strict=True)]
    base = ca.vertcat(D.solve(f[0][:3]), f[0][3:] * kin.per_mass)
    along = (
        ca.dot(S, force) - ca.dot(P, base)
        for S, P, force in zip(parts.S[1:], parts.P[1:], f[1:], strict=True)
    )
    momentum = parts.D_qq @ qdot - parts.D_q.T @ D.solve(parts.D_q @ qdot)
    return kin.gather(ca.vertcat(*along)) + loads.friction * momentum


def external_force(kin: TreeKinematics, wrench_B: ca.SX) -> ca.SX:
    """Return a base wrench as moment and force (6,) about the system's centre of mass.

    ``wrench_B`` is force (N) and torque (N m) at the base link origin.
    """
    force, torque = wrench_B[:3], wrench_B[3:]
    return ca.vertcat(torque - ca.cross(kin.r_BC_B, force), force)


def composite_dynamics(
    kin: TreeKinematics, v_cm: ca.SX, omega: ca.SX, qdot: ca.SX, wrench_B: ca.SX, tau: ca.SX
) -> ca.SX:
    """Return ``z0ddot = [v_cm_dot; omega_dot; qddot]`` (6 + n,), base components (eq. 19)."""
    system = shape_system(kin)
    external = external_force(kin, wrench_B)
    Q, moment = shape_forces(system, omega, qdot, external, tau, ExternalLoads.none(kin))
    qddot = SymmetricFactor(system.K).solve(Q)
    return ca.vertcat(
        external[3:] / kin.total_mass - ca.cross(omega, v_cm),
        system.base_motion(moment, qddot),
        qddot,
    )


def _angular_operator(omega: ca.SX, alpha: ca.SX) -> ca.SX:
    """Return ``hat(alpha) + hat(omega)^2`` (3, 3)."""
    squares = symmetric(omega @ omega.T)
    return ca.skew(alpha) - rotational(squares)


# -- equations of the papers -----------------------------------------------------------------------


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
    kin: TreeKinematics, inertia: Composites, qdot: ca.SX, p_B: ca.SX, L_B: ca.SX
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
