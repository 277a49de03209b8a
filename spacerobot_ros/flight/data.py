"""The data of one flight: arrays over time, reports, and quantities derived from them.

A bag need not contain everything: all components are optional.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np

from spacerobot_ros.commanding.goal_follower import Status
from spacerobot_ros.control.status import CommandReport, ControllerStatus
from spacerobot_ros.errors import RecordingError
from spacerobot_ros.events import Event, EventKind
from spacerobot_ros.flight.series import Commands, SentGoal, Signal, pose_error
from spacerobot_ros.measures import Outcome, flown_time, momentum_drift
from spacerobot_ros.messages.diagnostics import StatusRecord
from spacerobot_ros.model.description import Array, RobotDescription, Shape
from spacerobot_ros.model.kinematics import ForwardKinematics
from spacerobot_ros.model.meshes import TriangleMesh, shape_mesh
from spacerobot_ros.model.rotations import attitude_errors, matrices_from_quaternions
from spacerobot_ros.planning import METHODS, GaitSchedule, Goal, PoseError
from spacerobot_ros.planning.core.goal import Controlled, uncontrolled_parts
from spacerobot_ros.planning.core.schedule import BasePath
from spacerobot_ros.planning.execution.status import PlannerState, PlannerStatus
from spacerobot_ros.scenario import Scenario
from spacerobot_ros.simulation.capture import capture_values, load_target
from spacerobot_ros.simulation.clearance import FlightClearance
from spacerobot_ros.simulation.commands import Refusal
from spacerobot_ros.simulation.status import PlantStatus
from spacerobot_ros.times import SECOND

_QUANTITY_SIZES = {
    **dict.fromkeys(("pose", "momentum", "measured_pose", "end_effector_pose"), 7),
    **dict.fromkeys(("target_pose", "true_target_pose"), 7),
    **dict.fromkeys(("twist", "measured_twist", "expected_momenta"), 6),
    **dict.fromkeys(("target_twist", "true_target_twist"), 6),
}
"""Number of values per sample, by quantity; other quantities have one value per joint."""

_SAME_TICK_SHARE = 0.4
"""Largest difference, as a fraction of a tick, between log times of messages of the same tick."""

_TRUE_QUANTITIES = ("pose", "twist", "q", "qdot", "effort", "momentum")


@dataclass(frozen=True, eq=False, repr=False)
class FlightData:
    """The data of a flight, from :func:`spacerobot_ros.fly` or from a bag.

    All arrays are read-only; arrays for which data are missing have no rows.

    Attributes
    ----------
    scenario
        The flown scenario.
    robot
        The plant's robot; None if a bag has no robot description.
    joint_names
        The joints, in the order of the columns.
    series
        All plant quantities by name, each with its times (s): the true quantities :attr:`pose`,
        :attr:`twist`, :attr:`q`, :attr:`qdot`, :attr:`effort` and :attr:`momentum`, and
        :attr:`quantities`.
    commands
        The commands by topic.
    statuses
        Commander statuses, each with the stamp of the corresponding state, ns.
    events
        Events of the nodes.
    outcome, message
        The goal's outcome, and a sentence describing it.
    goal, end_effector_goal
        The goals that are active at the end of the flight; None if there is no active goal.
    goals, end_effector_goals
        All goals that were sent.
    schedules
        The flown gaits, each with its start stamp, ns; empty for a bag.
    plant_statuses, diagnostics, covariances
        Plant statuses, plant and commander diagnostics, and covariances (72,) of the measured pose
        and twist, each with the time of its first publication, ns. Empty for a bag; no covariances
        if the sensors have no errors.
    status, gait
        The last status of the commander that decides the outcome, and the planner's status when its
        first gait started.
    plan_time, wall_time
        Wall time for planning, and for the whole flight, s; NaN if unknown.
    refusals
        Rejected commands: time (s), topic, reason.
    measures_clearance
        Whether the distances between links are measured: false if ``plant.clearance_period`` is 0,
        and for bags without the topic ``clearance``.
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
    paths: tuple[tuple[int, BasePath], ...] = ()
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
        """Return a quantity over time; empty if the flight does not contain it."""
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
        """(N, 6) true base velocities in the base frame, m/s and rad/s."""
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
        """(N, n) joint actuator efforts, N or N m."""
        return self.signal("effort").values

    @property
    def momentum(self) -> Array:
        """(N, 7) linear (kg m/s) and angular momentum (kg m^2/s) in the world, energy (J)."""
        return self.signal("momentum").values

    @property
    def quantities(self) -> dict[str, Array]:
        """The quantities that have no separate attribute, each of shape (N, size).

        For the names, see :class:`~spacerobot_ros.simulation.sensors.ReportedState`: measured
        states (only if sensors have errors), the end-effector, thrusters, expected momenta.
        """
        others = (name for name in self.series if name not in _TRUE_QUANTITIES)
        return {name: self.series[name].values for name in others}

    def required_robot(self) -> RobotDescription:
        """Return the robot.

        Raises
        ------
        RecordingError
            The flight has no robot description.
        """
        if self.robot is None:
            raise RecordingError(
                f"The flight of '{self.scenario.name}' has no description of its robot."
            )
        return self.robot

    @cached_property
    def target(self) -> RobotDescription | None:
        """The second floating body; None if there is no such body."""
        return load_target(self.scenario.plant.target)

    @property
    def target_pose(self) -> Signal:
        """(M, 7) true positions (m) and quaternions of the target; empty if there is no target."""
        if self.target is None:
            return Signal.empty(7)
        return self.signal("true_target_pose") or self.signal("target_pose")

    @cached_property
    def capture(self) -> dict[str, Any]:
        """The first capture of the target, with the keys of ``spacerobot run --json``.

        If there was no capture, ``captured`` is false, and ``nearest_m`` and ``nearest_time_s`` are
        the smallest distance of the end-effector from the grapple frame and the time at which it
        occurs; the dictionary is empty if there is no target. After a planned approach,
        ``detumble`` contains the requested momentum, ``planned_momentum_Nms`` the planned value and
        ``angular_momentum_Nms`` the result.
        """
        planned: dict[str, Any] = {}
        for event in self.events:
            about = event.about
            if event.kind is EventKind.APPROACH_STARTED and "planned_momentum_Nms" in about:
                left = float(about["planned_momentum_Nms"])
                planned = {"detumble": about["detumble"], "planned_momentum_Nms": left}
            if event.kind is EventKind.CAPTURED:
                return {"time_s": event.time_s, **capture_values(about), **planned}
        if self.target is None:
            return {}
        time, distances = self._grapple_distances
        if not len(time):
            return {"captured": False}
        nearest = int(distances.argmin())
        return {
            "captured": False,
            "nearest_m": float(distances[nearest]),
            "nearest_time_s": float(time[nearest]),
            "distance_limit_m": self.scenario.plant.capture.distance,
        }

    @cached_property
    def detumbling(self) -> dict[str, float]:
        """The first detumbling after a capture, with the keys of ``spacerobot run --json``; empty
        if there was none.
        """
        for event in self.events:
            if event.kind is EventKind.DETUMBLED:
                numbers = {name: float(text) for name, text in event.about.items()}
                return {"time_s": event.time_s or 0.0, **numbers}
        return {}

    @property
    def _grapple_distances(self) -> tuple[Array, Array]:
        """Times (N,), s, and distances (N,) of the end-effector from the grapple frame, m; empty if
        the flight does not have them.
        """
        config = self.scenario.plant
        hand, body = self.signal("end_effector_pose"), self.target_pose
        of_link = config.capture.end_effector in ("", config.end_effector_frame)
        if self.target is None or not of_link or len(hand) != len(body):
            return np.zeros(0), np.zeros(0)
        grapple = self.target.frames[config.target.grapple_frame][1].r
        R_WT = matrices_from_quaternions(body.values[:, 3:])
        gaps = body.values[:, :3] + R_WT @ grapple - hand.values[:, :3]
        return hand.time, np.linalg.norm(gaps, axis=1)

    @property
    def control_period(self) -> float:
        """Duration of a tick, s."""
        return self.scenario.plant.control_period

    # -- measures -----------------------------------------------------------------------------

    @property
    def sentence(self) -> str:
        """Former name of :attr:`message`; deprecated."""
        return self.message

    @property
    def duration(self) -> float:
        """Simulated time of the flight, s."""
        return float(self.time[-1] - self.time[0]) if len(self.time) else 0.0

    @property
    def manoeuvre_time(self) -> float:
        """Flight time for the goal, s, see :func:`~spacerobot_ros.measures.flown_time`; if no
        status reports it, the duration of the flight.
        """
        reports = [(stamp_ns / SECOND, status) for stamp_ns, status in self.statuses]
        last = self.status.manoeuvre_time_s if isinstance(self.status, PlannerStatus) else 0.0
        end = float(self.time[-1]) if len(self.time) else 0.0
        return flown_time(reports, end) or last or self.duration

    @property
    def corrections(self) -> int:
        """Number of corrections (new plans for the same goal)."""
        return self.status.corrections if isinstance(self.status, PlannerStatus) else 0

    @property
    def method(self) -> str:
        """The gait method or control law used."""
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
        """Return the tolerance for a goal component, m or rad; None if a bag has no commander
        parameters.
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
        """Goal components (base pose and shape) that the method or the law does not control."""
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
                # Bags from earlier versions do not list these components.
                return ("position",)
        method = METHODS.get(self.method)
        if method is None:
            return ()
        return tuple(x for x in uncontrolled_parts(self.goal, method.controls) if x != "shape")

    @property
    def turns_end_effector(self) -> bool:
        """Whether a controller controls the end-effector attitude."""
        command = self.status.command if isinstance(self.status, ControllerStatus) else None
        return command is not None and "attitude" in command.controls("end_effector")

    @property
    def wrench(self) -> Signal:
        """(N, 6) commanded thruster force (N) and torque (N m), in the base link frame."""
        return self.commands.get("base_wrench", Signal.empty(6))

    @property
    def has_thrust(self) -> bool:
        """Whether thruster forces or torques were commanded."""
        return bool(self.wrench.values.any())

    @property
    def error(self) -> PoseError | None:
        """Error of the last true pose relative to the goal; None if either is unknown."""
        goal = self.goal
        return None if goal is None or not goal.base else pose_error(self.signal("pose"), goal)

    @property
    def errors(self) -> Array:
        """(N, 2) distances (m) and angles (rad) of the true poses from the final goal; no rows if
        there is no base goal.
        """
        if self.goal is None or not self.goal.base:
            return np.empty((0, 2))
        gaps = self.goal.position - self.pose[:, :3]
        turns = attitude_errors(self.pose[:, 3:], self.goal.quaternion)
        return np.column_stack([np.linalg.norm(each, axis=1) for each in (gaps, turns)])

    @property
    def end_effector_error(self) -> PoseError | None:
        """Error of the end-effector's last pose relative to its goal; None if there is no pose or
        goal.

        If there are several end-effectors, the one with the largest distance is used.
        """
        if errors := self.end_effector_errors:
            return max(errors.values(), key=lambda error: error.distance)
        return pose_error(self.signal("end_effector_pose"), self.end_effector_goal)

    @property
    def end_effector_errors(self) -> dict[str, PoseError]:
        """Errors in the last true end-effector poses relative to the planner's goal."""
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
        """Propellant used since the start or the last reset, kg; None without thrusters."""
        used = self.signal("propellant")
        return float(used.values[-1, 0]) if len(used) else None

    @property
    def planned_propellant(self) -> float | None:
        """Propellant used by the last planned reference, kg; None if no reference with thrusters
        was planned."""
        key = "planned_propellant_kg"
        found = [event.about[key] for event in self.events if key in event.about]
        return float(found[-1]) if found else None

    @property
    def resets(self) -> list[float]:
        """Times at which the plant was reset, s."""
        resets = (event.time_s for event in self.events if event.kind is EventKind.RESET)
        return [time for time in resets if time is not None]

    @cached_property
    def unexplained_momentum(self) -> Signal:
        """Momenta and energy (N, 7) without the change in momenta due to thrusters, at the times
        for which this change is known; if it is never known, no thrust is assumed."""
        balance, expected = self.signal("momentum"), self.signal("expected_momenta")
        if not len(balance) or not len(expected):
            return balance
        # A recording may begin or end between the two, and logs them at slightly different times.
        gaps = np.diff(balance.time)
        near = _SAME_TICK_SHARE * float(np.median(gaps)) if len(gaps) else 0.0
        of = np.searchsorted(expected.time, balance.time - near)
        # The states before and after a reset have the same stamp.
        of += np.arange(len(balance)) - np.searchsorted(balance.time, balance.time)
        of = of.clip(max=len(expected) - 1)
        at = np.flatnonzero(np.abs(expected.time[of] - balance.time) <= near)
        values = balance.values[at]
        values[:, :6] -= expected.values[of[at]]
        return Signal(balance.time[at], values)

    @cached_property
    def momentum_drift(self) -> Array:
        """(2,) drift of the linear and angular momentum, kg m/s and kg m^2/s; see
        :func:`~spacerobot_ros.measures.momentum_drift`."""
        return momentum_drift(self.unexplained_momentum.values)

    @cached_property
    def clearance(self) -> FlightClearance | None:
        """The smallest distance between links over time; None if it was not measured, there are no
        joint states, or no pair of links can touch.
        """
        if self.robot is None or not self.measures_clearance:
            return None
        q, pose = ((x.time, x.values) for x in (self.signal("q"), self.signal("pose")))
        return FlightClearance.of(self.robot, self.joint_names, q, pose, mesh_of=self.mesh_of)

    def __getstate__(self) -> dict[str, Any]:
        # Exact distances cannot be pickled; they are computed again.
        return {name: value for name, value in vars(self).items() if name != "clearance"}

    def mesh_of(self, shape: Shape) -> TriangleMesh:
        """Return the triangles of a shape, read from a file if the shape is a mesh.

        Raises
        ------
        MeshError
            The file cannot be read.
        """
        return shape_mesh(shape)
