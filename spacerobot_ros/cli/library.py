"""The command ``spacerobot library``."""

from __future__ import annotations

import math
import sys
from pathlib import Path

import click

from spacerobot_ros.cli.errors import fail
from spacerobot_ros.cli.options import PATH, settings_option


@click.command("library")
@click.argument("scenario", metavar="SCENARIO|ROBOT")
@settings_option
@click.option(
    "--count",
    default=80,
    show_default=True,
    type=click.IntRange(min=1),
    help="Number of random goals to plan.",
)
@click.option(
    "--within",
    nargs=2,
    type=float,
    default=(0.3, 60.0),
    metavar="M DEG",
    show_default=True,
    help="Largest distance (m) and angle (deg) of the goals from the start.",
)
@click.option(
    "--out",
    type=PATH,
    help="File to write, for the parameter planner.optimal.library [in the cache].",
)
def command(
    scenario: str,
    settings: tuple[str, ...],
    count: int,
    within: tuple[float, float],
    out: Path | None,
) -> None:
    """Make a library of manoeuvres, by which plans are found faster.

    Plans of the same robot, start, limits and options take the two manoeuvres that are nearest to
    their goal as initial guesses. Exit code 1: no goal is reachable; 2: bad input.
    """
    from spacerobot_ros.cli.plan import problem_of
    from spacerobot_ros.planning import PlanRequest
    from spacerobot_ros.planning.methods.optimal.method import OptimalGait
    from spacerobot_ros.private_files import write_whole
    from spacerobot_ros.simulation.trials import random_goals, state_of

    problem = problem_of(scenario, settings=settings)
    method = problem.method("optimal")
    assert isinstance(method, OptimalGait)
    goals = random_goals(problem, count, within[0], math.radians(within[1]))
    with click.progressbar(goals, label=problem.name, file=sys.stderr) as bar:
        state, tolerance = state_of(problem.plant()), problem.config.tolerance
        library = method.made_library(PlanRequest(state, goal, tolerance) for goal in bar)
    if library is None:
        fail("None of the goals could be reached.")
    if out is None:
        where = method.keep_library(library)
    else:
        write_whole(out, library.to_bytes())
        where = out
    if where is None:
        fail("The library could not be kept; --out chooses another place.")
    click.echo(f"library     {where} ({len(library.turns)} of {count} goals)")
