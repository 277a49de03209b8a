"""What planner and coordinated control make of faults, wrong masses and noise: docs/faults.md."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from std_srvs.srv import Trigger
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

ARM: dict[str, Any] = {
    "robot": "servicer",
    "initial_joint_positions": [0.0, -1.2, 2.0, 0.0, 0.8, 0.0],
    "diagnostics_period": 1.0,
}
AREA_LOOP: dict[str, Any] = {
    "method": "area_loop",
    "area_loop.k": 0.7,
    "area_loop.edge_time": 1.0,
    "area_loop.joints": "shoulder_yaw shoulder_pitch elbow_pitch",
    "area_loop.nominal": [0.0, -1.2, 2.0, 0.0, 0.8, 0.0],
}
A_LITTLE = ([0.0, 0.0, 0.0], [0.004, 0.003, -0.004])


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


@pytest.mark.slow
@pytest.mark.parametrize("seed", some_fast({str(k): k for k in range(5)}, "0"))
def test_noisy_poses_are_averaged_and_the_goal_is_met(harness: Harness, seed: int) -> None:
    flight = sliders(harness, averaging=25, **NOISE, **{"sensors.seed": seed})
    status = flight.fly(*TURNED)
    assert_met(flight, status)
    assert int(values_of(status)["corrections"]) <= 3


@pytest.mark.slow
def test_an_average_is_nearer_the_truth_than_what_is_measured_once(harness: Harness) -> None:
    flight = sliders(harness, averaging=100, position_tolerance=6e-4, **NOISE)
    status = flight.fly(*TURNED)
    assert values_of(status)["state"] == "reached", status.message
    assert flight.left(*TURNED)[0] <= 6e-4 + 4 * 1e-3 / 10
    # The planner has waited at rest for its states, before the gait and after it.
    stamps, shapes = flight.series("joint_states")
    moving = stamps[:-1][np.abs(np.diff(shapes[:, 0])) > 1e-12]
    # A goal may come a tick or two after the first state.
    assert 99 * 0.05 - 1e-6 <= moving[0] <= 101 * 0.05 + 1e-6
    assert stamps[-1] - moving[-1] >= 99 * 0.05


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


@pytest.mark.slow
def test_a_goal_is_aborted_while_its_end_is_averaged(harness: Harness) -> None:
    flight = sliders(harness, averaging=2000)
    flight.send(*TURNED)
    flight.ticks(2000 + 14 * 20 + 10)
    assert flight.states[-1] == "executing"
    client = flight.probe.create_client(Trigger, "planner/abort")
    assert harness.call(client, Trigger.Request()).success
    harness.spin_until(lambda: flight.states[-1] == "aborted", "the abortion")
    flight.ticks(2010)
    assert flight.states[-2:] == ["executing", "aborted"], "nothing is judged"


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


@pytest.mark.slow
def test_a_biased_pose_is_believed(harness: Harness) -> None:
    """Nothing in one sensor tells its bias: the goal is missed by it."""
    flight = sliders(harness, "sensor_bias position_y 0.1 at 0.5", max_corrections=6)
    assert values_of(flight.fly(*TURNED))["state"] == "reached"
    position, rotvec = TURNED
    distance, _ = flight.left([position[0], position[1] - 0.1, position[2]], rotvec)
    assert distance <= WITHIN["position_tolerance"]


@pytest.mark.slow
def test_a_late_pose_is_outwaited(harness: Harness) -> None:
    flight = sliders(harness, "sensor_delay odom 0.5", averaging=100)
    assert_met(flight, flight.fly(*TURNED))


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


# -- stuck joints -----------------------------------------------------------------------------


@pytest.mark.slow
def test_what_the_remaining_joints_cannot_do_is_said(harness: Harness) -> None:
    flight = sliders(harness, "joint_stuck slider_1 at 1")
    status = flight.fly(*TURNED)
    assert values_of(status)["state"] == "failed"
    assert_one_sentence(
        status.message,
        "not reached",
        "joint 'slider_1' is stuck at",
        "with the remaining joints:",
        "three sliders",
    )
    flight.ticks(5)
    assert not any(flight.probe.last("joint_states").velocity)


@pytest.mark.slow
@pytest.mark.parametrize("noise", [0.0, 2e-4])
def test_the_arm_goes_on_without_its_elbow(harness: Harness, noise: float) -> None:
    flight = FaultFlight(
        harness,
        {**ARM, "faults": ["joint_stuck elbow_pitch at 1.5"], "sensors.joint_noise": noise},
        planner={
            **AREA_LOOP,
            "attitude_tolerance": 1e-3,
            "shape_deadband": 4 * noise,
            "averaging": 10 if noise else 1,
        },
    )
    status = flight.fly(*A_LITTLE)
    assert values_of(status)["state"] == "reached", status.message
    assert flight.left(*A_LITTLE)[1] <= 1e-3
    stamps, _ = flight.series("joint_states")
    commands = flight.probe.messages["joint_commands"]
    elbow = list(commands[-1].name).index("elbow_pitch")
    assert len(commands[-1].velocity) == 6, "every joint is named"
    found = max(k for k, m in enumerate(commands) if m.velocity[elbow] != 0.0)
    assert 1.5 < stamps[found] < 1.5 + 6.0
    assert any(any(m.velocity) for m in commands[found + 1 :])
    assert float(flight.plant.plant.momentum[:6] @ flight.plant.plant.momentum[:6]) < 1e-20


@pytest.mark.slow
def test_the_next_goal_is_tried_with_all_joints(harness: Harness) -> None:
    flight = sliders(harness, "joint_stuck slider_1 at 1")
    assert values_of(flight.fly(*TURNED))["state"] == "failed"
    flight.inject("clear")
    assert_met(flight, flight.fly(*TURNED))


@pytest.mark.slow
def test_commands_that_the_plant_refuses_are_no_mystery(harness: Harness) -> None:
    flight = sliders(harness, *(f"joint_stuck slider_{i} at 1" for i in (1, 2, 3)))
    status = flight.fly(*TURNED)
    assert values_of(status)["state"] == "failed"
    assert "stuck" in status.message


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


@pytest.mark.slow
def test_control_with_wrong_masses(harness: Harness) -> None:
    flight = FaultFlight(
        harness, THRUST, coordinated_control={**CONTROL, "model_error": 0.3, "model_error_seed": 1}
    )
    assert values_of(flight.fly(*THERE))["state"] == "reached"
    assert flight.left(*THERE)[0] <= 0.01
