"""The commands ``up`` and ``goal``: for machines without the ros2 command."""

from __future__ import annotations

import sys
from pathlib import Path

import click

from spacerobot_ros.cli.errors import GOAL_NOT_REACHED, sentences
from spacerobot_ros.cli.options import settings_option
from spacerobot_ros.planning import Goal
from spacerobot_ros.session.scenario import goal_from_rotvec, load_scenario


@click.command()
@click.argument("scenario")
@settings_option
@click.option("--bag", type=click.Path(path_type=Path), help="Record into this bag.")
@click.option(
    "--rate",
    default=1.0,
    show_default=True,
    type=click.FloatRange(min=0.0, min_open=True),
    help="Simulated over wall time.",
)
@click.option("--processes", is_flag=True, help="Give each node a process of its own.")
@sentences
def up(
    scenario: str, settings: tuple[str, ...], bag: Path | None, rate: float, processes: bool
) -> None:
    """Run the nodes of SCENARIO in real time until Ctrl-C; send goals by topic."""
    chosen = load_scenario(scenario).in_real_time(rate).with_settings(settings)
    from spacerobot_ros.session.live import keep_up

    keep_up(chosen, bag, click.echo, processes=processes)
    if bag is not None:
        click.echo(f"bag         {bag}")


@click.command(context_settings={"ignore_unknown_options": True})
@click.argument("pose", nargs=-1, type=float, metavar="X Y Z [QX QY QZ QW]")
@click.option("--rotvec", nargs=3, type=float, metavar="RX RY RZ", help="Attitude instead (rad).")
@click.option("--namespace", default="", help="Of the stack.")
@click.option("--timeout", default=0.0, help="Wall time to wait for the end, s; 0: for ever.")
@sentences
def goal(
    pose: tuple[float, ...],
    rotvec: tuple[float, float, float] | None,
    namespace: str,
    timeout: float,
) -> None:
    """Send a goal pose to a running stack and follow it until it is met or refused.

    Exit code 0: the goal was reached; 1: it was not; 2: bad input.
    """
    if len(pose) not in (3, 7):
        raise click.UsageError("A goal is X Y Z, or X Y Z QX QY QZ QW.")
    wanted = Goal.checked(pose[:3], pose[3:] or (0.0, 0.0, 0.0, 1.0))
    if rotvec:
        wanted = goal_from_rotvec(pose[:3], rotvec)
    from spacerobot_ros.session.live import send_goal

    state, _ = send_goal(wanted, click.echo, namespace=namespace, timeout=timeout)
    if state != "reached":
        sys.exit(GOAL_NOT_REACHED)
