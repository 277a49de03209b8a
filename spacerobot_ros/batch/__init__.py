"""Thousands of flights at once: the plant on vector registers, a flight in each lane."""

from spacerobot_ros.batch.flights import (
    BatchResult,
    Controlled,
    Decision,
    FlightProgram,
    Flights,
    FollowedSchedule,
    HeldCommands,
    SensorErrors,
    Starts,
)
from spacerobot_ros.batch.lanes import fly_lanes
from spacerobot_ros.batch.scalar import fly_one_by_one

__all__ = [
    "BatchResult",
    "Controlled",
    "Decision",
    "FlightProgram",
    "Flights",
    "FollowedSchedule",
    "HeldCommands",
    "SensorErrors",
    "Starts",
    "fly_lanes",
    "fly_one_by_one",
]
