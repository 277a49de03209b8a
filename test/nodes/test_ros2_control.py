"""Robots of ros2_control: what its controllers ask of a description and of a gait."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, fromstring

import numpy as np
import pytest
import yaml
from rclpy.qos import QoSProfile, qos_profile_sensor_data
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from support.planner_flight import TURNED, Flight
from support.plant_rig import Rig
from support.ros_harness import Harness, nanoseconds
from trajectory_msgs.msg import JointTrajectory

from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.resources import robot_file
from spacerobot_ros.topics import TOPICS

FOLDER = Path(__file__).resolve().parents[2] / "ros2_control"
ROBOT = FOLDER / "three_joint_arm.urdf.xacro"
GOAL = {"shoulder_yaw": 0.05, "shoulder_pitch": -0.08, "elbow_pitch": 0.11}

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
        (tag,) = fromstring(urdf).findall("ros2_control")
        assert tag.get("type") == "system"
        hardware = tag.find("hardware")
        assert hardware is not None

        def interfaces(joint: Element, kind: str) -> tuple[str, ...]:
            return tuple(str(each.get("name")) for each in joint.findall(f"{kind}_interface"))

        joints = {str(joint.get("name")): joint for joint in tag.findall("joint")}
        return cls(
            str(hardware.findtext("plugin")),
            {str(each.get("name")): str(each.text) for each in hardware.findall("param")},
            {name: interfaces(joint, "command") for name, joint in joints.items()},
            {name: interfaces(joint, "state") for name, joint in joints.items()},
        )


class TopicSystem:
    """Behaves like JointStateTopicSystem in every cycle of a controller manager in simulated time.

    The rules are facts: those of its `read` and `write` at d115f23 (July 2026), and its parameters
    with their defaults in the code.
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


@pytest.fixture(scope="module")
def robot() -> SpaceRobot:
    return SpaceRobot.from_file(ROBOT)


def test_the_tag_has_what_its_plugin_knows(robot: SpaceRobot) -> None:
    tag = SystemTag.of(robot.description.urdf)
    assert tag.plugin == PLUGIN
    assert set(tag.parameters) <= set(DEFAULTS)
    for name, topic in (("commands", "joint_commands"), ("states", "joint_states")):
        assert tag.parameters[f"joint_{name}_topic"] == f"/{topic}"
        assert TOPICS[topic].type == "sensor_msgs/msg/JointState"
    # The plant stops joints whose commands are not repeated.
    assert float(tag.parameters["trigger_joint_command_threshold"]) < 0
    assert tag.parameters["sum_wrapped_joint_states"] == "false"
    assert tuple(tag.commands) == tuple(tag.states) == robot.joint_names
    for joint in robot.joint_names:
        assert tag.commands[joint] == ("velocity", "effort")
        assert tag.states[joint] == INTERFACES
    plain = SpaceRobot.from_file(robot_file("three_joint_arm"))
    assert robot.total_mass == plain.total_mass
    assert robot.joint_names == plain.joint_names


@pytest.mark.parametrize("interface", ["velocity", "effort"])
def test_controllers_command_joints_of_the_tag(robot: SpaceRobot, interface: str) -> None:
    text = (FOLDER / f"{interface}_controllers.yaml").read_text(encoding="utf-8")
    given = {name: each["ros__parameters"] for name, each in yaml.safe_load(text).items()}
    manager = given.pop("controller_manager")
    kinds = {name: each["type"] for name, each in manager.items() if isinstance(each, dict)}
    assert kinds == {
        "joint_trajectory_controller": "joint_trajectory_controller/JointTrajectoryController",
        f"forward_{interface}_controller": "forward_command_controller/ForwardCommandController",
    }
    assert set(kinds) == set(given)
    for parameters in given.values():
        assert tuple(parameters["joints"]) == robot.joint_names
    trajectories = given["joint_trajectory_controller"]
    assert trajectories["command_interfaces"] == [interface]
    assert trajectories["state_interfaces"] == ["position", "velocity"]
    assert tuple(trajectories["gains"]) == robot.joint_names
    assert set(trajectories["constraints"]) == {"goal_time", *robot.joint_names}
    assert given[f"forward_{interface}_controller"]["interface_name"] == interface


def servo(states: Values) -> Values:
    """Return velocities towards the goal; the efforts are nobody's."""
    return {
        f"{joint}/velocity": 4.0 * (q - states[f"{joint}/position"]) for joint, q in GOAL.items()
    }


def motors(states: Values) -> Values:
    """Return efforts towards the goal; the velocities are nobody's."""
    return {
        f"{joint}/effort": 150.0 * (q - states[f"{joint}/position"])
        - 60.0 * states[f"{joint}/velocity"]
        for joint, q in GOAL.items()
    }


@pytest.mark.parametrize(
    ("actuation", "controller"),
    [("velocity", servo), pytest.param("effort", motors, marks=pytest.mark.slow)],
)
def test_a_topic_system_drives_the_plant(
    harness: Harness,
    monkeypatch: pytest.MonkeyPatch,
    actuation: str,
    controller: Callable[[Values], Values],
) -> None:
    monkeypatch.setenv("SPACEROBOT_COMPILE", "0" if actuation == "velocity" else "1")
    parameters: dict[str, Any] = {
        "robot": str(ROBOT), "actuation": actuation, "time_mode": "realtime",
        "real_time_factor": 10.0, "tick_rate": 100.0, "diagnostics_period": 0.0,
    }  # fmt: skip
    rig = Rig(harness, parameters)
    rig.probe.destroy_publisher(rig.commands)
    rig.probe.watch("robot_description", String, latched=True)
    rig.wait("robot_description", 1)
    system = TopicSystem(harness, SystemTag.of(rig.probe.last("robot_description").data))
    # Before a controller is active, what comes is refused, and nothing is latched.
    harness.spin_until(lambda: system.written >= 3, "commands")
    counts = rig.plant.commands.counts
    harness.spin_until(lambda: counts.total() >= 2, "refusals")
    velocities = [f"{joint}/velocity" for joint in GOAL]
    harness.spin_until(lambda: system.states[velocities[0]] == 0.0, "a state")
    assert all(system.states[key] == 0.0 for key in velocities)
    system.controller = controller

    def there() -> bool:
        return all(
            abs(system.states[f"{joint}/position"] - q) < abs(q) / 8 for joint, q in GOAL.items()
        )

    harness.spin_until(there, "the goal")
    assert {reason.value for reason in counts} == {"not_finite"}
    assert not rig.plant.commands.fault
    assert not any(math.isnan(value) for value in system.states.values())


_FLOAT_EPSILON = float(np.finfo(np.float32).eps)


def refusal(message: JointTrajectory, joints: Sequence[str], now_ns: int) -> str:
    """Return why the controller refuses a trajectory, empty if it accepts it."""
    names, points = list(message.joint_names), list(message.points)
    # allow_partial_joints_goal is false.
    if len(names) != len(joints):
        return "not the controller's joints"
    if not names or not points:
        return "empty"
    if not set(names) <= set(joints):
        return "an unknown joint"
    # allow_nonzero_velocity_at_trajectory_end is false.
    if any(abs(velocity) > _FLOAT_EPSILON for velocity in points[-1].velocities):
        return "a velocity at the end"
    start = nanoseconds(message.header.stamp)
    if start and start + nanoseconds(points[-1].time_from_start) < now_ns:
        return "over already"
    previous = 0
    for number, point in enumerate(points):
        time = nanoseconds(point.time_from_start)
        if number and time <= previous:
            return "times that do not increase"
        previous = time
        # allow_integration_in_goal_trajectories is false: positions of all, the others if at all.
        if len(point.positions) != len(names):
            return "positions"
        if len(point.velocities) not in (0, len(names)):
            return "velocities"
        if len(point.accelerations) not in (0, len(names)):
            return "accelerations"
        # Without the command interface "effort".
        if len(point.effort):
            return "efforts"
    return ""


@pytest.fixture
def schedule(harness: Harness) -> tuple[JointTrajectory, list[str], int]:
    """Return the schedule of a gait, the joints, and when it has come."""
    flight = Flight(harness)
    flight.start()
    flight.send(TURNED)
    flight.wait("executing")
    harness.spin_until(lambda: flight.probe.messages["gait_schedule"], "the schedule")
    now = nanoseconds(flight.probe.last("joint_states").header.stamp)
    names = list(flight.plant.plant.robot.joint_names)
    return flight.probe.last("gait_schedule"), names, now


def test_a_gait_passes_the_checks_of_a_joint_trajectory_controller(
    schedule: tuple[JointTrajectory, list[str], int],
) -> None:
    message, names, now = schedule
    assert refusal(message, names, now) == ""
    assert sorted(message.joint_names) == sorted(names)  # Each once
    assert all(len(point.velocities) == len(names) for point in message.points)
    assert np.isfinite([point.positions for point in message.points]).all()

    # The rules themselves refuse what they are about.
    last = message.points[-1].time_from_start
    cases: dict[str, Callable[[JointTrajectory], object]] = {
        "not the controller's joints": lambda m: m.joint_names.pop(),
        "empty": lambda m: m.points.clear(),
        "an unknown joint": lambda m: m.joint_names.__setitem__(0, "nobody"),
        "a velocity at the end": lambda m: m.points[-1].velocities.__setitem__(0, 1e-3),
        "times that do not increase": lambda m: setattr(m.points[1], "time_from_start", last),
        "positions": lambda m: m.points[0].positions.pop(),
        "velocities": lambda m: m.points[0].velocities.pop(),
        "efforts": lambda m: setattr(m.points[0], "effort", [0.0]),
    }
    for reason, damage in cases.items():
        damaged = copy.deepcopy(message)
        damage(damaged)
        assert refusal(damaged, names, now) == reason
    # A stamp of zero begins whenever it is received.
    message.header.stamp.sec += 1
    late = nanoseconds(message.header.stamp) + nanoseconds(last) + 1
    assert refusal(message, names, late) == "over already"
