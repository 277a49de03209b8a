"""Thrusters as flight software: their table, allocation of a wrench, pulse modulation.

A node of a real robot needs no plant for it::

    table = find_thrusters("urdf", robot.description)
    modulator = ThrusterModulator(table, control_period=0.01)
    on_time = modulator.fire(wrench)  # (m,) s, for the valves; every period
"""

from spacerobot_ros.control.thrusters.modulator import (
    Allocation,
    ThrusterAllocation,
    ThrusterModulator,
)
from spacerobot_ros.control.thrusters.table import (
    IN_URDF,
    ThrusterTable,
    find_thrusters,
    load_thrusters,
    thrusters_of_urdf,
)

__all__ = [
    "IN_URDF",
    "Allocation",
    "ThrusterAllocation",
    "ThrusterModulator",
    "ThrusterTable",
    "find_thrusters",
    "load_thrusters",
    "thrusters_of_urdf",
]
