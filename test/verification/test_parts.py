"""Parts of a verification by themselves: what is compared, what is missing, and why."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from spacerobot_ros.errors import RecordingError
from spacerobot_ros.flight import second_opinion, verification
from spacerobot_ros.flight.second_opinion import EngineComparison
from spacerobot_ros.flight.verification import Difference, _PublishedTopic, _Resimulation
from spacerobot_ros.topics import TOPICS

PERIOD_NS = 50_000_000


def published(name: str, ticks: list[int], values: Any) -> _PublishedTopic:
    table = np.array(values, dtype=float)
    labels = [f"number {i}" for i in range(table.shape[1])]
    return _PublishedTopic(TOPICS[name], f"/{name}", np.array(ticks, np.int64), table, labels)


def joints(ticks: list[int], values: Any) -> _PublishedTopic:
    return published("joint_states", ticks, values)


def flight(n: int = 2, actuation: str = "velocity", **recorded: Any) -> Any:
    """Return a stand-in for the plant of a bag."""
    return SimpleNamespace(
        path=Path("a.mcap"),
        config=SimpleNamespace(period_ns=PERIOD_NS, actuation=actuation),
        robot=SimpleNamespace(n=n, lower=np.full(n, -1.0), upper=np.full(n, 2.0)),
        recorded=SimpleNamespace(namespace="/r1", **recorded),
    )


def test_on_times_count_from_the_state_at_which_the_flight_begins() -> None:
    count = len(TOPICS["thrusters"].state)
    rows = [[10.0 * tick + i for i in range(2 * count)] for tick in range(4)]
    before = published("thrusters", [2, 3, 4, 5], rows)
    after = before.after(3)
    assert after.ticks.tolist() == [4, 5]
    assert after.values[:, :2].tolist() == [[10.0, 10.0], [20.0, 20.0]]
    assert after.values[:, 2:].tolist() == [row[2:] for row in rows[2:]]
    assert before.after(1).values.tolist() == rows
    assert before.values.tolist() == rows
    others = joints([2, 3, 4], [[1.0] * 6, [2.0] * 6, [3.0] * 6])
    assert others.after(2).values.tolist() == [[2.0] * 6, [3.0] * 6]


def test_topics_follow_where_a_resimulation_has_all_their_numbers() -> None:
    states = {name: np.zeros((3, 2)) for name in ("measured_q", "measured_qdot", "effort")}
    assert joints([1], [[0.0] * 6]).is_determined_by(states)
    assert not joints([1], [[0.0] * 5]).is_determined_by(states)
    del states["effort"]
    assert not joints([1], [[0.0] * 6]).is_determined_by(states)


def test_efforts_are_the_last_third_of_joint_states() -> None:
    for column, found in enumerate([False] * 6 + [True] * 3):
        values = np.zeros((2, 9))
        values[1, column] = 1e-9
        assert verification._has_efforts([joints([1, 2], values)]) is found
    assert not verification._has_efforts([published("momentum", [1], [[1.0] * 7])])


def test_a_flight_in_mid_flight_begins_with_its_first_state() -> None:
    pose = [0.1, 0.2, 0.3, 0.5, -0.5, 0.5, 0.5]
    parts = [
        published("odom", [7, 8], [[*pose, *range(6)], [0.0] * 13]),
        joints([6, 7], [[9.0] * 6, [-1.5, 2.5, 0.25, 0.75, 0.0, 0.0]]),
        published("momentum", [7, 9], [[1, 2, 3, 4, 5, 6, 7], [0] * 7]),
    ]
    for actuation, rates in (("velocity", None), ("effort", [0.25, 0.75])):
        state = verification._initial_state(7, parts, flight(actuation=actuation))
        assert state is not None
        assert [*state.position, *state.quaternion] == pose
        # Rounding beyond the limits -1 and 2 is none of the robot's.
        assert np.array(state.joint_positions).tolist() == [-1.0, 2.0]
        assert np.array(state.linear_momentum).tolist() == [1, 2, 3]
        assert np.array(state.angular_momentum).tolist() == [4, 5, 6]
        found = state.joint_velocities
        assert (None if found is None else np.array(found).tolist()) == rates
    assert verification._rates_at(7, parts, flight()).tolist() == [0.25, 0.75]
    assert verification._rates_at(0, parts, flight(3)).tolist() == [0.0] * 3
    assert verification._initial_state(0, parts, flight()) is None
    with pytest.raises(RecordingError) as refusal:
        verification._initial_state(8, parts, flight())
    assert str(refusal.value) == (
        "The bag a.mcap begins in mid-flight, and its first state lacks odom, joint_states or "
        "momentum."
    )


@pytest.mark.parametrize(
    ("first", "counts", "commanded", "message"),
    [
        (0, {"messages": "12"}, {0, 1, 2}, ""),
        (0, {"messages": "13"}, {0, 1, 2},
         "its recorder wrote 13 messages, and it holds 12."),
        (2, {"messages": "13"}, {0, 1, 2}, ""),
        (0, {"messages": "many"}, {0, 1, 2}, ""),
        (0, {}, {1, 5, 4},
         "it holds commands for 2 states that are not in it, the first of 0.2 s."),
        (0, {"messages_lost": "1"}, {5, 4},
         "it holds commands for 2 states that are not in it, the first of 0.2 s."),
        (0, {"messages_lost": "2"}, {5, 4}, ""),
        (5, {"messages_lost": "0"}, {5, 4},
         "it holds commands for 1 states that are not in it, the first of 0.25 s."),
        (6, {}, {5, 4}, ""),
    ],
)  # fmt: skip
def test_states_are_missed_by_counts_and_commands(
    first: int, counts: dict[str, str], commanded: set[int], message: str
) -> None:
    bag = SimpleNamespace(message_count=lambda: 12)
    done = _Resimulation(first, 9, {}, frozenset(commanded))
    given = flight(metadata={"recorder": counts}, bag=bag)
    parts = [
        joints([0, 1, 2, 3], np.zeros((4, 6))),
        published("momentum", [4, 5], np.zeros((2, 7))),
    ]
    assert verification._missing_states(given, parts, done) == message


@pytest.mark.parametrize(
    ("ticks", "positions", "time"),
    [
        ([0, 1, 2, 3], [0.5, 0.6, 0.7, 0.8], None),
        ([0, 1, 2, 0, 1], [0.5, 0.6, 0.7, 0.5, 0.6], 0.0),
        # A later reset, to a state that goes on counting from its time.
        ([4, 5, 5, 6, 6], [0.5, 0.6, 0.5, 0.6, 0.5], 0.25),
        # The same state again is no reset, nor is a repeated one of another shape.
        ([0, 0, 1], [0.5, 0.5, 0.6], None),
        ([0, 1, 2, 2], [0.5, 0.6, 0.7, 0.8], None),
        ([0, 1, 2, 3], [0.5, 0.6, 0.7, 0.5], None),
    ],
)
def test_a_reset_repeats_the_first_state(
    ticks: list[int], positions: list[float], time: float | None
) -> None:
    states = {name: np.zeros((9, 1)) for name in ("measured_q", "measured_qdot", "effort")}
    states["measured_q"][0] = 0.5
    parts = [joints(ticks, [[q, 0.0, 0.0] for q in positions])]
    done = _Resimulation(0, 8, states, frozenset())
    if time is None:
        verification._require_no_reset(flight(1), parts, done)
        return
    with pytest.raises(RecordingError) as refusal:
        verification._require_no_reset(flight(1), parts, done)
    assert str(refusal.value) == (
        f"In the bag a.mcap the plant was reset at {time:.9g} s; only flights without a reset can "
        "be verified."
    )


def comparison(parts: list[_PublishedTopic], done: _Resimulation) -> Any:
    return verification._Comparison(flight(1), parts, done, 1e-6)


def test_the_largest_deviation_is_the_one_before_the_first_difference() -> None:
    states = {name: np.zeros((6, 1)) for name in ("measured_q", "measured_qdot", "effort")}
    states["measured_q"][:, 0] = [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]
    states["momentum"] = np.full((6, 7), 100.0)
    values = np.zeros((6, 3))
    values[:, 0] = states["measured_q"][:, 0]
    values[1, 1], values[2, 0] = 5e-7, 2.0 + 1.2e-6
    momenta = np.full((5, 7), 100.0)
    momenta[1, 6] += 8e-5
    parts = [joints([2, 3, 4, 5, 6, 7], values), published("momentum", [2, 3, 4, 5, 6], momenta)]
    values, momenta = parts[0].values, parts[1].values
    done = _Resimulation(2, 7, states, frozenset({2, 3, 4, 5, 6}))
    found = comparison(parts, done).result()
    assert found.difference is None
    assert (found.ticks, found.duration, found.messages) == (5, 0.25, 11)
    assert found.topics == ("/joint_states", "/momentum")
    # 8e-5 of 100 are 8e-7; 1.2e-6 of 2 are 6e-7; 5e-7 counts as it is.
    assert found.largest == pytest.approx(8e-7)
    assert found.largest_at is not None
    assert (found.largest_at.time, found.largest_at.field) == (pytest.approx(0.15), "number 6")
    values[1, 2] = 3e-6
    found = comparison(parts, done).result()
    assert found.difference == Difference(0.15, "/joint_states", "number 2", 3e-6, 0.0)
    assert (found.largest, found.largest_at) == (0.0, None)
    # Of the same tick the first topic is named, of several numbers the first.
    momenta[1, 2] += 1.0
    values[1, 1] = 1.0
    found = comparison(parts, done).result()
    assert found.difference is not None
    assert found.difference.field == "number 1"
    momenta[0, 2] = np.nan
    found = comparison(parts, done).result()
    assert found.difference is not None
    assert (found.difference.time, found.difference.topic) == (pytest.approx(0.1), "/momentum")


def test_a_difference_says_what_its_commands_were() -> None:
    done = _Resimulation(2, 20, {}, frozenset({2, 3, 4, 6}))
    none = comparison([], done)
    assert [none._command_remark(tick) for tick in (2, 3, 5)] == ["", "", ""]
    assert none._command_remark(6) == " (no message on /r1/joint_commands is stamped 0.25 s)"
    refusal: Any = SimpleNamespace(clause="too fast")
    done.refusals[4] = "joint_commands", refusal
    assert (
        none._command_remark(5)
        == " (that on /r1/joint_commands stamped 0.2 s is refused: too fast)"
    )
    done.latched = 7
    assert none._command_remark(7) == ""
    assert none._command_remark(8) == " (a fault latched at 0.35 s; rearming is not in a bag)"
    done.end, done.stopped = 10, "It spins."
    assert none._command_remark(10).startswith(" (a fault")
    assert none._command_remark(11) == " (its plant had stopped: It spins)"


def test_a_difference_is_a_sentence() -> None:
    found = Difference(0.15, "/odom", "x", 1.5, 2.25, " (why)")
    assert str(found) == "/odom at 0.15 s: x is 1.5 in the bag and 2.25 by its commands (why)."


@pytest.mark.parametrize(
    ("ticks", "taken"),
    [
        ([0, 1], True),
        ([-1, 1], False),
        ([0, verification._MAX_SILENT_TICKS + 2 * verification._MAX_TICKS_PER_STATE], True),
        ([0, verification._MAX_SILENT_TICKS + 2 * verification._MAX_TICKS_PER_STATE + 1], False),
        ([7, verification._MAX_SILENT_TICKS + 2 * verification._MAX_TICKS_PER_STATE + 7], True),
    ],
)
def test_a_flight_has_a_state_in_every_tick_or_nearly(
    monkeypatch: pytest.MonkeyPatch, ticks: list[int], taken: bool
) -> None:
    class BegunError(Exception):
        pass

    def begin(*_: Any) -> None:
        raise BegunError

    monkeypatch.setattr(verification, "read_bag", lambda path: path)
    monkeypatch.setattr(verification._RecordedPlant, "of", lambda _: flight())
    parts = [joints(ticks, np.zeros((2, 6)))]
    monkeypatch.setattr(verification, "_published_topics", lambda _: parts)
    monkeypatch.setattr(verification, "_initial_state", begin)
    if taken:
        with pytest.raises(BegunError):
            verification.verify_bag("a.mcap")
        return
    with pytest.raises(RecordingError) as refusal:
        verification.verify_bag("a.mcap")
    first, last = (tick * PERIOD_NS for tick in ticks)
    assert str(refusal.value) == (
        f"The states in the bag a.mcap are stamped {first} to {last} ns, and there are 2 of them: "
        "a flight has a state in every tick."
    )
    parts[0] = joints([3, 3], np.zeros((2, 6)))
    with pytest.raises(RecordingError, match=r"holds the states of one tick: there is nothing"):
        verification.verify_bag("a.mcap")


# -- the second engine ---------------------------------------------------------------------------


def test_an_engine_agrees_within_a_bound_in_each_quantity() -> None:
    at = second_opinion.AGREEMENT_TOLERANCE
    same = EngineComparison("e", "i", 1, at, at, at, 0.0)
    assert same.agrees
    assert same.stop_reason == ""
    for name in ("position", "attitude", "joints"):
        assert not replace(same, **cast(Any, {name: at * 1.001})).agrees
