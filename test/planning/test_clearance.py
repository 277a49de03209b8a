"""Plans keep clear of contacts between links: every method, by distances at dense samples."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from spacerobot_ros.collision import CollisionGeometry
from spacerobot_ros.collision.nearest import Approach
from spacerobot_ros.errors import ParameterError, PlanningError, Proof, UnreachableError
from spacerobot_ros.flight.trials import PlanningProblem
from spacerobot_ros.model import SpaceRobot, load_robot
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.shared_parameters import robot_of
from spacerobot_ros.planning import (
    METHODS,
    GaitSchedule,
    Goal,
    PlanRequest,
    RobotState,
    Tolerance,
    method_options,
    plan,
)
from spacerobot_ros.planning.core.clearance import Clearance
from spacerobot_ros.planning.core.method import InitialMotion
from spacerobot_ros.planning.core.prediction import BasePrediction
from spacerobot_ros.planning.core.progress import SearchPhase, SearchProgress, report_progress
from spacerobot_ros.planning.execution.config import PlannerConfig
from spacerobot_ros.planning.methods.optimal import OptimalGait
from spacerobot_ros.planning.methods.optimal.kept_distances import DistanceLibrary
from spacerobot_ros.planning.methods.optimal.problem import (
    BoundaryConditions,
    MotionLimits,
    Trajectory,
)
from spacerobot_ros.planning.methods.remaining_joints import RemainingJointsGait
from spacerobot_ros.resources import robot_file
from spacerobot_ros.simulation import InitialState

TOLERANCE = Tolerance(1e-6, 1e-6, 1e-6)
QUICK: dict[str, Any] = {"answers": 1, "intervals": 40, "cache": 0}


@pytest.fixture(scope="module")
def arm() -> SpaceRobot:
    return SpaceRobot.from_file(robot_file("three_joint_arm"))


def bare(name: str) -> SpaceRobot:
    """Return a robot of the package without its SRDF."""
    described = SpaceRobot.from_file(robot_file(name)).description
    return SpaceRobot(replace(described, disabled_collisions=frozenset()))


def planned(
    robot: SpaceRobot,
    method: str,
    rotvec: npt.ArrayLike,
    start: npt.ArrayLike,
    clearance: Clearance | None,
    **options: Any,
) -> GaitSchedule:
    maker = METHODS[method](robot, 0.05, 0.01, method_options(method, options), clearance)
    state = RobotState(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), np.array(start, dtype=float))
    return maker.plan(PlanRequest(state, Goal.from_rotvec(np.zeros(3), rotvec), TOLERANCE))


def nearest_of(geometry: CollisionGeometry, positions: Array) -> float:
    """Return the smallest distance at 400 instants of held commands, m."""
    ticks = np.linspace(0, len(positions) - 1, 400)
    at = np.column_stack([np.interp(ticks, np.arange(len(positions)), x) for x in positions.T])
    poses = geometry.poses(at)
    return min(float(geometry.distances(p, poses).min()) for p in range(len(geometry.pairs)))


@pytest.mark.parametrize("distance", [0.03, pytest.param(0.01, marks=pytest.mark.slow)])
def test_optimal_goes_round_a_contact(arm: SpaceRobot, distance: float) -> None:
    goal = (0.09, -0.26, -0.21), np.zeros(3)
    clearance = Clearance(arm.description, distance)
    plain = planned(arm, "optimal", *goal, None, **QUICK)
    assert nearest_of(clearance.geometry, plain.positions) < -0.01
    seen: list[SearchProgress] = []
    with report_progress(seen.append):
        clear = planned(arm, "optimal", *goal, clearance, **QUICK)
    phases = [each.phase for each in seen]
    assert list(dict.fromkeys(phases)) == list(SearchPhase), "each begins after the one before"
    shortened = [each.best_s for each in seen if each.phase is SearchPhase.SHORTENING]
    assert shortened == sorted(shortened, reverse=True)
    assert shortened[-1] == pytest.approx(clear.duration, rel=0.05), "the best is a clear one"
    assert nearest_of(clearance.geometry, clear.positions) >= distance
    assert clear.duration < 1.3 * plain.duration
    error = clear.notes["predicted_attitude_error"]
    assert isinstance(error, float)
    assert error < 1e-9


def test_where_no_clear_way_is_fast_enough_the_fastest_is_named(arm: SpaceRobot) -> None:
    few: dict[str, Any] = {**QUICK, "starts": 4, "intervals": 12, "control_period": 0.1}
    turn, start = (0.09, -0.26, -0.21), np.zeros(3)
    with pytest.raises(PlanningError, match=r"= 4\.5 s: the fastest one found takes 5"):
        plan(arm, rotvec=turn, start=start, clearance=0.03, longest=4.5, **few)


def test_a_plan_that_is_clear_stays_the_same(arm: SpaceRobot) -> None:
    goal = (0.27, 0.17, -0.05), np.zeros(3)
    plain = planned(arm, "optimal", *goal, None, **QUICK)
    clear = planned(arm, "optimal", *goal, Clearance(arm.description, 0.01), **QUICK)
    assert np.array_equal(plain.positions, clear.positions)


def test_a_plan_in_motion_keeps_clear(arm: SpaceRobot) -> None:
    goal = (0.09, -0.26, -0.21), np.zeros(3)
    clearance = Clearance(arm.description, 0.01)
    plain = planned(arm, "optimal", *goal, None, **QUICK)
    tick = 10
    motion = InitialMotion(plain.velocities[tick - 1], plain.positions[tick:])
    state = RobotState(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), plain.positions[tick])
    # In the frame in which the motion has turned the base so far, the goal is another one.
    request = PlanRequest(state, Goal.from_rotvec(np.zeros(3), goal[0]), TOLERANCE, motion=motion)
    options = method_options("optimal", QUICK)
    clear = OptimalGait(arm, 0.05, 0.01, options, clearance).plan(request)
    assert nearest_of(clearance.geometry, clear.positions) >= 0.01
    assert np.array_equal(clear.positions[0], plain.positions[tick])


def test_a_pair_that_begins_nearer_comes_no_nearer(arm: SpaceRobot) -> None:
    clearance = Clearance(arm.description, 0.1)
    far, near = 1.9, 2.175
    for _ in range(40):
        middle = (far + near) / 2
        nearest = clearance.geometry.nearest(np.array([0.0, -0.1, middle]))
        assert nearest is not None
        far, near = (middle, near) if nearest[0] > 0.07 else (far, middle)
    required = clearance.required(np.array([0.0, -0.1, middle]))
    assert np.sort(required) == pytest.approx([0.07, 0.1, 0.1], abs=1e-5)


def test_links_that_begin_much_nearer_keep_half_of_their_distance(
    arm: SpaceRobot, caplog: pytest.LogCaptureFixture
) -> None:
    clearance = Clearance(arm.description, 0.6)
    closest = clearance.geometry.nearest(np.zeros(3))
    assert closest is not None
    assert closest[0] == pytest.approx(0.25)
    schedule = planned(arm, "optimal", (0.1, 0.0, 0.0), np.zeros(3), clearance, **QUICK)
    assert 0.125 <= nearest_of(clearance.geometry, schedule.positions) < 0.3
    assert "apart at the start, closer than planner.clearance = 0.6 m: they are kept" in caplog.text


@pytest.mark.parametrize("distance", [-0.01, float("nan"), float("inf")])
def test_a_clearance_that_is_no_distance_is_refused(arm: SpaceRobot, distance: float) -> None:
    with pytest.raises(ParameterError, match="clearance is"):
        plan(arm, rotvec=(0.1, 0.0, 0.0), clearance=distance)


def test_a_contact_at_the_start_is_ignored_with_one_warning(
    caplog: pytest.LogCaptureFixture,
) -> None:
    robot = bare("sliding_masses")
    clearance = Clearance(robot.description, 0.01)
    with caplog.at_level(logging.WARNING):
        for _ in range(2):
            schedule = planned(
                robot, "lie_bracket", (0.02, 0.01, -0.02), (0.0, 0.02, 1.0), clearance
            )
    warnings = [each.message for each in caplog.records if "in contact" in each.message]
    assert [each.split(" are ")[0] for each in warnings] == ["Links 'mass_1' and 'mass_2'"]
    assert schedule.ticks > 0


def test_a_goal_shape_in_collision_is_refused(arm: SpaceRobot) -> None:
    touching = np.array([-0.01, -0.073, 2.175])
    with pytest.raises(UnreachableError, match="The shape of the goal is in collision") as refusal:
        plan(arm, rotvec=(0.05, 0.0, 0.0), joint_positions=touching, clearance=0.01, cache=0)
    assert refusal.value.proof is Proof.COLLISION


def test_loops_do_not_begin_for_a_goal_shape_in_collision(arm: SpaceRobot) -> None:
    """They would fly for an hour before the last way, to the shape, is refused."""
    touching = np.array([-0.01, -0.073, 2.175])
    for method in ("area_loop", "auto"):
        with pytest.raises(UnreachableError, match="The shape of the goal is in coll") as refusal:
            plan(arm, rotvec=(0.05, 0.0, 0.0), joint_positions=touching, method=method)
        assert refusal.value.proof is Proof.COLLISION
    flat = bare("planar_chain")
    folded = np.array([3.1, 3.1])
    with pytest.raises(UnreachableError, match="The shape of the goal is in collision"):
        plan(flat, rotvec=(0.0, 0.0, 0.1), joint_positions=folded, method="square_path")


def test_cycles_of_sliders_shrink() -> None:
    robot = bare("sliding_masses")
    goal = (0.02, 0.01, -0.02), (0.35, -0.07, 0.28)
    clearance = Clearance(robot.description, 0.01)
    plain = planned(robot, "lie_bracket", *goal, None)
    clear = planned(robot, "lie_bracket", *goal, clearance)
    assert nearest_of(clearance.geometry, plain.positions) < 0.01
    cycle = clear.positions[: 40 * 60]
    assert nearest_of(clearance.geometry, cycle) >= 0.01


def test_squares_in_collision_are_refused_with_the_pair() -> None:
    robot = bare("planar_chain")
    with pytest.raises(
        PlanningError,
        match=r"On square loops .* links 'base_link' and 'segment_2' touch, .* at the shape \[-2",
    ):
        planned(robot, "square_path", (0, 0, 0.4), (0.3, -0.4), Clearance(robot.description, 0.01))


def test_joints_that_follow_keep_clear_where_others_are_stuck(arm: SpaceRobot) -> None:
    clearance = Clearance(arm.description, 0.01)
    method = RemainingJointsGait(
        arm,
        0.05,
        0.01,
        stuck={arm.joint_names[0]: 0.0},
        method="optimal",
        options={"optimal": method_options("optimal", {**QUICK, "base_attitude": 0})},
        clearance=clearance,
    )
    state = RobotState(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), np.array([0.0, 0.0, 1.2]))
    goal = Goal(np.zeros(3), state.quaternion, np.array([0.0, 0.0, -1.2]))
    schedule = method.plan(PlanRequest(state, goal, TOLERANCE))
    assert nearest_of(clearance.geometry, schedule.positions) >= 0.01


def test_the_srdf_of_the_planner_is_read(tmp_path: Path) -> None:
    path = tmp_path / "mine.srdf"
    path.write_text('<robot><disable_collisions link1="base_link" link2="link_2"/></robot>')
    robot = robot_of(PlannerConfig(robot="three_joint_arm", srdf=str(path), model_error=0.1))
    assert robot is not None
    assert robot.description.disabled_collisions == {frozenset({"base_link", "link_2"})}
    plain = robot_of(PlannerConfig(robot="three_joint_arm"))
    assert plain is not None
    assert plain.description.disabled_collisions == frozenset()


def test_the_clearance_of_the_planner_is_kept(arm: SpaceRobot) -> None:
    # Links are nearer than that in the shape of the goal.
    shape = np.array([0.0, -0.1, 2.04])
    goal = replace(Goal.from_rotvec(np.zeros(3), (0.1, 0.0, 0.0)), joint_positions=shape)
    problem = PlanningProblem("near", arm, InitialState(), goal, PlannerConfig(clearance=0.2))
    state = RobotState(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(3))
    with pytest.raises(PlanningError, match=r"in collision: .*; planner\.clearance is 0\.2 m"):
        problem.method("optimal").plan(PlanRequest(state, goal, TOLERANCE))


def test_a_clear_path_keeps_to_the_planes_between_its_links() -> None:
    """Planes are where the path has its links, however little more than the clearance that is."""
    robot = SpaceRobot(load_robot(robot_file("servicer")))
    away, near = np.array([0.0, -1.4, 0.5, 0, 0, 0]), np.array([0.0, 0.6, 0.5, 0, 0, 0])
    geometry = Clearance(robot.description, 0.0).geometry
    closest = geometry.nearest(near)
    assert closest is not None
    distance, pair = closest[:2]
    library = DistanceLibrary(
        Clearance(robot.description, distance - 1e-4), robot, BasePrediction(robot, 0.05, 0.01)
    )
    no_turn = np.array([0.0, 0.0, 0.0, 1.0])
    boundary = BoundaryConditions(away, no_turn, near, near)
    kept = library.begin(boundary, turn_is_known=True)
    s = np.linspace(0.0, 1.0, 41)[:, np.newaxis]
    path = Trajectory(
        0.05,
        away + s * (near - away),
        np.tile((near - away) / 2.0, (41, 1)),
        np.tile(no_turn, (41, 1)),
    )
    assert not kept.approaches_of(path)
    kept.add([Approach(geometry.links_of(pair), pair, distance, 40, near)])
    still = MotionLimits(robot.lower, robot.upper, np.ones(6), np.ones(6))
    planes = kept.within(still, path).distances.reshape(-1, 7)
    shapes, _ = kept.along(path)
    distances, own = library.planes(boundary, pair, geometry.poses(shapes))
    np.testing.assert_allclose(
        planes[:, [0, 1, 2, 4, 5, 6]], own[:, [0, 1, 2, 4, 5, 6]], atol=1e-12
    )
    asked = planes[:, 3] - own[:, 3]
    assert np.all(asked <= distances + 1e-12)
    assert np.ptp(asked) > 1e-3, "far from each other links have the room of all"
