"""A flight and its bag as shown in a report; times are in s since the first state."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from spacerobot_ros.collision.distances import obstacle_visuals
from spacerobot_ros.commanding.goal_follower import Status
from spacerobot_ros.control.status import ControllerStatus
from spacerobot_ros.errors import MeshError
from spacerobot_ros.events import Event
from spacerobot_ros.flight.flight import Flight
from spacerobot_ros.flight.reading import (
    FlightBag,
    namespaces,
    open_flight_bag,
    pose_of,
    read_flight,
)
from spacerobot_ros.flight.series import SentGoal, Signal, nearest_rotvec, reported_goal, rotvecs
from spacerobot_ros.measures import flown_time
from spacerobot_ros.model.description import (
    DEFAULT_END_EFFECTOR,
    Array,
    Joint,
    Pose,
    RobotDescription,
    Shape,
)
from spacerobot_ros.model.kinematics import ForwardKinematics
from spacerobot_ros.model.meshes import TriangleMesh, Visual, meshes_from_attachments
from spacerobot_ros.model.rotations import (
    quaternion_inverse,
    quaternion_multiply,
    rotvec_from_quaternion,
    rotvecs_from_quaternions,
)
from spacerobot_ros.planning import Goal
from spacerobot_ros.planning.core.goal import EndEffectorGoal
from spacerobot_ros.planning.execution.status import PlannerState, PlannerStatus
from spacerobot_ros.planning.methods.registry import METHODS
from spacerobot_ros.report.events import shown_events
from spacerobot_ros.scenario import COMMANDERS
from spacerobot_ros.times import SECOND

_MAX_LINK_ERROR_STATES = 2000

_MIN_CYCLES = 12

_MAX_PERIOD_SAMPLES = 1 << 14
"""Number of samples at the end of a gait that are searched for a period."""


@dataclass(frozen=True)
class GoalSpan:
    """A goal and the time span, ``start`` to ``end`` in s, during which the robot flew to it."""

    start: float
    end: float
    goal: Goal


@dataclass(frozen=True)
class Cycles:
    """A segment of a flight, ``start`` to ``end`` in s, that repeats every ``period`` s."""

    start: float
    end: float
    period: float

    @property
    def count(self) -> int:
        """Number of whole cycles."""
        return int((self.end - self.start) / self.period + 0.05)

    def last(self, count: int) -> tuple[float, float]:
        """Return the start and end of the last few cycles."""
        return self.end - count * self.period, self.end


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class FlightReport(Flight):
    """A flight and its bag; times are in s since the first state, and missing signals are empty.

    Attributes
    ----------
    bag
        The bag that the flight was read from.
    meshes
        Triangles of the meshes in the bag, by URI.
    draws_events
        Whether figures over time show the events.
    """

    bag: FlightBag
    meshes: dict[str, TriangleMesh] = field(default_factory=dict)
    draws_events: bool = True

    # -- signals ------------------------------------------------------------------------------

    @cached_property
    def attitude(self) -> Signal:
        """Base attitude as exponential coordinates (N, 3), rad, continuous beyond half
        revolutions."""
        return Signal(self.time, rotvecs(self.pose[:, 3:]))

    @property
    def tool(self) -> Signal:
        """End-effector pose in the world (N, 7)."""
        return self.signal("end_effector_pose")

    @property
    def efforts(self) -> Signal:
        """Commanded joint efforts (N, n), in the order of the joint names."""
        # Without the plant's parameters, only the messages tell velocities from efforts.
        if self.parameter("plant", "actuation") == "velocity":
            return Signal.empty(len(self.joint_names))
        width = len(self.joint_names)
        return self.bag.signal("joint_commands", ["effort"], width, self.joint_names)

    @cached_property
    def planned(self) -> list[Array]:
        """Planned base positions (K, 3), m, one array per schedule."""
        paths = [message.poses for _, message in self.bag.messages("planned_path")]
        return [np.array([pose_of(p)[0] for p in poses]).reshape(-1, 3) for poses in paths]

    # -- the bag and the robot ----------------------------------------------------------------

    @property
    def other_robots(self) -> list[str]:
        """Namespaces of the other robots in the bag."""
        others = namespaces(self.bag.bag)
        return [name or "/" for name in others if name != self.bag.namespace]

    def mesh_of(self, shape: Shape) -> TriangleMesh:
        """Return a mesh from the bag; external files named in the bag are not read."""
        if shape.resource not in self.meshes:
            raise MeshError(f"The bag does not contain the mesh '{shape.resource}'.")
        return self.meshes[shape.resource].moved(shape.pose, shape.size)

    @cached_property
    def obstacles(self) -> tuple[tuple[Visual, Pose], ...]:
        """Obstacle solids, each with the pose of its link in the world."""
        return () if self.robot is None else obstacle_visuals(self.robot.world, self.mesh_of)

    # -- names --------------------------------------------------------------------

    @property
    def flown_method(self) -> str:
        """Control law, or gait method according to the first schedule or the planner's
        parameter."""
        for _, status in self.reports:
            if isinstance(status, PlannerStatus) and status.method:
                return status.method
            if isinstance(status, ControllerStatus) and status.command is not None:
                return status.command.law
        return str(self.parameter("planner", "method") or "")

    def parameter(self, node: str, name: str) -> Any:
        """Return a node parameter; None if the bag does not contain the parameter."""
        return self.scenario.in_file.get(node, {}).get(name)

    @property
    def timed_events(self) -> list[tuple[float, Event]]:
        """The events that are drawn, with their times, s."""
        return shown_events(self.events) if self.draws_events else []

    # -- reports and goals ------------------------------------------------------------------------

    @property
    def end(self) -> float:
        """Time of the last sample or status, s."""
        signals = map(self.signal, ("pose", "q", "momentum"))
        times = [float(signal.time[-1]) for signal in signals if len(signal)]
        return max([0.0, *times, *(time for time, _ in self.timed_statuses)])

    @cached_property
    def timed_statuses(self) -> list[tuple[float, Status | str]]:
        """Planner statuses or, if there are none, controller statuses, with their times, s. For a
        status from another package, only the message is returned.
        """
        for commander in COMMANDERS:
            found = [(time_ns / SECOND, status) for time_ns, status in self.bag.statuses(commander)]
            if found:
                return found
        return []

    @cached_property
    def reports(self) -> list[tuple[float, Status]]:
        """The statuses in :attr:`timed_statuses` that come from this package."""
        return [(time, each) for time, each in self.timed_statuses if not isinstance(each, str)]

    @property
    def executing(self) -> list[tuple[float, PlannerStatus]]:
        """The status at the start of each flown schedule."""
        return [
            (time, each)
            for time, each in self.reports
            if isinstance(each, PlannerStatus) and each.state is PlannerState.EXECUTING
        ]

    @cached_property
    def outputs(self) -> frozenset[str]:
        """Names of the controller outputs; none if the goals belong to a planner."""
        reports = (each for _, each in self.reports if isinstance(each, ControllerStatus))
        return frozenset(name for each in reports if each.command for name in each.command.errors)

    @cached_property
    def targets(self) -> list[GoalSpan]:
        """Base goals in the schedules; if there are no schedules, the goals that were sent."""
        return [target for target in self._all_targets if target.goal.base]

    @cached_property
    def _all_targets(self) -> list[GoalSpan]:
        found = [
            (time, goal)
            for time, status in self.executing
            if (goal := reported_goal(status, self.goals))
        ]
        return self._targets_until_next(found or [(sent.time, sent.goal) for sent in self.goals])

    @property
    def base_goal(self) -> Goal | None:
        """The base goal that is active at the end; None if there is no goal or the base is free."""
        return self.goal if self.goal is not None and self.goal.base else None

    @property
    def other_goal(self) -> bool:
        """Whether the base was sent to a goal other than the scenario goal."""
        own = self.scenario.goal
        return self.scenario.has_goal and any(
            not np.allclose(sent.goal.position, own.position)
            or not np.allclose(sent.goal.quaternion, own.quaternion)
            for sent in self.goals
            if own.base
        )

    @cached_property
    def link_goals(self) -> dict[str, EndEffectorGoal]:
        """The planner's active link goals at the end."""
        return {} if self.goal is None else {each.link: each for each in self.goal.end_effectors}

    @cached_property
    def link_errors(self) -> dict[str, tuple[Signal, Signal]]:
        """Distances (N, 1), m, and angles (M, 1), rad, between true link poses and their goals, at
        up to two thousand states. There are no angles if any attitude is acceptable. No links are
        returned if the bag lacks the robot description or states.
        """
        found = {}
        for link, poses in self.link_poses.items():
            aims = [
                (GoalSpan(target.start, target.end, aim.as_goal()), aim.quaternion is not None)
                for target in self._all_targets
                for aim in target.goal.end_effectors
                if aim.link == link
            ]
            distances = pose_errors(poses, [span for span, _ in aims]).norms([0, 1, 2])
            angles = pose_errors(poses, [span for span, turns in aims if turns]).norms([3, 4, 5])
            found[link] = distances, angles
        return found

    @cached_property
    def link_poses(self) -> dict[str, Signal]:
        """World poses (k, 7) of links with goals, at up to two thousand states."""
        aims = (each for target in self._all_targets for each in target.goal.end_effectors)
        links = list(dict.fromkeys(each.link for each in aims))
        if self.robot is None or self.hidden_links_text or not links:
            return {}
        rows = self.samples(_MAX_LINK_ERROR_STATES)
        poses = link_poses(self.robot, continuous(self.pose)[rows], self.joints[rows])
        time = self.time[rows]
        return {link: Signal(time, poses[link]) for link in links if link in poses}

    @property
    def tool_goals(self) -> tuple[SentGoal, ...]:
        """Goals of a controller's end-effector."""
        # A planner takes goals of the link `end_effector` on the same topic, and reports them.
        return () if DEFAULT_END_EFFECTOR in self.link_goals else self.end_effector_goals

    @property
    def tool_targets(self) -> list[GoalSpan]:
        """End-effector goals, each valid until the next goal."""
        return self._targets_until_next([(sent.time, sent.goal) for sent in self.tool_goals])

    def _targets_until_next(self, goals: list[tuple[float, Goal]]) -> list[GoalSpan]:
        ends = [*(time for time, _ in goals), self.end][1:]
        return [GoalSpan(t, end, goal) for (t, goal), end in zip(goals, ends, strict=True)]

    @property
    def position_counts(self) -> bool:
        """Whether the method controls the base position."""
        return "position" not in self.not_controlled

    def controls(self, part: str) -> list[int]:
        """Indices of the controlled components x, y, z, rx, ry, rz (0 to 5) of ``base`` or
        ``end_effector``.

        All six components if no controller has reported its outputs.
        """
        if not self.outputs:
            return list(range(6))
        axes = ("x", "y", "z", "rx", "ry", "rz")
        return [i for i, axis in enumerate(axes) if f"{part}.{axis}" in self.outputs]

    def goal_rotvec(self, goal: Goal) -> Array:
        """Goal attitude as the rotation vector (3,), rad, nearest to the last attitude."""
        rotvec = rotvec_from_quaternion(goal.quaternion)
        return nearest_rotvec(rotvec, self.attitude.values[-1]) if len(self.attitude) else rotvec

    @property
    def time_flown(self) -> float | None:
        """Time flown to the last goal, s; see :func:`~spacerobot_ros.measures.flown_time`."""
        return flown_time(self.reports, self.end)

    @property
    def no_poses_text(self) -> str:
        """A message that the bag contains no base poses, and what it contains instead."""
        instead = self.bag.instead_of("odom")
        return f"The bag contains no base poses (odom){instead}; base figures are missing."

    @property
    def no_joints_text(self) -> str:
        """A message that the bag contains no joint positions, and what it contains instead."""
        instead = self.bag.instead_of("joint_states")
        return f"The bag contains no joint positions (joint_states){instead}."

    @property
    def hidden_links_text(self) -> str:
        """A message about missing data that are needed to draw the robot; empty if nothing is
        missing."""
        lacking = []
        if self.robot is None:
            lacking.append("no robot description (robot_description)")
        if not len(self.time):
            lacking.append("no base poses (odom)")
        named = self.robot.joint_names if self.robot is not None else ()
        absent = named if not len(self.q) else [x for x in named if x not in self.joint_names]
        if absent:
            more = f" and {len(absent) - 1} more" if len(absent) > 1 else ""
            lacking.append(f"no positions of joint '{absent[0]}'{more} (joint_states)")
        if not lacking:
            return ""
        return f"The bag contains {' and '.join(lacking)}: the robot is not drawn."

    @property
    def missing_meshes(self) -> str:
        """A sentence for captions about meshes that are missing from the bag; empty if there are
        none."""
        shapes: list[Shape] = []
        if self.robot is not None:
            shapes += [each for link in self.robot.links for each in link.shapes]
            if (world := self.robot.world) is not None:
                shapes += [s for link in world.links for s in link.collisions or link.shapes]
        named = {each.resource for each in shapes if each.kind == "mesh"}
        missing = named - self.meshes.keys()
        if not missing:
            return ""
        count = f"{len(missing)} of {len(named)} meshes" if self.meshes else "Meshes"
        return f" {count} are not drawn. The bag does not contain them."

    def samples(self, count: int) -> list[int]:
        """Recorded states at approximately equal intervals, including the first and the last."""
        last = len(self.time) - 1
        return np.unique(np.linspace(0, last, count).astype(int)).tolist()

    @cached_property
    def joints(self) -> Array:
        """Joint positions (N, n), in robot description order, at the times of the base poses.

        Reaction wheel angles are set to 0: a body of revolution looks the same at any angle.
        """
        assert self.robot is not None
        time, found = self.time, []
        at_poses = np.array_equal(time, self.signal("q").time)
        for name in self.robot.joint_names:
            values = self.q[:, self.joint_names.index(name)]
            if name in self.robot.wheel_names:
                values = np.zeros(len(values))
            found.append(values if at_poses else np.interp(time, self.signal("q").time, values))
        return np.column_stack(found) if found else np.empty((len(time), 0))

    @property
    def repeats_cycles(self) -> bool:
        """Whether the method repeats cycles, or is unknown; false for control laws."""
        if any(isinstance(status, ControllerStatus) for _, status in self.reports):
            return False
        flown = {status.method for _, status in self.executing if status.method}
        return not flown or any(
            name not in METHODS or METHODS[name].repeats_cycles for name in flown
        )

    @cached_property
    def cycles(self) -> Cycles | None:
        """The equal cycles at the end of the longest schedule; None if there are no such cycles."""
        if not self.repeats_cycles:
            return None
        starts = [0.0, *(time for time, _ in self.executing)]
        spans = list(zip(starts, [*starts[1:], self.end], strict=True))
        start, end = max(spans, key=lambda span: span[1] - span[0])
        return find_cycles(self.signal("qdot").between(start, end))

    @property
    def tick(self) -> float:
        """Time between recorded poses, s; 0 if there are fewer than two."""
        return float(np.median(np.diff(self.time))) if len(self.time) > 1 else 0.0

    @cached_property
    def wheel_columns(self) -> tuple[int, ...]:
        """Columns of reaction wheel joints."""
        wheels = self.robot.wheel_names if self.robot is not None else ()
        return tuple(i for i, name in enumerate(self.joint_names) if name in wheels)

    @cached_property
    def shape_columns(self) -> tuple[int, ...]:
        """Columns of the other joints, whose positions form the robot's shape."""
        return tuple(i for i in range(len(self.joint_names)) if i not in self.wheel_columns)

    def joint(self, name: str) -> Joint | None:
        """The joint with that name in the robot description."""
        joints = self.robot.movable_joints if self.robot is not None else ()
        return next((joint for joint in joints if joint.name == name), None)


def pose_errors(pose: Signal, targets: Sequence[GoalSpan]) -> Signal:
    """Return the goal minus the pose (N, 7) at the M times with a goal: position and rotation
    vector (M, 6)."""
    times, values = [np.empty(0)], [np.empty((0, 6))]
    for target in targets:
        part = pose.between(target.start, target.end)
        if len(part):
            inverse = quaternion_inverse(part.values[:, 3:])
            turn = quaternion_multiply(target.goal.quaternion, inverse)
            left = target.goal.position - part.values[:, :3]
            times.append(part.time)
            values.append(np.hstack([left, rotvecs_from_quaternions(turn)]))
    return Signal(np.concatenate(times), np.concatenate(values))


def read_report(path: Path, namespace: str | None = None) -> FlightReport:
    """Read a bag for a report; see :func:`~spacerobot_ros.flight.reading.open_flight_bag`.

    Raises
    ------
    RecordingError
        There is no such bag or robot, or the bag is damaged.
    """
    bag = open_flight_bag(path, namespace, from_start=True)
    flight = read_flight(bag)
    return FlightReport(
        **{each.name: getattr(flight, each.name) for each in fields(flight)},
        bag=bag,
        meshes=meshes_from_attachments(flight.robot, bag.bag.attachments) if flight.robot else {},
    )


def labels_of(flights: Sequence[FlightReport]) -> list[str]:
    """Return a name for each of several flights: the method, or the file name if methods recur or
    scenarios differ."""
    scenarios = {each.bag.metadata.get("scenario", {}).get("name", "") for each in flights}
    methods = [each.flown_method for each in flights] if len(scenarios) == 1 else []
    paths = [each.bag.path for each in flights]
    for names in (methods, [path.stem for path in paths]):
        if all(names) and len(set(names)) == len(flights):
            return names
    return [f"{path.parent.name}/{path.stem}" for path in paths]


def joint_unit(flight: FlightReport, name: str) -> str:
    """Return the unit of a joint: m, rad, or ``m or rad`` without a robot description."""
    joint = flight.joint(name)
    return "m or rad" if joint is None else joint.unit


# -- arithmetic on recorded motion --------------------------------------------------------------


def continuous(poses: Array) -> Array:
    """Return poses (N, 7) with sign-continuous quaternions."""
    flips = np.cumsum((poses[1:, 3:] * poses[:-1, 3:]).sum(axis=1) < 0) % 2
    signs = np.append(1, 1 - 2 * flips)[: len(poses), np.newaxis]
    return np.hstack([poses[:, :3], poses[:, 3:] * signs])


def link_poses(robot: RobotDescription, base: Array, q: Array) -> dict[str, Array]:
    """Return the world poses (K, 7) of all links, with the base link first.

    Link quaternions are continuous if the base quaternions are.

    Parameters
    ----------
    robot
        The robot.
    base, q
        (K, 7) base poses in the world, and (K, n) joint positions, m or rad.
    """
    from scipy.spatial.transform import Rotation

    kinematics = ForwardKinematics(robot)
    R_WL, r_WL = kinematics.poses_in_world(base, q)
    attitudes = Rotation.from_matrix(R_WL.reshape(-1, 3, 3)).as_quat().reshape(*r_WL.shape[:2], 4)
    poses = np.concatenate([r_WL, attitudes], axis=2)
    return {link: continuous(poses[:, k]) for k, link in enumerate(kinematics.links)}


def find_cycles(rates: Signal) -> Cycles | None:
    """Return the equal cycles at the end of a gait, detected from its joint velocities.

    None if there are fewer than twelve cycles that agree to within a tenth of the peak velocity.
    """
    peak = np.abs(rates.values).max(axis=0, initial=0.0)
    moving = np.flatnonzero((np.abs(rates.values) > 1e-6 * peak).any(axis=1))
    if len(moving) < 4 * _MIN_CYCLES:
        return None
    values = rates.values[: int(moving[-1]) + 1] / np.where(peak > 0, peak, 1.0)
    # The cycles may be preceded by a large part of the gait.
    looks = (values[-min(_MAX_PERIOD_SAMPLES, len(values) // part) :] for part in (1, 2, 4))
    lag = next((lag for look in looks if (lag := _period_in_samples(look))), None)
    if lag is None:
        return None
    different = np.abs(values[lag:] - values[:-lag]).max(axis=1) > 0.1
    # The last stretch between differing samples that contains enough cycles.
    bounds = np.concatenate([[-1], np.flatnonzero(different), [len(different)]])
    enough = np.flatnonzero(np.diff(bounds) - 1 >= (_MIN_CYCLES - 1) * lag)
    if not len(enough):
        return None
    first, stop = int(bounds[enough[-1]]) + 1, int(bounds[enough[-1] + 1]) + lag
    last = min(stop, len(rates) - 1)
    start, end = float(rates.time[first]), float(rates.time[last])
    if end <= start:
        return None  # All messages have the same log time.
    return Cycles(start, end, lag * (end - start) / (last - first))


def _period_in_samples(values: Array) -> int | None:
    """Shortest shift, in samples, at which the columns match themselves; None if there is none."""
    n = len(values)
    spectrum = np.fft.rfft(values, 2 * n, axis=0)
    product = np.fft.irfft((spectrum * spectrum.conj()).sum(axis=1))[:n]
    energy = np.cumsum((values**2).sum(axis=1))
    # Energy of the overlapping parts: the first and the last n - lag samples.
    lags = np.arange(n // 3)
    first, last = energy[n - 1 - lags], energy[-1] - np.append(0.0, energy)[lags]
    match = product[lags] / np.maximum(np.sqrt(first * last), 1e-300)
    below = np.flatnonzero(match < 0.9)
    if not len(below):
        return None
    good = np.flatnonzero(match[below[0] :] > 0.97) + below[0]
    if not len(good):
        return None
    # The maximum of the first peak that is high enough.
    hill = np.split(good, np.flatnonzero(np.diff(good) > 1) + 1)[0]
    return int(hill[np.argmax(match[hill])])
