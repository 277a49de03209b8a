"""Flights of a batch: what they are refused for, and the plant as their engine."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.plant_flights import fly_one_by_one, sensor_config
from support.targets import needs_compiler, on_targets, target_named

from spacerobot_ros.batch import (
    BatchResult,
    Flights,
    FollowedSchedule,
    HeldCommands,
    InitialStates,
    SensorErrors,
    SteppedFlights,
)
from spacerobot_ros.batch.flights import NOISES
from spacerobot_ros.errors import CommandError, ParameterError, RobotDescriptionError
from spacerobot_ros.model import InertialParameters, SpaceRobot, load_robot
from spacerobot_ros.model.description import Inertia
from spacerobot_ros.resources import robot_file
from spacerobot_ros.simulation import InitialState
from spacerobot_ros.simulation.actuators import PLANTS
from spacerobot_ros.simulation.config import SensorConfig
from spacerobot_ros.simulation.plant import Plant

pytestmark = pytest.mark.usefixtures("compiled")


@pytest.fixture(scope="module")
def sliders() -> SpaceRobot:
    return SpaceRobot(load_robot(robot_file("sliding_masses")))


def flights(sliders: SpaceRobot, program: Any, **changes: Any) -> Flights:
    """Return two flights of 10 ticks under velocity commands, but for what is given."""
    starts = InitialStates.of(sliders, [InitialState()] * 2)
    chosen = {"actuation": "velocity", "ticks": 10, "initial_states": starts, **changes}
    return Flights(robot=sliders, control_period=0.05, program=program, **chosen)


STILL, RELAXED = HeldCommands(np.zeros((5, 3))), HeldCommands(np.zeros((5, 9)))
NOT_A_NUMBER = np.zeros((2, 5, 3))
NOT_A_NUMBER[1, 2, 0] = np.nan


@pytest.mark.parametrize(
    ("program", "changes", "sentence"),
    [
        (STILL, {"actuation": "speed"}, "The actuation is 'speed', not velocity or effort."),
        (STILL, {"ticks": 0}, "A flight of 0 ticks is too short: use at least 1."),
        (STILL, {"report_ticks": (0, 5, 11)},
         "The instants (0, 5, 11) are not ascending ticks of a flight of 10 ticks."),
        (STILL, {"report_ticks": (0, 5, 5)},
         "The instants (0, 5, 5) are not ascending ticks of a flight of 10 ticks."),
        (STILL, {"report_ticks": (-1, 5)},
         "The instants (-1, 5) are not ascending ticks of a flight of 10 ticks."),
        (STILL, {"sensors": range(3)}, "There are sensors for 3 flights, not 2."),
        (FollowedSchedule(np.zeros((5, 3))), {"actuation": "effort"},
         "A schedule requires velocity actuation."),
        (FollowedSchedule(np.zeros((5, 2))), {},
         "The positions have shape (5, 2), not (ticks, 3)."),
        (FollowedSchedule(np.zeros((3, 5, 3))), {}, "There are positions for 3 flights, not 2."),
        (HeldCommands(np.zeros(3)), {}, "The commands have shape (3,), not (ticks, 3)."),
        (HeldCommands(np.zeros((1, 1, 2, 3))), {},
         "The commands have shape (1, 1, 2, 3), not (ticks, 3)."),
        (HeldCommands(np.zeros((0, 3))), {}, "The commands have shape (0, 3), not (ticks, 3)."),
        (HeldCommands(NOT_A_NUMBER), {}, "The commands contain a value that is not finite."),
        (RELAXED, {}, "The commands have shape (5, 9), not (ticks, 3)."),
        (STILL, {"actuation": "effort"}, "The commands have shape (5, 3), not (ticks, 9)."),
    ],
)  # fmt: skip
def test_flights_are_refused_in_one_sentence(
    sliders: SpaceRobot, program: Any, changes: dict[str, Any], sentence: str
) -> None:
    with pytest.raises(ParameterError) as refusal:
        flights(sliders, program, **changes)
    assert str(refusal.value) == sentence


def test_masses_are_those_of_all_bodies_of_all_flights(sliders: SpaceRobot) -> None:
    nominal = InertialParameters.of(sliders.description)
    three = nominal.scaled(np.ones((3, 1)))
    with pytest.raises(ParameterError) as refusal:
        flights(sliders, STILL, inertial=three)
    assert str(refusal.value) == "The masses have shape (3, 4), not (2, 4)."
    two = flights(sliders, STILL, inertial=nominal.scaled(np.array([[1.0], [2.0]])))
    assert two.robot_of(1).total_mass == pytest.approx(2 * two.robot_of(0).total_mass)
    assert flights(sliders, STILL).robot_of(1) is sliders


def test_joints_that_move_at_the_start_need_efforts(sliders: SpaceRobot) -> None:
    moving = InitialState(joint_velocities=np.array([0.0, 0.1, 0.0]))
    starts = InitialStates.of(sliders, [InitialState(), moving])
    with pytest.raises(ParameterError) as refusal:
        flights(sliders, STILL, initial_states=starts)
    assert str(refusal.value) == "Joints under velocity commands must start at rest."
    assert len(flights(sliders, RELAXED, initial_states=starts, actuation="effort")) == 2


def test_flights_have_their_last_tick_and_the_steps_of_their_plant(sliders: SpaceRobot) -> None:
    plain = flights(sliders, STILL)
    assert (plain.report_ticks, len(plain)) == ((10,), 2)
    assert flights(sliders, STILL, report_ticks=(0, 4, 10)).report_ticks == (0, 4, 10)
    assert plain.substeps == 5
    assert flights(sliders, RELAXED, actuation="effort").substeps == 50
    assert flights(sliders, STILL, integration_step=0.02).substeps == 3
    assert flights(sliders, STILL, integration_step=0.05).substeps == 1


def test_one_row_of_commands_is_enough(sliders: SpaceRobot) -> None:
    assert len(flights(sliders, HeldCommands(np.zeros((1, 3))))) == 2
    assert len(flights(sliders, HeldCommands(np.zeros((2, 1, 3))))) == 2
    assert len(flights(sliders, STILL, ticks=1)) == 2


def test_starts_are_rows_of_initial_states(sliders: SpaceRobot) -> None:
    first = InitialState(
        position=np.array([1.0, 2.0, 3.0]),
        quaternion=np.array([0.0, 0.6, 0.0, 0.8]),
        joint_positions=np.array([0.1, 0.2, 0.3]),
        joint_velocities=np.array([0.01, 0.02, 0.03]),
        linear_momentum=np.array([4.0, 5.0, 6.0]),
        angular_momentum=np.array([7.0, 8.0, 9.0]),
    )
    second = InitialState(center_of_mass=np.array([-1.0, -2.0, -3.0]))
    starts = InitialStates.of(sliders, [first, second])
    assert starts.position.tolist() == [[1, 2, 3], [-1, -2, -3]]
    assert starts.quaternion.tolist() == [[0, 0.6, 0, 0.8], [0, 0, 0, 1]]
    assert starts.q[0].tolist() == [0.1, 0.2, 0.3]
    assert starts.qdot.tolist() == [[0.01, 0.02, 0.03], [0, 0, 0]]
    assert starts.momenta.tolist() == [[4, 5, 6, 7, 8, 9], [0] * 6]
    assert starts.position_is_of_center_of_mass.tolist() == [False, True]
    for index, wanted in enumerate((first, second)):
        again = InitialStates.of(sliders, [starts.initial_state(index)])
        once = InitialStates.of(sliders, [wanted])
        for each in dataclasses.fields(InitialStates):
            assert getattr(again, each.name).tolist() == getattr(once, each.name).tolist()
    three = InitialStates.repeated(sliders, first, 3)
    assert (len(three), three.momenta.shape, three.position_is_of_center_of_mass.shape) == (
        3,
        (3, 6),
        (3,),
    )
    three.q[1] = 0.0
    assert three.q[2].tolist() == [0.1, 0.2, 0.3]


def test_sensors_are_rows_of_configurations(sliders: SpaceRobot) -> None:
    one = SensorConfig(
        **dict(zip(NOISES, [0.1, 0.2, 0.3, 0.4, 0.5, 0.6], strict=True)),
        position_bias=(1.0, 2.0, 3.0),
        attitude_bias=(4.0, 5.0, 6.0),
        joint_bias=(7.0, 8.0, 9.0),
        seed=17,
    )
    errors = SensorErrors.of(sliders, [SensorConfig(seed=3), one])
    assert errors.noise.tolist() == [[0.0] * 6, [0.1, 0.2, 0.3, 0.4, 0.5, 0.6]]
    assert errors.pose_bias.tolist() == [[0.0] * 6, [1, 2, 3, 4, 5, 6]]
    assert errors.joint_bias.tolist() == [[0.0] * 3, [7, 8, 9]]
    assert (errors.seeds.tolist(), len(errors)) == ([3, 17], 2)
    assert sensor_config(errors, 1) == one
    assert errors.is_active.tolist() == [False, True]
    none = SensorErrors.of(sliders, [SensorConfig()] * 4)
    assert (len(none), none.noise.shape, none.pose_bias.shape) == (4, (4, 6), (4, 6))
    assert none.joint_bias.shape == (4, 3)
    assert none.seeds.tolist() == [0] * 4
    assert not none.is_active.any()
    none.noise[0, 5], none.pose_bias[1, 5], none.joint_bias[2, 0] = 1e-9, -1e-9, 1e-9
    assert none.is_active.tolist() == [True, True, True, False]
    # The order of the groups is that in which the plant's sensors name them.
    assert [name.rpartition("_")[2] for name in NOISES] == ["noise"] * 6


def test_results_begin_empty(sliders: SpaceRobot) -> None:
    made = flights(sliders, STILL, report_ticks=(0, 4, 10))
    made.initial_states.q[1] = 0.125
    result = BatchResult.empty(made)
    np.testing.assert_allclose(result.time, [0.0, 0.2, 0.5])
    shapes = {"pose": 7, "twist": 6, "q": 3, "qdot": 3, "momentum": 7, "measured_pose": 7}
    for name, width in {**shapes, "measured_q": 3}.items():
        assert getattr(result, name).shape == (2, 3, width)
        assert np.isnan(getattr(result, name)).all()
    shapes = {"peak_rate": 3, "peak_effort": 3, "peak_wrench": 2}
    for name, width in shapes.items():
        assert getattr(result, name).tolist() == [[0.0] * width] * 2
    for name, width in {"decision_distance": 3, "end_state": 26, "momentum_drift": 2}.items():
        assert getattr(result, name).shape == (2, width)
        assert np.isnan(getattr(result, name)).all()
    assert {name: each.tolist() for name, each in result.limited_ticks.items()} == {
        "rate": [[0] * 3] * 2,
        "stroke": [[0] * 3] * 2,
    }
    assert (result.decision.tolist(), result.decision_tick.tolist()) == ([0, 0], [-1, -1])
    assert (result.end_tick.tolist(), result.fallback_ticks.tolist()) == ([10, 10], [0, 0])
    for limits in (result.lowest, result.highest):
        assert limits.tolist() == made.initial_states.q.tolist()
        limits[0] = 9.0
        assert not (made.initial_states.q == 9.0).any()
    efforts = flights(sliders, RELAXED, actuation="effort")
    assert list(BatchResult.empty(efforts).limited_ticks) == ["effort", "stroke"]


def test_errors_are_distances_and_angles_to_a_pose(sliders: SpaceRobot) -> None:
    rng, rotations = np.random.default_rng(6), Rotation.random(6, random_state=2)
    result = BatchResult.empty(flights(sliders, STILL, report_ticks=(0, 4, 10)))
    result.pose[:] = np.hstack([rng.normal(size=(6, 3)), rotations.as_quat()]).reshape(2, 3, 7)
    one = Rotation.from_quat([0.5, -0.1, 0.2, 0.4])
    distance, angle = result.errors(np.array([1.0, -2.0, 0.5]), one.as_quat())
    moved = result.pose.reshape(6, 7)[:, :3] - [1.0, -2.0, 0.5]
    np.testing.assert_allclose(distance.ravel(), np.sqrt((moved**2).sum(axis=1)))
    np.testing.assert_allclose(angle.ravel(), (one.inv() * rotations).magnitude(), rtol=1e-12)
    # One pose for each flight, here those of its second instant.
    goals = result.pose[:, 1]
    distance, angle = result.errors(goals[:, :3], goals[:, 3:])
    np.testing.assert_allclose(distance[:, 1], 0.0)
    np.testing.assert_allclose(angle[:, 1], 0.0, atol=1e-15)
    between = (rotations[4].inv() * rotations[3]).magnitude()
    assert angle[1, 0] == pytest.approx(between, rel=1e-12)
    assert angle.shape == distance.shape == (2, 3)


# -- flights of a batch are those of the plant: the scalar engine, and what batches refuse -------


def test_a_heavier_slider_carries_the_base_further(sliders: SpaceRobot) -> None:
    """At zero momentum the centre of mass rests: M r_base = -sum m_k s_k, by hand."""
    positions = np.linspace([0.0, 0.0, 0.0], [0.2, 0.0, 0.0], 11)
    nominal = InertialParameters.of(sliders.description)
    inertial = nominal.scaled(masses=np.array([[1, 1, 1, 1], [1, 1.5, 1, 1.0]]), inertias=1.0)
    start = InitialState(joint_positions=np.zeros(3))
    flights = Flights(
        *(sliders, "velocity", 0.05, 10, InitialStates.of(sliders, [start] * 2)),
        FollowedSchedule(positions),
        inertial,
    )
    result = fly_one_by_one(flights)
    # The first slider stands off the base's axis and turns it: compare the centre of mass itself.
    for row, robot in enumerate((flights.robot_of(0), flights.robot_of(1))):
        assert robot.total_mass == pytest.approx(16.0 + row)
        np.testing.assert_allclose(result.q[row, 0], [0.2, 0, 0], atol=1e-12)
        np.testing.assert_allclose(result.momentum[row, 0, :6], 0.0, atol=1e-12)
    moved = np.linalg.norm(result.pose[:, 0, :3], axis=1)
    assert moved[1] > 1.2 * moved[0] > 0.0


def test_what_no_body_weighs_is_refused(sliders: SpaceRobot) -> None:
    nominal = InertialParameters.of(sliders.description)
    with pytest.raises(RobotDescriptionError, match=r"mass_2.*must be positive"):
        sliders.with_inertial(nominal.scaled([1.0, 1.0, -0.1, 1.0]))
    broken = nominal.inertias.copy()
    broken[0] = np.diag([1.0, 1.0, 2.1])
    with pytest.raises(RobotDescriptionError, match=r"base_link.*not physical"):
        sliders.with_inertial(InertialParameters(nominal.masses, nominal.centers, broken))
    with pytest.raises(RobotDescriptionError, match=r"mass_1.*not finite"):
        sliders.with_inertial(nominal.shifted(np.diag([0.0, np.nan, 0.0, 0.0])[:, :3]))


def test_a_payload_is_welded_on(sliders: SpaceRobot) -> None:
    nominal = InertialParameters.of(sliders.description)
    payload = Inertia(2.0, np.array([0.0, 0.3, 0.0]), np.diag([0.1, 0.2, 0.25]))
    loaded = nominal.with_payload(1, payload)
    assert loaded.masses[1] == 4.0
    np.testing.assert_allclose(loaded.centers[1], [0.0, 0.15, 0.0])
    # Two masses of 2 kg, 0.3 m apart: reduced mass 1 kg.
    np.testing.assert_allclose(loaded.inertias[1], np.diag([0.19, 0.2, 0.34]))
    again = InertialParameters.of(sliders.with_inertial(loaded).description)
    np.testing.assert_array_equal(again.vector, loaded.vector)


STATES = "pose", "twist", "q", "qdot", "momentum"


def drawn_starts(robot: SpaceRobot, count: int, rng: np.random.Generator) -> InitialStates:
    starts = InitialStates.repeated(robot, InitialState(), count)
    lower, upper = np.maximum(robot.lower, -1.0), np.minimum(robot.upper, 1.0)
    starts.q[:] = lower + (upper - lower) * rng.uniform(0.2, 0.8, starts.q.shape)
    starts.position[:] = rng.normal(size=(count, 3))
    starts.quaternion[:] = rng.normal(size=(count, 4))
    starts.momenta[:] = 0.1 * rng.normal(size=(count, 6))
    return starts


def drawn_masses(robot: SpaceRobot, count: int, rng: np.random.Generator) -> InertialParameters:
    factors = rng.uniform(0.8, 1.2, (count, len(robot.description.bodies)))
    return robot.inertial.scaled(factors)


class OnePlant:
    """One plant a flight, driven by hand: the reference."""

    def __init__(
        self, flights: SteppedFlights, actuation: str, starts: InitialStates, masses: Any
    ) -> None:
        self.robot, self.period, self.kind = flights.robot, flights.control_period, actuation
        self.plants = [self.make(starts, masses, row) for row in range(len(starts))]

    def make(self, starts: InitialStates, masses: InertialParameters, row: int) -> Plant:
        robot = self.robot.with_inertial(masses[row])
        return PLANTS[self.kind](robot, self.period, starts.initial_state(row))

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


@on_targets("registers", "threads")
@pytest.mark.parametrize(("actuation", "period"), [("velocity", 0.05), ("effort", 0.01)])
def test_stepped_lanes_are_plants_with_resets_and_other_masses(
    sliders: SpaceRobot, target_name: str, actuation: str, period: float
) -> None:
    """Joints arrive at their stops."""
    target, count, n, rng = target_named(target_name), 5, sliders.n, np.random.default_rng(3)
    starts, masses = drawn_starts(sliders, count, rng), drawn_masses(sliders, count, rng)
    flights = SteppedFlights(
        *(sliders, actuation, period, starts, masses), in_lanes=True, target=target
    )
    assert flights.engine == target.engine
    reference = OnePlant(flights, actuation, starts, masses)
    by_effort = actuation == "effort"
    most = 0.02 * np.minimum(sliders.effort_limit, 20.0)
    scale = np.append(
        most if by_effort else 1.2 * sliders.velocity_limit, np.ones(flights.command_size - n)
    )
    age, at_stops = np.zeros(count, dtype=int), 0
    for step in range(30):
        ticks = 1 + step % 3 // 2
        commands = scale * rng.normal(size=(count, flights.command_size))
        if step % 20 < 5:  # One joint is driven to its stop, to and fro.
            commands[:, 0] = scale[0] * (400.0 if by_effort else 1.0)
            commands[:, 0] *= 1.0 if step % 40 >= 20 else -1.0
        flights.step(commands, ticks)
        reference.step(commands, ticks)
        age += ticks
        if step % 7 == 4:
            rows = rng.permutation(count)[:2]
            again = drawn_starts(sliders, 2, rng)
            # The first joint is about to arrive at its stop.
            again.q[:, 0], again.qdot[:, 0] = sliders.upper[0] - 0.002, 0.1 * by_effort
            other = drawn_masses(sliders, 2, rng) if step % 2 else None
            flights.reset(rows, again, other)
            for place, row in enumerate(rows.tolist()):
                kept = InertialParameters.of(reference.plants[row].robot.description)
                each = InertialParameters.stacked([kept] * 2) if other is None else other
                reference.plants[row] = reference.make(again, each, place)
            age[rows] = 0
        reference.compare(flights)
        assert flights.ticks.tolist() == age.tolist()
        on = (flights.q <= sliders.lower) | (flights.q >= sliders.upper)
        at_stops += int(on.sum())
    assert flights.has_not_ended.all()
    assert flights.failures == {}
    np.testing.assert_allclose(flights.time, age * period)
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
    reference = OnePlant(flights, "effort", starts, masses)
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
        (lambda: three.step(zero[:2]), ParameterError, r"have shape \(2, 9\), not \(3, 9\)"),
        (lambda: three.step(zero, 0), ParameterError, "A step of 0 ticks is too short"),
        (lambda: three.step(bad), CommandError, "The command for flight 2 is not finite"),
        (
            lambda: three.reset([0, 1], one),
            ParameterError,
            r"A reset of 2 flights has 1 start state",
        ),
        (
            lambda: three.reset([0], one, drawn_masses(robot, 2, np.random.default_rng(1))),
            ParameterError,
            r"A reset of 1 flight has 1 start state and 2 rows of masses",
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
    with pytest.raises(
        ParameterError, match=r"has no link 'hand'; its links are: base_link, mass_1"
    ):
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
    np.testing.assert_array_equal(flights.q, starts.q)
    assert flights.link_r.size == 0
