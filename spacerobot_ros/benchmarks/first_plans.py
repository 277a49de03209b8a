"""CPU time of the first plan of a robot: with an empty cache, and in the next process.

This file is also run by itself, with the package of another checkout. So it uses only what both
checkouts have.
"""

from __future__ import annotations

import json
import os
import resource
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from spacerobot_ros.benchmarks.against import Checkout

ROBOTS = ("seven_joint_arm", "quadruped", "dual_arm")
"""Robots of 7, 12 and 14 joints."""

_PERIOD = 0.05
_TURN = (0.1, -0.15, 0.2)
_NEXT = 3
"""Number of processes that plan with the cache of the first one, of which medians are taken."""


def run_first_plan_benchmark(other: Path | None, show: Callable[[str], None]) -> dict[str, Any]:
    """Plan one goal of robots with many joints, first with an empty cache, then in other processes.

    CPU time is measured, with that of the compiler. The cache of plans is off: the other processes
    find only compiled equations.

    Parameters
    ----------
    other
        Folder of a checkout to compare with; None: there is none.
    show
        Called with lines for people.

    Returns
    -------
    By the name of the robot: its ``joints``; the CPU time in s of the process with an empty cache,
    ``first_cpu_s``; that of a next process, ``next_cpu_s``; how much of that is not the plan
    itself, ``more_cpu_s``; ``there``: the same of the other checkout.

    Raises
    ------
    SpaceRobotError
        There is no such checkout, or a plan fails.
    """
    from spacerobot_ros.benchmarks.against import Checkout

    ours, theirs = Checkout.pair(other)
    figures: dict[str, Any] = {}
    for name in ROBOTS:
        found = figures[name] = _measured(ours, name)
        show(f"{name}, {found['joints']} joints: {_sentence(found)}")
        if theirs is not None:
            found["there"] = _measured(theirs, name)
            show(f"... there {_sentence(found['there'])}")
    return figures


def _measured(checkout: Checkout, name: str) -> dict[str, Any]:
    """Return the figures of a robot by a checkout."""
    from spacerobot_ros.resources import robot_file

    with tempfile.TemporaryDirectory(prefix="spacerobot_") as cache:
        words = [str(Path(__file__)), str(robot_file(name)), cache]
        first, *others = (checkout.run(words) for _ in range(1 + _NEXT))
    return {
        "joints": first["joints"],
        "first_cpu_s": first["cpu_s"],
        "next_cpu_s": statistics.median(each["cpu_s"] for each in others),
        "more_cpu_s": statistics.median(each["cpu_s"] - each["plan_cpu_s"] for each in others),
    }


def _sentence(figures: dict[str, Any]) -> str:
    first, following, more = (figures[f"{name}_cpu_s"] for name in ("first", "next", "more"))
    return (
        f"{first:.1f} s of CPU time from an empty cache to the first plan, {following:.2f} s in "
        f"the next process, {more:.2f} s more than the plan itself"
    )


def first_plan(urdf: Path) -> dict[str, float]:
    """Return figures of the first plan in this process.

    They are the number of ``joints``, the CPU time of this process and of its compilers until the
    plan is there, ``cpu_s``, and that of the same plan when all is loaded, ``plan_cpu_s``.
    """
    import numpy as np

    from spacerobot_ros.model import SpaceRobot
    from spacerobot_ros.model.rotations import quaternion_from_rotvec
    from spacerobot_ros.planning import Goal, PlanRequest, RobotState, Tolerance
    from spacerobot_ros.planning.methods.optimal.method import OptimalGait
    from spacerobot_ros.planning.methods.optimal.options import OptimalOptions

    robot = SpaceRobot.from_file(urdf)
    method = OptimalGait(robot, _PERIOD, options=OptimalOptions(cache=0))
    q = np.clip(np.zeros(robot.n), robot.lower, robot.upper)
    state = RobotState(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), q)
    goal = Goal.checked(np.zeros(3), quaternion_from_rotvec(_TURN))
    request = PlanRequest(state, goal, Tolerance(2e-3, 2e-3))
    method.plan(request)
    used = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    total = sum(each.ru_utime + each.ru_stime for each in used)
    began = time.process_time()
    method.plan(request)
    return {
        "joints": robot.n,
        "cpu_s": total,
        "plan_cpu_s": time.process_time() - began,
    }


if __name__ == "__main__":
    urdf_of, os.environ["SPACEROBOT_CACHE_DIR"], result = sys.argv[1:]
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    Path(result).write_text(json.dumps(first_plan(Path(urdf_of))), encoding="utf-8")
