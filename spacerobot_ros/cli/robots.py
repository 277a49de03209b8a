"""The command ``spacerobot robots``."""

from __future__ import annotations

import click


@click.command("robots")
def command() -> None:
    """List the robots that come with the package."""
    from spacerobot_ros.model import load_robot
    from spacerobot_ros.resources import resource_names, robot_file

    click.echo(f"{'robot':<22}{'joints':>6}{'mass':>12}{'base':>12}")
    for name in resource_names("urdf", ".urdf"):
        robot = load_robot(robot_file(name))
        base = robot.bodies[0].inertia.mass
        joints = len(robot.joint_names)
        click.echo(f"{name:<22}{joints:>6}{robot.total_mass:>9.4g} kg{base:>9.4g} kg")
