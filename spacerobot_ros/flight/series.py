"""Flight data: quantities over time, commands, and sent goals."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from spacerobot_ros.commanding.goal_follower import Status
from spacerobot_ros.errors import PlanningError
from spacerobot_ros.model.description import Array
from spacerobot_ros.planning import Goal, PoseError
from spacerobot_ros.planning.core.goal import EndEffectorGoal
from spacerobot_ros.planning.execution.status import PlannerStatus

_FLOWN_STATES = frozenset(("executing", "reached", "reached_partly", "failed", "aborted"))
"""Commander states in which the goal is being or has been pursued."""


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
        """Number of values per sample."""
        return int(self.values.shape[1])

    def between(self, start: float, end: float) -> Signal:
        """Return the samples from ``start`` to ``end``, inclusive."""
        first, last = np.searchsorted(self.time, [start - 1e-9, end + 1e-9])
        return Signal(self.time[first:last], self.values[first:last])

    def at(self, time: Array) -> Array:
        """Return the values (M, k) at times (M,), interpolated linearly; NaN outside the span."""
        if not len(self):
            return np.full((len(time), self.width), np.nan)
        columns = (np.interp(time, self.time, x, np.nan, np.nan) for x in self.values.T)
        return np.stack([*columns], axis=1) if self.width else np.empty((len(time), 0))

    def norms(self, columns: Sequence[int]) -> Signal:
        """Return the norms (N, 1) of selected columns."""
        return Signal(self.time, np.linalg.norm(self.values[:, columns], axis=1, keepdims=True))


@dataclass(frozen=True)
class Commands:
    """The commands on one topic.

    Attributes
    ----------
    tick
        (N,) tick of the state to which each command responds.
    values
        (N, size) values used by the plant or the controller.
    setpoints
        (N, 2 n) joint positions and rates in a planner's messages; None if not known.
    """

    tick: npt.NDArray[np.int64]
    values: Array
    setpoints: Array | None = None


@dataclass(frozen=True)
class SentGoal:
    """A goal pose sent at ``time`` (s), and its id in statuses."""

    time: float
    goal: Goal
    goal_id: str


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
    for sent in reversed(goals):
        if status.goal_id and status.goal_id == sent.goal_id:
            return sent.goal
    named = status.goal if isinstance(status, PlannerStatus) else ()
    try:
        reported = Goal.checked(named[:3], named[3:])
    except PlanningError:
        return None
    # Bags from earlier versions have no ids; the goal that was sent has more digits.
    for sent in reversed(goals):
        goal = sent.goal
        same = np.allclose(goal.position, reported.position, rtol=1e-7, atol=1e-8)
        if same and np.allclose(goal.quaternion, reported.quaternion, rtol=0.0, atol=1e-7):
            return goal
    return reported


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
