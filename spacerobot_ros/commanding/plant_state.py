"""A commander's view of its plant: current states, complete states, status.

Messages are opaque here: each has a stamp, in ns, and is passed on unchanged.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from enum import Enum
from statistics import fmean, median
from typing import Any, NamedTuple, TypeAlias

from spacerobot_ros.simulation.status import PlantState, PlantStatus
from spacerobot_ros.times import SECOND

_NO_STAMP = -1
"""The stamp that represents a missing message; message stamps are never negative."""


class Stamped(NamedTuple):
    """A message and its stamp, ns."""

    stamp_ns: int
    message: Any


_NO_MESSAGE = Stamped(_NO_STAMP, None)


# -- states at the current time ----------------------------------------------------------------

_JUMP_CONFIRMATION_TIME = 0.5
"""Wall time without a state at the old time before a time jump is accepted, s."""

_STEP_SLACK = 1.5
"""Maximum distance, in plant steps, between two states if no state was lost."""

_PACE_SLACK = 2.0
"""Maximum ratio of the time of lost states to the time expected from the plant's rate."""

_MEETING_TIME = 1.0
"""Wall time after the first state during which poses may arrive before or long after their joints,
s."""

_LATE_POSES = 6
"""Poses older than this multiple of the longest step are late (the machine is busy), and are
discarded without a message."""

_MEASURED_STEPS = 8
"""Number of steps used to compute the state rate if the steps are not equal."""

_STEADY = 1.2
"""Maximum ratio of two steps at a steady rate; states skipped by a busy node make steps longer."""

_STEP_ROUNDING_NS = 1_000
"""Maximum difference between equal steps, due to stamps computed in floating point, ns."""


class StampFilter:
    """Separates states at the plant's current time from states with other stamps.

    The steps between states, and thus the plant's rate, are derived from the stamps. A stamp is
    current if it is

    * equal to the previous stamp, or at most 1.5 steps after it: no message was lost;
    * further ahead by at most twice the simulated time expected for the elapsed wall time: messages
      were lost, or this process was suspended.

    Any other state is a *time jump*, and is deferred. If a state with the current time follows, the
    jump is ignored and counted. If none follows for 0.5 s of wall time, the time has really
    changed, for example after a plant restart, and the jump is accepted. A plant in lockstep waits
    for its command during this time. ``clock`` returns the wall time, s.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._steps: deque[int] = deque(maxlen=_MEASURED_STEPS)
        """Latest steps between two states, ns."""
        self._longest_step = math.inf
        """Maximum step if no state was lost, ns; infinite before the second state."""
        self._first_ns, self._first_wall, self._wall = _NO_STAMP, 0.0, 0.0
        """Stamp (ns) and wall time (s) of the first state at the current time; wall time (s) of the
        last."""
        self._jump = self._jump_odom = _NO_MESSAGE
        self._jump_wall = 0.0
        self.now_ns = 0
        """Stamp of the latest admitted state, ns; 0 before the first state."""
        self.ignored = 0
        """Number of states and poses ignored because of their stamps."""
        self.last_ignored = ""
        """Message for the user about the latest ignored state."""

    @property
    def rate(self) -> float:
        """State rate from the stamps, Hz; 0 if there are too few stamps."""
        steps = list(self._steps)
        if len(steps) > 1 and abs(steps[-1] - steps[-2]) <= _STEP_ROUNDING_NS:
            return SECOND / steps[-1]
        if len(steps) < _MEASURED_STEPS:
            return 0.0
        # Sensor rates are integers, with some jitter; steps with losses are longer.
        usual = median(steps)
        measured = SECOND / fmean(step for step in steps if step <= _STEP_SLACK * usual)
        return float(round(measured)) or measured

    @property
    def steady_rate(self) -> float:
        """State rate if many successive steps agree, Hz; 0 otherwise."""
        steps = self._steps
        steady = len(steps) == _MEASURED_STEPS and max(steps) <= _STEADY * min(steps)
        return self.rate if steady else 0.0

    def is_present(self, stamp_ns: int, behind_ns: float = 0.0) -> bool:
        """Whether a stamp is current, and precedes the last stamp by at most ``behind_ns``."""
        ahead = stamp_ns - self.now_ns
        if ahead <= self._longest_step:
            return ahead >= -behind_ns
        elapsed = self._wall - self._first_wall
        pace = (self.now_ns - self._first_ns) / elapsed if elapsed > 0 else 0.0
        return ahead <= self._longest_step + _PACE_SLACK * pace * (self._clock() - self._wall)

    def accepts_joints(self, stamp_ns: int, joints: Any) -> bool:
        """Return whether joint states have a current stamp; defer other joint states."""
        if not self.is_present(stamp_ns):
            if self._jump.message is None:
                self._jump_wall = self._clock()
            self._jump = Stamped(stamp_ns, joints)
            return False
        if self._first_ns == _NO_STAMP:
            self._begin(stamp_ns)
            return True
        if stamp_ns > self.now_ns:
            self._steps.append(stamp_ns - self.now_ns)
            self._longest_step = _STEP_SLACK * self._steps[-1]
        self.now_ns, self._wall = stamp_ns, self._clock()
        if self._jump.message is not None or self._jump_odom.message is not None:
            self._ignore_jump()
        return True

    def accepts_odom(self, stamp_ns: int, odom: Any) -> bool:
        """Return whether a pose has a current stamp; defer other poses.

        A pose may arrive before or after the joints with the same stamp.
        """
        if self.is_present(stamp_ns, self._longest_step):
            return True
        if not 0 < self.now_ns - stamp_ns <= _LATE_POSES * self._longest_step:
            self._jump_odom = Stamped(stamp_ns, odom)
        return False

    def accepted_jump(self) -> tuple[Stamped | None, Stamped] | None:
        """Return the deferred odom message (or None) and joint states once their time is accepted.

        Call this several times per second; None if no jump is accepted.
        """
        joints, odom = self._jump, self._jump_odom
        if joints.message is None or self._clock() - self._jump_wall < _JUMP_CONFIRMATION_TIME:
            return None
        self._begin(joints.stamp_ns)
        return (odom if odom.stamp_ns == joints.stamp_ns else None), joints

    def _begin(self, stamp_ns: int) -> None:
        self.now_ns = self._first_ns = stamp_ns
        self._wall = self._first_wall = self._clock()
        self._longest_step = math.inf
        self._steps.clear()
        self._jump = self._jump_odom = _NO_MESSAGE

    def _ignore_jump(self) -> None:
        """Count the deferred messages as ignored: the current time continues.

        During discovery, nodes receive one topic before the other; such poses are not counted.
        """
        meeting = self._wall - self._first_wall < _MEETING_TIME
        odom = _NO_MESSAGE if meeting else self._jump_odom
        for name, given in (("joint_states", self._jump), ("odom", odom)):
            if given.message is None or given.stamp_ns == self.now_ns:
                continue
            ahead = (given.stamp_ns - self.now_ns) / SECOND
            self.ignored += 1
            self.last_ignored = (
                f"A message on '{name}' is ignored: its stamp is {abs(ahead):.4g} s "
                f"{'ahead of' if ahead > 0 else 'behind'} the state time."
            )
        self._jump = self._jump_odom = _NO_MESSAGE


# -- complete states --------------------------------------------------------------------------


class Pairing(str, Enum):
    """The messages of a state from a :class:`StateSynchroniser`."""

    WHOLE = "whole"
    """Joint states and odom with the same stamp."""

    WITHOUT_POSE = "without pose"
    """Only joint states: the odom message has not arrived."""

    LATE_POSE = "late pose"
    """Odom of a state that was previously returned without odom."""


class StateSynchroniser:
    """Pairs the latest odom message and joint states by their stamps, and returns every state once.

    A commander either requires the pose (a controller) or does not (a planner, which needs it
    only to plan):

    * *Pose required:* a state is ready when its odom message has arrived. If odom fails, this is
      detected when the next joint states arrive: the previous state is then overdue
      (:meth:`take_overdue`). From then on states are ready without their pose, until odom arrives
      again.
    * *Pose optional:* a state is ready when its joint states have arrived; odom that arrives later
      is returned as a :attr:`Pairing.LATE_POSE`.

    Further topics can be required (:meth:`require`): a state then waits for a message with its
    stamp on each of these topics.
    """

    def __init__(self, *, pose_required: bool) -> None:
        self._pose_required = pose_required
        self.odom: Any = None
        """The latest odom; None before the first odom message."""
        self.joints: Any = None
        """The latest joints; None before the first joint states."""
        self._odom_ns = self._joints_ns = _NO_STAMP
        self._odom_fresh = self._joints_fresh = self._without_pose = False
        self._required: dict[str, Stamped] = {}
        """Latest messages on the topics required in addition to odom and joints."""

    def require(self, topic: str, *, required: bool = True) -> None:
        """Set whether states wait for a message on an additional topic."""
        if not required:
            self._required.pop(topic, None)
        else:
            self._required.setdefault(topic, _NO_MESSAGE)

    def put_odom(self, stamp_ns: int, odom: Any) -> bool:
        """Accept an odom message; from now on, the pose is considered measured.

        Return whether the odom message contradicts the previous odom message with the same stamp:
        if so, another node also publishes odom, and the state has no pose.
        """
        contradicts = stamp_ns == self._odom_ns and odom != self.odom
        self._odom_ns, self.odom = stamp_ns, odom
        self._odom_fresh, self._without_pose = not contradicts, contradicts
        return contradicts

    def forget_pose(self) -> None:
        """Discard the latest odom message, because the plant publishes another state for the same
        time.

        A later odom with this time is then not treated as a contradiction, or as the pose for
        joints that were returned before.
        """
        self.odom, self._odom_ns, self._odom_fresh = None, _NO_STAMP, False
        if not self._joints_fresh:
            self.joints, self._joints_ns = None, _NO_STAMP

    def put_joints(self, stamp_ns: int, joints: Any) -> None:
        """Accept joint states; see :meth:`take_overdue` for the previous state."""
        self.joints, self._joints_ns = joints, stamp_ns
        self._joints_fresh = True

    @property
    def missing(self) -> tuple[str, ...]:
        """Topics for which an otherwise complete state waits."""
        if not (self._required and self._joints_fresh):
            return ()
        stamp = self._joints_ns
        if not (self._without_pose or (self._odom_fresh and self._odom_ns == stamp)):
            return ()
        return tuple(name for name, given in self._required.items() if given.stamp_ns != stamp)

    def put_required(self, topic: str, stamp_ns: int, message: Any) -> None:
        """Accept a message on an additional topic, and require the topic from now on."""
        self._required[topic] = Stamped(stamp_ns, message)

    def latest(self, topic: str) -> Any:
        """Return the latest message on a required topic; None before the first message."""
        return self._required.get(topic, _NO_MESSAGE).message

    def take_ready(self) -> Pairing | None:
        """Return a ready state once; None if there is no new ready state."""
        stamp = self._joints_ns
        together = stamp == self._odom_ns
        if not self._pose_required:
            posed = self._odom_fresh and together
            self._odom_fresh = self._odom_fresh and not together
            if self._joints_fresh:
                self._joints_fresh = False
                return Pairing.WHOLE if posed else Pairing.WITHOUT_POSE
            return Pairing.LATE_POSE if posed else None
        if (
            self._joints_fresh
            and (self._without_pose or (self._odom_fresh and together))
            and all(given.stamp_ns == stamp for given in self._required.values())
        ):
            self._odom_fresh = self._joints_fresh = False
            return Pairing.WITHOUT_POSE if self._without_pose else Pairing.WHOLE
        return None

    def take_overdue(self) -> Pairing | None:
        """Return a state that was never ready; call this before :meth:`put_joints`.

        :attr:`Pairing.WITHOUT_POSE`: the odom is missing, and states are ready without odom from
        now on. :attr:`Pairing.WHOLE`: another required topic is silent.
        """
        if not self._joints_fresh:
            return None
        self._joints_fresh = False
        self._without_pose = self._joints_ns != self._odom_ns
        return Pairing.WITHOUT_POSE if self._without_pose else Pairing.WHOLE


# -- plant status -----------------------------------------------------------------------------


@dataclass(frozen=True)
class PlantStopped:
    """The plant ignores commands.

    Attributes
    ----------
    reason
        Message of the plant.
    """

    reason: str


@dataclass(frozen=True)
class PlantRested:
    """The plant brought its joints to rest, because no command arrived in time.

    Parameters
    ----------
    commanded_until_ns
        Stamp of the last command, ns.
    since_ns
        Time at which the plant came to rest, ns; if unknown, that of the last command.
    """

    commanded_until_ns: int
    since_ns: int


class PlantChange(Enum):
    """Changes reported by a plant, other than a stop."""

    OBEYS = "obeys"
    """Commands are accepted again."""
    RESET = "reset"
    """The robot is back in its initial state."""


PlantReport: TypeAlias = PlantStopped | PlantRested | PlantChange


class PlantListener:
    """Tracks plant/status (optional): whether the plant accepts commands, and its resets."""

    def __init__(self) -> None:
        self.status = PlantStatus(PlantState.RUNNING)
        """The latest status; before the first, the status of a plant that accepts commands."""
        self._heard, self._name = False, "plant"
        self._time_s = -math.inf
        """Time of the latest status of an active plant."""

    @property
    def refusal_of_goals(self) -> str:
        """Message that says why goals are currently rejected; empty: goals are accepted."""
        status = self.status
        if status.latched_fault:
            return (
                f"'{self._name}' is latched: {status.latched_fault}; rearm it first by its service "
                f"'{self._name}/rearm'."
            )
        if status.state is PlantState.FAILED:
            return f"The plant has failed: {status.message}"
        return ""

    @property
    def in_lockstep(self) -> bool:
        """Whether the plant waits for commands."""
        return self.status.time_mode == "lockstep"

    @property
    def has_no_command(self) -> bool:
        """Whether no command is active: none has arrived, or commands are ignored."""
        return self.status.state is PlantState.RESTING or bool(self.refusal_of_goals)

    @property
    def paused(self) -> bool:
        """Whether the plant is paused."""
        return self.status.state is PlantState.PAUSED

    def update(self, status: PlantStatus, name: str = "plant") -> list[PlantReport]:
        """Process the next status of the named plant; return the changes to react to.

        Statuses may be missed; the plant's counters reveal the changes in between.
        """
        before, heard, was_blocked = self.status, self._heard, bool(self.refusal_of_goals)
        reset = heard and status.resets > before.resets
        if status.state not in (PlantState.INACTIVE, PlantState.FAILED):
            # Time goes back if another process has taken the plant's place.
            reset |= status.time_s < self._time_s
            self._time_s = status.time_s
        self.status, self._name, self._heard = status, name, True
        changes: list[PlantReport] = []
        if self.refusal_of_goals:
            if not was_blocked or status.latched_fault != before.latched_fault:
                fault = status.latched_fault
                changes.append(PlantStopped(f"{fault}." if fault else status.message))
            # A plant that ignores all commands may still be reset, immediately and to another pose.
            if reset:
                changes.append(PlantChange.RESET)
            return changes
        if not heard:
            return changes
        if status.rearms > before.rearms and not was_blocked:
            changes.append(PlantStopped("Commands are accepted again after a latched fault."))
        if status.timeouts > before.timeouts or (
            status.reason == "timeout" and before.reason != "timeout"
        ):
            since = status.time_s
            last = since if status.last_command_s is None else status.last_command_s
            if status.reason != "timeout":
                since = last
            if math.isfinite(last) and math.isfinite(since):
                changes.append(PlantRested(round(last * SECOND), round(since * SECOND)))
        if reset:
            changes.append(PlantChange.RESET)
        if was_blocked or status.rearms > before.rearms:
            changes.append(PlantChange.OBEYS)
        return changes


# -- missing inputs ---------------------------------------------------------------------------

_LONGEST_SILENCE, _SILENT_PERIODS = 1.0, 5
"""Wall time without a state after which states are reported as missing, s, and its minimum in
control periods."""

_SUSPENSION_TIME = 0.5
"""Wall time between two checks above which this process is assumed to have been suspended, s."""


class InputWatch:
    """Checks whether the states of a plant arrive; ``clock`` returns the wall time, s."""

    def __init__(
        self,
        states: StateSynchroniser,
        plant: PlantListener,
        has_publisher: Callable[[str], bool],
        clock: Callable[[], float],
    ) -> None:
        self._states, self._plant = states, plant
        self._has_publisher, self._clock = has_publisher, clock
        self.refusal = ""
        """Why the last joint states were rejected, as a clause; empty: not rejected."""
        self.begin()

    def begin(self) -> None:
        """Start waiting for states."""
        self._begun = self._heard = self._checked = self._clock()

    def note_state(self) -> None:
        """Record that a state has arrived."""
        self._heard = self._clock()

    @property
    def just_begun(self) -> bool:
        """Whether inputs may still be on their way."""
        return self._clock() - self._begun < _LONGEST_SILENCE

    def excuse_suspension(self) -> None:
        """Do not count as silence the time during which this process itself was suspended."""
        now = self._clock()
        if now - self._checked > _SUSPENSION_TIME:
            self._heard += now - self._checked
        self._checked = now

    def missing(self, control_period: float) -> str:
        """Return a clause that names the messages for which states wait; empty: none."""
        topics = {"joint_states": self._states.joints, "odom": self._states.odom}
        absent = [topic for topic, message in topics.items() if message is None]
        refused = f", whose messages are rejected: {self.refusal}" if self.refusal else ""
        if absent:
            unheard = [t for t in absent if not (self.just_begun or self._has_publisher(t))]
            nobody = f", and no node publishes {_quoted(unheard)}" if unheard else ""
            return f"states on {_quoted(absent)}{refused}{nobody}"
        if self._plant.status.reason == "ended":
            return "the plant, which has ended: start it again"
        silence = self._clock() - self._heard
        if silence <= max(_LONGEST_SILENCE, _SILENT_PERIODS * control_period):
            return ""
        if self._plant.status.state is PlantState.INACTIVE:
            return "the plant, which is inactive: activate it"
        if self._plant.paused:
            return "the plant, which is paused: resume it"
        if self._plant.in_lockstep:
            return ""
        return f"states on 'joint_states'{refused or ', which have ceased'}"


def _quoted(topics: Iterable[str]) -> str:
    return " and ".join(f"'{topic}'" for topic in topics)
