"""The impact of a grasp against Pinocchio's model of both bodies together, and its laws."""

from __future__ import annotations

import json

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from support.oracles import Array, PinocchioOracle, assert_agrees

from spacerobot_ros.errors import RobotDescriptionError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Inertia, Pose
from spacerobot_ros.model.grasp import (
    BodyMotion,
    GraspImpact,
    Payload,
    RobotMotion,
    combined_momenta,
    frame_motion,
    grasp_impact,
    separated_momenta,
)
from spacerobot_ros.model.rotations import matrix_from_rpy
from spacerobot_ros.resources import robot_file

TURN = matrix_from_rpy([0.4, -0.7, 1.1])
TUMBLER = Inertia(17.0, np.array([0.3, -0.2, 0.15]), TURN @ np.diag([1.1, 1.9, 2.4]) @ TURN.T)


def robot_named(name: str) -> SpaceRobot:
    return SpaceRobot.from_file(robot_file(name))


def random_motion(rng: np.random.Generator, robot: SpaceRobot) -> RobotMotion:
    quaternion = rng.normal(size=4)
    return RobotMotion(
        np.concatenate([rng.uniform(-2, 2, 3), quaternion / np.linalg.norm(quaternion)]),
        rng.uniform(-1, 1, 6),
        rng.uniform(-1.2, 1.2, robot.n),
        rng.uniform(-1, 1, robot.n),
    )


def random_body(rng: np.random.Generator, near: Array) -> BodyMotion:
    R = Rotation.random(random_state=int(rng.integers(1 << 30))).as_matrix()
    return BodyMotion(
        R, near + rng.uniform(-0.6, 0.6, 3), rng.uniform(-1, 1, 3), rng.uniform(-1, 1, 3)
    )


def momenta(robot: SpaceRobot, motion: RobotMotion) -> tuple[Array, float]:
    """Momenta (6,) about the centre of mass, summed over the bodies, and the kinetic energy."""
    quaternion, v, omega = motion.pose[3:], motion.twist[:3], motion.twist[3:]
    p, L, energy = robot.momentum(quaternion, motion.q, v, omega, motion.qdot)
    return np.concatenate([p, L]), energy


def center_of(robot: SpaceRobot, motion: RobotMotion) -> Array:
    return motion.pose[:3] + motion.R_WB @ robot.center_of_mass(motion.q)


def body_energy(body: BodyMotion, inertia: Inertia) -> float:
    p, L = body.momenta(inertia)
    return float(p @ p / inertia.mass + L @ body.omega) / 2


def after(motion: RobotMotion, impact: GraspImpact) -> RobotMotion:
    return RobotMotion(motion.pose, impact.twist, motion.q, impact.qdot)


def held_pose(robot: SpaceRobot, link: str, motion: RobotMotion, body: BodyMotion) -> Pose:
    """The pose of the body's frame T in the frame of the link."""
    at = frame_motion(robot, link, motion)
    return Pose(at.R_WT.T @ body.R_WT, at.R_WT.T @ (body.r_WT - at.r_WT))


@pytest.mark.parametrize("seed", range(3))
def test_velocities_after_it_are_those_of_pinocchios_joined_robot(seed: int) -> None:
    """The joined robot has the momentum of both along each of its own velocities."""
    rng = np.random.default_rng(seed)
    robot = robot_named("seven_joint_arm")
    motion = random_motion(rng, robot)
    body = random_body(rng, frame_motion(robot, "link_7", motion).r_WT)
    grasp = held_pose(robot, "link_7", motion, body)

    oracle = PinocchioOracle(robot.description.urdf, robot.joint_names)
    model, u = oracle.model, np.concatenate([motion.twist, motion.qdot])
    oracle.place(motion.q, motion.pose[3:], motion.pose[:3])
    alone = oracle.own_mass_matrix()
    wrist = model.frames[model.getFrameId("link_7", pin.FrameType.BODY)]
    held = wrist.placement * pin.SE3(grasp.R, grasp.r)
    inertia = pin.Inertia(TUMBLER.mass, TUMBLER.com, TUMBLER.about_com)
    model.appendBodyToJoint(wrist.parentJoint, inertia, held)
    model.addFrame(pin.Frame("held", wrist.parentJoint, held, pin.FrameType.OP_FRAME))
    oracle.data = model.createData()
    oracle.place(motion.q, motion.pose[3:], motion.pose[:3])
    joined, frame = oracle.own_mass_matrix(), model.getFrameId("held")
    J = pin.getFrameJacobian(model, oracle.data, frame, pin.ReferenceFrame.LOCAL)
    twist = np.concatenate([body.R_WT.T @ body.v, body.R_WT.T @ body.omega])
    momentum = alone @ u + J.T @ inertia.matrix() @ twist
    expected = np.linalg.solve(joined, momentum)

    impact = grasp_impact(robot, "link_7", motion, body, TUMBLER)
    assert_agrees(np.concatenate([impact.twist, impact.qdot]), expected, 1e-12)
    before = u @ alone @ u + twist @ inertia.matrix() @ twist
    assert impact.energy_before == pytest.approx(before / 2, rel=1e-12)
    assert impact.energy_lost == pytest.approx((before - expected @ momentum) / 2, rel=1e-11)
    # The generalised impulse on the robot is J' L: its joint part, and that on the base link.
    generalised = alone @ (expected - u)
    assert_agrees(impact.joint_impulses, generalised[6:], 1e-11)
    assert_agrees(impact.impulse[:3], motion.R_WB @ generalised[:3], 1e-11)
    arm = frame_motion(robot, "link_7", motion).r_WT - motion.pose[:3]
    about_base = impact.impulse[3:] + np.cross(arm, impact.impulse[:3])
    assert_agrees(about_base, motion.R_WB @ generalised[3:6], 1e-11)


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_momentum_is_conserved_energy_is_not_gained_and_both_move_as_one(seed: int) -> None:
    rng = np.random.default_rng(seed)
    robot = robot_named("planar_manipulator")
    motion = random_motion(rng, robot)
    link = ("end_effector", "link_1", "base_link")[seed % 3]
    body = random_body(rng, frame_motion(robot, link, motion).r_WT)
    before = momenta(robot, motion)
    of_body = np.concatenate(body.momenta(TUMBLER))
    masses = robot.total_mass, TUMBLER.mass
    centers = center_of(robot, motion), body.at(Pose(r=TUMBLER.com)).r_WT
    total = combined_momenta(masses, centers, (before[0], of_body))

    impact = grasp_impact(robot, link, motion, body, TUMBLER)
    moved = after(motion, impact)
    joined = Payload(link, TUMBLER.moved(held_pose(robot, link, motion, body))).attached_to(robot)
    both = momenta(joined, moved)
    np.testing.assert_allclose(both[0], total, rtol=0, atol=1e-12 * np.abs(total).max())
    energy = before[1] + body_energy(body, TUMBLER)
    assert impact.energy_before == pytest.approx(energy, rel=1e-12)
    assert impact.energy_lost >= 0.0
    assert both[1] == pytest.approx(energy - impact.energy_lost, rel=1e-10)
    # The body moves with the link: what it lost, the robot has.
    grasp = held_pose(robot, link, motion, body)
    carried = np.concatenate(frame_motion(robot, link, moved).at(grasp).momenta(TUMBLER))
    alone = separated_momenta(masses, centers, both[0], carried)
    np.testing.assert_allclose(alone, momenta(robot, moved)[0], rtol=0, atol=1e-11)
    np.testing.assert_allclose(impact.impulse[:3], of_body[:3] - carried[:3], rtol=0, atol=1e-11)


def test_the_motion_of_a_frame_is_the_change_of_its_pose() -> None:
    rng = np.random.default_rng(11)
    robot = robot_named("planar_manipulator")
    motion = random_motion(rng, robot)
    h = 1e-6

    def pose_at(t: float) -> tuple[Array, Array]:
        R_WB = motion.R_WB @ Rotation.from_rotvec(t * motion.twist[3:]).as_matrix()
        r_WB = motion.pose[:3] + t * motion.R_WB @ motion.twist[:3]
        quaternion = Rotation.from_matrix(R_WB).as_quat()
        moved = RobotMotion(
            np.concatenate([r_WB, quaternion]),
            motion.twist,
            motion.q + t * motion.qdot,
            motion.qdot,
        )
        at = frame_motion(robot, "end_effector", moved)
        return at.R_WT, at.r_WT

    at = frame_motion(robot, "end_effector", motion)
    (R_1, r_1), (R_2, r_2) = pose_at(-h), pose_at(h)
    np.testing.assert_allclose(at.v, (r_2 - r_1) / (2 * h), rtol=0, atol=1e-8)
    turn = Rotation.from_matrix(R_2 @ R_1.T).as_rotvec() / (2 * h)
    np.testing.assert_allclose(at.omega, turn, rtol=0, atol=1e-8)


def test_a_payload_survives_as_a_text() -> None:
    payload = Payload("link_7", TUMBLER)
    again = Payload.from_text(payload.to_text())
    assert again.link == "link_7"
    assert again.inertia.mass == 17.0
    np.testing.assert_array_equal(again.inertia.com, TUMBLER.com)
    # The text has the upper triangle of a matrix that is symmetric up to rounding.
    np.testing.assert_allclose(again.inertia.about_com, TUMBLER.about_com, rtol=1e-15)
    assert set(json.loads(payload.to_text())) == {"link", "mass", "com", "inertia"}


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        "{}",
        '{"link": "a", "mass": 1, "com": [1, 2], "inertia": [1, 1, 1, 0, 0, 0]}',
        '{"link": "a", "mass": 1, "com": [1, 2, 3], "inertia": [1, 1, 1]}',
        "[" * 100_000,
    ],
)
def test_a_text_that_is_no_payload_is_refused(text: str) -> None:
    with pytest.raises(RobotDescriptionError, match=r"^The string does not describe a payload: "):
        Payload.from_text(text)


def test_a_payload_of_an_unknown_link_is_refused() -> None:
    with pytest.raises(RobotDescriptionError) as error:
        Payload("hand", TUMBLER).attached_to(robot_named("planar_manipulator"))
    assert str(error.value) == (
        "The payload is held by link 'hand', but robot 'planar_manipulator' has no such link; it "
        "has base_link, link_1, link_2, end_effector."
    )


def test_momenta_of_two_systems_are_about_the_common_centre() -> None:
    """A mass of 1 kg at the origin at rest, one of 3 kg at x = 4 m that moves along y by 2 m/s."""
    still, moving = np.zeros(6), np.array([0.0, 6.0, 0.0, 0.1, 0.2, 0.5])
    masses, centers = (1.0, 3.0), (np.zeros(3), np.array([4.0, 0.0, 0.0]))
    together = combined_momenta(masses, centers, (still, moving))
    # The reduced mass, 0.75 kg, times 4 m and 2 m/s is 6 kg m^2/s.
    np.testing.assert_allclose(together, [0.0, 6.0, 0.0, 0.1, 0.2, 6.5], rtol=1e-15)
    parted = separated_momenta(masses, centers, together, moving)
    np.testing.assert_allclose(parted, still, rtol=0, atol=1e-15)
