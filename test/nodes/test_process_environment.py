"""The environment of a node's process, and transitions that fail."""

from __future__ import annotations

import ast
import inspect
import os
import re
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest
import rclpy
from lifecycle_msgs.msg import State
from rclpy.lifecycle import LifecycleNode
from support.command_line import finished

from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.events import Event, EventKind
from spacerobot_ros.nodes import (
    CoordinatedControlNode,
    PlannerNode,
    PlantNode,
    RecorderNode,
    ReplayNode,
)
from spacerobot_ros.nodes.common import process
from spacerobot_ros.nodes.common.node import FlightNode
from spacerobot_ros.nodes.common.process import start_ros
from spacerobot_ros.nodes.viewer.node import ViewerNode

DISCOVERY = ("ROS_AUTOMATIC_DISCOVERY_RANGE", "ROS_STATIC_PEERS", "ROS_LOCALHOST_ONLY")
FILES = "FASTDDS_DEFAULT_PROFILES_FILE", "FASTRTPS_DEFAULT_PROFILES_FILE"
TRANSPORT = "FASTDDS_BUILTIN_TRANSPORTS", *FILES


@pytest.fixture(autouse=True)
def _no_choices(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in (*DISCOVERY, *TRANSPORT, "ROS_DOMAIN_ID"):
        monkeypatch.setenv(name, "")


@pytest.mark.parametrize("own", ["", "ROS_AUTOMATIC_DISCOVERY_RANGE", *TRANSPORT])
def test_messages_stay_on_this_machine_unless_the_user_chose(
    monkeypatch: pytest.MonkeyPatch, own: str
) -> None:
    """By settings of Fast DDS that name the loopback interface, unless the user has others."""
    if own:
        monkeypatch.setenv(own, "LOCALHOST")
    process.use_loopback_discovery()
    process.use_loopback_discovery()  # As a child of this process does.
    files = [os.environ[name] for name in FILES]
    if own in FILES:
        assert os.environ[DISCOVERY[0]] == "LOCALHOST"
        assert sorted(files) == ["", "LOCALHOST"]
    else:
        assert os.environ[DISCOVERY[0]] == "SYSTEM_DEFAULT"
        text = Path(files[0]).read_text()
        assert files[0] == files[1]
        assert "<address>127.0.0.1</address>" in text
        assert "<useBuiltinTransports>false</useBuiltinTransports>" in text


@pytest.mark.parametrize(
    ("own", "value"), [(DISCOVERY[0], "SUBNET"), (DISCOVERY[1], "10.0.0.7"), (DISCOVERY[2], "1")]
)
@pytest.mark.parametrize("transport", ["", "LARGE_DATA"])
def test_a_chosen_network_is_kept(
    monkeypatch: pytest.MonkeyPatch, own: str, value: str, transport: str
) -> None:
    monkeypatch.setenv(own, value)
    monkeypatch.setenv(TRANSPORT[0], transport)
    process.use_loopback_discovery()
    assert {name: os.environ[name] for name in DISCOVERY if os.environ[name]} == {own: value}
    assert os.environ[TRANSPORT[0]] == (transport or "UDPv4")
    assert "127.0.0.1" not in Path(os.environ[FILES[0]]).read_text()


def test_other_middleware_has_only_its_range(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rclpy.get_rmw_implementation_identifier", lambda: "rmw_cyclonedds_cpp")
    process.use_loopback_discovery()
    assert os.environ[DISCOVERY[0]] == "LOCALHOST"
    assert [os.environ[name] for name in TRANSPORT] == ["", "", ""]


@pytest.mark.parametrize("domain", ["233", "-1", "x", "1.5", "\N{SUPERSCRIPT TWO}"])
def test_domains_are_numbers_that_have_ports(monkeypatch: pytest.MonkeyPatch, domain: str) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", domain)
    with pytest.raises(SpaceRobotError) as refused:
        start_ros([])
    assert str(refused.value) == (
        f"ROS_DOMAIN_ID is '{domain}'; it must be a whole number from 0 to 232."
    )


@pytest.mark.slow
@pytest.mark.parametrize("options", ["ro", "size=256k"])
def test_a_flight_without_shared_memory_reaches_its_goal(
    options: str, tmp_path: Path, own_domain: None
) -> None:
    """In a mount namespace of its own, which takes the rights of root."""
    unshare = shutil.which("unshare")
    if unshare is None or subprocess.run([unshare, "-m", "true"], check=False).returncode:
        pytest.skip("no mount namespaces here")
    command = (
        f"mount -t tmpfs -o {options} none /dev/shm && exec {sys.executable} -m spacerobot_ros "
        f"run sliding_masses --bag {tmp_path / 'flight.mcap'} --nodes"
    )
    ended = finished([unshare, "-m", "sh", "-c", command], timeout=120)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    assert "The goal is reached" in ended.stdout


# -- transitions that fail ----------------------------------------------------------------------


class Failing(PlantNode):
    """A plant that cannot be configured, and whose report of that fails, too."""

    events: list[Event]
    failures: list[str]

    def configure(self) -> None:
        raise ZeroDivisionError("one by none")

    def report_event(self, event: Event) -> None:
        self.events.append(event)

    def on_failure(self, message: str, error: Exception) -> None:
        self.failures.append(message)
        raise KeyError("no place for it")


def test_a_transition_that_raises_anything_is_reported_and_may_be_tried_again(
    ros_context: rclpy.Context,
) -> None:
    Failing.events, Failing.failures = [], []
    node = Failing(context=ros_context, autostart=False)
    try:
        node.get_logger().set_level(50)
        file = re.escape(Path(__file__).name)
        message = (
            rf"Node 'plant' has failed: ZeroDivisionError: one by none \({file}, line [0-9]+\)\."
        )
        for _ in range(2):
            node.trigger_configure()
            assert node.lifecycle_state == State.PRIMARY_STATE_UNCONFIGURED
            assert re.fullmatch(message, str(node.fault))
        failed = [event for event in node.events if event.kind is EventKind.FAILED]
        assert [(event.message, event.level) for event in failed] == [(str(node.fault), 2)] * 2
        assert node.failures == [str(node.fault)] * 4, (
            "when it fails, and when everything is released"
        )
    finally:
        node.get_logger().set_level(0)
        node.destroy_node()


NODES = (CoordinatedControlNode, PlannerNode, PlantNode, RecorderNode, ReplayNode, ViewerNode)

RELEASED = {"_state_machine"}
"""Set to None when the node is destroyed: it would keep the node in the graph."""


def assigned(kind: type) -> set[str]:
    """Return the attributes of ``self`` that the methods of a class assign."""
    tree = ast.parse(textwrap.dedent(inspect.getsource(kind)))
    return {
        node.attr
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute)
        and isinstance(node.ctx, ast.Store)
        and isinstance(node.value, ast.Name)
        and node.value.id == "self"
    }


def test_no_attribute_of_rclpy_is_assigned_and_no_private_method_replaced(
    ros_context: rclpy.Context,
) -> None:
    node = LifecycleNode("plain", context=ros_context)
    inherited = {*vars(node), *(name for name in dir(LifecycleNode) if not name.startswith("__"))}
    node.destroy_node()
    assert {"_clock", "_timers", "_parameters", "_logger"} <= inherited
    for kind in NODES:
        # A node's class and its bases down to rclpy's.
        own = [each for each in kind.__mro__ if issubclass(each, FlightNode)]
        found = {name for each in own for name in assigned(each)}
        assert {"_failure", "fault"} <= found
        assert found & inherited <= RELEASED, kind
        replaced = {name for each in own for name in vars(each)} & inherited
        assert not [name for name in replaced if name.startswith("_")], kind
