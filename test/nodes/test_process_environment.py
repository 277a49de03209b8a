"""A node's own process: its environment, its start, its end, and what it knows of frames."""

from __future__ import annotations

import gc
import os
import re
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import rclpy
from lifecycle_msgs.msg import State

from spacerobot_ros.bag import QosProfile
from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.events import Event, EventKind
from spacerobot_ros.nodes import PlantNode
from spacerobot_ros.nodes.common import process
from spacerobot_ros.nodes.common.process import run_node, start_ros
from spacerobot_ros.nodes.replay import _publisher_qos
from spacerobot_ros.termination import Terminated

MIB = 2**20
DISCOVERY = ("ROS_AUTOMATIC_DISCOVERY_RANGE", "ROS_STATIC_PEERS", "ROS_LOCALHOST_ONLY")
TRANSPORT = (
    *("FASTDDS_BUILTIN_TRANSPORTS", "FASTDDS_DEFAULT_PROFILES_FILE"),
    "FASTRTPS_DEFAULT_PROFILES_FILE",
)


@pytest.fixture
def variables(monkeypatch: pytest.MonkeyPatch) -> Callable[..., dict[str, str]]:
    """Return a function that has discovery chosen, and returns the variables that are set then."""

    def choose(
        choose: Callable[[], None], free: float | None = 64 * MIB, **given: str
    ) -> dict[str, str]:
        for name in (*DISCOVERY, *TRANSPORT, "ROS_DOMAIN_ID"):
            monkeypatch.setenv(name, given.get(name, ""))

        def statvfs(path: object) -> Any:
            assert str(path) == "/dev/shm"
            if free is None:
                raise FileNotFoundError(path)
            return SimpleNamespace(f_bavail=int(free) // 4096, f_frsize=4096)

        monkeypatch.setattr(os, "statvfs", statvfs)
        choose()
        names = (*DISCOVERY, *TRANSPORT)
        return {name: os.environ[name] for name in names if os.environ.get(name)}

    return choose


@pytest.mark.parametrize("own", [None, *DISCOVERY, "ROS_DOMAIN_ID"])
def test_discovery_is_on_this_machine_unless_the_user_chose(
    variables: Callable[..., dict[str, str]], own: str | None
) -> None:
    given = {} if own is None else {own: "7"}
    kept = {name: text for name, text in given.items() if name in DISCOVERY}
    local = kept or {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    assert variables(process.use_loopback_discovery, **given) == local


@pytest.mark.parametrize(
    ("free", "writable", "known"),
    [
        (2 * MIB, True, None),
        (2 * MIB - 4096, True, 2044),
        (64 * MIB, False, 0),
        (None, True, 0),
    ],
)
def test_messages_go_through_sockets_where_shared_memory_is_short(
    variables: Callable[..., dict[str, str]],
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    free: float | None,
    writable: bool,
    known: int | None,
) -> None:
    monkeypatch.setattr(os, "access", lambda path, mode: writable)
    found = variables(process.use_loopback_discovery, free)
    assert found.get("FASTDDS_BUILTIN_TRANSPORTS") == (None if known is None else "UDPv4")
    if known is not None:
        assert f"/dev/shm has {known} kB that can be used: messages go through" in caplog.text
    for name in TRANSPORT:
        assert variables(process.use_loopback_discovery, free, **{name: "mine"})[name] == "mine"
        assert os.environ["FASTDDS_BUILTIN_TRANSPORTS"] in ("", "mine")


@pytest.mark.parametrize("domain", ["", "0", "232", "233", "-1", "x", "1.5", "\N{SUPERSCRIPT TWO}"])
def test_domains_are_numbers_that_have_ports(monkeypatch: pytest.MonkeyPatch, domain: str) -> None:
    started: list[Any] = []
    monkeypatch.setenv("ROS_DOMAIN_ID", domain)
    monkeypatch.setattr(rclpy, "init", lambda **options: started.append(options["args"]))
    if domain in ("", "0", "232"):
        start_ros(["a"])
        assert started == [["a"]]
        return
    with pytest.raises(SpaceRobotError) as refused:
        start_ros([])
    assert str(refused.value) == (
        f"ROS_DOMAIN_ID is '{domain}'; it must be a whole number from 0 to 232."
    )
    assert started == []


class Time:
    """Wall time, which passes when something is waited for."""

    now = 0.0

    def monotonic(self) -> float:
        return self.now


TIME = Time()


class Node:
    """A node that notes what is done with it; the acknowledgement of a publisher takes 0.75 s."""

    def __init__(self, end: Callable[[Node], None]) -> None:
        self.end, self.done = end, list[Any]()
        self.on_end: Callable[[int], None] = lambda code: None
        self.interrupt = self.drain = lambda *_: None
        self.publishers = [self.publisher(readers) for readers in (0, 1, 2, 1)]

    def publisher(self, readers: int) -> Any:
        def wait(limit: Any) -> None:
            self.done.append(("acknowledged", limit.nanoseconds / 1e9))
            TIME.now += 0.75

        return SimpleNamespace(get_subscription_count=lambda: readers, wait_for_all_acked=wait)

    def finalize(self) -> None:
        self.done.append("finalised")

    def destroy_node(self) -> None:
        self.done.append("destroyed")


@pytest.fixture
def alone(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Have nodes run without ROS; the executor calls the node's ``end`` instead of spinning."""
    shut: list[str] = []

    class Executor:
        def add_node(self, node: Node) -> None:
            self.node = node

        def spin_until_future_complete(self, done: Any, timeout_sec: float) -> None:
            assert timeout_sec == 0.5
            self.node.end(self.node)

    monkeypatch.setattr(process, "start_ros", lambda arguments: None)
    monkeypatch.setattr(process, "use_loopback_discovery", lambda: None)
    monkeypatch.setattr(process, "EventsExecutor", Executor)
    monkeypatch.setattr(process, "time", TIME)
    monkeypatch.setattr(rclpy, "try_shutdown", lambda: shut.append("shut down"))
    for name in ("collect", "freeze"):
        monkeypatch.setattr(gc, name, lambda: None)
    return shut


@pytest.mark.parametrize("code", [0, 3])
def test_a_node_that_ends_by_itself_gives_its_exit_code(alone: list[str], code: int) -> None:
    """Its last messages are waited for, for one second in all; nobody reads the first topic."""
    node = Node(lambda node: node.on_end(code))
    assert run_node(lambda: node) == code  # type: ignore[arg-type, return-value]
    waits = [("acknowledged", 1.0), ("acknowledged", 0.25)]
    assert node.done == ["finalised", *waits, "destroyed"]
    assert alone == ["shut down"]


def test_a_signal_ends_a_node_in_order_and_before_its_start_at_once(
    alone: list[str], capfd: pytest.CaptureFixture[str]
) -> None:
    node = Node(lambda node: os.kill(os.getpid(), signal.SIGTERM))
    assert run_node(lambda: node) == 0  # type: ignore[arg-type, return-value]
    assert node.done[-1] == "destroyed"

    def killed() -> Any:
        raise Terminated(signal.SIGTERM)

    assert run_node(killed) == 0

    def refused() -> Any:
        raise SpaceRobotError("There is no robot.")

    assert run_node(refused) == 2
    assert capfd.readouterr().err == "There is no robot.\n"
    assert alone == ["shut down"] * 3


def test_a_caller_that_is_guarded_itself_hears_of_the_signal(
    alone: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    @contextmanager
    def guarded() -> Iterator[bool]:
        yield False

    def killed() -> Any:
        raise Terminated(signal.SIGINT)

    monkeypatch.setattr(process, "guarded", guarded)
    with pytest.raises(Terminated):
        run_node(killed)


def test_ros_that_does_not_start_is_one_sentence_and_exit_code_2(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(**options: Any) -> None:
        raise RuntimeError("no such file")

    monkeypatch.setenv("ROS_DOMAIN_ID", "")
    monkeypatch.setattr(process, "use_loopback_discovery", lambda: None)
    monkeypatch.setattr(rclpy, "init", fail)
    assert run_node(lambda: 1 / 0) == 2  # type: ignore[arg-type, return-value]
    assert capsys.readouterr().err == "ROS 2 does not start: no such file\n"


# -- transitions that fail ----------------------------------------------------------------------


class Failing(PlantNode):
    """A plant that cannot be configured, and whose report of that fails, too."""

    events: list[Event]
    reported: list[str]

    def configure(self) -> None:
        raise ZeroDivisionError("one by none")

    def report_event(self, event: Event) -> None:
        self.events.append(event)

    def on_failure(self, message: str, error: Exception) -> None:
        self.reported.append(message)
        raise KeyError("no place for it")


def test_a_transition_that_raises_anything_is_reported_and_may_be_tried_again(
    ros_context: rclpy.Context,
) -> None:
    Failing.events, Failing.reported = [], []
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
        assert node.reported == [str(node.fault)] * 4, (
            "when it fails, and when everything is released"
        )
    finally:
        node.get_logger().set_level(0)
        node.destroy_node()


@pytest.mark.parametrize(
    ("recorded", "depth"),
    [
        (QosProfile(depth=7, durability="transient_local"), 7),
        (QosProfile(depth=0, durability="transient_local"), 1),
        (QosProfile(depth=0, reliability="best_effort"), 100),
        (QosProfile(depth=10_001), 10_000),
    ],
)
def test_a_replay_offers_what_was_recorded_in_bounds(recorded: QosProfile, depth: int) -> None:
    qos = _publisher_qos(recorded)
    assert qos.depth == depth
    assert qos.durability.name.lower() == recorded.durability
    assert qos.reliability.name.lower() == recorded.reliability
