"""Parts of a flight: quantities over time, commands, and the goals that were sent."""

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

    def norms(self, columns: Sequence[int]) -> Signal:
        """Return the norms (N, 1) of some columns."""
        return Signal(self.time, np.linalg.norm(self.values[:, columns], axis=1, keepdims=True))

    def relative_to_first(self) -> Signal:
        """Return the changes since the first sample."""
        return Signal(self.time, self.values - self.values[:1])


@dataclass(frozen=True)
class Commands:
    """The commands on one topic.

    Attributes
    ----------
    tick
        (N,) tick of the state that each responds to.
    values
        (N, size) numbers that the plant or the controller uses.
    setpoints
        (N, 2 n) joint positions and rates in a planner's messages; None: not known.
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


def pose_error(poses: Signal, goal: Goal | None) -> PoseError | None:
    """Return the error of the last pose relative to a goal; None without a pose or a goal."""
    if goal is None or not len(poses):
        return None
    return PoseError.between(poses.values[-1, :3], poses.values[-1, 3:], goal)


def reported_goal(status: Status, goals: Sequence[SentGoal]) -> Goal | None:
    """Return the goal of a status: the base goal as sent, and the goals of links.

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
    """Return the last goal that was flown to, else the last one that was sent or reported."""
    reported = [(each, reported_goal(each, goals)) for each in statuses]
    for status, goal in reversed(reported):
        if status.state.value in _FLOWN_STATES and goal is not None:
            return goal
    if goals:
        return goals[-1].goal
    return next((goal for _, goal in reversed(reported) if goal is not None), None)
