"""A flight as arrays: what the plant did, what it was commanded, and what became of the goal."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from spacerobot_ros.commanding.goal_follower import Status
from spacerobot_ros.control.status import ControllerStatus, tracking_time
from spacerobot_ros.events import Event
from spacerobot_ros.model.description import Array, RobotDescription
from spacerobot_ros.model.rotations import rotvec_from_quaternion
from spacerobot_ros.planning import GaitSchedule, Goal, PoseError
from spacerobot_ros.planning.execution.status import PlannerStatus, manoeuvre_time
from spacerobot_ros.simulation.commands import Refusal
from spacerobot_ros.times import SECOND

if TYPE_CHECKING:
    from spacerobot_ros.flight.scenario import Scenario


class Outcome(str, Enum):
    """What became of a goal; the values are those of ``state`` in the status, but the last."""

    REACHED = "reached"
    FAILED = "failed"
    REFUSED = "refused"
    ABORTED = "aborted"
    INTERRUPTED = "interrupted"
    """The flight ended before the goal was decided."""


@dataclass(frozen=True)
class Commands:
    """What was sent on one topic: ``tick`` (N,) that each command answers, ``values`` (N, size)."""

    tick: npt.NDArray[np.int64]
    values: Array


@dataclass(frozen=True, eq=False)
class FlightArrays:
    """The numbers of a flight, from the initial state to the decision about its goal.

    All arrays are copies.

    Attributes
    ----------
    scenario
        What was flown.
    robot
        The robot of the plant.
    outcome, sentence
        What became of the goal.
    control_period
        Duration of a tick, s.
    time
        (N,) of the states, s.
    pose, twist
        (N, 7) position (m) and quaternion (x, y, z, w) of the base in the world, (N, 6) its
        velocities in its own frame, m/s and rad/s: the truth.
    q, qdot, effort
        (N, n) of the joints: positions (m or rad), rates, efforts of their actuators: the truth.
    momentum
        (N, 7) linear (kg m/s) and angular momentum (kg m^2/s) in the world, kinetic energy (J).
    quantities
        What else the plant reported, by the names of
        :class:`~spacerobot_ros.simulation.sensors.ReportedState`, (N, size) each: what was
        measured, the end-effector, thrusters, momenta that are expected. What is measured without
        error is not there twice.
    commands
        What was sent, by topic.
    statuses
        What the commanders reported, with the stamp of the state that they answered, ns.
    schedules
        The gaits that were flown, each with the stamp of its beginning, ns.
    events
        What has happened.
    status, gait
        The last status of the commander that decides, and the planner's when its first gait began.
    plan_time, wall_time
        What planning, and the whole flight, took of wall time, s.
    """

    scenario: Scenario
    robot: RobotDescription
    outcome: Outcome
    sentence: str
    control_period: float
    time: Array
    pose: Array
    twist: Array
    q: Array
    qdot: Array
    effort: Array
    momentum: Array
    quantities: Mapping[str, Array]
    commands: Mapping[str, Commands]
    statuses: tuple[tuple[int, Status], ...]
    schedules: tuple[tuple[int, GaitSchedule], ...]
    events: tuple[Event, ...]
    status: Status | None
    gait: PlannerStatus | None
    plan_time: float
    wall_time: float
    refusals: tuple[tuple[float, str, Refusal], ...] = field(default=(), repr=False)
    """Commands that were refused: time (s), topic, why."""

    @property
    def succeeded(self) -> bool:
        """Whether the goal was reached within tolerance, by the measured state."""
        return self.outcome is Outcome.REACHED

    @property
    def goal(self) -> Goal:
        """The goal of the base."""
        return self.scenario.goal

    @property
    def joint_names(self) -> tuple[str, ...]:
        """The joints, in the order of the columns."""
        return tuple(self.robot.joint_names)

    @property
    def duration(self) -> float:
        """Simulated time of the flight, s."""
        return float(self.time[-1] - self.time[0])

    @property
    def manoeuvre_time(self) -> float:
        """Duration of the schedules for the goal that were flown, s, as
        :func:`~spacerobot_ros.planning.execution.status.manoeuvre_time` has it; without any, from
        the first state that a controller tracked to the end that it named.
        """
        planned = manoeuvre_time(
            (
                (stamp_ns / SECOND, status)
                for stamp_ns, status in self.statuses
                if isinstance(status, PlannerStatus)
            ),
            float(self.time[-1]),
        )
        tracked = tracking_time(
            (stamp_ns / SECOND, status.state)
            for stamp_ns, status in self.statuses
            if isinstance(status, ControllerStatus)
        )
        return planned or tracked or self.duration

    @property
    def corrections(self) -> int:
        """New plans after the first that count as corrections."""
        return self.status.corrections if isinstance(self.status, PlannerStatus) else 0

    @property
    def method(self) -> str:
        """The gait method that was flown, or the control law."""
        if self.gait is not None and self.gait.method:
            return self.gait.method
        scenario = self.scenario
        plans = "planner" in scenario.commanders
        return scenario.planner.method if plans else scenario.controller.law

    @property
    def error(self) -> PoseError:
        """What remains from the true pose at the end to the goal."""
        return PoseError.between(self.pose[-1, :3], self.pose[-1, 3:], self.goal)

    @property
    def end_effector_error(self) -> PoseError | None:
        """The same of the end-effector; None without a goal for it."""
        goal, pose = self.scenario.end_effector_goal, self.quantities.get("end_effector_pose")
        if goal is None or pose is None:
            return None
        return PoseError.between(pose[-1, :3], pose[-1, 3:], goal)

    @property
    def momentum_changes(self) -> tuple[float, float]:
        """Largest changes of linear and angular momentum that thrust does not explain."""
        momenta = self.momentum[:, :6] - self.quantities.get("expected_momenta", 0.0)
        linear, angular = np.split(momenta - momenta[0], 2, axis=1)
        return (
            float(np.linalg.norm(linear, axis=1).max()),
            float(np.linalg.norm(angular, axis=1).max()),
        )

    def __repr__(self) -> str:
        error = self.error
        return (
            f"<Flight of {self.scenario.name} by {self.method}: {self.outcome.value} after "
            f"{self.duration:.6g} s ({len(self.time) - 1} ticks, {self.corrections} "
            f"correction(s)), {error.distance:.3g} m and {error.angle:.3g} rad from the goal. "
            f"{self.sentence}>"
        )

    def summary(self) -> dict[str, Any]:
        """Return the numbers of the flight, by the keys of ``spacerobot run --json``."""
        error, n = self.error, len(self.joint_names)
        linear, angular = self.momentum_changes
        ticks = len(self.time) - 1
        summary: dict[str, Any] = {
            "scenario": self.scenario.name,
            "method": self.method,
            "goal": [*self.goal.position.tolist(), *self.goal.quaternion.tolist()],
            "final_position_m": self.pose[-1, :3].tolist(),
            "final_attitude_rotvec_rad": rotvec_from_quaternion(self.pose[-1, 3:]).tolist(),
            "final_joint_positions": self.q[-1].tolist(),
            "joint_names": list(self.joint_names),
            "position_error_m": error.distance,
            "attitude_error_rad": error.angle,
            "sim_time_s": self.duration,
            "manoeuvre_time_s": self.manoeuvre_time,
            "plan_time_s": self.plan_time,
            "wall_time_s": self.wall_time,
            "ticks": ticks,
            "ticks_per_s": ticks / self.wall_time if self.wall_time else math.inf,
            "momentum_drift": max(linear, angular),
            "linear_momentum_drift": linear,
            "angular_momentum_drift": angular,
            "peak_joint_velocities": np.abs(self.qdot).max(axis=0).tolist() if n else [],
            "corrections": self.corrections,
            "gait": {}
            if self.gait is None
            else {"duration_s": self.gait.duration_s, **self.gait.notes},
            "state": self.outcome.value,
            "message": self.sentence,
            "succeeded": self.succeeded,
        }
        end = self.end_effector_error
        if end is not None:
            summary["end_effector_position_error_m"] = end.distance
        if self.propellant is not None:
            summary["propellant_kg"] = self.propellant
        return summary

    @property
    def propellant(self) -> float | None:
        """Propellant used, kg; None without thrusters."""
        found = self.quantities.get("propellant")
        return None if found is None else float(found[-1, 0])
