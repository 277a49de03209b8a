"""Help texts of the command line."""

from __future__ import annotations

import click
import pytest
from support.command_line import CliRunner

from spacerobot_ros.cli.campaign import campaign_command
from spacerobot_ros.cli.main import COMMANDS, CommandGroup, main


def commands() -> dict[str, click.Command]:
    """Return every command by its words."""
    group, context = CommandGroup(), click.Context(main, **main.context_settings)
    found = {name: group.get_command(context, name) for name in COMMANDS}
    return {
        **{name: each for name, each in found.items() if each is not None},
        **{f"campaign {name}": each for name, each in campaign_command.commands.items()},
    }


def test_every_option_says_what_it_does() -> None:
    options = {
        f"{words} {option.opts[0]}": option
        for words, each in commands().items()
        for option in each.params
        if isinstance(option, click.Option)
    }
    assert len(options) > 60
    assert [name for name, option in options.items() if not option.help] == []
    # Each sentence stands for itself: the option before it may be looked at on another day.
    assert [name for name, option in options.items() if (option.help or "").startswith(".")] == []


@pytest.mark.parametrize("words", [[], ["campaign"]])
def test_the_list_of_commands_has_whole_sentences(words: list[str]) -> None:
    listed = CliRunner().invoke(main, [*words, "--help"]).output.partition("Commands:\n")[2]
    assert listed
    for line in listed.splitlines():
        assert line.endswith("."), line
        assert not line.endswith("..."), line


@pytest.mark.parametrize("word", ["-h", "--help"])
def test_the_help_of_campaigns_is_that_of_all_their_commands(word: str) -> None:
    shown = CliRunner().invoke(main, ["campaign", word]).output
    assert all(f"\n  {name} " in shown for name in ("fly", "report", "rerun"))
