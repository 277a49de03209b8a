"""The command `spacerobot analyze`."""

from __future__ import annotations

import json
from pathlib import Path

import click

from spacerobot_ros.cli.errors import sentences
from spacerobot_ros.errors import ParameterError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.resources import robot_file


@click.command()
@click.argument("robot")
@click.option("--shape", metavar="'Q1 Q2 ...'", help="Shape to look at, m or rad [the best].")
@click.option(
    "--picture", type=click.Path(path_type=Path), help="PNG to draw [out/ROBOT_curvature.png]."
)
@click.option("--json", "json_file", type=click.Path(path_type=Path), help="Write the findings.")
@sentences
def analyze(robot: str, shape: str | None, picture: Path | None, json_file: Path | None) -> None:
    """Say what loops of the joints of ROBOT (a name or a URDF file) can do, and draw it."""
    from spacerobot_ros.session.analyze import analyze, json_of, lines_of

    model = SpaceRobot.from_file(robot_file(robot))
    found = analyze(model, None if shape is None else _numbers(shape))
    for line in lines_of(found):
        click.echo(line)
    if json_file is not None:
        json_file.parent.mkdir(parents=True, exist_ok=True)
        json_file.write_text(json.dumps(json_of(found), indent=2) + "\n", encoding="utf-8")
    from spacerobot_ros.report.analyze_figures import draw

    png = draw(found)
    if png is None:
        click.echo(f"{'picture':<13}none: no loops of the joints turn the base")
        return
    target = picture or Path("out") / f"{model.description.name}_curvature.png"
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_bytes(png)
    click.echo(f"{'picture':<13}{target}")


def _numbers(text: str) -> list[float]:
    try:
        return [float(word) for word in text.replace(",", " ").split()]
    except ValueError:
        raise ParameterError(f"--shape is '{text}'; it must be numbers, one a joint.") from None
