"""Plans of ``optimal`` without its cache: by this checkout, another one, and a long search."""

from __future__ import annotations

import statistics
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from spacerobot_ros.benchmarks.checkouts import Checkout
from spacerobot_ros.benchmarks.measurements import CASES
from spacerobot_ros.model.description import Array
from spacerobot_ros.resources import robot_file

_SEED = 7

_LONGER = (1.01, 1.02, 1.03)
"""Ratios of durations below which goals are counted."""

_LARGE_ROBOTS = ("seven_joint_arm", "quadruped", "dual_arm")
"""Robots of 7, 12 and 14 joints."""

_NEXT = 3
"""Number of processes with the cache of the first one, of which medians are taken."""

Plans = Mapping[str, list[float]]


def planning_benchmark(
    goals: int,
    other: Path | None,
    starts: int | None,
    library: int | None,
    show: Callable[[str], None],
) -> dict[str, Any]:
    """Plan goals of several robots and return the figures by the robot's name.

    CPU times of one process at a time are compared: the machine's other load affects all alike.

    Parameters
    ----------
    goals
        Number of goals of each robot.
    other
        Folder of a checkout that plans the same goals; None: no comparison.
    starts
        Number of initial guesses of a long search, whose durations are compared; None: no search.
    library
        Number of other goals, with a library of whose manoeuvres the goals are planned as well;
        None: no library.
    show
        Called with lines for the user.

    Raises
    ------
    SpaceRobotError
        The other folder contains no checkout, or a measurement fails.
    """
    ours, theirs = Checkout.pair(other)
    figures: dict[str, Any] = {}
    for name in CASES:

        def planned(checkout: Checkout, name: str = name, **more: Any) -> Plans:
            urdf = str(robot_file(name))
            arguments = {"options": {}, **more}
            result: Plans = checkout.measure(
                "plans", urdf=urdf, case=name, count=goals, seed=_SEED, **arguments
            )
            return result

        plans = planned(ours)
        found: dict[str, Any] = {"median_cpu_s": statistics.median(plans["cpu_s"]), **plans}
        show(f"{name}: {found['median_cpu_s']:.3f} s of CPU time in the median of {goals} goals")
        plain = found["median_cpu_s"]
        if theirs is not None:
            before = planned(theirs)
            median = statistics.median(before["cpu_s"])
            found |= {"there": before, "times_faster": median / found["median_cpu_s"]}
            show(f"... there {median:.3f} s: {found['times_faster']:.2f} times faster here")
            plain = median
            found["durations_to_there"] = _compared(plans, before, "there", show)
        if library is not None:
            helped = planned(ours, library=library)
            median = statistics.median(helped["cpu_s"])
            found |= {"with_library": helped, "library_times_faster": plain / median}
            show(f"... with a library {median:.3f} s: {plain / median:.2f} times faster")
            _compared(helped, plans, "without it", show)
        if starts is not None:
            options = {"starts": starts, "answers": starts, "agreeing": 0}
            long = planned(ours, options=options)
            found |= {"long_search": long}
            words = f"by a search from {starts} guesses"
            found["durations_to_long_search"] = _compared(plans, long, words, show)
        figures[name] = found
    return figures


def _compared(
    plans: Plans, others: Plans, whose: str, show: Callable[[str], None]
) -> dict[str, float]:
    """Return figures of the durations beside those of others, and show them."""
    here, there = (np.array(each["duration_s"]) for each in (plans, others))
    figures = duration_figures(here, there)
    shares = ", ".join(
        f"{100 * figures[f'share_below_{limit:g}']:.0f} % at most {100 * (limit - 1):.0f} %"
        for limit in _LONGER
    )
    show(f"... durations beside those {whose}: {shares} longer; at most {figures['worst']:.3f}")
    return figures


def duration_figures(here: Array, there: Array) -> dict[str, float]:
    """Return shares of goals (K,) by the ratio of their durations, and the largest ratio.

    A goal that is refused (NaN) here alone counts as infinitely longer, there alone as shorter.
    """
    ratio = np.where(np.isnan(there), np.where(np.isnan(here), 1.0, 0.0), here / there)
    ratio = np.where(np.isnan(ratio), np.inf, ratio)
    shares = {f"share_below_{limit:g}": float(np.mean(ratio <= limit)) for limit in _LONGER}
    return {**shares, "worst": float(ratio.max()), "best": float(ratio.min())}


def first_plan_benchmark(other: Path | None, show: Callable[[str], None]) -> dict[str, Any]:
    """Plan one goal of robots with many joints, first with an empty cache, then in other processes.

    The CPU time includes the compiler's. The cache of plans is off: the other processes find only
    compiled equations.

    Parameters
    ----------
    other
        Folder of a checkout to compare with; None: no comparison.
    show
        Called with lines for the user.

    Returns
    -------
    By the name of the robot: its ``joints``; the CPU time in s of the process with an empty cache,
    ``first_cpu_s``; that of a next process, ``next_cpu_s``; the part of it beyond the plan itself,
    ``more_cpu_s``; ``there``: the same of the other checkout.

    Raises
    ------
    SpaceRobotError
        The other folder contains no checkout, or a plan fails.
    """
    ours, theirs = Checkout.pair(other)
    figures: dict[str, Any] = {}
    for name in _LARGE_ROBOTS:
        found = figures[name] = _first_plans(ours, name)
        show(f"{name}, {found['joints']} joints: {_line(found)}")
        if theirs is not None:
            found["there"] = _first_plans(theirs, name)
            show(f"... there {_line(found['there'])}")
    return figures


def _first_plans(checkout: Checkout, name: str) -> dict[str, Any]:
    with tempfile.TemporaryDirectory(prefix="spacerobot_") as cache:
        first, *others = (
            checkout.measure("first_plan", cache=cache, urdf=str(robot_file(name)))
            for _ in range(1 + _NEXT)
        )
    return {
        "joints": first["joints"],
        "first_cpu_s": first["cpu_s"],
        "next_cpu_s": statistics.median(each["cpu_s"] for each in others),
        "more_cpu_s": statistics.median(each["cpu_s"] - each["plan_cpu_s"] for each in others),
    }


def _line(figures: dict[str, Any]) -> str:
    first, following, more = (figures[f"{name}_cpu_s"] for name in ("first", "next", "more"))
    return (
        f"{first:.1f} s of CPU time from an empty cache to the first plan, {following:.2f} s in "
        f"the next process, {more:.2f} s more than the plan itself"
    )
