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
    "--rate", default=1.0, show_default=True, metavar="FACTOR", help="Bag time over wall time."
)
@click.option(
    "--start", default=0.0, metavar="SECONDS", help="Where to begin, from the first message."
)
@click.option("--duration", default=0.0, metavar="SECONDS", help="How much to replay [all].")
@click.option("--loop", is_flag=True, help="Begin again at the end.")
@click.option("--topic", "topics", multiple=True, metavar="TOPIC", help="Replay this one [all].")
@click.option("--remap", multiple=True, metavar="OLD:=NEW", help="Publish a topic as another.")
@click.option(
    "--clock",
    is_flag=False,
    flag_value=100.0,
    default=0.0,
    type=float,
    metavar="[HZ]",
    help="Publish bag time on /clock, 100 times a second unless told [what the bag has].",
)
@click.option("--paused", is_flag=True, help="Begin paused; see the services of the node.")
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
    """Publish what a BAG holds on its topics, in the rhythm in which it was recorded.

    While it lasts, its services /replay/pause, /replay/resume and /replay/step steer it. With
    --view it stands still at the end, until Ctrl-C, and can be played again.
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
