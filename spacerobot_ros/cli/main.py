"""The command ``spacerobot``."""

from __future__ import annotations

import os
import shlex
from importlib import import_module
from pathlib import Path
from typing import Any

import click

from spacerobot_ros.cli import start
from spacerobot_ros.cli.terminal import sentences
from spacerobot_ros.resources import __version__

_COMMAND_NAMES_BY_MODULE = {
    "bags": ("export", "figures", "replay", "report", "salvage", "verify"),
    "campaign": ("campaign",),
    "flights": ("goal", "request", "run", "scenarios", "up"),
    "plan": ("plan",),
    "robots": ("analyze", "new", "robots"),
}
"""Names of the commands in each module of this folder: ``NAME_command`` is the attribute."""

COMMANDS: dict[str, str] = dict(
    sorted((name, module) for module, names in _COMMAND_NAMES_BY_MODULE.items() for name in names)
)
"""Modules by command name."""


class CommandGroup(click.Group):
    """Command group that loads a command on first use and reports errors as one sentence."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names of all commands."""
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Return a command by name, or None if it does not exist."""
        if cmd_name not in COMMANDS:
            return None
        module = import_module(f"spacerobot_ros.cli.{COMMANDS[cmd_name]}")
        command: click.Command = getattr(module, f"{cmd_name}_command")
        return command

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command named in the arguments."""
        with sentences():
            return super().invoke(ctx)


@click.group(
    cls=CommandGroup,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)
@click.version_option(__version__, prog_name="spacerobot")
@click.option(
    "--plugin",
    "plugins",
    type=click.Path(exists=True, dir_okay=False, path_type=Path),
    multiple=True,
    metavar="FILE.py",
    help="Python file with custom control laws or gait methods, for all commands; nodes load the "
    "files listed in SPACEROBOT_PLUGINS. May be repeated.",
)
@click.option(
    "--xacro-arg",
    "xacro_arguments",
    multiple=True,
    metavar="NAME:=VALUE",
    help="Argument for xacro files, for all commands; nodes read them from SPACEROBOT_XACRO_ARGS. "
    "May be repeated.",
)
def main(plugins: tuple[Path, ...], xacro_arguments: tuple[str, ...]) -> None:
    """Plan, fly, record and report the motion of free-floating space robots with ROS 2."""
    if xacro_arguments:
        from spacerobot_ros.model.urdf import XACRO_ARGUMENTS_VARIABLE

        os.environ[XACRO_ARGUMENTS_VARIABLE] = shlex.join(xacro_arguments)
    if plugins:
        from spacerobot_ros.registry import add_plugin

        for file in plugins:
            add_plugin(file)


if __name__ == "__main__":
    start()
