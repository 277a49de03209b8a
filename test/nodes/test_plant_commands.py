"""Commands of a plant: taken, limited, refused, and latched."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import WrenchStamped
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from support.bad_commands import BAD_COMMANDS
from support.control_loop import JOINTS
from support.odometry import pose_of, twist_of
from support.oracles import PinocchioOracle
from support.planner_flight import values_of
from support.plant_rig import STATE, TICK, TICK_NS, Rig
from support.ros_harness import Harness, nanoseconds
from support.sentences import assert_one_sentence

from spacerobot_ros.simulation.status import PlantState

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


REALTIME = {"time_mode": "realtime", "real_time_factor": 10.0, "command_timeout": 0.0}


def velocity(rig: Rig) -> float:
    return float(rig.probe.last("joint_states").velocity[0])


def wait_for_velocity(rig: Rig, wanted: float) -> None:
    rig.harness.spin_until(lambda: velocity(rig) == wanted, f"a velocity of {wanted} m/s")


def started(rig: Rig) -> int:
    """Return the time of a state after the first: a stamp of zero is none."""
    rig.harness.spin_until(lambda: rig.now_ns > 0, "a second state")
    return rig.now_ns


def assert_nothing_moves(rig: Rig, states: int = 5) -> None:
    before = rig.probe.count("joint_states")
    rig.wait("joint_states", before + states)
    assert not any(any(m.velocity) for m in rig.probe.messages["joint_states"][before + 1 :])


def assert_state(rig: Rig, state: PlantState) -> None:
    assert rig.plant.state is state


def test_a_second_commander_latches_a_fault_until_it_is_rearmed(harness: Harness) -> None:
    rig = Rig(harness, REALTIME)
    intruder = harness.probe({}, name="intruder")
    other = intruder.create_publisher(JointState, "joint_commands", 100)
    harness.connect()
    stamp = started(rig)
    rig.send([0.1, 0.0, 0.0], stamp_ns=stamp)
    wait_for_velocity(rig, 0.1)
    # Until the plant has counted its commanders, a repeated stamp is one commander's own.
    rig.harness.spin_until(
        lambda: (other.publish(command_at(stamp)), rig.diagnosed("commands", "refused"))[1],
        "a refusal",
    )
    wait_for_velocity(rig, 0.0)
    status = rig.diagnosis("commands")
    assert status.level == DiagnosticStatus.ERROR
    assert_one_sentence(status.message, "rearm", "is active", "2 nodes")
    rig.send([0.2, 0.0, 0.0])
    rig.wait_for_refusals(int(rig.diagnosed("commands", "refused")))
    assert_nothing_moves(rig)
    assert "is active" in rig.trigger("plant/rearm").message
    rig.send([0.2, 0.0, 0.0])
    wait_for_velocity(rig, 0.2)


def command_at(stamp_ns: int) -> JointState:
    message = JointState(name=["slider_1", "slider_2", "slider_3"], velocity=[0.1, 0.0, 0.0])
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 1_000_000_000)
    return message


@pytest.mark.parametrize("mode", ["realtime", "lockstep"])
def test_abort_holds_everything_until_rearm(harness: Harness, mode: str) -> None:
    rig = Rig(harness, {**REALTIME, "time_mode": mode})
    rig.send([0.3, 0.0, 0.0])
    wait_for_velocity(rig, 0.3)
    assert_state(rig, PlantState.RUNNING)
    assert rig.trigger("plant/abort").success
    assert_state(rig, PlantState.LATCHED)
    rig.send([0.3, 0.0, 0.0])
    wait_for_velocity(rig, 0.0)
    status = rig.diagnosis("commands")
    assert status.level == DiagnosticStatus.ERROR
    assert_one_sentence(status.message, "stopped on request")
    rig.pause(True)
    assert_state(rig, PlantState.PAUSED)
    rig.pause(False)
    assert_state(rig, PlantState.LATCHED)
    assert "stopped" in rig.trigger("plant/rearm").message
    # In real time no command is in force yet; lockstep waits for one.
    assert_state(rig, PlantState.RUNNING if mode == "lockstep" else PlantState.RESTING)
    rig.send([0.3, 0.0, 0.0])
    wait_for_velocity(rig, 0.3)
    assert "No fault" in rig.trigger("plant/rearm").message
    rig.plant.trigger_deactivate()
    assert_state(rig, PlantState.INACTIVE)


# -- efforts and wrenches ---------------------------------------------------------------------

MASS, MOTOR_TICK = 47.0, 0.02
STATUS = "plant/status"
URDF = Path(__file__).parents[2] / "urdf" / "planar_manipulator.urdf"


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

    def momentum(self) -> np.ndarray[Any, Any]:
        """Return linear over angular momentum (6,) of the last state, by Pinocchio."""
        self.harness.settle(self.probe)
        odom, joints = self.probe.last("odom"), self.probe.last("joint_states")
        oracle = PinocchioOracle(URDF.read_text("utf-8"), list(joints.name))
        r, quaternion = pose_of(odom)
        oracle.set_configuration(np.array(joints.position), quaternion, r)
        twist = np.concatenate(twist_of(odom))
        rates = np.array(joints.velocity)
        oracle.move(oracle.base_velocities(twist) + oracle.joint_velocities(rates))
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
