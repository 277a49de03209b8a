"""A ROS 2 flight stack for free-floating and free-flying space robots."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

from spacerobot_ros.resources import __version__, lazy_names

if TYPE_CHECKING:
    from spacerobot_ros.bag import read_bag
    from spacerobot_ros.campaign.running import sweep
    from spacerobot_ros.flight.api import fly, plan
    from spacerobot_ros.flight.reading import read_run
    from spacerobot_ros.scenario import load_scenario

__all__ = ["__version__", "fly", "load_scenario", "plan", "read_bag", "read_run", "sweep"]


__getattr__ = lazy_names(
    __name__,
    {
        "bag": ["read_bag"],
        "campaign.running": ["sweep"],
        "flight.api": ["fly", "plan"],
        "flight.reading": ["read_run"],
        "scenario": ["load_scenario"],
    },
)

if os.environ.get("SPACEROBOT_PLUGINS"):
    from spacerobot_ros.registry import import_plugins

    import_plugins()
