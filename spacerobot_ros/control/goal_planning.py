"""Reference planning, in parallel with the control loop."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TypedDict

from spacerobot_ros.control.controller import CoordinatedController
from spacerobot_ros.control.planned_reference import PLANNING_TIME, PlannedReference
from spacerobot_ros.control.state import ControlState, PoseReference
from spacerobot_ros.errors import PlanningError
from spacerobot_ros.model.description import Array
from spacerobot_ros.planning.core.cancellation import Cancellation, PlanningJob
from spacerobot_ros.planning.core.goal import Controlled
from spacerobot_ros.planning.execution.goal_file import IdentifiedGoal


class Aims(TypedDict):
    """Poses and joint positions requested by goals; None: not requested. The base rests at each of
    the ``waypoints``, poses (7,), before its goal.
    """

    base: PoseReference | None
    waypoints: tuple[Array, ...]
    end_effector: PoseReference | None
    joints: Array | None


@dataclass(frozen=True)
class PlannedGoals:
    """Pending goals, their poses and joints, the requested parts of the base pose, and the job that
    plans their reference.
    """

    pending: Mapping[str, IdentifiedGoal]
    aims: Aims
    asked: frozenset[Controlled]
    job: PlanningJob[PlannedReference]


class GoalPlanning:
    """Plans references for pending goals, one at a time.

    Parameters
    ----------
    in_background
        Whether to plan in a thread while states are handled.
    """

    def __init__(self, *, in_background: bool) -> None:
        self.in_background = in_background
        self.time = 0.0
        """Total wall time spent planning references, s."""
        self._plan: PlannedGoals | None = None
        self._job: PlanningJob[PlannedReference] | None = None
        """The last job, which may still be running although cancelled."""
        self._lead = PLANNING_TIME

    @property
    def active(self) -> bool:
        """Whether a reference is being planned."""
        return self._plan is not None

    def is_for(self, pending: Mapping[str, IdentifiedGoal]) -> bool:
        """Whether a reference for these goals is being planned."""
        if self._plan is None or self._plan.pending.keys() != pending.keys():
            return False
        return all(goal is pending[part] for part, goal in self._plan.pending.items())

    def planned(
        self,
        time: float,
        state: ControlState,
        controller: CoordinatedController,
        pending: Mapping[str, IdentifiedGoal],
        aims: Callable[[], tuple[Aims, frozenset[Controlled]]],
    ) -> PlannedGoals | None:
        """Return pending goals with their planned reference; None while it is being planned, and
        before it begins.

        ``aims`` returns the goal poses and joints, and the requested components.

        Raises
        ------
        PlanningError
            No motion is found.
        """
        if not self.is_for(pending):
            self.cancel()
            if self._plan is None:
                self._lead = PLANNING_TIME
            self._begin(time, state, controller, pending, *aims())
        plan = self._plan
        assert plan is not None
        job, waits = plan.job, self.in_background and plan.job.begins > time
        if not job.done:
            return None
        try:
            job.result()
        except PlanningError:
            waits = False
            raise
        finally:
            if not waits:
                self.time += job.wall_time
                self._plan = None
        if waits:
            return None
        if self.in_background and -math.inf < job.begins < time:
            # The reference has gone on: a plan from where it will be in twice the time.
            self._lead *= 2
            self._begin(time, state, controller, pending, plan.aims, plan.asked)
            return None
        return plan

    def _begin(
        self,
        time: float,
        state: ControlState,
        controller: CoordinatedController,
        pending: Mapping[str, IdentifiedGoal],
        aims: Aims,
        asked: frozenset[Controlled],
    ) -> None:
        planner = controller.planner
        assert planner is not None
        seen, begins = state.copied(), -math.inf
        if controller.reference_moves(time):
            begins = time + (self._lead if self.in_background else 0.0)
        motion = controller.motion_to(max(begins, time), seen, **aims)

        def work(cancellation: Cancellation) -> PlannedReference:
            return planner.plan(motion, seen, cancellation)

        last, self._job = self._job, PlanningJob(work, begins)
        # Known before the work begins, so that it can be cancelled.
        self._plan = PlannedGoals(dict(pending), aims, asked, self._job)
        self._job.start(in_background=self.in_background, after=last)

    def cancel(self) -> None:
        """Cancel the job; any thread may call this."""
        plan = self._plan
        if plan is not None:
            plan.job.cancel()

    def drop(self) -> None:
        """Cancel the job and drop its result."""
        self.cancel()
        self._plan = None

    def close(self) -> None:
        """Cancel the job and wait for its thread to end."""
        self._plan = None
        if self._job is not None:
            self._job.close()
