"""Nodes that do not go together: said once, in one sentence, within two seconds."""

from __future__ import annotations

import re
import time

import pytest
from nav_msgs.msg import Odometry
from sensor_msgs.msg import JointState
from support.nodes_apart import NodesApart
from support.sentences import assert_one_sentence
from support.slow import some_fast

SOON = 2.0
"""s from the first state within which it is said."""

AFTERWARDS = 6.0
"""s in which it is not said again: messages that repeat do so every five."""

_LINE = re.compile(r"^\[(\w+)\] \[([\d.]+)\] \[[^\]]*\]: (.*)$")


def sentences(apart: NodesApart, *words: str) -> list[tuple[float, str]]:
    """Return when (s) lines with all of some words were logged by any node, and their text."""
    matches = (_LINE.match(line) for line in apart.said.splitlines())
    found = [(float(m[2]), m[3]) for m in matches if m is not None]
    return [each for each in found if all(word in each[1] for word in words)]


def assert_said_once(apart: NodesApart, *words: str) -> None:
    """Check the sentence with these words: soon after the first state, and once."""
    apart.wait(lambda: apart.probe.count("odom") > 0, "the first state")
    began = time.time()
    apart.wait(lambda: sentences(apart, *words), f"a sentence with {words}", SOON + 3.0)
    said = sentences(apart, *words)[0][0]
    assert said - began <= SOON, apart.said
    apart.harness.spin_for(AFTERWARDS)
    ((_, sentence),) = sentences(apart, *words)
    assert_one_sentence(sentence, *words)


@pytest.mark.parametrize(
    ("robot", "commander"),
    some_fast(
        [("sliding_masses", "planner"), ("planar_manipulator", "coordinated_control")],
        ("sliding_masses", "planner"),
    ),
)
def test_an_unequal_rate_is_named(apart: NodesApart, robot: str, commander: str) -> None:
    apart.start(commander, tick_rate=20.0)
    apart.wait_state(commander, "waiting")
    apart.start("plant", robot=robot, tick_rate=10.0)
    assert_said_once(apart, "10", "20", "rate")


@pytest.mark.parametrize(
    ("robot", "commander", "actuation", "wanted"),
    some_fast(
        [
            ("planar_manipulator", "coordinated_control", "velocity", "effort"),
            ("sliding_masses", "planner", "effort", "velocity"),
        ],
        ("planar_manipulator", "coordinated_control", "velocity", "effort"),
    ),
)
def test_a_wrong_actuation_is_named(
    apart: NodesApart, robot: str, commander: str, actuation: str, wanted: str
) -> None:
    apart.start(commander)
    apart.wait_state(commander, "waiting")
    apart.start("plant", robot=robot, actuation=actuation)
    assert_said_once(apart, "actuation:=", actuation[:-1], wanted[:-1])


@pytest.mark.parametrize("commander", some_fast(["planner", "coordinated_control"], "planner"))
@pytest.mark.parametrize("missing", ["odom", "joint_states"])
def test_a_partner_that_publishes_half_of_the_states_is_named(
    apart: NodesApart, commander: str, missing: str
) -> None:
    apart.start(commander, robot="planar_manipulator")
    apart.wait_state(commander, "waiting")
    probe = apart.probe
    if missing == "odom":
        states = probe.create_publisher(JointState, "joint_states", 10)
    else:
        states = probe.create_publisher(Odometry, "odom", 10)
    apart.harness.matched(states)

    def publish() -> None:
        now = probe.get_clock().now().to_msg()
        message: JointState | Odometry
        if missing == "odom":
            message = JointState(name=["shoulder", "elbow"], position=[0.1, 0.2])
            message.velocity = [0.0, 0.0]
        else:
            message = Odometry(child_frame_id="base_link")
            message.header.frame_id = "world"
            message.pose.pose.orientation.w = 1.0
        message.header.stamp = now
        states.publish(message)

    timer = probe.create_timer(0.05, publish)
    apart.wait(
        lambda: (
            f"'{missing}'" in apart.status(commander)["message"]
            and apart.status(commander)["state"] == "waiting"
        ),
        f"the status names {missing}",
        SOON,
    )
    probe.destroy_timer(timer)


@pytest.mark.parametrize(
    "node", some_fast(["plant", "planner", "coordinated_control"], "coordinated_control")
)
def test_a_node_alone_says_what_it_waits_for(apart: NodesApart, node: str) -> None:
    if node == "plant":
        apart.start("plant", robot="sliding_masses")
        assert apart.wait_state("plant", "resting")["reason"] == "no_command"
        assert apart.status("plant")["actuation"] == "auto"
    else:
        apart.start(node)
        assert "robot" in apart.wait_state(node, "waiting")["message"]
    apart.end()
    assert apart.complaints == []
