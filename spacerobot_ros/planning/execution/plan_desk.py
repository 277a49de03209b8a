"""The plan that an executive requests: its goal, its reason, its start, and its result."""

from __future__ import annotations

from dataclasses import dataclass, replace

from spacerobot_ros.events import EventKind
from spacerobot_ros.planning.core.goal import Goal, PoseError, RobotState, Tolerance
from spacerobot_ros.planning.core.method import PlanRequest
from spacerobot_ros.planning.core.schedule import GaitSchedule
from spacerobot_ros.planning.execution.goal_file import IdentifiedGoal
from spacerobot_ros.planning.execution.outputs import OutputQueue, Pursuit, Severity, gait_by
from spacerobot_ros.planning.execution.state_machine import PlanReason
from spacerobot_ros.planning.execution.take_over import TakeOver
from spacerobot_ros.planning.execution.tracker import TrackingError
from spacerobot_ros.planning.execution.worker import (
    Braking,
    Planned,
    PlanningTask,
    PlanningWorker,
    Refused,
)


@dataclass(frozen=True)
class Ticket:
    """A plan that was requested: what for and why, and how far the robot was from the goal."""

    identified: IdentifiedGoal
    reason: PlanReason
    tracking_error: TrackingError | None = None
    remaining: PoseError | None = None
    take_over: TakeOver | None = None
    """When the plan takes over in motion; None: it begins when it is there."""
    aim: Goal | None = None
    """What is planned for, if it is not quite the goal."""

    def is_late(self, stamp_ns: int) -> bool:
        """Whether the plan should have taken over by now."""
        return self.take_over is not None and stamp_ns >= self.take_over.stamp_ns


@dataclass(frozen=True)
class ReadyPlan:
    """A plan that takes over when its tick comes."""

    ticket: Ticket
    take_over: TakeOver
    schedule: GaitSchedule


class PlanDesk:
    """Has one plan made at a time, and keeps one that is there until it takes over.

    Parameters
    ----------
    worker
        Makes the plans.
    out
        Where their events go.
    """

    def __init__(self, worker: PlanningWorker, out: OutputQueue) -> None:
        self._worker, self._out = worker, out
        self.ticket: Ticket | None = None
        """What is being planned."""
        self.ready: ReadyPlan | None = None
        self.plan_time, self.plans = 0.0, 0
        """Wall time of the plans for the present goal, s, and their number."""

    @property
    def current(self) -> Ticket | None:
        """Of the plan that is being made, or of the one that is there."""
        return self.ticket if self.ready is None else self.ready.ticket

    def begin_goal(self) -> None:
        """Begin to count for a new goal."""
        self.plan_time, self.plans = 0.0, 0

    def request(
        self,
        ticket: Ticket,
        state: RobotState,
        tolerance: Tolerance,
        pursuit: Pursuit | None,
        braking: Braking | None,
    ) -> None:
        """Have a plan made from a measured state, for the goal that is pursued or a new one.

        ``pursuit`` is None for a new goal; ``braking`` is what comes first.
        """
        self.ticket = ticket
        request = PlanRequest(
            state,
            ticket.aim or ticket.identified.goal,
            tolerance,
            correction=ticket.reason in (PlanReason.CORRECTION, PlanReason.CONTINUATION),
            previous=None if pursuit is None else pursuit.schedule,
        )
        reason = ticket.reason.value
        sentence = f"A plan is made: {reason}."
        self._out.happened(EventKind.PLAN_STARTED, sentence, ticket.identified, reason=reason)
        task = PlanningTask(request, braking=braking, take_over=ticket.take_over)
        if pursuit is not None:
            task = replace(task, stuck=pursuit.stuck_at or {}, required=pursuit.required)
        self._worker.submit(task)

    def take(self) -> tuple[Ticket, Planned | Refused] | None:
        """Return the result of the plan that is being made, once it is there."""
        result = self._worker.poll()
        if result is None:
            return None
        ticket, self.ticket = self.ticket, None
        assert ticket is not None
        self.plan_time += result.wall_time
        self.plans += 1
        self._out.notice(Severity.INFO, f"Planned in {result.wall_time:.6f} s.")
        if isinstance(result, Planned):
            # Whatever was aimed at, the goal is what counts.
            schedule = replace(result.schedule, goal=ticket.identified.goal)
            result = replace(result, schedule=schedule)
            method, duration = result.schedule.method, result.schedule.duration
            self._out.happened(
                EventKind.PLAN_READY,
                f"The plan is {gait_by(method)} of {duration:.6g} s.",
                ticket.identified,
                method=method,
                duration_s=f"{duration:.9g}",
            )
        return ticket, result

    def free(self) -> bool:
        """Whether no plan is being made; one that was cancelled may have yet to end."""
        if self._worker.busy:
            self._worker.poll()
            return False
        return True

    def drop(self) -> IdentifiedGoal | None:
        """Cancel the plan that is being made; return its goal, if that is a new one."""
        self._worker.cancel()
        ticket, self.ticket, self.ready = self.current, None, None
        return ticket.identified if ticket is not None and ticket.reason.for_new_goal else None
