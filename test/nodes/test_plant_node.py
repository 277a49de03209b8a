"""Managed life of the plant, and plants that go on from a bag."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rclpy
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from sensor_msgs.msg import JointState
from support.made_bags import array, joint_states, made_bag, odometry
from support.odometry import pose_of, twist_of
from support.plant_rig import SLIDERS, STATE, TICK_NS, Rig
from support.ros_harness import Harness, construction, nanoseconds
from support.sentences import assert_one_sentence

from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.nodes import PlantNode

JOINTS = ["slider_1", "slider_2", "slider_3"]

URDF = Path(__file__).parents[2] / "urdf"


# -- managed life -----------------------------------------------------------------------------


def test_a_supervisor_can_take_the_plant_through_its_life(harness: Harness) -> None:
    plant = harness.make(
        PlantNode,
        {"robot": "sliding_masses", "time_mode": "lockstep", "autostart": False},
    )
    probe = harness.probe(STATE)
    change = probe.create_client(ChangeState, "plant/change_state")
    state = probe.create_client(GetState, "plant/get_state")

    def go(transition: int, expected: int) -> None:
        request = ChangeState.Request(transition=Transition(id=transition))
        assert harness.call(change, request).success
        assert harness.call(state, GetState.Request()).current_state.id == expected

    def step(publisher: Publisher) -> None:
        before = probe.count("joint_states")
        message = JointState(name=JOINTS, velocity=[0.2, 0.0, 0.0])
        message.header.stamp = probe.last("joint_states").header.stamp
        publisher.publish(message)
        harness.spin_until(lambda: probe.count("joint_states") > before, "a step")

    for _ in range(2):
        go(Transition.TRANSITION_CONFIGURE, State.PRIMARY_STATE_INACTIVE)
        harness.connect()
        assert probe.count("odom") == 0
        go(Transition.TRANSITION_ACTIVATE, State.PRIMARY_STATE_ACTIVE)
        harness.spin_until(lambda: probe.count("joint_states"), "the first state")
        assert nanoseconds(probe.last("joint_states").header.stamp) == 0
        assert list(probe.last("joint_states").position) == [0.0] * 3
        publisher = probe.create_publisher(JointState, "joint_commands", 10)
        harness.connect()
        for _ in range(3):
            step(publisher)
        go(Transition.TRANSITION_DEACTIVATE, State.PRIMARY_STATE_INACTIVE)
        go(Transition.TRANSITION_CLEANUP, State.PRIMARY_STATE_UNCONFIGURED)
        harness.spin_until(lambda: not probe.count_publishers("odom"), "the end of odom")
        topics = ("/clock", "robot_description", "joint_states", "momentum", "/diagnostics")
        for topic in topics:
            assert probe.count_publishers(topic) == 0, topic
        assert probe.count_subscribers("joint_commands") == 0
        for kept in probe.messages.values():
            kept.clear()
    go(Transition.TRANSITION_UNCONFIGURED_SHUTDOWN, State.PRIMARY_STATE_FINALIZED)
    assert not plant.is_active


def test_a_transition_that_is_not_possible_is_answered_and_changes_nothing(
    harness: Harness,
) -> None:
    rig = Rig(harness)
    change = rig.probe.create_client(ChangeState, "plant/change_state")

    def succeeds(**transition: Any) -> bool:
        request = ChangeState.Request(transition=Transition(**transition))
        return bool(harness.call(change, request).success)

    for number in (Transition.TRANSITION_ACTIVATE, Transition.TRANSITION_CLEANUP, 99):
        assert not succeeds(id=number)
    assert not succeeds(label="configure")
    assert rig.plant.is_active
    np.testing.assert_array_equal(rig.step([0.2, 0.0, 0.0]).velocity, [0.2, 0.0, 0.0])
    assert succeeds(label="deactivate")
    assert not succeeds(id=Transition.TRANSITION_DEACTIVATE)
    assert succeeds(id=Transition.TRANSITION_INACTIVE_SHUTDOWN)
    assert not succeeds(id=Transition.TRANSITION_INACTIVE_SHUTDOWN)


def test_a_deactivated_lockstep_plant_takes_no_command(harness: Harness) -> None:
    rig = Rig(harness)
    rig.plant.trigger_deactivate()
    rig.send([0.1, 0.1, 0.1])
    harness.settle(rig.probe)
    assert rig.probe.count("joint_states") == 1
    rig.activate()
    np.testing.assert_array_equal(rig.step([0.2, 0.0, 0.0]).velocity, [0.2, 0.0, 0.0])


def test_a_node_shuts_down_from_every_state(harness: Harness) -> None:
    for transitions in ((), ("configure",), ("configure", "activate")):
        plant = harness.make(
            PlantNode,
            {"robot": "sliding_masses"},
            name=f"plant_{len(transitions)}",
            autostart=False,
        )
        for name in transitions:
            getattr(plant, f"trigger_{name}")()
        assert plant.trigger_shutdown() is TransitionCallbackReturn.SUCCESS


# -- parameters -------------------------------------------------------------------------------


REFUSED: dict[str, tuple[dict[str, Any], tuple[str, ...]]] = {
    "no robot": ({"robot": ""}, ("robot",)),
    "unknown robot": ({"robot": "octopus"}, ("'robot'", "octopus", "sliding_masses")),
    "missing file": ({"robot": "nowhere/robot.urdf"}, ("'robot'", "nowhere/robot.urdf")),
    "broken description": ({"robot_description": "<robot"}, ("robot description",)),
    "joint positions of wrong length": (
        {"initial_joint_positions": [0.1, 0.2]},
        ("initial joint positions", "2", "slider_1, slider_2, slider_3"),
    ),
    "joint positions not finite": (
        {"initial_joint_positions": [0.0, math.nan, 0.0]},
        ("initial joint positions",),
    ),
    "no tick rate": ({"tick_rate": 0.0}, ("'tick rate'", "0.001", "Hz")),
    "tick rate is not a number": ({"tick_rate": math.nan}, ("'tick rate'",)),
    "time mode": ({"time_mode": "foo"}, ("'time mode'", "foo", "realtime", "lockstep")),
    "actuation": ({"actuation": "magnets"}, ("'actuation'", "magnets", "velocity")),
    "real time factor": ({"real_time_factor": 0.0}, ("'real time factor'",)),
    "negative timeout": ({"command_timeout": -1.0}, ("'command timeout'", "s")),
    "integration step": ({"integration_step": -0.01}, ("'integration step'", "s")),
    "zero quaternion": ({"initial_orientation": [0.0] * 4}, ("initial orientation",)),
    "three quaternion entries": (
        {"initial_orientation": [0.0, 0.0, 1.0]},
        ("'initial orientation'", "4 numbers"),
    ),
    "momentum not finite": ({"linear_momentum": [0.0, math.inf, 0.0]}, ("'linear momentum'",)),
    "end effector": ({"end_effector_frame": "claw"}, ("'end effector frame'", "claw", "mass_1")),
}  # Words of names are compared without their underscores.


@pytest.mark.parametrize(("parameters", "mentions"), REFUSED.values(), ids=REFUSED)
def test_a_bad_parameter_is_refused_with_a_sentence_that_names_it(
    ros_context: rclpy.Context, parameters: dict[str, Any], mentions: tuple[str, ...]
) -> None:
    given = {"robot": "sliding_masses", "time_mode": "lockstep", **parameters}
    with pytest.raises(SpaceRobotError) as refusal:
        PlantNode(**construction(ros_context, given))
    plain = str(refusal.value).replace("_", " ")
    assert_one_sentence(plain, *(mention.replace("_", " ") for mention in mentions))


def test_parameters_are_described_and_fixed_while_the_plant_lives(harness: Harness) -> None:
    rig = Rig(harness)
    descriptor = rig.plant.describe_parameter("tick_rate")
    assert descriptor.read_only
    assert "Hz" in descriptor.description
    assert descriptor.floating_point_range[0].from_value == 0.001
    (result,) = rig.plant.set_parameters([Parameter("tick_rate", value=50.0)])
    assert not result.successful
    assert result.reason
    rig.step([0.0, 0.0, 0.0])
    assert rig.now_ns == TICK_NS


@pytest.mark.parametrize("name", ["sliding_masses.urdf", "the file", "the text"])
def test_a_robot_is_a_name_a_file_or_a_text(harness: Harness, tmp_path: Path, name: str) -> None:
    text = (URDF / "sliding_masses.urdf").read_text("utf-8").replace("slider_2", "boom")
    file = tmp_path / "mine.urdf"
    file.write_text(text, "utf-8")
    choose: dict[str, Callable[[], dict[str, str]]] = {
        "sliding_masses.urdf": lambda: {"robot": str(URDF / "sliding_masses.urdf")},
        "the file": lambda: {"robot": str(file)},
        "the text": lambda: {"robot": "octopus", "robot_description": text},
    }
    rig = Rig(harness, choose[name]())
    second = "slider_2" if name == "sliding_masses.urdf" else "boom"
    assert list(rig.probe.last("joint_states").name) == ["slider_1", second, "slider_3"]


MASS = 10 + 3 * 2.0
P, L = [0.8, -0.4, 0.2], [0.03, 0.02, -0.01]
POSE = (1.0, -2.0, 3.0, 0.0, 0.6, 0.0, 0.8)
JOINTS_PLANT_RESUMPTION, RATES = [0.5, -0.25, 0.125], [0.01, 0.02, 0.03]


def bag_of(path: Path, names: list[str] = SLIDERS, prefix: str = "", L: list[float] = L) -> Path:
    """Write a flight that ends at 1.15 s, in tick 23, with another state before."""
    with made_bag(path) as (_, say):
        for time, more in ((1.1, 1.0), (1.15, 0.0)):
            momenta = [x + more for x in (*P, *L, 9.0)]
            say(f"{prefix}/momentum", array(*momenta), time)
            pose = (POSE[0] + more, *POSE[1:])
            say(f"{prefix}/odom", odometry(time, *pose, *([0.7] * 6)), time)
            joints = [q + more for q in JOINTS_PLANT_RESUMPTION[: len(names)]]
            rates = [q + more for q in RATES[: len(names)]]
            say(f"{prefix}/joint_states", joint_states(time, names, joints, rates), time)
    return path


def resumed(harness: Harness, bag: Path, **parameters: Any) -> Rig:
    return Rig(harness, {"resume_bag": str(bag), **parameters})


def test_the_first_state_is_the_last_of_the_bag(harness: Harness, tmp_path: Path) -> None:
    rig = resumed(harness, bag_of(tmp_path / "a.mcap"))
    harness.settle(rig.probe)
    joints, odom = rig.probe.last("joint_states"), rig.probe.last("odom")
    assert nanoseconds(joints.header.stamp) == nanoseconds(odom.header.stamp) == 23 * TICK_NS
    assert nanoseconds(rig.probe.last("/clock").clock) == 23 * TICK_NS
    np.testing.assert_allclose(joints.position, JOINTS_PLANT_RESUMPTION, atol=1e-15)
    position, quaternion = pose_of(odom)
    np.testing.assert_allclose([*position, *quaternion], POSE, atol=1e-15)
    np.testing.assert_allclose(rig.probe.last("momentum").data[:6], [*P, *L], atol=1e-14)


def test_time_goes_on_from_there_tick_by_tick(harness: Harness, tmp_path: Path) -> None:
    # Without angular momentum the base coasts and does not turn: by hand, r + p t / m.
    rig = resumed(harness, bag_of(tmp_path / "a.mcap", L=[0.0] * 3))
    assert rig.plant.tick == 23
    for k in (1, 2):
        joints = rig.step([0.0] * 3)
        assert nanoseconds(joints.header.stamp) == (23 + k) * TICK_NS
    harness.settle(rig.probe)
    odom = rig.probe.last("odom")
    expected = np.array(POSE[:3]) + np.array(P) / MASS * 0.1
    np.testing.assert_allclose(pose_of(odom)[0], expected, atol=1e-13)
    np.testing.assert_allclose(pose_of(odom)[1], POSE[3:], atol=1e-13)
    np.testing.assert_allclose(joints.position, JOINTS_PLANT_RESUMPTION, atol=1e-15)
    np.testing.assert_allclose(rig.probe.last("momentum").data[:3], P, atol=1e-13)


@pytest.mark.parametrize(("actuation", "rates"), [("velocity", [0.0] * 3), ("effort", RATES)])
def test_only_motors_leave_joints_moving(
    harness: Harness, tmp_path: Path, actuation: str, rates: list[float]
) -> None:
    rig = resumed(harness, bag_of(tmp_path / "a.mcap"), actuation=actuation)
    joints = rig.probe.last("joint_states")
    np.testing.assert_allclose(joints.velocity, rates, atol=1e-14)
    harness.settle(rig.probe)
    np.testing.assert_allclose(rig.probe.last("momentum").data[:6], [*P, *L], atol=1e-14)
    assert np.linalg.norm(np.concatenate(twist_of(rig.probe.last("odom")))) > 0.01


def test_a_bag_of_another_robot_is_refused(harness: Harness, tmp_path: Path) -> None:
    bags = {
        "others": bag_of(tmp_path / "a.mcap", ["slider_2", "slider_1", "slider_3"]),
        "fewer": bag_of(tmp_path / "b.mcap", SLIDERS[:2]),
        "elsewhere": bag_of(tmp_path / "c.mcap", prefix="/a"),
    }
    for bag, mention in zip(
        bags.values(), ("slider_2, slider_1", "slider_1, slider_2;", "no messages on"), strict=True
    ):
        plant = harness.make(
            PlantNode,
            {"robot": "sliding_masses", "resume_bag": str(bag)},
            name=f"plant_{bag.stem}",
            autostart=False,
        )
        assert plant.trigger_configure() is TransitionCallbackReturn.FAILURE
        assert mention in str(plant.fault)


def test_a_plant_in_a_namespace_goes_on_from_its_own_robot(
    harness: Harness, tmp_path: Path
) -> None:
    bag = bag_of(tmp_path / "a.mcap", prefix="/a")
    plant = harness.make(
        PlantNode,
        {"robot": "sliding_masses", "resume_bag": str(bag), "tick_rate": 20.0},
        name="plant",
        namespace="/a",
        autostart=False,
    )
    assert plant.trigger_configure() is TransitionCallbackReturn.SUCCESS
    assert plant.tick == 23
