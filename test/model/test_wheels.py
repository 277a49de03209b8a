"""Reaction wheels: those that a URDF may have, and the gyrostat, against Pinocchio."""

from __future__ import annotations

import numpy as np
import pytest
from support.oracles import PinocchioOracle, random_motion
from support.wheels import ARM, ELBOW, HULL, LIMIT, ROUND, WHEELS, text, wheel, wheeled_robot

from spacerobot_ros.errors import RobotDescriptionError
from spacerobot_ros.model import SpaceRobot, load_robot, parse_robot
from spacerobot_ros.model.rotations import matrix_from_quaternion, matrix_from_rpy
from spacerobot_ros.model.wheels import ReactionWheels
from spacerobot_ros.resources import robot_file

RNG = np.random.default_rng(11)


def test_wheels_are_found_in_the_order_of_the_joints() -> None:
    robot = wheeled_robot()
    assert robot.joint_names == ("spin_c", "spin_a", "elbow", "spin_b")
    assert robot.description.wheel_names == ("spin_c", "spin_a", "spin_b")
    wheels = ReactionWheels.of(robot.description)
    assert len(wheels) == 3
    assert wheels.index.tolist() == [0, 1, 3]
    assert wheels.other.tolist() == [2]
    assert wheels.rate.tolist() == [200.0, 300.0, 200.0]
    assert wheels.torque.tolist() == [0.3, 0.2, 0.3]
    np.testing.assert_allclose(wheels.inertia, 0.03)
    turns = ([0.4, 0.2, 0.0], [1.4, -0.3, 0.6], [0.1, 1.5, -0.4])
    axes = np.column_stack([matrix_from_rpy(np.array(rpy))[:, 2] for rpy in turns])
    np.testing.assert_allclose(wheels.axes_B, axes, atol=1e-15)
    gyrostat = wheels.gyrostat
    assert (gyrostat.joint_names, gyrostat.wheel_names) == (("elbow",), ())
    assert gyrostat.total_mass == pytest.approx(40.0 + 4.0 + 3 * 3.0)


def test_a_robot_without_wheels_has_none() -> None:
    wheels = ReactionWheels.of(load_robot(robot_file("planar_manipulator")))
    assert (len(wheels), wheels.axes_B.shape, wheels.index.shape) == (0, (3, 0), (0,))
    assert wheels.other.tolist() == [0, 1]


def test_the_gyrostat_moves_as_the_robot_does_in_pinocchio() -> None:
    """Its momentum and those of the spins are the momentum of the robot."""
    robot = wheeled_robot()
    wheels = ReactionWheels.of(robot.description)
    gyrostat = SpaceRobot(wheels.gyrostat)
    oracle = PinocchioOracle(robot.description.urdf, robot.joint_names)
    for _ in range(5):
        motion = random_motion(RNG, robot.n)
        motion.qdot[wheels.index] *= 100.0
        wrench, tau = RNG.normal(size=6), RNG.normal(size=robot.n)
        h = wheels.spins(motion.omega_WB_B, motion.qdot[wheels.index])
        of_wheels = wheels.axes_B @ tau[wheels.index]
        on_base = wrench.copy()
        on_base[3:] -= of_wheels + np.cross(motion.omega_WB_B, wheels.axes_B @ h)
        rest = wheels.other
        moved = gyrostat.forward_dynamics(
            motion.q[rest], motion.v_cm_B, motion.omega_WB_B, motion.qdot[rest], on_base, tau[rest]
        )
        expected = oracle.forward_dynamics(motion, wrench, tau)
        np.testing.assert_allclose(moved[:6], expected[:6], atol=1e-9)
        np.testing.assert_allclose(moved[6:], expected[6:][rest], atol=1e-9)
        spun = wheels.axes_B.T @ expected[3:6] + expected[6:][wheels.index]
        np.testing.assert_allclose(wheels.inertia * spun, tau[wheels.index], atol=1e-9)
        _, of_gyrostat, _ = gyrostat.momentum(
            *(motion.quaternion_WB, motion.q[rest], np.zeros(3)),
            *(motion.omega_WB_B, motion.qdot[rest]),
        )
        R_WB = matrix_from_quaternion(motion.quaternion_WB)
        _, L_W, _ = oracle.momentum(motion)
        np.testing.assert_allclose(of_gyrostat + R_WB @ wheels.axes_B @ h, L_W, atol=1e-9)


PLACE = '<origin xyz="0 0 0.1"/>'


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        (
            wheel("bad", PLACE, '<limit lower="-1" upper="1" velocity="9" effort="1"/><wheel/>',
                  kind="revolute"),
            "The wheel 'bad' is revolute: give it type=\"continuous\".",
        ),
        (
            wheel("bad", PLACE, "<wheel/>"),
            "The wheel 'bad' has no rate and torque limits: give it "
            '<limit velocity="..." effort="..."/> in rad/s and N m.',
        ),
        (
            wheel("bad", PLACE, '<limit velocity="0" effort="1"/><wheel/>'),
            "The wheel 'bad' has no rate and torque limits",
        ),
        (
            wheel("bad", PLACE, '<limit velocity="9" effort="0"/><wheel/>'),
            "The wheel 'bad' has no rate and torque limits",
        ),
        (
            wheel("bad", PLACE, parent="elbow_body"),
            "The wheel 'bad' is on link 'elbow_body', which moves: a reaction wheel must be on "
            "the base; without <wheel> it is an ordinary joint.",
        ),
        (
            wheel("bad", PLACE, f'{LIMIT}<wheel/><mimic joint="elbow"/>'),
            "The wheel 'bad' is coupled to another joint by <mimic>: a wheel spins independently.",
        ),
        (
            wheel("bad", PLACE, com="0.001 0 0"),
            "The wheel 'bad' is not balanced: its centre of mass is 0.001 m off its axis; "
            "move the origin of its <inertial>.",
        ),
        (
            wheel("bad", PLACE, inertia=ROUND.replace('iyy="0.02"', 'iyy="0.021"')),
            "The wheel 'bad' is not balanced: its inertia is not rotationally symmetric",
        ),
        (
            wheel("bad", PLACE, inertia=ROUND.replace('ixz="0"', 'ixz="0.001"')),
            "The wheel 'bad' is not balanced: its inertia is not rotationally symmetric",
        ),
        (
            wheel("bad", PLACE) + wheel("next", PLACE, LIMIT, parent="bad_body"),
            "The wheel 'bad' carries a joint: a reaction wheel cannot carry joints.",
        ),
        (
            wheel("bad", PLACE) + wheel("next", PLACE, f'{LIMIT}<mimic joint="bad"/>'),
            "The wheel 'bad' is coupled to another joint by <mimic>",
        ),
    ],
)  # fmt: skip
def test_other_wheels_are_refused(bad: str, message: str) -> None:
    with pytest.raises(RobotDescriptionError) as refusal:
        parse_robot(text(HULL, WHEELS[0], ARM, ELBOW, bad))
    assert message in str(refusal.value)


def test_slight_flaws_of_a_wheel_are_admitted() -> None:
    inertia = '<inertia ixx="0.02" ixy="0" ixz="0" iyy="0.02002" iyz="0" izz="0.03"/>'
    round_enough = wheel("fair", PLACE, com="0.00009 0 0.2", inertia=inertia)
    assert parse_robot(text(HULL, round_enough)).wheel_names == ("fair",)


def test_a_fixed_wheel_is_part_of_the_base() -> None:
    robot = parse_robot(text(HULL, WHEELS[0], wheel("still", PLACE, kind="fixed")))
    assert robot.wheel_names == ("spin_c",)


def test_the_wheels_of_the_tender_are_a_pyramid() -> None:
    wheels = ReactionWheels.of(load_robot(robot_file("tender")))
    np.testing.assert_allclose(wheels.axes_B @ wheels.axes_B.T, 4 / 3 * np.eye(3), atol=1e-9)
    assert (wheels.inertia * wheels.rate).tolist() == [3.0] * 4
