"""Flight data: quantities over time, commands and sent goals, and their collection tick by tick."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from spacerobot_ros.commanding.goal_follower import Status
from spacerobot_ros.errors import PlanningError
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.rotations import rotvecs_from_quaternions
from spacerobot_ros.planning import Goal, PoseError
from spacerobot_ros.planning.core.goal import EndEffectorGoal
from spacerobot_ros.planning.execution.status import PlannerStatus
from spacerobot_ros.times import SECOND

if TYPE_CHECKING:
    from spacerobot_ros.events import Event
    from spacerobot_ros.messages.diagnostics import StatusRecord
    from spacerobot_ros.planning import GaitSchedule
    from spacerobot_ros.planning.core.schedule import BasePath
    from spacerobot_ros.simulation.actuators import PlantWithFaults
    from spacerobot_ros.simulation.commands import CommandValidator, Refusal
    from spacerobot_ros.simulation.sensors import ReportedState
    from spacerobot_ros.simulation.status import PlantStatus

_FLOWN_STATES = frozenset(("executing", "reached", "reached_partly", "failed", "aborted"))
"""Commander states in which the goal is being or has been pursued."""


@dataclass(frozen=True)
class Signal:
    """Samples ``values`` (N, k) at ``time`` (N,), s."""

    time: Array
    values: Array

    def __post_init__(self) -> None:
        # A caller that changed them would change errors, pictures and saved bags.
        self.time.flags.writeable = self.values.flags.writeable = False

    def __len__(self) -> int:
        return len(self.time)

    @classmethod
    def empty(cls, width: int) -> Signal:
        """Return a signal without samples."""
        return cls(np.empty(0), np.empty((0, width)))

    @property
    def width(self) -> int:
        """Number of values per sample."""
        return int(self.values.shape[1])

    def between(self, start: float, end: float) -> Signal:
        """Return the samples from ``start`` to ``end``, inclusive."""
        first, last = np.searchsorted(self.time, [start - 1e-9, end + 1e-9])
        return Signal(self.time[first:last], self.values[first:last])

    def at(self, time: Array) -> Array:
        """Return the values (M, k) at times (M,), interpolated linearly; NaN outside the span and
        at breaks."""
        found = np.full((len(time), self.width), np.nan)
        if len(self):
            for column, values in zip(found.T, self.values.T, strict=True):
                column[:] = np.interp(time, self.time, values, np.nan, np.nan)
            breaks = self.time[np.isnan(self.values).any(axis=1)]
            found[np.isin(time, breaks)] = np.nan
        return found

    def rows_after(self, resets: Sequence[float]) -> npt.NDArray[np.int64]:
        """Return the row of the first sample after each reset (s) that samples surround."""
        before = np.searchsorted(self.time, np.subtract(resets, 1e-9))
        rows = np.searchsorted(self.time, np.add(resets, 1e-9))
        # The states before and after a reset have the same stamp.
        rows = rows - (rows - before > 1)
        return rows[(rows > 0) & (rows < len(self))]

    def broken_at(self, resets: Sequence[float]) -> Signal:
        """Return the signal with a NaN sample at each reset (s), where its traces break."""
        rows = self.rows_after(resets)
        time = np.insert(self.time, rows, self.time[rows])
        return Signal(time, np.insert(self.values, rows, np.nan, axis=0))

    def norms(self, columns: Sequence[int]) -> Signal:
        """Return the norms (N, 1) of selected columns."""
        return Signal(self.time, np.linalg.norm(self.values[:, columns], axis=1, keepdims=True))

    def thinned(self, slices: int) -> Signal:
        """Return the samples with the smallest and the largest value of a trace in a time slice,
        and the first and last sample.

        Lines through them cover the same pixels as those through all samples if a slice is as wide
        as a pixel (Jugel et al., "M4: a visualization-oriented time series data aggregation", VLDB
        2014).
        """
        if len(self) <= 4 * slices:
            return self
        gaps = np.flatnonzero(np.isnan(self.values).any(axis=1))
        edges = np.linspace(0, len(self), slices + 1).astype(int)
        edges = np.unique(np.concatenate([edges, gaps, gaps + 1]))
        kept = [edges[:-1], edges[1:] - 1]
        for a, b in itertools.pairwise(edges.tolist()):
            part = self.values[a:b]
            kept += [a + part.argmin(axis=0), a + part.argmax(axis=0)]
        rows = np.unique(np.concatenate(kept))
        return Signal(self.time[rows], self.values[rows])


@dataclass(frozen=True)
class Commands(Signal):
    """The commands on one topic as used by the plant or the controller, at the times of the states
    to which they respond.

    ``setpoints`` (N, 2 n) are the joint positions and rates in a planner's messages; None if not
    known.
    """

    setpoints: Array | None = None


@dataclass(frozen=True)
class SentGoal:
    """A goal pose sent at ``time`` (s), and its id in statuses."""

    time: float
    goal: Goal
    goal_id: str


def rotvecs(quaternions: Array) -> Array:
    """Return attitudes (N, 4) as rotation vectors (N, 3), continuous beyond half revolutions.

    The first vector has a length of at most pi; each later vector is the equivalent vector nearest
    to the previous vector.
    """
    wrapped = rotvecs_from_quaternions(quaternions)
    lengths = np.linalg.norm(wrapped, axis=1)
    # The axis flips at half revolutions and at zero, where the angle about it changes sign.
    turned_over = np.einsum("ij,ij->i", wrapped[1:], wrapped[:-1]) < 0
    signs = np.append(1, np.cumprod(1 - 2 * turned_over))[: len(wrapped)]
    added = signs * np.unwrap(signs * lengths) - lengths
    return wrapped + added[:, np.newaxis] * wrapped / np.maximum(lengths, 1e-12)[:, np.newaxis]


def nearest_rotvec(rotvec: Array, near: Array) -> Array:
    """Return the rotation vector (3,) of the same attitude that is nearest to ``near`` (3,)."""
    length = float(np.linalg.norm(rotvec))
    if length < 1e-12:
        return rotvec
    turns = round((float(near @ rotvec) / length - length) / (2 * np.pi))
    return rotvec * (1 + 2 * np.pi * turns / length)


def pose_error(poses: Signal, goal: Goal | None) -> PoseError | None:
    """Return the error of the last pose relative to a goal; None if there is no pose or goal."""
    if goal is None or not len(poses):
        return None
    return PoseError.between(poses.values[-1, :3], poses.values[-1, 3:], goal)


def reported_goal(status: Status, goals: Sequence[SentGoal]) -> Goal | None:
    """Return the goal in a status: the base goal as sent, and the link goals.

    None if the status has no goal.
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
    as_sent = [each.goal for each in goals if status.goal_id and status.goal_id == each.goal_id]
    try:
        reported = Goal.checked(status.goal[:3], status.goal[3:])
    except PlanningError:
        return as_sent[-1] if as_sent else None
    if as_sent:
        return as_sent[-1].kept_at(reported.position, reported.quaternion)
    # Bags from earlier versions have no ids; the goal that was sent has more digits.
    for sent in reversed(goals):
        goal = sent.goal
        same = np.allclose(goal.position, reported.position, rtol=1e-7, atol=1e-8)
        if same and np.allclose(goal.quaternion, reported.quaternion, rtol=0.0, atol=1e-7):
            return goal
    return reported


def with_reported_goals(
    goals: Sequence[SentGoal], statuses: Iterable[tuple[int, Status]]
) -> tuple[SentGoal, ...]:
    """Return the goals that were sent, and the base goals in statuses (time in ns) of others."""
    found, ids = list(goals), {each.goal_id for each in goals}
    for time_ns, status in statuses:
        goal = None if status.goal_id in ids else reported_goal(status, ())
        if goal is not None and goal.base:
            found.append(SentGoal(time_ns / SECOND, goal, status.goal_id))
            ids.add(status.goal_id)
    return tuple(sorted(found, key=lambda sent: sent.time))


def goal_at_end(statuses: Iterable[Status], goals: Sequence[SentGoal]) -> Goal | None:
    """Return the last pursued goal; if there is none, return the last goal that was sent or
    reported."""
    reported = [(each, reported_goal(each, goals)) for each in statuses]
    for status, goal in reversed(reported):
        if status.state.value in _FLOWN_STATES and goal is not None:
            return goal
    if goals:
        return goals[-1].goal
    return next((goal for _, goal in reversed(reported) if goal is not None), None)


class FlightLog:
    """Collects the arrays of a :class:`~spacerobot_ros.flight.flight.Flight` tick by tick.

    Parameters
    ----------
    plant, reported, commands
        The plant, its reported quantities, and its commands.
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
        self.paths: list[tuple[int, BasePath]] = []
        self.plant_statuses: list[tuple[int, PlantStatus]] = []
        self.diagnostics: list[tuple[int, tuple[StatusRecord, ...]]] = []
        self.covariances: list[tuple[int, Array]] = []
        self.refusals: list[tuple[float, str, Refusal]] = []
        self._period_ns = period_ns
        self._plant, self._reported = plant, reported
        self._propellant = np.zeros(1)
        true = {"pose": plant.pose, "twist": plant.twist, "q": plant.q, "qdot": plant.qdot}
        # Without sensor errors, the measurements are the true arrays.
        unused = [f"true_{name}" for name in true]
        unused += [] if reported.sensors.used else [f"measured_{name}" for name in true]
        sources = {name: x for name, x in reported.quantities.items() if name not in unused} | true
        if plant.thrusters is not None:
            sources["propellant"] = self._propellant
        self._sources, self._parts = sources, tuple(sources.values())
        self._states: list[Array] = []
        """All quantities of each state, in one row per state."""
        self._sizes = {source.topic: len(source.limits) for source in commands.sources}
        self._commands: dict[str, list[tuple[int, Array]]] = {topic: [] for topic in self._sizes}
        self._setpoints: dict[str, list[Array]] = {}
        self._faults_seen: object = None
        self._ticks_without_pose: list[int] = []
        self._ticks_without_target: list[int] = []

    def add_state(self, tick: int) -> None:
        """Add the current state."""
        if self._plant.thrusters is not None:
            self._propellant[0] = self._plant.thrusters.propellant
        self._states.append(np.concatenate(self._parts))
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
        """Add a command; planner commands include the setpoint, joint positions and rates."""
        self._commands.setdefault(topic, []).append((tick, values.copy()))
        self._sizes.setdefault(topic, len(values))
        if setpoint is not None:
            self._setpoints.setdefault(topic, []).append(np.concatenate(setpoint))

    def data(self) -> dict[str, Any]:
        """Return the collected fields of the flight by name."""
        table = np.array(self._states)
        ends = np.cumsum([source.size for source in self._parts])
        columns = np.split(table, ends[:-1], axis=1)
        states = {name: each.copy() for name, each in zip(self._sources, columns, strict=True)}
        lost = {"pose_lost": self._ticks_without_pose}
        if self._ticks_without_target:
            lost["target_lost"] = self._ticks_without_target
        for name, ticks in lost.items():
            states[name] = np.zeros((len(table), 1))
            states[name][ticks] = 1.0
        time: Array = np.arange(len(table)) * self._period_ns / SECOND
        commands = {
            topic: Commands(
                np.array([tick for tick, _ in sent], np.int64) * self._period_ns / SECOND,
                np.array([values for _, values in sent]).reshape(len(sent), self._sizes[topic]),
                np.array(self._setpoints[topic]) if topic in self._setpoints else None,
            )
            for topic, sent in self._commands.items()
        }
        return {
            "series": {name: Signal(time, values) for name, values in states.items()},
            "commands": commands,
            # The public lists are fields of the same names.
            **{name: tuple(each) for name, each in vars(self).items() if name[0] != "_"},
        }
