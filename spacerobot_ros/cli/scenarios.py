"""The command ``spacerobot scenarios``."""

from __future__ import annotations

import click


@click.command("scenarios")
def command() -> None:
    """List the scenarios that come with the package."""
    from spacerobot_ros.flight.scenario import load_scenario, scenario_names

    for name in scenario_names():
        click.echo(f"{name:<26}{load_scenario(name).description}")
