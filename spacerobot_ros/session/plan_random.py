"""Many random goals of one robot, planned by several methods and flown: how often, how fast."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from spacerobot_ros.errors import PlanningError
from spacerobot_ros.model.rotations import quaternion_from_rotvec, quaternion_multiply
from spacerobot_ros.planning import Goal
from spacerobot_ros.planning.methods.optimal.reach import Turning
from spacerobot_ros.session.plan import Problem, solve

_MET = 1e-5
"""A goal is met when the flight ends this near, rad and m."""


@dataclass
class Record:
    """What became of a method's goals: ``met`` and ``missed`` flights, ``refused`` ones with the
    sentence; manoeuvre and planning times of all that were flown, s.
    """

    method: str
    met: int = 0
    missed: int = 0
    refused: list[str] = field(default_factory=list)
    durations: list[float] = field(default_factory=list)
    plan_times: list[float] = field(default_factory=list)

    def line(self) -> str:
        """Return the figures for people."""
        goals = self.met + self.missed + len(self.refused)
        counts = f"{self.method:<14}{goals:>7}{self.met:>7}{self.missed:>8}{len(self.refused):>9}"
        if not self.durations:
            return counts
        low, middle, high = np.quantile(self.durations, [0.0, 0.5, 1.0])
        planned, longest = np.quantile(self.plan_times, [0.5, 1.0])
        return f"{counts}{low:>10.4g}{middle:>10.4g}{high:>10.4g}{planned:>11.3g}{longest:>9.3g}"


HEADING = (
    f"{'method':<14}{'goals':>7}{'met':>7}{'missed':>8}{'refused':>9}{'shortest':>10}{'median':>10}"
    f"{'longest':>10}{'planned in':>11}{'at most':>9}"
)


def random_goals(problem: Problem, count: int, distance: float, angle: float) -> list[Goal]:
    """Return goals within ``distance`` (m) and ``angle`` (rad) of the start, always the same ones.

    Planar robots are asked to turn about their axis; others about any, evenly.
    """
    rng = np.random.default_rng(0)
    start = problem.plant().pose
    axes = Turning.of(problem.robot).axes
    goals = []
    for _ in range(count):
        offset = rng.normal(size=3)
        offset *= distance * rng.uniform() ** (1 / 3) / np.linalg.norm(offset)
        axis = rng.normal(size=3)
        if len(axes) == 1:
            axis = axes[0] * math.copysign(1.0, axis[0])
        turn = rng.uniform(0.0, angle) * axis / np.linalg.norm(axis)
        attitude = quaternion_multiply(start[3:], quaternion_from_rotvec(turn))
        goals.append(replace(problem.goal, position=start[:3] + offset, quaternion=attitude))
    return goals


def fly_goals(
    problem: Problem,
    goals: Sequence[Goal],
    methods: Sequence[str],
    show: Callable[[str], None] = lambda line: None,
) -> list[Record]:
    """Plan every goal by every method, fly it in the plant, and return what became of it."""
    tight = {
        **problem.parameters,
        "position_tolerance": _MET,
        "attitude_tolerance": _MET,
        "joint_tolerance": _MET,
    }
    problem = replace(problem, parameters=tight)
    built = {name: problem.method(name) for name in methods}
    records = [Record(name) for name in methods]
    for number, goal in enumerate(goals, 1):
        for record in records:
            try:
                planned = solve(replace(problem, goal=goal), record.method, built[record.method])
            except PlanningError as refusal:
                record.refused.append(str(refusal))
                show(f"goal {number}, {record.method}: {refusal}")
                continue
            record.met += planned.succeeded
            record.missed += not planned.succeeded
            record.durations.append(planned.duration)
            record.plan_times.append(planned.plan_time)
            show(
                f"goal {number}, {record.method}: {planned.duration:.6g} s, "
                f"{planned.error.angle:.2g} rad and {planned.error.distance:.2g} m off"
            )
    return records
