"""The parameters of the viewer."""

from __future__ import annotations

from dataclasses import dataclass

from spacerobot_ros.model.shared_parameters import WatchdogConfig
from spacerobot_ros.parameters import parameter


@dataclass(frozen=True)
class ViewerConfig(WatchdogConfig):
    """Where the page is, and how often it is drawn."""

    host: str = parameter(
        "127.0.0.1",
        "address that the page is served at; any other one lets other machines steer the robot",
    )
    port: int = parameter(
        8080,
        "port of the page, or the next free one; 0: any",
        minimum=0,
        maximum=65535,
    )
    update_rate: float = parameter(
        20.0, "how often the page is drawn, wall time", unit="Hz", minimum=1.0, maximum=60.0
    )
    dark: bool = parameter(False, "whether pages are dark when they are opened")
    world_frame: str = parameter("world", "frame of the goals that the page sends")
    check_goals: bool = parameter(
        True, "plan for the goal that is shown, to tell whether it is reachable before it is sent"
    )
