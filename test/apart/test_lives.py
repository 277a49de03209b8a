"""Nodes that are killed, come late, or are deactivated beside silent publishers, in every phase."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from itertools import permutations
from typing import Any

import pytest
from lifecycle_msgs.msg import Transition
from rclpy.qos import QoSProfile
from support.nodes_apart import NodesApart
from support.planner_flight import Place
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
QUICK_KILLS = [
    ("planner", "plant", "executing"),
    ("coordinated_control", "coordinated_control", "tracking"),
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


@pytest.mark.slow
@pytest.mark.parametrize("commander", ROBOTS)
def test_nodes_start_in_any_order_without_a_warning(apart: NodesApart, commander: str) -> None:
    for order in permutations(("plant", commander, "recorder")):
        for node in order:
            given = {"robot": ROBOTS[commander]} if node == "plant" else {}
            apart.start(node, **given)
        apart.wait_state(commander, *AT_REST[commander])
        apart.wait_state("plant", "running")
        apart.wait_states(40)
        apart.end()
        assert apart.complaints == [], (order, apart.said)


@pytest.mark.parametrize(("commander", "killed", "phase"), some_fast(KILLS, *QUICK_KILLS))
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
        waiting = apart.wait_state(commander, "waiting", timeout=20.0)
        assert "odom" in waiting["message"] or "joint_states" in waiting["message"], waiting
        apart.start("plant", robot=ROBOTS[commander])
    elif killed == commander:
        resting = apart.wait_state("plant", "resting", timeout=20.0)
        assert resting["reason"] in ("timeout", "no_command")
        apart.start(commander)
        apart.wait_state(commander, *AT_REST[commander])
    else:
        apart.start("recorder")
    apart.fly(commander, NEW[commander])
    assert apart.status("plant")["state"] == "running"
    apart.end()
    assert not any("Traceback" in line for line in apart.complaints), apart.said


@pytest.mark.parametrize("late", some_fast(["plant", "planner", "coordinated_control"], "plant"))
def test_a_partner_that_comes_late_is_met(apart: NodesApart, late: str) -> None:
    come_late(apart, "planner" if late == "plant" else late, late, 3.0)


@pytest.mark.slow
@pytest.mark.parametrize("commander", ROBOTS)
@pytest.mark.parametrize("late", ["plant", "commander"])
def test_a_partner_that_comes_late_by_half_a_minute_is_met(
    apart: NodesApart, commander: str, late: str
) -> None:
    come_late(apart, commander, commander if late == "commander" else late, 30.0)


def come_late(apart: NodesApart, commander: str, late: str, seconds: float) -> None:
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
    apart.harness.spin_for(seconds)
    starts[late]()
    apart.fly(commander, NEW[commander])
    apart.end()
    assert apart.complaints == []


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
        waiting = apart.wait_state(commander, "waiting", timeout=20.0)
        assert "the plant, which is inactive" in waiting["message"]
    assert apart.change(name, Transition.TRANSITION_ACTIVATE)
    apart.wait_state(commander, *AT_REST[commander], timeout=20.0)
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
