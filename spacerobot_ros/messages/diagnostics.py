"""Statuses, events and diagnostics: diagnostic_msgs/DiagnosticStatus and DiagnosticArray, and their
plain values.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from spacerobot_ros.errors import printable
from spacerobot_ros.messages.definitions import encode
from spacerobot_ros.times import LATEST_NS

if TYPE_CHECKING:
    from spacerobot_ros.simulation.actuators import PlantWithFaults, ThrusterPlant
    from spacerobot_ros.simulation.commands import CommandSource, CommandValidator, Refusal
    from spacerobot_ros.simulation.time_modes import RealTime

STATUS = "diagnostic_msgs/msg/DiagnosticStatus"


@dataclass(frozen=True)
class StatusRecord:
    """Content of a DiagnosticStatus.

    Attributes
    ----------
    name
        Name of the node, or of one of its components.
    level
        0 OK, 1 WARN, 2 ERROR, 3 STALE.
    message
        One sentence for the user.
    values
        Values as strings by key.
    hardware_id
        Name of the robot or bag, or role of the node.
    """

    name: str
    level: int
    message: str
    values: Mapping[str, str] = field(default_factory=dict)
    hardware_id: str = ""

    @classmethod
    def of(cls, node: str, status: Any, level: int | None = None) -> StatusRecord:
        """Return the content for the status of a node; the level is that of the status by
        default."""
        given = status.level if level is None else level
        return cls(node, given, status.message, status.to_values())

    @property
    def fields(self) -> dict[str, Any]:
        """Message fields by name."""
        return {
            "level": self.level,
            "name": self.name,
            "message": self.message,
            "hardware_id": self.hardware_id,
            "values": [{"key": key, "value": value} for key, value in self.values.items()],
        }

    def encoded(self) -> bytes:
        """Return the serialised message."""
        return encode(STATUS, self.fields)


def key_values(pairs: Iterable[Any]) -> dict[str, str]:
    """Return diagnostic_msgs/KeyValue messages as a dictionary whose strings are printable."""
    return {printable(pair.key): printable(pair.value) for pair in pairs}


def read_status(message: Any) -> StatusRecord:
    """Return the printable content of a received or recorded DiagnosticStatus.

    If several pairs have the same key, the last one takes precedence.
    """
    level = message.level if isinstance(message.level, int) else message.level[0]
    return StatusRecord(
        name=printable(message.name),
        level=level,
        message=printable(message.message),
        values=key_values(message.values),
        hardware_id=printable(message.hardware_id),
    )


# -- diagnostics ----------------------------------------------------------------------------------

_MOMENTUM_ROUNDING = 1e-9
"""Largest changes of linear and angular momentum due to rounding, divided by the mass, m/s and
m^2/s."""

_MILLISECONDS = 1e3

_OK, _WARN, _ERROR = 0, 1, 2

_Content: TypeAlias = tuple[int, str, Mapping[str, object]]
"""Level, message and values of a record."""


def diagnostic_name(node: str, part: str) -> str:
    """Return the name by which a node component appears in /diagnostics, as formed by
    diagnostic_updater.

    Aggregators match name prefixes and build a tree from them, so there is no leading slash.
    """
    return f"{node.removeprefix('/')}: {part}"


def encode_diagnostics(records: Sequence[StatusRecord], time_ns: int) -> bytes:
    """Return the records at one time as a serialised DiagnosticArray."""
    status = [record.fields for record in records]
    return encode(
        "diagnostic_msgs/msg/DiagnosticArray",
        {"header": {"stamp": min(time_ns, LATEST_NS)}, "status": status},
    )


def state_diagnostics(
    node: str,
    robot: str,
    ignored: Mapping[str, object],
    last: StatusRecord | None,
    *,
    warning: str = "",
    missing: str = "",
) -> list[StatusRecord]:
    """Return a commander's diagnostics: its responses to states, and its goal state.

    Parameters
    ----------
    node, robot
        Full name of the node, and name of the robot.
    ignored
        Numbers of ignored states, or of ignored parts of states, by diagnostics key.
    last
        The last published status; None if none yet.
    warning
        A warning to publish instead of the status; empty if there is no warning.
    missing
        Clause describing what the commander waits for; empty if nothing.
    """
    level = _WARN if warning or missing else _OK
    message = warning or (f"waiting for {missing}" if missing else "responding to states")
    records = [_record(node, "states", (level, message, ignored), robot)]
    if last is not None and not warning:
        records.append(_record(node, "goal", (last.level, last.message, last.values), robot))
    return records


def _record(node: str, part: str, content: _Content, robot: str) -> StatusRecord:
    level, message, values = content
    texts = {key: str(value) for key, value in values.items()}
    return StatusRecord(diagnostic_name(node, part), level, message, texts, robot)


class PlantDiagnostics:
    """The diagnostics of one plant.

    A record has level WARN if its counters have changed since the last diagnostics message.

    Parameters
    ----------
    node
        Full name of the plant node.
    plant, commands
        Sources of the diagnostics.
    real_time
        Clock of a real-time plant; None in lockstep.
    """

    def __init__(
        self,
        node: str,
        plant: PlantWithFaults,
        commands: CommandValidator,
        real_time: RealTime | None = None,
    ) -> None:
        self._node, self._real_time = node, real_time
        self.observe(commands, plant)
        self.command_timeouts = 0
        """Number of command timeouts, set by the caller."""
        self._last_refusal = ""
        self._reported = self._counters()
        self._unmet_reported = 0

    def observe(self, commands: CommandValidator, plant: PlantWithFaults) -> None:
        """Set the objects to report on."""
        self._commands, self._plant = commands, plant

    def note_refusal(self, source: CommandSource, refusal: Refusal) -> str:
        """Record and describe a rejected command, which the validator has already counted."""
        self._last_refusal = f"A command on '{source.topic}' was refused: {refusal.clause}."
        return self._last_refusal

    def records(self) -> list[StatusRecord]:
        """Return the current diagnostics."""
        before, self._reported = self._reported, self._counters()
        refused, limited = (now != then for now, then in zip(self._reported, before, strict=True))
        plant, real_time = self._plant, self._real_time
        parts = {
            "commands": self._of_commands(refused=refused),
            "actuators": self._of_actuators(limited=limited),
            "strokes": self._of_strokes(),
            "momentum": self._of_momentum(),
            "faults": self._of_faults(),
        }
        if plant.thrusters is not None:
            parts["thrusters"] = self._of_thrusters(plant.thrusters)
        robot = plant.robot.description.name
        found = [_record(self._node, part, content, robot) for part, content in parts.items()]
        if real_time is not None:
            found.append(timing_record(self._node, robot, real_time))
        return found

    def _counters(self) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Return the counters that determine the levels of command and actuator diagnostics."""
        limits = self._plant.limit_counts.values()
        return (
            (self._commands.counts.total(), self.command_timeouts, self._ticks_lost),
            tuple(int(n) for counts in limits for n in counts),
        )

    @property
    def _ticks_lost(self) -> int:
        return self._real_time.ticks_lost if self._real_time is not None else 0

    def _of_commands(self, *, refused: bool) -> _Content:
        commands = self._commands
        level, message = _WARN if refused else _OK, "commands arrive"
        if not commands.in_force:
            message = "no command is active"
        if commands.fault:
            level = _ERROR
            from spacerobot_ros.simulation.status import latched_text  # Statuses need no plant.

            message = f"{latched_text(commands.fault)}."
        elif refused and self._last_refusal:
            message = self._last_refusal
        values = {
            "refused": commands.counts.total(),
            **{f"refused.{reason.value}": n for reason, n in commands.counts.items()},
            "latched_fault": commands.fault,
            "timeouts": self.command_timeouts,
            "deadlines_missed": self._ticks_lost,
        }
        return level, message, values

    def _of_actuators(self, *, limited: bool) -> _Content:
        counts = {
            f"{what}_limited.{joint}": count
            for what, counts in self._plant.limit_counts.items()
            for joint, count in zip(self._plant.robot.joint_names, counts, strict=True)
        }
        if limited:
            return _WARN, "joints are limited by the URDF", counts
        return _OK, "within limits", counts

    def _of_strokes(self) -> _Content:
        robot, q = self._plant.robot, self._plant.q
        margins = np.minimum(q - robot.lower, robot.upper - q)
        values = {
            joint: f"{margin:.6g}" for joint, margin in zip(robot.joint_names, margins, strict=True)
        }
        return _OK, "distance of each joint from its nearer limit, m or rad", values

    def _of_momentum(self) -> _Content:
        plant = self._plant
        change = plant.momentum[:6] - plant.expected_momenta
        linear, angular = np.linalg.norm(change[:3]), np.linalg.norm(change[3:])
        values = {
            "linear_change": f"{linear:.3e}",
            "angular_change": f"{angular:.3e}",
            "kinetic_energy_J": f"{plant.momentum[6]:.6e}",
        }
        # The threshold exceeds rounding errors of bodies that move at up to 1 m/s.
        leaks = max(linear, angular) > _MOMENTUM_ROUNDING * plant.robot.total_mass
        if leaks:
            return _ERROR, "momentum changes that no thruster accounts for", values
        return _OK, "momentum is accounted for", values

    def _of_faults(self) -> _Content:
        plant, active = self._plant, "; ".join(map(str, self._plant.injected))
        given = {"fault": plant.active, "disturbance": plant.disturbances}
        values = {
            f"{kind}_{i}": str(each)
            for kind, those in given.items()
            for i, each in enumerate(those, 1)
        }
        if active:
            return _WARN, f"injected: {active}", values
        return _OK, "no fault is injected", values

    def _of_thrusters(self, thrusters: ThrusterPlant) -> _Content:
        """Return propellant, pulses and unmet wrenches; a warning if there are new unmet
        wrenches."""
        modulator = thrusters.modulator
        unmet = modulator.unmet_periods > self._unmet_reported
        self._unmet_reported = modulator.unmet_periods
        sentences = [f"they cannot produce {modulator.missing}"] if modulator.missing else []
        if unmet:
            sentences.append("the requested wrench exceeds the available thrust")
        force, torque = np.linalg.norm(modulator.unmet[:3]), np.linalg.norm(modulator.unmet[3:])
        values = {
            "propellant_kg": f"{thrusters.propellant:.9g}",
            "pulses": int(modulator.pulses.sum()),
            "unmet_ticks": modulator.unmet_periods,
            "unmet_force_N": f"{force:.6g}",
            "unmet_torque_Nm": f"{torque:.6g}",
            **{
                f"pulses.{name}": count
                for name, count in zip(thrusters.table.names, modulator.pulses, strict=True)
            },
        }
        message = "; ".join(sentences) or "the requested wrench is produced"
        return _WARN if sentences else _OK, message, values


def timing_record(node: str, robot: str, real_time: RealTime) -> StatusRecord:
    """Return the delays of plant ticks and of the commander's commands."""
    tick_rate, worse = real_time.report()
    values = {
        "tick_rate_Hz": f"{tick_rate:.6g}",
        "ticks": real_time.ticks,
        "ticks_late": real_time.ticks_late,
        "worst_tick_ms": f"{real_time.worst_tick * _MILLISECONDS:.3f}",
        "commands": real_time.commands,
        "commands_late": real_time.commands_late,
        "worst_command_ms": f"{real_time.worst_command * _MILLISECONDS:.3f}",
        "command_age_s": f"{real_time.command_age:.6g}",
    }
    level, message = (_WARN, "deadlines were missed") if worse else (_OK, "in time")
    return _record(node, "timing", (level, message, values), robot)
