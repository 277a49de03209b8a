"""The command ``spacerobot bench``."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click
from click.core import ParameterSource

from spacerobot_ros.cli.errors import fail
from spacerobot_ros.cli.options import PATH, json_option, write_json


@click.command("bench")
@click.option(
    "--ticks",
    default=20_000,
    show_default=True,
    type=click.IntRange(min=100),
    help="Ticks to fly in lockstep.",
)
@click.option(
    "--real-time",
    "seconds",
    type=click.FloatRange(min=5.0),
    metavar="S",
    help="Instead: fly in real time for S s, in separate processes; deadlines, losses, memory.",
)
@click.option(
    "--rate",
    "rates",
    multiple=True,
    type=click.FloatRange(min=1.0, max=1e4),
    metavar="HZ",
    help="With --real-time: commands a second. May be repeated.  [default: 100]",
)
@click.option(
    "--soak",
    type=click.FloatRange(min=10.0),
    metavar="S",
    help="Instead: fly in real time for S s with a goal every 12 s; whether memory, descriptors "
    "and threads of all processes stay flat. With --json also a picture beside it.",
)
@click.option(
    "--viewer",
    "viewed",
    type=click.FloatRange(min=5.0),
    metavar="S",
    help="Instead: fly the servicer in real time, in separate processes, in turns of S s without "
    "and with a viewer and a browser; updates received, deadlines missed.",
)
@click.option(
    "--no-priorities",
    is_flag=True,
    help="With --viewer: give plant and controller the same priority as all other processes.",
)
@click.option(
    "--planning",
    "goals",
    type=click.IntRange(min=1),
    metavar="N",
    help="Instead: plan N goals for each of four robots, without the cache of plans; CPU time. "
    "With --against also ratios of durations.",
)
@click.option(
    "--long-search",
    "starts",
    type=click.IntRange(min=1),
    metavar="N",
    help="With --planning: compare the durations with those of a search from N initial guesses.",
)
@click.option(
    "--library",
    type=click.IntRange(min=1),
    metavar="N",
    help="With --planning: plan also with a library of the manoeuvres to N other goals.",
)
@click.option(
    "--first-plans",
    is_flag=True,
    help="Instead: plan for robots of 7, 12 and 14 joints, first with an empty cache, then in "
    "another process; CPU time.",
)
@click.option(
    "--campaign",
    is_flag=True,
    help="Instead: fly thousands of flights in lanes, and the same in the plant and in MuJoCo's "
    "rollout; CPU time.",
)
@click.option(
    "--against",
    type=PATH,
    metavar="PATH",
    help="Measure the checkout at PATH in turns with this one, and print the ratios.",
)
@click.option(
    "--rounds",
    default=3,
    show_default=True,
    type=click.IntRange(min=1),
    help="With --against: how often each checkout is measured; the medians are compared.",
)
@json_option("Write the figures as JSON.")
def command(
    ticks: int,
    seconds: float | None,
    rates: tuple[float, ...],
    soak: float | None,
    viewed: float | None,
    no_priorities: bool,
    goals: int | None,
    starts: int | None,
    library: int | None,
    first_plans: bool,
    campaign: bool,
    json_file: Path | None,
    against: Path | None,
    rounds: int,
) -> None:
    """Measure the speed of the stack on this machine.

    The speed of a bare ping-pong of messages is measured beside it. Exit code 1: memory,
    descriptors or threads grow (--soak).
    """
    _require_one_benchmark()
    figures: Mapping[str, Any]
    if soak is not None:
        from spacerobot_ros.benchmarks.soak import run_soak

        picture = None if json_file is None else json_file.with_suffix(".png")
        figures = run_soak(soak, click.echo, picture)
        if json_file is not None:
            write_json(json_file, figures, indent=None)
        if not figures["flat"]:
            fail()
        return
    if campaign:
        from spacerobot_ros.benchmarks.lanes import lanes_benchmark

        figures = lanes_benchmark(click.echo)
    elif viewed is not None:
        from spacerobot_ros.benchmarks.viewing import run_viewer_benchmark

        figures = run_viewer_benchmark(viewed, click.echo, priorities=not no_priorities)
    elif goals is not None:
        from spacerobot_ros.benchmarks.planning import run_planning_benchmark

        figures = run_planning_benchmark(goals, against, starts, library, click.echo)
    elif first_plans:
        from spacerobot_ros.benchmarks.first_plans import run_first_plan_benchmark

        figures = run_first_plan_benchmark(against, click.echo)
    elif against is not None:
        from spacerobot_ros.benchmarks.against import compare_checkouts

        words = ["--ticks", str(ticks)]
        if seconds is not None:
            rate_words = [word for rate in rates for word in ("--rate", str(rate))]
            words = ["--real-time", str(seconds), *rate_words]
        figures = compare_checkouts(against, words, click.echo, rounds)
    elif seconds is None:
        from spacerobot_ros.benchmarks import bench

        figures = bench.run_benchmark(ticks, click.echo)
    else:
        from spacerobot_ros.benchmarks import real_time

        figures = real_time.run_benchmark(seconds, rates or (100.0,), click.echo)
    if json_file is not None:
        write_json(json_file, figures)


_BENCHMARKS = (*("--real-time", "--soak", "--viewer", "--planning", "--first-plans", "--campaign"),)
"""Options that each choose another benchmark."""

_OF_ONE = {
    "--rate": "--real-time",
    "--no-priorities": "--viewer",
    "--long-search": "--planning",
    "--library": "--planning",
}
"""Options that count with one benchmark alone."""


def _require_one_benchmark() -> None:
    """Refuse options that would have no effect."""
    context = click.get_current_context()
    given = {
        option.opts[0]
        for option in context.command.params
        if option.name and context.get_parameter_source(option.name) is ParameterSource.COMMANDLINE
    }
    chosen = [name for name in _BENCHMARKS if name in given]
    if len(chosen) > 1:
        raise click.UsageError(f"{' and '.join(chosen)} are benchmarks of their own: choose one.")
    for name, benchmark in _OF_ONE.items():
        if name in given and benchmark not in given:
            raise click.UsageError(f"{name} is an option of {benchmark}.")
