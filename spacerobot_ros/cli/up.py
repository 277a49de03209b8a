"""The command ``spacerobot up``: for machines without the ros2 command."""

from __future__ import annotations

from pathlib import Path

import click

from spacerobot_ros.cli.options import PATH, settings_option, view_option, viewing_if


@click.command("up")
@click.argument("scenario", metavar="SCENARIO|ROBOT")
@settings_option
@click.option("--bag", type=PATH, help="Bag to write [none].")
@click.option(
    "--rate",
    default=1.0,
    show_default=True,
    type=click.FloatRange(min=0.0, min_open=True),
    help="Simulated time per wall time.",
)
@click.option("--processes", is_flag=True, help="Give each node a process of its own.")
@click.option(
    "--namespace", default="", help="Namespace of all nodes and topics, also of /clock and /tf."
)
@view_option
def command(
    scenario: str,
    settings: tuple[str, ...],
    bag: Path | None,
    rate: float,
    processes: bool,
    namespace: str,
    view: bool,
) -> None:
    """Keep the nodes of a SCENARIO or a ROBOT running in real time.

    A SCENARIO is a name or a parameter file, a ROBOT a name or a URDF file. Send goals by topic or
    with the command spacerobot goal. Ctrl-C, SIGTERM or SIGHUP ends the nodes.
    """
    from spacerobot_ros.flight.scenario import scenario_or_robot

    chosen = scenario_or_robot(scenario).in_real_time(rate).with_settings(settings)
    from spacerobot_ros.session.live import keep_up

    with viewing_if(view, chosen.parameters("viewer"), namespace):
        recorded = keep_up(chosen, bag, click.echo, processes=processes, namespace=namespace)
    if recorded is not None:
        click.echo(f"bag         {recorded}")
