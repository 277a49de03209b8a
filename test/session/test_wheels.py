"""Flights with reaction wheels: bounds of the attitude, saturation, dumping, failures."""

from __future__ import annotations

import numpy as np
import pytest

from spacerobot_ros import fly
from spacerobot_ros.events import EventKind
from spacerobot_ros.flight.flight import Flight
from spacerobot_ros.model.rotations import rotvec_from_quaternion
from spacerobot_ros.scenario import load_scenario

pytestmark = pytest.mark.slow

HELD = 1e-4
"""Largest turn of a base that is held, rad."""


def turn(flight: Flight) -> float:
    return max(float(np.linalg.norm(rotvec_from_quaternion(q))) for q in flight.pose[:, 3:])


def times(flight: Flight, kind: EventKind) -> list[float]:
    return [float(each.time_s or 0.0) for each in flight.events if each.kind is kind]


def test_the_base_is_held_while_saturation_is_announced_and_momentum_dumped() -> None:
    flight = fly(load_scenario("wheels"))
    assert flight.succeeded
    assert turn(flight) < HELD
    (announced,), (began,), (ended,) = (
        times(flight, kind)
        for kind in (EventKind.WHEEL_NEAR_LIMIT, EventKind.DUMP_STARTED, EventKind.DUMP_ENDED)
    )
    rates = np.abs(flight.qdot[:, :4]).max(axis=1)
    assert announced == pytest.approx(flight.time[np.argmax(rates >= 270.0)], abs=0.021)
    assert announced < began < ended
    # As docs/theory/wheels.md has it.
    assert (announced, began, ended - began) == pytest.approx((4.6, 8.4, 23.0), rel=0.02)
    said = next(e.message for e in flight.events if e.kind is EventKind.WHEEL_NEAR_LIMIT)
    left = float(said.split("saturated in ")[1].removesuffix(" s."))
    assert left == pytest.approx(6.0, rel=0.05)
    assert rates.max() < 300.0
    after = flight.qdot[flight.time >= ended, :4]
    assert np.abs(after[0]).max() <= 6.0


def test_wheels_alone_hold_the_attitude() -> None:
    settings = {"use_thrusters": False, "wheels.dump_rate": 0.0}
    scenario = load_scenario("wheels").with_overrides("coordinated_control", settings)
    flight = fly(scenario)
    assert flight.succeeded
    assert turn(flight) < 2e-5
    assert not flight.commands["base_wrench"].values.any()
    away = np.linalg.norm(flight.pose[:, :3], axis=1).max()
    assert away == pytest.approx(0.04, rel=0.05), "nobody holds its position"


def test_two_wheels_fail_and_the_goal_is_reached() -> None:
    flight = fly(load_scenario("faults/wheel_failure"))
    assert flight.succeeded
    failed = {
        each.about["wheel"]: float(each.time_s or 0.0)
        for each in flight.events
        if each.kind is EventKind.WHEEL_FAILED
    }
    assert list(failed) == ["wheel_plus_x", "wheel_minus_y"]
    assert failed["wheel_plus_x"] - 2.0 == pytest.approx(1.6, rel=0.05)
    assert failed["wheel_minus_y"] - 9.0 == pytest.approx(0.3, abs=0.03)
    torque = flight.commands["base_wrench"].values[:, 3:]
    assert np.abs(torque[flight.commands["base_wrench"].tick < 9 * 50]).max() < 1e-9
    assert np.abs(torque).max() > 0.01
