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
from spacerobot_ros.simulation.capture import CaptureReport, ReleaseReport
from spacerobot_ros.simulation.commands import CommandValidator
from spacerobot_ros.simulation.config import PlantConfig
from spacerobot_ros.simulation.faults import with_seconds
from spacerobot_ros.times import SECOND


def latched_text(fault: str) -> str:
    """Return the effect of a latched fault as a sentence without a final full stop."""
    return f"The joints brake and the thrusters are off until the plant is rearmed: {fault}"


class PlantState(str, Enum):
    """State of the plant with regard to time and commands; the value of ``state`` in
    plant/status."""

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
        empty otherwise.
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
        # Commanders learn these before they see a robot or a state.
        self.status = replace(
            PlantStatus(PlantState.INACTIVE, "The plant is inactive."),
            actuation=config.actuation,
            tick_rate_hz=config.tick_rate,
            time_mode=config.time_mode,
        )
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
        before, reports = self.status, self._take_reports()
        now = replace(
            self._status(activity),
            time_s=before.time_s,
            rearms=self.rearms,
            resets=self.resets,
            timeouts=self._commands.timeouts,
            last_command_s=(
                self._commands.last_stamp_ns / SECOND if self._commands.timeouts else None
            ),
            faults=tuple(str(fault) for fault in self._plant.active),
            disturbances=tuple(str(each) for each in self._plant.disturbances),
            payload=self._payload(),
            contacts=self.contacts,
            actuation=self._config.actuation,
            tick_rate_hz=self._config.tick_rate,
            time_mode=self._config.time_mode,
        )
        captures = [report.event(time_s) for report in reports]
        if now == before:
            return captures
        self.status = replace(now, time_s=time_s)
        return [*captures, *_events_between(before, self.status)]

    def _take_reports(self) -> list[CaptureReport | ReleaseReport]:
        capturing = self._plant.capturing
        if capturing is None:
            return []
        reports, capturing.reports = capturing.reports, []
        return reports

    def _payload(self) -> str:
        capturing = self._plant.capturing
        payload = None if capturing is None else capturing.payload
        return "" if payload is None else payload.to_text()

    def _status(self, activity: PlantState) -> PlantStatus:
        commands, fault = self._commands, self._commands.fault
        match activity:
            case PlantState.INACTIVE:
                message = "The plant is inactive"
                if fault:
                    message += f", and a fault is latched: {fault}"
            case PlantState.FAILED:
                reason, message = self.failure
                return PlantStatus(activity, message, reason, fault)
            case PlantState.PAUSED:
                message = "Time is stopped until it is resumed"
                if fault:
                    message += f", and a fault is latched: {fault}"
            case _ if fault:
                activity = PlantState.LATCHED
                message = latched_text(fault)
            case _ if self._config.time_mode == "lockstep":
                message = "Each tick uses the command for its state"
            case _ if commands.in_force:
                message = "A command is active"
            case _:
                activity = PlantState.RESTING
                if commands.timed_out:
                    message = "The joints are brought to rest: the last command is too old"
                    return PlantStatus(activity, f"{message}.", "timeout")
                message = "The joints rest until a command arrives"
                if not any(source.commanders for source in commands.sources):
                    message += f"; no node publishes '{commands.sources[0].topic}'"
                return PlantStatus(activity, f"{message}.", "no_command")
        return PlantStatus(activity, f"{message}.", commands.fault_reason, fault)


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
    for fault in now.faults:
        if fault not in before.faults:
            add(EventKind.FAULT_INJECTED, f"A fault begins: {with_seconds(fault)}.", 1, fault=fault)
    ended = [fault for fault in before.faults if fault not in now.faults]
    for fault in ended:
        add(EventKind.FAULT_ENDED, f"A fault has ended: {with_seconds(fault)}.", fault=fault)
    if ended and not now.faults:
        add(EventKind.FAULTS_CLEARED, "No fault is active any more.")
    for each in now.disturbances:
        if each not in before.disturbances:
            message = f"A disturbance begins: {with_seconds(each)}."
            add(EventKind.DISTURBANCE, message, 1, disturbance=each)
    for each in before.disturbances:
        if each not in now.disturbances:
            message = f"A disturbance has ended: {with_seconds(each)}."
            add(EventKind.DISTURBANCE_ENDED, message, disturbance=each)
    if now.state is not before.state:
        if before.state is PlantState.PAUSED and now.state is not PlantState.INACTIVE:
            add(EventKind.RESUMED, "Time goes on.")
        match now.state:
            case PlantState.RUNNING:
                add(EventKind.RUNNING, now.message)
            case PlantState.RESTING:
                level = 1 if now.reason == "timeout" else 0
                add(EventKind.RESTING, now.message, level, reason=now.reason)
            case PlantState.PAUSED:
                add(EventKind.PAUSED, now.message)
            case _:
                pass  # The other changes have their own events.
    elif now.reason != before.reason and now.state is PlantState.RESTING:
        level = 1 if now.reason == "timeout" else 0
        add(EventKind.RESTING, now.message, level, reason=now.reason)
    return events
