"""The gait of random sliding masses: predictions against another integration."""

from __future__ import annotations

import itertools

import numpy as np
import numpy.typing as npt
import pytest
from planning.sliding_robots import SlidingRobot, paper_robot
from scipy.spatial.transform import Rotation
from support.planners import planner_of
from support.slides_and_turns import (
    PERIOD,
    TIGHT,
    check_prediction,
    goal_at,
    misses,
    note,
    origin,
    planner,
    random_case,
    state_at,
)

from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.planning import Goal, Tolerance

Array = npt.NDArray[np.float64]

CASES = [(3, 8), (3, 9), (4, 3), (4, 9), (5, 2), (5, 7), (5, 10)]


@pytest.mark.parametrize(("sliders", "seed"), CASES)
def test_the_goal_is_met_by_another_integration(sliders: int, seed: int) -> None:
    robot, state, goal, _ = random_case(sliders, seed)
    schedule = planner(robot).plan(state, goal)
    np.testing.assert_array_equal(schedule.positions[0], state.q)
    assert schedule.joint_names == tuple(f"s{k}" for k in range(1, sliders + 1))
    position, attitude = check_prediction(robot, state, schedule)
    distance, angle = misses(goal, position, attitude)
    assert distance <= TIGHT.position
    assert angle <= TIGHT.attitude
    # At rest in the final shape.
    np.testing.assert_allclose(
        schedule.positions[-1],
        note(schedule, "zf"),
        rtol=0,
        atol=1e-12,
    )


@pytest.mark.parametrize(("sliders", "seed"), [(3, 0), (3, 4), (3, 22), (3, 25), (4, 13)])
def test_refinement_meets_the_tolerance_where_first_order_is_far_off(
    sliders: int, seed: int
) -> None:
    # Ill-conditioned brackets, and goals between two numbers of cycles.
    robot, state, goal, _ = random_case(sliders, seed)
    schedule = planner(robot).plan(state, goal)
    position, quaternion = schedule.path.position[-1], schedule.path.quaternion[-1]
    distance, angle = misses(goal, position, Rotation.from_quat(quaternion))
    assert angle <= TIGHT.attitude
    assert distance <= TIGHT.position


@pytest.mark.parametrize("seed", range(6))
def test_three_sliders_have_one_final_shape(seed: int) -> None:
    robot, state, goal, z_f = random_case(3, seed)
    schedule = planner(robot, Tolerance(1.0, 1.0)).plan(state, goal)
    np.testing.assert_allclose(note(schedule, "zf"), z_f, atol=1e-9)


@pytest.mark.parametrize(("sliders", "seed"), [(4, 1), (4, 2), (5, 0), (5, 1)])
def test_more_sliders_share_the_least_displacement(sliders: int, seed: int) -> None:
    robot, state, goal, _ = random_case(sliders, seed)
    schedule = planner(robot, Tolerance(1.0, 1.0)).plan(state, goal)
    z_f = note(schedule, "zf")
    end = Rotation.from_quat(goal.quaternion)
    start = Rotation.from_quat(state.quaternion)
    before = state.position + start.apply(robot.center_of_mass(state.q))
    np.testing.assert_allclose(
        goal.position + end.apply(robot.center_of_mass(z_f)), before, atol=1e-9
    )
    # Nothing along the motions that leave the centre of mass where it is.
    moments = np.array([s.mass * s.direction for s in robot.sliders])
    np.testing.assert_allclose(null_space(moments.T).T @ (z_f - state.q), 0, atol=1e-9)


def null_space(A: Array) -> Array:
    return np.linalg.svd(A)[2][np.linalg.matrix_rank(A) :].T


def first_order_brackets(robot: SlidingRobot, z: Array) -> Array:
    """Return ``w[:, i, j] = omega_[Fi,Fj]`` of eq. (7), its derivatives by central differences."""
    n, h = len(z), 1e-5
    unit = np.eye(n)
    Ft = np.array([robot.base_rate(z, unit[i]) for i in range(n)])
    slope = np.array(
        [
            [
                (
                    robot.base_rate(z + h * unit[j], unit[i])
                    - robot.base_rate(z - h * unit[j], unit[i])
                )
                / (2 * h)
                for j in range(n)
            ]
            for i in range(n)
        ]
    )
    w = np.empty((3, n, n))
    for i, j in itertools.product(range(n), repeat=2):
        w[:, i, j] = np.cross(Ft[j], Ft[i]) + slope[i, j] - slope[j, i]
    return w


@pytest.mark.slow
@pytest.mark.parametrize(("sliders", "seed"), [(4, 0), (4, 3), (4, 5), (5, 1), (5, 3), (5, 9)])
def test_the_turn_is_made_by_the_best_triple_of_sliders(sliders: int, seed: int) -> None:
    robot, state, goal, _ = random_case(sliders, seed)
    schedule = planner(robot, Tolerance(1.0, 1.0)).plan(state, goal)
    w = first_order_brackets(robot, note(schedule, "zf"))
    conditions = {
        triple: np.linalg.cond(
            np.column_stack(
                [w[:, i, j] for i, j in (triple[:2], triple[1:], (triple[0], triple[2]))]
            )
        )
        for triple in itertools.combinations(range(sliders), 3)
    }
    best = min(conditions, key=lambda triple: conditions[triple])
    assert schedule.notes["sliders"] == ", ".join(f"s{k + 1}" for k in best)
    # The others rest while it turns.
    turning = schedule.positions[round(5.0 / PERIOD) :]
    moved = np.ptp(turning, axis=0) > 1e-12
    assert [k for k in range(sliders) if moved[k]] == list(best)


def test_alpha_solves_for_the_attitude_that_is_missing() -> None:
    robot, state, goal, z_f = random_case(3, 8)
    schedule = planner(robot, Tolerance(1.0, 1.0)).plan(state, goal)
    w = first_order_brackets(robot, z_f)
    matrix = np.column_stack([w[:, 0, 1], w[:, 1, 2], w[:, 0, 2]])
    slide = schedule.positions[: round(5.0 / PERIOD) + 1]
    after = robot.attitudes(slide, PERIOD, Rotation.from_quat(state.quaternion))[-1]
    missing = (after.inv() * Rotation.from_quat(goal.quaternion)).as_rotvec()
    np.testing.assert_allclose(note(schedule, "omega_d"), missing, atol=1e-9)
    np.testing.assert_allclose(
        note(schedule, "alpha"),
        np.linalg.solve(matrix, missing),
        rtol=1e-6,
    )


def test_other_joints_stay_where_they_are() -> None:
    # A boom with a hinge between the base and nothing else: its shape belongs to the robot.
    boom = (
        '<link name="boom"><inertial><origin xyz="0.4 0 0"/><mass value="1.5"/>'
        '<inertia ixx="0.01" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>'
        '<joint name="hinge" type="revolute"><parent link="base_link"/><child link="boom"/>'
        '<origin xyz="0 0.3 0"/><axis xyz="0 0 1"/>'
        '<limit lower="-3" upper="3" velocity="1" effort="9"/></joint>'
    )
    bare = paper_robot()
    robot = SpaceRobot.from_urdf(bare.urdf.replace("</robot>", f"{boom}</robot>"))
    hinge = robot.joint_names.index("hinge")
    q = np.zeros(4)
    q[hinge] = 0.7
    method = planner_of("lie_bracket", robot, PERIOD, TIGHT, t1=5.0, n1=1, cycle_period=1.0)
    goal = goal_at([0.03, -0.02, 0.01], Rotation.from_rotvec([0.02, 0.01, -0.02]))
    schedule = method.plan(state_at(np.zeros(3), Rotation.identity(), q), goal)
    np.testing.assert_array_equal(schedule.positions[:, hinge], 0.7)
    # The same as a robot on which the boom is part of the base.
    turn = Rotation.from_rotvec([0.0, 0.0, 0.7])
    mass, centre = 1.5, np.array([0.0, 0.3, 0.0]) + turn.apply([0.4, 0.0, 0.0])
    inertia = turn.as_matrix() @ np.diag([0.01, 0.1, 0.1]) @ turn.as_matrix().T
    welded_centre = mass * centre / (bare.mass + mass)
    reduced = bare.mass * mass / (bare.mass + mass)
    about = (
        bare.inertia + inertia + reduced * (centre @ centre * np.eye(3) - np.outer(centre, centre))
    )
    welded = SlidingRobot(bare.mass + mass, about, welded_centre, bare.sliders)
    sliders = [i for i in range(4) if i != hinge]
    attitudes = welded.attitudes(schedule.positions[:, sliders], PERIOD, Rotation.identity())
    positions = welded.positions(schedule.positions[:, sliders], attitudes, np.zeros(3))
    distance, angle = misses(goal, positions[-1], attitudes[-1])
    assert distance <= TIGHT.position
    assert angle <= TIGHT.attitude


@pytest.mark.parametrize("correction", [False, True])
def test_a_goal_that_is_the_present_pose_takes_no_time(correction: bool) -> None:
    robot, state, _, _ = random_case(3, 1)
    goal = Goal.checked(state.position, state.quaternion)
    schedule = planner(robot).plan(state, goal, correction=correction)
    assert schedule.ticks == 0
    assert schedule.duration == 0.0
    np.testing.assert_allclose(schedule.positions, [state.q], atol=1e-14)
    assert schedule.velocities.shape == (0, 3)
    np.testing.assert_allclose(schedule.path.position, [state.position], atol=1e-14)


def test_a_goal_of_position_alone_is_a_slide_and_what_it_turned() -> None:
    robot = paper_robot()
    # One mass through the centre of mass turns nothing.
    goal = goal_at([0.1, 0.0, 0.0], Rotation.identity())
    schedule = planner(robot).plan(origin(), goal)
    assert schedule.ticks == round(5.0 / PERIOD)
    assert note(schedule, "cycles") == 0.0
    np.testing.assert_allclose(schedule.positions[-1], [-0.8, 0.0, 0.0], atol=1e-12)
