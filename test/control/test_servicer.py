"""A spatial robot with a six-joint arm: spacecraft and end-effector fly to their goals together."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from control.flights import (
    END_EFFECTOR,
    INVERTIBLE,
    SERVICER_GAINS,
    SERVICER_GOAL,
    SERVICER_PACE,
    SERVICER_SLOW_PACE,
    Flight,
    fly,
    law_of,
    load,
    plant_of,
    scaled_robot,
    servicer_start,
)
from control.pinocchio_plant import PinocchioPlant
from scipy.spatial.transform import Rotation
from support.slow import some_fast

from spacerobot_ros.control import (
    PROFILES,
    ActuatorLimits,
    MotionLimits,
    PoseReference,
    Reference,
    ReferenceProfile,
)
from spacerobot_ros.model import SpaceRobot

MILLIMETRE = 1e-3
TENTH_OF_A_DEGREE = np.radians(0.1)


def profile_of(name: str, pace: MotionLimits = SERVICER_PACE) -> ReferenceProfile:
    present = Reference.present(load("servicer"), servicer_start(), END_EFFECTOR)
    return PROFILES[name](present, SERVICER_GOAL, pace)


def assert_arrived(plant: PinocchioPlant) -> None:
    """Both poses to 1 mm and 0.1 deg, as Pinocchio has them."""
    for link, goal in (
        ("base_link", SERVICER_GOAL.base),
        (END_EFFECTOR, SERVICER_GOAL.end_effector),
    ):
        assert isinstance(goal, PoseReference)
        position, attitude = plant.frame(link)
        turn = Rotation.from_quat(goal.quaternion) * Rotation.from_matrix(attitude).inv()
        assert np.linalg.norm(position - goal.position) < MILLIMETRE, link
        assert turn.magnitude() < TENTH_OF_A_DEGREE, link


def flown(
    name: str,
    profile: ReferenceProfile,
    settling: float,
    *,
    believed: SpaceRobot | None = None,
    limits: ActuatorLimits | None = None,
    rate: float = 100.0,
) -> Flight:
    """Fly the profile and some time longer; both poses must have been reached by then."""
    robot = load("servicer")
    law = law_of(name, believed or robot, SERVICER_GAINS[name])
    plant = plant_of(robot, servicer_start())
    duration = profile.duration + settling
    flight = fly(plant, law, profile.at, duration, rate, limits=limits, every=5)
    assert_arrived(plant)
    return flight


@pytest.mark.slow
@pytest.mark.parametrize("name", INVERTIBLE)
def test_both_poses_are_reached(name: str) -> None:
    robot, profile = load("servicer"), profile_of("quintic")
    assert profile.duration == pytest.approx(24.7, abs=0.05)
    flight = flown(name, profile, 5.0)
    assert flight.peak_force < 5.1
    assert flight.peak_torque < 1.5
    for state, actuation, status in zip(
        flight.states, flight.actuations, flight.statuses, strict=True
    ):
        assert np.all((robot.lower < state.q) & (state.q < robot.upper))
        assert np.all(np.abs(state.qdot) < robot.velocity_limit)
        assert np.all(np.abs(actuation.tau) < robot.effort_limit)
        assert not status.singular


@pytest.mark.slow
@pytest.mark.parametrize("name", INVERTIBLE)
def test_both_poses_are_reached_with_a_tenth_of_the_thrust(name: str) -> None:
    """The goal at once, and thrusters that give a tenth of what that demands."""
    robot = load("servicer")
    first = law_of(name, robot, SERVICER_GAINS[name]).command(servicer_start(), SERVICER_GOAL)
    force, torque = (float(np.linalg.norm(part)) / 10 for part in np.split(first.wrench_B, 2))
    limits = ActuatorLimits(force, torque, np.full(robot.n, np.inf))
    flight = flown(name, profile_of("step"), 22.0, limits=limits)
    assert flight.peak_force < force * (1 + 1e-9)
    assert flight.peak_torque < torque * (1 + 1e-9)
    assert flight.limited > 100


@pytest.mark.slow
@pytest.mark.parametrize("name", INVERTIBLE)
def test_a_smooth_reference_is_slowed_to_a_tenth_of_the_thrust(name: str) -> None:
    """Demand falls with the square of the time taken."""
    force, torque = {"transposed_jacobian": (0.49, 0.136), "model_based": (0.47, 0.126)}[name]
    limits = ActuatorLimits(force, torque, load("servicer").effort_limit)
    profile = profile_of("quintic", SERVICER_SLOW_PACE)
    assert profile.duration == pytest.approx(87.3, abs=0.1)
    flight = flown(name, profile, 5.0, limits=limits)
    assert flight.limited == 0


def ten_percent_heavier() -> Callable[[], float]:
    return lambda: 1.1


def ten_percent_either_way() -> Callable[[], float]:
    rng = np.random.default_rng(1)
    return lambda: float(rng.uniform(0.9, 1.1))


@pytest.mark.parametrize(
    "error", some_fast([ten_percent_heavier, ten_percent_either_way], ten_percent_either_way)
)
@pytest.mark.parametrize("profile", ["quintic", "step"])
def test_both_poses_are_reached_with_wrong_masses(
    error: Callable[[], Callable[[], float]], profile: str
) -> None:
    """Law (27) believes other masses and inertias; law (29) knows none."""
    believed = scaled_robot(load("servicer"), error())
    settling = 12.0 if profile == "step" else 5.0
    flown("model_based", profile_of(profile), settling, believed=believed, rate=50.0)
