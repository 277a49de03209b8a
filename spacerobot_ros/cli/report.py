"""The command ``spacerobot report``."""

from __future__ import annotations

from pathlib import Path

import click

from spacerobot_ros.cli.options import (
    PATH,
    bag_argument,
    beside,
    namespace_option,
    picture_option,
)


@click.command("report")
@bag_argument
@click.option("--output", "-o", type=PATH, help="HTML file [BAG.html].")
@picture_option("Also draw an overview (.png, .svg, .pdf).")
@click.option(
    "--beside",
    "others",
    multiple=True,
    type=PATH,
    metavar="BAG",
    help="Bag of another flight to compare with. May be repeated.",
)
@namespace_option
def command(
    bag: Path,
    output: Path | None,
    picture: Path | None,
    others: tuple[Path, ...],
    namespace: str | None,
) -> None:
    """Write an HTML report of a BAG, with pictures and a 3D view."""
    from spacerobot_ros.report import write_picture, write_report

    target = output or beside(bag, ".html")
    write_report(bag, target, others, namespace=namespace)
    click.echo(f"report      {target}")
    if picture is not None:
        write_picture(bag, picture, namespace=namespace)
        click.echo(f"picture     {picture}")
