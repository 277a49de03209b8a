"""Rows of end-effectors, turns on the direct way, and inverse kinematics, against other numbers."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from planning.test_end_effector_goals import ARM, ATTITUDE, FOLDER, PLACE, Array, at_rest, robot_of
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.planning import Goal
from spacerobot_ros.planning.core.goal import EndEffectorGoal
from spacerobot_ros.planning.methods.optimal.end_effectors import (
    EndEffectorRows,
    EndEffectorSpecification,
)
from spacerobot_ros.planning.methods.optimal.goal_specification import GoalSpecification
from spacerobot_ros.planning.methods.optimal.problem import (
    OptimalOptions,
    PossibleEnd,
)

HAND = "end_effector"


@pytest.fixture(scope="module")
def arm() -> SpaceRobot:
    return robot_of("three_joint_arm")


@pytest.fixture(scope="module")
def pose_rows(arm: SpaceRobot) -> EndEffectorRows:
    return EndEffectorRows(arm, [(HAND, True), ("base_link", False)], np.eye(3))


def hand_from_center(X: Rotation, q: Array) -> tuple[Array, Rotation]:
    """Return r_CE and the attitude of the hand in B_0 by Pinocchio, the base turned by X."""
    model = pin.buildModelFromUrdf(str(FOLDER / "three_joint_arm.urdf"), pin.JointModelFreeFlyer())
    data, full = model.createData(), pin.neutral(model)
    full[3:7] = X.as_quat()
    names = robot_of("three_joint_arm").joint_names
    for name, position in zip(names, q, strict=True):
        full[model.joints[model.getJointId(name)].idx_q] = position
    pin.framesForwardKinematics(model, data, full)
    pose = data.oMf[model.getFrameId(HAND)]
    center = pin.centerOfMass(model, data, full)
    return pose.translation - center, Rotation.from_matrix(pose.rotation)


def test_rows_are_distances_and_twice_the_sine_of_half_the_angle(
    arm: SpaceRobot, pose_rows: EndEffectorRows
) -> None:
    rng = np.random.default_rng(3)
    for angle in (0.4, 2.9):
        wanted = Rotation.from_rotvec(angle * np.array([0.36, -0.48, 0.8]))
        goal = EndEffectorGoal(HAND, rng.normal(size=3), wanted.as_quat())
        base = EndEffectorGoal("base_link", rng.normal(size=3))
        p = pose_rows.pack(at_rest(ARM), [goal, base])
        X, q = Rotation.from_rotvec(rng.normal(size=3)), ARM + 0.2
        values, _, _ = pose_rows.evaluate(X.as_quat()[np.newaxis], q[np.newaxis], p)
        r_CE, R_E = hand_from_center(X, q)
        # The centre of mass stays where it is; B_0 is the attitude at the start.
        start, _ = hand_from_center(Rotation.identity(), ARM)
        assert start.shape == (3,)
        r_WC = PLACE + ATTITUDE.apply(arm.center_of_mass(ARM))
        np.testing.assert_allclose(
            values[0, :3], r_CE - ATTITUDE.inv().apply(goal.position - r_WC), atol=1e-9
        )
        turn = (R_E * (ATTITUDE.inv() * wanted).inv()).as_rotvec()
        size = np.linalg.norm(turn)
        np.testing.assert_allclose(values[0, 3:6], 2 * np.sin(size / 2) * turn / size, atol=1e-6)
        r_CB = -X.apply(arm.center_of_mass(q))
        np.testing.assert_allclose(
            values[0, 6:], r_CB - ATTITUDE.inv().apply(base.position - r_WC), atol=1e-9
        )


def test_parameters_are_in_the_frame_of_the_base_at_the_start(
    arm: SpaceRobot, pose_rows: EndEffectorRows
) -> None:
    wanted = Rotation.from_rotvec([0.1, 0.9, -0.4])
    p = pose_rows.pack(
        at_rest(ARM),
        [
            EndEffectorGoal(HAND, np.array([1.0, 2.0, 3.0]), wanted.as_quat()),
            EndEffectorGoal("base_link", np.array([-1.0, 0.5, 0.25])),
        ],
    )
    r_WC = PLACE + ATTITUDE.apply(arm.center_of_mass(ARM))
    np.testing.assert_allclose(p[:3], ATTITUDE.inv().apply(np.array([1.0, 2.0, 3.0]) - r_WC))
    turned = (Rotation.from_quat(p[3:7]).inv() * ATTITUDE.inv() * wanted).magnitude()
    assert turned == pytest.approx(0.0, abs=1e-12)
    np.testing.assert_allclose(p[7:10], ATTITUDE.inv().apply(np.array([-1.0, 0.5, 0.25]) - r_WC))
    np.testing.assert_array_equal(p[10:], [0.0, 0.0, 0.0, 1.0])


def test_straight_ways_turn_the_base_as_momentum_says(
    arm: SpaceRobot, pose_rows: EndEffectorRows
) -> None:
    ends = np.array([[1.2, -0.2, 0.3], [-0.5, -1.4, 2.0]])
    found = pose_rows.turns_along_direct_path(ARM, ends)
    for end, X in zip(ends, found, strict=True):

        def rate(t: float, x: Array, end: Array = end) -> Array:
            omega = -arm.connection(ARM + t * (end - ARM))[3:] @ (end - ARM)
            v, w = x[:3], x[3]
            return np.append(w * omega + np.cross(v, omega), -v @ omega) / 2

        exact = solve_ivp(rate, (0, 1), [0, 0, 0, 1], rtol=1e-10, atol=1e-12).y[:, -1]
        error = Rotation.from_quat(exact).inv() * Rotation.from_quat(X)
        assert error.magnitude() < 2e-6
        assert Rotation.from_quat(X).magnitude() > 0.05


def specification(arm: SpaceRobot, goal: Goal) -> EndEffectorSpecification:
    base = GoalSpecification.of(arm, OptimalOptions())
    return EndEffectorSpecification.of(arm, base, goal)


def test_the_parts_of_a_goal_are_what_is_controlled(arm: SpaceRobot) -> None:
    hand = EndEffectorGoal(HAND, np.array([1.0, 0.5, 0.2]), np.array([0.5, 0.5, 0.5, 0.5]))
    free = Goal.of_end_effectors([hand])
    pose = Goal.checked([0.1, 0.2, 0.3], ATTITUDE.as_quat())
    whole, attitude = (
        free.joined_with(pose),
        free.joined_with(Goal(pose.position, pose.quaternion, base=frozenset({"attitude"}))),
    )
    place = Goal.of_end_effectors([EndEffectorGoal(HAND, np.array([7.0, 0.0, 0.0]))])
    still = place.joined_with(Goal(pose.position, pose.quaternion, base=frozenset({"attitude"})))
    for goal, controls, links, axes, exact in (
        (place, {"shape", "end_effectors"}, [(HAND, False)], 0, False),
        (still, {"shape", "end_effectors", "attitude"}, [(HAND, False)], 3, False),
        # Three joints move five coordinates of a pose, so that one that can be met fixes the shape.
        (free, {"shape", "end_effectors"}, [(HAND, True)], 3, True),
        (
            whole,
            {"shape", "end_effectors", "attitude", "position"},
            [(HAND, True), ("base_link", False)],
            3,
            True,
        ),
        (attitude, {"shape", "end_effectors", "attitude"}, [(HAND, True)], 3, True),
    ):
        found = specification(arm, goal)
        assert found.controls == controls
        assert list(found.rows.links) == links
        assert len(found.axes) == axes
        assert found.overdetermined == exact
        assert found.rows_at_end is (None if exact else found.rows)
    keys = {EndEffectorSpecification.key(each) for each in (free, whole, attitude)}
    assert len(keys) == 3
    assert EndEffectorSpecification.key(place) not in keys
    moved = Goal.of_end_effectors([EndEffectorGoal(HAND, np.ones(3), hand.quaternion)])
    assert EndEffectorSpecification.key(moved) == EndEffectorSpecification.key(free)


def test_coordinates_that_the_joints_move_are_counted(arm: SpaceRobot) -> None:
    rows = EndEffectorRows(arm, [(HAND, True), ("base_link", False)], np.eye(3))
    assert rows.rank(fixed_attitude=True) == (3, 9)
    # Loops turn the base about its own axis of the first joint, which moves neither of the two.
    assert rows.rank(fixed_attitude=False) == (5, 9)
    rows = EndEffectorRows(arm, [(HAND, False)], np.eye(3))
    assert rows.rank(fixed_attitude=True) == (3, 3)


def test_a_guess_begins_at_its_end() -> None:
    end = PossibleEnd(np.array([1.0, 2.0, 3.0]), np.array([0.0, 0.6, 0.0, 0.8]))
    assert end.shape.tolist() == [1.0, 2.0, 3.0]
    assert end.base_rotation.tolist() == [0.0, 0.6, 0.0, 0.8]
