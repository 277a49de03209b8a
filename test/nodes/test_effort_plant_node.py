"""The plant node under efforts and wrenches, from outside."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import WrenchStamped
from nav_msgs.msg import Odometry
from rclpy.lifecycle import TransitionCallbackReturn
from sensor_msgs.msg import JointState
from support.control_loop import JOINTS, URDF
from support.oracles import PinocchioOracle
from support.ros_harness import Harness
from support.sentences import assert_one_sentence

from spacerobot_ros.nodes import PlantNode

MASS = 47.0
EFFORT_LIMIT = 200.0  # of both joints, as the URDF says


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


def test_efforts_alone_do_where_nobody_gives_a_wrench(harness: Harness) -> None:
    rig = Effort(harness, wrench=False)
    for tick in range(1, 4):
        rig.turn(1.0, -1.0)
        rig.wait(tick + 1)
    assert list(rig.probe.last("joint_states").effort) == [1.0, -1.0]


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


def test_a_wrench_in_another_frame_is_refused_and_time_goes_on(harness: Harness) -> None:
    rig = Effort(harness, wrench=True)
    rig.push(4.7, frame="world")
    rig.turn(0.0, 0.0)
    rig.wait(2)
    assert rig.speed == 0.0
    assert rig.diagnosed("commands")["refused"] == "1"
    (status,) = (s for s in rig.probe.last("/diagnostics").status if s.name == "plant: commands")
    assert status.level == DiagnosticStatus.WARN
    assert_one_sentence(status.message, "base_wrench", "'world'", "base_link")
    rig.push(4.7, frame="")
    rig.turn(0.0, 0.0)
    rig.wait(3)
    assert rig.speed == pytest.approx(0.01 * 4.7 / MASS, rel=1e-12)


def test_efforts_beyond_the_limits_are_clipped_and_counted(harness: Harness) -> None:
    rig = Effort(harness, wrench=False)
    rig.turn(3 * EFFORT_LIMIT, -10.0)
    rig.wait(2)
    rig.turn(0.0, -1e6)
    rig.wait(3)
    efforts = [list(m.effort) for m in rig.probe.messages["joint_states"]]
    assert efforts == [[0.0, 0.0], [EFFORT_LIMIT, -10.0], [0.0, -EFFORT_LIMIT]]
    counted = rig.diagnosed("actuators")
    assert counted["effort_limited.shoulder"] == counted["effort_limited.elbow"] == "1"
    # The motion is that of the clipped efforts: energy is their work, by another engine.
    joints, odom = (rig.probe.messages[t][1] for t in ("joint_states", "odom"))
    oracle = PinocchioOracle(URDF.read_text("utf-8"), JOINTS)
    oracle.set_configuration(np.zeros(2))
    acceleration = oracle.own_acceleration(np.zeros(6), np.array([EFFORT_LIMIT, -10.0]))
    rates = np.array(joints.velocity) / 0.01
    np.testing.assert_allclose(rates, acceleration[6:], rtol=0.05)
    assert odom.twist.twist.angular.z == pytest.approx(0.01 * acceleration[5], rel=0.05)
