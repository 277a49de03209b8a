"""Fly a scenario: compose the nodes, send the goal, record, measure, sum up."""

from __future__ import annotations

import json
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from rclpy.signals import SignalHandlerOptions

from spacerobot_ros.bag import Bag, read_bag
from spacerobot_ros.model.rotations import rotvec_from_quaternion
from spacerobot_ros.nodes.common.node import use_loopback_discovery, use_private_discovery
from spacerobot_ros.nodes.plant.thruster_topics import PROPELLANT
from spacerobot_ros.planning import PoseError
from spacerobot_ros.session.measure import Measured
from spacerobot_ros.session.processes import ProcessStack
from spacerobot_ros.session.scenario import Scenario
from spacerobot_ros.session.stack import FlightStack

_NO_GAIT = (
    *("state", "goal", "goal_id", "corrections", "method"),
    *("manoeuvre_time_s", "ends_at_s"),
)
"""Values of the planner's status that do not describe its gait."""

Progress = Callable[[float, float], None]
"""Called with simulated time and the time the present schedule ends, s."""


@dataclass(frozen=True)
class RunResult:
    """What a run came to. ``summary`` is the object that ``--json`` writes."""

    summary: dict[str, Any]
    sentence: str
    measured: Measured

    @property
    def succeeded(self) -> bool:
        """Whether the goal was met within tolerance."""
        return bool(self.summary["succeeded"])

    def write_json(self, path: Path) -> None:
        """Write the summary."""
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(self.summary, indent=2) + "\n", encoding="utf-8")


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


def run_scenario(
    scenario: Scenario, bag: Path, progress: Progress | None = None, *, processes: bool = False
) -> RunResult:
    """Fly a scenario from its initial state to its goal, in this process.

    ``processes`` gives each node a process of its own instead.

    SIGINT and SIGTERM end the flight early; what was flown is recorded and summed up.

    Raises
    ------
    SpaceRobotError
        A parameter, the robot or the recording is refused.
    """
    if processes:
        return _run(scenario, bag, progress, ProcessStack, private=False)
    return _run(scenario, bag, progress, FlightStack, private=scenario.lockstep)


def _run(
    scenario: Scenario,
    bag: Path,
    progress: Progress | None,
    make: Callable[[Scenario, Path], FlightStack | ProcessStack],
    *,
    private: bool,
) -> RunResult:
    with ros(private=private), stop_on_signals() as stopped:
        stack = make(scenario, bag)
        try:
            began = time.perf_counter()
            stack.start(scenario.goal)
            ends_at = float(scenario.parameter("coordinated_control", "time_limit", 0.0))

            def look() -> bool:
                if progress is not None:
                    progress(stack.time_ns / 1e9, stack.operator.ends_at or ends_at)
                return stopped()

            stack.spin(look)
            wall_time = time.perf_counter() - began
            if progress is not None and not stopped():
                progress(1.0, 1.0)
            stack.finish()
            facts = _Facts.of(stack, wall_time, stopped=stopped())
        finally:
            stack.close()
    return _summarise(scenario, bag, facts)


@dataclass(frozen=True)
class _Facts:
    """What the nodes said of the flight, and how long it took."""

    state: str
    sentence: str
    method: str
    plan_time: float
    wall_time: float
    manoeuvre_time: float
    corrections: int
    gait: dict[str, str]
    end_effector_turns: bool

    @classmethod
    def of(cls, stack: FlightStack | ProcessStack, wall_time: float, *, stopped: bool) -> _Facts:
        scenario, operator = stack.scenario, stack.operator
        status = operator.status
        node, name = (
            ("planner", "method")
            if "planner" in scenario.commanders
            else ("coordinated_control", "law")
        )
        return cls(
            state="interrupted" if stopped else status.get("state", ""),
            sentence="" if stopped else operator.sentence,
            method=operator.gait.get("method")
            or status.get(name)
            or str(scenario.parameter(node, name, "")),
            plan_time=stack.plan_time,
            wall_time=wall_time,
            manoeuvre_time=float(status.get("manoeuvre_time_s", 0.0)),
            corrections=int(status.get("corrections", 0)),
            gait=operator.gait,
            end_effector_turns=any(key.startswith("error.end_effector.r") for key in status),
        )


def _summarise(scenario: Scenario, path: Path, facts: _Facts) -> RunResult:
    bag = read_bag(path)
    measured = Measured.of(bag)
    error = measured.final_error(scenario.goal)
    sim_time = float(measured.time[-1] - measured.time[0])
    ticks = len(measured.time) - 1
    sentence = facts.sentence or f"Interrupted after {sim_time:.6g} s of simulated time."
    goal = scenario.goal
    summary: dict[str, Any] = {
        "scenario": scenario.name,
        "method": facts.method,
        "goal": [*goal.position.tolist(), *goal.quaternion.tolist()],
        "final_position_m": measured.position[-1].tolist(),
        "final_attitude_rotvec_rad": rotvec_from_quaternion(measured.quaternion[-1]).tolist(),
        "final_joint_positions": measured.joints[-1].tolist(),
        "joint_names": measured.joint_names,
        "position_error_m": error.distance,
        "attitude_error_rad": error.angle,
        "sim_time_s": sim_time,
        "manoeuvre_time_s": facts.manoeuvre_time or sim_time,
        "plan_time_s": facts.plan_time,
        "wall_time_s": facts.wall_time,
        "ticks": ticks,
        "ticks_per_s": ticks / facts.wall_time,
        "real_time_factor": sim_time / facts.wall_time,
        "messages_recorded": bag.message_count(),
        "bag": str(path),
        "momentum_drift": max(measured.linear_drift, measured.angular_drift),
        "linear_momentum_drift": measured.linear_drift,
        "angular_momentum_drift": measured.angular_drift,
        "peak_joint_velocities": np.abs(measured.joint_rates).max(axis=0).tolist(),
        "corrections": facts.corrections,
        "gait": {name: _numbers(text) for name, text in facts.gait.items() if name not in _NO_GAIT},
        "state": facts.state,
        "message": sentence,
        "succeeded": facts.state == "reached",
    }
    if scenario.end_effector_goal is not None and measured.end_effector is not None:
        end = PoseError.between(*measured.end_effector, scenario.end_effector_goal)
        summary["end_effector_final_position_m"] = measured.end_effector[0].tolist()
        summary["end_effector_position_error_m"] = end.distance
        if facts.end_effector_turns:
            summary["end_effector_attitude_error_rad"] = end.angle
    propellant = _last_diagnosis(bag, PROPELLANT)
    if propellant is not None:
        summary["propellant_kg"] = float(propellant)
    return RunResult(summary, sentence, measured)


def _last_diagnosis(bag: Bag, key: str) -> str | None:
    """Return the last value of a key in the recorded diagnostics, None where there is none."""
    if not bag.message_count("/diagnostics"):
        return None
    value = None
    for _, array in bag["/diagnostics"].messages():
        for status in array.status:
            value = next((pair.value for pair in status.values if pair.key == key), value)
    return value


def _numbers(text: str) -> list[float] | float | str:
    """Read a value of the planner's status: one number, several, or a text."""
    try:
        values = [float(word) for word in text.split()]
    except ValueError:
        return text
    return values[0] if len(values) == 1 else values


@contextmanager
def stop_on_signals() -> Iterator[Callable[[], bool]]:
    """Turn SIGINT and SIGTERM into a flag while the flight lasts."""
    caught: list[int] = []
    before = {
        number: signal.signal(number, lambda number, _: caught.append(number))
        for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        yield lambda: bool(caught)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
