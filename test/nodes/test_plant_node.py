"""The plant node, from outside: what it publishes for what it is sent."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
from nav_msgs.msg import Odometry
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from support.oracles import PinocchioOracle
from support.plant_rig import SLIDERS, STATE, TICK, TICK_NS, Rig
from support.ros_harness import Harness, assert_one_sentence, construction, nanoseconds
from visualization_msgs.msg import Marker, MarkerArray

from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.nodes import PlantNode

Array = npt.NDArray[np.float64]

URDF = Path(__file__).parents[2] / "urdf"
MASS = 10 + 3 * 2.0
RATE_LIMIT, STROKE = 0.7, 2.5  # of each slider, as its <limit> says


def pose_of(odom: Odometry) -> tuple[Array, Array]:
    p, o = odom.pose.pose.position, odom.pose.pose.orientation
    return np.array([p.x, p.y, p.z]), np.array([o.x, o.y, o.z, o.w])


def twist_of(odom: Odometry) -> tuple[Array, Array]:
    v, w = odom.twist.twist.linear, odom.twist.twist.angular
    return np.array([v.x, v.y, v.z]), np.array([w.x, w.y, w.z])


def momentum_by_pinocchio(robot: str, odom: Odometry, joints: JointState) -> tuple[Array, float]:
    """Return the total momenta (world) and the kinetic energy of a published state."""
    oracle = PinocchioOracle((URDF / f"{robot}.urdf").read_text("utf-8"), list(joints.name))
    r, quaternion = pose_of(odom)
    oracle.set_configuration(np.array(joints.position), quaternion, r)
    twist = np.concatenate(twist_of(odom))
    oracle.move(oracle.base_velocities(twist) + oracle.joint_velocities(np.array(joints.velocity)))
    p, L, energy = oracle.momentum_W()
    return np.concatenate([p, L]), energy


# -- what is published ------------------------------------------------------------------------


def test_activation_publishes_the_state_of_tick_0_and_the_clock_first(harness: Harness) -> None:
    turn = Rotation.from_rotvec([0.3, -0.2, 0.5]).as_quat()
    rig = Rig(
        harness,
        {
            "initial_position": [1.0, -2.0, 3.0],
            "initial_orientation": turn.tolist(),
            "initial_joint_positions": [0.5, -0.25, 0.125],
            "world_frame": "map",
        },
        activate=False,
    )
    harness.settle(rig.probe)
    assert not set(rig.probe.order) & set(STATE), "published before activation"
    rig.activate()
    harness.settle(rig.probe)
    states = [topic for topic in rig.probe.order if topic in STATE]
    assert sorted(states) == sorted(STATE), "every topic once"
    assert states[0] == "/clock"
    assert nanoseconds(rig.probe.last("/clock").clock) == 0

    odom, base_pose = rig.probe.last("odom"), rig.probe.last("base_pose")
    assert (odom.header.frame_id, odom.child_frame_id) == ("map", "base_link")
    assert base_pose.header.frame_id == "map"
    assert base_pose.pose == odom.pose.pose
    position, quaternion = pose_of(odom)
    np.testing.assert_array_equal(position, [1.0, -2.0, 3.0])
    np.testing.assert_allclose(quaternion, turn, atol=1e-15)
    np.testing.assert_array_equal(np.concatenate(twist_of(odom)), np.zeros(6))

    joints = rig.probe.last("joint_states")
    assert list(joints.name) == SLIDERS
    assert list(joints.position) == [0.5, -0.25, 0.125]
    assert list(joints.velocity) == [0.0] * 3
    assert list(joints.effort) == [0.0] * 3

    momentum = rig.probe.last("momentum")
    (dimension,) = momentum.layout.dim
    assert dimension.label.split() == [
        "linear_x", "linear_y", "linear_z", "angular_x", "angular_y", "angular_z", "kinetic_energy",
    ]  # fmt: skip
    assert (dimension.size, dimension.stride, momentum.layout.data_offset) == (7, 7, 0)
    np.testing.assert_array_equal(momentum.data, np.zeros(7))
    for message in (odom, base_pose, joints):
        assert nanoseconds(message.header.stamp) == 0


def test_the_description_is_there_for_a_late_reader(harness: Harness) -> None:
    Rig(harness)
    late = harness.probe({"robot_description": String}, latched=("robot_description",), name="late")
    harness.spin_until(lambda: late.count("robot_description"), "the robot description")
    expected = (URDF / "sliding_masses.urdf").read_text("utf-8")
    assert late.last("robot_description").data == expected


def test_states_agree_with_pinocchio_while_everything_moves(harness: Harness) -> None:
    rig = Rig(
        harness,
        {
            "robot": "planar_manipulator",
            "linear_momentum": [1.0, -2.0, 0.5],
            "angular_momentum": [0.2, 0.1, -3.0],
            "end_effector_frame": "end_effector",
        },
        topics={"end_effector_pose": PoseStamped},
    )
    names = list(rig.probe.last("joint_states").name)
    rng = np.random.default_rng(1)
    for _ in range(5):
        rig.step(rng.uniform(-0.3, 0.3, len(names)).tolist(), names)
    harness.settle(rig.probe)
    oracle = PinocchioOracle((URDF / "planar_manipulator.urdf").read_text("utf-8"), names)
    for k in range(6):
        odom, joints = (rig.probe.messages[t][k] for t in ("odom", "joint_states"))
        published = np.array(rig.probe.messages["momentum"][k].data)
        momenta, energy = momentum_by_pinocchio("planar_manipulator", odom, joints)
        np.testing.assert_allclose(published[:6], momenta, atol=1e-12)
        np.testing.assert_allclose(published[:6], [1, -2, 0.5, 0.2, 0.1, -3], atol=1e-12)
        assert published[6] == pytest.approx(energy, rel=1e-12)
        r, quaternion = pose_of(odom)
        oracle.set_configuration(np.array(joints.position), quaternion, r)
        R_WE, r_WE = oracle.frame_W("end_effector")
        tip = rig.probe.messages["end_effector_pose"][k]
        assert tip.header.frame_id == "world"
        assert tip.header.stamp == odom.header.stamp
        p, o = tip.pose.position, tip.pose.orientation
        np.testing.assert_allclose([p.x, p.y, p.z], r_WE, atol=1e-12)
        np.testing.assert_allclose(
            Rotation.from_quat([o.x, o.y, o.z, o.w]).as_matrix(), R_WE, atol=1e-12
        )


def test_markers_stand_where_the_links_are(harness: Harness) -> None:
    rig = Rig(
        harness,
        {"marker_period": 2 * TICK, "initial_position": [0.0, 0.0, 1.0]},
        topics={"markers": MarkerArray},
    )
    for _ in range(4):
        rig.step([0.4, 0.0, 0.0])
    harness.settle(rig.probe)
    arrays = rig.probe.messages["markers"]
    assert [nanoseconds(a.markers[0].header.stamp) // TICK_NS for a in arrays] == [0, 2, 4]
    spheres = [m for m in arrays[-1].markers if m.type == Marker.SPHERE]
    assert [m.ns for m in spheres] == ["mass_1", "mass_2", "mass_3"]
    odom, joints = rig.probe.last("odom"), rig.probe.last("joint_states")
    r, quaternion = pose_of(odom)
    for axis, marker in enumerate(spheres):
        place = r + Rotation.from_quat(quaternion).apply(np.eye(3)[axis] * joints.position[axis])
        p = marker.pose.position
        np.testing.assert_allclose([p.x, p.y, p.z], place, atol=1e-14)
        assert marker.header.frame_id == "world"


def test_a_namespace_moves_all_but_the_clock_and_the_diagnostics(harness: Harness) -> None:
    harness.make(
        PlantNode,
        {"robot": "sliding_masses", "time_mode": "lockstep", "diagnostics_period": 0.05},
        namespace="/craft",
    )
    topics = {f"/craft/{name}" if name[0] != "/" else name: kind for name, kind in STATE.items()}
    probe = harness.probe({**topics, "/diagnostics": DiagnosticArray})
    # A newcomer is shown the state that waits.
    harness.spin_until(lambda: set(topics) <= set(probe.order), "the state in the namespace")
    publisher = harness.matched(probe.create_publisher(JointState, "/craft/joint_commands", 10))
    publisher.publish(JointState(name=["slider_1"], velocity=[0.5]))
    harness.spin_until(
        lambda: probe.last("/craft/joint_states").velocity[0] == 0.5, "a step in the namespace"
    )
    harness.spin_until(lambda: probe.count("/diagnostics"), "diagnostics")
    assert probe.last("/diagnostics").status[0].name == "/craft/plant: commands"


# -- commands ---------------------------------------------------------------------------------


def test_a_command_of_the_right_stamp_steps_exactly_once(harness: Harness) -> None:
    rig = Rig(harness)
    for k in range(1, 4):
        joints = rig.step([0.1, -0.2, 0.3])
        assert nanoseconds(joints.header.stamp) == k * TICK_NS
        np.testing.assert_allclose(joints.position, k * TICK * np.array([0.1, -0.2, 0.3]))
        np.testing.assert_array_equal(joints.velocity, [0.1, -0.2, 0.3])
    # The same stamp three times is one step.
    stamp = rig.now_ns
    for _ in range(3):
        rig.send([0.1, 0.0, 0.0], stamp_ns=stamp)
    rig.wait("joint_states", 5)
    rig.step([0.0, 0.0, 0.0])
    harness.settle(rig.probe)
    assert {topic: rig.probe.count(topic) for topic in STATE} == dict.fromkeys(STATE, 6)
    assert rig.diagnosed("commands", "refused") == 2


def test_time_is_a_whole_number_of_ticks(harness: Harness) -> None:
    rig = Rig(harness, {"tick_rate": 3.0})
    for k in range(1, 5):
        stamp = nanoseconds(rig.step([0.0, 0.0, 0.0]).header.stamp)
        assert stamp == k * 333_333_333
    harness.settle(rig.probe)
    clocks = [nanoseconds(m.clock) for m in rig.probe.messages["/clock"]]
    assert clocks == [nanoseconds(m.header.stamp) for m in rig.probe.messages["odom"]]


@pytest.mark.parametrize(
    ("offset_ns", "word"), [(-TICK_NS, "stale"), (-1, "stale"), (1, "ahead"), (10**12, "ahead")]
)
def test_a_command_of_another_stamp_is_refused_and_time_waits(
    harness: Harness, offset_ns: int, word: str
) -> None:
    rig = Rig(harness)
    rig.step([0.0, 0.0, 0.0])
    rig.send([0.1, 0.1, 0.1], stamp_ns=rig.now_ns + offset_ns)
    rig.wait_for_log(word)
    harness.settle(rig.probe)
    assert rig.probe.count("joint_states") == 2
    rig.step([0.1, 0.0, 0.0])
    status = rig.diagnosis("commands")
    assert status.level == DiagnosticStatus.WARN
    assert_one_sentence(status.message, "refused", word)
    assert rig.diagnosed("commands", "refused") == 1
    # The next diagnostics are about what is new.
    rig.step([0.1, 0.0, 0.0])
    assert rig.diagnosis("commands").level == DiagnosticStatus.OK


BAD_COMMANDS = {
    "NaN": ([math.nan, 0.1, 0.1], SLIDERS, "finite"),
    "infinite": ([0.1, 0.1, -math.inf], SLIDERS, "finite"),
    "infinities that cancel": ([math.inf, -math.inf, 0.1], SLIDERS, "finite"),
    "unknown joint": ([0.1, 0.1, 0.1], ["slider_1", "rudder", "slider_3"], "'rudder'"),
    "duplicate": ([0.1, 0.1, 0.1], ["slider_1", "slider_2", "slider_1"], "twice"),
    "too few velocities": ([0.1, 0.1], SLIDERS, "3 joint(s) are named but 2"),
    "too many velocities": ([0.1] * 4, SLIDERS, "3 joint(s) are named but 4"),
    "no velocities": ([], SLIDERS, "3 joint(s) are named but 0"),
    "no names": ([0.1, 0.1, 0.1], [], "0 joint(s) are named but 3"),
}


def test_a_bad_command_is_a_tick_at_rest_with_a_reason(harness: Harness) -> None:
    rig = Rig(harness)
    for count, (velocity, names, reason) in enumerate(BAD_COMMANDS.values(), start=1):
        before = rig.step([0.2, 0.2, 0.2])
        joints = rig.step(velocity, names)
        assert nanoseconds(joints.header.stamp) == nanoseconds(before.header.stamp) + TICK_NS
        np.testing.assert_array_equal(joints.velocity, np.zeros(3))
        np.testing.assert_array_equal(joints.position, before.position)
        status = rig.diagnosis("commands")
        assert status.level == DiagnosticStatus.WARN
        assert_one_sentence(status.message, reason)
        assert rig.diagnosed("commands", "refused") == count
        # The stack goes on.
        np.testing.assert_array_equal(rig.step([0.3, 0.2, 0.1]).velocity, [0.3, 0.2, 0.1])
        assert rig.diagnosis("commands").level == DiagnosticStatus.OK


@pytest.mark.parametrize(
    ("velocity", "names", "reason"),
    [BAD_COMMANDS["NaN"], BAD_COMMANDS["unknown joint"]],
    ids=["NaN", "unknown joint"],
)
def test_a_bad_command_is_logged(
    harness: Harness, velocity: list[float], names: list[str], reason: str
) -> None:
    rig = Rig(harness)
    rig.step(velocity, names)
    rig.wait_for_log(reason)


def test_joints_that_are_not_named_stay_at_rest(harness: Harness) -> None:
    rig = Rig(harness)
    rig.step([0.3, 0.3, 0.3])
    np.testing.assert_array_equal(rig.step([0.2], ["slider_2"]).velocity, [0, 0.2, 0])
    np.testing.assert_array_equal(rig.step([0.1], ["slider_2"]).velocity, [0, 0.1, 0])
    joints = rig.step([0.5, -0.5], ["slider_3", "slider_1"])
    np.testing.assert_array_equal(joints.velocity, [-0.5, 0, 0.5])
    np.testing.assert_array_equal(rig.step([], []).velocity, np.zeros(3))
    assert rig.diagnosed("commands", "refused") == 0


def test_joints_go_by_name_and_not_by_place(harness: Harness) -> None:
    rig = Rig(harness)
    rng = np.random.default_rng(2)
    for _ in range(6):
        wanted = dict(zip(SLIDERS, rng.uniform(-0.5, 0.5, 3), strict=True))
        names = [str(name) for name in rng.permutation(SLIDERS)]
        joints = rig.step([wanted[name] for name in names], names)
        assert dict(zip(joints.name, joints.velocity, strict=True)) == wanted


def test_positions_and_efforts_of_a_command_are_not_looked_at(harness: Harness) -> None:
    rig = Rig(harness)
    joints = rig.step([0.1, 0.2, 0.3], position=[math.nan], effort=[math.inf] * 5)
    np.testing.assert_array_equal(joints.velocity, [0.1, 0.2, 0.3])
    assert rig.diagnosed("commands", "refused") == 0


def test_rates_are_limited_as_the_urdf_says_and_counted(harness: Harness) -> None:
    rig = Rig(harness)
    joints = rig.step([1.0, -5.0, RATE_LIMIT])
    np.testing.assert_array_equal(joints.velocity, [RATE_LIMIT, -RATE_LIMIT, RATE_LIMIT])
    np.testing.assert_allclose(joints.position, np.array([1, -1, 1]) * RATE_LIMIT * TICK)
    status = rig.diagnosis("actuators")
    assert status.level == DiagnosticStatus.WARN
    counts = {pair.key: int(pair.value) for pair in status.values}
    assert counts == {
        "rate_limited.slider_1": 1,
        "rate_limited.slider_2": 1,
        "rate_limited.slider_3": 0,
        "stroke_limited.slider_1": 0,
        "stroke_limited.slider_2": 0,
        "stroke_limited.slider_3": 0,
    }
    rig.wait_for_log("slider_1")
    rig.step([0.1, 0.1, 0.1])
    assert rig.diagnosis("actuators").level == DiagnosticStatus.OK


def test_strokes_are_limited_as_the_urdf_says_and_counted(harness: Harness) -> None:
    rig = Rig(harness, {"initial_joint_positions": [2.48, -2.48, 0.0]})
    joints = rig.step([0.6, -0.5, 0.1])
    # 0.02 m are left, in 0.05 s.
    np.testing.assert_allclose(joints.velocity, [0.4, -0.4, 0.1], rtol=1e-12)
    np.testing.assert_allclose(joints.position, [STROKE, -STROKE, 0.005], rtol=1e-14)
    joints = rig.step([0.6, 0.5, 0.1])
    np.testing.assert_allclose(joints.velocity, [0.0, 0.5, 0.1], atol=1e-12)
    np.testing.assert_allclose(joints.position, [STROKE, -STROKE + 0.025, 0.01], rtol=1e-14)
    assert rig.diagnosed("actuators", "stroke_limited.slider_1") == 2
    assert rig.diagnosed("actuators", "stroke_limited.slider_2") == 1
    assert rig.diagnosed("actuators", "stroke_limited.slider_3") == 0
    assert rig.diagnosed("actuators", "rate_limited.slider_1") == 0


# -- momentum ---------------------------------------------------------------------------------


def test_a_robot_with_linear_momentum_drifts_at_p_over_m(harness: Harness) -> None:
    p = np.array([1.6, -3.2, 0.8])
    rig = Rig(harness, {"linear_momentum": p.tolist(), "initial_position": [5.0, 0.0, 0.0]})
    for _ in range(20):
        rig.step([0.0, 0.0, 0.0])
    harness.settle(rig.probe)
    for k, odom in enumerate(rig.probe.messages["odom"]):
        position, quaternion = pose_of(odom)
        np.testing.assert_allclose(position, [5, 0, 0] + p / MASS * k * TICK, atol=1e-13)
        np.testing.assert_allclose(quaternion, [0, 0, 0, 1], atol=1e-14)
        np.testing.assert_allclose(twist_of(odom)[0], p / MASS, rtol=1e-13)
    for message in rig.probe.messages["momentum"]:
        np.testing.assert_allclose(message.data[:3], p, rtol=1e-13)
        assert message.data[6] == pytest.approx(p @ p / (2 * MASS), rel=1e-12)


def test_a_robot_with_angular_momentum_turns_about_a_principal_axis(harness: Harness) -> None:
    # At the shape zero the point masses stand at the origin: I_zz is the base's.
    rig = Rig(harness, {"angular_momentum": [0.0, 0.0, 0.75]})
    for _ in range(20):
        rig.step([0.0, 0.0, 0.0])
    harness.settle(rig.probe)
    for k, odom in enumerate(rig.probe.messages["odom"]):
        _, quaternion = pose_of(odom)
        turned = Rotation.from_quat(quaternion).as_rotvec()
        np.testing.assert_allclose(turned, [0, 0, 0.75 / 1.5 * k * TICK], atol=1e-11)


def test_published_momentum_is_constant_while_the_shape_moves(harness: Harness) -> None:
    p, L = [0.5, 1.0, -0.25], [0.1, -0.4, 0.3]
    rig = Rig(harness, {"linear_momentum": p, "angular_momentum": L})
    rng = np.random.default_rng(3)
    for _ in range(20):
        rig.step(rng.uniform(-0.7, 0.7, 3).tolist())
    harness.settle(rig.probe)
    for k, message in enumerate(rig.probe.messages["momentum"]):
        np.testing.assert_allclose(message.data[:6], p + L, atol=1e-13)
        by_pinocchio, energy = momentum_by_pinocchio(
            "sliding_masses", rig.probe.messages["odom"][k], rig.probe.messages["joint_states"][k]
        )
        np.testing.assert_allclose(by_pinocchio, p + L, atol=1e-12)
        assert message.data[6] == pytest.approx(energy, rel=1e-11)
    assert rig.diagnosed("momentum", "linear_change") < 1e-12
    assert rig.diagnosed("momentum", "angular_change") < 1e-12


# -- services ---------------------------------------------------------------------------------


def test_reset_brings_the_initial_state_back_and_time_goes_on(harness: Harness) -> None:
    rig = Rig(harness, {"initial_joint_positions": [0.1, 0.2, 0.3], "initial_position": [1, 2, 3]})
    for _ in range(3):
        rig.step([0.5, 0.5, -0.5])
    assert pose_of(rig.probe.last("odom"))[0].tolist() != [1, 2, 3]
    before = rig.now_ns
    answer = rig.trigger("plant/reset")
    assert answer.success
    joints = rig.wait("joint_states", 5)
    np.testing.assert_array_equal(joints.position, [0.1, 0.2, 0.3])
    np.testing.assert_array_equal(joints.velocity, np.zeros(3))
    np.testing.assert_array_equal(pose_of(rig.probe.last("odom"))[0], [1, 2, 3])
    np.testing.assert_array_equal(np.concatenate(twist_of(rig.probe.last("odom"))), np.zeros(6))
    assert nanoseconds(joints.header.stamp) >= before
    joints = rig.step([0.5, 0.0, 0.0])
    assert nanoseconds(joints.header.stamp) > before
    np.testing.assert_allclose(joints.position, [0.125, 0.2, 0.3])


def test_pause_stops_time_until_it_is_taken_back(harness: Harness) -> None:
    rig = Rig(harness)
    rig.step([0.1, 0.0, 0.0])
    answer = rig.pause(True)
    assert (answer.success, answer.message) == (True, "paused")
    rig.send([0.2, 0.0, 0.0])
    harness.settle(rig.probe)
    assert rig.probe.count("joint_states") == 2
    answer = rig.pause(False)
    assert (answer.success, answer.message) == (True, "running")
    # The command that came meanwhile is carried out, once.
    joints = rig.wait("joint_states", 3)
    np.testing.assert_array_equal(joints.velocity, [0.2, 0.0, 0.0])
    np.testing.assert_array_equal(rig.step([0.3, 0, 0]).velocity, [0.3, 0.0, 0.0])
    harness.settle(rig.probe)
    assert rig.probe.count("joint_states") == 4
    assert rig.diagnosed("commands", "refused") == 0


def test_a_command_from_before_a_reset_is_forgotten(harness: Harness) -> None:
    rig = Rig(harness)
    rig.pause(True)
    rig.send([0.2, 0.0, 0.0])
    harness.settle(rig.probe)
    assert rig.trigger("plant/reset").success
    rig.wait("joint_states", 2)
    # The answer to the state that is shown now.
    rig.send([0.3, 0.0, 0.0])
    harness.settle(rig.probe)
    rig.pause(False)
    np.testing.assert_array_equal(rig.wait("joint_states", 3).velocity, [0.3, 0.0, 0.0])


def test_pause_without_a_command_changes_nothing(harness: Harness) -> None:
    rig = Rig(harness)
    for on in (False, True, True, False, False):
        assert rig.pause(on).success
    joints = rig.step([0.2, 0.0, 0.0])
    assert nanoseconds(joints.header.stamp) == TICK_NS
    harness.settle(rig.probe)
    assert rig.probe.count("joint_states") == 2


# -- lockstep with latecomers -----------------------------------------------------------------


def test_a_late_reader_gets_the_state_that_waits(harness: Harness) -> None:
    plant = harness.make(PlantNode, {"robot": "sliding_masses", "time_mode": "lockstep"})
    assert plant.is_active
    late = harness.probe(STATE)
    harness.spin_until(lambda: all(late.count(topic) for topic in STATE), "the waiting state")
    assert nanoseconds(late.last("joint_states").header.stamp) == 0
    # It is the same tick still, and goes on from it.
    publisher = late.create_publisher(JointState, "joint_commands", 10)
    harness.matched(publisher)
    publisher.publish(JointState(name=["slider_1"], velocity=[0.2]))
    harness.spin_until(
        lambda: nanoseconds(late.last("joint_states").header.stamp) > 0, "the next tick"
    )
    assert nanoseconds(late.last("joint_states").header.stamp) == TICK_NS


def test_a_reader_that_comes_during_a_pause_gets_the_state_after_it(harness: Harness) -> None:
    rig = Rig(harness)
    rig.pause(True)
    late = harness.probe(STATE, name="late")
    harness.connect()
    # Time for the plant to look for newcomers several times.
    harness.spin_for(0.35)
    rig.pause(False)
    harness.spin_until(lambda: late.count("joint_states"), "the waiting state after the pause")


# -- real time --------------------------------------------------------------------------------

REALTIME = {"time_mode": "realtime", "real_time_factor": 10.0, "command_timeout": 1.0}


def test_time_runs_at_the_real_time_factor(harness: Harness) -> None:
    rig = Rig(harness, {**REALTIME, "diagnostics_period": 0.0})
    rig.wait("/clock", 20)
    began = rig.probe.count("/clock")
    rig.wait("/clock", began + 120)
    clocks = [nanoseconds(m.clock) / 1e9 for m in rig.probe.messages["/clock"][began:]]
    arrivals = rig.probe.arrivals["/clock"][began:]
    factor = (clocks[-1] - clocks[0]) / (arrivals[-1] - arrivals[0])
    assert 5.0 < factor < 13.0
    np.testing.assert_allclose(np.diff(clocks), TICK)


def test_joints_come_to_rest_when_the_commander_falls_silent(harness: Harness) -> None:
    rig = Rig(harness, REALTIME)
    stamp = rig.now_ns
    rig.send([0.3, -0.2, 0.1])
    harness.spin_until(lambda: rig.probe.last("joint_states").velocity[0] == 0.3, "motion")
    harness.spin_until(lambda: rig.probe.last("joint_states").velocity[0] == 0.0, "rest")
    rest = nanoseconds(rig.probe.last("joint_states").header.stamp)
    # A tick carries the command for as long as it is not older than the timeout at its start.
    assert stamp + 1_000_000_000 < rest <= stamp + 1_000_000_000 + 2 * TICK_NS
    moving = [m for m in rig.probe.messages["joint_states"] if any(m.velocity)]
    for message in moving:
        np.testing.assert_array_equal(message.velocity, [0.3, -0.2, 0.1])
    at_rest = rig.probe.last("joint_states")
    np.testing.assert_allclose(
        at_rest.position, np.array([0.3, -0.2, 0.1]) * TICK * len(moving), rtol=1e-12
    )
    rig.wait_for_log("No command on 'joint_commands' for 1 s")
    assert rig.diagnosed("commands", "timeouts") == 1
    # It moves again with the next command, and is counted again.
    rig.send([0.3, 0.0, 0.0])
    harness.spin_until(lambda: rig.probe.last("joint_states").velocity[0] == 0.3, "motion again")
    harness.spin_until(lambda: rig.probe.last("joint_states").velocity[0] == 0.0, "rest again")
    assert rig.diagnosed("commands", "timeouts") == 2


def test_a_command_without_stamp_means_now(harness: Harness) -> None:
    rig = Rig(harness, REALTIME)
    harness.spin_until(lambda: rig.now_ns > 2_000_000_000, "two simulated seconds")
    rig.send([0.3, 0.0, 0.0], stamp_ns=0)
    harness.spin_until(lambda: rig.probe.last("joint_states").velocity[0] == 0.3, "motion")
    harness.spin_until(lambda: rig.probe.last("joint_states").velocity[0] == 0.0, "rest")
    assert rig.diagnosed("commands", "refused") == 0


@pytest.mark.parametrize(("offset_s", "word"), [(-2, "old"), (3, "ahead"), (10**9, "ahead")])
def test_real_time_refuses_commands_from_another_time(
    harness: Harness, offset_s: int, word: str
) -> None:
    rig = Rig(harness, REALTIME)
    harness.spin_until(lambda: rig.now_ns > 3_000_000_000, "three simulated seconds")
    rig.send([0.3, 0.3, 0.3], stamp_ns=rig.now_ns + offset_s * 10**9)
    rig.wait_for_log(word)
    rig.wait("joint_states", rig.probe.count("joint_states") + 3)
    assert not any(any(m.velocity) for m in rig.probe.messages["joint_states"])


def test_real_time_holds_the_last_good_command(harness: Harness) -> None:
    rig = Rig(harness, {**REALTIME, "command_timeout": 0.0})
    rig.send([0.1, 0.0, -0.1])
    harness.spin_until(lambda: rig.probe.last("joint_states").velocity[0] == 0.1, "motion")
    for count, (velocity, names, reason) in enumerate(BAD_COMMANDS.values(), start=1):
        rig.send(velocity, names)
        rig.wait_for_refusals(count)
        warned = [
            status.message
            for array in rig.probe.messages["/diagnostics"]
            for status in array.status
            if status.name == "/plant: commands" and status.level == DiagnosticStatus.WARN
        ]
        assert_one_sentence(warned[-1], "refused", reason)
    np.testing.assert_array_equal(rig.probe.last("joint_states").velocity, [0.1, 0.0, -0.1])


@pytest.mark.parametrize("timeout", [1.0, 0.0])
def test_reset_brings_moving_joints_to_rest_in_real_time(harness: Harness, timeout: float) -> None:
    rig = Rig(harness, {**REALTIME, "command_timeout": timeout})
    rig.send([0.3, 0.0, 0.0])
    harness.spin_until(lambda: rig.probe.last("joint_states").velocity[0] == 0.3, "motion")
    assert rig.trigger("plant/reset").success
    harness.spin_until(lambda: rig.probe.last("joint_states").position[0] == 0.0, "the start")
    rig.wait("joint_states", rig.probe.count("joint_states") + 5)
    assert rig.probe.last("joint_states").position[0] == 0.0


@pytest.mark.parametrize("timeout", [1.0, 0.0])
def test_joints_are_at_rest_after_a_deactivation(harness: Harness, timeout: float) -> None:
    rig = Rig(harness, {**REALTIME, "command_timeout": timeout})
    rig.send([0.3, 0.0, 0.0])
    harness.spin_until(lambda: rig.probe.last("joint_states").velocity[0] == 0.3, "motion")
    assert rig.plant.trigger_deactivate() is TransitionCallbackReturn.SUCCESS
    harness.settle(rig.probe)
    before = rig.probe.count("joint_states")
    rig.activate()
    rig.wait("joint_states", before + 6)
    # The first state is the one that was left.
    for message in rig.probe.messages["joint_states"][before + 1 :]:
        assert list(message.velocity) == [0.0] * 3


def test_deactivation_stops_time_and_publication(harness: Harness) -> None:
    rig = Rig(harness, REALTIME)
    rig.wait("joint_states", 5)
    assert rig.plant.trigger_deactivate() is TransitionCallbackReturn.SUCCESS
    harness.settle(rig.probe)
    before, stamp = rig.probe.count("joint_states"), rig.now_ns
    harness.spin_for(0.2)
    assert rig.probe.count("joint_states") == before
    rig.activate()
    rig.wait("joint_states", before + 3)
    stamps = [nanoseconds(m.header.stamp) for m in rig.probe.messages["joint_states"][before:]]
    assert stamps[:3] == [stamp, stamp + TICK_NS, stamp + 2 * TICK_NS]


def test_pause_stops_real_time_and_nothing_is_made_up_afterwards(harness: Harness) -> None:
    rig = Rig(harness, REALTIME)
    rig.wait("joint_states", 5)
    rig.pause(True)
    harness.settle(rig.probe)
    before = rig.probe.count("joint_states")
    harness.spin_for(0.2)
    assert rig.probe.count("joint_states") == before
    rig.pause(False)
    rig.wait("joint_states", before + 2)
    assert rig.diagnosed("commands", "deadlines_missed") == 0
    stamps = [nanoseconds(m.header.stamp) for m in rig.probe.messages["joint_states"]]
    assert set(np.diff(stamps)) == {TICK_NS}


def test_a_busy_machine_misses_deadlines_and_no_tick(harness: Harness) -> None:
    rig = Rig(harness, {**REALTIME, "real_time_factor": 100.0})

    def hog(_: Any) -> None:
        del rig.probe.react["odom"]
        began = time.monotonic()
        while time.monotonic() - began < 0.05:
            pass  # 100 ticks of wall time in which no callback runs.

    rig.wait("joint_states", 5)
    rig.probe.react["odom"] = hog
    harness.spin_until(
        lambda: (
            rig.probe.count("/diagnostics")
            and any(
                pair.key == "deadlines_missed" and int(pair.value) >= 50
                for pair in rig.probe.last("/diagnostics").status[0].values
            )
        ),
        "missed deadlines in the diagnostics",
    )
    stamps = [nanoseconds(m.header.stamp) for m in rig.probe.messages["joint_states"]]
    assert set(np.diff(stamps)) == {TICK_NS}


# -- managed life -----------------------------------------------------------------------------


def test_a_supervisor_can_take_the_plant_through_its_life(harness: Harness) -> None:
    plant = harness.make(
        PlantNode,
        {"robot": "sliding_masses", "time_mode": "lockstep", "autostart": False},
    )
    probe = harness.probe(STATE)
    change = probe.create_client(ChangeState, "plant/change_state")
    state = probe.create_client(GetState, "plant/get_state")

    def go(transition: int, expected: int) -> None:
        request = ChangeState.Request(transition=Transition(id=transition))
        assert harness.call(change, request).success
        assert harness.call(state, GetState.Request()).current_state.id == expected

    def step(publisher: Publisher) -> None:
        before = probe.count("joint_states")
        message = JointState(name=["slider_1"], velocity=[0.2])
        message.header.stamp = probe.last("joint_states").header.stamp
        publisher.publish(message)
        harness.spin_until(lambda: probe.count("joint_states") > before, "a step")

    for _ in range(2):
        go(Transition.TRANSITION_CONFIGURE, State.PRIMARY_STATE_INACTIVE)
        harness.connect()
        assert probe.count("odom") == 0
        go(Transition.TRANSITION_ACTIVATE, State.PRIMARY_STATE_ACTIVE)
        harness.spin_until(lambda: probe.count("joint_states"), "the first state")
        assert nanoseconds(probe.last("joint_states").header.stamp) == 0
        assert list(probe.last("joint_states").position) == [0.0] * 3
        publisher = probe.create_publisher(JointState, "joint_commands", 10)
        harness.connect()
        for _ in range(3):
            step(publisher)
        go(Transition.TRANSITION_DEACTIVATE, State.PRIMARY_STATE_INACTIVE)
        go(Transition.TRANSITION_CLEANUP, State.PRIMARY_STATE_UNCONFIGURED)
        harness.spin_until(lambda: not probe.count_publishers("odom"), "the end of odom")
        topics = ("/clock", "robot_description", "joint_states", "momentum", "/diagnostics")
        for topic in topics:
            assert probe.count_publishers(topic) == 0, topic
        assert probe.count_subscribers("joint_commands") == 0
        for kept in probe.messages.values():
            kept.clear()
    go(Transition.TRANSITION_UNCONFIGURED_SHUTDOWN, State.PRIMARY_STATE_FINALIZED)
    assert not plant.is_active


def test_a_deactivated_lockstep_plant_takes_no_command(harness: Harness) -> None:
    rig = Rig(harness)
    rig.plant.trigger_deactivate()
    rig.send([0.1, 0.1, 0.1])
    harness.settle(rig.probe)
    assert rig.probe.count("joint_states") == 1
    rig.activate()
    np.testing.assert_array_equal(rig.step([0.2, 0.0, 0.0]).velocity, [0.2, 0.0, 0.0])


def test_a_node_shuts_down_from_every_state(harness: Harness) -> None:
    for transitions in ((), ("configure",), ("configure", "activate")):
        plant = harness.make(
            PlantNode,
            {"robot": "sliding_masses"},
            name=f"plant_{len(transitions)}",
            autostart=False,
        )
        for name in transitions:
            getattr(plant, f"trigger_{name}")()
        assert plant.trigger_shutdown() is TransitionCallbackReturn.SUCCESS


# -- parameters -------------------------------------------------------------------------------

REFUSED: dict[str, tuple[dict[str, Any], tuple[str, ...]]] = {
    "no robot": ({"robot": ""}, ("robot",)),
    "unknown robot": ({"robot": "octopus"}, ("'robot'", "octopus", "sliding_masses")),
    "missing file": ({"robot": "nowhere/robot.urdf"}, ("'robot'", "nowhere/robot.urdf")),
    "broken description": ({"robot_description": "<robot"}, ("robot description",)),
    "robot of another type": ({"robot": 3}, ("'robot'",)),
    "joint positions of wrong length": (
        {"initial_joint_positions": [0.1, 0.2]},
        ("initial joint positions", "2", "slider_1, slider_2, slider_3"),
    ),
    "joint positions beyond stroke": (
        {"initial_joint_positions": [0.0, 0.0, 2.6]},
        ("initial position", "slider_3", "2.6", "2.5"),
    ),
    "joint positions not finite": (
        {"initial_joint_positions": [0.0, math.nan, 0.0]},
        ("initial joint positions",),
    ),
    "no tick rate": ({"tick_rate": 0.0}, ("'tick rate'", "0.001", "Hz")),
    "negative tick rate": ({"tick_rate": -20.0}, ("'tick rate'",)),
    "endless tick rate": ({"tick_rate": math.inf}, ("'tick rate'",)),
    "tick rate is not a number": ({"tick_rate": math.nan}, ("'tick rate'",)),
    "tick rate in words": ({"tick_rate": "fast"}, ("'tick rate'", "fast")),
    "tick rate is true": ({"tick_rate": True}, ("'tick rate'",)),
    "tick rate is a list": ({"tick_rate": [20.0]}, ("'tick rate'",)),
    "time mode": ({"time_mode": "foo"}, ("'time mode'", "foo", "realtime", "lockstep")),
    "actuation": ({"actuation": "magnets"}, ("'actuation'", "magnets", "velocity")),
    "real time factor": ({"real_time_factor": 0.0}, ("'real time factor'",)),
    "negative timeout": ({"command_timeout": -1.0}, ("'command timeout'", "s")),
    "integration step": ({"integration_step": -0.01}, ("'integration step'", "s")),
    "world frame is a number": ({"world_frame": 7}, ("'world frame'",)),
    "two coordinates": ({"initial_position": [1.0, 2.0]}, ("'initial position'", "3 numbers")),
    "zero quaternion": ({"initial_orientation": [0.0] * 4}, ("initial orientation",)),
    "three quaternion entries": (
        {"initial_orientation": [0.0, 0.0, 1.0]},
        ("'initial orientation'", "4 numbers"),
    ),
    "momentum not finite": ({"linear_momentum": [0.0, math.inf, 0.0]}, ("'linear momentum'",)),
    "momentum in words": ({"angular_momentum": ["a", "b", "c"]}, ("'angular momentum'",)),
    "end effector": ({"end_effector_frame": "claw"}, ("'end effector frame'", "claw", "mass_1")),
    "autostart is a number": ({"autostart": 1}, ("'autostart'", "true or false")),
}  # Words of names are compared without their underscores.


@pytest.mark.parametrize(("parameters", "mentions"), REFUSED.values(), ids=REFUSED)
def test_a_bad_parameter_is_refused_with_a_sentence_that_names_it(
    ros_context: rclpy.Context, parameters: dict[str, Any], mentions: tuple[str, ...]
) -> None:
    given = {"robot": "sliding_masses", "time_mode": "lockstep", **parameters}
    with pytest.raises(SpaceRobotError) as refusal:
        PlantNode(**construction(ros_context, given))
    plain = str(refusal.value).replace("_", " ")
    assert_one_sentence(plain, *(mention.replace("_", " ") for mention in mentions))


def test_a_whole_number_will_do_for_a_real_one(harness: Harness) -> None:
    rig = Rig(
        harness,
        {
            "tick_rate": 20,
            "initial_position": [1, 2, 3],
            "initial_joint_positions": [0, 1, 0],
            "linear_momentum": [16, 0, 0],
        },
    )
    kinds = {
        name: rig.plant.get_parameter(name).type_
        for name in ("tick_rate", "initial_position", "initial_joint_positions")
    }
    assert kinds == {
        "tick_rate": Parameter.Type.DOUBLE,
        "initial_position": Parameter.Type.DOUBLE_ARRAY,
        "initial_joint_positions": Parameter.Type.DOUBLE_ARRAY,
    }
    rig.step([0.0, 0.0, 0.0])
    np.testing.assert_allclose(pose_of(rig.probe.last("odom"))[0], [1.05, 2, 3], rtol=1e-14)


def test_parameters_are_described_and_fixed_while_the_plant_lives(harness: Harness) -> None:
    rig = Rig(harness)
    descriptor = rig.plant.describe_parameter("tick_rate")
    assert descriptor.read_only
    assert "Hz" in descriptor.description
    assert descriptor.floating_point_range[0].from_value == 0.001
    (result,) = rig.plant.set_parameters([Parameter("tick_rate", value=50.0)])
    assert not result.successful
    assert result.reason
    rig.step([0.0, 0.0, 0.0])
    assert rig.now_ns == TICK_NS


@pytest.mark.parametrize("name", ["sliding_masses.urdf", "the file", "the text"])
def test_a_robot_is_a_name_a_file_or_a_text(harness: Harness, tmp_path: Path, name: str) -> None:
    text = (URDF / "sliding_masses.urdf").read_text("utf-8").replace("slider_2", "boom")
    file = tmp_path / "mine.urdf"
    file.write_text(text, "utf-8")
    choose: dict[str, Callable[[], dict[str, str]]] = {
        "sliding_masses.urdf": lambda: {"robot": str(URDF / "sliding_masses.urdf")},
        "the file": lambda: {"robot": str(file)},
        "the text": lambda: {"robot": "octopus", "robot_description": text},
    }
    rig = Rig(harness, choose[name]())
    second = "slider_2" if name == "sliding_masses.urdf" else "boom"
    assert list(rig.probe.last("joint_states").name) == ["slider_1", second, "slider_3"]
