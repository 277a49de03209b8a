"""Goals of end-effectors with the base free: reached by another engine, or refused."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from planning.test_resolved_rate import ARM, ATTITUDE, PLACE, hand, poses, request_of
from scipy.spatial.transform import Rotation
from support.planner_loop import robot_of
from support.planners import assert_within

from spacerobot_ros.errors import GoalError, NotFoundError, PlanningError, Proof, UnreachableError
from spacerobot_ros.model.description import Array
from spacerobot_ros.planning import Goal, RobotState, build_method, plan
from spacerobot_ros.planning.core.goal import EndEffectorGoal, PoseError, Tolerance
from spacerobot_ros.planning.methods.optimal.end_effectors import EndEffectorRows
from spacerobot_ros.planning.methods.optimal.motion_bounds import reach_of_end_effector
from spacerobot_ros.planning.methods.registry import method_options

QUICK: dict[str, Any] = {
    **{"cache": 0, "answers": 1, "intervals": 30},
    **{"control_period": 0.1, "clearance": 0.0},
}


def at_rest(q: npt.ArrayLike) -> RobotState:
    return RobotState(PLACE, ATTITUDE.as_quat(), np.asarray(q, dtype=float))


def beside(robot: str, start: Array, end: Array, link: str) -> tuple[Array, Rotation]:
    """Return where a link is after the straight way to a shape: a goal that can be reached."""
    way = start + np.linspace(0.0, 1.0, 40)[:, np.newaxis] * (end - start)
    return poses(robot, way, link)[link]


@pytest.mark.slow
def test_a_position_is_reached_with_the_base_free() -> None:
    r, _ = beside("three_joint_arm", ARM, np.array([-0.7, -0.2, 1.9]), "end_effector")
    schedule = plan("three_joint_arm", end_effector_position=r, start=at_rest(ARM), **QUICK)
    reached, _ = hand(schedule.positions)
    np.testing.assert_allclose(reached, r, atol=1e-6)
    robot = robot_of("three_joint_arm")
    assert_within(schedule, robot.velocity_limit, robot.velocity_limit / 0.5)
    q = schedule.positions
    assert np.all((q >= robot.lower - 1e-8) & (q <= robot.upper + 1e-8))
    assert schedule.controls == {"shape", "end_effectors"}
    # The note says so, too.
    noted = schedule.notes["final_pose_of_end_effector"]
    assert isinstance(noted, list)
    assert noted[:3] == pytest.approx(r, abs=1e-6)


SEVEN = np.array([0.3, 0.2, -0.4, -1.7, 0.5, 1.6, 0.8])
SEVEN_END = np.array([-0.6, 0.8, 0.3, -1.1, -0.4, 2.3, 0.1])


@pytest.mark.slow
def test_the_attitude_of_the_base_is_reached_with_a_position() -> None:
    r, _ = beside("seven_joint_arm", SEVEN, SEVEN_END, "link_7")
    turned = (ATTITUDE * Rotation.from_rotvec([0.02, 0.03, -0.04])).as_rotvec()
    schedule = plan(
        "seven_joint_arm",
        end_effector_position={"link_7": r},
        rotvec=turned,
        start=at_rest(SEVEN),
        **QUICK,
    )
    found = poses("seven_joint_arm", schedule.positions, "link_7", "base_link")
    np.testing.assert_allclose(found["link_7"][0], r, atol=1e-6)
    assert (found["base_link"][1].inv() * Rotation.from_rotvec(turned)).magnitude() < 1e-6
    assert "attitude" in schedule.controls


@pytest.mark.slow
def test_two_hands_are_reached_at_once() -> None:
    start = robot_of("dual_arm")
    q = np.linspace(-0.5, 0.7, start.n)
    end = np.linspace(0.6, -0.3, start.n)
    left, right = (beside("dual_arm", q, end, f"{side}_link_7") for side in ("left", "right"))
    schedule = plan(
        "dual_arm",
        end_effector_pose={"left_link_7": [*left[0], *left[1].as_quat()]},
        end_effector_position={"right_link_7": right[0]},
        start=at_rest(q),
        **QUICK,
    )
    found = poses("dual_arm", schedule.positions, "left_link_7", "right_link_7")
    np.testing.assert_allclose(found["left_link_7"][0], left[0], atol=1e-6)
    assert (found["left_link_7"][1].inv() * left[1]).magnitude() < 1e-6
    np.testing.assert_allclose(found["right_link_7"][0], right[0], atol=1e-6)


def test_planar_robots_reach_positions_in_their_plane_and_no_other() -> None:
    chain = robot_of("planar_chain")
    link = chain.link_names[-1]
    q, end = np.array([0.4, -0.9]), np.array([1.1, -0.2])
    r, R = beside("planar_chain", q, end, link)
    schedule = plan("planar_chain", end_effector_position={link: r}, start=at_rest(q), **QUICK)
    np.testing.assert_allclose(
        poses("planar_chain", schedule.positions, link)[link][0], r, atol=1e-6
    )
    off = r + 0.05 * ATTITUDE.apply([0.0, 0.0, 1.0])
    with pytest.raises(UnreachableError, match="in one plane") as refusal:
        plan("planar_chain", end_effector_position={link: off}, start=at_rest(q), **QUICK)
    assert refusal.value.proof is Proof.RANK
    tilted = R * Rotation.from_rotvec([0.3, 0.0, 0.0])
    with pytest.raises(UnreachableError, match="about one axis"):
        plan(
            "planar_chain",
            end_effector_pose={link: [*r, *tilted.as_quat()]},
            start=at_rest(q),
            **QUICK,
        )


def test_joint_positions_that_go_with_the_goal_are_reached_and_others_refused() -> None:
    end = np.array([-0.7, -0.2, 1.9])
    r, R = beside("three_joint_arm", ARM, end, "end_effector")
    schedule = plan(
        "three_joint_arm",
        end_effector_pose=[*r, *R.as_quat()],
        joint_positions=end,
        start=at_rest(ARM),
        **{**QUICK, "intervals": 40, "answers": 2},
    )
    reached, R_reached = hand(schedule.positions)
    np.testing.assert_allclose(reached, r, atol=1e-6)
    assert (R_reached.inv() * R).magnitude() < 1e-6
    np.testing.assert_allclose(schedule.positions[-1], end, atol=1e-9)
    with pytest.raises(UnreachableError, match="Leave the joint positions out"):
        plan(
            "three_joint_arm",
            end_effector_position=r,
            joint_positions=end + 0.2,
            start=at_rest(ARM),
            **QUICK,
        )


def test_a_start_at_the_goal_is_no_motion() -> None:
    here, _ = hand(ARM[np.newaxis])
    schedule = plan("three_joint_arm", end_effector_position=here, start=at_rest(ARM), **QUICK)
    assert schedule.ticks == 0


def test_no_shape_is_beyond_the_radius_and_goals_beyond_are_refused() -> None:
    robot = robot_of("three_joint_arm")
    radius = reach_of_end_effector(robot, robot.lower, robot.upper, "end_effector")
    rng = np.random.default_rng(3)
    distances = [
        np.linalg.norm(robot.link_pose("end_effector", q)[1] - robot.center_of_mass(q))
        for q in rng.uniform(robot.lower, robot.upper, (300, robot.n))
    ]
    assert 0.9 * radius < max(distances) <= radius
    center = PLACE + ATTITUDE.apply(robot.center_of_mass(ARM))
    far = center + 1.01 * radius * np.array([0.6, 0.0, -0.8])
    with pytest.raises(UnreachableError, match="out of reach") as refusal:
        plan("three_joint_arm", end_effector_position=far, start=at_rest(ARM), **QUICK)
    assert refusal.value.proof is Proof.LIMITS


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"end_effector_position": (1, 0, 0), "end_effector": "hand"}, "does not have"),
        ({"end_effector_position": (1, 0, 0), "end_effector": "base_link"}, "is the base"),
        ({"end_effector_position": (1, 0, 0, 0)}, r"give 3 \(a position\) or 7"),
        ({"end_effector_pose": (1, 0, 0)}, "a pose has 7"),
        ({"end_effector_pose": (1, 0, 0, 0, 0, 0, 0)}, "zero quaternion"),
        ({"end_effector_position": (1, 0, np.nan)}, "not finite"),
        ({"end_effector": "end_effector"}, "has no goal"),
        (
            {
                "end_effector_position": {"end_effector": (1, 0, 0)},
                "end_effector_pose": {"": (1, 0, 0, 0, 0, 0, 1)},
            },
            "'end_effector' has 2 goals",
        ),
    ],
)
def test_goals_that_are_none_are_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(GoalError, match=message):
        plan("three_joint_arm", start=at_rest(ARM), **arguments, **QUICK)


@pytest.mark.parametrize("base", [None, (0.02, 0.03, -0.04)])
def test_a_pose_of_more_coordinates_than_the_joints_move_is_reached_where_it_can_be(
    base: tuple[float, float, float] | None,
) -> None:
    """Three joints and the turn of the base move five coordinates of a pose, and three of a pose
    with the base's attitude: a goal off those is refused, and one on them is met."""
    name, hand = "three_joint_arm", "end_effector"
    end = np.array([-0.7, -0.2, 1.9])
    r, R = beside(name, ARM, end, hand)
    given: dict[str, Any] = {}
    if base is not None:
        # The same shape with the base turned puts the hand elsewhere, about the centre of mass.
        turned = ATTITUDE * Rotation.from_rotvec(base)
        robot = robot_of(name)
        r_CE = robot.link_pose(hand, end)[1] - robot.center_of_mass(end)
        r_WC = PLACE + ATTITUDE.apply(robot.center_of_mass(ARM))
        r = r_WC + turned.apply(r_CE)
        R = turned * Rotation.from_matrix(robot.link_pose(hand, end)[0])
        given["rotvec"] = turned.as_rotvec()
    schedule = plan(
        name, end_effector_pose=[*r, *R.as_quat()], start=at_rest(ARM), **given, **QUICK
    )
    found = poses(name, schedule.positions, hand, "base_link")
    np.testing.assert_allclose(found[hand][0], r, atol=1e-6)
    assert (found[hand][1].inv() * R).magnitude() < 1e-6
    if base is not None:
        assert (found["base_link"][1].inv() * turned).magnitude() < 1e-6
    off = R * Rotation.from_rotvec([0.1, -0.2, 0.1])
    numbers = 5 if base is None else 3
    with pytest.raises(
        NotFoundError, match=f"6 independent coord.* no more than {numbers}: request"
    ):
        plan(name, end_effector_pose=[*r, *off.as_quat()], start=at_rest(ARM), **given, **QUICK)


def test_a_default_end_effector_is_named_where_there_is_none() -> None:
    with pytest.raises(GoalError, match="name one of its links"):
        plan("seven_joint_arm", end_effector_position=(1, 0, 0))


@pytest.mark.parametrize("method", ["area_loop", "auto"])
def test_methods_of_loops_leave_the_goal_to_optimal(method: str) -> None:
    r, _ = beside("three_joint_arm", ARM, ARM + np.array([0.3, 0.2, -0.2]), "end_effector")
    request = request_of("end_effector", r)
    options = {"optimal": method_options("optimal", {"cache": 0, "answers": 1, "intervals": 30})}
    planner = build_method(method, robot_of("three_joint_arm"), 0.1, 0.01, options)
    if method == "auto":
        assert planner.plan(request).method == "optimal"
    else:
        with pytest.raises(PlanningError, match=r"area_loop plans for the base pose.*optimal"):
            planner.plan(request)


def test_errors_are_those_of_the_links() -> None:
    robot = robot_of("three_joint_arm")
    r, R = beside("three_joint_arm", ARM, ARM, "end_effector")
    shift, turn = np.array([0.03, -0.04, 0.0]), Rotation.from_rotvec([0.0, 0.02, 0.0])
    aim = EndEffectorGoal("end_effector", r + shift, (R * turn).as_quat())
    goal = Goal.of_end_effectors([aim])
    error = PoseError.between(PLACE, ATTITUDE.as_quat(), goal, ARM, robot)
    assert error.largest_end_effector_distance == pytest.approx(0.05)
    assert error.largest_end_effector_angle == pytest.approx(0.02)
    parts = frozenset({"end_effectors"})
    assert Tolerance(0.051, 0.021).admits(error, parts)  # type: ignore[arg-type]
    assert not Tolerance(0.049, 0.021).admits(error, parts)  # type: ignore[arg-type]
    assert not Tolerance(0.051, 0.019).admits(error, parts)  # type: ignore[arg-type]
    # Without the robot the errors are not known.
    unknown = PoseError.between(PLACE, ATTITUDE.as_quat(), goal)
    assert not Tolerance(9.0, 9.0).admits(unknown, parts)  # type: ignore[arg-type]


def test_derivatives_of_the_rows_are_their_differences() -> None:
    robot = robot_of("three_joint_arm")
    rows = EndEffectorRows(robot, [("end_effector", True), ("base_link", False)], np.eye(3))
    rng = np.random.default_rng(4)
    goals = [
        EndEffectorGoal("end_effector", rng.normal(size=3), np.array([0.1, 0.7, 0.1, 0.7])),
        EndEffectorGoal("base_link", rng.normal(size=3)),
    ]
    p = rows.pack(at_rest(ARM), goals)
    X, q = Rotation.from_rotvec(rng.normal(size=3)), ARM + 0.3
    value, by_rotation, by_shape = rows.evaluate(X.as_quat()[np.newaxis], q[np.newaxis], p)
    assert value.shape == (1, 9)
    step, unit = 1e-6, np.eye(3)

    def at(turn: Array, move: Array) -> Array:
        turned = (X * Rotation.from_rotvec(turn)).as_quat()
        return rows.evaluate(turned[np.newaxis], (q + move)[np.newaxis], p)[0][0]

    rotated = [(at(step * e, 0 * e) - at(-step * e, 0 * e)) / (2 * step) for e in unit]
    moved = [(at(0 * e, step * e) - at(0 * e, -step * e)) / (2 * step) for e in unit]
    np.testing.assert_allclose(np.transpose(rotated), by_rotation[0], atol=1e-7)
    np.testing.assert_allclose(np.transpose(moved), by_shape[0], atol=1e-7)
