"""The thrusters of a robot: where they sit, which way they push, how hard, for how long at least.

A table is read from ``<thruster>`` elements of a URDF, which other programs pass over, or from a
YAML file; docs/theory/thrusters.md shows both.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from spacerobot_ros.errors import ParameterError, RobotDescriptionError, SpaceRobotError
from spacerobot_ros.model.description import Array, Pose, RobotDescription
from spacerobot_ros.model.rotations import matrix_from_rpy

STANDARD_GRAVITY = 9.80665
"""What a specific impulse in seconds is counted in, m/s^2."""

IN_URDF = "urdf"
"""Source of a table that is in no file of its own."""

_LARGEST = 1e12
"""Largest number that a table may have, in SI units."""

_AXES = ("force along x", "force along y", "force along z", *(f"torque about {x}" for x in "xyz"))
_KEYS = {"name", "link", "position", "rpy", "direction", "force", "min_on_time", "isp"}


@dataclass(frozen=True)
class ThrusterTable:
    """Thrusters on the base, m of them.

    ``r_B`` (m, 3) is where each pushes, from the origin of the base link, m; ``direction_B`` (m, 3)
    the unit vector of its force on the base, against its plume; ``force`` (m,) its thrust, N;
    ``min_on_time`` (m,) its shortest pulse, s; ``isp`` (m,) its specific impulse, s.
    """

    names: tuple[str, ...]
    r_B: Array
    direction_B: Array
    force: Array
    min_on_time: Array
    isp: Array

    @property
    def wrenches(self) -> Array:
        """Columns (6, m): force (N) over torque (N m) of each at full thrust, at the origin of the
        base link, in base components.
        """
        thrust_B = self.direction_B * self.force[:, None]
        return np.vstack([thrust_B.T, np.cross(self.r_B, thrust_B).T])

    @property
    def mass_flow(self) -> Array:
        """Propellant that each takes while it is on (m,), kg/s: ``F / (g0 Isp)``."""
        return self.force / (STANDARD_GRAVITY * self.isp)

    def index(self, name: str) -> int:
        """Return the place of a thruster in the table.

        Raises
        ------
        ParameterError
            There is none of that name.
        """
        if name not in self.names:
            raise ParameterError(
                f"There is no thruster '{name}'; there are {', '.join(self.names)}."
            )
        return self.names.index(name)

    def missing(self, without: Sequence[str] = ()) -> str:
        """Say which wrenches the thrusters, but for some names, cannot give; empty for none.

        They give every wrench if, with factors of zero or more, they give both ways along the six
        axes: what they give is a convex cone.
        """
        # Imported where it is used: scipy.optimize loads slowly.
        from scipy.optimize import linprog

        kept = [i for i, name in enumerate(self.names) if name not in without]
        if not kept:
            return "any wrench"
        wrenches = self.wrenches[:, kept]
        wrenches = wrenches / np.linalg.norm(wrenches, axis=0)
        lacking = []
        for axis, name in enumerate(_AXES):
            for sign, text in ((1.0, name), (-1.0, f"negative {name}")):
                wanted = np.zeros(6)
                wanted[axis] = sign
                if not linprog(np.ones(len(kept)), A_eq=wrenches, b_eq=wanted).success:
                    lacking.append(text)
        return ", ".join(lacking)


def find_thrusters(source: str, robot: RobotDescription) -> ThrusterTable:
    """Return the table at :data:`IN_URDF` or in the YAML file of a path.

    Raises
    ------
    ParameterError
        The file or a thruster in it is refused.
    RobotDescriptionError
        A thruster of the URDF is refused, or there is none.
    """
    return thrusters_of_urdf(robot) if source == IN_URDF else load_thrusters(source, robot)


def thrusters_of_urdf(robot: RobotDescription) -> ThrusterTable:
    """Read the ``<thruster>`` elements of the robot's URDF.

    Raises
    ------
    RobotDescriptionError
        There are none, or one is refused.
    """
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
    try:
        return thruster_table(entries, robot)
    except ParameterError as error:
        raise RobotDescriptionError(f"The URDF of robot '{robot.name}': {error}") from error


def load_thrusters(path: str | Path, robot: RobotDescription) -> ThrusterTable:
    """Read a YAML file: a list ``thrusters`` and, for what they have in common, ``defaults``.

    Raises
    ------
    ParameterError
        The file cannot be read, or a thruster is refused.
    """
    try:
        content = yaml.safe_load(Path(path).read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        reason = " ".join(str(error).split())
        raise ParameterError(f"The thruster file {path} cannot be read: {reason}.") from error
    entries = content.get("thrusters") if isinstance(content, dict) else None
    defaults = content.get("defaults", {}) if isinstance(content, dict) else {}
    if not (isinstance(entries, list) and entries and isinstance(defaults, dict)):
        raise ParameterError(
            f"The thruster file {path} has no list 'thrusters', or its 'defaults' are no mapping."
        )
    try:
        if not all(isinstance(entry, dict) for entry in entries):
            raise ParameterError("An entry of 'thrusters' is no mapping.")
        return thruster_table([{**defaults, **entry} for entry in entries], robot)
    except SpaceRobotError as error:
        raise ParameterError(f"{path}: {error}") from error


def thruster_table(entries: Sequence[Mapping[str, Any]], robot: RobotDescription) -> ThrusterTable:
    """Check thrusters and express them in the base link.

    Each has ``name``, ``position`` (m) and ``direction`` of its force, both in the frame that
    ``link`` (the base link unless given) and ``rpy`` (rad) define, ``force`` (N), ``isp`` (s) and
    ``min_on_time`` (s, 0 unless given). A direction is x unless given, as the axis of a joint is.

    Raises
    ------
    ParameterError
        Something is missing, unknown, not finite or not positive, or a link moves on the base.
    """
    names: list[str] = []
    rows: list[Array] = []
    for entry in entries:
        name = str(entry.get("name", ""))
        where = f"thruster '{name}'"
        if not name or name in names:
            problem = "is used twice; names are unique" if name else "is missing"
            raise ParameterError(f"The name of {where if name else 'a thruster'} {problem}.")
        unknown = sorted(set(entry) - _KEYS)
        if unknown:
            raise ParameterError(
                f"The {where} has '{unknown[0]}'; known are {', '.join(sorted(_KEYS))}."
            )
        mount = _mount(str(entry.get("link", robot.base_link)), robot, where)
        frame = Pose(
            matrix_from_rpy(_vector(entry, "rpy", where, (0.0, 0.0, 0.0))),
            _vector(entry, "position", where),
        )
        pose = mount @ frame
        direction = _vector(entry, "direction", where, (1.0, 0.0, 0.0))
        length = float(np.linalg.norm(direction))
        if length < 1e-9:
            raise ParameterError(f"The direction of {where} is zero; say which way it pushes.")
        numbers = [
            _number(entry, key, where, positive=key != "min_on_time")
            for key in ("force", "min_on_time", "isp")
        ]
        names.append(name)
        rows.append(np.concatenate([pose.r, pose.R @ direction / length, numbers]))
    table = np.array(rows)
    return ThrusterTable(
        tuple(names), table[:, :3], table[:, 3:6], table[:, 6], table[:, 7], table[:, 8]
    )


def _mount(link: str, robot: RobotDescription, where: str) -> Pose:
    if link not in robot.frames:
        raise ParameterError(f"The link of {where} is '{link}', but there is no such link.")
    body, pose = robot.frames[link]
    if body:
        raise ParameterError(
            f"The {where} is on link '{link}', which joints move; thrusters are fixed to the base "
            f"'{robot.base_link}'."
        )
    return pose


def _vector(
    entry: Mapping[str, Any], key: str, where: str, default: Sequence[float] | None = None
) -> Array:
    try:
        vector = np.array([float(x) for x in entry.get(key, default)])
    except (TypeError, ValueError):
        vector = np.empty(0)
    # Larger numbers are slips, and their squares overflow.
    if vector.shape != (3,) or not np.all(np.abs(vector) <= _LARGEST):
        raise ParameterError(
            f"The {key} of {where} is {entry.get(key, 'missing')}; it must be three finite numbers "
            f"of at most {_LARGEST:g}."
        )
    return vector


def _number(entry: Mapping[str, Any], key: str, where: str, *, positive: bool) -> float:
    given = entry.get(key, None if positive else 0.0)
    try:
        value = float(given)
    except (TypeError, ValueError):
        value = math.nan
    if not 0 <= value <= _LARGEST or (positive and value < 1 / _LARGEST):
        wanted = "a positive number" if positive else "zero or more"
        if value > _LARGEST:
            wanted += f" up to {_LARGEST:g}"
        raise ParameterError(
            f"The {key} of {where} is {'missing' if given is None else given}; it must be {wanted}."
        )
    return value
