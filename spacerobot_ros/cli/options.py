"""Arguments and options that several commands take."""

from __future__ import annotations

import json
from collections.abc import Iterable
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    _Choice = click.Choice[str]
else:  # Generic in new versions only.
    _Choice = click.Choice

PATH = click.Path(path_type=Path)

bag_argument = click.argument("bag", type=PATH)
pose_option = click.option(
    "--goal", nargs=7, type=float, metavar="X Y Z QX QY QZ QW", help="Goal pose (m, quaternion)."
)
rotvec_option = click.option(
    "--goal-rotvec",
    nargs=3,
    type=float,
    metavar="RX RY RZ",
    help="Attitude of the goal as exponential coordinates (rad).",
)
settings_option = click.option("--set", "settings", multiple=True, metavar="NODE.PARAMETER=VALUE")


class Registered(_Choice):
    """A choice of the names in registries, which are imported only where the names are needed.

    Parameters
    ----------
    registries
        Mappings as ``module:attribute``.
    """

    def __init__(self, *registries: str) -> None:
        super().__init__(())
        del self.choices
        self._registries = registries

    @cached_property
    def choices(self) -> tuple[str, ...]:  # type: ignore[override]
        """The names in alphabetical order."""
        names: set[str] = set()
        for registry in self._registries:
            module, _, attribute = registry.partition(":")
            names |= set(getattr(import_module(module), attribute))
        return tuple(sorted(names))


METHODS = "spacerobot_ros.planning.methods.registry:METHODS"
LAWS = "spacerobot_ros.control.laws.registry:LAWS"


def json_option(help: str) -> Any:
    """Return the option ``--json``."""
    return click.option("--json", "json_file", type=PATH, help=help)


def write(path: Path, content: bytes) -> None:
    """Write a file and the folders that it is in."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)


def write_json(path: Path, content: Any, indent: int | None = 2) -> None:
    """Write a JSON file and the folders that it is in."""
    write(path, (json.dumps(content, indent=indent) + "\n").encode())


def numbers(values: Iterable[float], digits: int = 5) -> str:
    """Return numbers for people."""
    return ", ".join(f"{x:.{digits}f}" for x in values)
