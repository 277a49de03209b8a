"""Dead reckoning without measurements of the base: integrated equations of motion."""

from __future__ import annotations

import numpy as np

from spacerobot_ros.control.state import Actuation, ControlState
from spacerobot_ros.model.composite_rigid_body import state_slices
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.integration import DEFAULT_INTEGRATION_STEP, count_steps
from spacerobot_ros.model.rotations import (
    matrix_from_quaternion,
    quaternion_from_rotvec,
    quaternion_multiply,
)
from spacerobot_ros.model.space_robot import SpaceRobot


class DeadReckoning:
    """Paper 4, end of section IV: the state by integration of eq. (19) under the commands sent.

    It starts at the last measured state and steps a control period at a time under held actuation,
    by Runge-Kutta 4. Differences between the model and the real robot accumulate over the time
    :attr:`elapsed`.

    The integrated state is that of :mod:`spacerobot_ros.model.composite_rigid_body`, with both
    momenta and the centre of mass, which joints do not change. Joints that are measured are
    therefore not predicted: their positions and rates replace the predicted ones, and the base
    turns by the connection ``A``. Then only the effect of the thrusters accumulates errors.

    Parameters
    ----------
    robot
        The model, as the controller believes it.
    control_period
        Duration of a step, s.
    integration_step
        Longest Runge-Kutta step, s.

    Raises
    ------
    ParameterError
        A duration is not positive.
    """

    def __init__(
        self,
        robot: SpaceRobot,
        control_period: float,
        integration_step: float = DEFAULT_INTEGRATION_STEP,
    ) -> None:
        self._substeps = count_steps(control_period, integration_step)
        self.robot = robot
        self.control_period = control_period
        self.elapsed = 0.0
        """Time since the last measured state, s."""
        self._step = robot.buffered("flight_step")
        self._x, self._command, h = self._step.inputs
        h[:] = control_period / self._substeps
        parts = (self._x[part] for part in state_slices(robot.n))
        self._q, self._quaternion, self._qdot, self._p_W, self._L_W, self._r_WC = parts

    def reset(self, measured: ControlState) -> None:
        """Start at a measured state."""
        quaternion, q, qdot = measured.quaternion_WB, measured.q, measured.qdot
        p_W, L_W, _ = self.robot.momentum(quaternion, q, measured.v_WB_B, measured.omega_WB_B, qdot)
        r_WC = measured.r_WB + matrix_from_quaternion(quaternion) @ self.robot.center_of_mass(q)
        self._x[:] = np.concatenate([q, quaternion, qdot, p_W, L_W, r_WC])
        self.elapsed = 0.0

    @property
    def state(self) -> ControlState:
        """The estimate."""
        q, quaternion, qdot = self._q.copy(), self._quaternion.copy(), self._qdot.copy()
        v, omega = self.robot.base_twist(quaternion, q, qdot, self._p_W, self._L_W)
        r = self._r_WC - matrix_from_quaternion(quaternion) @ self.robot.center_of_mass(q)
        return ControlState(r, quaternion, v, omega, q, qdot)

    def step(
        self, actuation: Actuation, q: Array | None = None, qdot: Array | None = None
    ) -> ControlState:
        """Advance one control period under held actuation and return the estimate at its end.

        ``q`` and ``qdot`` (n,) are the joints measured at the end of the period, if they are.
        """
        self._command[:] = np.concatenate([actuation.tau, actuation.wrench_B])
        for _ in range(self._substeps):
            self._step.evaluate()
            self._x[:] = self._step.outputs[0]
        if q is not None and qdot is not None:
            # At the middle of the difference the connection is right to second order.
            A = self.robot.connection((self._q + q) / 2)
            turn = quaternion_from_rotvec(-A[3:] @ (q - self._q))
            self._quaternion[:] = quaternion_multiply(self._quaternion, turn)
            self._q[:], self._qdot[:] = q, qdot
        self.elapsed += self.control_period
        return self.state
