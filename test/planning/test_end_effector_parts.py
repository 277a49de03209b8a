"""Parts of goals of end-effectors, against other ways to get them: rows, radii, ends."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation
from support.urdf_text import link

from spacerobot_ros.errors import NotFoundError, Proof, UnreachableError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.planning import Goal, RobotState
from spacerobot_ros.planning.core.goal import EndEffectorGoal, Tolerance
from spacerobot_ros.planning.core.method import PlanRequest
from spacerobot_ros.planning.methods.optimal.end_effectors import (
    EndEffectorRows,
    EndEffectorSpecification,
    reach_of_end_effector,
)
from spacerobot_ros.planning.methods.optimal.goal_specification import GoalSpecification
from spacerobot_ros.planning.methods.optimal.motion_bounds import moving_joint_ranges
from spacerobot_ros.planning.methods.optimal.problem import MotionLimits, OptimalOptions
from spacerobot_ros.resources import robot_file

Array = npt.NDArray[np.float64]

PLACE, ATTITUDE = np.array([0.4, -0.3, 0.2]), Rotation.from_rotvec([0.3, -0.5, 0.4])
ARM = np.array([0.4, -0.9, 1.1])
OTHER = np.array([-0.7, -0.2, 1.9])
TOOL = "end_effector"


@pytest.fixture(scope="module")
def arm() -> SpaceRobot:
    return SpaceRobot.from_file(robot_file("three_joint_arm"))


@pytest.fixture(scope="module")
def chain() -> SpaceRobot:
    return SpaceRobot.from_file(robot_file("planar_chain"))


@pytest.fixture(scope="module")
def rows(arm: SpaceRobot) -> EndEffectorRows:
    return EndEffectorRows(arm, [(TOOL, True), ("base_link", False)], np.eye(3))


@pytest.fixture(scope="module")
def position_rows(arm: SpaceRobot) -> EndEffectorRows:
    return EndEffectorRows(arm, [(TOOL, False)], np.eye(3))


def at_rest(q: npt.ArrayLike) -> RobotState:
    return RobotState(PLACE, ATTITUDE.as_quat(), np.asarray(q, dtype=float))


def seen(robot: SpaceRobot, name: str, q: Array, X: Rotation) -> tuple[Array, Rotation]:
    """Return a link's place from the centre of mass and its attitude, in the base of the start."""
    R, r = robot.link_pose(name, q)
    return X.apply(r - robot.center_of_mass(q)), X * Rotation.from_matrix(R)


# -- rows ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("angle", [0.4, 2.6, -1.3, np.pi - 1e-5])
def test_rows_are_displacements_and_twice_the_sine_of_half_the_angle(
    arm: SpaceRobot, rows: EndEffectorRows, angle: float
) -> None:
    X = Rotation.from_rotvec([0.2, 0.5, -0.3])
    r, R = seen(arm, TOOL, OTHER, X)
    base, _ = seen(arm, "base_link", OTHER, X)
    axis = np.array([0.6, 0.0, -0.8])
    goal = Rotation.from_rotvec(-angle * axis) * R
    aim, aim_of_base = np.array([0.5, -0.1, 0.3]), np.array([-0.2, 0.3, 0.7])
    parameters = np.concatenate([aim, goal.as_quat(), aim_of_base, [0.0, 0.0, 0.0, 1.0]])
    found = np.asarray(rows.function(X.as_quat(), OTHER, parameters)).ravel()
    # The number in the root keeps the derivative finite at half a turn.
    scale = np.sqrt(2 * (1 + np.cos(angle)) + 1e-9)
    turned = 2 * np.sin(angle) / scale * axis
    np.testing.assert_allclose(found[3:6], turned, rtol=1e-5, atol=1e-9)
    if abs(angle) < 3:
        np.testing.assert_allclose(found[3:6], 2 * np.sin(angle / 2) * axis, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(found[:3], r - aim, atol=1e-12)
    np.testing.assert_allclose(found[6:], base - aim_of_base, atol=1e-12)


def test_goals_are_packed_as_seen_from_the_centre_of_mass(
    arm: SpaceRobot, rows: EndEffectorRows
) -> None:
    aim, R_aim = np.array([1.1, 0.2, -0.4]), Rotation.from_rotvec([0.7, 0.1, -0.2])
    goals = [
        EndEffectorGoal(TOOL, aim, R_aim.as_quat()),
        EndEffectorGoal("base_link", PLACE + 0.1),
    ]
    packed = rows.pack(at_rest(ARM), goals)
    center = PLACE + ATTITUDE.apply(arm.center_of_mass(ARM))
    np.testing.assert_allclose(packed[:3], ATTITUDE.inv().apply(aim - center))
    assert (Rotation.from_quat(packed[3:7]).inv() * ATTITUDE.inv() * R_aim).magnitude() < 1e-9
    np.testing.assert_allclose(packed[7:10], ATTITUDE.inv().apply(PLACE + 0.1 - center))
    np.testing.assert_array_equal(packed[10:], [0.0, 0.0, 0.0, 1.0])
    assert rows.parameters == 14


def test_derivatives_at_several_ends_are_those_of_each(rows: EndEffectorRows) -> None:
    p = rows.pack(
        at_rest(ARM),
        [EndEffectorGoal(TOOL, PLACE, ATTITUDE.as_quat()), EndEffectorGoal("base_link", PLACE)],
    )
    X = Rotation.from_rotvec([[0.1, 0.2, 0.3], [-0.4, 0.1, 0.6]]).as_quat()
    both = rows.evaluate(X, np.array([ARM, OTHER]), p)
    for k, q in enumerate((ARM, OTHER)):
        one = rows.evaluate(X[k : k + 1], q[np.newaxis], p)
        for together, alone in zip(both, one, strict=True):
            np.testing.assert_allclose(together[k], alone[0], atol=1e-14)


def test_turns_on_direct_ways_are_those_of_many_small_steps(
    arm: SpaceRobot, rows: EndEffectorRows
) -> None:
    ends = np.array([OTHER, [1.3, -0.6, 0.9]])
    for X, end in zip(rows.turns_along_direct_path(ARM, ends), ends, strict=True):
        turned, step = Rotation.identity(), (end - ARM) / 600
        for k in range(600):
            A = arm.connection(ARM + (k + 0.5) * step)[3:]
            turned *= Rotation.from_rotvec(-A @ step)
        assert (turned.inv() * Rotation.from_quat(X)).magnitude() < 2e-5


# -- directions ---------------------------------------------------------------------------------


SLIDER = (
    '<robot name="slider">'
    + link("base_link", 9.0, np.diag([2.0, 3.0, 4.0]), np.array([0.1, 0.0, 0.0]))
    + link("mass", 3.0, np.diag([0.2, 0.3, 0.1]), np.zeros(3))
    + '<joint name="slot" type="prismatic"><parent link="base_link"/><child link="mass"/>'
    '<origin xyz="0.1 0 0"/><axis xyz="0.6 0 0.8"/>'
    '<limit lower="-0.4" upper="0.5" velocity="1" effort="9"/></joint></robot>'
)


@pytest.fixture(scope="module")
def slider() -> SpaceRobot:
    """A slider whose slot goes through both centres of mass: nothing turns."""
    return SpaceRobot.from_urdf(SLIDER)


def test_directions_are_those_in_which_the_joints_move_a_link(
    arm: SpaceRobot, chain: SpaceRobot, slider: SpaceRobot, rows: EndEffectorRows
) -> None:
    np.testing.assert_array_equal(rows.directions[0].displacements, np.eye(3))
    np.testing.assert_array_equal(rows.directions[0].rotations, np.eye(3))
    assert rows.directions[1].rotations.shape == (0, 3)
    (planar,) = EndEffectorRows(chain, [(chain.link_names[-1], True)], np.eye(3)[2:]).directions
    assert planar.displacements.shape == (2, 3)
    np.testing.assert_allclose(planar.displacements[:, 2], 0.0, atol=1e-9)
    np.testing.assert_allclose(np.abs(planar.rotations), [[0.0, 0.0, 1.0]], atol=1e-9)
    (one,) = EndEffectorRows(slider, [("mass", True)], np.zeros((0, 3))).directions
    np.testing.assert_allclose(np.abs(one.displacements), [[0.6, 0.0, 0.8]], atol=1e-9)
    assert one.rotations.shape == (0, 3)


def refusal(rows: EndEffectorRows, q: Array, goal: EndEffectorGoal, *tolerance: float) -> str:
    with pytest.raises(UnreachableError) as error:
        rows.require_directions(at_rest(q), [goal], (tolerance[0], tolerance[1]))
    assert error.value.proof is Proof.RANK
    return str(error.value)


def test_goals_beside_the_line_of_a_slider_are_refused(slider: SpaceRobot) -> None:
    rows = EndEffectorRows(slider, [("mass", True)], np.zeros((0, 3)))
    q = np.array([0.1])
    R, r = slider.link_pose("mass", q)
    r_WE, R_WE = PLACE + ATTITUDE.apply(r), ATTITUDE * Rotation.from_matrix(R)
    along, across = ATTITUDE.apply([0.6, 0.0, 0.8]), ATTITUDE.apply([0.8, 0.0, -0.6])
    off = EndEffectorGoal("mass", r_WE + 0.2 * along + 0.03 * across, R_WE.as_quat())
    rows.require_directions(at_rest(q), [off], (0.0301, 1e-6))
    assert refusal(rows, q, off, 0.0299, 1e-6) == (
        "The end-effector 'mass' of robot 'slider' moves along one line whatever the joints do, "
        "and its goal is 0.03 m away from there."
    )
    tilted = (Rotation.from_rotvec(0.04 * across) * R_WE).as_quat()
    turned = EndEffectorGoal("mass", r_WE + 0.2 * along, tilted)
    rows.require_directions(at_rest(q), [turned], (1e-6, 0.0401))
    assert refusal(rows, q, turned, 1e-6, 0.0399) == (
        "The end-effector 'mass' of robot 'slider' does not turn whatever the joints do, and its "
        "goal is tilted by 0.04 rad from there."
    )


def test_goals_off_the_plane_or_the_axis_of_a_chain_are_refused(chain: SpaceRobot) -> None:
    name = chain.link_names[-1]
    rows = EndEffectorRows(chain, [(name, True)], np.eye(3)[2:])
    q = np.array([0.4, -0.9])
    R, r = chain.link_pose(name, q)
    r_WE, R_WE = PLACE + ATTITUDE.apply(r), ATTITUDE * Rotation.from_matrix(R)
    normal = ATTITUDE.apply([0.0, 0.0, 1.0])
    inside = EndEffectorGoal(
        name,
        r_WE + ATTITUDE.apply([0.3, -0.4, 0.0]),
        (Rotation.from_rotvec(0.7 * normal) * R_WE).as_quat(),
    )
    rows.require_directions(at_rest(q), [inside], (1e-6, 1e-6))
    off = EndEffectorGoal(name, inside.position - 0.05 * normal, inside.quaternion)
    assert refusal(rows, q, off, 1e-3, 1e-3) == (
        f"The end-effector '{name}' of robot 'planar_chain' moves in one plane whatever the joints "
        "do, and its goal is 0.05 m away from there."
    )
    swing = Rotation.from_rotvec(ATTITUDE.apply([0.3, 0.0, 0.0]))
    tilted = EndEffectorGoal(name, inside.position, (swing * R_WE).as_quat())
    assert refusal(rows, q, tilted, 1e-3, 1e-3) == (
        f"The end-effector '{name}' of robot 'planar_chain' turns about one axis whatever the "
        "joints do, and its goal is tilted by 0.3 rad from there."
    )


def test_the_rank_counts_coordinates_that_the_joints_move(
    chain: SpaceRobot, rows: EndEffectorRows, position_rows: EndEffectorRows
) -> None:
    assert position_rows.rank(fixed_attitude=True) == (3, 3)
    assert rows.rank(fixed_attitude=False) == (5, 9)
    # Two joints and the turn of the base bring about three numbers in a plane.
    planar = EndEffectorRows(chain, [(chain.link_names[-1], True)], np.eye(3)[2:])
    assert planar.rank(fixed_attitude=False) == (3, 3)
    assert planar.rank(fixed_attitude=True) == (2, 3)


# -- the specification --------------------------------------------------------------------------


def specification(robot: SpaceRobot, goal: Goal) -> EndEffectorSpecification:
    return EndEffectorSpecification.of(robot, GoalSpecification.of(robot, OptimalOptions()), goal)


def tool_goal(robot: SpaceRobot, q: Array, X: Rotation, **parts: Any) -> Goal:
    """Return the goal of the tool's place in a shape, with the base turned by X."""
    center = PLACE + ATTITUDE.apply(robot.center_of_mass(ARM))
    r, R = seen(robot, TOOL, q, X)
    quaternion = (ATTITUDE * R).as_quat() if parts.pop("pose", False) else None
    aim = EndEffectorGoal(TOOL, center + ATTITUDE.apply(r), quaternion)
    return Goal.of_end_effectors([aim], **parts)


def test_kinds_of_goals_differ_by_their_parts(arm: SpaceRobot) -> None:
    place = EndEffectorGoal(TOOL, PLACE)
    pose = EndEffectorGoal(TOOL, PLACE, ATTITUDE.as_quat())
    goals = [
        Goal.of_end_effectors([place]),
        Goal.of_end_effectors([pose]),
        Goal.of_end_effectors([place], joint_positions=ARM),
        Goal.of_end_effectors([place], quaternion=ATTITUDE.as_quat()),
        Goal.of_end_effectors([place], position=PLACE),
    ]
    keys = [EndEffectorSpecification.key(goal) for goal in goals]
    assert len(set(keys)) == 5
    moved = EndEffectorGoal(TOOL, PLACE + 0.1)
    assert EndEffectorSpecification.key(Goal.of_end_effectors([moved])) == keys[0]
    kinds = [specification(arm, goal) for goal in goals]
    common = {"shape", "end_effectors"}
    more = [set(), set(), set(), {"attitude"}, {"position"}]
    assert [each.controls for each in kinds] == [common | each for each in more]
    assert [len(each.axes) for each in kinds] == [0, 3, 3, 3, 3]
    # Three joints move five coordinates of a pose, and of two positions.
    assert [each.overdetermined for each in kinds] == [False, True, False, False, True]
    assert [each.rows_at_end is None for each in kinds] == [False, True, True, False, True]
    names = [[name for name, _ in each.rows.links] for each in kinds]
    assert names == [[TOOL]] * 4 + [[TOOL, "base_link"]]
    assert [each.rows.links[0][1] for each in kinds] == [False, True, False, False, False]


@pytest.mark.parametrize("rotvec", [[0.1, 0.2, -0.1], [1.1, 1.9, -0.8], [-0.4, -0.3, 2.9]])
def test_the_turn_that_goes_with_given_joint_positions_is_found(
    arm: SpaceRobot, rotvec: list[float]
) -> None:
    X = Rotation.from_rotvec(rotvec)
    goal = tool_goal(arm, OTHER, X, pose=True, joint_positions=OTHER)
    kind = specification(arm, goal)
    request = PlanRequest(at_rest(ARM), goal, Tolerance(1e-6, 1e-6))
    boundary = kind.boundary_conditions(
        arm, request, OTHER, MotionLimits.of(arm, OptimalOptions()), np.array([0.0, 0.6, 0.8])
    )
    assert (Rotation.from_quat(boundary.goal_rotation).inv() * X).magnitude() < 1e-9
    np.testing.assert_array_equal(boundary.likely_final_shape, OTHER)
    assert boundary.final is OTHER
    assert boundary.center is None
    assert boundary.end_effectors.size == 0
    np.testing.assert_allclose(boundary.direction, ATTITUDE.inv().apply([0.0, 0.6, 0.8]))
    (end,) = boundary.possible_ends
    np.testing.assert_array_equal(end.base_rotation, boundary.goal_rotation)


def test_joint_positions_that_contradict_the_goal_are_refused_by_their_error(
    arm: SpaceRobot,
) -> None:
    goal = tool_goal(arm, OTHER, Rotation.identity(), joint_positions=OTHER)
    kind = specification(arm, goal)
    # In another shape the tool is nearer to the centre of mass, whatever the base does.
    shape = OTHER + np.array([0.1, 0.2, 0.3])
    here, there = (
        float(np.linalg.norm(seen(arm, TOOL, q, Rotation.identity())[0])) for q in (OTHER, shape)
    )
    request = PlanRequest(at_rest(ARM), goal, Tolerance(1e-6, 1e-6))
    limits = MotionLimits.of(arm, OptimalOptions())
    with pytest.raises(UnreachableError) as error:
        kind.boundary_conditions(arm, request, shape, limits, None)
    assert error.value.proof is Proof.MOMENTUM
    sentence = str(error.value)
    assert sentence.startswith(
        "With the joint positions of the goal no attitude of the base puts the end-effectors "
        "nearer than "
    )
    assert sentence.endswith(
        " m or rad to their goals: the centre of mass stays where it is. Leave the joint positions "
        "out."
    )
    stated = float(sentence.split("nearer than ")[1].split()[0])
    assert stated == pytest.approx(here - there, rel=2e-3)
    # Where the tolerance is larger, it will do.
    loose = PlanRequest(at_rest(ARM), goal, Tolerance(here - there, 1.0))
    assert kind.boundary_conditions(arm, loose, shape, limits, None).final is shape


@pytest.mark.parametrize("fixed", [False, True])
def test_possible_ends_are_at_the_goal_and_different_and_the_nearest_come_first(
    arm: SpaceRobot, fixed: bool
) -> None:
    X = Rotation.from_rotvec([0.05, -0.1, 0.08])
    parts = {"quaternion": (ATTITUDE * X).as_quat()} if fixed else {}
    goal = tool_goal(arm, OTHER, X, **parts)
    kind = specification(arm, goal)
    limits = MotionLimits.of(arm, OptimalOptions())
    request = PlanRequest(at_rest(ARM), goal, Tolerance(1e-6, 1e-6))
    boundary = kind.boundary_conditions(arm, request, None, limits, None)
    assert 1 <= len(boundary.possible_ends) <= 6
    assert boundary.final is None
    np.testing.assert_array_equal(boundary.likely_final_shape, boundary.possible_ends[0].shape)
    np.testing.assert_array_equal(boundary.direction, 0.0)
    half = limits.joint_ranges(ARM)[1]
    times = []
    for k, end in enumerate(boundary.possible_ends):
        values, _, _ = kind.rows.evaluate(
            end.base_rotation[np.newaxis], end.shape[np.newaxis], boundary.end_effectors
        )
        assert np.abs(values).max() <= 2e-3
        assert np.all((end.shape >= limits.lower) & (end.shape <= limits.upper))
        if fixed:
            assert (Rotation.from_quat(end.base_rotation).inv() * X).magnitude() < 1e-9
        else:
            direct = kind.rows.turns_along_direct_path(ARM, end.shape[np.newaxis])[0]
            np.testing.assert_allclose(end.base_rotation, direct, atol=1e-12)
        times.append(np.abs((end.shape - ARM) / limits.velocity).max())
        for other in boundary.possible_ends[:k]:
            assert np.abs((end.shape - other.shape) / half).max() > 0.05
    assert times == sorted(times)


def test_a_goal_that_no_shape_meets_is_not_found(arm: SpaceRobot) -> None:
    center = PLACE + ATTITUDE.apply(arm.center_of_mass(ARM))
    goal = Goal.of_end_effectors([EndEffectorGoal(TOOL, center)])
    kind = specification(arm, goal)
    request = PlanRequest(at_rest(ARM), goal, Tolerance(1e-6, 1e-6))
    limits = MotionLimits.of(arm, OptimalOptions())
    near = replace_limits(limits, ARM - 0.2, ARM + 0.2)
    with pytest.raises(NotFoundError) as error:
        kind.boundary_conditions(arm, request, None, near, None)
    head, _, tail = str(error.value).partition("; the nearest is ")
    assert head == (
        "No shape of robot 'three_joint_arm' that puts 'end_effector' to the goal was found from "
        "128 shapes"
    )
    assert tail.endswith(
        " m or rad away. A nearer goal may help, a position instead of a pose, or more freedom of "
        "the base."
    )
    # The nearest of a grid of shapes; its largest component is at most its length.
    corners = np.array(np.meshgrid(*np.linspace(ARM - 0.2, ARM + 0.2, 5).T)).reshape(3, -1).T
    least = min(float(np.linalg.norm(seen(arm, TOOL, q, Rotation.identity())[0])) for q in corners)
    assert 0.5 * least < float(tail.split()[0]) < 1.05 * least


def replace_limits(limits: MotionLimits, lower: Array, upper: Array) -> MotionLimits:
    return MotionLimits(lower, upper, limits.velocity, limits.acceleration)


# -- radii --------------------------------------------------------------------------------------


TREE = (
    '<robot name="tree">'
    + link("base_link", 5.0, np.diag([2.0, 3.0, 4.0]), np.array([0.1, 0.0, 0.0]))
    + link("l1", 2.0, np.diag([0.2, 0.3, 0.1]), np.array([0.3, 0.0, 0.0]))
    + link("l2", 3.0, np.diag([0.2, 0.3, 0.1]), np.array([0.0, 0.0, 0.25]))
    + link("l3", 1.0, np.diag([0.2, 0.3, 0.1]), np.array([0.0, 0.0, 0.15]))
    + '<link name="tool"/>'
    '<joint name="a" type="revolute"><parent link="base_link"/><child link="l1"/>'
    '<origin xyz="1 0 0"/><axis xyz="0 0 1"/>'
    '<limit lower="-2" upper="3" velocity="1" effort="9"/></joint>'
    '<joint name="b" type="prismatic"><parent link="l1"/><child link="l2"/>'
    '<origin xyz="0 0.4 0"/><axis xyz="0 1 0"/>'
    '<limit lower="-0.2" upper="0.5" velocity="1" effort="9"/></joint>'
    '<joint name="c" type="revolute"><parent link="base_link"/><child link="l3"/>'
    '<origin xyz="0 -0.7 0"/><axis xyz="1 0 0"/>{mimic}'
    '<limit lower="-2" upper="2" velocity="1" effort="9"/></joint>'
    '<joint name="d" type="fixed"><parent link="l2"/><child link="tool"/>'
    '<origin xyz="0 0 0.6"/></joint></robot>'
)


def test_the_radius_of_a_tree_is_the_sum_of_its_ways() -> None:
    """By hand: from the tool to each centre of mass, by way of the last body that carries both."""
    robot = SpaceRobot.from_urdf(TREE.format(mimic=""))
    # To the slot: 0.6 and the slide of 0.5; to the base: 0.4 more.
    base = 5.0 * (1.5 + 0.9)
    first = 2.0 * (1.1 + 0.5)
    second = 3.0 * 0.35
    branch = 1.0 * (1.5 + 0.15 + np.hypot(1.0, 0.7))
    found = reach_of_end_effector(robot, robot.lower, robot.upper, "tool")
    assert found == pytest.approx((base + first + second + branch) / 11.0, rel=1e-12)
    # A slide beyond zero on the other side counts with its size.
    lower = robot.lower.copy()
    lower[robot.joint_names.index("b")] = -0.8
    more = reach_of_end_effector(robot, lower, robot.upper, "tool")
    assert more - found == pytest.approx(0.3 * 8.0 / 11.0)


def test_joints_that_follow_others_have_the_ranges_that_these_lead_them_to() -> None:
    robot = SpaceRobot.from_urdf(
        TREE.format(mimic='<mimic joint="b" multiplier="-2" offset="0.1"/>')
    )
    assert robot.n == 2
    lower, upper = moving_joint_ranges(robot, np.array([-1.0, -0.2]), np.array([2.0, 0.5]))
    by_name = {
        joint.name: (low, high)
        for joint, low, high in zip(robot.description.moving_joints, lower, upper, strict=True)
    }
    assert by_name["a"] == (-1.0, 2.0)
    assert by_name["b"] == (-0.2, 0.5)
    assert by_name["c"] == pytest.approx((-0.9, 0.5))
    # A joint that turns adds no way, so the radius is that of the tree without mimics.
    plain = SpaceRobot.from_urdf(TREE.format(mimic=""))
    radii = [reach_of_end_effector(x, x.lower, x.upper, "tool") for x in (robot, plain)]
    assert radii[0] == pytest.approx(radii[1])
