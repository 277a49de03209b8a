"""Dead reckoning against the plant: paper 4, end of section IV."""

from __future__ import annotations

import numpy as np
import pytest
from control.flights import (
    PLANAR_GAINS,
    PLANAR_GOAL,
    law_of,
    load,
    planar_start,
    plant_of,
    random_state,
    scaled_robot,
)
from scipy.spatial.transform import Rotation
from support.oracles import PinocchioOracle
from support.random_robots import random_robot_urdf

from spacerobot_ros.control import Actuation, ControlState, DeadReckoning
from spacerobot_ros.errors import ParameterError
from spacerobot_ros.model import SpaceRobot


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
    plant = plant_of(robot, start, longest_step=1e-3)
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


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_measured_joints_need_no_joint_efforts(seed: int) -> None:
    """Momentum and measured joints place the base, whatever drives the joints."""
    rng = np.random.default_rng(20 + seed)
    robot = SpaceRobot.from_urdf(random_robot_urdf(rng, 4))
    start = random_state(rng, robot.n)
    plant = plant_of(robot, start, longest_step=1e-3)
    informed, blind = (DeadReckoning(robot, 0.01) for _ in range(2))
    informed.reset(start)
    blind.reset(start)
    for _ in range(100):
        actuation = Actuation(rng.uniform(-5, 5, 6), rng.uniform(-0.5, 0.5, robot.n))
        unknown = Actuation(actuation.wrench_B, np.zeros(robot.n))
        plant.step(actuation, 0.01)
        estimate = informed.step(unknown, plant.state.q, plant.state.qdot)
        blind.step(unknown)
    np.testing.assert_allclose(estimate.q, plant.state.q)
    np.testing.assert_allclose(estimate.qdot, plant.state.qdot)
    assert difference(estimate, plant.state) < 2e-3
    assert difference(blind.state, plant.state) > 100 * difference(estimate, plant.state)


def fly_blind(believed: SpaceRobot, *, joints: bool) -> float:
    """Fly the paper's manoeuvre without inertial measurements; return the largest error, 12 s."""
    robot = load("planar_manipulator")
    law = law_of("model_based", believed, PLANAR_GAINS)
    plant = plant_of(robot, planar_start())
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
