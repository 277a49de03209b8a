"""Pulses of on/off thrusters: shortest on-times, mean impulse, what is dropped."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.oracles import Array

from spacerobot_ros.errors import ParameterError
from spacerobot_ros.model.thrusters import ThrusterModulator, ThrusterTable, thrusters_of_urdf
from spacerobot_ros.model.urdf import load_robot
from spacerobot_ros.resources import share_directory

SERVICER = thrusters_of_urdf(load_robot(share_directory() / "urdf" / "servicer.urdf"))
TICK = 0.01


def with_shortest(shortest: float) -> ThrusterTable:
    return dataclasses.replace(SERVICER, min_on_time=np.full(24, shortest))


def pair(shortest: float) -> ThrusterTable:
    """Return two thrusters of 2 N through the origin, along x and against it."""
    return ThrusterTable(
        ("forth", "back"),
        np.zeros((2, 3)),
        np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]]),
        np.array([2.0, 2.0]),
        np.full(2, shortest),
        np.array([100.0, 100.0]),
    )


def along_x(force: float) -> Array:
    return np.array([force, 0.0, 0.0, 0.0, 0.0, 0.0])


def pulse_lengths(on_times: Array) -> list[float]:
    """Return the lengths (s) of one thruster's complete pulses from its on-times by tick."""
    lengths, running = [], 0.0
    for on_time in on_times:
        running += on_time
        if running and on_time < TICK * (1 - 1e-6):
            lengths.append(running)
            running = 0.0
    return lengths


@pytest.mark.slow
@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 2**31),
    shortest=st.sampled_from([0.0, 0.004, 0.01, 0.02, 0.033]),
)
def test_impulse_is_met_within_a_shortest_pulse_of_each_thruster(
    seed: int, shortest: float
) -> None:
    rng = np.random.default_rng(seed)
    table = with_shortest(shortest)
    pulses = ThrusterModulator(table, TICK)
    wanted, given_, fired = np.zeros(6), np.zeros(6), []
    # Both ways along every axis at most 12 N and 5 N m: far within the thrust of the table.
    wrench = np.zeros(6)
    for tick in range(100):
        if tick % 7 == 0:
            wrench = rng.uniform(-1.0, 1.0, 6) * [12.0, 12.0, 12.0, 5.0, 5.0, 5.0]
        on_time = pulses.fire(wrench)
        assert not pulses.unmet.any() or np.abs(pulses.unmet).max() < 1e-9
        assert np.all((on_time >= 0.0) & (on_time <= TICK * (1 + 1e-9)))
        fired.append(on_time)
        wanted += TICK * wrench
        given_ += table.wrenches @ on_time
    for lengths in map(pulse_lengths, np.array(fired).T):
        assert all(length >= shortest * (1 - 1e-6) for length in lengths)
    # What is missing is what thrusters owe, none more than a shortest pulse, and what is under way.
    missing = wanted - given_
    np.testing.assert_allclose(
        missing, pulses.pending_impulse + pulses.begun_pulse_impulse, atol=1e-9
    )
    assert np.all(np.abs(missing) <= shortest * np.abs(table.wrenches).sum(axis=1) + 1e-9)
    if not shortest:
        assert np.abs(missing).max() <= 1e-9


@pytest.mark.parametrize("force", [0.013, 0.5, 1.9, 2.0, -0.7])
@pytest.mark.parametrize("shortest", [0.0, 0.003, 0.025])
def test_mean_of_a_second_is_the_wanted_force(force: float, shortest: float) -> None:
    pulses = ThrusterModulator(pair(shortest), TICK)
    second = np.array([pulses.fire(along_x(force)) for _ in range(100)])
    impulse = float(np.sum(second @ [2.0, -2.0]))
    assert abs(impulse - force) <= 2.0 * shortest + 1e-9
    # Nothing is fired against the wanted force.
    assert not second[:, 1 if force > 0 else 0].any()


def test_little_wanted_both_ways_fires_nothing() -> None:
    pulses = ThrusterModulator(pair(0.02), TICK)
    fired = [pulses.fire(along_x(1.5 * (-1) ** tick)) for tick in range(200)]
    assert not np.any(fired)


def test_a_begun_pulse_is_ended_although_nothing_is_wanted_any_more() -> None:
    pulses = ThrusterModulator(pair(0.035), TICK)
    first = [pulses.fire(along_x(2.0))[0] for _ in range(4)]
    assert first == [0.0, 0.0, 0.0, pytest.approx(TICK)]
    assert pulses.begun.tolist() == [True, False]
    rest = [pulses.fire(np.zeros(6))[0] for _ in range(6)]
    # 40 ms were owed.
    assert TICK + sum(rest) == pytest.approx(0.04)
    assert pulses_end(rest)
    assert pulses.begun.tolist() == [False, False]


def pulses_end(on_times: list[float]) -> bool:
    """Whether a pulse once ended does not begin again."""
    ended = on_times.index(0.0)
    return not any(on_times[ended:])


def test_what_is_beyond_the_thrust_is_dropped_and_told() -> None:
    pulses = ThrusterModulator(pair(0.02), TICK)
    for _ in range(100):
        pulses.fire(along_x(5.0))
    assert pulses.unmet[0] == pytest.approx(3.0)
    later = np.array([pulses.fire(np.zeros(6)) for _ in range(20)])
    # A second of too much are not made up for: one tick and one shortest pulse at the most.
    assert later.sum() <= TICK + 0.02 + 1e-9
    assert pulses.unmet[0] == 0.0


@pytest.mark.parametrize("shortest", [0.012, 0.035, 0.05])
def test_pulses_under_way_count_towards_what_may_be_owed(shortest: float) -> None:
    """However much is wanted: once nothing is, a thruster gives a shortest pulse and a tick."""
    rng = np.random.default_rng(4)
    pulses, force = ThrusterModulator(pair(shortest), TICK), 2.0
    for tick in range(60):
        pulses.fire(along_x(float(rng.uniform(20.0, 500.0)) if tick % 9 < 6 else 0.0))
        outstanding = pulses.pending_impulse + pulses.begun_pulse_impulse
        assert abs(outstanding[0]) <= force * (shortest + TICK) + 1e-9, tick


def test_a_direction_without_thrusters_is_told() -> None:
    pulses = ThrusterModulator(pair(0.0), TICK)
    on_time = pulses.fire(np.array([1.0, 0.5, 0, 0, 0, -0.25]))
    assert on_time.tolist() == [pytest.approx(TICK / 2), 0.0]
    np.testing.assert_allclose(pulses.unmet, [0, 0.5, 0, 0, 0, -0.25], atol=1e-12)


def test_excluded_thrusters_stay_off() -> None:
    dead = [SERVICER.names[0], SERVICER.names[9]]
    pulses = ThrusterModulator(SERVICER, TICK, dead)
    rng = np.random.default_rng(5)
    fired = np.zeros(24)
    for _ in range(200):
        fired += pulses.fire(rng.normal(size=6) * 3.0)
        assert np.abs(pulses.unmet).max() < 1e-9
    assert fired[[0, 9]].tolist() == [0.0, 0.0]
    assert fired.sum() > 0.2
    with pytest.raises(ParameterError, match="no thruster 'nose'"):
        ThrusterModulator(SERVICER, TICK, ["nose"])


@pytest.mark.parametrize("seed", range(3))
def test_rounding_does_not_choose_the_thrusters(seed: int) -> None:
    """The servicer's are symmetric: many allocations of a wrench cost the same."""
    rng = np.random.default_rng(seed)
    pulses, others = ThrusterModulator(SERVICER, TICK), ThrusterModulator(SERVICER, TICK)
    for tick in range(150):
        if tick % 10 == 0:
            wrench = rng.uniform(-6.0, 6.0, 6) * rng.integers(0, 2, 6)
        rounded = wrench + 1e-13 * rng.normal(size=6)
        np.testing.assert_allclose(pulses.fire(wrench), others.fire(rounded), atol=1e-11)


def test_propellant_and_pulses_are_counted_from_the_commanded_on_times() -> None:
    modulator = ThrusterModulator(pair(0.02), TICK)
    fired = np.array([modulator.fire(along_x(0.5)) for _ in range(400)])
    np.testing.assert_allclose(modulator.on_time, fired.sum(axis=0), rtol=1e-12)
    # 2 N at a specific impulse of 100 s, for a mean thrust of 0.5 N over 4 s.
    assert modulator.propellant == pytest.approx(0.5 * 4.0 / (100.0 * 9.80665), rel=0.02)
    assert modulator.pulses[0] == len(pulse_lengths(fired[:, 0])) > 10
    assert modulator.pulses[1] == 0
    modulator.reset()
    assert modulator.on_time[0] > 0.0, "what was used stays used"


def test_what_cannot_be_given_without_a_thruster_is_named_and_counted() -> None:
    modulator = ThrusterModulator(SERVICER, TICK)
    assert modulator.missing == ""
    pulls = [
        name
        for name, direction in zip(SERVICER.names, SERVICER.direction_B, strict=True)
        if direction[0] < -0.5
    ]
    for name in pulls:
        modulator.exclude(name)
    assert "negative force along x" in modulator.missing
    modulator.fire(along_x(-1.0))
    assert modulator.unmet_periods == 1
