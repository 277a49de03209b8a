"""A coordinated-control node, with a probe in the place of the plant."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped, WrenchStamped
from nav_msgs.msg import Odometry
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger
from support.executive_loop import KD, KP, SHAPE, STEP, TIP, URDF, Array
from support.planner_flight import goal_at
from support.ros_harness import Harness

from spacerobot_ros.nodes import CoordinatedControlNode

__all__ = ["JOINTS", "KD", "KP", "SHAPE", "STATUS", "TICK_NS", "TIP", "URDF", "Loop", "pose"]

JOINTS = ["shoulder", "elbow"]
TICK_NS = 10_000_000
STATUS = "controller/status"


def pose(position: npt.ArrayLike, frame: str = "world", w: float = 1.0) -> PoseStamped:
    message = goal_at((np.asarray(position).tolist(), [0.0] * 3), frame)
    message.pose.orientation.w = w
    return message


class Loop:
    """The node, and a probe in the place of the plant: a robot that is where it is put.

    Its axes are the world's. At rest the law (29) then commands the force ``Kp`` times the errors
    of base and end-effector together, since the work of a force on the base moves both.
    """

    def __init__(self, harness: Harness, *, activate: bool = True, **settings: Any) -> None:
        self.harness = harness
        defaults = {
            "robot": "planar_manipulator",
            "tick_rate": 100.0,
            "status_period": 0.01,
            **STEP,
        }
        self.node = harness.make(
            CoordinatedControlNode, {**defaults, **settings}, name="control", autostart=False
        )
        self.probe = harness.probe(
            {"base_wrench": WrenchStamped, "joint_commands": JointState, STATUS: DiagnosticStatus},
            latched=(STATUS,),
        )
        make = self.probe.create_publisher
        self.odom = make(Odometry, "odom", 100)
        self.joints = make(JointState, "joint_states", 100)
        self.goals = {
            "base": make(PoseStamped, "goal_pose", 10),
            "end_effector": make(PoseStamped, "end_effector/goal_pose", 10),
        }
        assert self.node.trigger_configure() is TransitionCallbackReturn.SUCCESS
        harness.connect()
        if activate:
            assert self.node.trigger_activate() is TransitionCallbackReturn.SUCCESS
        self.tick = 0
        self.place = np.zeros(3)
        self.velocity = np.zeros(3)
        self.rates = np.zeros(2)

    def show(self, *, odom: bool = True, joints: Sequence[str] = JOINTS) -> None:
        """Publish the state of the next tick."""
        self.tick += 1
        state = Odometry(child_frame_id="base_link")
        state.header.frame_id = "world"
        p, v = state.pose.pose.position, state.twist.twist.linear
        p.x, p.y, p.z = self.place.tolist()
        v.x, v.y, v.z = self.velocity.tolist()
        state.pose.pose.orientation.w = 1.0
        shape = JointState(
            name=joints, position=SHAPE.tolist(), velocity=self.rates.tolist(), effort=[0.0, 0.0]
        )
        for message in (state, shape):
            stamp = divmod(self.tick * TICK_NS, 1_000_000_000)
            message.header.stamp.sec, message.header.stamp.nanosec = stamp
        if odom:
            self.odom.publish(state)
        self.joints.publish(shape)

    def answer(self, *, odom: bool = True) -> tuple[Array, Array]:
        """Show a state; return the wrench and the efforts that come for it, or one before."""
        before = {topic: self.probe.count(topic) for topic in ("base_wrench", "joint_commands")}
        self.show(odom=odom)
        self.harness.spin_until(
            lambda: all(self.probe.count(topic) > n for topic, n in before.items()), "a command"
        )
        return self.last_command

    @property
    def last_command(self) -> tuple[Array, Array]:
        wrench, joints = self.probe.last("base_wrench"), self.probe.last("joint_commands")
        assert wrench.header.stamp == joints.header.stamp
        assert wrench.header.frame_id == "base_link"
        assert list(joints.name) == JOINTS
        f, t = wrench.wrench.force, wrench.wrench.torque
        return np.array([f.x, f.y, f.z, t.x, t.y, t.z]), np.array(joints.effort)

    def aim(self, **goals: PoseStamped) -> None:
        """Send goals and let them arrive."""
        for group, message in goals.items():
            self.goals[group].publish(message)
        self.harness.settle(self.probe)

    def wait_for(self, state: str) -> DiagnosticStatus:
        self.harness.spin_until(
            lambda: self.probe.count(STATUS) and self.status["state"] == state, f"state {state}"
        )
        return self.probe.last(STATUS)

    @property
    def status(self) -> dict[str, str]:
        return {pair.key: pair.value for pair in self.probe.last(STATUS).values}

    def set(self, name: str, value: Any) -> Any:
        (result,) = self.node.set_parameters([Parameter(name, value=value)])
        return result

    def trigger(self, service: str) -> Any:
        """Call a service of the node."""
        client = self.probe.create_client(Trigger, f"control/{service}")
        return self.harness.call(client, Trigger.Request())
