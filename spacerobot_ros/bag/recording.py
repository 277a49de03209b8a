"""Recording of serialised messages: bag time base, latched topics and failures."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from enum import Enum
from typing import NamedTuple

from spacerobot_ros.bag.writer import BagWriter
from spacerobot_ros.errors import RecordingError, RobotDescriptionError
from spacerobot_ros.times import SECOND


class RecordingState(Enum):
    """What a recorder does with incoming messages."""

    PAUSED = "paused"
    """Messages are dropped; the last message of each latched topic is kept until recording
    starts."""

    WAITING = "waiting"
    """Messages are kept in memory until it is known whether a clock is published."""

    ON_CLOCK = "on clock"
    """Messages are written with the published clock time."""

    ON_WALL_TIME = "on wall time"
    """Messages are written with the wall time of their arrival."""

    FAILED = "failed"
    """Messages are dropped because the disk is full or no longer available; earlier messages are
    kept."""

    CLOSED = "closed"
    """Messages are dropped because the bag is complete."""


_DROPPING_STATES = (RecordingState.PAUSED, RecordingState.FAILED, RecordingState.CLOSED)


_MAX_EARLY_MESSAGES = 5000
"""Number of messages kept in memory from which on a bag no longer waits for a clock."""


class _EarlyMessage(NamedTuple):
    """A message received before the bag's time base was chosen."""

    channel: int
    message: bytes
    published_ns: int
    arrival_ns: int


class Recording:
    """Writes messages with one time base for the whole bag; recording is initially paused.

    Messages are logged at the published clock time; earlier messages are logged at the time of the
    first clock message. If no clock is published for ``clock_wait``, or too many messages wait for
    one, all messages are logged at the wall time of their arrival. The choice is final, because a
    bag has one time base.

    Parameters
    ----------
    writer
        The bag, which is closed together with the recording.
    clock_wait
        Longest time that the first message waits for a clock, wall time in s; messages on
        preliminary channels wait with it.
    on_failure
        Called once, with the reason, if writing fails.
    wall_time
        Returns the wall time in ns.
    """

    def __init__(
        self,
        writer: BagWriter,
        clock_wait: float,
        on_failure: Callable[[RecordingError], None] = lambda error: None,
        wall_time: Callable[[], int] = time.time_ns,
    ) -> None:
        self.writer = writer
        self.state = RecordingState.PAUSED
        self.now_ns = 0
        """Latest clock time, or arrival time of the latest message, ns."""
        self.messages = 0
        """Number of messages written to the bag."""
        self.clock_steps_back = 0
        """Number of backward clock jumps: one jump after a restart, many jumps if there are two
        clocks."""
        self.lost: Counter[str] = Counter()
        """Number of messages on each topic that were published but never received."""
        self.attached: set[str] = set()
        """Names of the files attached to the bag."""
        self.preliminary: set[int] = set()
        """Channels of messages that other nodes publish before a plant starts: they do not start
        the wait for its clock."""
        self.latched: dict[int, _EarlyMessage | None] = {}
        """Last message of each latched topic received during a pause, by channel."""
        self.failure: RecordingError | None = None
        self._clock_wait_ns = clock_wait * SECOND
        self._on_failure = on_failure
        self._wall_time = wall_time
        self.early_messages: list[_EarlyMessage] = []
        """Messages kept until the bag's time base is chosen."""
        self._time_base: RecordingState | None = None

    @property
    def running(self) -> bool:
        """Whether messages are recorded."""
        return self.state not in _DROPPING_STATES

    def start(self) -> None:
        """Start recording, including the last earlier message of every latched topic."""
        if self.state is not RecordingState.PAUSED:
            return
        self.state = self._time_base or RecordingState.WAITING
        for channel, last in self.latched.items():
            self.latched[channel] = None
            if last is not None:
                self.record(channel, last.message, last.published_ns)

    def pause(self) -> None:
        """Pause recording until the next start."""
        if self.running:
            self.state = RecordingState.PAUSED

    def set_clock(self, time_ns: int) -> None:
        """Set the clock time; has no effect once the bag uses wall time."""
        if self._time_base is RecordingState.ON_WALL_TIME:
            return
        self.clock_steps_back += time_ns < self.now_ns
        self.now_ns = time_ns
        if self.state is RecordingState.WAITING:
            self._choose_time_base(RecordingState.ON_CLOCK)

    def record(self, channel: int, message: bytes, published_ns: int = 0) -> None:
        """Write a message, or keep it until the bag's time base is chosen.

        ``published_ns`` is the publication time of the message; 0 selects the recording time.
        """
        if self.state is not RecordingState.ON_CLOCK:
            arrived = _EarlyMessage(channel, message, published_ns, self._wall_time())
            if self.state is RecordingState.PAUSED and channel in self.latched:
                self.latched[channel] = arrived
            elif self.state is RecordingState.WAITING:
                self.early_messages.append(arrived)
            if self.state is not RecordingState.ON_WALL_TIME:
                return
            self.now_ns = arrived.arrival_ns
        self._write(channel, message, self.now_ns, published_ns or self.now_ns)

    def _write(self, channel: int, message: bytes, log_ns: int, published_ns: int) -> None:
        try:
            self.writer.write(channel, message, log_ns, published_ns)
        except RecordingError as error:
            self._fail(error)
            return
        self.messages += 1

    def flush(self, clock_is_published: bool) -> None:
        """Write buffered data to the file once per flush period (wall time)."""
        first = next((x for x in self.early_messages if x.channel not in self.preliminary), None)
        waited_ns = self._wall_time() - first.arrival_ns if first is not None else 0
        late = waited_ns > self._clock_wait_ns and not clock_is_published
        if late or len(self.early_messages) >= _MAX_EARLY_MESSAGES:
            self._choose_time_base(RecordingState.ON_WALL_TIME)
        self._fail_on_error(self.writer.flush)

    def check(self) -> None:
        """Check that the bag file still exists and has its full size."""
        self._fail_on_error(self.writer.check)

    def describe(self, name: str, values: dict[str, str]) -> None:
        """Write named values into the bag."""
        self._fail_on_error(lambda: self.writer.add_metadata(name, values))

    def attach_robot(self, name: str, urdf: bytes) -> None:
        """Attach a robot description, and its meshes if they exist on this machine."""
        # Importing the robot model doubles the import time of this module.
        from spacerobot_ros.model.meshes import meshes_for_bag
        from spacerobot_ros.model.urdf import parse_robot

        self.attach(name, urdf, "application/xml")
        if b"<mesh" in urdf:
            with suppress(RobotDescriptionError, UnicodeDecodeError):
                for mesh, data in meshes_for_bag(parse_robot(urdf.decode())).items():
                    self.attach(mesh, data, "model/stl")

    def attach(self, name: str, data: bytes, media_type: str) -> None:
        """Attach a file to the bag."""
        self.attached.add(name)
        self._fail_on_error(lambda: self.writer.add_attachment(name, data, media_type, self.now_ns))

    def close(self) -> None:
        """Write the remaining data and the message counts, and complete the bag if this has not
        been done yet.

        Raises
        ------
        RecordingError
            Writing failed, and no earlier call reported it.
        """
        if self.state is RecordingState.CLOSED:
            return
        self._choose_time_base(RecordingState.ON_WALL_TIME)
        counts = {"messages": self.messages, "messages_lost": self.lost.total()}
        self.describe("recorder", {name: str(count) for name, count in counts.items()})
        self.check()
        self.state = RecordingState.CLOSED
        try:
            self.writer.close()
        except RecordingError as error:
            self.failure = error
            raise

    def _choose_time_base(self, state: RecordingState) -> None:
        """Choose the bag's time base unless already chosen, and write the early messages."""
        if self._time_base is not None or self.failure is not None:
            return
        self._time_base = state
        if self.state is RecordingState.WAITING:
            self.state = state
        on_clock = state is RecordingState.ON_CLOCK
        early, self.early_messages = self.early_messages, []
        for channel, message, published_ns, arrival_ns in early:
            if self.failure is None:
                log_ns = self.now_ns if on_clock else arrival_ns
                self._write(channel, message, log_ns, published_ns or log_ns)

    def _fail_on_error(self, act: Callable[[], None]) -> None:
        if self.failure is None and self.state is not RecordingState.CLOSED:
            try:
                act()
            except RecordingError as error:
                self._fail(error)

    def _fail(self, error: RecordingError) -> None:
        self.failure, self.state = error, RecordingState.FAILED
        self._on_failure(error)
