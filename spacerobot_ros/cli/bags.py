"""Commands for bags: export, figures, replay, report, salvage, verify."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

import click

from spacerobot_ros.cli.options import (
    PATH,
    NumberRange,
    bag_argument,
    beside,
    format_option,
    namespace_option,
    out_option,
    picture_option,
    topic_option,
    view_option,
    viewer_if_requested,
)
from spacerobot_ros.cli.terminal import fail, say
from spacerobot_ros.errors import counted, printable


@click.command("export")
@bag_argument
@format_option(
    ("csv", "parquet", "mat", "tree"),
    "csv and parquet: a folder with one file per topic; mat: one file for MATLAB; tree: csv with "
    "columns that PlotJuggler shows as a tree.",
)
@out_option("Folder or file to write [BAG_csv, BAG_parquet, BAG_tree or BAG.mat].")
@topic_option("Export only this topic, with or without the leading slash [all].")
def export_command(bag: Path, format_name: str, out: Path | None, topics: tuple[str, ...]) -> None:
    """Export the topics in a BAG as tables for other programs.

    Existing files and folders are not overwritten.
    """
    from spacerobot_ros.bag import read_bag
    from spacerobot_ros.bag.tables import ExportFormat, export

    opened = read_bag(bag)
    if out is None:
        out = beside(bag, ".mat" if format_name == "mat" else f"_{format_name}")
    tables = {opened[topic].topic: opened.table(topic) for topic in topics} or opened.tables()
    rows_by_topic = export(tables.values(), out, ExportFormat(format_name))
    for topic in tables:
        rows = rows_by_topic.get(topic)
        say(f"{printable(topic):<27} {'no messages, omitted' if rows is None else f'{rows} rows'}")
    say(f"{'tables':<27} {out}")


_MILLIMETRES_BY_UNIT = {"": 1.0, "mm": 1.0, "cm": 10.0, "in": 25.4, "pt": 25.4 / 72}


def _parse_length(context: click.Context, option: click.Parameter, text: str) -> float:
    """Return a length in mm."""
    match = re.fullmatch(r"([0-9]*\.?[0-9]+) *([a-z]*)", text.strip().lower())
    if match is None or match[2] not in _MILLIMETRES_BY_UNIT:
        raise click.BadParameter(f"'{text}' is not a length such as 88mm, 18cm, 3.5in or 246pt.")
    return float(match[1]) * _MILLIMETRES_BY_UNIT[match[2]]


_several_bags = click.argument("bags", metavar="BAG...", type=PATH, nargs=-1, required=True)


@click.command("figures")
@_several_bags
@click.option(
    "--only",
    metavar="NAME,NAME",
    default="",
    help="Draw only these figures, for example pose,joints. Available: robot, pose, position, "
    "attitude, cycles, joints, velocities, loops, errors, link_errors, sensors, efforts, "
    "thrusters, twist, clearance, momentum, momentum_budget and path.",
)
@format_option(
    ("pdf", "svg", "png"), "File format; text in PDF and SVG can be searched and edited."
)
@click.option(
    "--width",
    callback=_parse_length,
    default="88mm",
    show_default=True,
    help="Figure width in mm, cm, in or pt; 88mm is one column.",
)
@click.option(
    "--style",
    type=PATH,
    metavar="FILE.mplstyle",
    help="Fonts, sizes and colours: serif, a matplotlib style file, or the name of a matplotlib "
    "style.",
)
@click.option("--degrees", is_flag=True, help="Show angles in degrees [rad].")
@click.option("--events", is_flag=True, help="Show events below the time axes.")
@out_option("Folder for the figures [BAG_figures].")
@namespace_option
def figures_command(
    bags: tuple[Path, ...], only: str, format_name: str, out: Path | None, **options: Any
) -> None:
    """Draw figures for a paper from a BAG, one file per figure.

    Several bags are drawn in the same panels. Existing files with these names are replaced. Exit
    code 1: the bags lack the data for a figure named by --only, or for every figure.
    """
    from spacerobot_ros.report import write_figures
    from spacerobot_ros.report.figures import PictureFormat

    names = [name.strip().lower() for name in only.split(",") if name.strip()]
    folder = out or beside(bags[0], "_figures")
    format = PictureFormat(format_name)
    results = write_figures(bags[0], folder, names, beside=bags[1:], format=format, **options)
    drawn = {name: result for name, result in results.items() if isinstance(result, Path)}
    for name, path in drawn.items():
        say(f"{name:<11} {path}")
    for name in names or () if drawn else results:
        if name not in drawn:
            say(f"{name:<11} none: {results[name]}", err=True)
    if not drawn or not drawn.keys() >= set(names):
        fail()


@click.command("replay")
@bag_argument
@click.option(
    "--rate",
    default=1.0,
    show_default=True,
    metavar="FACTOR",
    help="Replay speed: ratio of bag time to wall time.",
)
@click.option(
    "--start",
    default=0.0,
    metavar="SECONDS",
    help="Start of the replay, relative to the first message.",
)
@click.option("--duration", default=0.0, metavar="SECONDS", help="Duration to replay [all].")
@click.option("--loop", is_flag=True, help="Repeat the replay when it ends.")
@topic_option("Replay only this topic [all].")
@click.option(
    "--remap", multiple=True, metavar="OLD:=NEW", help="Publish topic OLD as NEW. May be repeated."
)
@click.option(
    "--clock",
    is_flag=False,
    flag_value=100.0,
    default=0.0,
    type=NumberRange(min=0.0),
    metavar="[HZ]",
    help="Publish bag time on /clock HZ times per second (100 if HZ is omitted) [as recorded].",
)
@click.option("--paused", is_flag=True, help="Begin paused.")
@view_option
@click.option(
    "--wait",
    default=3.0,
    show_default=True,
    type=NumberRange(min=0.0),
    help="Maximum wait for subscribers (s).",
)
def replay_command(
    bag: Path, topics: tuple[str, ...], remap: tuple[str, ...], view: bool, **options: Any
) -> None:
    """Republish the messages in a BAG at their recorded times.

    The services /replay/pause, /replay/resume and /replay/step control the replay. With --view, the
    replay pauses at the end until Ctrl-C, and can be restarted.
    """
    from rclpy.parameter import Parameter

    from spacerobot_ros.nodes import ReplayNode
    from spacerobot_ros.nodes.common.process import run_node

    texts = {"bag": str(bag), "topics": " ".join(topics), "remap": " ".join(remap)}
    values = {**options, **texts, "hold": view}
    overrides = [Parameter(name, value=value) for name, value in values.items()]
    with viewer_if_requested(view, {"title": f"{bag.name}, replay"}):
        code = run_node(lambda: ReplayNode(parameter_overrides=overrides), [])
    sys.exit(code)


@click.command("report")
@_several_bags
@out_option("HTML file [BAG.html].")
@picture_option("Also draw an overview (.png, .svg, .pdf).")
@click.option(
    "--beside",
    "others",
    multiple=True,
    type=PATH,
    metavar="BAG",
    help="Bag of another flight to compare with, like further BAGs. May be repeated.",
)
@namespace_option
def report_command(
    bags: tuple[Path, ...],
    out: Path | None,
    picture: Path | None,
    others: tuple[Path, ...],
    namespace: str | None,
) -> None:
    """Write an HTML report of a BAG, with pictures and a 3D view.

    The report compares the flight of the first BAG with those of further ones.
    """
    from spacerobot_ros.report import write_picture, write_report

    bag, target = bags[0], out or beside(bags[0], ".html")
    write_report(bag, target, (*bags[1:], *others), namespace=namespace)
    say(f"report      {target}")
    if picture is not None:
        write_picture(bag, picture, namespace=namespace)
        say(f"picture     {picture}")


@click.command("salvage")
@bag_argument
@out_option("Bag to write [BAG-salvaged.mcap].")
def salvage_command(bag: Path, out: Path | None) -> None:
    """Recover a complete bag from a truncated or damaged BAG.

    The damaged BAG is not changed. Exit code 1: it has no readable messages.
    """
    from spacerobot_ros.bag.salvage import salvage_bag

    saved = salvage_bag(bag, out)
    say(f"saved       {saved.messages} messages over {saved.duration:.9g} s")
    say(
        f"lost        {saved.lost_bytes} bytes after the last whole record, "
        f"{counted(saved.lost_chunks, 'damaged chunk')}"
        + (f"; the first: {saved.loss_reason}" if saved.loss_reason else "")
    )
    say(f"bag         {saved.path}")
    if not saved.messages:
        fail(f"No messages in {bag} can be read.")


@click.command("verify")
@bag_argument
@click.option(
    "--tolerance",
    default=1e-9,
    show_default=True,
    type=NumberRange(min=0.0),
    help="Largest deviation treated as agreement (SI units; relative for values above 1).",
)
@click.option(
    "--engine",
    type=click.Choice(["mujoco"]),
    help="Also replay the commands in this engine, and compare its states.",
)
def verify_command(bag: Path, tolerance: float, engine: str | None) -> None:
    """Re-simulate a BAG from its commands, and compare the states.

    Exit code 0: the commands reproduce every recorded state; 1: a state differs, states are
    missing, or the other engine differs; 2: bad input.
    """
    from spacerobot_ros.flight.second_opinion import AGREEMENT_TOLERANCE
    from spacerobot_ros.flight.verification import verify_bag

    result = verify_bag(bag, tolerance, mujoco=engine == "mujoco")
    say(f"flown again {result.ticks} ticks, {result.duration:.9g} s")
    say(f"compared    {result.messages} messages on {', '.join(result.topics)}")
    where = result.largest_at
    place = f", {where.field} of {where.topic} at {where.time:.9g} s" if where else ""
    say(f"largest     {result.largest:.3g}{place}")
    if result.difference is not None:
        fail(f"The bag differs: {result.difference}")
    if result.missing:
        fail(f"The bag is incomplete: {result.missing}")
    say("verified    every published state follows from the commands")
    if (other := result.second_opinion) is not None:
        say(f"engine      {other.engine}, {other.integrator}")
        say(
            f"deviates    {other.position:.2g} m, {other.attitude:.2g} rad, joints "
            f"{other.joints:.2g} m or rad, largest at {other.time:.9g} s of {other.ticks} ticks"
        )
        if not other.agrees:
            fail(f"{other.engine} differs by more than {AGREEMENT_TOLERANCE:g} m or rad.")
        if other.stop_reason:
            say(f"note        compared until {other.stop_reason}")
