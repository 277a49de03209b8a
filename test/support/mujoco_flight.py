"""MuJoCo flying a robot under held joint efforts and a wrench held in the axes of the base."""

from __future__ import annotations

import mujoco
import numpy as np
import numpy.typing as npt
from support.oracles import Array, MujocoOracle


class MujocoFlight(MujocoOracle):
    """A robot with motors at its joints and thrusters at the origin of its base link.

    The thrusters are six motors on a site of the base, along and about its axes. They turn with
    it within a step, unlike ``xfrc_applied`` and ``qfrc_applied``, which are held in the world.
    """

    def describe(self, urdf: str) -> mujoco.MjSpec:
        spec = super().describe(urdf)
        spec.worldbody.first_body().add_site(name="thrusters")
        for gear in np.eye(6):
            motor = spec.add_actuator(trntype=mujoco.mjtTrn.mjTRN_SITE, target="thrusters")
            motor.gear = gear
        for name in self.joint_names:
            spec.add_actuator(trntype=mujoco.mjtTrn.mjTRN_JOINT, target=name)
        return spec

    def start(
        self, pose: Array, twist: Array, q: npt.ArrayLike, qdot: Array, step: float = 1e-3
    ) -> None:
        """Set the state as a plant publishes it, and the step in s of Runge-Kutta 4."""
        self.model.opt.integrator = mujoco.mjtIntegrator.mjINT_RK4
        self.model.opt.timestep = step
        self.set_configuration(np.asarray(q), pose[3:], pose[:3])
        self.move(self.base_velocities(twist) + self.joint_velocities(qdot))

    def fly(self, effort: npt.ArrayLike, wrench_B: npt.ArrayLike, steps: int) -> None:
        """Take steps under joint efforts (n,) and force over torque (6,), base components."""
        self.data.ctrl[:6] = wrench_B
        self.data.ctrl[6:] = effort
        mujoco.mj_step(self.model, self.data, nstep=steps)

    @property
    def pose(self) -> Array:
        """(7,) position and quaternion (x, y, z, w) of the base link."""
        return np.append(self.data.qpos[:3], np.roll(self.data.qpos[3:7], -1))

    @property
    def joints(self) -> tuple[Array, Array]:
        """Positions and velocities of the joints."""
        return np.array(self.data.qpos[self._q]), self.selection[3:] @ self.data.qvel
