"""MuJoCo as an oracle."""

from __future__ import annotations

import mujoco
import numpy as np
from support.oracles.agreement import Array
from support.oracles.oracle import Oracle


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
