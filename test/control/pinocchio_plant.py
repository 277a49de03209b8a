"""A plant of its own: Pinocchio's articulated-body algorithm under Runge-Kutta 4."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import pinocchio as pin

from spacerobot_ros.control import Actuation, ControlState

Array = npt.NDArray[np.float64]


class PinocchioPlant:
    """A free-floating robot under a wrench at its base link's origin and joint efforts.

    Shapes are given and reported in the order of ``joint_names``; Pinocchio has its own, which is
    that of the state vector in here: ``x = [r_WB; quaternion_WB; q; v_WB_B; omega_WB_B; qdot]``.
    """

    def __init__(
        self, urdf: str, joint_names: Sequence[str], start: ControlState, longest_step: float = 0.01
    ) -> None:
        self.model = pin.buildModelFromXML(urdf, pin.JointModelFreeFlyer())
        self.model.gravity = pin.Motion.Zero()
        self.data = self.model.createData()
        self._n = len(joint_names)
        joints = [self.model.joints[self.model.getJointId(name)] for name in joint_names]
        # Where each named joint is among Pinocchio's joint velocities.
        self._place = np.array([joint.idx_v - 6 for joint in joints], dtype=int)
        in_order = list(self.model.joints)[2:]
        # A continuous joint is a point on the unit circle: cosine and sine.
        self._circles = [(joint.idx_v - 6, joint.idx_q) for joint in in_order if joint.nq == 2]
        self._lines = [(joint.idx_v - 6, joint.idx_q) for joint in in_order if joint.nq == 1]
        self._external = [pin.Force.Zero() for _ in range(self.model.njoints)]
        self.longest_step = longest_step
        self.state = start

    def step(self, actuation: Actuation, duration: float) -> ControlState:
        """Advance under held actuation; return the new state."""
        count = max(1, round(duration / self.longest_step))
        h = duration / count
        efforts = self._efforts(actuation)
        x = self._stacked()
        for _ in range(count):
            k1 = self._rate(x, efforts)
            k2 = self._rate(x + h / 2 * k1, efforts)
            k3 = self._rate(x + h / 2 * k2, efforts)
            k4 = self._rate(x + h * k3, efforts)
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
            x[3:7] /= math.sqrt(x[3:7].dot(x[3:7]))
        q, u = x[7 : 7 + self._n], x[7 + self._n :]
        self.state = ControlState(x[:3], x[3:7], u[:3], u[3:6], q[self._place], u[6:][self._place])
        return self.state

    def frame(self, link: str) -> tuple[Array, Array]:
        """Return position (3,) and attitude (3, 3) in W of a link's frame."""
        pin.framesForwardKinematics(self.model, self.data, self._configuration(self._stacked()))
        placement = self.data.oMf[self.model.getFrameId(link, pin.FrameType.BODY)]
        return np.array(placement.translation), np.array(placement.rotation)

    def momentum(self) -> Array:
        """Return linear over angular momentum about the centre of mass (6,), in W."""
        x = self._stacked()
        h = pin.computeCentroidalMomentum(
            self.model, self.data, self._configuration(x), x[7 + self._n :]
        )
        return np.concatenate([h.linear, h.angular])

    def kinetic_energy(self) -> float:
        """Return the kinetic energy: that of the centre of mass, and the work of the rest, J."""
        x = self._stacked()
        q, velocity = self._configuration(x), x[7 + self._n :]
        return float(pin.computeKineticEnergy(self.model, self.data, q, velocity))

    def acceleration(self, actuation: Actuation) -> tuple[Array, Array]:
        """Return the rates of the base twist ``[v; omega]_B`` (6,) and of qdot (n,)."""
        rate = self._rate(self._stacked(), self._efforts(actuation))[7 + self._n :]
        return rate[:6], rate[6:][self._place]

    def _stacked(self) -> Array:
        s = self.state
        q, qdot = np.empty(self._n), np.empty(self._n)
        q[self._place], qdot[self._place] = s.q, s.qdot
        return np.concatenate([s.r_WB, s.quaternion_WB, q, s.v_WB_B, s.omega_WB_B, qdot])

    def _efforts(self, actuation: Actuation) -> Array:
        self._external[1] = pin.Force(actuation.wrench_B[:3], actuation.wrench_B[3:])
        efforts = np.zeros(self.model.nv)
        efforts[6 + self._place] = actuation.tau
        return efforts

    def _configuration(self, x: Array) -> Array:
        q = np.empty(self.model.nq)
        q[:7] = x[:7]
        q[3:7] /= math.sqrt(x[3:7].dot(x[3:7]))
        if not self._circles:
            q[7:] = x[7 : 7 + self._n]
            return q
        for v_index, q_index in self._lines:
            q[q_index] = x[7 + v_index]
        for v_index, q_index in self._circles:
            angle = x[7 + v_index]
            q[q_index : q_index + 2] = math.cos(angle), math.sin(angle)
        return q

    def _rate(self, x: Array, efforts: Array) -> Array:
        n = self._n
        q, u = self._configuration(x), x[7 + n :]
        rate = np.empty(len(x))
        vx, vy, vz, ox, oy, oz = u[:6].tolist()
        ix, iy, iz, w = q[3:7].tolist()
        # R v = v + 2 w (i x v) + 2 i x (i x v).
        tx, ty, tz = 2 * (iy * vz - iz * vy), 2 * (iz * vx - ix * vz), 2 * (ix * vy - iy * vx)
        rate[0] = vx + w * tx + iy * tz - iz * ty
        rate[1] = vy + w * ty + iz * tx - ix * tz
        rate[2] = vz + w * tz + ix * ty - iy * tx
        ix, iy, iz, w = x[3:7].tolist()
        rate[3] = 0.5 * (w * ox + iy * oz - iz * oy)
        rate[4] = 0.5 * (w * oy + iz * ox - ix * oz)
        rate[5] = 0.5 * (w * oz + ix * oy - iy * ox)
        rate[6] = -0.5 * (ix * ox + iy * oy + iz * oz)
        rate[7 : 7 + n] = u[6:]
        rate[7 + n :] = pin.aba(self.model, self.data, q, u, efforts, self._external)
        return rate
