"""Robot and target in the plant: free motion, capture, the motion of both as one, release."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.oracles import Array, PinocchioOracle
from support.oracles.integrated import tumbled_body
from support.oracles.orbit import relative_motion

from spacerobot_ros.errors import CommandError, ParameterError
from spacerobot_ros.events import EventKind
from spacerobot_ros.model import SpaceRobot, load_robot, parse_robot
from spacerobot_ros.model.description import Inertia
from spacerobot_ros.model.grasp import BodyMotion, Payload, RelativeMotion
from spacerobot_ros.model.urdf import with_held_joints
from spacerobot_ros.parameters import configured
from spacerobot_ros.resources import robot_file, share_directory
from spacerobot_ros.simulation import InitialState
from spacerobot_ros.simulation.actuators import PlantWithFaults, build_plant
from spacerobot_ros.simulation.capture import CapturePlant, capture_values
from spacerobot_ros.simulation.config import CaptureConfig, PlantConfig

BLOCK = str(share_directory() / "config" / "targets" / "block.urdf")

PAPER_ROBOT: dict[str, Any] = {
    "robot": "planar_manipulator",
    "tick_rate": 100.0,
    "initial_center_of_mass": [0.0, 0.0, 0.0],
    "initial_orientation": [0.0, 0.0, 0.18223552549214747, 0.9832549075639546],
    "initial_joint_positions": [-1.0122909661567112, 1.0524335389525807],
    "target.robot": BLOCK,
    "target.position": [2.3000768148, -0.0023734357, 0.0],
    "target.velocity": [-0.05, 0.02, 0.0],
    "target.angular_velocity": [0.0, 0.0, 0.1],
    "capture.distance": 0.01,
    "capture.angle": 0.5,
    "capture.rate": 0.2,
}
"""Papadopoulos and Dubowsky's robot at rest; the block's centre is 0.3 m beyond its hand."""

TUMBLER = """<robot name="tumbler">
  <link name="hull"><inertial><origin xyz="0.1 -0.05 0.2" rpy="0.3 -0.4 0.9"/><mass value="21"/>
    <inertia ixx="1.3" iyy="1.9" izz="2.6" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="ring"/><joint name="ring_mount" type="fixed"><parent link="hull"/>
    <child link="ring"/><origin xyz="0.4 0.3 -0.1" rpy="0.5 0.2 -0.3"/></joint></robot>"""

SPATIAL: dict[str, Any] = {
    "robot": "three_joint_arm",
    "tick_rate": 40.0,
    "integration_step": 0.005,
    "initial_position": [0.3, -0.2, 0.5],
    "initial_orientation": [0.1, -0.3, 0.2, 0.9],
    "initial_joint_positions": [0.3, -0.5, 0.4],
    "linear_momentum": [3.0, -2.0, 1.0],
    "angular_momentum": [1.0, 2.0, -1.5],
    "target.robot_description": TUMBLER,
    "target.grapple_frame": "ring",
    "target.position": [1.0, 1.5, -0.7],
    "target.orientation": [0.5, 0.1, -0.4, 0.7],
    "target.velocity": [0.02, -0.03, 0.01],
    "target.angular_velocity": [0.2, 0.3, -0.1],
    "capture.end_effector": "link_3",
    # Both are grasped where they are, however far apart.
    **{f"capture.{name}": 100.0 for name in ("distance", "angle", "speed", "rate")},
}


def plant_of(values: dict[str, Any], **others: Any) -> PlantWithFaults:
    config = configured(PlantConfig, {**values, **others})
    return build_plant(SpaceRobot.from_file(robot_file(config.robot)), config)


def capturing_of(plant: PlantWithFaults) -> CapturePlant:
    assert plant.capturing is not None
    return plant.capturing


def commands_of(plant: PlantWithFaults, rates: Any = 0.0) -> list[Array]:
    joints = np.zeros(plant.robot.n) + rates
    return [joints, np.zeros(6)] if plant.takes_wrench else [joints]


def total_momentum(plant: PlantWithFaults) -> Array:
    """Linear momentum, and angular momentum about the origin of W, summed over all bodies."""
    capturing = capturing_of(plant)
    payload, pose = capturing.payload, plant.pose
    robot = plant.robot if payload is None else payload.attached_to(plant.robot)
    R_WB = Rotation.from_quat(pose[3:]).as_matrix()
    p = plant.momentum[:3].copy()
    L = plant.momentum[3:6] + np.cross(pose[:3] + R_WB @ robot.center_of_mass(plant.q), p)
    if capturing.payload is None:
        inertia = capturing.target.inertia
        R = Rotation.from_quat(capturing.target_pose[3:]).as_matrix()
        omega = R @ capturing.target_twist[3:]
        v = R @ capturing.target_twist[:3] + np.cross(omega, R @ inertia.com)
        center = capturing.target_pose[:3] + R @ inertia.com
        p = p + inertia.mass * v
        L = L + R @ inertia.about_com @ R.T @ omega + np.cross(center, inertia.mass * v)
    return np.concatenate([p, L])


def relative_change(now: Array, before: Array) -> float:
    return max(
        float(np.linalg.norm((now - before)[part]) / np.linalg.norm(before[part]))
        for part in (slice(0, 3), slice(3, 6))
    )


@pytest.mark.parametrize("actuation", ["velocity", "effort"])
def test_the_papers_robot_captures_a_block(actuation: str) -> None:
    """Figures by Pinocchio."""
    mode = {"capture.mode": "automatic", "actuation": actuation}
    plant = plant_of(PAPER_ROBOT, **mode)
    capturing = capturing_of(plant)
    plant.step(*commands_of(plant))
    (event,) = capturing.events
    values = capture_values(event.about)
    expected: dict[str, Any] = {
        "base_velocity_mps": [5.2523e-4, 3.1376e-4, 0.0],
        "base_rate_radps": [0.0, 0.0, 3.1406e-4],
        "joint_rates_radps": [-0.0362457, 0.0809148],
        "impulse_Ns": [-0.110519, -0.065737, 0.0, 0.0, 0.0, 0.035296],
        "energy_before_J": 0.0195,
        "energy_lost_J": 0.0048564,
        "linear_momentum_kgmps": [-0.5, 0.2, 0.0],
        "angular_momentum_Nms": [0.0, 0.0, 0.4783324],
    }
    for name, figures in expected.items():
        np.testing.assert_allclose(values[name], figures, rtol=2e-5, atol=1e-9, err_msg=name)
    np.testing.assert_allclose(values["angular_momentum_Nms"][2], 0.4783324, rtol=0, atol=5e-8)
    assert values["total_momentum_residual"] < 1e-14
    assert values["captured"] is True
    assert values["requested"] is False
    # Servos have brought the joints to rest by internal torques; motors leave them moving.
    rates = [0.0, 0.0] if actuation == "velocity" else values["joint_rates_radps"]
    np.testing.assert_allclose(plant.qdot, rates, rtol=0, atol=6e-5)
    assert plant.effort.any() == (actuation == "velocity")
    assert capturing.payload is not None
    assert capturing.payload.attached_to(plant.robot).total_mass == pytest.approx(57.0)
    np.testing.assert_allclose(plant.momentum[:6], plant.expected_momenta, rtol=0, atol=1e-15)


@pytest.mark.parametrize("actuation", ["velocity", "effort"])
def test_momentum_is_constant_through_approach_capture_and_release(actuation: str) -> None:
    plant = plant_of(SPATIAL, actuation=actuation)
    capturing = capturing_of(plant)
    before = total_momentum(plant)
    joints = commands_of(plant, [0.02, -0.01, 0.03])
    poses = []
    for tick in range(16):
        if tick == 5:
            values = capture_values(capturing.capture().about)
            assert values["requested"]
            assert values["total_momentum_residual"] < 1e-13
        if tick == 11:
            capturing.release()
        plant.step(*joints)
        assert relative_change(total_momentum(plant), before) < 1e-12, tick
        poses.append(capturing.target_pose.copy())
    assert capturing.payload is None
    # The target moves on without a jump, and where its velocity says.
    steps = np.diff([pose[:3] for pose in poses], axis=0)
    assert np.abs(np.diff(steps, axis=0))[[0, 1, 6, 7, 8, 12, 13]].max() < 2e-3
    R = Rotation.from_quat(poses[-1][3:]).as_matrix()
    np.testing.assert_allclose(steps[-1] * 40.0, R @ capturing.target_twist[:3], rtol=0, atol=5e-3)


def test_a_release_at_once_leaves_the_motion_after_the_impact() -> None:
    plant = plant_of(SPATIAL, actuation="effort")
    capturing = capturing_of(plant)
    before, after = total_momentum(plant), capture_values(capturing.capture().about)
    released = capture_values(capturing.release().about)
    plant.step(*commands_of(plant))
    assert relative_change(total_momentum(plant), before) < 1e-12
    np.testing.assert_allclose(plant.qdot, after["joint_rates_radps"], rtol=0, atol=0.05)
    R = Rotation.from_quat(capturing.target_pose[3:]).as_matrix()
    omega = R @ capturing.target_twist[3:]
    np.testing.assert_allclose(omega, released["rate_radps"], rtol=0, atol=0.01)
    kinds = [each.kind for each in capturing.events]
    assert kinds == [EventKind.CAPTURED, EventKind.RELEASED]


def test_a_free_target_moves_by_eulers_equations() -> None:
    plant = plant_of(SPATIAL)
    capturing = capturing_of(plant)
    R_0 = Rotation.from_quat(SPATIAL["target.orientation"]).as_matrix()
    given = (np.array(SPATIAL[f"target.{k}"]) for k in ("position", "velocity", "angular_velocity"))
    start = BodyMotion(R_0, *given)
    R, r, omega = tumbled_body(capturing.target.inertia, start, np.array([2.0]))
    for _ in range(80):
        plant.step(*commands_of(plant))
    np.testing.assert_allclose(capturing.target_pose[:3], r[0], atol=1e-9)
    actual = Rotation.from_quat(capturing.target_pose[3:])
    assert (actual * R[0].inv()).magnitude() < 1e-9
    np.testing.assert_allclose(capturing.target_twist[3:], omega[0], rtol=0, atol=1e-9)


def test_a_held_target_moves_with_the_link() -> None:
    plant = plant_of(SPATIAL, actuation="velocity")
    capturing = capturing_of(plant)
    capturing.capture()
    index = plant.robot.link_names.index("link_3")

    def grasp() -> Array:
        R_WB = Rotation.from_quat(plant.pose[3:]).as_matrix()
        R_WL = R_WB @ plant.link_R[:, 3 * index : 3 * index + 3]
        arm = capturing.target_pose[:3] - plant.pose[:3] - R_WB @ plant.link_r[:, index]
        R_WT = Rotation.from_quat(capturing.target_pose[3:]).as_matrix()
        return np.column_stack([R_WL.T @ arm, R_WL.T @ R_WT])

    plant.step(*commands_of(plant, 0.1))
    first = grasp()
    plant.step(*commands_of(plant, 0.1))
    np.testing.assert_allclose(grasp(), first, rtol=0, atol=1e-13)


def test_an_automatic_capture_waits_for_the_target_and_after_a_release_for_its_return() -> None:
    """The block drifts towards the hand by 0.02 m a tick, from 0.06 m before it."""
    position = [2.3000768148 + 0.06, -0.0023734357, 0.0]
    plant = plant_of(
        PAPER_ROBOT,
        **{"capture.mode": "automatic", "target.position": position, "capture.distance": 0.025},
        **{"target.velocity": [-2.0, 0.0, 0.0], "capture.speed": 3.0, "capture.angle": 0.41},
        **{"target.angular_velocity": [0.0, 0.0, 0.0], "actuation": "effort"},
    )
    capturing = capturing_of(plant)
    held = []
    for _ in range(4):
        plant.step(*commands_of(plant))
        held.append(capturing.payload is not None)
    assert held == [False, False, True, True]
    capturing.release()
    for _ in range(3):
        plant.step(*commands_of(plant))
        assert capturing.payload is None
    # It has left and comes back.
    capturing.target.release(
        type(capturing.target.motion)(np.eye(3), np.full(3, 9.0), *np.eye(3)[:2])
    )
    plant.step(*commands_of(plant))
    plant.reset()
    np.testing.assert_allclose(capturing.target_pose[:3], position)
    assert not capturing.payload


def test_a_capture_needs_every_quantity_within_its_bound() -> None:
    approach = RelativeMotion(distance=0.2, angle=0.3, speed=0.04, rate=0.5)
    loose = CaptureConfig(distance=0.2, angle=0.3, speed=0.04, rate=0.5)
    assert loose.misses(approach) == []
    assert CaptureConfig(distance=0.05, angle=0.2, speed=0.03, rate=0.1).misses(approach) == [
        "distance is 0.2 m, 0.15 m more than 'capture.distance', 0.05",
        "angle is 0.3 rad, 0.1 rad more than 'capture.angle', 0.2",
        "speed is 0.04 m/s, 0.01 m/s more than 'capture.speed', 0.03",
        "rate is 0.5 rad/s, 0.4 rad/s more than 'capture.rate', 0.1",
    ]


def test_the_approach_is_measured_between_the_two_frames() -> None:
    approach = capturing_of(plant_of(PAPER_ROBOT)).approach()
    assert approach.distance < 1e-8
    assert approach.angle == pytest.approx(np.radians(23.3))
    # Of the handle: -0.05 m/s along x, and 0.02 - 0.3 * 0.1 m/s along y.
    assert approach.speed == pytest.approx(np.hypot(0.05, 0.01))
    assert approach.rate == pytest.approx(0.1)


def test_a_target_that_is_turned_too_far_is_not_captured() -> None:
    capturing = capturing_of(plant_of(PAPER_ROBOT, **{"capture.angle": 0.1}))
    with pytest.raises(CommandError) as error:
        capturing.capture()
    assert str(error.value) == (
        "The target cannot be captured: its angle is 0.4067 rad, 0.3067 rad more than "
        "'capture.angle', 0.1."
    )
    assert capturing.events == []


def test_a_reset_puts_both_back() -> None:
    plant = plant_of(PAPER_ROBOT, actuation="effort")
    capturing = capturing_of(plant)
    pose = plant.pose.copy()
    capturing.capture()
    plant.step(*commands_of(plant, 1.0))
    plant.reset()
    assert capturing.payload is None
    np.testing.assert_array_equal(plant.pose, pose)
    np.testing.assert_allclose(capturing.target_pose[:3], PAPER_ROBOT["target.position"])
    np.testing.assert_allclose(plant.momentum, 0.0, atol=1e-15)
    np.testing.assert_allclose(capturing.target_twist, [-0.05, 0.02, 0, 0, 0, 0.1], atol=1e-15)


def test_limits_and_locked_joints_outlast_a_capture() -> None:
    plant = plant_of(
        PAPER_ROBOT,
        faults=["joint_stuck shoulder at 0"],
        **{"capture.distance": 1.0, "capture.speed": 9.0, "capture.rate": 9.0},
    )
    capturing = capturing_of(plant)
    fast = commands_of(plant, [0.1, 9.0])
    plant.step(*fast)
    capturing.capture()
    plant.step(*fast)
    assert plant.limit_counts["rate"].tolist() == [0, 2]
    assert plant.qdot[0] == 0.0
    assert plant.q[0] == pytest.approx(-1.0122909661567112, abs=1e-15)
    plant.reset()
    plant.step(*fast)
    assert plant.limit_counts["rate"].tolist() == [0, 3]
    plant.reset()
    assert plant.limit_counts["rate"].tolist() == [0, 3]


@pytest.mark.parametrize("actuation", ["velocity", pytest.param("effort", marks=pytest.mark.slow)])
def test_disturbances_push_the_robot_before_and_after_a_capture(actuation: str) -> None:
    """0.3 N along x of the world from 0.02 s on: 0.003 N s in each tick of 0.01 s."""
    push = ["base_link force 0.3 0 0 at 0.02"]
    plant = plant_of(PAPER_ROBOT, actuation=actuation, disturbances=push)
    capturing = capturing_of(plant)
    along_x = []
    for tick in range(9):
        if tick == 4:
            capturing.capture()
        if tick == 7:
            capturing.release()
        plant.step(*commands_of(plant))
        along_x.append(total_momentum(plant)[0])
    expected = -0.5 + 0.003 * np.maximum(0.0, np.arange(1, 10) - 2)
    np.testing.assert_allclose(along_x, expected, rtol=0, atol=1e-12)
    np.testing.assert_allclose(plant.momentum[:6], plant.expected_momenta, rtol=0, atol=1e-13)


def test_joint_impulses_are_held_against_their_limit() -> None:
    capturing = capturing_of(plant_of(PAPER_ROBOT, **{"capture.joint_impulse_limit": 0.09}))
    event = capturing.capture()
    impulses = capture_values(event.about)["joint_impulses_Nms"]
    np.testing.assert_allclose(impulses, [-0.100376, 0.0186352], atol=5e-7)
    assert (event.kind, event.level) == (EventKind.CAPTURED, 1)
    assert event.message == (
        "The target is captured by an impulse of 0.1286 N s and 0.0353 N m s; 0.004856 J of "
        "0.0195 J are lost, and joint 'shoulder' takes 0.1004 N m s, more than "
        "'capture.joint_impulse_limit', 0.09."
    )
    assert capture_values({"impulse_Ns": "[1"}) == {}
    enough = capturing_of(plant_of(PAPER_ROBOT, **{"capture.joint_impulse_limit": 0.11})).capture()
    assert enough.level == 0
    assert enough.message.endswith("0.0195 J are lost.")


JOINTED = TUMBLER.replace('type="fixed"', 'type="continuous"').replace(
    '<link name="ring"/>',
    '<link name="ring"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" '
    'ixz="0" iyz="0"/></inertial></link>',
)


LEADING_JOINT = """<link name="slide"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1"
    ixy="0" ixz="0" iyz="0"/></inertial></link><joint name="lead" type="prismatic">
    <parent link="hull"/><child link="slide"/><axis xyz="0 0 1"/>
    <limit lower="-1" upper="1" velocity="1" effort="1"/></joint></robot>"""


@pytest.mark.parametrize(
    ("values", "sentence"),
    [
        (
            {"target.grapple_frame": "handle"},
            "The target 'block' has no link 'handle' to grasp; its links are block, grapple: set "
            "parameter 'target.grapple_frame', or add the link.",
        ),
        (
            {"target.robot_description": JOINTED, "target.joint_positions": [0.1, 0.2]},
            "The target is refused: 2 joint positions are given, but 'tumbler' has 1 joints: "
            "ring_mount.",
        ),
        (
            {"target.joint_positions": [0.1]},
            "The target is refused: 1 joint positions are given, but 'block' has 0 joints.",
        ),
        (
            {"target.robot": "planar_manipulator", "target.joint_positions": [9.0, 0.0]},
            "The target is refused: The position of joint 'shoulder', 9, is outside its limits ",
        ),
        (
            {"target.robot_description": TUMBLER.replace('value="21"', 'value="0"')},
            "The target is refused: The base link 'hull' has no mass;",
        ),
        ({"target.robot": "nowhere.urdf"}, "The target is refused: There is no robot 'nowhere"),
        (
            {"target.orientation": [0.0, 0.0, 0.0, 0.0]},
            "Parameter 'target.orientation' is refused: ",
        ),
        (
            {"capture.end_effector": "hand"},
            "The robot 'planar_manipulator' has no link 'hand' to capture a target with; it has "
            "base_link, link_1, link_2, end_effector: set parameter 'capture.end_effector'.",
        ),
    ],
)
def test_a_bad_target_is_refused(values: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ParameterError) as error:
        plant_of(PAPER_ROBOT, **values)
    assert str(error.value).startswith(sentence)


def test_a_target_of_several_bodies_is_rigid_at_the_positions_of_its_joints() -> None:
    """Mass properties and grapple frame are those of Pinocchio's robot with locked joints."""
    q = [0.7, -1.1, 0.4]
    plant = plant_of(
        {
            **{name: x for name, x in SPATIAL.items() if name != "target.robot_description"},
            "target.robot": "three_joint_arm",
            "target.grapple_frame": "link_3",
            "target.joint_positions": q,
        }
    )
    target = capturing_of(plant).target
    robot = load_robot(robot_file("three_joint_arm"))
    oracle = PinocchioOracle(robot.urdf, robot.joint_names)
    oracle.place(np.array(q), np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(3))
    whole = sum(
        (
            oracle.data.oMi[index].act(oracle.model.inertias[index])
            for index in range(2, oracle.model.njoints)
        ),
        oracle.data.oMi[1].act(oracle.model.inertias[1]),
    )
    assert target.inertia.mass == pytest.approx(whole.mass, rel=1e-14)
    np.testing.assert_allclose(target.inertia.com, whole.lever, atol=1e-14)
    np.testing.assert_allclose(target.inertia.about_com, whole.inertia, atol=1e-12)
    grapple = oracle.data.oMf[oracle.model.getFrameId("link_3")]
    np.testing.assert_allclose(target.grapple.R, grapple.rotation, atol=1e-14)
    np.testing.assert_allclose(target.grapple.r, grapple.translation, atol=1e-14)
    # All who read the published description know one rigid body.
    assert parse_robot(target.description.urdf).joint_names == ()
    before = total_momentum(plant)
    capturing_of(plant).capture()
    for _ in range(20):
        plant.step(*commands_of(plant, 0.1))
    assert relative_change(total_momentum(plant), before) < 1e-12


def test_joints_of_a_target_are_held_at_zero_or_the_nearest_limit() -> None:
    target = parse_robot(
        JOINTED.replace('type="continuous"', 'type="revolute"')
        .replace(
            "</joint>",
            '<axis xyz="0 1 0"/><limit lower="0.2" upper="1.5707963267948966" velocity="1" '
            'effort="1"/><mimic joint="lead" multiplier="2"/></joint>',
        )
        .replace("</robot>", LEADING_JOINT)
    )
    for given, lead in ((None, 0.1), (np.array([0.75]), 0.75)):
        held = with_held_joints(target, given)
        expected = Rotation.from_euler("xyz", [0.5, 0.2, -0.3]) * Rotation.from_euler("y", 2 * lead)
        np.testing.assert_allclose(held.frames["ring"][1].R, expected.as_matrix(), atol=1e-15)
        np.testing.assert_allclose(held.frames["slide"][1].r, [0.0, 0.0, lead], atol=1e-15)
    assert held.joint_names == ()


ENGINES = ["exact", pytest.param("mujoco", marks=pytest.mark.slow)]

ORBITING: dict[str, Any] = {
    **SPATIAL,
    "linear_momentum": [0.0, 0.0, 0.0],
    "angular_momentum": [0.0, 0.0, 0.0],
    "orbit.mean_motion": 0.05,
    "orbit.orientation": [0.3, -0.2, 0.4, 0.7],
}


@pytest.mark.parametrize("engine", ENGINES)
def test_a_target_in_an_orbit_moves_by_clohessy_and_wiltshire(engine: str) -> None:
    """Its centre of mass follows their closed solution, its attitude an independent integration of
    Euler's equations with the torque of the gravity gradient.
    """
    plant = plant_of(ORBITING, engine=engine, actuation="effort", integration_step=0.0)
    target, n = capturing_of(plant).target, 0.05
    inertia, motion = target.inertia, target.motion
    frame = Rotation.from_quat(ORBITING["orbit.orientation"])
    center = motion.r_WT + motion.R_WT @ inertia.com
    velocity = motion.v + np.cross(motion.omega, motion.R_WT @ inertia.com)
    start = frame.inv().apply(center)
    relative = frame.inv().apply(velocity) - np.cross([0.0, 0.0, n], start)

    def torque(t: float, R: Rotation) -> Array:
        outward = R.inv().apply(frame.apply([np.cos(n * t), np.sin(n * t), 0.0]))
        return 3 * n**2 * np.cross(outward, inertia.about_com @ outward)

    ticks = 80
    for _ in range(ticks):
        plant.step(*commands_of(plant))
    end = ticks / 40.0
    expected, _ = relative_motion(n, start, relative, end)
    expected = (frame * Rotation.from_rotvec([0.0, 0.0, n * end])).apply(expected)
    R = Rotation.from_quat(target.pose[3:])
    tolerance = {"exact": 1e-9, "mujoco": 2e-4}[engine]
    np.testing.assert_allclose(target.pose[:3] + R.apply(inertia.com), expected, atol=tolerance)
    turned, _, omega = tumbled_body(inertia, motion, np.array([end]), torque)
    assert (R.inv() * turned[0]).magnitude() < tolerance
    np.testing.assert_allclose(target.twist[3:], omega[0], atol=tolerance)


@pytest.mark.parametrize("engine", ENGINES)
def test_robot_and_target_together_follow_the_ledger_of_an_orbit(engine: str) -> None:
    """Nothing but the gravity gradient changes their momentum: before a capture, while the target
    is held, and after its release.
    """
    plant = plant_of(ORBITING, engine=engine, actuation="effort", integration_step=0.0)
    capturing, far = capturing_of(plant), np.zeros(0)
    changed = 0.0
    for tick in range(60):
        if tick == 20:
            capturing.capture()
        if tick == 40:
            capturing.release()
        plant.step(*commands_of(plant, 0.2))
        expected = capturing.expected_momenta
        tolerance = {"exact": 1e-9, "mujoco": 2e-3}[engine]
        np.testing.assert_allclose(plant.momentum[:6], expected, rtol=0, atol=tolerance)
        far = expected.copy() if tick == 20 else far
        changed = np.abs(expected - far).max() if 20 < tick < 40 else changed
    assert changed > 1e-2, "the gravity gradient acts on both while they are joined"
    momenta = np.concatenate(capturing.target.motion.momenta(capturing.target.inertia))
    assert momenta == pytest.approx(capturing.target.momenta, abs=1e-3)


def test_a_target_slides_on_a_table_with_the_robot() -> None:
    """Downhill with friction: ``v' = g sin(tilt) - d v``, the spin decays by itself."""
    plant = plant_of(
        PAPER_ROBOT, **{"table.tilt": 0.1, "table.direction": 0.6, "table.friction": 0.4}
    )
    capturing, ticks = capturing_of(plant), 100
    for _ in range(ticks):
        plant.step(*commands_of(plant))
    left = np.exp(-0.4 * ticks / 100.0)
    steady = 9.80665 * np.sin(0.1) / 0.4 * np.array([np.cos(0.6), np.sin(0.6)])
    v = capturing.target.motion.v[:2]
    np.testing.assert_allclose(v, steady + ([-0.05, 0.02] - steady) * left, atol=1e-9)
    assert capturing.target.motion.omega[2] == pytest.approx(0.1 * left, abs=1e-12)
    # It would not go on turning about z: none of its principal axes is along it.
    wobbly = {"target.robot_description": TUMBLER, "target.grapple_frame": "ring"}
    for flaw in (
        {"target.velocity": [0.0, 0.0, 0.1]},
        {"target.angular_velocity": [0.1, 0, 0]},
        wobbly,
    ):
        name = "tumbler" if flaw is wobbly else "block"
        with pytest.raises(ParameterError, match=f"the target '{name}' leaves the world's x-y"):
            plant_of(PAPER_ROBOT, **{"table.tilt": 0.1, **flaw})


@pytest.mark.parametrize("held", [True, False])
@pytest.mark.parametrize(
    ("engine", "actuation"), [("exact", "effort"), ("exact", "velocity"), ("mujoco", "effort")]
)
def test_a_plant_goes_on_from_a_state_with_its_target(
    engine: str, actuation: str, held: bool
) -> None:
    """The flight goes on as the one that was not interrupted, and a release works."""
    values = {**SPATIAL, "engine": engine, "actuation": actuation, "integration_step": 0.001}
    flown, resumed = plant_of(values), plant_of(values)
    first, second = capturing_of(flown), capturing_of(resumed)
    if held:
        first.capture()
    for _ in range(12):
        flown.step(*commands_of(flown, 0.1))
    moving = actuation == "effort"
    if not moving:
        flown.step(*commands_of(flown))  # Servos at rest: those of a plant that is started are.
    state = InitialState(
        position=flown.pose[:3].copy(),
        quaternion=flown.pose[3:].copy(),
        joint_positions=flown.q.copy(),
        joint_velocities=flown.qdot.copy() if moving else None,
        linear_momentum=flown.momentum[:3].copy(),
        angular_momentum=flown.momentum[3:6].copy(),
    )
    told = first.payload.to_text() if first.payload is not None else ""
    second.resume(
        state,
        Payload.from_text(told) if told else None,
        BodyMotion.of(first.target_pose, first.target_twist),
    )
    tolerance = 1e-12 if engine == "exact" else 1e-3
    for tick in range(12):
        for name in ("pose", "twist", "q", "qdot"):
            pair = getattr(flown, name), getattr(resumed, name)
            np.testing.assert_allclose(*pair, rtol=0, atol=tolerance)
        np.testing.assert_allclose(first.target_pose, second.target_pose, atol=tolerance)
        np.testing.assert_allclose(first.target_twist, second.target_twist, atol=tolerance)
        np.testing.assert_allclose(flown.momentum, resumed.momentum, atol=100 * tolerance)
        if tick == 6 and held:
            assert first.payload is not None
            assert second.payload is not None
            assert first.payload.to_text() == second.payload.to_text()
            first.release(), second.release()
        for plant in (flown, resumed):
            plant.step(*commands_of(plant, 0.05))
    assert second.payload is None
    if engine == "exact":
        resumed.plant.reset()
        fresh = plant_of(values)
        np.testing.assert_array_equal(resumed.pose, fresh.pose)
        np.testing.assert_array_equal(second.target_pose, capturing_of(fresh).target_pose)


def test_a_plant_that_goes_on_beside_its_target_captures_it_when_it_comes_back() -> None:
    """Nothing hinders a capture there, as just after a release."""
    plant = plant_of(PAPER_ROBOT, **{"capture.mode": "automatic", "capture.distance": 0.05})
    capturing = capturing_of(plant)
    state = InitialState(
        position=plant.pose[:3].copy(),
        quaternion=plant.pose[3:].copy(),
        joint_positions=plant.q.copy(),
    )
    there = BodyMotion.of(capturing.target_pose, capturing.target_twist)
    capturing.resume(state, None, there)
    plant.step(*commands_of(plant))
    assert capturing.payload is None
    away = replace(there, r_WT=there.r_WT + np.array([0.0, 0.2, 0.0]))
    for body, held in ((away, False), (there, True)):
        capturing.target.release(body)
        plant.step(*commands_of(plant))
        plant.step(*commands_of(plant))
        assert (capturing.payload is not None) is held


def test_a_body_that_another_link_holds_is_not_gone_on_with() -> None:
    plant = plant_of(SPATIAL)
    body = BodyMotion.of(plant.pose, plant.twist)
    with pytest.raises(ParameterError, match="The link 'link_1' holds the target, but this plant"):
        capturing_of(plant).resume(InitialState(), Payload("link_1", Inertia(1.0)), body)
