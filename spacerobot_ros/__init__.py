"""A ROS 2 flight stack for free-floating and free-flying space robots."""

from __future__ import annotations

import logging
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

_MIN_SHARED_MEMORY = 16 * 2**10
"""Minimum free shared memory in bytes; with less, loading ROS ends the process."""


def _warn_of_full_shared_memory() -> None:
    """Warn of full shared memory, in which the tracing of ROS ends the process with SIGBUS."""
    try:
        facts = os.statvfs("/dev/shm")
    except OSError:
        return
    if facts.f_blocks and facts.f_bavail * facts.f_frsize < _MIN_SHARED_MEMORY:
        logging.getLogger(__name__).warning(
            "/dev/shm is full: ROS may end here with SIGBUS (bus error). Free space in /dev/shm; "
            "fastrtps_* files left by killed processes may be deleted while nothing runs."
        )


_warn_of_full_shared_memory()

if os.environ.get("SPACEROBOT_PLUGINS"):
    from spacerobot_ros.registry import import_plugins

    import_plugins()
