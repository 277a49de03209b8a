"""Flights that are stepped are those of the plant, with starts and ends of their own."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest

from spacerobot_ros.batch import InitialStates, SteppedFlights
from spacerobot_ros.errors import CommandError, ParameterError, RobotDescriptionError
from spacerobot_ros.model import InertialParameters, SpaceRobot, load_robot
from spacerobot_ros.model.compilation import cxx_compiler
from spacerobot_ros.resources import robot_file
from spacerobot_ros.simulation.actuators import PLANTS
from spacerobot_ros.simulation.plant import InitialState, Plant

needs_compiler = pytest.mark.skipif(cxx_compiler() is None, reason="there is no C++ compiler")

STATES = "pose", "twist", "q", "qdot", "momentum"


@pytest.fixture(scope="module")
def sliders() -> SpaceRobot:
    return SpaceRobot(load_robot(robot_file("sliding_masses")))


def drawn_starts(robot: SpaceRobot, count: int, rng: np.random.Generator) -> InitialStates:
    starts = InitialStates.repeated(robot, InitialState(), count)
    lower, upper = np.maximum(robot.lower, -1.0), np.minimum(robot.upper, 1.0)
    starts.q[:] = lower + (upper - lower) * rng.uniform(0.2, 0.8, starts.q.shape)
    starts.position[:] = rng.normal(size=(count, 3))
    starts.quaternion[:] = rng.normal(size=(count, 4))
    starts.momenta[:] = 0.1 * rng.normal(size=(count, 6))
    return starts


def near_a_stop(robot: SpaceRobot, starts: InitialStates, rate: float) -> InitialStates:
    """Return starts whose first joint is about to arrive at its stop."""
    starts.q[:, 0], starts.qdot[:, 0] = robot.upper[0] - 0.002, rate
    return starts


def drawn_masses(robot: SpaceRobot, count: int, rng: np.random.Generator) -> InertialParameters:
    factors = rng.uniform(0.8, 1.2, (count, len(robot.description.bodies)))
    return robot.inertial.scaled(factors)


class OnePlant:
    """One plant a flight, driven by hand: the reference."""

    def __init__(self, flights: SteppedFlights, actuation: str, link: str) -> None:
        self.robot, self.period, self.kind = flights.robot, flights.control_period, actuation
        self.link = link
        self.plants: list[Plant] = []

    def make(self, starts: InitialStates, masses: InertialParameters, row: int) -> Plant:
        kind = PLANTS[self.kind]
        robot = self.robot.with_inertial(masses[row])
        initial = starts.initial_state(row)
        return kind.plant(robot, self.period, initial, kind.integration_step)

    def step(self, commands: np.ndarray, ticks: int) -> None:
        n = self.robot.n
        for plant, command in zip(self.plants, commands, strict=True):
            for _ in range(ticks):
                plant.step(*([command] if self.kind == "velocity" else [command[:n], command[n:]]))

    def compare(self, flights: SteppedFlights) -> None:
        for name in STATES:
            wanted = np.array([getattr(plant, name) for plant in self.plants])
            np.testing.assert_allclose(
                getattr(flights, name), wanted, rtol=1e-12, atol=1e-12, err_msg=name
            )
        for row, plant in enumerate(self.plants if self.link else []):
            R, r = plant.robot.link_pose(self.link, plant.q)
            np.testing.assert_allclose(flights.link_R[row], R, atol=1e-12)
            np.testing.assert_allclose(flights.link_r[row], r, atol=1e-12)


def fly_with_resets(
    robot: SpaceRobot,
    actuation: str,
    period: float,
    steps: int,
    *,
    in_lanes: bool,
    link: str,
    shifted: bool = False,
) -> tuple[SteppedFlights, int]:
    """Fly beside plants with resets, other masses and joint stops; return ticks on a stop.

    ``shifted``: from the middle on, centres of mass are beside axes on which they were before.
    """
    count, n, rng = 5, robot.n, np.random.default_rng(3)
    starts, masses = drawn_starts(robot, count, rng), drawn_masses(robot, count, rng)
    flights = SteppedFlights(robot, actuation, period, starts, masses, link=link, in_lanes=in_lanes)
    reference = OnePlant(flights, actuation, link)
    reference.plants = [reference.make(starts, masses, row) for row in range(count)]
    scale = np.concatenate(
        [
            1.2 * robot.velocity_limit
            if actuation == "velocity"
            else 0.02 * np.minimum(robot.effort_limit, 20.0),
            np.ones(flights.command_size - n),
        ]
    )
    age, at_stops = np.zeros(count, dtype=int), 0
    for step in range(steps):
        ticks = 1 + step % 3 // 2
        commands = scale * rng.normal(size=(count, flights.command_size))
        if step % 20 < 5:  # One joint is driven to its stop, to and fro.
            commands[:, 0] = scale[0] * (400.0 if actuation == "effort" else 1.0)
            commands[:, 0] *= 1.0 if step % 40 >= 20 else -1.0
        flights.step(commands, ticks)
        reference.step(commands, ticks)
        age += ticks
        if step % 7 == 4:
            rows = rng.permutation(count)[:2]
            rate = 0.1 if actuation == "effort" else 0.0
            again = near_a_stop(robot, drawn_starts(robot, 2, rng), rate)
            other = drawn_masses(robot, 2, rng) if step % 2 else None
            if other is not None and shifted and step > steps // 2:
                other = other.shifted(0.01 * rng.normal(size=other.centers.shape))
            flights.reset(rows, again, other)
            for place, row in enumerate(rows.tolist()):
                kept = InertialParameters.of(reference.plants[row].robot.description)
                each = InertialParameters.stacked([kept] * 2) if other is None else other
                reference.plants[row] = reference.make(again, each, place)
            age[rows] = 0
        reference.compare(flights)
        assert flights.ticks.tolist() == age.tolist()
        on = (flights.q <= robot.lower) | (flights.q >= robot.upper)
        at_stops += int(on.sum())
    assert flights.has_not_ended.all()
    assert flights.failures == {}
    np.testing.assert_allclose(flights.time, age * period)
    return flights, at_stops


@needs_compiler
@pytest.mark.parametrize(("actuation", "period"), [("velocity", 0.05), ("effort", 0.01)])
def test_stepped_lanes_are_plants_with_resets_and_other_masses(
    sliders: SpaceRobot, actuation: str, period: float
) -> None:
    flights, at_stops = fly_with_resets(sliders, actuation, period, 30, in_lanes=True, link="")
    assert "lanes" in flights.engine
    assert at_stops > 3


@needs_compiler
@pytest.mark.slow
def test_reaction_wheels_in_lanes_are_those_of_the_plant() -> None:
    robot, rng = SpaceRobot(load_robot(robot_file("tender"))), np.random.default_rng(4)
    wheels = np.array([name in robot.description.wheel_names for name in robot.joint_names])
    starts, masses = InitialStates.repeated(robot, InitialState(), 5), drawn_masses(robot, 5, rng)
    starts.q[:, ~wheels] = [0.9, -0.9, 1.6]
    starts.qdot[:, wheels] = 0.999 * robot.velocity_limit[wheels] * rng.choice([-1, 1], (5, 4))
    flights = SteppedFlights(robot, "effort", 0.02, starts, masses, link="base_link")
    assert "lanes" in flights.engine
    reference = OnePlant(flights, "effort", "")
    reference.plants = [reference.make(starts, masses, row) for row in range(5)]
    scale, at_limit = np.append(robot.effort_limit, np.ones(6)), 0
    for step in range(300):
        commands = scale * np.where(np.append(wheels, [False] * 6), 1.0, 0.01)
        commands = commands * rng.uniform(-1.0, 1.0, (5, 13)) * (1.0 if step % 50 < 25 else 0.1)
        commands[:, : robot.n][:, wheels] += 0.2 if step % 60 < 30 else -0.2
        flights.step(commands)
        reference.step(commands, 1)
        reference.compare(flights)
        at_limit += int((np.abs(flights.qdot) >= robot.velocity_limit)[:, wheels].sum())
    assert at_limit > 100


@pytest.fixture(params=[pytest.param(True, marks=needs_compiler), False], ids=["lanes", "plants"])
def three(request: pytest.FixtureRequest, sliders: SpaceRobot) -> SteppedFlights:
    starts = drawn_starts(sliders, 3, np.random.default_rng(5))
    return SteppedFlights(sliders, "effort", 0.01, starts, in_lanes=request.param)


def test_a_flight_that_is_ended_stays_where_it_is(three: SteppedFlights) -> None:
    commands = np.arange(27.0).reshape(3, 9) / 9
    three.step(commands)
    three.end([1])
    before = three.pose.copy()
    commands[1, 4] = np.nan  # Nobody looks at the command of a flight that has ended.
    three.step(commands, 2)
    assert three.has_not_ended.tolist() == [True, False, True]
    assert three.ticks.tolist() == [3, 1, 3]
    assert three.pose[1].tolist() == before[1].tolist()
    assert (three.pose[[0, 2]] != before[[0, 2]]).any(axis=1).all()
    three.reset([1], drawn_starts(three.robot, 1, np.random.default_rng(6)))
    assert three.has_not_ended.all()
    assert three.ticks.tolist() == [3, 0, 3]


def test_a_flight_that_fails_says_why_and_the_others_go_on(three: SteppedFlights) -> None:
    starts = drawn_starts(three.robot, 1, np.random.default_rng(7))
    starts.momenta[:] = 1e80
    three.reset(1, starts)
    commands = np.zeros((3, 9))
    for _ in range(3):
        three.step(commands)
    assert three.has_not_ended.tolist() == [True, False, True]
    assert list(three.failures) == [1]
    assert "no longer finite" in three.failures[1]
    assert three.ticks.tolist() == [3, 0, 3]
    three.reset([1], drawn_starts(three.robot, 1, np.random.default_rng(8)))
    three.step(commands)
    assert three.failures == {}
    assert three.ticks.tolist() == [4, 1, 4]
    assert np.isfinite(three.pose).all()


def test_bad_values_are_refused_and_change_nothing(three: SteppedFlights) -> None:
    robot, zero = three.robot, np.zeros((3, 9))
    one = drawn_starts(robot, 1, np.random.default_rng(9))
    outside = drawn_starts(robot, 1, np.random.default_rng(9))
    outside.q[0, 2] = 50.0
    before = three.q.copy()
    bad = zero.copy()
    bad[2, 8] = np.inf
    weightless = robot.inertial.scaled(np.full((1, 1), -1.0))
    refusals: list[tuple[Any, type[Exception], str]] = [
        (lambda: three.step(zero[:2]), ParameterError, r"The commands are \(2, 9\), not \(3, 9\)"),
        (lambda: three.step(zero, 0), ParameterError, "A step of 0 ticks is too short"),
        (lambda: three.step(bad), CommandError, "The command of flight 2 is not finite"),
        (lambda: three.reset([0, 1], one), ParameterError, "2 flights are reset to 1 starts"),
        (
            lambda: three.reset([0], one, drawn_masses(robot, 2, np.random.default_rng(1))),
            ParameterError,
            "1 flights are reset to 1 starts with 2 rows of masses",
        ),
        (lambda: three.reset([0], outside), ParameterError, "slider_3.* outside its limits"),
        (lambda: three.reset([0], one, weightless), RobotDescriptionError, "mass"),
    ]
    for refused, kind, message in refusals:
        with pytest.raises(kind, match=message):
            refused()
    np.testing.assert_array_equal(three.q, before)
    assert three.ticks.tolist() == [0, 0, 0]
    assert (len(three), three.command_size) == (3, 9)


def test_an_unknown_link_and_a_bad_start_are_refused(sliders: SpaceRobot) -> None:
    starts = drawn_starts(sliders, 2, np.random.default_rng(10))
    with pytest.raises(ParameterError, match=r"has no link 'hand'; it has: base_link, mass_1"):
        SteppedFlights(sliders, "velocity", 0.05, starts, link="hand", in_lanes=False)
    starts.q[1] = 50.0
    for in_lanes in (False, True):
        with pytest.raises(ParameterError, match="outside its limits"):
            SteppedFlights(sliders, "velocity", 0.05, starts, in_lanes=in_lanes)


def test_without_a_compiler_flights_are_plants(
    sliders: SpaceRobot, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("SPACEROBOT_COMPILE", "0")
    starts = drawn_starts(sliders, 2, np.random.default_rng(11))
    flights = SteppedFlights(sliders, "velocity", 0.04, starts)
    assert (flights.engine, flights.command_size) == ("scalar", 3)
    # Each start is that of its row.
    for row, (part, wanted) in itertools.product(range(2), [("q", starts.q)]):
        assert getattr(flights, part)[row].tolist() == wanted[row].tolist()
    assert flights.link_r.size == flights.link_R.size == 0
