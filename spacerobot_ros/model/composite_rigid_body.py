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

:func:`state_rate` computes the motion under joint efforts and a base wrench, with the total momenta
as part of the state. The state is ``x = [q; quaternion_WB; qdot; p_W; L_W; r_WC_W]``, (2 n + 13,):
joint positions, attitude (x, y, z, w), joint rates, total linear momentum (kg m/s), total angular
momentum about the system's centre of mass (kg m^2/s), and position of the centre of mass (m), the
last three in W. The base twist is not a state: it follows from the momenta and joint rates. Without
thrusters, the momenta are therefore constant to the last bit, for any step size:

* ``p_W_dot = R_WB f``, ``L_W_dot = R_WB (n + (r_origin - c) x f)``, ``r_WC_W_dot = p_W / M``;
* ``K qddot = Q`` with the ``omega_WB_B`` that follows from the momenta.

The command is ``[tau; f; n]``, (n + 6,): joint efforts (N or N m), then force (N) and torque (N m)
at the base link origin, in the base frame. The attitude is integrated in R^4 and normalised
after each Runge-Kutta step.

Under external loads (:mod:`spacerobot_ros.model.external_loads`), the state ends with the time (s),
and the command ends with the load vector. For the load ``F_k`` on composite k and the friction d,
``S_j' F_j - B_j' F_0 - d (K qdot)_j`` is added to ``Q_j``; both momenta change due to ``F_0``,
uniform gravity and friction.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from spacerobot_ros.model.compilation import dense_function
from spacerobot_ros.model.external_loads import ExternalLoads, LoadLayout, external_loads
from spacerobot_ros.model.inertial_parameters import rotational, sparse_constant, symmetric
from spacerobot_ros.model.kinematics import TreeKinematics
from spacerobot_ros.model.symbolic_rotations import matrix_from_quaternion, quaternion_rate


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
    qddot = None if qddot is None else kin.spread(qddot)
    omegas, alphas = [omega], [ca.SX(3, 1)]
    A, accelerations = [_angular_operator(omega, ca.SX(3, 1))], [ca.SX(3, 1)]
    for k in range(1, kin.moving_body_count + 1):
        i = kin.parent(k)
        rate = kin.axis[k] * qdot[k - 1]
        push = ca.SX(3, 1) if qddot is None else kin.axis[k] * qddot[k - 1]
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
    loads: ExternalLoads | None = None,
) -> tuple[ca.SX, ca.SX]:
    """Return ``Q`` (n,) of ``K qddot = Q`` and the remaining moment (3,) on the base.

    ``external`` (6,) is the external moment (N m) and force (N) on the base, in the base frame,
    about the system's centre of mass; ``tau`` (n,) are the joint efforts (N or N m).
    """
    f = motion_forces(system.parts, omega, qdot)
    if loads is not None:
        f = tuple(force - load for force, load in zip(f, loads.composites, strict=True))
        tau = tau - loads.friction * (system.K @ qdot)
    excess = f[0] - external
    kin = system.parts.kin
    if kin.robot.has_mimic_joints:
        along = [
            ca.dot(system.B[k], excess) - ca.dot(system.parts.S[k], f[k])
            for k in range(1, kin.moving_body_count + 1)
        ]
        return tau + kin.gather(ca.vertcat(*along)), -excess[:3]
    Q = [
        tau[k - 1] - ca.dot(system.parts.S[k], f[k]) + ca.dot(system.B[k], excess)
        for k in range(1, kin.n + 1)
    ]
    return ca.vertcat(*Q), -excess[:3]


def joint_efforts(
    kin: TreeKinematics,
    qdot: ca.SX,
    qddot: ca.SX,
    L_B: ca.SX | None = None,
    loads: ExternalLoads | None = None,
) -> ca.SX:
    """Return the efforts (n,), N or N m, of a free robot for joint rates ``qdot`` (n,) and
    accelerations ``qddot`` (n,): inverse dynamics.

    ``L_B`` (3,) is the angular momentum about the system's centre of mass, kg m^2/s in base
    components; None: zero. The base rotates and accelerates such that both momenta are constant:
    its acceleration is ``-diag(D, M 1)^-1 f_0``, where ``f_0`` is the external force that the joint
    motion alone would require. So ``tau_j = S_j' f_j - P_j' diag(D, M 1)^-1 f_0``, and no joint
    inertia matrix is needed. At zero momentum, the same path in half the time requires four times
    the efforts. ``loads`` are external loads, if any.
    """
    parts = composites(kin)
    D = SymmetricFactor(parts.D)
    relative = -(parts.D_q @ qdot) if L_B is None else L_B - parts.D_q @ qdot
    f = motion_forces(parts, D.solve(relative), qdot, qddot)
    if loads is not None:
        f = tuple(force - load for force, load in zip(f, loads.composites, strict=True))
    base = ca.vertcat(D.solve(f[0][:3]), f[0][3:] * kin.per_mass)
    along = (
        ca.dot(S, force) - ca.dot(P, base)
        for S, P, force in zip(parts.S[1:], parts.P[1:], f[1:], strict=True)
    )
    efforts = kin.gather(ca.vertcat(*along))
    if loads is None:
        return efforts
    momentum = parts.D_qq @ qdot - parts.D_q.T @ D.solve(parts.D_q @ qdot)
    return efforts + loads.friction * momentum


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
    Q, moment = shape_forces(system, omega, qdot, external, tau)
    qddot = SymmetricFactor(system.K).solve(Q)
    return ca.vertcat(
        external[3:] / kin.total_mass - ca.cross(omega, v_cm),
        system.base_motion(moment, qddot),
        qddot,
    )


def state_slices(n: int) -> tuple[slice, ...]:
    """Return the state slices of ``q, quaternion_WB, qdot, p_W, L_W, r_WC_W``."""
    ends = [n, n + 4, 2 * n + 4, 2 * n + 7, 2 * n + 10, 2 * n + 13]
    return tuple(slice(a, b) for a, b in zip([0, *ends], ends, strict=False))


def shape_equations(kin: TreeKinematics, *, loaded: bool = False) -> ca.Function:
    """Return the function ``(x, command) -> (K, Q)`` of ``K qddot = Q``."""
    equations = _equations(kin, loaded=loaded)
    inputs = equations.inputs | kin.mass_properties.inputs
    name = "loaded_shape_equations" if loaded else "shape_equations"
    return dense_function(name, inputs, {"K": equations.system.K, "Q": equations.Q})


def state_rate(kin: TreeKinematics, *, holding: bool = False, loaded: bool = False) -> ca.Function:
    """Return the function ``(x, command) -> x_dot``.

    If ``holding``, the function takes a third argument ``free`` (n,): 1 for a moving joint, 0 for a
    joint held at its current rate. If ``loaded``, external loads are included.
    """
    free = ca.SX.sym("free", kin.n) if holding else ca.DM.ones(kin.n)
    equations = _equations(kin, loaded=loaded)
    system = equations.system
    _, quaternion, qdot, p_W, L_W, _ = (equations.inputs["x"][part] for part in state_slices(kin.n))
    # A held joint is absent from the equations of other joints; its own equation is qddot = 0.
    K = system.K * (free @ free.T)
    for j in range(kin.n):
        K[j, j] = system.K[j, j]
    R_WB = matrix_from_quaternion(quaternion)
    p_dot, L_dot = R_WB @ equations.external[3:], R_WB @ equations.external[:3]
    if equations.loads is not None:
        by_loads = equations.loads.momentum_rates(R_WB, p_W, L_W, kin.total_mass)
        p_dot, L_dot = p_dot + by_loads[0], L_dot + by_loads[1]
    x_dot = ca.vertcat(
        qdot,
        quaternion_rate(quaternion, equations.omega),
        SymmetricFactor(K).solve(equations.Q * free),
        p_dot,
        L_dot,
        p_W / kin.total_mass,
        *([1.0] if loaded else []),
    )
    inputs = equations.inputs | ({"free": free} if holding else {}) | kin.mass_properties.inputs
    name = "holding_rate" if holding else "flight_rate"
    return dense_function(f"loaded_{name}" if loaded else name, inputs, {"x_dot": x_dot})


def servo_rate(kin: TreeKinematics) -> ca.Function:
    """Return the function ``(x, qdot, loads) -> x_dot`` for a robot whose servos hold ``qdot``
    under external loads.

    ``x = [q; quaternion_WB; p_W; L_W; r_WC_W; time]``, (n + 14,); ``loads`` is a vector laid out by
    :class:`.LoadLayout`.
    """
    parts = {"quaternion": 4, "p_W": 3, "L_W": 3, "r_WC_W": 3, "time": 1}
    symbols = {name: ca.SX.sym(name, count) for name, count in parts.items()}
    quaternion, p_W, L_W, r_WC_W, time = symbols.values()
    qdot = ca.SX.sym("qdot", kin.n)
    vector = ca.SX.sym("loads", LoadLayout(len(kin.robot.links)).size)
    bodies = composites(kin)
    loads = external_loads(kin, bodies.J, quaternion, r_WC_W, vector, time)
    R_WB = matrix_from_quaternion(quaternion)
    omega = SymmetricFactor(bodies.D).solve(R_WB.T @ L_W - bodies.D_q @ qdot)
    x_dot = ca.vertcat(
        qdot,
        quaternion_rate(quaternion, omega),
        *loads.momentum_rates(R_WB, p_W, L_W, kin.total_mass),
        p_W / kin.total_mass,
        1.0,
    )
    x = ca.vertcat(kin.q, *symbols.values())
    inputs = {"x": x, "qdot": qdot, "loads": vector, **kin.mass_properties.inputs}
    return dense_function("loaded_servo_rate", inputs, {"x_dot": x_dot})


@dataclass(frozen=True)
class _Equations:
    """The equations of motion in a state: the symbols ``x`` and ``command`` by name, the shape
    system, ``omega_WB_B``, the base wrench as moment over force ``external``, ``Q``, and the
    external loads, if any.
    """

    inputs: dict[str, ca.SX]
    system: ShapeSystem
    omega: ca.SX
    external: ca.SX
    Q: ca.SX
    loads: ExternalLoads | None


def _equations(kin: TreeKinematics, *, loaded: bool) -> _Equations:
    quaternion, qdot, p_W, L_W, r_WC_W = (
        ca.SX.sym(name, part.stop - part.start)
        for name, part in zip(
            ("quaternion", "qdot", "p_W", "L_W", "r_WC_W"), state_slices(kin.n)[1:], strict=True
        )
    )
    command = ca.SX.sym("command", kin.n + 6)
    tau, wrench_B = command[: kin.n], command[kin.n :]
    x = ca.vertcat(kin.q, quaternion, qdot, p_W, L_W, r_WC_W)
    system = shape_system(kin)
    loads = None
    if loaded:
        vector = ca.SX.sym("loads", LoadLayout(len(kin.robot.links)).size)
        time = ca.SX.sym("time")
        loads = external_loads(kin, system.parts.J, quaternion, r_WC_W, vector, time)
        x, command = ca.vertcat(x, time), ca.vertcat(command, vector)
    external = external_force(kin, wrench_B)
    omega = system.base_motion(matrix_from_quaternion(quaternion).T @ L_W, qdot)
    Q, _ = shape_forces(system, omega, qdot, external, tau, loads)
    return _Equations({"x": x, "command": command}, system, omega, external, Q, loads)


def _angular_operator(omega: ca.SX, alpha: ca.SX) -> ca.SX:
    """Return ``hat(alpha) + hat(omega)^2`` (3, 3)."""
    squares = symmetric(omega @ omega.T)
    return ca.skew(alpha) - rotational(squares)
