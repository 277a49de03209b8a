"""The commands about bags: replay, verify, salvage."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import click

from spacerobot_ros.cli.errors import sentences

DIFFERENT = 1

_BAG = click.argument("bag", type=click.Path(path_type=Path))


@click.command()
@_BAG
@click.option(
    "--rate", default=1.0, show_default=True, metavar="FACTOR", help="Bag time over wall time."
)
@click.option(
    "--start", default=0.0, metavar="SECONDS", help="Where to begin, from the first message."
)
@click.option("--duration", default=0.0, metavar="SECONDS", help="How much to replay [all].")
@click.option("--loop", is_flag=True, help="Begin again at the end.")
@click.option("--topic", "topics", multiple=True, metavar="TOPIC", help="Replay this one [all].")
@click.option("--remap", multiple=True, metavar="OLD:=NEW", help="Publish a topic as another.")
@click.option(
    "--clock",
    is_flag=False,
    flag_value=100.0,
    default=0.0,
    type=float,
    metavar="[HZ]",
    help="Publish bag time on /clock, 100 times a second unless told [what the bag has].",
)
@click.option("--paused", is_flag=True, help="Begin paused; see the services of the node.")
@click.option("--wait", default=3.0, show_default=True, help="Longest wait for readers (s).")
@sentences
def replay(
    bag: Path,
    rate: float,
    start: float,
    duration: float,
    loop: bool,
    topics: tuple[str, ...],
    remap: tuple[str, ...],
    clock: float,
    paused: bool,
    wait: float,
) -> None:
    """Publish what a BAG holds on its topics, in the rhythm in which it was recorded.

    While it lasts, its services /replay/pause, /replay/resume and /replay/step steer it.
    """
    values: dict[str, Any] = {
        "bag": str(bag),
        "rate": rate,
        "start": start,
        "duration": duration,
        "loop": loop,
        "topics": " ".join(topics),
        "remap": " ".join(remap),
        "clock": clock,
        "paused": paused,
        "wait": wait,
    }
    from rclpy.parameter import Parameter

    from spacerobot_ros.nodes import ReplayNode
    from spacerobot_ros.nodes.common.node import run_node

    given = [Parameter(name, value=value) for name, value in values.items()]
    sys.exit(run_node(lambda: ReplayNode(parameter_overrides=given), []))


@click.command()
@_BAG
@click.option(
    "--tolerance",
    default=1e-9,
    show_default=True,
    type=click.FloatRange(min=0.0),
    help="Deviation that is no difference (SI units; relative above 1).",
)
@sentences
def verify(bag: Path, tolerance: float) -> None:
    """Fly a BAG again by the commands in it, and compare what its plant published.

    Exit code 0: all is as the commands make it; 1: it is not; 2: bad input.
    """
    from spacerobot_ros.verification.comparison import verify_bag

    result = verify_bag(bag, tolerance)
    click.echo(f"flown again {result.ticks} ticks, {result.duration:.9g} s")
    click.echo(f"compared    {result.messages} messages")
    where = result.largest_at
    place = f", {where.field} of {where.topic} at {where.time:.9g} s" if where else ""
    click.echo(f"largest     {result.largest:.3g}{place}")
    if result.difference is not None:
        click.echo(f"The bag differs: {result.difference}", err=True)
        sys.exit(DIFFERENT)
    click.echo("verified    every published state is what the commands make it")


@click.command()
@_BAG
@click.option(
    "--output", "-o", type=click.Path(path_type=Path), help="The new bag [BAG-salvaged.mcap]."
)
@sentences
def salvage(bag: Path, output: Path | None) -> None:
    """Make a complete bag of a BAG that was cut off or is damaged; that one stays as it is."""
    from spacerobot_ros.bag.salvage import salvage_bag

    saved = salvage_bag(bag, output)
    click.echo(f"saved       {saved.messages} messages over {saved.duration:.9g} s")
    click.echo(
        f"lost        {saved.lost_bytes} bytes behind the last whole record, "
        f"{saved.lost_chunks} damaged chunk(s)"
    )
    click.echo(f"bag         {saved.path}")
