"""Pinocchio and MuJoCo on the same URDF: dynamics engines that the model is held against.

Each engine answers in its own velocities ``u``. What turns those into the model's
``z0dot = [v_cm; omega; qdot]`` (v_cm the velocity of the SYSTEM's centre of mass, the first two in
base components) is built here from the same engine's centre of mass and Jacobians alone.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
import numpy.typing as npt
import pinocchio as pin
from scipy.spatial.transform import Rotation

Array = npt.NDArray[np.float64]

TOLERANCE = 1e-10


def _solve(matrix: Array, right: Array) -> Array:
    return np.asarray(np.linalg.solve(matrix, right), dtype=np.float64)


def relative_deviation(actual: npt.ArrayLike, expected: npt.ArrayLike) -> float:
    """Return ``|actual - expected| / |expected|``, Euclidean (Frobenius) norms of the whole array.

    Where next to nothing is expected (a norm below 1e-3 in SI units) it is ``|actual - expected|``
    over 1e-3.
    """
    a, e = np.asarray(actual, dtype=float), np.asarray(expected, dtype=float)
    if a.shape != e.shape:
        raise AssertionError(f"shape {a.shape} where {e.shape} is expected")
    return float(np.linalg.norm(a - e) / max(float(np.linalg.norm(e)), 1e-3))


def assert_agrees(
    actual: npt.ArrayLike, expected: npt.ArrayLike, tolerance: float = TOLERANCE
) -> None:
    """Assert that two arrays agree norm-wise, by default to 1e-10 relative."""
    deviation = relative_deviation(actual, expected)
    assert deviation <= tolerance, (
        f"relative deviation {deviation:.3g} > {tolerance:.3g}\n"
        f"actual: {actual!r}\nexpected: {expected!r}"
    )


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

    def link_pose(self, link: str, q: Array) -> tuple[Array, Array]:
        """Return ``(R_BL, r_BL_B)`` of a link's frame."""
        self.set_configuration(q)
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


class PinocchioOracle(Oracle):
    """Pinocchio: u has the base twist in base components, as the model has it."""

    def load(self, urdf: str) -> None:
        self.model = pin.buildModelFromXML(urdf, pin.JointModelFreeFlyer())
        self.model.gravity = pin.Motion.Zero()
        self.model.armature = np.zeros(self.model.nv)
        self.data = self.model.createData()
        ids = [self.model.getJointId(name) for name in self.joint_names]
        assert max(ids) < self.model.njoints
        self._joints = [self.model.joints[index] for index in ids]
        self._selection = np.zeros((3 + self.n, 6 + self.n))
        self._selection[:3, 3:6] = np.eye(3)
        for row, joint in enumerate(self._joints, start=3):
            self._selection[row, joint.idx_v] = 1.0

    def place(self, q: Array, quaternion_WB: Array, r_WB_W: Array) -> None:
        self.q = pin.neutral(self.model)
        self.q[:7] = np.concatenate([r_WB_W, quaternion_WB])
        for joint, value in zip(self._joints, q, strict=True):
            # A continuous joint is a point on the unit circle.
            own = (value,) if joint.nq == 1 else (np.cos(value), np.sin(value))
            self.q[joint.idx_q : joint.idx_q + joint.nq] = own
        pin.computeJointJacobians(self.model, self.data, self.q)
        pin.updateFramePlacements(self.model, self.data)

    def move(self, u: Array) -> None:
        self.u = u

    @property
    def selection(self) -> Array:
        return self._selection

    def own_base_velocity(self, v_WB_B: Array) -> Array:
        return v_WB_B

    def own_mass_matrix(self) -> Array:
        M = np.triu(pin.crba(self.model, self.data, self.q))
        return M + np.triu(M, 1).T

    def own_bias(self) -> Array:
        return np.array(pin.rnea(self.model, self.data, self.q, self.u, np.zeros(self.model.nv)))

    def own_acceleration(self, wrench_B: Array, tau: Array) -> Array:
        external = [pin.Force.Zero() for _ in range(self.model.njoints)]
        external[1] = pin.Force(wrench_B[:3], wrench_B[3:])
        efforts = self.joint_velocities(tau)
        return np.array(pin.aba(self.model, self.data, self.q, self.u, efforts, external))

    def center_of_mass_jacobian_W(self) -> Array:
        return np.array(pin.jacobianCenterOfMass(self.model, self.data, self.q))

    def center_of_mass_bias_acceleration_W(self) -> Array:
        pin.centerOfMass(self.model, self.data, self.q, self.u, np.zeros(self.model.nv))
        return np.array(self.data.acom[0])

    def center_of_mass_W(self) -> Array:
        return np.array(pin.centerOfMass(self.model, self.data, self.q))

    def momentum_matrix_W(self) -> Array:
        return np.array(pin.computeCentroidalMap(self.model, self.data, self.q))

    def momentum_W(self) -> tuple[Array, Array, float]:
        h = pin.computeCentroidalMomentum(self.model, self.data, self.q, self.u)
        energy = pin.computeKineticEnergy(self.model, self.data, self.q, self.u)
        return np.array(h.linear), np.array(h.angular), float(energy)

    def frame_W(self, link: str) -> tuple[Array, Array]:
        placement = self.data.oMf[self._frame(link)]
        return np.array(placement.rotation), np.array(placement.translation)

    def frame_jacobian_W(self, link: str) -> Array:
        frame = self._frame(link)
        reference = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        return np.array(pin.computeFrameJacobian(self.model, self.data, self.q, frame, reference))

    def _frame(self, link: str) -> int:
        index = int(self.model.getFrameId(link, pin.FrameType.BODY))
        assert index < self.model.nframes, link
        return index


class MujocoOracle(Oracle):
    """MuJoCo: u has the base velocity in world and its rate in base components."""

    def describe(self, urdf: str) -> mujoco.MjSpec:
        """Return the description that is compiled."""
        spec = mujoco.MjSpec.from_string(urdf)
        # Left alone, links on fixed joints lose their names and the root is welded to the world.
        spec.compiler.fusestatic = False
        spec.worldbody.first_body().add_freejoint()
        return spec

    def load(self, urdf: str) -> None:
        self.model = self.describe(urdf).compile()
        self.model.opt.gravity[:] = 0.0
        self.model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
        assert not self.model.dof_armature.any()
        assert not self.model.dof_damping.any()
        self.data = mujoco.MjData(self.model)
        joints = [self.model.joint(name) for name in self.joint_names]
        self._q = [int(joint.qposadr[0]) for joint in joints]
        self._selection = np.zeros((3 + self.n, 6 + self.n))
        self._selection[:3, 3:6] = np.eye(3)
        for row, joint in enumerate(joints, start=3):
            self._selection[row, int(joint.dofadr[0])] = 1.0
        self._root = 1

    def place(self, q: Array, quaternion_WB: Array, r_WB_W: Array) -> None:
        self.data.qpos[:3] = r_WB_W
        # (w, x, y, z).
        self.data.qpos[3:7] = np.roll(quaternion_WB, 1)
        self.data.qpos[self._q] = q

    def move(self, u: Array) -> None:
        self.data.qvel[:] = u
        mujoco.mj_forward(self.model, self.data)

    @property
    def selection(self) -> Array:
        return self._selection

    def own_base_velocity(self, v_WB_B: Array) -> Array:
        return np.asarray(self.R_WB @ v_WB_B)

    def own_mass_matrix(self) -> Array:
        M = np.zeros((self.model.nv, self.model.nv))
        mujoco.mj_fullM(self.model, self.data, M)
        return M

    def own_bias(self) -> Array:
        return np.array(self.data.qfrc_bias)

    def own_acceleration(self, wrench_B: Array, tau: Array) -> Array:
        forces = self.joint_velocities(tau)
        force_W, torque_W = self.R_WB @ wrench_B[:3], self.R_WB @ wrench_B[3:]
        origin = self.data.xpos[self._root]
        mujoco.mj_applyFT(self.model, self.data, force_W, torque_W, origin, self._root, forces)
        self.data.qfrc_applied[:] = forces
        mujoco.mj_forward(self.model, self.data)
        self.data.qfrc_applied[:] = 0.0
        return np.array(self.data.qacc)

    def center_of_mass_jacobian_W(self) -> Array:
        J = np.zeros((3, self.model.nv))
        mujoco.mj_jacSubtreeCom(self.model, self.data, J, self._root)
        return J

    def center_of_mass_bias_acceleration_W(self) -> Array:
        total = np.zeros(3)
        for body in range(1, self.model.nbody):
            J_dot = np.zeros((3, self.model.nv))
            point = self.data.xipos[body]
            mujoco.mj_jacDot(self.model, self.data, J_dot, None, point, body)
            total += self.model.body_mass[body] * (J_dot @ self.data.qvel)
        return total / float(self.model.body_mass.sum())

    def center_of_mass_W(self) -> Array:
        return np.array(self.data.subtree_com[self._root])

    def momentum_matrix_W(self) -> Array:
        angular = np.zeros((3, self.model.nv))
        mujoco.mj_angmomMat(self.model, self.data, angular, self._root)
        mass = float(self.model.body_mass.sum())
        return np.vstack([mass * self.center_of_mass_jacobian_W(), angular])

    def momentum_W(self) -> tuple[Array, Array, float]:
        mujoco.mj_subtreeVel(self.model, self.data)
        mujoco.mj_energyVel(self.model, self.data)
        mass = float(self.model.body_mass.sum())
        linear = mass * np.array(self.data.subtree_linvel[self._root])
        return linear, np.array(self.data.subtree_angmom[self._root]), float(self.data.energy[1])

    def frame_W(self, link: str) -> tuple[Array, Array]:
        body = self.data.body(link)
        return np.array(body.xmat).reshape(3, 3), np.array(body.xpos)

    def frame_jacobian_W(self, link: str) -> Array:
        linear, angular = np.zeros((2, 3, self.model.nv))
        body = int(self.model.body(link).id)
        mujoco.mj_jacBody(self.model, self.data, linear, angular, body)
        return np.vstack([linear, angular])


ENGINES: tuple[type[Oracle], ...] = (PinocchioOracle, MujocoOracle)
