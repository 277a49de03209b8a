"""Cold plans of ``optimal`` by this checkout, by another one, and by a long search."""

from __future__ import annotations

import json
import statistics
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from spacerobot_ros.benchmarks import planning_goals
from spacerobot_ros.benchmarks.against import Checkout
from spacerobot_ros.model.description import Array
from spacerobot_ros.resources import share_directory

_SEED = 7

_LONGER = (1.01, 1.02, 1.03)
"""Ratios of durations below which goals are counted."""

Plans = Mapping[str, list[float]]


def run_planning_benchmark(
    goals: int,
    other: Path | None,
    starts: int | None,
    library: int | None,
    show: Callable[[str], None],
) -> dict[str, Any]:
    """Plan goals of every robot and return the figures by its name.

    CPU time is compared, with one process at a time: what else the machine does falls on all.

    Parameters
    ----------
    goals
        How many of each robot.
    other
        Folder of a checkout that plans the same goals; None: of none.
    starts
        Compare durations with those of a search from so many guesses; None: do not.
    library
        Plan with a library of the manoeuvres to so many other goals, too; None: do not.
    show
        Called with lines for people.

    Raises
    ------
    SpaceRobotError
        There is no such checkout, or a benchmark fails.
    """
    ours, theirs = Checkout.pair(other)
    figures: dict[str, Any] = {}
    for name in planning_goals.CASES:
        plans = _plans(ours, name, goals, {})
        found: dict[str, Any] = {"median_cpu_s": statistics.median(plans["cpu_s"]), **plans}
        show(f"{name}: {found['median_cpu_s']:.3f} s of CPU time in the median of {goals} goals")
        plain = found["median_cpu_s"]
        if theirs is not None:
            before = _plans(theirs, name, goals, {})
            median = statistics.median(before["cpu_s"])
            found |= {"there": before, "times_faster": median / found["median_cpu_s"]}
            show(f"... there {median:.3f} s: {found['times_faster']:.2f} times faster here")
            plain = median
            found["durations_to_there"] = _compared(plans, before, "there", show)
        if library is not None:
            helped = _plans(ours, name, goals, {}, library)
            median = statistics.median(helped["cpu_s"])
            found |= {"with_library": helped, "library_times_faster": plain / median}
            show(f"... with a library {median:.3f} s: {plain / median:.2f} times faster")
            _compared(helped, plans, "without it", show)
        if starts is not None:
            options = {"starts": starts, "answers": starts, "agreeing": 0}
            long = _plans(ours, name, goals, options)
            found |= {"long_search": long}
            words = f"by a search from {starts} guesses"
            found["durations_to_long_search"] = _compared(plans, long, words, show)
        figures[name] = found
    return figures


def _plans(
    checkout: Checkout, name: str, goals: int, options: Mapping[str, Any], library: int = 0
) -> Plans:
    """Return CPU times and durations of the plans that a checkout makes."""
    urdf = share_directory() / "urdf" / f"{name}.urdf"
    words = [str(urdf), name, str(goals), str(_SEED), json.dumps(options), str(library)]
    plans: Plans = checkout.run([str(planning_goals.__file__), *words])
    return plans


def _compared(
    plans: Plans, others: Plans, whose: str, show: Callable[[str], None]
) -> dict[str, float]:
    """Return how the durations compare, and show it."""
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
