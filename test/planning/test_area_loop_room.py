"""Loops of `area_loop` where links have little room: elsewhere, or refused with the pair."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.planners import planner_of

from spacerobot_ros.errors import PlanningError
from spacerobot_ros.model import SpaceRobot, load_robot
from spacerobot_ros.model.description import Array
from spacerobot_ros.planning import Goal, PlanRequest, RobotState, Tolerance
from spacerobot_ros.planning.core.clearance import Clearance
from spacerobot_ros.planning.methods.area_loop import AreaLoopGait
from spacerobot_ros.planning.methods.nominal_shape import (
    NominalShapeChooser,
    nominal_with_clearance,
)
from spacerobot_ros.resources import robot_file

GOAL = Goal.checked([0, 0, 0], Rotation.from_rotvec([0.1, -0.2, 0.3]).as_quat())
START = RobotState(np.zeros(3), np.array([0, 0, 0, 1.0]), np.array([0.3, -0.6, 1.2]))
TOLERANCE = Tolerance(1.0, 1e-3)
WALL = -1.0
"""Position of the second joint above which links come too near, rad, in these tests."""


@pytest.fixture(scope="module")
def arm() -> SpaceRobot:
    return SpaceRobot(load_robot(robot_file("three_joint_arm")))


def beyond_the_wall(shapes: Array) -> bool:
    return bool(np.all(shapes[:, 1] <= WALL))


def replaced(method: AreaLoopGait, clear: str, too_near: str) -> None:
    """Have a method find one clause on motions this side of the wall, and another beyond it."""

    def look(positions: Array, base: object = None, **_: object) -> str:
        return clear if beyond_the_wall(positions) else too_near

    method.__dict__.update(_too_near=look)


def walled(arm: SpaceRobot, **options: Any) -> AreaLoopGait:
    """Return a method for which links come too near where the second joint is above the wall."""
    method = planner_of("area_loop", arm, 0.25, TOLERANCE, 0.05, **options).method
    assert isinstance(method, AreaLoopGait)
    stand_in: Any = SimpleNamespace(
        is_clear=lambda shapes, required: beyond_the_wall(shapes),
        required=lambda start: None,
        has_obstacles=False,
    )
    method.clearance = stand_in
    replaced(method, "", "links 'a' and 'b' come within 0.004 m")
    return method


def test_boxes_of_loops_keep_clear_and_are_the_best_that_do(arm: SpaceRobot) -> None:
    free = nominal_with_clearance(arm, START.q, [(0, 1, 2)], 1.0, 0.5, lambda shapes: True)
    kept = nominal_with_clearance(arm, START.q, [(0, 1, 2)], 1.0, 0.5, beyond_the_wall)
    assert free is not None
    assert kept is not None
    assert free.shape[1] > WALL, "the best one is beyond the wall only if it must be"
    assert kept.shape[1] + kept.longest[1] / 2 <= WALL + 1e-12
    assert kept.longest.max() <= 0.5
    assert nominal_with_clearance(arm, START.q, [(0, 1, 2)], 1.0, 0.5, lambda shapes: False) is None
    # Edges of less than a tenth of a milliradian are none.
    assert nominal_with_clearance(arm, START.q, [(0, 1, 2)], 1.0, 1e-5, lambda shapes: True) is None
    seen: list[Array] = []

    def refuse(shapes: Array) -> bool:
        seen.append(shapes)
        return False

    nominal_with_clearance(arm, START.q, [(0, 1, 2)], 1.0, 0.5, refuse)
    assert {each.shape for each in seen} == {(27, 3)}
    np.testing.assert_allclose(np.ptp(seen[0], axis=0), free.longest)
    np.testing.assert_allclose(seen[0].mean(axis=0), free.shape)


def test_smaller_boxes_are_looked_for_and_none_where_users_chose(arm: SpaceRobot) -> None:
    found = list(
        NominalShapeChooser(arm, 0.8, "", ()).shapes_with_more_room(START.q, beyond_the_wall)
    )
    assert [each.longest.max() for each in found] == pytest.approx([0.8, 0.4, 0.2, 0.1])
    given = NominalShapeChooser(arm, 0.8, "", (0.1, -1.7, 1.0))
    assert list(given.shapes_with_more_room(START.q, beyond_the_wall)) == []


def test_a_loop_without_room_goes_elsewhere_and_one_with_room_stays(arm: SpaceRobot) -> None:
    free = planner_of("area_loop", arm, 0.25, TOLERANCE, 0.05).plan(START, GOAL)
    start = RobotState(START.position, START.quaternion, np.array([0.3, -1.5, 1.2]))
    moved = walled(arm).plan(PlanRequest(start, GOAL, TOLERANCE))
    shapes = moved.positions
    assert beyond_the_wall(shapes)
    nominal = np.array(moved.notes["nominal"])
    assert nominal[1] < WALL
    assert nominal[1] != pytest.approx(np.array(free.notes["nominal"])[1])
    # Edges are as long as a box has room for: 0.2 rad is far more than a shrunk loop has.
    assert max(np.atleast_1d(moved.notes["edges"])) > 0.2
    # A wall that no loop comes to changes nothing.
    method = walled(arm)
    replaced(method, "", "")
    same = method.plan(PlanRequest(START, GOAL, TOLERANCE))
    np.testing.assert_array_equal(same.positions, free.positions)


def test_cycles_are_counted_with_the_loop_that_is_flown(arm: SpaceRobot) -> None:
    nominal = (0.3, WALL - 0.03, 1.2)
    start = RobotState(START.position, START.quaternion, np.array(nominal))
    request = PlanRequest(start, GOAL, TOLERANCE)
    free = planner_of(
        "area_loop", arm, 0.25, TOLERANCE, 0.05, nominal=nominal, most_cycles=100000, longest=1e9
    ).plan(start, GOAL)
    method = walled(arm, nominal=nominal, most_cycles=1000000, longest=1e9)
    shrunk = method.plan(request)
    assert np.ptp(shrunk.positions[:, 1]) <= 0.06 + 1e-9
    S, small = (np.linalg.norm(each.notes["S"]) for each in (free, shrunk))
    assert small < 0.3 * S
    # A cycle makes up for a share of 0.15 of what is left, as far as its loop is large enough.
    left = np.linalg.norm([0.1, -0.2, 0.3])
    largest, count = 0.15 * left * small / S, 0
    while left > 1e-3:
        left -= min(0.15 * left, largest)
        count += 1
    assert float(str(shrunk.notes["expected_cycles"])) == pytest.approx(count, abs=2)
    most = int(float(str(shrunk.notes["expected_cycles"]))) - 1
    limited = walled(arm, nominal=nominal, most_cycles=most, longest=1e9)
    with pytest.raises(PlanningError) as refusal:
        limited.plan(request)
    cycles = float(str(shrunk.notes["expected_cycles"]))
    assert str(refusal.value) == (
        f"The goal takes about {cycles:.4g} cycles, more than most_cycles = {most}; 0 are flown. "
        "In a loop twice as large links 'a' and 'b' come within 0.004 m."
    )


def test_required_distances_are_kept_at_all_shapes() -> None:
    robot = load_robot(robot_file("servicer"))
    clearance = Clearance(robot, 0.05)
    away, near = np.array([0.0, -1.4, 0.5, 0, 0, 0]), np.array([-2.5, -0.37, 1.86, 0.0, 0.0, 0.0])
    geometry = clearance.geometry
    nearest = [geometry.nearest(each) for each in (away, near)]
    distances = [each[0] for each in nearest if each is not None]
    assert distances[0] > 2 * distances[1]
    between = np.full(len(geometry.pairs), 0.5 * sum(distances))
    assert clearance.is_clear(away[np.newaxis], between)
    assert not clearance.is_clear(near[np.newaxis], between)
    assert not clearance.is_clear(np.stack([away, near]), between)
    assert clearance.is_clear(np.stack([away, near]), np.full(len(between), distances[1] - 1e-6))
    # A pair that need not keep any distance does not count.
    free = between.copy()
    assert nearest[1] is not None
    free[nearest[1][1]] = -np.inf
    others = sorted(
        float(geometry.distances(k, geometry.poses(near[np.newaxis]))[0]) for k in range(len(free))
    )
    assert clearance.is_clear(near[np.newaxis], np.minimum(free, others[1] - 1e-9))
