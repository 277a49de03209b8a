"""The command ``spacerobot verify``."""

from __future__ import annotations

from pathlib import Path

import click

from spacerobot_ros.cli.errors import fail
from spacerobot_ros.cli.options import bag_argument


@click.command("verify")
@bag_argument
@click.option(
    "--tolerance",
    default=1e-9,
    show_default=True,
    type=click.FloatRange(min=0.0),
    help="Largest deviation that counts as equal (SI units; relative above 1).",
)
def command(bag: Path, tolerance: float) -> None:
    """Re-simulate a BAG from its commands, and compare the states.

    Exit code 0: every recorded state follows from the commands; 1: one does not; 2: bad input.
    """
    from spacerobot_ros.verification.comparison import verify_bag

    result = verify_bag(bag, tolerance)
    click.echo(f"flown again {result.ticks} ticks, {result.duration:.9g} s")
    click.echo(f"compared    {result.messages} messages")
    where = result.largest_at
    place = f", {where.field} of {where.topic} at {where.time:.9g} s" if where else ""
    click.echo(f"largest     {result.largest:.3g}{place}")
    if result.difference is not None:
        fail(f"The bag differs: {result.difference}")
    click.echo("verified    every published state is what the commands make it")
