"""The options of ``optimal``."""

from __future__ import annotations

import math
from dataclasses import dataclass

from spacerobot_ros.parameters import parameter


@dataclass(frozen=True)
class OptimalOptions:
    """The options of ``optimal``."""

    duration: float = parameter(
        0.0,
        "duration of a manoeuvre of least effort; 0: as fast as possible",
        unit="s",
        minimum=0.0,
        maximum=1e9,
    )
    max_velocity: tuple[float, ...] = parameter(
        (),
        "speed limit of every joint, below the URDF's; []: the URDF's",
        unit="m/s or rad/s",
        minimum=0.0,
        maximum=1e9,
        of_joints=True,
    )
    max_acceleration: tuple[float, ...] = parameter(
        (),
        "acceleration limit of every joint; []: by ramp_time",
        unit="m/s^2 or rad/s^2",
        minimum=0.0,
        maximum=1e9,
        of_joints=True,
    )
    ramp_time: float = parameter(
        0.5,
        "time from rest to full speed, without max_acceleration",
        unit="s",
        minimum=1e-6,
        maximum=1e9,
    )
    effort_limits: int = parameter(
        0,
        "efforts of the joints within their limits: 0: where the planner's output is a reference "
        "for a controller, 1: always, 2: never",
        minimum=0,
        maximum=2,
    )
    max_effort: tuple[float, ...] = parameter(
        (),
        "effort limit of every joint, below the URDF's; []: the URDF's",
        unit="N or N m",
        minimum=0.0,
        maximum=1e12,
        of_joints=True,
    )
    effort_reserve: float = parameter(
        0.15,
        "share of the effort limits that is left to the feedback of the controller",
        minimum=0.0,
        maximum=0.95,
    )
    joint_margin: tuple[float, ...] = parameter(
        (),
        "distance of every joint to its limits, not in corrections; []: none",
        unit="m or rad",
        minimum=0.0,
        maximum=1e9,
        of_joints=True,
    )
    base_position: int = parameter(
        0, "0: reached if sliders can, 1: reached, 2: ignored", minimum=0, maximum=2
    )
    base_attitude: int = parameter(1, "1: reached, 0: ignored", minimum=0, maximum=1)
    final_shape: int = parameter(
        0, "of goals without a shape: 0: any, 1: the present one", minimum=0, maximum=1
    )
    max_base_rate: float = parameter(
        0.0, "fastest turn of the base; 0: any", unit="rad/s", minimum=0.0, maximum=1e9
    )
    keep_axis: tuple[float, ...] = parameter(
        (), "direction in the base, away from keep_direction; []: none", minimum=-1e9, maximum=1e9
    )
    keep_direction: tuple[float, ...] = parameter(
        (), "direction in the world that keep_axis stays away from", minimum=-1e9, maximum=1e9
    )
    keep_angle: float = parameter(
        0.0, "angle that keep_axis stays away by", unit="rad", minimum=0.0, maximum=math.pi
    )
    keep_out: tuple[float, ...] = parameter(
        (),
        "boxes that the shape avoids: lower, then upper corner",
        unit="m or rad",
        minimum=-1e9,
        maximum=1e9,
    )
    intervals: int = parameter(
        80, "steps of the optimal control problem", minimum=10, maximum=10000
    )
    starts: int = parameter(24, "guesses that are tried at most", minimum=1, maximum=10000)
    answers: int = parameter(
        16,
        "solutions to find, unless starts agree before; several are found on a coarse grid, and "
        "the best of them is refined",
        minimum=1,
        maximum=10000,
    )
    agreeing: int = parameter(
        3,
        "solutions that are the best one and end the search; 0: only answers and starts do",
        minimum=0,
        maximum=10000,
    )
    iterations: int = parameter(
        300, "steps of the solver from one guess at most", minimum=1, maximum=100000
    )
    time_budget: float = parameter(
        0.0,
        "wall time to search, 5 times that if nothing is found; 0: no limit. A plan that it cuts "
        "short depends on how busy the machine is",
        unit="s",
        minimum=0.0,
        maximum=1e9,
    )
    longest: float = parameter(
        3600.0, "longest manoeuvre that is still planned", unit="s", minimum=1.0, maximum=1e9
    )
    library: str = parameter(
        "", "file of spacerobot library with manoeuvres to begin with; '': that of the cache"
    )
    cache: int = parameter(1, "1: manoeuvres are kept on disk", minimum=0, maximum=1)
