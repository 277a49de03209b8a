"""Help texts of the command line, and names of commands that are deprecated."""

from __future__ import annotations

import click
import pytest
from support.command_line import CliRunner

from spacerobot_ros.cli.bench import bench_command
from spacerobot_ros.cli.campaign import campaign_command
from spacerobot_ros.cli.main import COMMANDS, CommandGroup, main


def commands() -> dict[str, click.Command]:
    """Return every command by its words."""
    group, context = CommandGroup(), click.Context(main, **main.context_settings)
    found = {name: group.get_command(context, name) for name in COMMANDS}
    return {
        **{name: each for name, each in found.items() if each is not None},
        **{f"campaign {name}": each for name, each in campaign_command.commands.items()},
        **{f"bench {name}": each for name, each in bench_command.commands.items()},
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


@pytest.mark.parametrize("words", [[], ["bench"], ["campaign"]])
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


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (["--real-time", "1", "--rate", "200"], "real-time"),
        (["--rate=200", "--real-time=1"], "real-time"),
        (["--soak", "1"], "soak"),
        (["--no-priorities", "--viewer", "1"], "viewer"),
        (["--planning", "0", "--long-search", "8"], "planning"),
        (["--ticks", "1"], "ticks"),
    ],
)
def test_options_that_chose_a_benchmark_still_do(old: list[str], new: str) -> None:
    """The value is out of range, so that nothing is measured."""
    result = CliRunner().invoke(main, ["bench", *old])
    assert result.exit_code == 2
    assert f"is deprecated: use `spacerobot bench {new}`." in result.output
    assert f"Usage: main bench {new} " in result.output
    assert "is not in the range" in result.output


def test_bench_alone_is_ticks() -> None:
    result = CliRunner().invoke(main, ["bench", "--rounds", "0"])
    assert result.exit_code == 2
    assert "Usage: main bench ticks " in result.output
