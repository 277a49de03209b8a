"""Which messages a replay sends when: against the log times that were written."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.hostile.records import string
from support.made_bags import STRING

from spacerobot_ros.bag import LATCHED, Bag, BagWriter, RecordingError, ReplayConfig, read_bag
from spacerobot_ros.bag.playback import Playback, ReplayMessage, SubscriberWait, renamed_topics
from spacerobot_ros.errors import ParameterError

S = 10**9
BEGAN = 1_700_000_000 * S
CLOCK = 77 * S
"""Where the clock of a replay is when it begins."""


def bag_of(path: Path, entries: Sequence[tuple[str, float]], chunk_size: int = 65536) -> Path:
    """Write messages "/topic n" at so many seconds from the beginning, in the order given."""
    with BagWriter(path, chunk_size=chunk_size) as writer:
        for n, (topic, seconds) in enumerate(entries):
            qos = LATCHED if topic.startswith("/latched") else None
            channel = writer.add_topic(topic, STRING, qos)
            time_ns = BEGAN + round(seconds * S)
            writer.write(channel, string(f"{topic} {n}"), time_ns, time_ns)
    return path


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """/a every 0.1 s and /b every 0.25 s for 1 s, and two messages on a latched topic."""
    entries = [("/a", 0.1 * k) for k in range(11)] + [("/b", 0.25 * k) for k in range(5)]
    entries += [("/latched", 0.0), ("/latched", 0.3)]
    return bag_of(tmp_path / "a.mcap", sorted(entries, key=lambda entry: entry[1]))


def played(playback: Playback, end: float, step: float = 0.01) -> list[tuple[float, str]]:
    """Run a clock by steps; return when, in s since the beginning, each message was sent."""
    playback.run(CLOCK)
    found = []
    for k in range(round(end / step) + 1):
        now = round(k * step * S)
        for message in playback.take_due(CLOCK + now, 1000):
            found.append((now / S, message.data[8:-1].decode()))
    return found


@pytest.mark.parametrize("rate", [0.5, 3.0, 1000.0])
def test_the_rate_divides_the_spacing(path: Path, rate: float) -> None:
    playback = Playback(read_bag(path), ReplayConfig(topics="/b", rate=rate))
    playback.run(CLOCK)
    for k in range(5):
        due = playback.next_due_time()
        assert due is not None
        assert due == pytest.approx(CLOCK + 0.25 * k / rate * S, abs=2)
        assert list(playback.take_due(due - 10, 9)) == []
        (message,) = list(playback.take_due(due + 2, 9))
        assert message.log_time_ns == BEGAN + k * S // 4
    assert playback.ended


def test_start_and_duration_choose_a_part(path: Path) -> None:
    found = played(
        Playback(read_bag(path), ReplayConfig(topics="/a", start=0.25, duration=0.5)), 1.0
    )
    times = [time for time, _ in found]
    assert times == pytest.approx([0.05, 0.15, 0.25, 0.35, 0.45])


def test_a_late_clock_gets_everything_that_is_due_in_order(path: Path) -> None:
    playback = Playback(read_bag(path))
    playback.run(CLOCK)
    first = list(playback.take_due(CLOCK + 2 * S, 5))
    rest = list(playback.take_due(CLOCK + 2 * S, 100))
    assert (len(first), len(rest)) == (5, 13)
    times = [message.log_time_ns for message in first + rest]
    assert times == sorted(times)


def test_a_pause_shifts_what_follows(path: Path) -> None:
    playback = Playback(read_bag(path), ReplayConfig(topics="/a"))
    playback.run(CLOCK)
    assert len(list(playback.take_due(CLOCK + S // 4, 100))) == 3
    playback.pause(CLOCK + S // 4)
    assert list(playback.take_due(CLOCK + 50 * S, 100)) == []
    assert playback.next_due_time() is None
    assert playback.bag_time(CLOCK + 50 * S) == BEGAN + S // 4
    playback.run(CLOCK + 60 * S)
    assert playback.next_due_time() == CLOCK + 60 * S + S // 20


def test_steps_move_the_time_of_the_bag(path: Path) -> None:
    playback = Playback(read_bag(path), ReplayConfig(topics="/b"))
    for k in range(3):
        message = playback.step(CLOCK)
        assert message is not None
        assert message.log_time_ns == BEGAN + k * S // 4
    playback.run(CLOCK + 5 * S)
    assert playback.next_due_time() == CLOCK + 5 * S + S // 4
    while playback.step(CLOCK + 9 * S) is not None:
        pass
    assert playback.ended


def test_a_loop_begins_again_at_the_time_of_the_last_message(path: Path) -> None:
    found = played(Playback(read_bag(path), ReplayConfig(topics="/b", start=0.25, loop=True)), 2.5)
    times = [time for time, _ in found]
    turn = [0.0, 0.25, 0.5, 0.75]
    assert times[:12] == pytest.approx([0.75 * n + t for n in range(3) for t in turn])


def texts_of(messages: Sequence[ReplayMessage]) -> list[str]:
    return [message.data[8:-1].decode() for message in messages]


def test_a_jump_brings_what_a_subscriber_would_have(path: Path) -> None:
    playback = Playback(read_bag(path))
    everything = played(Playback(read_bag(path)), 1.0)
    playback.run(CLOCK)
    list(playback.take_due(CLOCK + S // 2, 1000))
    # Back and forth, running: the last of each topic, then all that follows in its time.
    for seconds in (0.05, 0.62, 0.3, 0.0):
        at = BEGAN + round(seconds * S)
        shown = playback.seek(at, CLOCK)
        last = {text.split()[0]: text for time, text in everything if time < seconds}
        assert sorted(texts_of(shown)) == sorted(last.values())
        assert all(message.log_time_ns == at for message in shown)
        assert playback.bag_time(CLOCK) == at
        rest = texts_of(list(playback.take_due(CLOCK + 2 * S, 1000)))
        assert rest == [text for time, text in everything if time >= seconds]
        assert playback.ended
    # Beyond the ends: at them. What is there last is still to come.
    assert texts_of(playback.seek(BEGAN - S, CLOCK)) == []
    playback.pause(CLOCK)
    playback.seek(BEGAN + 9 * S, CLOCK)
    assert playback.bag_time(CLOCK + S) == BEGAN + S
    assert (playback.start_ns, playback.duration_s) == (BEGAN, 1.0)
    assert not playback.ended


def test_a_jump_to_the_beginning_while_time_stands_still_shows_what_is_there(path: Path) -> None:
    everything = played(Playback(read_bag(path)), 1.0)
    for start in (0.0, 0.25):
        playback = Playback(read_bag(path), ReplayConfig(start=start))
        playback.seek(BEGAN + round(0.62 * S), CLOCK)
        shown = texts_of(playback.seek(BEGAN, CLOCK))
        there = {text.split()[0]: text for time, text in everything if time == start}
        assert there
        assert set(there.values()) <= set(shown)
        # Everything comes when it goes on.
        playback.run(CLOCK)
        rest = texts_of(list(playback.take_due(CLOCK + 2 * S, 1000)))
        assert rest == [text for time, text in everything if time >= start]


def test_a_jump_stays_in_the_part_that_is_played(path: Path) -> None:
    playback = Playback(read_bag(path), ReplayConfig(start=0.2, duration=0.5))
    assert (playback.start_ns, playback.duration_s) == (BEGAN + S // 5, 0.5)
    playback.run(CLOCK)
    shown = playback.seek(BEGAN, CLOCK)
    assert texts_of(shown) == ["/latched 2"]
    last = texts_of(list(playback.take_due(CLOCK + 9 * S, 1000)))[-1]
    assert last == [text for time, text in played(Playback(read_bag(path)), 1.0) if time <= 0.7][-1]


def test_what_is_long_ago_is_not_shown_again(tmp_path: Path) -> None:
    path = bag_of(tmp_path / "a.mcap", [("/a", 0.0), ("/b", 3.0), ("/a", 4.0)])
    playback = Playback(read_bag(path))
    assert texts_of(playback.seek(BEGAN + round(3.5 * S), CLOCK)) == ["/b 1"]


def test_messages_written_out_of_order_are_played_in_order(tmp_path: Path) -> None:
    seconds = [3.0, 1.0, 2.0, 9.0, 8.5, 8.75, 4.0, 5.0, 5.0, 0.0]
    path = bag_of(tmp_path / "a.mcap", [("/a", s) for s in seconds], chunk_size=100)
    texts = [text for _, text in played(Playback(read_bag(path)), 9.0)]
    # Equal times keep the order in which they were written.
    order = sorted(range(len(seconds)), key=lambda n: seconds[n])
    assert texts == [f"/a {n}" for n in order]


def test_what_cannot_be_played_is_refused(path: Path, tmp_path: Path) -> None:
    bag = read_bag(path)
    with pytest.raises(RecordingError, match="has no topic /c: it has /a"):
        Playback(bag, ReplayConfig(topics="/c"))
    with pytest.raises(RecordingError, match=r"no message to replay from 1.5 s: it lasts 1 s"):
        Playback(bag, ReplayConfig(start=1.5))
    with pytest.raises(RecordingError, match=r"from 0.01 s for 0.05 s: it lasts 1 s"):
        Playback(bag, ReplayConfig(topics="/a", start=0.01, duration=0.05))
    with pytest.raises(RecordingError, match="has no messages"):
        Playback(read_bag(bag_of(tmp_path / "empty.mcap", [])))


def test_a_bag_of_too_many_topics_is_played_by_name(tmp_path: Path) -> None:
    bag = read_bag(bag_of(tmp_path / "a.mcap", [(f"/t{n}", 0.0) for n in range(1001)]))
    with pytest.raises(RecordingError, match="has 1001 topics, but only 1000 can be replayed"):
        Playback(bag)
    assert [topic.name for topic in Playback(bag, ReplayConfig(topics="/t7 /t9")).topics] == [
        "/t7",
        "/t9",
    ]


@pytest.fixture(scope="module")
def far(tmp_path_factory: pytest.TempPathFactory) -> Bag:
    """A message now, and one in a hundred years."""
    folder = tmp_path_factory.mktemp("bags")
    return read_bag(bag_of(folder / "a.mcap", [("/a", 0.0), ("/a", FAR / S)]))


FAR = 3_000_000_000 * S


@given(
    rate=st.floats(1e-3, 1e5),
    moves=st.lists(st.tuples(st.booleans(), st.integers(0, 10**12)), max_size=8),
)
def test_time_goes_on_by_the_rate_and_stands_in_pauses(
    far: Bag, rate: float, moves: list[tuple[bool, int]]
) -> None:
    playback = Playback(far, ReplayConfig(rate=rate))
    assert playback.step(CLOCK) is not None
    running_ns = 0
    clock = CLOCK
    for runs, passed in moves:
        (playback.run if runs else playback.pause)(clock)
        clock += passed
        running_ns += passed if runs else 0
    # Floats near the time of the bag are 256 ns apart: whole numbers and fractions are not.
    exact = Fraction(rate) * running_ns
    # A nanosecond is lost at most wherever time stopped, and the accuracy of a product.
    assert abs(playback.bag_time(clock) - BEGAN - exact) <= len(moves) + 1 + exact / 2**50
    due = playback.next_due_time()
    assert (due is not None) == (bool(moves) and moves[-1][0])
    if due is not None:
        error = 1 + FAR / Fraction(2**50)
        playback.pause(due)
        assert playback.bag_time(due) >= BEGAN + FAR - error
        assert Fraction(due - clock) * Fraction(rate) <= FAR - exact + rate + error


def test_a_replay_waits_for_readers_to_be_matched_and_to_be_all() -> None:
    wait = SubscriberWait(period=0.1, longest=60.0, settled=0.25)
    assert not wait.may_begin([0, 0], [0, 0]), "nobody is there"
    assert not wait.may_begin([1, 0], [1, 1]), "one is known and not matched"
    assert not any(wait.may_begin([1, 0], [1, 1]) for _ in range(9))
    assert not wait.may_begin([1, 1], [1, 1]), "one has just come"
    assert [wait.may_begin([1, 1], [1, 1]) for _ in range(3)] == [False, False, True]


def test_a_replay_without_readers_begins_after_the_longest_wait() -> None:
    wait = SubscriberWait(period=0.25, longest=1.0)
    assert [wait.may_begin([0], [0]) for _ in range(4)] == [False, False, False, True]


def test_topics_get_new_names() -> None:
    topics = ["/odom", "/joint_states"]
    assert renamed_topics("", topics) == {}
    assert renamed_topics("/odom:=/a/odom  /joint_states:=/b", topics) == {
        "/odom": "/a/odom",
        "/joint_states": "/b",
    }
    for rule in ("/odom", "/odom:=", ":=/odom", "/odom=/a", "/momentum:=/a"):
        with pytest.raises(ParameterError, match="'remap'"):
            renamed_topics(rule, topics)


def replayed(path: Path, start: float) -> Playback:
    """Replay /a every 0.1 s for 1 s, and before it /latched at 0, 0.2 and 0.3 s."""
    entries = [("/a", 0.1 * n) for n in range(11)]
    for place, seconds in ((3, 0.3), (2, 0.2), (0, 0.0)):
        entries.insert(place, ("/latched", seconds))
    return Playback(read_bag(bag_of(path, entries)), ReplayConfig(start=start))


@pytest.mark.parametrize(
    ("start", "expected"),
    [
        (0.0, ["/latched 0", "/a 1"]),
        (0.2, ["/latched 0", "/latched 3", "/a 4"]),
        (0.3, ["/latched 3", "/latched 5", "/a 6"]),
        (0.35, ["/latched 5"]),
    ],
)
def test_what_was_latched_comes_once(tmp_path: Path, start: float, expected: list[str]) -> None:
    playback = replayed(tmp_path / "a.mcap", start)
    playback.run(CLOCK)
    due = list(playback.take_due(CLOCK, 100))
    assert texts_of(due) == expected
    # What was sent before is due at the start: a clock made of it does not go back.
    assert {message.log_time_ns for message in due} == {BEGAN + round(start * S)}


def test_the_time_of_a_late_replay_is_not_ahead_of_what_is_still_to_come(tmp_path: Path) -> None:
    playback = replayed(tmp_path / "a.mcap", 0.0)
    late = CLOCK + 4 * S
    playback.run(CLOCK)
    assert playback.bag_time(late) == BEGAN
    list(playback.take_due(CLOCK, 100))
    assert playback.bag_time(late) == BEGAN + S // 10
    list(playback.take_due(late, 100))
    assert playback.ended
    assert playback.bag_time(late) == BEGAN + 4 * S
