"""Flights of scenarios to their goals, recorded in bags, with or without ROS nodes."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from spacerobot_ros.bag import BagWriter, free_name
from spacerobot_ros.errors import SpaceRobotError, describe_exception
from spacerobot_ros.flight.lockstep import LockstepFlight
from spacerobot_ros.flight.saved import write_flight
from spacerobot_ros.scenario import Scenario
from spacerobot_ros.termination import graceful_shutdown

Progress = Callable[[float, float], None]
"""Function called with the simulated time and the end time of the current schedule, s."""


@dataclass(frozen=True)
class RunResult:
    """Result of a run; ``summary`` is the data written by ``--json``."""

    summary: dict[str, Any]

    @property
    def succeeded(self) -> bool:
        """Whether the goal was reached within tolerance."""
        return bool(self.summary["succeeded"])

    @property
    def message(self) -> str:
        """One-sentence description of the goal outcome."""
        return str(self.summary["message"])

    sentence = message
    """Earlier name of :attr:`message`."""


def run_scenario(
    scenario: Scenario,
    bag: Path,
    progress: Progress | None = None,
    *,
    nodes: bool = False,
    longest: float = math.inf,
) -> RunResult:
    """Fly a scenario from its initial state to its goal, and record a bag.

    The flight runs without ROS or, if ``nodes`` is set, with the nodes in separate processes. The
    flight is interrupted after ``longest`` s of simulated time.

    SIGINT, SIGTERM and SIGHUP end the flight early; the flight up to that time is recorded and
    summarised. Before the flight, signals have their usual effect.

    Raises
    ------
    SpaceRobotError
        A parameter or the robot is invalid, the bag cannot be recorded, or the scenario requires
        nodes.
    """

    def report(now: float, end: float) -> None:
        if progress is not None:
            limit = 0.0
            if "coordinated_control" in scenario.commanders:
                limit = scenario.controller.time_limit
            with suppress(OSError):  # A closed terminal must not end the flight.
                progress(now, end or limit)

    if nodes:
        from spacerobot_ros.session.live import fly_by_nodes  # This import loads ROS.

        return RunResult(fly_by_nodes(scenario, bag, report, longest))
    flight = LockstepFlight(scenario)
    if scenario.parameters("recorder").get("when_exists") == "next":
        bag = free_name(bag)
    writer = BagWriter(bag, scenario.config("recorder"), overwrite=False)
    with graceful_shutdown(flight.interrupt) as stopped, writer:

        def look(now: float, end: float) -> bool:
            report(now, end)
            return stopped()

        began = time.perf_counter()
        try:
            flown = flight.fly(look, longest)
        except Exception as error:
            message = f"The flight has failed at {flight.time:g} s: {describe_exception(error)}."
            write_flight(flight.until_now(time.perf_counter() - began, message), writer)
            if isinstance(error, SpaceRobotError):
                raise
            raise SpaceRobotError(message) from error
        write_flight(flown, writer)
    recorded = {"messages_recorded": writer.messages_written, "bag": str(bag)}
    return RunResult({**flown.summary(), **recorded})
