"""Fault lines and their timeline.

``KIND TARGET [VALUE] [at SECONDS] [until SECONDS]``, for example
``joint_stuck joint_2 at 10 until 50``. Without ``at`` a fault begins at once, without ``until`` it
never ends. :data:`FAULT_KINDS` has the kinds with their targets and values.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from spacerobot_ros.errors import ParameterError

_MAX_FAULT_VALUE = 1e6
"""Largest value of a fault, in its unit: squares of much larger ones overflow."""

_MAX_FAULT_TIME = 1e9
"""Largest time of a fault, s."""

_MAX_FAULTS = 1000
"""Largest number of faults: more take longer than a tick to search."""

WRENCH_AXES = ("force_x", "force_y", "force_z", "torque_x", "torque_y", "torque_z")
"""Components of the wrench on the base, in base components."""

POSE_AXES = (
    "position_x",
    "position_y",
    "position_z",
    "attitude_x",
    "attitude_y",
    "attitude_z",
)
"""Components of the measured pose: position in W, rotation vector in B."""

SENSOR_GROUPS = ("position", "attitude", "velocity", "angular_velocity", "joints", "joint_rates")
"""Groups of measured quantities: the base's pose and twist, joint positions and rates."""


@dataclass(frozen=True)
class FaultKind:
    """A kind of fault.

    Attributes
    ----------
    targets
        Names of targets; ``joint`` and ``nozzle`` stand for all names of joints and thrusters.
    value
        Meaning of its number; empty: it has none.
    minimum, maximum
        Range of that number.
    sensor
        Whether it changes measurements instead of the motion.
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
    "actuator_noise": FaultKind(("joint",), "1 sigma on the command, in its unit", 0.0),
    "thruster_stuck": FaultKind(WRENCH_AXES, "held whatever is commanded, N or N m"),
    "thruster_off": FaultKind((*WRENCH_AXES, "all")),
    "thruster_weak": FaultKind((*WRENCH_AXES, "all"), "factor on the command", 0.0, 1.0),
    "nozzle_open": FaultKind(("nozzle",)),
    "nozzle_closed": FaultKind(("nozzle",)),
    "nozzle_weak": FaultKind(("nozzle",), "factor on the thrust", 0.0, 1.0),
    "sensor_bias": FaultKind(
        (*POSE_AXES, "joint"), "added to the measurement, m or rad", sensor=True
    ),
    "sensor_noise": FaultKind(
        SENSOR_GROUPS, "1 sigma a component, m or rad (/s)", 0.0, sensor=True
    ),
    "sensor_dropout": FaultKind(("odom",), sensor=True),
    "sensor_delay": FaultKind(("odom",), "s, to whole ticks", 0.0, 60.0, sensor=True),
}
"""Kinds of faults by name."""


@dataclass(frozen=True)
class Fault:
    """One fault: active from ``start`` s on and until before ``end`` s of simulated time."""

    kind: str
    target: str
    value: float = 0.0
    start: float = 0.0
    end: float = math.inf

    def __str__(self) -> str:
        value = f" {self.value:g}" if FAULT_KINDS[self.kind].value else ""
        # With six digits, a short fault late in a flight would begin and end at the same time.
        until = f" until {self.end:.12g}" if math.isfinite(self.end) else ""
        return f"{self.kind} {self.target}{value} at {self.start:.12g}{until}"


@dataclass(frozen=True)
class Targets:
    """Targets of faults: joint names, the wrench on the base if there is one, and thruster names if
    thrusters are modelled.
    """

    joints: Sequence[str] = ()
    wrench: bool = False
    nozzles: Sequence[str] = ()

    def of(self, kind: FaultKind) -> list[str]:
        """Return the targets of a kind."""
        names: list[str] = []
        for target in kind.targets:
            if target == "joint":
                names += self.joints
            elif target == "nozzle":
                names += self.nozzles
            elif self.wrench or target not in (*WRENCH_AXES, "all"):
                names.append(target)
        return names


def parse_fault(line: str, targets: Targets, now: float = 0.0) -> Fault:
    """Read a fault from its line.

    Parameters
    ----------
    line
        As the module describes.
    targets
        Targets of this plant.
    now
        Begin of the fault if the line has none, s.

    Raises
    ------
    ParameterError
        The line is not a fault of this plant; the message quotes it.
    """

    def refusal(reason: str) -> ParameterError:
        return ParameterError(f"The fault '{line.strip()[:80]}' is refused: {reason}.")

    words = line.split()
    if len(words) < 2:
        raise refusal("it must be KIND TARGET [VALUE] [at SECONDS] [until SECONDS]")
    name, target, *rest = words
    if name not in FAULT_KINDS:
        raise refusal(f"there is no kind '{name[:40]}'; there are {', '.join(FAULT_KINDS)}")
    kind = FAULT_KINDS[name]
    known = targets.of(kind)
    if not known:
        raise refusal(f"this plant has no target of {name}")
    if target not in known:
        raise refusal(f"the target of {name} is one of {', '.join(known)}")
    value = 0.0
    if kind.value:
        if not rest or rest[0] in ("at", "until"):
            raise refusal(f"{name} needs a value: {kind.value}")
        value = _parse_number(rest.pop(0), refusal)
        if not kind.minimum <= value <= kind.maximum:
            raise refusal(
                f"its value is {value:g} and must be from {kind.minimum:g} to {kind.maximum:g}"
            )
    times = {"at": now, "until": math.inf}
    if rest[0::2] not in ([], ["at"], ["until"], ["at", "until"]) or len(rest) % 2:
        raise refusal(f"after {name} {target} come only 'at SECONDS' and 'until SECONDS'")
    for word, text in zip(rest[0::2], rest[1::2], strict=True):
        times[word] = _parse_number(text, refusal)
        if abs(times[word]) > _MAX_FAULT_TIME:
            raise refusal(
                f"its time is {times[word]:g} s and must be at most {_MAX_FAULT_TIME:g} s"
            )
    if not times["until"] > times["at"]:
        raise refusal(f"it ends at {times['until']:g} s and begins at {times['at']:g} s")
    return Fault(name, target, value, times["at"], times["until"])


def _parse_number(text: str, refusal: Callable[[str], ParameterError]) -> float:
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise refusal(f"'{text[:40]}' is not a finite number")
    return number


class FaultTimeline:
    """The faults of one plant by time.

    Parameters
    ----------
    lines
        Fault lines; see :func:`parse_fault`.
    targets
        Targets of this plant.
    """

    def __init__(self, lines: Iterable[str], targets: Targets) -> None:
        self._targets = targets
        self.faults: list[Fault] = []
        self.active: tuple[Fault, ...] = ()
        """Active faults; a new tuple object after every change."""
        self.next_change = -math.inf
        """Time of the next change of ``active``, s."""
        self.read(lines)

    def read(self, lines: Iterable[str], now: float = 0.0) -> None:
        """Add a fault per line; a fault without a time begins ``now`` (s).

        Raises
        ------
        ParameterError
            A line is not a fault, or there are too many; none is added.
        """
        added = [parse_fault(line, self._targets, now) for line in lines if line.strip()]
        if len(self.faults) + len(added) > _MAX_FAULTS:
            raise ParameterError(
                f"{len(added)} more fault(s) are refused: there are {len(self.faults)}, and at "
                f"most {_MAX_FAULTS}; inject 'clear' first."
            )
        self.faults += added
        self.next_change = -math.inf

    def clear(self) -> None:
        """Remove all faults, including future faults."""
        self.faults.clear()
        self.next_change = -math.inf

    def at(self, time: float) -> tuple[Fault, ...]:
        """Return the faults that are active at a time (s), which must not run backwards."""
        if time >= self.next_change:
            active = tuple(f for f in self.faults if f.start <= time < f.end)
            if active != self.active:
                self.active = active
            edges = [edge for f in self.faults for edge in (f.start, f.end) if edge > time]
            self.next_change = min(edges, default=math.inf)
        return self.active
