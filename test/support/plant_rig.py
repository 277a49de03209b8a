"""A plant node in a harness, with a probe that commands it and hears all that it says."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rcl_interfaces.msg import Log
from rclpy.lifecycle import TransitionCallbackReturn
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from std_srvs.srv import SetBool, Trigger
from support.ros_harness import Harness, nanoseconds

from spacerobot_ros.nodes import PlantNode

SLIDERS = ["slider_1", "slider_2", "slider_3"]
TICK = 0.05
TICK_NS = 50_000_000
WARN = 30  # of rcl_interfaces/msg/Log

Array = npt.NDArray[np.float64]

STATE = {
    "/clock": Clock,
    "base_pose": PoseStamped,
    "momentum": Float64MultiArray,
    "odom": Odometry,
    "joint_states": JointState,
}
TOPICS = {**STATE, "/diagnostics": DiagnosticArray, "/rosout": Log}

BAD_COMMANDS = {
    "NaN": ([math.nan, 0.1, 0.1], SLIDERS, "finite"),
    "infinite": ([0.1, 0.1, -math.inf], SLIDERS, "finite"),
    "infinities that cancel": ([math.inf, -math.inf, 0.1], SLIDERS, "finite"),
    "unknown joint": ([0.1, 0.1, 0.1], ["slider_1", "rudder", "slider_3"], "'rudder'"),
    "duplicate": ([0.1, 0.1, 0.1], ["slider_1", "slider_2", "slider_1"], "twice"),
    "too few velocities": ([0.1, 0.1], SLIDERS, "3 joint names and 2"),
    "too many velocities": ([0.1] * 4, SLIDERS, "3 joint names and 4"),
    "no velocities": ([], SLIDERS, "3 joint names and 0"),
    "no names": ([0.1, 0.1, 0.1], [], "joint 'slider_1' is missing"),
}
"""Velocities and names of commands that are refused, and the reason."""


def pose_of(odom: Odometry) -> tuple[Array, Array]:
    p, o = odom.pose.pose.position, odom.pose.pose.orientation
    return np.array([p.x, p.y, p.z]), np.array([o.x, o.y, o.z, o.w])


def twist_of(odom: Odometry) -> tuple[Array, Array]:
    v, w = odom.twist.twist.linear, odom.twist.twist.angular
    return np.array([v.x, v.y, v.z]), np.array([w.x, w.y, w.z])


class Rig:
    """A plant, and a probe that commands it and hears all that it says."""

    def __init__(
        self,
        harness: Harness,
        parameters: dict[str, Any] | None = None,
        *,
        topics: dict[str, Any] | None = None,
        activate: bool = True,
    ) -> None:
        self.harness = harness
        defaults = {
            "robot": "sliding_masses",
            "time_mode": "lockstep",
            "tick_rate": 1 / TICK,
            "diagnostics_period": TICK,
        }
        self.plant = harness.make(
            PlantNode, {**defaults, **(parameters or {})}, name="plant", autostart=False
        )
        self.probe = harness.probe({**TOPICS, **(topics or {})})
        self.commands = self.probe.create_publisher(JointState, "joint_commands", 100)
        assert self.plant.trigger_configure() is TransitionCallbackReturn.SUCCESS
        harness.connect()
        if activate:
            self.activate()

    def activate(self) -> None:
        before = self.probe.count("joint_states")
        assert self.plant.trigger_activate() is TransitionCallbackReturn.SUCCESS
        self.wait("joint_states", before + 1)

    def wait(self, topic: str, count: int) -> Any:
        """Wait until ``count`` messages have come on a topic, and return the last of them."""
        self.harness.spin_until(
            lambda: self.probe.count(topic) >= count, f"message {count} on {topic}"
        )
        return self.probe.messages[topic][count - 1]

    @property
    def now_ns(self) -> int:
        """Time of the last state."""
        return nanoseconds(self.probe.last("joint_states").header.stamp)

    def send(
        self,
        velocity: Sequence[float],
        names: Sequence[str] = SLIDERS,
        *,
        stamp_ns: int | None = None,
        **fields: Any,
    ) -> None:
        """Publish a command, stamped with the last state's time unless given."""
        message = JointState(name=list(names), velocity=[float(x) for x in velocity], **fields)
        stamp = self.now_ns if stamp_ns is None else stamp_ns
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 1_000_000_000)
        self.commands.publish(message)

    def step(
        self, velocity: Sequence[float], names: Sequence[str] = SLIDERS, **options: Any
    ) -> JointState:
        """Send a command, and return the joint states it leads to."""
        before = self.probe.count("joint_states")
        self.send(velocity, names, **options)
        return self.wait("joint_states", before + 1)

    def logged(self, part: str) -> bool:
        """Whether the plant has logged a warning with this text."""
        return any(
            part in line.msg and line.name == "plant" and line.level == WARN
            for line in self.probe.messages["/rosout"]
        )

    def wait_for_log(self, part: str) -> None:
        self.harness.spin_until(lambda: self.logged(part), f"a warning with '{part}'")

    def diagnosis(self, what: str) -> DiagnosticStatus:
        """Return a status of the diagnostics of the last tick."""
        self.harness.spin_until(
            lambda: (
                self.probe.count("/diagnostics")
                and nanoseconds(self.probe.last("/diagnostics").header.stamp) == self.now_ns
            ),
            "diagnostics of the last tick",
        )
        (status,) = (
            s for s in self.probe.last("/diagnostics").status if s.name == f"plant: {what}"
        )
        return status

    def diagnosed(self, what: str, key: str) -> float:
        """Return one value of the diagnostics of the last tick."""
        return float(next(p.value for p in self.diagnosis(what).values if p.key == key))

    def wait_for_refusals(self, count: int) -> None:
        self.harness.spin_until(
            lambda: self.diagnosed("commands", "refused") >= count, f"{count} refusal(s)"
        )

    def trigger(self, service: str) -> Any:
        return self.harness.call(self.probe.create_client(Trigger, service), Trigger.Request())

    def pause(self, on: bool) -> Any:
        client = self.probe.create_client(SetBool, "plant/pause")
        return self.harness.call(client, SetBool.Request(data=on))
