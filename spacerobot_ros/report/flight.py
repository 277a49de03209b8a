"""One flight, as a bag holds it: whatever is there, and nothing that is not."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from spacerobot_ros.control.status import CommandReport, ControllerStatus, tracking_time
from spacerobot_ros.control.thrusters import IN_URDF, find_thrusters
from spacerobot_ros.errors import PlanningError, SpaceRobotError
from spacerobot_ros.flight.scenario import Published
from spacerobot_ros.model import RobotDescription
from spacerobot_ros.model.description import Array, Joint, JointKind, Pose
from spacerobot_ros.model.meshes import TriangleMesh
from spacerobot_ros.model.rotations import matrix_from_quaternion, rotvec_from_quaternion
from spacerobot_ros.planning import METHODS, Goal, PoseError
from spacerobot_ros.planning.execution.status import (
    PlannerState,
    PlannerStatus,
    manoeuvre_time,
    time_to_end,
)
from spacerobot_ros.report.events import FlightEvent
from spacerobot_ros.report.signals import Cycles, Signal, find_cycles, nearest_rotvec
from spacerobot_ros.report.solids import SolidRobot

_FOLLOWED = frozenset(("executing", "reached", "failed", "aborted"))
"""States in which the goal of a status is, or was, the one to fly to."""


@dataclass(frozen=True)
class Status:
    """What planner or controller reported.

    Attributes
    ----------
    time
        When, s.
    sentence
        For people.
    report
        The same for programs; None where it is no status of this package.
    """

    time: float
    sentence: str
    report: PlannerStatus | ControllerStatus | None

    @property
    def state(self) -> str:
        """State of planner or controller; empty where it is not known."""
        return self.report.state.value if self.report is not None else ""

    @property
    def executing(self) -> bool:
        """Whether a schedule begins."""
        return self.state == PlannerState.EXECUTING.value

    @property
    def goal_id(self) -> str:
        """Id of the goal that the status is about; empty where it is not known."""
        return self.report.goal_id if self.report is not None else ""

    @property
    def goal(self) -> tuple[float, ...]:
        """Position and quaternion (7,) of that goal with 9 digits; empty where not reported."""
        return self.report.goal if isinstance(self.report, PlannerStatus) else ()

    @property
    def method(self) -> str:
        """Gait method of the schedule that begins, or control law."""
        match self.report:
            case PlannerStatus(method=method):
                return method
            case ControllerStatus(command=CommandReport(law=law)):
                return law
            case _:
                return ""

    @property
    def outputs(self) -> frozenset[str]:
        """Names of the outputs whose errors a controller reports."""
        match self.report:
            case ControllerStatus(command=CommandReport(errors=errors)):
                return frozenset(errors)
            case _:
                return frozenset()

    def note(self, name: str) -> list[float]:
        """Return a result of the planning method as numbers; none if it is not there."""
        notes = self.report.notes if isinstance(self.report, PlannerStatus) else {}
        value = notes.get(name, "")
        return [] if isinstance(value, str) else np.atleast_1d(value).tolist()


@dataclass(frozen=True)
class SentGoal:
    """A goal pose that was sent at ``time`` (s), and the id under which statuses report on it."""

    time: float
    goal: Goal
    goal_id: str


@dataclass(frozen=True)
class Target:
    """A goal and when it was flown to, ``start`` to ``end`` in s."""

    start: float
    end: float
    goal: Goal


@dataclass(frozen=True)
class Flight:
    """What a bag holds of a flight, times in s since the first state; missing signals are empty.

    Attributes
    ----------
    file_name, message_count, metadata, robot, joint_names
        About the bag, and the robot in it.
    position, quaternion, attitude
        Pose of the base link in the world: (N, 3) m, (N, 4) and exponential coordinates (N, 3).
        This and what follows is as it was, and not as sensors that err have measured it.
    twist
        Velocity and angular velocity of the base link in its frame (N, 6), m/s and rad/s.
    shape, rates, efforts
        Positions, velocities and commanded efforts of the joints (N, n), SI units.
    momentum
        Momenta and kinetic energy (N, 7), without the momenta that thrusters have put in.
    tool
        Pose of the end-effector in the world (N, 7).
    wrench
        Force and torque that were commanded of the thrusters, in the base link (N, 6), N and N m.
    duty, thrust, thruster_names
        For what part of each tick each thruster was on (N, m), its mean force in it (N, m), N, and
        their names.
    statuses
        What the planner reported, or else the controller.
    sent, tool_goals
        The goals of base and end-effector.
    planned
        Planned positions of the base (K, 3), one array a schedule.
    events
        Changes of state of the nodes; none in bags of earlier versions.
    meshes
        Triangles of the meshes that the bag carries, by their URIs.
    sensed_pose, sensed_shape
        Pose of the base link (M, 7) and joint positions (M, n) as measured while sensors err; empty
        where they do not.
    namespace, other_robots
        Of the robot's topics, such as ``/robot_1``; those of other robots in the bag.
    """

    file_name: str
    message_count: int
    metadata: dict[str, dict[str, str]]
    robot: RobotDescription | None
    joint_names: list[str]
    position: Signal
    quaternion: Array
    attitude: Signal
    shape: Signal
    twist: Signal
    rates: Signal
    momentum: Signal
    tool: Signal
    wrench: Signal
    efforts: Signal
    duty: Signal
    thrust: Signal
    thruster_names: list[str]
    statuses: list[Status]
    sent: list[SentGoal]
    tool_goals: list[SentGoal]
    planned: list[Array]
    events: list[FlightEvent] = field(default_factory=list)
    meshes: dict[str, TriangleMesh] = field(default_factory=dict)
    sensed_pose: Signal = field(default_factory=lambda: Signal.none(7))
    sensed_shape: Signal = field(default_factory=lambda: Signal.none(0))
    namespace: str = ""
    other_robots: Sequence[str] = ()

    # -- what it is called --------------------------------------------------------------------

    @property
    def scenario(self) -> str:
        """Name of the scenario, or of the bag."""
        return self.metadata.get("scenario", {}).get("name", "") or Path(self.file_name).stem

    @property
    def label(self) -> str:
        """Short name among several flights: that of the file and of the method."""
        return f"{Path(self.file_name).stem} ({self.method})" if self.method else self.file_name

    @property
    def description(self) -> str:
        """What the scenario says of itself."""
        return self.metadata.get("scenario", {}).get("description", "")

    @property
    def method(self) -> str:
        """Gait method: of the first schedule, or the planner's parameter; else the control law."""
        named = (status.method for status in self.statuses if status.method)
        return next(named, str(self.parameter("planner", "method") or ""))

    @property
    def robot_name(self) -> str:
        """Name in the robot description."""
        return self.robot.name if self.robot is not None else ""

    def parameter(self, node: str, name: str) -> Any:
        """Return a parameter of a node; None if the bag does not hold it."""
        try:
            return json.loads(self.metadata.get(f"parameters/{node}", {})[name])
        except (KeyError, ValueError, RecursionError):
            return None

    @cached_property
    def published(self) -> list[Published]:
        """Published figures of the scenario."""
        try:
            rows = json.loads(self.metadata.get("scenario", {}).get("published", "[]"))
            return [
                Published(str(r["quantity"]), [float(x) for x in r["printed"]], str(r["note"]))
                for r in rows
            ]
        except (KeyError, TypeError, ValueError, RecursionError):
            return []

    # -- what happened ------------------------------------------------------------------------

    @property
    def end(self) -> float:
        """Time of the last sample or status, s."""
        times = [float(s.time[-1]) for s in self._signals if len(s)]
        return max([0.0, *times, *(status.time for status in self.statuses)])

    @property
    def _signals(self) -> tuple[Signal, ...]:
        return self.position, self.shape, self.momentum

    @property
    def executing(self) -> list[Status]:
        """One status for each schedule that was flown."""
        return [status for status in self.statuses if status.executing]

    @cached_property
    def outputs(self) -> frozenset[str]:
        """Names of the controller's outputs; none where a planner has the goals."""
        return frozenset[str]().union(*(status.outputs for status in self.statuses))

    @cached_property
    def targets(self) -> list[Target]:
        """Goals of the schedules; without any schedule, the goals that were sent."""
        found = [(s.time, goal) for s in self.executing if (goal := self._goal_of(s))]
        return self._each_until_the_next(found or [(sent.time, sent.goal) for sent in self.sent])

    @property
    def goal(self) -> Goal | None:
        """The goal that counts at the end: the one flown to last, or else the one sent last."""
        for status in reversed(self.statuses):
            goal = self._goal_of(status)
            if status.state in _FOLLOWED and goal is not None:
                return goal
        return self.sent[-1].goal if self.sent else None

    @property
    def tool_targets(self) -> list[Target]:
        """Goals of the end-effector, each until the next."""
        return self._each_until_the_next([(sent.time, sent.goal) for sent in self.tool_goals])

    def _each_until_the_next(self, goals: list[tuple[float, Goal]]) -> list[Target]:
        ends = [*(time for time, _ in goals), self.end][1:]
        return [Target(t, end, goal) for (t, goal), end in zip(goals, ends, strict=True)]

    @property
    def tool_error(self) -> PoseError | None:
        """Remaining error of the last pose of the end-effector to its last goal."""
        if not self.tool_goals or not len(self.tool):
            return None
        last = self.tool.values[-1]
        return PoseError.between(last[:3], last[3:], self.tool_goals[-1].goal)

    @property
    def position_counts(self) -> bool:
        """Whether the position of the base is part of what the method flies to."""
        method = METHODS.get(self.method)
        return method is None or "position" in method.controls

    def controls(self, part: str) -> list[int]:
        """Components x, y, z, rx, ry, rz (0..5) of ``base`` or ``end_effector`` under control.

        All six where no controller has named its outputs.
        """
        if not self.outputs:
            return list(range(6))
        axes = ("x", "y", "z", "rx", "ry", "rz")
        return [i for i, axis in enumerate(axes) if f"{part}.{axis}" in self.outputs]

    @property
    def final_error(self) -> PoseError | None:
        """Remaining error of the last pose to the goal."""
        if self.goal is None or not len(self.position):
            return None
        return PoseError.between(self.position.values[-1], self.quaternion[-1], self.goal)

    @property
    def sensed_error(self) -> PoseError | None:
        """Remaining error of the last measured pose to the goal, where sensors err."""
        if self.goal is None or not len(self.sensed_pose):
            return None
        last = self.sensed_pose.values[-1]
        return PoseError.between(last[:3], last[3:], self.goal)

    def goal_rotvec(self, goal: Goal) -> Array:
        """Attitude of a goal (3,), rad, with the number of turns nearest to the last attitude."""
        rotvec = rotvec_from_quaternion(goal.quaternion)
        return nearest_rotvec(rotvec, self.attitude.values[-1]) if len(self.attitude) else rotvec

    @property
    def manoeuvre_time(self) -> float | None:
        """Duration of the schedules for the last goal that were flown, s, as
        :func:`~spacerobot_ros.planning.execution.status.manoeuvre_time` has it; of a controller,
        from the first state that it flew to the end that it named.
        """
        if not self.executing:
            return tracking_time(
                (status.time, status.report.state)
                for status in self.statuses
                if isinstance(status.report, ControllerStatus)
            )
        return manoeuvre_time(self._planner_reports, self.end)

    @property
    def time_to_end(self) -> float | None:
        """Time from the first schedule for the last goal to its end, s, with what was waited in
        between; None where no schedule was flown.
        """
        return time_to_end(self._planner_reports, self.end)

    @property
    def _planner_reports(self) -> list[tuple[float, PlannerStatus]]:
        reports = ((s.time, s.report) for s in self.statuses)
        return [(time, report) for time, report in reports if isinstance(report, PlannerStatus)]

    @cached_property
    def drawn(self) -> SolidRobot | None:
        """The robot as something to draw; None if the bag lacks its description or its states."""
        if self.robot is None or self.not_drawn:
            return None
        return SolidRobot(self.robot, self.meshes)

    @property
    def not_drawn(self) -> str:
        """A sentence on what the bag lacks for a picture of the robot; empty for nothing."""
        lacking = []
        if self.robot is None:
            lacking.append("no robot description (robot_description)")
        if not len(self.position):
            lacking.append("no base poses (odom)")
        named = self.robot.joint_names if self.robot is not None else ()
        absent = named if not len(self.shape) else [x for x in named if x not in self.joint_names]
        if absent:
            more = f" and {len(absent) - 1} more" if len(absent) > 1 else ""
            lacking.append(f"no positions of joint '{absent[0]}'{more} (joint_states)")
        if not lacking:
            return ""
        return f"The bag holds {' and '.join(lacking)}: the robot is not drawn."

    @property
    def missing_meshes(self) -> str:
        """A sentence for captions about meshes that the bag does not carry; empty for none."""
        links = self.robot.links if self.robot is not None else ()
        named = {each.resource for link in links for each in link.shapes if each.kind == "mesh"}
        missing = named - self.meshes.keys()
        if not missing:
            return ""
        count = f"{len(missing)} of {len(named)} meshes" if self.meshes else "Meshes"
        return f" {count} are not drawn. The bag does not carry them."

    def base_at(self, index: int) -> Pose:
        """Pose of the base link in the world at a recorded state."""
        R_WB = matrix_from_quaternion(self.quaternion[index])
        return Pose(R_WB, self.position.values[index])

    def samples(self, count: int) -> list[int]:
        """Recorded states at about equal intervals, the first and the last among them."""
        last = len(self.position) - 1
        return np.unique(np.linspace(0, last, count).astype(int)).tolist()

    @cached_property
    def flat(self) -> bool:
        """Whether every link stays in a plane z = const of the world."""
        assert self.drawn is not None
        shapes = self.joints
        poses = [
            list(self.drawn.link_poses(shapes[index], self.base_at(index)).values())
            for index in self.samples(25)
        ]
        upright = all(abs(pose.R[2, 2]) > 1 - 1e-9 for links in poses for pose in links)
        heights = np.array([[pose.r[2] for pose in links] for links in poses])
        return upright and float(np.ptp(heights, axis=0).max()) < 1e-6

    @cached_property
    def joints(self) -> Array:
        """Joint positions (N, n), in the order of the robot description, at the base poses."""
        assert self.robot is not None
        chosen = [self.joint_names.index(name) for name in self.robot.joint_names]
        time = self.position.time
        if not chosen:
            return np.empty((len(time), 0))
        if np.array_equal(time, self.shape.time):
            return self.shape.values[:, chosen]
        columns = [np.interp(time, self.shape.time, self.shape.values[:, i]) for i in chosen]
        return np.column_stack(columns)

    @cached_property
    def cycles(self) -> Cycles | None:
        """The equal cycles with which the longest schedule ends."""
        starts = [0.0, *(status.time for status in self.executing)]
        spans = list(zip(starts, [*starts[1:], self.end], strict=True))
        start, end = max(spans, key=lambda span: span[1] - span[0])
        return find_cycles(self.rates.between(start, end))

    @property
    def tick(self) -> float:
        """Time from one recorded pose to the next, s; 0 with one or none."""
        return float(np.median(np.diff(self.position.time))) if len(self.position) > 1 else 0.0

    def drift(self, first: int) -> float:
        """Largest change of linear (``first`` 0) or angular (3) momentum, SI."""
        part = self.momentum.values[:, first : first + 3]
        return float(np.nanmax(np.linalg.norm(part - part[0], axis=1)))

    @cached_property
    def impulse(self) -> Signal:
        """Impulse that all thrusters together have given (N, 1), N s."""
        return self._summed(np.ones(len(self.thruster_names)))

    @cached_property
    def propellant(self) -> Signal | None:
        """Propellant that the thrusters have taken (N, 1), kg; None where their specific impulses
        are not in the bag.
        """
        if self.robot is None or self.parameter("plant", "thrusters") != IN_URDF:
            return None
        try:
            table = find_thrusters(IN_URDF, self.robot)
        except SpaceRobotError:
            return None
        if list(table.names) != self.thruster_names:
            return None
        return self._summed(table.mass_flow / table.force)

    def _summed(self, weights: Array) -> Signal:
        """Return the sum over time and thrusters of their forces, each times its weight."""
        ticks = np.diff(self.thrust.time, prepend=self.thrust.time[:1])
        total = np.cumsum(ticks * (self.thrust.values @ weights))
        return Signal(self.thrust.time, total[:, np.newaxis])

    def joint(self, name: str) -> Joint | None:
        """The joint of that name in the robot description."""
        joints = self.robot.movable_joints if self.robot is not None else ()
        return next((joint for joint in joints if joint.name == name), None)

    def _goal_of(self, status: Status) -> Goal | None:
        """Return the goal of a status, as it was sent."""
        for sent in reversed(self.sent):
            if status.goal_id and status.goal_id == sent.goal_id:
                return sent.goal
        try:
            named = Goal.checked(status.goal[:3], status.goal[3:])
        except PlanningError:
            return None
        # Bags of earlier versions have no ids: the goal that was sent has more digits.
        for sent in reversed(self.sent):
            goal = sent.goal
            same = np.allclose(goal.position, named.position, rtol=1e-7, atol=1e-8)
            if same and np.allclose(goal.quaternion, named.quaternion, rtol=0.0, atol=1e-7):
                return goal
        return named


def joint_unit(flight: Flight, name: str) -> str:
    """Return m or rad; without a robot description, that it is one of them."""
    joint = flight.joint(name)
    if joint is None:
        return "m or rad"
    return "m" if joint.kind is JointKind.PRISMATIC else "rad"
