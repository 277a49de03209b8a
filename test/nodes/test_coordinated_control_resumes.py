"""A coordinated-control node that ends in mid-flight, and the one that is started after it."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from std_msgs.msg import String
from std_srvs.srv import Trigger
from support.control_loop import SHAPE, STATUS, TIP, URDF, Loop, pose
from support.executive_loop import STEP
from support.ros_harness import LATCHED, Harness, Probe, construction, nanoseconds
from support.sentences import assert_one_sentence
from support.warm_python import WarmPython

from spacerobot_ros.errors import ParameterError
from spacerobot_ros.nodes import CoordinatedControlNode, FlightNode, PlannerNode, PlantNode

AIM = np.array([0.5, 0.25, 0.0])
CONTROL = {"robot": "planar_manipulator", "tick_rate": 50.0, "settle_time": 0.5}


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


@pytest.mark.slow
@pytest.mark.parametrize("profile", ["step", "quintic"])
def test_the_goals_are_met_by_the_next_controller(
    harness: Harness, file: Path, profile: str
) -> None:
    plant = {
        "robot": "planar_manipulator",
        "actuation": "effort",
        "time_mode": "lockstep",
        "tick_rate": 50.0,
        "initial_joint_positions": SHAPE.tolist(),
    }
    control = {**CONTROL, "profile": profile, "motion.speed": 0.3, "motion.acceleration": 0.1}
    harness.make(PlantNode, plant, name="plant")
    probe = harness.probe(
        {"odom": Odometry, "end_effector_pose": PoseStamped, STATUS: DiagnosticStatus},
        latched=(STATUS,),
    )
    make = probe.create_publisher
    tip_goal = TIP + np.array([0.1, 0.4, 0.0])
    goals = {
        make(PoseStamped, "goal_pose", 10): pose([0.3, 0.2, 0.0]),
        make(PoseStamped, "end_effector/goal_pose", 10): pose(tip_goal),
    }

    def start() -> CoordinatedControlNode:
        return harness.make(CoordinatedControlNode, {**control, "resume_file": str(file)})

    def pass_time(seconds: float) -> None:
        end = nanoseconds(probe.last("odom").header.stamp) + seconds * 1e9
        harness.spin_until(
            lambda: nanoseconds(probe.last("odom").header.stamp) >= end, f"{seconds} s", 30.0
        )

    def states() -> list[str]:
        return [
            pair.value for m in probe.messages[STATUS] for pair in m.values if pair.key == "state"
        ]

    node = start()
    harness.spin_until(lambda: probe.count(STATUS), "the robot is held")
    assert not file.exists()
    for publisher, message in goals.items():
        harness.matched(publisher).publish(message)
    harness.spin_until(lambda: file.exists() and len(json.loads(file.read_text())) == 2, "the file")
    for seconds in (0.5, 1.5):
        pass_time(seconds)
        assert "reached" not in states(), "in mid-flight"
        kill(harness, probe, node)
        before = probe.count("odom")
        harness.spin_for(0.5)
        assert probe.count("odom") == before, "a plant in lockstep waits"
        assert file.exists()
        node = start()
    harness.spin_until(lambda: states()[-1] == "reached", "the goal is met", 60.0)
    assert not file.exists()
    base, tip = probe.last("odom").pose.pose.position, probe.last("end_effector_pose").pose.position
    np.testing.assert_allclose([base.x, base.y, base.z], [0.3, 0.2, 0.0], atol=1e-3)
    np.testing.assert_allclose([tip.x, tip.y, tip.z], tip_goal, atol=1e-3)


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


FOREIGN = {
    "empty": b"",
    "cut": written().encode()[:-5],
    "no text": b"\xff\xfe\x00",
    "no object": b"[1, 2]",
    "no goal": b"{}",
    "another name": written("tail").encode(),
    "no position": b'{"base": {"quaternion": [0, 0, 0, 1], "joint_positions": null}}',
    "a number": b'{"base": 1}',
    "not finite": written(position=[0, float("nan"), 0]).encode(),
    "no rotation": written(quaternion=[0, 0, 0, 0]).encode(),
    "deep": b"[" * 100_000,
}


@pytest.mark.parametrize("node", [CoordinatedControlNode, PlannerNode])
@pytest.mark.parametrize("content", FOREIGN.values(), ids=FOREIGN)
def test_a_file_that_holds_no_goal_is_refused(
    harness: Harness, file: Path, node: type[FlightNode], content: bytes
) -> None:
    file.write_bytes(content)
    parameters = {"robot": "planar_manipulator", "resume_file": str(file)}
    with pytest.raises(ParameterError) as refusal:
        node(**construction(harness.context, parameters))
    assert_one_sentence(str(refusal.value), "resume_file", str(file), "no goal")
    assert file.read_bytes() == content


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
    assert_one_sentence(ended.stderr.strip().splitlines()[-1], "resume_file", str(file), "no goal")
