"""Status of a plant: its state, the reason, and the injected faults and disturbances."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import Enum

from spacerobot_ros.events import (
    INTEGER,
    SECONDS,
    Event,
    EventKind,
    KeyValueField,
    KeyValueFormat,
    choice_format,
    list_format,
    number_format,
)
from spacerobot_ros.simulation.actuators import PlantWithFaults
from spacerobot_ros.simulation.commands import CommandValidator
from spacerobot_ros.simulation.config import PlantConfig
from spacerobot_ros.simulation.faults import with_seconds
from spacerobot_ros.times import SECOND


def latched_text(fault: str) -> str:
    """Return the effect of a latched fault as a sentence without a final full stop."""
    return f"The joints brake and the thrusters are off until the plant is rearmed: {fault}"


class PlantState(str, Enum):
    """Operating state of a plant: the value of ``state`` in plant/status."""

    INACTIVE = "inactive"
    """The plant publishes no states and accepts no commands."""
    RUNNING = "running"
    """A command is active, or a lockstep plant waits for a command."""
    RESTING = "resting"
    """Time advances without an active command: none has arrived yet, or the last one expired."""
    PAUSED = "paused"
    """Time is stopped; commands are accepted."""
    LATCHED = "latched"
    """Time advances, but joints and thrusters stay at rest until the plant is rearmed."""
    FAILED = "failed"
    """An error stopped the plant: it is inactive until configured or activated again."""


@dataclass(frozen=True)
class PlantStatus:
    """A plant status, as published on plant/status.

    Attributes
    ----------
    state
        State of the plant.
    message
        State and reason, as a message for the user.
    reason
        Reason as a word. Latched, or paused and latched: the refusal reason, ``abort``
        or ``watchdog``; resting: ``no_command`` or ``timeout``; failed: ``model`` or ``exception``;
        inactive: ``ended`` once the robot no longer exists; empty otherwise.
    latched_fault
        The fault latched until ``~/rearm``, in any plant state; empty if there is none.
    time_s
        Simulated time of the last change, s.
    rearms, resets
        Number of rearms and resets, by which subscribers can detect a missed status.
    faults
        Lines of the active injected faults.
    disturbances
        Lines of the active disturbances.
    payload
        The body that the robot holds, as a :class:`.Payload` string; empty if there is no such
        body. A held body changes the robot's mass, inertia and momentum.
    contacts
        Links in contact, including obstacles and the target; end-effector contacts with the target
        are omitted.
    timeouts
        Number of times the joints were brought to rest because no command arrived in time.
    last_command_s
        Stamp of the last command before the most recent timeout, s; None if there was no such
        command.
    actuation
        Quantity in joint_commands: ``velocity`` or ``effort``; ``auto``: not yet determined by a
        command; empty if the plant is not configured.
    tick_rate_hz
        Ticks per second of simulated time, Hz; 0 if the plant is not configured.
    time_mode
        What drives time: ``realtime`` or ``lockstep``; empty if the plant is not configured.
    """

    state: PlantState
    message: str = ""
    reason: str = ""
    latched_fault: str = ""
    time_s: float = 0.0
    rearms: int = 0
    resets: int = 0
    faults: tuple[str, ...] = ()
    disturbances: tuple[str, ...] = ()
    timeouts: int = 0
    last_command_s: float | None = None
    payload: str = ""
    contacts: tuple[str, ...] = ()
    actuation: str = ""
    tick_rate_hz: float = 0.0
    time_mode: str = ""

    @property
    def level(self) -> int:
        """Level of diagnostic_msgs/DiagnosticStatus: 0 OK, 1 WARN, 2 ERROR."""
        if self.latched_fault or self.state in (PlantState.LATCHED, PlantState.FAILED):
            return 2
        return 1 if self.reason == "timeout" or self.faults or self.disturbances else 0

    def to_values(self) -> dict[str, str]:
        """Return the status as key-value pairs of a DiagnosticStatus."""
        return _FORMAT.to_values(self)

    @classmethod
    def from_values(cls, values: Mapping[str, str], message: str = "") -> PlantStatus:
        """Return the status from the key-value pairs of :meth:`to_values`.

        Raises
        ------
        SpaceRobotError
            The pairs do not form a plant status.
        """
        return _FORMAT.from_values(cls, values, message=message)


_FORMAT = KeyValueFormat(
    "status of a plant",
    KeyValueField("state", choice_format(PlantState)),
    KeyValueField("reason", always=True),
    KeyValueField("latched_fault", always=True),
    KeyValueField("time_s", SECONDS, always=True),
    KeyValueField("rearms", INTEGER, always=True),
    KeyValueField("resets", INTEGER, always=True),
    KeyValueField("timeouts", INTEGER, always=True),
    KeyValueField("last_command_s", SECONDS),
    KeyValueField("faults", list_format("; "), always=True),
    KeyValueField("disturbances", list_format("; ")),
    KeyValueField("payload"),
    KeyValueField("contacts", list_format("; ")),
    KeyValueField("actuation"),
    KeyValueField("tick_rate_hz", number_format(".15g")),
    KeyValueField("time_mode"),
)


class PlantMonitor:
    """Derives the status of a plant, and the events between successive statuses.

    Parameters
    ----------
    commands, plant
        The plant and its command validator.
    config
        Configuration of the plant. In lockstep, the plant waits for commands and is therefore never
        ``resting``.
    """

    def __init__(
        self, commands: CommandValidator, plant: PlantWithFaults, config: PlantConfig
    ) -> None:
        self.observe(commands, plant, config)
        self.rearms = self.resets = 0
        """Numbers of rearms and resets, set by the caller."""
        # Commanders learn the configuration before they see a robot or a state.
        self.status = self._configured(PlantState.INACTIVE, "The plant is inactive.")
        """Status of the last update."""
        self.contacts: tuple[str, ...] = ()
        """Links in contact, set by the caller."""
        self.failure = "", ""
        """Reason and message of the error that stopped the plant, set by the caller."""

    def observe(
        self, commands: CommandValidator, plant: PlantWithFaults, config: PlantConfig
    ) -> None:
        """Replace the validator, plant and configuration."""
        self._commands, self._plant, self._config = commands, plant, config

    def update(self, activity: PlantState, time_s: float) -> list[Event]:
        """Update the status.

        Parameters
        ----------
        activity
            Plant activity: inactive, running, paused or failed.
        time_s
            Simulated time, s.

        Returns
        -------
        list[Event]
            Events since the last update; empty if the status is unchanged.
        """
        before, commands, capturing = self.status, self._commands, self._plant.capturing
        captures, payload = [], ""
        if capturing is not None:
            captures = [replace(event, time_s=time_s) for event in capturing.events]
            capturing.events.clear()
            payload = "" if capturing.payload is None else capturing.payload.to_text()
        now = replace(
            self._status(activity),
            time_s=before.time_s,
            rearms=self.rearms,
            resets=self.resets,
            timeouts=commands.timeouts,
            last_command_s=commands.last_stamp_ns / SECOND if commands.timeouts else None,
            faults=tuple(str(fault) for fault in self._plant.active),
            disturbances=tuple(str(each) for each in self._plant.disturbances),
            payload=payload,
            contacts=self.contacts,
        )
        if now == before:
            return captures
        self.status = replace(now, time_s=time_s)
        return [*captures, *_events_between(before, self.status)]

    def _configured(
        self, state: PlantState, message: str, reason: str = "", fault: str = ""
    ) -> PlantStatus:
        config = self._config
        return PlantStatus(
            state,
            message,
            reason,
            fault,
            actuation=config.actuation,
            tick_rate_hz=config.tick_rate,
            time_mode=config.time_mode,
        )

    def _status(self, activity: PlantState) -> PlantStatus:
        commands, fault = self._commands, self._commands.fault
        reason, latched = commands.fault_reason, f", and a fault is latched: {fault}"
        match activity:
            case PlantState.INACTIVE:
                message = f"The plant is inactive{latched * bool(fault)}"
            case PlantState.FAILED:
                return self._configured(activity, self.failure[1], self.failure[0], fault)
            case PlantState.PAUSED:
                message = f"Time is stopped until it is resumed{latched * bool(fault)}"
            case _ if fault:
                activity = PlantState.LATCHED
                message = latched_text(fault)
            case _ if self._config.time_mode == "lockstep":
                message = "Each tick uses the command for its state"
            case _ if commands.in_force:
                message = "A command is active"
            case _ if commands.timed_out:
                activity, reason = PlantState.RESTING, "timeout"
                message = "The joints are brought to rest: the last command is too old"
            case _:
                activity, reason = PlantState.RESTING, "no_command"
                message = "The joints rest until a command arrives"
                if not any(source.commanders for source in commands.sources):
                    message += f"; no node publishes '{commands.sources[0].topic}'"
        return self._configured(activity, f"{message}.", reason, fault)


def _events_between(before: PlantStatus, now: PlantStatus) -> list[Event]:
    events: list[Event] = []

    def add(kind: EventKind, message: str, level: int = 0, **about: str) -> None:
        events.append(Event(kind, message, level, now.time_s, about=about))

    if now.resets != before.resets:
        add(EventKind.RESET, "The robot is back in its initial state.")
    if now.rearms != before.rearms:
        add(EventKind.REARMED, "Commands are accepted again.")
    if now.latched_fault and now.latched_fault != before.latched_fault:
        message = f"A fault is latched: {now.latched_fault}."
        add(EventKind.LATCHED, message, 2, reason=now.reason)
    for fault in _new(now.faults, before.faults):
        add(EventKind.FAULT_INJECTED, f"A fault begins: {with_seconds(fault)}.", 1, fault=fault)
    ended = _new(before.faults, now.faults)
    for fault in ended:
        add(EventKind.FAULT_ENDED, f"A fault has ended: {with_seconds(fault)}.", fault=fault)
    if ended and not now.faults:
        add(EventKind.FAULTS_CLEARED, "No fault is active any more.")
    for each in _new(now.disturbances, before.disturbances):
        message = f"A disturbance begins: {with_seconds(each)}."
        add(EventKind.DISTURBANCE, message, 1, disturbance=each)
    for each in _new(before.disturbances, now.disturbances):
        message = f"A disturbance has ended: {with_seconds(each)}."
        add(EventKind.DISTURBANCE_ENDED, message, disturbance=each)
    changed = now.state is not before.state
    if changed and before.state is PlantState.PAUSED and now.state is not PlantState.INACTIVE:
        add(EventKind.RESUMED, "Time goes on.")
    # Other changes of the state have their own events.
    if changed and now.state is PlantState.RUNNING:
        add(EventKind.RUNNING, now.message)
    elif changed and now.state is PlantState.PAUSED:
        add(EventKind.PAUSED, now.message)
    elif now.state is PlantState.RESTING and (changed or now.reason != before.reason):
        level = 1 if now.reason == "timeout" else 0
        add(EventKind.RESTING, now.message, level, reason=now.reason)
    return events


def _new(lines: tuple[str, ...], others: tuple[str, ...]) -> list[str]:
    return [line for line in lines if line not in others]
