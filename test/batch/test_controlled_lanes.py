"""Coordinated control in lanes is that of the controller, tick by tick in the plant."""

from __future__ import annotations

import dataclasses
import itertools
from typing import Any

import numpy as np
import pytest

from spacerobot_ros.batch import (
    BatchResult,
    Controlled,
    Decision,
    Flights,
    SensorErrors,
    Starts,
    fly_lanes,
    fly_one_by_one,
)
from spacerobot_ros.control.config import ControllerConfig
from spacerobot_ros.control.laws.law import GainPair, Gains
from spacerobot_ros.control.limits import MotionLimits
from spacerobot_ros.control.thrusters import ThrusterTable, thruster_table
from spacerobot_ros.errors import ParameterError
from spacerobot_ros.model import SpaceRobot, load_robot
from spacerobot_ros.model.compilation import cxx_compiler
from spacerobot_ros.model.description import Array
from spacerobot_ros.resources import share_directory
from spacerobot_ros.simulation import InitialState

needs_compiler = pytest.mark.skipif(cxx_compiler() is None, reason="there is no C++ compiler")

NUMBERS = (
    *("pose", "twist", "q", "qdot", "momentum", "measured_pose", "measured_q"),
    *("peak_rate", "peak_effort", "peak_wrench", "impulse", "lowest", "highest"),
    *("decision", "decided_tick", "decided_distance", "end_tick", "end_state"),
    "momentum_drift",
)

SHAPE = np.array([-1.0, 1.05])
BASE = np.array([0.05, -0.03, 0.0, 0.0, 0.0, 0.02, 0.9998])


def controlled(
    name: str,
    shape: Array,
    *,
    ticks: int,
    count: int = 9,
    end_effector: Array | None = None,
    noise: float = 1e-5,
    **parameters: Any,
) -> Flights:
    """Return flights to a pose nearby, each with other masses, noise, start and gains."""
    rng = np.random.default_rng(2)
    robot = SpaceRobot(load_robot(share_directory() / "urdf" / f"{name}.urdf"))
    wanted: dict[str, Any] = {"tick_rate": 100.0, "settle_time": 0.2, "profile": "quintic"}
    config = dataclasses.replace(ControllerConfig(), **(wanted | parameters))
    starts = Starts.repeated(robot, InitialState(joint_positions=shape), count)
    starts.position[:, :2] = 0.01 * rng.normal(size=(count, 2))
    sensors = SensorErrors.none(robot, count)
    sensors.noise[1:] = noise
    sensors.pose_bias[2:] = 1e-4
    sensors.seeds[:] = np.arange(count)
    pair = config.gains.base_position
    gains = tuple(
        dataclasses.replace(config.gains, base_position=GainPair(pair.kp * f, pair.kd))
        for f in rng.uniform(0.9, 1.1, count)
    )
    return Flights(
        *(robot, "effort", 0.01, ticks, starts),
        Controlled(config, base=BASE, end_effector=end_effector, gains=gains),
        robot.inertial.scaled(rng.uniform(0.95, 1.05, (count, len(robot.inertial.masses)))),
        sensors,
        instants=(0, ticks // 2, ticks),
    )


def assert_same(here: BatchResult, there: BatchResult) -> None:
    for name in NUMBERS:
        one, two = getattr(here, name), getattr(there, name)
        np.testing.assert_allclose(one, two, rtol=1e-12, atol=1e-12, err_msg=name)
    assert here.failures == there.failures == {}


@needs_compiler
def test_control_in_lanes_is_that_of_the_controller() -> None:
    flights = controlled(
        *("planar_manipulator", SHAPE),
        ticks=220,
        law="transposed_jacobian",
        position_tolerance=0.01,
        attitude_tolerance=0.02,
        gains=Gains.uniform(1000.0, 60.0),
        max_force=10.0,
        motion=MotionLimits(1.0, 1.0, 1.0, 1.0),
    )
    here, there = fly_lanes(flights), fly_one_by_one(flights)
    assert "lanes" in here.engine
    assert_same(here, there)
    assert not here.fallback_ticks.any()
    # Goals are reached at times of their own, and the force was at its limit.
    assert set(there.decision.tolist()) == {Decision.REACHED}
    assert len(set(there.decided_tick.tolist())) > 1
    np.testing.assert_allclose(there.peak_wrench[:, 0].max(), 10.0)


@needs_compiler
@pytest.mark.slow
def test_what_the_law_cannot_give_in_one_step_is_given_by_the_controller() -> None:
    """Through a singularity, and with joints that are held within a small rate."""
    cases: tuple[dict[str, Any], ...] = (
        {"law": "model_based", "shape": np.array([0.3, 0.02]), "gains": Gains.uniform(4.0, 4.0)},
        {
            **{"law": "model_based", "shape": SHAPE, "gains": Gains.uniform(4.0, 4.0)},
            **{"joint_rates": 0.02, "profile": "step"},
        },
    )
    for case in cases:
        shape = case.pop("shape")
        flights = controlled("planar_manipulator", shape, ticks=120, **case)
        here, there = fly_lanes(flights), fly_one_by_one(flights)
        assert_same(here, there)
        assert 0 < here.fallback_ticks.sum() <= 9 * 120


@needs_compiler
@pytest.mark.slow
def test_the_servicer_is_controlled_in_lanes() -> None:
    shape = np.array([0.0, -1.2, 2.0, 0.0, 0.8, 0.0])
    # The wrist is light: large gains of its attitude would shake it, and rounding would decide how.
    careful = Gains(
        *(GainPair(400.0, 900.0), GainPair(200.0, 400.0)),
        *(GainPair(200.0, 200.0), GainPair(3.0, 2.0)),
    )
    for law, gains in (
        ("transposed_jacobian", careful),
        ("model_based", Gains.uniform(1.0, 2.0)),
    ):
        flights = controlled("servicer", shape, ticks=100, law=law, gains=gains)
        assert_same(fly_lanes(flights), fly_one_by_one(flights))
    gains = Gains.uniform(4.0, 4.0)
    flights = controlled("servicer", shape, ticks=60, law="computed_torque", gains=gains)
    program = flights.program
    assert isinstance(program, Controlled)
    shaped = dataclasses.replace(program, base=None, joints=shape + 0.1)
    flights = dataclasses.replace(flights, program=shaped)
    here, there = fly_lanes(flights), fly_one_by_one(flights)
    assert_same(here, there)
    assert np.abs(here.q[:, -1] - shape).max() > 0.001


def thrusters(robot: SpaceRobot, force: float) -> ThrusterTable:
    """Return two thrusters at each of the eight corners of a cube on the base."""
    entries: list[dict[str, Any]] = []
    for corner in itertools.product((-0.4, 0.4), repeat=3):
        for axis in (0, 1):
            direction = [0.0, 0.0, 0.0]
            direction[axis] = -corner[axis]
            named = {"name": f"thruster_{len(entries)}", "position": list(corner)}
            entries.append({**named, "direction": direction, "force": force, "isp": 220.0})
    return thruster_table([{**each, "min_on_time": 0.01} for each in entries], robot.description)


@needs_compiler
@pytest.mark.slow
@pytest.mark.parametrize("force", [40.0, 8.0])
def test_thrusters_in_lanes_are_fired_as_by_the_modulator(force: float) -> None:
    """Until rounding decides about a pulse; the weak ones are at their limit at once."""
    flights = controlled(
        *("planar_manipulator", SHAPE),
        ticks=25,
        noise=0.0,
        profile="step",
        gains=Gains.uniform(1000.0, 60.0),
        max_force=10.0,
    )
    flights = dataclasses.replace(flights, thrusters=thrusters(flights.robot, force))
    here, there = fly_lanes(flights), fly_one_by_one(flights)
    assert "lanes" in here.engine
    for name in (*NUMBERS, "propellant"):
        one, two = getattr(here, name), getattr(there, name)
        np.testing.assert_allclose(one, two, rtol=1e-9, atol=1e-9, err_msg=name)
    assert there.propellant.min() > 0
    assert bool(here.fallback_ticks.any()) == (force < 10.0)


@needs_compiler
@pytest.mark.slow
def test_the_noise_of_a_flight_is_that_of_its_seed() -> None:
    """Of flights that are equal but for their seeds, those of one seed alone are equal."""
    flights = controlled(
        *("planar_manipulator", SHAPE),
        ticks=8,
        count=4,
        noise=1e-3,
        gains=Gains.uniform(30.0, 60.0),
    )
    assert flights.sensors is not None
    flights.starts.position[:], flights.sensors.pose_bias[:] = 0.0, 0.0
    flights.sensors.noise[:], flights.sensors.seeds[:] = 1e-3, [7, 8, 7, 9]
    program = flights.program
    assert isinstance(program, Controlled)
    alike = dataclasses.replace(
        flights, program=dataclasses.replace(program, gains=()), inertial=None
    )
    for result in (fly_lanes(alike), fly_one_by_one(alike)):
        for values in (result.measured_pose[:, -1], result.qdot[:, -1]):
            np.testing.assert_array_equal(values[0], values[2])
            others = (values[0], values[1], values[3])
            for one, other in itertools.combinations(others, 2):
                assert np.abs(one - other).max() > 1e-7


def test_a_controller_at_another_rate_is_refused() -> None:
    flights = controlled("planar_manipulator", SHAPE, ticks=5)
    with pytest.raises(ParameterError, match="another rate"):
        dataclasses.replace(flights, control_period=0.02)
