"""The step under held joint velocities, against tight integration of Pinocchio's momentum."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from support.oracles import Array, PinocchioOracle, assert_agrees
from support.random_robots import random_robot_urdf

from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.model_functions import SymbolicModels

SEEDS = (70, 71, 72)
DURATION = 0.8


@dataclass(frozen=True)
class Case:
    """A robot, where it starts, and how its joints turn and slide."""

    robot: SpaceRobot
    oracle: PinocchioOracle
    q: Array
    quaternion_WB: Array
    qdot: Array
    spin_W: Array

    @property
    def x(self) -> Array:
        return np.concatenate([self.q, self.quaternion_WB])

    def L_W(self, spinning: bool) -> Array:
        return self.spin_W if spinning else np.zeros(3)


@cache
def random_case(seed: int) -> Case:
    rng = np.random.default_rng(seed)
    urdf = random_robot_urdf(rng, joints=3 + seed % 2)
    robot = SpaceRobot.from_urdf(urdf)
    quaternion = rng.normal(size=4)
    return Case(
        robot=robot,
        oracle=PinocchioOracle(urdf, robot.joint_names),
        q=rng.uniform(-0.5, 0.5, robot.n),
        quaternion_WB=quaternion / np.linalg.norm(quaternion),
        qdot=rng.uniform(-1.0, 1.0, robot.n),
        spin_W=rng.uniform(-6.0, 6.0, 3),
    )


@cache
def integrated_attitude(seed: int, spinning: bool) -> Array:
    """Return the quaternion after ``DURATION``: at each instant the base turns at the rate at which
    Pinocchio's centroidal momentum is the constant one.
    """
    case = random_case(seed)
    momentum_W = np.concatenate([np.zeros(3), case.L_W(spinning)])

    def rate(t: float, quaternion: Array) -> Array:
        unit = quaternion / np.linalg.norm(quaternion)
        twist = case.oracle.base_twist(case.q + t * case.qdot, case.qdot, unit, momentum_W)
        x, y, z = twist[3:]
        # R_WB_dot = R_WB hat(omega) in quaternions (x, y, z, w).
        spin = np.array([[0, z, -y, x], [-z, 0, x, y], [y, -x, 0, z], [-x, -y, -z, 0]])
        return 0.5 * spin @ quaternion

    solution = solve_ivp(
        rate, (0.0, DURATION), case.quaternion_WB, "DOP853", rtol=1e-12, atol=1e-13
    )
    assert solution.success
    return np.asarray(solution.y[:, -1] / np.linalg.norm(solution.y[:, -1]))


def step(robot: SpaceRobot, case: Case, spinning: bool, substeps: int) -> Array:
    (x,) = robot.velocity_step(substeps)(case.x, case.qdot, case.L_W(spinning), DURATION)
    return np.asarray(x)


@pytest.mark.parametrize("spinning", [False, True], ids=["at_rest", "spinning"])
@pytest.mark.parametrize("seed", SEEDS)
def test_attitude_converges_at_fourth_order(seed: int, spinning: bool) -> None:
    case, expected = random_case(seed), integrated_attitude(seed, spinning)
    start = np.linalg.norm(case.quaternion_WB - expected)
    assert start > 0.02, "the base turns"
    errors = [
        np.linalg.norm(step(case.robot, case, spinning, substeps)[case.robot.n :] - expected)
        for substeps in (4, 8, 16)
    ]
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert np.all(np.abs(orders - 4.0) < 0.3), f"orders {orders}, errors {errors}"


@pytest.mark.parametrize("spinning", [False, True], ids=["at_rest", "spinning"])
@pytest.mark.parametrize("seed", SEEDS)
def test_attitude_is_the_integrated_one(seed: int, spinning: bool) -> None:
    case = random_case(seed)
    attitude = step(case.robot, case, spinning, substeps=256)[case.robot.n :]
    assert_agrees(attitude, integrated_attitude(seed, spinning), tolerance=1e-10)
    assert abs(np.linalg.norm(attitude) - 1.0) < 1e-15


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("substeps", [1, 3, 16])
def test_shape_is_exact(seed: int, substeps: int) -> None:
    case = random_case(seed)
    shape = step(case.robot, case, spinning=True, substeps=substeps)[: case.robot.n]
    np.testing.assert_allclose(shape, case.q + DURATION * case.qdot, rtol=0.0, atol=1e-15)


def test_two_steps_are_one_of_twice_the_substeps() -> None:
    case = random_case(70)
    buffer, x = case.robot.velocity_step(2), case.x
    for _ in range(2):
        (x,) = buffer(x, case.qdot, case.spin_W, DURATION / 2)
    assert_agrees(x, step(case.robot, case, spinning=True, substeps=4), tolerance=1e-14)


def test_joints_at_rest_and_no_momentum_leave_everything_as_it_is() -> None:
    case = random_case(71)
    (x,) = case.robot.velocity_step(2)(case.x, np.zeros(case.robot.n), np.zeros(3), DURATION)
    np.testing.assert_allclose(x, case.x, rtol=0.0, atol=1e-15)


def test_compiled_step(compiled_code: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    case = random_case(70)
    robot = SpaceRobot(case.robot.description)
    x = step(robot, case, spinning=True, substeps=64)
    assert robot.function("velocity_step:64").class_name() == "External"
    assert_agrees(x[robot.n :], integrated_attitude(70, spinning=True), tolerance=1e-8)
    monkeypatch.setenv("SPACEROBOT_COMPILE", "0")
    interpreted = SpaceRobot(case.robot.description)
    assert_agrees(x, step(interpreted, case, spinning=True, substeps=64), tolerance=1e-13)
    assert interpreted.function("velocity_step:64").class_name() != "External"


def test_a_robot_of_few_calls_is_not_compiled(compiled_code: Path) -> None:
    """The numbers are those of compiled functions, bit for bit."""
    case = random_case(71)
    description = case.robot.description
    # Its functions have the mass properties as their last argument.
    robot = SpaceRobot(description, SymbolicModels.of(description))
    for name, arguments in (
        ("velocity_step:3", (case.x, case.qdot, case.spin_W, DURATION)),
        ("link_poses", (case.x[: robot.n],)),
    ):
        interpreted, compiled = (each.buffered(name) for each in (robot.interpreted, robot))
        assert interpreted.function.class_name() != "External"
        assert compiled.function.class_name() == "External"
        for here, there in zip(interpreted(*arguments), compiled(*arguments), strict=True):
            np.testing.assert_array_equal(here, there)
