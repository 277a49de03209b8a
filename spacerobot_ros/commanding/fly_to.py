"""Action goals, with feedback and results, without ROS.

An action goal is handled like a topic goal: the commander passes it to its executive,
and statuses report its progress. :class:`FlyToGoals` keeps the goals with waiting clients, and
sends each client exactly one result: the final status.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from typing import Protocol

from spacerobot_ros.commanding.goal_follower import Status
from spacerobot_ros.errors import PlanningError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.planning.core.goal import NO_TOLERANCE, Goal, PoseError, Tolerance
from spacerobot_ros.planning.execution.status import PlannerStatus
from spacerobot_ros.times import SECOND

FEEDBACK_PERIOD_NS = SECOND // 5
"""Minimum simulated time between two feedback messages for a goal, ns."""


@dataclass(frozen=True)
class FlyTo:
    """An action goal.

    Attributes
    ----------
    goal
        Base pose, end-effector poses, and joint positions.
    tolerance
        Maximum errors; 0: the commander's parameter.
    time_limit
        Simulated time after which the goal is aborted, s; 0: never.

    Raises
    ------
    PlanningError
        A tolerance or the time limit is negative or not finite.
    """

    goal: Goal
    tolerance: Tolerance = NO_TOLERANCE
    time_limit: float = 0.0

    def __post_init__(self) -> None:
        for name, value, unit in (
            ("position tolerance", self.tolerance.position, "m"),
            ("attitude tolerance", self.tolerance.attitude, "rad"),
            ("joint tolerance", self.tolerance.shape, "m or rad"),
            ("time limit", self.time_limit, "s"),
        ):
            if not 0 <= value < math.inf:
                raise PlanningError(
                    f"The {name} of the goal is {value:g} {unit}: give a finite number above 0, or "
                    "0 for the parameter value."
                )

    def tolerance_or(self, default: Tolerance) -> Tolerance:
        """Return the tolerances, with defaults for unset values."""
        mine = self.tolerance
        return Tolerance(
            mine.position or default.position,
            mine.attitude or default.attitude,
            mine.shape or default.shape,
        )


@dataclass(frozen=True)
class GoalErrors:
    """Errors of a state relative to a goal; NaN for components not requested or not measured.

    Attributes
    ----------
    position, attitude
        Base errors, m and rad.
    end_effector_position, end_effector_attitude
        Largest end-effector errors, m and rad.
    joints
        Largest joint error, m or rad.
    """

    position: float = math.nan
    attitude: float = math.nan
    end_effector_position: float = math.nan
    end_effector_attitude: float = math.nan
    joints: float = math.nan

    @classmethod
    def between(cls, robot: SpaceRobot, pose: Array, q: Array, goal: Goal) -> GoalErrors:
        """Return the errors of a base pose (7,) and joint positions (n,) relative to a goal.

        Raises
        ------
        GoalError
            The robot has no link with the goal's name.
        """
        goal = goal.for_robot(robot.description)
        error = PoseError.between(pose[:3], pose[3:], goal, q, robot)
        turned = any(each.quaternion is not None for each in goal.end_effectors)
        return cls(
            error.distance if "position" in goal.base & goal.asked else math.nan,
            error.angle if "attitude" in goal.base & goal.asked else math.nan,
            error.largest_end_effector_distance if goal.end_effectors else math.nan,
            error.largest_end_effector_angle if turned else math.nan,
            error.max_joint_error if goal.joint_positions is not None else math.nan,
        )

    def reported_by(self, status: Status) -> GoalErrors:
        """Return the errors, updated with the errors reported in a status."""
        if not isinstance(status, PlannerStatus):
            return self
        reported = {
            "position": status.position_error_m,
            "attitude": status.attitude_error_rad,
            "end_effector_position": status.end_effector_position_error_m,
            "end_effector_attitude": status.end_effector_attitude_error_rad,
        }
        # A status reports an angle of zero if no attitude is required.
        return replace(
            self,
            **{
                name: value
                for name, value in reported.items()
                if value is not None and not math.isnan(getattr(self, name))
            },
        )


@dataclass(frozen=True)
class Progress:
    """Feedback about a goal.

    Attributes
    ----------
    phase
        Current activity for the goal.
    remaining_time
        Predicted time until the current motion ends, s; None without a prediction.
    elapsed_time
        Time since the first state after the goal was sent, s.
    stamp_ns
        Stamp of the last state, ns.
    pose
        (7,) the measured base pose; None: not measured.
    errors
        Its errors.
    """

    phase: str
    remaining_time: float | None
    elapsed_time: float
    stamp_ns: int
    pose: Array | None
    errors: GoalErrors


class FlyToClient(Protocol):
    """The client of one goal."""

    def feedback(self, progress: Progress) -> None:
        """Send feedback about the goal to the client."""

    def end(self, status: Status, errors: GoalErrors) -> None:
        """Send the result to the client: final status and errors; called once, at the end."""


@dataclass
class _ActionGoal:
    """A goal with a client that waits for its result."""

    client: FlyToClient | None
    """Client waiting for the result; None: the goal is from a topic."""
    request: FlyTo | None
    """None: the goal is rejected, or is from a topic."""
    first_state_ns: int | None = None
    """Stamp of the first state after the goal was sent, ns."""
    last_feedback_ns: int | None = None
    """Stamp of the state at the last feedback about the goal, ns."""
    give_up: str = ""
    """Reason to abort the goal; empty: no abort."""
    aborted: bool = False
    """Whether the executive was requested to abort the goal."""


class FlyToGoals:
    """Pursued and waiting goals, and the clients waiting for their results.

    Parameters
    ----------
    errors
        Returns the errors of the last measured state relative to a goal.
    report_aborted
        Publishes the abort of a goal (id, message), and returns this status.
    """

    def __init__(
        self, errors: Callable[[Goal], GoalErrors], report_aborted: Callable[[str, str], Status]
    ) -> None:
        self._errors, self._report_aborted = errors, report_aborted
        self._served: dict[str, _ActionGoal] = {}
        """Goals by id, in order of arrival."""
        self._accepted: list[str] = []
        """Ids of accepted goals that were not rejected later, from actions or topics, in order."""

    def __bool__(self) -> bool:
        """Whether a client is waiting."""
        return any(served.client is not None for served in self._served.values())

    def begin(
        self, goal_id: str, client: FlyToClient | None = None, request: FlyTo | None = None
    ) -> None:
        """Start tracking a goal; ``request`` is None if the client's goal is rejected."""
        self._served[goal_id] = _ActionGoal(client, request)

    def accepted(self, goal_id: str) -> None:
        """Record the latest accepted goal."""
        self._accepted = [each for each in self._accepted if each in self._served]
        self._accepted.append(goal_id)

    def leave(self, goal_id: str) -> None:
        """Stop tracking a topic goal, because another commander pursues it."""
        self._served.pop(goal_id, None)

    def request_abort(self, goal_id: str, why: str = "on request") -> None:
        """Request that a goal is aborted; :meth:`abort_reason` then returns the reason."""
        served = self._served.get(goal_id)
        if served is not None:
            served.give_up = served.give_up or why

    def abort_reason(self, waiting: Collection[str]) -> str:
        """Return the reason to abort all goals now; empty: no abort.

        An abort ends every goal. So if a goal is about to be replaced, its abort waits until the
        goal is replaced or the later goal is rejected: as long as ``waiting`` contains another goal
        id.
        """
        for goal_id, served in self._served.items():
            alone = self._accepted[-1:] == [goal_id] or set(waiting) <= {goal_id}
            if served.give_up and not served.aborted and alone:
                served.aborted = True
                return served.give_up
        return ""

    def advance(self, now_ns: int, progress: Callable[[str, Goal, int], Progress]) -> None:
        """Check the time limits at a state, and send feedback to the clients.

        ``progress`` returns the progress of a goal, given the goal id, the goal, and the start
        stamp.
        """
        for goal_id, served in self._served.items():
            if served.request is None or served.client is None:
                continue
            if served.first_state_ns is None or now_ns < served.first_state_ns:
                # Also after a time jump.
                served.first_state_ns, served.last_feedback_ns = now_ns, None
            limit = served.request.time_limit
            if limit and now_ns - served.first_state_ns >= limit * SECOND:
                self.request_abort(goal_id, f"after its time limit of {limit:g} s")
            if (
                served.last_feedback_ns is None
                or now_ns - served.last_feedback_ns >= FEEDBACK_PERIOD_NS
            ):
                served.last_feedback_ns = now_ns
                served.client.feedback(
                    progress(goal_id, served.request.goal, served.first_state_ns)
                )

    def update(self, status: Status) -> None:
        """End the goal completed by a status, if a client waits for its result."""
        if status.state.value == "refused" and status.goal_id in self._accepted:
            self._accepted.remove(status.goal_id)
        if status.state.decided:
            self._end(status.goal_id, status)

    def end_dropped_goals(self, pursued: Collection[str], why: str = "") -> bool:
        """End the goals that are no longer pursued and have no final status; return whether there
        are any.

        Parameters
        ----------
        pursued
            Ids of pursued goals, and of goals about to get their final status.
        why
            The reason, for goals not replaced by a later goal.
        """
        dropped = [each for each in self._served if each not in pursued]
        for goal_id in dropped:
            message = why or "The goal is no longer pursued."
            if not why and self._accepted[-1:] != [goal_id]:
                message = f"Aborted: replaced by goal {self._accepted[-1]}."
            self._end(goal_id, self._report_aborted(goal_id, message))
        return bool(dropped)

    def _end(self, goal_id: str, status: Status) -> None:
        served = self._served.pop(goal_id, None)
        if served is None or served.client is None:
            return
        errors = GoalErrors()
        if served.request is not None:
            errors = self._errors(served.request.goal).reported_by(status)
        served.client.end(status, errors)
