"""Fly a scenario: start the nodes, send the goal, record, measure, sum up."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import rclpy
from rclpy.signals import SignalHandlerOptions

from spacerobot_ros.bag import Bag, RecordedRobot, read_bag
from spacerobot_ros.bag.recorded_robot import columns
from spacerobot_ros.commanding.goal_follower import Status
from spacerobot_ros.control.status import ControllerStatus, tracking_time
from spacerobot_ros.errors import RecordingError, SpaceRobotError
from spacerobot_ros.flight.arrays import Outcome
from spacerobot_ros.flight.scenario import Scenario
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.rotations import rotvec_from_quaternion
from spacerobot_ros.nodes.common.process import use_loopback_discovery, use_private_discovery
from spacerobot_ros.nodes.plant.diagnostics import PROPELLANT
from spacerobot_ros.planning import PoseError
from spacerobot_ros.planning.execution.status import PlannerState, PlannerStatus, manoeuvre_time
from spacerobot_ros.session.processes import MultiProcessStack
from spacerobot_ros.session.stack import InProcessStack, Stack
from spacerobot_ros.termination import ended_on_request
from spacerobot_ros.times import SECOND

_Status = TypeVar("_Status", PlannerStatus, ControllerStatus)

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
    """Return what the nodes reported of a finished flight, and what the plant published of it."""
    scenario, client = stack.scenario, stack.client
    outcome, gait = client.outcome or Outcome.INTERRUPTED, client.gait
    # A controller that flies alone plans nothing.
    planner = client.status
    if not isinstance(planner, PlannerStatus):
        planner = PlannerStatus(PlannerState.IDLE)
    method = gait.method if gait is not None else ""
    if not method:
        plans = "planner" in scenario.commanders
        method = scenario.planner.method if plans else scenario.controller.law
    assert stack.bag is not None
    bags, goal = _files(stack.bag), scenario.goal
    robots = [RecordedRobot(bag) for bag in bags]
    joint_names = next((robot.joint_names for robot in robots if robot.joint_names), [])
    n = len(joint_names)
    time, pose = _truth(robots, "odom", columns("odom", "pose.pose"))
    _, joints = _truth(robots, "joint_states", ["position", "velocity"], 2 * n)
    error = PoseError.between(pose[-1, :3], pose[-1, 3:], goal)
    linear, angular = _momentum_changes(robots)
    sim_time, ticks = float(time[-1] - time[0]), len(time) - 1
    interrupted = f"Interrupted after {sim_time:.6g} s of simulated time."
    summary: dict[str, Any] = {
        "scenario": scenario.name,
        "method": method,
        "goal": [*goal.position.tolist(), *goal.quaternion.tolist()],
        "final_position_m": pose[-1, :3].tolist(),
        "final_attitude_rotvec_rad": rotvec_from_quaternion(pose[-1, 3:]).tolist(),
        "final_joint_positions": joints[-1, :n].tolist(),
        "joint_names": joint_names,
        "position_error_m": error.distance,
        "attitude_error_rad": error.angle,
        "sim_time_s": sim_time,
        "manoeuvre_time_s": (
            _manoeuvre_time(robots, float(time[-1]))
            or planner.manoeuvre_time_s
            or _tracking_time(robots)
            or sim_time
        ),
        "plan_time_s": stack.statistics.plan_time_s,
        "wall_time_s": wall_time,
        "ticks": ticks,
        "ticks_per_s": ticks / wall_time,
        "real_time_factor": sim_time / wall_time,
        "messages_recorded": sum(bag.message_count() for bag in bags),
        "bag": str(bags[0].path),
        "momentum_drift": max(linear, angular),
        "linear_momentum_drift": linear,
        "angular_momentum_drift": angular,
        "peak_joint_velocities": np.abs(joints[:, n:]).max(axis=0).tolist(),
        "corrections": planner.corrections,
        "gait": {} if gait is None else {"duration_s": gait.duration_s, **gait.notes},
        "state": outcome.value,
        "message": interrupted if outcome is Outcome.INTERRUPTED else client.sentence,
        "succeeded": outcome is Outcome.REACHED,
    }
    tools = [tool for robot in robots if (tool := robot.get("end_effector_pose")) is not None]
    if scenario.end_effector_goal is not None and tools:
        last = tools[-1].table(columns("end_effector_pose", "pose"))[-1]
        end = PoseError.between(last[:3], last[3:], scenario.end_effector_goal)
        summary["end_effector_final_position_m"] = last[:3].tolist()
        summary["end_effector_position_error_m"] = end.distance
        if _turns_end_effector(client.status):
            summary["end_effector_attitude_error_rad"] = end.angle
    diagnoses = [_last_diagnosis(bag, PROPELLANT) for bag in bags]
    propellant = next((value for value in reversed(diagnoses) if value is not None), None)
    if propellant is not None:
        summary["propellant_kg"] = float(propellant)
    return summary


def _turns_end_effector(status: Status | None) -> bool:
    """Whether a controller turns the end-effector to an attitude."""
    command = status.command if isinstance(status, ControllerStatus) else None
    return command is not None and any(
        label.startswith("end_effector.r") for label in command.errors
    )


def _files(path: Path) -> list[Bag]:
    """Return the files of a bag in order: one, or ``NAME_0``, ``NAME_1``, ... if it was split."""
    parts: list[Path] = []
    while (part := path.with_name(f"{path.stem}_{len(parts)}{path.suffix}")).exists():
        parts.append(part)
    return [read_bag(part) for part in ([path] if path.exists() or not parts else parts)]


def _manoeuvre_time(robots: Sequence[RecordedRobot], end_s: float) -> float | None:
    """Return how long the schedules for the last goal were flown, None where none was."""
    statuses = _statuses(robots, "planner/status", PlannerStatus.from_values)
    return manoeuvre_time(statuses, max(end_s, statuses[-1][0]) if statuses else end_s)


def _tracking_time(robots: Sequence[RecordedRobot]) -> float | None:
    """Return how long a controller flew, None where none did."""
    statuses = _statuses(robots, "controller/status", ControllerStatus.from_values)
    return tracking_time((time, status.state) for time, status in statuses)


def _statuses(
    robots: Sequence[RecordedRobot], topic: str, read: Callable[[dict[str, str]], _Status]
) -> list[tuple[float, _Status]]:
    """Return the statuses of a commander with their log times, s."""
    found = []
    for series in filter(None, (robot.get(topic) for robot in robots)):
        for time_ns, message in series.messages():
            values = {pair.key: pair.value for pair in message.values}
            with suppress(SpaceRobotError):
                found.append((time_ns / SECOND, read(values)))
    return found


def _truth(
    robots: Sequence[RecordedRobot], name: str, fields: list[str], width: int | None = None
) -> tuple[Array, Array]:
    """Return :meth:`RecordedRobot.truth` of all files; where none has any, its error."""
    having = [robot for robot in robots if robot.get(name) or robot.get(f"{name}_true")]
    tables = [robot.truth(name, fields, width) for robot in having or robots[:1]]
    return np.concatenate([t for t, _ in tables]), np.concatenate([x for _, x in tables])


def _momentum_changes(robots: Sequence[RecordedRobot]) -> tuple[float, float]:
    """Return the largest changes of linear and angular momentum that thrust does not explain."""

    def data(name: str) -> Array | None:
        found = [topic for robot in robots if (topic := robot.get(name)) is not None]
        if not found:
            return None
        return np.concatenate([np.asarray(topic.field("data"))[:, :6] for topic in found])

    momentum, expected = data("momentum"), data("momentum_expected")
    if momentum is None:
        raise RecordingError(f"The bag {robots[0].bag.path} has no momenta.")
    # Without thrusters nothing is published, and nothing is to change.
    if expected is not None and len(expected) == len(momentum):
        momentum = momentum - expected
    linear, angular = np.split(momentum - momentum[0], 2, axis=1)
    return float(np.linalg.norm(linear, axis=1).max()), float(np.linalg.norm(angular, axis=1).max())


def _last_diagnosis(bag: Bag, key: str) -> str | None:
    """Return the last value of a key in the recorded diagnostics, None where there is none."""
    if "/diagnostics" not in bag.topics:
        return None
    value = None
    for _, array in bag["/diagnostics"].messages():
        for status in array.status:
            value = next((pair.value for pair in status.values if pair.key == key), value)
    return value
