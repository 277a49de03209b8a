"""The command `spacerobot plan`."""

from __future__ import annotations

import json
import logging
import math
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click

from spacerobot_ros.cli.errors import GOAL_NOT_REACHED, sentences
from spacerobot_ros.cli.options import pose_option, rotvec_option, settings_option
from spacerobot_ros.planning import METHODS

if TYPE_CHECKING:
    from spacerobot_ros.session.plan import Problem


@click.command()
@click.argument("scenario", metavar="SCENARIO|ROBOT")
@pose_option
@rotvec_option
@click.option(
    "--method",
    type=click.Choice(sorted(METHODS)),
    default="optimal",
    show_default=True,
    help="Gait method.",
)
@settings_option
@click.option("--json", "json_file", type=click.Path(path_type=Path), help="Write schedule, path.")
@click.option("--picture", type=click.Path(path_type=Path), help="Draw both (PNG).")
@click.option("--compare", "comparing", is_flag=True, help="Fly every method, print a table.")
@click.option("--random", "count", type=click.IntRange(min=1), help="Fly so many random goals.")
@click.option(
    "--within",
    nargs=2,
    type=float,
    default=(0.3, 180.0),
    metavar="M DEG",
    show_default=True,
    help="... at most so far from the start.",
)
@click.option("--beside", type=click.Choice(sorted(METHODS)), help="... by this method too.")
@sentences
def plan(
    scenario: str,
    goal: tuple[float, ...] | None,
    goal_rotvec: tuple[float, ...] | None,
    method: str,
    settings: tuple[str, ...],
    json_file: Path | None,
    picture: Path | None,
    comparing: bool,
    count: int | None,
    within: tuple[float, float],
    beside: str | None,
) -> None:
    """Plan a gait without ROS, for a SCENARIO or a ROBOT, and fly it in the plant.

    Exit code 0: it ends within tolerance; 1: it does not; 2: bad input, or the goal is refused.
    """
    from spacerobot_ros.session.plan import compare, json_of, problem, solve, table_of

    asked = problem(scenario, goal, goal_rotvec, settings)
    if count is not None:
        _fly_random(asked, [method] if beside is None else [method, beside], count, within)
        return
    with _progress():
        if comparing:
            answers = compare(asked)
            for line in table_of(answers):
                click.echo(line)
            flown = [x for x in answers.values() if not isinstance(x, str)]
            found = next((x for x in flown if x.method == method), None)
        else:
            found = solve(asked, method)
    if found is None:
        sys.exit(GOAL_NOT_REACHED)
    left = f"{found.error.angle:.3g} rad and {found.error.distance:.3g} m from the goal"
    if not comparing:
        click.echo(f"{scenario}, {method}: {found.duration:.6g} s, ends {left}")
        click.echo(f"planned in {found.plan_time:.3f} s")
    if json_file is not None:
        content = json_of(asked, found)
        if comparing:
            content["compared"] = {
                name: answer if isinstance(answer, str) else answer.duration
                for name, answer in answers.items()
            }
        json_file.parent.mkdir(parents=True, exist_ok=True)
        json_file.write_text(json.dumps(content) + "\n", encoding="utf-8")
        click.echo(f"json        {json_file}")
    if picture is not None:
        from spacerobot_ros.report.plan_figures import draw

        picture.parent.mkdir(parents=True, exist_ok=True)
        picture.write_bytes(draw(asked, found))
        click.echo(f"picture     {picture}")
    if not found.succeeded:
        click.echo(f"The goal is not met within the planner's tolerance: {left}.", err=True)
        sys.exit(GOAL_NOT_REACHED)


def _fly_random(
    asked: Problem, methods: list[str], count: int, within: tuple[float, float]
) -> None:
    """Print what becomes of random goals; the exit code says whether all flown ones are met."""
    from spacerobot_ros.session.plan_random import HEADING, fly_goals, random_goals

    goals = random_goals(asked, count, within[0], math.radians(within[1]))
    show = partial(click.echo, err=True) if sys.stderr.isatty() else lambda line: None
    records = fly_goals(asked, goals, methods, show)
    click.echo(HEADING)
    for record in records:
        click.echo(record.line())
    for record in records:
        for reason in dict.fromkeys(record.refused):
            click.echo(f"{record.method} refused: {reason}")
    if records[0].missed:
        sys.exit(GOAL_NOT_REACHED)


@contextmanager
def _progress() -> Iterator[None]:
    """Show what the methods say of their search, where somebody is looking."""
    log, handler = logging.getLogger("spacerobot_ros.planning"), logging.StreamHandler(sys.stderr)
    if not sys.stderr.isatty():
        yield
        return
    level = log.level
    log.addHandler(handler)
    log.setLevel(logging.INFO)
    try:
        yield
    finally:
        log.removeHandler(handler)
        log.setLevel(level)
