"""Execution of schedules by a FollowJointTrajectory server, one at a time.

This module is independent of ROS: a :class:`TrajectoryServer` sends and cancels schedules, and its
responses contain the schedule number. A response about a replaced or cancelled schedule is ignored.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum, IntEnum
from typing import Protocol

from spacerobot_ros.errors import printable
from spacerobot_ros.planning.execution.status import Phase, ScheduleStart
from spacerobot_ros.times import SECOND

_ANSWER_TIMEOUT_NS = 5 * SECOND
_SERVER_CHECK_PERIOD_NS = SECOND

_PHASES_OF_MOTION = (Phase.EXECUTING, Phase.REPLANNING, Phase.TAKING_OVER, Phase.PLANNING)
"""Phases in which a schedule continues; in PLANNING, the next schedule replaces it."""


class ErrorCode(IntEnum):
    """``error_code`` in a control_msgs/action/FollowJointTrajectory result."""

    SUCCESSFUL = 0
    INVALID_GOAL = -1
    INVALID_JOINTS = -2
    OLD_HEADER_TIMESTAMP = -3
    PATH_TOLERANCE_VIOLATED = -4
    GOAL_TOLERANCE_VIOLATED = -5


class Outcome(Enum):
    """Final state of an action goal."""

    SUCCEEDED = "succeeded"
    ABORTED = "aborted"
    CANCELED = "canceled"


@dataclass(frozen=True)
class TrajectoryEnd:
    """The end of a schedule executed by the robot's own controller.

    Attributes
    ----------
    message
        Reason for an early end, as a clause; empty: the schedule was completed.
    final
        Whether a correction would end in the same way; if so, none is planned.
    """

    message: str = ""
    final: bool = False


class TrajectoryServer(Protocol):
    """The connection to the action server."""

    def is_available(self) -> bool:
        """Whether the server is available."""

    def send(self, number: int, start: ScheduleStart) -> None:
        """Send a schedule."""

    def cancel(self, number: int) -> None:
        """Cancel a schedule, whether or not it has been accepted."""


class TrajectoryOutput:
    """Sends each schedule to a server, evaluates its result, and cancels abandoned schedules.

    Parameters
    ----------
    server
        The connection.
    name
        Name of the action, for messages.
    on_end
        Called once for each schedule that ends without being replaced or cancelled.
    """

    def __init__(
        self, server: TrajectoryServer, name: str, on_end: Callable[[TrajectoryEnd], None]
    ) -> None:
        self._server, self._name, self._on_end = server, name, on_end
        self._number = 0
        """Number of the latest schedule."""
        self._sent: int | None = None
        """Number of the schedule without a result."""
        self._replaced: int | None = None
        """Number of the schedule replaced by the latest schedule, until the latest schedule is
        accepted."""
        self._accepted = False
        self._watched_ns: int | None = None
        """Stamp of the first state after the latest schedule was sent, ns."""
        self._looked_ns = 0
        """Stamp of the last check for the server, ns."""

    def start(self, start: ScheduleStart) -> None:
        """Send a schedule; it replaces the current schedule."""
        self._number += 1
        self._replaced, self._sent, self._accepted = self._sent, self._number, False
        self._watched_ns = None
        if not self._server.is_available():
            self._end(TrajectoryEnd(f"the action '{self._name}' has no server", final=True))
            return
        self._server.send(self._number, start)

    def check_server(self, now_ns: int) -> None:
        """End a schedule if its server does not respond or no longer exists; called for every
        state."""
        if self._sent is None:
            return
        if self._watched_ns is None or now_ns < self._watched_ns:
            self._watched_ns = self._looked_ns = now_ns
        if not self._accepted and now_ns - self._watched_ns > _ANSWER_TIMEOUT_NS:
            self._give_up(f"the action '{self._name}' has not responded")
        elif now_ns - self._looked_ns >= _SERVER_CHECK_PERIOD_NS:
            self._looked_ns = now_ns
            if not self._server.is_available():
                self._give_up(f"the server of the action '{self._name}' is gone")

    def _give_up(self, why: str) -> None:
        assert self._sent is not None
        self._server.cancel(self._sent)
        self._end(TrajectoryEnd(why, final=True))

    def on_phase_change(self, phase: Phase) -> None:
        """Cancel the schedule if the planner has abandoned it."""
        sent = self._sent
        if sent is None or phase in _PHASES_OF_MOTION:
            return
        self._sent = self._replaced = None
        self._server.cancel(sent)

    def accepted(self, number: int) -> None:
        """Record that the server is now executing a schedule."""
        if number == self._sent:
            self._accepted, self._replaced = True, None

    def rejected(self, number: int) -> None:
        """End a schedule rejected by the server, and the schedule that it would have replaced."""
        if number != self._sent:
            return
        if self._replaced is not None:
            self._server.cancel(self._replaced)
        self._end(
            TrajectoryEnd(f"the action '{self._name}' has rejected the trajectory", final=True)
        )

    def ended(self, number: int, outcome: Outcome, code: int, text: str) -> None:
        """End a schedule with the result of the server: ``error_code`` and ``error_string``."""
        if number == self._sent:
            self._end(_motion_end(outcome, code, text))

    def _end(self, end: TrajectoryEnd) -> None:
        self._sent = self._replaced = None
        self._on_end(end)


def _motion_end(outcome: Outcome, code: int, text: str) -> TrajectoryEnd:
    if outcome is Outcome.SUCCEEDED and code == ErrorCode.SUCCESSFUL:
        return TrajectoryEnd()
    text = printable(text).rstrip(".")
    told = f": {text}" if text else ""
    if outcome is Outcome.CANCELED:
        return TrajectoryEnd(f"another client has replaced or cancelled the trajectory{told}", True)
    if code == ErrorCode.SUCCESSFUL:
        return TrajectoryEnd(f"the trajectory was aborted without an error code{told}", final=True)
    try:
        name = ErrorCode(code).name
    except ValueError:
        name = f"error code {code}"
    clause = f"the trajectory ended early with {name}{told}"
    violated = code in (ErrorCode.PATH_TOLERANCE_VIOLATED, ErrorCode.GOAL_TOLERANCE_VIOLATED)
    return TrajectoryEnd(clause, final=not violated)
