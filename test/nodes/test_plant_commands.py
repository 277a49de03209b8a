"""Commands of a plant: taken, limited, refused, and latched; what it publishes of its state."""

from __future__ import annotations

from typing import Any
from xml.etree import ElementTree

import numpy as np
import numpy.typing as npt
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped, WrenchStamped
from nav_msgs.msg import Odometry
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from support.control_loop import JOINTS, Loop
from support.oracles import PinocchioOracle
from support.planner_flight import values_of
from support.plant_rig import BAD_COMMANDS, SLIDERS, STATE, TICK, TICK_NS, Rig, pose_of, twist_of
from support.ros_harness import LATCHED, Harness, nanoseconds
from support.sentences import assert_one_sentence
from visualization_msgs.msg import Marker, MarkerArray

from spacerobot_ros.resources import robot_file

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
    assert not rig.probe.diagnoses("plant: timing"), "lockstep has no deadlines"


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
    rig.send([0.2, 0.0, 0.0], stamp_ns=0)
    # The answer to the state that is shown now.
    rig.send([0.3, 0.0, 0.0])
    harness.settle(rig.probe)
    rig.pause(False)
    np.testing.assert_array_equal(rig.wait("joint_states", 3).velocity, [0.3, 0.0, 0.0])


REALTIME = {"time_mode": "realtime", "real_time_factor": 10.0, "command_timeout": 0.0}


def wait_for_velocity(rig: Rig, wanted: float) -> None:
    rig.harness.spin_until(
        lambda: rig.probe.last("joint_states").velocity[0] == wanted, f"{wanted} m/s"
    )


def state_of(rig: Rig) -> str:
    return rig.plant.state.value


def test_a_second_commander_latches_a_fault_until_it_is_rearmed(harness: Harness) -> None:
    rig = Rig(harness, REALTIME)
    intruder = harness.probe({}, name="intruder")
    other = intruder.create_publisher(JointState, "joint_commands", 100)
    harness.connect()
    # A stamp of zero is none.
    harness.spin_until(lambda: rig.now_ns > 0, "a second state")
    command = JointState(name=SLIDERS, velocity=[0.1, 0.0, 0.0])
    command.header.stamp = rig.probe.last("joint_states").header.stamp
    rig.commands.publish(command)
    wait_for_velocity(rig, 0.1)
    # Until the plant has counted its commanders, a repeated stamp is one commander's own.
    harness.spin_until(
        lambda: (other.publish(command), rig.diagnosed("commands", "refused"))[1], "a refusal"
    )
    wait_for_velocity(rig, 0.0)
    status = rig.diagnosis("commands")
    assert status.level == DiagnosticStatus.ERROR
    assert_one_sentence(status.message, "rearm", "is active", "2 nodes")
    rig.send([0.2, 0.0, 0.0])
    rig.wait_for_refusals(int(rig.diagnosed("commands", "refused")))
    before = rig.probe.count("joint_states")
    rig.wait("joint_states", before + 5)
    assert not any(any(m.velocity) for m in rig.probe.messages["joint_states"][before + 1 :])
    assert "is active" in rig.trigger("plant/rearm").message
    rig.send([0.2, 0.0, 0.0])
    wait_for_velocity(rig, 0.2)


@pytest.mark.parametrize("mode", ["realtime", "lockstep"])
def test_abort_holds_everything_until_rearm(
    harness: Harness, mode: str, capfd: pytest.CaptureFixture[str]
) -> None:
    rig = Rig(harness, {**REALTIME, "time_mode": mode})
    rig.send([0.3, 0.0, 0.0])
    wait_for_velocity(rig, 0.3)
    assert state_of(rig) == "running"
    assert rig.trigger("plant/abort").success
    assert state_of(rig) == "latched"
    rig.send([0.3, 0.0, 0.0])
    wait_for_velocity(rig, 0.0)
    status = rig.diagnosis("commands")
    rig.wait_for_refusals(1)
    assert "was refused" not in capfd.readouterr().err, "the stop itself is logged"
    assert status.level == DiagnosticStatus.ERROR
    assert_one_sentence(status.message, "stopped on request")
    rig.pause(True)
    assert state_of(rig) == "paused"
    rig.pause(False)
    assert state_of(rig) == "latched"
    assert "stopped" in rig.trigger("plant/rearm").message
    # In real time no command is in force yet; lockstep waits for one.
    assert state_of(rig) == ("running" if mode == "lockstep" else "resting")
    rig.send([0.3, 0.0, 0.0])
    wait_for_velocity(rig, 0.3)
    assert "No fault" in rig.trigger("plant/rearm").message
    rig.plant.trigger_deactivate()
    assert state_of(rig) == "inactive"


# -- efforts and wrenches ---------------------------------------------------------------------

MASS, MOTOR_TICK = 47.0, 0.02
STATUS = "plant/status"


def moving(odom: Odometry, joints: JointState) -> PinocchioOracle:
    """Return the arm in a published state."""
    urdf = robot_file("planar_manipulator").read_text("utf-8")
    oracle = PinocchioOracle(urdf, list(joints.name))
    r, quaternion = pose_of(odom)
    oracle.set_configuration(np.array(joints.position), quaternion, r)
    twist, rates = np.concatenate(twist_of(odom)), np.array(joints.velocity)
    oracle.move(oracle.base_velocities(twist) + oracle.joint_velocities(rates))
    return oracle


class Manipulator(Rig):
    """A plant in lockstep of an arm that may be pushed, too."""

    def __init__(self, harness: Harness, *, wrenches: bool = True, **parameters: Any) -> None:
        given = {"robot": "planar_manipulator", "tick_rate": 1 / MOTOR_TICK, **parameters}
        super().__init__(harness, given, topics={STATUS: DiagnosticStatus}, activate=False)
        if wrenches:
            self.wrenches = self.probe.create_publisher(WrenchStamped, "base_wrench", 100)
            harness.connect()
        self.activate()

    def wait_for_state(self, count: int) -> None:
        for topic in ("odom", "joint_states"):
            self.wait(topic, count)

    def push(self, force: float) -> None:
        message = WrenchStamped(header=self.probe.last("joint_states").header)
        message.header.frame_id = "base_link"
        message.wrench.force.x = force
        self.wrenches.publish(message)

    def turn(self, *efforts: float) -> None:
        self.send([], JOINTS, effort=list(efforts))

    @property
    def ticks(self) -> int:
        """States seen so far, when nothing is under way."""
        self.harness.settle(self.probe)
        return self.probe.count("joint_states")

    @property
    def speed(self) -> float:
        return float(self.probe.last("odom").twist.twist.linear.x)

    @property
    def actuation(self) -> str:
        return values_of(self.probe.last(STATUS))["actuation"]

    def momentum(self) -> npt.NDArray[np.float64]:
        """Return linear over angular momentum (6,) of the last state, by Pinocchio."""
        self.harness.settle(self.probe)
        oracle = moving(self.probe.last("odom"), self.probe.last("joint_states"))
        return np.concatenate(oracle.momentum_W()[:2])


@pytest.mark.parametrize("first", ["wrench", "efforts"])
def test_a_lockstep_plant_waits_for_both_commands(harness: Harness, first: str) -> None:
    rig = Manipulator(harness, actuation="effort")
    sends = [lambda: rig.push(4.7), lambda: rig.turn(0.0, 0.0)]
    if first == "efforts":
        sends.reverse()
    for tick in range(1, 4):
        sends[0]()
        assert rig.ticks == tick
        sends[1]()
        rig.wait_for_state(tick + 1)
    # All links lie along the force: no more than the whole mass is pushed.
    assert rig.speed == pytest.approx(3 * MOTOR_TICK * 4.7 / MASS, rel=1e-12)


def test_a_lockstep_plant_does_not_wait_for_a_commander_that_is_gone(harness: Harness) -> None:
    rig = Manipulator(harness, actuation="effort")
    rig.turn(1.0, 0.0)
    assert rig.ticks == 1
    rig.probe.destroy_publisher(rig.wrenches)
    harness.spin_until(lambda: rig.probe.count("joint_states") > 1, "a step", 3.0)


REST = [0.0, 0.0]


def test_velocities_decide_and_rest_does_not(harness: Harness) -> None:
    rig = Manipulator(harness)
    for _ in range(3):
        rig.step(REST, JOINTS, position=REST, effort=REST)
    assert rig.actuation == "auto"
    rig.step([0.2, -0.3], JOINTS, position=REST, effort=REST)
    np.testing.assert_allclose(rig.momentum(), 0.0, atol=1e-12)
    assert rig.actuation == "velocity"
    assert rig.probe.last("joint_states").velocity.tolist() == [0.2, -0.3]
    # A wrench comes too late: servos take none.
    rig.push(5.0)
    rig.step([0.1, 0.0], JOINTS)
    np.testing.assert_allclose(rig.momentum(), 0.0, atol=1e-12)


@pytest.mark.parametrize("drift", [0.0, 2.5])
def test_a_wrench_decides_and_pushes_by_newton(harness: Harness, drift: float) -> None:
    rig = Manipulator(harness, linear_momentum=[0.0, drift, 0.0])
    for _ in range(4):
        rig.step(REST, JOINTS, effort=REST)
    before = rig.momentum()
    np.testing.assert_allclose(before[:3], [0.0, drift, 0.0], atol=1e-12)
    at = pose_of(rig.probe.last("odom"))[0]
    for _ in range(10):
        rig.push(4.0)
        rig.step([], JOINTS, effort=REST)
    gained = (rig.momentum() - before)[:3]
    assert rig.actuation == "effort"
    # The push turns the base a little, and so itself.
    assert gained[0] == pytest.approx(4.0 * 10 * MOTOR_TICK, rel=1e-3)
    assert abs(gained[1]) < 0.05
    moved = pose_of(rig.probe.last("odom"))[0] - at
    assert moved[1] == pytest.approx(drift / 47.0 * 10 * MOTOR_TICK, abs=2e-3)


def test_faults_from_before_the_decision_stay(harness: Harness) -> None:
    rig = Manipulator(harness, wrenches=False)
    faults = rig.probe.create_publisher(String, "fault_injection", 10)
    harness.matched(faults)
    faults.publish(String(data="joint_stuck elbow"))
    heard = rig.probe.messages[STATUS]
    harness.spin_until(
        lambda: heard and "joint_stuck" in values_of(heard[-1])["faults"], "the fault"
    )
    for _ in range(5):
        rig.step([], JOINTS, effort=[3.0, 3.0])
    assert rig.actuation == "effort"
    shoulder, elbow = rig.probe.last("joint_states").velocity
    assert abs(shoulder) > 1e-3
    assert elbow == 0.0


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
    # With the pairs of the SRDF beside it.
    received = ElementTree.fromstring(late.last("robot_description").data)
    carried = received.findall("disable_collisions")
    assert [dict(each.attrib) for each in carried] == [
        {"link1": f"mass_{i}", "link2": f"mass_{j}"} for i, j in ((1, 2), (1, 3), (2, 3))
    ]
    for each in carried:
        received.remove(each)
    text = ElementTree.tostring(received, encoding="unicode")
    file = robot_file("sliding_masses").read_text("utf-8")
    assert ElementTree.canonicalize(text, strip_text=True) == ElementTree.canonicalize(
        file, strip_text=True
    )


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
    for k in range(6):
        odom, joints = (rig.probe.messages[t][k] for t in ("odom", "joint_states"))
        published = np.array(rig.probe.messages["momentum"][k].data)
        oracle = moving(odom, joints)
        p, L, energy = oracle.momentum_W()
        np.testing.assert_allclose(published[:6], [*p, *L], atol=1e-12)
        np.testing.assert_allclose(published[:6], [1, -2, 0.5, 0.2, 0.1, -3], atol=1e-12)
        assert published[6] == pytest.approx(energy, rel=1e-12)
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
    assert [m.ns for m in spheres] == ["robot"] * 3
    odom, joints = rig.probe.last("odom"), rig.probe.last("joint_states")
    r, quaternion = pose_of(odom)
    for axis, marker in enumerate(spheres):
        place = r + Rotation.from_quat(quaternion).apply(np.eye(3)[axis] * joints.position[axis])
        p = marker.pose.position
        np.testing.assert_allclose([p.x, p.y, p.z], place, atol=1e-14)
        assert marker.header.frame_id == "world"


# -- lockstep with latecomers -----------------------------------------------------------------


def test_a_reader_that_comes_during_a_pause_gets_the_state_after_it(harness: Harness) -> None:
    rig = Rig(harness)
    rig.pause(True)
    late = harness.probe(STATE, name="late")
    harness.connect()
    # Time for the plant to look for newcomers several times.
    harness.spin_for(0.35)
    rig.pause(False)
    harness.spin_until(lambda: late.count("joint_states"), "the waiting state after the pause")


def test_a_status_is_published_before_the_states_that_it_is_true_of(harness: Harness) -> None:
    rig = Rig(harness, topics={"plant/status": DiagnosticStatus})
    rig.step([0.1, 0.0, 0.0])
    harness.settle(rig.probe)
    # From here on: right after discovery the order of topics is not kept.
    before = len(rig.probe.order)
    rig.plant.trigger_deactivate()
    rig.activate()
    rig.trigger("plant/reset")
    rig.wait("odom", 4)
    states = [t for t in rig.probe.order[before:] if t in ("plant/status", "odom")]
    assert states == ["plant/status", "plant/status", "odom", "plant/status", "odom"]


CRATE = """<robot name="crate"><link name="world"/><link name="crate"><collision><geometry>
  <box size="0.2 0.3 0.4"/></geometry></collision></link><joint name="held" type="fixed">
  <parent link="world"/><child link="crate"/><origin xyz="0.1 0 0"/></joint></robot>"""


def test_a_contact_is_published_and_ends_with_its_obstacle(harness: Harness) -> None:
    """The robot has no pair of links that may touch: without the crate nothing is measured."""
    topics = dict.fromkeys(("plant/status", "clearance", "events"), DiagnosticStatus)
    rig = Rig(harness, {"clearance_period": 2 * TICK}, topics=topics)
    obstacles = rig.probe.create_publisher(String, "obstacles", LATCHED)
    harness.connect()

    def contacts() -> str:
        return values_of(rig.probe.last("plant/status")).get("contacts", "")

    obstacles.publish(String(data=CRATE))
    harness.settle(rig.probe)
    for _ in range(4):
        rig.step([0.01, 0.02, -0.01])
    harness.spin_until(lambda: "crate" in contacts(), "a contact")
    near = rig.probe.last("clearance")
    assert (near.level, values_of(near)["second"]) == (DiagnosticStatus.ERROR, "crate")
    events = [values_of(event) for event in rig.probe.messages["events"]]
    assert {each["second"] for each in events if each["event"] == "contact"} == {"crate"}
    obstacles.publish(String(data=""))
    harness.spin_until(lambda: not contacts(), "its end")


# -- states of others -------------------------------------------------------------------------


def test_beside_another_robot_a_controller_sees_every_pose(harness: Harness) -> None:
    """The other's joint_states come between odom and joint_states, with the same stamp."""
    loop = Loop(harness)
    stranger = loop.probe.create_publisher(JointState, "joint_states", 10)
    harness.matched(stranger)
    alone = loop.answer()
    send = loop.odom.publish
    for number in range(3):

        def publish(message: Odometry, late: int = number % 2) -> None:
            send(message)
            wing = JointState(header=message.header, name=["wing"])
            wing.position = wing.velocity = wing.effort = [0.5]
            wing.header.stamp.nanosec += late
            stranger.publish(wing)

        loop.odom.publish = publish
        beside = loop.answer()
        np.testing.assert_array_equal(beside[0], alone[0])
        np.testing.assert_array_equal(beside[1], alone[1])
