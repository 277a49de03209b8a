"""What coordinated control says of itself: one latched status."""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus

from spacerobot_ros.control import Saturated
from spacerobot_ros.control.controller import CoordinatedController, Mode
from spacerobot_ros.nodes.common.diagnostics import diagnostic_status
from spacerobot_ros.nodes.common.node import LATCHED, FlightNode


class ControllerState(str, Enum):
    """The value of ``state`` in controller/status."""

    HOLDING = "holding"
    TRACKING = "tracking"
    REACHED = "reached"
    FAILED = "failed"
    REFUSED = "refused"
    ABORTED = "aborted"
    ESTIMATING = "estimating"
    STOPPED = "stopped"


_LEVELS = {
    ControllerState.FAILED: DiagnosticStatus.ERROR,
    ControllerState.STOPPED: DiagnosticStatus.ERROR,
    ControllerState.REFUSED: DiagnosticStatus.ERROR,
    ControllerState.ABORTED: DiagnosticStatus.WARN,
    ControllerState.ESTIMATING: DiagnosticStatus.WARN,
}


_BLIND = (ControllerState.ESTIMATING, ControllerState.STOPPED)
"""States in which the base is not measured."""


class ControllerStatus:
    """Publishes controller/status when something changes, and every ``status_period``."""

    def __init__(self, node: FlightNode) -> None:
        self._node = node
        self._publisher = node.create_publisher(DiagnosticStatus, "controller/status", LATCHED)
        self.begin()

    def begin(self) -> None:
        """Forget earlier goals."""
        self._state = self._seen = ControllerState.HOLDING
        self._started = self._within_since = self._next = -1.0
        self._limited = False
        self._values: dict[str, str] = {}

    def refused(self, sentence: str) -> None:
        """Say that a goal is refused; the earlier one goes on."""
        self._publish(ControllerState.REFUSED, sentence)

    def started(self, now: float) -> None:
        """Begin to judge a new goal."""
        self._started, self._within_since, self._next = now, -1.0, now
        self._state = ControllerState.TRACKING

    def state(self, state: ControllerState, sentence: str) -> None:
        """Take a state that was decided elsewhere; the goal is not judged any more."""
        self._state, self._started = state, -1.0
        self._publish(state, sentence)

    def update(self, now: float, controller: CoordinatedController, result: Saturated) -> bool:
        """Judge the errors after a command, and publish what is due.

        Returns whether a goal was decided: met, or not in time.
        """
        before, decided = self._state, False
        if before not in _BLIND:
            self._seen = before
        if controller.mode is Mode.MEASURED:
            # After a gap in the measurements everything is as it was before.
            self._state = self._seen
            decided = self._judge(now, controller)
        else:
            estimated = controller.mode is Mode.ESTIMATED
            self._state = ControllerState.ESTIMATING if estimated else ControllerState.STOPPED
        if self._state is before and result.limited == self._limited and now < self._next:
            return decided
        values: Mapping[str, Any] = self._node.parameters
        self._next = now + values["status_period"]
        self._limited = result.limited
        self._values = self._describe(controller, result)
        self._publish(self._state, self._sentence(controller))
        return decided

    def _judge(self, now: float, controller: CoordinatedController) -> bool:
        """Judge a goal that is flown to; return whether it is decided now."""
        if self._state is not ControllerState.TRACKING or self._started < 0:
            return False
        values: Mapping[str, Any] = self._node.parameters
        errors = controller.errors()
        within = controller.arrived(now) and (
            errors.position <= values["position_tolerance"]
            and errors.attitude <= values["attitude_tolerance"]
            and errors.joints <= values["joint_tolerance"]
        )
        if not within:
            self._within_since = -1.0
        elif self._within_since < 0:
            self._within_since = now
        limit = values["time_limit"]
        if within and now - self._within_since >= values["settle_time"] - 1e-9:
            self._state, self._next = ControllerState.REACHED, now
        elif limit and now - self._started >= limit - 1e-9:
            self._state, self._next = ControllerState.FAILED, now
        return self._state is not ControllerState.TRACKING

    def _sentence(self, controller: CoordinatedController) -> str:
        errors = controller.errors()
        left = f"{errors.position:.3g} m, {errors.attitude:.3g} rad"
        return {
            ControllerState.HOLDING: f"Holding; off by {left}.",
            ControllerState.TRACKING: f"Flying to the goal; {left} from the reference.",
            ControllerState.REACHED: f"The goal is met: {left} from it.",
            ControllerState.FAILED: f"The goal is not met in time: {left} from it.",
            ControllerState.ESTIMATING: (
                f"The base is not measured; it is estimated since {controller.estimated_for:.3g} s."
            ),
            ControllerState.STOPPED: (
                "The base is not measured any more: thrusters off, joints brought to rest."
            ),
        }.get(self._state, "")

    def _describe(self, controller: CoordinatedController, result: Saturated) -> dict[str, str]:
        status = controller.law.status
        force, torque = result.loss.wrench_B[:3], result.loss.wrench_B[3:]
        values = {
            "law": controller.law.name,
            "singular": str(status.singular).lower(),
            "smallest_singular_value": f"{status.smallest_singular_value:.6g}",
            "damping": f"{status.damping:.6g}",
            "lost_force_N": f"{np.linalg.norm(force):.6g}",
            "lost_torque_Nm": f"{np.linalg.norm(torque):.6g}",
            "lost_effort": f"{np.abs(result.loss.tau).max(initial=0.0):.6g}",
        }
        for label, error in controller.labelled_errors().items():
            values[f"error.{label}"] = f"{error:.6g}"
        return values

    def _publish(self, state: ControllerState, sentence: str) -> None:
        level = _LEVELS.get(state, DiagnosticStatus.OK)
        values = {"state": state.value, **self._values}
        name = self._node.get_fully_qualified_name()
        self._publisher.publish(diagnostic_status(name, level, sentence, values))
        if level != DiagnosticStatus.OK:
            self._node.get_logger().warning(sentence, throttle_duration_sec=5.0)
