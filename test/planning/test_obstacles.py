"""Plans keep clear of obstacles and of the robot itself, and of obstacles that come in flight."""

from __future__ import annotations

import gc
import logging
from dataclasses import replace
from pathlib import Path
from typing import Any

import casadi as ca
import coal
import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation, Slerp
from support.hand_motion import attitude_after
from support.oracles import PinocchioOracle
from support.planner_phases import resting
from support.urdf_text import numbers

from spacerobot_ros.collision import CollisionGeometry
from spacerobot_ros.collision.geometry import Approach
from spacerobot_ros.collision.planes import PlaneDistances
from spacerobot_ros.errors import ParameterError, PlanningError, Proof, UnreachableError
from spacerobot_ros.flight.trials import PlanningProblem
from spacerobot_ros.model import RobotDescription, SpaceRobot, load_robot
from spacerobot_ros.model.description import Array, Pose
from spacerobot_ros.model.shared_parameters import robot_of
from spacerobot_ros.model.urdf import load_world, parse_world, with_world
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
from spacerobot_ros.planning.core.schedule import BasePath
from spacerobot_ros.planning.execution.config import PlannerConfig
from spacerobot_ros.planning.execution.worker import PlanningWorker
from spacerobot_ros.planning.methods.optimal import OptimalGait
from spacerobot_ros.planning.methods.optimal.kept_distances import KeptDistances
from spacerobot_ros.planning.methods.optimal.multiple_shooting import MultipleShooting
from spacerobot_ros.planning.methods.optimal.problem import (
    BoundaryConditions,
    MotionLimits,
    OptimalOptions,
    PathConstraints,
    Trajectory,
)
from spacerobot_ros.planning.methods.optimal.transcription import ConstraintBlock, Stages
from spacerobot_ros.planning.methods.registry import RemainingJointsGait
from spacerobot_ros.resources import robot_file, share_directory
from spacerobot_ros.scenario import load_scenario
from spacerobot_ros.simulation import InitialState

QUICK: dict[str, Any] = {"answers": 1, "intervals": 40, "cache": 0}
STRUT = share_directory() / "config" / "worlds" / "strut.urdf"

ELSEWHERE = RobotState(
    np.array([0.4, -1.3, 0.7]), Rotation.from_rotvec([0.5, -0.3, 1.1]).as_quat(), np.zeros(3)
)
"""A start whose base is not at the origin of the world."""


def distances_to(
    pose: Pose, obstacle: Any, robot: SpaceRobot, schedule: GaitSchedule, state: RobotState
) -> list[float]:
    """Return the distances (N + 1) of the nearest link to a solid at the ticks, m, by coal.

    The poses of the base are those of Pinocchio, at which the centre of mass rests.
    """
    oracle = PinocchioOracle(robot.description.urdf, robot.joint_names)
    oracle.set_configuration(state.q, state.quaternion, state.position)
    center, R_WB = oracle.center_of_mass_W(), Rotation.from_quat(state.quaternion)
    made = {"box": coal.Box, "cylinder": coal.Cylinder, "sphere": coal.Sphere}
    there, found, before = coal.Transform3s(pose.R, pose.r), [], state.q
    for q in schedule.positions:
        R_WB, before = attitude_after(oracle, np.array([before, q]), R_WB), q
        oracle.set_configuration(q, R_WB.as_quat())
        oracle.set_configuration(q, R_WB.as_quat(), center - oracle.center_of_mass_W())
        least = np.inf
        for link in robot.description.links:
            R, r = oracle.frame_W(link.name)
            for shape in link.collisions or link.shapes:
                here = coal.Transform3s(R @ shape.pose.R, r + R @ shape.pose.r)
                solid, result = made[shape.kind](*shape.size), coal.DistanceResult()
                request = coal.DistanceRequest()
                least = min(least, coal.distance(solid, here, obstacle, there, request, result))
        found.append(least)
    return found


def ball_at(place: npt.ArrayLike, radius: float) -> RobotDescription:
    """Return a world with a ball at a place (3,)."""
    ball = f'<collision><geometry><sphere radius="{radius}"/></geometry></collision>'
    return parse_world(
        f'<robot name="w"><link name="w"/><link name="rock">{ball}</link>'
        '<joint name="j" type="fixed"><parent link="w"/><child link="rock"/>'
        f'<origin xyz="{numbers(place)}"/></joint></robot>'
    )


def test_optimal_goes_round_a_rock(arm: SpaceRobot) -> None:
    attitude = Rotation.from_quat(ELSEWHERE.quaternion)
    place = ELSEWHERE.position + attitude.apply([1.8, -0.2, 0.1])
    rock = Pose(np.eye(3), place), coal.Sphere(0.12)
    goal = attitude * Rotation.from_rotvec([0, 0, 0.2])
    quick: dict[str, Any] = {"rotvec": goal.as_rotvec(), "start": ELSEWHERE}
    quick |= {**QUICK, "intervals": 20}
    plain = plan(arm, **quick)
    assert -0.06 < min(distances_to(*rock, arm, plain, ELSEWHERE)) < 0
    clear = plan(arm, world=ball_at(place, 0.12), **quick)
    assert min(distances_to(*rock, arm, clear, ELSEWHERE)) >= 0.01 - 1e-4


def test_the_pose_of_a_goal_in_an_obstacle_is_refused_before_a_search(arm: SpaceRobot) -> None:
    goal, shape = Rotation.from_rotvec([0.5, -0.3, 1.0]), np.array([0.3, -0.4, 0.5])
    start = Rotation.from_quat(ELSEWHERE.quaternion)
    r_WC = ELSEWHERE.position + start.apply(arm.center_of_mass(ELSEWHERE.q))
    _, r_all = arm.function("link_poses", compile=False)(shape)
    hand = np.array(r_all)[:, arm.link_names.index("end_effector")]
    world = ball_at(r_WC + goal.apply(hand - arm.center_of_mass(shape)), 0.05)
    wanted: dict[str, Any] = {"rotvec": goal.as_rotvec(), "joint_positions": shape, **QUICK}
    with pytest.raises(UnreachableError, match="The pose of the goal is in collision") as caught:
        plan(arm, start=ELSEWHERE, world=world, **wanted)
    assert caught.value.proof is Proof.COLLISION


def test_a_clearance_of_zero_is_a_centimetre_among_obstacles(arm: SpaceRobot) -> None:
    described = with_world(arm.description, load_world(STRUT))
    assert Clearance.wanted(arm.description, 0.0) is None
    for asked, kept in ((0.0, 0.01), (0.2, 0.2)):
        wanted = Clearance.wanted(described, asked)
        assert wanted is not None
        assert wanted.distance == kept


def test_the_world_of_a_scenario_is_that_of_plant_and_planner(tmp_path: Path) -> None:
    scenario = load_scenario("strut")
    assert scenario.plant.world == scenario.planner.world == str(STRUT)
    world = PlanningProblem.of(scenario).robot.description.world
    assert world is not None
    assert world.name == "strut"
    text = scenario.path.read_text("utf-8")
    file = tmp_path / "mine.yaml"
    file.write_text(text.replace("worlds/strut.urdf", "none.urdf"), "utf-8")
    with pytest.raises(ParameterError, match=r"The world in the scenario file .* cannot be read"):
        load_scenario(str(file))
    file.write_text(text.replace("worlds/strut.urdf", str(robot_file("free_flyer"))), "utf-8")
    with pytest.raises(ParameterError, match='give it type="fixed"'):
        load_scenario(str(file))


def test_a_path_of_the_base_is_read_between_its_poses() -> None:
    turns = Rotation.from_rotvec([[0.0, 0, 0.1], [0.0, 0, 0.3], [0.0, 0.02, 0.3]])
    quaternions = turns.as_quat() * np.array([[1.0], [-1.0], [1.0]])
    path = BasePath(np.array([0.0, 1.0, 3.0]), np.eye(3), quaternions)
    position, quaternion = path.at(np.array([0.25, 1.0, 2.0, 9.0]))
    wanted_r: Any = [[0.75, 0.25, 0], [0, 1, 0], [0, 0.5, 0.5], [0, 0, 1]]
    np.testing.assert_allclose(position, wanted_r)
    wanted = Slerp([0.0, 1.0, 3.0], turns)([0.25, 1.0, 2.0, 3.0])
    assert (wanted.inv() * Rotation.from_quat(quaternion)).magnitude().max() < 1e-4
    np.testing.assert_allclose(np.linalg.norm(quaternion, axis=1), 1.0, atol=1e-14)


@pytest.mark.parametrize("obstacles", [True, False])
def test_a_worker_plans_among_the_obstacles_that_it_is_given(*, obstacles: bool) -> None:
    loop = resting()
    robot, config = loop.plant.robot, PlannerConfig(clearance=0.0)
    described = with_world(robot.description, ball_at(np.zeros(3), 0.3)) if obstacles else None
    worker = PlanningWorker(robot, config, loop.method, described=described)
    clearance = worker.clearance
    assert (clearance is not None) == obstacles
    assert clearance is None or (clearance.has_obstacles, clearance.distance) == (True, 0.01)


# -- rows of distances along an interval --------------------------------------------------------


N = 2


def rows() -> PlaneDistances:
    """Return one row as of links, and one as of a link and an obstacle."""
    y, w, multipliers = ca.SX.sym("y", N + 4), ca.SX.sym("w", 7, 2), ca.SX.sym("lambda", 2)
    of_links = ca.sin(y[0]) * y[1] * w[1, 0] + y[0] ** 2 - w[3, 0]
    of_obstacle = y[0] * y[3] + ca.cos(y[1]) * y[5] * w[2, 1] + w[6, 1] * y[2] * y[4]
    d = ca.vertcat(of_links, of_obstacle)
    H, slope = ca.hessian(ca.dot(multipliers, d), y)
    return PlaneDistances(
        ca.Function("d", [y, w], [d]),
        ca.Function("J", [y, w], [d, ca.jacobian(d, y)]),
        ca.Function("H", [y, w, multipliers], [slope.T, H]),
    )


H, START = 0.4, np.array([0.3, -0.7])
V, V_NEXT = np.array([0.5, -0.2]), np.array([-0.1, 0.6])
X, X_NEXT = np.array([0.1, -0.2, 0.3, 0.9]), np.array([0.2, -0.1, 0.25, 0.92])
# The variable s of a knot is q + h v / 2.
LACK = 0.03
Z = np.concatenate([[H], X, START + H * V / 2, V, X_NEXT, V_NEXT, [LACK]])
PLANES = np.random.default_rng(5).normal(size=(3, 2, 7))


def by_hand(z: np.ndarray) -> np.ndarray:
    """Return the rows at thirds of an interval in which velocities change linearly."""
    h, X0, s, v, X1, v1, lack = z[0], z[1:5], z[5:7], z[7:9], z[9:13], z[13:15], z[15]
    found = []
    for tau, (first, second) in zip((1 / 3, 2 / 3, 1.0), PLANES, strict=True):
        t = tau * h
        q = s - h * v / 2 + v * t + (v1 - v) / h * t**2 / 2
        y = np.concatenate([q, (1 - tau) * X0 + tau * X1])
        found.append(np.sin(q[0]) * q[1] * first[1] + q[0] ** 2 - first[3] + lack)
        of_obstacle = y[0] * y[3] + np.cos(y[1]) * y[5] * second[2] + second[6] * y[2] * y[4]
        found.append(of_obstacle + lack)
    return np.array(found)


def distance_block() -> ConstraintBlock:
    chain = SpaceRobot.from_file(robot_file("planar_chain"))
    constraints = PathConstraints.of(chain, OptimalOptions())
    block = Stages.of(chain, np.eye(3), False, constraints).with_distances(rows(), 3).distances
    assert block is not None
    return block


def test_rows_are_those_of_the_shapes_between_the_knots() -> None:
    block, p = distance_block(), PLANES.ravel()
    np.testing.assert_allclose(block.values(Z, p).full().ravel(), by_hand(Z), atol=1e-13)
    values, J = block.jacobian(Z, p)
    np.testing.assert_allclose(values.full().ravel(), by_hand(Z), atol=1e-13)
    step = 1e-6
    differences = [(by_hand(Z + e) - by_hand(Z - e)) / (2 * step) for e in step * np.eye(len(Z))]
    np.testing.assert_allclose(J.full(), np.column_stack(differences), atol=1e-8)


def test_second_derivatives_are_those_of_differences() -> None:
    block, p = distance_block(), PLANES.ravel()
    multipliers = np.array([0.7, -1.2, 0.4, 2.0, -0.6, 1.1])

    def gradient(z: np.ndarray) -> np.ndarray:
        return np.asarray(block.jacobian(z, p)[1].full().T @ multipliers)

    step = 1e-6
    expected = np.column_stack(
        [(gradient(Z + e) - gradient(Z - e)) / (2 * step) for e in step * np.eye(len(Z))]
    )
    upper = block.hessian(Z, p, multipliers).full()
    np.testing.assert_allclose(np.triu(upper), np.triu(expected), atol=1e-8)
    assert np.abs(np.tril(upper, -1)).max() == pytest.approx(0.0, abs=1e-12)


# -- clearances -----------------------------------------------------------------------------------


TOLERANCE = Tolerance(1e-6, 1e-6, 1e-6)


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


def test_solvers_are_released_with_their_planner(arm: SpaceRobot) -> None:
    """With two arms, they take a hundred megabytes, which the garbage collector does not see."""

    def count() -> int:
        return sum(isinstance(each, MultipleShooting) for each in gc.get_objects())

    gc.disable()
    try:
        before = count()
        planned(
            arm,
            "optimal",
            (0.09, -0.26, -0.21),
            np.zeros(3),
            Clearance(arm.description, 0.03),
            **QUICK,
        )
        assert count() == before
    finally:
        gc.enable()


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
        (nearest,), _ = clearance.geometry.nearest_along(np.array([[0.0, -0.1, middle]]))
        far, near = (middle, near) if nearest > 0.07 else (far, middle)
    required = clearance.required(np.array([0.0, -0.1, middle]))
    assert np.sort(required) == pytest.approx([0.07, 0.1, 0.1], abs=1e-5)


def test_links_that_begin_much_nearer_keep_half_of_their_distance(
    arm: SpaceRobot, caplog: pytest.LogCaptureFixture
) -> None:
    clearance = Clearance(arm.description, 0.6)
    assert clearance.geometry.nearest_along(np.zeros((1, 3)))[0] == pytest.approx(0.25)
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


def test_loops_do_not_begin_for_a_goal_shape_in_collision(arm: SpaceRobot) -> None:
    """They would fly for an hour before the last way, to the shape, is refused."""
    touching = np.array([-0.01, -0.073, 2.175])
    for method in ("area_loop", "auto", "optimal"):
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
    options = {"optimal": method_options("optimal", {**QUICK, "base_attitude": 0})}
    stuck = {arm.joint_names[0]: 0.0}
    method = RemainingJointsGait(
        arm, 0.05, 0.01, stuck=stuck, method="optimal", options=options, clearance=clearance
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
    distance, pair = (each[0].item() for each in geometry.nearest_along(near[np.newaxis]))
    clearance = Clearance(robot.description, distance - 1e-4)
    no_turn, prediction = np.array([0.0, 0.0, 0.0, 1.0]), BasePrediction(robot, 0.05, 0.01)
    boundary = BoundaryConditions(away, no_turn, near, near)
    kept = KeptDistances(clearance, robot, prediction, boundary, turn_is_known=True)
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
    distances, own = kept.planes(pair, geometry.poses(shapes))
    np.testing.assert_allclose(
        planes[:, [0, 1, 2, 4, 5, 6]], own[:, [0, 1, 2, 4, 5, 6]], atol=1e-12
    )
    asked = planes[:, 3] - own[:, 3]
    assert np.all(asked <= distances + 1e-12)
    assert np.ptp(asked) > 1e-3, "far from each other links have the room of all"
