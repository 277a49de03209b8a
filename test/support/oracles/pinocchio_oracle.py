"""Pinocchio as an oracle."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from support.oracles.agreement import Array
from support.oracles.oracle import Oracle


class PinocchioOracle(Oracle):
    """Pinocchio: u has the base twist in base components, as the model has it."""

    def load(self, urdf: str) -> None:
        self.model = pin.buildModelFromXML(urdf, pin.JointModelFreeFlyer())
        self.model.gravity = pin.Motion.Zero()
        self.model.armature = np.zeros(self.model.nv)
        self.data = self.model.createData()
        ids = [self.model.getJointId(name) for name in self.joint_names]
        assert max(ids, default=0) < self.model.njoints
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
