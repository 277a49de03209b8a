"""Nodes that are killed, come late, or are deactivated beside silent publishers, in every phase."""

from __future__ import annotations

import re
import signal
import time
from collections.abc import Callable
from importlib import import_module
from itertools import permutations
from typing import Any

import pytest
from lifecycle_msgs.msg import Transition
from nav_msgs.msg import Odometry
from rclpy.qos import QoSProfile
from sensor_msgs.msg import JointState
from support.nodes_apart import NodesApart
from support.planner_flight import Place
from support.sentences import assert_one_sentence
from support.slow import some_fast

ROBOTS = {"planner": "sliding_masses", "coordinated_control": "planar_manipulator"}
FAR: dict[str, Place] = {
    # Long enough for a node to be killed in between.
    "planner": ([0.3, 0.0, 0.0], [0.0, 0.0, 0.2]),
    "coordinated_control": ([0.5, 0.2, 0.0], [0.0, 0.0, 0.3]),
}
NEW: dict[str, Place] = {
    "planner": ([-0.03, 0.02, 0.0], [0.0, 0.0, 0.0]),
    "coordinated_control": ([0.1, 0.05, 0.0], [0.0, 0.0, 0.1]),
}
PHASES = {
    "planner": ("idle", "planning", "executing"),
    "coordinated_control": ("holding", "tracking"),
}
KILLS = [
    (commander, killed, phase)
    for commander, phases in PHASES.items()
    for phase in phases
    for killed in (commander, "plant", "recorder")
]
QUICK_KILLS = [("planner", "plant", "executing")]
SLOW_KILLS = [
    ("coordinated_control", "coordinated_control", "tracking"),
    ("planner", "planner", "planning"),
    ("planner", "recorder", "executing"),
    ("coordinated_control", "plant", "tracking"),
]
AT_REST = {
    "planner": ("idle", "reached", "reached_partly", "failed", "refused", "aborted"),
    "coordinated_control": ("holding", "reached", "reached_partly", "failed", "refused", "aborted"),
}
"""States of a commander whose plant publishes states, and which pursues no goal."""


def begin(apart: NodesApart, commander: str) -> None:
    apart.start("plant", robot=ROBOTS[commander])
    apart.start(commander)
    apart.start("recorder")


@pytest.mark.parametrize("commander", some_fast(list(ROBOTS), slow=["planner"]))
def test_nodes_start_in_any_order_without_a_warning(apart: NodesApart, commander: str) -> None:
    for order in permutations(("plant", commander, "recorder")):
        for node in order:
            given: dict[str, Any] = {"robot": ROBOTS[commander]} if node == "plant" else {}
            apart.start(node, **given)
        apart.wait_state(commander, *AT_REST[commander])
        apart.wait_state("plant", "running")
        apart.wait_states(40)
        apart.end()
        assert apart.complaints == [], (order, apart.said)


@pytest.mark.parametrize(
    ("commander", "killed", "phase"), some_fast(KILLS, *QUICK_KILLS, slow=SLOW_KILLS)
)
def test_a_node_that_is_killed_and_started_again_flies_on(
    apart: NodesApart, commander: str, killed: str, phase: str
) -> None:
    begin(apart, commander)
    if phase in AT_REST[commander]:
        apart.wait_state(commander, phase)
    else:
        apart.send(FAR[commander])
        apart.wait_state(commander, phase)
    apart.kill(killed)
    if killed == "plant":
        waiting = apart.wait_state(commander, "waiting")
        assert "odom" in waiting["message"] or "joint_states" in waiting["message"], waiting
        apart.start("plant", robot=ROBOTS[commander])
    elif killed == commander:
        resting = apart.wait_state("plant", "resting")
        assert resting["reason"] in ("timeout", "no_command")
        apart.start(commander)
        apart.wait_state(commander, *AT_REST[commander])
    else:
        apart.start("recorder")
    apart.fly(commander, NEW[commander])
    apart.wait_state("plant", "running")
    apart.end()
    assert not any("Traceback" in line for line in apart.complaints), apart.said


@pytest.mark.slow
@pytest.mark.parametrize("commander", ROBOTS)
def test_a_goal_is_reached_although_its_commander_is_suspended(
    apart: NodesApart, commander: str
) -> None:
    begin(apart, commander)
    goal = apart.send(FAR[commander])
    apart.wait_state(commander, "executing", "tracking")
    apart.wait_states(20)
    process = apart.running[commander]
    process.signal(signal.SIGSTOP)
    assert apart.wait_state("plant", "resting")["reason"] == "timeout"
    process.signal(signal.SIGCONT)
    assert apart.decision(commander, goal)[0] == "reached"
    apart.end()
    (message,) = [text for _, text in apart.told(commander, goal) if "brought to rest" in text]
    assert_one_sentence(message, "no command arrived in time")


@pytest.mark.slow
@pytest.mark.parametrize("late", some_fast(["plant", "planner", "coordinated_control"], "plant"))
def test_a_partner_that_comes_late_is_met(apart: NodesApart, late: str) -> None:
    commander = "planner" if late == "plant" else late
    first = commander if late == "plant" else "plant"
    starts: dict[str, Callable[[], Any]] = {
        "plant": lambda: apart.start("plant", robot=ROBOTS[commander]),
        commander: lambda: apart.start(commander),
    }
    starts[first]()
    apart.start("recorder")
    if late == "plant":
        waiting = apart.wait_state(commander, "waiting")
        assert "robot_description" in waiting["message"] or "odom" in waiting["message"], waiting
    else:
        assert apart.wait_state("plant", "resting")["reason"] == "no_command"
    apart.harness.spin_for(3.0)
    starts[late]()
    apart.fly(commander, NEW[commander])
    apart.end()
    assert apart.complaints == []


@pytest.mark.slow
@pytest.mark.parametrize("commander", some_fast(list(ROBOTS), "coordinated_control"))
@pytest.mark.parametrize("node", ["plant", "commander"])
def test_silent_publishers_do_not_hold_a_node_that_is_activated_again(
    apart: NodesApart, commander: str, node: str
) -> None:
    begin(apart, commander)
    apart.fly(commander, NEW[commander])
    name = commander if node == "commander" else node
    publish_nothing(apart, name)
    assert apart.change(name, Transition.TRANSITION_DEACTIVATE)
    assert apart.life(name) == "inactive"
    if name == "plant":
        waiting = apart.wait_state(commander, "waiting")
        assert "the plant, which is inactive" in waiting["message"]
    assert apart.change(name, Transition.TRANSITION_ACTIVATE)
    apart.wait_state(commander, *AT_REST[commander])
    apart.fly(commander, FAR[commander])
    apart.end()
    assert not any("Traceback" in line for line in apart.complaints), apart.said


def publish_nothing(apart: NodesApart, node: str) -> None:
    """Have a publisher that never says anything on every topic that a node subscribes to."""
    probe = apart.probe
    silent = []
    for topic, (kind, *_) in probe.get_subscriber_names_and_types_by_node(node, "/"):
        package, _, name = kind.split("/")
        if topic == "/parameter_events":
            continue
        readers = probe.get_subscriptions_info_by_topic(topic)
        reader = next(each for each in readers if each.node_name == node)
        qos = QoSProfile(
            depth=1, reliability=reader.qos_profile.reliability,
            durability=reader.qos_profile.durability,
        )  # fmt: skip
        message = getattr(import_module(f"{package}.msg"), name)
        silent.append(probe.create_publisher(message, topic, qos))
    assert silent
    for publisher in silent:
        apart.harness.matched(publisher)


SOON = 20.0
"""s from the first state within which it is said; on an idle machine 1 s."""

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


@pytest.mark.slow
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


@pytest.mark.slow
@pytest.mark.parametrize(
    ("robot", "commander", "actuation", "wanted"),
    [
        ("planar_manipulator", "coordinated_control", "velocity", "effort"),
        ("sliding_masses", "planner", "effort", "velocity"),
    ],
)
def test_a_wrong_actuation_is_named(
    apart: NodesApart, robot: str, commander: str, actuation: str, wanted: str
) -> None:
    apart.start(commander)
    apart.wait_state(commander, "waiting")
    apart.start("plant", robot=robot, actuation=actuation)
    assert_said_once(apart, "actuation:=", actuation[:-1], wanted[:-1])


@pytest.mark.parametrize("commander", some_fast(["planner", "coordinated_control"], "planner"))
@pytest.mark.parametrize("missing", some_fast(["odom", "joint_states"], "odom"))
def test_a_partner_that_publishes_half_of_the_states_is_named(
    apart: NodesApart, commander: str, missing: str
) -> None:
    apart.start(commander, robot="planar_manipulator")
    apart.wait_state(commander, "waiting")
    probe, message = apart.probe, Odometry(child_frame_id="base_link")
    message.header.frame_id, message.pose.pose.orientation.w = "world", 1.0
    if missing == "odom":
        joints = {"name": ["shoulder", "elbow"], "position": [0.1, 0.2]}
        message = JointState(**joints, velocity=[0.0, 0.0])
    topic = "joint_states" if missing == "odom" else "odom"
    states = apart.harness.matched(probe.create_publisher(type(message), topic, 10))

    def publish() -> None:
        message.header.stamp = probe.get_clock().now().to_msg()
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
        process = apart.start(node)
        waits = "Waiting for a robot on 'robot_description'."
        assert apart.wait_state(node, "waiting")["message"] == waits
        apart.wait(lambda: "goals on '/goal_pose'" in process.said, "it is up")
        assert process.said.count(waits) == 1
    apart.end()
    assert apart.complaints == []
