"""Random goals of six robots: with clearance, plans keep it, and most of the others stay.

Distances are those of Pinocchio and coal at 400 instants of the held commands.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import pinocchio
import pytest
from scipy.spatial.transform import Rotation

from spacerobot_ros.errors import PlanningError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.planning import (
    GaitSchedule,
    Goal,
    PlanRequest,
    RobotState,
    Tolerance,
    method_options,
)
from spacerobot_ros.planning.core.clearance import Clearance
from spacerobot_ros.planning.methods.optimal import OptimalGait
from spacerobot_ros.resources import robot_file, share_directory

GOALS = int(os.environ.get("SPACEROBOT_CLEAR_GOALS", "2"))
CLEARANCE = 0.01
ROBOTS = ("three_joint_arm", "seven_joint_arm", "servicer", "surveyor", "quadruped", "dual_arm")


class Distances:
    """Distances of a robot by Pinocchio, whose model has the convex hulls of meshes."""

    def __init__(
        self, robot: SpaceRobot, clearance: Clearance, start: Array, packages: Path
    ) -> None:
        path = str(robot_file(robot.description.name))
        self._model = pinocchio.buildModelFromUrdf(path)
        # Paths of meshes begin with the name of the package, whatever the folder's name is.
        (packages / "spacerobot_ros").symlink_to(share_directory())
        simple = "<collision>" in Path(path).read_text()
        kinds = pinocchio.GeometryType
        kind = kinds.COLLISION if simple else kinds.VISUAL
        self._solids = pinocchio.buildGeomFromUrdf(
            self._model, path, kind, package_dirs=[str(packages)]
        )
        for each in self._solids.geometryObjects:
            if hasattr(each.geometry, "buildConvexHull"):
                each.geometry.buildConvexHull(True, "Qt")
                each.geometry = each.geometry.convex
        required, geometry = clearance.required(start), clearance.geometry
        looked_at = {
            frozenset(geometry.links_of(p)) for p in range(len(required)) if required[p] > -np.inf
        }
        names = [each.name.rsplit("_", 1)[0] for each in self._solids.geometryObjects]
        for i, first in enumerate(names):
            for j, second in enumerate(names[:i]):
                if frozenset({first, second}) in looked_at:
                    self._solids.addCollisionPair(pinocchio.CollisionPair(j, i))
        self._order = [robot.joint_names.index(each) for each in list(self._model.names)[1:]]
        self._data = self._model.createData()
        self._of_solids = pinocchio.GeometryData(self._solids)

    def nearest(self, schedule: GaitSchedule) -> float:
        ticks = np.arange(schedule.ticks + 1)
        at = np.linspace(0, schedule.ticks, 400)
        shapes = np.column_stack([np.interp(at, ticks, x) for x in schedule.positions.T])
        return self.nearest_of(shapes)

    def nearest_of(self, shapes: Array) -> float:
        """Return the smallest distance at shapes (N, n), m."""
        best = np.inf
        for q in shapes:
            pinocchio.computeDistances(
                self._model, self._data, self._solids, self._of_solids, q[self._order]
            )
            found = [each.min_distance for each in self._of_solids.distanceResults]
            best = min([best, *found])
        return best


@dataclass
class Row:
    """Plans without and with clearance to one goal: duration (s), CPU (s), distance (m)."""

    plain: tuple[float, float, float] | None
    clear: tuple[float, float, float] | None
    same: bool


def row(
    robot: SpaceRobot, request: PlanRequest, distances: Distances, *, with_position: bool
) -> Row:
    options = method_options("optimal", {"cache": 0, "base_position": int(with_position)})
    found: list[tuple[float, float, float] | None] = []
    schedules: list[Any] = []
    for clearance in (None, Clearance(robot.description, CLEARANCE)):
        method = OptimalGait(robot, 0.05, 0.01, options, clearance)
        began = time.process_time()
        try:
            schedule = method.plan(request)
        except PlanningError as refusal:
            print(f"  {robot.description.name}: {refusal}", flush=True)
            found.append(None)
            schedules.append(None)
            continue
        cpu = time.process_time() - began
        found.append((schedule.duration, cpu, distances.nearest(schedule)))
        schedules.append(schedule)
    same = None not in schedules and np.array_equal(schedules[0].positions, schedules[1].positions)
    return Row(found[0], found[1], same)


@dataclass
class Summary:
    """Figures of some rows.

    Attributes
    ----------
    goals, before, now
        Goals; those that are planned without clearance, and those of them that are with it.
    near, smallest
        Plans that come too near without clearance; the smallest distance with it, m.
    same
        Plans that are the same with clearance.
    duration, cpu
        Medians of the ratios with clearance to without: of the durations of those that come too
        near, and of all CPU times.
    """

    goals: int
    before: int
    now: int
    near: int
    smallest: float
    same: int
    duration: float
    cpu: float


def summary_of(rows: list[Row]) -> Summary:
    both = [(each.plain, each.clear) for each in rows if each.plain and each.clear]
    longer = [after[0] / before[0] for before, after in both if before[2] < CLEARANCE]
    return Summary(
        goals=len(rows),
        before=sum(each.plain is not None for each in rows),
        now=len(both),
        near=sum(each.plain is not None and each.plain[2] < CLEARANCE for each in rows),
        smallest=min((after[2] for _, after in both), default=np.inf),
        same=sum(each.same for each in rows),
        duration=median(longer) if longer else 1.0,
        cpu=median(after[1] / before[1] for before, after in both) if both else 1.0,
    )


def random_goals(robot: SpaceRobot, start: Array, count: int) -> Iterator[Goal]:
    """Yield goals from a shape (n,) at rest in the origin: attitudes, attitudes with a position of
    the base, and attitudes with a shape by turns.
    """
    rng, geometry = np.random.default_rng(20260), Clearance(robot.description, CLEARANCE).geometry
    low, high = np.maximum(robot.lower, -1.0), np.minimum(robot.upper, 1.0)

    def keeps_clear(shape: Array) -> bool:
        nearest = geometry.nearest(shape)
        return nearest is None or nearest[0] >= CLEARANCE

    for number in range(count):
        axis = rng.normal(size=3)
        turn = rng.uniform(0.05, 0.5) * axis / np.linalg.norm(axis)
        quaternion = Goal.from_rotvec(np.zeros(3), turn).quaternion
        position, shape = np.zeros(3), None
        if number % 3 == 1:
            # The centre of mass rests, so a shape puts the base to one position.
            other = np.random.default_rng([20260, number])
            end = other.uniform(low, high)
            while not keeps_clear(end):
                end = other.uniform(low, high)
            turned = Rotation.from_rotvec(turn).apply(robot.center_of_mass(end))
            position = robot.center_of_mass(start) - turned
        if number % 3 == 2:
            shape = rng.uniform(low, high)
            shape = shape if keeps_clear(shape) else None
        yield Goal(position, quaternion, shape)


@pytest.fixture(scope="module")
def rows_of_all() -> list[Row]:
    """Rows of all robots that were planned for, by the tests before the last one."""
    return []


@pytest.mark.slow
@pytest.mark.parametrize("name", ROBOTS)
def test_plans_to_random_goals_keep_clear(
    name: str, tmp_path: Path, rows_of_all: list[Row]
) -> None:
    robot = SpaceRobot.from_file(robot_file(name))
    start = np.clip(np.zeros(robot.n), robot.lower, robot.upper)
    distances = Distances(robot, Clearance(robot.description, CLEARANCE), start, tmp_path)
    rows = []
    for number, goal in enumerate(random_goals(robot, start, GOALS)):
        state = RobotState(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), start)
        request = PlanRequest(state, goal, Tolerance(1e-6, 1e-6, 1e-6))
        rows.append(row(robot, request, distances, with_position=number % 3 == 1))
        print(f"  {name}: goal {number}: {rows[-1]}", flush=True)
    rows_of_all += rows
    print(f"{name}: {summary_of(rows)}", flush=True)
    smallest = min((each.clear[2] for each in rows if each.clear), default=np.inf)
    assert smallest >= CLEARANCE - 1e-5
    for each in rows:
        if each.plain and each.plain[2] > CLEARANCE + 2e-3:
            assert each.same


@pytest.mark.slow
def test_clearance_costs_little_over_all_robots(rows_of_all: list[Row]) -> None:
    found = summary_of(rows_of_all)
    print(f"all robots: {found}", flush=True)
    assert found.now >= 0.97 * found.before
    if GOALS >= 50:
        assert found.duration <= 1.05
        assert found.cpu <= 3.0
