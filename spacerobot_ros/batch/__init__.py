"""Thousands of simultaneous flights in SIMD lanes, one flight per lane of a vector register."""

from spacerobot_ros.batch.flights import (
    BatchResult,
    ControlledGoals,
    FlightProgram,
    Flights,
    FollowedSchedule,
    HeldCommands,
    InitialStates,
    SensorErrors,
)
from spacerobot_ros.batch.lanes import fly_lanes
from spacerobot_ros.batch.stepping import SteppedFlights
from spacerobot_ros.control.goal_monitor import Decision

__all__ = [
    "BatchResult",
    "ControlledGoals",
    "Decision",
    "FlightProgram",
    "Flights",
    "FollowedSchedule",
    "HeldCommands",
    "InitialStates",
    "SensorErrors",
    "SteppedFlights",
    "fly_lanes",
]
