"""What an executive hands out beside setpoints, and a queue of it."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from enum import Enum

from spacerobot_ros.events import Event as FlightEvent
from spacerobot_ros.events import EventKind
from spacerobot_ros.planning.core.goal import Controlled, PoseError
from spacerobot_ros.planning.core.schedule import GaitSchedule
from spacerobot_ros.planning.execution.goal_file import IdentifiedGoal
from spacerobot_ros.planning.execution.state_machine import PlanReason, Transition
from spacerobot_ros.planning.execution.status import PlannerState, PlannerStatus, goal_values
from spacerobot_ros.times import SECOND


class Severity(Enum):
    """How grave a notice is."""

    INFO = "info"
    WARNING = "warning"
    ERROR = "error"


@dataclass(frozen=True)
class Notice:
    """A message for the log."""

    severity: Severity
    message: str


@dataclass(frozen=True)
class ScheduleStart:
    """A schedule that is tracked from a stamp on, ns."""

    schedule: GaitSchedule
    stamp_ns: int


Output = PlannerStatus | ScheduleStart | Notice | Transition | FlightEvent
"""What an executive hands out beside setpoints, in order."""


@dataclass
class Pursuit:
    """A goal that was accepted, and its plans and corrections so far."""

    identified: IdentifiedGoal
    schedule: GaitSchedule
    """The schedule that was executed last."""
    begins_ns: int
    """Stamp of the state from which the first one was planned."""
    corrections: int = 0
    manoeuvre_time: float = 0.0
    """Duration of all its schedules, s."""
    ends_at: float = 0.0
    """Simulated time at which the last one ends, s."""
    next_plan: PlanReason = PlanReason.CORRECTION
    """Why the next plan is made, if one has to be."""
    stuck_at: dict[str, float] | None = field(default_factory=dict)
    """Where the stuck joints are; None: to be measured."""
    required: frozenset[Controlled] = frozenset()
    """Parts of the goal that plans without the stuck joints must control."""


class OutputQueue:
    """Outputs in order; ``stamp_ns`` is the time now, for the owner to set."""

    def __init__(self) -> None:
        self.waiting: deque[Output] = deque()
        self.stamp_ns = 0

    def notice(self, severity: Severity, sentence: str) -> None:
        """Add a sentence for the log."""
        self.waiting.append(Notice(severity, sentence))

    def happened(
        self,
        kind: EventKind,
        sentence: str,
        identified: IdentifiedGoal,
        level: int = 0,
        **about: str,
    ) -> None:
        """Add an event about a goal."""
        now = self.stamp_ns / SECOND
        self.waiting.append(FlightEvent(kind, sentence, level, now, identified.goal_id, about))

    def report(
        self,
        state: PlannerState,
        sentence: str,
        identified: IdentifiedGoal,
        pursuit: Pursuit | None = None,
        remaining: PoseError | None = None,
        schedule: GaitSchedule | None = None,
    ) -> None:
        """Add a status of a goal, with corrections, durations, remaining error and schedule."""
        self.waiting.append(
            PlannerStatus(
                state,
                sentence,
                goal_id=identified.goal_id,
                goal=goal_values(identified.goal),
                corrections=0 if pursuit is None else pursuit.corrections,
                position_error_m=None if remaining is None else remaining.distance,
                attitude_error_rad=None if remaining is None else remaining.angle,
                manoeuvre_time_s=0.0 if pursuit is None else pursuit.manoeuvre_time,
                ends_at_s=0.0 if pursuit is None else pursuit.ends_at,
                method="" if schedule is None else schedule.method,
                duration_s=0.0 if schedule is None else schedule.duration,
                notes={} if schedule is None else schedule.notes,
            )
        )


def gait_by(method: str) -> str:
    """Return what a method has made, such as "an optimal gait", for sentences."""
    return f"{'an' if method[:1] in tuple('aeiou') else 'a'} {method} gait"
