"""Planner outputs: goal status, notices, schedules, and statistics."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from enum import Enum
from typing import Any, Literal, NamedTuple

from spacerobot_ros.errors import AT_JOINTS, enumeration, quantity
from spacerobot_ros.events import (
    INTEGER,
    KeyValueField,
    KeyValueFormat,
    TextFormat,
    choice_format,
    number_format,
)
from spacerobot_ros.events import Event as FlightEvent
from spacerobot_ros.model.description import Array
from spacerobot_ros.planning.core.goal import (
    Controlled,
    Goal,
    PoseError,
    Tolerance,
    missed_parts,
    reached_message,
    uncontrolled_parts,
)
from spacerobot_ros.planning.core.schedule import GaitSchedule, Notes
from spacerobot_ros.planning.execution.goal_file import IdentifiedGoal, PursuedGoals
from spacerobot_ros.times import SECOND

_LATE_TIME_SHARE = 1 / 3
"""Fraction of a motion's duration that remains when its late phase begins."""

_LEVELS = {
    "stalled": 1,
    "estimating": 1,
    "reached_partly": 1,
    "aborted": 1,
    "failed": 2,
    "refused": 2,
    "stopped": 2,
}


class GoalState(str, Enum):
    """Value of ``state`` in the status of a commander."""

    @property
    def decided(self) -> bool:
        """Whether the goal has ended and is no longer pursued."""
        return self.value in ("reached", "reached_partly", "failed", "refused", "aborted")

    @property
    def level(self) -> int:
        """diagnostic_msgs/DiagnosticStatus level: 0 OK, 1 WARN, 2 ERROR."""
        return _LEVELS.get(self.value, 0)


class PlannerState(GoalState):
    """Value of ``state`` in planner/status."""

    WAITING = "waiting"
    """States or the robot description are missing."""
    IDLE = "idle"
    PLANNING = "planning"
    EXECUTING = "executing"
    REACHED = "reached"
    REACHED_PARTLY = "reached_partly"
    """A requested base component is out of tolerance and not controlled."""
    FAILED = "failed"
    REFUSED = "refused"
    ABORTED = "aborted"
    TELEOPERATING = "teleoperating"


@dataclass(frozen=True)
class PlannerStatus:
    """A planner status, as published on planner/status.

    Attributes
    ----------
    state
        State of the goal.
    message
        Text for the user.
    goal_id
        Goal id; empty: no goal, or a goal without an id.
    goal
        (7,) goal position in m and quaternion (x, y, z, w); empty if not reported.
    corrections
        Number of plans for this goal, after the first, that count as corrections.
    end_effector_goals
        End-effector goals by link: a position (3,), m, or position and quaternion (7,).
    end_effector_waypoints
        Number of waypoints on the given paths to these goals, by link.
    end_effector_position_error_m, end_effector_attitude_error_rad
        Largest remaining end-effector errors; None if they were not evaluated, or have no goals.
    position_error_m, attitude_error_rad
        Remaining error of the measured base pose; None if it was not evaluated.
    manoeuvre_time_s
        Duration of all schedules for the goal so far, without replaced parts; 0: none.
    ends_at_s
        Simulated time at which the latest schedule ends; 0: none.
    remaining_s
        Expected duration of later schedules until the goal is reached; 0: none is needed.
    method
        Gait method of the schedule that starts; empty if no schedule starts.
    duration_s
        Its duration.
    notes
        Method results by name.
    not_controlled
        Goal components not controlled by the method of the latest schedule.
    """

    state: PlannerState
    message: str = ""
    goal_id: str = ""
    goal: tuple[float, ...] = ()
    corrections: int = 0
    position_error_m: float | None = None
    attitude_error_rad: float | None = None
    end_effector_goals: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    end_effector_waypoints: Mapping[str, int] = field(default_factory=dict)
    end_effector_position_error_m: float | None = None
    end_effector_attitude_error_rad: float | None = None
    manoeuvre_time_s: float = 0.0
    ends_at_s: float = 0.0
    remaining_s: float = 0.0
    method: str = ""
    duration_s: float = 0.0
    notes: Notes = field(default_factory=dict)
    not_controlled: tuple[Controlled, ...] = ()

    @classmethod
    def of_goal(
        cls,
        state: PlannerState,
        message: str,
        identified: IdentifiedGoal,
        error: PoseError | None = None,
        **values: Any,
    ) -> PlannerStatus:
        """Return a status with a goal, its remaining error if evaluated, and other ``values``."""
        goal = identified.goal
        if error is not None:
            if not goal.end_effectors or "position" in goal.base:
                values["position_error_m"] = error.distance
            if not goal.end_effectors or "attitude" in goal.base:
                values["attitude_error_rad"] = error.angle
            if goal.end_effectors:
                values["end_effector_position_error_m"] = error.largest_end_effector_distance
                values["end_effector_attitude_error_rad"] = error.largest_end_effector_angle
        pose = (*goal.position.tolist(), *goal.quaternion.tolist()) if goal.base else ()
        ways = {x.link: x.waypoints for x in goal.end_effectors}
        return cls(
            state,
            message,
            identified.goal_id,
            pose,
            end_effector_goals={x.link: x.values for x in goal.end_effectors},
            end_effector_waypoints={k: len(x) for k, x in ways.items() if x is not None},
            **values,
        )

    def to_values(self) -> dict[str, str]:
        """Return the status as key-value pairs of a DiagnosticStatus; numbers have nine digits."""
        return _FORMAT.to_values(self)

    @classmethod
    def from_values(cls, values: Mapping[str, str], message: str = "") -> PlannerStatus:
        """Return the status from the key-value pairs of :meth:`to_values`.

        Raises
        ------
        SpaceRobotError
            The values do not form a planner status.
        """
        return _FORMAT.from_values(cls, values, message=message)


def _format_note(note: list[float] | Array | float | str) -> str:
    numbers = note if isinstance(note, list) else [note]
    return " ".join(f"{x:.9g}" if isinstance(x, float) else str(x) for x in numbers)


def _note_from_text(text: str) -> list[float] | float | str:
    try:
        numbers = [float(word) for word in text.split()]
    except ValueError:
        return text
    return numbers[0] if len(numbers) == 1 else numbers


_NUMBER = number_format(".9g")
NUMBERS = TextFormat(
    lambda numbers: _format_note(list(numbers)), lambda text: tuple(map(float, text.split()))
)
"""Poses and positions, with nine digits."""
_NOTE = TextFormat(_format_note, _note_from_text)
_PARTS = TextFormat(
    " ".join,
    lambda text: tuple(part for part in ("position", "attitude", "shape") if part in text.split()),
)
"""Goal components that a method may leave uncontrolled; unknown component names are ignored."""

_FORMAT = KeyValueFormat(
    "status of a planner",
    KeyValueField("state", choice_format(PlannerState)),
    KeyValueField("corrections", INTEGER, always=True),
    KeyValueField("goal_id"),
    KeyValueField("goal", NUMBERS),
    KeyValueField("position_error_m", _NUMBER),
    KeyValueField("attitude_error_rad", _NUMBER),
    KeyValueField("end_effector_goals", NUMBERS, prefix="goal_of_"),
    KeyValueField("end_effector_waypoints", INTEGER, prefix="waypoints_of_"),
    KeyValueField("end_effector_position_error_m", _NUMBER),
    KeyValueField("end_effector_attitude_error_rad", _NUMBER),
    KeyValueField("not_controlled", _PARTS),
    KeyValueField("manoeuvre_time_s", _NUMBER, present_with="ends_at_s"),
    KeyValueField("ends_at_s", _NUMBER),
    KeyValueField("remaining_s", _NUMBER),
    KeyValueField("method"),
    KeyValueField("duration_s", _NUMBER, present_with="method"),
    KeyValueField("notes", _NOTE, prefix="", present_with="method"),
)

LogLevel = Literal["debug", "info", "warning", "error"]


class Notice(NamedTuple):
    """A log message."""

    level: LogLevel
    message: str


@dataclass(frozen=True)
class ScheduleStart:
    """Start of a schedule: the schedule, and the stamp of its first tick, ns."""

    schedule: GaitSchedule
    stamp_ns: int


class Phase(Enum):
    """Activity of an executive."""

    IDLE = "idle"  # There is no goal; the joints rest.
    MEASURING = "measuring"  # A new goal waits for measured states to plan from; the joints rest.
    PLANNING = "planning"  # The worker computes a plan.
    EXECUTING = "executing"  # A schedule is tracked.
    REPLANNING = "replanning"  # A schedule is tracked while a plan that takes over is computed.
    TAKING_OVER = "taking over"  # A schedule is tracked until its successor takes over.
    BRAKING = "braking"  # The joints brake along the planned path.
    EVALUATING = "evaluating"  # A schedule has ended; measured states are compared with the goal.
    TELEOPERATING = "teleoperating"  # An end-effector follows twists, or brakes after the last one.


class Event(Enum):
    """Cause of a phase change."""

    NEW_GOAL = "new goal"
    TWIST = "twist"  # The first twist of a teleoperation.
    PLAN_REQUESTED = "plan requested"  # A plan from the measured state was requested.
    PLANNED = "planned"
    REFUSED = "refused"  # The method has found no plan.
    PLAN_LATE = "plan late"  # The takeover tick has been reached, but the plan is not ready.
    TAKEN_OVER = "taken over"  # The tick at which a plan takes over has been reached.
    SCHEDULE_ENDED = "schedule ended"
    AT_REST = "at rest"  # Braking has ended.
    TRACKING_ERROR = "tracking error"  # The base is off its path; the method plans from rest only.
    OBSTACLES = "obstacles"  # The obstacles have changed since planning.
    JOINTS_STUCK = "joints stuck"
    TIME_JUMPED = "time jumped"  # The schedule does not cover the time of the states.
    REACHED = "reached"
    FAILED = "failed"  # All corrections are used, or the measured state is not finite.
    ABORTED = "aborted"  # The goal is given up on request.
    PLANT_STOPPED = "plant stopped"  # The plant does not obey commands: the goal is given up.
    PLANT_RESET = "plant reset"
    """The plant was reset, its robot has captured or released, or its joints were brought to rest
    because commands were late."""
    DEACTIVATED = "deactivated"


class Transition(NamedTuple):
    """A phase change and its cause."""

    source: Phase
    event: Event
    target: Phase


Output = PlannerStatus | ScheduleStart | Notice | Transition | FlightEvent | PursuedGoals
"""Output of an executive other than setpoints."""


@dataclass
class PlannerStatistics:
    """Plan and command counts, for benchmarks and summaries.

    Attributes
    ----------
    plan_time_s
        Wall time spent planning for the current goal.
    plans
        Number of plans made or rejected for the current goal.
    commands_published
        Number of commands since the node was configured.
    """

    plan_time_s: float = 0.0
    plans: int = 0
    commands_published: int = 0

    def to_json(self) -> str:
        """Return the response message of the service ``~/statistics``."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str) -> PlannerStatistics:
        """Return the statistics from a response message of the service ``~/statistics``."""
        return cls(**json.loads(text))


class PlanReason(Enum):
    """Reason for a plan request; events contain its value under ``reason``."""

    NEW_GOAL = "new goal"  # A new goal, from rest.
    BLEND = "blend"  # A new goal arrived while the joints were moving; the plan begins by braking.
    IN_MOTION = "new goal in motion"  # A new goal; its plan takes over in motion.
    SHRINKING_HORIZON = "shrinking horizon"  # The remaining motion, planned in motion.
    CORRECTION = "correction"  # The schedule has ended, and the goal is not reached.
    CONTINUATION = "continuation"  # The next part of a manoeuvre planned in parts.
    TRACKING_ERROR = "tracking error"  # The base is off its path; the plan begins with braking.
    REPLAN = "replan"  # The schedule ended by braking, or no longer applies.
    STUCK_JOINTS = "stuck joints"  # Some joints are stuck; the plan uses the other joints.

    @property
    def is_for_new_goal(self) -> bool:
        """Whether the plan is for a new goal, which is not active yet."""
        return self in (PlanReason.NEW_GOAL, PlanReason.BLEND, PlanReason.IN_MOTION)


@dataclass
class ActiveGoal:
    """An accepted goal, its current schedule, and the number of corrections so far."""

    identified: IdentifiedGoal
    schedule: GaitSchedule
    """The latest executed schedule."""
    begins_ns: int
    """Stamp of the state used to plan the first schedule, ns."""
    corrections: int = 0
    manoeuvre_time: float = 0.0
    """Duration of all schedules for the goal, s."""
    ends_at: float = 0.0
    """Simulated time at which the latest schedule ends, s."""
    next_plan: PlanReason = PlanReason.CORRECTION
    """Reason for the next plan, if one is needed."""
    stuck_positions: dict[str, float] = field(default_factory=dict)
    """Positions of stuck joints, m or rad, as measured for the last plan."""
    required: frozenset[Controlled] = frozenset()
    """Goal components that plans without the stuck joints must control."""
    not_flown_reason: str = ""
    """Reason why schedules are no longer executed, as a clause; empty: schedules are executed."""

    def begin(self, schedule: GaitSchedule, stamp_ns: int) -> None:
        """Pursue the goal with a schedule whose first tick has this stamp."""
        self.cut_off(stamp_ns)
        self.schedule = schedule
        self.manoeuvre_time += schedule.duration
        self.ends_at = stamp_ns / SECOND + schedule.duration
        self.next_plan = PlanReason.CONTINUATION if schedule.partial else PlanReason.CORRECTION

    def cut_off(self, stamp_ns: int) -> None:
        """Subtract the part of the schedule after a stamp, because that part is not executed."""
        remainder = self.time_left(stamp_ns)
        if remainder > 0:
            self.manoeuvre_time -= min(remainder, self.schedule.duration)
            self.ends_at = stamp_ns / SECOND

    @property
    def counted(self) -> dict[str, str]:
        """The number of corrections, for events."""
        return {"corrections": str(self.corrections)}

    def time_left(self, stamp_ns: int) -> float:
        """Return the time from a stamp to the end of the schedule, s."""
        return self.ends_at - stamp_ns / SECOND

    def is_late(self, stamp_ns: int) -> bool:
        """Whether most of the motion is over."""
        return self.time_left(stamp_ns) < _LATE_TIME_SHARE * self.manoeuvre_time

    def reached(self, error: PoseError, tolerance: Tolerance) -> PlannerStatus | None:
        """Return the status of a goal reached with this error; None if it is not reached."""
        goal, controls = self.identified.goal, self.schedule.controls
        if not tolerance.admits(error, controls):
            return None
        left = describe_remaining_error(error, controls, tolerance, goal)
        missed = missed_parts(goal, error, controls, tolerance)
        decided = PlannerState.REACHED_PARTLY if missed else PlannerState.REACHED
        return self.status(decided, reached_message(left, missed), error)

    def failed(self, error: PoseError, tolerance: Tolerance, why: str) -> PlannerStatus:
        """Return the status of a goal that is not reached; ``why`` precedes its error."""
        controls, goal = self.schedule.controls, self.identified.goal
        off = describe_remaining_error(error, controls, tolerance, goal)
        return self.status(PlannerState.FAILED, f"The goal is not reached{why}: {off}.", error)

    def status(
        self, state: PlannerState, message: str, error: PoseError | None = None, **values: Any
    ) -> PlannerStatus:
        """Return a status of the goal, with its remaining error if evaluated."""
        return PlannerStatus.of_goal(
            state,
            message,
            self.identified,
            error,
            corrections=self.corrections,
            manoeuvre_time_s=self.manoeuvre_time,
            ends_at_s=self.ends_at,
            remaining_s=self.schedule.remaining,
            not_controlled=uncontrolled_parts(self.identified.goal, self.schedule.controls),
            **values,
        )


def describe_remaining_error(
    error: PoseError,
    controls: frozenset[Controlled],
    tolerance: Tolerance | None = None,
    goal: Goal | None = None,
) -> str:
    """Return a clause with the remaining error in the controlled goal components.

    Given tolerances are included, and the uncontrolled components of a given goal are named.
    """
    parts: dict[Controlled, str] = {
        "position": quantity(error.distance, "m"),
        "attitude": quantity(error.angle, "rad"),
    }
    if len(error.shape):
        parts["shape"] = quantity(error.max_joint_error, AT_JOINTS)
    controlled = [text for part, text in parts.items() if part in controls]
    body = enumeration(controlled) if controlled else ""
    hand, hands, several = "", "end_effectors" in controls, len(error.end_effectors) > 1
    if hands and error.end_effectors:
        distance, angle = error.largest_end_effector_distance, error.largest_end_effector_angle
        # Position-only goals have no angle error.
        turn = f" and {quantity(angle, 'rad')}" if angle > 0 else ""
        hand = f"end-effector{'s at most' if several else ''} {quantity(distance, 'm')}{turn}"
    remaining = f"{body or hand} from the goal"
    if body and hand:
        remaining += f", {hand} from {'theirs' if several else 'its goal'}"
    parts_left = () if goal is None else uncontrolled_parts(goal, controls)
    notes = []
    if tolerance is not None:
        limits = (
            (quantity(tolerance.position, "m"), hands or "position" in controls),
            (quantity(tolerance.attitude, "rad"), hands or "attitude" in controls),
            (quantity(tolerance.shape, AT_JOINTS), "shape" in controls and "shape" in parts),
        )
        notes.append("tolerance " + ", ".join(text for text, counts in limits if counts))
    if parts_left:
        notes.append(f"{' and '.join(parts_left)} not controlled")
    return remaining + (f" ({'; '.join(notes)})" if notes else "")


def manoeuvre_time(statuses: Iterable[tuple[float, PlannerStatus]], end_s: float) -> float | None:
    """Return the duration of the executed schedules for the last goal, s; None if there are none.

    This is the planner's value, minus the rest of the last schedule if the flight ended early. If
    the planner has no value, for example after an abort, :func:`time_to_end` is returned.
    """
    given = list(statuses)
    flown = [
        (time, status)
        for time, status in given
        if status.state is PlannerState.EXECUTING
        or (status.state.decided and status.state is not PlannerState.REFUSED)
    ]
    if all(status.state is not PlannerState.EXECUTING for _, status in flown):
        return None
    began, last = flown[-1]
    counted = last.manoeuvre_time_s
    if last.state is PlannerState.EXECUTING:
        counted -= max(0.0, last.duration_s - (end_s - began))
    return counted if counted > 0.0 else time_to_end(given, end_s)


def time_to_end(statuses: Iterable[tuple[float, PlannerStatus]], end_s: float) -> float | None:
    """Return the time, s, from the first schedule for the last goal to the end; None: no schedule.

    Waiting times, such as for a restarted planner, are included. ``statuses`` are times, s, and
    statuses in order of time; ``end_s``, s, ends the flight if no status has ended the goal.
    """
    given = list(statuses)
    executing = [each for each in given if each[1].state is PlannerState.EXECUTING]
    if not executing:
        return None
    last_began, last = executing[-1]
    began = next(time for time, status in executing if status.goal_id == last.goal_id)
    ends = (
        time
        for time, status in given
        if time >= last_began and status.state.decided and status.state is not PlannerState.REFUSED
    )
    return next(ends, end_s) - began
