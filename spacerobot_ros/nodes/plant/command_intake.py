"""Which commands reach a plant's actuators: each is judged by its tick, or by the clock."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rclpy.node import Node

from spacerobot_ros.model.description import Array
from spacerobot_ros.nodes.common.cdr import NANOSECONDS, UnreadableError
from spacerobot_ros.nodes.plant.command_channel import NEVER, CommandChannel, Refused
from spacerobot_ros.nodes.plant.command_gate import CommandGate, Reason
from spacerobot_ros.nodes.plant.diagnostics import PlantReport

_START = 1.0
"""How long a stamp of zero is that of the first state where commands never grow old, s."""


class CommandIntake:
    """The command channels of one plant behind their gate.

    In lockstep the command of a tick is the one stamped with it, and the first such; in real time
    the last one holds until it is older than ``command_timeout``.

    Parameters
    ----------
    node
        Whose topics they are.
    channels
        The joints' first; the others are waited for in lockstep only while somebody commands them.
    gate, report
        Count and tell what is refused.
    parameters
        Of the plant node.
    """

    def __init__(
        self,
        node: Node,
        channels: Sequence[CommandChannel],
        gate: CommandGate,
        report: PlantReport,
        parameters: Mapping[str, Any],
    ) -> None:
        self.channels = channels
        self._node, self._gate, self._report = node, gate, report
        self._commands = [channel.command for channel in channels]
        for channel in channels:
            channel.refuses_beyond_limits = parameters["beyond_limits"] == "refuse"
        self._one_commander = parameters["second_commander"] == "refuse"
        self._timeout = float(parameters["command_timeout"])
        self._lockstep = parameters["time_mode"] == "lockstep"

    @property
    def joints_rest(self) -> bool:
        """Whether the joints were commanded and are no more."""
        return self.channels[0].resting

    @property
    def complete(self) -> bool:
        """Whether every command that a lockstep plant waits for is there."""
        # Twice as fast as all() over a generator, and asked every tick.
        for channel in self.channels:  # noqa: SIM110
            if channel.required and not channel.arrived:
                return False
        return True

    def begin_step(self) -> list[Array]:
        """Return the commands to step under, a writable array for each channel."""
        for channel in self.channels:
            channel.arrived = False
        return self._commands

    def rest(self) -> None:
        """Command nothing any more."""
        for channel in self.channels:
            channel.rest()
            channel.arrived = False

    def latch(self, sentence: str) -> None:
        """Bring everything to rest until the gate is rearmed."""
        self._gate.latch(sentence)
        for channel in self.channels:
            arrived = channel.arrived
            channel.rest()
            channel.arrived = arrived
        self._node.get_logger().error(
            f"A fault is latched: {self._gate.fault}. Nothing moves until '~/rearm' is called."
        )

    def count_commanders(self) -> None:
        """See how many publish on each topic."""
        for channel in self.channels:
            channel.commanders = self._node.count_publishers(channel.topic)

    def look_round(self) -> None:
        """See who commands what: the joints are always waited for, a wrench if one comes."""
        self.count_commanders()
        for channel in self.channels[1:]:
            channel.required = channel.commanders > 0
            if not channel.required:
                # Nobody is left who could turn the thrusters off.
                channel.rest()
                channel.arrived = False

    def drop_old(self, now_ns: int) -> None:
        """Bring to rest what nobody has commanded for the timeout."""
        for channel in self.channels:
            age = now_ns - channel.stamp_ns
            if self._timeout and channel.stamp_ns != NEVER and age > self._timeout * NANOSECONDS:
                channel.rest()
                self._report.timed_out(channel.topic, self._timeout)

    def accept(self, channel: CommandChannel, raw: bytes, now_ns: int) -> bool:
        """Take or refuse a command; return whether it is this tick's answer in lockstep."""
        try:
            stamp, refused = channel.check(raw)
        except UnreadableError as error:
            # It has no stamp, and so is no answer to any tick.
            self._refuse(channel, (Reason.MALFORMED, str(error)))
            return False
        if self._lockstep:
            if stamp != now_ns or channel.arrived:
                self._refuse(channel, _not_this_tick(stamp, now_ns))
                return False
        else:
            if not stamp and now_ns > (self._timeout or _START) * NANOSECONDS:
                stamp = now_ns  # An unset stamp means now; at the start it is the first state's.
            refused = self._untimely(channel, stamp, now_ns) or refused
        if refused is None and self._gate.fault:
            refused = Reason.LATCHED, self._gate.fault
        if refused is None:
            channel.take(stamp)
        else:
            self._refuse(channel, refused)
            if self._lockstep:
                # Time must go on for the others: a bad command is a tick at rest.
                channel.rest()
        return self._lockstep

    def _untimely(self, channel: CommandChannel, stamp: int, now_ns: int) -> Refused | None:
        """Return why a command does not belong to this moment of real time, if it does not."""
        age = (now_ns - stamp) / NANOSECONDS
        if self._timeout and age > self._timeout:
            return Reason.STALE, f"it is {age:.3g} s old"
        if self._timeout and -age > self._timeout:
            return Reason.EARLY, f"it is {-age:.3g} s ahead of time"
        late = (channel.stamp_ns - stamp) / NANOSECONDS
        if late > 0:
            return Reason.OUT_OF_ORDER, f"it is {late:.3g} s older than the one in force"
        if late == 0 and channel.commanders > 1 and self._one_commander:
            return (
                Reason.SECOND_COMMANDER,
                f"the same state was answered before, and {channel.commanders} nodes command",
            )
        return None

    def _refuse(self, channel: CommandChannel, refused: Refused) -> None:
        """Count a refused command; where its reason latches, everything comes to rest."""
        reason, clause = refused
        before = self._gate.fault
        self._gate.refuse(reason, f"a command on '{channel.topic}' was refused: {clause}")
        self._report.refused(channel.topic, clause)
        if self._gate.fault and not before:
            self.latch(self._gate.fault)


def _not_this_tick(stamp: int, now_ns: int) -> Refused:
    early = stamp > now_ns
    return (
        Reason.EARLY if early else Reason.STALE,
        f"it is {'ahead of time' if early else 'stale'}: stamped {stamp / NANOSECONDS:.9g} s, the "
        f"plant is at {now_ns / NANOSECONDS:.9g} s",
    )
