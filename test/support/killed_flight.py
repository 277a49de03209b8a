"""A flight in real time, one process a node, whose nodes are killed and started again."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from spacerobot_ros.bag import Bag, RecordingError, read_bag
from spacerobot_ros.bag.salvage import salvage_bag
from spacerobot_ros.scenario import Scenario
from spacerobot_ros.session.processes import MultiProcessStack

KILLS = 20
TIMEOUT = 0.5
"""After which a plant does without commands, simulated s."""

PACE = 4.0
"""Simulated over wall time."""

PATIENCE = 300.0

Away = list[tuple[float, float]]
"""When a node was killed, and when it was started again, simulated s."""


class Flight:
    """A scenario in real time, and what kills and restarts its nodes.

    Parameters
    ----------
    folder
        Of the bags.
    scenario
        What is flown.
    timeout
        After which the plant does without commands, simulated s. Where no commander is killed it
        is longer than any busy machine makes one wait.
    """

    def __init__(self, folder: Path, scenario: Scenario, timeout: float = TIMEOUT) -> None:
        self.folder = folder
        self.bags = [folder / "flight.mcap"]
        plant = {"time_mode": "realtime", "real_time_factor": PACE, "command_timeout": timeout}
        scenario = scenario.with_overrides("plant", plant).with_overrides(
            "recorder", {"flush_period": 0.1}
        )
        self.stack = MultiProcessStack(scenario, self.bags[0])

    def restart(self, name: str) -> None:
        if name == "recorder":
            self.bags.append(self.folder / f"flight_{len(self.bags)}.mcap")
            self.stack.launch(name, bag=str(self.bags[-1]))
        elif name == "plant":
            self.stack.launch(name, resume_bag=str(self.bags[-1]), autostart=True)
        else:
            self.stack.launch(name)

    def leave(self, name: str, timeouts: int = 2) -> tuple[float, float]:
        """Kill a node, start it again after some timeouts, and return when it was away."""
        self.stack.kill(name)
        killed = self.stack.time_ns / 1e9
        self.pass_time(timeouts * TIMEOUT / PACE)
        started = self.stack.time_ns / 1e9
        self.restart(name)
        return killed, started

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
        return self.stack.client.outcome is not None


def whole(path: Path) -> Bag:
    """Read a bag; one whose recorder was killed is salvaged first."""
    try:
        return read_bag(path)
    except RecordingError:
        return read_bag(salvage_bag(path).path)


def assert_at_rest_while_away(bag: Bag, away: Away, braking: float, rest: float = 0.0) -> None:
    """Joints rest (rates up to ``rest``) from the timeout, and ``braking`` (s) after it, until
    their commander is started again.
    """
    states = bag["/joint_states"]
    speed = np.abs(np.asarray(states.field("velocity"))).max(axis=1)
    seen = 0
    for killed, started in away:
        chosen = (states.stamp > killed + TIMEOUT + braking) & (states.stamp <= started)
        seen += int(chosen.sum())
        assert speed[chosen].max(initial=0.0) <= rest
    assert seen > KILLS
