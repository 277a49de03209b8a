"""The velocity-driven plant: servos hold joint velocities, and momentum determines the base motion.

The total linear and angular momenta are constants of the motion, initially zero by default; under
external loads, they are states that change with the impulses.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import casadi as ca
import numpy as np
from typing_extensions import override

from spacerobot_ros.errors import ParameterError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.integration import DEFAULT_INTEGRATION_STEP, LoadLayout
from spacerobot_ros.model.model_functions import Composition
from spacerobot_ros.simulation.loads import PlantLoads
from spacerobot_ros.simulation.plant import CompiledPlant, Flags, body_outputs

_ROUNDING = 1e-9
"""Largest excess over a limit that is attributed to rounding: a fraction of a rate, and a motion in
a tick (m or rad)."""


class VelocityPlant(CompiledPlant):
    """A free-floating robot whose servos hold the commanded joint velocities.

    After :meth:`step`, the attributes are those of :class:`Plant`: ``qdot`` holds the velocities of
    the last tick, and ``effort`` the servo efforts. The efforts follow from inverse dynamics. The
    velocity is the mean of the velocities before and during the tick; the acceleration is their
    difference divided by the tick length. Effort limits do not apply to servos.

    See :class:`.CompiledPlant` for the parameters and errors of the constructor; the initial joint
    velocities must be zero.
    """

    actuation: ClassVar[str] = "velocity"
    default_integration_step: ClassVar[float] = DEFAULT_INTEGRATION_STEP
    takes_wrench: ClassVar[bool] = False
    limits: ClassVar[tuple[str, str]] = "rate", "stroke"

    @override
    def _bind(self, inputs: Sequence[Array], outputs: Sequence[Array]) -> None:
        self._state, self._command, self._before = inputs[:3]
        self.expected_momenta, self._r_cm, self._h = inputs[3:]
        self._next_state, self.pose, self.twist, self.qdot = outputs[:4]
        self.effort, self.momentum, self.link_R, self.link_r = outputs[4:8]
        self._limited, self._next_r_cm = outputs[8:]
        self.q = self._next_state[: self.robot.n]
        self._next_momenta: Array | None = None
        self._held: Flags | None = None

    def reset(self) -> None:
        """Return to the initial state, at rest; the limit counters are kept."""
        start, robot = self.initial, self.robot
        if np.any(start.rates(robot)):
            raise ParameterError(
                "Joints under velocity commands start at rest: omit the initial joint velocities, "
                "or command them."
            )
        self._state[: robot.n] = start.shape(robot)
        self._state[robot.n :] = start.attitude()
        self.expected_momenta[:] = start.momenta()
        self._r_cm[:] = start.system_position(robot)
        self._command[:] = self._before[:] = 0.0
        self._update_outputs()

    def hold(self, joints: Flags) -> None:
        """Lock the marked joints (n,) at their positions, and release all others."""
        self._held = joints.copy() if joints.any() else None

    def load(self, loads: PlantLoads) -> None:
        """Apply external loads; their values may change before each step."""
        self._use_loads(loads)
        self._next_momenta = self._tick.outputs[-1]

    def step(self, command: Array) -> bool:
        """Advance one tick under the joint velocities ``command`` (n,), clipped to their limits.

        If a joint would pass its limit within the tick, its rate is reduced so that it ends at the
        limit. Returns whether any joint was limited.
        """
        self._state[:] = self._next_state
        self._before[:] = self.qdot
        self._command[:] = command
        if self._held is not None:
            self._command[self._held] = 0.0
        self._tick.evaluate()
        self._r_cm[:] = self._next_r_cm
        if self._next_momenta is not None:
            self.expected_momenta[:] = self._next_momenta
        if self._limited[0] == 0.0:
            return False
        by_rate, by_stroke = self._limited[1:].reshape(2, -1) != 0.0
        self.limit_counts["rate"] += by_rate
        self.limit_counts["stroke"] += by_stroke
        return True

    @staticmethod
    @override
    def tick_function(
        robot: SpaceRobot, model: Composition, substeps: int, *, loaded: bool = False
    ) -> ca.Function:
        """Compose the tick; with ``loaded``, the momenta after it are the last output."""
        n = robot.n
        state, command = ca.MX.sym("state", n + 4), ca.MX.sym("command", n)
        before = ca.MX.sym("before", n)
        momenta, r_cm, h = ca.MX.sym("momenta", 6), ca.MX.sym("r_cm", 3), ca.MX.sym("h")
        p_W, L_W = momenta[:3], momenta[3:]

        rate = ca.fmin(ca.fmax(command, -robot.velocity_limit), robot.velocity_limit)
        q = state[:n]
        # A tick of zero duration computes outputs only, and must not divide by zero.
        duration = ca.fmax(h, 1e-12)
        to_lower, to_upper = (
            (ca.DM(robot.lower) - q) / duration,
            (ca.DM(robot.upper) - q) / duration,
        )
        qdot = ca.fmin(ca.fmax(rate, to_lower), to_upper)
        by_rate = ca.fabs(command - rate) > _ROUNDING * ca.DM(robot.velocity_limit)
        by_stroke = ca.fabs(rate - qdot) * duration > _ROUNDING
        limited = ca.vertcat(ca.sum1(by_rate) + ca.sum1(by_stroke), by_rate, by_stroke)

        loads: list[ca.MX] = []
        if loaded:
            layout = LoadLayout(len(robot.link_names))
            loads = [ca.MX.sym("loads", layout.size)]
            effort = model(
                "loaded_servo_efforts", state[n:], q, before, qdot, L_W, duration, r_cm, *loads
            )
            x = ca.vertcat(state, momenta, r_cm, loads[0][layout.time])
            x_next = model(f"loaded_velocity_step:{substeps}", x, qdot, *loads, h)
            next_state, r_cm_next = x_next[: n + 4], x_next[n + 10 : n + 13]
            p_W, L_W = x_next[n + 4 : n + 7], x_next[n + 7 : n + 10]
        else:
            effort = model("servo_efforts", state[n:], q, before, qdot, L_W, duration)
            next_state = model(f"velocity_step:{substeps}", state, qdot, L_W, h)
            r_cm_next = r_cm + p_W * (h / model.total_mass)
        q_next, quaternion = next_state[:n], next_state[n:]
        pose, twist, bodies = body_outputs(model, q_next, quaternion, qdot, (p_W, L_W), r_cm_next)
        return model.function(
            f"loaded_velocity_tick_{substeps}" if loaded else f"velocity_tick_{substeps}",
            [state, command, before, momenta, r_cm, h, *loads],
            [
                next_state,
                pose,
                twist,
                qdot,
                effort,
                *bodies,
                ca.densify(limited),
                r_cm_next,
                *([ca.vertcat(p_W, L_W)] if loaded else []),
            ],
        )
