"""The files of ros2_control/, and a plant that a client like its topic system drives."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from std_msgs.msg import String
from support.plant_rig import Rig
from support.ros_harness import Harness
from support.topic_system import DEFAULTS, INTERFACES, PLUGIN, SystemTag, TopicSystem, Values

from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.resources import robot_file
from spacerobot_ros.topics import TOPICS

FOLDER = Path(__file__).resolve().parents[2] / "ros2_control"
ROBOT = FOLDER / "three_joint_arm.urdf.xacro"
GOAL = {"shoulder_yaw": 0.05, "shoulder_pitch": -0.08, "elbow_pitch": 0.11}


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
    counts = rig.plant._commands.counts
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
    assert not rig.plant._commands.fault
    assert not any(math.isnan(value) for value in system.states.values())
