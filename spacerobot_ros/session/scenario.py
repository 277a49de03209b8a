"""Scenarios: ROS parameter files with a section that says what is to be reached."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from spacerobot_ros.errors import ParameterError, PlanningError
from spacerobot_ros.model.rotations import quaternion_from_rotvec
from spacerobot_ros.planning import Goal
from spacerobot_ros.resources import resource_names, share_directory
from spacerobot_ros.session.kills import Kill, parse_kills

NODES = ("plant", "planner", "coordinated_control", "recorder")
"""The nodes that a scenario may set parameters of."""

COMMANDERS = ("planner", "coordinated_control")
"""Those of them that take goals; a scenario runs the ones its file has a section for."""

_LARGEST_ANGLE = 2e6 * np.pi
"""A million turns: beyond them the digits of an angle are not its attitude's any more, rad."""

_GOALS = ("goal", "end_effector_goal")
_KEYS = (
    "description",
    "published",
    "published_method",
    "kills",
    "goal_joint_positions",
    *(f"{goal}_{part}" for goal in _GOALS for part in ("position", "orientation", "rotvec")),
)


@dataclass(frozen=True)
class Published:
    """A figure that a publication prints for this scenario, to stand beside the measured one.

    ``quantity`` is a key of the run's summary, or a value of the planner's status; ``note`` says
    what is known about the printed figure (a misprint, an integration error).
    """

    quantity: str
    printed: list[float]
    note: str = ""


@dataclass(frozen=True)
class Scenario:
    """A parameter file and its goals; ``overrides``, parameters by node, go before the file's,
    ``in_file``.

    ``published_method`` is the gait method that the published figures are of, empty: any.
    ``goal`` is of the base, ``end_effector_goal`` of the end-effector; ``commanders`` are the nodes
    that fly there, ``kills`` what happens to nodes on the way.
    """

    name: str
    path: Path
    description: str
    goal: Goal
    end_effector_goal: Goal | None
    commanders: tuple[str, ...]
    published: tuple[Published, ...]
    published_method: str
    kills: tuple[Kill, ...]
    in_file: Mapping[str, Mapping[str, Any]]
    overrides: Mapping[str, Mapping[str, Any]]

    @property
    def lockstep(self) -> bool:
        """Whether the plant waits for commands instead of the wall clock (unless overridden)."""
        return self.overrides.get("plant", {}).get("time_mode", "lockstep") == "lockstep"

    @property
    def comparable(self) -> tuple[Published, ...]:
        """The published figures, where the method that they are of is flown."""
        method = self.parameter("planner", "method", "")
        return self.published if self.published_method in ("", method) else ()

    def parameter(self, node: str, name: str, default: Any) -> Any:
        """Return what a node's parameter is set to, by the overrides or the file."""
        return self.parameters(node).get(name, default)

    def parameters(self, node: str) -> dict[str, Any]:
        """Return what is set of a node, by the overrides or the file."""
        return {**self.in_file.get(node, {}), **self.overrides.get(node, {})}

    def with_overrides(self, node: str, values: Mapping[str, Any]) -> Scenario:
        """Return the scenario with more parameters of one node set."""
        merged = {**self.overrides, node: {**self.overrides.get(node, {}), **values}}
        return replace(self, overrides=merged)

    def in_real_time(self, factor: float) -> Scenario:
        """Return the scenario on the wall clock times a factor, planned beside the flight."""
        pace = {"time_mode": "realtime", "real_time_factor": factor}
        scenario = self.with_overrides("plant", pace)
        if "planner" in self.commanders:
            scenario = scenario.with_overrides("planner", {"plan_in_background": True})
        return scenario.with_overrides("recorder", {"diagnostics_period": 1.0})

    def with_settings(self, texts: Sequence[str]) -> Scenario:
        """Return the scenario with ``node.parameter=value`` set, each as :func:`parse_setting`.

        Raises
        ------
        ParameterError
            A text has another form, or names no node.
        """
        scenario = self
        for text in texts:
            node, name, value = parse_setting(text)
            scenario = scenario.with_overrides(node, {name: value})
        return scenario


def load_scenario(name: str) -> Scenario:
    """Return a scenario of this package by name, or of any parameter file by path.

    Raises
    ------
    ParameterError
        There is no such scenario, or its file is broken; the sentence names it.
    """
    path = Path(name)
    if path.suffix not in (".yaml", ".yml"):
        path = share_directory() / "config" / f"{name}.yaml"
    if not path.is_file():
        known = ", ".join(scenario_names())
        raise ParameterError(
            f"There is no scenario '{name}'; there are: {known}, or any YAML file."
        )
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        reason = " ".join(str(error).split())
        raise ParameterError(f"The scenario file {path} cannot be read: {reason}.") from error
    section = content.get("scenario") if isinstance(content, dict) else None
    values = section.get("ros__parameters") if isinstance(section, dict) else None
    if not isinstance(values, dict):
        raise ParameterError(
            f"The scenario file {path} has no 'scenario: ros__parameters:' section with a goal."
        )
    for node in NODES:
        given = content.get(node)
        if given is not None and not (
            isinstance(given, dict) and isinstance(given.get("ros__parameters", {}), dict)
        ):
            raise ParameterError(
                f"The section '{node}' of the scenario file {path} is not 'ros__parameters:' with "
                "the parameters under it."
            )
    unknown = sorted(set(map(str, values)) - set(_KEYS))
    if unknown:
        raise ParameterError(
            f"The scenario file {path} has an unknown key '{unknown[0]}' in its scenario section; "
            f"it takes {', '.join(_KEYS)}."
        )
    return Scenario(
        name=path.stem,
        path=path.resolve(),
        description=str(values.get("description", "")),
        goal=_goal("goal", values, path),
        end_effector_goal=(
            _goal("end_effector_goal", values, path)
            if any(key.startswith("end_effector_goal") for key in values)
            else None
        ),
        commanders=tuple(name for name in COMMANDERS if name in content) or ("planner",),
        published=_published(values.get("published", {}), path),
        published_method=str(values.get("published_method", "")),
        kills=parse_kills(values.get("kills", []), ("plant", *COMMANDERS), f"the file {path}"),
        in_file={
            node: content[node].get("ros__parameters", {}) for node in NODES if content.get(node)
        },
        overrides={},
    )


def scenario_names() -> list[str]:
    """Return the names of the scenarios that come with the package."""
    return resource_names("config", ".yaml")


def goal_from_rotvec(position: Sequence[float], rotvec: Sequence[float]) -> Goal:
    """Return the goal at a position (m) with the attitude ``exp(hat(rotvec))`` (rad).

    Raises
    ------
    PlanningError
        It is no goal, or the rotation vector is not three numbers of at most a million turns.
    """
    try:
        vector = np.asarray(rotvec, dtype=float)
    except (TypeError, ValueError, OverflowError):
        vector = np.full(3, np.nan)
    if vector.shape != (3,) or not np.all(np.abs(vector) <= _LARGEST_ANGLE):
        raise PlanningError(
            f"The rotation vector {rotvec} is not three finite numbers of at most "
            f"{_LARGEST_ANGLE:.2g} rad."
        )
    return Goal.checked(position, quaternion_from_rotvec(vector))


def parse_setting(text: str) -> tuple[str, str, Any]:
    """Split ``node.parameter=value``; the value is read as YAML.

    Raises
    ------
    ParameterError
        The text has another form, or names no node.
    """
    key, equals, value = text.partition("=")
    node, dot, name = key.strip().partition(".")
    if not equals or not dot or node not in NODES or not name:
        raise ParameterError(
            f"'{text}' is not node.parameter=value with one of the nodes {', '.join(NODES)}."
        )
    try:
        parsed = yaml.safe_load(value)
    except yaml.YAMLError:
        raise ParameterError(f"The value in '{text}' cannot be read.") from None
    if isinstance(parsed, str):
        # YAML wants a dot in 1e-3; people do not write it.
        try:
            return node, name, float(parsed)
        except ValueError:
            return node, name, parsed
    return node, name, parsed


def _published(rows: Any, path: Path) -> tuple[Published, ...]:
    try:
        return tuple(
            Published(quantity, [float(x) for x in row["printed"]], str(row.get("note", "")))
            for quantity, row in rows.items()
        )
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise ParameterError(
            f"The section 'published' of the scenario file {path} is not "
            f"quantity: {{printed: [numbers], note: text}}: {error!r}."
        ) from error


def _goal(name: str, values: Mapping[str, Any], path: Path) -> Goal:
    try:
        position = values.get(f"{name}_position", [0.0, 0.0, 0.0])
        orientation = values.get(f"{name}_orientation", [0.0, 0.0, 0.0, 1.0])
        if f"{name}_rotvec" in values:
            orientation = goal_from_rotvec(position, values[f"{name}_rotvec"]).quaternion
        return Goal.checked(position, orientation, values.get(f"{name}_joint_positions"))
    except (PlanningError, ValueError, TypeError) as error:
        raise ParameterError(f"The goal of the scenario file {path} is refused: {error}") from error
