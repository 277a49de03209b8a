"""Joint commands that a plant of three sliders refuses: velocities, names, and the reason."""

from __future__ import annotations

import math

from support.plant_rig import SLIDERS

BAD_COMMANDS = {
    "NaN": ([math.nan, 0.1, 0.1], SLIDERS, "finite"),
    "infinite": ([0.1, 0.1, -math.inf], SLIDERS, "finite"),
    "infinities that cancel": ([math.inf, -math.inf, 0.1], SLIDERS, "finite"),
    "unknown joint": ([0.1, 0.1, 0.1], ["slider_1", "rudder", "slider_3"], "'rudder'"),
    "duplicate": ([0.1, 0.1, 0.1], ["slider_1", "slider_2", "slider_1"], "twice"),
    "too few velocities": ([0.1, 0.1], SLIDERS, "3 joint names and 2"),
    "too many velocities": ([0.1] * 4, SLIDERS, "3 joint names and 4"),
    "no velocities": ([], SLIDERS, "3 joint names and 0"),
    "no names": ([0.1, 0.1, 0.1], [], "joint 'slider_1' is missing"),
}
