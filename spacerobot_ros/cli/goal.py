"""The command ``spacerobot goal``: for machines without the ros2 command."""

from __future__ import annotations

import click

from spacerobot_ros.cli.errors import end_if_requested, fail
from spacerobot_ros.cli.options import note_large_angles


@click.command("goal", context_settings={"ignore_unknown_options": True})
@click.argument("pose", nargs=-1, type=float, metavar="X Y Z [QX QY QZ QW]")
@click.option(
    "--rotvec", nargs=3, type=float, metavar="RX RY RZ", help="Attitude as a rotation vector (rad)."
)
@click.option(
    "--rpy-deg",
    nargs=3,
    type=float,
    metavar="ROLL PITCH YAW",
    help="Attitude by turns about the fixed axes x, y, z in this order (deg).",
)
@click.option("--namespace", default="", help="Namespace of the stack.")
@click.option(
    "--timeout", default=0.0, help="Longest wait for the result, s of wall time; 0: no limit."
)
def command(
    pose: tuple[float, ...],
    rotvec: tuple[float, float, float] | None,
    rpy_deg: tuple[float, float, float] | None,
    namespace: str,
    timeout: float,
) -> None:
    """Send a goal pose to a running stack, and wait for the result.

    Exit code 0: the goal was reached; 1: it was not; 2: bad input; 130: Ctrl-C has ended the
    command, and the stack still pursues the goal.
    """
    if len(pose) not in (3, 7):
        raise click.UsageError("A goal is X Y Z, or X Y Z QX QY QZ QW.")
    if rotvec and rpy_deg:
        raise click.UsageError("The attitude is given twice, in radians and in degrees.")
    from spacerobot_ros.planning import Goal

    wanted = Goal.checked(pose[:3], pose[3:] or (0.0, 0.0, 0.0, 1.0))
    if rotvec:
        note_large_angles(rotvec, "--rpy-deg")
        wanted = Goal.from_rotvec(pose[:3], rotvec)
    if rpy_deg:
        wanted = Goal.from_rpy(pose[:3], rpy_deg)
    from spacerobot_ros.flight.arrays import Outcome
    from spacerobot_ros.session.live import send_goal

    outcome = send_goal(wanted, click.echo, namespace=namespace, timeout=timeout)
    end_if_requested()
    if outcome is not Outcome.REACHED:
        fail()
