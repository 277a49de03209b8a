"""References that small thrusters can follow, against Pinocchio's rigid-body inertia."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.oracles import PinocchioOracle

from spacerobot_ros.control import ActuatorLimits, MotionLimits
from spacerobot_ros.model import SpaceRobot

URDF = Path(__file__).parents[2] / "urdf" / "servicer.urdf"
FAST = MotionLimits(1.0, 1e3, 1.0, 1e3)
REST = np.array([0.0, 0.0, 0.0, 1.0])


@pytest.fixture(scope="module")
def robot() -> SpaceRobot:
    return SpaceRobot.from_file(URDF)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize(("force", "torque"), [(0.5, 10.0), (5.0, 0.2)])
def test_a_rigid_robot_is_accelerated_by_half_the_thrust(
    robot: SpaceRobot, seed: int, force: float, torque: float
) -> None:
    rng = np.random.default_rng(seed)
    q = rng.uniform(-1.5, 1.5, robot.n)
    limits = ActuatorLimits(force, torque, robot.effort_limit)
    motion = FAST.within_thruster_limits(limits, robot, q)
    oracle = PinocchioOracle(robot.description.urdf, robot.joint_names)
    oracle.place(q, REST, np.zeros(3))
    M = oracle.own_mass_matrix()[:6, :6]
    center = oracle.center_of_mass_W()
    forces, turning, both = [], [], []
    for _ in range(2000):
        a, alpha = (x / np.linalg.norm(x) for x in rng.normal(size=(2, 3)))
        a, alpha = a * motion.acceleration, alpha * motion.angular_acceleration
        wrench = M @ np.concatenate([a - np.cross(alpha, center), alpha])
        forces.append(np.linalg.norm(wrench[:3]))
        both.append(np.linalg.norm(wrench[3:]))
        about_center = M @ np.concatenate([-np.cross(alpha, center), alpha])
        turning.append(np.linalg.norm(about_center[3:]))
    assert max(both) <= torque
    assert max(turning) == pytest.approx(torque / 2, rel=0.01)
    lever = np.linalg.norm(center)
    assert max(forces) == pytest.approx(min(force / 2, torque / 2 / lever), rel=1e-9)


def test_strong_thrusters_and_none_at_all_leave_the_limits_as_they_are(robot: SpaceRobot) -> None:
    motion = MotionLimits()
    q = np.zeros(robot.n)
    for force, torque in ((np.inf, np.inf), (1e9, 1e9), (0.0, 0.0)):
        limits = ActuatorLimits(force, torque, robot.effort_limit)
        assert motion.within_thruster_limits(limits, robot, q) == motion
