"""Options, limits and libraries reach the search of ``optimal``; plans in motion aim well."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation
from support.planner_loop import NEAR, TICK, Loop, MovingStub, robot_of
from support.planner_phases import OTHER, resting

from spacerobot_ros.errors import PlanningError
from spacerobot_ros.planning import (
    BasePath,
    GaitSchedule,
    Goal,
    PlanRequest,
    RobotState,
    Tolerance,
)
from spacerobot_ros.planning.execution.config import PlannerConfig
from spacerobot_ros.planning.execution.path_deviation import PathCheck
from spacerobot_ros.planning.methods.optimal import OptimalGait
from spacerobot_ros.planning.methods.optimal.initial_guesses import move_to_ends
from spacerobot_ros.planning.methods.optimal.problem import (
    BoundaryConditions,
    MotionLimits,
    OptimalOptions,
)
from spacerobot_ros.planning.methods.optimal.search import ManoeuvreSearch

Array = npt.NDArray[np.float64]
ARM = robot_of("three_joint_arm")
START = np.array([0.2, -0.6, 1.3])
LIMITS = MotionLimits(
    np.array([-1.0, -2.0, -3.0]), np.array([2.0, 1.0, 4.0]), np.full(3, 0.5), np.full(3, 1.5)
)


def asked(
    monkeypatch: pytest.MonkeyPatch, *, correction: bool, shape: Any = None, **options: Any
) -> tuple[BoundaryConditions, MotionLimits, dict[str, Any]]:
    """Return the problem that the search is given, and its keyword arguments."""
    given: list[Any] = []

    def search(self: ManoeuvreSearch, *arguments: Any, **named: Any) -> None:
        given.append((arguments[0], arguments[1], named))
        raise PlanningError("searched")

    monkeypatch.setattr(ManoeuvreSearch, "search", search)
    method = OptimalGait(ARM, TICK, 0.01, OptimalOptions(cache=0, **options))
    state = RobotState(np.zeros(3), Rotation.from_rotvec([0.3, 0.1, -0.2]).as_quat(), START)
    goal = Goal.from_rotvec([0.0, 0.0, 0.0], [0.3, 0.15, -0.2])
    goal = Goal(goal.position, goal.quaternion, None if shape is None else np.array(shape))
    request = PlanRequest(state, goal, Tolerance(1e-3, 1e-3), correction=correction)
    with pytest.raises(PlanningError, match="searched"):
        method.plan(request)
    boundary, limits, named = given[0]
    return boundary, limits, named


def test_corrections_may_use_the_margins_and_are_gentle(monkeypatch: pytest.MonkeyPatch) -> None:
    margins = (0.1, 0.2, 0.3)
    _, limits, named = asked(monkeypatch, correction=False, joint_margin=margins)
    np.testing.assert_allclose(limits.lower, ARM.lower + margins)
    np.testing.assert_allclose(limits.upper, ARM.upper - margins)
    assert named["gentle"] is False
    _, limits, named = asked(monkeypatch, correction=True, joint_margin=margins)
    np.testing.assert_array_equal(limits.lower, ARM.lower)
    np.testing.assert_array_equal(limits.upper, ARM.upper)
    assert named["gentle"] is True


@pytest.mark.parametrize("shape", [None, [0.4, -0.9, 1.0]])
@pytest.mark.parametrize("final_shape", [0, 1])
def test_a_goal_without_a_shape_alone_ends_in_the_present_one(
    monkeypatch: pytest.MonkeyPatch, shape: list[float] | None, final_shape: int
) -> None:
    boundary, _, _ = asked(monkeypatch, correction=False, shape=shape, final_shape=final_shape)
    wanted = START if shape is None and final_shape else shape
    if wanted is None:
        assert boundary.final is None
    else:
        np.testing.assert_array_equal(boundary.final, wanted)


def test_options_lower_the_speeds_of_the_urdf_and_never_raise_them() -> None:
    slow = tuple((ARM.velocity_limit * [0.5, 3.0, 1.0]).tolist())
    limits = MotionLimits.of(ARM, OptimalOptions(max_velocity=slow, ramp_time=0.25))
    expected = ARM.velocity_limit * [0.5, 1.0, 1.0]
    np.testing.assert_allclose(limits.velocity, expected)
    np.testing.assert_allclose(limits.acceleration, expected / 0.25)


def test_shapes_within_margins_are_admitted_and_those_beyond_limits_are_not() -> None:
    inside, beyond = np.array([-0.95, 0.95, 0.0]), np.array([-1.5, 1.5, 5.0])
    kept = LIMITS.within(np.array([0.1, 0.2, 0.3]), inside)
    np.testing.assert_allclose(kept.lower, [-0.95, -1.8, -2.7])
    np.testing.assert_allclose(kept.upper, [1.9, 0.95, 3.7])
    wide = LIMITS.within(np.array([0.1, 0.2, 0.3]), inside, beyond)
    np.testing.assert_allclose(wide.lower, [-1.0, -1.8, -2.7])
    np.testing.assert_allclose(wide.upper, [1.9, 1.0, 4.0])


def test_a_guess_is_moved_to_the_ends_and_within_the_limits() -> None:
    s = np.linspace(0.0, 1.0, 5)[:, np.newaxis]
    own = 0.1 + s * np.array([0.5, -0.25, 0.15]) + 0.1 * np.sin(np.pi * s)
    final = np.array([0.5, -0.25, 0.15])
    late = s**3 * (10 - 15 * s + 6 * s**2)
    for last in (final, None):
        boundary = BoundaryConditions(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), final, last)
        expected = own + (1 - late) * -own[0] + late * (0.0 if last is None else last - own[-1])
        np.testing.assert_allclose(move_to_ends(own, boundary, LIMITS), expected, atol=1e-12)
    narrow = MotionLimits(np.full(3, -0.1), np.full(3, 0.2), *[np.ones(3)] * 2)
    moved = move_to_ends(own, boundary, narrow)
    np.testing.assert_allclose(moved, np.clip(expected, -0.1, 0.2), atol=1e-12)


# -- plans in motion --------------------------------------------------------------------------


def check_off(position: float, angle: float) -> tuple[PathCheck, Goal]:
    """Return a path whose end is off a goal by so much, and the goal."""
    end = Rotation.from_rotvec([0.2, 0.0, 0.4])
    path = BasePath(
        np.array([0.0, 1.0]), np.array([[0.0] * 3, [1.0, 2.0, 3.0]]), np.tile(end.as_quat(), (2, 1))
    )
    goal_at = (end * Rotation.from_rotvec([0.0, angle, 0.0])).as_quat()
    goal = Goal(np.array([1.0, 2.0 + position, 3.0]), goal_at)
    shapes = np.zeros((21, ARM.n))
    schedule = GaitSchedule("stub", ARM.joint_names, TICK, shapes, path, goal)
    check = PathCheck(ARM, schedule, 0, PlannerConfig(), average=1)
    assert check.due(0)
    return check, goal


WITHIN = Tolerance(1.0, 0.1)


@pytest.mark.parametrize(
    ("position", "angle", "late", "left"),
    [
        (0.59, 0.059, False, None),
        (0.61, 0.0, False, (0.4, 0.0)),
        (0.0, 0.061, False, (0.0, 0.04)),
        (0.79, 0.079, True, None),
        (0.81, 0.03, True, (0.6, 0.03)),
        (0.3, 0.081, True, (0.3, 0.06)),
    ],
)
def test_the_aim_of_a_plan_leaves_a_share_of_each_tolerance(
    position: float, angle: float, late: bool, left: tuple[float, float] | None
) -> None:
    check, goal = check_off(position, angle)
    aim = check.shift_goal(goal, WITHIN, frozenset({"position", "attitude"}), late=late)
    if left is None:
        assert aim is None
        return
    assert aim is not None
    np.testing.assert_allclose(goal.position - aim.position, [0.0, left[0], 0.0], atol=1e-12)
    turn = Rotation.from_quat(aim.quaternion).inv() * Rotation.from_quat(goal.quaternion)
    np.testing.assert_allclose(turn.as_rotvec(), [0.0, left[1], 0.0], atol=1e-12)


@pytest.mark.parametrize(("ticks_flown", "late"), [(4, False), (70, True)])
def test_a_motion_is_late_in_its_last_third(
    ticks_flown: int, late: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[bool] = []

    def aim(self: PathCheck, *arguments: Any, late: bool) -> None:
        told.append(late)

    monkeypatch.setattr(PathCheck, "shift_goal", aim)
    loop = Loop({"takeover_time": 0.3, "replan_period": 0.1}, method=MovingStub(90))
    loop.propose_goal(NEAR)
    loop.tick(ticks_flown + 2)
    assert told[-1] is late


def test_a_goal_that_takes_over_a_schedule_counts_what_is_left_of_it() -> None:
    loop = Loop({"takeover_time": 0.3}, method=MovingStub(40))
    loop.propose_goal(NEAR)
    loop.tick(11)
    loop.propose_goal(NEAR)
    loop.tick()
    status = loop.statuses[-1]
    assert status.goal_id == "goal-2"
    assert status.ends_at_s == pytest.approx(40 * TICK)
    assert status.manoeuvre_time_s == pytest.approx((40 - 11) * TICK)


def test_plans_are_counted_for_every_goal_anew() -> None:
    loop = resting()
    for place in (NEAR, OTHER):
        loop.decide(place)
        assert loop.executive.statistics.plans == 1
    assert loop.executive.statistics.commands_published == len(loop.commands)
