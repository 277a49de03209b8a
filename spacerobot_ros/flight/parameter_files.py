"""ROS parameter files and settings of the command line, for the nodes that a scenario may set."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from spacerobot_ros.bag.config import RecorderConfig
from spacerobot_ros.control.config import ControllerConfig
from spacerobot_ros.errors import ParameterError
from spacerobot_ros.parameters import declared
from spacerobot_ros.planning.execution.config import PlannerConfig
from spacerobot_ros.simulation.config import PlantConfig
from spacerobot_ros.viewer.server import ViewerConfig

CONFIGS: Mapping[str, type[Any]] = {
    "plant": PlantConfig,
    "planner": PlannerConfig,
    "coordinated_control": ControllerConfig,
    "recorder": RecorderConfig,
    "viewer": ViewerConfig,
}
"""The nodes that a scenario may set parameters of, and what declares these parameters."""

NODES = tuple(CONFIGS)


def read_sections(path: Path) -> dict[str, dict[str, Any]]:
    """Return the parameters by node and full name that a parameter file has.

    A section is for a node in any namespace (``/**/plant``), in one (``/robot_1/plant``), in none
    (``plant``), or for all nodes (``/**``); of two that set a parameter the later one counts, and
    the one for all nodes counts least.

    Raises
    ------
    ParameterError
        The file cannot be read, or a section has no ``ros__parameters`` with parameters under it.
    """
    return sections_of(read_content(path), path)


def read_content(path: Path) -> dict[Any, Any]:
    """Return the content of a parameter file; empty where the file is no mapping.

    Raises
    ------
    ParameterError
        The file cannot be read.
    """
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        reason = " ".join(str(error).split())
        raise ParameterError(f"The scenario file {path} cannot be read: {reason}.") from error
    return content if isinstance(content, dict) else {}


def sections_of(content: Mapping[str, Any], path: Path) -> dict[str, dict[str, Any]]:
    """Return what :func:`read_sections` does, of a content that was read.

    Raises
    ------
    ParameterError
        A section has no ``ros__parameters`` with parameters under it.
    """
    found: dict[str, dict[str, Any]] = {}
    of_all: dict[str, Any] = {}
    for key, given in content.items():
        node = str(key).rpartition("/")[2]
        if node not in (*NODES, "**"):
            continue
        given = {} if given is None else given
        values = given.get("ros__parameters", {}) if isinstance(given, dict) else None
        if not isinstance(values, dict):
            raise ParameterError(
                f"The section '{key}' of the scenario file {path} is not 'ros__parameters:' with "
                "the parameters under it."
            )
        (of_all if node == "**" else found.setdefault(node, {})).update(_flat(values))
    for node, values in found.items():
        known = {parameter.name for parameter in declared(CONFIGS[node])}
        shared = {name: value for name, value in of_all.items() if name in known}
        found[node] = {**shared, **values}
    return found


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
    return node, name, number_in(parsed) if isinstance(parsed, str) else parsed


def number_in(text: str) -> float | str:
    """Return the number in a text, if it is one: YAML wants a dot in 1e-3, people do not."""
    try:
        return float(text)
    except ValueError:
        return text


def _flat(section: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return parameters by full name: a map within a section is a group of them."""
    flat: dict[str, Any] = {}
    for key, value in section.items():
        if isinstance(value, dict):
            flat |= _flat(value, f"{prefix}{key}.")
        else:
            flat[f"{prefix}{key}"] = value
    return flat
