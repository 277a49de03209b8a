"""The command ``spacerobot bench``."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from spacerobot_ros.cli.options import PATH, DefaultGroup, json_option, write_json
from spacerobot_ros.cli.terminal import fail

if TYPE_CHECKING:
    from spacerobot_ros.benchmarks.checkouts import Checkout

_json_option = json_option("Write the figures as JSON.")


def _against_option(help: str) -> Callable[..., Any]:
    return click.option("--against", type=PATH, metavar="CHECKOUT", help=help)


_rounds_option = click.option(
    "--rounds",
    default=5,
    show_default=True,
    type=click.IntRange(min=1),
    help="With --against: number of measurements of each checkout; their medians are compared.",
)


class _BenchmarkGroup(DefaultGroup):
    """Command group of the benchmarks, with the options that version 0.2.0 had instead."""

    default = "ticks"

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Replace ``--BENCHMARK VALUE`` by ``BENCHMARK VALUE``."""
        for number, word in enumerate(args):
            option, equals, value = word.partition("=")
            name = option.removeprefix("--")
            if option != name and name in self.commands:
                click.echo(
                    f"`spacerobot bench {option}` is deprecated: use `spacerobot bench {name}`.",
                    err=True,
                )
                rest = [*args[:number], *args[number + 1 :]]
                return super().parse_args(ctx, [name, *([value] if equals else []), *rest])
        return super().parse_args(ctx, args or [self.default])


@click.group("bench", cls=_BenchmarkGroup)
def bench_command() -> None:
    """Measure the speed of the package on this machine.

    `spacerobot bench` alone is short for `spacerobot bench ticks`.
    """


@bench_command.command("ticks")
@click.argument("ticks", default=20_000, type=click.IntRange(min=100))
@_against_option(
    "Instead: measure CPU times of flights and plans of this checkout and of CHECKOUT in turns, "
    "and print the ratios."
)
@_rounds_option
@_json_option
def ticks(ticks: int, against: Path | None, rounds: int, json_file: Path | None) -> None:
    """Fly in lockstep, plan by each method, step the dynamics.

    A flight has TICKS [20000]. A minimal exchange of as many messages, and MuJoCo, are measured
    beside it.
    """
    if against is None:
        from spacerobot_ros.benchmarks.ticks import ticks_benchmark

        _write_figures(json_file, ticks_benchmark(ticks, click.echo))
    else:
        _compare_checkouts(
            against, lambda there: there.measure("tick_times", ticks=ticks), rounds, json_file
        )


@bench_command.command("real-time")
@click.argument("seconds", default=60.0, type=click.FloatRange(min=5.0))
@click.option(
    "--rate",
    "rates",
    multiple=True,
    default=(100.0,),
    show_default=True,
    type=click.FloatRange(min=1.0, max=1e4),
    metavar="HZ",
    help="Commands a second. May be repeated.",
)
@_against_option("Instead: fly by this checkout and by CHECKOUT in turns, and print the ratios.")
@_rounds_option
@_json_option
def real_time(
    seconds: float,
    rates: tuple[float, ...],
    against: Path | None,
    rounds: int,
    json_file: Path | None,
) -> None:
    """Fly in separate processes in real time.

    Deadlines, losses and memory of SECONDS [60] are measured.
    """
    if against is None:
        from spacerobot_ros.benchmarks.real_time import real_time_benchmark

        _write_figures(json_file, real_time_benchmark(seconds, rates, click.echo))
    else:
        words = ["-m", "spacerobot_ros", "bench", "real-time", str(seconds)]
        words += [f"--rate={rate}" for rate in rates]
        _compare_checkouts(against, lambda there: there.run([*words, "--json"]), rounds, json_file)


@bench_command.command("soak")
@click.argument("seconds", default=1800.0, type=click.FloatRange(min=10.0))
@json_option("Write all samples as JSON, and draw them beside it (.png).")
def soak(seconds: float, json_file: Path | None) -> None:
    """Fly long, and find memory and descriptors that grow.

    Memory, descriptors and threads of every process are sampled for SECONDS [1800], with a goal
    every 12 s. Exit code 0: none of them grows; 1: one grows.
    """
    from spacerobot_ros.benchmarks.soak import soak_benchmark

    named = None if json_file == Path("-") else json_file
    picture = None if named is None else named.with_suffix(".png")
    figures = soak_benchmark(seconds, click.echo, picture)
    _write_figures(json_file, figures, indent=None)
    if not figures["flat"]:
        fail()


@bench_command.command("viewer")
@click.argument("seconds", default=60.0, type=click.FloatRange(min=5.0))
@click.option(
    "--no-priorities",
    is_flag=True,
    help="Give plant and controller the same priority as all other processes.",
)
@_json_option
def viewer(seconds: float, no_priorities: bool, json_file: Path | None) -> None:
    """Fly in real time without and with a viewer.

    Updates received and deadlines missed are counted, with a viewer and a browser and without, in
    turns of SECONDS [60].
    """
    from spacerobot_ros.benchmarks.real_time import viewer_benchmark

    _write_figures(json_file, viewer_benchmark(seconds, click.echo, priorities=not no_priorities))


@bench_command.command("planning")
@click.argument("goals", default=20, type=click.IntRange(min=1))
@click.option(
    "--long-search",
    "starts",
    type=click.IntRange(min=1),
    metavar="N",
    help="Compare the durations with those of a search from N initial guesses.",
)
@_against_option("Plan the same goals by CHECKOUT, and compare CPU times and durations.")
@_json_option
def planning(
    goals: int,
    starts: int | None,
    against: Path | None,
    json_file: Path | None,
) -> None:
    """Plan goals of four robots by optimal.

    The CPU time of GOALS [20] for each robot is measured, without the cache of plans.
    """
    from spacerobot_ros.benchmarks.planning import planning_benchmark

    _write_figures(json_file, planning_benchmark(goals, against, starts, click.echo))


@bench_command.command("refusals")
@click.argument("goals", default=3, type=click.IntRange(min=1))
@_against_option("Plan for the same goals by CHECKOUT, too.")
@_json_option
def refusals(goals: int, against: Path | None, json_file: Path | None) -> None:
    """Plan for goals out of reach of four robots by optimal.

    Each of GOALS [3] is asked for in half of the time that its plan takes, as optimal.longest and
    as optimal.duration, and moved out of reach. The CPU time to the refusal, and to the first line
    about the search, is measured, and refusals that name a bound are counted.
    """
    from spacerobot_ros.benchmarks.planning import refusals_benchmark

    _write_figures(json_file, refusals_benchmark(goals, against, click.echo))


@bench_command.command("first-plans")
@_against_option("Plan by CHECKOUT, too.")
@_json_option
def first_plans(against: Path | None, json_file: Path | None) -> None:
    """Plan for large robots from an empty cache.

    The CPU time of the first plans for robots of 7, 12 and 14 joints is measured, and that of the
    next process.
    """
    from spacerobot_ros.benchmarks.planning import first_plan_benchmark

    _write_figures(json_file, first_plan_benchmark(against, click.echo))


@bench_command.command("campaign")
@click.argument("flights", default=10_000, type=click.IntRange(min=100))
@_against_option(
    "Instead: measure CPU times of a campaign of FLIGHTS in open loop by this checkout and by "
    "CHECKOUT in turns, and print the ratios."
)
@_rounds_option
@_json_option
def campaign(flights: int, against: Path | None, rounds: int, json_file: Path | None) -> None:
    """Fly in SIMD lanes, by the plant and by MuJoCo.

    The CPU time of thousands of flights is measured. With --against, a whole campaign of FLIGHTS
    [10000] is flown.
    """
    if against is None:
        from spacerobot_ros.benchmarks.engines import lanes_benchmark

        _write_figures(json_file, lanes_benchmark(click.echo))
    else:
        _compare_checkouts(
            against,
            lambda there: there.measure("campaign_times", flights=flights),
            rounds,
            json_file,
        )


@bench_command.command("report")
@click.argument("rows", default=1_000_000, type=click.IntRange(min=1))
@_json_option
def report(rows: int, json_file: Path | None) -> None:
    """Report a campaign of many flights.

    The largest memory and the CPU time of the report of ROWS [1000000] flights are measured; the
    rows are those of 500 flights.
    """
    from spacerobot_ros.benchmarks.checkouts import Checkout

    figures = Checkout.pair(None)[0].measure("report_figures", rows=rows)
    click.echo(
        f"{figures['rows']:.0f} flights: {figures['report_peak_MB']:.0f} MB at most, "
        f"{figures['report_cpu_s']:.1f} s of CPU time"
    )
    _write_figures(json_file, figures)


@bench_command.command("environments")
@click.argument("lanes", default=1024, type=click.IntRange(min=1))
@_json_option
def environments(lanes: int, json_file: Path | None) -> None:
    """Step environments in SIMD lanes, a plant and MuJoCo.

    Steps a CPU second are measured for an arm and a servicer, LANES [1024] of each.
    """
    from spacerobot_ros.benchmarks.engines import environments_benchmark

    _write_figures(json_file, environments_benchmark(lanes, click.echo))


def _compare_checkouts(
    other: Path, measure: Callable[[Checkout], Any], rounds: int, json_file: Path | None
) -> None:
    from spacerobot_ros.benchmarks.checkouts import compare

    _write_figures(json_file, compare(other, measure, click.echo, rounds))


def _write_figures(json_file: Path | None, figures: Any, indent: int | None = 2) -> None:
    if json_file is not None:
        write_json(json_file, figures, indent)
