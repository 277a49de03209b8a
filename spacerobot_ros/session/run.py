"""Fly a scenario: start the nodes, send the goal, record, measure, sum up."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import rclpy
from rclpy.signals import SignalHandlerOptions

from spacerobot_ros.flight.reading import (
    open_flight_bag,
    read_flight,
    require_states,
    with_propellant,
)
from spacerobot_ros.flight.scenario import Scenario
from spacerobot_ros.measures import Outcome
from spacerobot_ros.nodes.common.process import use_loopback_discovery, use_private_discovery
from spacerobot_ros.session.processes import MultiProcessStack
from spacerobot_ros.session.stack import InProcessStack, Stack
from spacerobot_ros.termination import ended_on_request
from spacerobot_ros.times import SECOND

Progress = Callable[[float, float], None]
"""Called with simulated time and the time the present schedule ends, s."""


@dataclass(frozen=True)
class RunResult:
    """What a run came to. ``summary`` is the object that ``--json`` writes."""

    summary: dict[str, Any]

    @property
    def succeeded(self) -> bool:
        """Whether the goal was reached within tolerance."""
        return bool(self.summary["succeeded"])

    @property
    def sentence(self) -> str:
        """How it ended."""
        return str(self.summary["message"])


@contextmanager
def ros(*, private: bool) -> Iterator[None]:
    """Have rclpy initialised, signals left to Python; discovery private to us or on loopback."""
    (use_private_discovery if private else use_loopback_discovery)()
    quiet = ["--ros-args", "--log-level", "WARN"]
    rclpy.init(args=quiet, signal_handler_options=SignalHandlerOptions.NO)
    try:
        yield
    finally:
        rclpy.try_shutdown()


def make_stack(
    scenario: Scenario, bag: Path | None, *, processes: bool, namespace: str = ""
) -> Stack:
    """Return the stack of a scenario, in this process or with a process for each node.

    Raises
    ------
    SpaceRobotError
        A parameter or the robot is refused, or a node does not start.
    """
    stack = MultiProcessStack if processes else InProcessStack
    return stack(scenario, bag, namespace)


def run_scenario(
    scenario: Scenario,
    bag: Path,
    progress: Progress | None = None,
    *,
    processes: bool = False,
    longest: float = math.inf,
) -> RunResult:
    """Fly a scenario from its initial state to its goal, in this process.

    ``processes`` gives each node a process of its own instead. A flight of ``longest`` s of
    simulated time and more is interrupted at one of the looks at it, five a second of wall time.

    SIGINT, SIGTERM and SIGHUP end the flight early; the flight until then is recorded and summed
    up. Before it has begun they raise what they would without it.

    Raises
    ------
    SpaceRobotError
        A parameter, the robot or the recording is refused.
    """
    private = not processes and scenario.lockstep
    with ros(private=private):
        stack = make_stack(scenario, bag, processes=processes)
        try:
            with ended_on_request(at_once=stack.interrupt) as stopped:
                began = time.perf_counter()
                stack.start(scenario.goal)
                time_limit = 0.0
                if "coordinated_control" in scenario.commanders:
                    time_limit = scenario.controller.time_limit

                def look() -> bool:
                    if progress is not None:
                        with suppress(OSError):  # A closed terminal ends no flight.
                            progress(stack.time_ns / SECOND, stack.client.ends_at or time_limit)
                    return stopped() or stack.time_ns / SECOND >= longest

                stack.spin(look)
                wall_time = time.perf_counter() - began
                if progress is not None and not stopped():
                    flown = stack.time_ns / SECOND
                    progress(flown, flown)
                stack.finish()
                return RunResult(_summary(stack, wall_time))
        finally:
            stack.close()


def _summary(stack: Stack, wall_time: float) -> dict[str, Any]:
    """Return the measures of a finished flight: from its bag, and the client's about its goal."""
    scenario, client = stack.scenario, stack.client
    assert stack.bag is not None
    bag = open_flight_bag(stack.bag)
    flight = read_flight(bag)
    require_states(bag, flight)
    outcome, message = client.outcome or Outcome.INTERRUPTED, client.sentence
    if outcome is Outcome.INTERRUPTED:
        message = f"Interrupted after {flight.duration:.6g} s of simulated time."
    flight = replace(
        flight,
        scenario=scenario,
        outcome=outcome,
        message=message,
        goal=scenario.goal,
        end_effector_goal=scenario.end_effector_goal,
        status=client.status,
        gait=client.gait,
        plan_time=stack.statistics.plan_time_s,
        wall_time=wall_time,
    )
    flight = with_propellant(flight, scenario.plant.thrusters, bag.names("thrusters"))
    recorded = {"messages_recorded": bag.message_count, "bag": str(bag.path)}
    return {**flight.summary(), **recorded}
