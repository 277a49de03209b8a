"""Where a robot is from several measurements, and what momenta they show."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.effort_flights import robot_of
from support.oracles import PinocchioOracle

from spacerobot_ros.errors import PlanningError
from spacerobot_ros.planning.execution.state_average import StateAverage
from spacerobot_ros.resources import share_directory
from spacerobot_ros.simulation import EffortPlant, InitialState

URDF = (share_directory() / "urdf" / "three_joint_arm.urdf").read_text("utf-8")
Q = np.array([0.2, -0.4, 0.9])
REST = np.zeros(3)
STILL = np.zeros(6)


def pose(position: float = 0.0, turn: Rotation | None = None) -> np.ndarray:
    attitude = turn or Rotation.identity()
    return np.concatenate([[position, 0.0, 0.0], attitude.as_quat()])


def test_the_mean_of_noisy_states_is_nearer_by_the_root_of_their_number() -> None:
    rng, robot = np.random.default_rng(0), robot_of(URDF)
    true = Rotation.from_rotvec([2.0, -1.5, 1.0])
    single, averaged = [], []
    for _ in range(60):
        average = StateAverage(robot, 25)
        for _ in range(25):
            assert not average.complete
            turned = true * Rotation.from_rotvec(rng.normal(0.0, 1e-3, 3))
            # Either sign of a quaternion is the same attitude.
            measured = pose(1.0, turned)
            measured[3:] *= rng.choice([-1.0, 1.0])
            measured[:3] += rng.normal(0.0, 2e-3, 3)
            average.add(measured, STILL, Q + rng.normal(0.0, 3e-3, 3), REST)
        assert average.complete
        state = average.state()
        error = (true.inv() * Rotation.from_quat(state.quaternion)).as_rotvec()
        averaged.append([*(state.position - [1.0, 0.0, 0.0]), *error, *(state.q - Q)])
        single.append([*(measured[:3] - [1.0, 0.0, 0.0]), *(true.inv() * turned).as_rotvec()])
    sigma = np.sqrt(np.mean(np.square(averaged).reshape(60, 3, 3), axis=(0, 2)))
    np.testing.assert_allclose(sigma, np.array([2e-3, 1e-3, 3e-3]) / 5, rtol=0.25)
    assert np.std(single) > 3 * np.std(averaged)


def test_the_mean_of_two_attitudes_is_half_way() -> None:
    average = StateAverage(robot_of(URDF), 2)
    first = Rotation.from_rotvec([2.0, -1.5, 1.0])
    for angle in (0.0, 0.02):
        turned = first * Rotation.from_rotvec([0.0, angle, 0.0])
        average.add(pose(10 * angle, turned), STILL, Q, REST)
    state = average.state()
    half = (first.inv() * Rotation.from_quat(state.quaternion)).as_rotvec()
    np.testing.assert_allclose(half, [0.0, 0.01, 0.0], atol=1e-12)
    np.testing.assert_allclose(state.position, [0.1, 0.0, 0.0])


def test_momenta_are_those_measured_last_at_rest() -> None:
    robot = robot_of(URDF)
    average = StateAverage(robot)
    twist = np.array([0.01, 0.0, -0.02, 0.03, 0.0, 0.01])
    average.add(pose(), twist, Q, REST)
    oracle = PinocchioOracle(URDF, robot.joint_names)
    oracle.set_configuration(Q, np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(3))
    oracle.move(oracle.base_velocities(twist) + oracle.joint_velocities(REST))
    p, L, _ = oracle.momentum_W()
    state = average.state()
    np.testing.assert_allclose(state.linear_momentum, p, atol=1e-12)
    np.testing.assert_allclose(state.angular_momentum, L, atol=1e-12)
    average.restart()
    assert average.count == 0
    average.add(pose(), 2 * twist, Q, np.array([0.1, 0.0, 0.0]))
    moving = average.state()
    np.testing.assert_array_equal(moving.linear_momentum, state.linear_momentum)


def test_before_a_robot_was_at_rest_its_momenta_are_those_in_motion() -> None:
    robot = robot_of(URDF)
    average = StateAverage(robot)
    average.add(pose(), np.array([0.01, 0.0, -0.02, 0.03, 0.0, 0.01]), Q, REST)
    assert np.abs(average.state().angular_momentum).max() > 0.01
    # It is put elsewhere, where its momenta are others, and its joints move.
    average.forget()
    assert average.count == 0
    p, L = np.array([0.2, -0.1, 0.3]), np.array([0.03, 0.02, -0.01])
    initial = InitialState(
        joint_positions=Q, joint_velocities=-Q, linear_momentum=p, angular_momentum=L
    )
    plant = EffortPlant(robot, 0.01, initial)
    assert plant.qdot.any()
    average.add(plant.pose, plant.twist, plant.q, plant.qdot)
    state = average.state()
    np.testing.assert_allclose(state.linear_momentum, p, atol=1e-12)
    np.testing.assert_allclose(state.angular_momentum, L, atol=1e-12)


def test_rates_within_the_tolerance_are_rest_and_larger_ones_are_not() -> None:
    robot = robot_of(URDF)
    average = StateAverage(robot, 2, rest_tolerance=0.01)
    average.add(pose(), STILL + 0.012, Q, REST + 0.012)
    average.add(pose(), STILL + 0.006, Q, REST - 0.006)
    assert not average.state().linear_momentum.any(), "0.009 on the average"
    average.restart()
    average.add(pose(), STILL + 0.02, Q, REST)
    assert np.linalg.norm(average.state().linear_momentum) > 1.0


@pytest.mark.parametrize("part", range(4))
def test_what_is_not_finite_is_refused(part: int) -> None:
    parts = [pose(), STILL.copy(), Q.copy(), REST.copy()]
    parts[part][1] = np.nan
    average = StateAverage(robot_of(URDF), 2)
    average.add(pose(), STILL, Q, REST)
    average.add(*parts)
    with pytest.raises(PlanningError, match="not finite"):
        average.state()
