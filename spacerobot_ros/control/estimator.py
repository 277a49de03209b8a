"""Dead reckoning without measurements of the base: integrated equations of motion."""

from __future__ import annotations

import casadi as ca

from spacerobot_ros.control.state import Actuation, ControlState
from spacerobot_ros.model.compilation import BufferedFunction, compiled, dense_function
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.integration import (
    DEFAULT_INTEGRATION_STEP,
    repeated,
    runge_kutta_step,
    steps_in,
)
from spacerobot_ros.model.space_robot import SpaceRobot
from spacerobot_ros.model.symbolic_rotations import (
    matrix_from_quaternion,
    quaternion_from_rotvec,
    quaternion_multiply,
    quaternion_rate,
)


class DeadReckoning:
    """Paper 4, end of section IV: the state by integration of eq. (19) under the commands sent.

    It starts at the last measured state and steps a control period at a time under held actuation,
    by Runge-Kutta 4. Differences between the model and the real robot accumulate over the time
    :attr:`elapsed`.

    Joints that are measured are not predicted. The predicted shape is replaced by the measured one,
    and the base moves by the difference: the centre of mass and both momenta, which no joint effort
    changes, stay as predicted, and the attitude follows by the connection ``A``. Then only the
    effect of the thrusters accumulates errors.

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
        substeps = steps_in(control_period, integration_step)
        self.robot = robot
        self.control_period = control_period
        self.elapsed = 0.0
        """Time since the last measured state, s."""
        self._advance = BufferedFunction(compiled(_effort_step(robot, substeps)))
        self._correct = BufferedFunction(compiled(_joint_correction(robot)))
        self._advance.inputs[3][:] = control_period
        self._state, self._next = self._advance.inputs[0], self._advance.outputs[0]

    def reset(self, measured: ControlState) -> None:
        """Start at a measured state."""
        measured.stack(self._state)
        self.elapsed = 0.0

    @property
    def state(self) -> ControlState:
        """The estimate."""
        return ControlState.unstack(self._state)

    def step(
        self, actuation: Actuation, q: Array | None = None, qdot: Array | None = None
    ) -> ControlState:
        """Advance one control period under held actuation and return the estimate at its end.

        ``q`` and ``qdot`` (n,) are the joints measured at the end of the period, if they are.
        """
        self._advance.inputs[1][:] = actuation.wrench_B
        self._advance.inputs[2][:] = actuation.tau
        self._advance.evaluate()
        self._state[:] = self._next
        if q is not None and qdot is not None:
            predicted, measured_q, measured_qdot = self._correct.inputs
            predicted[:], measured_q[:], measured_qdot[:] = self._next, q, qdot
            self._correct.evaluate()
            self._state[:] = self._correct.outputs[0]
        self.elapsed += self.control_period
        return self.state


def _split(x: ca.SX, n: int) -> list[ca.SX]:
    return ca.vertsplit(x, [0, 3, 7, 10, 13, 13 + n, 13 + 2 * n])


def _effort_step(robot: SpaceRobot, substeps: int) -> ca.Function:
    """Return ``(x, wrench_B, tau, h) -> x`` of a stacked :class:`ControlState`, RK4.

    The integrated state is ``y``, in which position and velocity are those of the centre of mass
    (``r_cm`` in W, ``v_cm`` in base components), as in eq. (19).
    """
    x, h = ca.MX.sym("x", 13 + 2 * robot.n), ca.MX.sym("h")
    held = ca.MX.sym("wrench_B", 6), ca.MX.sym("tau", robot.n)
    march = repeated(runge_kutta_step(_center_rate(robot), attitude=slice(3, 7)), substeps)
    y = march(_center_from_origin(robot)(x), *held, h / substeps)
    x_next = _origin_from_center(robot)(y)
    names = ["x", "wrench_B", "tau", "h"]
    return ca.Function(f"effort_step_{substeps}", [x, *held, h], [x_next], names, ["x_next"])


def _center_rate(robot: SpaceRobot) -> ca.Function:
    """Return ``(y, wrench_B, tau) -> dy/dt``, eq. (19)."""
    y = ca.SX.sym("y", 13 + 2 * robot.n)
    wrench, tau = ca.SX.sym("wrench_B", 6), ca.SX.sym("tau", robot.n)
    _, quaternion, v_cm, omega, q, qdot = _split(y, robot.n)
    dynamics = robot.function("forward_dynamics", compile=False)
    z0ddot = dynamics(q, v_cm, omega, qdot, wrench, tau)
    rate = ca.vertcat(
        matrix_from_quaternion(quaternion) @ v_cm,
        quaternion_rate(quaternion, omega),
        z0ddot[:6],
        qdot,
        z0ddot[6:],
    )
    return dense_function("center_rate", {"y": y, "w": wrench, "tau": tau}, {"rate": rate})


def _center_from_origin(robot: SpaceRobot) -> ca.Function:
    """Return ``x -> y``: from the origin of the base to the centre of mass."""
    x = ca.SX.sym("x", 13 + 2 * robot.n)
    r_WB, quaternion, v, omega, q, qdot = _split(x, robot.n)
    r_cm = r_WB + matrix_from_quaternion(quaternion) @ _center_of_mass(robot, q)
    v_cm = v - _base_jacobian(robot, q)[:, 3:] @ ca.vertcat(omega, qdot)
    y = ca.vertcat(r_cm, quaternion, v_cm, omega, q, qdot)
    return dense_function("center_from_origin", {"x": x}, {"y": y})


def _origin_from_center(robot: SpaceRobot) -> ca.Function:
    """Return ``y -> x``: from the centre of mass to the origin of the base."""
    y = ca.SX.sym("y", 13 + 2 * robot.n)
    r_cm, quaternion, v_cm, omega, q, qdot = _split(y, robot.n)
    r_WB = r_cm - matrix_from_quaternion(quaternion) @ _center_of_mass(robot, q)
    v = v_cm + _base_jacobian(robot, q)[:, 3:] @ ca.vertcat(omega, qdot)
    x = ca.vertcat(r_WB, quaternion, v, omega, q, qdot)
    return dense_function("origin_from_center", {"y": y}, {"x": x})


def _center_of_mass(robot: SpaceRobot, q: ca.SX) -> ca.SX:
    return robot.function("center_of_mass", compile=False)(q)


def _base_jacobian(robot: SpaceRobot, q: ca.SX) -> ca.SX:
    """Return the rows of eq. (10) that give the velocity of the base's origin."""
    return robot.function(f"jacobian:{robot.base_link}", compile=False)(q)[:3, :]


def _joint_correction(robot: SpaceRobot) -> ca.Function:
    """Return ``(x, q, qdot) -> x``: a predicted state with the measured shape in it."""
    n = robot.n
    x, measured = ca.SX.sym("x", 13 + 2 * n), ca.SX.sym("q", n)
    measured_rate = ca.SX.sym("qdot", n)
    r_WB, quaternion, v, omega, q, qdot = _split(x, n)
    r_cm = r_WB + matrix_from_quaternion(quaternion) @ _center_of_mass(robot, q)
    p_W, L_W, _ = robot.function("momentum", compile=False)(quaternion, q, v, omega, qdot)
    # At the middle of the difference the connection is right to second order.
    A = ca.reshape(robot.function("connection", compile=False)((q + measured) / 2), 6, n)
    turned = quaternion_multiply(quaternion, quaternion_from_rotvec(-A[3:, :] @ (measured - q)))
    v_next, omega_next = robot.function("base_twist", compile=False)(
        turned, measured, measured_rate, p_W, L_W
    )
    r_next = r_cm - matrix_from_quaternion(turned) @ _center_of_mass(robot, measured)
    corrected = ca.vertcat(r_next, turned, v_next, omega_next, measured, measured_rate)
    inputs = {"x": x, "q": measured, "qdot": measured_rate}
    return dense_function("joint_correction", inputs, {"x_next": corrected})
