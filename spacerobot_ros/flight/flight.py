"""One flight: its arrays over time, the reports about it, and its measures.

A flight is made by the loop without ROS (:mod:`~spacerobot_ros.flight.lockstep`) or by reading a
bag (:mod:`~spacerobot_ros.flight.reading`). A bag need not hold everything: parts are optional.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import numpy.typing as npt

from spacerobot_ros.commanding.goal_follower import Status
from spacerobot_ros.control.status import CommandReport, ControllerStatus
from spacerobot_ros.errors import PlanningError, RecordingError
from spacerobot_ros.events import Event, EventKind
from spacerobot_ros.flight.clearance import FlightClearance
from spacerobot_ros.flight.verdict import Verdict, verdict_of
from spacerobot_ros.measures import (
    CaptureMeasures,
    Measures,
    Outcome,
    flown_time,
    momentum_drift,
    peak,
    peak_wrench,
)
from spacerobot_ros.model.description import Array, RobotDescription
from spacerobot_ros.model.kinematics import ForwardKinematics
from spacerobot_ros.model.rotations import (
    matrices_from_quaternions,
    quaternion_inverse,
    quaternion_multiply,
    rotvec_from_quaternion,
    rotvecs_from_quaternions,
)
from spacerobot_ros.planning import METHODS, GaitSchedule, Goal, PoseError
from spacerobot_ros.planning.core.goal import Controlled, EndEffectorGoal, uncontrolled_parts
from spacerobot_ros.planning.execution.status import PlannerState, PlannerStatus
from spacerobot_ros.simulation.actuators import PlantWithFaults, thrusters_in
from spacerobot_ros.simulation.capture import capture_values, load_target
from spacerobot_ros.simulation.commands import CommandValidator, Refusal
from spacerobot_ros.simulation.sensors import ReportedState
from spacerobot_ros.simulation.status import PlantStatus
from spacerobot_ros.times import SECOND

if TYPE_CHECKING:
    import os

    import pandas as pd
    import xarray as xr

    from spacerobot_ros.messages.statuses import StatusRecord
    from spacerobot_ros.scenario import Scenario

_INITIAL_ROW_COUNT = 1024

_TRUE_QUANTITIES = ("pose", "twist", "q", "qdot", "effort", "momentum")

_QUANTITY_SIZES = {
    **dict.fromkeys(("pose", "momentum", "measured_pose", "end_effector_pose"), 7),
    **dict.fromkeys(("target_pose", "true_target_pose"), 7),
    **dict.fromkeys(("twist", "measured_twist", "expected_momenta"), 6),
    **dict.fromkeys(("target_twist", "true_target_twist"), 6),
}
"""Numbers per sample by quantity; other quantities have one number per joint."""

_FLOWN_STATES = frozenset(("executing", "reached", "failed", "aborted"))
"""States of a status whose goal the robot flies to, or has flown to."""


@dataclass(frozen=True)
class Signal:
    """Samples ``values`` (N, k) at ``time`` (N,), s."""

    time: Array
    values: Array

    def __len__(self) -> int:
        return len(self.time)

    @classmethod
    def empty(cls, width: int) -> Signal:
        """Return a signal without samples."""
        return cls(np.empty(0), np.empty((0, width)))

    @property
    def width(self) -> int:
        """Number of values in a sample."""
        return int(self.values.shape[1])

    def between(self, start: float, end: float) -> Signal:
        """Return the samples from ``start`` to ``end``, both included."""
        first, last = np.searchsorted(self.time, [start - 1e-9, end + 1e-9])
        return Signal(self.time[first:last], self.values[first:last])

    def relative_to_first(self) -> Signal:
        """Return the changes since the first sample."""
        return Signal(self.time, self.values - self.values[:1])


@dataclass(frozen=True)
class Commands:
    """The commands on one topic.

    Attributes
    ----------
    tick
        (N,) tick that each answers.
    values
        (N, size) numbers that the plant, or the controller, takes from them.
    setpoints
        (N, 2 n) joint positions and rates in the messages of a planner; None: not known.
    """

    tick: npt.NDArray[np.int64]
    values: Array
    setpoints: Array | None = None


@dataclass(frozen=True)
class SentGoal:
    """A goal pose that was sent at ``time`` (s), and the id under which statuses report on it."""

    time: float
    goal: Goal
    goal_id: str


@dataclass(frozen=True, eq=False, repr=False)
class Flight:
    """A flight, from :func:`spacerobot_ros.fly` or from a bag.

    All arrays are copies; those of a missing part have no rows.

    Attributes
    ----------
    scenario
        The scenario that was flown.
    robot
        The robot of the plant; None where a bag holds no description of it.
    joint_names
        The joints, in the order of columns.
    series
        All quantities of the plant by name, each with its times (s). The true ones are ``pose``
        (N, 7), position (m) and quaternion (x, y, z, w) of the base in the world; ``twist`` (N, 6),
        its velocities in its own frame, m/s and rad/s; ``q``, ``qdot``, ``effort`` (N, n), joint
        positions (m or rad), rates and actuator efforts; ``momentum`` (N, 7), linear (kg m/s) and
        angular momentum (kg m^2/s) in the world and kinetic energy (J). For the others see
        :attr:`quantities`.
    commands
        The commands by topic.
    statuses
        Statuses of the commanders, with the stamp of the state that they answered, ns.
    events
        Events of the nodes.
    outcome, message
        The end of the goal, and the same for people.
    goal, end_effector_goal
        The goals that count at the end; None: there is none.
    goals, end_effector_goals
        All goals that were sent.
    schedules
        The gaits that were flown, each with the stamp of its beginning, ns; none of a bag.
    plant_statuses, diagnostics, covariances
        Statuses of the plant, diagnostics of plant and commanders, and covariances (72,) of
        measured pose and twist, each with the time from which on it is published, ns; none of a
        bag, nor covariances of sensors without errors.
    status, gait
        The last status of the commander that decides, and the planner's when its first gait began.
    plan_time, wall_time
        Wall time of planning, and of the whole flight, s; NaN where it is not known.
    refusals
        Commands that were refused: time (s), topic, reason.
    measures_clearance
        Whether the distances between links are measured: false where ``plant.clearance_period`` is
        0, and of bags without the topic ``clearance``.
    """

    scenario: Scenario
    robot: RobotDescription | None
    joint_names: tuple[str, ...]
    series: Mapping[str, Signal]
    commands: Mapping[str, Commands]
    statuses: tuple[tuple[int, Status], ...]
    events: tuple[Event, ...]
    outcome: Outcome
    message: str
    goal: Goal | None
    end_effector_goal: Goal | None
    goals: tuple[SentGoal, ...] = ()
    end_effector_goals: tuple[SentGoal, ...] = ()
    schedules: tuple[tuple[int, GaitSchedule], ...] = ()
    plant_statuses: tuple[tuple[int, PlantStatus], ...] = ()
    diagnostics: tuple[tuple[int, tuple[StatusRecord, ...]], ...] = ()
    covariances: tuple[tuple[int, Array], ...] = ()
    status: Status | None = None
    gait: PlannerStatus | None = None
    plan_time: float = math.nan
    wall_time: float = math.nan
    refusals: tuple[tuple[float, str, Refusal], ...] = ()
    measures_clearance: bool = False

    # -- arrays -------------------------------------------------------------------------------

    def signal(self, name: str) -> Signal:
        """Return a quantity over time; without samples where the flight does not have it."""
        found = self.series.get(name)
        if found is not None:
            return found
        usual = 7 if name.startswith("pose_of_") else len(self.joint_names)
        return Signal.empty(_QUANTITY_SIZES.get(name, usual))

    @property
    def time(self) -> Array:
        """(N,) times of the poses, s."""
        return self.signal("pose").time

    @property
    def pose(self) -> Array:
        """(N, 7) true positions (m) and quaternions (x, y, z, w) of the base in the world."""
        return self.signal("pose").values

    @property
    def twist(self) -> Array:
        """(N, 6) true velocities of the base in its own frame, m/s and rad/s."""
        return self.signal("twist").values

    @property
    def q(self) -> Array:
        """(N, n) true joint positions, m or rad."""
        return self.signal("q").values

    @property
    def qdot(self) -> Array:
        """(N, n) true joint rates, m/s or rad/s."""
        return self.signal("qdot").values

    @property
    def effort(self) -> Array:
        """(N, n) efforts of the joints' actuators, N or N m."""
        return self.signal("effort").values

    @property
    def momentum(self) -> Array:
        """(N, 7) linear (kg m/s) and angular momentum (kg m^2/s) in the world, energy (J)."""
        return self.signal("momentum").values

    @property
    def quantities(self) -> dict[str, Array]:
        """The quantities without an attribute of their own, (N, size) each.

        Names are those of :class:`~spacerobot_ros.simulation.sensors.ReportedState`:
        measured states (only where sensors err), the end-effector, thrusters, expected momenta.
        """
        return {
            name: self.series[name].values for name in self.series if name not in _TRUE_QUANTITIES
        }

    def required_robot(self) -> RobotDescription:
        """Return the robot.

        Raises
        ------
        RecordingError
            The flight has no description of it.
        """
        if self.robot is None:
            raise RecordingError(
                f"The flight of '{self.scenario.name}' has no description of its robot."
            )
        return self.robot

    @cached_property
    def target(self) -> RobotDescription | None:
        """The body that floats beside the robot; None: there is none."""
        return load_target(self.scenario.plant.target)

    @cached_property
    def capture(self) -> dict[str, Any]:
        """The first capture of the target, by the keys of ``spacerobot run --json``.

        Without a capture, ``captured`` is false; empty where there is no target.
        """
        for event in self.events:
            if event.kind is EventKind.CAPTURED:
                return {"time_s": event.time_s, **capture_values(event.about)}
        return {} if self.target is None else {"captured": False}

    @cached_property
    def detumbling(self) -> dict[str, float]:
        """The first detumbling after a capture, by the keys of ``spacerobot run --json``; empty:
        there was none.
        """
        for event in self.events:
            if event.kind is EventKind.DETUMBLED:
                numbers = {name: float(text) for name, text in event.about.items()}
                return {"time_s": event.time_s or 0.0, **numbers}
        return {}

    @cached_property
    def capture_measures(self) -> CaptureMeasures:
        """The measures of the flight to the target; all are NaN where there is none."""
        capture, detumbling = self.capture, self.detumbling
        if not capture:
            return CaptureMeasures()
        time = capture.get("time_s", math.nan)
        impulse = np.array(capture.get("impulse_Ns", [math.nan] * 6))
        joints = np.abs(capture.get("joint_impulses_Nms", ()))
        return CaptureMeasures(
            captured=float(capture["captured"]),
            placed=float(self.succeeded and self._holds_target),
            time=time,
            distance=self._capture_distance(time),
            impulse=float(np.linalg.norm(impulse[:3])),
            angular_impulse=float(np.linalg.norm(impulse[3:])),
            joint_impulse=float(joints.max()) if joints.size else math.nan,
            detumbling_time=detumbling.get("took_s", math.nan),
            detumbling_bound=detumbling.get("shortest_s", math.nan),
        )

    @property
    def _holds_target(self) -> bool:
        changes = (EventKind.CAPTURED, EventKind.RELEASED)
        last = [event.kind for event in self.events if event.kind in changes][-1:]
        return last == [EventKind.CAPTURED]

    def _capture_distance(self, capture: float) -> float:
        """Return the distance of the end-effector from the grapple frame at the time of a capture,
        s; the smallest of the flight, where that is NaN. NaN where the flight does not have it.
        """
        config = self.scenario.plant
        hand, body = self.signal("end_effector_pose"), self.signal("true_target_pose")
        body = body or self.signal("target_pose")
        of_link = config.capture.end_effector in ("", config.end_effector_frame)
        if self.target is None or not of_link or not len(hand) or len(hand) != len(body):
            return math.nan
        grapple = self.target.frames[config.target.grapple_frame][1].r
        R_WT = matrices_from_quaternions(body.values[:, 3:])
        gaps = body.values[:, :3] + R_WT @ grapple - hand.values[:, :3]
        distances = np.linalg.norm(gaps, axis=1)
        if math.isnan(capture):
            return float(distances.min())
        return float(distances[int(np.searchsorted(hand.time, capture - 1e-9))])

    @property
    def control_period(self) -> float:
        """Duration of a tick, s."""
        return self.scenario.plant.control_period

    # -- measures -----------------------------------------------------------------------------

    @property
    def succeeded(self) -> bool:
        """Whether the goal was reached within tolerance, by the measured state."""
        return self.outcome is Outcome.REACHED

    @cached_property
    def verdict(self) -> Verdict:
        """The end of the flight in a word and a sentence, by its last true state."""
        return verdict_of(self)

    @property
    def sentence(self) -> str:
        """Earlier name of :attr:`message`; deprecated."""
        return self.message

    @property
    def duration(self) -> float:
        """Simulated time of the flight, s."""
        return float(self.time[-1] - self.time[0]) if len(self.time) else 0.0

    @property
    def manoeuvre_time(self) -> float:
        """Time flown for the goal, s, see :func:`~spacerobot_ros.measures.flown_time`; where no
        status reports it, the duration of the flight.
        """
        reports = [(stamp_ns / SECOND, status) for stamp_ns, status in self.statuses]
        last = self.status.manoeuvre_time_s if isinstance(self.status, PlannerStatus) else 0.0
        end = float(self.time[-1]) if len(self.time) else 0.0
        return flown_time(reports, end) or last or self.duration

    @property
    def corrections(self) -> int:
        """Number of new plans that count as corrections."""
        return self.status.corrections if isinstance(self.status, PlannerStatus) else 0

    @property
    def method(self) -> str:
        """The gait method that was flown, or the control law."""
        if self.gait is not None and self.gait.method:
            return self.gait.method
        scenario = self.scenario
        if "planner" in scenario.commanders:
            return scenario.planner.method
        for _, status in reversed(self.statuses):
            if isinstance(status, ControllerStatus) and status.command is not None:
                return status.command.law
        return scenario.controller.law

    def tolerance(self, part: Literal["position", "attitude", "joint"]) -> float | None:
        """Return the largest error of a part of a reached goal, m or rad; None where a bag has no
        parameters of the commander.
        """
        scenario, name = self.scenario, f"{part}_tolerance"
        node = "planner" if "planner" in scenario.commanders else "coordinated_control"
        given = scenario.parameters(node)
        if not given:
            return None
        value = given[name] if name in given else getattr(scenario.config(node), name)
        return float(value) if isinstance(value, float | int) else None

    @cached_property
    def not_controlled(self) -> tuple[Controlled, ...]:
        """Parts of the goal's base and shape that the method or the law does not control."""
        if self.goal is None:
            return ()
        match self.status:
            case ControllerStatus(command=CommandReport(errors=errors) as command) if errors:
                return uncontrolled_parts(self.goal, command.controls())
            case PlannerStatus(not_controlled=parts) if parts:
                return parts
            case PlannerStatus(state=PlannerState.REACHED, position_error_m=float(left)) if left > (
                self.tolerance("position") or math.inf
            ):
                # Bags of earlier versions do not name the parts.
                return ("position",)
        method = METHODS.get(self.method)
        if method is None:
            return ()
        return tuple(x for x in uncontrolled_parts(self.goal, method.controls) if x != "shape")

    @property
    def turns_end_effector(self) -> bool:
        """Whether a controller turns the end-effector to an attitude."""
        command = self.status.command if isinstance(self.status, ControllerStatus) else None
        return command is not None and "attitude" in command.controls("end_effector")

    @property
    def has_thrust(self) -> bool:
        """Whether forces or torques were commanded of thrusters."""
        wrench = self.commands.get("base_wrench")
        return wrench is not None and bool(wrench.values.any())

    @property
    def error(self) -> PoseError | None:
        """Error of the last true pose to the goal; None without a pose or a goal of the base."""
        goal = self.goal
        return None if goal is None or not goal.base else pose_error(self.signal("pose"), goal)

    @property
    def errors(self) -> Array:
        """(N, 2) distances (m) and angles (rad) of the true poses from the goal that counts at the
        end; without rows where there is no goal of the base.
        """
        if self.goal is None or not self.goal.base:
            return np.empty((0, 2))
        gaps = self.goal.position - self.pose[:, :3]
        turns = quaternion_multiply(quaternion_inverse(self.pose[:, 3:]), self.goal.quaternion)
        norms = [np.linalg.norm(each, axis=1) for each in (gaps, rotvecs_from_quaternions(turns))]
        return np.column_stack(norms)

    @property
    def end_effector_error(self) -> PoseError | None:
        """Error of the end-effector's last pose to its goal; None without a pose or a goal.

        Of several it is that of the farthest.
        """
        if errors := self.end_effector_errors:
            return max(errors.values(), key=lambda error: error.distance)
        return pose_error(self.signal("end_effector_pose"), self.end_effector_goal)

    @property
    def end_effector_errors(self) -> dict[str, PoseError]:
        """Errors of the last true poses of the end-effectors that the planner's goal names."""
        goal, robot = self.goal, self.robot
        if goal is None or not goal.end_effectors or not len(self.q) or not len(self.pose):
            return {}
        if robot is None or set(robot.joint_names) - set(self.joint_names):
            return {}
        q = self.q[-1, [self.joint_names.index(name) for name in robot.joint_names]]
        kinematics, errors = ForwardKinematics(robot), {}
        for each in goal.for_robot(robot).end_effectors:
            pose = kinematics.link_in_world(each.link, self.pose[-1], q)
            errors[each.link] = PoseError.of_link(pose, each)
        return errors

    @property
    def propellant(self) -> float | None:
        """Propellant used, kg; None without thrusters."""
        used = self.signal("propellant")
        return float(used.values[-1, 0]) if len(used) else None

    @cached_property
    def momentum_drift(self) -> Array:
        """(2,) see :func:`~spacerobot_ros.measures.momentum_drift`; kg m/s and kg m^2/s."""
        expected = self.series.get("expected_momenta")
        return momentum_drift(self.momentum, None if expected is None else expected.values)

    @cached_property
    def clearance(self) -> FlightClearance | None:
        """The smallest distance between links over time; None where it is not measured, without
        joint states, or of a robot without links that could touch.
        """
        if self.robot is None or not self.measures_clearance:
            return None
        q, pose = self.signal("q"), self.signal("pose")
        return FlightClearance.of(
            self.robot, self.joint_names, (q.time, q.values), (pose.time, pose.values)
        )

    @cached_property
    def measures(self) -> Measures:
        """The measures of the flight, which has states."""
        return self.measured()

    def measured(self, *, clearance: bool = True) -> Measures:
        """Return the measures of the flight, which has states.

        ``clearance``: whether the smallest distance between links is measured, which takes a while.
        """
        wrench = self.commands.get("base_wrench")
        distance, angle = self._largest_end_effector_errors
        return Measures(
            outcome=self.outcome,
            message=self.message,
            duration=self.duration,
            manoeuvre_time=self.manoeuvre_time,
            error=self.error,
            peak_rate=peak(self.qdot),
            peak_effort=peak(self.effort),
            peak_wrench=np.zeros(2) if wrench is None else peak_wrench(wrench.values),
            lowest=self.q.min(axis=0),
            highest=self.q.max(axis=0),
            momentum_drift=self.momentum_drift,
            end_effector_distance=distance,
            end_effector_angle=angle,
            corrections=self.corrections,
            propellant=math.nan if self.propellant is None else self.propellant,
            plan_time=self.plan_time,
            wall_time=self.wall_time,
            clearance=self._smallest_distance if clearance else math.nan,
            capture=self.capture_measures,
        )

    @property
    def _largest_end_effector_errors(self) -> tuple[float, float]:
        """Distance (m) and angle (rad) as :class:`Measures` has them."""
        if errors := self.end_effector_errors:
            angles = [errors[link].angle for link in self._turned_links]
            return max(each.distance for each in errors.values()), max(angles, default=math.nan)
        error = self.end_effector_error
        if error is None:
            return math.nan, math.nan
        return error.distance, error.angle if self.turns_end_effector else math.nan

    @property
    def _turned_links(self) -> list[str]:
        assert self.goal is not None
        assert self.robot is not None
        aims = self.goal.for_robot(self.robot).end_effectors
        return [aim.link for aim in aims if aim.quaternion is not None]

    @property
    def _smallest_distance(self) -> float:
        if self.clearance is not None:
            return self.clearance.nearest.distance
        return math.inf if self.measures_clearance else math.nan

    def __repr__(self) -> str:
        error, left = self.error, ""
        if error is not None:
            distance, angle = (
                f"{value:.3g} {unit}" + " (not controlled)" * (part in self.not_controlled)
                for part, value, unit in (
                    ("position", error.distance, "m"),
                    ("attitude", error.angle, "rad"),
                )
            )
            left = f", {distance} and {angle} from "
        return (
            f"<Flight of {self.scenario.name} by {self.method}: {self.outcome.value} after "
            f"{self.duration:.6g} s ({len(self.time) - 1} ticks, {self.corrections} "
            f"correction(s)){left and f'{left}the goal'}. {self.verdict.sentence}>"
        )

    def summary(self) -> dict[str, Any]:
        """Return the measures by the keys of ``spacerobot run --json``.

        The flight has states and a goal.
        """
        goal, measures = self.goal, self.measures
        assert goal is not None
        assert measures.error is not None or not goal.base
        error = measures.error
        linear, angular = measures.momentum_drift.tolist()
        ticks, wall_time = len(self.time) - 1, self.wall_time
        summary: dict[str, Any] = {
            "scenario": self.scenario.name,
            "method": self.method,
            "goal": [*goal.position.tolist(), *goal.quaternion.tolist()] if goal.base else None,
            "final_position_m": self.pose[-1, :3].tolist(),
            "final_attitude_rotvec_rad": rotvec_from_quaternion(self.pose[-1, 3:]).tolist(),
            "final_joint_positions": self.q[-1].tolist(),
            "joint_names": list(self.joint_names),
            "wheel_names": [] if self.robot is None else list(self.robot.wheel_names),
            "position_error_m": None if error is None else error.distance,
            "attitude_error_rad": None if error is None else error.angle,
            "position_tolerance_m": self.tolerance("position"),
            "attitude_tolerance_rad": self.tolerance("attitude"),
            "not_controlled": list(self.not_controlled),
            "has_thrust": self.has_thrust,
            "sim_time_s": measures.duration,
            "manoeuvre_time_s": measures.manoeuvre_time,
            "plan_time_s": measures.plan_time,
            "wall_time_s": wall_time,
            "ticks": ticks,
            "ticks_per_s": ticks / wall_time if wall_time else math.inf,
            "real_time_factor": self.duration / wall_time if wall_time else math.inf,
            "momentum_drift": max(linear, angular),
            "linear_momentum_drift": linear,
            "angular_momentum_drift": angular,
            "peak_joint_velocities": measures.peak_rate.tolist(),
            "corrections": measures.corrections,
            "gait": {}
            if self.gait is None
            else {"duration_s": self.gait.duration_s, **self.gait.notes},
            "state": self.outcome.value,
            "message": self.message,
            "verdict": self.verdict.sentence,
            "succeeded": self.succeeded,
        }
        if errors := self.end_effector_errors:
            summary["end_effectors"] = {
                link: {
                    "position_error_m": each.distance,
                    "attitude_error_rad": each.angle if link in self._turned_links else None,
                }
                for link, each in errors.items()
            }
        elif math.isfinite(measures.end_effector_distance):
            end = self.signal("end_effector_pose").values[-1, :3]
            summary["end_effector_final_position_m"] = end.tolist()
            summary["end_effector_position_error_m"] = measures.end_effector_distance
            if self.turns_end_effector:
                summary["end_effector_attitude_error_rad"] = measures.end_effector_angle
        if self.capture:
            summary["capture"] = self.capture
        if self.detumbling:
            summary["detumbling"] = self.detumbling
        if self.propellant is not None:
            summary["propellant_kg"] = self.propellant
        if self.clearance is not None:
            summary["clearance_m"] = measures.clearance
            summary["clearance_links"] = list(self.clearance.nearest.links)
            summary["clearance_time_s"] = self.clearance.nearest_time
        return summary

    # -- views and files ----------------------------------------------------------------------

    def to_pandas(self, *, euler: bool = False) -> pd.DataFrame:
        """Return a table with a row a state, indexed by time (s).

        Columns and their units, ``attrs["units"]``, are those of the tables of bags: of ``odom``
        and ``joint_states`` as there, with the true state, of other topics with the topic before
        them, as ``momentum.data[linear_x]``; ``measured`` stands before measured states that
        differ from the true ones. With ``euler`` the turns of each attitude about the fixed axes
        x, y, z (rad) stand beside its quaternion, in columns ``roll``, ``pitch`` and ``yaw``.

        Raises
        ------
        SpaceRobotError
            pandas is not installed.
        """
        from spacerobot_ros.bag.tables import to_pandas
        from spacerobot_ros.flight.saved import table_of_flight

        made = to_pandas(table_of_flight(self, euler=euler))
        made.attrs = self._attributes | {"units": made.attrs["units"]}
        return made

    def to_xarray(self, *, euler: bool = False) -> xr.Dataset:
        """Return the columns of :meth:`to_pandas` as variables over ``time``, with their units.

        Arrays stay arrays, over ``time`` and ``joint`` for joint states, as with those of bags.

        Raises
        ------
        SpaceRobotError
            xarray is not installed.
        """
        from spacerobot_ros.bag.tables import to_xarray
        from spacerobot_ros.flight.saved import table_of_flight

        made = to_xarray(table_of_flight(self, euler=euler))
        made.attrs = dict(self._attributes)
        return made

    @property
    def _attributes(self) -> dict[str, str]:
        return {
            "scenario": self.scenario.name,
            "method": self.method,
            "message": self.message,
        }

    def plot(self) -> Any:
        """Return a matplotlib figure: pose of the base and its goal, joints, efforts or rates."""
        from spacerobot_ros.flight.views import figure

        return figure(self)

    def animate(self, *, seconds: float = 8.0, frames: int = 80) -> Any:
        """Return the robot in motion as an HTML animation for a notebook.

        Parameters
        ----------
        seconds
            Wall time of the animation.
        frames
            Number of pictures, at most 1000.

        Raises
        ------
        ParameterError
            A number is out of range.
        SpaceRobotError
            The flight has no description of its robot.
        """
        from spacerobot_ros.flight.views import animation

        return animation(self, seconds, frames)

    def save(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
        """Write a bag for ``spacerobot verify`` and ``spacerobot report``.

        Raises
        ------
        RecordingError
            The file exists and is not to be replaced, or cannot be written; or the flight has no
            description of its robot.
        """
        from spacerobot_ros.flight.saved import save_flight

        save_flight(self, path, overwrite=overwrite)


def pose_error(poses: Signal, goal: Goal | None) -> PoseError | None:
    """Return the error of the last pose to a goal; None without a pose or a goal."""
    if goal is None or not len(poses):
        return None
    return PoseError.between(poses.values[-1, :3], poses.values[-1, 3:], goal)


def reported_goal(status: Status, goals: Sequence[SentGoal]) -> Goal | None:
    """Return the goal of a status: that of the base as it was sent, and those of links.

    None for a status without a goal.
    """
    base = _reported_base_goal(status, goals)
    links = status.end_effector_goals if isinstance(status, PlannerStatus) else {}
    try:
        aims = tuple(EndEffectorGoal.checked(*each) for each in links.items())
    except PlanningError:
        return base
    if not aims:
        return base
    return Goal.of_end_effectors(aims) if base is None else replace(base, end_effectors=aims)


def _reported_base_goal(status: Status, goals: Sequence[SentGoal]) -> Goal | None:
    for sent in reversed(goals):
        if status.goal_id and status.goal_id == sent.goal_id:
            return sent.goal
    named = status.goal if isinstance(status, PlannerStatus) else ()
    try:
        reported = Goal.checked(named[:3], named[3:])
    except PlanningError:
        return None
    # Bags of earlier versions have no ids: the goal that was sent has more digits.
    for sent in reversed(goals):
        goal = sent.goal
        same = np.allclose(goal.position, reported.position, rtol=1e-7, atol=1e-8)
        if same and np.allclose(goal.quaternion, reported.quaternion, rtol=0.0, atol=1e-7):
            return goal
    return reported


def goal_at_end(statuses: Iterable[Status], goals: Sequence[SentGoal]) -> Goal | None:
    """Return the last goal of the flight, or otherwise the last one that was sent or reported."""
    reported = [(each, reported_goal(each, goals)) for each in statuses]
    for status, goal in reversed(reported):
        if status.state.value in _FLOWN_STATES and goal is not None:
            return goal
    if goals:
        return goals[-1].goal
    return next((goal for _, goal in reversed(reported) if goal is not None), None)


class FlightLog:
    """Collects the arrays of a :class:`Flight` tick by tick.

    Parameters
    ----------
    plant, reported, commands
        The plant, the quantities that it reports, and its commands.
    period_ns
        Duration of a tick, ns.
    """

    def __init__(
        self,
        plant: PlantWithFaults,
        reported: ReportedState,
        commands: CommandValidator,
        period_ns: int,
    ) -> None:
        self.events: list[Event] = []
        self.statuses: list[tuple[int, Status]] = []
        self.schedules: list[tuple[int, GaitSchedule]] = []
        self.plant_statuses: list[tuple[int, PlantStatus]] = []
        self.diagnostics: list[tuple[int, tuple[StatusRecord, ...]]] = []
        self.covariances: list[tuple[int, Array]] = []
        self.refusals: list[tuple[float, str, Refusal]] = []
        self._period_ns = period_ns
        self._thrusters = thrusters_in(plant)
        self._propellant = np.zeros(1)
        true = {"pose": plant.pose, "twist": plant.twist, "q": plant.q, "qdot": plant.qdot}
        # Measurements of sensors without error are the true arrays.
        unused = [f"true_{name}" for name in true]
        unused += [] if reported.sensors.used else [f"measured_{name}" for name in true]
        sources = {
            **{name: x for name, x in reported.quantities.items() if name not in unused},
            **true,
        }
        if self._thrusters is not None:
            sources["propellant"] = self._propellant
        self._sources, self._parts = sources, tuple(sources.values())
        self._states = _GrowingTable(sum(source.size for source in self._parts))
        """All quantities of a state side by side."""
        self._commands = {
            source.topic: (array("q"), _GrowingTable(len(source.limits)))
            for source in commands.sources
        }
        self._setpoints: dict[str, _GrowingTable] = {}
        self._plant = plant
        self._faults_seen: object = None
        self._ticks_without_pose: list[int] = []
        self._ticks_without_target: list[int] = []
        self._reported = reported

    def add_state(self, tick: int) -> None:
        """Add the present state."""
        if self._thrusters is not None:
            self._propellant[0] = self._thrusters.propellant
        np.concatenate(self._parts, out=self._states.next_row())
        sensors = self._reported.sensors
        if sensors.used and self._plant.active is not self._faults_seen:
            self._faults_seen = self._plant.active
            both = np.concatenate([sensors.pose_covariance, sensors.twist_covariance])
            self.covariances.append((tick * self._period_ns, both))
        if sensors.dropout:
            self._ticks_without_pose.append(tick)
        if self._reported.misses_target:
            self._ticks_without_target.append(tick)

    def add_command(
        self, topic: str, tick: int, values: Array, setpoint: tuple[Array, Array] | None = None
    ) -> None:
        """Add a command; a planner's has its setpoint, joint positions and rates."""
        if topic not in self._commands:
            self._commands[topic] = array("q"), _GrowingTable(len(values))
        ticks, rows = self._commands[topic]
        ticks.append(tick)
        rows.next_row()[:] = values
        if setpoint is not None:
            if topic not in self._setpoints:
                self._setpoints[topic] = _GrowingTable(2 * len(setpoint[0]))
            np.concatenate(setpoint, out=self._setpoints[topic].next_row())

    def flight(
        self,
        scenario: Scenario,
        robot: RobotDescription,
        *,
        outcome: Outcome,
        message: str,
        status: Status | None,
        gait: PlannerStatus | None,
        plan_time: float,
        wall_time: float,
    ) -> Flight:
        """Return the flight."""
        table = self._states.table()
        count, ends = len(table), np.cumsum([source.size for source in self._parts])
        columns = np.split(table, ends[:-1], axis=1)
        states = {name: each.copy() for name, each in zip(self._sources, columns, strict=True)}
        lost = {"pose_lost": self._ticks_without_pose}
        if self._ticks_without_target:
            lost["target_lost"] = self._ticks_without_target
        for name, ticks in lost.items():
            states[name] = np.zeros((count, 1))
            states[name][ticks] = 1.0
        time: Array = np.arange(count) * self._period_ns / SECOND
        return Flight(
            scenario=scenario,
            robot=robot,
            joint_names=tuple(robot.joint_names),
            series={name: Signal(time, values) for name, values in states.items()},
            commands={
                topic: Commands(
                    np.array(ticks, np.int64),
                    rows.table().copy(),
                    self._setpoints[topic].table().copy() if topic in self._setpoints else None,
                )
                for topic, (ticks, rows) in self._commands.items()
            },
            statuses=tuple(self.statuses),
            events=tuple(self.events),
            outcome=outcome,
            message=message,
            goal=scenario.goal,
            end_effector_goal=scenario.end_effector_goal,
            schedules=tuple(self.schedules),
            plant_statuses=tuple(self.plant_statuses),
            diagnostics=tuple(self.diagnostics),
            covariances=tuple(self.covariances),
            status=status,
            gait=gait,
            plan_time=plan_time,
            wall_time=wall_time,
            refusals=tuple(self.refusals),
            measures_clearance=scenario.plant.clearance_period > 0,
        )


class _GrowingTable:
    def __init__(self, size: int) -> None:
        self._table = np.empty((_INITIAL_ROW_COUNT, size))
        self._count = 0

    def next_row(self) -> Array:
        """Return one more row, which the caller fills."""
        if self._count == len(self._table):
            self._table = np.concatenate([self._table, np.empty_like(self._table)])
        self._count += 1
        return self._table[self._count - 1]

    def table(self) -> Array:
        """Return all rows so far, not copied."""
        return self._table[: self._count]
