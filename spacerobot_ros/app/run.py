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

from spacerobot_ros.app.measure import Measured
from spacerobot_ros.app.scenario import Scenario
from spacerobot_ros.app.stack import FlightStack
from spacerobot_ros.model.attitude import rotvec_from_quaternion
from spacerobot_ros.nodes.flight_node import use_loopback_discovery, use_private_discovery
from spacerobot_ros.planning import PoseError
from spacerobot_ros.recording import read_bag

_NO_GAIT = ("state", "goal", "corrections", "method")
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


def run_scenario(scenario: Scenario, bag: Path, progress: Progress | None = None) -> RunResult:
    """Fly a scenario from its initial state to its goal, in this process.

    SIGINT and SIGTERM end the flight early; what was flown is recorded and summed up.

    Raises
    ------
    SpaceRobotError
        A parameter, the robot or the recording is refused.
    """
    with ros(private=scenario.lockstep), _stop_on_signals() as stopped:
        stack = FlightStack(scenario, bag)
        try:
            began = time.perf_counter()
            stack.start(scenario.goal)

            def look() -> bool:
                if progress is not None:
                    progress(stack.plant.time_ns / 1e9, _ends_at(stack))
                return stopped()

            stack.spin(look)
            wall_time = time.perf_counter() - began
            if progress is not None and not stopped():
                progress(1.0, 1.0)
            stack.finish()
            facts = _Facts.of(stack, wall_time, stopped())
        finally:
            stack.close()
    return _summarise(scenario, bag, facts)


@dataclass(frozen=True)
class _Facts:
    """What only the live nodes know."""

    state: str
    sentence: str
    method: str
    plan_time: float
    wall_time: float
    ticks: int
    messages: int
    manoeuvre_time: float
    corrections: int
    gait: dict[str, str]
    end_effector_turns: bool

    @classmethod
    def of(cls, stack: FlightStack, wall_time: float, stopped: bool) -> _Facts:
        sentence = stack.sentence
        if stopped:
            sentence = f"Interrupted after {stack.plant.time_ns / 1e9:.6g} s of simulated time."
        assert stack.recorder is not None
        return cls(
            state="interrupted" if stopped else stack.status.get("state", ""),
            sentence=sentence,
            method=_method(stack),
            plan_time=stack.planner.plan_time if stack.planner else 0.0,
            wall_time=wall_time,
            ticks=stack.plant.tick,
            messages=stack.recorder.messages_recorded,
            manoeuvre_time=(
                stack.planner.flown_time if stack.planner else stack.plant.time_ns / 1e9
            ),
            corrections=int(stack.status.get("corrections", 0)),
            gait=stack.gait,
            end_effector_turns=_controls_rotation(stack),
        )


def _method(stack: FlightStack) -> str:
    """Name the gait method, or the control law where nobody plans."""
    node, name = (stack.planner, "method") if stack.planner else (stack.controller, "law")
    return str(node.parameters[name]) if node is not None else ""


def _controls_rotation(stack: FlightStack) -> bool:
    """Whether the attitude of the end-effector is one of the outputs."""
    if stack.controller is None:
        return False
    return any(
        axis[0] == "r" for axis in stack.controller.controller.law.outputs.selection.end_effector
    )


def _ends_at(stack: FlightStack) -> float:
    """Simulated time at which the flight will end as far as is known, s; 0 if it is not."""
    if stack.planner is not None:
        return stack.planner.ends_at
    assert stack.controller is not None
    return float(stack.controller.parameters["time_limit"])  # type: ignore[arg-type]


def _summarise(scenario: Scenario, path: Path, facts: _Facts) -> RunResult:
    measured = Measured.of(read_bag(path))
    error = measured.final_error(scenario.goal)
    sim_time = float(measured.time[-1] - measured.time[0])
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
        "manoeuvre_time_s": facts.manoeuvre_time,
        "plan_time_s": facts.plan_time,
        "wall_time_s": facts.wall_time,
        "ticks": facts.ticks,
        "ticks_per_s": facts.ticks / facts.wall_time,
        "real_time_factor": sim_time / facts.wall_time,
        "messages_recorded": facts.messages,
        "bag": str(path),
        "momentum_drift": max(measured.linear_drift, measured.angular_drift),
        "linear_momentum_drift": measured.linear_drift,
        "angular_momentum_drift": measured.angular_drift,
        "peak_joint_velocities": np.abs(measured.joint_rates).max(axis=0).tolist(),
        "corrections": facts.corrections,
        "gait": {name: _numbers(text) for name, text in facts.gait.items() if name not in _NO_GAIT},
        "state": facts.state,
        "message": facts.sentence,
        "succeeded": facts.state == "reached",
    }
    if scenario.end_effector_goal is not None and measured.end_effector is not None:
        end = PoseError.between(*measured.end_effector, scenario.end_effector_goal)
        summary["end_effector_final_position_m"] = measured.end_effector[0].tolist()
        summary["end_effector_position_error_m"] = end.distance
        if facts.end_effector_turns:
            summary["end_effector_attitude_error_rad"] = end.angle
    return RunResult(summary, facts.sentence, measured)


def _numbers(text: str) -> list[float] | float | str:
    """Read a value of the planner's status: one number, several, or a text."""
    try:
        values = [float(word) for word in text.split()]
    except ValueError:
        return text
    return values[0] if len(values) == 1 else values


@contextmanager
def _stop_on_signals() -> Iterator[Callable[[], bool]]:
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
