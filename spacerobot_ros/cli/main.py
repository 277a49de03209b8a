"""The command ``spacerobot``."""

from __future__ import annotations

from importlib import import_module
from typing import Any

import click

from spacerobot_ros.cli import start
from spacerobot_ros.cli.errors import sentences
from spacerobot_ros.version import __version__

COMMANDS = (
    *("analyze", "bench", "campaign", "export", "figures", "goal", "library", "new", "plan"),
    *("replay", "report", "robots", "run", "salvage", "scenarios", "up", "verify"),
)
"""Each is the attribute ``command`` of the module of its name in this folder."""


class CommandGroup(click.Group):
    """Loads a command when it is used, and ends it with a sentence where its input is refused."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names of all commands."""
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Return a command by its name, None where there is none."""
        if cmd_name not in COMMANDS:
            return None
        command: click.Command = import_module(f"spacerobot_ros.cli.{cmd_name}").command
        return command

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command that the words name."""
        with sentences():
            return super().invoke(ctx)


@click.group(
    cls=CommandGroup,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)
@click.version_option(__version__, prog_name="spacerobot")
def main() -> None:
    """Plan, fly, record and report the motion of free-floating space robots with ROS 2."""


if __name__ == "__main__":
    start()
