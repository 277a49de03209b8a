"""Managed life of the plant, and plants that go on from a bag."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.publisher import Publisher
from sensor_msgs.msg import JointState
from support.made_bags import array, joint_states, made_bag, odometry
from support.plant_rig import SLIDERS, STATE, TICK_NS, Rig, pose_of, twist_of
from support.ros_harness import Harness, nanoseconds
from support.sentences import assert_one_sentence

from spacerobot_ros.nodes import PlantNode
from spacerobot_ros.resources import robot_file

# -- managed life -----------------------------------------------------------------------------


def test_a_supervisor_can_take_the_plant_through_its_life(harness: Harness) -> None:
    plant = harness.make(
        PlantNode, {"robot": "sliding_masses", "time_mode": "lockstep", "autostart": False}
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
        message = JointState(name=SLIDERS, velocity=[0.2, 0.0, 0.0])
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
    harness: Harness, capfd: pytest.CaptureFixture[str]
) -> None:
    rig = Rig(harness)
    change = rig.probe.create_client(ChangeState, "plant/change_state")

    def succeeds(**transition: Any) -> bool:
        request = ChangeState.Request(transition=Transition(**transition))
        return bool(harness.call(change, request).success)

    for number in (Transition.TRANSITION_ACTIVATE, Transition.TRANSITION_CLEANUP, 99):
        capfd.readouterr()
        assert not succeeds(id=number)
        (line,) = capfd.readouterr().err.splitlines()
        possible = "'active', which has deactivate (4), shutdown (7)"
        assert_one_sentence(line.partition("]: ")[2], f"The transition {number} ", possible)
    assert not succeeds(label="configure")
    assert rig.plant.is_active
    np.testing.assert_array_equal(rig.step([0.2, 0.0, 0.0]).velocity, [0.2, 0.0, 0.0])
    assert succeeds(label="deactivate")
    before = rig.probe.count("joint_states")
    rig.send([0.1, 0.1, 0.1])
    harness.settle(rig.probe)
    assert rig.probe.count("joint_states") == before, "an inactive plant takes no command"
    assert not succeeds(id=Transition.TRANSITION_DEACTIVATE)
    assert succeeds(id=Transition.TRANSITION_INACTIVE_SHUTDOWN)
    assert not succeeds(id=Transition.TRANSITION_INACTIVE_SHUTDOWN)


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


@pytest.mark.parametrize("given", ["file", "text"])
def test_a_robot_is_a_file_or_a_text(harness: Harness, tmp_path: Path, given: str) -> None:
    text = robot_file("sliding_masses").read_text("utf-8").replace("slider_2", "boom")
    file = tmp_path / "mine.urdf"
    file.write_text(text, "utf-8")
    of_text = {"robot": "octopus", "robot_description": text}
    rig = Rig(harness, of_text if given == "text" else {"robot": str(file)})
    assert list(rig.probe.last("joint_states").name) == ["slider_1", "boom", "slider_3"]


MASS = 10 + 3 * 2.0
P, L = [0.8, -0.4, 0.2], [0.03, 0.02, -0.01]
POSE = (1.0, -2.0, 3.0, 0.0, 0.6, 0.0, 0.8)
SHAPE, RATES = [0.5, -0.25, 0.125], [0.01, 0.02, 0.03]


def bag_of(path: Path, names: list[str] = SLIDERS, prefix: str = "", L: list[float] = L) -> Path:
    """Write a flight that ends at 1.15 s, in tick 23, with another state before."""
    with made_bag(path) as (_, say):
        for time, more in ((1.1, 1.0), (1.15, 0.0)):
            momenta = [x + more for x in (*P, *L, 9.0)]
            say(f"{prefix}/momentum", array(*momenta), time)
            pose = (POSE[0] + more, *POSE[1:])
            say(f"{prefix}/odom", odometry(time, *pose, *([0.7] * 6)), time)
            joints = [q + more for q in SHAPE[: len(names)]]
            rates = [q + more for q in RATES[: len(names)]]
            say(f"{prefix}/joint_states", joint_states(time, names, joints, rates), time)
    return path


@pytest.mark.parametrize(("actuation", "rates"), [("velocity", [0.0] * 3), ("effort", RATES)])
def test_the_first_state_is_the_last_of_the_bag(
    harness: Harness, tmp_path: Path, actuation: str, rates: list[float]
) -> None:
    """Only motors leave joints moving."""
    bag = bag_of(tmp_path / "a.mcap")
    rig = Rig(harness, {"resume_bag": str(bag), "actuation": actuation})
    harness.settle(rig.probe)
    joints, odom = rig.probe.last("joint_states"), rig.probe.last("odom")
    np.testing.assert_allclose(joints.velocity, rates, atol=1e-14)
    assert np.linalg.norm(np.concatenate(twist_of(odom))) > 0.01
    assert nanoseconds(joints.header.stamp) == nanoseconds(odom.header.stamp) == 23 * TICK_NS
    assert nanoseconds(rig.probe.last("/clock").clock) == 23 * TICK_NS
    np.testing.assert_allclose(joints.position, SHAPE, atol=1e-15)
    position, quaternion = pose_of(odom)
    np.testing.assert_allclose([*position, *quaternion], POSE, atol=1e-15)
    np.testing.assert_allclose(rig.probe.last("momentum").data[:6], [*P, *L], atol=1e-14)


def test_time_goes_on_from_there_tick_by_tick(harness: Harness, tmp_path: Path) -> None:
    # Without angular momentum the base coasts and does not turn: by hand, r + p t / m.
    rig = Rig(harness, {"resume_bag": str(bag_of(tmp_path / "a.mcap", L=[0.0] * 3))})
    assert rig.plant.tick == 23
    for k in (1, 2):
        joints = rig.step([0.0] * 3)
        assert nanoseconds(joints.header.stamp) == (23 + k) * TICK_NS
    harness.settle(rig.probe)
    odom = rig.probe.last("odom")
    expected = np.array(POSE[:3]) + np.array(P) / MASS * 0.1
    np.testing.assert_allclose(pose_of(odom)[0], expected, atol=1e-13)
    np.testing.assert_allclose(pose_of(odom)[1], POSE[3:], atol=1e-13)
    np.testing.assert_allclose(joints.position, SHAPE, atol=1e-15)
    np.testing.assert_allclose(rig.probe.last("momentum").data[:3], P, atol=1e-13)


def test_a_bag_of_another_robot_is_refused(harness: Harness, tmp_path: Path) -> None:
    for bag, mention in (
        (bag_of(tmp_path / "a.mcap", ["slider_2", "slider_1", "slider_3"]), "slider_2, slider_1"),
        (bag_of(tmp_path / "b.mcap", SLIDERS[:2]), "slider_1, slider_2;"),
        (bag_of(tmp_path / "c.mcap", prefix="/a"), "no messages on"),
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
