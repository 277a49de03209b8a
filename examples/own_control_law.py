"""A custom control law: transposed-Jacobian control with saturation.

Run it with ``python examples/own_control_law.py``, or fly it with
``spacerobot --plugin examples/own_control_law.py run coordinated_control --method soft``.
"""

from dataclasses import dataclass

import casadi as ca
import numpy as np

from spacerobot_ros.control import ControlState, Gains, PoseReference, Reference
from spacerobot_ros.control.laws.law import ControlLaw, LawOptions
from spacerobot_ros.control.laws.transposed_jacobian import TransposedJacobianLaw
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.parameters import parameter
from spacerobot_ros.resources import robot_file


@dataclass(frozen=True)
class SoftOptions(LawOptions):
    """The options of ``soft``."""

    reach: float = parameter(0.2, "errors beyond this pull hardly harder", minimum=1e-6)


class SoftLaw(ControlLaw):
    """``[f; n; tau] = J_q^-T J_z' (Kp d tanh(e / d) + Kd edot)``, after paper 4, eq. (29)."""

    name = "soft"
    gain_units = ("N/m or N m/rad", "N s/m or N m s/rad")
    Options = SoftOptions

    def results(self, symbols: dict[str, ca.SX]) -> dict[str, ca.SX]:
        """Return the command's expressions; see :meth:`ControlLaw.results`."""
        z1, d = self.outputs, self.options.reach
        pull = symbols["kp"] * d * ca.tanh(z1.error / d) + symbols["kd"] * z1.error_rate
        return {"actuation": (z1.J_z @ z1.J_q_inverse).T @ pull}


def main() -> None:
    """Compare the commands of this law and of paper 4's law, near the goal and far from it."""
    robot = SpaceRobot.from_file(robot_file("planar_manipulator"))
    upright = np.array([0.0, 0.0, 0.0, 1.0])
    state = ControlState.at_rest(np.zeros(3), upright, np.array([-1.0, 1.0]))
    now = Reference.present(robot, state, "end_effector")
    assert now.end_effector is not None
    for distance in (0.01, 0.1, 1.0):
        base = PoseReference(np.array([distance, 0.0, 0.0]), upright)
        forces = []
        for law in (TransposedJacobianLaw, SoftLaw):
            outputs = law.default_outputs(robot, "end_effector")
            command = law(robot, outputs, Gains.uniform(30.0, 60.0)).command(
                state, Reference(base, now.end_effector)
            )
            forces.append(f"{law.name} {command.wrench_B[0]:.3f} N")
        print(f"{distance:g} m from the goal: {', '.join(forces)}")


if __name__ == "__main__":
    main()
