"""Content of scenario files, other parameter files and command line settings.

A scenario file is a ROS parameter file for the nodes of a flight, with a section for the goals.
This module reads parameters by node, and the goals, published figures and kills in that section.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from spacerobot_ros.bag import RecorderConfig
from spacerobot_ros.control.config import ControllerConfig
from spacerobot_ros.errors import GoalError, ParameterError, RobotDescriptionError, counted, reason
from spacerobot_ros.files import load_yaml, warn_once
from spacerobot_ros.model.urdf import load_world
from spacerobot_ros.parameters import as_numbers, declared, known_values
from spacerobot_ros.planning.core.goal import (
    POSE,
    Controlled,
    EndEffectorGoal,
    Goal,
    warn_of_large_angles,
)
from spacerobot_ros.planning.execution.config import PlannerConfig
from spacerobot_ros.resources import is_path, suggestion
from spacerobot_ros.simulation.config import PlantConfig
from spacerobot_ros.simulation.faults import line_refusal, parse_times
from spacerobot_ros.viewer.server import ViewerConfig

CONFIGS: Mapping[str, type[Any]] = {
    "plant": PlantConfig,
    "planner": PlannerConfig,
    "coordinated_control": ControllerConfig,
    "recorder": RecorderConfig,
    "viewer": ViewerConfig,
}
"""Configuration class of each configurable node."""

NODES = tuple(CONFIGS)

COMMANDERS = ("planner", "coordinated_control")
"""Nodes that accept goals; a scenario runs the nodes with a section in its file."""

GOAL_KEYS = ("goal", "end_effector_goal")
_SCENARIO_KEYS = (
    "description",
    "published",
    "published_method",
    "kills",
    "world",
    "goal_joint_positions",
    "goal_waypoints",
    "end_effector_goals",
    *(f"{goal}_{part}" for goal in GOAL_KEYS for part in ("position", "orientation", "rotvec")),
)


@dataclass(frozen=True)
class Published:
    """A published value for this scenario, for comparison with the measured value.

    ``quantity`` is a key in the run summary, or a gait note in the planner's status;
    ``note`` is a comment on the printed value (a misprint, an integration error).
    """

    quantity: str
    printed: list[float]
    note: str = ""


@dataclass(frozen=True)
class Kill:
    """A node that is killed at the simulated time ``at``, s, and stays offline until
    ``until``, s.
    """

    node: str
    at: float
    until: float


_POSITION: frozenset[Controlled] = frozenset({"position"})
_ATTITUDE: frozenset[Controlled] = frozenset({"attitude"})

KEYS_OF_PARTS: Mapping[Controlled, frozenset[str]] = {
    "position": frozenset({"goal_position"}),
    "attitude": frozenset({"goal_orientation", "goal_rotvec"}),
}
"""Keys in the scenario section that require a component of the base pose."""


# -- parameters by node and settings ------------------------------------------------------------


def read_sections(path: Path) -> dict[str, dict[str, Any]]:
    """Return the parameters in a parameter file, by node and full name.

    A section applies to a node in any namespace (``/**/plant``), in one namespace
    (``/robot_1/plant``), in no namespace (``plant``), or to all nodes (``/**``). If two sections
    set the same parameter, the later one takes precedence. A section for all nodes has the lowest
    precedence.

    Raises
    ------
    ParameterError
        The file cannot be read, or a section has no ``ros__parameters`` that contains parameters.
    """
    return _sections(_read_content(path), path)


def read_scenario(path: Path) -> tuple[dict[str, dict[str, Any]], dict[str, Any] | None]:
    """Return the parameters in a scenario file, as in :func:`read_sections`, and the values in its
    section ``scenario``; None: there is no such section, but the plant has a robot.

    Raises
    ------
    ParameterError
        See :func:`read_sections`; or the section is missing or has an unknown key.
    """
    content = _read_content(path)
    in_file, values = _sections(content, path), _scenario_values(content)
    plant = in_file.get("plant", {})
    if "scenario" not in content and (plant.get("robot") or plant.get("robot_description")):
        return in_file, None
    if not isinstance(values, dict):
        raise ParameterError(
            f"The scenario file {path} has no 'scenario: ros__parameters:' section with a goal."
        )
    unknown = sorted(set(map(str, values)) - set(_SCENARIO_KEYS))
    if unknown:
        raise ParameterError(
            f"The scenario file {path} has an unknown key '{unknown[0]}' in its scenario section; "
            f"the keys are {', '.join(_SCENARIO_KEYS)}."
        )
    return in_file, values


def _scenario_values(content: Mapping[str, Any]) -> Any:
    section = content.get("scenario")
    return section.get("ros__parameters") if isinstance(section, dict) else None


def _read_content(path: Path) -> Mapping[str, Any]:
    try:
        content = load_yaml(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ParameterError(
            f"The scenario file {path} cannot be read: {reason(error)}."
        ) from error
    return content if isinstance(content, dict) else {}


def _sections(content: Mapping[str, Any], path: Path) -> dict[str, dict[str, Any]]:
    by_node: dict[str, dict[str, Any]] = {}
    of_all_nodes: dict[str, Any] = {}
    for key, section in content.items():
        node = str(key).rpartition("/")[2]
        if node not in (*NODES, "**"):
            # Sections of other nodes are allowed, but this may be a misspelt name.
            if node != "scenario" and (meant := suggestion(node, (*NODES, "scenario"))):
                warn_once(f"The section '{key}' of {path} is of no node of this package.{meant}")
            continue
        section = {} if section is None else section
        values = section.get("ros__parameters", {}) if isinstance(section, dict) else None
        if not isinstance(values, dict):
            raise ParameterError(
                f"The section '{key}' of the scenario file {path} is not 'ros__parameters:' with "
                f"parameters under it."
            )
        chosen = of_all_nodes if node == "**" else by_node.setdefault(node, {})
        chosen.update(_flatten_section(values))
    known = {each.name for kind in CONFIGS.values() for each in declared(kind)}
    for name in of_all_nodes.keys() - known:
        # Parameters of other nodes are allowed, but this may be a misspelt name.
        if meant := suggestion(name, known, similarity=0.8):
            warn_once(f"No node of this package has the parameter '{name}' of {path}.{meant}")
    for node, values in by_node.items():
        parameters = by_node[node] = {**known_values(CONFIGS[node], of_all_nodes), **values}
        # Files next to the scenario file get their full paths.
        for name in ("robot", "world", "target.robot", "srdf", "thrusters"):
            file = parameters.get(name, "")
            named = isinstance(file, str) and (is_path(file) or name in ("srdf", "thrusters"))
            if named and (path.parent / file).is_file():
                parameters[name] = str((path.parent / file).resolve())
    values = _scenario_values(content)
    if isinstance(values, dict) and (world := values.get("world")) is not None:
        obstacles = (path.parent / str(world)).resolve()
        try:
            load_world(obstacles)
        except RobotDescriptionError as error:
            message = f"The world in the scenario file {path} is invalid: {error}"
            raise ParameterError(message) from None
        for node in by_node.keys() & {"plant", "planner"}:
            by_node[node] = {"world": str(obstacles), **by_node[node]}
    return by_node


def parse_setting(text: str) -> tuple[str, str, Any]:
    """Split ``node.parameter=value``; the value is read as YAML.

    Raises
    ------
    ParameterError
        The string has a different format, or does not name a node.
    """
    key, equals, value = text.partition("=")
    node, dot, name = key.strip().partition(".")
    if not equals or not dot or node not in NODES or not name:
        raise ParameterError(
            f"'{text}' is not node.parameter=value with one of the nodes {', '.join(NODES)}."
        )
    try:
        parsed = load_yaml(value)
    except ValueError:
        raise ParameterError(f"The value in '{text}' cannot be read.") from None
    return node, name, number_in(parsed) if isinstance(parsed, str) else parsed


def number_in(text: str) -> float | str:
    """Convert a string to a number if possible; unlike in YAML, 1e-3 is a number."""
    try:
        return float(text)
    except ValueError:
        return text


def _flatten_section(section: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return parameters by full name; a mapping within a section is a parameter group."""
    flat: dict[str, Any] = {}
    for key, value in section.items():
        if isinstance(value, dict):
            flat |= _flatten_section(value, f"{prefix}{key}.")
        else:
            flat[f"{prefix}{key}"] = value
    return flat


# -- goals, published figures and kills ---------------------------------------------------------


def changed_goal(
    before: Goal,
    pose: Goal | npt.ArrayLike | None = None,
    position: npt.ArrayLike | None = None,
    rotvec: npt.ArrayLike | None = None,
    rpy_deg: npt.ArrayLike | None = None,
) -> Goal:
    """Return a goal for the base, with the remaining parts of another goal.

    Parameters
    ----------
    before
        The other goal; its end-effector goals and waypoints are dropped.
    pose
        A goal, a pose (7,), a part of which may be NaN (not requested), or a position (3,), m.
    position, rotvec, rpy_deg
        Position (3,), m, and attitude (3,) as a rotation vector (rad), or as roll, pitch and yaw
        about fixed axes (deg); they override ``pose``.

    Raises
    ------
    GoalError
        The pose requests nothing, or a part of it is not finite, or the attitude is given twice.
    """
    if rotvec is not None and rpy_deg is not None:
        raise GoalError("The goal attitude is given twice, in radians and in degrees.")
    made = replace(before, end_effectors=(), base=POSE, waypoints=None)
    if isinstance(pose, Goal):
        made = pose
    elif pose is not None:
        numbers = as_numbers(pose, "The goal", GoalError).reshape(-1)
        if len(numbers) not in (3, 7):
            raise GoalError(
                "A goal must have 3 numbers (position) or 7 (position and quaternion), not "
                f"{len(numbers)}."
            )
        whole = len(numbers) == 7
        given = (
            Goal.received(numbers[:3].tolist(), numbers[3:].tolist())
            if whole
            else Goal.checked(numbers[:3], before.quaternion)
        )
        asked = given.asked if whole else before.asked | _POSITION
        made = replace(made, position=given.position, quaternion=given.quaternion, asked=asked)
    if position is not None:
        place = as_numbers(position, "The position", GoalError).reshape(-1)
        given = Goal.checked(place, made.quaternion)
        made = replace(made, position=given.position, asked=made.asked | _POSITION)
    if rotvec is not None:
        turn = as_numbers(rotvec, "The rotvec", GoalError).reshape(-1)
        given = Goal.from_rotvec(made.position, turn.tolist())
        warn_of_large_angles(turn)
    elif rpy_deg is not None:
        given = Goal.from_rpy(made.position, rpy_deg)
    else:
        return made
    return replace(made, quaternion=given.quaternion, asked=made.asked | _ATTITUDE)


def parse_kills(lines: object, where: str) -> tuple[Kill, ...]:
    """Parse kills from lines ``NODE at SECONDS [until SECONDS]``, sorted by time.

    Raises
    ------
    ParameterError
        A line has a different format, its node cannot be killed, or its times are not in ascending
        order.
    """
    if not isinstance(lines, list):
        raise ParameterError(
            f"'kills' in {where} is {lines!r}, not a list of lines NODE at SECONDS."
        )
    kills = []
    for line in map(str, lines):
        refusal = line_refusal(line, f"kill in {where}")
        node, *words = line.split() or [""]
        if node not in ("plant", *COMMANDERS):
            raise refusal(f"its node is one of {', '.join(('plant', *COMMANDERS))}")
        if words[:1] != ["at"]:
            raise refusal("it must be NODE at SECONDS [until SECONDS]")
        kills.append(Kill(node, *parse_times(words, node, 0.0, refusal)))
    return tuple(sorted(kills, key=lambda kill: kill.at))


def parse_published(rows: Any, path: Path) -> tuple[Published, ...]:
    """Return the published figures of a scenario section."""
    try:
        return tuple(
            Published(quantity, [float(x) for x in row["printed"]], str(row.get("note", "")))
            for quantity, row in rows.items()
        )
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise ParameterError(
            f"The section 'published' in the scenario file {path} is not "
            f"quantity: {{printed: [numbers], note: text}}: {error!r}."
        ) from error


def parse_goals(values: Mapping[str, Any], path: Path) -> tuple[Goal, Goal | None]:
    """Return the goal and the end-effector goal, if any, of a scenario section."""
    try:
        goal = _parse_pose("goal", values)
        asked = frozenset(
            part for part, keys in KEYS_OF_PARTS.items() if not keys.isdisjoint(values)
        )
        goal = replace(goal, asked=asked)
        if numbers := values.get("goal_waypoints"):
            if len(numbers) % 7:
                raise GoalError(
                    f"goal_waypoints has {counted(len(numbers), 'number')}; each pose has 7."
                )
            poses = np.vstack([np.reshape(numbers, (-1, 7)), goal.path_values])
            goal = replace(goal, waypoints=Goal.through(poses).waypoints, asked=POSE)
        if links := values.get("end_effector_goals", {}):
            if not isinstance(links, Mapping):
                raise TypeError(f"end_effector_goals must map names to poses, not {links!r}.")
            goals = [EndEffectorGoal.of_numbers(str(link), pose) for link, pose in links.items()]
            hands = Goal.of_end_effectors(goals).end_effectors
            goal = replace(goal, end_effectors=hands, base=POSE if asked else frozenset())
        has_other = any(key.startswith("end_effector_goal_") for key in values)
        return goal, _parse_pose("end_effector_goal", values) if has_other else None
    except (GoalError, ValueError, TypeError, AttributeError) as error:
        raise ParameterError(f"The goal in the scenario file {path} is invalid: {error}") from error


def _parse_pose(name: str, values: Mapping[str, Any]) -> Goal:
    position = values.get(f"{name}_position", [0.0, 0.0, 0.0])
    orientation = values.get(f"{name}_orientation", [0.0, 0.0, 0.0, 1.0])
    if f"{name}_rotvec" in values:
        if f"{name}_orientation" in values:
            raise GoalError(f"{name}_orientation and {name}_rotvec are both given: remove one.")
        orientation = Goal.from_rotvec(position, values[f"{name}_rotvec"]).quaternion
        warn_of_large_angles(values[f"{name}_rotvec"])
    return Goal.checked(position, orientation, values.get(f"{name}_joint_positions"))
