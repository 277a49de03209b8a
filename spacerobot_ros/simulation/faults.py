"""Fault lines, disturbance lines, and their timelines.

A fault is ``KIND TARGET [VALUE] [at SECONDS] [until SECONDS]``, for example
``joint_stuck joint_2 at 10 until 50``; :data:`FAULT_KINDS` lists the kinds with their targets and
values. A disturbance is a constant external wrench on a link,
``LINK [force X Y Z] [torque X Y Z] [in world|link] [at SECONDS] [until SECONDS]``, for example
``hand force 1 0 0 torque 0 0 0.2 in link at 10 until 50``. Force (N) and torque (N m) act at the
link frame origin, in world or link components; in link components, they rotate with the link.
Without ``at``, a fault or disturbance begins immediately; without ``until``, it never ends.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

from spacerobot_ros.errors import ParameterError

_MAX_FAULT_VALUE = 1e6
"""Largest fault value, in its unit: the squares of much larger values would overflow."""

WRENCH_AXES = ("force_x", "force_y", "force_z", "torque_x", "torque_y", "torque_z")
"""Axes of the base wrench, in the base frame."""

POSE_AXES = tuple(f"{part}_{axis}" for part in ("position", "attitude") for axis in "xyz")
"""Axes of the measured pose: position in W, rotation vector in B."""

SENSOR_GROUPS = ("position", "attitude", "velocity", "angular_velocity", "joints", "joint_rates")
"""Groups of measured quantities: base pose and twist, joint positions and rates."""


@dataclass(frozen=True)
class FaultKind:
    """A kind of fault.

    Attributes
    ----------
    targets
        Names of targets; ``joint`` and ``nozzle`` stand for all joint and thruster names.
    value
        Meaning of the fault's value; empty if the fault takes no value.
    minimum, maximum
        Range of that number.
    sensor
        Whether the fault affects measurements instead of the motion.
    """

    targets: tuple[str, ...]
    value: str = ""
    minimum: float = -_MAX_FAULT_VALUE
    maximum: float = _MAX_FAULT_VALUE
    sensor: bool = False


FAULT_KINDS: dict[str, FaultKind] = {
    "joint_stuck": FaultKind(("joint",)),
    "joint_slow": FaultKind(("joint",), "factor on the command", 0.0, 1.0),
    "actuator_bias": FaultKind(("joint",), "added to the command, in its unit"),
    "actuator_noise": FaultKind(("joint",), "1 sigma, added to the command, in its unit", 0.0),
    "thruster_stuck": FaultKind(WRENCH_AXES, "held regardless of the command, N or N m"),
    "thruster_off": FaultKind((*WRENCH_AXES, "all")),
    "thruster_weak": FaultKind((*WRENCH_AXES, "all"), "factor on the command", 0.0, 1.0),
    "nozzle_open": FaultKind(("nozzle",)),
    "nozzle_closed": FaultKind(("nozzle",)),
    "nozzle_weak": FaultKind(("nozzle",), "factor on the thrust", 0.0, 1.0),
    "sensor_bias": FaultKind(
        (*POSE_AXES, "joint"), "added to the measurement, m or rad", sensor=True
    ),
    "sensor_noise": FaultKind(
        SENSOR_GROUPS, "1 sigma per component, m or rad (/s)", 0.0, sensor=True
    ),
    "sensor_dropout": FaultKind(("odom",), sensor=True),
    "sensor_delay": FaultKind(("odom",), "s, to whole ticks", 0.0, 60.0, sensor=True),
}
"""Fault kinds by name."""


@dataclass(frozen=True)
class Fault:
    """One fault, active from ``start`` s until just before ``end`` s of simulated time."""

    kind: str
    target: str
    value: float = 0.0
    start: float = 0.0
    end: float = math.inf

    def __str__(self) -> str:
        value = f" {self.value:g}" if FAULT_KINDS[self.kind].value else ""
        return f"{self.kind} {self.target}{value} {format_times(self.start, self.end)}"


@dataclass(frozen=True)
class FaultTargets:
    """Fault targets: joint names, the base wrench if there is one, and thruster names if thrusters
    are modelled.
    """

    joints: Sequence[str] = ()
    wrench: bool = False
    nozzles: Sequence[str] = ()

    def of(self, kind: FaultKind) -> list[str]:
        """Return the possible targets of a fault kind."""
        names: list[str] = []
        for target in kind.targets:
            if target == "joint":
                names += self.joints
            elif target == "nozzle":
                names += self.nozzles
            elif self.wrench or target not in (*WRENCH_AXES, "all"):
                names.append(target)
        return names


def parse_fault(line: str, targets: FaultTargets, now: float = 0.0) -> Fault:
    """Parse a fault line.

    Parameters
    ----------
    line
        The line; see the module docstring.
    targets
        Targets of this plant.
    now
        Start time of the fault if the line specifies none, s.

    Raises
    ------
    ParameterError
        The line is not a valid fault for this plant; the message quotes it.
    """
    refusal = line_refusal(line, "fault")
    words = line.split()
    if len(words) < 2:
        raise refusal("it must be KIND TARGET [VALUE] [at SECONDS] [until SECONDS]")
    name, target, *rest = words
    if name not in FAULT_KINDS:
        raise refusal(f"there is no kind '{name[:40]}'; the kinds are {', '.join(FAULT_KINDS)}")
    kind = FAULT_KINDS[name]
    known = targets.of(kind)
    if not known:
        raise refusal(f"this plant has no target for {name}")
    if target not in known:
        raise refusal(f"the target of {name} must be one of {', '.join(known)}")
    value = 0.0
    if kind.value:
        if not rest or rest[0] in ("at", "until"):
            raise refusal(f"{name} needs a value: {kind.value}")
        value = _parse_number(rest.pop(0), refusal)
        if not kind.minimum <= value <= kind.maximum:
            raise refusal(
                f"its value is {value:g} but must be from {kind.minimum:g} to {kind.maximum:g}"
            )
    start, end = parse_times(rest, f"{name} {target}", now, refusal)
    return Fault(name, target, value, start, end)


def edited_fault(line: str, part: str, text: str) -> str:
    """Return a fault line with one component replaced: ``kind``, ``target``, ``value``, ``at``,
    or ``until``.

    If the new kind takes no value, the line's value is dropped.
    """
    kind, target, *times = line.split()
    value = [times.pop(0)] if FAULT_KINDS[kind].value else []
    if part == "kind":
        has_none = text in FAULT_KINDS and not FAULT_KINDS[text].value
        kind, value = text, [] if has_none else value
    elif part == "target":
        target = text
    elif part == "value":
        value = [text] if value else []
    elif part in times:
        times[times.index(part) + 1] = text
    else:
        times = [part, text, *times] if part == "at" else [*times, part, text]
    return " ".join([kind, target, *value, *times])


# -- disturbances ---------------------------------------------------------------------------------

_MAX_COMPONENT = 1e6  # N or N m

_LINE_FORMAT = (
    "it must be LINK [force X Y Z] [torque X Y Z] [in world|link] [at SECONDS] [until SECONDS], "
    "with a force or a torque"
)


@dataclass(frozen=True)
class Disturbance:
    """One disturbance, active from ``start`` s until just before ``end`` s of simulated time.

    ``force`` (3,), N, and ``torque`` (3,), N m, act at the frame origin of ``link``, in link
    components if ``in_link``, otherwise in the world frame.
    """

    link: str
    force: tuple[float, float, float] = (0.0, 0.0, 0.0)
    torque: tuple[float, float, float] = (0.0, 0.0, 0.0)
    in_link: bool = False
    start: float = 0.0
    end: float = math.inf

    def __str__(self) -> str:
        words = [self.link]
        for name, vector in (("force", self.force), ("torque", self.torque)):
            if any(vector):
                words += [name, *(f"{component:g}" for component in vector)]
        frame = "link" if self.in_link else "world"
        return " ".join([*words, "in", frame, format_times(self.start, self.end)])


def parse_disturbance(line: str, links: Sequence[str], now: float = 0.0) -> Disturbance:
    """Parse a disturbance line.

    Parameters
    ----------
    line
        The line; see the module docstring.
    links
        Link names of the robot.
    now
        Start time of the disturbance if the line specifies none, s.

    Raises
    ------
    ParameterError
        The line is not a valid disturbance for this robot; the message quotes it.
    """
    refusal = line_refusal(line, "disturbance")
    link, *rest = line.split() or [""]
    vectors = {"force": (0.0, 0.0, 0.0), "torque": (0.0, 0.0, 0.0)}
    given: list[str] = []
    while rest and rest[0] in vectors and rest[0] not in given:
        name, components = rest[0], rest[1:4]
        if len(components) < 3:
            raise refusal(_LINE_FORMAT)
        x, y, z = (_parse_number(text, refusal) for text in components)
        if max(abs(x), abs(y), abs(z)) > _MAX_COMPONENT:
            raise refusal(f"components of its {name} must be at most {_MAX_COMPONENT:g}")
        vectors[name], given, rest = (x, y, z), [*given, name], rest[4:]
    if not given:
        raise refusal(_LINE_FORMAT)
    if link not in links:
        raise refusal(f"the robot has no link '{link[:40]}'; it has {', '.join(links)}")
    in_link = False
    if rest[:1] == ["in"]:
        if rest[1:2] not in (["world"], ["link"]):
            raise refusal("its frame must be world or link")
        in_link, rest = rest[1] == "link", rest[2:]
    start, end = parse_times(rest, f"the {given[-1]}", now, refusal)
    return Disturbance(link, vectors["force"], vectors["torque"], in_link, start, end)


# -- lines and times ------------------------------------------------------------------------------

MAX_TIME = 1e9
"""Largest time in a line, s."""

Refusal = Callable[[str], ParameterError]
"""Function that returns the error for an invalid line, given the reason as a clause."""


def line_refusal(line: str, noun: str) -> Refusal:
    """Return the error for an invalid line; its message quotes the line."""
    return lambda reason: ParameterError(f"The {noun} '{line.strip()[:80]}' is refused: {reason}.")


def _parse_number(text: str, refusal: Refusal) -> float:
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise refusal(f"'{text[:40]}' is not a finite number")
    return number


def parse_times(
    words: Sequence[str], before: str, now: float, refusal: Refusal
) -> tuple[float, float]:
    """Return the start and end (s) from the last words of a line, ``[at SECONDS] [until SECONDS]``.

    Parameters
    ----------
    words
        The words.
    before
        The preceding part of the line, for messages.
    now
        Start time if the words specify none, s.
    refusal
        Function that returns the error for the line.

    Raises
    ------
    ParameterError
        The words are not valid times, or the end is not after the start.
    """
    times = {"at": now, "until": math.inf}
    if words[0::2] not in ([], ["at"], ["until"], ["at", "until"]) or len(words) % 2:
        raise refusal(f"only 'at SECONDS' and 'until SECONDS' may follow {before}")
    for word, text in zip(words[0::2], words[1::2], strict=True):
        times[word] = _parse_number(text, refusal)
        if not 0.0 <= times[word] <= MAX_TIME:
            raise refusal(f"its time is {times[word]:g} s but must be from 0 to {MAX_TIME:g} s")
    if not times["until"] > times["at"]:
        raise refusal(f"it ends at {times['until']:g} s but begins at {times['at']:g} s")
    return times["at"], times["until"]


_TIME = re.compile(r"\b(at|until) [\d.e+-]+")


def with_seconds(line: str) -> str:
    """Return a fault or disturbance line with units added to its times, for display."""
    return _TIME.sub(r"\g<0> s", line)


_FAULT_LINE = re.compile(r"(?P<noun>[a-z]+)_(?P<state>[a-z]+) (?P<target>\S+).*? at (?P<since>\S+)")


def active_fault(line: str) -> str:
    """Return a clause that says since when the fault of a line has been active, such as ``joint
    'elbow' has been stuck since 12 s``."""
    found = _FAULT_LINE.match(line)
    if found is None:
        return f"the fault '{line}' has been active"
    noun, state, target, since = found.groups()
    if state in ("bias", "noise", "dropout", "delay"):
        return f"the {noun} {state} of '{target}' has been active since {since} s"
    return f"{noun} '{target}' has been {state} since {since} s"


def format_times(start: float, end: float) -> str:
    """Return the start and end formatted as the last words of a line."""
    # With six digits, an entry that is short and late would begin and end at the same time.
    until = f" until {end:.12g}" if math.isfinite(end) else ""
    return f"at {start:.12g}{until}"


Entry = TypeVar("Entry", Fault, Disturbance)


class Timeline(Generic[Entry]):
    """Timed entries of one plant.

    Parameters
    ----------
    lines
        One entry per line.
    parse
        Function that parses an entry line; the second argument is the start time if the line
        specifies none, s.
    """

    def __init__(self, lines: Iterable[str], parse: Callable[[str, float], Entry]) -> None:
        self._parse: Callable[[str, float], Entry] = parse
        self.entries: list[Entry] = []
        self.active: tuple[Entry, ...] = ()
        """Active entries; a new tuple object after every change."""
        self.next_change = -math.inf
        """Time of the next change in ``active``, s."""
        self.read(lines)

    def read(self, lines: Iterable[str], now: float = 0.0) -> None:
        """Add one entry per line; an entry without a time begins at ``now`` (s).

        Raises
        ------
        ParameterError
            A line is invalid; none is added.
        """
        self.entries += [self._parse(line, now) for line in lines if line.strip()]
        self.next_change = -math.inf

    def inject(self, text: str, now: float) -> None:
        """Add the entries in a string, one per line, or remove all entries (``clear``), including
        future entries.

        Raises
        ------
        ParameterError
            As for :meth:`read`.
        """
        if text.strip() == "clear":
            self.entries.clear()
            self.next_change = -math.inf
        else:
            self.read(text.splitlines(), now)

    def copy_from(self, other: Timeline[Entry]) -> None:
        """Replace the entries with the entries of another timeline."""
        self.entries, self.next_change = list(other.entries), -math.inf

    def at(self, time: float) -> tuple[Entry, ...]:
        """Return the entries active at a time (s), which must not decrease between calls."""
        if time >= self.next_change:
            active = tuple(each for each in self.entries if each.start <= time < each.end)
            if active != self.active:
                self.active = active
            edges = [
                edge for each in self.entries for edge in (each.start, each.end) if edge > time
            ]
            self.next_change = min(edges, default=math.inf)
        return self.active
