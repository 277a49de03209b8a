"""Determines when replayed messages are due, without a clock or a publisher."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain, islice, starmap

from spacerobot_ros.bag import ReplayConfig
from spacerobot_ros.bag.mcap_file import QosProfile, RecordedTopic
from spacerobot_ros.bag.mcap_reading import LATEST_TIME_NS
from spacerobot_ros.bag.reader import Bag
from spacerobot_ros.errors import ParameterError, RecordingError
from spacerobot_ros.events import SECONDS, KeyValueField, KeyValueFormat, number_format
from spacerobot_ros.times import SECOND

_MAX_AGE_REPUBLISHED_AFTER_SEEK_NS = SECOND

_DEFAULTS = ReplayConfig()

_MAX_REPLAYED_TOPICS = 1000
"""Largest number of replayed topics: each requires a publisher, memory and discovery."""


@dataclass(frozen=True)
class ReplayStatus:
    """Replay state, as published on replay/status.

    Attributes
    ----------
    position_s, duration_s
        Replay time since the first message, and time from the first to the last message, s.
    state
        ``playing``, ``paused``, or ``ended`` if all messages have been published.
    rate
        Bag seconds per second of wall time.
    """

    position_s: float
    duration_s: float
    state: str
    rate: float

    def to_values(self) -> dict[str, str]:
        """Return the status as the key-value pairs of a DiagnosticStatus."""
        return _STATUS_FORMAT.to_values(self)

    @classmethod
    def from_values(cls, values: Mapping[str, str]) -> ReplayStatus:
        """Return the status from the pairs of :meth:`to_values`.

        Raises
        ------
        SpaceRobotError
            The pairs are not a replay status.
        """
        return _STATUS_FORMAT.from_values(cls, values)


_STATUS_FORMAT = KeyValueFormat(
    "status of a replay",
    KeyValueField("state"),
    KeyValueField("position_s", SECONDS),
    KeyValueField("duration_s", SECONDS),
    KeyValueField("rate", number_format(".9g")),
)


@dataclass(frozen=True)
class ReplayMessage:
    """One message to publish: its topic in the bag, its log time (ns) and its serialised form."""

    topic: str
    log_time_ns: int
    data: bytes


class SubscriberWait:
    """Decides when a replay may start: when all known subscribers are matched and no new
    subscribers appear.

    Parameters
    ----------
    period
        Time between checks, s.
    longest
        Longest wait, s.
    settled
        Time, in s, after which no more subscribers are expected if no new one appears.
    """

    def __init__(self, period: float, longest: float, settled: float = 0.3) -> None:
        self._period, self._longest, self._settled = period, longest, settled
        self._readers = 0
        self._waited = self._quiet = 0.0

    def may_begin(self, matched: Sequence[int], known: Sequence[int]) -> bool:
        """Return whether to start, given the numbers of matched and known subscribers by topic."""
        readers = sum(matched)
        self._waited += self._period
        self._quiet = self._quiet + self._period if readers == self._readers else 0.0
        self._readers = readers
        settled = readers > 0 and self._quiet >= self._settled and matched == known
        return settled or self._waited >= self._longest


def renamed_topics(remap: str, topics: Collection[str]) -> dict[str, str]:
    """Return the new name of each topic that ``remap`` (``old:=new``, separated by spaces) renames.

    Raises
    ------
    ParameterError
        A rule is malformed, or names a topic that is not in ``topics``.
    """
    names = {}
    for rule in remap.split():
        old, separator, new = rule.partition(":=")
        if not (old and separator and new):
            raise ParameterError(
                f"Parameter 'remap' has '{rule}'; write it as 'old:=new', such as "
                "'/odom:=/replayed/odom'."
            )
        old = _with_slash(old)
        if old not in topics:
            raise ParameterError(
                f"Parameter 'remap' renames '{old}', which is not replayed; the replayed topics "
                f"are {', '.join(sorted(topics))}."
            )
        names[old] = new
    return names


class Playback:
    """Messages in a bag, scheduled by log time.

    The last message on each latched topic before the start time is due immediately:
    subscribers to a latched topic always expect its last message.

    Parameters
    ----------
    bag
        What to play.
    config
        Topics, time span and rate, and whether to restart at the end.

    Raises
    ------
    RecordingError
        A topic is not in the bag, or there is no message to replay.
    """

    def __init__(self, bag: Bag, config: ReplayConfig = _DEFAULTS) -> None:
        topics, start, duration = config.topics.split(), config.start, config.duration
        if not bag.message_count():
            raise RecordingError(f"The bag {bag.path} has no messages to replay.")
        if len(topics or bag.topics) > _MAX_REPLAYED_TOPICS:
            raise RecordingError(
                f"The bag {bag.path} has {len(bag.topics)} topics, but only "
                f"{_MAX_REPLAYED_TOPICS} can be replayed at once: name the topics to replay."
            )
        self._bag = bag
        self._loop, self._rate = config.loop, config.rate
        self.start_ns = min(bag.start_time_ns + round(start * SECOND), LATEST_TIME_NS)
        """Log time at which the replay starts, ns."""
        end_ns = self.start_ns + round(duration * SECOND) if duration else LATEST_TIME_NS
        self._end_ns = min(end_ns, LATEST_TIME_NS)
        self._last_ns = max(min(bag.end_time_ns, self._end_ns), self.start_ns)
        self.duration_s = (self._last_ns - self.start_ns) / SECOND
        """Time from the first to the last replayed message, s."""
        self._names = [_with_slash(name) for name in topics or bag.topics]
        profiles = {name: [*bag.qos(name), QosProfile()][0] for name in self._names}
        self.topics = [RecordedTopic(name, bag.topics[name], profiles[name]) for name in profiles]
        """The topics to publish."""
        self._bag_ns = self.start_ns
        self._clock_ns: int | None = None
        """Clock time at bag time `_bag_ns`; None if bag time is paused."""
        self._begin()
        if self._next_message is None:
            raise RecordingError(
                f"The bag {bag.path} has no message to replay from {start:g} s"
                + (f" for {duration:g} s" if duration else "")
                + f": it lasts {(bag.end_time_ns - bag.start_time_ns) / SECOND:g} s."
            )

    @property
    def ended(self) -> bool:
        """Whether all messages have been replayed."""
        return self._next_message is None

    def bag_time(self, clock_ns: int) -> int:
        """Return the bag time, in nanoseconds, at clock time ``clock_ns``."""
        now = self._time(clock_ns)
        if self._next_message is None:
            return now
        # Pending messages are published late, not skipped.
        return min(now, max(self._next_message.log_time_ns, self.start_ns))

    def run(self, clock_ns: int) -> None:
        """Start or resume the replay; ``clock_ns`` is the current clock time."""
        if self._clock_ns is None:
            self._clock_ns = clock_ns

    def pause(self, clock_ns: int) -> None:
        """Pause the replay; ``clock_ns`` is the current clock time."""
        self._bag_ns, self._clock_ns = self._time(clock_ns), None

    def take_due(self, clock_ns: int, max_count: int) -> Iterator[ReplayMessage]:
        """Iterate over the messages that are due, at most ``max_count``.

        Raises
        ------
        RecordingError
            The bag is damaged.
        """
        for _ in range(max_count):
            due = self.next_due_time()
            if due is None or due > clock_ns:
                return
            yield self._take_next_message()

    def next_due_time(self) -> int | None:
        """Return the clock time at which the next message is due, ns; None at the end or while
        paused."""
        if self._next_message is None or self._clock_ns is None:
            return None
        return self._clock_ns + self._clock_span(self._next_message.log_time_ns)

    def step(self, clock_ns: int) -> ReplayMessage | None:
        """Return the next message immediately, even if it is not due; None at the end of the
        replay."""
        if self._next_message is None:
            return None
        self._set_time(max(self._next_message.log_time_ns, self.start_ns), clock_ns)
        return self._take_next_message()

    def seek(self, bag_ns: int, clock_ns: int) -> list[ReplayMessage]:
        """Jump to the bag time ``bag_ns``, clipped to the replayed part of the bag; a paused replay
        remains paused.

        Returns the messages that a subscriber would have received by then: the last message of each
        topic, if the topic is latched or the message is at most one second old. If the replay is
        paused at the beginning, the first messages are returned; they are published again when time
        resumes.

        Raises
        ------
        RecordingError
            The bag is damaged.
        """
        at = min(max(bag_ns, self.start_ns), self._last_ns)
        recent = max(at - _MAX_AGE_REPUBLISHED_AFTER_SEEK_NS, self.start_ns)
        begins = at == self.start_ns and self._clock_ns is None
        shown = self._last_messages(at, recent, at if begins else at - 1)
        self._set_time(at, clock_ns)
        self._set_coming(self._messages(self._names, at, self._end_ns))
        return shown

    def close(self) -> None:
        """Close the bag; the replay has no more messages."""
        self._set_coming(iter(()))

    def _time(self, clock_ns: int) -> int:
        if self._clock_ns is None:
            return self._bag_ns
        return self._bag_ns + math.floor((clock_ns - self._clock_ns) * self._rate)

    def _clock_span(self, bag_ns: int) -> int:
        """Return the clock time from the last time change to a time in the bag, ns."""
        return math.ceil((bag_ns - self._bag_ns) / self._rate)

    def _set_time(self, bag_ns: int, clock_ns: int) -> None:
        self._bag_ns = bag_ns
        self._clock_ns = None if self._clock_ns is None else clock_ns

    def _set_coming(self, messages: Iterator[ReplayMessage]) -> None:
        self._coming = messages
        self._next_message = next(messages, None)

    def _begin(self) -> None:
        """Schedule all messages from the start time on, after earlier latched messages."""
        found = self._messages(self._names, self.start_ns, self._end_ns)
        first = list(islice(found, 1))
        start = self.start_ns
        earlier = self._last_messages(start, start, start - 1) if first else []
        self._set_coming(chain(earlier, first, found))

    def _take_next_message(self) -> ReplayMessage:
        message = self._next_message
        assert message is not None
        self._next_message = next(self._coming, None)
        if self._next_message is None and self._loop:
            # A repeated replay begins at the log time of the last message.
            span = self._clock_span(max(message.log_time_ns, self.start_ns))
            self._set_time(self.start_ns, (self._clock_ns or 0) + span)
            self._begin()
        return message

    def _last_messages(self, time_ns: int, since_ns: int, until_ns: int) -> list[ReplayMessage]:
        """Return the last message of each topic, oldest first, to be published at a given time."""
        latched = [each.name for each in self.topics if each.qos.durability == "transient_local"]
        last: dict[str, ReplayMessage] = {}
        spans = (latched, 0, time_ns - 1), (self._names, since_ns, until_ns)
        for names, begin, end in spans:
            last.update((each.topic, each) for each in self._messages(names, begin, end))
        ordered = sorted(last.values(), key=lambda message: message.log_time_ns)
        return [replace(message, log_time_ns=time_ns) for message in ordered]

    def _messages(self, names: list[str], start_ns: int, end_ns: int) -> Iterator[ReplayMessage]:
        return starmap(ReplayMessage, self._bag.raw_messages(names, start_ns, end_ns))


def _with_slash(topic: str) -> str:
    return topic if topic.startswith("/") else f"/{topic}"
