"""Flights of a batch are those of the plant: the scalar engine, and what batches refuse."""

from __future__ import annotations

import numpy as np
import pytest

from spacerobot_ros.batch import (
    Flights,
    FollowedSchedule,
    HeldCommands,
    InitialStates,
    fly_one_by_one,
)
from spacerobot_ros.errors import ParameterError, RobotDescriptionError
from spacerobot_ros.model import InertialParameters, SpaceRobot, load_robot
from spacerobot_ros.model.description import Inertia
from spacerobot_ros.resources import share_directory
from spacerobot_ros.simulation import InitialState


@pytest.fixture(scope="module")
def sliders() -> SpaceRobot:
    return SpaceRobot(load_robot(share_directory() / "urdf" / "sliding_masses.urdf"))


def test_a_heavier_slider_carries_the_base_further(sliders: SpaceRobot) -> None:
    """At zero momentum the centre of mass rests: M r_base = -sum m_k s_k, by hand."""
    positions = np.linspace([0.0, 0.0, 0.0], [0.2, 0.0, 0.0], 11)
    nominal = InertialParameters.of(sliders.description)
    inertial = nominal.scaled(masses=np.array([[1, 1, 1, 1], [1, 1.5, 1, 1.0]]), inertias=1.0)
    start = InitialState(joint_positions=np.zeros(3))
    flights = Flights(
        *(sliders, "velocity", 0.05, 10, InitialStates.repeated(sliders, start, 2)),
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
    with pytest.raises(RobotDescriptionError, match=r"base_link.*no body"):
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


def test_flights_that_do_not_go_together_are_refused(sliders: SpaceRobot) -> None:
    starts = InitialStates.repeated(sliders, InitialState(), 2)
    commands = HeldCommands(np.zeros((5, 3)))
    for arguments, sentence in (
        (("speed", 0.05, 10, starts, commands), "not velocity or effort"),
        (("velocity", 0.05, 0, starts, commands), "0 ticks"),
        (("velocity", 0.05, 10, starts, HeldCommands(np.zeros((5, 2)))), "joints are"),
        (("velocity", 0.05, 10, starts, HeldCommands(np.zeros((3, 5, 3)))), "3 flights"),
        (("effort", 0.05, 10, starts, FollowedSchedule(np.zeros((5, 3)))), "velocity actuation"),
    ):
        with pytest.raises(ParameterError, match=sentence):
            Flights(sliders, *arguments)
