"""Bodies that a robot holds, and its momentum budget over time, from recorded flights."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.oracles import Array

from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.events import Event, EventKind
from spacerobot_ros.flight.captures import (
    BUDGET_PARTS,
    States,
    held_bodies,
    momentum_budget_over_time,
    payload_estimates,
)
from spacerobot_ros.flight.flight import Flight, Signal
from spacerobot_ros.flight.reading import open_flight_bag, read_run
from spacerobot_ros.model.kinematics import ForwardKinematics
from spacerobot_ros.model.payload_estimation import PAYLOAD_PARAMETERS, payload_parameters
from spacerobot_ros.report.flight import FlightReport
from spacerobot_ros.report.tables import headline

BAGS = Path(__file__).parents[2] / "bags"


@pytest.fixture(scope="module", autouse=True)
def _interpreted() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SPACEROBOT_COMPILE", "0")
        yield


@pytest.fixture(scope="module")
def capture() -> Flight:
    return read_run(BAGS / "capture.mcap")


def norms(values: Array) -> Array:
    return np.linalg.norm(values, axis=1)


def released(flight: Flight, time_s: float) -> Flight:
    event = Event(EventKind.RELEASED, "The target is released.", 0, time_s)
    return replace(flight, events=(*flight.events, event))


def test_the_held_body_is_where_the_target_is_seen(capture: Flight) -> None:
    (held,) = held_bodies(capture)
    assert (held.start, held.end, held.payload.link) == (0.0, math.inf, "end_effector")
    assert held.payload.inertia.mass == 10.0
    # Its centre at the end of the flight, by the recorded pose of the target and by the arm.
    assert capture.robot is not None
    kinematics = ForwardKinematics(capture.robot)
    R_BL, r_BL = kinematics.link_poses(capture.q[-1:])
    link = list(kinematics.links).index("end_effector")
    turn, base = Rotation.from_quat(capture.pose[-1, 3:]), capture.pose[-1, :3]
    center = base + turn.apply(r_BL[0, link] + R_BL[0, link] @ held.payload.inertia.com)
    assert capture.target is not None
    seen, own = capture.signal("target_pose").values[-1], capture.target.bodies[0].inertia.com
    np.testing.assert_allclose(
        center, seen[:3] + Rotation.from_quat(seen[3:]).apply(own), atol=1e-9
    )
    assert float(np.linalg.norm(held.payload.inertia.com)) > 0.1


def test_each_capture_has_its_release(capture: Flight) -> None:
    twice = released(capture, 0.5)
    again = next(e for e in capture.events if e.kind is EventKind.CAPTURED)
    twice = released(replace(twice, events=(*twice.events, replace(again, time_s=1.0))), 1.5)
    assert [(each.start, each.end) for each in held_bodies(twice)] == [(0.0, 0.5), (1.0, 1.5)]
    assert held_bodies(replace(capture, robot=None)) == ()
    none = Signal(np.empty(0), np.empty((0, 7)))
    assert held_bodies(replace(capture, series={**capture.series, "target_pose": none})) == ()
    assert held_bodies(replace(capture, events=())) == ()


def test_the_parts_add_up_to_the_recorded_momentum_of_robot_and_held_body(capture: Flight) -> None:
    budget = momentum_budget_over_time(capture, 40)
    assert len(budget) == 40
    assert (budget.time[0], budget.time[-1]) == (capture.time[0], capture.time[-1])
    rows = np.searchsorted(capture.time, budget.time)
    recorded = norms(capture.momentum[rows, 3:6])
    assert recorded[1:].max() > 5e-3
    # The first state is that of the capture, before the impact.
    np.testing.assert_allclose(budget.values[1:, 3], recorded[1:], atol=1e-12)
    assert budget.values[0, 3] == 0.0
    assert not budget.values[:, 2].any(), "there are no wheels"
    assert (budget.values[:, 3] <= budget.values[:, :3].sum(axis=1) + 1e-12).all()
    # A robot without the body has another momentum.
    alone = momentum_budget_over_time(released(capture, 1.0), 40)
    later = budget.time > 1.0
    assert np.array_equal(alone.values[~later], budget.values[~later])
    assert np.abs(alone.values[later, 3] - recorded[later]).max() > 1e-3


def test_wheels_base_and_arm_add_up_to_the_recorded_momentum() -> None:
    flight = read_run(BAGS / "wheels.mcap")
    budget = momentum_budget_over_time(flight, 25)
    rows = np.searchsorted(flight.time, budget.time)
    np.testing.assert_allclose(budget.values[:, 3], norms(flight.momentum[rows, 3:6]), atol=1e-11)
    # Wheels alone: each spins at its own rate, and the base turns slowly.
    assert flight.robot is not None
    spinning = [list(flight.joint_names).index(name) for name in flight.robot.wheel_names]
    bodies = {b.joint.name: b for b in flight.robot.bodies if b.joint is not None}
    axes = np.array(
        [bodies[n].origin.R @ bodies[n].joint.axis for n in flight.robot.wheel_names]  # type: ignore[union-attr]
    )
    moments = np.array(
        [
            bodies[n].joint.axis @ bodies[n].inertia.about_com @ bodies[n].joint.axis  # type: ignore[union-attr]
            for n in flight.robot.wheel_names
        ]
    )
    rates = flight.qdot[rows][:, spinning] + flight.twist[rows, 3:] @ axes.T
    np.testing.assert_allclose(budget.values[:, 2], norms((moments * rates) @ axes), atol=1e-12)
    assert budget.values[:, 2].max() > 0.1
    assert BUDGET_PARTS == ("base", "arm", "wheels", "sum")


def test_a_flight_without_a_robot_or_its_joints_has_no_budget(capture: Flight) -> None:
    assert len(momentum_budget_over_time(replace(capture, robot=None), 10)) == 0
    others = replace(capture, joint_names=("a", "b"))
    empty = momentum_budget_over_time(others, 10)
    assert (len(empty), empty.width) == (0, 4)


def test_states_are_those_at_which_base_and_joints_are_known(capture: Flight) -> None:
    q = capture.signal("q")
    fewer = Signal(q.time[3:9], q.values[3:9])
    flight = replace(capture, series={**capture.series, "q": fewer, "qdot": fewer})
    assert flight.robot is not None
    backward = replace(flight, joint_names=flight.joint_names[::-1])
    states = States.of(backward, flight.robot)
    assert np.array_equal(states.time, q.time[3:9])
    assert np.array_equal(states.pose, capture.pose[3:9])
    assert np.array_equal(states.q, fewer.values[:, ::-1])
    middle = states.between(float(q.time[4]), float(q.time[6]))
    assert np.array_equal(middle.time, q.time[4:7])
    assert np.array_equal(states.time[states.sample_rows(2)], q.time[[3, 8]])
    assert len(states.sample_rows(100)) == 6


def test_a_planar_flight_determines_seven_parameters_of_the_block(capture: Flight) -> None:
    """Thrusters fire all the time: their impulse is part of the balance."""
    (found,) = payload_estimates(capture, 80)
    assert found.undetermined == ("Ixx", "Iyy", "Ixy")
    (held,) = held_bodies(capture)
    shown = ~np.isnan(found.parameters)
    true = payload_parameters(held.payload.inertia)
    # Normal equations square what rounding does, and it differs between processors.
    np.testing.assert_allclose(found.parameters[shown], true[shown], atol=1e-4)
    # Without the thrust it would be another body.
    still = {**capture.commands, "base_wrench": replace(capture.commands["base_wrench"])}
    still["base_wrench"] = replace(
        still["base_wrench"], values=np.zeros_like(capture.commands["base_wrench"].values)
    )
    (other,) = payload_estimates(replace(capture, commands=still), 80)
    assert abs(other.parameters[0] - 10.0) > 1.0


@pytest.fixture(scope="module")
def servicing() -> Flight:
    return read_run(BAGS / "servicing.mcap")


def noisy(flight: Flight, size: float) -> Flight:
    """The flight with white noise of measured velocities, and a hundredth of it of positions."""
    rng = np.random.default_rng(4)
    noise = {"pose": size / 100, "twist": size, "q": size / 100, "qdot": size}
    measured = {
        f"measured_{name}": Signal(
            flight.signal(name).time,
            flight.signal(name).values + s * rng.normal(size=flight.signal(name).values.shape),
        )
        for name, s in noise.items()
    }
    return replace(flight, series={**flight.series, **measured})


def test_a_satellite_with_unequal_moments_is_estimated_from_its_flight(servicing: Flight) -> None:
    """Its thrusters fire on and off, and its wheels turn."""
    (found,) = payload_estimates(servicing, 90)
    assert found.undetermined == ()
    (held,) = held_bodies(servicing)
    true = payload_parameters(held.payload.inertia)
    assert len(set(np.round(true, 3))) == 10
    np.testing.assert_allclose(found.parameters, true, rtol=1e-3, atol=0.03)
    assert found.payload is not None
    assert found.payload.link == held.payload.link


def test_an_estimate_without_noise_knows_what_the_impulses_of_ticks_lack(
    servicing: Flight,
) -> None:
    (held,) = held_bodies(servicing)
    true = payload_parameters(held.payload.inertia)
    (found,) = payload_estimates(servicing)
    shares = (found.parameters - true) / found.deviations
    assert 0.3 < np.sqrt(np.mean(shares**2)) < 1.8
    assert np.abs(shares).max() < 3.5


def test_an_estimate_from_noisy_sensors_knows_its_errors(servicing: Flight) -> None:
    (held,) = held_bodies(servicing)
    true = payload_parameters(held.payload.inertia)
    (found,) = payload_estimates(noisy(servicing, 1e-6), 240)
    assert found.undetermined == ()
    error = np.abs(found.parameters - true)
    assert 1e-4 < found.deviations[0] < 0.02
    assert (error < 3.5 * found.deviations).all()
    (coarse,) = payload_estimates(noisy(servicing, 1e-4), 240)
    assert set(coarse.undetermined) >= {"Ixx", "Iyy", "Izz", "Ixy", "Ixz", "Iyz"}


def test_a_short_flight_with_noise_shows_nothing(capture: Flight) -> None:
    (found,) = payload_estimates(noisy(capture, 1e-5), 200)
    assert found.undetermined == PAYLOAD_PARAMETERS


def test_loads_from_outside_are_not_taken_for_a_body(capture: Flight) -> None:
    loaded = Event(EventKind.DISTURBANCE, "A wrench acts.", 1, 0.5)
    scenario = capture.scenario
    windy = scenario.with_overrides("plant", {"disturbances": ("wrench spacecraft 1 0 0 0 0 0",)})
    orbit = scenario.with_overrides("plant", {"orbit.mean_motion": 1e-3})
    for flight in (
        replace(capture, events=(*capture.events, loaded)),
        replace(capture, scenario=windy),
        replace(capture, scenario=orbit),
    ):
        with pytest.raises(SpaceRobotError) as error:
            payload_estimates(flight)
        assert str(error.value) == (
            "The held body is not estimated: loads from outside (disturbances, an orbit or a "
            "table) acted on the robot, and their impulse is not known to it; estimate it from a "
            "flight without them."
        )
    assert payload_estimates(replace(capture, robot=None)) == ()
    assert payload_estimates(replace(capture, events=(loaded,))) == ()


def test_a_goal_without_its_automatic_capture_is_not_complete(capture: Flight) -> None:
    assert (capture.verdict.word, capture.verdict.complete) == ("Reached", True)
    missed = replace(capture, events=())
    assert missed.verdict.word == "Reached, but the target is not captured"
    assert not missed.verdict.complete
    # A target that is captured on request alone may be left where it is.
    by_hand = capture.scenario.with_overrides("plant", {"capture.mode": "manual"})
    assert replace(missed, scenario=by_hand).verdict.complete


def test_a_report_has_a_card_of_the_capture() -> None:
    report = FlightReport.of(open_flight_bag(BAGS / "capture.mcap"))
    cards = {label: (value, note) for label, value, note in headline(report)}
    value, note = cards["Target captured"]
    (time,) = [each.time_s for each in report.events if each.kind is EventKind.CAPTURED]
    assert value == f"at {time:.4g} s"
    assert float(note.split(" m from the grapple")[0]) < 0.02
    report = replace(report, events=())
    assert ("Target captured", "no") in {card[:2] for card in headline(report)}
    without = FlightReport.of(open_flight_bag(BAGS / "servicer.mcap"))
    assert "Target captured" not in {label for label, _, _ in headline(without)}
