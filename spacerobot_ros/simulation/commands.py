"""Command validation: the rules by which a plant accepts commands, used by its node and for
checking bags.

A command comes from a *source* (one topic) and consists of values and the stamp of a state.
In lockstep, the first command with a tick's stamp applies to that tick; if it is refused, the
joints rest during the tick. In real time, a command may carry the stamp of any recent state, and
remains active until the timeout; only one publisher may send commands.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from enum import Enum
from typing import Literal

import numpy as np
import numpy.typing as npt

from spacerobot_ros.errors import CommandError, ParameterError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.wheels import ReactionWheels
from spacerobot_ros.simulation.config import PlantConfig
from spacerobot_ros.simulation.plant import Plant
from spacerobot_ros.times import SECOND

NO_STAMP = -math.inf
"""The stamp that represents a missing command."""


_START_TIME = 1.0
"""Duration, in s, for which a zero stamp refers to the first state if there is no timeout."""

_STAMP_ROUNDING = 1_000
"""Allowed rounding error in stamps from commanders with floating-point time, ns."""

_OUTDATED_STATE_CLAUSE = "it is for a state before the last start, reset or stop of the plant"

_BRAKING_RATE = 20.0
"""Joint rates decay as exp(-20 t), with t in s, while the motors are strong enough."""

_MAX_RATE_PER_TICK = 0.5
"""A held effort must not stop a joint in less than two ticks, or the joint would swing back."""

Quantity = Literal["velocity", "effort", "wrench"]


class Reason(str, Enum):
    """Reason for refusing a command; its value appears in parameters and diagnostics."""

    MALFORMED = "malformed"
    """Unknown or missing joints, wrong lengths, or a wrong frame."""
    NOT_FINITE = "not_finite"
    STALE = "stale"
    EARLY = "early"
    """Stamped ahead of plant time."""
    UNKNOWN_STATE = "unknown_state"
    """Stamped between two ticks."""
    OUT_OF_ORDER = "out_of_order"
    """Stamped before the active command."""
    BEYOND_LIMITS = "beyond_limits"
    SECOND_COMMANDER = "second_commander"
    """Another node has already sent a command for the same state."""
    LATCHED = "latched"
    """A fault is latched: joints brake and thrusters are off until the plant is rearmed."""


@dataclass(frozen=True)
class Refusal:
    """Refusal of a command.

    Attributes
    ----------
    reason
        Its reason.
    clause
        The reason as a clause, with numbers and names; it completes "the command was refused:".
    latches
        Whether the refusal latched a fault: joints brake and thrusters are off until the plant is
        rearmed.
    """

    reason: Reason
    clause: str
    latches: bool = False


class CommandSource:
    """One topic that commands a plant.

    Attributes
    ----------
    topic
        Topic name, relative to the robot's namespace.
    quantity
        Quantity of its commands.
    limits
        (size,) maximum magnitude of each value.
    kept
        Indices of the values that stay active if a command is revoked: reaction wheel rates,
        because stopping the wheels would rotate the base.
    command
        (size,) active command: for the joints (m/s, rad/s, N or N m), or force (N) and torque (N
        m) at the base link origin, in the base frame.
    stamp_ns
        Stamp of the active command; :data:`NO_STAMP` if there is none.
    arrived
        Whether the command for this tick has arrived, accepted or not (lockstep).
    resting
        Whether the last command was revoked, so that the joints are brought to rest.
    required
        Whether a lockstep plant waits for this source's commands.
    commanders
        Number of known publishers on the topic.
    """

    def __init__(
        self,
        topic: str,
        quantity: Quantity,
        limits: Array,
        kept: npt.NDArray[np.int64] | None = None,
    ) -> None:
        self.topic, self.quantity, self.limits = topic, quantity, limits
        self.kept = np.zeros(0, dtype=np.int64) if kept is None else kept
        self.command: Array = np.zeros(len(limits))
        self.stamp_ns: float = NO_STAMP
        self.arrived = self.resting = False
        self.required = True
        self.commanders = 1

    def rest(self) -> None:
        """Revoke the active command."""
        kept = self.command[self.kept]
        self.command[:] = 0.0
        self.command[self.kept] = kept
        self.stamp_ns = NO_STAMP
        self.resting = True

    def accept(self, values: Array, stamp_ns: float) -> None:
        """Activate a command."""
        self.command[:] = values
        self.stamp_ns = stamp_ns
        self.arrived = True
        self.resting = False


class CommandValidator:
    """Accepts or refuses commands to a plant, counts refusals, and latches faults.

    Parameters
    ----------
    plant
        The commanded plant.
    config
        The plant configuration: time mode, timeout, limits, and the reasons that latch a fault.

    Raises
    ------
    ParameterError
        ``latched_faults`` contains an unknown word.
    """

    def __init__(self, plant: Plant, config: PlantConfig) -> None:
        robot = plant.robot
        kept = ReactionWheels.of(robot.description).index
        self.sources = [CommandSource("joint_commands", "velocity", robot.velocity_limit, kept)]
        """Sources in the order of the step arguments: joints first."""
        self._brakes: _JointBrakes | None = None
        if config.actuation == "effort":
            self.sources = [
                CommandSource("joint_commands", "effort", robot.effort_limit),
                CommandSource("base_wrench", "wrench", np.full(6, np.inf)),
            ]
            # Velocity servos stop immediately; motors have to brake.
            self._brakes = _JointBrakes(plant, config.control_period)
        self._commands = [source.command for source in self.sources]
        self._lockstep = config.time_mode == "lockstep"
        self._timeout, self._period = config.command_timeout, config.period_ns
        self._earliest = 0
        self._clips = config.beyond_limits == "clip"
        self._one_commander = config.second_commander == "refuse"
        self._latching = _parse_latching_reasons(config.latched_faults)
        self.counts: Counter[Reason] = Counter()
        """Number of refused commands by reason."""
        self.fault = ""
        """The latched fault, as a clause; empty if there is none."""
        self.fault_reason = ""
        """Reason for the latched fault: the value of a :class:`Reason`, ``abort``, or
        ``watchdog``."""
        self.timed_out = False
        """Whether the last command was revoked because it was too old."""
        self.timeouts = 0
        """Number of such revocations."""
        self.last_stamp_ns: float = NO_STAMP
        """Stamp of the last command before the most recent timeout."""

    def succeed(self, before: CommandValidator) -> None:
        """Take over the faults and counters of the plant's previous validator."""
        self.counts, self.timeouts = before.counts, before.timeouts
        self.fault, self.fault_reason = before.fault, before.fault_reason
        self.last_stamp_ns, self._earliest = before.last_stamp_ns, before._earliest

    @property
    def complete(self) -> bool:
        """Whether all commands that a lockstep plant waits for have arrived."""
        return all(source.arrived or not source.required for source in self.sources)

    @property
    def in_force(self) -> bool:
        """Whether a command from any source is active."""
        return any(source.stamp_ns != NO_STAMP for source in self.sources)

    def accept_or_refuse(
        self, source: CommandSource, stamp_ns: int, values: Array | CommandError, now_ns: int
    ) -> Refusal | None:
        """Accept or refuse a command.

        Parameters
        ----------
        source
            Its source.
        stamp_ns
            Its stamp.
        values
            Its values, or the error if the message is malformed.
        now_ns
            Simulated time of the plant's state.

        Returns
        -------
        Refusal or None The refusal; None if the command was accepted.
        """
        unset = False
        if self._lockstep:
            if stamp_ns != now_ns or source.arrived:
                early = stamp_ns > now_ns
                clause = (
                    f"it is {'ahead of time' if early else 'stale'}: stamped "
                    f"{stamp_ns / SECOND:.9g} s, while the plant is at {now_ns / SECOND:.9g} s"
                )
                reason = Reason.EARLY if early else Reason.STALE
                return self._refuse(source, Refusal(reason, clause), now_ns)
            refusal = self._refusal_of_values(source, values)
        else:
            if not stamp_ns and (
                self._earliest or now_ns > (self._timeout or _START_TIME) * SECOND
            ):
                # A stamp of zero means the current state, at the start the first state.
                stamp_ns, unset = now_ns, True
            elif stamp_ns % self._period:
                # The stamp of the nearest tick, if the difference is rounding only.
                tick = (stamp_ns + self._period // 2) // self._period * self._period
                stamp_ns = tick if abs(stamp_ns - tick) <= _STAMP_ROUNDING else stamp_ns
            refusal = self._refusal_of_stamp(source, stamp_ns, now_ns) or self._refusal_of_values(
                source, values
            )
        if refusal is None and self.fault:
            refusal = Refusal(Reason.LATCHED, f"the plant is latched: {self.fault}")
        if stamp_ns < self._earliest and refusal is None and not unset:
            refusal = Refusal(Reason.STALE, _OUTDATED_STATE_CLAUSE)
        if refusal is None:
            assert not isinstance(values, CommandError)
            source.accept(values, stamp_ns)
            return None
        refusal = self._refuse(source, refusal, now_ns)
        if self._lockstep:
            # Time must advance: a tick with a refused command is executed at rest.
            source.rest()
            source.arrived = True
        return refusal

    def unreadable(self, source: CommandSource, error: CommandError, now_ns: int) -> Refusal:
        """Refuse bytes that cannot be decoded as a message; since they have no stamp, they belong
        to no tick."""
        return self._refuse(source, Refusal(Reason.MALFORMED, str(error)), now_ns)

    def begin_step(self) -> list[Array]:
        """Return the commands for the next step, one writable array per source."""
        for source in self.sources:
            source.arrived = False
        if self._brakes is not None and self.sources[0].resting:
            self._commands[0][:] = self._brakes.efforts()
        return self._commands

    def revoke_before(self, now_ns: int) -> None:
        """Revoke all commands, and accept only commands stamped ``now_ns`` or later."""
        self.rest()
        self._earliest = now_ns

    def reset(self, now_ns: int) -> None:
        """Restart (:meth:`revoke_before`) with the plant's wheels at rest, as in the initial
        state."""
        for source in self.sources:
            source.command[:] = 0.0
        self.revoke_before(now_ns)

    def rest(self) -> None:
        """Revoke all commands."""
        self.timed_out = False
        for source in self.sources:
            source.rest()
            source.arrived = False

    def latch(self, reason: str, clause: str, now_ns: int) -> None:
        """Brake the joints and turn off the thrusters until :meth:`rearm`; the first of several
        faults is reported.

        Commands for states before the fault are refused even after :meth:`rearm`.

        Parameters
        ----------
        reason
            The value of a :class:`Reason`, ``abort`` or ``watchdog``.
        clause
            The fault as text; it completes "a fault is latched:".
        now_ns
            Simulated time of the plant's state.
        """
        if not self.fault:
            self.fault, self.fault_reason = clause, reason
            self._earliest = now_ns + self._period
        self.timed_out = False
        for source in self.sources:
            source.rest()

    def rearm(self) -> str:
        """Accept commands again, and return the latched fault; empty if there was none."""
        fault, self.fault, self.fault_reason = self.fault, "", ""
        return fault

    def require_commanded(self) -> None:
        """Require wrench commands only while a node publishes them; joint commands are always
        awaited."""
        for source in self.sources[1:]:
            source.required = source.commanders > 0
            if not source.required:
                # Without a commander, nothing would turn the thrusters off.
                source.rest()
                source.arrived = False

    def drop_old(self, now_ns: int) -> list[CommandSource]:
        """Revoke commands older than the timeout, and return the sources of these commands."""
        silent, last = [], NO_STAMP
        for source in self.sources:
            age = now_ns - source.stamp_ns
            if self._timeout and source.stamp_ns != NO_STAMP and age > self._timeout * SECOND:
                last = max(last, source.stamp_ns)
                source.rest()
                silent.append(source)
        self.timed_out = self.timed_out or bool(silent)
        if silent and not self.in_force:
            self.timeouts += 1
            self.last_stamp_ns = last
        return silent

    def _refusal_of_values(
        self, source: CommandSource, values: Array | CommandError
    ) -> Refusal | None:
        if isinstance(values, CommandError):
            return Refusal(Reason.MALFORMED, str(values))
        # A sum is finite only if all its terms are; summing a list is fastest for few numbers.
        if not math.isfinite(sum(values.tolist())):
            return Refusal(Reason.NOT_FINITE, f"a value is not finite: {values.tolist()}")
        if not self._clips and np.any(np.abs(values) > source.limits):
            limits = f"{values.tolist()} exceeds the limits {source.limits.tolist()}"
            return Refusal(Reason.BEYOND_LIMITS, limits)
        return None

    def _refusal_of_stamp(
        self, source: CommandSource, stamp_ns: int, now_ns: int
    ) -> Refusal | None:
        """Return the refusal of a command whose stamp is unsuitable in real time, or None."""
        age = (now_ns - stamp_ns) / SECOND
        if self._timeout and age > self._timeout:
            return Refusal(Reason.STALE, f"it is {age:.3g} s old")
        if age < 0:
            return Refusal(Reason.EARLY, f"it is {-age:.3g} s ahead of time")
        if stamp_ns % self._period:
            period = self._period / SECOND
            return Refusal(
                Reason.UNKNOWN_STATE,
                f"it is stamped {stamp_ns / SECOND:.9g} s, but state stamps are multiples of "
                f"{period:.9g} s",
            )
        late = (source.stamp_ns - stamp_ns) / SECOND
        if late > 0:
            return Refusal(Reason.OUT_OF_ORDER, f"it is {late:.3g} s older than the active command")
        if late == 0 and source.commanders > 1 and self._one_commander:
            return Refusal(
                Reason.SECOND_COMMANDER,
                f"a command for the same state is active, and {source.commanders} nodes send "
                "commands",
            )
        return None

    def _refuse(self, source: CommandSource, refusal: Refusal, now_ns: int) -> Refusal:
        self.counts[refusal.reason] += 1
        if refusal.reason not in self._latching or self.fault:
            return refusal
        clause = f"a command on '{source.topic}' was refused: {refusal.clause}"
        self.latch(refusal.reason.value, clause, now_ns)
        return Refusal(refusal.reason, refusal.clause, latches=True)


def _parse_latching_reasons(words: str) -> frozenset[Reason]:
    known = [reason.value for reason in Reason if reason is not Reason.LATCHED]
    for word in words.split():
        if word not in known:
            raise ParameterError(
                f"Parameter 'latched_faults' has '{word}'; it accepts {', '.join(known)}, "
                "separated by spaces."
            )
    return frozenset(Reason(word) for word in words.split())


class _JointBrakes:
    """Efforts that brake the joints of a plant: internal forces, which keep its momenta."""

    def __init__(self, plant: Plant, control_period: float) -> None:
        robot: SpaceRobot = plant.robot
        self._rate = min(_BRAKING_RATE, _MAX_RATE_PER_TICK / control_period)
        self._braked: slice | npt.NDArray[np.int64] = slice(None)
        self._efforts = np.zeros(robot.n)
        if robot.description.wheel_names:
            wheels = ReactionWheels.of(robot.description)
            robot, self._braked = robot.derived(wheels.gyrostat), wheels.other
        self._inertia, self._bias = robot.buffered("inertia_matrix"), robot.buffered("bias")
        self._plant = plant

    def efforts(self) -> Array:
        """Return the efforts (n,) for the next tick, N or N m, before limits are applied.

        The joint rows of ``H+ z0ddot + C+ = Q`` (paper 4, eq. 19), with base motion eliminated.
        """
        q, qdot = self._plant.q[self._braked], self._plant.qdot[self._braked]
        (H,), (C,) = self._inertia(q), self._bias(q, np.zeros(3), self._plant.twist[3:], qdot)
        qddot = -self._rate * qdot
        omega_dot = -np.linalg.solve(H[3:6, 3:6], H[3:6, 6:] @ qddot + C[3:6])
        self._efforts[self._braked] = H[6:, 6:] @ qddot + H[6:, 3:6] @ omega_dot + C[6:]
        return self._efforts
