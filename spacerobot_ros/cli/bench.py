"""The command ``spacerobot bench``."""

from __future__ import annotations

from pathlib import Path

import click

from spacerobot_ros.cli.options import PATH, json_option


@click.command("bench")
@click.option("--ticks", default=20_000, show_default=True, type=click.IntRange(min=100))
@click.option(
    "--real-time",
    "seconds",
    type=click.FloatRange(min=5.0),
    metavar="S",
    help="Instead: fly for S s in real time, in separate processes; deadlines, losses, memory.",
)
@click.option(
    "--rate",
    "rates",
    multiple=True,
    type=click.FloatRange(min=1.0, max=1e4),
    metavar="HZ",
    help="... with so many commands a second. May be repeated.  [default: 100]",
)
@json_option("Write the figures.")
@click.option(
    "--against",
    type=PATH,
    metavar="PATH",
    help="Measure the checkout at PATH in turns with this one, and print the ratios.",
)
def command(
    ticks: int,
    seconds: float | None,
    rates: tuple[float, ...],
    json_file: Path | None,
    against: Path | None,
) -> None:
    """Measure the speed of the stack against a bare ping-pong in the same run."""
    if against is not None:
        from spacerobot_ros.benchmarks.against import compare_checkouts

        words = ["--ticks", str(ticks)]
        if seconds is not None:
            rate_words = [word for rate in rates for word in ("--rate", str(rate))]
            words = ["--real-time", str(seconds), *rate_words]
        lines = compare_checkouts(against, words, json_file)
    elif seconds is None:
        from spacerobot_ros.benchmarks import bench

        lines = bench.run_benchmark(ticks, json_file)
    else:
        from spacerobot_ros.benchmarks import real_time

        lines = real_time.run_benchmark(seconds, rates or (100.0,), json_file)
    for line in lines:
        click.echo(line)
