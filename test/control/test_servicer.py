"""A spatial robot with an arm: flights of both poses, dead reckoning, inverse kinematics."""

from __future__ import annotations

import math

import numpy as np
import pytest
from control.flights import (
    END_EFFECTOR,
    PLANAR_GAINS,
    PLANAR_GOAL,
    SERVICER_GAINS,
    SERVICER_GOAL,
    SERVICER_PACE,
    PinocchioPlant,
    fly,
    law_of,
    load,
    planar_start,
    random_state,
    scaled_robot,
    servicer_start,
)
from scipy.spatial.transform import Rotation
from support.executive_loop import planar_manipulator
from support.oracles import PinocchioOracle
from support.random_robots import random_robot_urdf
from support.slow import some_fast

from spacerobot_ros.control import (
    PROFILES,
    Actuation,
    ControlState,
    DeadReckoning,
    PoseReference,
    Reference,
)
from spacerobot_ros.errors import ParameterError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array, Pose
from spacerobot_ros.model.inverse_kinematics import FixedBaseArm, is_reached

MILLIMETRE = 1e-3
TENTH_OF_A_DEGREE = np.radians(0.1)


def assert_arrived(plant: PinocchioPlant) -> None:
    """Both poses to 1 mm and 0.1 deg, as Pinocchio has them."""
    for link, goal in (
        ("base_link", SERVICER_GOAL.base),
        (END_EFFECTOR, SERVICER_GOAL.end_effector),
    ):
        assert isinstance(goal, PoseReference)
        attitude, position = plant.frame_W(link)
        turn = Rotation.from_quat(goal.quaternion) * Rotation.from_matrix(attitude).inv()
        assert np.linalg.norm(position - goal.position) < MILLIMETRE, link
        assert turn.magnitude() < TENTH_OF_A_DEGREE, link


@pytest.mark.parametrize("least", some_fast([1.1, 0.9], 0.9), ids=["heavier", "either way"])
@pytest.mark.parametrize("profile", ["quintic", "step"])
def test_both_poses_are_reached_with_wrong_masses(least: float, profile: str) -> None:
    """Law (27) believes other masses and inertias, off by 10 %; law (29) knows none."""
    rng = np.random.default_rng(1)
    believed = scaled_robot(load("servicer"), lambda: float(rng.uniform(least, 1.1)))
    law = law_of("model_based", believed, SERVICER_GAINS["model_based"])
    present = Reference.present(load("servicer"), servicer_start(), END_EFFECTOR)
    reference = PROFILES[profile](present, SERVICER_GOAL, SERVICER_PACE)
    settling = 12.0 if profile == "step" else 5.0
    plant = PinocchioPlant(load("servicer"), servicer_start())
    fly(plant, law, reference.at, reference.duration + settling, rate=50.0)
    assert_arrived(plant)


# -- dead reckoning against the plant: paper 4, end of section IV --------------------------------


def difference(one: ControlState, other: ControlState) -> float:
    """Return the largest difference of two states, attitudes as a rotation vector (SI)."""
    turn = Rotation.from_quat(one.quaternion_WB).inv() * Rotation.from_quat(other.quaternion_WB)
    return float(
        np.abs(
            np.concatenate(
                [
                    one.r_WB - other.r_WB,
                    turn.as_rotvec(),
                    one.v_WB_B - other.v_WB_B,
                    one.omega_WB_B - other.omega_WB_B,
                    one.q - other.q,
                    one.qdot - other.qdot,
                ]
            )
        ).max()
    )


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_true_model_follows_the_plant(seed: int) -> None:
    rng = np.random.default_rng(seed)
    robot = SpaceRobot.from_urdf(random_robot_urdf(rng, 3 + seed))
    start = random_state(rng, robot.n)
    plant = PinocchioPlant(robot, start, longest_step=1e-3)
    estimator = DeadReckoning(robot, 0.01, integration_step=1e-3)
    assert estimator.elapsed == 0.0
    estimator.reset(start)
    assert difference(estimator.state, start) < 1e-12
    for _ in range(50):
        actuation = Actuation(rng.uniform(-5, 5, 6), rng.uniform(-0.5, 0.5, robot.n))
        plant.step(actuation, 0.01)
        estimate = estimator.step(actuation)
    assert difference(estimate, plant.state) < 1e-8
    assert estimator.elapsed == pytest.approx(0.5)
    estimator.reset(plant.state)
    assert estimator.elapsed == 0.0


def fly_blind(believed: SpaceRobot, *, joints: bool) -> float:
    """Fly the paper's manoeuvre without inertial measurements; return the largest error, 12 s."""
    robot = load("planar_manipulator")
    law = law_of("model_based", believed, PLANAR_GAINS)
    plant = PinocchioPlant(robot, planar_start())
    estimator = DeadReckoning(believed, 0.01)
    estimator.reset(plant.state)
    estimate = plant.state
    for _ in range(1200):
        actuation = law.command(estimate, PLANAR_GOAL)
        measured = plant.step(actuation, 0.01)
        if joints:
            estimate = estimator.step(actuation, measured.q, measured.qdot)
        else:
            estimate = estimator.step(actuation)
    law.command(plant.state, PLANAR_GOAL)
    return float(np.abs(law.error).max())


@pytest.mark.slow
def test_manoeuvre_without_inertial_measurements() -> None:
    true = load("planar_manipulator")
    assert fly_blind(true, joints=False) < 0.004
    wrong = scaled_robot(true, iter([1.03, 1.03, 1.0, 1.0, 1.0, 1.0]).__next__)
    # "Then errors due to model uncertainties will be introduced."
    drift = fly_blind(wrong, joints=True)
    assert 0.01 < drift < 0.2


@pytest.mark.parametrize("durations", [(0.0, 0.01), (np.nan, 0.01), (0.01, -1.0)])
def test_durations_that_are_refused(durations: tuple[float, float]) -> None:
    with pytest.raises(ParameterError, match="must be positive"):
        DeadReckoning(load("planar_manipulator"), *durations)


def test_measured_joints_far_from_the_predicted_ones_turn_the_base_to_second_order() -> None:
    """One step of all joints, against many small ones of Pinocchio: the error is of third order."""
    robot = load("planar_manipulator")
    oracle = PinocchioOracle(robot.description.urdf, robot.joint_names)
    start = ControlState.at_rest(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), np.array([0.7, -1.9]))
    errors = []
    for size in (0.4, 0.2):
        step = size * np.array([1.0, 0.6])
        between = [start.q + (k + 0.5) / 50 * step for k in range(50)]
        turn = sum(oracle.base_twist(q, step / 50)[5] for q in between)
        estimator = DeadReckoning(robot, 1e-6)
        estimator.reset(start)
        none = Actuation(np.zeros(6), np.zeros(robot.n))
        estimate = estimator.step(none, start.q + step, np.zeros(robot.n))
        turned = Rotation.from_quat(estimate.quaternion_WB).as_rotvec()[2]
        errors.append(abs(turned - turn))
        assert abs(turn) > 0.1 * size
    assert errors[0] < 1e-3
    assert errors[0] > 6 * errors[1]


# -- inverse kinematics with a base that stays: nearest shapes of an arm, and errors they --------


LINK = "end_effector"
LEVERS = np.array([0.5, 1.0, 1.0])


def turned(*rotvec: float) -> Array:
    return np.asarray(Rotation.from_rotvec(rotvec).as_matrix())


def end_position(base: Array, angle: float, shape: Array) -> Array:
    """Return the end of the planar arm (2,) by its three levers, whose angles add up."""
    angles = np.cumsum([angle, *shape])
    return base[:2] + np.array([LEVERS @ np.cos(angles), LEVERS @ np.sin(angles)])


@pytest.mark.parametrize(
    ("distance", "angle", "reached"),
    [
        *((2e-4, 4e-4, True), (2.01e-4, 0.0, False), (0.0, 4.01e-4, False)),
        *((0.0, 0.0, True), (1.9e-4, 3.9e-4, True)),
    ],
)
def test_an_arm_reaches_its_goal_within_a_fifth_of_a_millimetre(
    distance: float, angle: float, reached: bool
) -> None:
    assert is_reached(distance, angle) is reached


def test_the_errors_of_the_nearest_shape_are_in_metres_and_radians() -> None:
    """A planar arm stays in its plane, and its end at the tilt of its base."""
    base, q = Pose(np.eye(3), np.array([0.3, -0.2, 0.1])), np.zeros(2)
    arm = FixedBaseArm(planar_manipulator(), LINK, base)
    place = np.array([*end_position(base.r, 0.0, q), 0.1])
    lifted = Pose(turned(0.3, 0.0, 0.0), place + np.array([0.0, 0.0, 0.04]))
    _, distance, angle = arm.search_shape(q, lifted)
    assert distance == pytest.approx(0.04, abs=2e-3)
    assert angle == pytest.approx(0.3, abs=5e-3)
    shape, distance, angle = arm.search_shape(q, Pose(np.eye(3), place))
    assert max(distance, angle) < 1e-9
    np.testing.assert_array_equal(shape, q)


def test_the_shape_nearest_to_a_pose_out_of_reach_has_no_nearer_neighbour() -> None:
    q, base = np.array([0.3, -0.4]), Pose(turned(0.0, 0.0, 0.5), np.array([0.4, -0.2, 0.0]))
    arm = FixedBaseArm(planar_manipulator(), LINK, base)
    away = base.r + np.array([7.0, 0.0, 0.0])
    shape, distance, angle = arm.search_shape(q, Pose(base.R, away))
    again = arm.search_shape(q, Pose(base.R, away))
    np.testing.assert_array_equal(shape, again[0])
    left = away[:2] - end_position(base.r, 0.5, shape)
    assert distance == pytest.approx(float(np.linalg.norm(left)), rel=1e-6)
    assert angle == pytest.approx(abs(float(shape.sum())), rel=1e-6)
    weighted = distance**2 + (0.5 * angle) ** 2
    for step in 1e-3 * np.vstack([np.eye(2), -np.eye(2)]):
        left = away[:2] - end_position(base.r, 0.5, shape + step)
        assert left @ left + (0.5 * float((shape + step).sum())) ** 2 >= weighted - 1e-9


def test_the_derivative_of_the_error_is_that_of_finite_differences() -> None:
    """The base turns the errors of a small motion, and the axes that do not count are left out."""
    base = Pose(turned(0.2, -0.4, 0.5), np.array([0.4, -0.2, 0.3]))
    arm = FixedBaseArm(planar_manipulator(), LINK, base, ("x", "z", "rx", "ry", "rz"))
    q, step = np.array([0.7, -1.1]), 1e-6
    R_BE, r_BE = planar_manipulator().link_pose(LINK, q)
    goal = Pose(base.R @ R_BE, base.r + base.R @ r_BE)
    error, J = arm.error(q, goal)
    np.testing.assert_allclose(error, 0.0, atol=1e-12)
    changes = [arm.error(q + step * each, goal)[0] for each in np.eye(2)]
    np.testing.assert_allclose(J, -np.transpose(changes) / step, atol=2e-6)
    assert np.abs(J).min(axis=1).max() > 0.1


def test_from_the_present_shape_on_the_elbow_keeps_its_side() -> None:
    base = Pose()
    arm = FixedBaseArm(planar_manipulator(), LINK, base, ("x", "y"))
    for side in (1.0, -1.0):
        there = side * np.array([-0.5, 1.2])
        goal = Pose(r=np.array([*end_position(base.r, 0.0, there), 0.0]))
        shape, distance = arm.nearest_shape(there + np.array([0.3, -0.25]), goal)
        assert distance < 1e-4
        np.testing.assert_allclose(shape, there, atol=1e-3)
    beyond = Pose(r=np.array([3.0, 0.0, 0.0]))
    assert math.isclose(arm.nearest_shape(np.array([0.1, 0.1]), beyond)[1], 0.5, abs_tol=0.01)
