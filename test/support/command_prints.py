"""What users type: the commands with their arguments, options, ranges and defaults."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import click

from spacerobot_ros.cli.main import main
from spacerobot_ros.topics import TOPICS


def command_prints() -> dict[str, Any]:
    """Return every command by its words, with its parameters by name."""
    context = click.Context(main)
    found: dict[str, Any] = {}
    for name in main.list_commands(context):
        command = main.get_command(context, name)
        assert command is not None
        found |= dict(_prints_of(name, command))
    return found


def topic_prints() -> dict[str, Any]:
    """Return every topic by its name, without its texts, in their order."""
    texts = ("meaning", "when")
    return {
        name: {key: value for key, value in asdict(topic).items() if key not in texts}
        for name, topic in TOPICS.items()
    }


def _prints_of(words: str, command: click.Command) -> list[tuple[str, Any]]:
    parameters = {each.name: _parameter(each) for each in command.params if each.name is not None}
    found: list[tuple[str, Any]] = [(words, parameters)]
    if isinstance(command, click.Group):
        for name, part in command.commands.items():
            found += _prints_of(f"{words} {name}", part)
    return found


def _parameter(parameter: click.Parameter) -> dict[str, Any]:
    kind: Any = parameter.type
    found = {
        "names": [*parameter.opts, *parameter.secondary_opts],
        "type": type(kind).__name__,
        "numbers": parameter.nargs,
        "metavar": parameter.metavar,
        "required": parameter.required,
    }
    default = parameter.default
    # Versions of click differ in what stands for no default.
    if isinstance(default, str | bool | int | float | tuple):
        found["default"] = str(default)
    if isinstance(kind, click.Choice):
        found["choices"] = list(kind.choices)
    if isinstance(kind, click.IntRange | click.FloatRange):
        found["range"] = [str(kind.min), str(kind.max), kind.min_open, kind.max_open]
    if isinstance(parameter, click.Option):
        found |= {"multiple": parameter.multiple, "flag": parameter.is_flag}
        if isinstance(parameter.flag_value, str | int | float):
            found["flag_value"] = str(parameter.flag_value)
    return found
