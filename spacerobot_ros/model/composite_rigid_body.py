"""Fast forward dynamics by composite rigid bodies, with the base eliminated analytically.

Computes ``z0ddot`` of paper 4, eq. (19), with 44 to 84 % of the operations that barycentric vectors
require, depending on the robot. Spatial vectors follow Featherstone, Rigid Body Dynamics Algorithms
(2008), with the angular part first: motions ``[omega; v]`` and forces ``[n; f]``. All these vectors
are in the base frame at one common point, the system's centre of mass, so that no body needs a
transform and the inertia of the whole system is ``diag(D, M 1)``.

Because that inertia is block-diagonal, the base can be eliminated joint by joint. A unit rate of
joint j gives the joint's composite (all bodies that the joint carries) the momentum ``P_j = I^c_j
S_j``; to cancel this momentum, the whole system moves by ``-B_j``, ``B_j = diag(D, M 1)^-1 P_j``.
So ``S_j - B_j`` is the motion of the bodies outboard of joint j if the base is free, and

* ``K_ij = (S_i - B_i)' P_j``: joint inertia matrix at a given momentum (if joint i carries joint j;
  without the ``S_i`` term if neither joint carries the other);
* ``omega = D^-1 L - sum_j B_j qdot_j`` (angular parts): the base rate at angular momentum L;
* ``K qddot = Q``, ``Q_j = tau_j - S_j' f_j + B_j' (f_0 - f_external)``, where ``f_j`` is the force
on composite j required by the motion alone, at ``qddot = 0``.

For chains of up to about eight joints, this method takes fewer operations than the articulated-body
algorithm, although the cost of the latter grows only linearly.

External loads on the links (:class:`ExternalLoads`; derived in docs/theory/external_loads.md) form
one vector (:class:`LoadLayout`); all times are in plant time. Frame W is in free fall on a circular
orbit with mean motion n and does not rotate. The orbital frame O has its x axis radially outward
and its z axis along the orbit normal; ``R_WO`` is the attitude of O at time zero, ``o`` the unit
vector along the radius. For the load ``F_k`` on composite k and the friction d, ``S_j' F_j - B_j'
F_0 - d (K qdot)_j`` is added to ``Q_j``.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from spacerobot_ros.model.inertial_parameters import rotational, sparse_constant, symmetric
from spacerobot_ros.model.kinematics import TreeKinematics
from spacerobot_ros.model.symbolic_rotations import matrix_from_quaternion


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


# -- external loads ------------------------------------------------------------------------------


class LoadLayout:
    """Slices of the load vector for a robot with L links.

    Attributes
    ----------
    in_link, in_world
        Force (N) and torque (N m) at the origin of every link, in link components and in W
        components: (6 L,) each.
    mean_motion
        Mean motion of the orbit, rad/s; zero if there is no gravity gradient.
    quaternion_WO
        Attitude (x, y, z, w) of the orbital frame in W at time zero.
    gravity_W
        Uniform acceleration (3,), m/s^2.
    friction
        Viscous friction force on a body divided by the body's momentum, 1/s.
    time
        Time at the beginning of the tick, s.
    size
        Length of the vector.
    """

    def __init__(self, links: int) -> None:
        ends = np.cumsum([6 * links, 6 * links, 1, 4, 3, 1, 1]).tolist()
        self.in_link, self.in_world, self.mean_motion, self.quaternion_WO, *rest = map(
            slice, [0, *ends], ends
        )
        self.gravity_W, self.friction, self.time = rest
        self.size: int = ends[-1]


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


def external_loads(
    kin: TreeKinematics,
    second_moments: tuple[ca.SX, ...],
    quaternion: ca.SX,
    r_WC_W: ca.SX,
    loads: ca.SX,
    time: ca.SX,
) -> ExternalLoads:
    """Return the loads in a state.

    Parameters
    ----------
    kin
        The kinematics.
    second_moments
        (3, 3) second moment of mass of every body about its own centre, in the base frame.
    quaternion
        (4,) of ``R_WB``.
    r_WC_W
        (3,) position of the system's centre of mass, m.
    loads
        The vector of :class:`LoadLayout`.
    time
        Time, s.
    """
    links = [link.name for link in kin.robot.links]
    layout = LoadLayout(len(links))
    R_BW = matrix_from_quaternion(quaternion).T
    forces = [ca.SX(6, 1) for _ in kin.robot.bodies]
    in_link, in_world = (
        ca.reshape(loads[part], 6, len(links)) for part in (layout.in_link, layout.in_world)
    )
    for i, link in enumerate(links):
        R_BL, r_BL_B, body = kin.frame(link)
        force = R_BL @ in_link[:3, i] + R_BW @ in_world[:3, i]
        torque = R_BL @ in_link[3:, i] + R_BW @ in_world[3:, i]
        forces[body] += ca.vertcat(torque + ca.cross(r_BL_B - kin.r_BC_B, force), force)
    n = loads[layout.mean_motion]
    angle = n * time
    radius_O = ca.vertcat(ca.cos(angle), ca.sin(angle), 0)
    o = R_BW @ (matrix_from_quaternion(loads[layout.quaternion_WO]) @ radius_O)
    r_WC_B = R_BW @ r_WC_W
    for k, J in enumerate(second_moments):
        arm = kin.com[k] - kin.r_BC_B
        r = r_WC_B + arm
        force = kin.mass(k) * n**2 * (3 * ca.dot(o, r) * o - r)
        moment = ca.cross(arm, force) + 3 * n**2 * ca.cross(o, rotational(J) @ o)
        forces[k] += ca.vertcat(moment, force)
    for k in range(kin.moving_body_count, 0, -1):
        forces[kin.parent(k)] += forces[k]
    return ExternalLoads(tuple(forces), loads[layout.gravity_W], loads[layout.friction])
