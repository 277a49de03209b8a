"""Cold plans of ``optimal``: what they cost, and how long the manoeuvres are.

This file is also run by itself, with the package of another checkout (:mod:`.planning`): it uses
only what both have.
"""

from __future__ import annotations

import json
import math
import os
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

from spacerobot_ros.errors import PlanningError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.rotations import matrix_from_quaternion, quaternion_from_rotvec
from spacerobot_ros.planning import Goal, PlanRequest, RobotState, Tolerance
from spacerobot_ros.planning.methods.optimal.method import OptimalGait
from spacerobot_ros.planning.methods.optimal.options import OptimalOptions

_PERIOD = 0.05
_LEAST = 0.05
_SCATTER = 0.3


@dataclass(frozen=True)
class Case:
    """A robot, the shape that its goals start near, and its options.

    Goals are turned by up to ``angle``, rad; ``planar`` ones about the third axis. Of ``sliding``
    ones the position counts, too.
    """

    start: tuple[float, ...]
    options: dict[str, Any]
    angle: float = 1.0
    planar: bool = False
    sliding: bool = False


CASES = {
    "planar_chain": Case((0.0, 0.0), {}, angle=3.0, planar=True),
    "sliding_masses": Case(
        (0.0, 0.0, 0.0),
        {
            "max_velocity": (0.0647, 0.1871, 0.6550),
            "max_acceleration": (0.228, 0.643, 3.564),
        },
        sliding=True,
    ),
    "three_joint_arm": Case((0.0, -math.pi / 4, math.pi / 2), {}),
    "servicer": Case((0.0, -1.2, 2.0, 0.0, 0.8, 0.0), {}),
}
"""By the names of their robots."""


def requests(robot: SpaceRobot, case: Case, count: int, seed: int) -> Iterator[PlanRequest]:
    """Yield goals of a case, always the same ones."""
    rng = np.random.default_rng(seed)
    for _ in range(count):
        scattered = np.array(case.start) + rng.uniform(-_SCATTER, _SCATTER, robot.n)
        q = np.clip(scattered, robot.lower, robot.upper)
        axis = rng.normal(size=3)
        if case.planar:
            axis = np.array([0.0, 0.0, axis[2]])
        turn = quaternion_from_rotvec(axis / np.linalg.norm(axis) * rng.uniform(_LEAST, case.angle))
        position = np.zeros(3)
        if case.sliding:
            last = np.clip(q + rng.uniform(-1.0, 1.0, robot.n), robot.lower, robot.upper)
            there = matrix_from_quaternion(turn) @ robot.center_of_mass(last)
            position = robot.center_of_mass(q) - there
        state = RobotState(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), q)
        yield PlanRequest(state, Goal.checked(position, turn), Tolerance(2e-3, 2e-3))


def measure(
    urdf: Path, case: Case, count: int, seed: int, options: dict[str, Any], library: int = 0
) -> dict[str, list[float]]:
    """Return the CPU time (s) and the duration (s; NaN: refused) of every plan.

    What is built for the first of all goals is not counted, nor is a library of the manoeuvres to
    so many other goals.
    """
    robot = SpaceRobot.from_file(urdf)
    chosen = {**case.options, **options, "cache": 0}
    if OptimalOptions().time_budget > 0:
        # Of a version whose plans depend on the machine: as on one that is quick enough.
        chosen["time_budget"] = 1e6
    method = OptimalGait(robot, _PERIOD, options=OptimalOptions(**chosen))
    warm, *goals = requests(robot, case, count + 1, seed)
    if library:
        made = method.made_library(requests(robot, case, library, seed + 1))
        assert made is not None
        with tempfile.TemporaryDirectory(prefix="spacerobot_") as folder:
            file = Path(folder, "library.npz")
            file.write_bytes(made.to_bytes())
            chosen["library"] = str(file)
            method = OptimalGait(robot, _PERIOD, options=OptimalOptions(**chosen))
    times: list[float] = []
    durations: list[float] = []
    for request in (warm, *goals):
        began = time.process_time()
        try:
            duration = method.plan(request).duration
        except PlanningError:
            duration = math.nan
        times.append(time.process_time() - began)
        durations.append(duration)
    return {"cpu_s": times[1:], "duration_s": durations[1:]}


if __name__ == "__main__":
    urdf_of, name, number, first, more, others, result = sys.argv[1:]
    found = measure(
        Path(urdf_of), CASES[name], int(number), int(first), json.loads(more), int(others)
    )
    Path(result).write_text(json.dumps(found), encoding="utf-8")
