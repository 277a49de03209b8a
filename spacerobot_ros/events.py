"""Events of a flight: one record for each change of a node's state, as on the topic ``events``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum

from spacerobot_ros.errors import SpaceRobotError


class EventKind(str, Enum):
    """Kinds of events; the value is the word ``event`` of the message."""

    CONFIGURED = "configured"
    ACTIVATED = "activated"
    DEACTIVATED = "deactivated"
    CLEANED_UP = "cleaned_up"
    SHUT_DOWN = "shut_down"
    FAILED = "failed"
    """A node has failed and does nothing until it is configured or activated again."""

    RUNNING = "running"
    RESTING = "resting"
    PAUSED = "paused"
    RESUMED = "resumed"
    RESET = "reset"
    LATCHED = "latched"
    REARMED = "rearmed"
    FAULT_INJECTED = "fault_injected"
    """A fault begins to act."""
    FAULT_ENDED = "fault_ended"
    FAULTS_CLEARED = "faults_cleared"
    DISTURBANCE = "disturbance"
    """A wrench from outside begins to act."""
    DISTURBANCE_ENDED = "disturbance_ended"
    CONTACT = "contact"
    """Two links of the robot touch; the exact plant goes on through the contact."""
    CONTACT_ENDED = "contact_ended"
    CAPTURED = "captured"
    """The robot has captured the target: from now on it is another robot."""
    RELEASED = "released"
    """The robot has released the target."""

    APPROACH_STARTED = "approach_started"
    """The end-effector has a way to the target."""
    DETUMBLE_STARTED = "detumble_started"
    """The robot is brought to rest with the target that it holds."""
    DETUMBLED = "detumbled"

    WHEEL_NEAR_LIMIT = "wheel_near_limit"
    """A reaction wheel comes near its largest rate."""
    WHEEL_SATURATED = "wheel_saturated"
    WHEEL_FAILED = "wheel_failed"
    """A reaction wheel does not answer its torque; control goes on without it."""
    DUMP_STARTED = "dump_started"
    """The momentum of reaction wheels is dumped to the thrusters."""
    DUMP_ENDED = "dump_ended"

    GOAL_ACCEPTED = "goal_accepted"
    GOAL_REFUSED = "goal_refused"
    GOAL_REACHED = "goal_reached"
    GOAL_FAILED = "goal_failed"
    GOAL_ABORTED = "goal_aborted"
    PLAN_STARTED = "plan_started"
    PLAN_READY = "plan_ready"
    PLAN_TAKEN_OVER = "plan_taken_over"
    """A plan takes over from another one while the joints move."""
    PLAN_LATE = "plan_late"
    """A plan was not ready at the start time of its schedule."""
    PLAN_DISTURBED = "plan_disturbed"
    """A wrench from outside changes the momenta that a plan takes as constant."""
    CORRECTION = "correction"
    STUCK_JOINT = "stuck_joint"

    RECORDING = "recording"
    RECORDING_PAUSED = "recording_paused"
    RECORDING_FAILED = "recording_failed"
    FILE_SPLIT = "file_split"

    NODE_SILENT = "node_silent"
    NODE_BACK = "node_back"
    NODE_RESTARTED = "node_restarted"
    """A node has died, and the command that started it starts it again."""


CONTACTS = frozenset({EventKind.CONTACT, EventKind.CONTACT_ENDED})
"""Kinds of events of contacts between links."""


@dataclass(frozen=True)
class Event:
    """One change of a node's state.

    Attributes
    ----------
    kind
        Kind of change.
    message
        One sentence for people.
    level
        Of diagnostic_msgs/DiagnosticStatus: 0 OK, 1 WARN, 2 ERROR.
    time_s
        Simulated time, s; None where the node does not know it.
    goal_id
        The goal that the event is about; empty: none.
    about
        Further facts by name.
    """

    kind: EventKind
    message: str
    level: int = 0
    time_s: float | None = None
    goal_id: str = ""
    about: Mapping[str, str] = field(default_factory=dict)

    def to_values(self, wall_time_s: float | None) -> dict[str, str]:
        """Return the event as the key-value pairs of a DiagnosticStatus.

        Parameters
        ----------
        wall_time_s
            Wall time of the publication, s since the epoch; None leaves the entry out.
        """
        values = {"event": self.kind.value}
        if self.time_s is not None:
            values["time"] = f"{self.time_s:.9f}"
        if wall_time_s is not None:
            values["wall_time"] = f"{wall_time_s:.6f}"
        if self.goal_id:
            values["goal_id"] = self.goal_id
        return values | dict(self.about)

    @classmethod
    def from_values(cls, values: Mapping[str, str], message: str = "", level: int = 0) -> Event:
        """Return the event that :meth:`to_values` has turned into these pairs.

        Raises
        ------
        SpaceRobotError
            The pairs are no event.
        """
        given = dict(values)
        try:
            kind, time = EventKind(given.pop("event")), given.pop("time", None)
            time_s = None if time is None else float(time)
        except (KeyError, ValueError) as error:
            raise SpaceRobotError(f"The message is no event of a flight: {error}.") from error
        given.pop("wall_time", None)
        return cls(kind, message, level, time_s, given.pop("goal_id", ""), given)
