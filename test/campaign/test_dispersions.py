"""What is drawn is read back from what the plant did: each kind of dispersion by itself."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.campaigns import campaign, flown

from spacerobot_ros.campaign.targets import description_of
from spacerobot_ros.events import EventKind
from spacerobot_ros.flight.flight import Flight
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.scenario import load_scenario

ROBOT = description_of(load_scenario("faults/stuck_slider"))
BODIES = [body.name for body in ROBOT.bodies]

Check = Callable[[Flight, dict[str, Any]], None]

COAST = {"plant.linear_momentum": [3.0, 0.0, 0.0], "planner.max_corrections": 0}
SPIN = {"plant.angular_momentum": [0.0, 0.0, 0.2], "planner.max_corrections": 0}


def factors(kind: str, drawn: dict[str, Any]) -> np.ndarray:
    return np.array([drawn.get(f"{kind}.{name}", 1.0) for name in BODIES])


def centres() -> np.ndarray:
    """Centres of mass of the bodies in the base at the start, where all sliders are at zero."""
    robot = SpaceRobot(ROBOT)
    poses = [robot.link_pose(body.name, np.zeros(3)) for body in ROBOT.bodies]
    return np.array(
        [r + R @ body.inertia.com for (R, r), body in zip(poses, ROBOT.bodies, strict=True)]
    )


MASSES = np.array([body.inertia.mass for body in ROBOT.bodies])


def mass_from_momentum(flight: Flight, drawn: dict[str, Any]) -> None:
    """At rest all bodies move alike: p = m v."""
    mass = 3.0 / flight.twist[0, 0]
    assert mass == pytest.approx(factors("mass", drawn) @ MASSES, rel=1e-12)


def inertia_from_angular_momentum(flight: Flight, drawn: dict[str, Any]) -> None:
    """At rest the robot spins as one body: L = I omega, of which the third row is known."""
    r = centres() - MASSES @ centres() / MASSES.sum()
    tensor = np.zeros((3, 3))
    for body, x, factor in zip(ROBOT.bodies, r, factors("inertia", drawn), strict=True):
        steiner = body.inertia.mass * (x @ x * np.eye(3) - np.outer(x, x))
        tensor += factor * body.inertia.about_com + steiner
    np.testing.assert_allclose(tensor @ flight.twist[0, 3:], [0, 0, 0.2], atol=1e-13)


def centre_of_mass_from_spin(flight: Flight, drawn: dict[str, Any]) -> None:
    """The base's origin goes round the centre of mass: v = -omega x r_BC."""
    offsets = [[drawn.get(f"com.{name}.{axis}", 0.0) for axis in "xyz"] for name in BODIES]
    r_BC = MASSES @ (centres() + np.array(offsets)) / MASSES.sum()
    v, omega = flight.twist[0, :3], flight.twist[0, 3:]
    np.testing.assert_allclose(v, -np.cross(omega, r_BC), atol=1e-14)


def noise_from_statistics(flight: Flight, drawn: dict[str, Any]) -> None:
    errors = flight.quantities["measured_pose"][:, :3] - flight.pose[:, :3]
    sigma = drawn["plant.sensors.position_noise"]
    # Of 200 numbers and more the standard deviation is known to 5 %.
    assert errors.size > 200
    assert errors.std() == pytest.approx(sigma, rel=0.2)
    assert abs(errors.mean()) < 0.3 * sigma


def bias_from_the_mean(flight: Flight, drawn: dict[str, Any]) -> None:
    errors = flight.quantities.get("measured_pose", flight.pose) - flight.pose
    assert errors[:, 1].mean() == pytest.approx(drawn["plant.sensors.position_bias[1]"], rel=1e-9)
    assert not errors[:, 0].any()


def goal_from_the_end(flight: Flight, drawn: dict[str, Any]) -> None:
    nominal = load_scenario("faults/stuck_slider").goal
    assert flight.goal is not None
    moved = flight.goal.position - nominal.position
    np.testing.assert_allclose(moved, [0, 0, drawn["goal.position.z"]], atol=1e-15)
    assert flight.succeeded
    # As far as the paper's first-order gait goes: a third of what was drawn.
    error = flight.pose[-1, 2] - nominal.position[2] - drawn["goal.position.z"]
    assert abs(error) < abs(drawn["goal.position.z"]) / 3


def goal_attitude_from_the_end(flight: Flight, drawn: dict[str, Any]) -> None:
    nominal = Rotation.from_quat(load_scenario("faults/stuck_slider").goal.quaternion)
    turned = Rotation.from_rotvec([drawn["goal.rotvec.x"], 0.0, 0.0])
    left = (nominal * turned).inv() * Rotation.from_quat(flight.pose[-1, 3:])
    assert left.magnitude() < drawn["goal.rotvec.x"] / 3


def start_from_the_first_state(flight: Flight, drawn: dict[str, Any]) -> None:
    assert flight.pose[0, 0] == drawn["initial.position.x"]
    rotvec = Rotation.from_quat(flight.pose[0, 3:]).as_rotvec()
    np.testing.assert_allclose(rotvec, [0, drawn["initial.rotvec.y"], 0], atol=1e-15)
    assert flight.q[0, 1] == pytest.approx(drawn["initial.joints.slider_2"], abs=1e-15)


def momentum_from_the_first_state(flight: Flight, drawn: dict[str, Any]) -> None:
    given = drawn["plant.linear_momentum[1]"]
    assert flight.momentum[0, 1] == pytest.approx(given, rel=1e-9)


def fault_from_when_a_joint_sticks(flight: Flight, drawn: dict[str, Any]) -> None:
    (begins,) = [e.time_s for e in flight.events if e.kind is EventKind.FAULT_INJECTED]
    at = drawn["faults[0].at"]
    assert begins is not None
    assert at <= begins < at + flight.control_period
    stuck = flight.time > begins + 1e-9
    assert not flight.qdot[stuck, 0].any()
    assert flight.qdot[~stuck, 0].any()


def uniform(low: float, high: float) -> dict[str, Any]:
    return {"uniform": {"loc": low, "scale": high - low}}


FAULT = {
    "plant.faults": ["joint_stuck slider_1 at 1 until 100"],
    **{"planner.max_corrections": 0, "planner.optimal.starts": 1, "planner.optimal.answers": 1},
}

KINDS: list[Any] = [
    pytest.param({"mass.*": uniform(0.5, 0.9)}, COAST, mass_from_momentum, id="mass"),
    pytest.param(
        {"inertia.*": uniform(1.1, 1.5)}, SPIN, inertia_from_angular_momentum, id="inertia"
    ),
    pytest.param({"com.*": uniform(0.01, 0.03)}, SPIN, centre_of_mass_from_spin, id="com"),
    pytest.param(
        {"plant.sensors.position_noise": uniform(0.001, 0.002)}, {}, noise_from_statistics,
        id="noise",
    ),
    pytest.param(
        {"plant.sensors.position_bias[1]": uniform(0.001, 0.002)}, {}, bias_from_the_mean,
        id="bias",
    ),
    pytest.param({"goal.position.z": uniform(0.015, 0.02)}, {}, goal_from_the_end, id="goal"),
    pytest.param(
        {"goal.rotvec.x": uniform(0.02, 0.03)}, {}, goal_attitude_from_the_end, id="goal-attitude"
    ),
    pytest.param(
        {
            "initial.position.x": uniform(0.001, 0.002),
            "initial.rotvec.y": uniform(0.001, 0.002),
            "initial.joints.slider_2": uniform(0.01, 0.02),
        },
        {}, start_from_the_first_state, id="start",
    ),
    pytest.param(
        {"plant.linear_momentum[1]": uniform(0.01, 0.02)}, {"planner.max_corrections": 0},
        momentum_from_the_first_state, id="momentum",
    ),
    pytest.param(
        {"faults[0].at": uniform(0.5, 0.9)}, FAULT, fault_from_when_a_joint_sticks, id="fault"
    ),
]  # fmt: skip

FAULT_SLOWLY = pytest.param(*KINDS[-1].values, id="fault", marks=pytest.mark.slow)


@pytest.mark.parametrize(("disperse", "settings", "check"), [*KINDS[:-1], FAULT_SLOWLY])
def test_what_is_drawn_is_what_is_flown(
    disperse: dict[str, Any], settings: dict[str, Any], check: Check
) -> None:
    flight, drawn = flown(campaign(disperse=disperse, set=settings, seed=5))
    assert len(drawn) >= len(disperse)
    check(flight, drawn)


@pytest.mark.parametrize(("disperse", "settings", "check"), [*KINDS[:-1], FAULT_SLOWLY])
def test_a_dispersion_that_is_not_applied_is_noticed(
    disperse: dict[str, Any], settings: dict[str, Any], check: Check
) -> None:
    """The same checks on a flight without dispersions."""
    made = campaign(disperse=disperse, set=settings, seed=5)
    _, drawn = flown(made)
    plain, _ = flown(campaign(set=settings, seed=5))
    with pytest.raises((AssertionError, KeyError)):
        check(plain, drawn)
