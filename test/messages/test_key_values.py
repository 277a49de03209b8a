"""The key-value pairs of statuses and events: names, order, defaults, and pairs that are wrong."""

from __future__ import annotations

from dataclasses import dataclass, field

import pytest

from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.events import (
    INTEGER,
    SECONDS,
    Event,
    EventKind,
    KeyValueField,
    KeyValueFormat,
    list_format,
)


@dataclass(frozen=True)
class Sample:
    count: int
    time_s: float | None = None
    words: tuple[str, ...] = ()
    named: dict[str, int] = field(default_factory=dict)
    others: dict[str, str] = field(default_factory=dict)


FORMAT = KeyValueFormat(
    "sample",
    KeyValueField("words", list_format("; "), always=True),
    KeyValueField("count", INTEGER, key="number"),
    KeyValueField("time_s", SECONDS),
    KeyValueField("named", INTEGER, prefix="n."),
    KeyValueField("others", prefix="", present_with="words"),
)


def test_pairs_have_the_order_of_the_fields_and_leave_defaults_out() -> None:
    sample = Sample(3, 0.0, ("a b", "c"), {"x": 4, "y": 5}, {"free": "text"})
    pairs = {"words": "a b; c", "number": "3", "time_s": "0.000000000"}
    pairs |= {"n.x": "4", "n.y": "5", "free": "text"}
    assert list(FORMAT.to_values(sample).items()) == list(pairs.items())
    assert FORMAT.from_values(Sample, pairs) == sample
    assert FORMAT.to_values(Sample(0, others={"free": "text"})) == {"words": "", "number": "0"}
    assert FORMAT.from_values(Sample, {"number": "7"}, time_s=2.5) == Sample(7, 2.5)


@pytest.mark.parametrize(
    ("pairs", "named"), [({"words": "a"}, "'number'"), ({"number": "3", "n.x": "1.5"}, "1.5")]
)
def test_pairs_that_are_missing_or_unreadable_are_named(pairs: dict[str, str], named: str) -> None:
    with pytest.raises(SpaceRobotError, match=f"^The values are no sample: .*{named}"):
        FORMAT.from_values(Sample, pairs)


def test_an_event_carries_its_times_first_and_its_facts_last() -> None:
    event = Event(EventKind.LATCHED, "m", 2, 1.25, "7.5", {"reason": "late", "fault": "x"})
    pairs = event.to_values(9.5)
    assert list(pairs) == ["event", "time", "wall_time", "goal_id", "reason", "fault"]
    assert (pairs["time"], pairs["wall_time"]) == ("1.250000000", "9.500000")
    assert Event.from_values(pairs, "m", 2) == event
    assert "time" not in Event(EventKind.RESET, "").to_values(None)
