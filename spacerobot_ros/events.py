"""Flight events, and the conversion of events and statuses to key-value pairs.

Every status and event is a diagnostic_msgs/DiagnosticStatus, which contains pairs of strings. A
:class:`KeyValueFormat` describes the pairs that represent a class, for both writing and reading.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import MISSING, dataclass, field, fields
from enum import Enum
from typing import Any, TypeVar

from spacerobot_ros.errors import SpaceRobotError


@dataclass(frozen=True)
class TextFormat:
    """Conversion of a value to a string and back."""

    write: Callable[[Any], str]
    read: Callable[[str], Any]


def number_format(specification: str) -> TextFormat:
    """Return the format of a number, given a format specification such as ``.9g``."""
    return TextFormat(lambda number: format(number, specification), float)


def choice_format(choices: type[Enum]) -> TextFormat:
    """Return the format of an enumeration member."""
    return TextFormat(lambda member: str(member.value), choices)


def list_format(separator: str) -> TextFormat:
    """Return the format of a tuple of strings."""
    return TextFormat(separator.join, lambda text: tuple(text.split(separator) if text else ()))


PLAIN_TEXT = TextFormat(str, str)
INTEGER = TextFormat(str, int)
BOOLEAN = TextFormat(lambda truth: str(truth).lower(), "true".__eq__)
SECONDS = number_format(".9f")
"""Times with nanoseconds."""


@dataclass(frozen=True)
class KeyValueField:
    """An attribute of a status or event, and its key-value pair or pairs.

    An attribute is omitted if it has its default value.

    Attributes
    ----------
    attribute
        Name of the attribute.
    format
        Format of its value.
    key
        Key of the pair; empty: the attribute name.
    prefix
        Key prefix, if the attribute is a mapping with one pair per item. Empty: all pairs not used
        by earlier fields.
    always
        Whether to write the attribute even if it has its default value.
    present_with
        Attribute whose absence means that this attribute is not written either; empty: none.
    """

    attribute: str
    format: TextFormat = PLAIN_TEXT
    key: str = ""
    prefix: str | None = None
    always: bool = False
    present_with: str = ""


_Record = TypeVar("_Record")


class KeyValueFormat:
    """The key-value pairs of the statuses or events of one class, in the order of the class fields.

    Parameters
    ----------
    subject
        Name of the status or event in messages.
    described
        The fields that are written.
    """

    def __init__(self, subject: str, *described: KeyValueField) -> None:
        self._subject, self._described = subject, described
        self._known_defaults: dict[str, Any] = {}

    def to_values(self, record: Any) -> dict[str, str]:
        """Return a status or event (a dataclass) as pairs."""
        defaults = self._defaults(type(record))
        values: dict[str, str] = {}
        for each in self._described:
            value = getattr(record, each.attribute)
            decides = each.present_with or each.attribute
            if not each.always and getattr(record, decides) == defaults[decides]:
                continue
            if each.prefix is None:
                values[each.key or each.attribute] = each.format.write(value)
            else:
                for name, item in value.items():
                    values[f"{each.prefix}{name}"] = each.format.write(item)
        return values

    def from_values(self, kind: type[_Record], values: Mapping[str, str], **given: Any) -> _Record:
        """Return a status or event from the pairs returned by :meth:`to_values`.

        Attributes missing from the pairs are taken from ``given`` or, if missing there, have their
        defaults.

        Raises
        ------
        SpaceRobotError
            A pair is missing or unreadable; the message names the pair.
        """
        left, arguments = dict(values), dict(given)
        defaults = self._defaults(kind)
        with self.reading():
            for each in self._described:
                key = each.key or each.attribute
                if each.prefix is not None:
                    names = [name for name in left if name.startswith(each.prefix)]
                    arguments[each.attribute] = {
                        name.removeprefix(each.prefix): each.format.read(left.pop(name))
                        for name in names
                    }
                elif key in left or defaults[each.attribute] is MISSING:
                    arguments[each.attribute] = each.format.read(left.pop(key))
        return kind(**arguments)

    def _defaults(self, kind: Any) -> dict[str, Any]:
        """Return the defaults of the attributes of the class; MISSING: an attribute has none."""
        if not self._known_defaults:
            self._known_defaults = {
                each.name: each.default_factory()
                if callable(each.default_factory)
                else each.default
                for each in fields(kind)
            }
        return self._known_defaults

    @contextmanager
    def reading(self) -> Iterator[None]:
        """Convert errors about missing keys or unreadable values to messages for the user."""
        try:
            yield
        except (KeyError, ValueError) as error:
            raise SpaceRobotError(
                f"No {self._subject} can be read from the values: {error}."
            ) from error


class EventKind(str, Enum):
    """Kinds of events; the value is the ``event`` entry in the message."""

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
    """A fault becomes active."""
    FAULT_ENDED = "fault_ended"
    FAULTS_CLEARED = "faults_cleared"
    DISTURBANCE = "disturbance"
    """An external wrench becomes active."""
    DISTURBANCE_ENDED = "disturbance_ended"
    CONTACT = "contact"
    """Two links of the robot touch; the exact plant lets the links pass through each other."""
    CONTACT_ENDED = "contact_ended"
    CAPTURED = "captured"
    """The robot has captured the target; its model changes from now on."""
    RELEASED = "released"
    """The robot has released the target."""

    APPROACH_STARTED = "approach_started"
    """A trajectory of the end-effector to the target was planned."""
    DETUMBLE_STARTED = "detumble_started"
    """The robot is brought to rest together with the held target."""
    DETUMBLED = "detumbled"

    WHEEL_NEAR_LIMIT = "wheel_near_limit"
    """A reaction wheel approaches its maximum rate."""
    WHEEL_SATURATED = "wheel_saturated"
    WHEEL_FAILED = "wheel_failed"
    """A reaction wheel does not respond to its torque; control continues without it."""
    DUMP_STARTED = "dump_started"
    """Thrusters dump reaction wheel momentum."""
    DUMP_ENDED = "dump_ended"

    GOAL_ACCEPTED = "goal_accepted"
    GOAL_REFUSED = "goal_refused"
    GOAL_REACHED = "goal_reached"
    GOAL_REACHED_PARTLY = "goal_reached_partly"
    GOAL_FAILED = "goal_failed"
    GOAL_ABORTED = "goal_aborted"
    PLAN_STARTED = "plan_started"
    PLAN_READY = "plan_ready"
    PLAN_TAKEN_OVER = "plan_taken_over"
    """A plan replaces another plan while the joints are moving."""
    PLAN_LATE = "plan_late"
    """A plan was not ready at the start time of its schedule."""
    PLAN_DISTURBED = "plan_disturbed"
    """An external wrench changes momenta that a plan assumes to be constant."""
    CORRECTION = "correction"
    STUCK_JOINT = "stuck_joint"

    RECORDING = "recording"
    RECORDING_PAUSED = "recording_paused"
    RECORDING_FAILED = "recording_failed"
    FILE_SPLIT = "file_split"

    NODE_SILENT = "node_silent"
    NODE_BACK = "node_back"
    NODE_RESTARTED = "node_restarted"
    """A node has died and is restarted by the command that started it."""


@dataclass(frozen=True)
class Event:
    """One change in a node's state.

    Attributes
    ----------
    kind
        Kind of change.
    message
        One sentence for people.
    level
        Level of diagnostic_msgs/DiagnosticStatus: 0 (OK), 1 (WARN) or 2 (ERROR).
    time_s
        Simulated time, s; None if the node does not know it.
    goal_id
        The goal to which the event refers; empty: none.
    about
        Further facts by name.
    node
        Name of the reporting node; empty: unknown.
    """

    kind: EventKind
    message: str
    level: int = 0
    time_s: float | None = None
    goal_id: str = ""
    about: Mapping[str, str] = field(default_factory=dict)
    node: str = ""

    def to_values(self, wall_time_s: float | None) -> dict[str, str]:
        """Return the event as the key-value pairs of a DiagnosticStatus.

        Parameters
        ----------
        wall_time_s
            Wall time of the publication, s since the epoch; None omits the entry.
        """
        values = _EVENT_FORMAT.to_values(self)
        times = {key: values.pop(key) for key in list(values) if key in ("event", "time")}
        if wall_time_s is not None:
            times["wall_time"] = f"{wall_time_s:.6f}"
        return times | values

    @classmethod
    def from_values(cls, values: Mapping[str, str], message: str = "", level: int = 0) -> Event:
        """Return the event from the pairs returned by :meth:`to_values`.

        Raises
        ------
        SpaceRobotError
            The pairs are not an event.
        """
        given = {key: value for key, value in values.items() if key != "wall_time"}
        return _EVENT_FORMAT.from_values(cls, given, message=message, level=level)


_EVENT_FORMAT = KeyValueFormat(
    "event of a flight",
    KeyValueField("kind", choice_format(EventKind), key="event"),
    KeyValueField("time_s", SECONDS, key="time"),
    KeyValueField("goal_id"),
    KeyValueField("about", prefix=""),
)
