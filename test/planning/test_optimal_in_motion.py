"""Manoeuvres of `optimal` that begin while the joints move."""

from __future__ import annotations

from functools import cache

import numpy as np
import numpy.typing as npt
import pytest
from planning.flown import STEP, plant_at
from scipy.spatial.transform import Rotation
from support.planner_loop import robot_of

from spacerobot_ros.errors import PlanningError
from spacerobot_ros.planning import (
    METHODS,
    GaitMethod,
    GaitSchedule,
    Goal,
    InitialMotion,
    PlanRequest,
    RobotState,
    Tolerance,
    build_method,
    method_options,
)

Array = npt.NDArray[np.float64]

PERIOD = 0.05
TOLERANCE = Tolerance(1e-6, 1e-6, 1e-6)
SPEED, ACCELERATION = np.array([0.4, 0.5]), np.array([0.9, 1.1])


@cache
def planar(method: str = "optimal", **options: float) -> GaitMethod:
    limits = {"max_velocity": (0.4, 0.5), "max_acceleration": (0.9, 1.1), "cache": 0, "answers": 1}
    chosen = {"optimal": method_options("optimal", {**limits, **options})}
    return build_method(method, robot_of("planar_chain"), PERIOD, STEP, chosen)


def turned(angle: float, shape: Array | None = None) -> Goal:
    return Goal.checked(np.zeros(3), Rotation.from_rotvec([0, 0, angle]).as_quat(), shape)


def at_rest() -> RobotState:
    return RobotState(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), np.array([0.3, -0.2]))


@cache
def first() -> GaitSchedule:
    return planar().plan(PlanRequest(at_rest(), turned(0.3), TOLERANCE))


def halfway(schedule: GaitSchedule) -> tuple[int, RobotState, InitialMotion]:
    """Fly half of a schedule in the plant; return where and how fast the robot is then."""
    plant = plant_at(robot_of("planar_chain"), at_rest().q, PERIOD)
    k = schedule.ticks // 2
    for rates in schedule.velocities[:k]:
        plant.step(rates)
    state = RobotState(plant.pose[:3].copy(), plant.pose[3:].copy(), plant.q.copy())
    return k, state, InitialMotion(schedule.velocities[k - 1], schedule.positions[k:])


def flown_angle(state: RobotState, schedule: GaitSchedule) -> float:
    """Return the angle of the base (rad) after a schedule was flown in the plant from a state."""
    attitude = Rotation.from_quat(state.quaternion)
    plant = plant_at(robot_of("planar_chain"), state.q, PERIOD, attitude)
    for rates in schedule.velocities:
        plant.step(rates)
    return float(Rotation.from_quat(plant.pose[3:]).as_rotvec()[2])


def require_smooth(before: Array, schedule: GaitSchedule) -> None:
    """Check velocities and accelerations by differences, from what was held before to the rest."""
    rates = np.vstack([before, np.diff(schedule.positions, axis=0) / PERIOD, np.zeros(2)])
    assert (np.abs(rates) <= SPEED * (1 + 1e-9)).all()
    assert (np.abs(np.diff(rates, axis=0)) / PERIOD <= ACCELERATION * (1 + 1e-6)).all()


@pytest.mark.parametrize("angle", [0.42, -0.1])
def test_another_goal_is_reached_from_moving_joints_within_the_limits(angle: float) -> None:
    _, state, motion = halfway(first())
    assert np.abs(motion.velocity).max() > 0.2, "the joints move"
    schedule = planar().plan(PlanRequest(state, turned(angle), TOLERANCE, motion=motion))
    assert "braking_time" not in schedule.notes
    np.testing.assert_array_equal(schedule.positions[0], state.q)
    require_smooth(motion.velocity, schedule)
    assert flown_angle(state, schedule) == pytest.approx(angle, abs=1e-6)


def test_the_rest_of_a_manoeuvre_planned_again_takes_about_as_long() -> None:
    k, state, motion = halfway(first())
    request = PlanRequest(state, turned(0.3), TOLERANCE, previous=first(), motion=motion)
    schedule = planar().plan(request)
    assert abs(schedule.ticks - (first().ticks - k)) <= 2
    require_smooth(motion.velocity, schedule)
    assert flown_angle(state, schedule) == pytest.approx(0.3, abs=1e-6)


def test_it_begins_as_fast_as_the_joints_move_and_not_faster_than_they_may() -> None:
    _, state, motion = halfway(first())
    fast = InitialMotion(np.array([0.0, 0.6]), motion.remaining)
    with pytest.raises(PlanningError, match="faster than the velocity limits"):
        planar().plan(PlanRequest(state, turned(0.4), TOLERANCE, motion=fast))


def test_joints_brake_first_where_no_plan_in_motion_is_found() -> None:
    """So few steps of the solver are enough from rest alone."""
    _, state, motion = halfway(first())
    method = planar(starts=2, intervals=20, iterations=12)
    schedule = method.plan(PlanRequest(state, turned(-0.1), TOLERANCE, motion=motion))
    braking = round(float(str(schedule.notes["braking_time"])) / PERIOD)
    assert braking >= np.abs(motion.velocity / ACCELERATION).max() / PERIOD
    np.testing.assert_array_equal(schedule.positions[braking], schedule.positions[braking - 1])
    require_smooth(motion.velocity, schedule)
    assert flown_angle(state, schedule) == pytest.approx(-0.1, abs=1e-6)


def test_methods_say_whether_they_start_in_motion() -> None:
    able = {name for name, method in METHODS.items() if method.starts_in_motion}
    assert able == {"optimal", "auto"}


def test_auto_asks_no_method_that_plans_from_rest_only() -> None:
    """The papers' method of this robot would be tried first."""
    _, state, motion = halfway(first())
    schedule = planar("auto").plan(PlanRequest(state, turned(0.42), TOLERANCE, motion=motion))
    assert schedule.method == "optimal"
    require_smooth(motion.velocity, schedule)
