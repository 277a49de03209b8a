"""The command ``spacerobot up``: for machines without the ros2 command."""

from __future__ import annotations

from pathlib import Path

import click

from spacerobot_ros.cli.options import PATH, settings_option, view_option, viewing_if


@click.command("up")
@click.argument("scenario", metavar="SCENARIO|ROBOT")
@settings_option
@click.option("--bag", type=PATH, help="Record into this bag.")
@click.option(
    "--rate",
    default=1.0,
    show_default=True,
    type=click.FloatRange(min=0.0, min_open=True),
    help="Simulated over wall time.",
)
@click.option("--processes", is_flag=True, help="Give each node a process of its own.")
@click.option("--namespace", default="", help="Of all nodes and topics, /clock and /tf among them.")
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
    """Run the nodes of SCENARIO, or of a ROBOT (a name or a URDF file), in real time.

    They end at Ctrl-C, SIGTERM or SIGHUP; goals come by topic.
    """
    from spacerobot_ros.flight.scenario import scenario_or_robot

    chosen = scenario_or_robot(scenario).in_real_time(rate).with_settings(settings)
    from spacerobot_ros.session.live import keep_up

    with viewing_if(view, chosen.parameters("viewer"), namespace):
        recorded = keep_up(chosen, bag, click.echo, processes=processes, namespace=namespace)
    if recorded is not None:
        click.echo(f"bag         {recorded}")
