"""The command ``spacerobot salvage``."""

from __future__ import annotations

from pathlib import Path

import click

from spacerobot_ros.cli.options import PATH, bag_argument


@click.command("salvage")
@bag_argument
@click.option("--output", "-o", type=PATH, help="Bag to write [BAG-salvaged.mcap].")
def command(bag: Path, output: Path | None) -> None:
    """Make a complete bag of a BAG that was cut off or is damaged.

    The damaged BAG is not changed.
    """
    from spacerobot_ros.bag.salvage import salvage_bag

    saved = salvage_bag(bag, output)
    click.echo(f"saved       {saved.messages} messages over {saved.duration:.9g} s")
    click.echo(
        f"lost        {saved.lost_bytes} bytes behind the last whole record, "
        f"{saved.lost_chunks} damaged chunk(s)"
        + (f"; the first: {saved.lost_because}" if saved.lost_because else "")
    )
    click.echo(f"bag         {saved.path}")
