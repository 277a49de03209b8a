"""The command ``spacerobot figures``."""

from __future__ import annotations

import re
from pathlib import Path

import click

from spacerobot_ros.cli.errors import fail
from spacerobot_ros.cli.options import PATH, bag_argument, beside, namespace_option

FORMATS = ("pdf", "svg", "png")
_MILLIMETRES = {"": 1.0, "mm": 1.0, "cm": 10.0, "in": 25.4, "pt": 25.4 / 72}


def _millimetres(context: click.Context, option: click.Parameter, text: str) -> float:
    found = re.fullmatch(r"([0-9]*\.?[0-9]+) *([a-z]*)", text.strip().lower())
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
    type=click.Choice(FORMATS, case_sensitive=False),
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
    help="Style file of matplotlib, or name of one of its styles: fonts, sizes, lines, colours.",
)
@click.option("--events", is_flag=True, help="Show events below the time axes.")
@click.option("--out", "-o", type=PATH, help="Folder of the figures [BAG_figures].")
@namespace_option
def command(
    bag: Path,
    only: str,
    format_name: str,
    width: float,
    style: Path | None,
    events: bool,
    out: Path | None,
    namespace: str | None,
) -> None:
    """Draw figures of a BAG for a paper, one file each.

    Files of the same names are replaced. Exit code 1: the bag lacks the data of a figure that
    --only names, or of all figures.
    """
    from spacerobot_ros.report import write_figures
    from spacerobot_ros.report.figures import PictureFormat

    names = [name.strip().lower() for name in only.split(",") if name.strip()]
    folder = out or beside(bag, "_figures")
    made = write_figures(
        bag,
        folder,
        names,
        format=PictureFormat(format_name),
        width=width,
        style=style,
        events=events,
        namespace=namespace,
    )
    drawn = {name: result for name, result in made.items() if isinstance(result, Path)}
    for name, path in drawn.items():
        click.echo(f"{name:<11} {path}")
    for name in names or () if drawn else made:
        if name not in drawn:
            click.echo(f"{name:<11} none: {made[name]}", err=True)
    if not drawn or not drawn.keys() >= set(names):
        fail()
