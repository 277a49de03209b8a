"""Which commands reach the actuators of a plant: the one rule set, for its node and for bags.

A command comes from a *source* (one topic) with a stamp and values, and answers the state of that
stamp. In lockstep the command of a tick is the first one that is stamped with it; a refused one
makes it a tick at rest. In real time a command answers any state that was published lately, and
holds until it is older than the timeout; one publisher commands, not two by turns.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from functools import partial
from typing import Literal

import numpy as np
import numpy.typing as npt

from spacerobot_ros.control.laws.computed_torque import ComputedTorqueLaw
from spacerobot_ros.control.laws.law import Gains
from spacerobot_ros.control.state import ControlState, JointReference, Reference
from spacerobot_ros.errors import CommandError, ParameterError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.simulation.config import PlantConfig
from spacerobot_ros.simulation.plant import Plant
from spacerobot_ros.times import SECOND

NEVER = -math.inf
"""The stamp of no command."""


_START = 1.0
"""Time for which a stamp of zero is that of the first state where commands never grow old, s."""

_STAMP_ROUNDING = 1_000
"""By how much a stamp may be off its state where a commander keeps time in floating point, ns."""

_SUPERSEDED = "it answers a state from before the plant was started, reset or stopped"

_BRAKING_RATE = 20.0
"""Joint rates decay as exp(-20 t/s) while the motors are strong enough."""

_LARGEST_RATE_PER_TICK = 0.5
"""A held effort must not stop a joint in less than two ticks: it would swing back."""

Quantity = Literal["velocity", "effort", "wrench"]


class Reason(str, Enum):
    """Why a command is refused; the value is the word for it in parameters and diagnostics."""

    MALFORMED = "malformed"
    """Unknown or missing joints, wrong lengths, another frame."""
    NOT_FINITE = "not_finite"
    STALE = "stale"
    EARLY = "early"
    """Stamped ahead of the plant's time."""
    UNKNOWN_STATE = "unknown_state"
    """Stamped between two ticks: there is no such state."""
    OUT_OF_ORDER = "out_of_order"
    """Stamped before the command that is in force."""
    BEYOND_LIMITS = "beyond_limits"
    SECOND_COMMANDER = "second_commander"
    """Another commander has already answered the same state, or two send by turns."""
    LATCHED = "latched"
    """A fault is latched: nothing moves until it is rearmed."""


@dataclass(frozen=True)
class Refusal:
    """Why a command was refused.

    Attributes
    ----------
    reason
        The kind of it.
    clause
        What goes after "was refused:", with numbers and names.
    latches
        Whether this refusal has latched a fault, after which nothing moves until it is rearmed.
    """

    reason: Reason
    clause: str
    latches: bool = False


def joint_order(
    joints: Sequence[str], named: Sequence[str], *, complete: bool = False
) -> npt.NDArray[np.intp]:
    """Return which of the robot's joints each name of a message is.

    Parameters
    ----------
    joints
        Names of the robot's joints.
    named
        Those of the message.
    complete
        Whether every joint must be named, as in a measured state.

    Raises
    ------
    CommandError
        A joint is unknown, missing or named twice.
    """
    index = {name: i for i, name in enumerate(joints)}
    unknown = [name for name in named if name not in index]
    if unknown:
        raise CommandError(f"joint '{unknown[0]}' is unknown; the robot has {', '.join(joints)}")
    if complete and len(set(named)) < len(index):
        missing = next(name for name in index if name not in named)
        raise CommandError(f"joint '{missing}' is missing")
    if len(set(named)) != len(named):
        raise CommandError(f"a joint is named twice in {list(named)}")
    return np.array([index[name] for name in named], dtype=np.intp)


def require_values(named: Sequence[str], quantity: str, count: int) -> None:
    """Refuse a message with another number of values than joints.

    Raises
    ------
    CommandError
        It is one.
    """
    if count != len(named):
        raise CommandError(f"{len(named)} joint(s) are named but {count} {quantity} value(s) given")


def require_frame(frame: str, base_link: str, prefix: str = "") -> None:
    """Refuse a wrench that is not in the frame of the base link; an empty name is that frame.

    The name may have the prefix of the robot's frames, if they have one.

    Raises
    ------
    CommandError
        It is one.
    """
    if frame not in ("", base_link, prefix + base_link):
        raise CommandError(f"the wrench is in frame '{frame}'; it is taken in '{base_link}'")


class CommandSource:
    """One topic that commands a plant.

    Attributes
    ----------
    topic
        Its name below the robot's namespace.
    quantity
        What its commands are.
    limits
        (size,) largest magnitude of each value.
    command
        (size,) what the actuators are to do now: joint by joint (m/s, rad/s, N or N m), or force
        (N) over torque (N m) at the origin of the base link, base components.
    stamp_ns
        When the command in force was stamped; :data:`NEVER` while there is none.
    arrived
        Whether the command of this tick has come, accepted or not (lockstep).
    resting
        Whether the last command was taken back, so that joints are to come to rest.
    required
        Whether a lockstep plant waits for its commands.
    commanders
        How many publish on the topic, as far as is known.
    senders
        Which of them has sent the last message.
    sender
        Which of them has sent the command in force.
    """

    def __init__(
        self, topic: str, quantity: Quantity, limits: Array, senders: Senders | None = None
    ) -> None:
        self.topic, self.quantity, self.limits = topic, quantity, limits
        self.senders = senders or Senders(SECOND)
        self.sender: int | None = None
        self.command: Array = np.zeros(len(limits))
        self.stamp_ns: float = NEVER
        self.arrived = self.resting = False
        self.required = True
        self.commanders = 1

    def rest(self) -> None:
        """Command nothing from now on."""
        self.command[:] = 0.0
        self.stamp_ns = NEVER
        self.resting = True

    def accept(self, values: Array, stamp_ns: float) -> None:
        """Put a command into force."""
        self.command[:] = values
        self.stamp_ns = stamp_ns
        self.sender = self.senders.current
        self.arrived = True
        self.resting = False


class CommandValidator:
    """Decides which commands drive a plant, counts those that it refuses, and latches faults.

    Parameters
    ----------
    plant
        What is commanded.
    config
        Its configuration: time mode, timeout, limits, and which reasons latch.

    Raises
    ------
    ParameterError
        ``latched_faults`` has a word that is no reason.
    """

    def __init__(self, plant: Plant, config: PlantConfig) -> None:
        robot = plant.robot
        silence_ns = round((config.command_timeout or _START) * SECOND)
        joints = partial(CommandSource, "joint_commands", senders=Senders(silence_ns))
        self.sources = [joints("velocity", robot.velocity_limit)]
        """Those whose commands are the arguments of a step, in that order: the joints' first."""
        self._brakes: _JointBrakes | None = None
        if config.actuation == "effort":
            self.sources = [
                joints("effort", robot.effort_limit),
                CommandSource("base_wrench", "wrench", np.full(6, np.inf), Senders(silence_ns)),
            ]
            # Velocity servos stop at once; motors have to brake.
            self._brakes = _JointBrakes(plant, config.control_period)
        self._commands = [source.command for source in self.sources]
        self._lockstep = config.time_mode == "lockstep"
        self._timeout, self._period = config.command_timeout, config.period_ns
        self._earliest = 0
        self._clips = config.beyond_limits == "clip"
        self._one_commander = config.second_commander == "refuse"
        self._latching = _latching(config.latched_faults)
        self.counts: Counter[Reason] = Counter()
        """How many commands were refused, by reason."""
        self.fault = ""
        """Why nothing moves; empty while commands pass."""
        self.fault_reason = ""
        """The same as a word: that of the reason to refuse a command, ``abort``, ``watchdog``."""
        self.timed_out = False
        """Whether the last command was brought to rest because it was too old."""
        self.timeouts = 0
        """How often that has happened."""
        self.last_stamp_ns: float = NEVER
        """The stamp of the command that was the last one then."""

    @property
    def complete(self) -> bool:
        """Whether every command that a lockstep plant waits for is there."""
        # Twice as fast as all() over a generator, and asked every tick.
        for source in self.sources:  # noqa: SIM110
            if source.required and not source.arrived:
                return False
        return True

    @property
    def in_force(self) -> bool:
        """Whether a command of any source is in force."""
        return any(source.stamp_ns != NEVER for source in self.sources)

    def offer(
        self, source: CommandSource, stamp_ns: int, values: Array | CommandError, now_ns: int
    ) -> Refusal | None:
        """Accept or refuse a command.

        Parameters
        ----------
        source
            Where it came from.
        stamp_ns
            Its stamp.
        values
            What it commands; an error, if its message is malformed.
        now_ns
            Simulated time of the plant's state.

        Returns
        -------
        Refusal or None
            Why it is refused; None if it is in force now.
        """
        unset = False
        if self._lockstep:
            if stamp_ns != now_ns or source.arrived:
                return self._refuse(source, _not_this_tick(stamp_ns, now_ns), now_ns)
            refusal = self._unsound(source, values)
        else:
            if not stamp_ns and (self._earliest or now_ns > (self._timeout or _START) * SECOND):
                # An unset stamp means now; at the start it is the first state's.
                stamp_ns, unset = now_ns, True
            elif stamp_ns % self._period:
                stamp_ns = self._rounded(stamp_ns)
            refusal = self._untimely(source, stamp_ns, now_ns) or self._unsound(source, values)
        if refusal is None and self.fault:
            refusal = Refusal(Reason.LATCHED, self.fault)
        if stamp_ns < self._earliest and refusal is None and not unset:
            refusal = Refusal(Reason.STALE, _SUPERSEDED)
        if refusal is None:
            assert not isinstance(values, CommandError)
            source.accept(values, stamp_ns)
            return None
        refusal = self._refuse(source, refusal, now_ns)
        if self._lockstep:
            # Time must go on for the others: a bad command is a tick at rest.
            source.rest()
            source.arrived = True
        return refusal

    def unreadable(self, source: CommandSource, error: CommandError, now_ns: int) -> Refusal:
        """Refuse bytes that are no message: they have no stamp, and so answer no tick."""
        return self._refuse(source, Refusal(Reason.MALFORMED, str(error)), now_ns)

    def begin_step(self) -> list[Array]:
        """Return the commands to step under, a writable array for each source."""
        for source in self.sources:
            source.arrived = False
        if self._brakes is not None and self.sources[0].resting:
            self._commands[0][:] = self._brakes.efforts()
        return self._commands

    def begin(self, now_ns: int) -> None:
        """Command nothing, and accept from now on what answers the state of this time or later."""
        self.rest()
        self._earliest = now_ns

    def rest(self) -> None:
        """Command nothing any more."""
        self.timed_out = False
        for source in self.sources:
            source.rest()
            source.arrived = False

    def latch(self, reason: str, sentence: str, now_ns: int) -> None:
        """Bring everything to rest until :meth:`rearm`; the first fault stays the one shown.

        What answers a state from before the fault is refused even after it is rearmed.

        Parameters
        ----------
        reason
            A word: the value of a :class:`Reason`, ``abort`` or ``watchdog``.
        sentence
            What goes after "a fault is latched:".
        now_ns
            Simulated time of the plant's state.
        """
        if not self.fault:
            self.fault, self.fault_reason = sentence, reason
            self._earliest = now_ns + self._period
        self.timed_out = False
        for source in self.sources:
            source.rest()

    def rearm(self) -> str:
        """Let commands pass again; return the fault that was latched, empty if there was none."""
        fault, self.fault, self.fault_reason = self.fault, "", ""
        return fault

    def require_commanded(self) -> None:
        """Wait for wrenches only while a node publishes them; joints are always waited for."""
        for source in self.sources[1:]:
            source.required = source.commanders > 0
            if not source.required:
                # No commander is left that could turn the thrusters off.
                source.rest()
                source.arrived = False

    def drop_old(self, now_ns: int) -> list[CommandSource]:
        """Bring to rest the sources without a command for the timeout, and return them."""
        silent, last = [], NEVER
        for source in self.sources:
            age = now_ns - source.stamp_ns
            if self._timeout and source.stamp_ns != NEVER and age > self._timeout * SECOND:
                last = max(last, source.stamp_ns)
                source.rest()
                silent.append(source)
        self.timed_out = self.timed_out or bool(silent)
        if silent and not self.in_force:
            self.timeouts += 1
            self.last_stamp_ns = last
        return silent

    def _unsound(self, source: CommandSource, values: Array | CommandError) -> Refusal | None:
        """Return why values are refused whenever they come, if they are."""
        if isinstance(values, CommandError):
            return Refusal(Reason.MALFORMED, str(values))
        # A sum is finite only if every term is; for a few numbers a list is summed fastest.
        if not math.isfinite(sum(values.tolist())):
            return Refusal(Reason.NOT_FINITE, f"a value is not finite: {values.tolist()}")
        if not self._clips and np.any(np.abs(values) > source.limits):
            limits = f"{values.tolist()} is beyond the limits {source.limits.tolist()}"
            return Refusal(Reason.BEYOND_LIMITS, limits)
        return None

    def _rounded(self, stamp_ns: int) -> int:
        """Return the tick that a stamp means, if it is off by rounding only."""
        tick = (stamp_ns + self._period // 2) // self._period * self._period
        return tick if abs(stamp_ns - tick) <= _STAMP_ROUNDING else stamp_ns

    def _untimely(self, source: CommandSource, stamp_ns: int, now_ns: int) -> Refusal | None:
        """Return why a command does not belong to this moment of real time, if it does not."""
        if source.senders.multiple_publishers and self._one_commander:
            return Refusal(Reason.SECOND_COMMANDER, "two publishers command by turns")
        age = (now_ns - stamp_ns) / SECOND
        if self._timeout and age > self._timeout:
            return Refusal(Reason.STALE, f"it is {age:.3g} s old")
        if age < 0:
            return Refusal(Reason.EARLY, f"it is {-age:.3g} s ahead of time")
        if stamp_ns % self._period:
            period = self._period / SECOND
            return Refusal(
                Reason.UNKNOWN_STATE,
                f"it is stamped {stamp_ns / SECOND:.9g} s, and states have multiples of "
                f"{period:.9g} s",
            )
        late = (source.stamp_ns - stamp_ns) / SECOND
        if late > 0:
            return Refusal(Reason.OUT_OF_ORDER, f"it is {late:.3g} s older than the one in force")
        if late == 0 and source.commanders > 1 and self._one_commander:
            senders = source.senders
            if senders.current is None or senders.current != source.sender:
                return Refusal(
                    Reason.SECOND_COMMANDER,
                    f"the same state was answered before, and {source.commanders} nodes command",
                )
        return None

    def _refuse(self, source: CommandSource, refusal: Refusal, now_ns: int) -> Refusal:
        """Count a refused command; where its reason latches, everything comes to rest."""
        self.counts[refusal.reason] += 1
        if refusal.reason not in self._latching or self.fault:
            return refusal
        sentence = f"a command on '{source.topic}' was refused: {refusal.clause}"
        self.latch(refusal.reason.value, sentence, now_ns)
        return Refusal(refusal.reason, refusal.clause, latches=True)


def _not_this_tick(stamp_ns: int, now_ns: int) -> Refusal:
    early = stamp_ns > now_ns
    return Refusal(
        Reason.EARLY if early else Reason.STALE,
        f"it is {'ahead of time' if early else 'stale'}: stamped {stamp_ns / SECOND:.9g} s, the "
        f"plant is at {now_ns / SECOND:.9g} s",
    )


def _latching(words: str) -> frozenset[Reason]:
    known = [reason.value for reason in Reason if reason is not Reason.LATCHED]
    for word in words.split():
        if word not in known:
            raise ParameterError(
                f"Parameter 'latched_faults' has '{word}'; it takes {', '.join(known)}, separated "
                "by spaces."
            )
    return frozenset(Reason(word) for word in words.split())


class _JointBrakes:
    """Motor efforts against the joint rates of a plant: inner forces, which leave its momenta."""

    def __init__(self, plant: Plant, control_period: float) -> None:
        robot: SpaceRobot = plant.robot
        rate = min(_BRAKING_RATE, _LARGEST_RATE_PER_TICK / control_period)
        outputs = ComputedTorqueLaw.default_outputs(robot, "")
        # Only the damping acts: the reference is always where the joints are.
        self._law = ComputedTorqueLaw(robot, outputs, Gains.uniform(1.0, rate))
        self._plant = plant

    def efforts(self) -> Array:
        """Return the efforts (n,) to hold for the next tick, N or N m, before limits."""
        plant = self._plant
        state = ControlState(
            plant.pose[:3], plant.pose[3:], plant.twist[:3], plant.twist[3:], plant.q, plant.qdot
        )
        return self._law.command(state, Reference(joints=JointReference.at_rest(plant.q))).tau


_UNNUMBERED = 2**63
"""Middleware that does not number messages reports a larger number."""

_MOST_PUBLISHERS = 100
"""Largest number of publishers that are remembered."""


class Senders:
    """Tells the publishers of one topic apart, by the numbers that each gives its messages.

    A publisher numbers its messages one by one, so a message belongs to the publisher whose last
    one has the number before. Other numbers are those of a publisher that has not sent before, or
    was started again. A publisher that comes back after another has sent, and was not silent
    meanwhile, shares the topic with it; one that takes over for good does not.

    Parameters
    ----------
    silence_ns
        Simulated time without a message after which a publisher has handed over, ns.

    Attributes
    ----------
    current
        A number for the publisher of the last message; None where the middleware numbers nothing.
    multiple_publishers
        Whether that publisher and another one send by turns.
    """

    def __init__(self, silence_ns: int) -> None:
        self.current: int | None = None
        self.multiple_publishers = False
        self._silence = silence_ns
        self._next = -1
        self._heard = 0
        self._publishers = 0
        self._others: dict[int, tuple[int, int]] = {}
        """Of publishers that another one has followed, by their next number: which, and when."""

    def note(self, number: int, now_ns: int) -> None:
        """Note the number of a message that comes at a simulated time (ns)."""
        if number == self._next:
            self._next, self._heard, self.multiple_publishers = number + 1, now_ns, False
            return
        if not 0 < number < _UNNUMBERED:
            self.current = None
            return
        if self.current is not None:
            self._others[self._next] = self.current, self._heard
        publisher, heard = self._others.pop(number, (0, 0))
        self.multiple_publishers = bool(publisher) and now_ns - heard <= self._silence
        if not publisher:
            self._publishers = publisher = self._publishers + 1
        if len(self._others) > _MOST_PUBLISHERS:
            del self._others[next(iter(self._others))]
        self.current, self._next, self._heard = publisher, number + 1, now_ns
