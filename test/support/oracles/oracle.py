"""What a dynamics engine has to say, and the model's quantities made of it.

Each engine answers in its own velocities ``u``. What turns those into the model's
``z0dot = [v_cm; omega; qdot]`` (v_cm the velocity of the SYSTEM's centre of mass, the first two in
base components) is built here from the same engine's centre of mass and Jacobians alone.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation
from support.oracles.agreement import Array


def _solve(matrix: Array, right: Array) -> Array:
    return np.asarray(np.linalg.solve(matrix, right), dtype=np.float64)


@dataclass(frozen=True)
class Motion:
    """A state of a robot: shape and rates in the caller's joint order, pose and twist of the base.

    ``quaternion_WB`` is (x, y, z, w); ``v_cm_B`` and ``omega_WB_B`` are in base components.
    """

    q: Array
    qdot: Array
    quaternion_WB: Array
    r_WB_W: Array
    v_cm_B: Array
    omega_WB_B: Array

    @property
    def z0dot(self) -> Array:
        """The model's velocities ``[v_cm; omega; qdot]``."""
        return np.concatenate([self.v_cm_B, self.omega_WB_B, self.qdot])


def random_motion(rng: np.random.Generator, joints: int) -> Motion:
    """Return a state of order one in everything, anywhere and turned anyhow."""
    quaternion = rng.normal(size=4)
    return Motion(
        q=rng.uniform(-1.5, 1.5, joints),
        qdot=rng.uniform(-1.0, 1.0, joints),
        quaternion_WB=quaternion / np.linalg.norm(quaternion),
        r_WB_W=rng.uniform(-2.0, 2.0, 3),
        v_cm_B=rng.uniform(-1.0, 1.0, 3),
        omega_WB_B=rng.uniform(-1.0, 1.0, 3),
    )


class Oracle(ABC):
    """An engine with a free root, no gravity, no friction, and nothing else that the URDF lacks.

    ``joint_names`` is the order in which shapes are given and results are wanted; the engine has
    its own, and joints are found by name.
    """

    def __init__(self, urdf: str, joint_names: Sequence[str]) -> None:
        self.joint_names = tuple(joint_names)
        self.n = len(self.joint_names)
        self.R_WB = np.eye(3)
        self.load(urdf)

    # -- what an engine has to say, in its own velocities u ---------------------------------------

    @abstractmethod
    def load(self, urdf: str) -> None:
        """Build the engine's model and find the joints."""

    @abstractmethod
    def place(self, q: Array, quaternion_WB: Array, r_WB_W: Array) -> None:
        """Put the robot into a configuration."""

    @abstractmethod
    def move(self, u: Array) -> None:
        """Set the velocities, in the configuration of the last :meth:`place`."""

    @property
    @abstractmethod
    def selection(self) -> Array:
        """(3 + n, 6 + n): ``[omega_WB_B; qdot] = selection @ u``, entries u has as they are."""

    @abstractmethod
    def own_base_velocity(self, v_WB_B: Array) -> Array:
        """Return the first three entries of u at a velocity of the base origin."""

    @abstractmethod
    def own_mass_matrix(self) -> Array:
        """Return M (6 + n, 6 + n) of u."""

    @abstractmethod
    def own_bias(self) -> Array:
        """Return h (6 + n,) of ``M udot + h = forces``."""

    @abstractmethod
    def own_acceleration(self, wrench_B: Array, tau: Array) -> Array:
        """Return udot (6 + n,) under a wrench at the base origin and joint efforts."""

    @abstractmethod
    def center_of_mass_jacobian_W(self) -> Array:
        """Return (3, 6 + n): u to the velocity of the system's centre of mass, world components."""

    @abstractmethod
    def center_of_mass_bias_acceleration_W(self) -> Array:
        """Return (3,) the acceleration of the system's centre of mass at ``udot = 0``, world."""

    @abstractmethod
    def center_of_mass_W(self) -> Array:
        """Return (3,) the system's centre of mass, world."""

    @abstractmethod
    def momentum_matrix_W(self) -> Array:
        """Return (6, 6 + n): u to linear over angular momentum about the centre of mass, world."""

    @abstractmethod
    def momentum_W(self) -> tuple[Array, Array, float]:
        """Return linear and angular momentum about the centre of mass (world), kinetic energy."""

    @abstractmethod
    def frame_W(self, link: str) -> tuple[Array, Array]:
        """Return attitude ``R_WL`` (3, 3) and position (3,) of a link's frame in the world."""

    @abstractmethod
    def frame_jacobian_W(self, link: str) -> Array:
        """Return (6, 6 + n): u to linear over angular velocity of a link's frame, world."""

    # -- the model's quantities -------------------------------------------------------------------

    def to_z0dot(self) -> Array:
        """Return ``T`` (6 + n, 6 + n), ``z0dot = T u``, of the present configuration."""
        return np.vstack([self.R_WB.T @ self.center_of_mass_jacobian_W(), self.selection])

    def set_motion(self, motion: Motion) -> None:
        """Put the robot into a state."""
        self.set_configuration(motion.q, motion.quaternion_WB, motion.r_WB_W)
        self.move(_solve(self.to_z0dot(), motion.z0dot))

    def set_configuration(
        self,
        q: Array,
        quaternion_WB: npt.ArrayLike = (0, 0, 0, 1),
        r_WB_W: npt.ArrayLike = (0, 0, 0),
    ) -> None:
        """Put the robot at rest into a configuration."""
        quaternion = np.asarray(quaternion_WB, dtype=float)
        self.R_WB = Rotation.from_quat(quaternion).as_matrix()
        self.place(np.asarray(q, dtype=float), quaternion, np.asarray(r_WB_W, dtype=float))
        self.move(np.zeros(6 + self.n))

    def mass_matrix(self, motion: Motion) -> Array:
        """Return H+ (6 + n, 6 + n): the engine's mass matrix in the velocities z0dot."""
        self.set_motion(motion)
        T_inverse = np.linalg.inv(self.to_z0dot())
        return T_inverse.T @ self.own_mass_matrix() @ T_inverse

    def velocity_products(self, motion: Motion) -> Array:
        """Return ``Tdot u`` (6 + n,): the rate of z0dot at ``udot = 0``.

        The velocity of the centre of mass is measured along axes that turn with the base.
        """
        along_base = self.R_WB.T @ self.center_of_mass_bias_acceleration_W()
        along_base = along_base - np.cross(motion.omega_WB_B, motion.v_cm_B)
        return np.concatenate([along_base, np.zeros(3 + self.n)])

    def bias(self, motion: Motion) -> Array:
        """Return C+ (6 + n,): from ``M udot + h = f`` and ``z0ddot = T udot + Tdot u``."""
        self.set_motion(motion)
        T = self.to_z0dot()
        udot = _solve(T, self.velocity_products(motion))
        return _solve(T.T, self.own_bias() - self.own_mass_matrix() @ udot)

    def forward_dynamics(self, motion: Motion, wrench_B: Array, tau: Array) -> Array:
        """Return z0ddot (6 + n,) under a wrench at the base origin and joint efforts."""
        self.set_motion(motion)
        udot = self.own_acceleration(wrench_B, tau)
        return self.to_z0dot() @ udot + self.velocity_products(motion)

    def connection(self, q: Array) -> Array:
        """Return A (6, n): minus the base twists that cancel the momenta of unit joint rates."""
        return -np.column_stack([self.base_twist(q, rate) for rate in np.eye(self.n)])

    def base_twist(
        self,
        q: Array,
        qdot: Array,
        quaternion_WB: npt.ArrayLike = (0, 0, 0, 1),
        momentum_W: npt.ArrayLike = (0, 0, 0, 0, 0, 0),
    ) -> Array:
        """Return ``[v_WB_B; omega_WB_B]`` at joint rates and momenta (about the CoM, world)."""
        self.set_configuration(q, quaternion_WB)
        base = np.column_stack([self.base_velocities(column) for column in np.eye(6)])
        matrix = self.momentum_matrix_W()
        of_joints = matrix @ self.joint_velocities(np.asarray(qdot, dtype=float))
        return _solve(matrix @ base, np.asarray(momentum_W, dtype=float) - of_joints)

    def base_velocities(self, twist_B: Array) -> Array:
        """Return u (6 + n,) of a base twist ``[v_WB_B; omega_WB_B]`` with the joints at rest."""
        u = np.zeros(6 + self.n)
        u[:3] = self.own_base_velocity(twist_B[:3])
        u[3:6] = twist_B[3:]
        return u

    def joint_velocities(self, qdot: Array) -> Array:
        """Return u (6 + n,) of joint rates with the base at rest."""
        return self.selection.T @ np.concatenate([np.zeros(3), qdot])

    def center_of_mass(self, q: Array) -> Array:
        """Return ``r_BC_B`` (3,): the system's centre of mass from the base origin."""
        self.set_configuration(q)
        return self.center_of_mass_W()

    def link_pose(
        self, link: str, q: Array, pose: npt.ArrayLike = (0, 0, 0, 0, 0, 0, 1)
    ) -> tuple[Array, Array]:
        """Return ``(R_WL, r_WL_W)`` of a link's frame, with the base at the origin by default."""
        at = np.asarray(pose, dtype=float)
        self.set_configuration(q, at[3:], at[:3])
        return self.frame_W(link)

    def jacobian(self, link: str, motion: Motion) -> Array:
        """Return J+ (6, 6 + n): z0dot to the twist of a link's frame, base components."""
        self.set_motion(motion)
        J = self.frame_jacobian_W(link)
        along_base = np.vstack([self.R_WB.T @ J[:3], self.R_WB.T @ J[3:]])
        return _solve(self.to_z0dot().T, along_base.T).T

    def momentum(self, motion: Motion, v_WB_B: Array | None = None) -> tuple[Array, Array, float]:
        """Return linear momentum, angular momentum about the CoM (world) and kinetic energy.

        With ``v_WB_B`` the base origin has that velocity; without, the centre of mass has
        the motion's.
        """
        self.set_motion(motion)
        if v_WB_B is not None:
            twist = np.concatenate([v_WB_B, motion.omega_WB_B])
            self.move(self.base_velocities(twist) + self.joint_velocities(motion.qdot))
        return self.momentum_W()
