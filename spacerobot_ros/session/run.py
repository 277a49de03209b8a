"""Fly a scenario: start the nodes, send the goal, record, measure, sum up."""

from __future__ import annotations

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

from spacerobot_ros.bag import Bag, RecordedRobot, read_bag
from spacerobot_ros.bag.recorded_robot import columns
from spacerobot_ros.control.status import ControllerStatus
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.rotations import rotvec_from_quaternion
from spacerobot_ros.nodes.common.process import use_loopback_discovery, use_private_discovery
from spacerobot_ros.nodes.plant.diagnostics import PROPELLANT
from spacerobot_ros.planning import Goal, PoseError
from spacerobot_ros.planning.execution.status import PlannerStatus
from spacerobot_ros.session.mission_client import Outcome, Status
from spacerobot_ros.session.processes import MultiProcessStack
from spacerobot_ros.session.scenario import Scenario
from spacerobot_ros.session.stack import InProcessStack, Stack

Progress = Callable[[float, float], None]
"""Called with simulated time and the time the present schedule ends, s."""


@dataclass(frozen=True)
class Measured:
    """Time series of a bag: ``time`` (N,) s, base ``position`` (N, 3) m and ``quaternion`` (N, 4),
    ``joints`` and ``joint_rates`` (N, n), ``momentum`` (N, 7) as on the topic. Of imperfect sensors
    they are the truth, which the plant publishes beside what is measured.
    """

    time: Array
    position: Array
    quaternion: Array
    joint_names: list[str]
    joints: Array
    joint_rates: Array
    momentum: Array
    expected: Array
    """Momenta (N, 6) by what the run began with and the thrusters gave."""
    end_effector: tuple[Array, Array] | None = None
    """Its last position (3,) and quaternion (4,), where it was published."""

    @classmethod
    def of(cls, bag: Bag, namespace: str = "") -> Measured:
        """Take the series out of a bag.

        Raises
        ------
        RecordingError
            A topic is missing or empty.
        """
        robot = RecordedRobot(bag, namespace)
        names = robot.joint_names
        n = len(names)
        time, pose = robot.truth("odom", columns("odom", "pose.pose"))
        _, shapes = robot.truth("joint_states", ["position", "velocity"], 2 * n)
        momentum = np.asarray(robot["momentum"].field("data"))
        expected, tool = robot.get("momentum_expected"), robot.get("end_effector_pose")
        last = tool.table(columns("end_effector_pose", "pose"))[-1] if tool is not None else None
        if expected is not None and len(expected) != len(momentum):
            expected = None
        return cls(
            time=time,
            position=pose[:, :3],
            quaternion=pose[:, 3:],
            joint_names=names,
            joints=shapes[:, :n],
            joint_rates=shapes[:, n:],
            momentum=momentum,
            # Without thrusters nothing is published, and nothing is to change.
            expected=(
                np.asarray(expected.field("data"))
                if expected is not None
                else np.zeros((len(momentum), 6))
            ),
            end_effector=(last[:3], last[3:]) if last is not None else None,
        )

    @property
    def linear_drift(self) -> float:
        """Largest change of the total linear momentum without thrust, kg m/s."""
        return _largest_change(self.momentum[:, :3] - self.expected[:, :3])

    @property
    def angular_drift(self) -> float:
        """Largest change of the total angular momentum without thrust, kg m^2/s."""
        return _largest_change(self.momentum[:, 3:6] - self.expected[:, 3:6])

    def final_error(self, goal: Goal) -> PoseError:
        """Return what the last pose leaves to the goal."""
        return PoseError.between(self.position[-1], self.quaternion[-1], goal)


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


def make_stack(scenario: Scenario, bag: Path | None, *, processes: bool) -> Stack:
    """Return the stack of a scenario, in this process or with a process for each node.

    Raises
    ------
    SpaceRobotError
        A parameter or the robot is refused, or a node does not start.
    """
    return MultiProcessStack(scenario, bag) if processes else InProcessStack(scenario, bag)


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
    private = not processes and scenario.lockstep
    with ros(private=private), stop_on_signals() as stopped:
        stack = make_stack(scenario, bag, processes=processes)
        try:
            began = time.perf_counter()
            stack.start(scenario.goal)
            time_limit = 0.0
            if "coordinated_control" in scenario.commanders:
                time_limit = scenario.controller.time_limit

            def look() -> bool:
                if progress is not None:
                    progress(stack.time_ns / 1e9, stack.client.ends_at or time_limit)
                return stopped()

            stack.spin(look)
            wall_time = time.perf_counter() - began
            if progress is not None and not stopped():
                progress(1.0, 1.0)
            stack.finish()
            facts = _Facts.of(stack, wall_time)
        finally:
            stack.close()
    return _summarise(scenario, bag, facts)


@dataclass(frozen=True)
class _Facts:
    """What the nodes reported of the flight, and how long it took."""

    outcome: Outcome
    sentence: str
    status: Status | None
    gait: PlannerStatus | None
    method: str
    plan_time: float
    wall_time: float

    @classmethod
    def of(cls, stack: Stack, wall_time: float) -> _Facts:
        scenario, client = stack.scenario, stack.client
        outcome = client.outcome or Outcome.INTERRUPTED
        method = client.gait.method if client.gait is not None else ""
        if not method:
            plans = "planner" in scenario.commanders
            method = scenario.planner.method if plans else scenario.controller.law
        return cls(
            outcome=outcome,
            sentence="" if outcome is Outcome.INTERRUPTED else client.sentence,
            status=client.status,
            gait=client.gait,
            method=method,
            plan_time=stack.statistics.plan_time_s,
            wall_time=wall_time,
        )

    @property
    def corrections(self) -> int:
        """New plans that the planner has made to come nearer."""
        return self.status.corrections if isinstance(self.status, PlannerStatus) else 0

    @property
    def manoeuvre_time(self) -> float:
        """Duration of all schedules, s; 0 without a planner."""
        return self.status.manoeuvre_time_s if isinstance(self.status, PlannerStatus) else 0.0

    @property
    def gait_values(self) -> dict[str, Any]:
        """The planner's results by name, for the schedule that it flew first."""
        if self.gait is None:
            return {}
        return {"duration_s": self.gait.duration_s, **self.gait.notes}

    @property
    def end_effector_turns(self) -> bool:
        """Whether the controller turns the end-effector to an attitude."""
        command = self.status.command if isinstance(self.status, ControllerStatus) else None
        return command is not None and any(
            label.startswith("end_effector.r") for label in command.errors
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
        "gait": facts.gait_values,
        "state": facts.outcome.value,
        "message": sentence,
        "succeeded": facts.outcome is Outcome.REACHED,
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


def _largest_change(vectors: Array) -> float:
    return float(np.linalg.norm(vectors - vectors[0], axis=1).max())


def _last_diagnosis(bag: Bag, key: str) -> str | None:
    """Return the last value of a key in the recorded diagnostics, None where there is none."""
    if not bag.message_count("/diagnostics"):
        return None
    value = None
    for _, array in bag["/diagnostics"].messages():
        for status in array.status:
            value = next((pair.value for pair in status.values if pair.key == key), value)
    return value


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
