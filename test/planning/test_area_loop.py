"""Loops of three joints: paper 2's convergence in the plant, and what is refused, and why."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from planning.flown import STEP, fly, measured, plant_at
from scipy.spatial.transform import Rotation
from support.decided_clearance import DecidedClearance
from support.oracles import PinocchioOracle
from support.oracles.integrated import IDENTITY, carried
from support.planar_manoeuvres import goal_of
from support.planners import Planner, planner_of
from support.random_robots import random_robot_urdf
from support.slow import some_fast

from spacerobot_ros.errors import ParameterError, PlanningError
from spacerobot_ros.model import SpaceRobot, load_robot
from spacerobot_ros.model.description import Array
from spacerobot_ros.planning import METHODS, Goal, PlanRequest, RobotState, Tolerance
from spacerobot_ros.planning.core.clearance import Clearance
from spacerobot_ros.planning.methods import area_loop
from spacerobot_ros.planning.methods.area_loop import AreaLoopGait, EdgePath, edge_path
from spacerobot_ros.planning.methods.nominal_shape import NominalShape, NominalShapeChooser
from spacerobot_ros.resources import robot_file

URDF = Path(__file__).parents[2] / "urdf" / "three_joint_arm.urdf"
NOMINAL = np.radians([0.0, -45.0, 90.0])
PERIOD = 0.25


def planner(
    robot: SpaceRobot, attitude: float = 1e-3, period: float = PERIOD, **options: Any
) -> Planner:
    return planner_of("area_loop", robot, period, Tolerance(1.0, attitude, 1e-6), STEP, **options)


def turned(*degrees: float) -> Rotation:
    return Rotation.from_rotvec(np.radians(degrees))


def integrated(oracle: PinocchioOracle, corners: Array) -> Array:
    """Return the rotation vector (3,) of the base along straight legs of the shape (V, n), by
    Pinocchio's base rate at zero momentum and DOP853.
    """
    pose = IDENTITY
    for a, b in itertools.pairwise(corners):
        pose = carried(oracle, a, b - a, 1.0, pose)
    return np.asarray(Rotation.from_quat(pose[3:]).as_rotvec())


def around(nominal: NominalShape, areas: Array) -> Array:
    """Return the shapes (V, n) along the path that encloses areas (3,) round a nominal shape."""
    path = edge_path(areas, nominal.longest)
    shapes = [nominal.shape]
    for loop in path.loops:
        for corner in loop:
            shape = nominal.shape.copy()
            shape[list(nominal.joints)] += corner
            shapes.append(shape)
        shapes.append(nominal.shape)
    return np.array(shapes)


# -- first order ------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("areas", [(1, 0.7, 0.5), (-0.6, 1, 0.8), (1, 0, 0), (0, -1, 0.4)])
@pytest.mark.parametrize("seed", [None, 3])
def test_small_loops_turn_the_base_by_the_curvature_matrix(
    arm: SpaceRobot, seed: int | None, areas: tuple[float, float, float]
) -> None:
    urdf = URDF.read_text() if seed is None else random_robot_urdf(np.random.default_rng(seed), 4)
    robot = arm if seed is None else SpaceRobot.from_urdf(urdf)
    oracle = PinocchioOracle(urdf, robot.joint_names)
    shape = NOMINAL if seed is None else np.clip([0.3, -0.4, 0.5, 0.2], robot.lower, robot.upper)
    joints = [robot.joint_names[i] for i in ((0, 1, 2) if seed is None else (3, 0, 2))]
    nominal = NominalShapeChooser(robot, 1.0, " ".join(joints)).around(shape)
    errors = []
    for size in (4e-3, 1e-3):
        S = size * np.array(areas)
        wanted = nominal.M @ S
        turn = integrated(oracle, around(nominal, S))
        errors.append(np.linalg.norm(turn - wanted) / np.linalg.norm(wanted))
    # To first order: what is left goes down with the size of the loop, at least as its side.
    assert errors[1] < 0.02
    assert errors[1] < 0.55 * errors[0]


def test_the_best_nominal_shape_is_better_than_any_of_many(arm: SpaceRobot) -> None:
    chooser = NominalShapeChooser(arm, 1.0)
    best = chooser.best(np.zeros(3))

    def worst_turn(nominal: NominalShape) -> float:
        room = np.minimum(nominal.shape - arm.lower, arm.upper - nominal.shape)
        edges = np.clip(2 * room, 0.0, 1.0)
        areas = edges * np.roll(edges, -1)
        return float(np.linalg.svd(nominal.M * areas)[1][-1])

    rng = np.random.default_rng(5)
    for shape in rng.uniform(arm.lower, arm.upper, (500, 3)):
        assert worst_turn(chooser.around(shape)) <= worst_turn(best) + 1e-6
    # Loops of a radian fit round it.
    assert np.all(best.shape - 0.5 >= arm.lower)
    assert np.all(best.shape + 0.5 <= arm.upper)


# -- convergence ------------------------------------------------------------------------------


def test_five_degrees_about_each_axis_converge_as_in_the_paper(arm: SpaceRobot) -> None:
    goal = goal_of(turned(5, 5, 5))
    method = planner(arm, 1e-3, nominal=NOMINAL.tolist())
    flight = fly(method, plant_at(arm, NOMINAL, PERIOD), goal)
    left = np.degrees(np.abs(flight.left(goal)))
    assert left[19].max() <= 0.22
    assert left[29].max() <= 0.045
    # k = 0.15 to first order leaves 0.85^N.
    np.testing.assert_allclose(left[19], 5 * 0.85**20, rtol=0.05)
    assert np.radians(np.linalg.norm(left[-1])) <= 1e-3
    # All but the last know that they end short of the goal.
    assert [piece.partial for piece in flight.pieces] == [True] * (len(left) - 1) + [False]
    # The first estimate of the number of cycles was right.
    assert flight.pieces[0].notes["expected_cycles"] == pytest.approx(len(left), abs=2)


def test_the_prediction_is_what_the_plant_does(arm: SpaceRobot) -> None:
    attitude = turned(40, -70, 100)
    plant = plant_at(arm, [0.4, -1.2, 0.3], PERIOD, attitude)
    goal = goal_of(attitude * turned(3, 8, -5))
    method = planner(arm, cycles_per_plan=3)
    schedule = method.plan(measured(plant), goal)
    assert schedule.notes["cycles"] == 3
    knots = np.round(schedule.path.time / PERIOD).astype(int).tolist()
    assert (knots[0], knots[-1]) == (0, schedule.ticks)
    for k, rates in enumerate(schedule.velocities):
        if k in knots:
            i = knots.index(k)
            np.testing.assert_allclose(schedule.path.position[i], plant.pose[:3], atol=1e-9)
            np.testing.assert_allclose(schedule.path.quaternion[i], plant.pose[3:], atol=1e-9)
        assert not plant.step(rates)
    np.testing.assert_allclose(plant.q, schedule.positions[-1], atol=1e-9)
    left = Rotation.from_quat(plant.pose[3:]).inv() * Rotation.from_quat(goal.quaternion)
    assert schedule.notes["predicted_attitude_error"] == pytest.approx(left.magnitude(), abs=1e-9)


# -- other robots, shapes and limits ----------------------------------------------------------


@pytest.mark.parametrize("seed", some_fast(range(2), 0))
def test_any_robot_of_three_joints_or_more(seed: int) -> None:
    rng = np.random.default_rng(40 + seed)
    robot = SpaceRobot.from_urdf(random_robot_urdf(rng, 3 + seed % 2))
    q = np.clip(rng.uniform(-1, 1, robot.n), robot.lower, robot.upper)
    attitude = Rotation.from_rotvec(rng.normal(size=3))
    goal = goal_of(attitude * Rotation.from_rotvec(rng.uniform(-0.2, 0.2, 3)))
    method = planner(robot, 0.02, k=0.6)
    flight = fly(method, plant_at(robot, q, PERIOD, attitude), goal)
    assert np.linalg.norm(flight.left(goal)[-1]) <= 0.02
    # Three joints move, the others rest.
    moved = np.ptp(np.vstack([piece.positions for piece in flight.pieces]), axis=0) > 1e-9
    assert moved.sum() <= 3


def test_the_final_shape_is_reached_with_the_attitude(arm: SpaceRobot) -> None:
    final = np.array([1.0, -2.0, -0.5])
    goal = goal_of(turned(-4, 6, 2), final)
    method = planner(arm, 2e-3, k=0.5)
    flight = fly(method, plant_at(arm, [0.4, -1.2, 0.3], PERIOD), goal)
    assert np.linalg.norm(flight.left(goal)[-1]) <= 2e-3
    np.testing.assert_allclose(flight.shapes[-1], final, atol=1e-9)
    # There, nothing is left to do.
    end = plant_at(arm, final, PERIOD, Rotation.from_quat(flight.poses[-1][3:]))
    schedule = method.plan(measured(end), goal, correction=True)
    assert (schedule.ticks, schedule.partial) == (0, False)


def test_the_nominal_shape_at_the_end_of_a_stroke_moves_its_loops_inside(arm: SpaceRobot) -> None:
    shape = np.array([0.0, arm.upper[1], arm.lower[2]])
    method = planner(arm, 0.01, nominal=shape.tolist(), k=0.5)
    goal = goal_of(turned(8, -4, 3))
    flight = fly(method, plant_at(arm, shape, PERIOD), goal)
    assert np.linalg.norm(flight.left(goal)[-1]) <= 0.01
    shapes = np.vstack([piece.positions for piece in flight.pieces])
    assert np.all(shapes >= arm.lower - 1e-12)
    assert np.all(shapes <= arm.upper + 1e-12)


def test_edges_are_no_longer_than_allowed_and_rates_are_kept(arm: SpaceRobot) -> None:
    goal = goal_of(turned(0, 0, 170))
    method = planner(arm, largest_edge=0.3, edge_time=0.5, nominal=NOMINAL.tolist())
    schedule = method.plan(measured(plant_at(arm, NOMINAL, PERIOD)), goal)
    assert np.abs(schedule.positions - NOMINAL).max() <= 0.15 + 1e-9
    assert np.abs(schedule.velocities).max() <= 0.5 + 1e-9
    # Slower than half a second an edge: the servos' 0.5 rad/s.
    assert np.abs(schedule.velocities).max() > 0.4


def test_slow_edges_take_their_time_and_start_and_end_at_rest(arm: SpaceRobot) -> None:
    goal = goal_of(turned(5, 5, 5))
    method = planner(arm, period=0.01, edge_time=10.0, nominal=NOMINAL.tolist())
    schedule = method.plan(measured(plant_at(arm, NOMINAL, 0.01)), goal)
    # Six edges, and half an edge's time to the first corner and back.
    assert schedule.duration == pytest.approx(70.0)
    corners = np.array([0, 5, *range(15, 70, 10), 70]) * 100
    speed = np.linalg.norm(schedule.velocities, axis=1)
    for k in corners[1:-1]:
        assert max(speed[k - 1], speed[k]) < 1e-3 * speed.max()
    np.testing.assert_allclose(schedule.positions[-1], NOMINAL, atol=1e-12)


def test_a_joint_without_limits_takes_the_nearest_turn() -> None:
    endless = changed('shoulder_yaw" type="revolute"', 'shoulder_yaw" type="continuous"')
    method = planner(endless, nominal=NOMINAL.tolist())
    schedule = method.plan(at([4 * np.pi + 1.0, 0.0, 1.0]), goal_of(turned(5, 5, 5)))
    np.testing.assert_allclose(schedule.positions[-1], NOMINAL + np.array([4 * np.pi, 0.0, 0.0]))


def test_a_joint_with_limits_is_not_turned_round_to_a_nominal_shape(arm: SpaceRobot) -> None:
    """It is more than half a turn away, and the other way round is beyond the limits."""
    gait = planner(arm, 1e-2, nominal=[2.0, -0.8, 1.5], k=0.5)
    schedule = gait.plan(at([-2.9, -0.8, 1.5]), goal_of(Rotation.from_rotvec([0.0, 0.0, 0.05])))
    assert schedule.positions[:, 0].max() == pytest.approx(2.0, abs=0.5)
    assert np.all(schedule.positions >= arm.lower - 1e-12)
    assert np.all(schedule.positions <= arm.upper + 1e-12)


@pytest.mark.parametrize(
    ("nominal", "joint"),
    [
        ((2.99, -0.8, 1.5), 0),
        ((-2.99, -0.8, 1.5), 0),
        ((0.0, 0.395, 1.5), 1),
        ((0.0, -0.8, 2.79), 2),
    ],
)
def test_a_loop_near_a_limit_is_moved_and_not_cut_off(
    arm: SpaceRobot, nominal: tuple[float, float, float], joint: int
) -> None:
    """Its edges are as long as the areas need; cut off, the base would turn less."""
    method = planner(arm, nominal=nominal)
    schedule = method.plan(at(nominal), goal_of(turned(1.0, -1.5, 2.0)))
    edges = np.array(schedule.notes["edges"])
    assert edges[joint] / 2 > min(
        arm.upper[joint] - nominal[joint], nominal[joint] - arm.lower[joint]
    )
    np.testing.assert_allclose(np.ptp(schedule.positions, axis=0), edges, rtol=1e-9)
    assert np.all(schedule.positions >= arm.lower - 1e-12)
    assert np.all(schedule.positions <= arm.upper + 1e-12)


# -- what `area_loop` refuses, and the reason it gives -------------------------------------------


GOAL = Goal.checked([0, 0, 0], Rotation.from_rotvec([0.1, -0.2, 0.3]).as_quat())


FLAT = '<axis xyz="0 0 1"/>', '<axis xyz="0 1 0"/>'
STUCK = 'upper="2.8" velocity="0.5"', 'upper="2.8" velocity="0"'
NARROW = 'lower="-2.8" upper="2.8"', 'lower="1.0" upper="1.00001"'
# Straight up along the yaw axis, the arm's yaw moves no mass off its axis.
STRAIGHT = (0.0, -np.pi / 2, 0.0)


def changed(old: str = "", new: str = "") -> SpaceRobot:
    """Return the three-joint arm with a part of its text replaced."""
    text = URDF.read_text()
    assert old in text
    return SpaceRobot.from_urdf(text.replace(old, new))


def at(q: npt.ArrayLike, **momenta: Array) -> RobotState:
    return RobotState(np.zeros(3), np.array([0, 0, 0, 1.0]), np.asarray(q, dtype=float), **momenta)


@pytest.mark.parametrize(
    ("robot", "options", "shape", "sentence"),
    [
        (FLAT, {}, [0, 0, 0], "span 1 of the three axes"),
        (STUCK, {}, NOMINAL, r"three moving joints; .* has 2 with a velocity"),
        (NARROW, {}, [0, 0, 1], "leave joint 'elbow_pitch' no room"),
        (
            (),
            {"nominal": STRAIGHT},
            NOMINAL,
            r"singular at the nominal shape \[0.0, -1.5708, 0.0\]",
        ),
        ((), {"most_cycles": 20}, NOMINAL, r"takes about \d+\S* cycles, more than most_cycles"),
        # Small loops, more of them.
        ((), {"most_cycles": 60, "largest_edge": 0.05}, NOMINAL, "more than most_cycles"),
        ((), {"attitude": 0.0}, NOMINAL, "about inf cycles"),
        ((), {"longest": 600.0}, NOMINAL, r"cycles of \S+ s, more than longest = 600 s"),
        ((), {"longest": 2.0}, NOMINAL + 1, "more than longest = 2 s; the slowest joint is"),
    ],
)
def test_what_cannot_be_planned_is_refused_at_once(
    robot: tuple[str, ...], options: dict[str, Any], shape: npt.ArrayLike, sentence: str
) -> None:
    with pytest.raises(PlanningError, match=sentence):
        planner(changed(*robot), **options).plan(at(shape), GOAL)


def test_robots_of_two_joints_or_one_axis_do_not_suit() -> None:
    chain = SpaceRobot.from_file(robot_file("planar_chain"))
    for robot, sentence in (
        (chain, r"needs three joints .* 'planar_chain' has 2"),
        (changed(*FLAT), "span 1 of the three axes"),
    ):
        with pytest.raises(PlanningError, match=sentence):
            METHODS["area_loop"].require_suitable(robot)


@pytest.mark.parametrize(
    ("shape", "reason"),
    [([0.0, 0.0], r"has 2 joint positions"), ([0.0, 0.5, 0.0], "'shoulder_pitch' at 0.5 rad")],
)
def test_a_final_shape_that_is_none_is_refused(
    arm: SpaceRobot, shape: list[float], reason: str
) -> None:
    goal = Goal.checked(GOAL.position, GOAL.quaternion, shape)
    with pytest.raises(PlanningError, match=reason):
        planner(arm).plan(at(NOMINAL), goal)


def test_the_last_cycle_that_a_goal_may_take_is_flown(arm: SpaceRobot) -> None:
    goal = goal_of(Rotation.from_rotvec([0.0, 1e-3, 0.0]))
    method = planner(arm, 5e-4, most_cycles=1, k=1.0, nominal=NOMINAL.tolist())
    schedule = method.plan(at(NOMINAL), goal)
    assert (schedule.notes["cycles"], schedule.notes["expected_cycles"]) == (1.0, 1.0)


def test_a_base_that_comes_no_nearer_is_given_up(arm: SpaceRobot) -> None:
    # A plant that does not turn at all: the same attitude is measured again and again.
    method, stuck = planner(arm, most_cycles=60), at(NOMINAL)
    needed = float(str(method.plan(stuck, GOAL).notes["expected_cycles"]))
    for _ in range(int(60 - needed)):
        method.plan(stuck, GOAL, correction=True)
    with pytest.raises(PlanningError, match=r"more than most_cycles = 60; \d+ have been flown"):
        method.plan(stuck, GOAL, correction=True)
    # Another goal begins from nothing.
    again = Goal.checked(GOAL.position, GOAL.quaternion)
    assert method.plan(at(NOMINAL), again).partial


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"nominal": [0.0, 0.0]}, r"area_loop.nominal has 2 numbers"),
        ({"nominal": [0.0, 1.0, 0.0]}, "'shoulder_pitch' at 1, but its limits"),
        ({"joints": "shoulder_yaw elbow_pitch"}, "must name three of the joints"),
        ({"joints": "shoulder_yaw elbow_pitch wrist"}, "must name three of the joints"),
        ({"joints": "elbow_pitch elbow_pitch shoulder_yaw"}, "must name three of the joints"),
    ],
)
def test_options_that_do_not_fit_the_robot(
    arm: SpaceRobot, options: dict[str, Any], reason: str
) -> None:
    with pytest.raises(ParameterError, match=reason):
        planner(arm, **options)


def test_loops_that_turn_the_wrong_way_are_given_up_however_small(
    arm: SpaceRobot, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The method believes in the opposite of the true curvature."""
    method = METHODS["area_loop"](arm, 0.25, 0.05)
    choose = NominalShapeChooser.at

    def opposite(self: NominalShapeChooser, *args: Any) -> NominalShape:
        chosen = choose(self, *args)
        return replace(chosen, M=-chosen.M)

    tried: list[Array] = []

    def counted(areas: Array, longest: Array) -> EdgePath:
        tried.append(areas)
        assert len(tried) < 20, "it goes on for ever"
        return edge_path(areas, longest)

    monkeypatch.setattr(NominalShapeChooser, "at", opposite)
    monkeypatch.setattr(area_loop, "edge_path", counted)
    with pytest.raises(PlanningError, match=r"None of 6 cycles .* brings the base closer"):
        method.plan(PlanRequest(at(NOMINAL), GOAL, Tolerance(1.0, 1e-3)))


START = at([0.3, -0.6, 1.2])
WALL = -1.0
"""Position of the second joint above which links come too near, rad, in these tests."""


def beyond_the_wall(shapes: Array) -> bool:
    return bool(np.all(shapes[:, 1] <= WALL))


def walled(
    arm: SpaceRobot, motions: Callable[[Array], bool] | None = None, **options: Any
) -> AreaLoopGait:
    """Return a method for which links come too near where the second joint is above the wall."""
    method = planner(arm, **options).method
    assert isinstance(method, AreaLoopGait)
    method.clearance = DecidedClearance(
        arm.description, lambda shapes: not beyond_the_wall(shapes), motions
    )
    return method


def test_boxes_of_loops_keep_clear_and_are_the_best_that_do(arm: SpaceRobot) -> None:
    chooser = NominalShapeChooser(arm, 1.0)
    kept = chooser.with_clearance(START.q, 0.5, beyond_the_wall)
    free = chooser.with_clearance(START.q, 0.5, lambda shapes: True)
    assert free is not None
    assert kept is not None
    assert free.shape[1] > WALL, "the best one is beyond the wall only if it must be"
    assert kept.shape[1] + kept.longest[1] / 2 <= WALL + 1e-12
    assert kept.longest.max() <= 0.5
    assert chooser.with_clearance(START.q, 0.5, lambda shapes: False) is None
    # Edges of less than a tenth of a milliradian are none.
    assert chooser.with_clearance(START.q, 1e-5, lambda shapes: True) is None
    seen: list[Array] = []

    def refuse(shapes: Array) -> bool:
        seen.append(shapes)
        return False

    chooser.with_clearance(START.q, 0.5, refuse)
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
    free = planner(arm).plan(START, GOAL)
    moved = walled(arm).plan(PlanRequest(at([0.3, -1.5, 1.2]), GOAL, Tolerance(1.0, 1e-3)))
    assert beyond_the_wall(moved.positions)
    nominal = np.array(moved.notes["nominal"])
    assert nominal[1] < WALL
    assert nominal[1] != pytest.approx(np.array(free.notes["nominal"])[1])
    # Edges are as long as a box has room for: 0.2 rad is far more than a shrunk loop has.
    assert max(np.atleast_1d(moved.notes["edges"])) > 0.2
    # A wall that no loop comes to changes nothing.
    method = walled(arm, lambda positions: False)
    same = method.plan(PlanRequest(START, GOAL, Tolerance(1.0, 1e-3)))
    np.testing.assert_array_equal(same.positions, free.positions)


def test_cycles_are_counted_with_the_loop_that_is_flown(arm: SpaceRobot) -> None:
    nominal = (0.3, WALL - 0.03, 1.2)
    request = PlanRequest(at(nominal), GOAL, Tolerance(1.0, 1e-3))
    many: dict[str, Any] = {"nominal": nominal, "longest": 1e9, "most_cycles": 1000000}
    free = planner(arm, **many).method.plan(request)
    shrunk = walled(arm, **many).plan(request)
    assert np.ptp(shrunk.positions[:, 1]) <= 0.06 + 1e-9
    S, small = (np.linalg.norm(each.notes["S"]) for each in (free, shrunk))
    assert small < 0.3 * S
    # A cycle makes up for a share of 0.15 of what is left, as far as its loop is large enough.
    left = np.linalg.norm([0.1, -0.2, 0.3])
    largest, count = 0.15 * left * small / S, 0
    while left > 1e-3:
        left -= min(0.15 * left, largest)
        count += 1
    cycles = float(str(shrunk.notes["expected_cycles"]))
    assert cycles == pytest.approx(count, abs=2)
    most = int(cycles) - 1
    with pytest.raises(PlanningError) as refusal:
        walled(arm, **{**many, "most_cycles": most}).plan(request)
    assert str(refusal.value) == (
        f"The goal takes about {cycles:.4g} cycles, more than most_cycles = {most}; "
        "0 have been flown. In a loop twice as large, links 'a' and 'b' come within 0.004 m."
    )


def test_required_distances_are_kept_at_all_shapes() -> None:
    robot = load_robot(robot_file("servicer"))
    clearance = Clearance(robot, 0.05)
    away, near = np.array([0.0, -1.4, 0.5, 0, 0, 0]), np.array([-2.5, -0.37, 1.86, 0.0, 0.0, 0.0])
    geometry = clearance.geometry
    distances, pairs = geometry.nearest_along(np.stack([away, near]))
    assert distances[0] > 2 * distances[1]
    between = np.full(len(geometry.pairs), 0.5 * sum(distances))
    assert clearance.is_clear(away[np.newaxis], between)
    assert not clearance.is_clear(near[np.newaxis], between)
    assert not clearance.is_clear(np.stack([away, near]), between)
    assert clearance.is_clear(np.stack([away, near]), np.full(len(between), distances[1] - 1e-6))
    # A pair that need not keep any distance does not count.
    free = between.copy()
    free[pairs[1]] = -np.inf
    others = sorted(
        float(geometry.distances(k, geometry.poses(near[np.newaxis]))[0]) for k in range(len(free))
    )
    assert clearance.is_clear(near[np.newaxis], np.minimum(free, others[1] - 1e-9))
