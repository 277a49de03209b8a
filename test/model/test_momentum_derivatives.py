"""Derivatives of the angular momentum in closed form against those by CasADi."""

from __future__ import annotations

from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from support.branched_robot import branched_robot
from support.slow import some_fast

from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.resources import robot_file


def compare(robot: SpaceRobot, seed: int) -> None:
    q, qdot = ca.SX.sym("q", robot.n), ca.SX.sym("qdot", robot.n)
    omega, eta = ca.SX.sym("omega", 3), ca.SX.sym("eta", 3)
    D, D_q = robot.function("locked_inertia", compile=False)(q)
    momentum = D @ omega + D_q @ qdot
    weighted = ca.dot(eta, momentum)
    slope = ca.gradient(weighted, q)
    wanted = [
        ca.jacobian(momentum, q),
        *(ca.jacobian(slope, x) for x in (q, qdot, omega)),
    ]
    symbols = [q, omega, qdot, eta]
    of_casadi = ca.Function("of_casadi", symbols, [ca.densify(x) for x in wanted])
    ours = robot.function("momentum_derivatives", compile=False)
    rng = np.random.default_rng(seed)
    for _ in range(3):
        at = [rng.uniform(-1.5, 1.5, x.numel()) for x in symbols]
        for found, expected in zip(ours(*at), of_casadi(*at), strict=True):
            assert found.shape == expected.shape
            scale = np.abs(expected.full()).max()
            assert scale > 1e-3
            assert found.full() == pytest.approx(expected.full(), abs=1e-13 * scale)


def test_branches_sliders_and_joints_that_follow(tmp_path: Path) -> None:
    description = branched_robot(tmp_path)
    assert description.has_mimic_joints
    compare(SpaceRobot(description), 2)


@pytest.mark.parametrize("name", some_fast(["seven_joint_arm", "quadruped"]))
def test_robots_of_the_package(name: str) -> None:
    compare(SpaceRobot.from_file(robot_file(name)), 4)
