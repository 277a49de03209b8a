"""A client that behaves like joint_state_topic_hardware_interface's JointStateTopicSystem.

The rules are facts: those of its `read` and `write` at d115f23 (July 2026), and its parameters with
their defaults in the code.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from rclpy.qos import QoSProfile, qos_profile_sensor_data
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from support.ros_harness import Harness

PLUGIN = "joint_state_topic_hardware_interface/JointStateTopicSystem"
DEFAULTS = {
    "joint_commands_topic": "/robot_joint_commands",
    "joint_states_topic": "/robot_joint_states",
    "trigger_joint_command_threshold": "1e-5",
    "sum_wrapped_joint_states": "false",
}
INTERFACES = ("position", "velocity", "effort")
"""Interfaces that it knows, which are fields of JointState."""

Values = dict[str, float]
"""Values by JOINT/INTERFACE."""


@dataclass(frozen=True)
class SystemTag:
    """The content of a ros2_control tag: plugin, parameters, and interfaces by joint."""

    plugin: str
    parameters: Mapping[str, str]
    commands: Mapping[str, tuple[str, ...]]
    states: Mapping[str, tuple[str, ...]]

    @classmethod
    def of(cls, urdf: str) -> SystemTag:
        """Return the only tag of a URDF."""
        (tag,) = ET.fromstring(urdf).findall("ros2_control")
        assert tag.get("type") == "system"
        hardware = tag.find("hardware")
        assert hardware is not None

        def interfaces(joint: ET.Element, kind: str) -> tuple[str, ...]:
            return tuple(str(each.get("name")) for each in joint.findall(f"{kind}_interface"))

        joints = {str(joint.get("name")): joint for joint in tag.findall("joint")}
        return cls(
            str(hardware.findtext("plugin")),
            {str(each.get("name")): str(each.text) for each in hardware.findall("param")},
            {name: interfaces(joint, "command") for name, joint in joints.items()},
            {name: interfaces(joint, "state") for name, joint in joints.items()},
        )


class TopicSystem:
    """Reads states and writes commands in every cycle of a controller manager in simulated time.

    Parameters
    ----------
    harness
        Where it is.
    tag
        Its tag.
    """

    def __init__(self, harness: Harness, tag: SystemTag) -> None:
        self.tag, given = tag, {**DEFAULTS, **tag.parameters}
        self.threshold = float(given["trigger_joint_command_threshold"])
        self.states = self._unset(tag.states)
        self.commands = self._unset(tag.commands)
        """Not a number until a controller is active."""
        self.controller: Callable[[Values], Values] | None = None
        self.written = 0
        self._latest = JointState()
        node = harness.probe({}, name="topic_system")
        self._publisher = node.create_publisher(
            JointState, given["joint_commands_topic"], QoSProfile(depth=1)
        )
        node.create_subscription(
            JointState, given["joint_states_topic"], self._on_states, qos_profile_sensor_data
        )
        node.create_subscription(Clock, "/clock", self._on_clock, qos_profile_sensor_data)

    @staticmethod
    def _unset(interfaces: Mapping[str, tuple[str, ...]]) -> Values:
        return {f"{joint}/{each}": math.nan for joint in interfaces for each in interfaces[joint]}

    def _on_states(self, states: JointState) -> None:
        self._latest = states

    def _on_clock(self, clock: Clock) -> None:
        self._read()
        if self.controller is not None:
            self.commands.update(self.controller(self.states))
        self._write(clock.clock)

    def _read(self) -> None:
        for i, joint in enumerate(self._latest.name):
            if joint not in self.tag.states:
                continue
            for interface in INTERFACES:
                values = getattr(self._latest, interface)
                if len(values) and math.isfinite(values[i]):
                    # An interface that the tag has not is an error of the system.
                    assert f"{joint}/{interface}" in self.states
                    self.states[f"{joint}/{interface}"] = values[i]

    def _write(self, now: Any) -> None:
        # A command without a state of the same name is an error, too.
        difference = sum(abs(self.states[key] - self.commands[key]) for key in self.commands)
        if difference <= self.threshold:
            return
        message = JointState()
        message.header.stamp = now
        for joint, interfaces in self.tag.commands.items():
            message.name.append(joint)
            for interface in interfaces:
                getattr(message, interface).append(self.commands[f"{joint}/{interface}"])
        self._publisher.publish(message)
        self.written += 1
