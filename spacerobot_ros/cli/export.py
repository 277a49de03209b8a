"""The command ``spacerobot export``."""

from __future__ import annotations

from pathlib import Path

import click

from spacerobot_ros.cli.options import PATH, bag_argument

FORMATS = ("csv", "parquet", "mat")


@click.command("export")
@bag_argument
@click.option(
    "--format",
    "format_name",
    type=click.Choice(FORMATS, case_sensitive=False),
    default="csv",
    show_default=True,
    help="csv and parquet: a folder with a file for each topic; mat: one file for MATLAB.",
)
@click.option(
    "--out", "-o", type=PATH, help="Folder or file to write [BAG_csv, BAG_parquet or BAG.mat]."
)
@click.option(
    "--topic",
    "topics",
    multiple=True,
    metavar="TOPIC",
    help="Only this topic, with or without the slash before it. May be repeated.",
)
def command(bag: Path, format_name: str, out: Path | None, topics: tuple[str, ...]) -> None:
    """Write the topics of a BAG as tables for other programs.

    Existing files and folders are not overwritten.
    """
    from spacerobot_ros.bag import read_bag
    from spacerobot_ros.bag.export import ExportFormat, export

    opened = read_bag(bag)
    stem = opened.path.with_suffix("")
    beside = stem.with_suffix(".mat") if format_name == "mat" else Path(f"{stem}_{format_name}")
    chosen = dict.fromkeys(opened[topic].topic for topic in topics) or opened.keys()
    tables = (opened.table(topic) for topic in chosen)
    made = export(tables, out or beside, ExportFormat(format_name))
    for topic in chosen:
        rows = made.rows.get(topic)
        click.echo(f"{topic:<27} {'no messages, left out' if rows is None else f'{rows} rows'}")
    click.echo(f"{'tables':<27} {made.path}")
