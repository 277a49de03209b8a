"""What the motion of a base tells of masses, held against robots that weigh otherwise."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation
from support.planner_loop import TICK, robot_of

from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.planning import BasePath, GaitSchedule, Goal, RobotState
from spacerobot_ros.planning.core.prediction import BasePrediction
from spacerobot_ros.planning.execution.path_deviation import (
    MassEstimate,
    PathDeviation,
    PathSensitivity,
)

Array = npt.NDArray[np.float64]

ROBOTS = ("sliding_masses", "three_joint_arm", "servicer")
START = Rotation.from_rotvec([0.4, -0.2, 0.3])


def weighing(robot: SpaceRobot, errors: Array) -> SpaceRobot:
    """Return the robot with other masses and inertias, two relative errors a body."""
    masses, inertias = np.split(1 + errors, 2)
    return SpaceRobot(
        robot.inertial.scaled(masses, inertias).apply_to_description(robot.description)
    )


def shapes_of(robot: SpaceRobot, ticks: int) -> Array:
    """Return shapes (ticks + 1, n) that go to and fro, each joint in its own time."""
    s = np.linspace(0.0, 1.0, ticks + 1)[:, np.newaxis]
    lower, upper = np.maximum(robot.lower, -2.0), np.minimum(robot.upper, 2.0)
    number: Array = np.arange(robot.n, dtype=float)
    return lower + (upper - lower) * (0.5 + 0.3 * np.sin(2 * np.pi * s * (1 + number % 3) + number))


def flown(robot: SpaceRobot, shapes: Array) -> BasePath:
    """Return the base path by numerical integration at every tick."""
    state = RobotState(np.array([0.3, -0.1, 0.2]), START.as_quat(), shapes[0])
    return BasePrediction(robot, TICK, 0.01).path(state, shapes)


def schedule_of(robot: SpaceRobot, shapes: Array) -> GaitSchedule:
    goal = Goal(np.zeros(3), START.as_quat())
    return GaitSchedule("any", robot.joint_names, TICK, shapes, flown(robot, shapes), goal)


def deviations(path: BasePath, predicted: BasePath) -> Array:
    """Return by how much poses differ (K, 6): displacements over turns in the world."""
    turns = Rotation.from_quat(path.quaternion) * Rotation.from_quat(predicted.quaternion).inv()
    return np.hstack([path.position - predicted.position, turns.as_rotvec()])


@pytest.mark.slow
@pytest.mark.parametrize("name", ROBOTS)
@pytest.mark.parametrize("ticks", [40, 300, 950])
def test_sensitivities_are_those_of_integrated_paths(name: str, ticks: int) -> None:
    robot = robot_of(name)
    schedule = schedule_of(robot, shapes_of(robot, ticks))
    sensitivity = PathSensitivity(robot)
    errors = 1e-4 * np.random.default_rng(3).normal(size=sensitivity.count)
    expected = deviations(flown(weighing(robot, errors), schedule.positions), schedule.path)
    found = sensitivity.path_derivatives(schedule) @ errors
    assert np.abs(expected[:, :3]).max() > 1e-6
    np.testing.assert_allclose(found, expected, atol=0.05 * np.abs(expected).max())


@pytest.mark.slow
def test_half_of_a_path_tells_where_it_ends() -> None:
    """Masses wrong by a tenth, poses with noise of a milliradian, and where it begins as well."""
    robot = robot_of("three_joint_arm")
    schedule = schedule_of(robot, shapes_of(robot, 120))
    sensitivity = PathSensitivity(robot)
    derivatives = sensitivity.path_derivatives(schedule)
    missed: list[float] = []
    known: list[float] = []
    for seed in range(10):
        rng = np.random.default_rng(seed)
        true = weighing(robot, rng.uniform(-0.1, 0.1, sensitivity.count))
        path = flown(true, schedule.positions)
        off = Rotation.from_rotvec(2e-3 * rng.normal(size=3))
        deviation = PathDeviation(schedule.path, 3, derivatives, MassEstimate(sensitivity.count))
        for k in range(60):
            noise = Rotation.from_rotvec(1e-3 * rng.normal(size=3))
            attitude = off * Rotation.from_quat(path.quaternion[k]) * noise
            deviation.add(k, path.position[k] + 1e-3 * rng.normal(size=3), attitude.as_quat())
        end = off * Rotation.from_quat(path.quaternion[-1])
        for where, errors in ((deviation.end, missed), (deviation.expected_end, known)):
            errors.append((end.inv() * Rotation.from_quat(where(59)[1])).magnitude())
    assert np.median(missed) > 0.009
    assert np.median(known) < 0.2 * np.median(missed)
    assert max(known) < 0.002


def test_what_was_learnt_on_one_path_counts_on_the_next() -> None:
    robot = robot_of("three_joint_arm")
    sensitivity = PathSensitivity(robot)
    schedule = schedule_of(robot, shapes_of(robot, 100))
    derivatives, masses = sensitivity.path_derivatives(schedule), MassEstimate(sensitivity.count)
    true = weighing(robot, np.random.default_rng(8).uniform(-0.1, 0.1, sensitivity.count))
    path = flown(true, schedule.positions)
    first = PathDeviation(schedule.path, 1, derivatives, masses)
    for k in range(101):
        first.add(k, path.position[k], path.quaternion[k])
    learnt = masses.errors.copy()
    assert np.abs(learnt).max() > 0.01
    second = PathDeviation(schedule.path, 1, derivatives, masses)
    second.add(0, path.position[0], path.quaternion[0])
    np.testing.assert_allclose(masses.errors, learnt, rtol=1e-9)
    end = Rotation.from_quat(second.expected_end(0)[1])
    unknown = Rotation.from_quat(second.end(0)[1])
    true_end = Rotation.from_quat(path.quaternion[-1])
    assert (true_end.inv() * end).magnitude() < 0.1 * (true_end.inv() * unknown).magnitude()


@pytest.mark.parametrize("size", [1e-4, 1e-2, 1.0], ids="{:g}".format)
@pytest.mark.parametrize("name", ROBOTS)
def test_an_offset_of_all_poses_tells_nothing_of_masses(name: str, size: float) -> None:
    robot = robot_of(name)
    sensitivity = PathSensitivity(robot)
    schedule = schedule_of(robot, shapes_of(robot, 60))
    derivatives = sensitivity.path_derivatives(schedule)
    true = 0.02 * np.random.default_rng(5).normal(size=sensitivity.count)
    offset = size * np.array([0.01, -0.02, 0.03, 0.02, 0.01, -0.01])
    plain, shifted = MassEstimate(sensitivity.count), MassEstimate(sensitivity.count)
    for derivative in derivatives:
        plain.add(derivative, derivative @ true)
        shifted.add(derivative, derivative @ true + offset)
    # Not an implausible estimate, which is zero whatever the poses were.
    assert np.abs(plain.errors).max() > 1e-3
    np.testing.assert_allclose(shifted.errors, plain.errors, atol=1e-8)


@pytest.mark.parametrize(
    ("name", "step"),
    [
        ("three_joint_arm", [0.1, 0.0, 0.0, 0.0, 0.0, 0.0]),
        ("servicer", [0.02, 0.0, 0.0, 0.0, 0.02, 0.0]),
    ],
)
def test_a_jump_of_what_is_measured_tells_nothing_of_masses(name: str, step: list[float]) -> None:
    robot = robot_of(name)
    sensitivity = PathSensitivity(robot)
    schedule = schedule_of(robot, shapes_of(robot, 120))
    derivatives, masses = sensitivity.path_derivatives(schedule), MassEstimate(sensitivity.count)
    true = weighing(robot, np.random.default_rng(8).uniform(-0.1, 0.1, sensitivity.count))
    path = flown(true, schedule.positions)

    def follow(until: int, jump_at: int) -> PathDeviation:
        deviation = PathDeviation(schedule.path, 3, derivatives, masses)
        for k in range(until):
            off = np.array(step) * (k >= jump_at)
            attitude = Rotation.from_rotvec(off[3:]) * Rotation.from_quat(path.quaternion[k])
            deviation.add(k, path.position[k] + off[:3], attitude.as_quat())
        return deviation

    jumped = follow(60, jump_at=30)
    for found, plain in zip(jumped.expected_end(59), jumped.end(59), strict=True):
        np.testing.assert_allclose(found, plain, atol=1e-12)
    # The path of the jump is forgotten: what comes after it counts alone.
    following = follow(60, jump_at=60)
    end = Rotation.from_quat(following.expected_end(59)[1])
    assert (Rotation.from_quat(path.quaternion[-1]).inv() * end).magnitude() < 1e-3
