"""The command ``spacerobot figures``."""

from __future__ import annotations

import re
from pathlib import Path

import click

from spacerobot_ros.cli.errors import fail
from spacerobot_ros.cli.options import PATH, bag_argument

FORMATS = ("pdf", "svg", "png")
_MILLIMETRES = {"": 1.0, "mm": 1.0, "cm": 10.0, "in": 25.4, "pt": 25.4 / 72}


def _millimetres(context: click.Context, option: click.Parameter, text: str) -> float:
    found = re.fullmatch(r"([0-9]+(?:\.[0-9]+)?) *([a-z]*)", text.strip())
    if found is None or found[2] not in _MILLIMETRES:
        raise click.BadParameter(f"'{text}' is no length such as 88mm, 18cm, 3.5in or 246pt.")
    return float(found[1]) * _MILLIMETRES[found[2]]


@click.command("figures")
@bag_argument
@click.option(
    "--only", metavar="NAME,NAME", default="", help="Draw only these figures, such as pose,joints."
)
@click.option(
    "--format",
    "format_name",
    type=click.Choice(FORMATS),
    default="pdf",
    show_default=True,
    help="Format of the files; text in PDF and SVG can be searched and edited.",
)
@click.option(
    "--width",
    callback=_millimetres,
    default="88mm",
    show_default=True,
    help="Width of a figure in mm, cm, in or pt; 88mm is one column.",
)
@click.option(
    "--style",
    type=PATH,
    metavar="FILE.mplstyle",
    help="Style file of matplotlib: fonts, sizes, lines, colours.",
)
@click.option("--events", is_flag=True, help="Show events below the time axes.")
@click.option("--out", "-o", type=PATH, help="Folder of the figures [BAG_figures].")
def command(
    bag: Path,
    only: str,
    format_name: str,
    width: float,
    style: Path | None,
    events: bool,
    out: Path | None,
) -> None:
    """Draw figures of a BAG for a paper, one file each.

    Files of the same names are replaced. Exit code 1: the bag lacks the data of a figure that
    --only names.
    """
    from spacerobot_ros.report import write_figures
    from spacerobot_ros.report.style import PictureFormat

    names = [name.strip() for name in only.split(",") if name.strip()]
    folder = out or bag.with_name(f"{bag.stem}_figures")
    made = write_figures(
        bag,
        folder,
        names,
        format=PictureFormat(format_name),
        width=width,
        style=style,
        events=events,
    )
    for name, result in made.items():
        if isinstance(result, Path):
            click.echo(f"{name:<11} {result}")
        elif names:
            click.echo(f"{name:<11} none: {result}", err=True)
    if names and not all(isinstance(result, Path) for result in made.values()):
        fail()
