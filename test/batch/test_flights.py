"""What flights of a batch are refused for, word by word, and what they have by default."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from spacerobot_ros.batch import Controlled, Flights, FollowedSchedule, HeldCommands, Starts
from spacerobot_ros.errors import ParameterError
from spacerobot_ros.model import InertialParameters, SpaceRobot, load_robot
from spacerobot_ros.resources import robot_file
from spacerobot_ros.simulation import InitialState


@pytest.fixture(scope="module")
def sliders() -> SpaceRobot:
    return SpaceRobot(load_robot(robot_file("sliding_masses")))


def flights(sliders: SpaceRobot, program: Any, **changes: Any) -> Flights:
    """Return two flights of 10 ticks under velocity commands, but for what is given."""
    starts = Starts.repeated(sliders, InitialState(), 2)
    chosen: dict[str, Any] = {"actuation": "velocity", "ticks": 10, "starts": starts, **changes}
    actuation, ticks, starts = (chosen.pop(name) for name in ("actuation", "ticks", "starts"))
    return Flights(sliders, actuation, 0.05, ticks, starts, program, **chosen)


STILL = HeldCommands(np.zeros((5, 3)))
NOT_A_NUMBER = np.zeros((2, 5, 3))
NOT_A_NUMBER[1, 2, 0] = np.nan


def controlled(period: float = 0.05, gains: tuple[object, ...] = ()) -> Controlled:
    made: Any = object.__new__(Controlled)
    object.__setattr__(made, "config", SimpleNamespace(control_period=period))
    object.__setattr__(made, "gains", gains)
    result: Controlled = made
    return result


@pytest.mark.parametrize(
    ("program", "changes", "sentence"),
    [
        (STILL, {"actuation": "speed"}, "The actuation is 'speed', not velocity or effort."),
        (STILL, {"ticks": 0}, "A flight of 0 ticks is too short; it needs one."),
        (STILL, {"instants": (0, 5, 11)},
         "The instants (0, 5, 11) are not ascending ticks of a flight of 10."),
        (STILL, {"instants": (0, 5, 5)},
         "The instants (0, 5, 5) are not ascending ticks of a flight of 10."),
        (STILL, {"instants": (-1, 5)},
         "The instants (-1, 5) are not ascending ticks of a flight of 10."),
        (STILL, {"sensors": range(3)}, "There are sensors of 3 flights, not 2."),
        (STILL, {"thrusters": SimpleNamespace(names=("a",))},
         "Only the wrench of a controller can come from thrusters."),
        (FollowedSchedule(np.zeros((5, 3))), {"actuation": "effort"},
         "A schedule needs velocity actuation."),
        (FollowedSchedule(np.zeros((5, 2))), {}, "The joints are (5, 2), not (ticks, 3)."),
        (FollowedSchedule(np.zeros((3, 5, 3))), {}, "There are joints of 3 flights, not 2."),
        (HeldCommands(np.zeros(3)), {}, "The joints are (3,), not (ticks, 3)."),
        (HeldCommands(np.zeros((0, 3))), {}, "The joints are (0, 3), not (ticks, 3)."),
        (HeldCommands(NOT_A_NUMBER), {}, "The joints have a number that is not finite."),
        (HeldCommands(np.zeros((5, 3)), np.zeros((5, 6))), {},
         "A wrench on the base needs effort actuation."),
        (HeldCommands(np.zeros((5, 3)), np.zeros((5, 5))), {"actuation": "effort"},
         "The wrench are (5, 5), not (ticks, 6)."),
        (controlled(), {}, "A controller needs effort actuation."),
        (controlled(0.0500001), {"actuation": "effort"},
         "The controller has another rate than the plant."),
        (controlled(gains=(1, 2, 3)), {"actuation": "effort"},
         "There are gains of 3 flights, not 2."),
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
    assert str(refusal.value) == "The masses are (3, 4), not 2 flights of 4 bodies."
    two = flights(sliders, STILL, inertial=nominal.scaled(np.array([[1.0], [2.0]])))
    assert two.robot_of(1).total_mass == pytest.approx(2 * two.robot_of(0).total_mass)
    assert flights(sliders, STILL).robot_of(1) is sliders


def test_joints_that_move_at_the_start_need_efforts(sliders: SpaceRobot) -> None:
    moving = InitialState(joint_velocities=np.array([0.0, 0.1, 0.0]))
    starts = Starts.of(sliders, [InitialState(), moving])
    with pytest.raises(ParameterError) as refusal:
        flights(sliders, STILL, starts=starts)
    assert str(refusal.value) == "Joints under velocity commands must start at rest."
    assert len(flights(sliders, STILL, starts=starts, actuation="effort")) == 2


def test_flights_have_their_last_tick_and_the_steps_of_their_plant(sliders: SpaceRobot) -> None:
    plain = flights(sliders, STILL)
    assert (plain.instants, plain.thruster_count, len(plain)) == ((10,), 0, 2)
    assert flights(sliders, STILL, instants=(0, 4, 10)).instants == (0, 4, 10)
    assert flights(sliders, STILL, integration_step=0.02).substeps == 3
    assert flights(sliders, STILL, integration_step=0.05).substeps == 1
