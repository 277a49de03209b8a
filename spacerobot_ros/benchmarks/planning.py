"""How long the papers' gaits take to plan, once their methods are built."""

from __future__ import annotations

import statistics
import time
from collections.abc import Iterator

from spacerobot_ros.planning import PlanRequest
from spacerobot_ros.session.plan import problem, start_of

_GAITS = (
    ("sliding_masses", "lie_bracket"),
    ("arm_attitude", "area_loop"),
    ("planar_chain", "square_path"),
)
"""Scenarios of the papers, and the methods that are theirs."""

_REPEATS = 5


def planning_times() -> Iterator[tuple[str, float, float]]:
    """Yield for each method its name, and the first and the median time of a plan, s.

    ``area_loop`` plans one cycle at a time.
    """
    for scenario, name in _GAITS:
        task = problem(scenario)
        method = task.method(name)
        request = PlanRequest(start_of(task.plant()), task.goal, task.tolerance)
        times = []
        for _ in range(1 + _REPEATS):
            began = time.perf_counter()
            method.plan(request)
            times.append(time.perf_counter() - began)
        yield name, times[0], statistics.median(times[1:])
