"""The command ``spacerobot campaign``."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.shell_completion import CompletionItem

from spacerobot_ros.cli.options import PATH, bag_option, out_option, report_option
from spacerobot_ros.cli.terminal import exit_if_terminated, fail, say
from spacerobot_ros.errors import ParameterError

if TYPE_CHECKING:
    from spacerobot_ros.campaign.running import Progress


def _checked_engine(context: click.Context, parameter: click.Parameter, name: str) -> str:
    from spacerobot_ros.campaign.config import require_engine

    try:
        require_engine(name)
    except ParameterError as refusal:
        raise click.BadParameter(str(refusal)) from refusal
    return name


def _complete_engine(_: click.Context, __: click.Parameter, incomplete: str) -> list[str]:
    from spacerobot_ros.campaign.config import ENGINES

    return [name for name in ENGINES if name.startswith(incomplete)]


class _CampaignGroup(click.Group):
    """Command group whose default command is ``fly``."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        if args and args[0] not in (*self.commands, *ctx.help_option_names):
            args = ["fly", *args]
        return super().parse_args(ctx, args)

    def shell_complete(self, ctx: click.Context, incomplete: str) -> list[CompletionItem]:
        file = fly.params[0]
        return [*file.shell_complete(ctx, incomplete), *super().shell_complete(ctx, incomplete)]


@click.group("campaign", cls=_CampaignGroup)
def campaign_command() -> None:
    """Fly a scenario many times with dispersed parameters.

    `spacerobot campaign FILE.yaml` is short for `spacerobot campaign fly FILE.yaml`.
    """


@campaign_command.command("fly")
@click.argument("file", type=PATH, required=False)
@click.option("--flights", type=click.IntRange(min=1), help="Number of flights [as in FILE].")
@click.option(
    "--engine",
    default="auto",
    show_default=True,
    metavar="NAME",
    callback=_checked_engine,
    shell_complete=_complete_engine,
    help="Flight engine: auto, lanes, flights or cuda (cuda:1, cuda:single; see the docs).",
)
@click.option(
    "--workers",
    type=click.IntRange(min=0),
    default=2,
    show_default=True,
    help="Worker processes on this machine; 0: fly in this process.",
)
@click.option(
    "--scheduler",
    default="",
    metavar="tcp://HOST:PORT",
    help="Address of a dask scheduler whose workers execute the flights.",
)
@out_option("Folder for the results [out/NAME].")
@report_option("Report to write [OUT/report.html].")
@click.option(
    "--compare",
    type=PATH,
    nargs=2,
    metavar="A.yaml B.yaml",
    help="Fly two campaigns, given instead of FILE, with the same draws.",
)
def fly(
    file: Path | None,
    flights: int | None,
    out: Path | None,
    report: Path | None,
    compare: tuple[Path, Path] | None,
    **how: Any,
) -> None:
    """Fly the campaign in FILE and write its dataset and report.

    Example FILE for 20 flights with dispersed masses and goals:

    \b
      campaign:
        scenario: sliding_masses
        flights: 20
        seed: 1
        disperse:
          mass.*: {norm: {loc: 1.0, scale: 0.05}}
          goal.position.x: {uniform: [-0.01, 0.01]}
        criteria:
          position_error_m: {max: 0.02}

    For --compare, the second file describes the second campaign, for example with `method:
    lie_bracket` below the scenario. More are in examples/campaigns.

    The command resumes an interrupted campaign. Exit code 0: all flights were flown;
    1: every flight was rejected or failed with an error; 2: bad input; 130: Ctrl-C, finished
    flights are kept.
    """
    if (file is None) == (compare is None):
        raise ParameterError("Give one campaign FILE, or two after --compare, not both.")
    if compare is not None:
        from spacerobot_ros.campaign.config import load_campaign
        from spacerobot_ros.campaign.report import require_same_draws, write_comparison

        require_same_draws(*(load_campaign(each, flights) for each in compare))
        names = [each.stem for each in compare]
        if names[0] == names[1]:  # The default folders of two campaigns must differ.
            names = [f"{name}_{letter}" for name, letter in zip(names, "AB", strict=True)]
        base = out or Path("out") / "_".join(names)
        flown = []
        for each, name in zip(compare, names, strict=True):
            flown.append(_fly_campaign(each, flights, base / name, how, name))
            exit_if_terminated()
        path = report or base / "report.html"
        (first, first_end), (second, second_end) = flown
        for line in write_comparison((first, second), path):
            say(line)
        say(f"report      {path}")
        _require_flights(first_end, second_end)
        return
    assert file is not None
    folder, progress = _fly_campaign(file, flights, out, how)
    _write_report(folder, report)
    exit_if_terminated()
    _require_flights(progress)


@campaign_command.command("report")
@click.argument("folder", metavar="DIR", type=PATH)
@report_option("Report to write [DIR/report.html].")
def report(folder: Path, report: Path | None) -> None:
    """Rewrite the report on the flights in DIR."""
    _write_report(folder, report)


@campaign_command.command("rerun")
@click.argument("folder", metavar="DIR", type=PATH)
@click.argument("number", metavar="N", type=click.IntRange(min=0))
@bag_option("Bag to write [DIR/flight_N.mcap, or the next free name].")
def rerun(folder: Path, number: int, bag: Path | None) -> None:
    """Repeat flight N in DIR, and record a bag.

    Exit code 0: the flight agrees with the dataset; 1: it differs; 2: bad input.
    """
    from spacerobot_ros.bag import free_name
    from spacerobot_ros.campaign.running import rerun_flight

    path = bag or free_name(folder / f"flight_{number}.mcap")
    result = rerun_flight(folder, number, path)
    for line in result.report_lines:
        say(line)
    exit_if_terminated()
    if not result.agrees:
        fail("The flight differs from the recorded flight in the dataset.")


def _fly_campaign(
    file: Path, flights: int | None, out: Path | None, how: dict[str, Any], name: str = ""
) -> tuple[Path, Progress]:
    from spacerobot_ros.campaign.config import load_campaign
    from spacerobot_ros.campaign.running import run_campaign
    from spacerobot_ros.termination import graceful_shutdown

    campaign = load_campaign(file, flights)
    if name:
        campaign = replace(campaign, name=name)
    folder = out or Path("out") / campaign.name
    for line in campaign.description_lines:
        say(line)
    with graceful_shutdown() as stopped, _progress_bar(campaign.name) as show:
        progress = run_campaign(campaign, folder, show=show, stopped=stopped, **how)
    flown = f"{progress.flown} of {progress.total} flights"
    say(f"{campaign.name}: {flown}, {progress.flights_per_second:.3g} per second; {folder}")
    return folder, progress


def _require_flights(*each: Progress) -> None:
    for progress in each:
        if progress.unflown and progress.unflown == progress.flown:
            fail(
                f"None of the {progress.flown} draws could be flown: the report lists the reasons."
            )


@contextmanager
def _progress_bar(label: str) -> Iterator[Callable[[Progress], None]]:
    """Show progress, rate and remaining time of a campaign, if standard error is a terminal."""
    if not sys.stderr.isatty():
        yield lambda progress: None
        return
    with click.progressbar(
        length=1000, label=label, file=sys.stderr, show_eta=False, item_show_func=str
    ) as bar:

        def show(progress: Progress) -> None:
            flown = f"{progress.flown}/{progress.total}, {progress.flights_per_second:.3g}/s"
            seconds = progress.seconds_left
            left = "?" if math.isinf(seconds) else timedelta(seconds=round(seconds))
            step = max(0, 1000 * progress.flown // progress.total - bar.pos)
            bar.update(step, f"{flown}, {left} left")

        yield show


def _write_report(folder: Path, report: Path | None) -> None:
    from spacerobot_ros.campaign.report import write_campaign_report

    path = report or folder / "report.html"
    for line in write_campaign_report(folder, path):
        say(line)
    say(f"report      {path}")
