"""Nodes killed in mid-manoeuvre and started again: each joins in, and the goal is met."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from support.killed_flight import (
    KILLS,
    PACE,
    TIMEOUT,
    Away,
    Flight,
    assert_at_rest_while_away,
    whole,
)

from spacerobot_ros.bag import Bag
from spacerobot_ros.measures import Outcome
from spacerobot_ros.planning import Goal
from spacerobot_ros.scenario import Scenario, load_scenario
from spacerobot_ros.session.live import ros
from spacerobot_ros.session.processes import MultiProcessStack

pytestmark = pytest.mark.slow

TICK = 0.05
LATE = 5.0
"""Wall s within which a commander that was not killed answers on a machine that does other things,
the longest wait for a processor among them. Where it is killed it is given TIMEOUT, simulated."""

GOAL = Goal.checked([0.1, -0.05, 0.02], [0.0, 0.0, 0.1, 0.995])


def scenario(folder: Path) -> Scenario:
    """Sliding masses that take long, and a planner that keeps its goal."""
    planner = {
        "method": "lie_bracket",
        "resume_file": str(folder / "goal.json"),
        "position_tolerance": 1e-3,
        "attitude_tolerance": 1e-3,
        "max_corrections": 10,
        "lie_bracket.t1": 20.0,
        "lie_bracket.cycles": 160,
    }
    return load_scenario("sliding_masses").with_overrides("planner", planner)


@pytest.fixture
def flight(
    ros_domain: int,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    request: pytest.FixtureRequest,
) -> Iterator[Flight]:
    monkeypatch.setenv("ROS_DOMAIN_ID", str(ros_domain))
    with ros():
        commands_end = request.node.callspec.params.get("name") != "recorder"
        timeout = TIMEOUT if commands_end else PACE * LATE
        flight = Flight(tmp_path, scenario(tmp_path), timeout)
        try:
            yield flight
        finally:
            flight.stack.close()


def plant_reasons(bag: Bag) -> set[str]:
    """Return the reasons that the plant has given for what it does."""
    if "/plant/status" not in bag.topics:
        return set()
    said = [
        {pair.key: pair.value for pair in status.values}
        for _, status in bag["/plant/status"].messages()
    ]
    return {values.get("reason", "") for values in said}


def after(stack: MultiProcessStack, time: float) -> Callable[[], bool]:
    return lambda: stack.time_ns > round(time * 1e9)


@pytest.mark.parametrize("name", ["planner", "plant", "recorder"])
def test_a_node_killed_at_random_moments_joins_in_again(flight: Flight, name: str) -> None:
    rng = random.Random(name)
    stack = flight.stack
    stack.start(GOAL)
    flight.spin(lambda: stack.client.gait, "the goal is flown")
    away: Away = []
    for _ in range(KILLS):
        flight.pass_time(rng.uniform(0.1, 2.0))
        assert not flight.decided, f"in mid-manoeuvre: {stack.client.message}"
        away.append(flight.leave(name))
        if name == "plant":
            flight.spin(after(stack, away[-1][1]), "time goes on")
        elif name == "planner":
            flight.spin(lambda: stack.client.node.count_publishers("joint_commands"), "it is up")
        else:
            flight.spin(flight.bags[-1].exists, "the next bag")
    flight.spin(lambda: flight.decided, "the goal is decided")
    if name == "recorder":
        grown = flight.bags[-1].stat().st_size + 5000
        flight.spin(lambda: flight.bags[-1].stat().st_size > grown, "the last one records")
    assert stack.client.outcome is Outcome.REACHED, stack.client.message
    stack.finish()
    bags = [whole(bag) for bag in flight.bags]
    last = bags[-1]["/odom"]
    position = [last.field(f"pose.pose.position.{x}")[-1] for x in "xyz"]
    assert np.linalg.norm(position - GOAL.position) <= 1e-3
    spoken = [bag for bag in bags if "/joint_states" in bag.topics]
    assert len(spoken) > len(bags) / 2, "few recorders were killed before their first chunk"
    if name == "planner":
        for bag in spoken:
            assert_at_rest_while_away(bag, away, 3 * TICK)
    elif name == "recorder":
        # Nobody else notices: the plant has had a command for every tick.
        reasons = set().union(*map(plant_reasons, spoken))
        assert reasons
        assert reasons <= {"", "no_command"}
