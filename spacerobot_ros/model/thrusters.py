"""Thrusters in flight software: table, wrench allocation, pulse modulation.

A node on a real robot can use this module without a plant::

    table = find_thrusters("urdf", robot.description)
    modulator = ThrusterModulator(table, control_period=0.01)
    on_time = modulator.fire(wrench)  # (m,) s, for the valves; every period

A table is read from ``<thruster>`` elements in a URDF, which other programs ignore, or from a YAML
file; docs/theory/thrusters.md shows both.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from spacerobot_ros.errors import ParameterError, RobotDescriptionError, SpaceRobotError, reason
from spacerobot_ros.files import load_yaml, read_regular
from spacerobot_ros.model.description import Array, Pose, RobotDescription
from spacerobot_ros.model.rotations import matrix_from_rpy

STANDARD_GRAVITY = 9.80665
"""Acceleration relating specific impulse in seconds to exhaust velocity, m/s^2."""

IN_URDF = "urdf"
"""Table source: the robot's URDF."""

_MAX_TABLE_NUMBER = 1e12
"""Largest number in a table, in SI units."""

_WRENCH_AXES = (
    "force along x",
    "force along y",
    "force along z",
    *(f"torque about {x}" for x in "xyz"),
)
_THRUSTER_KEYS = {"name", "link", "position", "rpy", "direction", "force", "min_on_time", "isp"}

COST_WEIGHT = 1e-5
"""Weight of the cost relative to the wrench. The cost changes the wrench by about 1e-10, which is
corrected afterwards; a much smaller weight would be lost in solver rounding errors."""

TIE_BREAK = 0.01
"""Largest relative change made to a cost. Symmetric thrusters have many allocations of equal cost,
and machine-dependent rounding errors would select one."""

_ACHIEVED_TOLERANCE = 1e-9
"""Largest relative error at which a wrench is considered achieved."""

_WRENCH_WEIGHT = 1e4
"""Weight, relative to the cost, of the achieved part of a wrench that exceeds the thrust."""

_ROUNDING = 1e-9
"""Fractions of a time below this value are considered zero."""

_MIN_UNMET_WRENCH = 1e-6
"""Shortfalls of a wrench below this value are ignored, N or N m."""


@dataclass(frozen=True)
class ThrusterTable:
    """The m thrusters on the base.

    ``r_B`` (m, 3) are the points of application relative to the base link origin, m;
    ``direction_B`` (m, 3) unit vectors of the forces on the base, opposite to the plumes;
    ``force`` (m,) thrusts, N; ``min_on_time`` (m,) shortest pulses, s; ``isp`` (m,) specific
    impulses, s.
    """

    names: tuple[str, ...]
    r_B: Array
    direction_B: Array
    force: Array
    min_on_time: Array
    isp: Array

    @property
    def wrenches(self) -> Array:
        """Wrenches (6, m) at full thrust, force (N) and torque (N m) at the base link origin, in
        the base frame.
        """
        thrust_B = self.direction_B * self.force[:, None]
        return np.vstack([thrust_B.T, np.cross(self.r_B, thrust_B).T])

    @property
    def mass_flow(self) -> Array:
        """Mass flow of each open thruster (m,), kg/s: ``F / (g0 Isp)``."""
        return self.force / (STANDARD_GRAVITY * self.isp)

    def index(self, name: str) -> int:
        """Return the index of a thruster in the table.

        Raises
        ------
        ParameterError
            There is no thruster with that name.
        """
        if name not in self.names:
            raise ParameterError(
                f"There is no thruster '{name}'; available: {', '.join(self.names)}."
            )
        return self.names.index(name)

    def missing(self, without: Sequence[str] = ()) -> str:
        """Return the names of wrenches that the thrusters other than ``without`` cannot produce;
        empty if there are none.

        Thrusters can produce every wrench if they can produce both directions along all six axes,
        because their wrenches form a convex cone.
        """
        # Imported where it is used: scipy.optimize loads slowly.
        from scipy.optimize import linprog

        kept = [i for i, name in enumerate(self.names) if name not in without]
        if not kept:
            return "any wrench"
        wrenches = self.wrenches[:, kept]
        wrenches = wrenches / np.linalg.norm(wrenches, axis=0)
        lacking = []
        for axis, name in enumerate(_WRENCH_AXES):
            for sign, text in ((1.0, name), (-1.0, f"negative {name}")):
                wanted = np.zeros(6)
                wanted[axis] = sign
                if not linprog(np.ones(len(kept)), A_eq=wrenches, b_eq=wanted).success:
                    lacking.append(text)
        return ", ".join(lacking)


def find_thrusters(source: str | Path, robot: RobotDescription) -> ThrusterTable:
    """Return the table from :data:`IN_URDF`, the ``<thruster>`` elements in the robot's URDF, or
    from a YAML file that contains a list ``thrusters`` and, for common values, a mapping
    ``defaults``.

    Raises
    ------
    ParameterError
        The file cannot be read, or a thruster in it is invalid.
    RobotDescriptionError
        A thruster in the URDF is invalid, or the URDF has no thrusters.
    """
    refused: type[SpaceRobotError] = ParameterError
    if source == IN_URDF:
        refused, source = RobotDescriptionError, f"The URDF of robot '{robot.name}'"
        entries = _entries_of_urdf(robot)
    else:
        entries = _entries_of_file(source)
    try:
        return _thruster_table(entries, robot)
    except ParameterError as error:
        raise refused(f"{source}: {error}") from error


def _entries_of_urdf(robot: RobotDescription) -> list[dict[str, Any]]:
    entries = []
    for element in ET.fromstring(robot.urdf.encode("utf-8")).findall("thruster"):
        entry: dict[str, Any] = dict(element.attrib)
        for tag, names in (
            ("origin", {"xyz": "position", "rpy": "rpy"}),
            ("axis", {"xyz": "direction"}),
            ("thrust", {name: name for name in ("force", "min_on_time", "isp")}),
        ):
            child = element.find(tag)
            for attribute, value in (child.attrib if child is not None else {}).items():
                entry[names.get(attribute, attribute)] = value.split() if tag != "thrust" else value
        entries.append(entry)
    if not entries:
        raise RobotDescriptionError(
            f"The URDF of robot '{robot.name}' has no <thruster> elements; "
            "add them, or give a YAML file of thrusters."
        )
    return entries


def _entries_of_file(path: str | Path) -> list[dict[str, Any]]:
    try:
        content = load_yaml(read_regular(path).decode("utf-8"))
    except (OSError, ValueError) as error:
        raise ParameterError(
            f"The thruster file {path} cannot be read: {reason(error)}."
        ) from error
    entries = content.get("thrusters") if isinstance(content, dict) else None
    defaults = content.get("defaults", {}) if isinstance(content, dict) else {}
    if not (isinstance(entries, list) and entries and isinstance(defaults, dict)):
        raise ParameterError(
            f"The thruster file {path} must have a list 'thrusters'; 'defaults' must be a mapping."
        )
    if not all(isinstance(entry, dict) for entry in entries):
        raise ParameterError(f"{path}: An entry of 'thrusters' is not a mapping.")
    return [{**defaults, **entry} for entry in entries]


def _thruster_table(entries: Sequence[Mapping[str, Any]], robot: RobotDescription) -> ThrusterTable:
    """Check thrusters and express their data in the base link frame.

    Each thruster has ``name``, ``position`` (m) in the frame of ``link`` (default: the base link),
    force ``direction`` (default: x, as for joint axes) in that frame rotated by ``rpy`` (rad),
    ``force`` (N), ``isp`` (s) and ``min_on_time`` (s, default: 0).
    """
    names: list[str] = []
    rows: list[Array] = []
    for entry in entries:
        name = str(entry.get("name", ""))
        where = f"thruster '{name}'"
        if not name or name in names:
            problem = "is used twice; names must be unique" if name else "is missing"
            raise ParameterError(f"The name of {where if name else 'a thruster'} {problem}.")
        unknown = sorted(set(entry) - _THRUSTER_KEYS)
        if unknown:
            raise ParameterError(
                f"The {where} has '{unknown[0]}'; known keys: {', '.join(sorted(_THRUSTER_KEYS))}."
            )
        mount = _pose_of_link(str(entry.get("link", robot.base_link)), robot, where)
        frame = Pose(
            matrix_from_rpy(_read_vector(entry, "rpy", where, (0.0, 0.0, 0.0))),
            _read_vector(entry, "position", where),
        )
        pose = mount @ frame
        direction = _read_vector(entry, "direction", where, (1.0, 0.0, 0.0))
        length = float(np.linalg.norm(direction))
        if length < 1e-9:
            raise ParameterError(
                f"The direction of {where} is zero; give the direction of its force."
            )
        numbers = [
            _read_number(entry, key, where, positive=key != "min_on_time")
            for key in ("force", "min_on_time", "isp")
        ]
        names.append(name)
        rows.append(np.concatenate([pose.r, pose.R @ direction / length, numbers]))
    table = np.array(rows)
    return ThrusterTable(
        tuple(names), table[:, :3], table[:, 3:6], table[:, 6], table[:, 7], table[:, 8]
    )


def _pose_of_link(link: str, robot: RobotDescription, where: str) -> Pose:
    if link not in robot.frames:
        raise ParameterError(f"The link of {where} is '{link}', but there is no such link.")
    body, pose = robot.frames[link]
    if body:
        raise ParameterError(
            f"The {where} is on link '{link}', which moves with the joints; thrusters must be "
            f"fixed to the base '{robot.base_link}'."
        )
    return pose


def _read_vector(
    entry: Mapping[str, Any], key: str, where: str, default: Sequence[float] | None = None
) -> Array:
    try:
        vector = np.array([float(x) for x in entry.get(key, default)])
    except (TypeError, ValueError):
        vector = np.empty(0)
    # Larger numbers are typing errors, and their squares overflow.
    if vector.shape != (3,) or not np.all(np.abs(vector) <= _MAX_TABLE_NUMBER):
        raise ParameterError(
            f"The {key} of {where} is {entry.get(key, 'missing')}; it must be three finite numbers "
            f"of at most {_MAX_TABLE_NUMBER:g}."
        )
    return vector


def _read_number(entry: Mapping[str, Any], key: str, where: str, *, positive: bool) -> float:
    given = entry.get(key, None if positive else 0.0)
    try:
        value = float(given)
    except (TypeError, ValueError):
        value = math.nan
    if not 0 <= value <= _MAX_TABLE_NUMBER or (positive and value < 1 / _MAX_TABLE_NUMBER):
        wanted = "a positive number" if positive else "zero or more"
        if value > _MAX_TABLE_NUMBER:
            wanted += f" up to {_MAX_TABLE_NUMBER:g}"
        raise ParameterError(
            f"The {key} of {where} is {'missing' if given is None else given}; it must be {wanted}."
        )
    return value


@dataclass(frozen=True)
class Allocation:
    """Thruster levels ``levels`` (m,) and their wrench ``achieved`` (6,)."""

    levels: Array
    achieved: Array


class ThrusterAllocation:
    """Distributes wrenches over push-only thrusters at minimal cost; see docs/theory/thrusters.md.

    The levels solve ``wrenches @ levels = wanted`` with ``0 <= levels <= most``. If a level would
    exceed its upper bound, the wrench becomes smaller but keeps its direction, as in
    :class:`spacerobot_ros.control.ActuatorLimits`. If a wrench is outside the thrusters' cone, the
    nearest wrench in the cone is allocated, with torques weighted by the mean lever arm.

    Parameters
    ----------
    wrenches
        (6, m) force (N) and torque (N m) of each thruster at level one.
    cost
        (m,) cost of each thruster at level one, positive.
    """

    def __init__(self, wrenches: Array, cost: Array) -> None:
        self._wrenches = wrenches
        force, torque = np.linalg.norm(wrenches[:3]), np.linalg.norm(wrenches[3:])
        lever = torque / force if torque > 0 and force > 0 else 1.0
        self._weights = np.repeat([1.0, 1.0 / lever], 3)
        self._matrix = self._weights[:, None] * wrenches
        size = float(np.linalg.norm(self._matrix, axis=0).max())
        self._matrix, self._weights = self._matrix / size, self._weights / size
        self._cost = cost / cost.max()
        # Imported where thrusters are used: scipy.optimize loads slowly.
        from scipy.optimize import nnls

        self._nnls = nnls
        self._usable: npt.NDArray[np.int64] = np.arange(cost.size)
        self._use(self._usable)

    def exclude(self, index: int) -> None:
        """Exclude a thruster from further use."""
        self._use(self._usable[self._usable != index])

    def _use(self, usable: npt.NDArray[np.int64]) -> None:
        self._usable = usable
        self._columns = self._matrix[:, usable]
        self._extended = np.vstack([self._columns, COST_WEIGHT * self._cost[usable]])

    def allocate(self, wanted: Array, most: Array) -> Allocation:
        """Return levels (m,), each at most ``most`` (m,), for a wrench ``wanted`` (6,), or for its
        achievable part.
        """
        levels = np.zeros(self._cost.size)
        target = self._weights * wanted
        size = float(np.linalg.norm(target))
        if size > 0.0 and self._usable.size:
            target = target / size
            share, _ = self._nnls(self._extended, np.append(target, 0.0))
            share = self._correct_levels(share, target, share > 0.0)
            bounds = most[self._usable] / size
            if np.any(share > bounds):
                achieved = self._columns @ share
                if np.linalg.norm(achieved - target) > _ACHIEVED_TOLERANCE:
                    target = achieved
                share = self._largest_part(target, bounds)
            levels[self._usable] = np.minimum(size * share, most[self._usable])
        return Allocation(levels, self._wrenches @ levels)

    def _correct_levels(self, levels: Array, target: Array, free: npt.NDArray[np.bool_]) -> Array:
        """Return nonnegative levels; the free ones are corrected to remove the target error."""
        columns = self._columns[:, free]
        corrected = levels.copy()
        corrected[free] += np.linalg.lstsq(columns, target - self._columns @ levels, rcond=None)[0]
        return np.maximum(corrected, 0.0)

    def _largest_part(self, target: Array, bounds: Array) -> Array:
        """Return the cheapest levels within bounds that produce the largest part of the target."""
        from scipy.optimize import linprog

        cost = np.append(self._cost[self._usable], -_WRENCH_WEIGHT)
        equations = np.column_stack([self._columns, -target])
        limits = [*((0.0, bound) for bound in bounds), (0.0, 1.0)]
        solution = linprog(cost, A_eq=equations, b_eq=np.zeros(6), bounds=limits).x
        levels, part = solution[:-1], solution[-1]
        inside = (levels > 0.0) & (levels < bounds)
        return np.minimum(self._correct_levels(levels, part * target, inside), bounds)


class ThrusterModulator:
    """Converts a desired wrench into thruster on-times, one control period at a time.

    This is a sigma-delta modulation with minimum pulse lengths; see docs/theory/thrusters.md. With
    the shortest on-time ``t`` and the period ``h``, ``allocation <= t + h - (remaining part of a
    shortest pulse)`` holds in every period if the desired wrench is achievable. A wrench beyond the
    available thrust is dropped and not compensated for later. A pulse begins at the start of a
    period and may end at any time within a period.

    Parameters
    ----------
    table
        The thrusters.
    control_period
        Time between calls of :meth:`fire`, s.
    excluded
        Names of thrusters never to be fired.

    Raises
    ------
    ParameterError
        There is no thruster with the name of an excluded thruster.
    """

    def __init__(
        self, table: ThrusterTable, control_period: float, excluded: Sequence[str] = ()
    ) -> None:
        self.table, self._control_period = table, control_period
        self._wrenches, self._shortest = table.wrenches, table.min_on_time
        count = len(table.names)
        # Rationally independent numbers, so that sums of costs differ, too.
        tie_break = 1.0 + TIE_BREAK * np.sin(np.arange(1.0, count + 1.0) ** 2)
        self.allocation = ThrusterAllocation(self._wrenches, table.mass_flow * tie_break)
        """Distributes wrenches over the thrusters."""
        self._remaining = np.zeros(count)
        """Remaining time of minimum pulses (m,), s."""
        self._open = np.zeros(count, dtype=np.bool_)
        """Whether each thruster (m,) remains open from the last period into the next."""
        self._excluded: tuple[str, ...] = ()
        self._missing = cache(table.missing)
        for name in excluded:
            self.exclude(name)
        self.unmet = np.zeros(6)
        """Part of the last desired wrench that the thrusters could not produce, N, N m."""
        self.unmet_periods = 0
        """Number of periods in which the thrusters could not produce the full wrench."""
        self.begun = np.zeros(count, dtype=np.bool_)
        """Whether a pulse of each thruster (m,) began in the last period."""
        self.pulses = np.zeros(count, dtype=np.int64)
        """Number of pulses of each thruster (m,) so far."""
        self.reset()

    @property
    def missing(self) -> str:
        """Names of the wrenches that the thrusters in use cannot produce; empty if they can produce
        all."""
        return self._missing(self._excluded)

    def exclude(self, name: str) -> None:
        """Stop using a (broken) thruster; the other thrusters produce the wrench if possible.

        Raises
        ------
        ParameterError
            There is no thruster with that name.
        """
        self.allocation.exclude(self.table.index(name))
        self._excluded += (name,)

    def reset(self) -> None:
        """Close all thrusters and drop the pending impulse; counters are kept."""
        self.pending_impulse = np.zeros(6)
        """Desired impulse (6,) that has not been fired yet, N s, N m s."""
        self._remaining[:] = 0.0
        self._open[:] = self.begun[:] = False
        self.unmet[:] = 0.0

    def fire(self, wrench: Array) -> Array:
        """Return the on-time of each thruster (m,) in the next period, s.

        ``wrench`` (6,) is force (N) and torque (N m) at the base link origin, in the base frame.
        """
        h = self._control_period
        wanted = self.pending_impulse + h * wrench
        shares = self.allocation.allocate(wanted, self._shortest + h - self._remaining)
        self.unmet[:] = (wanted - shares.achieved) / h
        self.unmet_periods += bool(np.any(np.abs(self.unmet) > _MIN_UNMET_WRENCH))
        on_time, added = self._pulses(shares.levels)
        self.pending_impulse = shares.achieved - self._wrenches @ added
        self.pulses += self.begun
        return on_time

    def _pulses(self, levels: Array) -> tuple[Array, Array]:
        """Return the on-times (m,) of a period, and the parts of ``levels`` used by pulses, s."""
        h, remaining = self._control_period, self._remaining
        levels = np.where(levels > _ROUNDING * h, levels, 0.0)
        whole = (levels > 0.0) & (levels >= (1.0 - _ROUNDING) * self._shortest)
        self.begun[:] = ~self._open & whole
        longer = np.minimum(levels, np.maximum(h - remaining, 0.0))
        new = np.where(self.begun, np.maximum(np.minimum(levels, h), self._shortest), 0.0)
        added = np.where(self._open, longer, new)
        on_time = np.minimum(remaining + added, h)
        rest = remaining + added - on_time
        self._remaining[:] = np.where(rest <= _ROUNDING * h, 0.0, rest)
        self._open[:] = on_time >= (1.0 - _ROUNDING) * h
        return on_time, added
