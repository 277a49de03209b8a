"""What planner and coordinated control make of faults, wrong masses and noise: docs/faults.md."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from support.fault_flights import FaultFlight, values_of
from support.ros_harness import Harness
from support.sentences import assert_one_sentence
from support.slow import some_fast

SLIDERS: dict[str, Any] = {"robot": "sliding_masses", "diagnostics_period": 1.0}
# Slides of 2 s in one swing, cycles of 1 s.
LIE_BRACKET: dict[str, Any] = {
    "method": "lie_bracket",
    "lie_bracket.t1": 2.0,
    "lie_bracket.n1": 1,
    "lie_bracket.cycle_period": 1.0,
}
TURNED = ([0.02, -0.03, 0.01], [0.01, -0.005, 0.015])
NOISE = {"sensors.position_noise": 1e-3, "sensors.attitude_noise": 8.7e-4}
WITHIN = {"position_tolerance": 3e-3, "attitude_tolerance": 2.6e-3}


def sliders(harness: Harness, *faults: str, **planner: Any) -> FaultFlight:
    plant = {**SLIDERS, **{k: planner.pop(k) for k in list(planner) if k.startswith("sensors.")}}
    return FaultFlight(
        harness, {**plant, "faults": list(faults)}, planner={**LIE_BRACKET, **WITHIN, **planner}
    )


def assert_met(flight: FaultFlight, status: DiagnosticStatus) -> None:
    assert values_of(status)["state"] == "reached", status.message
    distance, angle = flight.left(*TURNED)
    assert distance <= WITHIN["position_tolerance"]
    assert angle <= WITHIN["attitude_tolerance"]


# -- noise ------------------------------------------------------------------------------------


def test_noisy_joints_are_not_shaken_and_noisy_rates_are_no_drift(harness: Harness) -> None:
    rates = dict.fromkeys(
        ("sensors.velocity_noise", "sensors.angular_velocity_noise", "sensors.joint_rate_noise"),
        1e-3,
    )
    flight = sliders(
        harness,
        averaging=25,
        rest_tolerance=2e-3,
        shape_deadband=4e-3,
        **NOISE,
        **rates,
        **{"sensors.joint_noise": 1e-3},
    )
    assert_met(flight, flight.fly(*TURNED))
    # What is commanded is the gait alone: no velocity is an answer to noise.
    (schedule,) = flight.probe.messages["gait_schedule"][:1]
    planned = [point.velocities for point in schedule.points[:-1]]
    commanded = [m.velocity for m in flight.probe.messages["joint_commands"] if any(m.velocity)]
    np.testing.assert_allclose(commanded[: len(planned)], planned, atol=1e-12)


def test_without_a_tolerance_noisy_rates_are_taken_for_drift(harness: Harness) -> None:
    flight = sliders(harness, **{"sensors.velocity_noise": 1e-3})
    status = flight.fly(*TURNED)
    assert values_of(status)["state"] == "refused"
    assert_one_sentence(status.message, "drifts")


# -- faults that the planner flies through ----------------------------------------------------

SURVIVED = {
    "a slow joint": ("joint_slow slider_1 0.5 at 1",),
    "a very slow joint": ("joint_slow slider_2 0.1 at 1 until 4",),
    "a joint that sticks for less than a second": ("joint_stuck slider_1 at 2 until 2.5",),
    "a biased actuator": ("actuator_bias slider_2 0.002 at 0.5",),
    "a noisy actuator": ("actuator_noise slider_3 0.01",),
    "no pose in flight": ("sensor_dropout odom at 0.5 until 10",),
    "no pose when the gait ends": ("sensor_dropout odom at 10 until 20",),
    "a shift of the joint sensor": ("sensor_bias slider_1 0.001 at 1",),
    "noise for a while": ("sensor_noise attitude 0.05 at 1 until 9",),
}


@pytest.mark.parametrize("faults", some_fast(SURVIVED, "no pose in flight"))
def test_the_goal_is_met_in_spite_of(harness: Harness, faults: tuple[str, ...]) -> None:
    flight = sliders(harness, *faults, averaging=15, max_corrections=6)
    assert_met(flight, flight.fly(*TURNED))
    assert not any("stuck" in s.message for s in flight.probe.messages["planner/status"])


@pytest.mark.parametrize("seed", some_fast({str(k): k for k in range(4)}, "0"))
def test_wrong_masses_cost_corrections_and_not_the_goal(harness: Harness, seed: int) -> None:
    flight = sliders(
        harness,
        model_error=0.1,
        model_error_seed=seed,
        max_corrections=6,
        position_tolerance=1e-3,
        attitude_tolerance=1e-3,
    )
    status = flight.fly(*TURNED)
    assert_met(flight, status)
    assert int(values_of(status)["corrections"]) >= 1
    assert flight.plant.plant.robot.total_mass == 16.0, "the plant knows its masses"


# -- coordinated control ----------------------------------------------------------------------

THRUST: dict[str, Any] = {
    "robot": "planar_manipulator",
    "actuation": "effort",
    "tick_rate": 50.0,
    "initial_joint_positions": [-1.0, 1.0],
    "diagnostics_period": 1.0,
}
CONTROL: dict[str, Any] = {
    "position_tolerance": 5e-3,
    "attitude_tolerance": 5e-3,
    "settle_time": 0.5,
    "time_limit": 60.0,
}
THERE = ([0.1, 0.05, 0.0], [0.0, 0.0, 0.1])

CONTROLLED = {
    "weak thrusters": ("thruster_weak all 0.5",),
    "thrusters off for a while": ("thruster_off all at 1 until 3",),
    "a thruster stuck on for a while": ("thruster_stuck force_y 5 at 1 until 3",),
    "a weak joint motor": ("joint_slow shoulder 0.3",),
    "a noisy motor": ("actuator_noise elbow 0.2",),
    "a jammed joint": ("joint_stuck elbow at 1 until 4",),
    "no pose for a while": ("sensor_dropout odom at 1 until 1.6",),
    "a short delay": ("sensor_delay odom 0.04",),
}


@pytest.mark.slow
@pytest.mark.parametrize("faults", some_fast(CONTROLLED, "no pose for a while"))
def test_control_holds_in_spite_of(harness: Harness, faults: tuple[str, ...]) -> None:
    flight = FaultFlight(
        harness, {**THRUST, "faults": list(faults)}, coordinated_control=dict(CONTROL)
    )
    status = flight.fly(*THERE)
    assert values_of(status)["state"] == "reached", status.message
    distance, angle = flight.left(*THERE)
    assert distance <= 0.02
    assert angle <= 0.02
    gone = flight.plant.plant.momentum[:6] - flight.plant.plant.expected_momenta
    assert np.abs(gone).max() < 1e-8


@pytest.mark.slow
def test_a_thruster_that_stays_on_is_too_much_and_said(harness: Harness) -> None:
    flight = FaultFlight(
        harness,
        {**THRUST, "faults": ["thruster_stuck force_y 3"]},
        coordinated_control={**CONTROL, "time_limit": 8.0},
    )
    status = flight.fly(*THERE)
    assert values_of(status)["state"] == "aborted"
    assert_one_sentence(status.message, "control is lost")
