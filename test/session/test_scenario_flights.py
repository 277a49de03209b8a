"""Scenarios flown from end to end: paper 2, reaction wheels, thrusters, servicing."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import coal
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.slow import some_fast

from spacerobot_ros import fly
from spacerobot_ros.bag import Bag, read_bag
from spacerobot_ros.bag.reader import columns
from spacerobot_ros.errors import ParameterError, PlanningError
from spacerobot_ros.events import EventKind
from spacerobot_ros.flight.flight import Flight
from spacerobot_ros.flight.verification import verify_bag
from spacerobot_ros.measures import Outcome
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.rotations import rotvec_from_quaternion
from spacerobot_ros.resources import robot_file
from spacerobot_ros.scenario import load_scenario
from spacerobot_ros.session.run import run_scenario
from spacerobot_ros.simulation.actuators import build_plant


@pytest.mark.slow
def test_five_degrees_about_each_axis(tmp_path: Path) -> None:
    result = run_scenario(load_scenario("arm_attitude"), tmp_path / "arm.mcap")
    assert result.succeeded
    summary = result.summary
    # Cycles are pieces of one gait, not corrections of it.
    assert summary["corrections"] == 0
    assert summary["attitude_error_rad"] <= 0.0012
    odom = read_bag(tmp_path / "arm.mcap")["/odom"]
    attitudes = odom.table(columns("odom", "pose.pose"))[:, 3:]
    goal = Rotation.from_rotvec(np.radians([5.0, 5.0, 5.0]))
    left = np.degrees(np.abs((Rotation.from_quat(attitudes).inv() * goal).as_rotvec()))
    # A cycle is six edges of 4 s, and 2 s to the first corner and back: 28 s at 20 Hz.
    per_cycle = 560
    assert left[20 * per_cycle].max() <= 0.22
    assert left[30 * per_cycle].max() <= 0.045
    assert summary["ticks"] == pytest.approx(30 * per_cycle, abs=per_cycle)
    # The arm is where it was: what turned the base is the way.
    np.testing.assert_allclose(
        summary["final_joint_positions"], np.radians([0.0, -45.0, 90.0]), atol=1e-6
    )


# -- flights with reaction wheels --------------------------------------------------------------

HELD = 1e-4
"""Largest turn of a base that is held, rad."""


def turn(flight: Flight) -> float:
    return max(float(np.linalg.norm(rotvec_from_quaternion(q))) for q in flight.pose[:, 3:])


def times(flight: Flight, kind: EventKind) -> list[float]:
    return [float(each.time_s or 0.0) for each in flight.events if each.kind is kind]


@pytest.mark.slow
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
    left = float(said.split("saturate in ")[1].removesuffix(" s."))
    assert left == pytest.approx(6.0, rel=0.05)
    assert rates.max() < 300.0
    after = flight.qdot[flight.time >= ended, :4]
    assert np.abs(after[0]).max() <= 6.0


@pytest.mark.slow
def test_wheels_alone_hold_the_attitude() -> None:
    settings = {"use_thrusters": False, "wheels.dump_rate": 0.0}
    scenario = load_scenario("wheels").with_overrides("coordinated_control", settings)
    flight = fly(scenario)
    assert flight.outcome.value == "reached_partly", "nobody holds its position"
    assert "but for its position, which is 0.04" in flight.message
    assert turn(flight) < 2e-5
    assert not flight.commands["base_wrench"].values.any()
    away = np.linalg.norm(flight.pose[:, :3], axis=1).max()
    assert away == pytest.approx(0.04, rel=0.05)


@pytest.mark.slow
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
    assert np.abs(torque[flight.commands["base_wrench"].time < 9.0 - 1e-6]).max() < 1e-9
    assert np.abs(torque).max() > 0.01


# -- the servicing spacecraft on thrusters -----------------------------------------------------

MILLIMETRE = 1e-3
TENTH_OF_A_DEGREE = np.radians(0.1)


def status(bag: Bag, name: str) -> dict[str, str]:
    """Return the last values of one status in the diagnostics."""
    values: dict[str, str] = {}
    for _, message in bag["/diagnostics"].messages():
        for entry in message.status:
            if entry.name.endswith(name):
                values = {pair.key: pair.value for pair in entry.values}
    return values


@pytest.mark.slow
@pytest.mark.parametrize("excluded", ["", "plus_x_1 minus_y_4 plus_z_2"], ids=["all", "dead"])
def test_both_poses_are_reached_by_pulses(excluded: str, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    scenario = load_scenario("servicer_thrusters").with_overrides(
        "plant", {"thrusters_excluded": excluded}
    )
    result = run_scenario(scenario, path)
    summary, bag = result.summary, read_bag(path)
    assert result.succeeded, result.message
    assert summary["position_error_m"] <= MILLIMETRE
    assert summary["attitude_error_rad"] <= TENTH_OF_A_DEGREE
    assert summary["end_effector_position_error_m"] <= MILLIMETRE
    assert summary["end_effector_attitude_error_rad"] <= TENTH_OF_A_DEGREE

    momentum = np.asarray(bag["/momentum"].field("data"))[:, :6]
    expected = np.asarray(bag["/momentum_expected"].field("data"))
    largest = np.linalg.norm(momentum[:, :3], axis=1).max()
    assert np.abs(momentum - expected).max() <= 1e-12 * max(1.0, largest)

    series = bag["/thrusters"]
    names = list(next(series.messages())[1].name)
    on_time, duty = (np.asarray(series.field(name)) for name in ("position", "velocity"))
    thrust = np.asarray(series.field("effort"))
    # Ten newton and 290 s, as the URDF has them.
    used = on_time[-1].sum() * 10.0 / (9.80665 * 290.0)
    assert summary["propellant_kg"] == pytest.approx(used, rel=1e-9)
    assert 0.01 < used < 0.1
    if not excluded:
        # The straight profile takes 45 g and 55 s.
        assert used <= 0.020
        assert summary["manoeuvre_time_s"] <= 31.0
    np.testing.assert_allclose(thrust, 10.0 * duty, atol=1e-12)
    assert np.mean((duty == 0.0) | (duty > 1.0 - 1e-9)) > 0.97
    for name in excluded.split():
        assert not on_time[:, names.index(name)].any()

    wrench = bag["/base_wrench_realised"]
    force_B = np.column_stack([wrench.field(f"wrench.force.{x}") for x in "xyz"])
    odom = bag["/odom"]
    turns = Rotation.from_quat(odom.table(columns("odom", "pose.pose"))[:, 3:])
    impulse = 0.01 * turns.apply(force_B).sum(axis=0)
    # The last attitude of a tick instead of that of its middle.
    np.testing.assert_allclose(impulse, momentum[-1, :3], atol=0.05)
    counted = status(bag, "thrusters")
    # The diagnostics come once a second.
    before = on_time[-101].sum() * 10.0 / (9.80665 * 290.0)
    assert before * (1 - 1e-8) <= float(counted["propellant_kg"]) <= used * (1 + 1e-8)
    assert int(counted["unmet_ticks"]) == 0
    assert int(counted["pulses"]) > 50
    assert verify_bag(path).difference is None


@pytest.mark.slow
def test_a_crate_in_the_way_is_passed_at_a_distance(tmp_path: Path) -> None:
    """The bus of 1.2 x 1 x 1 m and its panels, by coal: straight through the crate, or past it."""
    crate, place = coal.Box(0.3, 0.3, 0.3), coal.Transform3s(np.eye(3), np.array([0.9, -0.8, 0.0]))
    origin = '<origin xyz="0.9 -0.8 0"/><geometry><box size="0.3 0.3 0.3"/></geometry>'
    shapes = f"<visual>{origin}</visual><collision>{origin}</collision>"
    world = tmp_path / "crate.urdf"
    world.write_text(f'<robot name="w"><link name="crate">{shapes}</link></robot>', "utf-8")
    bus = [((1.2, 1.0, 1.0), 0.0), ((0.8, 1.6, 0.03), 1.5), ((0.8, 1.6, 0.03), -1.5)]

    def distance(flight: Flight) -> float:
        distances = []
        for pose in flight.pose[::10]:
            R = Rotation.from_quat(pose[3:]).as_matrix()
            for size, y in bus:
                at = coal.Transform3s(R, pose[:3] + R @ [0.0, y, 0.0])
                request, result = coal.DistanceRequest(), coal.DistanceResult()
                part = coal.Box(*size)
                distances.append(coal.distance(part, at, crate, place, request, result))
        return float(min(distances))

    straight = fly("servicer_thrusters", parameters={"coordinated_control.profile": "quintic"})
    assert distance(straight) < -0.05
    past = fly("servicer_thrusters", parameters={"coordinated_control.world": str(world)})
    assert past.succeeded, past.message
    assert distance(past) > 0.01


def test_thrusters_of_a_robot_that_nothing_pushes_are_refused(tmp_path: Path) -> None:
    scenario = load_scenario("servicer_thrusters").with_overrides(
        "plant", {"actuation": "velocity"}
    )
    with pytest.raises(ParameterError, match="has no base wrench"):
        run_scenario(scenario, tmp_path / "no.mcap")


# -- the scenario `servicing` ------------------------------------------------------------------


@pytest.fixture(scope="module")
def flight() -> Flight:
    straight = {"profile": "quintic", "target.horizon": 120.0}
    return fly(load_scenario("servicing").with_overrides("coordinated_control", straight))


@pytest.mark.slow
def test_a_tumbling_satellite_is_captured_brought_to_rest_and_carried(flight: Flight) -> None:
    assert flight.succeeded, flight.message
    phases = [
        each.kind
        for each in flight.events
        if each.kind.value.startswith(("approach", "captured", "detumbl", "goal"))
    ]
    assert phases == [
        EventKind.GOAL_ACCEPTED,
        EventKind.APPROACH_STARTED,
        EventKind.CAPTURED,
        EventKind.DETUMBLE_STARTED,
        EventKind.DETUMBLED,
        EventKind.GOAL_REACHED,
    ]
    tumbling = np.degrees(np.linalg.norm(flight.signal("target_twist").values[0, 3:]))
    assert tumbling == pytest.approx(3.0 * np.sqrt(2.0), rel=1e-6)
    summary = flight.summary()
    capture, detumbling = summary["capture"], summary["detumbling"]
    assert np.linalg.norm(capture["impulse_Ns"][:3]) < 0.5
    assert detumbling["shortest_s"] < detumbling["took_s"] < 4.0
    assert detumbling["grasp_torque_Nm"] <= 5.0 + 1e-9
    after = flight.time >= detumbling["time_s"]
    assert np.linalg.norm(flight.twist[after][0, 3:]) < 0.002
    turn = rotvec_from_quaternion(flight.pose[-1, 3:])
    np.testing.assert_allclose(flight.pose[-1, :3], [-0.8, 0.3, 0.2], atol=0.002)
    np.testing.assert_allclose(turn, [0.05, -0.04, 0.12], atol=0.002)


@pytest.mark.slow
def test_planned_motions_take_less_propellant_and_no_more_time(flight: Flight) -> None:
    planned = fly("servicing")
    assert planned.succeeded, planned.message
    assert planned.manoeuvre_time <= flight.manoeuvre_time
    spent, straight = (each.signal("propellant").values[-1, 0] for each in (planned, flight))
    assert spent < 0.8 * straight


@pytest.mark.slow
def test_the_momenta_are_those_of_the_thrust_to_the_last_digits(flight: Flight) -> None:
    """Of robot and target together, summed over the bodies: by the ledger of impulses."""
    summed = flight.signal("momentum").values[:, :6]
    expected = flight.signal("expected_momenta").values
    for part in (slice(0, 3), slice(3, 6)):
        largest = np.linalg.norm(expected[:, part], axis=1).max()
        assert largest > 1.0
        assert np.abs(summed[:, part] - expected[:, part]).max() <= 1e-12 * largest


def commanded(flight: Flight, engine: str) -> tuple[dict[str, np.ndarray], int]:
    """Return states of a plant under the recorded efforts and thrust, and the tick of capture."""
    scenario = load_scenario("servicing")
    # The wrench is that of the thrusters.
    config = replace(scenario.plant, engine=engine, thrusters="")
    plant = build_plant(SpaceRobot.from_file(robot_file("servicer_wheels")), config)
    capturing = plant.capturing
    assert capturing is not None
    effort = flight.commands["joint_commands"].values
    wrench = flight.signal("thruster_wrench").values[1:]
    rows: dict[str, list[np.ndarray]] = {}
    captured = 0
    for tick in range(len(flight.time)):
        for name, values in (
            ("pose", plant.pose),
            ("q", plant.q),
            ("target", capturing.target_pose),
            ("momentum", plant.momentum[:6]),
            ("expected", plant.expected_momenta),
        ):
            rows.setdefault(name, []).append(values.copy())
        if capturing.payload is None:
            captured = tick
        if tick < len(effort):
            plant.step(effort[tick], wrench[tick])
    return {name: np.array(values) for name, values in rows.items()}, captured


@pytest.mark.slow
def test_mujoco_flies_the_same_flight_from_its_commands(flight: Flight) -> None:
    """Approach, capture by a weld, detumbling by wheels and thrusters, carrying: no feedback."""
    pytest.importorskip("mujoco")
    flown, captured = commanded(flight, "mujoco")
    exact, also = commanded(flight, "exact")
    assert captured == also
    np.testing.assert_array_equal(exact["pose"], flight.pose)
    arm = [k for k, name in enumerate(flight.joint_names) if "wheel" not in name]
    for until, base, turn, joints, target in (
        (captured, 1e-12, 1e-11, 1e-9, 1e-11),
        (captured + 100, 2e-6, 2e-5, 1e-3, 5e-5),
        (len(flight.time), 5e-3, 5e-2, 0.3, 5e-3),
    ):
        part = slice(0, until)
        off = {name: np.abs(flown[name][part] - exact[name][part]) for name in flown}
        figures = (
            off["pose"][:, :3].max(),
            2 * off["pose"][:, 3:].max(),
            off["q"][:, arm].max(),
            off["target"][:, :3].max(),
        )
        print(f"until {until / 100:g} s:", *(f"{x:.1e}" for x in figures))
        assert np.all(np.array(figures) < (base, turn, joints, target))
    for part in (slice(0, 3), slice(3, 6)):
        largest = np.linalg.norm(flown["expected"][:, part], axis=1).max()
        left = np.abs(flown["momentum"] - flown["expected"])[:, part].max() / largest
        print(f"momentum: {left:.1e} of the largest")
        assert left < 1e-6


# -- faults and noise that planners and controllers fly through --------------------------------

WITHIN = 3e-3, 2.6e-3
"""Tolerances of the base, m and rad."""

TURNED = [0.02, -0.03, 0.01], [0.01, -0.005, 0.015]
SLIDE = {
    "plant.tick_rate": 20.0,
    "planner.tick_rate": 20.0,
    "planner.lie_bracket.t1": 2.0,
    "planner.lie_bracket.n1": 1,
    "planner.lie_bracket.cycle_period": 1.0,
    "planner.position_tolerance": WITHIN[0],
    "planner.attitude_tolerance": WITHIN[1],
}


def slide(*faults: str, **planner: Any) -> Flight:
    """Return a flight of sliding masses with faults, parameters of the planner, and others."""
    robot = SpaceRobot.from_file(robot_file("sliding_masses"))
    given = {name if "." in name else f"planner.{name}": value for name, value in planner.items()}
    parameters = {**SLIDE, "plant.faults": list(faults), **given}
    return fly(robot, TURNED[0], rotvec=TURNED[1], method="lie_bracket", parameters=parameters)


def true_error(flight: Flight, place: tuple[list[float], list[float]]) -> tuple[float, float]:
    """Return how far the true base ends from a pose: m, rad."""
    pose = flight.pose[-1]
    turn = Rotation.from_quat(pose[3:]).inv() * Rotation.from_rotvec(place[1])
    return float(np.linalg.norm(pose[:3] - place[0])), float(turn.magnitude())


def assert_met(flight: Flight) -> None:
    assert flight.outcome is Outcome.REACHED, flight.message
    assert np.all(np.less_equal(true_error(flight, TURNED), WITHIN))


def test_noisy_joints_are_not_shaken_and_noisy_rates_are_no_drift() -> None:
    noise = {"position": 1e-3, "attitude": 8.7e-4, "joint": 1e-3}
    noise |= dict.fromkeys(("velocity", "angular_velocity", "joint_rate"), 1e-3)
    sensors = {f"plant.sensors.{name}_noise": value for name, value in noise.items()}
    flight = slide(averaging=25, rest_tolerance=2e-3, shape_deadband=4e-3, **sensors)
    assert_met(flight)
    # What is commanded is the gait alone: no velocity is an answer to noise.
    planned = flight.schedules[0][1].velocities[:-1]
    commanded = flight.commands["joint_commands"].values
    moving = commanded[commanded.any(axis=1)]
    np.testing.assert_allclose(moving[: len(planned)], planned, atol=1e-12)


def test_without_a_tolerance_noisy_rates_are_taken_for_drift() -> None:
    with pytest.raises(PlanningError, match="drifts"):
        slide(**{"plant.sensors.velocity_noise": 1e-3})


SURVIVED = {
    "a slow joint": "joint_slow slider_1 0.5 at 1",
    "a very slow joint": "joint_slow slider_2 0.1 at 1 until 4",
    "a joint that sticks for less than a second": "joint_stuck slider_1 at 2 until 2.5",
    "a biased actuator": "actuator_bias slider_2 0.002 at 0.5",
    "a noisy actuator": "actuator_noise slider_3 0.01",
    "no pose in flight": "sensor_dropout odom at 0.5 until 10",
    "no pose when the gait ends": "sensor_dropout odom at 10 until 20",
    "a shift of the joint sensor": "sensor_bias slider_1 0.001 at 1",
    "noise for a while": "sensor_noise attitude 0.05 at 1 until 9",
}


@pytest.mark.parametrize("fault", some_fast(SURVIVED, "no pose in flight"))
def test_the_goal_is_met_in_spite_of(fault: str) -> None:
    flight = slide(fault, averaging=15, max_corrections=6)
    assert_met(flight)
    assert not any("stuck" in status.message for _, status in flight.statuses)


@pytest.mark.parametrize("seed", some_fast({str(k): k for k in range(4)}, "0"))
def test_wrong_masses_cost_corrections_and_not_the_goal(seed: int) -> None:
    flight = slide(
        model_error=0.1,
        model_error_seed=seed,
        max_corrections=6,
        position_tolerance=1e-3,
        attitude_tolerance=1e-3,
    )
    assert_met(flight)
    assert flight.corrections >= 1
    assert flight.momentum_drift.max() < 1e-12, "the plant knows its masses"


THERE = [0.1, 0.05, 0.0], [0.0, 0.0, 0.1]


def controlled(fault: str, time_limit: float) -> Flight:
    """Return a flight of a planar arm whose plant has a fault."""
    within = {"position_tolerance": 5e-3, "attitude_tolerance": 5e-3, "settle_time": 0.5}
    control = {"tick_rate": 50.0, "time_limit": time_limit, **within}
    parameters = {
        "plant.tick_rate": 50.0,
        "plant.initial_joint_positions": [-1.0, 1.0],
        "plant.faults": [fault],
        **{f"coordinated_control.{name}": value for name, value in control.items()},
    }
    robot = SpaceRobot.from_file(robot_file("planar_manipulator"))
    method = "transposed_jacobian"
    return fly(robot, THERE[0], rotvec=THERE[1], method=method, parameters=parameters)


CONTROLLED = {
    "weak thrusters": "thruster_weak all 0.5",
    "thrusters off for a while": "thruster_off all at 1 until 3",
    "a thruster stuck on for a while": "thruster_stuck force_y 5 at 1 until 3",
    "a weak joint motor": "joint_slow shoulder 0.3",
    "a noisy motor": "actuator_noise elbow 0.2",
    "a jammed joint": "joint_stuck elbow at 1 until 4",
    "no pose for a while": "sensor_dropout odom at 1 until 1.6",
    "a short delay": "sensor_delay odom 0.04",
}


@pytest.mark.slow
@pytest.mark.parametrize("fault", CONTROLLED.values(), ids=CONTROLLED)
def test_control_holds_in_spite_of(fault: str) -> None:
    flight = controlled(fault, 60.0)
    assert flight.outcome is Outcome.REACHED, flight.message
    assert max(true_error(flight, THERE)) <= 0.02
    assert flight.momentum_drift.max() < 1e-8


@pytest.mark.slow
def test_a_thruster_that_stays_on_is_too_much_and_said() -> None:
    flight = controlled("thruster_stuck force_y 3", 8.0)
    assert flight.outcome is Outcome.ABORTED
    assert "control is lost" in flight.message
