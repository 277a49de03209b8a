"""What the plant refuses and limits: counted, logged, and published as diagnostics."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.node import Node

from spacerobot_ros.model.description import Array
from spacerobot_ros.nodes.common.cdr import NANOSECONDS
from spacerobot_ros.nodes.common.diagnostics import diagnostic_status
from spacerobot_ros.nodes.common.node import STREAM
from spacerobot_ros.nodes.plant.command_gate import CommandGate
from spacerobot_ros.simulation.faults_plant import FaultyPlant

_ROUNDING = 1e-9
"""Momenta that change by less than this times the mass only round, m/s and m^2/s."""

_LOG_PERIOD = 5.0
"""Wall s between two log lines of one kind."""


class PlantReport:
    """Counters of one plant. Every refusal has a reason; the last one stays in the diagnostics."""

    def __init__(self, node: Node, plant: FaultyPlant, gate: CommandGate) -> None:
        self._node, self._plant, self._gate = node, plant, gate
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", STREAM)
        self.others: list[Callable[[], DiagnosticStatus]] = [self._faults]
        """Status of further parts of the plant, published with the rest."""
        self.command_timeouts = 0
        self.deadlines_missed = 0
        self.last_refusal = ""
        self._reported = self._levels()

    def refused(self, topic: str, reason: str) -> None:
        """Log a refused command, which the gate has counted."""
        self.last_refusal = f"A command on '{topic}' was refused: {reason}."
        self._node.get_logger().warning(self.last_refusal, throttle_duration_sec=_LOG_PERIOD)

    def timed_out(self, topic: str, timeout: float) -> None:
        """Count a commander that fell silent."""
        self.command_timeouts += 1
        self._node.get_logger().warning(
            f"No command on '{topic}' for {timeout:g} s: its actuators are brought to rest.",
            throttle_duration_sec=_LOG_PERIOD,
        )

    def limited(self) -> None:
        """Log that joints were held back in the last step."""
        plant = self._plant
        texts = []
        for what, counts in plant.limit_counts.items():
            names = [
                name for name, count in zip(plant.robot.joint_names, counts, strict=True) if count
            ]
            if names:
                texts.append(f"{what} of {', '.join(names)}")
        self._node.get_logger().warning(
            f"Limits of the URDF held joints back so far: {'; '.join(texts)}.",
            throttle_duration_sec=_LOG_PERIOD,
        )

    def publish(self, time_ns: int) -> None:
        """Publish the diagnostics; a level is a warning when its counters moved since the last."""
        levels = self._levels()
        moved = {key: levels[key] != self._reported[key] for key in levels}
        self._reported = levels
        plant, name = self._plant, self._node.get_fully_qualified_name()
        joints = plant.robot.joint_names
        array = DiagnosticArray()
        array.header.stamp.sec, array.header.stamp.nanosec = divmod(time_ns, NANOSECONDS)
        array.status = [
            diagnostic_status(
                f"{name}: commands",
                self._command_level(moved["commands"]),
                self._command_sentence(moved["commands"]),
                {
                    "refused": self._gate.refused,
                    **{f"refused.{reason.value}": n for reason, n in self._gate.counts.items()},
                    "latched_fault": self._gate.fault,
                    "timeouts": self.command_timeouts,
                    "deadlines_missed": self.deadlines_missed,
                },
            ),
            diagnostic_status(
                f"{name}: actuators",
                DiagnosticStatus.WARN if moved["limits"] else DiagnosticStatus.OK,
                "limits of the URDF hold joints back" if moved["limits"] else "within limits",
                {
                    f"{what}_limited.{joint}": count
                    for what, counts in plant.limit_counts.items()
                    for joint, count in zip(joints, counts, strict=True)
                },
            ),
            diagnostic_status(
                f"{name}: strokes",
                DiagnosticStatus.OK,
                "how far each joint is from the nearer end of its stroke, m or rad",
                {
                    joint: f"{left:.6g}"
                    for joint, left in zip(joints, self._stroke_left(), strict=True)
                },
            ),
            diagnostic_status(
                f"{name}: momentum",
                DiagnosticStatus.ERROR if self._leaks() else DiagnosticStatus.OK,
                "momentum changes that no thruster accounts for"
                if self._leaks()
                else "momentum is accounted for",
                {
                    "linear_change": f"{self._drift(0):.3e}",
                    "angular_change": f"{self._drift(3):.3e}",
                    "kinetic_energy_J": f"{plant.momentum[6]:.6e}",
                },
            ),
            *(status() for status in self.others),
        ]
        self._publisher.publish(array)

    def _faults(self) -> DiagnosticStatus:
        """Name every fault that is active."""
        active = [str(fault) for fault in self._plant.active]
        return diagnostic_status(
            f"{self._node.get_fully_qualified_name()}: faults",
            DiagnosticStatus.WARN if active else DiagnosticStatus.OK,
            f"injected: {'; '.join(active)}" if active else "no fault is injected",
            {f"fault_{i}": fault for i, fault in enumerate(active, 1)},
        )

    def _levels(self) -> dict[str, tuple[int, ...]]:
        plant = self._plant
        return {
            "commands": (self._gate.refused, self.command_timeouts, self.deadlines_missed),
            "limits": tuple(int(n) for counts in plant.limit_counts.values() for n in counts),
        }

    def _command_level(self, moved: bool) -> bytes:
        if self._gate.fault:
            return bytes(DiagnosticStatus.ERROR)
        return bytes(DiagnosticStatus.WARN if moved else DiagnosticStatus.OK)

    def _command_sentence(self, moved: bool) -> str:
        if self._gate.fault:
            return f"Nothing moves until '~/rearm' is called: {self._gate.fault}."
        return self.last_refusal if moved and self.last_refusal else "commands arrive"

    def _stroke_left(self) -> Array:
        """Return how far each joint (n,) is from the nearer end of its stroke, m or rad."""
        robot, q = self._plant.robot, self._plant.q
        left: Array = np.minimum(q - robot.lower, robot.upper - q)
        return left

    def _leaks(self) -> bool:
        """Whether momentum changes by more than rounding, for bodies that move at up to 1 m/s."""
        return max(self._drift(0), self._drift(3)) > _ROUNDING * self._plant.robot.total_mass

    def _drift(self, first: int) -> float:
        """Change of the momentum that no thruster accounts for."""
        part = slice(first, first + 3)
        return float(
            np.linalg.norm(self._plant.momentum[part] - self._plant.expected_momenta[part])
        )
