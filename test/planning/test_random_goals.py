"""Goals that can be reached and goals that cannot, and the numbers that methods state."""

from __future__ import annotations

import inspect
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from planning.sliding_robots import Slider, SlidingRobot, paper_robot
from scipy.spatial.transform import Rotation
from support.planar_manoeuvres import phase_density
from support.planner_loop import NEAR, TICK, Loop, StubMethod
from support.planners import planner_of, refusal_in
from support.slides_and_turns import PERIOD as GAIT_PERIOD
from support.slides_and_turns import goal_at, note, origin, state_at
from support.slides_and_turns import planner as gait_planner

from spacerobot_ros.events import Event
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.planning import Tolerance, plan
from spacerobot_ros.planning.execution.config import PlannerConfig
from spacerobot_ros.planning.execution.status import Phase, PlannerState
from spacerobot_ros.planning.methods.geometric_phase import (
    PhasePlane,
    PlanarPhase,
    check_planar_chain,
    curvature_peaks,
)
from spacerobot_ros.planning.methods.lie_bracket import LieBracketGait

FOLDER = Path(__file__).parents[2] / "urdf"


# -- numbers that methods state, and defaults of tolerances: against other ways to get them ------


def test_tolerances_are_those_of_the_planner_where_none_are_given() -> None:
    assert Tolerance(1.0, 1.0).shape == PlannerConfig().joint_tolerance == 1e-3
    given = inspect.signature(plan).parameters["tolerance"].default
    assert given == Tolerance(1e-6, 1e-6, 1e-6), "who calls the API wants what the method can do"


# -- lie_bracket ------------------------------------------------------------------------------


@pytest.mark.parametrize("rate", [0.04, 0.02])
def test_no_more_cycles_than_the_rates_of_the_sliders_demand(rate: float) -> None:
    """Amplitudes go as the root of the number of cycles: the fastest slider is at its rate."""
    goal = goal_at([0.0, 0.0, 0.0], Rotation.from_rotvec([0.02, 0.01, -0.015]))
    schedule = gait_planner(paper_robot(rate=rate), Tolerance(1e-2, 1e-2)).plan(origin(), goal)
    assert note(schedule, "cycles") > 20
    share = np.abs(schedule.velocities).max() / rate
    # One cycle more than necessary, and 1 in 1000.
    assert 0.97 < share <= 1.0


def two_along_x(reach: float) -> SlidingRobot:
    """Return the robot of paper 1 with a second slider along x; both have the same stroke."""
    axes = [*np.eye(3), np.eye(3)[0]]
    along = [(-reach, reach) if axis[0] else (-2.5, 2.5) for axis in axes]
    sliders = tuple(
        Slider(2.0, axis, np.array([0.0, 0.1 * k, 0.1]), stroke=stroke)
        for k, (axis, stroke) in enumerate(zip(axes, along, strict=True))
    )
    return SlidingRobot(10.0, np.diag([1.0, 1.5, 1.5]), np.zeros(3), sliders)


def test_two_sliders_share_a_way_up_to_the_ends_of_both_strokes_and_no_further() -> None:
    # 0.1 m of 18 kg is 0.9 m of 2 kg; from the ends of the strokes on the other side.
    goal = goal_at([-0.1, 0.0, 0.0], Rotation.identity())
    for reach, fits in ((0.225, True), (0.2249, False)):
        ends = state_at(np.zeros(3), Rotation.identity(), [-reach, 0.0, 0.0, -reach])
        method = gait_planner(two_along_x(reach)).method
        assert isinstance(method, LieBracketGait)
        if fits:
            z_f = method.final_shape(ends, goal)
            np.testing.assert_allclose(z_f, [reach, 0.0, 0.0, reach], atol=1e-9)
            continue
        text = refusal_in(partial(method.final_shape, ends, goal))
        assert "beyond the stroke" in text
        # 0.4 mm of 2 kg are missing, of 18 kg.
        assert f"no closer to it than {4e-4 * 2 / 18:.3g} m" in text


def test_the_path_of_many_cycles_is_predicted_at_the_end_of_some() -> None:
    goal = goal_at([0.0, 0.0, 0.0], Rotation.from_rotvec([0.02, 0.01, -0.015]))
    gait = gait_planner(paper_robot(rate=0.02), Tolerance(1e-2, 1e-2))
    schedule = gait.plan(origin(), goal)
    cycle = schedule.ticks / note(schedule, "cycles")
    ends = schedule.path.time[1:] / GAIT_PERIOD / cycle
    np.testing.assert_allclose(ends, np.round(ends), atol=1e-9)
    assert 100 <= len(ends) <= 200
    assert np.diff(ends).max() <= 2 * note(schedule, "cycles") / 100


# -- planar robots ----------------------------------------------------------------------------


def test_a_planar_robot_is_described_by_its_links_and_by_its_largest_curvature() -> None:
    found = check_planar_chain(SpaceRobot.from_file(FOLDER / "planar_chain.urdf"))
    words = found.message
    assert words.startswith("3 links in a plane: loops of joints 'pin_1' and 'pin_2' rotate")
    shapes = np.stack(np.meshgrid(*2 * [np.linspace(-np.pi, np.pi, 181)]), axis=-1)
    top = np.abs(phase_density(shapes)).max()
    assert float(words.split(" rad per unit")[0].rsplit(" ", 1)[1]) == pytest.approx(top, rel=5e-3)
    assert abs(phase_density(found.shape)) == pytest.approx(top, rel=1e-3)
    assert str(np.round(found.shape, 3).tolist()) in words


# -- area_loop --------------------------------------------------------------------------------


def test_the_last_cycle_that_a_goal_may_take_is_flown() -> None:
    robot = SpaceRobot.from_file(FOLDER / "three_joint_arm.urdf")
    shape = np.radians([0.0, -45.0, 90.0])
    goal = goal_at(np.zeros(3), Rotation.from_rotvec([0.0, 1e-3, 0.0]))
    options = {"most_cycles": 1, "k": 1.0, "nominal": shape.tolist()}
    method = planner_of("area_loop", robot, 0.25, Tolerance(1.0, 5e-4), 0.05, **options)
    schedule = method.plan(state_at(np.zeros(3), Rotation.identity(), shape), goal)
    assert (schedule.notes["cycles"], schedule.notes["expected_cycles"]) == (1.0, 1.0)


# -- the executive ----------------------------------------------------------------------------


@pytest.mark.parametrize(("jump", "after"), [(12.0, "13.1"), (-0.9, "0.2")])
def test_a_jump_of_time_is_reported_with_both_times(jump: float, after: str) -> None:
    loop = Loop(method=StubMethod(ticks=20))
    loop.measured.stamp_ns = 1_000_000_000
    loop.propose_goal(NEAR)
    loop.tick(2)
    before = f"{loop.measured.stamp_ns / 1e9 - TICK:.9g}"
    assert loop.executive.phase is Phase.EXECUTING
    loop.measured.stamp_ns += round(jump * 1e9)
    loop.tick()
    words = f"has jumped from {before} s to {after} s; no motion is planned for that time."
    assert any(words in notice for notice in loop.notices), loop.notices


def test_plan_and_execution_are_reported_with_the_duration_of_the_gait() -> None:
    loop = Loop(method=StubMethod(ticks=13))
    loop.propose_goal(NEAR)
    status = loop.until(PlannerState.EXECUTING)
    assert status.message == "Executing a stub gait of 0.65 s."
    reported = [output.message for output in loop.outputs if isinstance(output, Event)]
    assert "The plan is a stub gait of 0.65 s." in reported


def test_a_box_without_width_has_its_largest_curvature_in_it() -> None:
    """As for the largest square that the limits of one joint leave room for."""
    phase = PlanarPhase(SpaceRobot.from_file(FOLDER / "planar_chain.urdf"))
    plane = PhasePlane(phase, np.zeros(2), 0, 1)
    boxes = np.array([[[0.4, -2.0], [0.4, 2.0]], [[-0.3, 0.7], [-0.3, 0.7]]])
    line, point = curvature_peaks(plane, np.array([0.4, 0.1]), boxes)
    assert point.tolist() == [-0.3, 0.7]
    assert line[0] == 0.4
    along = np.column_stack([np.full(801, 0.4), np.linspace(-2.0, 2.0, 801)])
    top = np.abs(phase_density(along)).max()
    assert abs(phase_density(line)) == pytest.approx(top, rel=1e-4)


# -- nominal shapes ---------------------------------------------------------------------------


def test_a_joint_with_limits_is_not_turned_round_to_a_nominal_shape() -> None:
    """It is more than half a turn away, and the other way round is beyond the limits."""
    robot = SpaceRobot.from_file(FOLDER / "three_joint_arm.urdf")
    options = {"nominal": [2.0, -0.8, 1.5], "k": 0.5}
    gait = planner_of("area_loop", robot, 0.25, Tolerance(1.0, 1e-2), 0.05, **options)
    start = state_at(np.zeros(3), Rotation.identity(), [-2.9, -0.8, 1.5])
    schedule = gait.plan(start, goal_at(np.zeros(3), Rotation.from_rotvec([0.0, 0.0, 0.05])))
    assert schedule.positions[:, 0].max() == pytest.approx(2.0, abs=0.5)
    assert np.all(schedule.positions >= robot.lower - 1e-12)
    assert np.all(schedule.positions <= robot.upper + 1e-12)
