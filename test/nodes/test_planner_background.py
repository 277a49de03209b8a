"""A planner that plans beside a flight in real time: states are answered meanwhile, at rest."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from std_srvs.srv import Trigger
from support.planner_flight import NEAR, Flight
from support.ros_harness import Harness, nanoseconds

from spacerobot_ros.planning import METHODS, GaitSchedule
from spacerobot_ros.planning.methods.lie_bracket import LieBracketGait

REAL_TIME = {"time_mode": "realtime"}
THOROUGH = {"optimal.cache": 0, "optimal.answers": 9999, "optimal.starts": 9999}
FAR = ([50.0, 0.0, 0.0], [0.0, 0.0, 0.0])


class Gate:
    """Holds every plan back until it is opened."""

    def __init__(self) -> None:
        self.open = threading.Event()
        self.waiting = threading.Event()

    def held(self, plan: Callable[..., GaitSchedule]) -> Callable[..., GaitSchedule]:
        def wait(*args: Any, **options: Any) -> GaitSchedule:
            self.waiting.set()
            assert self.open.wait(30.0)
            return plan(*args, **options)

        return wait


@pytest.fixture
def gate(monkeypatch: pytest.MonkeyPatch) -> Iterator[Gate]:
    gate = Gate()
    assert METHODS["lie_bracket"] is LieBracketGait
    monkeypatch.setattr(LieBracketGait, "plan", gate.held(LieBracketGait.plan))
    yield gate
    gate.open.set()


@pytest.fixture
def flight(harness: Harness) -> Flight:
    return Flight(harness, {"abort_time": 0.5}, REAL_TIME)


def speeds(flight: Flight, since: int = 0) -> list[float]:
    """The largest commanded velocities, by state."""
    return [max(map(abs, m.velocity)) for m in flight.probe.messages["joint_commands"][since:]]


def test_states_are_answered_at_rest_until_the_plan_is_there(flight: Flight, gate: Gate) -> None:
    flight.send(NEAR)
    flight.start()
    flight.harness.spin_until(gate.waiting.is_set, "the planner plans")
    flight.ticks(40)
    assert flight.states[-1] != "executing"
    assert not any(speeds(flight))
    gate.open.set()
    flight.wait("executing")
    flight.wait("reached")
    assert flight.error_to(NEAR)[0] < 1e-3
    assert any(speeds(flight))
    # One command for a state, with its stamp; where states pile up, for the last of them.
    flight.plant.trigger_deactivate()
    flight.harness.settle(flight.probe)
    stamps = [m.header.stamp for m in flight.probe.messages["joint_commands"]]
    states = [nanoseconds(m.header.stamp) for m in flight.probe.messages["joint_states"]]
    answered = [nanoseconds(stamp) for stamp in stamps]
    assert answered == sorted(set(answered))
    assert set(answered) <= set(states)
    assert len(answered) > 0.5 * len(states)
    assert flight.probe.count("gait_schedule") >= 1


def test_an_abort_drops_what_is_being_planned(flight: Flight, gate: Gate) -> None:
    client = flight.probe.create_client(Trigger, "/planner/abort")
    flight.send(NEAR)
    flight.start()
    flight.harness.spin_until(gate.waiting.is_set, "the planner plans")
    answer = flight.harness.call(client, Trigger.Request())
    assert answer.success
    gate.open.set()
    flight.ticks(40)
    assert flight.states[-1] == "aborted"
    assert not any(speeds(flight))
    # Another goal is taken up as ever.
    flight.decide(NEAR)
    assert flight.states[-1] == "reached"


def test_a_node_that_ends_has_its_search_given_up(harness: Harness) -> None:
    flight = Flight(
        harness,
        {"robot": "seven_joint_arm", "method": "optimal", **THOROUGH},
        {"robot": "seven_joint_arm", **REAL_TIME},
    )
    flight.send(([0.0, 0.0, 0.0], [0.5, -0.3, 0.2]))
    flight.start()
    before = threading.active_count()
    flight.harness.spin_until(lambda: threading.active_count() > before, "the search")
    flight.ticks(10)
    assert flight.states[-1] != "executing", "it searches still"
    began = time.monotonic()
    flight.planner.trigger_deactivate()
    assert time.monotonic() - began < 1.6
    flight.harness.spin_until(lambda: threading.active_count() <= before, "the thread is gone")
