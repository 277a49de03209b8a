"""The command ``spacerobot new``."""

from __future__ import annotations

import os
import shlex
from pathlib import Path

import click

from spacerobot_ros.cli.errors import fail
from spacerobot_ros.cli.options import PATH
from spacerobot_ros.cli.progress import display
from spacerobot_ros.output_files import write_output


@click.command("new")
@click.argument("robot", metavar="URDF")
@click.option("--out", type=PATH, help="Scenario file to write [NAME.yaml].")
def command(robot: str, out: Path | None) -> None:
    """Check a robot of your own, plan a first turn, write a scenario.

    URDF is a URDF or xacro file, or the name of a robot. Exit code 0: a scenario that reaches its
    goal is written; 1: no method reaches one; 2: the robot is refused.
    """
    from spacerobot_ros.bag import free_name
    from spacerobot_ros.cli.analyze import lines_of
    from spacerobot_ros.cli.plan import table
    from spacerobot_ros.model import SpaceRobot
    from spacerobot_ros.planning.analysis import analyze
    from spacerobot_ros.resources import is_path, robot_file
    from spacerobot_ros.session.own_robot import fastest, first_problem, remarks, scenario_text
    from spacerobot_ros.simulation.trials import compare

    file = robot_file(robot)
    model = SpaceRobot.from_file(file)
    name = file.name.split(".")[0]
    with display(name):
        known = analyze(model)
    for line in lines_of(known):
        click.echo(line)
    for remark in remarks(model.description):
        click.echo(f"{'to mind':<13}{remark}")
    click.echo()
    problem = first_problem(name, model, file)
    with display(name):
        found = compare(problem)
    for line in table(found):
        click.echo(line)
    best = fastest(found)
    if best is None:
        fail("No method reaches the goal of a first flight; no scenario is written.")
    target = free_name(out or Path(f"{name}.yaml"))
    # Beside the scenario the robot is found by its name from anywhere.
    from_there = os.path.relpath(file.resolve(), target.resolve().parent)
    named = from_there if is_path(robot) else robot
    write_output(target, scenario_text(problem, best.method, named))
    click.echo(f"\n{best.method} is the fastest: {best.duration:.4g} s. The scenario is {target}:")
    click.echo(f"  spacerobot run {shlex.quote(str(target))}")
