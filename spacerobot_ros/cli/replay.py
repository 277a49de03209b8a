"""The command ``spacerobot replay``."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import click

from spacerobot_ros.cli.options import bag_argument, view_option, viewing_if


@click.command("replay")
@bag_argument
@click.option(
    "--rate", default=1.0, show_default=True, metavar="FACTOR", help="Bag time per wall time."
)
@click.option(
    "--start",
    default=0.0,
    metavar="SECONDS",
    help="Where to begin, counted from the first message.",
)
@click.option("--duration", default=0.0, metavar="SECONDS", help="How much to replay [all].")
@click.option("--loop", is_flag=True, help="Begin again at the end.")
@click.option(
    "--topic",
    "topics",
    multiple=True,
    metavar="TOPIC",
    help="Replay only this topic [all]. May be repeated.",
)
@click.option(
    "--remap", multiple=True, metavar="OLD:=NEW", help="Publish topic OLD as NEW. May be repeated."
)
@click.option(
    "--clock",
    is_flag=False,
    flag_value=100.0,
    default=0.0,
    type=float,
    metavar="[HZ]",
    help="Publish bag time on /clock HZ times a second (100 without a number) [as recorded].",
)
@click.option("--paused", is_flag=True, help="Begin paused.")
@view_option
@click.option("--wait", default=3.0, show_default=True, help="Longest wait for readers (s).")
def command(
    bag: Path,
    rate: float,
    start: float,
    duration: float,
    loop: bool,
    topics: tuple[str, ...],
    remap: tuple[str, ...],
    clock: float,
    paused: bool,
    wait: float,
    view: bool,
) -> None:
    """Publish the messages of a BAG again, at their recorded times.

    The services /replay/pause, /replay/resume and /replay/step control it. With --view it stays
    paused at the end until Ctrl-C, and can be played again.
    """
    values: dict[str, Any] = {
        "bag": str(bag),
        "rate": rate,
        "start": start,
        "duration": duration,
        "loop": loop,
        "topics": " ".join(topics),
        "remap": " ".join(remap),
        "clock": clock,
        "paused": paused,
        "wait": wait,
        "hold": view,
    }
    from rclpy.parameter import Parameter

    from spacerobot_ros.nodes import ReplayNode
    from spacerobot_ros.nodes.common.process import run_node

    given = [Parameter(name, value=value) for name, value in values.items()]
    with viewing_if(view, {}):
        code = run_node(lambda: ReplayNode(parameter_overrides=given), [])
    sys.exit(code)
