"""What the plant refuses and limits: counted, logged, and published as diagnostics."""

from __future__ import annotations

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.node import Node

from spacerobot_ros.nodes.common.messages import diagnostic_name, diagnostic_status
from spacerobot_ros.nodes.common.node import STREAM
from spacerobot_ros.simulation.actuators import FaultyPlant, ThrusterPlant, thrusters_in
from spacerobot_ros.simulation.commands import CommandSource, CommandValidator, Refusal
from spacerobot_ros.simulation.time_modes import RealTime
from spacerobot_ros.times import set_stamp

PROPELLANT = "propellant_kg"
"""Key of the propellant used, in the diagnostics."""

_ROUNDING = 1e-9
"""Momenta that change by less than this times the mass only round, m/s and m^2/s."""

_LOG_PERIOD = 5.0
"""Wall s between two log lines of one kind."""

_MILLISECONDS = 1e3

_OK, _WARN, _ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR


class PlantReport:
    """Logs and diagnostics of one plant.

    A level is a warning when its counters have moved since the last diagnostics.

    Parameters
    ----------
    node
        Whose they are.
    plant, commands
        What is reported.
    real_time
        How well it keeps to the clock; None in lockstep.
    """

    def __init__(
        self,
        node: Node,
        plant: FaultyPlant,
        commands: CommandValidator,
        real_time: RealTime | None,
    ) -> None:
        self._node, self._plant, self._commands = node, plant, commands
        self._real_time, self._thrusters = real_time, thrusters_in(plant)
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", STREAM)
        self._command_timeouts = 0
        self._last_refusal = ""
        self._reported = self._counters()
        self._unmet_reported = 0
        if self._thrusters is not None and self._thrusters.missing:
            node.get_logger().warning(f"The thrusters cannot give {self._thrusters.missing}.")

    def refused(self, source: CommandSource, refusal: Refusal) -> None:
        """Log a refused command, which its validator has counted."""
        self._last_refusal = f"A command on '{source.topic}' was refused: {refusal.clause}."
        self._node.get_logger().warning(self._last_refusal, throttle_duration_sec=_LOG_PERIOD)
        if refusal.latches:
            self.latched()

    def latched(self) -> None:
        """Log that a fault is latched."""
        self._node.get_logger().error(
            f"A fault is latched: {self._commands.fault}. Nothing moves until '~/rearm' is called."
        )

    def timed_out(self, source: CommandSource, timeout: float) -> None:
        """Count a commander that fell silent."""
        self._command_timeouts += 1
        self._node.get_logger().warning(
            f"No command on '{source.topic}' for {timeout:g} s: its actuators are brought to rest.",
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
        """Publish the diagnostics."""
        before, self._reported = self._reported, self._counters()
        refused, limited = (now != then for now, then in zip(self._reported, before, strict=True))
        array = DiagnosticArray()
        set_stamp(array.header.stamp, time_ns)
        array.status = [
            self._command_status(refused=refused),
            self._actuator_status(limited=limited),
            self._margin_status(),
            self._momentum_status(),
            self._fault_status(),
        ]
        if self._thrusters is not None:
            array.status.append(self._thruster_status(self._thrusters))
        if self._real_time is not None:
            array.status.append(timing_status(self._name("timing"), self._real_time))
        for status in array.status:
            status.hardware_id = self._plant.robot.description.name
        self._publisher.publish(array)

    def _name(self, part: str) -> str:
        return diagnostic_name(self._node.get_fully_qualified_name(), part)

    @property
    def _ticks_lost(self) -> int:
        return self._real_time.ticks_lost if self._real_time is not None else 0

    def _counters(self) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Return the counts from which the levels of commands and actuators follow."""
        limits = self._plant.limit_counts.values()
        return (
            (self._commands.counts.total(), self._command_timeouts, self._ticks_lost),
            tuple(int(n) for counts in limits for n in counts),
        )

    def _command_status(self, *, refused: bool) -> DiagnosticStatus:
        commands = self._commands
        level, sentence = _WARN if refused else _OK, "commands arrive"
        if commands.fault:
            level = _ERROR
            sentence = f"Nothing moves until '~/rearm' is called: {commands.fault}."
        elif refused and self._last_refusal:
            sentence = self._last_refusal
        return diagnostic_status(
            self._name("commands"),
            level,
            sentence,
            {
                "refused": commands.counts.total(),
                **{f"refused.{reason.value}": n for reason, n in commands.counts.items()},
                "latched_fault": commands.fault,
                "timeouts": self._command_timeouts,
                "deadlines_missed": self._ticks_lost,
            },
        )

    def _actuator_status(self, *, limited: bool) -> DiagnosticStatus:
        return diagnostic_status(
            self._name("actuators"),
            _WARN if limited else _OK,
            "limits of the URDF hold joints back" if limited else "within limits",
            {
                f"{what}_limited.{joint}": count
                for what, counts in self._plant.limit_counts.items()
                for joint, count in zip(self._plant.robot.joint_names, counts, strict=True)
            },
        )

    def _margin_status(self) -> DiagnosticStatus:
        robot, q = self._plant.robot, self._plant.q
        margins = np.minimum(q - robot.lower, robot.upper - q)
        return diagnostic_status(
            self._name("strokes"),
            _OK,
            "how far each joint is from the nearer of its limits, m or rad",
            {
                joint: f"{margin:.6g}"
                for joint, margin in zip(robot.joint_names, margins, strict=True)
            },
        )

    def _momentum_status(self) -> DiagnosticStatus:
        plant = self._plant
        change = plant.momentum[:6] - plant.expected_momenta
        linear, angular = np.linalg.norm(change[:3]), np.linalg.norm(change[3:])
        # Rounding, for bodies that move at up to 1 m/s, is less.
        leaks = max(linear, angular) > _ROUNDING * plant.robot.total_mass
        return diagnostic_status(
            self._name("momentum"),
            _ERROR if leaks else _OK,
            "momentum changes that no thruster accounts for"
            if leaks
            else "momentum is accounted for",
            {
                "linear_change": f"{linear:.3e}",
                "angular_change": f"{angular:.3e}",
                "kinetic_energy_J": f"{plant.momentum[6]:.6e}",
            },
        )

    def _fault_status(self) -> DiagnosticStatus:
        active = [str(fault) for fault in self._plant.active]
        return diagnostic_status(
            self._name("faults"),
            _WARN if active else _OK,
            f"injected: {'; '.join(active)}" if active else "no fault is injected",
            {f"fault_{i}": fault for i, fault in enumerate(active, 1)},
        )

    def _thruster_status(self, thrusters: ThrusterPlant) -> DiagnosticStatus:
        """Return propellant, pulses and unmet wrenches; a warning where new ones are unmet."""
        unmet = thrusters.unmet_ticks > self._unmet_reported
        self._unmet_reported = thrusters.unmet_ticks
        sentences = [f"they cannot give {thrusters.missing}"] if thrusters.missing else []
        if unmet:
            sentences.append("the wanted wrench is beyond them")
        force, torque = np.linalg.norm(thrusters.unmet[:3]), np.linalg.norm(thrusters.unmet[3:])
        return diagnostic_status(
            self._name("thrusters"),
            _WARN if sentences else _OK,
            "; ".join(sentences) or "the wanted wrench is given",
            {
                PROPELLANT: f"{thrusters.propellant:.9g}",
                "pulses": int(thrusters.pulses.sum()),
                "unmet_ticks": thrusters.unmet_ticks,
                "unmet_force_N": f"{force:.6g}",
                "unmet_torque_Nm": f"{torque:.6g}",
                **{
                    f"pulses.{name}": count
                    for name, count in zip(thrusters.table.names, thrusters.pulses, strict=True)
                },
            },
        )


def timing_status(name: str, real_time: RealTime) -> DiagnosticStatus:
    """Return how well a plant keeps to the clock, and its commander to the plant."""
    timing = real_time.report()
    return diagnostic_status(
        name,
        _WARN if timing.worse else _OK,
        "deadlines were missed" if timing.worse else "in time",
        {
            "tick_rate_Hz": f"{timing.tick_rate:.6g}",
            "ticks": timing.ticks,
            "ticks_late": timing.ticks_late,
            "worst_tick_ms": f"{timing.worst_tick * _MILLISECONDS:.3f}",
            "commands": timing.commands,
            "commands_late": timing.commands_late,
            "worst_command_ms": f"{timing.worst_command * _MILLISECONDS:.3f}",
            "command_age_s": f"{timing.command_age:.6g}",
        },
    )
