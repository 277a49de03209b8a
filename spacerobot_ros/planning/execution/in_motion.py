"""Whether, when and from where plans take over while the joints move."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from spacerobot_ros.model.description import Array
from spacerobot_ros.model.rotations import quaternion_from_rotvec, quaternion_multiply
from spacerobot_ros.planning.core.goal import POSE, Goal, PoseError, RobotState, Tolerance
from spacerobot_ros.planning.core.schedule import GaitSchedule
from spacerobot_ros.planning.execution.config import PlannerConfig
from spacerobot_ros.planning.execution.outputs import Pursuit
from spacerobot_ros.planning.execution.take_over import TakeOver
from spacerobot_ros.planning.execution.tracker import TrajectoryTracker
from spacerobot_ros.planning.execution.worker import PlanningWorker
from spacerobot_ros.times import SECOND

_MOST_ATTEMPTS = 2
"""Plans in motion that are tried for a goal: each takes over twice as late as the one before."""

_NEAR_ENOUGH, _AIM = (0.6, 0.8), (0.4, 0.6)
"""Shares of the tolerances, early and late in a motion: within the first the remaining motion is
not planned again; where it is, the second may be left."""

_LATE = 1 / 3
"""It is late when this share of the motion is left: turns of the base then take long."""


@dataclass(frozen=True)
class Remainder:
    """The remaining motion to plan again: when it takes over, the state now, and the goal."""

    take_over: TakeOver
    state: RobotState
    aim: Goal


class InMotion:
    """Decides on plans that take over from the schedule that is tracked.

    A plan takes over in motion where the methods of both schedules allow for it, all joints follow,
    and the schedule of now is not over by then. The tick follows from parameters and from the stamp
    of the request, not from how long the plan takes.

    Parameters
    ----------
    tracker, worker
        Track the schedules, and make the plans.
    """

    def __init__(self, tracker: TrajectoryTracker, worker: PlanningWorker) -> None:
        self._tracker, self._worker = tracker, worker
        self._attempts = 0
        self._replan_ns = 0

    def begin_goal(self) -> None:
        """Begin with a new goal: all attempts are left."""
        self._attempts = 0

    def attempt_failed(self) -> None:
        """Note that a plan for the new goal was late, or that there is none from its tick."""
        self._attempts += 1

    @property
    def tries_again(self) -> bool:
        """Whether an attempt is left: a plan that fails from one tick, as where joints brake at a
        limit, may succeed from a later one.
        """
        return self._attempts < _MOST_ATTEMPTS

    def begin_schedule(self, config: PlannerConfig, schedule: GaitSchedule, begins_ns: int) -> int:
        """Begin with a schedule; return how many measured poses are to be averaged meanwhile."""
        self._replan_ns = begins_ns + round(config.replanning * SECOND)
        wanted = config.replanning > 0 or config.averaging > 1
        able = config.takeover_time > 0 and self._worker.starts_in_motion(schedule)
        return config.averaging if wanted and able else 0

    def take_over(
        self, config: PlannerConfig, pursuit: Pursuit | None, stamp_ns: int, q: Array
    ) -> TakeOver | None:
        """Return when a plan for a new goal takes over; None where it must begin at rest."""
        if pursuit is None or not self.tries_again or not self._able(config, pursuit):
            return None
        return self._tracker.take_over(stamp_ns, q, config.takeover_time * 2**self._attempts)

    def replans(self, config: PlannerConfig, pursuit: Pursuit) -> bool:
        """Whether the remaining motion is planned again while it is flown."""
        return config.replanning > 0 and self._able(config, pursuit)

    def remaining(
        self, config: PlannerConfig, pursuit: Pursuit, stamp_ns: int, state: RobotState
    ) -> Remainder | None:
        """Return what remains to be planned again from ``state``, which is due.

        None where it is not time yet, where the motion so far leads near enough to the goal, or
        where no time is left.
        """
        if not self.replans(config, pursuit):
            return None
        state = self._tracker.averaged(state)
        if stamp_ns < self._replan_ns or pursuit.schedule.partial:
            return None
        self._replan_ns = stamp_ns + round(config.replanning * SECOND)
        position, quaternion = self._tracker.end
        goal, within = pursuit.identified.goal, config.tolerance
        error = PoseError.between(*self._tracker.expected_end, goal)
        late = pursuit.ends_at - stamp_ns / SECOND < _LATE * pursuit.manoeuvre_time
        near = Tolerance(*(_NEAR_ENOUGH[late] * x for x in (within.position, within.attitude)))
        if near.admits(error, pursuit.schedule.controls & POSE):
            return None
        take_over = self._tracker.take_over(stamp_ns, state.q, config.takeover_time)
        if take_over is None:
            return None
        moved = error.position * _beyond(error.distance, _AIM[late] * within.position)
        turn = error.rotvec * _beyond(error.angle, _AIM[late] * within.attitude)
        aimed = quaternion_multiply(quaternion, quaternion_from_rotvec(turn))
        aim = Goal(position + moved, aimed, goal.joint_positions)
        return Remainder(take_over, replace(state, q=take_over.shapes[0].copy()), aim)

    def _able(self, config: PlannerConfig, pursuit: Pursuit) -> bool:
        """Whether a plan may take over in motion from the schedule that is tracked."""
        return (
            config.takeover_time > 0
            and not self._tracker.stuck
            and self._worker.starts_in_motion(pursuit.schedule)
        )


def _beyond(error: float, left: float) -> float:
    """Return the share of an error that is to be made good, where some may be left."""
    return max(0.0, 1.0 - left / error) if error > 0 else 0.0


def same_goal(first: Goal, second: Goal) -> bool:
    """Whether two goals are one pose and shape, number by number."""
    one, other = first.joint_positions, second.joint_positions
    equal = one is other if one is None or other is None else np.array_equal(one, other)
    return (
        bool(equal)
        and np.array_equal(first.position, second.position)
        and np.array_equal(first.quaternion, second.quaternion)
    )
