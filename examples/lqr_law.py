"""A custom control law in plain numpy: a linear-quadratic regulator for base and joints.

Run it with ``python examples/lqr_law.py``; to fly any robot with it, use
``spacerobot --plugin examples/lqr_law.py run ROBOT --method lqr --goal X Y Z``.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_continuous_are
from scipy.spatial.transform import Rotation

from spacerobot_ros import fly
from spacerobot_ros.control import Actuation, ControlState, OutputSelection, Reference
from spacerobot_ros.control.laws.law import LawOptions
from spacerobot_ros.control.laws.numpy_law import NumpyLaw
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.parameters import parameter


@dataclass(frozen=True)
class LqrOptions(LawOptions):
    """The options of ``lqr``; each becomes a parameter ``lqr.<option>`` of the controller."""

    response_time: float = parameter(
        2.0, "time in which an error shall decay", unit="s", minimum=0.01
    )


class LqrLaw(NumpyLaw):
    """``[f; n; tau] = M a_ref - K dx``, with K for the robot at rest in the goal configuration.

    Errors are weighted by their share of energy: the cost is ``dx' Q dx + du' R du`` with the mass
    matrix M in ``Q = diag(M, M T^2)`` and ``R = M^-1 T^4``, where T is the response time.
    """

    name = "lqr"
    Options = LqrOptions

    @classmethod
    def default_outputs(cls, robot: SpaceRobot, end_effector_link: str) -> OutputSelection:
        """Return the outputs: the base pose and all joints."""
        return OutputSelection(("x", "y", "z", "rx", "ry", "rz"), (), robot.joint_names)

    def start(self, time: float, start: Reference, goal: Reference) -> None:
        """Compute the gains in the goal configuration."""
        super().start(time, start, goal)
        assert goal.joints is not None
        A, B = self.robot.linearised(goal.joints.q)
        n, T = 6 + self.robot.n, self.options.response_time
        M = np.linalg.inv(B[n:])
        Q = np.block([[M, np.zeros((n, n))], [np.zeros((n, n)), T**2 * M]])
        R = T**4 * np.linalg.inv(M)
        self._K = np.linalg.solve(R, B.T @ solve_continuous_are(A, B, Q, R))
        self._M = M

    def compute(self, state: ControlState, reference: Reference) -> Actuation:
        """Return the command; see :meth:`NumpyLaw.compute`."""
        base, joints = reference.base, reference.joints
        assert base is not None
        assert joints is not None
        R_WB = Rotation.from_quat(state.quaternion_WB)
        turned = Rotation.from_quat(base.quaternion).inv() * R_WB
        to_base = R_WB.inv().apply
        r, v = to_base(state.r_WB - base.position), state.v_WB_B - to_base(base.velocity)
        omega = state.omega_WB_B - to_base(base.angular_velocity)
        q, qdot = state.q - joints.q, state.qdot - joints.qdot
        a, alpha = to_base(base.acceleration), to_base(base.angular_acceleration)
        command = self._M @ np.concatenate([a, alpha, joints.qddot])
        command -= self._K @ np.concatenate([r, turned.as_rotvec(), q, v, omega, qdot])
        return Actuation(command[:6], command[6:])


if __name__ == "__main__":
    for seconds in (1.0, 2.0, 4.0):
        flight = fly(
            "surveyor", (0.4, 0.1, 0.2), law=LqrLaw, law_options={"response_time": seconds}
        )
        print(f"response time {seconds:g} s: {flight.message}")
