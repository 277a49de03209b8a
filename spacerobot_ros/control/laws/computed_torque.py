"""Control of the shape only, by joint efforts; the base floats freely."""

from __future__ import annotations

from typing import ClassVar

import casadi as ca
from typing_extensions import override

from spacerobot_ros.control.laws.law import ACCELERATION_GAINS, ControlLaw
from spacerobot_ros.control.outputs import OutputSelection
from spacerobot_ros.errors import ParameterError
from spacerobot_ros.model.dynamics import solve_positive_definite
from spacerobot_ros.model.space_robot import SpaceRobot


class ComputedTorqueLaw(ControlLaw):
    """Paper 3, eqs (2) and (6-9): ``tau = Js(q) u + Fs``, so that the shape obeys ``qddot = u``.

    Here ``u = qddot_ref + Kd (qdot_ref - qdot) + Kp (q_ref - q)`` (Kp in 1/s^2, Kd in 1/s). The
    base reacts with ``omegadot = -D^-1 (D_q u + C_omega)``, the base rows of eq. (19) of paper 4
    without a wrench; inserted into the joint rows, this gives ``Js = D_qq - D_q' D^-1 D_q`` and
    ``Fs = C_q - D_q' D^-1 C_omega``. This form holds for any spatial tree and any momentum; the
    paper's case is a planar chain without angular momentum. No wrench is commanded, so both momenta
    are conserved.
    """

    name: ClassVar[str] = "computed_torque"
    gain_units: ClassVar[tuple[str, str]] = ACCELERATION_GAINS

    @classmethod
    @override
    def accepted_outputs(cls, robot: SpaceRobot, outputs: OutputSelection) -> OutputSelection:
        """Return all joints, in the order of q.

        Raises
        ------
        ParameterError
            The outputs are not exactly all joints: this law commands the whole shape.
        """
        if outputs.base or outputs.end_effector or set(outputs.joints) != set(robot.joint_names):
            raise ParameterError(
                f"The law '{cls.name}' controls exactly the joints; its outputs must be the "
                f"joints {', '.join(robot.joint_names)}."
            )
        return OutputSelection(joints=robot.joint_names)

    @classmethod
    @override
    def default_outputs(cls, robot: SpaceRobot, end_effector_link: str) -> OutputSelection:
        return OutputSelection(joints=robot.joint_names)

    @override
    def results(self, symbols: dict[str, ca.SX]) -> dict[str, ca.SX]:
        z1 = self.outputs
        H = z1.model("inertia_matrix", z1.q)
        C = z1.model("bias", z1.q, z1.v_cm, z1.omega, z1.qdot)
        u = z1.acceleration + symbols["kd"] * z1.error_rate + symbols["kp"] * z1.error
        u += symbols["integral"]
        D, D_q, D_qq = H[3:6, 3:6], H[3:6, 6:], H[6:, 6:]
        omega_dot = -solve_positive_definite(D, D_q @ u + C[3:6])
        tau = D_qq @ u + D_q.T @ omega_dot + C[6:]
        return {"actuation": ca.vertcat(ca.SX(6, 1), tau)}
