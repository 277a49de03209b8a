"""A planner that plans beside the flight: states are answered meanwhile, from a robot at rest."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from std_srvs.srv import Trigger
from support.planner_flight import HERE, NEAR, TURNED, Flight, values_of
from support.ros_harness import Harness

from spacerobot_ros.planning import METHODS, Cancellation, GaitSchedule, PlanRequest
from spacerobot_ros.planning.methods.lie_bracket import LieBracketGait

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
    return Flight(harness, {"plan_in_background": True, "abort_time": 0.5})


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
    # One command for each state, each with its stamp, as ever.
    flight.plant.trigger_deactivate()
    flight.harness.settle(flight.probe)
    stamps = [m.header.stamp for m in flight.probe.messages["joint_commands"]]
    assert stamps == [m.header.stamp for m in flight.probe.messages["joint_states"]]
    assert flight.probe.count("gait_schedule") >= 1


def test_a_new_goal_in_flight_is_planned_from_rest(flight: Flight, gate: Gate) -> None:
    gate.open.set()
    flight.send(NEAR)
    flight.start()
    flight.wait("executing")
    flight.ticks(5)
    gate.open.clear()
    gate.waiting.clear()
    flight.send(TURNED)
    flight.harness.spin_until(gate.waiting.is_set, "the planner plans again")
    resting = flight.probe.count("joint_commands")
    flight.ticks(20)
    assert not any(speeds(flight, resting + 1))
    assert max(map(abs, flight.probe.last("joint_states").velocity)) == 0.0
    gate.open.set()
    flight.wait("reached")
    distance, angle = flight.error_to(TURNED)
    assert distance < 1e-3
    assert angle < 1e-3
    # Nothing jumps: from tick to tick no faster than the gait itself accelerates.
    q = np.array([m.position for m in flight.probe.messages["joint_states"]])
    assert np.abs(np.diff(q, axis=0)).max() <= 0.05 * max(speeds(flight)) + 1e-12


def test_a_goal_that_is_refused_in_flight_leaves_the_earlier_one(flight: Flight) -> None:
    flight.send(NEAR)
    flight.start()
    flight.wait("executing")
    flight.ticks(5)
    flight.send(FAR)
    refused = flight.wait("refused")
    assert "The earlier goal is still pursued." in refused.message
    assert values_of(flight.wait("reached"))["corrections"] == "0"
    assert flight.error_to(NEAR)[0] < 1e-3


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


def test_turning_back_is_the_same_flight(flight: Flight) -> None:
    assert values_of(flight.decide(NEAR))["state"] == "reached"
    assert values_of(flight.decide(HERE))["state"] == "reached"
    assert flight.error_to(HERE)[0] < 1e-3


def test_a_defect_of_a_method_is_seen(harness: Harness, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: Any, **__: Any) -> GaitSchedule:
        raise ZeroDivisionError("a defect")

    monkeypatch.setattr(LieBracketGait, "plan", broken)
    flight = Flight(harness, {"plan_in_background": True})
    flight.send(NEAR)
    flight.start()
    with pytest.raises(ZeroDivisionError, match="a defect"):
        flight.wait("executing")


def test_a_node_that_ends_has_its_search_given_up(harness: Harness) -> None:
    flight = Flight(
        harness, {"plan_in_background": True, "method": "optimal", "optimal.cache": 0}, {}
    )
    flight.send(([0.0, 0.0, 0.0], [0.05, -0.03, 0.02]))
    flight.start()
    before = threading.active_count()
    flight.harness.spin_until(lambda: threading.active_count() > before, "the search")
    flight.ticks(200)
    assert flight.states[-1] != "executing", "it searches still"
    began = time.monotonic()
    flight.planner.trigger_deactivate()
    assert time.monotonic() - began < 1.6
    flight.harness.spin_until(lambda: threading.active_count() <= before, "the thread is gone")


@pytest.mark.parametrize("background", [False, True])
def test_a_plan_after_an_abort_is_wanted_again(
    harness: Harness, monkeypatch: pytest.MonkeyPatch, background: bool
) -> None:
    plan = LieBracketGait.plan

    def searching(
        method: LieBracketGait, request: PlanRequest, cancellation: Cancellation
    ) -> GaitSchedule:
        cancellation.raise_if_requested()
        return plan(method, request, cancellation)

    monkeypatch.setattr(LieBracketGait, "plan", searching)
    flight = Flight(harness, {"plan_in_background": background, "abort_time": 0.5})
    client = flight.probe.create_client(Trigger, "/planner/abort")
    flight.send(NEAR)
    flight.start()
    flight.wait("executing")
    assert harness.call(client, Trigger.Request()).success
    assert values_of(flight.decide(NEAR))["state"] == "reached"
