"""Nodes killed in mid-manoeuvre and started again: each joins in, and the goal is met."""

from __future__ import annotations

import os
import random
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from spacerobot_ros.app.processes import ProcessStack
from spacerobot_ros.app.run import ros
from spacerobot_ros.app.scenario import load_scenario
from spacerobot_ros.planning import Goal
from spacerobot_ros.recording import Bag, RecordingError, read_bag
from spacerobot_ros.recording.salvage import salvage_bag

pytestmark = pytest.mark.slow

KILLS = 20
TIMEOUT = 0.5
TICK = 0.05
PACE = 4.0
PATIENCE = 300.0
GOAL = Goal.checked([0.1, -0.05, 0.02], [0.0, 0.0, 0.1, 0.995])


class Flight:
    """Sliding masses in real time, one process a node, and what kills and restarts them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.bags = [folder / "flight.mcap"]
        plant = {"time_mode": "realtime", "real_time_factor": PACE, "command_timeout": TIMEOUT}
        planner = {
            "method": "lie_bracket",
            "resume_file": str(folder / "goal.json"),
            "position_tolerance": 1e-3,
            "attitude_tolerance": 1e-3,
            "max_corrections": 10,
            "lie_bracket.t1": 20.0,
            "lie_bracket.cycles": 160,
        }
        scenario = (
            load_scenario("sliding_masses")
            .with_overrides("plant", plant)
            .with_overrides("planner", planner)
            .with_overrides("recorder", {"flush_period": 0.1})
        )
        self.stack = ProcessStack(scenario, self.bags[0])

    def kill(self, name: str) -> None:
        os.killpg(self.stack.processes[name].pid, signal.SIGKILL)
        self.stack.processes[name].wait()

    def restart(self, name: str) -> None:
        if name == "recorder":
            self.bags.append(self.folder / f"flight_{len(self.bags)}.mcap")
            self.stack.launch(name, bag=str(self.bags[-1]))
        elif name == "plant":
            self.stack.launch(name, resume_bag=str(self.bags[-1]), autostart=True)
        else:
            self.stack.launch(name)

    def spin(self, condition: Callable[[], Any], what: str) -> None:
        deadline = time.monotonic() + PATIENCE
        while not condition():
            assert time.monotonic() < deadline, what
            self.stack.executor.spin_once(timeout_sec=0.02)

    def pass_time(self, wall: float) -> None:
        end = time.monotonic() + wall
        self.spin(lambda: time.monotonic() >= end, "time")

    @property
    def decided(self) -> bool:
        return bool(self.stack.operator.done.done())


@pytest.fixture
def flight(ros_domain: int, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Flight]:
    monkeypatch.setenv("ROS_DOMAIN_ID", str(ros_domain))
    with ros(private=False):
        flight = Flight(tmp_path)
        try:
            yield flight
        finally:
            flight.stack.close()


def after(stack: ProcessStack, time_ns: int) -> Callable[[], bool]:
    return lambda: stack.time_ns > time_ns


@pytest.mark.parametrize("name", ["planner", "plant", "recorder"])
def test_a_node_killed_at_random_moments_joins_in_again(flight: Flight, name: str) -> None:
    rng = random.Random(name)
    stack = flight.stack
    stack.start(GOAL)
    flight.spin(lambda: stack.operator.gait, "the goal is flown")
    away: list[tuple[float, float]] = []
    for _ in range(KILLS):
        flight.pass_time(rng.uniform(0.1, 2.0))
        assert not flight.decided, "in mid-manoeuvre"
        flight.kill(name)
        killed = stack.time_ns / 1e9
        flight.pass_time(2 * TIMEOUT / PACE)
        before = stack.time_ns
        away.append((killed, before / 1e9))
        flight.restart(name)
        if name == "plant":
            flight.spin(after(stack, before), "time goes on")
        elif name == "planner":
            flight.spin(lambda: stack.operator.node.count_publishers("joint_commands"), "it is up")
        else:
            flight.spin(flight.bags[-1].exists, "the next bag")
    flight.spin(lambda: flight.decided, "the goal is decided")
    assert stack.operator.status["state"] == "reached", stack.operator.sentence
    stack.finish()
    bags = [whole(bag) for bag in flight.bags]
    last = bags[-1]["/odom"]
    position = [last.field(f"pose.pose.position.{x}")[-1] for x in "xyz"]
    assert np.linalg.norm(position - GOAL.position) <= 1e-3
    spoken = [bag for bag in bags if "/joint_states" in bag.topics]
    assert len(spoken) > len(bags) / 2, "few recorders were killed before their first chunk"
    if name == "planner":
        for bag in spoken:
            assert_at_rest_while_away(bag, away)


def whole(path: Path) -> Bag:
    """Read a bag; one whose recorder was killed is salvaged first."""
    try:
        return read_bag(path)
    except RecordingError:
        return read_bag(salvage_bag(path).path)


def assert_at_rest_while_away(bag: Bag, away: list[tuple[float, float]]) -> None:
    """Joints rest from the timeout after their commander was killed, until it is started again."""
    states = bag["/joint_states"]
    speed = np.abs(np.asarray(states.field("velocity"))).max(axis=1)
    seen = 0
    for killed, started in away:
        chosen = (states.stamp > killed + TIMEOUT + 3 * TICK) & (states.stamp <= started)
        seen += int(chosen.sum())
        assert not speed[chosen].any()
    assert seen > KILLS
