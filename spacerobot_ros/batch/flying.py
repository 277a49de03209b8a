"""The batch engine: flights in lanes where the machine has them, one by one elsewhere."""

from __future__ import annotations

from spacerobot_ros.batch.flights import BatchResult, Flights
from spacerobot_ros.batch.lanes import fly_in_lanes
from spacerobot_ros.batch.scalar import fly_one_by_one
from spacerobot_ros.model.compilation import NoLibraryError
from spacerobot_ros.private_files import warn_once


def fly_lanes(flights: Flights) -> BatchResult:
    """Fly many flights at once.

    Every flight is the one that the plant flies on its own with the same numbers, to rounding
    (1e-12 over the flights of the benchmark). Without a C++ compiler the plant flies them one by
    one; :attr:`BatchResult.engine` says so.
    """
    try:
        return fly_in_lanes(flights)
    except NoLibraryError as reason:
        warn_once(f"Flights are flown one by one, not in lanes: {reason}.")
        return fly_one_by_one(flights)
