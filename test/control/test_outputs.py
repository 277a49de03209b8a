"""The output vector: which outputs a robot gets, their Jacobian, bias and error."""

from __future__ import annotations

from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest
from control.flights import END_EFFECTOR, PinocchioPlant, load, random_pose_reference, random_state
from scipy.spatial.transform import Rotation
from support.oracles import Array
from support.random_robots import random_chain_urdf, random_robot_urdf

from spacerobot_ros.control import (
    ControlState,
    JointReference,
    NotFiniteError,
    OutputSelection,
    PoseReference,
    Reference,
    TargetNotSetError,
    default_selection,
    plane_normal,
)
from spacerobot_ros.control.outputs import OutputVector
from spacerobot_ros.errors import ParameterError
from spacerobot_ros.model import RobotDescription, SpaceRobot, parse_robot
from spacerobot_ros.model.inverse_kinematics import AXES

STEP = 1e-6


@dataclass
class Outputs:
    """The expressions of an output vector, evaluated."""

    vector: OutputVector

    def __post_init__(self) -> None:
        z1 = self.vector
        results = [z1.J_z, z1.bias_acceleration, z1.z0dot, z1.error, z1.error_rate, z1.acceleration]
        self._function = ca.Function("outputs", [z1.state, z1.reference], results)

    def __call__(self, state: ControlState, reference: Reference) -> list[Array]:
        z1 = self.vector
        x, r = np.zeros(z1.state.numel()), np.zeros(z1.reference.numel())
        z1.pack_state(state, x)
        z1.pack_reference(reference, r)
        J_z, *vectors = (np.array(result) for result in self._function(x, r))
        return [J_z, *(vector.ravel() for vector in vectors)]


def frames_after(
    robot: SpaceRobot, state: ControlState, time: float
) -> list[tuple[Array, Rotation]]:
    """Return where Pinocchio has base and tool after a short time at constant velocities."""
    plant = PinocchioPlant(robot, state)
    q = pin.integrate(plant.model, plant.q, time * plant.u)
    pin.framesForwardKinematics(plant.model, plant.data, q)
    placements = (plant.frame_W(link) for link in (robot.base_link, "tool_frame"))
    return [(r, Rotation.from_matrix(R)) for R, r in placements]


def with_all(rng: np.random.Generator, joints: int) -> Reference:
    return Reference(
        random_pose_reference(rng),
        random_pose_reference(rng),
        JointReference(*rng.uniform(-1, 1, (3, joints))),
    )


@pytest.mark.parametrize("seed", range(6))
def test_outputs_of_random_robots(seed: int) -> None:
    """Jacobian and bias by finite differences, errors by the poses that Pinocchio has."""
    rng = np.random.default_rng(seed)
    robot = SpaceRobot.from_urdf(random_robot_urdf(rng, joints=6 + seed % 2))
    outputs = Outputs(OutputVector(robot, OutputSelection(AXES, AXES, (), "tool_frame")))
    state, reference = random_state(rng, robot.n), with_all(rng, robot.n)
    J_z, bias, z0dot, error, error_rate, acceleration = outputs(state, reference)

    moved = (frames_after(robot, state, time) for time in (-STEP, STEP))
    differences = []
    for before, after in zip(*moved, strict=True):
        differences.append((after[0] - before[0]) / (2 * STEP))
        differences.append((after[1] * before[1].inv()).as_rotvec() / (2 * STEP))
    np.testing.assert_allclose(J_z @ z0dot, np.concatenate(differences), atol=1e-8)

    def J_z_after(time: float) -> Array:
        turn = Rotation.from_quat(state.quaternion_WB) * Rotation.from_rotvec(
            time * state.omega_WB_B
        )
        moved = replace(state, quaternion_WB=turn.as_quat(), q=state.q + time * state.qdot)
        return outputs(moved, reference)[0]

    J_z_dot = (J_z_after(STEP) - J_z_after(-STEP)) / (2 * STEP)
    np.testing.assert_allclose(bias, J_z_dot @ z0dot, atol=1e-7)

    expected, velocity, wanted = [], [], []
    poses = reference.base, reference.end_effector
    for pose, (position, attitude) in zip(poses, frames_after(robot, state, 0.0), strict=True):
        assert pose is not None
        turn = Rotation.from_quat(pose.quaternion) * attitude.inv()
        expected += [pose.position - position, turn.as_rotvec()]
        velocity += [pose.velocity, pose.angular_velocity]
        wanted += [pose.acceleration, pose.angular_acceleration]
    np.testing.assert_allclose(error, np.concatenate(expected), atol=1e-12)
    np.testing.assert_allclose(error_rate, np.concatenate(velocity) - J_z @ z0dot, atol=1e-12)
    np.testing.assert_array_equal(acceleration, np.concatenate(wanted))


def test_error_rate_is_the_derivative_of_the_error_about_one_axis() -> None:
    robot = load("planar_manipulator")
    outputs = Outputs(OutputVector(robot, OutputSelection(base=("rz",))))
    turned = Rotation.from_euler("z", 0.4).as_quat()
    still = ControlState.at_rest(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(2))
    state = replace(still, omega_WB_B=np.array([0.0, 0.0, 0.7]))

    def error_after(time: float) -> Array:
        attitude = Rotation.from_euler("z", 0.7 * time).as_quat()
        target = Reference(PoseReference(np.zeros(3), turned))
        return outputs(replace(state, quaternion_WB=attitude), target)[3]

    rate = (error_after(STEP) - error_after(-STEP)) / (2 * STEP)
    np.testing.assert_allclose(rate, [-0.7], atol=1e-9)


def test_joints_and_axes_are_selected_in_order() -> None:
    robot = load("servicer")
    selection = OutputSelection(("z", "rx"), ("y",), ("elbow_pitch", "shoulder_yaw"), END_EFFECTOR)
    vector = OutputVector(robot, selection)
    assert vector.labels == (
        "base.z",
        "base.rx",
        "end_effector.y",
        "joint.elbow_pitch",
        "joint.shoulder_yaw",
    )
    rng = np.random.default_rng(7)
    state, reference = random_state(rng, 6), with_all(rng, 6)
    assert reference.joints is not None
    full = OutputSelection(AXES, AXES, (), END_EFFECTOR)
    whole = Outputs(OutputVector(robot, full))(state, reference)
    part = Outputs(vector)(state, reference)
    for everything, chosen in zip(whole, part, strict=True):
        if len(everything) == 12 and everything is not whole[2]:
            np.testing.assert_array_equal(chosen[:3], everything[[2, 3, 7]])
    _, bias, _, error, error_rate, acceleration = part
    np.testing.assert_array_equal(part[0][3:, 6:], np.eye(6)[[2, 0]])
    np.testing.assert_array_equal(bias[3:], 0.0)
    np.testing.assert_array_equal(error[3:], (reference.joints.q - state.q)[[2, 0]])
    np.testing.assert_array_equal(error_rate[3:], (reference.joints.qdot - state.qdot)[[2, 0]])
    np.testing.assert_array_equal(acceleration[3:], reference.joints.qddot[[2, 0]])


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("degrees", [0.0, 1e-9, 90.0, 179.999, 180.0, 180.001, 270.0, 360.0])
def test_attitude_error_takes_the_shorter_way(degrees: float, sign: float) -> None:
    robot = load("planar_manipulator")
    outputs = Outputs(OutputVector(robot, OutputSelection(base=("rx", "ry", "rz"))))
    axis = np.array([2.0, -3.0, 6.0]) / 7.0
    rng = np.random.default_rng(11)
    present = Rotation.random(random_state=rng)
    half = np.radians(degrees) / 2
    turn = np.append(np.sin(half) * axis, np.cos(half))
    target = sign * (Rotation.from_quat(turn) * present).as_quat()
    state = ControlState.at_rest(np.zeros(3), present.as_quat(), np.zeros(2))
    error = outputs(state, Reference(PoseReference(np.zeros(3), target)))[3]
    shorter = degrees if degrees <= 180.0 else degrees - 360.0
    if degrees == 180.0:
        # Both ways are as short: either will do.
        error = error * np.sign(error @ axis)
    np.testing.assert_allclose(error, np.radians(shorter) * axis, atol=1e-7)


def test_state_and_reference_that_are_refused() -> None:
    robot = load("planar_manipulator")
    vector = OutputVector(robot, OutputSelection(("x",), ("x",), ("elbow",), END_EFFECTOR))
    x, r = np.zeros(vector.state.numel()), np.zeros(vector.reference.numel())
    rng = np.random.default_rng(3)
    state, reference = random_state(rng, 2), with_all(rng, 2)
    vector.pack_state(state, x)
    vector.pack_reference(reference, r)
    for bad in (np.nan, np.inf, -np.inf):
        with pytest.raises(NotFiniteError, match="state"):
            vector.pack_state(replace(state, qdot=np.array([0.0, bad])), x)
        joints = JointReference.at_rest(np.array([bad, 0.0]))
        with pytest.raises(NotFiniteError, match="reference"):
            vector.pack_reference(replace(reference, joints=joints), r)
    with pytest.raises(ValueError, match="shape"):
        vector.pack_state(random_state(rng, 3), x)
    for without, named in (
        (replace(reference, base=None), "the base"),
        (replace(reference, end_effector=None), "the end-effector"),
        (replace(reference, joints=None), "the joints"),
    ):
        with pytest.raises(TargetNotSetError, match=named):
            vector.pack_reference(without, r)


# -- which outputs a robot gets, and which are refused -------------------------------------------


BODY = '<link name="{name}"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" '
BODY += 'ixy="0" ixz="0" iyz="0"/></inertial></link>'


def chain(*joints: tuple[str, str], rpy: str = "0 0 0") -> RobotDescription:
    """Return a chain of (type, axis); the first joint's frame is turned by ``rpy``."""
    parts = [BODY.format(name="base_link")]
    for k, (kind, axis) in enumerate(joints, start=1):
        parent = "base_link" if k == 1 else f"link_{k - 1}"
        parts.append(BODY.format(name=f"link_{k}"))
        parts.append(
            f'<joint name="joint_{k}" type="{kind}"><parent link="{parent}"/>'
            f'<child link="link_{k}"/><origin xyz="1 0 0" rpy="{rpy if k == 1 else "0 0 0"}"/>'
            f'<axis xyz="{axis}"/><limit lower="-1" upper="1" velocity="1" effort="1"/></joint>'
        )
    return parse_robot(f'<robot name="chain">{"".join(parts)}</robot>')


R, P, C = "revolute", "prismatic", "continuous"


@pytest.mark.parametrize(
    ("description", "normal"),
    [
        (load("planar_manipulator").description, [0, 0, 1]),
        (load("planar_chain").description, [0, 0, 1]),
        (load("servicer").description, None),
        (load("sliding_masses").description, None),
        (load("three_joint_arm").description, None),
        (chain((R, "0 0 1"), (C, "0 0 -2"), (P, "3 4 0")), [0, 0, 1]),
        (chain((P, "1 0 0"), (R, "0 1 0")), [0, 1, 0]),
        (chain((R, "0 0 1"), (P, "0 0 1")), None),
        (chain((P, "1 0 0"), (P, "0 1 0")), None),
        (chain((R, "0 0 1"), (R, "0 0 1"), rpy="1.5707963267948966 0 0"), [0, -1, 0]),
        (chain((R, "0 0 1"), (R, "0 0 1"), rpy="0.3 0 0"), [0, -np.sin(0.3), np.cos(0.3)]),
    ],
)
def test_plane_of_a_robot(description: RobotDescription, normal: list[float] | None) -> None:
    found = plane_normal(description)
    if normal is None:
        assert found is None
    else:
        assert found is not None
        np.testing.assert_allclose(found, normal, atol=1e-12)


def test_default_outputs() -> None:
    planar = OutputSelection(("x", "y", "rz"), ("x", "y"), (), END_EFFECTOR)
    assert default_selection(load("planar_manipulator").description, END_EFFECTOR) == planar
    spatial = OutputSelection(AXES, AXES, (), END_EFFECTOR)
    assert default_selection(load("servicer").description, END_EFFECTOR) == spatial
    # No end-effector: base and joints.
    pins = OutputSelection(("x", "y", "rz"), joints=("pin_1", "pin_2"))
    assert default_selection(load("planar_chain").description, "") == pins
    # Three joints: the position of the end-effector only.
    arm = load("three_joint_arm").description
    tip = arm.links[-1].name
    assert default_selection(arm, tip) == OutputSelection(AXES, ("x", "y", "z"), (), tip)
    # A plane of the base's x and z; and one along none of its axes, with too few joints for space.
    tilted = chain((R, "0 1 0"), (R, "0 1 0"))
    assert default_selection(tilted, "link_2") == OutputSelection(
        ("x", "z", "ry"), ("x", "z"), (), "link_2"
    )
    askew = chain((R, "0 0 1"), (R, "0 0 1"), rpy="0.3 0 0")
    assert default_selection(askew, "link_2") == OutputSelection(AXES, joints=askew.joint_names)
    # One joint.
    single = chain((R, "0 0 1"))
    assert default_selection(single, "link_1") == OutputSelection(
        ("x", "y", "rz"), joints=("joint_1",)
    )


@pytest.mark.parametrize(("direction", "leaves"), [("1 0 0", False), ("0 0 -1", True)])
def test_a_planar_arm_on_a_base_that_thrusters_push_out_of_the_plane(
    direction: str, leaves: bool
) -> None:
    plain = load("planar_manipulator").description
    nozzle = f'<thruster name="jet"><origin xyz="0 0 0"/><axis xyz="{direction}"/>'
    nozzle += '<thrust force="1" isp="60"/></thruster>'
    robot = parse_robot(plain.urdf.replace("</robot>", f"{nozzle}</robot>"))
    expected = default_selection(plain, END_EFFECTOR)
    if leaves:
        expected = OutputSelection(AXES, joints=robot.joint_names)
    assert default_selection(robot, END_EFFECTOR) == expected


@pytest.mark.parametrize("joints", range(1, 9))
def test_default_outputs_never_exceed_the_degrees_of_freedom(joints: int) -> None:
    description = parse_robot(random_chain_urdf(np.random.default_rng(joints), joints))
    for link in ("", f"link_{joints}"):
        selection = default_selection(description, link)
        selection.require_valid(description)
        assert len(selection.labels) <= 6 + joints


@pytest.mark.parametrize(
    ("selection", "sentence"),
    [
        (OutputSelection(), "No output"),
        (OutputSelection(base=("x", "u")), "no axis of the base 'u'"),
        (OutputSelection(base=("x", "x")), "'x' is named twice"),
        (OutputSelection(end_effector=("x",)), "no end-effector link ''"),
        (OutputSelection(end_effector=("x",), end_effector_link="hand"), "link 'hand'"),
        (OutputSelection(joints=("knee",)), "no joint 'knee'; available: shoulder, elbow"),
        (OutputSelection(AXES, AXES, (), END_EFFECTOR), "12 outputs .* 8 degrees"),
    ],
)
def test_selections_that_are_refused(selection: OutputSelection, sentence: str) -> None:
    with pytest.raises(ParameterError, match=sentence):
        selection.require_valid(load("planar_manipulator").description)


def test_unknown_end_effector_is_refused() -> None:
    with pytest.raises(ParameterError, match="no end-effector link 'hand'"):
        default_selection(load("servicer").description, "hand")
