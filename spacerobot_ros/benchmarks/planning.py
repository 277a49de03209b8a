"""Plans of ``optimal`` without its cache, compared with another checkout and with a long search."""

from __future__ import annotations

import re
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

_GOAL_SEED = 7

_DURATION_RATIO_BOUNDS = (1.01, 1.02, 1.03)
"""Bounds of duration ratios; goals with ratios below each bound are counted."""

_BOUND = re.compile(r"takes less than \S+ s|no nearer than \S+ m|keeps it in \[[^]]*\]")
"""The bound in a refusal: of the duration, of the distance, or of a joint."""

_LARGE_ROBOTS = ("seven_joint_arm", "quadruped", "dual_arm")
"""Robots with 7, 12 and 14 joints in the benchmark of first plans."""

_PROCESSES_AFTER_FIRST = 3
"""Number of processes after the first one, which use its cache; medians are taken."""

Plans = Mapping[str, list[float]]


def planning_benchmark(
    goals: int,
    other: Path | None,
    starts: int | None,
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
        plans = _measured_plans(ours, name, goals)
        here = statistics.median(plans["cpu_s"])
        slowest = max(plans["cpu_s"]) / here
        robot = figures[name] = {"median_cpu_s": here, "slowest_to_median": slowest, **plans}
        show(
            f"{name}: {here:.3f} s of CPU time in the median of {goals} goals, the slowest "
            f"{slowest:.1f} times as long"
        )
        if theirs is not None:
            robot["there"] = _measured_plans(theirs, name, goals)
            there = statistics.median(robot["there"]["cpu_s"])
            robot["times_faster"] = there / here
            show(f"... there {there:.3f} s: {there / here:.2f} times faster here")
            robot["durations_to_there"] = _compare_durations(plans, robot["there"], "there", show)
        if starts is not None:
            options = {"starts": starts, "answers": starts, "agreeing": 0}
            robot["long_search"] = _measured_plans(ours, name, goals, options=options)
            robot["durations_to_long_search"] = _compare_durations(
                plans, robot["long_search"], f"by a search from {starts} guesses", show
            )
    return figures


def refusals_benchmark(
    goals: int, other: Path | None, show: Callable[[str], None]
) -> dict[str, Any]:
    """Plan for goals of several robots that cannot be reached; return the figures by the robot.

    Parameters
    ----------
    goals
        Number of goals of each robot: each is asked for in too short a time, as the longest and as
        the wanted duration, and out of reach.
    other
        Folder of a checkout that plans for the same goals; None: no comparison.
    show
        Called with lines for the user.

    Returns
    -------
    By the name of the robot, of each goal: ``cpu_s``, ``sign_s`` and ``reason`` of
    :func:`.measurements.refusals`; ``bound``, the bound that the reason names, if it names one;
    ``there``: the same of the other checkout.

    Raises
    ------
    SpaceRobotError
        The other folder contains no checkout, or a measurement fails.
    """
    ours, theirs = Checkout.pair(other)
    figures: dict[str, Any] = {}
    for name in CASES:
        urdf = str(robot_file(name))
        given: dict[str, Any] = {"urdf": urdf, "case": name, "count": goals, "seed": _GOAL_SEED}
        found = figures[name] = _with_bounds(ours.measure("refusals", **given))
        show(f"{name}: {_refusals_text(found)}")
        if theirs is not None:
            found["there"] = _with_bounds(theirs.measure("refusals", **given))
            show(f"... there {_refusals_text(found['there'])}")
        for reason in dict.fromkeys(filter(None, found["reason"])):
            show(f"... {reason}")
    return figures


def _with_bounds(found: dict[str, Any]) -> dict[str, Any]:
    """Return figures of refusals with the bound in each reason, or an empty text."""
    matches = [_BOUND.search(reason) for reason in found["reason"]]
    return {**found, "bound": [match[0] if match else "" for match in matches]}


def _refusals_text(found: Mapping[str, Any]) -> str:
    count = len(found["reason"])
    # A robot whose position is not controlled reaches a goal that is moved.
    refused = [k for k, reason in enumerate(found["reason"]) if reason]
    if not refused:
        return f"none of {count} goals refused"
    slowest, sign = (max(found[name][k] for k in refused) for name in ("cpu_s", "sign_s"))
    return (
        f"{len(refused)} of {count} goals refused, the slowest after {slowest:.2f} s of CPU time, "
        f"a first line after {sign:.2f} s at most, {sum(map(bool, found['bound']))} with a bound"
    )


def _measured_plans(checkout: Checkout, robot: str, goals: int, **arguments: Any) -> Plans:
    """Return the plans of a number of goals; ``arguments`` are further ones of ``plans``."""
    arguments = {"options": {}, **arguments}
    plans: Plans = checkout.measure(
        "plans", urdf=str(robot_file(robot)), case=robot, count=goals, seed=_GOAL_SEED, **arguments
    )
    return plans


def _compare_durations(
    plans: Plans, others: Plans, whose: str, show: Callable[[str], None]
) -> dict[str, float]:
    """Return and show figures that compare plan durations with those of other plans."""
    here, there = (np.array(each["duration_s"]) for each in (plans, others))
    figures = duration_figures(here, there)
    shares = ", ".join(
        f"{100 * figures[f'share_below_{limit:g}']:.0f} % at most {100 * (limit - 1):.0f} %"
        for limit in _DURATION_RATIO_BOUNDS
    )
    show(f"... durations beside those {whose}: {shares} longer; at most {figures['worst']:.3f}")
    return figures


def duration_figures(here: Array, there: Array) -> dict[str, float]:
    """Return shares of goals (K,) by the ratio of their durations, and the largest ratio.

    A goal that is refused (NaN) here alone counts as infinitely longer, there alone as shorter.
    """
    ratio = np.where(np.isnan(there), np.where(np.isnan(here), 1.0, 0.0), here / there)
    ratio = np.where(np.isnan(ratio), np.inf, ratio)
    shares = {
        f"share_below_{limit:g}": float(np.mean(ratio <= limit)) for limit in _DURATION_RATIO_BOUNDS
    }
    return {**shares, "worst": float(ratio.max()), "best": float(ratio.min())}


def first_plan_benchmark(other: Path | None, show: Callable[[str], None]) -> dict[str, Any]:
    """Plan one goal of robots with many joints, first with an empty cache, then in other processes.

    The CPU time includes the compiler's, and the import from byte code. The cache of plans is off:
    the other processes find only compiled equations.

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
        robot = figures[name] = _first_plans(ours, name)
        show(f"{name}, {robot['joints']} joints: {_first_plan_text(robot)}")
        if theirs is not None:
            robot["there"] = _first_plans(theirs, name)
            show(f"... there {_first_plan_text(robot['there'])}")
    return figures


def _first_plans(checkout: Checkout, name: str) -> dict[str, Any]:
    urdf = str(robot_file(name))
    with tempfile.TemporaryDirectory(prefix="spacerobot_") as folder:
        _, first, *others = (
            # The first process is there to write the byte code: its cache is not used again.
            checkout.measure("first_plan", cache=f"{folder}/{cache}", byte_code=folder, urdf=urdf)
            for cache in ("unused", *["used"] * (1 + _PROCESSES_AFTER_FIRST))
        )
    return {
        "joints": first["joints"],
        "first_cpu_s": first["cpu_s"],
        "next_cpu_s": statistics.median(each["cpu_s"] for each in others),
        "more_cpu_s": statistics.median(each["cpu_s"] - each["plan_cpu_s"] for each in others),
    }


def _first_plan_text(figures: dict[str, Any]) -> str:
    first, following, more = (figures[f"{name}_cpu_s"] for name in ("first", "next", "more"))
    return (
        f"{first:.1f} s of CPU time from an empty cache to the first plan, {following:.2f} s in "
        f"the next process, {more:.2f} s more than the plan itself"
    )
