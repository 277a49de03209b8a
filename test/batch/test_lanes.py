"""Flights in lanes are those of the plant, and where there are no lanes the plant flies them."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from support.slow import some_fast

from spacerobot_ros.batch import (
    BatchResult,
    Flights,
    FollowedSchedule,
    HeldCommands,
    InitialStates,
    SensorErrors,
    fly_lanes,
    fly_one_by_one,
    native,
)
from spacerobot_ros.model import (
    InertialParameters,
    SpaceRobot,
    load_robot,
)
from spacerobot_ros.model.compilation import cxx_compiler
from spacerobot_ros.resources import share_directory

needs_compiler = pytest.mark.skipif(cxx_compiler() is None, reason="there is no C++ compiler")

NUMBERS = (
    *("pose", "twist", "q", "qdot", "momentum", "measured_pose", "measured_q"),
    *("peak_rate", "peak_effort", "peak_wrench", "impulse"),
)


@pytest.fixture(scope="module")
def robots() -> dict[str, SpaceRobot]:
    urdf = share_directory() / "urdf"
    names = "sliding_masses", "servicer"
    return {name: SpaceRobot(load_robot(urdf / f"{name}.urdf")) for name in names}


def assert_equal_flights(here: BatchResult, there: BatchResult, rtol: float = 1e-12) -> None:
    for name in NUMBERS:
        one, two = getattr(here, name), getattr(there, name)
        # An attitude has no size of its own: numbers below one are compared absolutely.
        np.testing.assert_allclose(one, two, rtol=rtol, atol=rtol, err_msg=name)
    for name, counts in there.limited_ticks.items():
        np.testing.assert_array_equal(here.limited_ticks[name], counts)
    assert here.failures == there.failures


def draws(
    robot: SpaceRobot, count: int, rng: np.random.Generator, *, moving: bool
) -> tuple[InitialStates, SensorErrors, InertialParameters]:
    """Return starts, sensors and masses that all differ, some without noise, some without bias."""
    n, bodies = robot.n, len(robot.description.bodies)
    quaternion = rng.normal(size=(count, 4))
    lower, upper = np.maximum(robot.lower, -1.0), np.minimum(robot.upper, 1.0)
    starts = InitialStates(
        rng.normal(size=(count, 3)),
        quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True),
        lower + (upper - lower) * rng.uniform(0.3, 0.7, (count, n)),
        0.02 * rng.normal(size=(count, n)) * moving,
        0.1 * rng.normal(size=(count, 6)),
        rng.uniform(size=count) < 0.3,
    )
    noise = 1e-3 * np.abs(rng.normal(size=(count, 6)))
    noise[::3] = 0.0
    bias = 1e-3 * rng.normal(size=(count, 6 + n))
    bias[::2] = 0.0
    seeds = rng.integers(0, 1000, count)
    sensors = SensorErrors(noise, bias[:, :6], bias[:, 6:], seeds)
    factors = rng.uniform(0.9, 1.1, (2, count, bodies))
    return starts, sensors, robot.inertial.scaled(*factors)


def velocity_flights(robot: SpaceRobot, count: int, *, each: bool, deadband: float) -> Flights:
    """Return flights along a schedule that runs into rate limits and ends of travel."""
    rng = np.random.default_rng(3)
    starts, sensors, inertial = draws(robot, count, rng, moving=False)
    near = np.minimum(robot.upper, 3.0) - rng.uniform(0.01, 1.0, (count, robot.n))
    starts = dataclasses.replace(starts, q=np.maximum(near, robot.lower))
    # At 0.5 to 1.5 of the largest rate, back and forth.
    rates = robot.velocity_limit * np.linspace(0.5, 1.5, robot.n) * np.ones((60, 1))
    rates[25:] *= -0.8
    positions = np.vstack([np.zeros(robot.n), 0.05 * np.cumsum(rates, axis=0)])
    positions = positions + (starts.q[:, None] if each else starts.q[0])
    program = FollowedSchedule(positions, shape_gain=2.0, deadband=deadband)
    return Flights(
        *(robot, "velocity", 0.05, 70, starts, program),
        inertial,
        sensors,
        report_ticks=(0, 7, 61, 70),
    )


def effort_flights(robot: SpaceRobot, count: int) -> Flights:
    """Return flights under efforts beyond their limits, of which some drive joints to stops."""
    rng = np.random.default_rng(4)
    starts, sensors, inertial = draws(robot, count, rng, moving=True)
    starts.q[::3, 0], starts.qdot[::3, 0] = robot.upper[0] - 0.005, 0.1
    effort = np.minimum(robot.effort_limit, 5.0)
    joints = 0.03 * effort * rng.normal(size=(count, 30, robot.n))
    # Of the first joint alone: such efforts would spin a light wrist beyond all rates, and rounding
    # would decide where it ends.
    joints[:, 5, 0] *= 3000.0
    joints[:, 6, 0] = -joints[:, 5, 0]
    program = HeldCommands(joints, rng.normal(size=(40, 6)))
    return Flights(
        *(robot, "effort", 0.01, 45, starts, program),
        inertial,
        sensors,
        report_ticks=(0, 3, 44, 45),
    )


@needs_compiler
@pytest.mark.parametrize(
    ("each", "deadband"), some_fast([(False, 0.0), (True, 0.003)], (True, 0.003))
)
def test_velocity_flights_in_lanes_are_those_of_the_plant(
    robots: dict[str, SpaceRobot], each: bool, deadband: float
) -> None:
    flights = velocity_flights(robots["sliding_masses"], 19, each=each, deadband=deadband)
    here, there = fly_lanes(flights), fly_one_by_one(flights)
    assert "lanes" in here.engine
    assert_equal_flights(here, there)
    assert there.limited_ticks["rate"].any(axis=1).sum() > 10
    assert there.limited_ticks["stroke"].any(axis=1).sum() > 10
    assert not here.fallback_ticks.any()


@needs_compiler
def test_flights_without_momentum_are_those_of_the_plant_and_of_neighbours_of_moving_ones(
    robots: dict[str, SpaceRobot],
) -> None:
    flights = velocity_flights(robots["sliding_masses"], 19, each=True, deadband=0.0)
    momenta = flights.initial_states.momenta.copy()
    momenta[:, 3:] = 0.0
    without = dataclasses.replace(
        flights, initial_states=dataclasses.replace(flights.initial_states, momenta=momenta)
    )
    here = fly_lanes(without)
    assert "lanes" in here.engine
    assert_equal_flights(here, fly_one_by_one(without))
    # One flight of every group turns: all flights of the group have the tick of such flights.
    turning = momenta.copy()
    turning[::2, 3:] = 0.1
    mixed = fly_lanes(
        dataclasses.replace(
            flights, initial_states=dataclasses.replace(flights.initial_states, momenta=turning)
        )
    )
    for name in NUMBERS:
        np.testing.assert_array_equal(getattr(mixed, name)[1::2], getattr(here, name)[1::2])
    assert (mixed.pose[::2, -1] != here.pose[::2, -1]).any(axis=1).all()


@pytest.mark.slow
@needs_compiler
def test_effort_flights_in_lanes_are_those_of_the_plant(robots: dict[str, SpaceRobot]) -> None:
    flights = effort_flights(robots["sliding_masses"], 19)
    here, there = fly_lanes(flights), fly_one_by_one(flights)
    assert_equal_flights(here, there)
    assert there.limited_ticks["effort"].any(axis=1).sum() > 10
    assert 0 < there.limited_ticks["stroke"].any(axis=1).sum() < 19
    # Ticks at a stop, and no others, are the scalar plant's.
    assert (here.fallback_ticks > 0).sum() == there.limited_ticks["stroke"].any(axis=1).sum()
    assert here.fallback_ticks.sum() < 0.5 * 45 * 19


@needs_compiler
def test_a_flight_that_fails_says_why_and_leaves_its_neighbours_alone(
    robots: dict[str, SpaceRobot],
) -> None:
    flights = effort_flights(robots["sliding_masses"], 9)
    momenta, q = flights.initial_states.momenta.copy(), flights.initial_states.q.copy()
    momenta[4] = 1e80
    q[7, 0] = 50.0
    starts = dataclasses.replace(flights.initial_states, momenta=momenta, q=q)
    broken = dataclasses.replace(flights, initial_states=starts)
    here, there = fly_lanes(broken), fly_one_by_one(broken)
    assert here.failures == there.failures
    assert sorted(here.failures) == [4, 7]
    assert "no longer finite" in here.failures[4]
    assert "outside its limits" in here.failures[7]
    assert np.isnan(here.pose[4, -1]).all()
    others = [i for i in range(9) if i not in (4, 7)]
    np.testing.assert_array_equal(here.pose[others], fly_lanes(flights).pose[others])


def test_without_a_compiler_the_plant_flies_them(
    robots: dict[str, SpaceRobot], monkeypatch: pytest.MonkeyPatch
) -> None:
    flights = velocity_flights(robots["sliding_masses"], 2, each=False, deadband=0.0)
    there = fly_one_by_one(flights)
    monkeypatch.setenv("SPACEROBOT_COMPILE", "0")
    here = fly_lanes(flights)
    assert here.engine == "scalar"
    np.testing.assert_array_equal(here.pose, there.pose)


def test_the_widest_registers_that_there_are_are_chosen(monkeypatch: pytest.MonkeyPatch) -> None:
    for flags, name in (
        ("fpu sse2 avx2 avx512f", "AVX-512"),
        ("fpu sse2 avx avx2", "AVX2"),
        ("fpu sse2", "SSE2"),
        ("asimd", "two at a time"),
        (None, "two at a time"),
    ):
        native.vector_unit.cache_clear()
        text = f"model name : avx512f\nflags\t\t: {flags}\n" if flags else "no processor\n"
        monkeypatch.setattr(Path, "read_text", lambda *_, text=text, **__: text)
        assert native.vector_unit().name == name
    monkeypatch.undo()
    native.vector_unit.cache_clear()


@needs_compiler
@pytest.mark.slow
def test_without_vector_functions_of_the_c_library_lanes_fly_as_well(
    robots: dict[str, SpaceRobot], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    flights = velocity_flights(robots["servicer"], 9, each=True, deadband=0.0)
    with_functions = fly_lanes(flights)
    compiler = tmp_path / "c++"
    script = f'#!/bin/sh\ncase "$*" in *-lmvec*) exit 1;; esac\nexec {cxx_compiler()} "$@"\n'
    compiler.write_text(script, encoding="utf-8")
    compiler.chmod(0o700)
    monkeypatch.setenv("CXX", str(compiler))
    here = fly_lanes(flights)
    assert here.engine == with_functions.engine
    assert_equal_flights(here, with_functions)
