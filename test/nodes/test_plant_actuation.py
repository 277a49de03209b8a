"""Plants of motors and thrusters, and plants whose first command decides what they are."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import WrenchStamped
from nav_msgs.msg import Odometry
from rclpy.lifecycle import TransitionCallbackReturn
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from support.control_loop import JOINTS
from support.odometry import pose_of, twist_of
from support.oracles import PinocchioOracle
from support.planner_flight import values_of
from support.ros_harness import Harness

from spacerobot_ros.nodes import PlantNode

MASS = 47.0
URDF = Path(__file__).parents[2] / "urdf" / "planar_manipulator.urdf"


class Effort:
    """A plant under efforts in lockstep, and a probe that commands it."""

    def __init__(self, harness: Harness, *, wrench: bool) -> None:
        self.harness = harness
        self.plant = harness.make(
            PlantNode,
            {
                "robot": "planar_manipulator",
                "actuation": "effort",
                "time_mode": "lockstep",
                "tick_rate": 100.0,
                "diagnostics_period": 0.01,
            },
            name="plant",
            autostart=False,
        )
        self.probe = harness.probe(
            {"odom": Odometry, "joint_states": JointState, "/diagnostics": DiagnosticArray}
        )
        self.efforts = self.probe.create_publisher(JointState, "joint_commands", 100)
        self.wrenches: Any = None
        if wrench:
            self.wrenches = self.probe.create_publisher(WrenchStamped, "base_wrench", 100)
        assert self.plant.trigger_configure() is TransitionCallbackReturn.SUCCESS
        harness.connect()
        assert self.plant.trigger_activate() is TransitionCallbackReturn.SUCCESS
        self.wait(1)

    def wait(self, count: int) -> None:
        self.harness.spin_until(
            lambda: all(self.probe.count(topic) >= count for topic in self.probe.messages),
            f"state {count}",
        )

    @property
    def ticks(self) -> int:
        """States seen so far, when nothing is under way."""
        self.harness.settle(self.probe)
        return self.probe.count("joint_states")

    def stamped(self, message: Any) -> Any:
        message.header.stamp = self.probe.last("joint_states").header.stamp
        return message

    def push(self, force: float, frame: str = "base_link") -> None:
        message = self.stamped(WrenchStamped())
        message.header.frame_id = frame
        message.wrench.force.x = force
        self.wrenches.publish(message)

    def turn(self, *efforts: float) -> None:
        self.efforts.publish(self.stamped(JointState(name=JOINTS, effort=list(efforts))))

    @property
    def speed(self) -> float:
        return float(self.probe.last("odom").twist.twist.linear.x)

    def diagnosed(self, what: str) -> dict[str, str]:
        (status,) = (
            s for s in self.probe.last("/diagnostics").status if s.name == f"plant: {what}"
        )
        return {pair.key: pair.value for pair in status.values}


@pytest.mark.parametrize("first", ["wrench", "efforts"])
def test_a_lockstep_plant_waits_for_both_commands(harness: Harness, first: str) -> None:
    rig = Effort(harness, wrench=True)
    sends = [lambda: rig.push(4.7), lambda: rig.turn(0.0, 0.0)]
    if first == "efforts":
        sends.reverse()
    for tick in range(1, 4):
        sends[0]()
        assert rig.ticks == tick
        sends[1]()
        rig.wait(tick + 1)
    # All links lie along the force: no more than the whole mass is pushed.
    assert rig.speed == pytest.approx(3 * 0.01 * 4.7 / MASS, rel=1e-12)


def test_a_lockstep_plant_does_not_wait_for_a_commander_that_is_gone(harness: Harness) -> None:
    rig = Effort(harness, wrench=True)
    rig.turn(1.0, 0.0)
    assert rig.ticks == 1
    rig.probe.destroy_publisher(rig.wrenches)
    harness.spin_until(lambda: rig.probe.count("joint_states") > 1, "a step", 3.0)


def test_thrusters_are_off_when_their_commander_is_gone(harness: Harness) -> None:
    rig = Effort(harness, wrench=True)
    rig.push(4.7)
    rig.turn(0.0, 0.0)
    rig.wait(2)
    speed = rig.speed
    rig.probe.destroy_publisher(rig.wrenches)
    # The plant looks round for commanders every tenth of a second.
    harness.spin_for(0.5)
    rig.turn(0.0, 0.0)
    rig.wait(3)
    assert rig.speed == pytest.approx(speed, rel=1e-12)


TICK = 0.02
STATUS = "plant/status"


class Plant:
    """A plant in lockstep with nothing but a robot, and a probe that commands it."""

    def __init__(self, harness: Harness, *, wrenches: bool = True, **parameters: Any) -> None:
        self.harness = harness
        given = {"robot": "planar_manipulator", "time_mode": "lockstep", "tick_rate": 1 / TICK}
        self.plant = harness.make(PlantNode, {**given, **parameters}, name="plant", autostart=False)
        self.probe = harness.probe(
            {"odom": Odometry, "joint_states": JointState, STATUS: DiagnosticStatus},
            latched=(STATUS,),
        )
        self.joints = self.probe.create_publisher(JointState, "joint_commands", 100)
        self.wrenches: Any = None
        if wrenches:
            self.wrenches = self.probe.create_publisher(WrenchStamped, "base_wrench", 100)
        self.faults = self.probe.create_publisher(String, "fault_injection", 10)
        assert self.plant.trigger_configure() is TransitionCallbackReturn.SUCCESS
        harness.connect()
        assert self.plant.trigger_activate() is TransitionCallbackReturn.SUCCESS
        self.wait(1)

    def wait(self, count: int) -> None:
        topics = ("odom", "joint_states")
        self.harness.spin_until(
            lambda: all(self.probe.count(topic) >= count for topic in topics), f"state {count}"
        )

    @property
    def actuation(self) -> str:
        return values_of(self.probe.last(STATUS))["actuation"]

    def step(self, *, force: float | None = None, **arrays: list[float]) -> None:
        """Send commands for the present state, and wait for the next one."""
        state = self.probe.last("joint_states")
        count = self.probe.count("joint_states")
        wrench = WrenchStamped(header=state.header)
        wrench.header.frame_id = ""
        wrench.wrench.force.x = force or 0.0
        if force is not None:
            self.wrenches.publish(wrench)
        self.joints.publish(JointState(header=state.header, name=state.name, **arrays))
        self.wait(count + 1)

    def momentum(self) -> np.ndarray[Any, Any]:
        """Return linear over angular momentum (6,) of the last state, by Pinocchio."""
        odom, joints = self.probe.last("odom"), self.probe.last("joint_states")
        oracle = PinocchioOracle(URDF.read_text("utf-8"), list(joints.name))
        r, quaternion = pose_of(odom)
        oracle.set_configuration(np.array(joints.position), quaternion, r)
        twist = np.concatenate(twist_of(odom))
        rates = np.array(joints.velocity)
        oracle.move(oracle.base_velocities(twist) + oracle.joint_velocities(rates))
        return np.concatenate(oracle.momentum_W()[:2])


def test_velocities_decide_and_rest_does_not(harness: Harness) -> None:
    plant = Plant(harness)
    zeros = [0.0, 0.0]
    for _ in range(3):
        plant.step(position=zeros, velocity=zeros, effort=zeros)
    assert plant.actuation == "auto"
    plant.step(position=zeros, velocity=[0.2, -0.3], effort=zeros)
    harness.settle(plant.probe)
    assert plant.actuation == "velocity"
    assert plant.probe.last("joint_states").velocity.tolist() == [0.2, -0.3]
    np.testing.assert_allclose(plant.momentum(), 0.0, atol=1e-12)
    # A wrench comes too late: servos take none.
    plant.step(force=5.0, velocity=[0.1, 0.0])
    np.testing.assert_allclose(plant.momentum(), 0.0, atol=1e-12)


@pytest.mark.parametrize("drift", [0.0, 2.5])
def test_a_wrench_decides_and_pushes_by_newton(harness: Harness, drift: float) -> None:
    plant = Plant(harness, linear_momentum=[0.0, drift, 0.0])
    zeros = [0.0, 0.0]
    for _ in range(4):
        plant.step(velocity=zeros, effort=zeros)
    before = plant.momentum()
    np.testing.assert_allclose(before[:3], [0.0, drift, 0.0], atol=1e-12)
    at = pose_of(plant.probe.last("odom"))[0]
    for _ in range(10):
        plant.step(force=4.0, effort=zeros)
    harness.settle(plant.probe)
    assert plant.actuation == "effort"
    gained = (plant.momentum() - before)[:3]
    # The push turns the base a little, and so itself.
    assert gained[0] == pytest.approx(4.0 * 10 * TICK, rel=1e-3)
    assert abs(gained[1]) < 0.05
    moved = pose_of(plant.probe.last("odom"))[0] - at
    assert moved[1] == pytest.approx(drift / 47.0 * 10 * TICK, abs=2e-3)


def test_faults_from_before_the_decision_stay(harness: Harness) -> None:
    plant = Plant(harness, wrenches=False)
    plant.faults.publish(String(data="joint_stuck elbow"))
    heard = plant.probe.messages[STATUS]
    harness.spin_until(
        lambda: heard and "joint_stuck" in values_of(heard[-1])["faults"], "the fault"
    )
    for _ in range(5):
        plant.step(effort=[3.0, 3.0])
    assert plant.actuation == "effort"
    shoulder, elbow = plant.probe.last("joint_states").velocity
    assert abs(shoulder) > 1e-3
    assert elbow == 0.0
