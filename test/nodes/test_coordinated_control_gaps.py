"""A controller whose pose or references are missing, and one that goes on with a goal on file."""

from __future__ import annotations

import json
import math
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from nav_msgs.msg import Odometry
from rclpy.lifecycle import TransitionCallbackReturn
from std_msgs.msg import String
from std_srvs.srv import Trigger
from support.control_loop import KD, KP, STATUS, TICK_NS, TIP, URDF, Loop, pose
from support.executive_loop import STEP, Array
from support.ros_harness import LATCHED, Harness, Probe, construction, nanoseconds
from support.sentences import assert_one_sentence
from support.warm_python import WarmPython

from spacerobot_ros.errors import ParameterError
from spacerobot_ros.nodes import CoordinatedControlNode, FlightNode, PlannerNode


def test_without_odom_the_base_is_estimated_and_then_the_thrusters_are_off(
    harness: Harness,
) -> None:
    loop = Loop(harness, estimation_time=0.05)
    loop.aim(base=pose([1.0, 0.0, 0.0]), end_effector=pose(TIP))
    loop.answer()
    loop.wait_for("tracking")
    # The first state without odom is known to be one when the next joints come; those are answered
    # at once, and so are all that follow.
    loop.show(odom=False)
    harness.settle(loop.probe)
    for _ in range(4):
        loop.answer(odom=False)
        assert nanoseconds(loop.probe.last("base_wrench").header.stamp) == loop.tick * TICK_NS
        assert loop.wait_for("estimating").level == DiagnosticStatus.WARN
    loop.show(odom=False)
    harness.spin_until(lambda: loop.status["state"] == "stopped", "the stop")
    assert loop.probe.last(STATUS).level == DiagnosticStatus.ERROR
    np.testing.assert_array_equal(loop.answer(odom=False)[0], np.zeros(6))
    loop.show(odom=True)
    harness.spin_until(lambda: loop.status["state"] == "tracking", "the loop again")
    wrench, _ = loop.answer()
    np.testing.assert_allclose(wrench[:3], [KP, 0.0, 0.0], atol=1e-12)


class Referenced(Loop):
    """A loop in which somebody publishes a reference of the base before the node is active."""

    def __init__(self, harness: Harness, **settings: Any) -> None:
        super().__init__(harness, activate=False, **settings)
        self.references = self.probe.create_publisher(Odometry, "base_reference", 10)
        harness.spin_until(lambda: self.node.count_publishers("base_reference"), "its discovery")
        harness.connect()
        assert self.node.trigger_activate() is TransitionCallbackReturn.SUCCESS

    def refer(self, tick: int, speed: float) -> None:
        """Publish the pose of the robot turned by 90 deg about z, moving along its own x."""
        message = Odometry()
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(tick * TICK_NS, 10**9)
        message.pose.pose.orientation.z = message.pose.pose.orientation.w = math.sqrt(0.5)
        message.twist.twist.linear.x = speed
        self.references.publish(message)

    def force(self, speed: float) -> Array:
        """Show a state and its reference; return the force on the base."""
        before = self.probe.count("joint_commands")
        self.show()
        self.harness.settle(self.probe)
        assert self.probe.count("joint_commands") == before, "it waits for the reference"
        self.refer(self.tick, speed)
        # The wrench is published first.
        self.harness.spin_until(lambda: self.probe.count("joint_commands") > before, "a command")
        return self.last_command[0][:3]


def test_a_moving_reference_is_waited_for_and_moves_along_its_own_axes(harness: Harness) -> None:
    loop = Referenced(harness)
    still, moving = loop.force(0.0), loop.force(0.2)
    # Its x is the y of the world, along which the robot has to be pushed.
    push = moving - still
    assert push[1] > 0.1 * 0.2 * KD
    np.testing.assert_allclose(push[[0, 2]], 0.0, atol=1e-9)


def test_a_silent_reference_is_done_without_until_it_comes_again(harness: Harness) -> None:
    """A plant in lockstep: its time stands still until each state is answered."""
    loop = Referenced(harness, reference_timeout=0.3)
    # Its publisher has sent nothing yet.
    np.testing.assert_allclose(np.concatenate(loop.answer()), 0.0, atol=1e-9)
    said = " There is no reference on base_reference."
    harness.spin_until(lambda: loop.probe.last(STATUS).message.endswith(said), "a status")
    assert loop.status["state"] == "holding"
    loop.place = np.array([0.1, 0.0, 0.0])
    assert abs(loop.answer()[0][0]) > 1.0, "the pose of the first state is held, without a delay"
    loop.refer(loop.tick, 0.0)
    harness.settle(loop.probe)
    assert abs(loop.force(0.2)[1]) > 0.1 * 0.2 * KD
    harness.spin_until(
        lambda: loop.probe.last(STATUS).message.startswith("Following references; "), "a status"
    )
    # It is silent again: the robot holds where it is.
    np.testing.assert_allclose(np.concatenate(loop.answer()), 0.0, atol=1e-9)
    harness.spin_until(
        lambda: loop.probe.last(STATUS).message.startswith("Waiting for a goal; holding, 0 m"),
        "a status",
    )


AIM = np.array([0.5, 0.25, 0.0])


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "goals.json"


def kill(harness: Harness, probe: Probe, node: FlightNode) -> None:
    """Destroy a node without any of its cleanup, when it hears nothing any more."""
    harness.executor.remove_node(node)
    harness.settle(probe)
    harness.remove(node)


def replaced(loop: Loop, file: Path, **settings: Any) -> None:
    """Kill the node of a loop, and start another in its place."""
    kill(loop.harness, loop.probe, loop.node)
    defaults = {"robot": "planar_manipulator", "tick_rate": 100.0, "status_period": 0.01, **STEP}
    loop.node = loop.harness.make(
        CoordinatedControlNode,
        {**defaults, "resume_file": str(file), **settings},
        name="control",
    )
    loop.harness.connect()


# -- going on ---------------------------------------------------------------------------------


def test_a_node_that_is_activated_again_goes_on(harness: Harness, file: Path) -> None:
    loop = Loop(harness, resume_file=str(file))
    loop.aim(base=pose(AIM))
    before, _ = loop.answer()
    loop.node.trigger_deactivate()
    loop.node.trigger_activate()
    np.testing.assert_allclose(loop.answer()[0], before, atol=1e-12)


def test_the_robot_may_be_told_later(harness: Harness, file: Path) -> None:
    loop = Loop(harness, resume_file=str(file))
    loop.aim(base=pose(AIM))
    before, _ = loop.answer()
    replaced(loop, file, robot="")
    loop.show()
    description = loop.probe.create_publisher(String, "robot_description", LATCHED)
    harness.connect()
    count = loop.probe.count("joint_commands")
    description.publish(String(data=URDF.read_text("utf-8")))
    harness.spin_until(lambda: loop.probe.count("joint_commands") > count, "the answer")
    harness.settle(loop.probe)
    np.testing.assert_allclose(loop.last_command[0], before, atol=1e-12)


# -- files that are refused -------------------------------------------------------------------


def written(name: str = "base", **values: Any) -> str:
    goal = {"position": [0, 0, 0], "quaternion": [0, 0, 0, 1], "joint_positions": None}
    return json.dumps({name: {**goal, **values}})


@pytest.mark.parametrize("node", [CoordinatedControlNode, PlannerNode])
def test_a_file_that_holds_no_goal_is_refused(
    harness: Harness, file: Path, node: type[FlightNode]
) -> None:
    file.write_text("{}")
    parameters = {"robot": "planar_manipulator", "resume_file": str(file)}
    with pytest.raises(ParameterError) as refusal:
        node(**construction(harness.context, parameters))
    assert_one_sentence(str(refusal.value), "resume_file", str(file), "no valid goals")


@pytest.mark.parametrize(
    ("content", "settings", "mentions"),
    [
        (written("end_effector"), {"law": "computed_torque"}, ("computed_torque", "end-effector")),
        (written(joint_positions=[0.0] * 3), {}, ("3 joints", "planar_manipulator", "2")),
    ],
)
def test_goals_of_another_robot_or_law_are_refused(
    harness: Harness,
    file: Path,
    content: str,
    settings: dict[str, str],
    mentions: tuple[str, ...],
) -> None:
    file.write_text(content)
    parameters = {"robot": "planar_manipulator", "resume_file": str(file), **settings}
    with pytest.raises(ParameterError) as refusal:
        CoordinatedControlNode(**construction(harness.context, parameters))
    assert_one_sentence(str(refusal.value), "resume_file", *mentions)


def test_a_robot_that_comes_later_and_cannot_go_on_says_so_and_holds(
    harness: Harness, file: Path
) -> None:
    file.write_text(written("end_effector"))
    loop = Loop(harness, robot="", resume_file=str(file), law="computed_torque")
    description = loop.probe.create_publisher(String, "robot_description", LATCHED)
    harness.connect()
    description.publish(String(data=URDF.read_text("utf-8")))
    assert_one_sentence(loop.wait_for("refused").message, "computed_torque", "end-effector")
    np.testing.assert_allclose(loop.answer()[0], 0.0, atol=1e-12)


def test_a_goal_that_is_aborted_before_the_robot_is_known_is_not_flown_to(
    harness: Harness, file: Path
) -> None:
    file.write_text(written("base", position=[0.5, 0.25, 0.0]))
    loop = Loop(harness, robot="", resume_file=str(file))
    description = loop.probe.create_publisher(String, "robot_description", LATCHED)
    harness.connect()
    client = loop.probe.create_client(Trigger, "control/abort")
    answer = harness.call(client, Trigger.Request())
    assert answer.success
    assert loop.wait_for("aborted").message == answer.message
    assert not file.exists()
    assert not harness.call(client, Trigger.Request()).success, "nothing waits any more"
    description.publish(String(data=URDF.read_text("utf-8")))
    harness.spin_until(lambda: loop.node.commander.robot is not None, "the robot is known")
    np.testing.assert_allclose(loop.answer()[0], 0.0, atol=1e-12)


def test_a_process_with_a_broken_file_ends_with_one_sentence(
    warm_python: WarmPython, file: Path, ros_domain: int
) -> None:
    file.write_text("{")
    words = (
        *("-m", "spacerobot_ros.nodes.controller", "--ros-args"),
        *("-p", "robot:=planar_manipulator", "-p", f"resume_file:={file}"),
    )
    environment = {**os.environ, "ROS_DOMAIN_ID": str(ros_domain)}
    ended = warm_python.run(words, file.parent, environment, timeout=60.0)
    assert ended.returncode == 2
    assert_one_sentence(
        ended.stderr.strip().splitlines()[-1], "resume_file", str(file), "no valid goals"
    )
