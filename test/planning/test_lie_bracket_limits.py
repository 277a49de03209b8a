"""The gait of sliding masses: strokes and rates are kept, or the goal is refused."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from planning.sliding_robots import Slider, SlidingRobot, paper_robot, random_sliding_robot
from scipy.spatial.transform import Rotation
from support.planning_refusals import refusal_in
from support.slides_and_turns import (
    PERIOD,
    check_prediction,
    goal_at,
    misses,
    note,
    origin,
    planner,
    pose_for_shape,
    state_at,
)

from spacerobot_ros.errors import PlanningError
from spacerobot_ros.planning import Goal, RobotState, Tolerance
from spacerobot_ros.planning.methods.lie_bracket import LieBracketGait

Array = npt.NDArray[np.float64]

NEAR = goal_at([0.05, 0.02, -0.03], Rotation.from_rotvec([0.01, 0.02, 0.03]))


def refusal_of(robot: SlidingRobot, state: RobotState, goal: Goal, **options: Any) -> str:
    return refusal_in(lambda: planner(robot, **options).plan(state, goal))


# -- limits -----------------------------------------------------------------------------------


@pytest.mark.slow
@settings(derandomize=True, deadline=None, max_examples=15)
@given(
    seed=st.integers(0, 10_000),
    sliders=st.integers(3, 5),
    rate=st.sampled_from([0.02, 0.1, 0.7]),
    reach=st.sampled_from([0.3, 1.0, 2.5]),
    angle=st.sampled_from([0.0, 0.1, 1.0]),
    n1=st.sampled_from([1, 10]),
)
def test_a_schedule_keeps_strokes_and_rates_or_there_is_none(
    seed: int, sliders: int, rate: float, reach: float, angle: float, n1: int
) -> None:
    rng = np.random.default_rng(seed)
    robot = random_sliding_robot(rng, sliders)
    strokes = [(-reach, float(rng.uniform(0.5, 1.0) * reach)) for _ in robot.sliders]
    robot = replace(
        robot,
        sliders=tuple(
            replace(s, stroke=stroke, rate=float(rate * rng.uniform(0.5, 1.0)))
            for s, stroke in zip(robot.sliders, strokes, strict=True)
        ),
    )
    lower, upper = np.array(strokes).T
    limits = np.array([s.rate for s in robot.sliders])
    state = state_at(np.zeros(3), Rotation.identity(), rng.uniform(lower, upper))
    turn = Rotation.from_rotvec(angle * rng.normal(size=3))
    goal = pose_for_shape(robot, state, rng.uniform(1.1 * lower, 1.1 * upper), turn)
    schedule, refusal = None, ""
    try:
        method = planner(robot, Tolerance(1e-3, 1e-3), n1=n1, longest=2000.0)
        schedule = method.plan(state, goal)
    except PlanningError as error:
        refusal = str(error)
    if schedule is None:
        assert "stroke" in refusal
        return
    assert np.all(schedule.positions >= lower - 1e-12)
    assert np.all(schedule.positions <= upper + 1e-12)
    assert np.all(np.abs(schedule.velocities) <= limits * (1 + 1e-9))
    np.testing.assert_array_equal(schedule.positions[0], state.q)
    # Nobody jumps: what the velocities carry is what the positions say.
    carried = schedule.positions[0] + np.cumsum(schedule.velocities, axis=0) * PERIOD
    np.testing.assert_allclose(carried, schedule.positions[1:], atol=1e-8)


def test_a_slow_servo_stretches_the_slide() -> None:
    robot = paper_robot(rate=0.05)
    goal = goal_at([0.1, 0.0, 0.0], Rotation.identity())
    schedule = planner(robot).plan(origin(), goal)
    # 0.8 m at a mean of half the peak rate of 0.05 m/s.
    assert schedule.duration == pytest.approx(32.0, abs=PERIOD)
    position, attitude = check_prediction(robot, origin(), schedule)
    assert max(misses(goal, position, attitude)) <= 1e-5


def test_the_speed_that_is_told_is_that_of_the_stretched_slide() -> None:
    goal = goal_at([0.1, 0.0, 0.0], Rotation.identity())
    schedule = planner(paper_robot(rate=0.05)).plan(origin(), goal)
    # v = c sin^2: c is the peak.
    peak = np.abs(schedule.velocities[:, 0]).max()
    assert abs(note(schedule, "c")[0]) == pytest.approx(peak, rel=1e-3)


def test_a_servo_that_does_not_move_is_refused() -> None:
    goal = goal_at([0.1, 0.0, 0.0], Rotation.identity())
    assert "'s1'" in refusal_of(paper_robot(rate=0.0), origin(), goal)


def test_a_slide_that_takes_too_long_is_refused_with_the_time() -> None:
    # 0.8 m at a mean of 5 mm/s.
    goal = goal_at([0.1, 0.0, 0.0], Rotation.identity())
    assert "100 s" in refusal_of(paper_robot(rate=0.01), origin(), goal, longest=100.0)


def test_a_fourth_slider_takes_what_the_others_have_no_stroke_for() -> None:
    # Two slots along x. Alone, or in equal shares, the first cannot do it.
    axes = np.vstack([np.eye(3), [[1.0, 0.0, 0.0]]])
    sliders = tuple(
        Slider(2.0, axis, np.array([0.0, 0.1 * k, 0.1]), stroke=stroke)
        for k, (axis, stroke) in enumerate(
            zip(axes, [(-0.2, 0.2), (-2.5, 2.5), (-2.5, 2.5), (-2.5, 2.5)], strict=True)
        )
    )
    robot = SlidingRobot(10.0, np.diag([1.0, 1.5, 1.5]), np.zeros(3), sliders)
    # 0.1 m of 18 kg is 0.9 m of 2 kg.
    goal = goal_at([-0.1, 0.0, 0.0], Rotation.identity())
    method = planner(robot).method
    assert isinstance(method, LieBracketGait)
    z_f = method.final_shape(origin(4), goal)
    assert z_f[0] + z_f[3] == pytest.approx(0.9, abs=1e-9)
    assert -0.2 <= z_f[0] <= 0.2
    np.testing.assert_allclose(z_f[1:3], 0.0, atol=1e-9)


def test_a_shape_at_the_end_of_a_stroke_is_reached_without_a_turn() -> None:
    # 2.5 m of 2 kg is 0.3125 m of 16 kg; a mass through the centre turns nothing.
    goal = goal_at([-0.3125, 0.0, 0.0], Rotation.identity())
    schedule = planner(paper_robot()).plan(origin(), goal)
    np.testing.assert_allclose(schedule.positions[-1], [2.5, 0.0, 0.0], atol=1e-12)
    assert schedule.positions.max() <= 2.5


# -- refusals ---------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [0, 1, 2])
def test_fewer_than_three_sliders_are_refused(count: int) -> None:
    robot = paper_robot()
    robot = replace(robot, sliders=robot.sliders[:count])
    text = refusal_of(robot, origin(count), NEAR)
    assert "three sliders" in text
    assert f"{count} slider" in text


@pytest.mark.parametrize("count", [3, 5])
def test_slots_in_one_plane_are_refused(count: int) -> None:
    rng = np.random.default_rng(7)
    plane = np.linalg.qr(rng.normal(size=(3, 3)))[0][:, :2]
    sliders = tuple(
        Slider(2.0, plane @ (v / np.linalg.norm(v)), rng.uniform(-0.3, 0.3, 3))
        for v in rng.normal(size=(count, 2))
    )
    robot = SlidingRobot(10.0, np.diag([1.0, 1.5, 1.5]), np.zeros(3), sliders)
    text = refusal_of(robot, origin(count), NEAR)
    assert "linearly independent" in text
    assert f"{count} slider(s) of rank 2" in text


@pytest.mark.parametrize(("axis", "sign"), [(0, 1), (1, -1), (2, 1)])
def test_a_goal_beyond_stroke_names_joint_and_stroke(axis: int, sign: int) -> None:
    # 0.35 m of 16 kg is 2.8 m of 2 kg, the other way.
    position = -0.35 * sign * np.eye(3)[axis]
    text = refusal_of(paper_robot(), origin(), goal_at(position, Rotation.identity()))
    assert "beyond stroke" in text
    assert f"'s{axis + 1}'" in text
    assert f"at {2.8 * sign:.4g} m" in text
    assert "[-2.5, 2.5] m" in text


def test_a_turn_without_room_for_the_masses_is_refused() -> None:
    # The final shape is at the very end of a stroke.
    goal = pose_for_shape(
        paper_robot(), origin(), np.array([2.5, 0.0, 0.0]), Rotation.from_rotvec([0, 0, 0.1])
    )
    text = refusal_of(paper_robot(), origin(), goal)
    assert "stroke" in text


def test_a_turn_that_takes_too_long_is_refused_with_the_time() -> None:
    goal = goal_at([0.0, 0.0, 0.0], Rotation.from_rotvec([0.4, 0.0, 0.0]))
    text = refusal_of(paper_robot(), origin(), goal, longest=20.0)
    assert "20 s" in text


@pytest.mark.parametrize(
    ("momentum", "shown"),
    [
        ({"linear_momentum": np.array([0.0, 3e-3, 4e-3])}, "0.005 kg m/s"),
        ({"angular_momentum": np.array([0.0, -2e-3, 0.0])}, "0.002 kg m^2/s"),
    ],
)
def test_a_drifting_robot_is_refused(momentum: dict[str, Array], shown: str) -> None:
    text = refusal_of(paper_robot(), replace(origin(), **momentum), NEAR)
    assert "drifts" in text
    assert shown in text


def test_a_slider_that_is_not_used_may_have_no_rate_and_no_room() -> None:
    """A fourth one that neither the slide nor the turn moves: it rests at the end of its stroke."""
    fourth = Slider(0.5, np.array([0.6, 0.8, 0.0]), np.zeros(3), stroke=(-1.0, 0.0), rate=0.0)
    robot = paper_robot()
    robot = replace(robot, sliders=(*robot.sliders, fourth))
    state = state_at(np.zeros(3), Rotation.identity(), np.zeros(4))
    goal = goal_at([0.0, 0.0, 0.0], Rotation.from_rotvec([0.01, 0.0, -0.02]))
    schedule = planner(robot, Tolerance(1e-3, 1e-3)).plan(state, goal)
    assert np.all(schedule.positions[:, 3] == 0.0)
    assert np.ptp(schedule.positions[:, :3]) > 0.01
