"""Commander statuses: their topics, and tracking of the statuses of one goal."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from spacerobot_ros.control.status import ControllerStatus
from spacerobot_ros.events import Event, EventKind
from spacerobot_ros.planning.execution.status import PlannerState, PlannerStatus

Status = PlannerStatus | ControllerStatus

STATUS_TOPICS: Mapping[str, tuple[str, Callable[[Mapping[str, str], str], Status]]] = {
    "planner": ("planner/status", PlannerStatus.from_values),
    "coordinated_control": ("controller/status", ControllerStatus.from_values),
}
"""Status topic of each commander, and the function that reads its values and message."""


class GoalFollower:
    """Tracks one goal through its commander's statuses.

    Parameters
    ----------
    goal_id
        Id of the goal; None: no goal has been sent yet, so no status refers to it.
    unnamed
        Whether statuses without an id also refer to the goal, as in version 0.1 bags.
    """

    def __init__(self, goal_id: str | None = None, *, unnamed: bool = False) -> None:
        self.goal_id = goal_id
        self._unnamed = unnamed
        self.gait: PlannerStatus | None = None
        """The planner's status at the start of its first schedule for the goal."""
        self.decision: Status | None = None
        """The goal's final status; None while the goal is pursued."""

    def is_about_goal(self, status: Status) -> bool:
        """Whether a status refers to the goal."""
        if self.goal_id is None:
            return False
        return status.goal_id == self.goal_id or (self._unnamed and not status.goal_id)

    def update(self, status: Status) -> bool:
        """Process the next status; return whether it is the goal's final status."""
        if self.decision is not None or not self.is_about_goal(status):
            return False
        if self.gait is None and status.state is PlannerState.EXECUTING:
            assert isinstance(status, PlannerStatus)
            self.gait = status
        if status.state.decided:
            self.decision = status
        return status.state.decided


def decision_event(status: Status) -> Event:
    """Return the event for the final status of a goal."""
    kind = EventKind(f"goal_{status.state.value}")
    return Event(kind, status.message, status.state.level, goal_id=status.goal_id)
